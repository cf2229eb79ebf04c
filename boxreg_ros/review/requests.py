"""Values of the requests of the page, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import re
from typing import Any

import anyio
from boxreg_ros.errors import RecordingError
from boxreg_ros.structures import Floats
import numpy as np
import orjson
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

MAX_BODY = 2**23
"""Longest request [bytes]: one decision about a track whose id has 1 MB, several times over."""
BODY_SECONDS = 20.0
"""The body of a request is received within this time; chosen."""
STAMP = re.compile(r'-?[0-9]{1,19}')


async def json_of(request: Request) -> Mapping[str, Any]:
    """Return the object that a request has sent; RecordingError if it is none."""
    if request.headers.get('content-type') != 'application/json':  # no form of another page
        raise HTTPException(415, 'expected application/json')
    body = bytearray()
    try:
        with anyio.fail_after(BODY_SECONDS):
            async for part in request.stream():
                body += part
                if len(body) > MAX_BODY:
                    raise HTTPException(413, f'expected at most {MAX_BODY:,} bytes')
    except TimeoutError:
        raise HTTPException(408, f'expected the request within {BODY_SECONDS:g} s') from None
    try:
        sent = orjson.loads(body)
    except ValueError as error:
        raise RecordingError(f'request: expected JSON, got: {error}') from None
    if not isinstance(sent, dict):
        raise RecordingError('request: expected an object')
    return sent


def posted(answer: Callable[[Mapping[str, Any]], bytes | Response]) -> Callable[[Request], Any]:
    """Return the endpoint of requests whose object is answered in a thread, by JSON as bytes."""

    async def endpoint(request: Request) -> Response:
        found = await run_in_threadpool(answer, await json_of(request))
        if isinstance(found, Response):
            return found
        return Response(found, media_type='application/json')

    return endpoint


def text_of(sent: Mapping[str, Any], name: str) -> str:
    """Return a text; empty if there is none."""
    value = sent.get(name, '')
    if not isinstance(value, str):
        raise RecordingError(f'{name}: expected a text, got {value!r:.80}')
    return value


def stamp_of(sent: Mapping[str, Any], name: str) -> int | None:
    """Return a stamp [ns]; None if there is none."""
    text = text_of(sent, name)
    if text and not STAMP.fullmatch(text):
        raise RecordingError(f'{name}: expected nanoseconds, got {text!r:.80}')
    return int(text) if text else None


def box_of(sent: object) -> Floats:
    """Return a box (9,)."""
    return numbers_of(sent, 'box', 9)


def numbers_of(sent: object, name: str, count: int) -> Floats:
    """Return numbers (`count`,); RecordingError if there are not so many, or they are none."""
    if not isinstance(sent, list) or not all(type(one) in (int, float) for one in sent):
        raise RecordingError(f'{name}: expected {count} numbers, got {sent!r:.80}')
    if len(sent) != count:
        raise RecordingError(f'{name}: expected {count} numbers, got {len(sent)}')
    return np.array(sent, np.float64)

"""HTTP connections that end if a client does not send a request in time."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_SECONDS = 20.0
"""A request, its body included, is received within this time; chosen."""


class TimedProtocol(H11Protocol):
    """Close a connection on which no whole request arrives within `REQUEST_SECONDS`."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._answered: Any = None
        self._expire_later()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._timer.cancel()
        super().connection_lost(exc)

    def _expire_later(self) -> None:
        self._timer = self.loop.call_later(REQUEST_SECONDS, self._expire)

    def _expire(self) -> None:
        """Close the connection unless a request has been received since the last time."""
        cycle = self.cycle
        is_received = cycle is not None and not cycle.more_body
        is_new = cycle is not self._answered or (cycle is not None and not cycle.response_complete)
        if not (is_received and is_new):
            self.transport.close()
            return
        self._answered = cycle
        self._expire_later()

#!/usr/bin/env bash
# guess: importing Dask's distributed leaves alone what pickle makes of the exceptions of others
# happens: with it comes tblib, which lets pickle follow __context__: an error raised in place of one of aiohttp (`from None`) is 48 bytes before the import, and cannot be pickled after it (TypeError)
# versions: distributed 2026.8.0, tblib 3.2.2, aiohttp 3.14.5
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check distributed==2026.8.0 tblib==3.2.2 aiohttp==3.14.5
cat > "$folder/errors.py" <<'PYTHON'
import asyncio
import pickle

import aiohttp
from aiohttp import web


async def answered_500():
    application = web.Application()

    async def fails(_):
        return web.Response(status=500)

    application.router.add_get('/', fails)
    runner = web.AppRunner(application)
    await runner.setup()
    await web.TCPSite(runner, '127.0.0.1', 0).start()
    port = runner.addresses[0][1]
    try:
        async with aiohttp.ClientSession() as session, session.get(f'http://127.0.0.1:{port}/') as answer:
            answer.raise_for_status()
    finally:
        await runner.cleanup()


def pickled(error):
    try:
        return f'{len(pickle.dumps(error))} bytes'
    except Exception as problem:
        return f'{type(problem).__name__}: {problem}'


try:
    try:
        asyncio.run(answered_500())
    except aiohttp.ClientResponseError:
        raise RuntimeError('x') from None
except RuntimeError as error:
    own = error

before = pickled(own)
import distributed  # noqa: E402

after = pickled(own)
print('distributed', distributed.__version__, 'aiohttp', aiohttp.__version__)
print('before the import:', before)
print('after it:', after)
assert before == '48 bytes', before
assert after.startswith('TypeError'), after
PYTHON
"$folder/venv/bin/python" "$folder/errors.py"

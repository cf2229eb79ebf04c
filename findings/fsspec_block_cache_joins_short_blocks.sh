#!/usr/bin/env bash
# guess: where a server answers a range with fewer bytes (206, with a right Content-Range), fsspec asks
#        for the rest or raises an error, whatever its cache.
# happens: the caches "readahead" and "bytes" read on; "blockcache" and "background" keep the short
#          block as whole and join the next one to it: bytes of a later place, without an error.
# versions: fsspec 2026.9.0, aiohttp 3.14.5
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check fsspec==2026.9.0 aiohttp==3.14.5
"$folder/venv/bin/python" - <<'PYTHON'
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from threading import Thread

import fsspec

print('fsspec', version('fsspec'), 'aiohttp', version('aiohttp'))
BLOCK = 2**16
CONTENT = bytes(i % 251 for i in range(4 * BLOCK))


class Server(BaseHTTPRequestHandler):
    """Sends half of a range that begins at the second block."""

    def do_HEAD(self):
        self.answer()

    def do_GET(self):
        self.wfile.write(self.answer())

    def answer(self):
        asked = self.headers.get('Range')
        first, last = 0, len(CONTENT) - 1
        if asked:
            first, end = map(int, asked.removeprefix('bytes=').split('-'))
            last = min(end, last)
            if first == BLOCK:
                last = (first + last) // 2
        self.send_response(206 if asked else 200)
        self.send_header('Accept-Ranges', 'bytes')
        self.send_header('Content-Length', str(last - first + 1))
        if asked:
            self.send_header('Content-Range', f'bytes {first}-{last}/{len(CONTENT)}')
        self.end_headers()
        return CONTENT[first : last + 1]

    def log_message(self, *_):
        pass


server = ThreadingHTTPServer(('127.0.0.1', 0), Server)
Thread(target=server.serve_forever, daemon=True).start()
url = f'http://127.0.0.1:{server.server_port}/file'
begin = BLOCK + 1000
right = CONTENT[begin : begin + 2 * BLOCK]
outcomes = {}
for cache in ('readahead', 'bytes', 'blockcache', 'background'):
    with fsspec.open(url, 'rb', block_size=BLOCK, cache_type=cache) as file:
        file.seek(begin)
        read = file.read(2 * BLOCK)
    outcomes[cache] = 'right' if read == right else f'{len(read)} bytes, wrong'
    assert read == right or read != right[: len(read)]
    print(f'{cache}: {outcomes[cache]}')
assert [cache for cache, text in outcomes.items() if text != 'right'] == ['blockcache', 'background']
PYTHON

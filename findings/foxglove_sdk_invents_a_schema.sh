#!/usr/bin/env bash
# guess: a channel of JSON that is made without a schema has none in the file (schema id 0).
# happens: it gets a schema of the encoding "jsonschema" without content, under a made-up name, so the
#          name of the schema says nothing of the message.
# versions: foxglove-sdk 0.30.3, mcap 1.6.0
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check foxglove-sdk==0.30.3 mcap==1.6.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from foxglove import Channel, open_mcap
from mcap.reader import make_reader

print('foxglove-sdk', version('foxglove-sdk'), 'mcap', version('mcap'))
writer = open_mcap('file.mcap')
channel = Channel('/speed', message_encoding='json')
channel.log({'speed': 2}, log_time=1_000_000_000)
writer.close()
with open('file.mcap', 'rb') as file:
    (channel,) = make_reader(file).get_summary().channels.values()
    (schema,) = make_reader(file).get_summary().schemas.values()
print('schema id', channel.schema_id, schema)
assert channel.schema_id == schema.id != 0
assert (schema.encoding, schema.data) == ('jsonschema', b'')
assert 'speed' not in schema.name
PYTHON

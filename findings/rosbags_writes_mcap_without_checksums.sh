#!/usr/bin/env bash
# guess: an MCAP file written by rosbags has the checksums of its chunks, as those of rosbag2 and mcap.
# happens: those of chunks, data and summary are all 0, which means "not written"; validate_crcs=True
#          of mcap then reads a changed byte without an error.
# versions: rosbags 0.11.9, mcap 1.6.0
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check rosbags==0.11.9 mcap==1.6.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
from io import BytesIO
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Chunk, DataEnd, Footer
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

print('rosbags', version('rosbags'), 'mcap', version('mcap'))
store = get_typestore(Stores.ROS2_JAZZY)
kind = 'std_msgs/msg/String'
with Writer(Path('drive'), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    connection = writer.add_connection('/text', kind, typestore=store)
    message = store.types[kind](data='unchanged')
    writer.write(connection, 1, store.serialize_cdr(message, kind))
content = next(Path('drive').glob('*.mcap')).read_bytes()
records = list(StreamReader(BytesIO(content), emit_chunks=True).records)
checksums = {
    'chunk': [r.uncompressed_crc for r in records if isinstance(r, Chunk)],
    'data': [r.data_section_crc for r in records if isinstance(r, DataEnd)],
    'summary': [r.summary_crc for r in records if isinstance(r, Footer)],
}
print('checksums:', checksums)
assert set(sum(checksums.values(), [])) == {0} and all(checksums.values())
changed = content.replace(b'unchanged', b'unchained')
((_, _, read),) = make_reader(BytesIO(changed), validate_crcs=True).iter_messages()
print('read with validate_crcs:', read.data)
assert changed != content and b'unchained' in read.data
PYTHON

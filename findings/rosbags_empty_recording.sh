#!/usr/bin/env bash
# guess: a recording without messages begins and ends at the same time, and lasts 0 ns
# happens: it begins at the largest 64-bit number and ends at 0, so that its duration is negative
# versions: rosbags 0.11.9
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
from importlib.metadata import version
from pathlib import Path
import sys

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

print('rosbags', version('rosbags'))
store = get_typestore(Stores.ROS2_JAZZY)
found = {}
for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
    path = Path(sys.argv[1]) / plugin.name.lower()
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        writer.add_connection('/text', 'std_msgs/msg/String', typestore=store)
    with AnyReader([path]) as reader:
        found[path.name] = reader.start_time, reader.end_time, reader.duration
        assert list(reader.messages()) == []
for name, times in found.items():
    print(f'{name}: start, end, duration [ns] {times}')
assert set(found.values()) == {(2**63 - 1, 0, 1 - 2**63)}
PYTHON

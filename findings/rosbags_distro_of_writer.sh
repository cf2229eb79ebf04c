#!/usr/bin/env bash
# guess: `ros_distro` of metadata.yaml names the ROS distribution whose message types were written
# happens: it is the text "rosbags", whatever the types are; the hash of each type is that of ROS
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

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from ruamel.yaml import YAML

print('rosbags', version('rosbags'))
distros = {}
for stock in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED):
    store = get_typestore(stock)
    path = Path(sys.argv[1]) / stock.value
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/text', 'std_msgs/msg/String', typestore=store)
        kind = store.types['std_msgs/msg/String']
        writer.write(connection, 1, store.serialize_cdr(kind('a'), 'std_msgs/msg/String'))
    about = YAML(typ='safe').load(path / 'metadata.yaml')['rosbag2_bagfile_information']
    (topic,) = about['topics_with_message_count']
    distros[stock.value] = about['ros_distro']
    print(stock.value, repr(about['ros_distro']), topic['topic_metadata']['type_description_hash'])
assert set(distros.values()) == {'rosbags'}
PYTHON

"""MCAP files whose definitions are IDL, and MCAP files with messages of ROS 1."""

from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import BoxArray
from mcap.writer import Writer
import numpy as np
import pytest
from ros_messages import Drive, Messages
from rosbags.interfaces import Nodetype

SEPARATOR = '=' * 80
IDL_NAMES = {'float32': 'float', 'float64': 'double', 'bool': 'boolean', 'byte': 'octet'}
IDL_NAMES |= {f'int{n}': f'int{n}' for n in (8, 16, 32, 64)}
IDL_NAMES |= {f'uint{n}': f'uint{n}' for n in (8, 16, 32, 64)}


def idl_of(store, kind, found=None):
    """Return the definition of a type and of those in it, as rosbag2 writes ``ros2idl``."""
    found = {} if found is None else found
    package, _, name = kind.split('/')
    lines = []
    for field, node in store.fielddefs[kind][1]:
        element = node[1][0] if node[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else node
        if element[0] == Nodetype.NAME:
            inner = '::'.join(element[1].split('/'))
            idl_of(store, element[1], found)
        else:
            inner = IDL_NAMES.get(element[1][0], element[1][0])
        if node[0] == Nodetype.SEQUENCE:
            inner = f'sequence<{inner}>'
        size = f'[{node[1][1]}]' if node[0] == Nodetype.ARRAY else ''
        lines.append(f'{inner} {field}{size};')
    body = ' '.join(lines) or 'uint8 structure_needs_at_least_one_member;'
    text = f'module {package} {{ module msg {{ struct {name} {{ {body} }}; }}; }};'
    found[kind] = f'{SEPARATOR}\nIDL: {kind}\n{text}\n'
    return ''.join(found.values())


def written(path, drive, profile, encoding, schema_of, to_bytes):
    """Write a drive by the mcap library, with other schemas."""
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile)
        channels = {}
        for topic, received, message in drive.items:
            kind = message.__msgtype__
            if topic not in channels:
                name, text = schema_of(kind)
                number = writer.register_schema(name, f'{profile}{encoding}', text.encode())
                wire = 'ros1' if profile == 'ros1' else 'cdr'
                channels[topic] = writer.register_channel(topic, wire, number)
            writer.add_message(channels[topic], received, bytes(to_bytes(message, kind)), received)
        writer.finish()
    return path


def boxes_of(path):
    """Return the boxes (n, 9) of a recording, in the order of their messages."""
    tree = TransformTree()
    with Recording([path]) as recording:
        recording.choose_fixed_frame(tree)
        items = [item.content for item in recording.items(tree)]
        assert not recording.unreadable
    return np.concatenate([item.boxes for item in items if isinstance(item, BoxArray)])


@pytest.mark.parametrize('boxes', ['vision', 'markers'])
def test_definitions_in_idl(tmp_path, boxes):
    drive = Drive(sweeps=3, boxes=boxes)
    store = drive.messages.store
    path = written(
        tmp_path / 'idl.mcap', drive, 'ros2', 'idl', lambda kind: (kind, idl_of(store, kind)),
        store.serialize_cdr,
    )  # fmt: skip
    expected = boxes_of(drive.write(tmp_path / 'drive'))
    assert expected.shape == (6, 9)
    np.testing.assert_array_equal(boxes_of(path), expected)


def test_messages_of_ros1(tmp_path):
    drive = Drive(sweeps=3, boxes='markers', ros1=True)
    store = Messages(ros1=True).store

    def schema_of(kind):
        return kind.replace('/msg/', '/'), store.generate_msgdef(kind, ros_version=1)[0]

    path = written(tmp_path / 'ros1.mcap', drive, 'ros1', 'msg', schema_of, store.serialize_ros1)
    expected = boxes_of(drive.write(tmp_path / 'drive', 'rosbag1'))
    assert expected.shape == (6, 9)
    np.testing.assert_array_equal(boxes_of(path), expected)

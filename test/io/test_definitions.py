"""Recordings without message definitions, or with those of another release or language."""

from contextlib import closing
import sqlite3

from boxreg_ros.io.definitions import types_of
from boxreg_ros.io.items import Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import BoxArray
from msg_adapters import ADAPTERS
from msg_adapters.convention import Convention
import numpy as np
import pytest
from ros_messages import (
    DETECTIONS,
    Drive,
    MARKERS,
    Messages,
    OBJECTS,
    START,
    with_interfaces,
    write_recording,
)
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import get_typestore, Stores

ASSOCIATE = Convention(associate=True)


def without_definitions(folder):
    """Make the database of a recording one of ROS 2 Humble, which has no definitions."""
    (database,) = folder.glob('*.db3')
    with closing(sqlite3.connect(database)) as opened, opened:
        opened.execute('DROP TABLE message_definitions')
        opened.execute('ALTER TABLE topics DROP COLUMN type_description_hash')
        opened.execute("UPDATE schema SET schema_version = 3, ros_distro = 'humble'")
    return folder


def boxes_of(recording):
    """Return the box arrays of an open recording, all of whose messages are readable."""
    items = recording.items(TransformTree(), Wanted(clouds=False))
    found = [item.content for item in items if isinstance(item.content, BoxArray)]
    assert not recording.unreadable
    return found


def older_messages(stock):
    """Return the messages of an older release of ROS 2."""
    messages = Messages()
    messages.store = with_interfaces(get_typestore(stock), ('foxy', 'humble', 'jazzy'))
    return messages


def older_boxes(messages, kind, stamp_ns, count=2):
    """Return boxes as an older release has them, of tracks 1 and 2 at x = 11 and 12."""
    found = [(n, ((10.0 + n, 2.0, 0.5), (0, 0, 0, 1)), (4.5, 1.8, 1.6)) for n in (1, 2)][:count]
    if kind != DETECTIONS:
        return messages.boxes(kind, stamp_ns, 'lidar', found)
    header = messages.header(stamp_ns, 'lidar')
    items = [
        {
            'header': header, 'is_tracking': True, 'tracking_id': str(n),
            'results': [{'id': 'car', 'score': 0.9, 'pose': {'pose': messages.pose(*pose)}}],
            'bbox': {'center': messages.pose(*pose), 'size': messages.vector(*size)},
        }
        for n, pose, size in found
    ]  # fmt: skip
    return messages.build(kind, header=header, detections=items)


def write_older(path, kind, stock, counts=(2, 2)):
    """Write clouds and boxes of an older release as a database without definitions."""
    messages = older_messages(stock)
    items = []
    for k, count in enumerate(counts):
        stamp_ns = START + k * 10**8
        items.append(('/points', stamp_ns, messages.points(stamp_ns, 'lidar', np.ones((4, 3)))))
        items.append(('/boxes', stamp_ns, older_boxes(messages, kind, stamp_ns, count)))
    return without_definitions(write_recording(path, items, 'sqlite3', messages))


@pytest.mark.parametrize('kind', ADAPTERS)
def test_types_that_are_read_need_no_definition_in_the_recording(tmp_path, kind):
    path = Drive(sweeps=2, boxes=kind).write(tmp_path / 'drive', 'sqlite3')
    with Recording([path], boxes='/boxes', convention=ASSOCIATE) as recording:
        expected = boxes_of(recording)
    assert expected[0].boxes.shape == (2, 9)
    without_definitions(path)
    with Recording([path], boxes='/boxes', convention=ASSOCIATE) as recording:
        found = boxes_of(recording)
        assert 'Foxy' not in recording.finding
    for one, other in zip(found, expected, strict=True):
        assert (one.stamp_ns, one.track_ids) == (other.stamp_ns, other.track_ids)
        np.testing.assert_array_equal(one.boxes, other.boxes)


@pytest.mark.parametrize(
    ('kind', 'stock', 'releases'),
    [
        (MARKERS, Stores.ROS2_FOXY, 'Foxy to Galactic'),
        (MARKERS, Stores.ROS2_GALACTIC, 'Foxy to Galactic'),
        (DETECTIONS, Stores.ROS2_FOXY, 'Foxy'),
        (OBJECTS, Stores.ROS2_GALACTIC, 'Foxy to Galactic'),
    ],
)
def test_the_definition_that_messages_fit_is_chosen_and_said(tmp_path, kind, stock, releases):
    path = write_older(tmp_path / 'older', kind, stock, counts=(0, 2, 1))
    with Recording([path]) as recording:
        found = boxes_of(recording)
        assert recording.finding == (
            f'/boxes: the recording has no definition of {kind}; its messages are read as those '
            f'of ROS 2 {releases}, the only known definition that they fit'
        )
    assert [boxes.track_ids for boxes in found] == [(), ('1', '2'), ('1',)]
    np.testing.assert_allclose(found[1].boxes[:, :6], [[11, 2, 0.5, 4.5, 1.8, 1.6],
                                                       [12, 2, 0.5, 4.5, 1.8, 1.6]])  # fmt: skip
    assert found[1].class_names == ('car', 'car')


def test_refined_boxes_of_an_older_release_are_written_as_that_release_has_them(tmp_path):
    path = write_older(tmp_path / 'older', DETECTIONS, Stores.ROS2_FOXY)
    with Recording([path]) as recording:
        (connection,) = recording._topics.connections({'/boxes'})
        record = next(iter(recording._read({'/boxes'})))
        message, boxes = recording.box_message(connection, record.data)
        covariances = np.full((2, 6, 6), np.nan)
        written = recording.with_boxes(connection, message, boxes, covariances)
        assert written == record.data
        text, _ = recording.decoder.store_of(connection).generate_msgdef(DETECTIONS, ros_version=2)
    assert 'tracking_id' in text


def test_each_file_has_its_own_definition_of_a_type(tmp_path):
    old = older_messages(Stores.ROS2_FOXY)
    new = Messages()
    paths = []
    for k, messages in enumerate((old, new)):
        stamp_ns = START + k * 10**8
        items = [
            ('/points', stamp_ns, messages.points(stamp_ns, 'lidar', np.ones((4, 3)))),
            ('/boxes', stamp_ns, older_boxes(messages, MARKERS, stamp_ns)),
        ]
        paths.append(write_recording(tmp_path / f'part_{k}', items, 'mcap', messages))
    with Recording(paths) as recording:
        found = boxes_of(recording)
        assert recording.finding == ''
    assert [boxes.boxes[1, 0] for boxes in found] == [12, 12]


def test_one_folder_may_have_files_of_different_definitions(tmp_path):
    folder = tmp_path / 'drive'
    folder.mkdir()
    for k, messages in enumerate((older_messages(Stores.ROS2_FOXY), Messages())):
        stamp_ns = START + k * 10**8
        items = [
            ('/points', stamp_ns, messages.points(stamp_ns, 'lidar', np.ones((4, 3)))),
            ('/boxes', stamp_ns, older_boxes(messages, MARKERS, stamp_ns)),
        ]
        path = write_recording(tmp_path / f'part_{k}', items, 'mcap', messages)
        path.rename(folder / f'drive_{k}.mcap')
    with Recording([folder]) as recording:
        assert [boxes.boxes[1, 0] for boxes in boxes_of(recording)] == [12, 12]


IDL = """// generated from rosidl_adapter
#include "std_msgs/msg/Header.idl"
  #include "shapes/msg/Side.idl"

module shapes {
  module msg {
    module Shape_Constants {
      const uint8 BOX = 1;
      @verbatim (language="comment", text="#include is a word here")
      const string NAME = "# no directive";
    };
    typedef double double__9[9];
    @verbatim (language="comment", text=
      " first line" "\\n"
      "# second line; }; (")
    struct Shape {
      std_msgs::msg::Header header;
      @default (value=TRUE)
      boolean is_closed;
      @key
      uint32 number; // # as long as it lasts
      string<16> name;
      wstring<8> title;
      sequence<shapes::msg::Side, 4> sides;
      double__9 matrix;
    };
  };
};
"""


def test_definitions_in_idl_may_include_others():
    types = types_of('shapes/msg/Shape', MessageDefinition(MessageDefinitionFormat.IDL, IDL))
    constants, fields = types['shapes/msg/Shape']
    assert constants == [('BOX', 'uint8', 1), ('NAME', 'string', '# no directive')]
    names = [name for name, _ in fields]
    assert names == ['header', 'is_closed', 'number', 'name', 'title', 'sides', 'matrix']


@pytest.mark.parametrize(
    'text',
    [
        'uint8 A=1\r\nuint8 x\r\n',
        '\ufeffuint8 x',
        'uint8 x\n' + 80 * '=' + '\nMSG: other_msgs/Unread\nwstring<=10 text',
        'string<=10[<=5] names\nuint8 x 5\nstring text "a # b"\nfloat32[] list [1.0, 2.0]',
    ],
    ids=['line ends of Windows', 'byte order mark', 'another that rosbags refuses', 'bounds'],
)
def test_definitions_in_msg_of_other_writers(text):
    types = types_of('a/msg/B', MessageDefinition(MessageDefinitionFormat.MSG, text))
    assert 'x' in [name for name, _ in types['a/msg/B'][1]]

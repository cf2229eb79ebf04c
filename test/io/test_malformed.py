"""Malformed messages are counted as unreadable; errors in this package are raised."""

import copy
import json

from boxreg_ros.cli import main
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.message_decoder import ENCAPSULATIONS
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.transform_tree import TransformTree
from foxglove_recordings import write_foxglove_mcap
from mcap.reader import make_reader
from msg_adapters import ADAPTERS, pointcloud, vision
from msg_adapters.convention import Convention
from msg_adapters.serialized import BoxReader
import numpy as np
import pytest
from ros_messages import DETECTIONS, Drive, SCENE

BYTES = (0, 1, 127, 128, 255)


def corrupted(data, rng):
    """Return the bytes of a message, cut off or with some bytes replaced."""
    if rng.random() < 0.3:
        return data[: rng.integers(len(data))]
    changed = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        end = (
            len(data) if rng.random() < 0.5 else min(len(data), 200)
        )  # sizes are in the first bytes
        changed[rng.integers(4, end)] = rng.choice(BYTES)
    return bytes(changed)


def outcomes(recording, record, changed):
    """Decode each of `changed` in place of a record; return the number of successes."""
    decoded = 0
    for data in changed:
        tampered = Record(record.connection, record.received_ns, data)
        if record.connection.topic == '/tf':
            before = recording.unreadable.total()
            recording._follow(TransformTree(), tampered)
            decoded += recording.unreadable.total() == before
        else:
            decoded += recording._contents.item(tampered, (), with_intensities=True) is not None
    return decoded


@pytest.mark.parametrize('topic', ['/points', '/tf', *ADAPTERS])
def test_corrupted_bytes_are_unreadable_or_decoded(tmp_path, topic):
    drive = Drive(sweeps=1, boxes=topic if topic in ADAPTERS else 'vision')
    path = drive.write(tmp_path / 'drive')
    topic = '/boxes' if topic in ADAPTERS else topic
    rng = np.random.default_rng(0)
    with Recording([path], convention=Convention(associate=True)) as recording:
        record = next(recording._read({topic}))
        changed = [corrupted(bytes(record.data), rng) for _ in range(300)]
        assert 0 < outcomes(recording, record, changed) < 300
        cut_off = [bytes(record.data[:size]) for size in range(12)]
        assert outcomes(recording, record, cut_off) == 0


@pytest.mark.parametrize('kind', ['PL_CDR', 'XCDR2', 'D_CDR2', 'PL_CDR2'])
def test_encodings_of_dds_that_are_not_plain_cdr_are_refused_by_name(tmp_path, kind):
    """They may parse as plain CDR, too: XCDR2 aligns numbers of 8 bytes to 4, so values differ."""
    drive = Drive(sweeps=1)
    message = drive.items[-1][2]
    with Recording([drive.write(tmp_path / 'drive')]) as recording:
        record = next(recording._read({'/boxes'}))
        for head in (head for head, name in ENCAPSULATIONS.items() if name == kind):
            with pytest.raises(UnsupportedMessage, match=f'expected plain CDR, .* got {kind};'):
                recording.box_message(record.connection, head + bytes(record.data)[2:])
        store = drive.messages.store
        of_big_endian = bytes(store.serialize_cdr(message, DETECTIONS, little_endian=False))
        found = recording.box_message(record.connection, of_big_endian)[1]
        np.testing.assert_array_equal(found.boxes, vision.from_msg(message).boxes)


def tampered_json(value, rng):
    """Return a JSON value with one field removed or replaced."""
    value = copy.deepcopy(value)
    holder = value
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        key = keys[rng.integers(len(keys))]
        inner = holder[key]
        if isinstance(inner, dict | list) and inner and rng.random() < 0.8:
            holder = inner
            continue
        if isinstance(holder, dict) and rng.random() < 0.3:
            del holder[key]
        else:
            wrong = [None, 'text', -1, 10**400, 1e300, True, [], {}, [1], float('nan')]
            holder[key] = wrong[rng.integers(len(wrong))]
        return value


@pytest.mark.parametrize('topic', ['/boxes', '/points', '/tf'])
def test_json_of_wrong_types_is_unreadable_or_decoded(tmp_path, topic):
    encodings = dict.fromkeys(('/boxes', '/points', '/tf'), 'json')
    path = write_foxglove_mcap(tmp_path / 'drive.mcap', Drive(sweeps=1, boxes=SCENE), encodings)
    with path.open('rb') as file:
        raw = json.loads(next(make_reader(file).iter_messages(topic))[2].data)
    rng = np.random.default_rng(0)
    with Recording([path]) as recording:
        record = next(recording._read({topic}))
        changed = [json.dumps(tampered_json(raw, rng)).encode() for _ in range(300)]
        changed += [b'{', b'{"entities": [' * 10_000, b'{"a": "\xff"}', b'{}']
        assert 0 < outcomes(recording, record, changed) < len(changed) - 2


def own_fault(kind):
    """Return an adapter function that raises an exception."""

    def from_msg(message, *_):
        if kind is AttributeError:
            return np.a_function_that_old_versions_lack(message)
        if kind is TypeError:
            return np.zeros(3, no_such_argument=True)
        return {}['missing']

    return from_msg


@pytest.mark.parametrize('kind', [AttributeError, TypeError, KeyError])
@pytest.mark.parametrize('reads', [(BoxReader, 'boxes_of'), (pointcloud, 'from_msg')])
def test_an_error_in_an_adapter_is_raised_and_not_counted_as_unreadable(
    tmp_path, monkeypatch, capsys, reads, kind
):
    path = Drive(sweeps=2).write(tmp_path / 'drive')
    monkeypatch.setattr(*reads, own_fault(kind))
    recording = Recording([path])
    with pytest.raises(kind), recording:
        list(recording.items(TransformTree()))
    assert not recording.unreadable
    command = ['relabel', str(path), '-o', str(tmp_path / 'out')]
    assert main(command) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert kind.__name__ in line and '--debug' in line
    with pytest.raises(kind) as caught:
        main([*command, '--debug'])
    assert 'test_malformed' in caught.value.__notes__[0]  # traceback of the reading process


def test_a_field_that_the_definition_lacks_is_unreadable(tmp_path):
    path = Drive(sweeps=1).write(tmp_path / 'drive')
    with Recording([path]) as recording:
        record = next(recording._read({'/boxes'}))
        message = recording.decoder.message(record)
        del message.detections[0].bbox.__dict__['size']
        with pytest.raises(UnsupportedMessage, match=r"topic '/boxes'.*field 'size'"):
            recording._contents.of('/boxes', message)

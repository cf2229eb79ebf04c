"""Damaged recordings: the whole parts are read and the others listed, or a tool is named."""

from collections import Counter
from contextlib import closing
from io import BytesIO
import json
import os
import random
import shutil
import sqlite3
import struct

from boxreg_ros.cli import main
from boxreg_ros.errors import BoxregError, RecordingError
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage import mcap
from boxreg_ros.io.storage.files import opened
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import BoxArray, Sweep
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_files import rewritten
import pytest
from ros_messages import Drive, SECOND, START, write_recording
from rosbags.rosbag2 import CompressionMode
import zstandard

MAGIC_BYTES = 8


def read(path, **options):
    """Return the stamps of sweeps and boxes, and the damages of a recording."""
    tree = TransformTree()
    with Recording([path], **options) as recording:
        recording.choose_fixed_frame(tree)
        items = [item.content for item in recording.items(tree)]
        damages = recording.damages
    sweeps = [item.stamp_ns for item in items if isinstance(item, Sweep)]
    return sweeps, [item.stamp_ns for item in items if isinstance(item, BoxArray)], damages


@pytest.fixture
def drive():
    return Drive(sweeps=12)


@pytest.fixture
def whole(tmp_path, drive):
    """Return an MCAP file of one message per chunk."""
    return rewritten(drive.write(tmp_path / 'drive'), tmp_path / 'whole.mcap')


def chunk_places(path):
    with path.open('rb') as file:
        indexes = make_reader(file).get_summary().chunk_indexes
    return [(i.chunk_start_offset, i.chunk_length) for i in indexes]


# MCAP ------------------------------------------------------------------------------------------


@pytest.mark.parametrize('known', [b'', b'\1\0'])
def test_a_record_that_lacks_its_fields_is_not_made_of_the_bytes_behind(known):
    length = len(known) + len(mcap.END)
    head = struct.pack('<BQ', Opcode.MESSAGE, length)
    with pytest.raises(EndOfFile):
        mcap._records_in(BytesIO(head + known), len(head + known))


@pytest.mark.parametrize('options', [
    {'compression': CompressionType.LZ4},
    {'compression': CompressionType.NONE},
    {'use_chunking': False},
    {'use_summary_offsets': False, 'use_statistics': False},
    {'repeat_channels': False, 'repeat_schemas': False},
    {'enable_crcs': False},
])  # fmt: skip
def test_every_layout_of_mcap_is_read(tmp_path, drive, whole, options):
    path = rewritten(whole, tmp_path / 'layout.mcap', **options)
    assert read(path) == (drive.stamps, drive.stamps, [])


def test_a_truncated_file_is_read_up_to_its_end(tmp_path, drive, whole):
    places = chunk_places(whole)
    cut = tmp_path / 'cut.mcap'
    middle = sum(places[len(places) // 2]) - 10
    cut.write_bytes(whole.read_bytes()[:middle])
    sweeps, boxes, damages = read(cut)
    assert 2 < len(sweeps) < 12
    assert sweeps == drive.stamps[: len(sweeps)]
    assert boxes == drive.stamps[: len(boxes)]
    assert damages[0].first_byte == places[len(places) // 2][0]
    assert damages[0].end_byte == middle
    assert damages[0].start_ns in drive.stamps
    assert damages[0].reason.startswith('interrupted or damaged: no whole record from here on')
    assert 'mcap recover' in damages[0].reason
    assert len(damages) == 1


def test_a_truncated_file_without_chunks_is_read_up_to_its_end(tmp_path, drive, whole):
    path = rewritten(whole, tmp_path / 'flat.mcap', use_chunking=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    sweeps, _, damages = read(path)
    assert 2 < len(sweeps) < 12
    assert sweeps == drive.stamps[: len(sweeps)]
    assert damages


def test_a_chunk_that_claims_too_much_is_left_out(tmp_path, whole):
    data = bytearray(whole.read_bytes())
    first, _ = chunk_places(whole)[5]
    at = first + 9 + 16  # opcode and length; first and last time
    data[at : at + 8] = struct.pack('<Q', 2**31)
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(data)
    _, _, damages = read(path)
    assert damages[0].first_byte == first
    assert 'size of 2147483648 bytes' in damages[0].reason


@pytest.mark.parametrize('has_index', [True, False])
def test_a_damaged_chunk_is_left_out(tmp_path, drive, whole, has_index):
    first, length = chunk_places(whole)[5]
    data = bytearray(whole.read_bytes())
    data[first + length // 2] ^= 0xFF
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(data if has_index else data[:-300])
    sweeps, boxes, damages = read(path)
    assert 24 - 8 <= len(sweeps) + len(boxes) < 24
    assert set(sweeps + boxes) <= set(drive.stamps)
    assert [one.first_byte for one in damages] == [first]
    assert damages[0].end_byte == first + length
    assert START <= damages[0].start_ns <= damages[0].end_ns <= drive.stamps[-1]


def test_a_broken_record_without_an_index_ends_the_file_there(tmp_path, drive, whole):
    """The bytes behind it are noted: nothing in them can be told from the content of messages."""
    first, _ = chunk_places(whole)[-3]
    data = bytearray(whole.read_bytes()[:-300])
    data[first + 3] ^= 0xFF  # in its length
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(data)
    sweeps, boxes, damages = read(path)
    assert 8 < len(sweeps) + len(boxes) < 24
    assert damages[0][2:4] == (first, len(data))
    assert 'mcap recover' in damages[0].reason


@pytest.mark.parametrize('change', [0x20, 0x80, 0x01])
def test_a_chunk_that_became_another_record_is_noted(tmp_path, whole, change):
    """The readers of mcap skip records that they do not know, without a word."""
    first, length = chunk_places(whole)[5]
    data = bytearray(whole.read_bytes()[:-300])
    data[first] ^= change
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(data)
    _, _, damages = read(path)
    assert damages[0].first_byte == first
    assert damages[0].end_byte >= first + length


@pytest.mark.parametrize('change', [16_000, -16])
def test_a_message_of_a_wrong_length_is_noted_without_checksums(tmp_path, whole, change):
    """One that is too long takes others with it, and the readers of mcap do not notice."""
    path = rewritten(
        whole, tmp_path / 'plain.mcap', compression=CompressionType.NONE, chunk_size=2**20,
        enable_crcs=False,
    )  # fmt: skip
    ((first, length),) = chunk_places(path)
    data = bytearray(path.read_bytes())
    head = struct.pack('<BQ', 5, 0)[:1]
    with path.open('rb') as file:
        size = len(list(make_reader(file).iter_messages('/tf'))[5][2].data) + 22
    at = data.index(head + struct.pack('<Q', size), first)
    data[at + 1 : at + 9] = struct.pack('<Q', size + change)
    path.write_bytes(data)
    with closing(opened(path)) as file:
        assert list(file.messages(file.connections, None, None)) == []
        (damage,) = file.damages
    assert damage[2:4] == (first, first + length)


def test_a_summary_with_a_wrong_checksum_is_not_trusted(tmp_path, drive, whole):
    data = bytearray(whole.read_bytes())
    with whole.open('rb') as file:
        index = make_reader(file).get_summary().chunk_indexes[12]
    times = struct.pack('<QQ', index.message_start_time, index.message_end_time)
    at = data.rindex(times)
    data[at : at + 16] = bytes(16)  # as if its messages were before all others
    path = tmp_path / 'summary.mcap'
    path.write_bytes(data)
    sweeps, boxes, damages = read(path, start=0.45, end=1.0)
    assert (sweeps, boxes, damages) == (drive.stamps[5:10], drive.stamps[5:10], [])


def test_an_index_of_places_beyond_the_file_is_not_used(tmp_path, drive, whole):
    path = rewritten(whole, tmp_path / 'places.mcap', enable_crcs=False)
    data = bytearray(path.read_bytes())
    first, length = chunk_places(path)[5]
    at = data.rindex(struct.pack('<QQ', first, length))
    data[at : at + 8] = struct.pack('<Q', len(data))
    path.write_bytes(data)
    assert read(path) == (drive.stamps, drive.stamps, [])


def test_topics_written_one_after_another_and_shuffled_messages(tmp_path, drive, whole):
    by_topic = rewritten(whole, tmp_path / 'topics.mcap', lambda item: item[1].topic)
    assert read(by_topic) == (drive.stamps, drive.stamps, [])
    rng = random.Random(0)
    shuffled = rewritten(
        whole, tmp_path / 'shuffled.mcap', lambda _: rng.random(), chunk_size=20_000
    )
    assert read(shuffled) == (drive.stamps, drive.stamps, [])


def test_static_transforms_before_the_part_are_read_without_an_index(tmp_path, drive, whole):
    path = tmp_path / 'cut.mcap'
    path.write_bytes(whole.read_bytes()[:-300])
    sweeps, boxes, _ = read(path, start=0.6)
    assert sweeps == boxes == drive.stamps[6:]


def test_metadata_that_cannot_be_parsed_is_not_used(tmp_path, drive):
    folder = drive.write(tmp_path / 'drive', 'mcap-folder')
    (folder / 'metadata.yaml').write_text('[' * 5000)
    assert read(folder) == (drive.stamps, drive.stamps, [])


def test_a_missing_file_of_a_folder_is_listed(tmp_path, drive):
    folder = drive.write(tmp_path / 'drive', 'mcap-folder')
    metadata = folder / 'metadata.yaml'
    (name,) = [file.name for file in folder.glob('*.mcap')]
    text = metadata.read_text()
    metadata.write_text(text.replace(f'- {name}', f'- {name}\n  - ../../{name}.lost', 1))
    sweeps, _, damages = read(folder)
    assert sweeps == drive.stamps
    assert [damage.file for damage in damages] == [str(folder / f'{name}.lost')]


def test_a_file_that_the_metadata_does_not_list_is_named(tmp_path, drive):
    folder = drive.write(tmp_path / 'drive', 'mcap-folder')
    (name,) = [file.name for file in folder.glob('*.mcap')]
    (folder / 'added.mcap').write_bytes((folder / name).read_bytes())
    sweeps, _, damages = read(folder)
    assert sweeps == drive.stamps
    assert [damage.file for damage in damages] == [str(folder / 'added.mcap')]
    assert 'metadata.yaml does not list this file' in damages[0].reason


@pytest.mark.parametrize('keeps_compressed', [True, False])
def test_a_file_that_a_player_has_unpacked_is_not_missing(tmp_path, drive, keeps_compressed):
    """`ros2 bag play` unpacks the files of the mode FILE beside the compressed ones."""
    folder = drive.write(tmp_path / 'drive', 'mcap-folder')
    (file,) = folder.glob('*.mcap')
    metadata = folder / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace(file.name, f'{file.name}.zstd'))
    if keeps_compressed:
        packed = zstandard.ZstdCompressor().compress(file.read_bytes())
        (folder / f'{file.name}.zstd').write_bytes(packed)
    assert read(folder) == (drive.stamps, drive.stamps, [])


# rosbag2 databases -----------------------------------------------------------------------------


def database_of(folder):
    (file,) = folder.glob('*.db3')
    return file


def test_the_write_ahead_log_is_read_and_nothing_is_changed(tmp_path, drive):
    folder = drive.write(tmp_path / 'drive', 'sqlite3')
    file = database_of(folder)
    (folder / 'metadata.yaml').unlink()
    (tmp_path / 'crashed').mkdir()
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA journal_mode = WAL')
        database.execute('PRAGMA wal_autocheckpoint = 0')
        database.execute('CREATE TABLE moved AS SELECT * FROM messages WHERE timestamp > ?',
                         (drive.stamps[5],))  # fmt: skip
        database.execute('DELETE FROM messages WHERE timestamp > ?', (drive.stamps[5],))
        database.commit()
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        database.execute('INSERT INTO messages SELECT * FROM moved')
        database.commit()
        for path in folder.glob('*.db3*'):
            shutil.copy(path, tmp_path / 'crashed')
    (tmp_path / 'crashed' / f'{file.name}-shm').unlink()
    before = {p.name: p.read_bytes() for p in (tmp_path / 'crashed').iterdir()}
    assert len(before) == 2
    assert read(tmp_path / 'crashed') == (drive.stamps, drive.stamps, [])
    assert {p.name: p.read_bytes() for p in (tmp_path / 'crashed').iterdir()} == before


def test_a_damaged_database_is_refused_with_what_mends_it(tmp_path):
    file = database_of(Drive(sweeps=40).write(tmp_path / 'drive', 'sqlite3'))
    data = file.read_bytes()
    middle = len(data) // 2 // 4096 * 4096
    for name, content in (
        ('cut', data[:middle]),
        ('page', data[:middle] + b'\xff' * 4096 + data[middle + 4096 :]),
    ):
        path = tmp_path / f'{name}.db3'
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=rf'sqlite3 {path} \.recover \| sqlite3'):
            read(path)


def test_messages_of_no_topic_are_counted(tmp_path, drive):
    file = database_of(drive.write(tmp_path / 'drive', 'sqlite3'))
    with closing(sqlite3.connect(file)) as database:
        database.execute(
            'UPDATE messages SET topic_id = 77 WHERE id IN (SELECT messages.id FROM messages '
            "JOIN topics ON topics.id = topic_id WHERE name = '/points' LIMIT 2)"
        )
        database.commit()
    sweeps, boxes, damages = read(file)
    assert len(sweeps) + len(boxes) == 24 - 2
    assert [damage.reason for damage in damages] == ['2 messages whose topic or place is unknown']


def test_a_topic_whose_definition_was_not_found(tmp_path, drive):
    drive.items.append(('/talk', START, drive.messages.header(START, 'x')))
    folder = drive.write(tmp_path / 'drive', 'sqlite3')
    with closing(sqlite3.connect(database_of(folder))) as database:
        database.execute(
            "UPDATE message_definitions SET encoding = 'unknown', encoded_message_definition = '' "
            "WHERE topic_type LIKE 'std_msgs%'"
        )
        database.commit()
    assert read(folder) == (drive.stamps, drive.stamps, [])


@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_databases(tmp_path, drive, mode):
    path = write_recording(tmp_path / 'drive', drive.items, 'sqlite3', compression=mode)
    assert read(path) == (drive.stamps, drive.stamps, [])


def test_a_damaged_compressed_file(tmp_path, drive, whole):
    data = whole.read_bytes()
    compress = zstandard.ZstdCompressor().compress
    half = [compress(data[i : i + 1000]) for i in range(0, len(data) // 2, 1000)]
    path = tmp_path / 'drive.mcap.zstd'
    path.write_bytes(b''.join(half) + b'no frame')
    sweeps, _, damages = read(path)
    assert 2 < len(sweeps) < 12
    assert 'damaged compression' in damages[0].reason
    assert {damage.file for damage in damages} == {str(path)}


# ROS 1 bags ------------------------------------------------------------------------------------


@pytest.fixture
def bag(tmp_path):
    drive = Drive(sweeps=40, ros1=True)
    path = write_recording(
        tmp_path / 'drive', drive.items, 'rosbag1', drive.messages, chunk_bytes=8_000
    )
    return drive, path


def without_index(data):
    """Return a bag as a recorder that was killed leaves it."""
    changed = bytearray(data)
    at = changed.index(b'index_pos=') + len(b'index_pos=')
    (end,) = struct.unpack_from('<Q', changed, at)
    changed[at : at + 8] = bytes(8)
    return changed[:end]


@pytest.mark.parametrize('damage', ['no index', 'cut', 'chunk', 'head'])
def test_a_damaged_bag_is_refused_with_what_mends_it(tmp_path, bag, damage):
    _, path = bag
    data = bytearray(path.read_bytes())
    mark = data.index(b'op=\x05', len(data) // 3)
    if damage == 'no index':
        path = tmp_path / 'drive.bag.active'
        data = without_index(data)
    elif damage == 'cut':
        data = data[: len(data) // 2]
    elif damage == 'chunk':
        data[mark + 21 : mark + 60] = b'\xff' * 39  # the first record in the chunk
    else:
        data[mark - 24 : mark] = b'\xff' * 24
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=f'rosbag reindex {path}'):
        read(path)


def test_chunks_of_a_bag_that_its_index_has_lost_are_noted(bag):
    _, path = bag
    data = bytearray(path.read_bytes())
    at = data.index(b'chunk_count=') + len(b'chunk_count=')
    (count,) = struct.unpack_from('<I', data, at)
    assert count > 4
    data[at : at + 4] = struct.pack('<I', 4)
    path.write_bytes(data)
    sweeps, _, damages = read(path)
    assert 0 < len(sweeps) < 40
    assert [damage.reason for damage in damages] == ['bytes behind the index are not read']


# Any place -------------------------------------------------------------------------------------

PLACES = int(os.environ.get('DAMAGED_PLACES', '40'))
"""Places in a file that are damaged by a test; 200 of each take half a minute."""


@pytest.mark.parametrize('kind', ['cut', 'flip'])
@pytest.mark.parametrize('storage', ['mcap', 'mcap-flat', 'mcap-cut', 'sqlite3', 'rosbag1'])
def test_no_message_is_lost_without_a_word(tmp_path, storage, kind):
    """A file that is cut, or has another byte, at any place."""
    drive = Drive(sweeps=12, ros1=storage == 'rosbag1')
    path = drive.write(tmp_path / 'drive', storage.partition('-')[0])
    if storage == 'sqlite3':
        path = database_of(path)
    elif storage != 'rosbag1':
        target = tmp_path / 'other.mcap'
        path = rewritten(path, target, use_chunking=storage != 'mcap-flat')
    data = path.read_bytes()[: -1000 if storage == 'mcap-cut' else None]
    path.write_bytes(data)
    whole = messages_of(path)[0]
    rng = random.Random(storage + kind)
    outcomes = Counter()
    for place in sorted(rng.randrange(len(data)) for _ in range(PLACES)):
        changed = bytearray(data[:place] if kind == 'cut' else data)
        if kind == 'flip':
            changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        try:
            found, damages = messages_of(path)
        except RecordingError as error:
            assert '\n' not in str(error)
            outcomes['refused'] += 1
            continue
        is_whole = len(found) == len(whole) if storage == 'sqlite3' else found == whole
        outcomes['whole' if is_whole else 'noted'] += 1
        assert is_whole or damages or is_content(found, whole), place
    assert outcomes.total() == PLACES


def is_content(found, whole):
    """Return whether one message, or the name of a topic, differs: no checksum is stored of it."""
    lost = Counter(one[1:] for one in whole) - Counter(one[1:] for one in found)
    return len(found) >= len(whole) and lost.total() <= 1


def messages_of(path):
    """Return the messages of a file, and its damages."""
    with closing(opened(path)) as file:
        found = [
            (record.connection.topic, record.received_ns, bytes(record.data))
            for record in file.messages(file.connections, None, None)
        ]
        return found, list(file.damages)


# Fuzzing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'rosbag1'])
def test_mutated_files_are_read_or_refused(tmp_path, storage):
    drive = Drive(sweeps=3, ros1=storage == 'rosbag1')
    path = drive.write(tmp_path / 'drive', storage)
    path = database_of(path) if storage == 'sqlite3' else path
    data = path.read_bytes()
    rng = random.Random(1)
    read_again = 0
    for _ in range(60):
        path.write_bytes(mutated(data, rng))
        try:
            with closing(opened(path)) as file:
                for record in file.messages(file.connections, None, None):
                    assert isinstance(record.data, bytes | memoryview)
            read_again += 1
            read(path)
        except BoxregError as error:
            assert '\n' not in str(error)
    assert read_again > 5


def mutated(data, rng):
    """Return a file with bytes replaced, removed, repeated or cut off."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 4, 30))):
        at = rng.randrange(len(changed))
        kind = rng.randrange(5)
        size = rng.choice((1, 1, 8, 100))
        if kind == 0:
            changed[at : at + size] = rng.randbytes(min(size, len(changed) - at))
        elif kind == 1:
            changed[at : at + size] = rng.choice((b'\0', b'\xff')) * min(size, len(changed) - at)
        elif kind == 2:
            del changed[at : at + size]
        elif kind == 3:
            changed[at:at] = changed[at : at + size]
        elif len(changed) > 1000:
            del changed[rng.randrange(500, len(changed)) :]
    return bytes(changed)


# boxreg relabel --------------------------------------------------------------------------------


def test_relabel_lists_damages_and_strict_fails(tmp_path, drive, whole, capsys):
    first, length = chunk_places(whole)[9]
    data = bytearray(whole.read_bytes())
    data[first + length // 2] ^= 0xFF
    whole.write_bytes(data)
    out = tmp_path / 'out'
    command = ['relabel', str(whole), '-o', str(out), '--formats=csv,mcap']
    assert main(command) == 0
    line, unpaired = capsys.readouterr().err.splitlines()
    assert '(no_sweep)' in unpaired  # the damaged chunk had clouds
    assert f'{whole}: damaged chunk' in line
    assert f'bytes {first} to {first + length}' in line
    (damage,) = json.loads((out / 'summary.json').read_text())['damage']
    assert damage['first_byte'] == first
    assert START <= damage['start_ns'] <= damage['end_ns']
    with (out / 'overlay.mcap').open('rb') as file:
        assert len(list(make_reader(file).iter_messages('/points'))) >= 11
    assert main([*command, '--strict']) == 1
    assert main([*command, '--strict']) == 1


def test_stamps_of_zero_are_reported(tmp_path, capsys):
    drive = Drive(sweeps=12)
    for index in (3, 4):
        drive.replace('/points', index, lambda m: setattr(m.header, 'stamp', zero_of(drive)))
    path = drive.write(tmp_path / 'drive')
    main(['relabel', str(path), '-o', str(tmp_path / 'out')])
    assert '2 sweeps have the stamp 0' in capsys.readouterr().err
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['without_stamp'] == {'sweeps': 2}


def test_a_simulation_begins_at_0_without_a_word(tmp_path, capsys):
    path = str(Drive(sweeps=12, start=0).write(tmp_path / 'drive'))
    assert main(['relabel', path, '-o', str(tmp_path / 'out'), '--strict']) == 0
    assert main(['inspect', path]) == 0
    output = capsys.readouterr()
    assert '24 boxes in, 24 refined' in output.out
    assert 'stamp 0' not in output.out + output.err


def zero_of(drive):
    return drive.messages.make('builtin_interfaces/msg/Time', sec=0, nanosec=0)


def test_nothing_readable_is_an_error(tmp_path, whole):
    path = tmp_path / 'cut.mcap'
    path.write_bytes(whole.read_bytes()[: MAGIC_BYTES + 20])
    with pytest.raises(RecordingError, match='no message can be read'):
        read(path)


@pytest.mark.parametrize('name', ['drive.mcap', 'drive.db3', 'drive.bag'])
def test_an_empty_file_is_named_as_one(tmp_path, name):
    # No tool mends it: none is advised.
    (tmp_path / name).touch()
    with pytest.raises(RecordingError, match='got an empty file; copy it again, or leave it out'):
        read(tmp_path / name)


def test_time_between_chunks_is_that_of_the_receiver(tmp_path, drive, whole):
    with closing(opened(whole)) as file:
        assert (file.start_time, file.end_time) == (START, drive.stamps[-1] + 1)
        times = [record.received_ns for record in file.messages(file.connections, None, None)]
    assert times == sorted(times)
    assert times[-1] - times[0] == 11 * SECOND // 10

"""Damaged, odd and unindexed recordings: whole parts are read, the others are listed."""

from contextlib import closing
import json
import random
import shutil
import sqlite3
import struct

from boxreg_ros.cli import main
from boxreg_ros.errors import BoxregError, RecordingError
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage import chunks
from boxreg_ros.io.storage.files import opened
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.storage.rosbag1 import CHUNK_MARK, SEARCH_BYTES
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.structures import BoxArray, Sweep
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
    assert 'interrupted' in damages[1].reason


def test_a_truncated_file_without_chunks_is_read_up_to_its_end(tmp_path, drive, whole):
    path = rewritten(whole, tmp_path / 'flat.mcap', use_chunking=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    sweeps, _, damages = read(path)
    assert 2 < len(sweeps) < 12
    assert sweeps == drive.stamps[: len(sweeps)]
    assert damages


@pytest.mark.parametrize(
    ('where', 'has_index'), [('content', True), ('content', False), ('length', False)]
)
def test_a_damaged_chunk_is_left_out(tmp_path, drive, whole, where, has_index):
    first, length = chunk_places(whole)[5]
    data = bytearray(whole.read_bytes())
    place = first + length // 2 if where == 'content' else first + 3
    data[place] ^= 0xFF
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(data if has_index else data[:-300])
    sweeps, boxes, damages = read(path)
    assert 24 - 8 <= len(sweeps) + len(boxes) < 24
    assert set(sweeps + boxes) <= set(drive.stamps)
    assert damages[0].first_byte == first
    assert damages[0].end_byte >= first + length
    assert START <= damages[0].start_ns <= damages[0].end_ns <= drive.stamps[-1]
    if has_index:
        assert damages[0].end_byte == first + length
        assert len(damages) == 1


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


@pytest.mark.parametrize('has_index', [True, False])
def test_a_chunk_that_claims_too_much_is_left_out(tmp_path, drive, whole, has_index):
    path = rewritten(whole, tmp_path / 'flat.mcap', compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    first, _ = chunk_places(path)[5]
    at = first + 9 + 16  # opcode and length; first and last time
    data[at : at + 8] = struct.pack('<Q', chunks.MAX_CHUNK_BYTES + 1)
    path.write_bytes(data if has_index else data[:-300])
    sweeps, boxes, damages = read(path)
    assert 24 - 3 <= len(sweeps) + len(boxes) < 24
    assert damages[0].first_byte == first
    assert 'size of 1073741825 bytes' in damages[0].reason


def test_messages_are_held_up_to_a_limit():
    # Four chunks that all cover the whole time, so that all of them are needed at once.
    times = {k: range(k, 40, 4) for k in range(4)}
    sources = [chunks.Chunk(k, k + 1, k, 36 + k, {0: 10}) for k in range(4)]
    loaded = []

    def load(chunk):
        loaded.append(chunk.first_byte)
        return [Record(None, time, bytes(100), time) for time in times[chunk.first_byte]]

    of_a_chunk = 10 * (100 + chunks.RECORD_BYTES)
    for limit, most_loads in ((4 * of_a_chunk, 4), (2.5 * of_a_chunk, 40)):
        loaded.clear()
        found = [record.received_ns for record in chunks._merged(sources, load, limit)]
        assert found == list(range(40))
        assert 4 <= len(loaded) <= most_loads
        assert (len(loaded) == 4) == (limit == 4 * of_a_chunk)


@pytest.mark.parametrize('buffer_bytes', [1, 2**28])
def test_topics_written_one_after_another_and_shuffled_messages(
    tmp_path, monkeypatch, drive, whole, buffer_bytes
):
    monkeypatch.setattr(chunks, 'BUFFER_BYTES', buffer_bytes)
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


def test_a_truncated_database_is_read_row_by_row(tmp_path):
    drive = Drive(sweeps=40)
    file = database_of(drive.write(tmp_path / 'drive', 'sqlite3'))
    cut = tmp_path / 'cut.db3'
    size = file.stat().st_size
    cut.write_bytes(file.read_bytes()[: size // 2])
    sweeps, _, damages = read(cut)
    assert 4 < len(sweeps) < 40
    assert set(sweeps) <= set(drive.stamps)
    assert (damages[0].first_byte, damages[0].end_byte) == (size // 2, size)


def test_a_damaged_page_costs_the_messages_on_it(tmp_path):
    drive = Drive(sweeps=40)
    file = database_of(drive.write(tmp_path / 'drive', 'sqlite3'))
    data = bytearray(file.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 4096] = b'\xff' * 4096
    file.write_bytes(data)
    sweeps, _, _ = read(file)
    assert 30 < len(sweeps) <= 40


def test_damaged_rows_behind_a_gap_of_ids_are_skipped(tmp_path, drive):
    """Ids are not tried one by one: the last row is a million million ids behind the others."""
    file = database_of(drive.write(tmp_path / 'drive', 'sqlite3'))
    with closing(sqlite3.connect(file)) as database:
        database.execute('UPDATE messages SET id = 1000000000000 WHERE id IN '
                         '(SELECT max(id) FROM messages)')  # fmt: skip
        ((stamp_ns,),) = database.execute('SELECT timestamp FROM messages WHERE id > 1e11')
        database.commit()
    data = bytearray(file.read_bytes())
    stored = stamp_ns.to_bytes(8, 'big')
    place = data.rfind(stored)
    while place >= 0:
        data[max(place - 8, 0) : place] = b'\xff' * 8
        place = data.rfind(stored, 0, place)
    file.write_bytes(data)
    sweeps, _, damages = read(file)
    assert len(sweeps) >= len(drive.stamps) - 1
    assert damages


def test_a_topic_whose_definition_was_not_found(tmp_path, drive):
    drive.items.append(('/talk', START, drive.messages.header(START, 'x')))
    folder = write_recording(
        tmp_path / 'drive', sorted(drive.items, key=lambda item: item[1]), 'sqlite3'
    )
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


def test_a_bag_without_an_index_is_scanned(tmp_path, bag):
    drive, path = bag
    data = bytearray(path.read_bytes())
    at = data.index(b'index_pos=') + len(b'index_pos=')
    (end,) = struct.unpack_from('<Q', data, at)
    data[at : at + 8] = bytes(8)
    active = tmp_path / 'drive.bag.active'
    active.write_bytes(data[:end])
    assert read(active) == (drive.stamps, drive.stamps, [])


@pytest.mark.parametrize('damage', ['cut', 'chunk', 'head'])
def test_a_damaged_bag(tmp_path, bag, damage):
    drive, path = bag
    data = bytearray(path.read_bytes())
    mark = data.index(b'op=\x05', len(data) // 3)
    if damage == 'cut':
        data = data[: len(data) // 2]
    elif damage == 'chunk':
        data[mark + 21 : mark + 60] = b'\xff' * 39  # the first record in the chunk
    else:
        data[mark - 24 : mark] = b'\xff' * 24
        data = data[:-1000]
    path.write_bytes(data)
    sweeps, boxes, damages = read(path)
    assert 10 < len(sweeps) + len(boxes) < 80
    assert set(sweeps + boxes) <= set(drive.stamps)
    assert damages[0].first_byte > 0
    assert damages[0].start_ns is not None


def test_a_chunk_of_a_bag_that_claims_too_much_is_left_out(tmp_path, bag):
    _, path = bag
    data = bytearray(path.read_bytes())
    mark = data.index(b'op=\x05', len(data) // 3)
    at = data.index(b'size=', mark - 60) + len(b'size=')
    data[at : at + 4] = struct.pack('<I', chunks.MAX_CHUNK_BYTES + 1)
    path.write_bytes(data)
    sweeps, boxes, damages = read(path)
    assert 40 < len(sweeps) + len(boxes) < 80
    assert [damage.reason for damage in damages] == ['damaged chunk (size of 1073741825 bytes)']


@pytest.mark.parametrize('split', [0, 2])
def test_a_chunk_of_a_bag_across_blocks_of_the_search_is_found(tmp_path, bag, split):
    """A block of the search ends with the first `split` bytes of the mark, or before it."""
    drive, path = bag
    data = path.read_bytes()
    chunk = data.index(CHUNK_MARK) - 8
    # The search begins one byte behind the damage.
    gap = SEARCH_BYTES + 1 - 8 - split
    path.write_bytes(data[:chunk] + b'\xff' * gap + data[chunk:-1000])  # without an index
    sweeps, boxes, damages = read(path)
    assert sweeps[0] == boxes[0] == drive.stamps[0]
    assert damages[0][2:4] == (chunk, chunk + gap)


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
    assert read_again > 10


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
    (line,) = capsys.readouterr().err.splitlines()
    assert f'{whole}: damaged chunk' in line
    assert f'bytes {first} to {first + length}' in line
    (damage,) = json.loads((out / 'summary.json').read_text())['damage']
    assert damage['first_byte'] == first
    assert START <= damage['start_ns'] <= damage['end_ns']
    with (out / 'overlay.mcap').open('rb') as file:
        assert len(list(make_reader(file).iter_messages('/points'))) >= 11
    assert main([*command, '--strict']) == 1
    assert main([*command, '--strict', '--resume']) == 1


def test_stamps_of_zero_are_reported(tmp_path, capsys):
    drive = Drive(sweeps=12)
    for index in (3, 4):
        drive.replace('/points', index, lambda m: setattr(m.header, 'stamp', zero_of(drive)))
    path = drive.write(tmp_path / 'drive')
    main(['relabel', str(path), '-o', str(tmp_path / 'out')])
    assert '2 sweeps have the stamp 0' in capsys.readouterr().err
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['without_stamp'] == {'sweeps': 2}


def zero_of(drive):
    return drive.messages.make('builtin_interfaces/msg/Time', sec=0, nanosec=0)


def test_nothing_readable_is_an_error(tmp_path, whole):
    path = tmp_path / 'cut.mcap'
    path.write_bytes(whole.read_bytes()[: MAGIC_BYTES + 20])
    with pytest.raises(RecordingError, match='no message can be read'):
        read(path)


def test_time_between_chunks_is_that_of_the_receiver(tmp_path, drive, whole):
    with closing(opened(whole)) as file:
        assert (file.start_time, file.end_time) == (START, drive.stamps[-1] + 1)
        times = [record.received_ns for record in file.messages(file.connections, None, None)]
    assert times == sorted(times)
    assert times[-1] - times[0] == 11 * SECOND // 10

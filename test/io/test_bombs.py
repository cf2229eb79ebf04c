"""Files of a few bytes that claim or hold any number: refused soon, in bounded memory."""

from contextlib import closing, contextmanager
import json
import resource
import sqlite3
import struct
import subprocess
import sys
import time

from boxreg_ros.errors import TransferError
from boxreg_ros.io.storage.files import Files, opened, part_of
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Footer
from mcap_files import rewritten
import pytest
from ros_messages import Drive
import zstandard

MEMORY = 2**30
SECONDS = 60
READ = """
import json, resource, sys
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.files import opened
resource.setrlimit(resource.RLIMIT_AS, ({memory}, {memory}))
from pathlib import Path
for path in sys.argv[1:]:
    try:
        file = opened(Path(path))
        count = sum(1 for _ in file.messages(file.connections, None, None))
        print(json.dumps([count, [damage.reason for damage in file.damages]]))
    except RecordingError as error:
        print(json.dumps([0, [str(error)]]))
"""

ENDLESS = (
    'WITH RECURSIVE rows(id, topic_id, timestamp, data) AS '
    "(SELECT 1, 1, 1, x'00' UNION ALL SELECT id + 1, 1, id, x'00' FROM rows) SELECT * FROM rows"
)
"""A view with rows without end."""


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp('whole')
    return rewritten(Drive(sweeps=2).write(folder / 'drive'), folder / 'whole.mcap')


def with_repeated_index(whole, target, times):
    """Write a file whose summary names each chunk many times."""
    with whole.open('rb') as file:
        summary = make_reader(file).get_summary()
    data = whole.read_bytes()
    (begin,) = struct.unpack_from('<Q', data, len(data) - 28)
    records = RecordBuilder()
    summary.statistics.chunk_count *= times
    for record in (
        *summary.schemas.values(), *summary.channels.values(), summary.statistics,
        *summary.chunk_indexes * times, Footer(begin, 0, 0),
    ):  # fmt: skip
        record.write(records)
    target.write_bytes(data[:begin] + records.end() + data[-8:])
    return target


def database(folder, change):
    (file,) = Drive(sweeps=2).write(folder, 'sqlite3').glob('*.db3')
    with closing(sqlite3.connect(file)) as connected:
        connected.executescript(f'ALTER TABLE messages RENAME TO others; {change}')
        connected.commit()
    return file


def many_messages(count, data='NULL'):
    """Return the statements that make a table of messages, and no index."""
    return (
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);'
        f'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < {count}) '
        f'INSERT INTO messages SELECT i, (SELECT min(id) FROM topics), i, {data} FROM n'
    )


@contextmanager
def limited(kind, soft):
    """Limit a resource of this process in a block."""
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (soft, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def test_bombs_are_refused_in_bounded_time_and_memory(tmp_path, whole):
    zeros = bytes(2**27)
    files = {
        'more than 1000 times': tmp_path / 'file.mcap.zstd',
        'expected a whole database of rosbag2, got: Cannot open database': database(
            tmp_path / 'view', f'CREATE VIEW messages AS {ENDLESS}'
        ),
        'expected a whole database of rosbag2, got: string or blob too big': database(
            tmp_path / 'generated',
            'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, '
            'data GENERATED ALWAYS AS (zeroblob(1000000000))); '
            'INSERT INTO messages SELECT id, topic_id, timestamp FROM others',
        ),
    }  # fmt: skip
    compress = zstandard.ZstdCompressor().compress
    bomb = compress(zeros) * 8
    (tmp_path / 'file.mcap.zstd').write_bytes(compress(whole.read_bytes()) + bomb)
    done = subprocess.run(
        [sys.executable, '-c', READ.format(memory=MEMORY), *map(str, files.values())],
        capture_output=True, text=True, timeout=SECONDS,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    for (reason, path), (count, reasons) in zip(files.items(), lines, strict=True):
        assert any(reason in found for found in reasons), (reason, reasons)
        assert (count > 0) == (path.suffix != '.db3'), path  # the bytes before are read


def test_an_index_that_names_chunks_twice_is_not_used(tmp_path, whole):
    path = with_repeated_index(whole, tmp_path / 'repeated.mcap', 1)
    with closing(opened(path)) as file:
        expected = sum(1 for _ in file.messages(file.connections, None, None))
        assert file.is_indexed
    path = with_repeated_index(whole, tmp_path / 'repeated.mcap', 1000)
    with closing(opened(path)) as file:
        assert not file.is_indexed
        assert sum(1 for _ in file.messages(file.connections, None, None)) == expected


def test_a_full_disk_of_temporary_files_is_named(tmp_path, whole, monkeypatch):
    """Damage would be noted, and the run done, if the error were about the recording."""
    folder = tmp_path / 'drive'
    folder.mkdir()
    (folder / 'a.mcap').write_bytes(whole.read_bytes())
    packed = zstandard.ZstdCompressor().compress(whole.read_bytes())
    (folder / 'b.mcap.zstd').write_bytes(packed)
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    with limited(resource.RLIMIT_FSIZE, 2000), pytest.raises(TransferError) as caught:
        Files(part_of(folder))
    assert str(caught.value).startswith(f'temporary files in {tmp_path}: expected room')
    assert 'TMPDIR' in str(caught.value)


def test_no_room_for_sorting_a_database_is_no_damage(tmp_path):
    path = database(tmp_path / 'drive', many_messages(20_000, 'zeroblob(1000)'))
    with (
        limited(resource.RLIMIT_FSIZE, 2000),
        pytest.raises(TransferError, match='TMPDIR'),
        closing(opened(path)) as file,
    ):
        list(file.messages(file.connections, None, None))


def test_a_file_that_cannot_be_opened_is_no_damage(tmp_path, whole):
    """Of the second file nothing is known: the limit of open files is reached before it."""
    folder = tmp_path / 'drive'
    folder.mkdir()
    for name in ('a', 'b'):
        (folder / f'{name}.mcap').write_bytes(whole.read_bytes())
    part = part_of(folder)
    with open('/dev/null') as newest:
        next_number = newest.fileno() + 1
        with (
            limited(resource.RLIMIT_NOFILE, next_number + 1),
            pytest.raises(TransferError, match='raise the limit of open files'),
        ):
            Files(part)


def test_many_damages_take_time_in_proportion(tmp_path):
    count = 30_000
    path = database(tmp_path / 'drive', many_messages(count))
    begin = time.process_time()
    with closing(opened(path)) as file:
        assert not list(file.messages(file.connections, None, None))
        assert len(file.damages) == count
    assert time.process_time() - begin < 5  # comparing each with all takes minutes

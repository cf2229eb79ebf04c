"""Journals: what was added is read back, whatever a power cut leaves of the file."""

import os
from pathlib import Path
import pickle
import subprocess
import sys
import zlib

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.journal import Journal, opened_journal
from boxreg_ros.io.lock import locked
import pytest

PAGE = 4096
ITEMS = [f'{i}' * 40 * i for i in range(12)]


@pytest.fixture(params=['killed', 'closed'])
def journal(request, tmp_path):
    """Return the files of a journal of `ITEMS`: of a process that was killed, or has ended."""
    path = tmp_path / 'journal'
    journal = Journal(path)
    for item in ITEMS:
        journal.append(item)
    if request.param == 'closed':
        journal.close()
    files = {file: file.read_bytes() for file in tmp_path.iterdir()}
    journal.delete()
    assert not list(tmp_path.iterdir())
    return path, files


def read(path, files):
    """Return the objects of a journal with these files, which then takes further ones."""
    for file, content in files.items():
        file.write_bytes(content)
    journal = opened_journal(path)
    found = list(journal.records())
    kept = journal.cut(len(found))
    assert kept in (0, len(found))
    journal.append('next')
    assert list(journal.records()) == [*found[:kept], 'next']
    journal.delete()
    return found


def test_every_cut_and_zero_pages_leave_the_whole_objects(journal):
    path, files = journal
    assert read(path, files) == ITEMS
    lengths = set()
    for file, content in files.items():
        for pages in range(21):
            assert read(path, {**files, file: content + bytes(PAGE * pages)}) == ITEMS
        cuts = {*range(0, len(content), 211), *range(len(content) - 3, len(content))}
        for size in cuts | {k + d for k in range(0, len(content), PAGE) for d in (0, 1)}:
            for tail in (b'', bytes(PAGE * (size % 21))):
                found = read(path, {**files, file: content[:size] + tail})
                assert found == ITEMS[: len(found)]
                lengths.add(len(found))
    assert len(lengths) > 2 or len(files) == 1  # a closed journal is one file, whole or not


def test_any_other_byte_ends_the_journal_and_nothing_else_is_unpickled(tmp_path):
    path = tmp_path / 'journal'
    journal = Journal(path)
    for item in ITEMS:
        journal.append(item)
    content = pickle.dumps(print)
    journal._database.execute('UPDATE record SET crc = 1 WHERE number = 5')
    assert list(journal.records()) == ITEMS[:5]
    journal._database.execute(
        'UPDATE record SET crc = ?, content = ? WHERE number = 5', (zlib.crc32(content), content)
    )
    with pytest.raises(RecordingError, match=r'got builtins\.print'):
        list(journal.records())
    journal.delete()


def test_one_process_at_a_time_also_where_one_was_killed(tmp_path):
    file = tmp_path / '.lock'
    code = (
        'import os, pathlib, sys, time; from boxreg_ros.io.lock import locked\n'
        'with locked(pathlib.Path(sys.argv[1]), "it"):\n'
        '    child = os.fork()\n'  # holds no lock
        '    print(os.getpid() if child else "", flush=True)\n'
        '    time.sleep(60)'
    )
    process = subprocess.Popen(
        [sys.executable, '-c', code, str(file)], stdout=subprocess.PIPE, text=True,
        process_group=0,
    )  # fmt: skip
    assert {process.stdout.readline(), process.stdout.readline()} == {f'{process.pid}\n', '\n'}
    with (
        pytest.raises(RecordingError, match=rf'it: .*in use by process {process.pid} on '),
        locked(file, 'it', 0.2),
    ):
        pass
    process.kill()
    process.wait()
    with locked(file, 'it', 5.0):
        with pytest.raises(RecordingError), locked(file, 'it'):
            pass
        assert file.exists()
    assert not file.exists()
    os.killpg(process.pid, 9)
    assert not list(Path(tmp_path).iterdir())

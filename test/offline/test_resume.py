"""Interrupted runs: the journal, equal bytes, full disks and outputs that cannot be written."""

import errno
from itertools import product
import json
import os
from pathlib import Path
import random
import resource
import shutil
import subprocess

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.journal import Journal
from boxreg_ros.offline.job import jobs_of
from boxreg_ros.offline.job_process import JobRunner
from boxreg_ros.offline.relabel import relabel
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import claimed, whole_folder, whole_summary
from boxreg_ros.offline.resume import EstimateJournal, journal_path
from preloaded import BOXREG, PreloadedProcess
import pytest
from ros_messages import Drive
import zstandard

SETTINGS = {'track_window': 16, 'min_observations': 3}
"""Windows of sixteen observations, so that there are several batches."""
QUICK = ['--set=solver.rounds=1']


def content_of(folder):
    """Return the bytes of all files by name, without times and command in the summary."""
    content = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob('*'))
        if path.is_file()
    }
    summary = json.loads(content['summary.json'])
    del summary['seconds'], summary['command']
    return content | {'summary.json': summary}


@pytest.fixture(scope='module')
def request_of_drive(tmp_path_factory):
    recording = Drive(sweeps=60).write(tmp_path_factory.mktemp('drive') / 'drive')
    return Request((recording,), formats=('csv', 'openlabel', 'mcap'), config=Config(**SETTINGS))


@pytest.fixture(scope='module')
def uninterrupted(request_of_drive, tmp_path_factory):
    out = tmp_path_factory.mktemp('whole') / 'out'
    relabel(request_of_drive, out)
    return content_of(out)


class Interruption(BaseException):
    """Ends a run as a signal does."""


def test_an_interrupted_run_goes_on_and_gives_the_same_bytes(
    tmp_path, request_of_drive, uninterrupted, monkeypatch
):
    out = tmp_path / 'out'
    append = Journal.append
    solved = []

    def append_until(limit):
        def limited(journal, content):
            append(journal, content)
            solved.append(content)
            if len(solved) == limit:
                raise Interruption

        return limited

    for limit in (3, 2, 1):  # the first record has the fingerprint
        solved.clear()
        monkeypatch.setattr(Journal, 'append', append_until(limit))
        with pytest.raises(Interruption):
            relabel(request_of_drive, out, resume=True)
        assert [path.name for path in tmp_path.iterdir()] == ['.out.journal']
    # A record that was cut off is solved again; the remains of a killed run are deleted.
    journal = journal_path(out)
    os.truncate(journal, journal.stat().st_size // 2)
    (tmp_path / '.out.partial').mkdir()
    solved.clear()
    monkeypatch.setattr(Journal, 'append', append_until(0))
    relabel(request_of_drive, out, resume=True)
    assert content_of(out) == uninterrupted
    assert solved
    assert [path.name for path in tmp_path.iterdir()] == ['out']


def test_runs_that_are_killed_at_random_give_the_same_bytes_of_every_file(
    tmp_path, request_of_drive, uninterrupted
):
    (recording,) = request_of_drive.recordings
    out = tmp_path / 'results' / 'out'
    settings = [f'--set={name}={value}' for name, value in SETTINGS.items()]
    arguments = ['relabel', str(recording), '-o', str(out), '--formats=csv,openlabel,mcap']
    arguments += ['--resume', *settings]
    log = tmp_path / 'log'
    draw = random.Random(1)
    kills = 0
    while not out.exists():
        process = PreloadedProcess(BOXREG, arguments, {}, log)
        status = process.wait(draw.uniform(0.1, 0.5) * 1.5**kills)
        if status is None:
            assert not out.exists() or (out / 'summary.json').exists()
            process.kill()
            process.wait()
            kills += 1
        else:
            assert status == 0, log.read_text()
    assert kills
    assert PreloadedProcess(BOXREG, arguments, {}, log).wait() == 0  # removes what is left
    found = content_of(out)
    assert found.keys() == uninterrupted.keys()
    differing = [name for name, content in found.items() if content != uninterrupted[name]]
    assert not differing


@pytest.mark.parametrize('options', [{'estimate': 'final'}, {'complete': {'fill': True}}])
def test_other_estimates_and_both_passes_are_resumed(tmp_path, options, monkeypatch):
    recording = Drive(sweeps=12).write(tmp_path / 'drive')
    config = Config.from_dict({**SETTINGS, 'window': 4, 'lag': 2, **options})
    request = Request((recording,), formats=('csv',), config=config)
    relabel(request, tmp_path / 'whole')
    out = tmp_path / 'out'

    def fail(*_):
        raise Interruption

    with monkeypatch.context() as patched:
        patched.setattr('boxreg_ros.offline.relabel.write_track_tables', fail)
        with pytest.raises(Interruption):
            relabel(request, out, resume=True)
    appended = []
    monkeypatch.setattr(Journal, 'append', lambda _, content: appended.append(content))
    relabel(request, out, resume=True)
    assert content_of(out) == content_of(tmp_path / 'whole')
    assert not appended


def test_a_journal_of_another_request_is_not_used(tmp_path):
    path = tmp_path / '.out.journal'
    with pytest.raises(Interruption), EstimateJournal(path, 'one') as journal:
        journal._store((0, [], {}))
        raise Interruption
    with pytest.raises(Interruption), EstimateJournal(path, 'one'):
        raise Interruption  # refused, before anything was recalled
    with pytest.raises(Interruption), EstimateJournal(path, 'one') as journal:
        assert journal._recalled(0) == ([], {})
        raise Interruption
    with EstimateJournal(path, 'two') as journal:
        assert journal._recalled(0) is None
    assert not path.exists()


def test_a_result_is_judged_by_its_content_and_not_by_its_times(tmp_path):
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    request = Request((recording,), formats=('csv',), config=Config(**SETTINGS))
    relabel(request, tmp_path / 'first')
    out = tmp_path / 'copy'
    shutil.copytree(tmp_path / 'first', out, copy_function=shutil.copyfile)  # newer files
    os.utime(out / 'summary.json', (0, 0))  # the clock has stepped back
    relabel(request, out)
    assert content_of(out) == content_of(tmp_path / 'first')
    # A file that a power cut has emptied is made again; one that was edited is kept.
    os.truncate(out / 'boxes.csv', 0)
    assert whole_summary(out) is None
    relabel(request, out)
    assert whole_summary(out) is not None
    boxes = (out / 'boxes.csv').read_text()
    (out / 'boxes.csv').write_text(boxes.replace('car', 'bus'))
    os.utime(out / 'boxes.csv', (0, 0))
    with pytest.raises(RecordingError, match=r"one with 'boxes\.csv' changed or added since"):
        relabel(request, out)
    assert 'bus' in (out / 'boxes.csv').read_text()
    # Killed between the two renames of a replacement: the earlier result has its name again.
    (out / 'boxes.csv').write_text(boxes)
    out.rename(tmp_path / '.copy.earlier')
    with claimed(out):
        assert (out / 'boxes.csv').read_text() == boxes
    relabel(request, out)
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith('.')]


def test_a_result_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """After a power cut the folder is whole or not there: all of it is synced, then renamed."""
    events = []

    def noted(name, call, place):
        def note(*arguments):
            result = call(*arguments)
            events.append((name, place(*arguments)))
            return result

        return note

    def place_of(descriptor, *_):
        return Path(f'/proc/self/fd/{descriptor}').resolve()

    monkeypatch.setattr('os.fsync', noted('sync', os.fsync, place_of))
    monkeypatch.setattr('os.replace', noted('rename', os.replace, lambda _, new: Path(new)))
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    out = tmp_path / 'results' / 'one'
    (job,) = jobs_of([recording])
    config = [f'--set={name}={value}' for name, value in SETTINGS.items()]
    relabel(Request((recording,), formats=('csv', 'openlabel'), config=Config(**SETTINGS)), out)
    renamed = events.index(('rename', out))
    synced = {path for name, path in events[:renamed] if name == 'sync'}
    partial = out.with_name('.one.partial')
    assert synced >= {partial, *(partial / path.relative_to(out) for path in out.rglob('*'))}
    assert ('sync', out.parent) in events[renamed:]
    # Likewise the key that says that a drive is done.
    state = out.parent / 'jobs' / 'drive.json'
    assert JobRunner(out.parent, tuple(config), '')(job).is_done
    renamed = events.index(('rename', state))
    assert events[renamed - 1][1].name.startswith('.drive.json.')
    assert events[renamed + 1] == ('sync', state.parent)


def test_file_size_limit_is_an_error_and_leaves_nothing(
    tmp_path, request_of_drive, preloaded_python
):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    code = (
        'import resource, sys, tempfile; tempfile.tempdir = None; '
        f'resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, {limits[1]})); '
        f'from boxreg_ros.cli import main; sys.exit(main(sys.argv[1:]))'
    )
    out = tmp_path / 'results' / 'out'
    (recording,) = request_of_drive.recordings
    packed = tmp_path / f'{recording.name}.zstd'
    packed.write_bytes(zstandard.ZstdCompressor().compress(recording.read_bytes()))
    room = f"output '{out}': expected room for all files"
    for path, formats, words in (
        (recording, 'csv', room),
        (recording, 'openlabel,mcap', room),
        (packed, 'csv', f'temporary files in {tmp_path}: expected room for a copy'),
    ):
        command = [preloaded_python, '-c', code, 'relabel', path, '-o', out, *QUICK]
        ran = subprocess.run(
            [*command, f'--formats={formats}'], capture_output=True, text=True,
            env={**os.environ, 'TMPDIR': str(tmp_path)},
        )  # fmt: skip
        assert ran.returncode == 1
        assert ran.stderr.startswith(f'boxreg: {words}')
        assert len(ran.stderr.splitlines()) == 1
        assert not list((tmp_path / 'results').iterdir())


def test_outputs_that_cannot_be_written_are_named(tmp_path, capsys, monkeypatch):
    file = tmp_path / 'file'
    file.touch()
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    for out, options in product((file / 'out', Path('/proc/out')), ([], ['--resume'])):
        assert main(['relabel', str(recording), '-o', str(out), *options]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"boxreg: output '{out}': expected a folder that can be written")

    # Root may write everywhere, so the error of a read-only file system is raised here.
    def refuse(path, *_args, **_options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr('pathlib.Path.mkdir', refuse)
    with pytest.raises(RecordingError, match='Read-only file system'):  # noqa: SIM117
        with whole_folder(tmp_path / 'out'):
            pass

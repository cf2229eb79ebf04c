"""Results appear whole or not at all: killed runs, full disks, outputs that cannot be written."""

import errno
import json
import os
from pathlib import Path
import resource
import shutil
import subprocess

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.errors import RecordingError
from boxreg_ros.offline.relabel import relabel
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import claimed, whole_folder, whole_summary
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
    assert whole_summary(out, request.fingerprint()) is None
    relabel(request, out)
    assert whole_summary(out, request.fingerprint()) is not None
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
    relabel(Request((recording,), formats=('csv', 'openlabel'), config=Config(**SETTINGS)), out)
    renamed = events.index(('rename', out))
    synced = {path for name, path in events[:renamed] if name == 'sync'}
    partial = out.with_name('.one.partial')
    assert synced >= {partial, *(partial / path.relative_to(out) for path in out.rglob('*'))}
    assert ('sync', out.parent) in events[renamed:]


def test_file_size_limit_is_an_error_and_leaves_nothing(tmp_path, preloaded_python):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    code = (
        'import resource, sys, tempfile; tempfile.tempdir = None; '
        f'resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, {limits[1]})); '
        f'from boxreg_ros.cli import main; sys.exit(main(sys.argv[1:]))'
    )
    out = tmp_path / 'results' / 'out'
    recording = Drive(sweeps=60).write(tmp_path / 'drive')
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
    for out in (file / 'out', Path('/proc/out')):
        assert main(['relabel', str(recording), '-o', str(out)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"boxreg: output '{out}': expected a folder that can be written")

    # Root may write everywhere, so the error of a read-only file system is raised here.
    def refuse(path, *_args, **_options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr('pathlib.Path.mkdir', refuse)
    with pytest.raises(RecordingError, match='Read-only file system'):  # noqa: SIM117
        with whole_folder(tmp_path / 'out'):
            pass


def test_the_current_folder_is_not_replaced(tmp_path, capsys, monkeypatch):
    """A shell would go on in the folder that is deleted, where it sees no file."""
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    (tmp_path / 'out' / 'inner').mkdir(parents=True)
    for name in ('out', 'out/inner'):
        monkeypatch.chdir(tmp_path / name)
        assert main(['relabel', str(recording), '-o', str(tmp_path / 'out'), *QUICK]) == 2
        assert 'not the current one nor contains it' in capsys.readouterr().err
    monkeypatch.chdir(tmp_path / 'out')
    assert main(['relabel', str(recording), '-o', '.', *QUICK]) == 2
    capsys.readouterr()
    assert main(['relabel', str(recording), '-o', '/', *QUICK]) == 2
    assert "output '/': expected a folder that contains no input" in capsys.readouterr().err


def test_a_full_disk_is_named_and_nothing_is_written(tmp_path):
    out = tmp_path / 'out'
    with pytest.raises(RecordingError, match=r"output '.*/out'.*No space left"):  # noqa: SIM117
        with whole_folder(out) as folder:
            (folder / 'boxes.csv').symlink_to('/dev/full')
            (folder / 'boxes.csv').write_text('x')
    assert list(tmp_path.iterdir()) == []

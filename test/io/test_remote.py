"""Recordings and results behind URLs: an object store and a plain HTTP server on loopback."""

from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from io import SEEK_END
import json
from pathlib import Path
import socket
import subprocess
from threading import Thread

from boxreg_ros.cli import main
from boxreg_ros.errors import RecordingError, TransferError
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage import urls
from boxreg_ros.io.storage.byte_file import ByteFile
from boxreg_ros.io.storage.files import part_of
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.io.transform_tree import TransformTree
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap_files import rewritten
import numpy as np
import pytest
from ros_messages import Drive, SECOND, START

fsspec = pytest.importorskip('fsspec')
remote_file = pytest.importorskip('boxreg_ros.io.storage.remote_file')

# Not imported: each process that shares the tests would, also where others run these.
pytestmark = pytest.mark.skipif(find_spec('aiohttp') is None, reason='no extra "remote"')
QUICK = ['--set=min_observations=3', '--formats=csv']


class Files(BaseHTTPRequestHandler):
    """
    Serve the files of a folder, whole or a range, and count the bytes.

    Ranges that `fault_of` of the server names a fault for are answered with it: ``error`` (500),
    ``cut`` (the connection ends in the middle), ``short`` (206 with half of the bytes).

    """

    def do_HEAD(self):
        self.respond(with_content=False)

    def do_GET(self):
        self.respond(with_content=True)

    def respond(self, with_content):
        path = Path(self.server.folder, self.path.lstrip('/'))
        if not path.is_file():
            self.send_error(404)
            return
        data = path.read_bytes()
        first, last = 0, len(data) - 1
        asked = self.server.has_ranges and self.headers.get('Range')
        if asked:
            begin, _, end = asked.removeprefix('bytes=').partition('-')
            first, last = min(int(begin), last + 1), min(int(end or last), last)
        fault = self.server.fault_of(first, last) if asked else None
        if fault == 'error':
            self.send_error(500)
            return
        sent_last = (first + last) // 2 if fault else last
        if fault == 'short':
            last = sent_last
        self.send_response(206 if asked else 200)
        self.send_header('Accept-Ranges', 'bytes')
        self.send_header('Content-Length', str(last + 1 - first))
        if asked:
            self.send_header('Content-Range', f'bytes {first}-{last}/{len(data)}')
        self.end_headers()
        if with_content:
            self.server.sent.append(last + 1 - first)
            self.wfile.write(data[first : sent_last + 1])

    def log_message(self, *_):
        """Be silent."""


@contextmanager
def http_server(folder):
    server = ThreadingHTTPServer(('127.0.0.1', 0), Files)
    server.folder, server.sent, server.fault_of = folder, [], lambda *_: None
    server.has_ranges = True
    Thread(target=server.serve_forever, daemon=True).start()
    yield server, f'http://127.0.0.1:{server.server_port}'
    server.shutdown()
    server.server_close()


@pytest.fixture
def sent(monkeypatch):
    """Return a list that fills with the sizes of the answers of the object store [bytes]."""
    application = pytest.importorskip('moto.moto_server.werkzeug_app').DomainDispatcherApplication
    call = application.__call__
    sizes = []

    def counted(self, *arguments):
        parts = list(call(self, *arguments))
        sizes.append(sum(map(len, parts)))
        return parts

    monkeypatch.setattr(application, '__call__', counted)
    return sizes


@pytest.fixture
def store(monkeypatch):
    """Yield a file system of an object store with the bucket ``drives``."""
    s3fs = pytest.importorskip('s3fs')
    moto = pytest.importorskip('moto.server')
    server = moto.ThreadedMotoServer(ip_address='127.0.0.1', port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv('AWS_ENDPOINT_URL', f'http://{host}:{port}')
    monkeypatch.setenv('AWS_ACCESS_KEY_ID', 'key')
    monkeypatch.setenv('AWS_SECRET_ACCESS_KEY', 'secret')
    monkeypatch.setenv('AWS_DEFAULT_REGION', 'us-east-1')
    s3fs.S3FileSystem.clear_instance_cache()  # one of an earlier test has another endpoint
    system = s3fs.S3FileSystem()
    system.makedirs('drives', exist_ok=True)
    yield system
    server.stop()


@pytest.fixture
def google_store(monkeypatch):
    """Yield a file system of Google's object store with the bucket ``drives``."""
    monkeypatch.setenv('GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT', 'false')  # gRPC, not in the emulator
    gcsfs = pytest.importorskip('gcsfs')
    emulator = pytest.importorskip('gcp_storage_emulator.server')
    server = emulator.create_server('127.0.0.1', 0, in_memory=True, default_bucket='drives')
    server.start()
    address = f'http://127.0.0.1:{server._api._httpd.server_port}'
    monkeypatch.setenv('STORAGE_EMULATOR_HOST', address)
    monkeypatch.setitem(fsspec.config.conf, 'gs', {'token': 'anon'})
    gcsfs.GCSFileSystem.clear_instance_cache()
    yield gcsfs.GCSFileSystem(token='anon')
    server.stop()


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Return an MCAP file of 60 sweeps and many chunks, 0.4 MB."""
    folder = tmp_path_factory.mktemp('whole')
    return rewritten(Drive(sweeps=60).write(folder / 'drive'), folder / 'whole.mcap')


@pytest.fixture(scope='module')
def boxes_of_whole(whole, tmp_path_factory):
    """Return the boxes.csv of that file, read from this machine."""
    out = tmp_path_factory.mktemp('local') / 'out'
    assert main(['relabel', str(whole), '-o', str(out), *QUICK]) == 0
    return boxes(out)


def boxes(out):
    return (out / 'boxes.csv').read_bytes()


def test_a_path_carries_a_url():
    assert url_of(Path('s3://bucket/a/b.mcap')) == 's3://bucket/a/b.mcap'
    assert url_of(Path('https://host:80/b.mcap')) == 'https://host:80/b.mcap'
    assert url_of(Path('file:///a/b.mcap')) == 'file:///a/b.mcap'
    assert url_of(Path('/s3:/bucket')) is None
    assert url_of(Path('c:/drive')) is None


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(urls, 'REPEAT_SECONDS', (0.01, 0.01))


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(remote_file, 'REQUEST_BYTES', 2**15)


@pytest.mark.parametrize('fault', [None, 'error', 'cut', 'short'])
def test_recordings_over_http_give_the_same_boxes(
    tmp_path, whole, boxes_of_whole, fault, impatient, small_blocks
):
    """Also where the first request for each range fails."""
    remote = tmp_path / 'remote'
    asked = set()

    def fault_of(*place):
        has_failed = place in asked
        asked.add(place)
        return None if has_failed else fault

    with http_server(whole.parent) as (server, url):
        server.fault_of = fault_of
        assert main(['relabel', f'{url}/whole.mcap', '-o', str(remote), *QUICK]) == 0
    assert len(asked) > 1
    assert boxes(remote) == boxes_of_whole
    assert json.loads((remote / 'summary.json').read_text())['damage'] == []


@pytest.mark.parametrize('fault', ['error', 'cut', 'short'])
def test_bytes_that_a_server_does_not_send_are_no_damage(
    tmp_path, large, fault, impatient, capsys
):
    """A part in the middle never comes: the run fails and writes nothing."""
    out = tmp_path / 'out'
    middle = large.stat().st_size // 2
    with http_server(large.parent) as (server, url):
        server.fault_of = lambda first, last: fault if first <= middle <= last else None
        path = f'{url}/{large.name}'
        assert main(['relabel', path, '-o', str(out), *QUICK]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'boxreg: {path}: got no answer: ')
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_replaced_while_it_is_read_is_no_damage(
    tmp_path, whole, small_blocks, capsys
):
    out = tmp_path / 'out'
    data = whole.read_bytes()
    served = tmp_path / 'whole.mcap'
    served.write_bytes(data)

    def fault_of(first, _):
        if 0 < first < len(data) // 2:  # behind the index, which is read first
            served.write_bytes(data[::-1] + b'longer')

    with http_server(tmp_path) as (server, url):
        server.fault_of = fault_of
        assert main(['relabel', f'{url}/whole.mcap', '-o', str(out), *QUICK]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'expected the file as it was at the start, got another version' in line
    assert not out.exists()


@pytest.mark.parametrize('has_ranges', [True, False])
def test_a_copy_of_a_file_is_whole(tmp_path, large, has_ranges, impatient):
    """A file that is copied first, from servers with and without ranges."""
    asked = []

    def fault_of(*place):
        asked.append(place)
        return 'short' if len(asked) % 2 and has_ranges else None

    with http_server(large.parent) as (server, url):
        server.fault_of, server.has_ranges = fault_of, has_ranges
        remote_file.download(Path(f'{url}/{large.name}'), tmp_path / 'copy')
        if not has_ranges:
            with pytest.raises(TransferError, match='a server that sends ranges'):
                read_slice(f'{url}/{large.name}')
    assert (tmp_path / 'copy').read_bytes() == large.read_bytes()
    assert len(asked) > 3 or not has_ranges


@pytest.fixture(scope='module')
def large(tmp_path_factory):
    """Return an MCAP file of 60 sweeps of 0.3 MB in chunks of one."""
    folder = tmp_path_factory.mktemp('large')
    drive = Drive(sweeps=60)
    others = [item for item in drive.items if item[0] != '/points']
    rng = np.random.default_rng(0)
    clouds = [
        ('/points', stamp, drive.messages.points(stamp, 'lidar', rng.normal(size=(25_000, 3))))
        for stamp in drive.stamps
    ]
    drive.items = sorted([*others, *clouds], key=lambda item: item[1])
    return rewritten(drive.write(folder / 'drive'), folder / 'large.mcap', chunk_size=300_000)


def bytes_of_a_slice(path):
    """Return the bytes that the fourth second needs: its chunks are those of a sweep each."""
    begin, end = START + 3 * SECOND, START + 4 * SECOND
    with path.open('rb') as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    # A slice needs its chunks, those of the transforms 2 s around it, and the first of all.
    return chunks[0].chunk_length + sum(
        chunk.chunk_length
        for chunk in chunks
        if chunk.message_end_time >= begin - 2 * SECOND
        and chunk.message_start_time < end + 2 * SECOND
    )


def read_slice(url):
    """Read the fourth second of a recording."""
    with Recording([Path(url)], start=3.0, end=4.0) as recording:
        tree = TransformTree()
        recording.choose_fixed_frame(tree)
        assert len(list(recording.items(tree))) == 20


def test_a_slice_takes_little_more_than_its_bytes(large, store, sent):
    """Over HTTP, and from an object store: its blocks, that of the index and the first one."""
    with http_server(large.parent) as (server, url):
        read_slice(f'{url}/{large.name}')
    store.put(str(large), 'drives/large.mcap')
    sent.clear()
    read_slice('s3://drives/large.mcap')
    needed = bytes_of_a_slice(large)
    for answers in (server.sent, sent):
        assert 0.5 * needed < sum(answers) < needed + 4 * remote_file.REQUEST_BYTES


@pytest.mark.parametrize('storage', ['sqlite3', 'rosbag1'])
def test_other_storages_over_http(tmp_path, storage):
    drive = Drive(sweeps=6, boxes='markers', ros1=storage == 'rosbag1')
    path = drive.write(tmp_path / 'other', storage)
    file = path if path.is_file() else next(path.glob('*.db3'))
    with http_server(tmp_path) as (_, url):
        remote = Path(f'{url}/{file.relative_to(tmp_path)}')
        with Recording([remote]) as recording:
            tree = TransformTree()
            recording.choose_fixed_frame(tree)
            assert len(list(recording.items(tree))) == 12


@pytest.mark.parametrize(('scheme', 'fixture'), [('s3', 'store'), ('gs', 'google_store')])
def test_an_object_store_in_and_out(whole, boxes_of_whole, scheme, fixture, request, capsys):
    store = request.getfixturevalue(fixture)
    store.put(str(whole), 'drives/one/whole.mcap')
    out = f'{scheme}://drives/results/one'
    command = ['relabel', f'{scheme}://drives/one', '-o', out, *QUICK]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f'{out}: ') and f'next: copy {out} to this machine' in printed
    assert store.cat('drives/results/one/boxes.csv') == boxes_of_whole
    summary = json.loads(store.cat('drives/results/one/summary.json'))
    assert summary['boxes_in'] == 120
    store.pipe('drives/other/file', b'x')
    assert main(['relabel', str(whole), '-o', f'{scheme}://drives/other', *QUICK]) == 1
    assert 'expected a new folder or an earlier result' in capsys.readouterr().err
    store.pipe('drives/results/one/decisions.csv', b'x')  # uploaded after a review elsewhere
    assert main(command) == 1
    assert "'decisions.csv' changed or added since" in capsys.readouterr().err
    assert store.cat('drives/results/one/decisions.csv') == b'x'


def test_urls_of_this_machine(whole, boxes_of_whole, tmp_path):
    out = tmp_path / 'new' / 'out'
    for _ in range(2):
        assert main(['relabel', f'file://{whole}', '-o', f'file://{out}', *QUICK]) == 0
        assert (out / 'boxes.csv').read_bytes() == boxes_of_whole


def test_an_upload_that_is_killed_goes_on_at_the_next_run(whole, store, preloaded_python, capsys):
    out = 's3://drives/results/one'
    command = ['relabel', str(whole), '-o', out, QUICK[0], '--formats=sustechpoints']
    command += ['--end=1']
    for _ in range(5):  # a kill may come too late, after the last file
        names = set()
        if store.exists(out):
            store.rm(out, recursive=True)
        process = subprocess.Popen([preloaded_python, '-m', 'boxreg_ros.cli', *command])
        while not names:
            assert process.poll() is None
            store.invalidate_cache()
            names = {name.removeprefix('drives/results/one/') for name in store.find(out)}
        process.kill()
        process.wait()
        if 'summary.json' not in names:
            break
    assert 'summary.json' not in names
    assert main(command) == 0
    assert '20 boxes in' in capsys.readouterr().out
    store.invalidate_cache()
    summary = json.loads(store.cat(f'{out}/summary.json'))
    found = {name.removeprefix('drives/results/one/') for name in store.find(out)}
    assert found == {'summary.json', *summary['files']}


def test_batch_with_an_object_store(whole, store, capsys):
    store.put(str(whole), 'drives/one/whole.mcap')
    command = ['batch', 's3://drives/one/whole.mcap', '-o', 's3://drives/all']
    assert main([*command, '--set=min_observations=3']) == 0
    assert store.exists('drives/all/whole/boxes.csv')
    assert b'whole,done' in store.cat('drives/all/index.csv')
    assert main([*command, '--set=min_observations=3']) == 0
    assert '1 of them earlier' in capsys.readouterr().out


def test_errors_name_url_and_remedy(tmp_path, capsys):
    with http_server(tmp_path) as (_, url):
        missing = f'{url}/missing.mcap'
        assert main(['relabel', missing, '-o', str(tmp_path / 'out')]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f'boxreg: {missing}: expected a file, got none')
        assert 'credentials' in line
    with pytest.raises(RecordingError, match='expected a scheme of fsspec'):
        part_of(Path('nonsense://host/file.mcap'))


def test_refused_credentials_are_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Files, 'respond', lambda self, with_content: self.send_error(403))
    with http_server(tmp_path) as (_, server_url):
        url = f'{server_url}/one.mcap'
        assert main(['relabel', url, '-o', str(tmp_path / 'out')]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'boxreg: {url}: expected credentials that give access, got: ')


@pytest.mark.parametrize('out', ['results', 's3://missing-bucket/results'])
def test_refused_credentials_of_an_object_store(tmp_path, whole, store, out, monkeypatch, capsys):
    """No credentials at all, where drives are read or results are written."""
    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY'):
        monkeypatch.delenv(name)
    monkeypatch.setenv('AWS_EC2_METADATA_DISABLED', 'true')
    monkeypatch.setenv('HOME', str(tmp_path))
    type(store).clear_instance_cache()
    drives = ['s3://drives/one/whole.mcap'] if out == 'results' else []
    target = out if '://' in out else str(tmp_path / out)
    command = [
        'batch',
        str(whole),
        *drives,
        '-o',
        target,
        '--workers=1',
        '--set=min_observations=3',
    ]
    assert main(command) == 1
    streams = capsys.readouterr()
    (line,) = streams.err.splitlines()
    assert 'expected credentials that give access, got: ' in line
    if drives:
        assert '1 of 2 drives done' in streams.out


def test_a_server_that_does_not_answer_fails_its_drive_only(tmp_path, monkeypatch, capsys):
    path = Drive(sweeps=6).write(tmp_path / 'drive')
    monkeypatch.setattr(urls, 'ANSWER_SECONDS', 0.5)
    with socket.create_server(('127.0.0.1', 0)) as silent:
        url = f'http://127.0.0.1:{silent.getsockname()[1]}/silent.mcap'
        command = ['batch', url, str(path), '-o', str(tmp_path / 'out'), '--workers=1']
        assert main([*command, '--set=min_observations=3']) == 1
    streams = capsys.readouterr()
    (line,) = streams.err.splitlines()
    assert line.startswith(f'boxreg: silent: {url}: got no answer')
    assert '1 of 2 drives done' in streams.out


def test_blocks_are_read_once(tmp_path):
    (tmp_path / 'file.mcap').write_bytes(bytes(range(256)) * 2**16)
    with http_server(tmp_path) as (server, url):
        file = ByteFile(Path(f'{url}/file.mcap'))
        assert file.read(8) == bytes(range(8))
        file.seek(2**22 - 2)
        assert file.read(4) == b'\xfe\xff\0\1'
        file.seek(256)
        assert file.read(4) == bytes(range(4))
        assert server.sent == [remote_file.REQUEST_BYTES] * 2
        file.seek(-1, SEEK_END)
        assert file.read(1) == b'\xff'
        with pytest.raises(EndOfFile):
            file.read(1)
        assert len(server.sent) == 3
        file.close()

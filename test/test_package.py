"""The package: versions, distributions that pip installs, and what colcon builds."""

import ast
import importlib.metadata
import os
from pathlib import Path
import re
import shutil
import signal
import site
import subprocess
import sys
import sysconfig
import tarfile
import time
import venv
from xml.etree import ElementTree

import boxreg_ros
from compiled import copy_compiled
from paths import ROOT
import pytest
import yaml


def test_all_files_state_the_same_version():
    manifest = ElementTree.parse(ROOT / 'package.xml')
    assert manifest.findtext('version') == boxreg_ros.__version__
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert citation['version'] == boxreg_ros.__version__
    released = re.search(
        r'^## \[(\d.*?)\] - (\S+)$', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE
    )
    assert released[1] == boxreg_ros.__version__
    assert released[2] == str(citation['date-released'])


def test_each_declared_python_is_tried():
    text = (ROOT / 'setup.py').read_text(encoding='utf-8')
    declared = ast.literal_eval(re.search(r'^PYTHONS = (.*)$', text, re.MULTILINE)[1])
    workflow = yaml.safe_load((ROOT / '.github/workflows/test.yaml').read_text(encoding='utf-8'))
    assert workflow['jobs']['python']['strategy']['matrix']['python'] == list(declared)
    assert workflow['permissions'] == {'contents': 'read'}
    used = [
        step['uses']
        for job in workflow['jobs'].values()
        for step in job['steps']
        if 'uses' in step
    ]
    assert used and all(re.fullmatch(r'[\w/-]+@[0-9a-f]{40}', action) for action in used)


def test_dependencies_are_pinned():
    try:
        needed = importlib.metadata.requires('boxreg_ros')
    except importlib.metadata.PackageNotFoundError:
        pytest.skip('boxreg_ros is not installed: its requirements are unknown')
    names = {re.match(r'[\w.-]+', requirement)[0].lower() for requirement in needed}
    pinned = set(re.findall(r'^([\w.-]+)==', (ROOT / 'constraints.txt').read_text(), re.MULTILINE))
    assert len(names) > 30
    assert names <= pinned


def imported_distributions():
    """Return the import names of third-party modules in the package, those of extras excluded."""
    names = set()
    for path in [*ROOT.glob('boxreg_ros/**/*.py'), *ROOT.glob('msg_adapters/*.py')]:
        for node in ast.parse(path.read_text(encoding='utf-8')).body:  # the top level alone
            if isinstance(node, ast.ImportFrom):
                names.add(node.module.partition('.')[0])
            elif isinstance(node, ast.Import):
                names |= {alias.name.partition('.')[0] for alias in node.names}
    return names - sys.stdlib_module_names - {'boxreg_ros', 'msg_adapters'}


def test_rosdep_keys_cover_the_imports():
    manifest = ElementTree.parse(ROOT / 'package.xml')
    keys = {item.text for item in manifest.iter('exec_depend')}
    # mcap has no rosdep key; the README describes its installation. It installs zstandard, rosbags
    # installs apsw, and torch filelock. fsspec is that of an extra, and torch needs it.
    # Starlette has none either; `boxreg review` imports its server when it is asked to.
    server = {'anyio', 'starlette', 'uvicorn'}
    others = {'apsw', 'filelock', 'fsspec', 'mcap', 'zstandard'}
    names = imported_distributions() - others - server
    other_keys = {'torch': 'python3-pytorch-pip', 'rosbags': 'python3-rosbags-pip'}
    wanted = {other_keys.get(name, name) for name in names}
    assert len(wanted) > 5
    missing = [name for name in wanted if not {name, f'python3-{name}'} & keys]
    assert missing == []


INSTALLATIONS = (
    'README.md',
    'docs/getting-started.md',
    '.github/workflows/test.yaml',
    'Dockerfile',
)


@pytest.mark.parametrize('file', INSTALLATIONS)
def test_installations_leave_nothing_of_pip_to_rosdep(file):
    index = yaml.safe_load((ROOT / 'test' / 'rosdep_noble.yaml').read_text(encoding='utf-8'))
    manifest = ElementTree.parse(ROOT / 'package.xml')
    keys = {item.text for item in manifest.iter() if item.tag.endswith('depend')}
    assert keys - set(index['ros']) - set(index['apt']) <= set(index['pip'])
    text = (ROOT / file).read_text(encoding='utf-8').replace('\\\n', ' ')
    (line,) = re.findall(r'rosdep install .*?--skip-keys "(.*?)"', text)
    assert keys & set(index['pip']) <= set(line.split())
    by_pip = set(re.findall(r'[a-z]+', ' '.join(re.findall(r'pip install (.*)', text)).lower()))
    names = {index['pip'].get(key, key.removeprefix('python3-')) for key in line.split()}
    assert {*names, 'mcap'} <= by_pip


def test_a_robot_needs_nothing_with_a_window():
    manifest = ElementTree.parse(ROOT / 'package.xml')
    needed = {item.text for item in manifest.iter('exec_depend')}
    assert not needed & {'rviz2', 'python3-matplotlib', 'python3-jinja2'}


def run(command, **options):
    """Run a command that must succeed, outside of the source tree; return its output."""
    environment = options.pop('env', os.environ)
    done = subprocess.run(
        [*map(str, command)],
        env={key: value for key, value in environment.items() if key != 'PYTHONPATH'},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
        **options,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope='module')
def distributions(tmp_path_factory):
    """Build the sdist, and the wheel from the sdist, as for a release."""
    pytest.importorskip('build', reason='build is not installed')
    folder = tmp_path_factory.mktemp('distributions')
    source = folder / 'source'
    ignored = ('.git', '.venv*', '.*_cache', 'out', 'build', 'log', 'install', '*.egg-info')
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*ignored), symlinks=True)
    return built(source, folder / 'dist')


def built(source, folder):
    """Build sdist and wheel into a folder; return their paths."""
    epoch = {**os.environ, 'SOURCE_DATE_EPOCH': '1795651200'}
    command = [sys.executable, '-m', 'build', '--no-isolation', '-o', folder, source]
    run(command, cwd=source.parent, env=epoch)
    (sdist,) = folder.glob('*.tar.gz')
    (wheel,) = folder.glob('*.whl')
    return sdist, wheel


@pytest.fixture(scope='module')
def unpacked(distributions, tmp_path_factory):
    """Return the folder of the unpacked sdist."""
    folder = tmp_path_factory.mktemp('unpacked')
    with tarfile.open(distributions[0]) as archive:
        archive.extractall(folder, filter='data')
    (source,) = folder.iterdir()
    copy_compiled(source)
    return source


def test_sdist_contains_every_file_of_the_sources(unpacked):
    if not (ROOT / '.git').exists():
        pytest.skip('not a clone: its files are unknown')
    tracked = run(['git', '-C', ROOT, 'ls-files', '-z'], cwd=ROOT).split('\0')
    missing = [
        name for name in tracked if (ROOT / name).exists() and not (unpacked / name).exists()
    ]
    assert missing == []


def test_tests_of_the_sdist_run_in_it(unpacked):
    tests = ('test/test_rotations.py', 'test/core/test_metrics.py')
    command = [sys.executable, '-B', '-m', 'pytest', '-q', *tests]
    assert ' passed' in run(command, cwd=unpacked)


def test_distributions_are_reproducible(distributions, unpacked, tmp_path):
    again = built(unpacked, tmp_path)
    for first, second in zip(distributions, again, strict=True):
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes(), first.name


def new_environment(folder):
    """Make an environment with the packages of the running one, except boxreg_ros."""
    venv.create(folder, symlinks=True)
    packages = sysconfig.get_path('purelib', vars={'base': str(folder)})
    # Those of the system too, where the running environment sees them.
    (Path(packages) / 'dependencies.pth').write_text('\n'.join(site.getsitepackages()))
    return folder / 'bin'


def test_wheel_runs_in_another_environment(distributions, tmp_path):
    _, wheel = distributions
    programs = new_environment(tmp_path / 'environment')
    pip = [sys.executable, '-m', 'pip', '--python', programs / 'python', 'install', '--no-deps']
    run([*pip, '--no-index', '--ignore-installed', '--quiet', wheel], cwd=tmp_path)
    packages = sysconfig.get_path('purelib', vars={'base': str(tmp_path / 'environment')})
    copy_compiled(Path(packages))
    code = 'import boxreg_ros; print(boxreg_ros.__path__[0])'
    assert str(tmp_path) in run([programs / 'python', '-c', code], cwd=tmp_path)
    assert 'openlabel' in run([programs / 'boxreg', 'formats'], cwd=tmp_path)
    recording = ROOT / 'bags' / 'street.mcap'
    printed = run([programs / 'boxreg', 'relabel', recording, '-o', 'out'], cwd=tmp_path)
    assert '845 boxes in' in printed
    assert (tmp_path / 'out' / 'boxes.csv').is_file()


def test_editable_install_is_a_plain_path(tmp_path):
    """Type checkers follow a path in a .pth file; they do not run an import hook."""
    programs = new_environment(tmp_path / 'environment')
    source = tmp_path / 'source'
    ignored = shutil.ignore_patterns('.*', 'out', 'build', 'log', 'install', '*.egg-info', 'bags')
    shutil.copytree(ROOT, source, ignore=ignored)
    makefile = (ROOT / 'Makefile').read_text(encoding='utf-8')
    options = re.search(r'^BUILD := (.*)$', makefile, re.MULTILINE)[1].split()
    pip = [sys.executable, '-m', 'pip', '--python', programs / 'python', 'install', '--no-deps']
    run([*pip, '--quiet', '--ignore-installed', *options, '-e', source], cwd=tmp_path)
    packages = Path(sysconfig.get_path('purelib', vars={'base': str(tmp_path / 'environment')}))
    (path_file,) = packages.glob('__editable__*.pth')
    assert path_file.read_text().strip() == str(source)


@pytest.fixture(scope='module', params=['plain', 'symlink'])
def prefix(request, tmp_path_factory):
    """Build with colcon; return the install prefix of the package."""
    pytest.importorskip('colcon_core', reason='colcon is not installed')
    workspace = tmp_path_factory.mktemp(request.param)
    command = [sys.executable, '-m', 'colcon', '--log-base', workspace / 'log', 'build']
    command += ['--base-paths', ROOT, '--packages-select', 'boxreg_ros']
    command += ['--build-base', workspace / 'build', '--install-base', workspace / 'install']
    command += ['--symlink-install'] if request.param == 'symlink' else []
    done = subprocess.run(command, cwd=workspace, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    for core in (workspace / 'install').rglob('boxreg_ros/core'):
        copy_compiled(core.parents[1])
    return workspace / 'install' / 'boxreg_ros'


def sourced(prefix, command, **options):
    """Start a command as after `source install/local_setup.bash`, without the source tree."""
    script = f'source {prefix.parent / "local_setup.bash"} && exec "$@"'
    return subprocess.Popen(
        ['bash', '-c', script, 'bash', *map(str, command)],
        cwd=prefix,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def test_colcon_installs_executables_where_ros2_run_finds_them(prefix):
    for executable in ('boxreg', 'boxreg_node', 'boxreg_lifecycle_node'):
        path = prefix / 'lib' / 'boxreg_ros' / executable
        assert os.access(path, os.X_OK), path
        assert not (prefix / 'bin' / executable).exists()
    assert (prefix / 'share/ament_index/resource_index/packages/boxreg_ros').is_file()
    assert (prefix / 'share/boxreg_ros/package.xml').is_file()
    for file in ROOT.glob('boxreg_ros/share/*'):
        assert (prefix / 'share/boxreg_ros' / file.name).read_bytes() == file.read_bytes()


def test_every_module_is_installed_and_imported_from_the_workspace(prefix):
    modules = [*ROOT.glob('boxreg_ros/**/*.py'), *ROOT.glob('msg_adapters/*.py')]
    names = sorted(str(path.relative_to(ROOT)) for path in modules)
    code = 'import boxreg_ros, sys; print(boxreg_ros.__path__[0])'
    process = sourced(prefix, [sys.executable, '-c', code])
    output, _ = process.communicate(timeout=60)
    site = Path(output.strip()).parent
    assert prefix.parent.parent in site.parents, output
    assert [name for name in names if not (site / name).is_file()] == []


def test_command_line_starts_from_the_workspace(prefix):
    process = sourced(prefix, [prefix / 'lib/boxreg_ros/boxreg', '--help'])
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    for command in ('relabel', 'evaluate', 'simulate'):
        assert command in output


@pytest.mark.parametrize('prefix', ['plain'], indirect=True)  # `boxreg` starts from both
def test_node_starts_and_ends_from_the_workspace(prefix):
    rclpy = pytest.importorskip('rclpy')
    process = sourced(prefix, [prefix / 'lib/boxreg_ros/boxreg_node'], start_new_session=True)
    context = rclpy.Context()
    rclpy.init(context=context)
    observer = rclpy.create_node('observer', context=context)
    try:
        deadline = time.monotonic() + 180  # kernels are compiled first
        while '/refined_markers' not in dict(observer.get_topic_names_and_types()):
            assert process.poll() is None, process.communicate()[0]
            assert time.monotonic() < deadline, observer.get_topic_names_and_types()
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=30)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        observer.destroy_node()
        rclpy.shutdown(context=context)
    assert process.returncode == 0, output
    assert 'Traceback' not in output

"""The package as colcon builds it and `ros2 run` finds it."""

import importlib.metadata
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from xml.etree import ElementTree

import boxreg_ros
from paths import ROOT
import pytest


def test_version_is_one():
    manifest = ElementTree.parse(ROOT / 'package.xml')
    assert manifest.findtext('version') == boxreg_ros.__version__
    newest = re.search(r'^## \[(\d.*?)\]', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)
    assert newest[1] == boxreg_ros.__version__


def test_dependencies_are_pinned():
    try:
        needed = importlib.metadata.requires('boxreg_ros')
    except importlib.metadata.PackageNotFoundError:
        pytest.skip('boxreg_ros is not installed: nothing says what it needs')
    names = {re.match(r'[\w.-]+', requirement)[0].lower() for requirement in needed}
    pinned = set(re.findall(r'^([\w.-]+)==', (ROOT / 'constraints.txt').read_text(), re.MULTILINE))
    assert len(names) > 30
    assert names <= pinned


@pytest.fixture(scope='module', params=['plain', 'symlink'])
def prefix(request, tmp_path_factory):
    pytest.importorskip('colcon_core', reason='colcon is not installed')
    workspace = tmp_path_factory.mktemp(request.param)
    command = [sys.executable, '-m', 'colcon', '--log-base', workspace / 'log', 'build']
    command += ['--base-paths', ROOT, '--packages-select', 'boxreg_ros']
    command += ['--build-base', workspace / 'build', '--install-base', workspace / 'install']
    command += ['--symlink-install'] if request.param == 'symlink' else []
    done = subprocess.run(command, cwd=workspace, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
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


def test_colcon_installs_where_ros2_run_looks(prefix):
    for executable in ('boxreg', 'boxreg_node'):
        path = prefix / 'lib' / 'boxreg_ros' / executable
        assert os.access(path, os.X_OK), path
        assert not (prefix / 'bin' / executable).exists()
    assert (prefix / 'share/ament_index/resource_index/packages/boxreg_ros').is_file()
    assert (prefix / 'share/boxreg_ros/package.xml').is_file()
    for file in ROOT.glob('boxreg_ros/share/*'):
        assert (prefix / 'share/boxreg_ros' / file.name).read_bytes() == file.read_bytes()


def test_every_module_is_installed_and_imported_from_there(prefix):
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


def test_node_starts_and_ends_from_the_workspace(prefix):
    rclpy = pytest.importorskip('rclpy')
    process = sourced(prefix, [prefix / 'lib/boxreg_ros/boxreg_node'], start_new_session=True)
    context = rclpy.Context()
    rclpy.init(context=context)
    observer = rclpy.create_node('observer', context=context)
    try:
        deadline = time.monotonic() + 60
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

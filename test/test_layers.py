"""The rooms of docs/architecture.md: which package may import which; the core knows no ROS."""

import ast
import re
import subprocess
import sys

from paths import ROOT
import pytest

BASE = 'base'
"""The modules that lie in `boxreg_ros` itself."""
MAY_IMPORT = {
    BASE: set(),
    'msg_adapters': {BASE},
    'core': {BASE},
    'io': {BASE, 'core', 'msg_adapters'},
    'labels': {BASE, 'core', 'io', 'msg_adapters'},
    'datasets': {BASE, 'core', 'io', 'labels', 'msg_adapters'},
    'live': {BASE, 'core', 'io', 'msg_adapters'},
    'simulation': {BASE, 'core', 'io', 'msg_adapters'},
    'tracks': {BASE, 'core', 'io', 'msg_adapters'},
    'review': {BASE, 'core', 'io', 'msg_adapters'},
    'offline': {
        *(BASE, 'core', 'io', 'labels', 'datasets', 'tracks', 'review'),
        'msg_adapters',
    },
}
FRONT_DOORS = {ROOT / 'boxreg_ros' / '__init__.py', ROOT / 'boxreg_ros' / 'cli.py'}
"""They offer what lies behind them, in any room, and import it when it is asked for."""
FILES = sorted(
    {*ROOT.glob('boxreg_ros/**/*.py'), *ROOT.glob('msg_adapters/**/*.py')} - FRONT_DOORS
)
KEPT_OUT = {
    *('ament_index_python', 'mcap', 'msg_adapters', 'rclpy', 'rosbags'),
    *('builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces'),
    *('sensor_msgs', 'std_msgs', 'tf2_msgs', 'vision_msgs', 'visualization_msgs'),
}


def room_of(module):
    """Return the room of 'boxreg_ros.room.name'; None for modules of others."""
    top, *inner = module.split('.')
    if top == 'msg_adapters':
        return top
    if top != 'boxreg_ros':
        return None
    return inner[0] if inner and (ROOT / top / inner[0]).is_dir() else BASE


def module_of(path):
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def imports_of(path):
    """Yield every module a file imports, anywhere in it, as a full name with its line."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f'{path}:{node.lineno}: relative import'
            for alias in node.names:  # `from boxreg_ros import core`, too
                yield f'{node.module}.{alias.name}', node.lineno


def wrong_imports(module, imports):
    """Yield what in `imports`, pairs of module and line, a module must not import."""
    room = room_of(module)
    for name, line in imports:
        target = room_of(name)
        if target is not None and target != room and target not in MAY_IMPORT[room]:
            yield f'{module}:{line} imports {name}: {room} may not import {target}'


@pytest.mark.parametrize('path', FILES, ids=module_of)
def test_imports_follow_the_arrows(path):
    assert not list(wrong_imports(module_of(path), imports_of(path)))


def test_every_package_is_a_room():
    packages = {path.parent.name for path in ROOT.glob('boxreg_ros/*/__init__.py')}
    assert packages == set(MAY_IMPORT) - {BASE, 'msg_adapters'}
    assert {path.name for path in ROOT.glob('test/*') if path.name in packages} == packages


def test_the_picture_of_the_house_has_the_same_arrows():
    page = (ROOT / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    picture = page[page.index('```mermaid') : page.index('```\n\n|')]
    downstairs = {room: set() for room in MAY_IMPORT}
    for above, below in re.findall(r'^ +([\w &]+) --> ([\w &]+)$', picture, re.MULTILINE):
        for room in above.split(' & '):
            downstairs[room] |= set(below.split(' & '))
    for _ in MAY_IMPORT:  # whatever can be reached
        for rooms in downstairs.values():
            rooms |= set().union(*(downstairs[room] for room in rooms))
    assert downstairs == MAY_IMPORT


@pytest.mark.parametrize(
    ('module', 'imported'),
    [
        ('boxreg_ros.core.geometry', 'boxreg_ros.io.recording'),
        ('boxreg_ros.core.geometry', 'msg_adapters.vision'),
        ('boxreg_ros.live.node', 'boxreg_ros.offline.relabel'),
        ('boxreg_ros.offline.relabel', 'boxreg_ros.live.pipeline'),
        ('boxreg_ros.config', 'boxreg_ros.core.geometry'),
        ('msg_adapters.vision', 'boxreg_ros.core.geometry'),
    ],
)
def test_the_rule_can_fail(module, imported):
    assert list(wrong_imports(module, [(imported, 1)]))
    assert not list(wrong_imports(module, [('boxreg_ros.structures', 1), ('numpy', 1)]))


def test_core_imports_numbers_only():
    allowed = {'boxreg_ros', 'numba', 'numpy', 'scipy', 'torch', 'yaml'}
    clocks = {'time', 'datetime', 'os', 'subprocess', 'threading'}
    for path in (path for path in FILES if room_of(module_of(path)) == 'core'):
        tops = {name.split('.')[0] for name, _ in imports_of(path)}
        assert tops - sys.stdlib_module_names <= allowed, path
        assert not tops & clocks, path


WITHOUT_ROS = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {KEPT_OUT}:
            raise ModuleNotFoundError(f'{{name}} is kept out of this test')

sys.meta_path.insert(0, Absent())
import numpy as np
from boxreg_ros import Config, Track, refine
import boxreg_ros.core.registrar

stamps = np.arange(6) * 100_000_000
across, up = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7))
rear = np.stack([np.full(63, -2.0), across.ravel(), up.ravel()], axis=1)
boxes = np.array([[10.0 + i, 0, 0, 4, 1.8, 1.5, 0, 0, 0] for i in range(6)])
points = [box[:3] + rear for box in boxes]
boxes[2, 0] += 0.3
track = Track('7', 'car', stamps, boxes, points, sensor_origins=np.zeros((6, 3)))
(refined,) = refine([track], Config())
assert refined.track_id == '7' and refined.boxes.shape == (6, 9)
assert np.isfinite(refined.boxes).all()
assert set(refined.status) <= {{'refined', 'kept', 'interpolated'}}, refined.status
print('ran', abs(refined.boxes[2, 0] - 12.0))
"""


def test_refine_needs_no_ros():
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    word, error = done.stdout.split()
    assert word == 'ran'
    assert float(error) < 0.3  # no further from the truth than the input

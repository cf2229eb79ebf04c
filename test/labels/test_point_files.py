"""PCD files as other programs write them."""

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.labels.clouds import read_pcd, write_cloud
from consumers import consumer
import numpy as np
import pytest

ROWS = [[1.5, -2.0, 3.25, 7], [4.0, 5.5, -6.0, 65535]]
HEADER = {
    'VERSION': '0.7', 'FIELDS': 'x y z ring', 'SIZE': '4 4 8 2', 'TYPE': 'F F F U',
    'COUNT': '1 1 1 1', 'WIDTH': '2', 'HEIGHT': '1', 'VIEWPOINT': '0 0 0 1 0 0 0',
    'POINTS': '2', 'DATA': 'ascii',
}  # fmt: skip
TEXT = '1.5 -2.0 3.25 7\n4.0 5.5 -6.0 65535\n'


def write(path, body, **changes):
    """Write a PCD file; a line whose value is None is left out."""
    header = HEADER | changes
    lines = [f'{name} {value}' for name, value in header.items() if value is not None]
    text = '\n'.join(['# written by hand', *lines, ''])
    path.write_bytes(text.encode() + body)
    return path


def packed():
    kinds = [('x', '<f4'), ('y', '<f4'), ('z', '<f8'), ('ring', '<u2')]
    return np.array([tuple(row) for row in ROWS], kinds)


@pytest.mark.parametrize(
    ('body', 'changes'),
    [
        (TEXT, {}),
        (TEXT.replace(' ', '  ').replace('\n', ' \r\n'), {}),
        (TEXT.replace(' ', '\t'), {'COUNT': None, 'VIEWPOINT': None, 'VERSION': '.6'}),
        (TEXT, {'POINTS': None, 'WIDTH': '1', 'HEIGHT': '2'}),
        (packed().tobytes(), {'DATA': 'binary'}),
        (packed().tobytes() + b'more', {'DATA': 'binary'}),
    ],
)
def test_pcd_files_of_any_writer_have_the_same_points(tmp_path, body, changes):
    body = body.encode() if isinstance(body, str) else body
    table = read_pcd(write(tmp_path / 'a.pcd', body, **changes))
    assert table.dtype == packed().dtype
    assert table.tolist() == packed().tolist()


def test_fields_of_several_numbers_and_padding_do_not_shift_the_others(tmp_path):
    layout = {'FIELDS': '_ x hist y', 'SIZE': '1 4 4 4', 'TYPE': 'U F F F', 'COUNT': '3 1 2 1'}
    path = write(tmp_path / 'a.pcd', b'9 9 9 1 0 0 2\n8 8 8 3 0 0 4\n', **layout)
    table = read_pcd(path)
    assert table.dtype.names == ('x', 'hist', 'y')
    assert (table['x'].tolist(), table['y'].tolist()) == ([1, 3], [2, 4])


@pytest.mark.parametrize('encoding', ['ascii', 'binary', 'binary_compressed'])
def test_pcd_files_of_pypcd4_have_the_same_points(tmp_path, encoding):
    points = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    write_cloud(tmp_path / 'a.pcd', points, np.arange(200.0))
    consumer('recoded_cloud', tmp_path / 'a.pcd', tmp_path / 'b.pcd', encoding)
    table = read_pcd(tmp_path / 'b.pcd')
    found = np.stack([table[name] for name in 'xyz'], axis=1)
    np.testing.assert_allclose(found, points, atol=1e-6 if encoding == 'ascii' else 0)
    assert table['intensity'].tolist() == list(range(200))


@pytest.mark.parametrize(
    ('body', 'changes', 'message'),
    [
        (packed().tobytes()[:18], {'DATA': 'binary'}, '1 of 2 points'),
        (TEXT.encode(), {'POINTS': '3'}, '2 of 3 points'),
        (b'', {'DATA': 'binary_compressed'}, '0 of 2 points'),
        (b'', {'DATA': None}, 'no line DATA'),
        (b'', {'FIELDS': None}, "KeyError 'FIELDS'"),
        (b'', {'DATA': 'morse'}, 'DATA morse'),
    ],
)
def test_a_damaged_pcd_file_is_refused(tmp_path, body, changes, message):
    with pytest.raises(UnsupportedMessage, match=f'a.pcd: expected a PCD file: .*{message}'):
        read_pcd(write(tmp_path / 'a.pcd', body, **changes))

"""docs/results.md: made from the stored measurements alone."""

import json
import re
import runpy
import shutil

from boxreg_ros.bench.sensitivity import variations_of_constants
from boxreg_ros.config import Config
from paths import ROOT
import pytest

SCRIPT = runpy.run_path(str(ROOT / 'docs' / 'results.py'), run_name='results')
STORE = ROOT / 'docs' / 'results'
STORED = sorted(STORE.glob('*.json'))


def test_page_is_made_from_the_stored_measurements():
    assert (ROOT / 'docs' / 'results.md').read_text(encoding='utf-8') == SCRIPT['page'](STORE)


def test_page_follows_the_measurements(tmp_path):
    store = tmp_path / 'results'
    shutil.copytree(STORE, store)
    path = store / 'real_pandaset_002_a.json'
    document = json.loads(path.read_text(encoding='utf-8'))
    (methods,) = document['results'].values()
    assert f'| ours, track | {methods["ours, track"]["iou_bev"]:.3f} |' in SCRIPT['page'](store)
    methods['ours, track']['iou_bev'] = 0.12345
    path.write_text(json.dumps(document), encoding='utf-8')
    assert '| ours, track | 0.123 |' in SCRIPT['page'](store)


def test_numbers_without_an_effect_exist():
    text = (STORE / 'sensitivity.md').read_text(encoding='utf-8')
    rows = [line for line in text.splitlines() if line.startswith('| `')]
    listed = {name for row in rows for name in re.findall(r'`([^`]+)`', row.split('|')[1])}
    settings = {item.name for item, _ in Config().items()}
    constants = {item.name.partition('[')[0] for item in variations_of_constants()}
    assert listed
    assert listed <= settings | constants


@pytest.mark.parametrize('path', STORED, ids=lambda path: path.stem)
def test_stored_measurement_names_version_and_command(path):
    document = json.loads(path.read_text(encoding='utf-8'))
    kind = path.stem.partition('_')[0]
    assert document['command'].startswith(f'boxreg bench {kind}')
    anywhere = document['command'].replace('out/bench', '').replace('bags/', '')
    assert '/' not in anywhere  # no path of one machine
    assert document['version']
    assert kind in SCRIPT['SECTIONS']


@pytest.mark.parametrize('path', sorted(STORE.glob('real_*.json')), ids=lambda path: path.stem)
def test_every_accuracy_table_shows_the_baselines(path):
    (methods,) = json.loads(path.read_text(encoding='utf-8'))['results'].values()
    rows = {'input', 'smoothing only', 'ICP on box points', 'paper, track', 'ours, track'}
    assert rows <= methods.keys()


def test_cells_within_chance_by_hand():
    # Tracks scatter little in the first kind, so that exact covariances would be in the band, but
    # along it is far below and up far above. In the second kind exact ones would be above 1.5,
    # one deviation off, in 16 % and below 0.7 in 27 %. The third has too few tracks to say.
    nees = {'along': 0.2, 'across': 1.0, 'up': 3.0, 'yaw': 1.0}
    groups = {
        kind: {'tracks': tracks, 'nees': nees, 'nees_error': {v: e * nees[v] for v in nees}}
        for kind, tracks, e in (('vehicles', 9, 0.01), ('cyclists', 3, 0.5), ('pedestrians', 2, 1))
    }
    said = SCRIPT['_cells_and_chance']({'drive': {'track': groups}})
    assert '6 of 12 cells are 0.7 to 1.5' in said
    assert 'with 3 tracks or more 4 of 8' in said
    assert f'{4 + 4 * (1 - 0.159 - 0.274):.0f} of these would be' in said
    assert 'standard errors are 2, more 1.' in said

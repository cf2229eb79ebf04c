#!/usr/bin/env bash
# guess: ate and rte of evalio, which by their documentation check whether the two trajectories are aligned and otherwise align them, compare
#        poses of one time: align works on space and time, and takes for each stamp the closest one.
# happens: the check (_check_aligned in stats.py) looks at the first poses and the number of poses, at no stamp. An estimate without error
#          that lacks one pose has an error of 0; if it also goes on for one pose more, the counts are equal, all poses after the gap are
#          compared with those of the step before, and at 10 m/s and 10 Hz the error is 1 m.
# versions: evalio 0.6.1, numpy 2.4.6
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check evalio==0.6.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from evalio.stats import WindowSeconds, align, ate, rte
from evalio.types import SE3, SO3, Stamp, Trajectory
import numpy as np

print('evalio', version('evalio'), 'numpy', version('numpy'))
SPEED = 10.0  # m/s
stamps = np.arange(101) / 10.0  # s


def drive(times):
    """Return where the vehicle is at each time [s], without error."""
    return Trajectory(
        stamps=[Stamp.from_sec(float(time)) for time in times],
        poses=[SE3(SO3.identity(), np.array([SPEED * time, 0.0, 0.0])) for time in times],
    )


truth = drive(stamps[:-1])
estimates = {
    'all poses': drive(stamps[:-1]),
    'one missing': drive(np.delete(stamps[:-1], 50)),
    'one more': drive(stamps),
    'one missing, one more': drive(np.delete(stamps, 50)),
}
largest = {}
for name, estimate in estimates.items():
    absolute, relative = ate(estimate, truth).trans, rte(estimate, truth, WindowSeconds(1.0)).trans
    largest[name] = absolute.max(), relative.max()
    print(f'{name}: {len(estimate)} poses for {len(truth)}, ATE mean {absolute.mean():.2f} m, largest {absolute.max():.2f} m;',
          f'RTE over 1 s, largest {relative.max():.2f} m')
same_count = estimates.pop('one missing, one more')
assert len(same_count) == len(truth)
assert all(np.allclose(largest[name], 0) for name in estimates)
assert np.allclose(largest['one missing, one more'], 1.0)
assert np.isclose(ate(same_count, truth).trans.mean(), 0.5)

# Aligned by the user before, the same estimate has no error but that of the missing pose.
by_hand = ate(*align(same_count, truth)).trans
print(f'aligned before: ATE mean {by_hand.mean():.2f} m, {(by_hand > 1e-6).sum()} of {len(by_hand)} poses above 0')
PYTHON

"""Files ``input_model.json``: what drives have shown of their detector."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import erfc, sqrt
from pathlib import Path

from boxreg_ros.config import KINDS
from boxreg_ros.core.input_model import FACE_GROUPS
from boxreg_ros.core.input_statistics import Drives, from_text, joined
from boxreg_ros.core.method.margins import MIN_HITS
from boxreg_ros.errors import ConfigError, unreadable
from boxreg_ros.io.storage.urls import read_text
from boxreg_ros.structures import Floats
import numpy as np

CHANCE = 1e-3
"""Drives of one detector are said to differ with this probability. Chosen."""
MIN_SCATTER = 8
"""Faces of tracks whose scatter is an estimate. Chosen."""
GROUP_NAMES = ('ends', 'sides', 'top', 'bottom')
"""Of `FACE_GROUPS`."""


def read_models(paths: Sequence[Path]) -> Drives:
    """
    Return the drives of some files.

    Raises ConfigError if a file cannot be read, is of another version or damaged, or all have no
    drive.

    """
    found = joined(map(_read, paths))
    if paths and not found:
        raise ConfigError(
            f'input model: expected at least one drive, got none in '
            f'{", ".join(map(str, paths))}; give files of drives with tracks'
        )
    return found


def _read(path: Path) -> Drives:
    try:
        text = read_text(path)
    except OSError as error:
        raise ConfigError(f'input model {unreadable(path, error)}') from None
    except UnicodeDecodeError as error:
        raise ConfigError(
            f'input model {path}: expected text in UTF-8, got {error.reason}; is it another file?'
        ) from None
    return from_text(text, str(path))


def disagreements(drives: Drives) -> Iterator[str]:
    """
    Yield where the gaps of a drive differ from the others by more than chance.

    Then detectors or rules differ. By the mean gap of each group of faces, with the scatter
    between its tracks.

    """
    tests = len(drives) * len(KINDS) * len(GROUP_NAMES)
    for digest, k in product(drives if len(drives) > 1 else (), range(len(KINDS))):
        own = drives[digest][k]
        others = [drive[k] for name, drive in drives.items() if name != digest]
        sums = np.concatenate([kind.tracks['sums'] for kind in others])
        pairs = zip(GROUP_NAMES, _means(own.tracks['sums']), _means(sums), strict=True)
        for name, (mean, variance), (known, error) in pairs:
            if _is_chance(mean - known, variance + error, tests):
                continue
            yield (
                f'margins of {name} of {KINDS[k]}s that differ by {mean - known:+.2f} m in drive '
                f'{digest}'
            )


def _is_chance(difference: float, variance: float, tests: int) -> bool:
    """Return whether a difference of a normal variable may be none; NaN is no evidence."""
    return not erfc(abs(difference) / sqrt(2 * variance)) * tests < CHANCE


def _means(sums: Floats) -> list[tuple[float, float]]:
    """Return mean and variance of the gaps of tracks, by group of faces, NaN for few tracks."""
    found = []
    for faces in FACE_GROUPS:
        total, count, share = sums[:, 0][..., faces].swapaxes(0, 1).reshape(3, -1)
        is_known = count >= MIN_HITS
        known = total[is_known] / share[is_known]
        n = len(known)
        variance = known.var(ddof=1) / n if n > MIN_SCATTER else np.nan
        found.append((known.mean() if n else np.nan, variance))
    return found

"""
What drives show of the errors of their detector and of its labelling rule, to begin others with.

Statistics of single tracks, for each kind of objects: they can be joined in any order.

"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
import json
from typing import Any, NamedTuple

from boxreg_ros.config import KINDS
from boxreg_ros.errors import ConfigError
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray

FORMAT, MODEL_VERSION, MODEL_UNITS = 'boxreg input model', 1, 'm, rad'
DIGITS = 6
"""Significant digits of a number in a file. Chosen: more than any of them is known."""
MAX_NOISE = 1e3
"""Deviations of an input over those of the settings are smaller. Chosen."""
MAX_METRES = 1e3
"""Extents and gaps of objects are smaller [m]. Chosen."""
TRACK = np.dtype(
    [('sums', float, (3, 3, 6)), ('evidence', float, (3, 3)), ('at_input', float, (3, 3, 6))]
)
"""
Of one track.

sums
    Over the observations of its faces: of gap, occlusion inset and range inset; each with value
    [m], number of observations and share.
evidence
    Of its points about the extents, see `population_slopes`.
at_input
    As `sums`, of observations at the angles of the input, until a fit replaces them.
"""
NOISE = np.dtype([('deviation', float, 9), ('correlation', float, 9), ('boxes', float)])
"""
Noise of one kind of a drive (M16).

deviation, correlation
    Robust standard deviation about the mean of a track, along the box axes: lon lat z roll pitch
    yaw, and the extents, in units of the settings; correlation from one observation to the next.
boxes
    That it is estimated from.
"""
TRACK_FIELDS = ('sums', 'evidence')
NOISE_FIELDS = ('deviation', 'correlation', 'boxes')


class KindStatistics(NamedTuple):
    """
    What a drive shows of one kind of objects.

    Attributes
    ----------
    tracks : array of `TRACK`, shape (n,)
    noise : record `NOISE`

    """

    tracks: NDArray[np.void]
    noise: NDArray[np.void]


Drives = dict[str, tuple[KindStatistics, ...]]
"""Statistics of drives, of each of `KINDS`, by a name that their recordings give, in order."""


def joined(models: Iterable[Drives]) -> Drives:
    """Return all drives of some files, each once; their order makes no difference."""
    every = [item for model in models for item in model.items()]
    every.sort(key=lambda item: (item[0], _digest(item[1])))  # one drive, run twice: either
    return dict(every)


def pooled_noise(parts: Iterable[NDArray[np.void]]) -> NDArray[np.void]:
    """Return the noise of all boxes of some records `NOISE`; zeros without any."""
    known = np.array(list(parts), NOISE)
    pooled, boxes = np.zeros((), NOISE), known['boxes']
    if boxes.sum() > 0:
        pooled['boxes'] = boxes.sum()
        pooled['deviation'] = np.sqrt(boxes @ known['deviation'] ** 2 / boxes.sum())
        pooled['correlation'] = boxes @ known['correlation'] / boxes.sum()
    return pooled


def drive_of(kinds: Iterable[KindStatistics], name: str) -> Drives:
    """Return one drive, as a file will have it; none where it shows nothing."""
    drive = tuple(_kind_of(_as_json(kind)) for kind in kinds)
    is_known = any(len(kind.tracks) or kind.noise['boxes'] for kind in drive)
    return {name or _digest(drive): drive} if is_known else {}


def to_text(drives: Drives) -> str:
    """Return the content of a file ``input_model.json``: of the same drives, the same bytes."""
    content = {
        name: {'sha256': _digest(drive), **dict(zip(KINDS, map(_as_json, drive), strict=True))}
        for name, drive in sorted(drives.items())
    }
    head = {'format': FORMAT, 'version': MODEL_VERSION, 'units': MODEL_UNITS, 'drives': content}
    return json.dumps(head, indent=1) + '\n'


def from_text(text: str, name: str) -> Drives:
    """
    Return the drives of a file.

    Raises
    ------
    ConfigError
        If it is no input model of this version, or damaged.

    """
    try:
        head = json.loads(text, parse_constant=_refuse_constant)
    except ValueError as error:
        raise _wrong(name, 'JSON of finite numbers', f'other text ({error})') from None
    if not isinstance(head, dict) or head.get('format') != FORMAT:
        raise _wrong(name, f'a file with the format {FORMAT!r}', 'another one')
    for key, known in (('version', MODEL_VERSION), ('units', MODEL_UNITS)):
        if head.get(key) != known:
            raise _wrong(name, f'{key} {known!r}', repr(head.get(key)))
    drives = head.get('drives')
    if not isinstance(drives, dict):
        raise _wrong(name, 'drives by name', type(drives).__name__)
    return dict(sorted(_checked_drive(name, *item) for item in drives.items()))


def _checked_drive(file: str, name: str, drive: Any) -> tuple[str, tuple[KindStatistics, ...]]:
    """Return name and content of one drive of a file."""
    known = {'sha256', *KINDS}
    if not isinstance(drive, dict) or set(drive) != known:
        others = ', '.join(drive) if isinstance(drive, dict) else type(drive).__name__
        raise _wrong(file, f'{", ".join(sorted(known))} of each drive', others)
    try:
        found = tuple(_kind_of(drive[kind]) for kind in KINDS)
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise _wrong(file, 'the numbers of its version', str(error)) from None
    if not all(map(_is_plausible, found)):
        raise _wrong(file, f'numbers in {MODEL_UNITS}', f'others in drive {name}')
    if _digest(found) != drive['sha256']:
        raise _wrong(file, f'drive {name} as it was written', 'a changed one')
    return name, found


def _is_plausible(kind: KindStatistics) -> bool:
    """Return whether the numbers of a kind can be those of tracks."""
    counts = kind.tracks['sums'][:, :, 1]
    logarithms = np.abs(kind.tracks['evidence'][:, 0])
    sums = np.abs(kind.tracks['sums'][:, :, 0])
    noise = kind.noise
    return bool(
        (counts >= 0).all()
        and (sums <= MAX_METRES * counts).all()
        and (logarithms < np.log(MAX_METRES)).all()
        and ((noise['deviation'] >= 0) & (noise['deviation'] < MAX_NOISE)).all()
        and ((noise['correlation'] >= 0) & (noise['correlation'] < 1)).all()
        and noise['boxes'] >= 0
    )


def _wrong(name: str, expected: str, actual: str) -> ConfigError:
    """Return the error of a file."""
    return ConfigError(
        f'input model {name!r}: expected {expected}, got {actual}; leave it out, or take an '
        f'input_model.json that this version of boxreg has written'
    )


def _refuse_constant(text: str) -> None:
    raise ValueError(text)


def _digest(drive: tuple[KindStatistics, ...]) -> str:
    return sha256(json.dumps([_as_json(kind) for kind in drive]).encode()).hexdigest()[:16]


def _rounded(values: Floats) -> list[Any]:
    """Return numbers with `DIGITS` digits, in nested lists."""
    if values.ndim:
        return [_rounded(part) for part in values]
    return float(f'{float(values):.{DIGITS}g}')  # type: ignore[return-value]


def _as_json(kind: KindStatistics) -> dict[str, Any]:
    """Return the statistics of a kind as a file has them."""
    tracks = [{name: _rounded(track[name]) for name in TRACK_FIELDS} for track in kind.tracks]
    return {
        'noise': {name: _rounded(kind.noise[name]) for name in NOISE_FIELDS},
        'tracks': tracks,
    }


def _kind_of(content: dict[str, Any]) -> KindStatistics:
    """Return the statistics of a kind from a file: the inverse of `_as_json`."""
    tracks, noise = np.zeros(len(content['tracks']), TRACK), np.zeros((), NOISE)
    for name in NOISE_FIELDS:
        noise[name] = _exactly(content['noise'][name], noise[name].shape)
    for track, given in zip(tracks, content['tracks'], strict=True):
        for name in TRACK_FIELDS:
            track[name] = _exactly(given[name], track[name].shape)
    return KindStatistics(tracks, noise)


def _exactly(given: Any, shape: tuple[int, ...]) -> Floats:
    """Return numbers, which must have a shape and be finite."""
    values = np.array(given, dtype=np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f'numbers of shape {values.shape}, not {shape}, or not finite')
    return values

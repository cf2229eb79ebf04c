"""
`boxreg calibrate`: labelling margins and errors of the input, from a few labelled tracks.

The labelling margins come from face observations at true boxes, pooled as the core pools those at
input boxes. The errors are the deviations of the boxes of the recording from the true ones.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.config import Config, KINDS, Setting, settings
from boxreg_ros.core.input_model import FACE_GROUPS, InputModel
from boxreg_ros.core.input_noise import noise_of, normalised_residuals
from boxreg_ros.core.matching import AT_ONCE
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.noise import DETECTED, MAD_TO_DEVIATION
from boxreg_ros.core.observation import Observation, Observations, observe
from boxreg_ros.core.problem import group_windows, stack_windows
from boxreg_ros.core.window import Window
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.arguments import (
    add_options,
    add_recordings,
    request_from,
    Settings,
    TOPICS,
)
from boxreg_ros.offline.drive import Drive
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import spare_file
from boxreg_ros.offline.sources import source_of, true_boxes
from boxreg_ros.structures import Floats, is_valid_box, POSE, ROLL
import numpy as np
import yaml

GAPS = ('gap_ends', 'gap_sides', 'gap_top', 'gap_bottom')
INSETS = ('inset_ends', 'inset_sides')
ERRORS = ('position', 'lateral', 'height', 'heading', 'extent')
PASSES = 4
"""Passes of the estimation: the outermost points depend a little on the margins. Chosen."""
MIN_TRACKS = 3
"""Fewest tracks that give a value. Chosen."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A setting as estimated from labelled tracks."""

    value: float  # the estimate; NaN without evidence
    spread: float  # robust standard deviation between tracks, in the unit of the value
    tracks: int  # number of tracks with evidence

    @classmethod
    def median(cls, means: Sequence[Floats]) -> Measured:
        """Return the median over values, one array of them per track."""
        values = np.concatenate([np.zeros(0), *means])
        middle = float(np.median(values)) if len(values) else np.nan
        return cls(middle, _deviation(values - middle), len(means))


def labelling_margins(drive: Drive, config: Config) -> dict[str, Measured]:
    """
    Estimate the labelling margins and insets of faces at the true boxes of a drive.

    Parameters
    ----------
    drive : Drive
        Its sweeps and true boxes are used, its input boxes are not.
    config : Config
        Has the margins to begin with.

    Returns
    -------
    measured : dict of str to Measured
        By the name of the setting [m]: margins and their spread by the kinds of objects there are,
        insets of all kinds together; NaN without evidence.

    """
    kinds: dict[str, list[Window]] = {}
    for window in _true_windows(drive, config):
        kinds.setdefault(config.kind(window.class_name), []).append(window)
    found: dict[str, Measured] = {}
    for _ in range(PASSES):
        means = _means_of_tracks(kinds, config)
        found = {name: Measured.median(values) for name, values in means.items()}
        config = config.updated(_valid(found))
    return found | {f'{kind}.gap_spread': _margin_spread(kind, found, config) for kind in kinds}


def _margin_spread(kind: str, margins: Mapping[str, Measured], config: Config) -> Measured:
    """
    Return the deviation of the margins of a kind between objects, of ends, sides and top [m].

    The setting counts as some tracks (M15): three equal margins do not make the next one equal.

    """
    found = [margins[f'{kind}.{name}'] for name in GAPS[:-1]]
    tracks = min(measured.tracks for measured in found)
    before, prior = getattr(config, kind).gap_spread, CONSTANTS.half_weight
    measured = np.mean([measured.spread**2 for measured in found])
    variance = (prior * before**2 + tracks * measured) / (prior + tracks)
    return Measured(float(np.sqrt(variance)), np.nan, tracks)


def _means_of_tracks(
    kinds: Mapping[str, Sequence[Window]], config: Config
) -> dict[str, list[Floats]]:
    """Return margins and insets by name of the setting, one array per track with evidence [m]."""
    gaps: dict[str, list[Floats]] = {f'{kind}.{name}': [] for kind in kinds for name in GAPS}
    insets: dict[str, list[Floats]] = {f'faces.{name}': [] for name in INSETS}
    for kind, windows in kinds.items():
        expected = [getattr(getattr(config, kind), name) for name in GAPS]
        for first in range(0, len(windows), CONSTANTS.max_tracks):
            model = _model_of(windows[first : first + CONSTANTS.max_tracks], config)
            for name, gap, faces in zip(GAPS, expected, FACE_GROUPS, strict=True):
                gaps[f'{kind}.{name}'] += [gap + shift for shift in model.gaps_of_tracks(faces)]
            for name, faces in zip(INSETS, FACE_GROUPS, strict=False):
                insets[f'faces.{name}'] += model.occlusion_insets_of_tracks(faces)
    return gaps | insets


def input_errors(drive: Drive, config: Config) -> dict[str, Measured]:
    """
    Estimate the errors of the boxes of a drive.

    Parameters
    ----------
    drive : Drive
        Its input boxes are compared with the true ones of the same stamp and track id.
    config : Config
        Assigns class names to kinds of objects.

    Returns
    -------
    measured : dict of str to Measured
        By the name of the setting, in its unit, for the kinds of objects with such pairs; NaN
        without tracks that are long enough.

    """
    given = {
        (array.stamp_ns, name): box
        for array in reversed(drive.boxes)
        for name, box in zip(reversed(array.track_ids), reversed(array.boxes), strict=True)
        if is_valid_box(box)
    }  # of several boxes with one id the first counts
    pairs: dict[str, dict[str, list[tuple[int, Floats, Floats]]]] = {}
    truth = drive.truth
    for i in np.argsort(truth.stamps_ns, kind='stable'):
        stamp_ns, name = int(truth.stamps_ns[i]), truth.track_ids[i]
        if (stamp_ns, name) in given and is_valid_box(truth.boxes[i]):
            kind = config.kind(truth.class_names[i])
            pair = stamp_ns, given[stamp_ns, name], truth.boxes[i]
            pairs.setdefault(kind, {}).setdefault(name, []).append(pair)
    return {
        f'{kind}.{name}': measured
        for kind, tracks in pairs.items()
        for name, measured in _errors_of_kind(list(tracks.values()), config).items()
    }


def _errors_of_kind(
    tracks: list[list[tuple[int, Floats, Floats]]], config: Config
) -> dict[str, Measured]:
    """Return the errors of tracks of (stamp, input box, true box) that are long enough."""
    tracks = [track for track in tracks if len(track) >= CONSTANTS.min_observations]
    found = dict.fromkeys(ERRORS, Measured(np.nan, np.nan, 0))
    if not tracks:
        return found
    given = [_bare([row[:2] for row in track]) for track in tracks]
    labelled = [_bare([row[::2] for row in track]) for track in tracks]
    decay = CONSTANTS.prior_decay
    problem, priors = stack_windows(given, config, decay)
    true, true_priors = stack_windows(labelled, config, decay)
    problem = problem._replace(counts=problem.valid.astype(int))  # as if all boxes had points
    poses = true.boxes[..., POSE]
    poses[..., :3] += (true_priors.base - priors.base)[:, None]
    # The input may have the opposite heading, for a whole track: yaw is compared modulo 180°.
    half_turns = np.array([2.0, 2.0, 1.0]) * np.pi
    off = problem.boxes[..., ROLL:] - poses[..., 3:]
    poses[..., 3:] += half_turns * np.round(off / half_turns)
    extent = true.mean_extents()
    residuals = normalised_residuals(problem, poses, extent) * problem.errors[:, None]
    # Without tracks whose boxes only repeat the one before.
    counts = np.isfinite(residuals).all(2).sum(1)
    residuals = residuals[counts >= CONSTANTS.min_observations]
    if len(residuals):
        single = np.array([_deviations(residuals[b : b + 1]) for b in range(len(residuals))])
        spreads = [_deviation(column - np.median(column)) for column in single.T]
        values = _deviations(residuals)
        for name, value, spread in zip(ERRORS, values, spreads, strict=False):
            found[name] = Measured(float(value), spread, len(residuals))
    # A track has one extent: what counts is the error of its mean.
    error = np.abs(problem.mean_extents() / extent - 1)
    by_track = MAD_TO_DEVIATION * np.median(error, axis=1)
    spread = _deviation(by_track - np.median(by_track))
    found['extent'] = Measured(MAD_TO_DEVIATION * float(np.median(error)), spread, len(tracks))
    return found


def _deviations(residuals: Floats) -> Floats:
    """Return the deviations (4,) of all `ERRORS` but the extent, of residuals (B, N, 9)."""
    noise = noise_of(residuals, CONSTANTS)
    deviations: Floats = noise['deviation'][[*DETECTED]]
    return deviations


def calibrated(config: Config, measured: Mapping[str, Measured]) -> dict[str, Any]:
    """
    Return the settings that were estimated, and those in `config` that are not the defaults.

    `faces.learn` is switched off if for each kind of objects all margins are known, or none: a
    kind without labels keeps those of `config`.

    """
    values: dict[str, Any] = {
        item.name: list(value) if isinstance(value, tuple) else value
        for item, value in config.items()
        if value != item.default
    }
    values |= {name: round(value, 4) for name, value in _valid(measured).items()}
    known = {sum(f'{kind}.{name}' in values for name in GAPS) for kind in KINDS}
    if max(known) > 0 and known <= {0, len(GAPS)}:
        values['faces.learn'] = False
    return values


def _valid(measured: Mapping[str, Measured]) -> dict[str, Any]:
    """Return values by name that enough tracks have evidence of, within the bounds of settings."""
    bounds = {item.name: item for item in settings()}
    values = {}
    for name, found in measured.items():
        if found.tracks >= MIN_TRACKS:
            item = bounds[name]
            values[name] = float(np.clip(found.value, item.low, item.high))
    return values


def write_settings(path: Path, values: Mapping[str, Any], origin: str) -> None:
    """Write settings as ROS does, so that `--config` and `--params-file` take them."""
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split('.')
        inner = nested
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[last] = value
    text = yaml.safe_dump({'/**': {'ros__parameters': nested}}, sort_keys=False)
    text = f'# boxreg calibrate, {origin}\n{text}'
    with written_whole(path) as file:
        file.write(text)


def table(measured: Mapping[str, Measured], config: Config) -> list[str]:
    """Return lines: each setting before and as estimated."""
    known: dict[str, tuple[Setting, Any]] = {item.name: (item, v) for item, v in config.items()}
    used = _valid(measured)
    lines = [f'{"setting":22}{"before":>9}{"measured":>10}{"spread":>9}{"tracks":>8}']
    for name, found in measured.items():
        item, before = known[name]
        note = f'  {item.unit}' if name in used else '  (kept: not enough evidence)'
        numbers = (f'{x:.3f}' if np.isfinite(x) else '-' for x in (found.value, found.spread))
        value, spread = numbers
        lines.append(f'{name:22}{before:9.3f}{value:>10}{spread:>9}{found.tracks:8d}{note}')
    return lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads."""
    add_recordings(parser)
    add_options(parser, Request, *TOPICS)
    add_options(parser, Settings, 'config', 'overrides')
    parser.add_argument(
        '--truth', type=Path, required=True, metavar='TRUTH.csv',
        help='true boxes of some tracks, in the columns of boxes.csv',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--output', type=Path, metavar='MARGINS.yaml', help='file to write the settings to'
    )
    parser.add_argument(
        '--no-boxes',
        action='store_true',
        help='estimate the labelling margins only, not the errors of the input',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Estimate, print a table, and write the settings."""
    request = request_from(args)
    config = request.config
    if args.output:
        _check_output(args)
    truth = true_boxes(args.truth)
    if not len(truth.boxes):
        raise RecordingError(f'{args.truth}: expected true boxes, got none; give another table')
    recording = source_of(request)
    recording.has_boxes = not args.no_boxes
    drive = Drive.of(recording, truth, AT_ONCE, config)
    if drive.left_out:
        print(f'boxreg: {drive.left_out}', file=sys.stderr)
    measured = labelling_margins(drive, config)
    if not any(found.tracks for found in measured.values()):
        raise RecordingError(
            f'{args.truth}: expected true boxes with points in {recording}, got no face '
            f'observation at {len(truth.boxes)} boxes; '
            'are stamps and frame those of the recording?'
        )
    if not args.no_boxes:
        measured |= input_errors(drive, config)
    print('\n'.join(table(measured, config)))
    values = calibrated(config, measured)
    learns = values.get('faces.learn', config.faces.learn)
    print(
        f'{len(set(truth.track_ids))} labelled tracks; the spread is between them; '
        + (
            'the input still corrects the labelling margins: some of a kind are unknown'
            if learns
            else 'the labelling margins are fixed (faces.learn: false)'
        )
    )
    if args.output:
        write_settings(args.output, values, f'{args.truth.name} of {recording}')
        print(f'{args.output}: use it with boxreg relabel --config or the node --params-file')
    return 0


def _check_output(args: argparse.Namespace) -> None:
    """Refuse an output that cannot be written, or would replace an input but ``--config``."""
    if args.output.is_dir() or not args.output.parent.is_dir():
        raise ConfigError(
            f'output {str(args.output)!r}: expected a file in a folder that is there, got '
            f'{str(args.output if args.output.is_dir() else args.output.parent)!r}; choose another'
        )
    spare_file(args.output, [*args.recordings, args.truth])


def _true_windows(drive: Drive, config: Config) -> list[Window]:
    """Return the labelled tracks as windows, as if the labels were the input."""
    truth = drive.truth
    rows = np.flatnonzero([is_valid_box(box) for box in truth.boxes])
    observations: dict[str, list[Observation]] = {}
    classes: dict[str, str] = {}
    for stamp_ns in np.unique(truth.stamps_ns[rows]).tolist() if drive.sweeps else ():
        (sweep,) = drive.sweeps_at(np.array([stamp_ns]))
        if abs(sweep.stamp_ns - stamp_ns) > AT_ONCE * 1e9:
            continue
        here = rows[truth.stamps_ns[rows] == stamp_ns]
        found = observe(sweep, truth.boxes[here], stamp_ns, config)
        for row, i in enumerate(here):
            seen = Observation(found, row)
            observations.setdefault(truth.track_ids[i], []).append(seen)
            classes[truth.track_ids[i]] = truth.class_names[i]
    start = np.zeros((0, 9))
    return [
        Window(track_id, classes[track_id], track, len(track), start)
        for track_id, track in observations.items()
    ]


def _model_of(windows: Sequence[Window], config: Config) -> InputModel:
    """Return an input model with the face observations at the boxes of `windows`."""
    model = InputModel(config.faces)
    for rows in group_windows(windows, config):
        part = [windows[i] for i in rows]
        problem, _ = stack_windows(part, config, CONSTANTS.prior_decay)
        track_ids = [window.track_id for window in part]
        model.observe_margins(track_ids, problem, problem.boxes[..., POSE], config)
    return model


def _bare(rows: Iterable[Sequence[Any]]) -> Window:
    """Return a window of (stamp, box) without points."""
    stamps, boxes = zip(*rows, strict=True)
    n = len(stamps)
    origins = np.full((n, 1, 3), np.nan)
    table = Observations.without_points(np.array(stamps), np.array(boxes), origins)
    observations = [Observation(table, row) for row in range(n)]
    return Window('', '', observations, n, np.zeros((0, 9)))


def _deviation(offsets: Floats) -> float:
    """Return the robust standard deviation of offsets from their median; NaN without any."""
    return MAD_TO_DEVIATION * float(np.median(np.abs(offsets))) if len(offsets) else np.nan

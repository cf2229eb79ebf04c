"""
`boxreg calibrate`: the annotation rule and the errors of the input, from a few labelled tracks.

The rule is what the core sees of the faces of true boxes, counted as it counts input boxes while
it learns from them. The errors are those of the boxes of the recording against the true ones.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.config import Config, Setting, settings
from boxreg_ros.core.face_support import Rule, support
from boxreg_ros.core.input_model import expect, InputModel, InputNoise, LEAST, scatter, TRACKS
from boxreg_ros.core.input_model import KINDS as FACE_KINDS
from boxreg_ros.core.objective import EXTENT, State
from boxreg_ros.core.observation import Observation, observe
from boxreg_ros.core.window import group_windows, stack_windows, Window
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.arguments import add_recording_arguments, config_from, convention_from
from boxreg_ros.offline.drive import Drive
from boxreg_ros.offline.result_folder import spare_file
from boxreg_ros.structures import Floats, is_valid_box
import numpy as np
import torch
import yaml

GAPS = ('gap_ends', 'gap_sides', 'gap_top', 'gap_bottom')
DEPTHS = ('depth_ends', 'depth_sides')
ERRORS = ('position', 'lateral', 'height', 'tilt', 'heading', 'extent')
KINDS = ('vehicle', 'cyclist', 'pedestrian')
PASSES = 4  # how a face is seen depends a little on the rule that is looked for
FEWEST = 3  # tracks that make a value


@dataclass(frozen=True, slots=True)
class Measured:
    """
    A setting as labelled tracks have it.

    Attributes
    ----------
    value : float
        What it should be; NaN where nothing told.
    spread : float
        Robust standard deviation between tracks, in the unit of the value.
    tracks : int
        How many told.

    """

    value: float
    spread: float
    tracks: int

    @classmethod
    def median(cls, values: Floats, tracks: int) -> Measured:
        """Return the median of values, of which each track gave some."""
        middle = float(np.median(values)) if len(values) else np.nan
        return cls(middle, _deviation(values - middle), tracks)


class _Sights(InputModel):
    """What the core learns of a rule, track by track."""

    def of(self, which: int, faces: Sequence[int]) -> list[Floats]:
        """Return shifts of gaps (0) or depths (1) of faces, per track that tells some [m]."""
        means = []
        for known in self._sights.values():
            total, count, share = known[which][:, faces]
            if (count >= FEWEST).any():  # observations, as the model wants of a track
                means.append(total[count >= FEWEST] / share[count >= FEWEST])
        return means


def annotation_rule(drive: Drive, config: Config) -> dict[str, Measured]:
    """
    Return the gaps and depths of faces, as true boxes show them.

    Parameters
    ----------
    drive : Drive
        Sweeps and true boxes; its noisy boxes do not matter.
    config : Config
        How faces are seen, and the rule to begin with.

    Returns
    -------
    rule : dict of Measured
        By name of the setting [m]: gaps of the kinds of objects there are, depths of all
        together. What was seen on no track is NaN.

    """
    kinds: dict[str, list[Window]] = {}
    for window in _true_windows(drive, config):
        kinds.setdefault(_kind(window.class_name, config), []).append(window)
    rule: dict[str, Measured] = {}
    for _ in range(PASSES):
        gaps: dict[str, list[Floats]] = {f'{k}.{n}': [] for k in kinds for n in GAPS}
        depths: dict[str, list[Floats]] = {f'faces.{n}': [] for n in DEPTHS}
        for kind, windows in kinds.items():
            expected = [getattr(getattr(config, kind), name) for name in GAPS]
            for first in range(0, len(windows), TRACKS):
                model = _Sights(config.faces)
                _show(model, windows[first : first + TRACKS], config, model.rule())
                for name, gap, faces in zip(GAPS, expected, FACE_KINDS, strict=True):
                    gaps[f'{kind}.{name}'] += [gap + shift for shift in model.of(0, faces)]
                for name, faces in zip(DEPTHS, FACE_KINDS, strict=False):
                    depths[f'faces.{name}'] += model.of(1, faces)
        rule = {
            name: Measured.median(np.concatenate([np.zeros(0), *means]), len(means))
            for name, means in (gaps | depths).items()
        }
        config = config.updated(_valid(rule))
    return rule


def input_errors(drive: Drive, config: Config) -> dict[str, Measured]:
    """Return how the boxes of a drive err, by name of the setting, for kinds of objects it has."""
    given = {
        (array.stamp_ns, name): box
        for array in reversed(drive.boxes)
        for name, box in zip(reversed(array.track_ids), reversed(array.boxes), strict=True)
        if is_valid_box(box)
    }  # of boxes with one identity the first counts
    pairs: dict[str, dict[str, list[tuple[int, Floats, Floats]]]] = {}
    truth = drive.truth
    for i in np.argsort(truth.stamps_ns, kind='stable'):
        stamp_ns, name = int(truth.stamps_ns[i]), truth.track_ids[i]
        if (stamp_ns, name) in given and is_valid_box(truth.boxes[i]):
            kind = _kind(truth.class_names[i], config)
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
    """Return the errors of tracks of (stamp, input box, true box) long enough to tell."""
    tracks = [track for track in tracks if len(track) >= LEAST]
    if not tracks:
        return dict.fromkeys(ERRORS, Measured(np.nan, np.nan, 0))
    problem, base = stack_windows([_bare([row[:2] for row in track]) for track in tracks], config)
    true, true_base = stack_windows(
        [_bare([row[::2] for row in track]) for track in tracks], config
    )
    problem = problem._replace(mask=problem.valid[..., None])  # the truth tells, not points
    pose = true.pose + torch.nn.functional.pad(torch.from_numpy(true_base - base), (0, 3))[:, None]
    # Headings against those of the truth, whichever of the two directions a track is given in.
    half_turns = torch.tensor([2.0, 2.0, 1.0]) * torch.pi
    pose[..., 3:] += half_turns * ((problem.pose - pose)[..., 3:] / half_turns).round()
    rule = Rule(*torch.zeros(3, 6))
    extent = expect(true, rule).shared
    off = scatter(problem, State(pose, extent))
    off = off[off.isfinite().all(2).sum(1) >= LEAST]  # the boxes of others were held

    def deviations(rows: slice) -> Floats:
        noise = InputNoise.measure(off[rows])
        lon, lat, z, roll, pitch, yaw = noise.deviation[:6].tolist()
        return np.array([lon, lat, z, np.hypot(roll, pitch) / np.sqrt(2), yaw])

    found = dict.fromkeys(ERRORS, Measured(np.nan, np.nan, 0))
    if len(off):
        single = np.array([deviations(slice(b, b + 1)) for b in range(len(off))])
        spreads = [_deviation(column - np.median(column)) for column in single.T]
        for name, value, spread in zip(ERRORS, deviations(slice(None)), spreads, strict=False):
            found[name] = Measured(float(value), spread, len(off))
    # What counts for the one extent of a track is the error of its mean.
    error = (expect(problem, rule).shared / extent)[:, EXTENT].numpy() - 1
    size = 1.48 * np.median(np.abs(error), axis=1)
    found['extent'] = Measured(
        1.48 * float(np.median(np.abs(error))), _deviation(size - np.median(size)), len(tracks)
    )
    return found


def calibrated(config: Config, measured: Mapping[str, Measured]) -> dict[str, Any]:
    """
    Return the settings that were measured, and those in `config` that are not the defaults.

    The rule is stated, and not learnt from the input any more, where of each kind of objects
    all gaps are known or none is: such a kind keeps what is expected of it.

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
    """Return values by name that enough tracks told, as near as the bounds of settings allow."""
    bounds = {item.name: item for item in settings()}
    values = {}
    for name, found in measured.items():
        if found.tracks >= FEWEST:
            item = bounds[name]
            # Angles that neither labels nor input have tell nothing of an error.
            if not (name.endswith('tilt') and found.value < (item.low or 0)):
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
    path.write_text(text, encoding='utf-8', errors='backslashreplace')  # names of files in origin


def table(measured: Mapping[str, Measured], config: Config) -> list[str]:
    """Return lines: each setting as measured, and what it was before."""
    known: dict[str, tuple[Setting, Any]] = {item.name: (item, v) for item, v in config.items()}
    used = _valid(measured)
    lines = [f'{"setting":22}{"before":>9}{"measured":>10}{"spread":>9}{"tracks":>8}']
    for name, found in measured.items():
        item, before = known[name]
        note = f'  {item.unit}' if name in used else '  (stays: too little to tell)'
        numbers = (f'{x:.3f}' if np.isfinite(x) else '-' for x in (found.value, found.spread))
        value, spread = numbers
        lines.append(f'{name:22}{before:9.3f}{value:>10}{spread:>9}{found.tracks:8d}{note}')
    return lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads."""
    add_recording_arguments(parser)
    parser.add_argument(
        '--truth', type=Path, required=True, metavar='TRUTH.csv',
        help='true boxes of some tracks, in the columns of boxes.csv',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--output', type=Path, metavar='RULE.yaml', help='where the settings go'
    )
    parser.add_argument(
        '--no-boxes', action='store_true', help='measure the rule alone, no errors of the input'
    )


def run(args: argparse.Namespace) -> int:
    """Measure, print what was found, and write it as settings."""
    config = config_from(args)
    if args.output and (args.output.is_dir() or not args.output.parent.is_dir()):
        raise ConfigError(
            f'output {str(args.output)!r}: expected a file in a folder that is there, got '
            f'{str(args.output if args.output.is_dir() else args.output.parent)!r}; choose another'
        )
    if args.output:  # that of --config may be measured anew
        spare_file(args.output, [*args.recordings, args.truth])
    truth = BoxTable.read(args.truth)
    recording = Recording(
        args.recordings, args.points, args.boxes, args.odometry, convention=convention_from(args)
    )
    recording.has_boxes = not args.no_boxes
    drive = Drive.of(recording, truth, config.tolerance)
    if drive.left_out:
        print(f'boxreg: {drive.left_out}', file=sys.stderr)
    measured = annotation_rule(drive, config)
    if not any(found.tracks for found in measured.values()):
        raise RecordingError(
            f'{args.truth}: expected true boxes with points in {recording}, got no face of '
            f'{len(truth.boxes)} boxes that is seen; are stamps and frame those of the recording?'
        )
    if not args.no_boxes:
        measured |= input_errors(drive, config)
    print('\n'.join(table(measured, config)))
    values = calibrated(config, measured)
    learns = values.get('faces.learn', config.faces.learn)
    print(
        f'{len(set(truth.track_ids))} labelled tracks; spread between them; the rule '
        + (
            'is still corrected by the input: not all gaps of a kind told'
            if learns
            else 'is stated (faces.learn: false), where nothing told as before'
        )
    )
    if args.output:
        write_settings(args.output, values, f'{args.truth.name} of {recording}')
        print(f'{args.output}: for --config of boxreg relabel and --params-file of the node')
    return 0


def _true_windows(drive: Drive, config: Config) -> list[Window]:
    """Return the labelled tracks as the core would see them if they were its input."""
    truth = drive.truth
    rows = np.flatnonzero([is_valid_box(box) for box in truth.boxes])
    seen: dict[str, list[Observation]] = {}
    classes: dict[str, str] = {}
    for stamp_ns in np.unique(truth.stamps_ns[rows]).tolist() if drive.sweeps else ():
        (sweep,) = drive.sweeps_at(np.array([stamp_ns]))
        if abs(sweep.stamp_ns - stamp_ns) > config.tolerance * 1e9:
            continue
        here = rows[truth.stamps_ns[rows] == stamp_ns]
        found = observe(sweep, truth.boxes[here], stamp_ns, config)
        for i, observation in zip(here, found, strict=True):
            seen.setdefault(truth.track_ids[i], []).append(observation)
            classes[truth.track_ids[i]] = truth.class_names[i]
    nothing = np.zeros((0, 9))
    return [Window(name, classes[name], o, len(o), nothing) for name, o in seen.items()]


def _show(model: InputModel, windows: Sequence[Window], config: Config, rule: Rule) -> None:
    """Show true boxes to a model as `registration` shows it input boxes."""
    for rows in group_windows(windows, config):
        part = [windows[i] for i in rows]
        problem, _ = stack_windows(part, config)
        state = State(problem.pose, expect(problem, rule).shared)
        sights = support(problem, state, config.faces.outermost, rule)
        model.learn_rule([w.track_id for w in part], sights, problem.valid, rule)


def _bare(rows: Iterable[Sequence[Any]]) -> Window:
    """Return a window of (stamp, box) without points."""
    nowhere, no_points = np.full(3, np.nan), np.zeros((0, 3), np.float32)
    observations = [
        Observation(stamp_ns, box, no_points, no_points[:, 0], nowhere, np.nan, 0)
        for stamp_ns, box in rows
    ]
    return Window('', '', observations, len(observations), np.zeros((0, 9)))


def _kind(class_name: str, config: Config) -> str:
    """Return the name of the settings for objects of a class."""
    found = config.class_config(class_name)
    return next(kind for kind in KINDS if getattr(config, kind) is found)


def _deviation(offsets: Floats) -> float:
    """Return the robust standard deviation of offsets from their median; NaN without any."""
    return 1.48 * float(np.median(np.abs(offsets))) if len(offsets) else np.nan

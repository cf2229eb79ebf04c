"""
Settings: default, unit, bounds and meaning of each.

Node parameters, ``--set``, YAML files and the tables of the documentation are generated from
these dataclasses. Deviations are standard deviations: each residual is divided by its own.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
import hashlib
import json
from math import isnan, nan
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

from boxreg_ros.errors import ConfigError, one_line, unreadable
import yaml

_T = TypeVar('_T')

YAML_ERRORS = (yaml.YAMLError, ValueError, RecursionError)
"""Of `yaml.safe_load`: malformed text, dates that do not exist, and nesting that is too deep."""
NODE_OPTIONS = (
    *('boxes_type', 'points', 'points_type', 'time_unit', 'sensor_frames', 'points_info'),
    *('pose_reference', 'size_order', 'forward_axis', 'orientation', 'size_scale', 'boxes_frame'),
    *('associate', 'boxes_offset', 'keep_ids'),
    *('clock_offset', 'fixed_frame', 'output_frame'),
    *('transform_timeout', 'deadline', 'backlog', 'static_points'),
    *('static_points_wait', 'config_file', 'input_model'),
    *('use_sim_time', 'start_type_description_service', 'qos_overrides'),
)
"""Parameters of the node that a parameter file of ROS may contain in addition to `Config`."""


COMPLETE_STEPS = ('stitch', 'static', 'prune', 'fill', 'extend')
"""Switches of `CompleteConfig`, in the order of execution."""
KINDS = ('vehicle', 'cyclist', 'pedestrian')
"""Kinds of objects, each a group of settings of `Config`."""

DEFAULT_LAG = 9
"""The whole default window. It may exceed a shorter window, which then limits it."""


class Setting(NamedTuple):
    """
    A setting as users see it.

    Attributes
    ----------
    name : str
        Dotted, as in ``solver.rounds``.
    default : bool, int, float, str or tuple of str
        Its type is the type of the setting.
    meaning, unit : str
        For tables and help texts.
    low, high : float or None
        Bounds, both included.
    choices : tuple of str
        Allowed words; empty for any. With bounds, a number within them is allowed as well.

    """

    name: str
    default: bool | int | float | str | tuple[str, ...]
    meaning: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def bounds(self) -> str:
        """Return what is allowed, as users read it; empty for anything."""
        words = ', '.join(self.choices)
        if self.low is None or self.high is None:
            return words
        numbers = f'{self.low:g} to {self.high:g} {self.unit}'.rstrip()
        return f'{words}, or {numbers}' if words else numbers

    def check(self, value: Any) -> None:
        """Raise ConfigError for a value of the right type that is not allowed."""
        if value in self.choices or not self.bounds:
            return
        if self.low is None or self.high is None:
            raise ConfigError(f'{self.name}: expected one of {self.bounds}, got {value!r}')
        number = nan
        with suppress(ValueError):
            number = float(value)
        if not self.low <= number <= self.high:
            got = value if isnan(number) else number
            raise ConfigError(f'{self.name}: expected {self.bounds}, got {got!r}')


def setting(default: Any, *facts: Any, **more: Any) -> Any:
    """Return a dataclass field with the arguments of a `Setting` after the name as metadata."""
    return field(default=default, metadata={'of': Setting('', default, *facts, **more)})


@dataclass(frozen=True, slots=True)
class SamplingConfig:
    """Selection of the points of an observation."""

    deskew: bool = setting(True, 'motion-compensate points by their own times, where known')
    box_time: str = setting(
        'auto',
        'latency of the input boxes: how long before their stamp they were right; estimated '
        'from moving objects (auto), or none, with boxes of the stamp or of when the sweep saw '
        'the object (sight)',
        unit='s',
        low=-1.0,
        high=2.0,
        choices=('auto', 'stamp', 'sight'),
    )
    box_extents: str = setting(
        'auto',
        'what the input boxes hold: the whole object, or what is visible of it, as those of '
        'clusters do, which are lengthened away from the sensor to the extents of their track; '
        'found by their points (auto)',
        choices=('auto', 'whole', 'visible'),
    )
    points: int = setting(128, 'maximum number of points per box', '', 8, 100000)


@dataclass(frozen=True, slots=True)
class FaceConfig:
    """Face observations: the outermost points on each face, and their errors."""

    ends: float = setting(
        0.12, 'standard deviation of one observation of the front or rear face', 'm', 1e-3, 10.0
    )
    sides: float = setting(
        0.08, 'standard deviation of one observation of a side or of the top', 'm', 1e-3, 10.0
    )
    inset_ends: float = setting(
        0.36, 'expected inset of the surface behind an occluded front or rear face', 'm', 0.0, 2.0
    )
    inset_sides: float = setting(
        0.18, 'expected inset of the surface behind an occluded left or right face', 'm', 0.0, 2.0
    )
    learn: bool = setting(
        True, 'estimate the labelling margins from the input boxes while they come in'
    )


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """L-BFGS, and the rounds of correspondence and weighting around it."""

    rounds: int = setting(
        10, 'most rounds; each renews the outermost points and the weights', '', 1, 100
    )
    threads: int = setting(
        0, 'threads that share the windows of a batch; 0: one per core', '', 0, 256
    )


@dataclass(frozen=True, slots=True)
class PaperConfig:
    """Weights of the paper's objective (Eq. 8); used with ``objective: paper`` only."""

    closeness: float = setting(0.1, 'weight of the closeness term, Eq. 4', '1/m^2', 0.0, 1e6)
    enclosure: float = setting(3.0, 'weight of the enclosure term, Eq. 5', '1/m', 0.0, 1e6)
    smoothness: float = setting(
        0.1, 'weight of the smoothness constraint, Eq. 6, and its first multiplier', '', 0.0, 1e6
    )
    alignment: float = setting(
        0.3, 'weight of the alignment constraint, Eq. 7, and its first multiplier', '', 0.0, 1e6
    )
    iterations: int = setting(60, 'most L-BFGS iterations per update', '', 1, 10000)


@dataclass(frozen=True, slots=True)
class ClassConfig:
    """
    Motion, input errors and labelling margins of the objects of one kind.

    A labelling margin (``gap_*``) is the distance from the outermost surface points out to the
    face of the label. With ``faces.learn`` the input boxes correct them, each kind its own.

    """

    tilt: ClassVar[float] = 0.02
    """Standard deviation of the input roll and pitch [rad]. Chosen: detectors set both to zero."""

    names: tuple[str, ...] = setting(
        (), 'class names of this kind: any of these names, all words of it, in any case'
    )
    acceleration: float = setting(
        1.5, 'standard deviation of the forward acceleration', 'm/s^2', 1e-3, 1e3
    )
    cornering: float = setting(
        4.0, 'standard deviation of the sideways acceleration', 'm/s^2', 1e-3, 1e3
    )
    turning: float = setting(
        0.8, 'standard deviation of the yaw acceleration', 'rad/s^2', 1e-3, 1e3
    )
    slip: float = setting(
        0.15, 'standard deviation of the sideways velocity of the pivot', 'm/s', 1e-3, 1e3
    )
    shape: float = setting(
        0.03, 'standard deviation of the surface from one rigid shape per track', 'm', 1e-3, 1.0
    )
    position: float = setting(
        0.14, 'standard deviation of the input centre along the heading', 'm', 1e-3, 10.0
    )
    lateral: float = setting(
        0.08, 'standard deviation of the input centre across the heading', 'm', 1e-3, 10.0
    )
    height: float = setting(
        0.07, 'standard deviation of the height of the input centre', 'm', 1e-3, 10.0
    )
    heading: float = setting(0.04, 'standard deviation of the input yaw', 'rad', 1e-3, 3.2)
    extent: float = setting(
        0.05, 'standard deviation of the input extents, as part of each', '', 1e-3, 1.0
    )
    gap_ends: float = setting(
        0.05, 'labelling margin: front and rear face outside the surface points', 'm', -2.0, 2.0
    )
    gap_sides: float = setting(
        0.03, 'labelling margin: left and right face outside the surface points', 'm', -2.0, 2.0
    )
    gap_top: float = setting(
        0.05, 'labelling margin: top face above the roof points', 'm', -2.0, 2.0
    )
    gap_bottom: float = setting(
        0.0, 'labelling margin: bottom face below the road', 'm', -2.0, 2.0
    )
    gap_spread: float = setting(
        0.05,
        'standard deviation of the labelling margins between objects, but that of the road',
        'm',
        1e-4,
        1.0,
    )


@dataclass(frozen=True, slots=True)
class CompleteConfig:
    """Steps from tracks to whole tracks of recordings; `boxreg relabel --complete` sets all."""

    stitch: bool = setting(False, 'join fragments of one object')
    static: bool = setting(False, 'join parked tracks that are one object with pauses')
    prune: bool = setting(False, 'reject ghosts and duplicates')
    fill: bool = setting(False, 'add missing boxes between two boxes of a track')
    extend: bool = setting(False, 'add boxes before and after a track while points support them')
    fill_gap: float = setting(
        2.0, 'longest gap between fragments of an object, and of a moving one that is filled',
        's', 0.0, 1e3,
    )  # fmt: skip

    @property
    def steps(self) -> tuple[str, ...]:
        """Return the names of the steps that are on, in the order of their execution."""
        return tuple(name for name in COMPLETE_STEPS if getattr(self, name))


@dataclass(frozen=True, slots=True)
class Ingredients:
    """
    Parts of the method that `measure ablation` switches off, one at a time.

    For measurement only: no settings, so neither parameters of the node nor part of a written
    configuration. Each docstring states the effect of True.

    """

    strips: bool = True
    """Each of three strips of a face has outermost points of its own."""
    occluded_faces: bool = True
    """Faces turned away from the sensor have a weight."""
    range_inset: bool = True
    """Points are expected further inside the faces of distant objects."""
    ring_inset: bool = True
    """The top of an object is expected half a ring of the LiDAR above its highest points."""
    point_ownership: bool = True
    """A point near two boxes belongs to the one it is deeper inside of."""
    road: bool = True
    """The road beside a box is an observation of its bottom face."""
    noise_estimation: bool = True
    """The noise of the input is estimated."""
    input_bias: bool = True
    """The errors of the input have a part that is constant over a track."""
    population_extents: bool = True
    """Extents of a track are expected by those of the others."""
    marginalisation: bool = True
    """Observations that leave a sliding window leave a prior."""
    heading_sign: bool = True
    """180° flips of the input are corrected."""
    robust_motion: bool = True
    """Motion residuals are down-weighted beyond three deviations."""
    robust_weights: bool = True
    """Input poses, faces and labelling margins far from the expected ones are down-weighted."""
    without: tuple[str, ...] = ()
    """Names of `RESIDUALS` that are left out."""


@dataclass(frozen=True, slots=True)
class Config:
    """
    All settings, with defaults for road vehicles at 10 Hz; checked on construction.

    The groups `sampling`, `faces`, `solver`, `paper`, `complete`, `vehicle`, `cyclist` and
    `pedestrian` are objects of their own: ``Config.from_dict({'solver': {'rounds': 5}})`` and
    ``config.updated({'solver.rounds': 5})`` set a part of one. docs/parameters.md lists every
    setting with its meaning, unit and bounds, as `items` yields them.

    Raises
    ------
    ConfigError
        For a value of the wrong type or out of bounds.

    """

    objective: str = setting(
        'robust',
        'objective function: robust (default), or Eq. 4-8 of the paper, to compare with: its '
        'boxes may be worse than the input',
        choices=('robust', 'paper'),
    )
    mode: str = setting(
        '3d', 'optimised: x y z roll pitch yaw, or x y yaw only', choices=('3d', 'bev')
    )
    estimate: str = setting(
        'track',
        'box as newest of its window, `lag` later, or of the whole track',
        choices=('early', 'final', 'track'),
    )
    extent: str = setting(
        'track',
        'extents: one estimate per track, or those of the input',
        choices=('track', 'fixed'),
    )
    window: int = setting(10, 'observations per sliding window', '', 3, 1000)
    lag: int = setting(
        DEFAULT_LAG,
        'later observations used for a final box, less than window; the default shrinks with it',
        '',
        0,
        999,
    )
    track_window: int = setting(
        130, "observations per window with estimate 'track'", '', 10, 10000
    )
    min_observations: int = setting(3, 'boxes of shorter windows are kept', '', 2, 1000)
    max_gap: float = setting(1.6, 'time without observation that ends a track', 's', 0.01, 1e4)
    coast: float = setting(
        0.0,
        'time after its last detection that a track goes on with predicted boxes, as long as its '
        "points confirm them; 0: off; only with estimate 'early' or 'final', and without complete",
        's',
        0.0,
        10.0,
    )
    reach: float = setting(
        0.06,
        'maximum time offset between a box array and a sweep; points are motion-compensated to '
        'the box stamp',
        's',
        0.0,
        10.0,
    )
    merge_span: float = setting(
        0.1,
        'maximum time between the clouds of several LiDARs that are merged into one sweep',
        's',
        0.0,
        10.0,
    )
    queue: int = setting(
        20, 'maximum number of unpaired sweeps, and of box arrays, held', '', 1, 10000
    )
    sampling: SamplingConfig = SamplingConfig()
    faces: FaceConfig = FaceConfig()
    solver: SolverConfig = SolverConfig()
    paper: PaperConfig = PaperConfig()
    complete: CompleteConfig = CompleteConfig()
    ingredients: Ingredients = Ingredients()
    vehicle: ClassConfig = ClassConfig(
        names=(
            'car', 'van', 'truck', 'bus', 'vehicle', 'trailer', 'suv', 'pickup', 'tram', 'lorry',
            'taxi', 'train', 'motor vehicle', 'bicycle rack', 'crossing sign', 'human depiction',
        )
    )  # fmt: skip
    cyclist: ClassConfig = ClassConfig(
        names=(
            'cyclist', 'bicyclist', 'bicycle', 'bike', 'motorcycle', 'motorcyclist', 'motorbike',
            'motorbiker', 'motor', 'moped', 'rider', 'ride', 'scooter', 'tricycle', 'pedicab',
            'vulnerablevehicle', 'wheeled device', 'personal mobility',
        ),
        acceleration=1.5, cornering=1.5, turning=1.0, slip=0.4,
        shape=0.15, heading=0.08, extent=0.07, gap_spread=0.2,
    )  # fmt: skip
    pedestrian: ClassConfig = ClassConfig(
        names=(
            'pedestrian', 'person', 'walker', 'people', 'child', 'adult', 'human', 'worker',
            'officer', 'signaler', 'stroller', 'wheelchair', 'animal', 'animals', 'dog',
        ),
        acceleration=0.8, cornering=0.8, turning=1.0, slip=0.5,
        shape=0.2, heading=0.2, extent=0.07, gap_spread=0.2,
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check types and bounds."""
        for part in fields(self):
            group = type(part.default)
            if is_dataclass(group) and not isinstance(getattr(self, part.name), group):
                raise ConfigError(
                    f'{part.name}: expected {group.__name__}, got {getattr(self, part.name)!r}; '
                    f'Config.from_dict takes groups as dictionaries'
                )
        for item, value in self.items():
            item.check(cast_value(item.name, value, item.default))
        if self.lag >= self.window and self.lag != DEFAULT_LAG:
            raise ConfigError(
                f'lag: expected less than window ({self.window}), got {self.lag}: a final box '
                f'waits within its window; lower lag or raise window'
            )
        name = 'track_window' if self.estimate == 'track' else 'window'
        most = getattr(self, name)
        if self.min_observations > most:
            raise ConfigError(
                f'min_observations: expected at most {name} ({most}), got '
                f'{self.min_observations}: no window has as many, and no box would be refined; '
                f'lower min_observations or raise {name}'
            )

    def __hash__(self) -> int:
        """Return a hash of a few settings: of all it takes 4 us, and is looked up in each tick."""
        return hash((self.estimate, self.objective, self.mode, self.window))

    @property
    def coasts(self) -> bool:
        """Return whether boxes are added online; whole tracks are filled from both sides."""
        return self.coast > 0 and self.estimate != 'track' and not self.complete.steps

    @property
    def digest(self) -> str:
        """Return the first 16 digits of the SHA-256 of all settings as JSON."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def items(self) -> Iterator[tuple[Setting, Any]]:
        """Yield every setting with its value; names of groups are dotted."""
        for item in settings():
            yield item, attrgetter(item.name)(self)

    def kind(self, class_name: str) -> str:
        """Return the one of `KINDS` that `class_name` is of; vehicle for unknown classes."""
        return self._known_kind(class_name) or 'vehicle'

    def drives(self, class_name: str) -> bool:
        """Return whether objects of a class move along their length: all but pedestrians."""
        return self.kind(class_name) != 'pedestrian'

    def class_config(self, class_name: str) -> ClassConfig:
        """Return the group of settings for `class_name`; `vehicle` for unknown classes."""
        group: ClassConfig = getattr(self, self.kind(class_name))
        return group

    def knows_class(self, class_name: str) -> bool:
        """Return whether `class_name` has a name of some group; others are vehicles by default."""
        return bool(self._known_kind(class_name))

    def _known_kind(self, class_name: str) -> str:
        """Return the kind that `class_name` has a name of; empty for unknown classes."""
        return _kind_by_names(
            class_name, self.cyclist.names, self.pedestrian.names, self.vehicle.names
        )

    def updated(self, changes: Mapping[str, Any]) -> Config:
        """
        Return a copy with some settings changed.

        Parameters
        ----------
        changes : mapping
            Values by dotted name, as in ``{'solver.rounds': 2}``.

        Raises
        ------
        ConfigError
            For an unknown name, or a value of the wrong type or out of bounds.

        """
        values: dict[str, Any] = {}
        for name, value in changes.items():
            group, _, last = name.rpartition('.')
            target = values.setdefault(group, {}) if group else values
            target[last] = value
        return _filled(self, values, '')

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """
        Build from nested mappings of plain values; absent settings have their defaults.

        Raises
        ------
        ConfigError
            For an unknown key, or a value of the wrong type or out of bounds; names the setting.

        """
        return _filled(cls(), values, '')

    @classmethod
    def from_yaml(cls, path: str | Path) -> Config:
        """
        Read a YAML file: plain, or a ROS parameter file (its first node is used).

        Of a parameter file of ROS the `NODE_OPTIONS` are ignored.

        Raises
        ------
        ConfigError
            If the file cannot be read, or `from_dict` refuses its content.

        """
        try:
            values = yaml.load(Path(path).read_text(encoding='utf-8'), _SettingsLoader) or {}
            return cls.from_dict(_without_node_options(values))
        except OSError as error:
            raise ConfigError(f'config file {unreadable(path, error)}') from None
        except UnicodeDecodeError as error:
            raise ConfigError(
                f'config file {str(path)!r}: expected YAML in UTF-8, got other bytes '
                f'({error.reason}); save it as UTF-8, or correct the path'
            ) from None
        except (ConfigError, *YAML_ERRORS) as error:
            raise ConfigError(f'config file {str(path)!r}: {one_line(error)}') from None


class _SettingsLoader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """Reads YAML, but refuses a setting that is given twice: PyYAML would take the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        is_mapping = isinstance(node, yaml.MappingNode)  # not so with a wrong tag
        names = Counter(str(key.value) for key, _ in node.value) if is_mapping else Counter()
        twice = [name for name, number in names.items() if number > 1]
        if twice:
            raise ConfigError(f'{twice[0]}: expected one value, got it twice; leave one out')
        values: dict[Any, Any] = super().construct_mapping(node, deep)
        return values


def _without_node_options(values: Any) -> Any:
    """Return the settings of a ROS parameter file; other content unchanged."""
    node = next(iter(values.values()), None) if isinstance(values, dict) else None
    if not isinstance(node, dict) or set(node) != {'ros__parameters'}:
        return values
    parameters = node['ros__parameters']
    if not isinstance(parameters, dict):
        return parameters
    return {
        key: value
        for key, value in parameters.items()
        if str(key).partition('.')[0] not in NODE_OPTIONS
    }


def words_of(class_name: str) -> set[str]:
    """Return the words of a class name, in lower case."""
    return {*class_name.lower().translate(str.maketrans('_-./', '    ')).split()}


@lru_cache(maxsize=4096)
def _kind_by_names(class_name: str, *names_of_kinds: tuple[str, ...]) -> str:
    """
    Return the kind with the name of most words, all of them in `class_name`; empty for none.

    So ``bicycle_rack`` is not of the kind of ``bicycle``. Of equal numbers the first kind counts.

    """
    words = words_of(class_name)
    found, most = '', 0
    for kind, names in zip(('cyclist', 'pedestrian', 'vehicle'), names_of_kinds, strict=True):
        for name in map(words_of, names):
            if name <= words and len(name) > most:
                found, most = kind, len(name)
    return found


def settings() -> Iterator[Setting]:
    """Yield every setting of `Config`; names of groups are dotted."""
    for item in fields(Config):
        if not is_dataclass(item.default):
            yield item.metadata['of']._replace(name=item.name)
            continue
        for part in fields(item.default):
            if 'of' not in part.metadata:  # `Ingredients` are no settings
                continue
            yield part.metadata['of']._replace(
                name=f'{item.name}.{part.name}', default=getattr(item.default, part.name)
            )


def _filled(default: _T, value: Any, name: str) -> _T:
    """Return `value` as a setting like `default`, or as a group with `default` for absent ones."""
    if not is_dataclass(default):
        return cast_value(name, value, default)  # type: ignore[no-any-return]
    if not isinstance(value, Mapping):
        raise ConfigError(f'{name or "config"}: expected a group of settings, got {value!r}')
    known = {item.name: getattr(default, item.name) for item in fields(default)}
    prefix = f'{name}.' if name else ''
    for key in value:
        if key not in known:
            raise ConfigError(_unknown(prefix, str(key), known))
    changes = {key: _filled(known[key], inner, prefix + key) for key, inner in value.items()}
    return replace(default, **changes)  # type: ignore[type-var]


def _unknown(prefix: str, key: str, known: Mapping[str, Any]) -> str:
    """Return the message of a setting that a group does not have, with what to set instead."""
    name = prefix + key
    group, dot, last = key.partition('.')
    if dot and is_dataclass(known.get(group)):
        return f'{name}: expected a nested group; write {group}: {{{last}: ...}}'
    names = ', '.join(sorted(set(known) - {'ingredients'}))  # for `measure ablation` alone
    similar = get_close_matches(key, known, 1)
    proposal = f'; did you mean {prefix}{similar[0]}?' if similar else ''
    return f'{name}: no such setting; expected one of {names}{proposal}'


def cast_value(name: str, value: Any, default: Any) -> Any:
    """
    Return the value of a setting in the type of its default.

    Parameters
    ----------
    name : str
        Of the setting, for the error message.
    value : object
        As YAML, JSON or a parameter of ROS has it. Numbers may be text where the default is a
        float.
    default : float, int, bool, str or tuple of str
        Of the setting.

    Returns
    -------
    value
        Of the type of `default`. Its bounds are not checked here.

    Raises
    ------
    ConfigError
        If `value` is of another type, as 1.5 for an int or a number for a bool.

    """
    if isinstance(default, float) and not isinstance(value, bool):
        with suppress(TypeError, ValueError):
            return float(value)  # YAML reads 1e-4, without a point, as text
    elif isinstance(default, tuple):
        if isinstance(value, list | tuple) and all(isinstance(v, str) for v in value):
            return tuple(value)
    elif type(value) is type(default):
        return value
    elif isinstance(default, str) and type(value) in (int, float):
        return str(value)  # in place of a word; `check` knows which settings take a number
    kind = (
        "a list of texts such as [car, '2']"
        if isinstance(default, tuple)
        else type(default).__name__
    )
    raise ConfigError(f'{name}: expected {kind}, got {value!r}')

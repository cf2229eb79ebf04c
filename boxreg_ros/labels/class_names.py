"""
Class names of data sets whose evaluation counts no others, for the formats that write them.

A name that the vocabulary of a format has is written in its spelling. Any other is translated by
the words it contains, unless ``--class-map`` states a name for it. One that has none of these
words stays as it is: an evaluation does not count it.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from boxreg_ros.config import words_of, YAML_ERRORS
from boxreg_ros.errors import ConfigError, unreadable
import yaml

NUSCENES = (
    'noise', 'animal', 'human.pedestrian.adult', 'human.pedestrian.child',
    'human.pedestrian.construction_worker', 'human.pedestrian.personal_mobility',
    'human.pedestrian.police_officer', 'human.pedestrian.stroller',
    'human.pedestrian.wheelchair', 'movable_object.barrier', 'movable_object.debris',
    'movable_object.pushable_pullable', 'movable_object.trafficcone',
    'static_object.bicycle_rack', 'vehicle.bicycle', 'vehicle.bus.bendy', 'vehicle.bus.rigid',
    'vehicle.car', 'vehicle.construction', 'vehicle.emergency.ambulance',
    'vehicle.emergency.police', 'vehicle.motorcycle', 'vehicle.trailer', 'vehicle.truck',
    'flat.driveable_surface', 'flat.other', 'flat.sidewalk', 'flat.terrain', 'static.manmade',
    'static.other', 'static.vegetation', 'vehicle.ego',
)  # fmt: skip
"""Categories of nuScenes-lidarseg by their index; the first of each kind are those of boxes."""
ARGOVERSE2 = (
    'ANIMAL', 'ARTICULATED_BUS', 'BICYCLE', 'BICYCLIST', 'BOLLARD', 'BOX_TRUCK', 'BUS',
    'CONSTRUCTION_BARREL', 'CONSTRUCTION_CONE', 'DOG', 'LARGE_VEHICLE', 'MESSAGE_BOARD_TRAILER',
    'MOBILE_PEDESTRIAN_CROSSING_SIGN', 'MOTORCYCLE', 'MOTORCYCLIST', 'OFFICIAL_SIGNALER',
    'PEDESTRIAN', 'RAILED_VEHICLE', 'REGULAR_VEHICLE', 'SCHOOL_BUS', 'SIGN', 'STOP_SIGN',
    'STROLLER', 'TRAFFIC_LIGHT_TRAILER', 'TRUCK', 'TRUCK_CAB', 'VEHICULAR_TRAILER', 'WHEELCHAIR',
    'WHEELED_DEVICE', 'WHEELED_RIDER',
)  # fmt: skip
KITTI = ('Car', 'Van', 'Truck', 'Pedestrian', 'Person_sitting', 'Cyclist', 'Tram', 'Misc')
VOCABULARIES = {
    'nuscenes': NUSCENES, 'lidarseg': NUSCENES, 'argoverse2': ARGOVERSE2, 'kitti': KITTI,
    'kitti_object': KITTI,
}  # fmt: skip
"""By format."""
TRANSLATIONS = (
    (('rack',), 'static_object.bicycle_rack', '', 'Misc'),
    (('sign', 'signs'), '', 'SIGN', 'Misc'),
    (('depiction',), '', '', 'Misc'),
    (('barrel', 'barrels'), '', 'CONSTRUCTION_BARREL', 'Misc'),
    (('motorcyclist',), 'vehicle.motorcycle', 'MOTORCYCLIST', 'Misc'),
    (('motorcycle', 'motorbike'), 'vehicle.motorcycle', 'MOTORCYCLE', 'Misc'),
    (('cyclist', 'bicyclist', 'rider'), 'vehicle.bicycle', 'BICYCLIST', 'Cyclist'),
    (('bicycle', 'bike'), 'vehicle.bicycle', 'BICYCLE', 'Cyclist'),
    (('stroller',), 'human.pedestrian.stroller', 'STROLLER', 'Misc'),
    (('wheelchair',), 'human.pedestrian.wheelchair', 'WHEELCHAIR', 'Misc'),
    (('child',), 'human.pedestrian.child', 'PEDESTRIAN', 'Pedestrian'),
    (
        ('pedestrian', 'person', 'adult', 'human', 'signaler', 'worker', 'officer'),
        'human.pedestrian.adult', 'PEDESTRIAN', 'Pedestrian',
    ),
    (('cone', 'cones', 'trafficcone'), 'movable_object.trafficcone', 'CONSTRUCTION_CONE', 'Misc'),
    (('barrier', 'barriers'), 'movable_object.barrier', '', 'Misc'),
    (('animal', 'animals', 'dog'), 'animal', 'ANIMAL', 'Misc'),
    (('articulated', 'bendy'), 'vehicle.bus.bendy', 'ARTICULATED_BUS', 'Misc'),
    (('bus',), 'vehicle.bus.rigid', 'BUS', 'Misc'),
    (('tram', 'railed', 'train'), '', 'RAILED_VEHICLE', 'Tram'),
    (('trailer',), 'vehicle.trailer', 'VEHICULAR_TRAILER', 'Misc'),
    (('construction',), 'vehicle.construction', 'LARGE_VEHICLE', 'Misc'),
    (('truck', 'lorry', 'large'), 'vehicle.truck', 'TRUCK', 'Truck'),
    (('van',), 'vehicle.car', 'REGULAR_VEHICLE', 'Van'),
    (('car', 'vehicle', 'suv', 'taxi'), 'vehicle.car', 'REGULAR_VEHICLE', 'Car'),
)  # fmt: skip
"""Words of a name, and its names in nuScenes, Argoverse 2 and KITTI; the first row counts."""
VOCABULARY_COLUMNS = (NUSCENES, ARGOVERSE2, KITTI)
"""Vocabularies of the columns of `TRANSLATIONS`."""
MAX_NAMED = 5
"""Most class names in a sentence; chosen."""


class ClassNames:
    """
    Translate class names for one format.

    Parameters
    ----------
    form : str
        Name of the format; one without an entry in `VOCABULARIES` has no translations of its own.
    path : Path, optional
        YAML with a name for each class name: of all formats, or by format under its name.

    Raises
    ------
    ConfigError
        If `path` cannot be read, is something else, or states a name that the format lacks.

    """

    def __init__(self, form: str, path: Path | None = None) -> None:
        self._vocabulary = VOCABULARIES.get(form, ())
        self._stated = {} if path is None else _stated(path, form)
        for given, name in self._stated.items():
            if self._vocabulary and name not in self._vocabulary:
                raise ConfigError(
                    f'{path}: {given!r}: expected a class of the format {form!r} '
                    f'({", ".join(self._vocabulary)}), got {name!r}; correct it'
                )
        self.translated: dict[str, str] = {}
        """Names that were written otherwise than given, by the given one."""
        self.uncounted: Counter[str] = Counter()
        """Boxes by a name that the vocabulary lacks, which an evaluation does not count."""

    def notes(self) -> list[str]:
        """Return in a sentence which boxes an evaluation does not count; none if it counts all."""
        if not self.uncounted:
            return []
        named = [repr(name) for name in list(self.uncounted)[:MAX_NAMED]]
        if len(self.uncounted) > MAX_NAMED:
            named.append(f'{len(self.uncounted) - MAX_NAMED} more')
        return [
            f'its evaluation has no class {", ".join(named)} and does not count these '
            f'{self.uncounted.total():,} boxes; state names for them by --class-map FILE'
        ]

    def of(self, class_name: str) -> str:
        """Return the name to write for a class name."""
        if class_name in self._stated:
            name = self._stated[class_name]
        elif self._vocabulary:
            name = official(class_name, self._vocabulary)
        else:
            name = class_name
        if name != class_name:
            self.translated[class_name] = name
        if self._vocabulary and name not in self._vocabulary:
            self.uncounted[class_name] += 1
        return name

    def word_of(self, class_name: str, unknown: str) -> str:
        """Return the name to write where names are one word; `unknown` for boxes without one."""
        return '_'.join(self.of(class_name).split()) or unknown


@cache
def official(class_name: str, vocabulary: tuple[str, ...], default: str | None = None) -> str:
    """
    Return a class name as a vocabulary has it.

    Parameters
    ----------
    class_name : str
        Any name.
    vocabulary : tuple of str
        One of `VOCABULARY_COLUMNS`.
    default : str, optional
        For names that cannot be translated; by default they stay as they are.

    """
    spelt = {name.lower(): name for name in vocabulary}
    if class_name.lower() in spelt:
        return spelt[class_name.lower()]
    column = 1 + VOCABULARY_COLUMNS.index(vocabulary)
    words = words_of(class_name)
    names = (str(row[column]) for row in TRANSLATIONS if not words.isdisjoint(row[0]))
    return next(names, '') or (class_name if default is None else default)


def check_sections(path: Path, forms: Sequence[str]) -> None:
    """Raise ConfigError if a file states names for something else than one of some formats."""
    for key, value in _content(path).items():
        if isinstance(value, Mapping) and key not in forms:
            raise ConfigError(
                f'{path}: {key!r}: expected a format that uses it ({", ".join(forms)}), or a name '
                f'for a class, got names for {key!r}; correct it'
            )


def _content(path: Path) -> Mapping[Any, Any]:
    """Return the content of a file of class names."""
    try:
        content: Any = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigError(unreadable(path, error)) from None
    except YAML_ERRORS as error:
        raise ConfigError(f'{path}: not a map of class names: {error}') from None
    if not isinstance(content, Mapping):
        raise ConfigError(f'{path}: expected lines CLASS: NAME, got {content!r:.60}; correct it')
    return content


def _stated(path: Path, form: str) -> dict[str, str]:
    """Return the names that a file states for a format, by class name."""
    found: dict[str, str] = {}
    for key, value in _content(path).items():
        if not isinstance(value, Mapping):
            found[str(key)] = str(value)
        elif str(key) == form:
            found |= {str(given): str(name) for given, name in value.items()}
    return found

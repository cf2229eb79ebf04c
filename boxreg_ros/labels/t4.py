"""
T4, the data set format of TIER IV: nuScenes with other folder and channel names.

Its devkit refuses columns that it does not know, since version 0.8. So status, reason, covariance
and the stamp in nanoseconds are in ``boxreg_values.json``, by the token of their row. Its own
columns have velocity and acceleration, those that were refined where they are known and else the
velocity between the boxes before and after, and whether a program made the box, with its name and
the score.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from boxreg_ros.labels import nuscenes
from boxreg_ros.labels.attributes import to_nuscenes
from boxreg_ros.labels.files import JsonList
from boxreg_ros.labels.nuscenes import OWN_VALUES, read, read_scene
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.structures import HUMAN, RefinedBoxes
import numpy as np

__all__ = ['FORMAT', 'read', 'read_scene', 'Writer']

FORMAT = replace(
    nuscenes.FORMAT,
    name='t4',
    title='T4',
    files='annotation/, data/LIDAR_CONCAT/, maps/',
    read_back='t4-devkit 0.1.0; 0.8.0 by hand',
)
MOTION = ('velocity', 'acceleration')
"""Columns with the motion of a box over ground, of x y z in the frame of the map [m/s, m/s^2]."""
LONGEST_STEP = 1.5
"""No velocity is stated across longer gaps [s]; that of the devkit of nuScenes."""


class Writer(nuscenes.Writer):
    """Write the tables of nuScenes under the names of T4, and no other columns than it has."""

    form = 't4'
    version = 'annotation'
    channel = 'LIDAR_CONCAT'
    cloud_file = 'data/LIDAR_CONCAT/{number:05d}.pcd.bin'
    image_file = 'data/{channel}/{number:05d}.{suffix}'
    date_key = 'data_captured'

    def begin(self) -> None:
        """Open the files."""
        super().begin()
        self._own_values = JsonList(self.folder / OWN_VALUES)
        self._model = f'{self.provenance.tool} {self.provenance.version}'
        self._stamp_ns = 0
        # Stamp [ns] and centre of the last two boxes, by instance key
        self._places: dict[str, list[tuple[int, list[float]]]] = {}
        self._are_refined: dict[str, bool] = {}  # the velocity of the last box, by instance key

    def add(self, frame: LabelFrame) -> None:
        """Add a sample with its annotations."""
        self._stamp_ns = frame.refined.boxes.stamp_ns
        super().add(frame)

    def finish(self) -> None:
        """Complete the tables and the file of values."""
        super().finish()
        self._own_values.close()

    def attribute_names(self, attributes: Mapping[str, str]) -> list[str]:
        """Return all attributes: T4 has groups of its own for occlusion and truncation."""
        return to_nuscenes(attributes, 'vehicle_state.parked')

    def _link(self, table: str, row: dict[str, Any], instance: str = '', camera: str = '') -> None:
        """Hold a row as that class does; annotations get their velocity."""
        if instance:
            places = self._places.setdefault(instance, [])
            places.append((self._stamp_ns, row['translation']))
            held = self._held_annotations.get(instance)
            if held is not None and not self._are_refined[instance]:
                held['velocity'] = _velocity(places[-3:]) or held['velocity']
            self._are_refined[instance] = row['velocity'] is not None
            row['velocity'] = row['velocity'] or _velocity(places[-2:])  # until the next is known
            del places[:-2]
        super()._link(table, row, instance, camera)

    def _evidence(self, refined: RefinedBoxes, row: int) -> dict[str, Any]:
        """Return what an annotation states beside the columns of nuScenes."""
        motion = refined.boxes.known_kinematics[row]
        known = {
            name: motion[name][:3].tolist() if motion[f'has_{name}'] else None for name in MOTION
        }
        return super()._evidence(refined, row) | known

    def _own_columns(self, token: str, values: dict[str, Any]) -> dict[str, Any]:
        """Write values beside the tables; return those that T4 has columns for."""
        motion = {name: values.pop(name, None) for name in MOTION}
        self._own_values.append({'token': token, **values})
        if 'status' not in values:  # of a sweep
            return {}
        is_automatic = values['status'] != HUMAN
        score = values.get('score')
        # A box without a score is taken for certain: T4 demands a number from 0 to 1.
        certainty = 1.0 if score is None else float(np.clip(score, 0.0, 1.0))
        model = {'name': self._model, 'score': certainty, 'uncertainty': None}
        return {
            **motion,
            'automatic_annotation': is_automatic,
            'autolabel_metadata': [model] if is_automatic else None,
        }


def _velocity(places: Sequence[tuple[int, list[float]]]) -> list[float] | None:
    """Return the velocity between the first and the last place [m/s]; None across a gap."""
    (first_ns, first), (last_ns, last) = places[0], places[-1]
    seconds = (last_ns - first_ns) * 1e-9
    if not 0 < seconds <= LONGEST_STEP * (len(places) - 1):
        return None
    return [float(b - a) / seconds for a, b in zip(first, last, strict=True)]

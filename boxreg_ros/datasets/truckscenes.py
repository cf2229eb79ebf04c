"""
MAN TruckScenes, as it is downloaded: the tables of nuScenes, clouds of six LiDARs as PCD.

Each LiDAR has stamps of its own, and its points have times. Points are moved to the stamp of their
cloud by the poses of the vehicle, which has some hundred a second; that of other objects is not
compensated.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from boxreg_ros.datasets import nuscenes
from boxreg_ros.datasets.nuscenes import inputs, scene_names
from boxreg_ros.datasets.protocol import Scene

__all__ = ['DATASET', 'inputs', 'open_scene', 'scene_names']

DATASET = replace(
    nuscenes.DATASET,
    name='truckscenes',
    title='MAN TruckScenes',
    scene='scene-0044384af3d8494e913fb8b14915239e-3',
    reads='the LiDARs of a scene, times of points',
    leaves_out='cameras, radar, motion of cabin and chassis',
    read_back='truckscenes-devkit 1.2.0',
)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a scene, by default with all of its LiDARs; see `protocol.DatasetModule`."""
    return nuscenes.scene_of(root, name, lidars, has_all_poses=True)

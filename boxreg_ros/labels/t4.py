"""T4, the data set format of TIER IV: nuScenes with other folder and channel names."""

from __future__ import annotations

from dataclasses import replace

from boxreg_ros.labels import nuscenes
from boxreg_ros.labels.nuscenes import read, read_scene

__all__ = ['FORMAT', 'read', 'read_scene', 'Writer']

FORMAT = replace(
    nuscenes.FORMAT, name='t4', title='T4', files='annotation/, data/LIDAR_CONCAT/, maps/'
)


class Writer(nuscenes.Writer):
    """Write the tables of nuScenes under the names of T4."""

    version = 'annotation'
    channel = 'LIDAR_CONCAT'
    cloud_file = 'data/LIDAR_CONCAT/{number:05d}.pcd.bin'
    date_key = 'data_captured'

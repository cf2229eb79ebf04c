"""T4, the data set format of TIER IV: nuScenes with other names of folders and channel."""

from __future__ import annotations

from dataclasses import replace

from boxreg_ros.labels import nuscenes
from boxreg_ros.labels.nuscenes import read

__all__ = ['FORMAT', 'read', 'Writer']

FORMAT = replace(
    nuscenes.FORMAT, name='t4', title='T4', files='annotation/, data/LIDAR_CONCAT/, maps/'
)


class Writer(nuscenes.Writer):
    """Write the tables where T4 has them."""

    version, channel, clouds = 'annotation', 'LIDAR_CONCAT', 'data/LIDAR_CONCAT'
    captured = 'data_captured'

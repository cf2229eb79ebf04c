"""Register tracked 3D boxes to the point clouds themselves: live on ROS 2, over recordings."""

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.registrar import refine
from boxreg_ros.structures import RefinedTrack, Track

__version__ = '0.1.0'

__all__ = ['BoxregError', 'Config', 'RefinedTrack', 'Track', 'refine']

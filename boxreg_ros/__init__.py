"""Register tracked 3D boxes to the point cloud stream; live on ROS 2 and over recordings."""

from typing import Any, TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError

if TYPE_CHECKING:
    from boxreg_ros.core.refine import refine, RefinedTrack, Track

__version__ = '0.1.0'

__all__ = ['BoxregError', 'Config', 'RefinedTrack', 'Track', 'refine']


def __getattr__(name: str) -> Any:
    """Import what needs torch when it is first asked for: it takes seconds."""
    if name in __all__:
        from boxreg_ros.core import refine as tracks

        return getattr(tracks, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')

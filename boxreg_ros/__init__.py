"""Register tracked 3D boxes to LiDAR points: whole tracks, streams, recordings, ROS 2 topics."""

from importlib import import_module
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.errors import (
    BoxregError,
    ConfigError,
    RecordingError,
    ShapeError,
    TransformUnavailable,
    UnsupportedMessage,
)

if TYPE_CHECKING:
    from boxreg_ros.core.follow import follow, FollowedTrack
    from boxreg_ros.core.refine import refine, RefinedTrack, Track
    from boxreg_ros.core.registrar import BoxRegistrar
    from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep

__version__ = '0.1.0'

__all__ = [
    'BoxArray',
    'BoxRegistrar',
    'BoxregError',
    'Config',
    'ConfigError',
    'FollowedTrack',
    'RecordingError',
    'RefinedBoxes',
    'RefinedTrack',
    'ShapeError',
    'Sweep',
    'Track',
    'TransformUnavailable',
    'UnsupportedMessage',
    'follow',
    'refine',
]

# The import of torch takes seconds: these names are imported at their first use.
_MODULES = {
    'structures': ('BoxArray', 'RefinedBoxes', 'Sweep'),
    'core.registrar': ('BoxRegistrar',),
    'core.follow': ('FollowedTrack', 'follow'),
    'core.refine': ('RefinedTrack', 'Track', 'refine'),
}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    module = next((module for module, names in _MODULES.items() if name in names), '')
    if not module:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'boxreg_ros.{module}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, those not yet imported too."""
    return sorted({*globals(), *__all__})

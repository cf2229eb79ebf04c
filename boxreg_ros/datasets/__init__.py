"""
Public data sets as recordings, from the folder as it is downloaded: one module per data set.

Each is behind `protocol.DatasetModule` and listed in `registry.DATASETS`. To add a data set, write
a module with ``DATASET``, ``scene_names``, ``inputs`` and ``open_scene``, and add it to the table.

"""

from boxreg_ros.datasets.protocol import Cloud, Dataset, Scene, SweepFile
from boxreg_ros.datasets.registry import (
    Address,
    address_of,
    all_scenes,
    DATASETS,
    module_of,
    open_scene,
    resolved,
    scene_files,
    scene_inputs,
    scene_names,
)
from boxreg_ros.datasets.scene_recording import SceneRecording

__all__ = [
    'Address',
    'address_of',
    'all_scenes',
    'Cloud',
    'Dataset',
    'DATASETS',
    'module_of',
    'open_scene',
    'resolved',
    'Scene',
    'scene_files',
    'scene_inputs',
    'scene_names',
    'SceneRecording',
    'SweepFile',
]

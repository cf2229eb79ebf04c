"""
Label formats: one module per format, behind `protocol.FormatModule`, listed in `registry.FORMATS`.

To add a format, write a module with ``FORMAT``, ``Writer`` and, where files can be read back,
``read``, and name it in the table or, in a package of your own, by an entry point;
docs/tasks/write-a-label-format.md shows it step by step.

"""

from boxreg_ros.labels.output import LabelOutput
from boxreg_ros.labels.protocol import (
    Format,
    LabelFrame,
    LabelWriter,
    Options,
    Provenance,
    SceneFrames,
)
from boxreg_ros.labels.registry import (
    can_read,
    check_options,
    files_of,
    FORMATS,
    frames_of,
    import_format,
    labels_points,
    module_of,
    writer_for,
)

__all__ = [
    'can_read',
    'check_options',
    'files_of',
    'Format',
    'FORMATS',
    'frames_of',
    'import_format',
    'labels_points',
    'LabelFrame',
    'LabelOutput',
    'LabelWriter',
    'module_of',
    'Options',
    'Provenance',
    'SceneFrames',
    'writer_for',
]

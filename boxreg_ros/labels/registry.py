"""The table of label formats, and access to them by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

from boxreg_ros.errors import ConfigError, RecordingError, require_packages
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.class_names import check_sections, ClassNames
from boxreg_ros.labels.protocol import (
    FormatModule,
    LabelFrame,
    LabelWriter,
    Options,
    Provenance,
    SceneFrames,
)
from msg_adapters.convention import Convention, STANDARD

BUILT_IN = {
    name: f'boxreg_ros.labels.{name}'
    for name in (
        *('csv', 'parquet', 'openlabel', 'kitti', 'kitti_object', 'tracklets', 'nuscenes', 't4'),
        *('argoverse2', 'waymo', 'openpcdet', 'sustechpoints', 'datumaro', 'supervisely'),
        *('sly_pointcloud', 'xtreme1', 'mcap', 'semantickitti', 'lidarseg', 'recording'),
    )
}
GROUP = 'boxreg_ros.labels'
"""Entry points of this group are formats of other packages: ``name = package.module``."""
FORMATS = BUILT_IN | {
    point.name: point.value for point in entry_points(group=GROUP) if point.name not in BUILT_IN
}
"""Name on the command line -> module that implements `protocol.FormatModule`."""
IN_RESULT_FOLDER = ('csv', 'mcap')
"""Formats of a single file that is written into the folder of results itself."""
COMMAND_LINE_OPTIONS = ('camera', 'with_points', 'swap_axes', 'class_map', 'with_images')
"""Fields of `protocol.Options` that a user sets by name."""


def module_of(name: str) -> FormatModule:
    """Return the module of a format; ConfigError if it does not exist, or lacks a package."""
    module = import_format(name)
    require_packages(f'format {name!r}', module.FORMAT.packages)
    return module


def can_read(name: str) -> bool:
    """Return whether label files of this format can be read back."""
    return hasattr(import_format(name), 'read')


def labels_points(name: str) -> bool:
    """Return whether a format labels points and not boxes."""
    return module_of(name).FORMAT.has_points


def require_boxes(names: Sequence[str]) -> None:
    """Raise ConfigError if one of the formats labels points, or can only be read."""
    for name in names:
        if not hasattr(module_of(name), 'Writer'):
            able = ', '.join(other for other in FORMATS if hasattr(import_format(other), 'Writer'))
            raise ConfigError(f'format {name!r} can only be read; to write: {able}')
    for name in filter(labels_points, names):
        raise ConfigError(
            f'format {name!r} labels the points of clouds: expected formats of boxes; write it '
            f'by boxreg relabel --label-points'
        )


def check_options(names: Sequence[str], options: Options) -> None:
    """
    Check that the options fit the formats, before a recording is read.

    Parameters
    ----------
    names : sequence of str
        Of the formats to write.
    options : Options
        Of all of them together.

    Raises
    ------
    ConfigError
        If no format uses an option that is set, with the formats that use it; if the camera or the
        class names that a format uses cannot be read; if a format does not exist, lacks a package,
        labels points, or can only be read.

    """
    require_boxes(names)
    used = {option for name in names for option in module_of(name).FORMAT.options}
    for option in COMMAND_LINE_OPTIONS:
        if getattr(options, option) and option not in used:
            able = _formats_with(option)
            raise ConfigError(
                f'--{option.replace("_", "-")}: expected a format that uses it '
                f'({", ".join(able)}), got {", ".join(names)}; add one, or leave it out'
            )
    if options.class_map is not None:
        check_sections(options.class_map, _formats_with('class_map'))
    for name in names:
        if 'class_map' in module_of(name).FORMAT.options:
            ClassNames(name, options.class_map)  # raises for other names
        camera = options.camera if 'camera' in module_of(name).FORMAT.options else None
        # Without a file it is that of the recording, which is not open yet.
        if camera is not None and (camera.is_file() or not str(camera).startswith('/')):
            Camera.read(camera)  # raises if it cannot be read


def _formats_with(option: str) -> list[str]:
    """Return the names of the formats that use an option."""
    return [name for name in FORMATS if option in import_format(name).FORMAT.options]


def writer_for(
    name: str, out: Path, provenance: Provenance, options: Options | None = None
) -> LabelWriter:
    """
    Return a writer of a format.

    Parameters
    ----------
    name : str
        Of the format.
    out : Path
        The folder of results, which exists. The writer has a folder of its own in it, except for
        the formats of `IN_RESULT_FOLDER`.
    provenance : Provenance
        Origin of the labels.
    options : Options, optional
        Settings of the writer.

    Returns
    -------
    writer : LabelWriter
        To be closed by the caller.

    Raises
    ------
    ConfigError
        If the format does not exist or lacks a package, or an option does not fit it.

    """
    module = module_of(name)
    folder = out if name in IN_RESULT_FOLDER else out / name
    folder.mkdir(exist_ok=True)
    return module.Writer(folder, provenance, options or Options())


def frames_of(
    name: str,
    path: Path,
    scene: SceneFrames | None = None,
    convention: Convention = STANDARD,
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a label file or folder.

    Parameters
    ----------
    name : str
        Of the format.
    path : Path
        The file or folder; for some formats ``PATH#PART``, see `files_of`.
    scene : SceneFrames, optional
        Scene of a data set, whose boxes are read. It states stamps and calibration for formats
        with ``read_scene``; others ignore it.
    convention : Convention
        Of the boxes, where they follow another than that of their format.

    Yields
    ------
    frame : LabelFrame
        One per stamp. Boxes whose file states no status or covariance have the status ``input``
        and the unit matrix.

    Raises
    ------
    ConfigError
        At the call, if the format does not exist, lacks a package or cannot be read.
    RecordingError
        At the call, if the files do not exist; at a frame, if they do not follow the format.

    """
    module = module_of(name)
    if not can_read(name):
        able = ', '.join(other for other in FORMATS if can_read(other))
        raise ConfigError(f'format {name!r} can only be written; readable: {able}')
    readable: Any = module
    files = files_of(name, path)
    if not files.exists():
        raise RecordingError(f'labels {str(files)!r}: no such file or folder; correct the path')
    frames: Iterator[LabelFrame]
    if scene is not None and hasattr(module, 'read_scene'):
        frames = readable.read_scene(path, scene)
    else:
        frames = readable.read(path)
    return frames if convention.is_standard else (_meant(one, convention) for one in frames)


def _meant(frame: LabelFrame, convention: Convention) -> LabelFrame:
    """Return a frame with its boxes as a convention means them."""
    boxes = convention.to_centers(frame.refined.boxes)
    return replace(frame, refined=replace(frame.refined, boxes=boxes))


def files_of(name: str, path: Path) -> Path:
    """Return the files of a path of a format, without the part of them that it names."""
    module: Any = import_format(name)
    found: Path = module.files_of(path) if hasattr(module, 'files_of') else path
    return found


def import_format(name: str) -> FormatModule:
    """
    Return the module of a format, whether or not the packages it needs are installed.

    Raises ConfigError if the format does not exist, or the package that has it cannot be imported.

    """
    if name not in FORMATS:
        similar = get_close_matches(name, FORMATS, 1)
        meant = f'; did you mean {similar[0]}?' if similar else ''
        raise ConfigError(f'format {name!r}: expected one of {", ".join(FORMATS)}{meant}')
    try:
        return cast(FormatModule, import_module(FORMATS[name]))
    except (ImportError, SyntaxError) as error:
        raise ConfigError(
            f'format {name!r} of another package: expected a module {FORMATS[name]}, got '
            f'{type(error).__name__}: {error}; update or uninstall that package'
        ) from None

"""Command line options shared by the subcommands that read recordings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import Config, YAML_ERRORS
from msg_adapters.convention import Convention, FORWARD, REFERENCES, SIZE_ORDERS, STANDARD
from msg_adapters.point_layout import AUTO, TIME_UNIT_CHOICES
import yaml

if TYPE_CHECKING:
    from boxreg_ros.io.lidars import Lidars

RECORDINGS = (
    'MCAP file, rosbag2 folder, .db3 file or ROS 1 bag, or a scene of a data set as in '
    'nuscenes:/data#scene-0061'
)
"""Kinds of recordings, for the help of options."""


def add_recording_arguments(
    parser: argparse.ArgumentParser,
    several: str = 'several are merged by time',
    count: str = '+',
) -> None:
    """
    Add the recordings, their topics and the settings.

    Parameters
    ----------
    parser : ArgumentParser
        Gets the arguments.
    several : str
        Use of several recordings, for the help.
    count : str
        How many recordings are expected: ``+`` or ``*``.

    """
    parser.add_argument(
        'recordings', nargs=count, type=Path, metavar='RECORDING',
        help=f'{RECORDINGS}; {several}',
    )  # fmt: skip
    add_topic_arguments(parser)
    parser.add_argument('--config', type=Path, metavar='FILE', help='settings as a YAML file')
    parser.add_argument(
        '--set', action='append', default=[], type=key_value, metavar='KEY=VALUE',
        help='one setting, as in solver.rounds=2; overrides --config; can be repeated',
    )  # fmt: skip


def add_lidar_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the topics of the clouds, and the frames and times of their LiDARs."""
    parser.add_argument(
        '--points', action='append', default=[], metavar='TOPIC',
        help='topic of the point clouds (default: found by type); repeat it to merge the clouds '
        'of several LiDARs',
    )  # fmt: skip
    parser.add_argument(
        '--sensor-frame', action='append', default=[], metavar='FRAME', dest='sensor_frames',
        help='frame of the LiDAR where clouds are in another one: once per --points, or once per '
        'LiDAR of a single concatenated cloud',
    )  # fmt: skip
    parser.add_argument(
        '--points-info', metavar='TOPIC', default='',
        help='topic of ConcatenatedPointCloudInfo, which divides a concatenated cloud among its '
        'LiDARs (default: that of the clouds with _info behind it, if there is one)',
    )  # fmt: skip
    parser.add_argument(
        '--time-unit', choices=TIME_UNIT_CHOICES, default=AUTO,
        help='unit of the times of the points (default: that of the layout, else by magnitude)',
    )  # fmt: skip


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the topics to read, the LiDARs, and the convention of the boxes."""
    add_lidar_arguments(parser)
    parser.add_argument(
        '--boxes', metavar='TOPIC', help='topic of the boxes (default: found by type)'
    )
    parser.add_argument(
        '--odometry', metavar='TOPIC',
        help='odometry topic, used where TF does not connect the clouds with a fixed frame '
        '(default: found by type)',
    )  # fmt: skip
    parser.add_argument(
        '--pose-reference', metavar='POINT', default=STANDARD.pose_reference,
        help=f'point of the box at its pose: {", ".join(REFERENCES)}, or X,Y,Z as fractions of '
        f'length, width and height (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--size-order', choices=SIZE_ORDERS, default=STANDARD.size_order,
        help='meaning of x, y and z of a size (default: %(default)s: length, width, height)',
    )  # fmt: skip
    parser.add_argument(
        '--forward-axis', choices=FORWARD, default=STANDARD.forward_axis,
        help='axis of the box pose that points forward (default: %(default)s)',
    )  # fmt: skip


def add_label_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the label formats, for every subcommand that writes them."""
    parser.add_argument(
        '--camera', type=Path, metavar='FILE',
        help='camera calibration, for formats with image coordinates',
    )  # fmt: skip
    parser.add_argument(
        '--swap-axes', action='store_true',
        help='write the extents in the order that Datumaro and CVAT display them',
    )  # fmt: skip
    parser.add_argument(
        '--with-points', action='store_true',
        help='also write the point clouds that a label format stores beside its labels',
    )  # fmt: skip
    parser.add_argument(
        '--label-frame', metavar='FRAME',
        help='sensor frame of the label files (default: frame of the clouds)',
    )  # fmt: skip


def lidars_from(args: argparse.Namespace) -> Lidars:
    """Return the topics of the clouds and the frames of the LiDARs of the arguments."""
    from boxreg_ros.io.lidars import Lidars  # imports numpy

    frames = tuple(args.sensor_frames)
    return Lidars(tuple(args.points), frames, args.points_info, args.time_unit)


def lidar_options(args: argparse.Namespace) -> list[str]:
    """Return the options that `lidars_from` reads, as they are written."""
    words = [f'--points={topic}' for topic in args.points]
    words += [f'--sensor-frame={frame}' for frame in args.sensor_frames]
    if args.points_info:
        words.append(f'--points-info={args.points_info}')
    if args.time_unit != AUTO:
        words.append(f'--time-unit={args.time_unit}')
    return words


def convention_from(args: argparse.Namespace, associate: bool = False) -> Convention:
    """Return the convention of the boxes that the arguments describe."""
    return Convention(args.pose_reference, args.size_order, args.forward_axis, associate)


def key_value(text: str) -> tuple[str, Any]:
    """
    Return name and value of ``KEY=VALUE``, the value parsed as YAML.

    Raises
    ------
    ArgumentTypeError
        If the text has another form, or the value is not YAML.

    """
    name, equals, value = text.partition('=')
    if not name or not equals:
        raise argparse.ArgumentTypeError(f'expected KEY=VALUE, got {text!r}')
    try:
        return name, yaml.safe_load(value)
    except YAML_ERRORS:
        raise argparse.ArgumentTypeError(f'{name}: expected a YAML value, got {value!r}') from None


def config_from(args: argparse.Namespace) -> Config:
    """Return the settings of ``--config``, overridden by those of ``--set``."""
    config = Config() if args.config is None else Config.from_yaml(args.config)
    return config.updated(dict(args.set))

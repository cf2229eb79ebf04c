"""Options of the subcommands that read recordings, and what they mean."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from boxreg_ros.config import Config
from msg_adapters.convention import Convention, FORWARD, REFERENCES, SIZE_ORDERS, STANDARD
import yaml


def add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what is read of which recordings, and under which settings."""
    parser.add_argument(
        'recordings', nargs='+', type=Path, metavar='RECORDING',
        help='MCAP file, rosbag2 folder, .db3 file or ROS 1 bag; several are merged by time',
    )  # fmt: skip
    add_topic_arguments(parser)
    parser.add_argument('--config', type=Path, metavar='FILE', help='settings as YAML')
    parser.add_argument(
        '--set', action='append', default=[], type=setting, metavar='KEY=VALUE',
        help='one setting, as in solver.rounds=2; wins over --config',
    )  # fmt: skip


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which topics are read, and what the poses of boxes mean."""
    parser.add_argument('--points', metavar='TOPIC', help='point clouds (default: found by type)')
    parser.add_argument('--boxes', metavar='TOPIC', help='boxes (default: found by type)')
    parser.add_argument(
        '--odometry', metavar='TOPIC', help='where TF does not lead to a fixed frame'
    )
    parser.add_argument(
        '--pose-reference', metavar='POINT', default=STANDARD.pose_reference,
        help=f'point of a box that its pose is at: {", ".join(REFERENCES)}, or X,Y,Z in parts of '
        f'length, width and height (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--size-order', choices=SIZE_ORDERS, default=STANDARD.size_order,
        help='what x, y and z of a size are (default: %(default)s, length, width, height)',
    )  # fmt: skip
    parser.add_argument(
        '--forward-axis', choices=FORWARD, default=STANDARD.forward_axis,
        help='axis of a pose that points forward (default: %(default)s)',
    )  # fmt: skip


def convention_from(args: argparse.Namespace, associate: bool = False) -> Convention:
    """Return what `--pose-reference` and the options beside it say."""
    return Convention(args.pose_reference, args.size_order, args.forward_axis, associate)


def setting(text: str) -> tuple[str, Any]:
    """Return name and value of ``KEY=VALUE``, the value read as YAML."""
    name, equals, value = text.partition('=')
    if not name or not equals:
        raise argparse.ArgumentTypeError(f'expected KEY=VALUE, got {text!r}')
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError:
        raise argparse.ArgumentTypeError(f'{name}: not a YAML value: {value!r}') from None


def config_from(args: argparse.Namespace) -> Config:
    """Return the settings of ``--config`` and ``--set``."""
    config = Config() if args.config is None else Config.from_yaml(args.config)
    return config.updated(dict(args.set))

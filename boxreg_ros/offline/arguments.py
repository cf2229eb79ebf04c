"""The options of commands, from the dataclasses that state them, and back to these."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, Field, fields, is_dataclass, MISSING
import json
from pathlib import Path
from typing import Any

from boxreg_ros.config import COMPLETE_STEPS, Config, YAML_ERRORS
from boxreg_ros.offline.request import Request
from boxreg_ros.options import Option, option
import yaml

RECORDINGS = (
    'MCAP file, rosbag2 folder, .db3 file or ROS 1 bag, or a scene of a data set as in '
    'nuscenes:/data#scene-0061'
)
"""Kinds of recordings, for the help of options."""
TOPICS = (
    *('lidars', 'boxes', 'odometry', 'tf', 'clock_offset'),
    *('pose_reference', 'size_order', 'forward_axis', 'orientation', 'size_scale', 'boxes_frame'),
    'boxes_offset',
)
"""Options of `Request` for the topics to read, and for the convention of the boxes."""


def add_recordings(
    parser: argparse.ArgumentParser, several: str = 'several are merged by time', count: str = '+'
) -> None:
    """Add the recordings."""
    parser.add_argument(
        'recordings', nargs=count, type=Path, metavar='RECORDING',
        help=f'{RECORDINGS}; {several}',
    )  # fmt: skip


def add_options(
    parser: argparse.ArgumentParser, owner: type, *names: str, **defaults: Any
) -> None:
    """
    Add the options that a dataclass states, those of dataclasses within it included.

    With `names` only these fields; a dataclass within `owner` adds all its options. `defaults`
    are those that differ from the fields.

    """
    for one, facts in _options(owner, names):
        default = defaults.get(one.name, one.default)
        more: dict[str, Any] = {'dest': one.name, 'default': default}
        more['help'] = f'{facts.meaning} [{facts.unit}]' if facts.unit else facts.meaning
        if default and '(default: ' not in facts.meaning:
            shown = ','.join(default) if isinstance(default, tuple) else default
            more['help'] += f' (default: {shown})'
        if default is False:
            parser.add_argument(_flag(one, facts), action='store_true', **more)
            continue
        if facts.is_repeated:
            more |= {'action': 'append', 'default': []}
        if facts.choices:
            more['choices'] = facts.choices
        parser.add_argument(
            _flag(one, facts), type=facts.parse, metavar=facts.metavar, **more
        )  # fmt: skip


def values_of(args: argparse.Namespace, owner: type) -> dict[str, Any]:
    """Return the values of the options of a dataclass, by the names of its fields."""
    values: dict[str, Any] = {}
    for one in fields(owner):
        facts = one.metadata.get('option')
        if facts is None:
            inner = _inner(one)
            if inner is not None and next(_options(inner), None):
                values[one.name] = inner(**values_of(args, inner))
        elif hasattr(args, one.name):
            value = getattr(args, one.name)
            values[one.name] = tuple(value) if facts.is_repeated else value
    return values


def words_of(args: argparse.Namespace, owner: type, *names: str) -> list[str]:
    """Return the options of a dataclass as they are written, for the command of another run."""
    words = []
    for one, facts in _options(owner, names):
        value = getattr(args, one.name)
        flag = _flag(one, facts)
        if facts.is_repeated:
            words += [f'{flag}={facts.text(part)}' for part in value]
        elif value is True:
            words.append(flag)
        elif value != one.default:
            words.append(f'{flag}={facts.text(value)}')
    return words


def _options(owner: type, names: tuple[str, ...] = ()) -> Iterator[tuple[Field[Any], Option]]:
    """Yield the fields of a dataclass that state an option, those of inner ones in their place."""
    for one in fields(owner):
        facts = one.metadata.get('option')
        inner = _inner(one)
        if facts is not None:
            if not names or one.name in names:
                yield one, facts
        elif inner is not None:
            yield from _options(inner, () if one.name in names else names)


def _inner(one: Field[Any]) -> type | None:
    """Return the dataclass that is the type of a field; None for another type."""
    default = one.default if one.default_factory is MISSING else one.default_factory
    kind = default if isinstance(default, type) else type(default)
    return kind if is_dataclass(kind) else None


def _flag(one: Field[Any], facts: Option) -> str:
    return facts.flag or f'--{one.name.replace("_", "-")}'


def _key_value(text: str) -> tuple[str, Any]:
    """Return name and value of ``KEY=VALUE``, the value parsed as YAML."""
    name, equals, value = text.partition('=')
    if not name or not equals:
        raise argparse.ArgumentTypeError(f'expected KEY=VALUE, got {text!r}')
    try:
        return name, yaml.safe_load(value)
    except YAML_ERRORS:
        raise argparse.ArgumentTypeError(f'{name}: expected a YAML value, got {value!r}') from None


def _written(setting: tuple[str, Any]) -> str:
    name, value = setting
    return f'{name}={json.dumps(value)}'


@dataclass(frozen=True, slots=True)
class Settings:
    """The options that make a `Config`; a setting of its own wins over one that sets several."""

    config: Path | None = option(None, 'settings as a YAML file', metavar='FILE', parse=Path)
    overrides: tuple[tuple[str, Any], ...] = option(
        (),
        'one setting, as in solver.rounds=2; overrides --config and --complete; can be repeated',
        flag='--set',
        metavar='KEY=VALUE',
        parse=_key_value,
        text=_written,
        is_repeated=True,
    )
    complete: bool = option(
        False,
        'complete the tracks: join fragments, reject ghosts, add missing boxes (sets '
        'complete.stitch, static, prune, fill and extend)',
    )
    workers: int | None = option(
        None,
        'CPU cores of the solver (sets solver.threads); with 1 the run is one process',
        metavar='N',
        parse=int,
    )

    def effective(self) -> Config:
        """Return the settings: ``--config``, then the shorthands, then ``--set``."""
        config = Config() if self.config is None else Config.from_yaml(self.config)
        shorthands: dict[str, Any] = {}
        if self.complete:
            shorthands |= {f'complete.{step}': True for step in COMPLETE_STEPS}
        if self.workers is not None:
            shorthands['solver.threads'] = self.workers
        return config.updated(shorthands).updated(dict(self.overrides))


def config_from(args: argparse.Namespace) -> Config:
    """Return the settings that the arguments describe."""
    return Settings(**values_of(args, Settings)).effective()


def request_from(args: argparse.Namespace, *recordings: Path) -> Request:
    """Return the request of the arguments; options that a command lacks have their defaults."""
    paths = recordings or tuple(args.recordings)
    command = () if recordings else tuple(getattr(args, 'arguments', ()))
    values = values_of(args, Request)
    return Request(paths, config=config_from(args), command=command, **values)

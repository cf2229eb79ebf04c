"""`boxreg formats`: the label formats, and what each means by a box."""

from __future__ import annotations

import argparse
from importlib import import_module

from boxreg_ros.labels import FORMATS

HEAD = ('name', 'format', 'read', 'frame', 'position', 'sizes', 'rotation', 'files', 'needs')


def rows() -> list[tuple[str, ...]]:
    """Return what each format states, in the order of `HEAD`."""
    found: list[tuple[str, ...]] = []
    for path in FORMATS.values():
        module = import_module(path)
        f = module.FORMAT
        can_read = 'yes' if hasattr(module, 'read') else ''
        needs = ', '.join(f.packages)
        found.append(
            (f.name, f.title, can_read, f.frame, f.reference, f.sizes, f.rotation, f.files, needs)
        )
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads: nothing."""


def run(args: argparse.Namespace) -> int:
    """Print a paragraph per format."""
    for name, title, can_read, *facts, needs in rows():
        print(f'{name}: {title}' + ('' if can_read else ' (written only)'))
        for what, fact in zip(HEAD[3:], facts, strict=False):
            print(f'    {what:9} {fact}')
        if needs:
            print(f'    needs     pip install {needs}')
    return 0

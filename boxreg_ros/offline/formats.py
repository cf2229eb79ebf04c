"""`boxreg formats`: the label formats and their conventions, and the data sets that are read."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from boxreg_ros.datasets.registry import DATASETS
from boxreg_ros.datasets.registry import module_of as dataset_module
from boxreg_ros.errors import ConfigError
from boxreg_ros.labels import can_read, FORMATS, import_format

FORMAT_COLUMNS = (
    'name',
    'format',
    'read',
    'frame',
    'position',
    'sizes',
    'rotation',
    'files',
    'needs',
)
DATASET_COLUMNS = ('address', 'data set', 'in the folder', '`--labels`', 'needs')


def dataset_rows() -> list[tuple[str, ...]]:
    """Return each data set in the columns of `DATASET_COLUMNS`."""
    table: list[tuple[str, ...]] = []
    for name in DATASETS:
        dataset = dataset_module(name).DATASET
        labels = f'{dataset.labels}:PATH' if dataset.labels else ''
        packages = ', '.join(dataset.packages)
        address = f'{name}:FOLDER#{dataset.scene}'
        table.append((address, dataset.title, dataset.folder, labels, packages))
    return table


def rows() -> list[tuple[str, ...]]:
    """Return each format in the columns of `FORMAT_COLUMNS`; its error in place of the title."""
    table: list[tuple[str, ...]] = []
    for name in FORMATS:
        try:
            form = import_format(name).FORMAT
        except ConfigError as error:
            table.append((name, str(error), *[''] * (len(FORMAT_COLUMNS) - 2)))
            continue
        conventions = form.frame, form.reference, form.sizes, form.rotation, form.files
        readable, needs = 'yes' if can_read(name) else '', ', '.join(form.packages)
        table.append((name, form.title, readable, *conventions, needs))
    return table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `run`: none."""


def run(args: argparse.Namespace) -> int:
    """Print a paragraph per label format and per data set."""
    for name, title, is_readable, *conventions, needs in rows():
        is_whole = is_readable or not any(conventions)
        print(f'{name}: {title}' + ('' if is_whole else ' (written only)'))
        _print_facts(dict(zip(FORMAT_COLUMNS[3:-1], conventions, strict=True)), needs)
    print('\ndata sets, as recordings:')
    for address, title, folder, labels, needs in dataset_rows():
        print(f'{address}: {title}')
        _print_facts({'folder': folder, 'labels': f'--labels {labels}' if labels else ''}, needs)
    return 0


def _print_facts(facts: Mapping[str, str], packages: str) -> None:
    """Print what is known of a format or data set, a line each."""
    for name, text in {**facts, 'needs': f'pip install {packages}' if packages else ''}.items():
        if text:
            print(f'    {name:9} {text}')

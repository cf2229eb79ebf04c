"""A name has one meaning in the package: constants have one value, classes one definition."""

import ast
from collections import defaultdict

from paths import ROOT

PROTOCOL = {'BOX_FIELDS', 'DATASET', 'FORMAT', 'REQUIRED_FIELDS', '__all__'}
"""Names that each label format, data set or message adapter defines for itself."""
KERNELS = [ROOT / 'boxreg_ros' / 'core' / name for name in ('method',)]
"""Kernels number what others have under the same names: variables as slices, reasons."""


def constants_of(path):
    """Yield name and source of the value of each upper-case name that a module assigns."""
    for node in ast.parse(path.read_text(encoding='utf-8')).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        for target in targets:
            is_group = isinstance(target, ast.Tuple)
            values = getattr(node.value, 'elts', None) if is_group else [node.value]
            names = target.elts if is_group else [target]
            for name, value in zip(names, values or [node.value] * len(names), strict=True):
                if isinstance(name, ast.Name) and name.id.isupper():
                    yield name.id, ast.unparse(value)


def test_a_class_of_one_name_is_defined_once():
    found = defaultdict(list)
    for folder in ('boxreg_ros', 'msg_adapters'):
        for path in sorted((ROOT / folder).rglob('*.py')):
            for node in ast.parse(path.read_text(encoding='utf-8')).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
                    found[node.name].append(path.name)
    del found['Writer']  # each label format has its own
    assert {name: paths for name, paths in found.items() if len(paths) > 1} == {}


def test_a_constant_of_one_name_has_one_value_in_the_package():
    found = defaultdict(lambda: defaultdict(list))
    for folder in ('boxreg_ros', 'msg_adapters'):
        for path in sorted((ROOT / folder).rglob('*.py')):
            if not any(folder in path.parents for folder in KERNELS):
                for name, value in constants_of(path):
                    found[name][value].append(path.name)
    several = {name: dict(values) for name, values in found.items() if len(values) > 1}
    assert {name for name in several if name not in PROTOCOL} == set(), several

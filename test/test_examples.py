"""The examples of the documentation run, and the pages show them as they are."""

import re
import runpy
import subprocess
import sys

from paths import ROOT
import pytest

PAGE = ROOT / 'docs' / 'tasks' / 'use-from-python.md'
ERROR = re.compile(r'^mean position error, (\w+): ([\d.]+) m', re.MULTILINE)


def example(name):
    return ROOT / 'docs' / 'examples' / f'{name}.py'


def block_after(text, start):
    """Return the content of the first fenced block of `text` that starts with `start`."""
    first = text.index(start) + len(start)
    return text[first : text.index('```\n', first)]


@pytest.mark.parametrize('name', ['refine_tracks', 'stream'])
def test_example_reduces_the_position_error_as_its_page_shows(name, capsys):
    runpy.run_path(str(example(name)), run_name='__main__')
    output = capsys.readouterr().out
    errors = {key: float(value) for key, value in ERROR.findall(output)}
    given = errors.pop('input')
    assert max(errors.values()) < 0.5 * given
    page = PAGE.read_text(encoding='utf-8')
    source = example(name).read_text(encoding='utf-8')
    start = {'refine_tracks': 'track = ', 'stream': 'registrar = '}[name]
    source = source[source.index(f'\n{start}') + 1 : source.index("\nprint('")]
    assert f'```python\n{source}```\n' in page
    shown = block_after(page[page.index(source) :], '```text\n')
    # Digits may differ a little between processors; names and counts may not.
    for key, value in ERROR.findall(shown):
        assert float(value) == pytest.approx(errors.get(key, given), rel=0.2), key
    assert re.sub(r'0\.\d+', '', shown) == re.sub(r'0\.\d+', '', output)


def test_public_names_are_imported_at_their_first_use():
    code = """
import sys
import boxreg_ros
assert not {'torch', 'numpy', 'scipy'} & set(sys.modules), 'imported too early'
for name in boxreg_ros.__all__:
    assert getattr(boxreg_ros, name).__name__ == name
    assert name in dir(boxreg_ros)
try:
    boxreg_ros.no_such_name
except AttributeError as error:
    assert 'no_such_name' in str(error)
else:
    raise AssertionError('an unknown name was found')
"""
    subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=True, timeout=120)


def test_packages_are_marked_as_typed():
    for package in ('boxreg_ros', 'msg_adapters'):
        assert (ROOT / package / 'py.typed').is_file()
    assert "'py.typed'" in (ROOT / 'setup.py').read_text(encoding='utf-8')

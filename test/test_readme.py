"""The README shows what is so; `python test/test_readme.py` writes its tables."""

import re
import shlex

from boxreg_ros.cli import parser
from boxreg_ros.config import settings
from boxreg_ros.offline.formats import HEAD, rows
from boxreg_ros.reasons import REASONS
from paths import ROOT

README = ROOT / 'README.md'


def parameters():
    lines = ['| name | default | unit | range | meaning |', '|---|---|---|---|---|']
    for item in settings():
        bounds = ', '.join(item.choices)
        if item.low is not None:
            bounds = f'{item.low:g} to {item.high:g}'
        default = item.default
        if isinstance(default, tuple):
            default = ', '.join(default)
        cells = (f'`{item.name}`', f'{default}', item.unit, bounds, item.meaning)
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines)


def formats():
    lines = [f'| {" | ".join(HEAD)} |', f'|{"---|" * len(HEAD)}']
    for name, *facts in rows():
        lines.append(f'| `{name}` | {" | ".join(facts)} |')
    return '\n'.join(lines)


def counters():
    lines = ['| counter | of | meaning | what helps |', '|---|---|---|---|']
    lines += [f'| `{name}` | {" | ".join(reason)} |' for name, reason in REASONS.items()]
    return '\n'.join(lines)


def with_tables(text):
    for name, table in (
        ('parameters', parameters()),
        ('formats', formats()),
        ('counters', counters()),
    ):
        first = text.index('\n', text.index(f'<!-- {name}'))
        text = f'{text[:first]}\n\n{table}\n\n{text[text.index(f"<!-- end of {name} -->") :]}'
    return text


def commands():
    lines = README.read_text(encoding='utf-8').splitlines()
    return [line.strip() for line in lines if re.match(r'    boxreg \w', line)]


def test_tables_are_those_of_the_code():
    text = README.read_text(encoding='utf-8')
    assert text == with_tables(text), 'run: python test/test_readme.py'


def test_every_reason_that_is_counted_is_explained():
    # Reasons are words in quotes: what is counted, refused, told as trouble, or kept for.
    found = set()
    for path in (ROOT / 'boxreg_ros').rglob('*.py'):
        text = path.read_text(encoding='utf-8')
        for pattern in (
            r"counts\[f?'(\w+)'\]",
            r"self\.reasons\[i\] = '(\w+)'",
            r"_trouble\(\s*'(\w+)'",
            r"tick\.reasons\[i\] = .*'(\w+)'$",
            r"sink\.expect\(item, '(\w+)'",
        ):
            found |= set(re.findall(pattern, text))
    totals = {'sweeps', 'boxes', 'box_arrays', 'frames'}
    assert len(found) > 10
    assert sorted(found - totals - set(REASONS)) == []
    files = {*(ROOT / 'boxreg_ros').rglob('*.py')} - {ROOT / 'boxreg_ros' / 'reasons.py'}
    source = ''.join(path.read_text(encoding='utf-8') for path in files)
    for name, reason in REASONS.items():
        ending = f"}}_{name.partition('_')[2]}'"  # of one that begins with the topic
        assert f"'{name}'" in source or ending in source, name
        if 'see "' in reason.remedy:
            (title,) = re.findall(r'see "([^"]+)"', reason.remedy)
            assert f'\n## {title}\n' in README.read_text(encoding='utf-8')


def test_commands_are_understood():
    assert len(commands()) >= 3
    for command in commands():
        words = shlex.split(command)[1:]
        parser(words[0]).parse_args(words)


def test_links_lead_somewhere():
    links = re.findall(r'\]\(([^)]+)\)', README.read_text(encoding='utf-8'))
    files = [link for link in links if not link.startswith(('http', '#'))]
    assert len(files) >= 3
    assert [link for link in files if not (ROOT / link).exists()] == []


if __name__ == '__main__':
    README.write_text(with_tables(README.read_text(encoding='utf-8')), encoding='utf-8')

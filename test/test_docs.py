"""The README and the documentation: links, commands, paths and generated tables."""

import importlib.util
import re
import shlex
import subprocess
import sys

from boxreg_ros.cli import parser
from boxreg_ros.core.method.residuals import RESIDUALS
from boxreg_ros.reasons import Reason
from browser import launched, NEEDS_BROWSER
import generate
from paths import ROOT
import pytest
import yaml

DOCS = ROOT / 'docs'
README = ROOT / 'README.md'
PAGES = [README, ROOT / 'CONTRIBUTING.md', *sorted(DOCS.rglob('*.md'))]


def page_name(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize('page', generate.TABLES)
def test_generated_tables_match_the_code(page):
    text = (DOCS / page).read_text(encoding='utf-8')
    assert text == generate.renewed(page), f'stale: run {generate.COMMAND}'


def test_generator_refuses_a_page_without_marks(tmp_path, monkeypatch):
    monkeypatch.setattr(generate, 'DOCS', tmp_path)
    (tmp_path / 'parameters.md').write_text('# Parameters\n')
    with pytest.raises(ValueError, match=r'parameters\.md'):
        generate.renewed('parameters.md')


def test_every_explained_reason_is_counted():
    # That each counted one is explained, the type says: `Reason` has no other members.
    files = {*(ROOT / 'boxreg_ros').rglob('*.py')} - {ROOT / 'boxreg_ros' / 'reasons.py'}
    source = ''.join(path.read_text(encoding='utf-8') for path in files)
    for one in Reason:
        parts = rf"f'\{{\S+\}}_{one.value.partition('_')[2]}'"  # begins with the topic
        assert f'Reason.{one.name}' in source or re.search(parts, source), one


def test_remedies_name_existing_sections():
    text = (DOCS / 'troubleshooting.md').read_text(encoding='utf-8')
    for reason in Reason:
        for title in re.findall(r'see "([^"]+)"', reason.remedy):
            assert f'\n## {title}\n' in text


def commands_in(path):
    """Yield the lines of a page's code blocks that start boxreg, with the options of each."""
    for line in path.read_text(encoding='utf-8').splitlines():
        if re.match(r' *boxreg [a-z]', line):
            yield line.strip()


@pytest.mark.parametrize('path', PAGES, ids=page_name)
def test_commands_are_valid(path):
    for command in commands_in(path):
        words = shlex.split(re.sub(r'\s#.*', '', command))[1:]
        parser(words[0]).parse_args(words)


def test_every_extra_is_explained():
    text = (DOCS / 'getting-started.md').read_text(encoding='utf-8')
    explained = set(re.findall(r'^\| `(\w+)` \|', text, re.MULTILINE))
    _, _, setup = (ROOT / 'setup.py').read_text(encoding='utf-8').partition('extras_require')
    extras = set(re.findall(r"^        '(\w+)': \[", setup, re.MULTILINE))
    assert extras - {'test'} == explained  # it is for the tests here


def test_readme_has_commands():
    assert len(list(commands_in(README))) >= 5


@pytest.mark.parametrize('path', PAGES, ids=page_name)
def test_links_lead_to_files(path):
    links = re.findall(r'\]\(([^)\s]+)\)', path.read_text(encoding='utf-8'))
    files = [link.partition('#')[0] for link in links if not link.startswith(('http', '#'))]
    assert [link for link in files if not (path.parent / link).exists()] == []


def anchors_of(path):
    """Return the anchors of a page's headings, as GitHub and mkdocs make them."""
    titles = re.findall(r'^#+ (.+)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', title).strip().lower().replace(' ', '-') for title in titles}


@pytest.mark.parametrize('path', PAGES, ids=page_name)
def test_anchors_exist(path):
    for link in re.findall(r'\]\(([^)\s]*\.md)?#([^)\s]+)\)', path.read_text(encoding='utf-8')):
        target = path.parent / link[0] if link[0] else path
        assert link[1] in anchors_of(target), link


# Pages in tasks/ also name files that their readers write.
@pytest.mark.parametrize('path', [p for p in PAGES if p.parent.name != 'tasks'], ids=page_name)
def test_named_files_exist(path):
    text = path.read_text(encoding='utf-8')
    named = set(re.findall(r'`((?:boxreg_ros|msg_adapters|test|bags|docs)/[\w./-]+)`', text))
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_labels_that_the_code_quotes_are_those_of_the_method():
    text = ''.join((DOCS / page).read_text('utf-8') for page in ('method.md', 'method-tracks.md'))
    tagged = re.findall(r'\\tag\{(M\d+[a-z]?)\}', text)  # a formula
    titled = re.findall(
        r'^(?:\| |\*\*[^*(]+)\((M\d+[a-z]?)\)', text, re.MULTILINE
    )  # a row, a title
    labels = {*tagged, *titled}
    assert len(labels) > 25 and len(tagged) == len(set(tagged))
    for path in [*(ROOT / 'boxreg_ros').rglob('*.py'), *(ROOT / 'test').rglob('*.py')]:
        if path.name != 'test_example_residual.py':  # its label is a new one
            quoted = set(re.findall(r'\((M\d+[a-z]?)\)', path.read_text(encoding='utf-8')))
            assert quoted <= labels, (path, quoted - labels)
    for page in PAGES:
        quoted = set(re.findall(r'\((M\d+[a-z]?)\)', page.read_text(encoding='utf-8')))
        assert page.stem == 'add-a-residual' or quoted <= labels, (page, quoted - labels)


def test_every_residual_is_a_row_of_the_method():
    text = (DOCS / 'method.md').read_text(encoding='utf-8')
    for row in RESIDUALS:
        number = re.search(r'\((M\d+)\)', row.function.__doc__)[1]
        assert re.search(rf'^\| \({number}\) \|.*`{row.function.__name__}`', text, re.MULTILINE)


def test_the_method_reads_as_a_paper():
    lines = (DOCS / 'method.md').read_text(encoding='utf-8').splitlines()
    assert len(lines) <= 300
    assert max(map(len, lines)) <= 150  # none of them longer to be fewer


def test_readme_is_short():
    text = README.read_text(encoding='utf-8')
    assert len(text.splitlines()) <= 200
    assert len(text.encode()) <= 12_000


def test_every_page_is_in_the_navigation():
    class Loader(yaml.SafeLoader):
        """YAML with mkdocs' own tags, which are of no interest here."""

    Loader.add_multi_constructor('tag:yaml.org,2002:python/name:', lambda *_: None)
    configuration = yaml.load((ROOT / 'mkdocs.yml').read_text(encoding='utf-8'), Loader)
    listed = set(re.findall(r"'([\w/-]+\.md)'", str(configuration['nav'])))
    pages = {str(path.relative_to(DOCS)) for path in DOCS.rglob('*.md')}
    assert listed == pages, 'add the page to "nav" in mkdocs.yml'


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Build the documentation, without a warning, and return its folder."""
    for name in ('mkdocs', 'material', 'latex2mathml', 'mermaidx', 'ziamath'):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f'{name} is not installed')
    folder = tmp_path_factory.mktemp('site')
    command = [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_of_the_site_is_there_and_needs_no_network(site):
    pages = {path.relative_to(DOCS).with_suffix('.html') for path in DOCS.rglob('*.md')}
    for page in pages:
        text = (site / page).read_text(encoding='utf-8')
        loaded = re.findall(r'<(?:script|img|link|iframe)\b[^>]* (?:src|href)="([^"]+)"', text)
        assert [url for url in loaded if url.startswith(('http', '//'))] == [], page
        assert 'class="arithmatex"' not in text and 'class="mermaid"' not in text, page


def test_the_site_folds_all_tables_of_the_measurements(site):
    pages = {path: path.read_text(encoding='utf-8') for path in (DOCS / 'results').glob('*.md')}
    folded = {path: text.count('All tables: `python') for path, text in pages.items()}
    for path, count in folded.items():
        html = (site / path.relative_to(DOCS).with_suffix('.html')).read_text(encoding='utf-8')
        blocks = re.findall('<details.*?</details>', html, re.DOTALL)
        assert len(blocks) == count, path
        assert all('<table>' in block and 'json' in block for block in blocks)
    assert sum(folded.values()) > 10


@NEEDS_BROWSER
def test_formulas_and_diagrams_are_visible_without_a_network(site):
    with launched() as browser:
        page = browser.new_page(offline=True)
        page.goto((site / 'method.html').as_uri())
        formulas = page.locator('math')
        assert formulas.count() >= 50
        assert not re.search(r'\\[a-z(\[]', ' '.join(formulas.all_text_contents()))
        numerator, bar = (page.locator(f'mfrac > :nth-child({n})').first for n in (1, 2))
        above, below = numerator.bounding_box(), bar.bounding_box()
        assert above['y'] + above['height'] <= below['y'] + 1 and below['width'] > 3
        states = 'document.fonts.ready.then(fonts => [...fonts].map(font => font.status))'
        assert page.evaluate(states) == ['loaded']
        source = (DOCS / 'architecture.md').read_text(encoding='utf-8')
        page.goto((site / 'architecture.html').as_uri())
        diagrams = page.locator('svg[aria-roledescription]')
        assert diagrams.count() == source.count('```mermaid') > 0
        for diagram in diagrams.all():
            box = diagram.bounding_box()
            assert box['width'] > 300 and box['height'] > 100
            assert 'core' in diagram.text_content()

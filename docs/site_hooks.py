"""
What mkdocs draws for the documentation: formulas, diagrams and tables of measurements.

A reader needs no network.

"""

from __future__ import annotations

from html import unescape
from pathlib import Path
import re
import sys
from textwrap import indent
from typing import Any

from latex2mathml.converter import convert
import mermaidx
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
import ziamath

sys.path.insert(0, str(Path(__file__).parent))
from results import all_tables, FOLDED, STORE

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.+?)\\[)\]]</\1>', re.DOTALL)
"""A formula as pymdownx.arithmatex marks it, in a line or in a block of its own."""
DIAGRAM = re.compile(r'<pre class="mermaid"><code>(.+?)</code></pre>', re.DOTALL)
TABLES = re.compile(re.escape(FOLDED).replace(r'\{\}', r'(\w+)'))
"""The place of all tables of a kind of measurements."""
FONT = Path(ziamath.__file__).parent / 'fonts' / 'STIXTwoMath-Regular.ttf'
"""Without a font for mathematics browsers place indices and fractions badly."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the font that `assets/site.css` names."""
    files.append(File.generated(config, f'assets/{FONT.name}', abs_src_path=str(FONT)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return the text of a page with all tables of its measurements, folded."""
    return TABLES.sub(_folded, markdown)


def _folded(found: re.Match[str]) -> str:
    tables = indent('\n'.join(all_tables(STORE, found[1])), '    ')
    return f'??? info "All tables"\n\n{tables}'


def on_page_content(html: str, **_: Any) -> str:
    """Return the HTML of a page with MathML for its formulas and SVG for its diagrams."""
    html = FORMULA.sub(_mathml, html)
    parts = DIAGRAM.split(html)  # text and sources by turns
    parts[1::2] = [_svg(source, number) for number, source in enumerate(parts[1::2])]
    return ''.join(parts)


def _mathml(found: re.Match[str]) -> str:
    latex = re.sub(r'\\tag\{(.+?)\}', r'\\qquad \\text{(\1)}', unescape(found[3]))
    mathml = convert(latex, display='block' if found[2] == '[' else 'inline')
    # The bars of a norm would grow with its indices; of the lines above U+203E alone stretches.
    mathml = mathml.replace('<mo>&#x02016;</mo>', '<mo stretchy="false">&#x02016;</mo>')
    return mathml.replace('<mo accent="true">&#x02015;</mo>', '<mo stretchy="true">&#x0203E;</mo>')


def _svg(source: str, number: int) -> str:
    """Return a diagram; its styles have a name of its own on the page."""
    svg = mermaidx.render(unescape(source)).svg()
    return f'<p>{svg.replace("my-svg", f"diagram-{number}")}</p>'

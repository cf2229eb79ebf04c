"""A headless Chromium for tests, measurements and pictures of pages."""

from contextlib import contextmanager
import shutil

import pytest

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
BROWSER_OPTIONS = ('--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader')
"""Root needs ``--no-sandbox``; the others draw WebGL without a GPU."""
EXECUTABLE = next(filter(None, map(shutil.which, BROWSERS)), None)
NEEDS_BROWSER = pytest.mark.skipif(
    EXECUTABLE is None, reason='no Chromium on PATH: apt install chromium'
)


@contextmanager
def launched(*options):
    """Yield a browser with some `options` beside `BROWSER_OPTIONS`."""
    playwright = pytest.importorskip('playwright.sync_api')
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=EXECUTABLE, args=[*BROWSER_OPTIONS, *options]
        )
        yield browser
        browser.close()


@contextmanager
def opened_page(url, expected='', ready='html[data-ready]', **context):
    """Yield a page of a browser, ready; it fails for errors on its console but one `expected`."""
    errors = []
    with launched() as browser:
        # Tests evaluate text on the page, which its policy forbids.
        usual = {'viewport': {'width': 1366, 'height': 800}, 'bypass_csp': True}
        page = browser.new_page(**{**usual, **context})
        page.on('console', lambda line: errors.append(line.text) if line.type == 'error' else None)
        page.on('pageerror', lambda error: errors.append(str(error)))
        page.goto(url)
        page.wait_for_selector(ready, timeout=60_000)
        yield page
    assert [line for line in errors if not expected or expected not in line] == []

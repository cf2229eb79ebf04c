"""A headless Chromium for tests, measurements and pictures of pages."""

from contextlib import contextmanager, ExitStack
import shutil
from threading import Thread

import pytest

BROWSERS = ('chromium-headless-shell', 'chromium', 'chromium-browser', 'google-chrome')
"""The first found is used; that without windows takes a tenth less of the processor's time."""
BROWSER_OPTIONS = (
    '--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
    '--disable-features=WebUIOmniboxPopup,WebUIOmniboxAimPopup',
)  # fmt: skip
"""
Root needs ``--no-sandbox``; the next two draw WebGL without a GPU. The popups of the address bar
are pages of their own, which a window loads though nobody sees them: 1.5 s of processor time.
"""
EXECUTABLE = next(filter(None, map(shutil.which, BROWSERS)), None)
READY = 'html[data-ready]'
PATIENCE = 120.0  # [s]; pages are slow on a busy machine
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


_shared = ExitStack()
_running = []


def shared_browser():
    """Return the browser of modules that follow each other: its start takes 1.4 s of CPU."""
    if not _running:
        # What emulates a GPU draws WebGL alone: half a second of processor time less a page.
        _running.append(_shared.enter_context(launched('--disable-gpu-compositing')))
    return _running[0]


def end_shared_browser():
    """End it, where it was started."""
    _running.clear()
    _shared.close()


@contextmanager
def serving(server, joins=False):
    """Run a server in a thread; yield it, and end it afterwards; with `joins`, wait for that."""
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        if joins:
            thread.join()


@contextmanager
def opened_page(url, expected='', ready=READY, **context):
    """
    Yield a page in a context of its own, ready.

    It fails for errors on its console but one `expected`.

    """
    errors = []
    # Tests evaluate text on the page, which its policy forbids.
    usual = {'viewport': {'width': 1366, 'height': 800}, 'bypass_csp': True}
    with shared_browser().new_context(**{**usual, **context}) as opened:
        opened.set_default_timeout(1e3 * PATIENCE)
        page = opened.new_page()
        page.on('console', lambda line: errors.append(line.text) if line.type == 'error' else None)
        page.on('pageerror', lambda error: errors.append(str(error)))
        page.goto(url)
        page.wait_for_selector(ready)
        yield page
    unexpected = [line for line in errors if not expected or expected not in line]
    assert not unexpected, unexpected


def other_page(page, url, ready=READY):
    """Return the page of another person, in a context of its own, ready."""
    page = page.context.browser.new_page(bypass_csp=True)
    page.set_default_timeout(1e3 * PATIENCE)
    page.goto(url)
    page.wait_for_selector(ready)
    return page


def show_charts(page):
    """Scroll to the charts of the open track, which are drawn then, and back."""
    page.locator('#charts').scroll_into_view_if_needed()
    page.wait_for_function("view.charts && !$('cursor').hidden")
    page.locator('#title').scroll_into_view_if_needed()


def press(page, key, until, **options):
    """Press a key, and wait until an expression holds on the page."""
    page.keyboard.press(key)
    page.wait_for_function(until, **options)


def open_box(page, track_id, row):
    """Open a box of a track, with the focus in the views."""
    page.evaluate(f"openTrack(TRACKS.findIndex(t => t.id === '{track_id}'), null, {row})")
    page.wait_for_function(f"view.part && current().id === '{track_id}'")
    page.locator('#top').focus()


def answer(page, text):
    """Give the text that the page asks for."""
    page.wait_for_selector('#ask[open]')
    page.fill('#ask-text', text)
    page.keyboard.press('Enter')
    page.wait_for_selector('#ask[open]', state='detached')

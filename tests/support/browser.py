"""A real browser for tests of pages: Chromium, driven by playwright. Where it is missing, the test says what to install."""

import importlib.util
import shutil
from contextlib import contextmanager

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@contextmanager
def launched():
    """Yield a browser."""
    assert importlib.util.find_spec("playwright"), (
        "playwright is needed: pip install -e '.[build,test]', then test again"
    )
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, NAMES)), None)
    assert program, "a browser is needed: install chromium (apt-get install chromium), then run this test again"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@contextmanager
def opened(file, size=(1100, 900), scheme="light", **options):
    """Open a page from the disk; what it says in the console, and what it asks for, must be nothing."""
    said, asked, url = [], [], file.as_uri()
    with launched() as browser:
        viewport = dict(zip(("width", "height"), size, strict=True))
        page = browser.new_context(viewport=viewport, color_scheme=scheme, **options).new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(url)
        yield page
    assert said == []
    assert [one for one in asked if one != url and not one.startswith(("data:", "blob:"))] == []

"""The documentation's site: links between pages, and the site itself, without warnings and without a network."""

import os
import posixpath
import re
import shutil
import subprocess
import sys
import urllib.parse
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [*(ROOT / "docs").rglob("*.md"), *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md"))]
)


def anchors(page):
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_a_page_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    wrong = []
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", text):
        if urllib.parse.urlsplit(target).scheme:
            continue
        file = (page.parent / target) if target else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            wrong.append(f"{target}#{anchor}")
    assert not wrong


NAMED = r"(blocks|fmus|diagrams|front|docs|tests|benchmarks|notebooks|install)/[A-Za-z0-9_./]+\.(py|pyi|md|ipynb|png|svg|c|h|toml)"
"""A file of ours that a text names."""

NO_FILE = re.compile(r"tests/x/|/out/")
"""Names of examples, and of files that are made."""


def test_files_that_pages_code_and_notebooks_name_exist():
    command = ["git", "grep", "-ohP", rf"(?<![\w/.}}>]){NAMED}\b", "--", ".", ":!CHANGELOG.md"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    named = {name for name in done.stdout.split() if not NO_FILE.search(name)}
    assert len(named) > 100
    assert not sorted(name for name in named if not (ROOT / name).exists())


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "build.py", folder],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.slow
def test_the_site_asks_nothing_of_a_network(site):
    asked = [
        (page.relative_to(site).as_posix(), found)
        for page in site.rglob("*.html")
        for found in re.findall(
            r"<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)=[\"'](?:https?:)?//[^\"']*",
            page.read_text(encoding="utf-8"),
        )
    ]
    asked += [
        (sheet.relative_to(site).as_posix(), found)
        for sheet in site.rglob("*.css")
        for found in re.findall(
            r"(?:url\(|@import\s)\s*[\"']?(?:https?:)?//[^)\"']*", sheet.read_text(encoding="utf-8")
        )
    ]
    assert not asked


@pytest.mark.slow
def test_every_block_of_the_library_shows_its_response(site):
    page = (ROOT / "docs" / "reference" / "blocks.md").read_text(encoding="utf-8")
    names = set(re.findall(r"(?m)^\| `(\w+)` \| \w+ \| .* \|$", page)) - {"PathTracking"}  # a base of blocks
    assert len(names) > 60
    pages = {name: (site / "reference" / "blocks" / f"{name}.html").read_text(encoding="utf-8") for name in names}
    assert not [name for name, text in pages.items() if f"Response of {name} " not in text]


USEFUL = {
    "scope": "howto/plots",
    "mux": "howto/formulas",
    "demux": "reference/blocks/Demux",
    "goto": "howto/from_simulink",
    "gain": "reference/blocks/Gain",
    "transfer function": "reference/blocks/TransferFunction",
    "PID": "reference/blocks/PID",
    "anti-windup": "howto/anti_windup",
    "rate transition": "howto/from_simulink",
    "zero-order hold": "reference/blocks/Hold",
    "dead time": "howto/dead_time",
    "lookup table": "reference/blocks/Lookup1D",
    "algebraic loop": "howto/algebraic_loop",
    "solver": "howto/choose_a_solver",
    "sample time": "explanation/time",
    "linearize": "tutorial/margins",
    "bode": "tutorial/margins",
    "phase margin": "howto/frequency",
    "root locus": "howto/frequency",
    "step info": "reference/classes/Run",
    "overshoot": "howto/plots",
    "FMU": "tutorial/fmu",
    "co-simulation": "tutorial/fmu",
    "code generation": "howto/c_for_a_target",
    "S-function": "howto/from_simulink",
}
"""Words that users of other tools type, and a page that answers them."""


@contextmanager
def browser_window(width):
    """Yield an empty page of a real browser."""
    from playwright.sync_api import sync_playwright  # in the extra `test`

    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert program, "a browser is needed: install chromium (apt-get install chromium), then run this test again"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield browser.new_page(viewport={"width": width, "height": 800})
        browser.close()


@pytest.mark.slow
def test_the_search_lists_a_useful_page_among_the_first_three(site):
    missed = {}
    with browser_window(1100) as window:
        for words, page in USEFUL.items():
            window.goto(f"{(site / 'search.html').as_uri()}?q={urllib.parse.quote(words)}")
            window.wait_for_function(
                "document.querySelector('#search-results > .search-summary')?.innerText.match(/\\d/)"
            )
            found = window.eval_on_selector_all("ul.search li a", "links => links.slice(0, 3).map(link => link.href)")
            if not any(f"/{page}.html" in link for link in found):
                missed[words] = found
    assert not missed


WIDER = """() => {
    const width = document.documentElement.clientWidth;
    const scrolled = element => element && element !== document.body
        && (['auto', 'scroll', 'hidden'].includes(getComputedStyle(element).overflowX) || scrolled(element.parentElement));
    return [...document.querySelectorAll('article *')]
        .filter(element => element.getBoundingClientRect().right > width + 1 && !scrolled(element))
        .map(element => element.tagName + ': ' + element.textContent.slice(0, 40))
        .concat([...document.images].filter(image => image.complete && !image.naturalWidth).map(image => image.src));
}"""
"""What sticks out of a page at the right, and images that are missing."""


@pytest.mark.slow
@pytest.mark.parametrize("width", [1100, 390])
def test_pages_fit_a_window_and_a_phone(site, width):
    pages = [page for page in site.rglob("*.html") if "reference/blocks/" not in page.as_posix() or "PID" in page.name]
    with browser_window(width) as window:
        wide = {}
        for page in pages:
            window.goto(page.as_uri(), wait_until="load")
            if found := window.evaluate(WIDER):
                wide[page.relative_to(site).as_posix()] = found[:3]
    assert not wide


@pytest.mark.slow
def test_links_of_the_site_lead_somewhere(site):
    ids = {
        page.relative_to(site).as_posix(): set(re.findall(r"\bid=\"([^\"]+)\"", page.read_text(encoding="utf-8")))
        for page in site.rglob("*.html")
    }
    assert len(ids) > 15
    wrong = []
    for page in ids:
        for target in re.findall(r"<a\b[^>]*?href=\"([^\"]*)\"", (site / page).read_text(encoding="utf-8")):
            parts = urllib.parse.urlsplit(target)
            if parts.scheme or not (parts.path or parts.fragment):
                continue
            full = posixpath.normpath(posixpath.join(posixpath.dirname(page), urllib.parse.unquote(parts.path)))
            full = full if parts.path else page
            if not (site / full).is_file() or (
                parts.fragment and parts.fragment not in ids.get(full, {parts.fragment})
            ):
                wrong.append((page, target))
    assert not wrong

"""The documentation's site: links between pages, and the site itself, without warnings and without a network."""

import json
import os
import posixpath
import re
import subprocess
import sys
import urllib.parse
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


def test_pages_that_code_and_notebooks_name_exist():
    done = subprocess.run(
        ["git", "grep", "-ohE", r"docs/[a-z_/]+\.(md|py|png)"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    named = set(done.stdout.split())
    assert len(named) > 10
    assert not [name for name in named if not (ROOT / name).exists()]


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
    "scope": "howto/from_simulink",
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
    "lookup table": "howto/from_simulink",
    "algebraic loop": "howto/algebraic_loop",
    "solver": "howto/choose_a_solver",
    "sample time": "explanation/time",
    "linearize": "tutorial/margins",
    "bode": "tutorial/margins",
    "phase margin": "howto/frequency",
    "root locus": "howto/frequency",
    "step info": "howto/plots",
    "overshoot": "howto/plots",
    "FMU": "tutorial/fmu",
    "co-simulation": "reference/fmus",
    "S-function": "howto/from_simulink",
}
"""Words that users of other tools type, and a page that answers them."""


@pytest.mark.slow
def test_the_search_finds_a_useful_page(site):
    from sphinx.search.en import SearchEnglish

    script = (site / "searchindex.js").read_text(encoding="utf-8")
    index = json.loads(script[script.index("{") : script.rindex("}") + 1])
    language = SearchEnglish({})

    def pages_with(word):
        stem, found = language.stem(word.lower()), set()
        for terms in (index["terms"], index["titleterms"]):
            numbers = terms.get(stem, [])
            found |= {numbers} if isinstance(numbers, int) else {*numbers}
        return {index["docnames"][number] for number in found}

    missed = {}
    for words, page in USEFUL.items():
        asked = [word for word in re.split(r"[^\w]+", words) if len(word) > 1]
        found = set.intersection(*map(pages_with, asked))
        if page not in found:
            missed[words] = sorted(found)
    assert not missed


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

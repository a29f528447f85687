"""Build the documentation's site: python docs/build.py [FOLDER], by default out/site; FOLDER/index.html opens it.

Pages, notebooks and generated pages of the reference are staged in a temporary folder, which Sphinx then reads. Every
warning is an error. Nothing is asked of a network, neither here nor by the pages.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import posixpath
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
_NO_SEARCH = "---\nnosearch: true\n---\n\n"  # the changelog has every word
LINK = re.compile(r"(?<=\]\()([^)#\s:]+)(?=[)#])")


def _on_site(path: str) -> str:
    """Return where a file of the repository is on the site, whose root is docs/."""
    return "." if path == "docs" else path.removeprefix("docs/")


def _restaged(page: Path, text: str) -> str:
    """Change the links of a page to files outside docs/, and from there into it."""
    folder = page.parent.relative_to(ROOT).as_posix()

    def change(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[0]))
        return posixpath.relpath(_on_site(target), _on_site(folder))

    return LINK.sub(change, text)


def _staged_text(page: Path) -> str:
    """Return the text of a page, or of a notebook with its live drawings."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    from notebooks import with_live_drawings

    notebook = json.loads(text)
    for cell in notebook["cells"]:
        with_live_drawings(cell.get("outputs", []))
    return json.dumps(notebook, ensure_ascii=False, indent=1)


def stage(folder: Path) -> None:
    """Write all sources of the site into a folder."""
    pages = [
        *HERE.rglob("*.md"),
        *(ROOT / "notebooks").glob("*.ipynb"),
        ROOT / "CHANGELOG.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "benchmarks" / "README.md",
    ]
    for page in pages:
        place = folder / page.relative_to(HERE if HERE in page.parents else ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        head = _NO_SEARCH if page.name == "CHANGELOG.md" else ""
        place.write_text(head + _restaged(page, _staged_text(page)), encoding="utf-8")
    for pictures in (HERE / "images", ROOT / "benchmarks" / "images"):
        shutil.copytree(pictures, folder / pictures.relative_to(HERE if HERE in pictures.parents else ROOT))


def write_made_pages(folder: Path) -> None:
    """Write the pages that are made of the package and of the notebooks."""
    sys.path.insert(0, str(HERE / "site"))
    import facts
    import gallery
    import names
    import responses

    gallery.write(folder)
    folder = folder / "reference"

    facts.write(folder)
    names.write(folder, responses.draw_all(folder / "responses"))


def build(folder: Path) -> int:
    """Build the site in a folder, and return Sphinx's exit status: 0 where there was no warning."""
    from sphinx.cmd.build import main as sphinx

    with tempfile.TemporaryDirectory() as temporary:
        sources, trees = Path(temporary) / "pages", Path(temporary) / "trees"
        started = time.monotonic()

        def say(doing: str) -> None:
            print(f"{time.monotonic() - started:6.1f} s  {doing}", file=sys.stderr, flush=True)

        say("pages and notebooks")
        stage(sources)
        say("gallery, facts and responses of blocks")
        write_made_pages(sources)
        say("Sphinx: about a minute of processor time; warnings follow")
        options = ["-W", "--keep-going", "-q", "-j", "auto", "-d", str(trees), "-c", str(HERE / "site")]
        status = sphinx([*options, str(sources), str(folder)])
        for process in multiprocessing.active_children():  # of a build that broke off: they wait for a reader
            process.terminate()
        say("done" if status == 0 else "there were warnings")
        return status


def main() -> int:
    """Parse the command line, and build."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "out" / "site", help="where the site goes")
    folder = parser.parse_args().folder
    status = build(folder)
    if status == 0:
        print(f"{folder / 'index.html'}")
    return status


if __name__ == "__main__":
    sys.exit(main())

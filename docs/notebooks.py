"""Execute notebooks and save them with their outputs of today: python docs/notebooks.py [NAME ...], all without one.

Progress, which is shown where a run takes over two seconds, is left out. A live drawing is saved as its picture, which
GitHub shows (it strips scripts and styles); the live one is in the output's metadata, from where the site takes it.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import nbformat

LIVE = "loopwright_live"
"""Key of a live drawing in the metadata of its output."""
FOLDER = Path(__file__).parent.parent / "notebooks"


def without_progress(outputs: list[Any]) -> list[Any]:
    """Return the outputs of a cell without those of progress bars; texts that these have parted are one again."""
    kept: list[Any] = []
    for output in outputs:
        data = output.get("data", {})
        text = "".join(data.get("text/plain", "x"))
        is_progress = any("widget" in kind for kind in data) or not text.strip() or "━" in text
        last = kept[-1] if kept else {}
        if is_progress:
            continue
        if output["output_type"] == "stream" == last.get("output_type") and output["name"] == last["name"]:
            last["text"] += output["text"]
        else:
            kept.append(output)
    return kept


def with_pictures(outputs: list[Any]) -> list[Any]:
    """Move live drawings into the metadata of their outputs, which leaves their pictures."""
    for output in outputs:
        if "image/svg+xml" in output.get("data", {}) and "text/html" in output["data"]:
            output["metadata"][LIVE] = output["data"].pop("text/html")
    return outputs


def with_live_drawings(outputs: list[Any]) -> list[Any]:
    """Move live drawings back; the other way round than `with_pictures`."""
    for output in outputs:
        if LIVE in output.get("metadata", {}):
            output["data"]["text/html"] = output["metadata"].pop(LIVE)
    return outputs


def execute(path: Path) -> None:
    """Execute a notebook, and save it."""
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(path.parent)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # the times
        if cell.cell_type == "code":
            cell.outputs = with_pictures(without_progress(cell.outputs))
    nbformat.write(notebook, path)


def main() -> int:
    """Parse the command line, and execute."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="such as 01_first_loop")
    names = parser.parse_args().names
    for path in [FOLDER / f"{name}.ipynb" for name in names] or sorted(FOLDER.glob("*.ipynb")):
        began = time.monotonic()
        execute(path)
        print(f"{path.stem}: {time.monotonic() - began:.0f} s", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The gallery: a picture, a title and the question of each notebook."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import nbformat

_ENTRY = """
## [{title}](notebooks/{name}.ipynb)

{question}

[![Figure of the notebook {title}](notebooks/{name}.png)](notebooks/{name}.ipynb)
"""

_PAGES = """
```{{toctree}}
:hidden:

{names}
```
"""


def _picture(notebook: nbformat.NotebookNode) -> bytes:
    """Return the picture of a notebook: that of the cell with the tag "gallery", else its largest one."""
    found: list[tuple[bool, int, bytes]] = []
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            picture = output.get("data", {}).get("image/png")
            if picture:
                made = base64.b64decode(picture)
                found.append(("gallery" in cell.metadata.get("tags", ()), len(made), made))
    return max(found)[2]


def write(folder: Path) -> None:
    """Write the entries of all staged notebooks to the end of the gallery's page, and their pictures next to them."""
    page, names = folder / "gallery.md", []
    text = page.read_text(encoding="utf-8")
    for file in sorted((folder / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(file, as_version=4)
        introduction = notebook.cells[0].source
        title = re.search(r"^# (.+)$", introduction, re.MULTILINE)
        question = re.search(r"\*\*Question:\*\*\s*(.+?)(?:\n\n|\Z)", introduction, re.DOTALL)
        asked = " ".join(question[1].split()) if question else ""
        file.with_suffix(".png").write_bytes(_picture(notebook))
        text += _ENTRY.format(
            title=title[1] if title else file.stem, name=file.stem, question=asked[:1].upper() + asked[1:]
        )
        names.append(f"notebooks/{file.stem}")
    page.write_text(text + _PAGES.format(names="\n".join(names)), encoding="utf-8")

"""Prints a table of all sub-packages: files, lines, and names that others may use. Run it from anywhere.

Lines are those of the files, with docstrings, comments and blanks; "code" is without them. Names are those that the
package's interface lists: its neighbours import nothing else of it.
"""

import ast
import io
import tokenize
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = ("front", "blocks", "fmus", "diagrams", "install")
NOT_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def count_code(text):
    """Return how many lines of a Python text hold code: no docstring, no comment, no blank."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    described = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            described.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {line for t in tokens if t.type not in NOT_CODE for line in range(t.start[0], t.end[0] + 1)}
    return len(lines - described)


def names_outside(folder):
    """Return how many names a package's interface has."""
    stub, interface = folder / "__init__.pyi", folder / "__init__.py"
    file = stub if stub.is_file() else interface
    if not file.is_file():
        return 0
    imports = (n for n in ast.parse(file.read_text(encoding="utf-8")).body if isinstance(n, ast.ImportFrom))
    return len({alias.asname or alias.name for n in imports for alias in n.names if n.module != "__future__"})


def measure(folder):
    """Return what a folder's own files have: files, lines of Python, its code, lines of C, names outside."""
    python = [
        file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.py*")) if file.suffix in {".py", ".pyi"}
    ]
    c = [file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.[ch]"))]
    lines = [sum(len(text.splitlines()) for text in texts) for texts in (python, c)]
    return len(python) + len(c), lines[0], sum(map(count_code, python)), lines[1], names_outside(folder)


def list_folders(rooms=ROOMS):
    """Return the folders that may have code."""
    folders = [folder for room in rooms for folder in (ROOT / room, *sorted((ROOT / room).rglob("*/")))]
    return [folder for folder in folders if "." not in folder.name]


def table(rooms=ROOMS):
    """Return a row for each sub-package that has code, by its folder, and one for all."""
    rows = {str(folder.relative_to(ROOT)): measure(folder) for folder in list_folders(rooms)}
    rows = {name: row for name, row in rows.items() if row[0]}
    return {**rows, "all": tuple(map(sum, zip(*rows.values(), strict=True)))}


def main():
    """Print the table."""
    print(f"{'sub-package':26} {'files':>6} {'Python':>8} {'code':>8} {'C':>7} {'names':>6}")
    for name, (files, python, code, c, names) in table().items():
        print(f"{name:26} {files:6} {python:8} {code:8} {c:7} {names:6}")


if __name__ == "__main__":
    main()

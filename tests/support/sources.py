"""Source files as trees of syntax, each parsed once for all tests that read them."""

import ast
import gc
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
ROOMS = ("blocks", "fmus", "diagrams", "front")  # the last is the package `loopwright` itself
SOURCES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))


@cache
def nodes_of(path):
    """Return the nodes of a file by their class, those of each class in the order of `ast.walk`.

    Garbage isn't collected meanwhile: the trees stay, and to look through them again and again would take most of the time.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        found = defaultdict(list)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found[type(node)].append(node)
        return found
    finally:
        if enabled:
            gc.enable()


def find_nodes(path, *kinds):
    """Return a file's nodes of some classes."""
    found = nodes_of(path)
    return [node for kind in kinds for node in found.get(kind, ())]

"""Cycles of wires."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np


def find_cyclic_parts(keys: Sequence[str], pairs: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Return the strongly connected parts of a graph that have a cycle, in the order of their first nodes."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    place = {key: i for i, key in enumerate(keys)}
    edges = sorted(
        {(place[a], place[b]) for a, b in pairs}
    )  # each once: SciPy 1.13.0 is wrong or hangs with repeated ones
    if not edges:
        return []
    rows, columns = zip(*edges, strict=True)
    graph = csr_matrix((np.ones(len(edges)), (rows, columns)), shape=(len(place), len(place)))
    _, labels = connected_components(graph, directed=True, connection="strong")
    own = {a for a, b in edges if a == b}
    parts: dict[int, set[str]] = {}
    for key, i in place.items():
        parts.setdefault(int(labels[i]), set()).add(key)
    return [part for part in parts.values() if len(part) > 1 or place[min(part)] in own]

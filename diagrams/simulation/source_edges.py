"""Discontinuities of sources ahead of a run, which the loop in C lands on."""

from __future__ import annotations

import math

import numpy as np

from .continuous import Continuous
from .solver_setup import next_instant

_MOST_EDGES = 100_000  # in a call


def find_edges(
    continuous: Continuous, t: float, end: float, *, limited: bool = True
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the discontinuities of sources from t to the first of each after the end; None if they are too many."""
    found = set[float]()
    for path, source in continuous.sources:
        edge = t
        while edge <= end and (edge := next_instant(path, source, edge)) < math.inf:
            found.add(edge)
            if limited and len(found) > _MOST_EDGES:
                return None
    if t in continuous.late:
        found.add(t)
    edges = np.array(sorted(found))
    return edges, np.array([continuous.late.get(float(edge), float(edge)) for edge in edges])


class EdgesAhead:
    """Discontinuities of sources, found once for a stretch of ticks, in however many calls C goes through it."""

    def __init__(self, continuous: Continuous):
        self._continuous = continuous
        self._begin, self._end = math.inf, -math.inf
        self._found = np.zeros(0), np.zeros(0)

    def until(self, t: float, end: float, *, limited: bool) -> tuple[np.ndarray, np.ndarray] | None:
        """Return those from t on, up to an end and the first one of each source after it; see `find_edges`."""
        if t < self._begin or end > self._end:
            found = find_edges(self._continuous, t, end, limited=limited)
            if found is None:
                return None
            self._begin, self._end, self._found = t, end, found
        edges, late = self._found
        first = int(np.searchsorted(edges, t, side="left" if t in self._continuous.late else "right"))
        return edges[first:], late[first:]

"""Discontinuities of sources as numbers: those that end, and those that repeat without end."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...blocks.core import DefinitionError
from ..flat import Announcer
from ..simulation import find_late, next_instant
from .open_diagram import OpenDiagram

_MOST, _LISTED = 4000, 600
"""Discontinuities that a source may have before it ends; and those of one without end, by which its period is known."""
_PHASES = 8  # discontinuities in a period, at most
_SAME = 1e-9  # of a period

Edges = tuple[tuple[float, float], ...]


def find_edges(opened: OpenDiagram, sources: Sequence[tuple[str, Announcer]]) -> tuple[Edges, Edges]:
    """Return discontinuities of sources, each with the time at which it is seen there; and first ones with periods.

    Raises `DefinitionError`: for a source with very many of them that don't repeat.
    """
    late = find_late(sources)
    single, periodic = set[float](), list[tuple[float, float]]()
    for path, source in sources:
        found: list[float] = []
        t = -1e-300  # an instant at 0 is one
        while len(found) < _MOST and (t := next_instant(path, source, t)) < math.inf:
            found.append(t)
            if len(found) == _LISTED and (repeats := _find_period(found)) is not None:
                periodic += repeats
                break
        else:
            if len(found) == _MOST:
                raise DefinitionError(
                    f"it has more than {_MOST} discontinuities, which don't repeat; so many are not exported. Put it "
                    "into a sampled subsystem, or leave it outside: outside=….",
                    block=path,
                )
            single.update(found)
    return tuple((t, late.get(t, t)) for t in sorted(single)), tuple(periodic)


def _find_period(times: list[float]) -> list[tuple[float, float]] | None:
    """Return the first discontinuities with their period; None if they don't repeat from the first one on."""
    for phases in range(1, _PHASES + 1):
        whole = (len(times) - 1) // phases
        period = (times[whole * phases] - times[0]) / whole
        expected = (times[i % phases] + (i // phases) * period for i in range(len(times)))
        if all(abs(a - b) <= _SAME * period for a, b in zip(times, expected, strict=True)):
            return [(times[i], period) for i in range(phases)]
    return None

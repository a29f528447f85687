"""Instants that a solver lands on: those that sources announce, and those that are read from blocks on a clock.

A table that reads a `Clock`, and a block whose equations compare the time, switch at times that are known beforehand. A
solver of variable step would step over a short pulse between them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import Block, Constant, Gain, Sum, move_earlier, right_of
from ...blocks.library import Clock
from ...blocks.tracing import Line, size, switching_times
from ..flat import FlatDiagram


class Announcer(Protocol):
    """Whatever knows the next instant at which a block is not smooth in time."""

    def next_instant(self, t: float) -> float:
        """Return the first one after t, in s; infinity if there is none."""


class Times:
    """Instants that are known from the start.

    Parameters
    ----------
    times : mapping
        The instants in s, each with whether the block still has the value from before at the instant itself.
    """

    def __init__(self, times: Mapping[float, bool]):
        self.times = sorted(times)
        self.late = {t: right_of(t) for t, is_late in times.items() if is_late}
        """The instants with the value from before, each with a time just after, at which it has the value from then."""
        self._from = [float(move_earlier(np.float64(t))) for t in self.times]

    def next_instant(self, t: float) -> float:
        """Return the first instant after t; one that differs from t by rounding is not after it."""
        i = bisect_right(self._from, t)
        return self.times[i] if i < len(self.times) else math.inf


_KNOWN: WeakKeyDictionary[FlatDiagram, list[tuple[str, Announcer]]] = WeakKeyDictionary()


def announcers(flat: FlatDiagram) -> list[tuple[str, Announcer]]:
    """Return the blocks in continuous time that are not smooth at known instants, by path, with those instants."""
    if flat not in _KNOWN:
        _KNOWN[flat] = _find_announcers(flat)
    return _KNOWN[flat]


def _find_announcers(flat: FlatDiagram) -> list[tuple[str, Announcer]]:
    found: list[tuple[str, Announcer]] = []
    for path in sorted(flat.checked.traced):
        block = flat.table.blocks[path]
        if flat.table.is_sampled(flat.table.subsystem_of[path]):
            continue
        if type(block).next_instant is not Block.next_instant:
            found.append((path, block))
        elif not block.opaque and (times := dict(_times_of(flat, path))):
            found.append((path, Times(times)))
    return found


def _times_of(flat: FlatDiagram, path: str) -> Iterator[tuple[float, bool]]:
    """Yield the times at which a block without instants of its own is not smooth; see `Times`."""
    block, traced = flat.table.blocks[path], flat.checked.traced[path]
    lines = {name: line for name in traced.inputs if (line := _line_at(flat, path, name)) is not None}
    moving = {name: line for name, line in lines.items() if np.any(line[1])}
    for name, values in block.input_breaks().items():
        if name in moving:
            for start, slope in zip(*moving[name], strict=True):
                yield from ((float(t), False) for t in (np.ravel(values) - start) / slope) if slope else ()
    if moving or any("t" in depends for depends in traced.depends.values()):
        yield from switching_times(traced, flat.p[flat.parameters.slices[path]], lines).items()


def _line_at(flat: FlatDiagram, path: str, port: str, behind: frozenset[str] = frozenset()) -> Line | None:
    """Return the signal at an input if it is a straight line in time: of a clock, with gains, sums and constants.

    ``behind`` holds the blocks that lead here: one that comes again is in an algebraic loop.
    """
    wire = flat.table.wires.get((path, port))
    if wire is None or wire.block in behind:
        return None
    behind |= {wire.block}
    source = flat.table.blocks[wire.block]
    shape = flat.checked.shapes.get((wire.block, wire.port))
    if shape is None or flat.table.is_sampled(flat.table.subsystem_of[wire.block]):
        return None
    line: Line | None = None
    if isinstance(source, Clock):
        line = np.zeros(1), np.ones(1)
    elif isinstance(source, Constant):
        value = np.ravel(np.asarray(source.value, dtype=float))
        line = value, np.zeros(value.size)
    elif isinstance(source, Gain) and np.ndim(source.gain) < 2:
        inner = _line_at(flat, wire.block, "u", behind)
        if inner is not None:
            line = np.ravel(source.gain * inner[0]), np.ravel(source.gain * inner[1])
    elif isinstance(source, Sum):
        inners = [_line_at(flat, wire.block, name, behind) for name in source.inputs]
        signs = [1.0 if sign == "+" else -1.0 for sign in source.signs]
        known = [(s * i[0], s * i[1]) for s, i in zip(signs, inners, strict=True) if i is not None]
        if len(known) == len(inners):
            line = sum(k[0] for k in known) + np.zeros(size(shape)), sum(k[1] for k in known) + np.zeros(size(shape))
    if line is None or line[0].size != size(shape):
        return None
    if wire.index is None:
        return line
    index = np.ravel(np.arange(size(shape)).reshape(shape)[wire.index])
    return line[0][index], line[1][index]

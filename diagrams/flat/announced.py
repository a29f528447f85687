"""Instants that a solver lands on: those that sources announce, and those that are read from blocks on a clock.

A table that reads a `Clock`, and a block whose equations compare the time, switch at times that are known beforehand. A
solver of variable step would step over a short pulse between them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import Block, Constant, Gain, Sum, move_earlier, right_of
from ...blocks.library import Clock
from ...blocks.tracing import Line, size, switching_times
from .flat_diagram import FlatDiagram


class Times:
    """Known instants in s, each with whether the block still has the value from before at the instant itself."""

    def __init__(self, times: Mapping[float, bool]):
        self.times = sorted(times)
        self.late = {t: right_of(t) for t, is_late in times.items() if is_late}
        """The instants with the value from before, each with a time just after, at which it has the value from then."""
        self._from = [float(move_earlier(np.float64(t))) for t in self.times]

    def next_instant(self, t: float) -> float:
        """Return the first instant after t; one that differs from t by rounding is not after it."""
        i = bisect_right(self._from, t)
        return self.times[i] if i < len(self.times) else math.inf


Announcer = Block | Times
"""Source of instants at which a block is not smooth in time: the block itself, or instants known from the start."""

_KNOWN: WeakKeyDictionary[FlatDiagram, list[tuple[str, Announcer]]] = WeakKeyDictionary()


def announcers(flat: FlatDiagram) -> list[tuple[str, Announcer]]:
    """Return the blocks in continuous time that are not smooth at known instants, by path, with those instants."""
    if flat not in _KNOWN:
        _KNOWN[flat] = _find_announcers(flat)
    return _KNOWN[flat]


def _find_announcers(flat: FlatDiagram) -> list[tuple[str, Announcer]]:
    found: list[tuple[str, Announcer]] = []
    known: Lines = {}
    for path in sorted(flat.checked.traced):
        block = flat.table.blocks[path]
        if flat.table.is_sampled(flat.table.subsystem_of[path]):
            continue
        if type(block).next_instant is not Block.next_instant:
            found.append((path, block))
        elif not block.opaque and (times := dict(_times_of(flat, path, known))):
            found.append((path, Times(times)))
    return found


def _times_of(flat: FlatDiagram, path: str, known: Lines) -> Iterator[tuple[float, bool]]:
    """Yield the times at which a block without its own instants is not smooth; see `Times`."""
    block, traced = flat.table.blocks[path], flat.checked.traced[path]
    lines = {name: line for name in traced.inputs if (line := _line_at(flat, path, name, known)) is not None}
    moving = {name: line for name, line in lines.items() if np.any(line[1])}
    for name, values in block.input_breaks().items():
        if name in moving:
            for start, slope in zip(*moving[name], strict=True):
                yield from ((float(t), False) for t in (np.ravel(values) - start) / slope) if slope else ()
    if moving or any("t" in depends for depends in traced.depends.values()):
        yield from switching_times(traced, flat.p[flat.parameters.slices[path]], lines).items()


Lines = dict[str, Line | None]
"""By path, whether the output of a block is a straight line in time; None where it is not, or is not known yet."""


def _line_at(flat: FlatDiagram, path: str, port: str, known: Lines) -> Line | None:
    """Return the signal at an input if it is a straight line in time: of a clock, with gains, sums and constants."""
    wire = flat.table.wires.get((path, port))
    if wire is None or flat.table.is_sampled(flat.table.subsystem_of[wire.block]):
        return None
    if wire.block not in known:
        known[wire.block] = None  # until it is known: a block that comes again is in an algebraic loop
        known[wire.block] = _line_of(flat, wire.block, known)
    line, shape = known[wire.block], flat.checked.shapes.get((wire.block, wire.port))
    if line is None or shape is None or line[0].size != size(shape):
        return None
    if wire.index is None:
        return line
    index = np.ravel(wire.entries(shape))
    return line[0][index], line[1][index]


def _line_of(flat: FlatDiagram, path: str, known: Lines) -> Line | None:
    """Return the output of a clock, a constant, a gain or a sum if it is a straight line in time."""
    block = flat.table.blocks[path]
    if isinstance(block, Clock):
        return np.zeros(1), np.ones(1)
    if isinstance(block, Constant):
        value = np.ravel(np.asarray(block.value, dtype=float))
        return value, np.zeros(value.size)
    if isinstance(block, Gain) and np.ndim(block.gain) < 2:
        inner = _line_at(flat, path, "u", known)
        return None if inner is None else (np.ravel(block.gain * inner[0]), np.ravel(block.gain * inner[1]))
    if isinstance(block, Sum):
        start, slope = np.zeros(1), np.zeros(1)
        for sign, name in zip(block.signs, block.inputs, strict=True):
            inner = _line_at(flat, path, name, known)
            if inner is None:
                return None
            factor = 1.0 if sign == "+" else -1.0
            start, slope = start + factor * inner[0], slope + factor * inner[1]
        return start, slope
    return None

"""Search for points at which a linear model says little: kinks, jumps, stairs, and slopes of zero.

Every block whose equations are not linear is looked at, at the values of its states and inputs, one entry after the
other. Three things are found:

- *stairs*: an output that depends on an input with a slope that is zero everywhere, or by events only. Of those that
  don't come from rounding, such as comparisons, only those whose steps lie within the nominal range;
- *kinks*: within 1e-6 of the point, relative to the nominal value, the exact slopes at both ends differ by more than
  the curvature between them explains, or the value jumps. A smooth function passes however steep it is;
- *zero slopes*: the slope is zero at the point, while the value changes from one end of the nominal range to the other,
  and the point is no extremum.

The nominal range of an entry is its port's ``nominal`` to both sides, or 1 + its size where none is declared. Blocks
that switch by events are looked at after the events that the change fires.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ...blocks.core import Block, Finding, Output, State
from ...fmus.calls import is_smooth
from ...fmus.fmu_block import Fmu
from ..flat import FlatDiagram, WiredDiagram, just_after
from ..results import OperatingPoint
from ..wiring import join
from .block_slopes import BlockSlopes, slopes_of
from .exchanged import evaluators_at
from .left_out_effects import EventsOnly, Kink, StepsOnly, ZeroSlope
from .operating_points import operating_point
from .plant_models import plant_paths
from .signal_paths import SignalPaths

NEAR = 1e-6
"""Distance within which a kink counts as at the point, relative to the nominal value."""
DIFFERENT = 1e-3
"""Relative difference of two slopes, beyond their curvature, that is a kink."""
HALVINGS = 16
"""Halvings of the interval around a kink that it must survive."""
NO_SLOPE = 1e-9
"""Share of a change over the nominal range up to which a slope that explains no more counts as zero."""
ASIDE = 1e-2
"""Distance to both sides, relative to the nominal value, at which an extremum is distinguished from a flat place."""
JUMP = 1e-9
"""Smallest jump and change that count, relative to 1 + the size of the value."""

Curved: TypeAlias = Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""From the distance along one column to the rows, their slopes and their curvatures."""


def find_kinks(flat: FlatDiagram, at: OperatingPoint) -> tuple[Finding, ...]:
    """Return the findings about all blocks at an operating point, by path."""
    found: list[Finding] = []
    log: np.ndarray | None = None
    for path in sorted(set(flat.checked.traced).difference(flat.in_model_exchange)):
        slopes = slopes_of(flat.checked.traced[path])
        wired = {f"u {port}" for port in slopes.inputs if (path, port) in flat.table.wires}
        if slopes.is_simple or not slopes.columns.total or not slopes.rows.total:
            continue
        if log is None:
            log = read_log(flat, at)
        found += _BlockAtPoint.of(flat, at, log, path, slopes, wired).find()
    return (*found, *_find_steps_of_plants(flat))


def _find_steps_of_plants(flat: FlatDiagram) -> Iterator[StepsOnly]:
    """Yield the ways through FMUs from or to a port of integers, which has no derivatives, and from discrete inputs."""
    for path in (*plant_paths(flat), *flat.in_model_exchange):
        block = flat.table.blocks[path]
        if not isinstance(block, Fmu):
            continue
        for port, source in product(block.output_variables, block.input_variables):
            if (path, source) not in flat.table.wires:
                continue
            if block.output_variables[port].is_integer or block.input_variables[source].is_integer:
                yield StepsOnly(path, port, source)
            elif path in flat.in_model_exchange and not is_smooth(block.input_variables[source]):
                yield EventsOnly(path, port, source)


def find_kinks_between(
    diagram: WiredDiagram,
    point: OperatingPoint | None,
    sources: Iterable[tuple[str, str]],
    sinks: Iterable[tuple[str, str]],
) -> tuple[Finding, ...]:
    """Return the findings at a point, the start without one, on loops and on the ways from ports to ports."""
    at = operating_point(diagram, point, {})
    flat = diagram.flatten_like(at)
    ways, found = SignalPaths(flat), find_kinks(flat, at)
    return tuple(dict.fromkeys((*ways.between(found, sources, sinks), *ways.on_loops(found))))


def read_log(flat: FlatDiagram, at: OperatingPoint) -> np.ndarray:
    """Return all outputs at an operating point, as if every clock ticked."""
    tick = flat.at_tick(frozenset(flat.clocks.values()))
    return tick(at.t, at.x, at.w, flat.p, evaluators=evaluators_at(flat, at))[2]


def read_arguments(
    flat: FlatDiagram, at: OperatingPoint, path: str, slopes: BlockSlopes, log: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the states and inputs z of a block at an operating point, and its parameters."""
    log = read_log(flat, at) if log is None else log
    parts = [at.x[flat.states.slices[path]]]
    for name in slopes.inputs:
        wire = flat.table.wires.get((path, name))
        if wire is None:
            parts.append(np.ravel(np.asarray(flat.table.blocks[path].inputs[name].default, dtype=float)))
            continue
        full = join(wire.block, wire.port)
        value = log[flat.log.slices[full]].reshape(flat.log.shapes[full])
        parts.append(np.ravel(value if wire.index is None else value[wire.index]))
    return np.concatenate(parts), flat.p[flat.parameters.slices[path]]


@dataclass(frozen=True, eq=False)
class _BlockAtPoint:
    """A block with the values of its states and inputs z, and the nominal range of each."""

    path: str
    block: Block
    slopes: BlockSlopes
    t: float
    z: np.ndarray
    p: Any
    span: np.ndarray
    wired: set[str]
    used: frozenset[str]

    @classmethod
    def of(
        cls, flat: FlatDiagram, at: OperatingPoint, log: np.ndarray, path: str, slopes: BlockSlopes, wired: set[str]
    ) -> _BlockAtPoint:
        block = flat.table.blocks[path]
        z, p = read_arguments(flat, at, path, slopes, log)
        ports = {**{"x " + n: s for n, s in block.states.items()}, **{"u " + n: s for n, s in block.inputs.items()}}
        span = 1.0 + np.abs(z)
        for name, where in slopes.columns.slices.items():
            given = ports[name].nominal if name in ports else None
            if given:
                span[where] = given
        used = frozenset(w.port for w in (*flat.table.wires.values(), *flat.table.names.values()) if w.block == path)
        numbers = ca.DM(p) if slopes.is_large else p  # converted once
        return cls(path, block, slopes, just_after(at.t, block), z, numbers, span, wired, used)

    def find(self) -> Iterator[Finding]:
        """Yield the kinks and zero slopes of the block."""
        steps = set(self.slopes.steps)
        rounds = self.slopes.has_stairs
        yield from (StepsOnly(self.path, r[2:], c[2:], rounds) for r, c in self.slopes.steps if self._steps_count(r, c))
        kinks, zeros = dict[tuple[str, str], Kink](), dict[tuple[str, str], ZeroSlope]()
        f0, J0 = self._slopes(0, 0.0)
        for column in range(self.slopes.columns.total):
            source = self.slopes.columns.name_at(column)
            if source in self.slopes.columns.ports and source not in self.wired:
                continue
            for row, kink in self._find_kinks(column, f0):
                kink = replace(kink, slope=float(J0[row, column]))
                key = self.slopes.rows.name_at(row), source
                old = kinks.get(key)
                if key not in steps and (old is None or _size_of(kink) > _size_of(old)):
                    kinks[key] = kink
            if source in self.slopes.columns.ports:
                for row, zero in self._find_zeros(column, f0, J0):
                    key = self.slopes.rows.name_at(row), source
                    if key not in steps and (key not in zeros or abs(zero.change) > abs(zeros[key].change)):
                        zeros[key] = zero
        made: dict[tuple[str, str], Finding] = {**zeros, **kinks}
        outputs = self.slopes.rows.ports - self._unused
        named = {source for row, source in (*made, *steps) if row in outputs}  # a state is named if no output is
        yield from (f for (row, source), f in made.items() if row in outputs or _is_own(row, source, named))

    def _steps_count(self, row: str, column: str) -> bool:
        """Whether a row follows an input in stairs, or in steps of which some lie within its nominal range."""
        if column not in self.wired or self.slopes.has_stairs:
            return column in self.wired
        rows, columns = self.slopes.rows.slices[row], self.slopes.columns.slices[column]
        here = self._values(columns.start, 0.0)[rows]
        ends = (self._values(i, s * self.span[i])[rows] for i in range(columns.start, columns.stop) for s in (-1, 1))
        return any(not np.array_equal(end, here) for end in ends)

    @property
    def _unused(self) -> frozenset[str]:
        """The secondary outputs that nothing is wired to."""
        return frozenset(
            f"u {n}" for n, port in self.block.outputs.items() if _is_secondary(port) and n not in self.used
        )

    # --- the equations along one column ------------------------------------------------------------------------------

    def _moved(self, column: int, by: float) -> tuple[np.ndarray, bool]:
        """Return z with an entry moved, after the events that this fires, and whether any does."""
        z = self.z.copy()
        z[column] += by
        return self.slopes.settle(self.block, self.t, self.z, z, self.p)

    def _values(self, column: int, by: float) -> np.ndarray:
        return self.slopes.values(self.t, self._moved(column, by)[0], self.p)

    def _slopes(self, column: int, by: float) -> tuple[np.ndarray, np.ndarray]:
        return self.slopes.slopes(self.t, self._moved(column, by)[0], self.p)

    # --- kinks -------------------------------------------------------------------------------------------------------

    def _find_kinks(self, column: int, f0: np.ndarray) -> Iterator[tuple[int, Kink]]:
        h = NEAR * self.span[column]
        by_values = self.slopes.is_opaque or self.slopes.is_large
        if by_values or any(self._moved(column, by)[1] for by in (h, -h)):
            yield from self._find_by_values(column, h, f0)
        elif self.slopes.has_branches:
            yield from self._find_by_slopes(column, h)

    def _find_by_slopes(self, column: int, h: float) -> Iterator[tuple[int, Kink]]:
        def curved(by: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            f, J, H = self.slopes.curvature(self.t, self._moved(column, by)[0], self.p)
            return f, J[:, column], H[:, column]

        low, high = curved(-h), curved(h)
        jumps, bends = _mismatch(low, high, 2 * h)
        steepest = np.maximum(np.abs(low[1]), np.abs(high[1]))
        size = np.maximum(np.abs(low[0]), np.abs(high[0]))
        for row in np.flatnonzero(_is_jump(jumps, size) | (np.abs(bends) > DIFFERENT * steepest + _rounding(size, h))):
            jumped = bool(_is_jump(jumps, size)[row]) and _survives(curved, int(row), h, 0)
            if jumped or _survives(curved, int(row), h, 1):
                yield int(row), self._kink(int(row), column, low[1][row], high[1][row], jumps[row] * jumped)

    def _find_by_values(self, column: int, h: float, f0: np.ndarray) -> Iterator[tuple[int, Kink]]:
        """Find kinks by differences at two distances: of a smooth function their mismatch shrinks with the distance."""

        def sides(by: float) -> tuple[np.ndarray, np.ndarray]:
            up, down = (self._values(column, s * by) for s in (1, -1))
            return (f0 - down) / by, (up - f0) / by

        by = h * (1e3 if self.slopes.is_opaque else 1.0)  # rounding of any Python is not known
        last = np.abs(np.subtract(*sides(64 * by)))
        below, above = sides(by)
        bend = np.abs(above - below)
        size = 1.0 + np.abs(f0)
        steep = np.maximum(np.abs(above), np.abs(below))
        found = (bend > DIFFERENT * steep + _rounding(size, by)) & ((bend > 0.5 * last) | ~(last > 0))
        for row in np.flatnonzero(found & np.isfinite(bend)):
            grows = bend[row] > 8 * last[row] > 0
            jump = (above[row] + below[row]) * by if grows else 0.0
            yield int(row), self._kink(int(row), column, below[row], above[row], jump)

    def _kink(self, row: int, column: int, below: float, above: float, jump: float) -> Kink:
        port, source = self.slopes.rows.name_at(row)[2:], self.slopes.columns.name_at(column)[2:]
        return Kink(self.path, port, source, float(below), float(above), float(jump))

    # --- zero slopes -------------------------------------------------------------------------------------------------

    def _find_zeros(self, column: int, f0: np.ndarray, J0: np.ndarray) -> Iterator[tuple[int, ZeroSlope]]:
        span, slope = float(self.span[column]), np.abs(J0[:, column])
        if slope.size and np.all(slope > JUMP * slope.max()):
            return
        low, high = (self._values(column, s * span) for s in (-1, 1))
        change = high - low
        found = (slope * span <= NO_SLOPE * np.abs(change)) & (np.abs(change) > JUMP * (1.0 + np.abs(f0)))
        if not np.any(found):
            return
        down, up = (self._values(column, s * ASIDE * span) - f0 for s in (-1, 1))
        found &= ~(down * up > 0)  # a smooth extremum, where a slope of zero is right
        for row in np.flatnonzero(found & np.isfinite(change)):
            port, source = self.slopes.rows.name_at(int(row))[2:], self.slopes.columns.name_at(column)[2:]
            yield int(row), ZeroSlope(self.path, port, source, span, float(change[row]))


def _mismatch(
    low: tuple[np.ndarray, np.ndarray, np.ndarray], high: tuple[np.ndarray, np.ndarray, np.ndarray], length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a change of the rows, and of their slopes, has beyond its derivative: zero of a smooth function."""
    changes = [b - a - 0.5 * length * (db + da) for a, b, da, db in zip(low, high, low[1:], high[1:], strict=False)]
    return changes[0], changes[1]


def _is_jump(jumps: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(jumps) > JUMP * (1.0 + size))


def _rounding(size: np.ndarray, h: float) -> np.ndarray:
    """Return the error of a slope by rounding."""
    return np.asarray(1e-15 * (1.0 + size) / h)


def _survives(curved: Curved, row: int, h: float, which: int) -> bool:
    """Whether a mismatch of the values (0) or slopes (1) stays while the interval around it is halved.

    At a jump and a kink it does, in a steep place not.
    """
    a, b, low, high = -h, h, curved(-h), curved(h)
    first = abs(_mismatch(low, high, b - a)[which][row])
    for _ in range(HALVINGS):
        m = 0.5 * (a + b)
        middle = curved(m)
        left, right = (abs(_mismatch(*pair)[which][row]) for pair in ((low, middle, m - a), (middle, high, b - m)))
        if left >= right:
            b, high = m, middle
        else:
            a, low = m, middle
        if not max(left, right) >= 0.4 * first > 0.0:
            return False
    return True


def _is_own(row: str, source: str, named: set[str]) -> bool:
    """Whether a row is a state that follows a source which no output follows in such a way."""
    return row.startswith("x ") and source not in named


def _is_secondary(port: Output | State) -> bool:
    return isinstance(port, Output) and port.secondary


def _size_of(kink: Kink) -> float:
    return abs(kink.jump) * 1e9 + abs(kink.above - kink.below)

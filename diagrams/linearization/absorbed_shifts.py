"""Blocks that answer a shift of an input and of their own states alike everywhere, such as differences of positions.

The speed of most drives is the difference of two angles of an encoder: the angle's wire lies on the loop, and shifts
with the angle. Nothing comes of it, as the last angle shifts, too. At one point alone this would prove nothing: a dead
zone and an actuator at its limit answer a shift by nothing, too. So the block's equations are evaluated at points of
all sizes. There the answer to a shift has to be the same everywhere, and in proportion to it. What a block passes on
is another signal, which may not shift either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..flat import FlatDiagram
from ..wiring import join
from .block_slopes import BlockSlopes, slopes_of
from .taps import Tap, wire_entries

POINTS = 24
"""Points at which the equations of a block are evaluated."""
SIZES = (1.0, -1.0, 37.0, -4093.0, 1.0e6)
"""Sizes of shifts, in whole quanta where a block rounds its input, else times `UNIT`."""
UNIT = 7.390851e-3
ROUNDING = 1e-9
"""Rounding of the equations, relative to the sizes of what is summed in them."""


@dataclass(frozen=True, eq=False)
class ShiftedBlock:
    """A block on a loop that has states: its equations, and the signals that its inputs read."""

    path: str
    slopes: BlockSlopes
    watched: tuple[str, ...]  # inputs whose wires are on a loop
    taps: Mapping[str, Tap]  # signals of its wired inputs

    @classmethod
    def of(cls, flat: FlatDiagram, path: str, watched: Sequence[str]) -> ShiftedBlock | None:
        """Return a block with its signals; None if it has no states, or equations that can't be evaluated."""
        trace, block = flat.checked.traced.get(path), flat.table.blocks[path]
        if trace is None or not trace.states or trace.foreign is not None or hasattr(block, "guards") or block.stops:
            return None
        slopes = slopes_of(trace)
        wires = {name: wire for name in trace.inputs if (wire := flat.table.wires.get((path, name))) is not None}
        taps = {
            name: Tap(join(wire.block, wire.port), (wire.block, wire.port), wire_entries(flat, wire), ())
            for name, wire in wires.items()
        }
        return cls(path, slopes, tuple(watched), taps)

    def absorbs(self, flat: FlatDiagram, t: float, states: np.ndarray, inputs: Mapping[str, np.ndarray]) -> bool:
        """Return whether the answer to a shift is the same at every point, and in proportion to the shift.

        ``states`` and ``inputs`` are the shifts of its states and of its wired inputs, in a unit of the motion.
        """
        columns, d = self.slopes.columns, np.zeros(self.slopes.columns.total)
        d[: len(states)] = states
        for name, shift in inputs.items():
            d[columns.slices[f"u {name}"]] = shift
        if not any(d[columns.slices[f"u {name}"]].any() for name in self.watched):
            return True
        quanta = self._quanta(flat, d)
        rounded = quanta > 0.0
        units = np.unique(quanta[rounded] / np.abs(d[rounded]))
        if len(units) > 1:
            return False
        unit = float(units[0]) if len(units) else UNIT / float(np.max(np.abs(d)))
        p, rng = flat.p[flat.parameters.slices[self.path]], np.random.default_rng(0)
        expected: np.ndarray | None = None
        for k in range(POINTS):
            z = rng.standard_normal(len(d)) * 10.0 ** rng.uniform(-3.0, 3.0) * (1.0 if k else 0.0)
            z[rounded] = (np.floor(z[rounded] / quanta[rounded]) + rng.uniform(0.1, 0.4)) * quanta[rounded]
            before, (_, J) = self.slopes.values(t, z, p), self.slopes.slopes(t, z, p)
            for factor in SIZES:
                moved = z + factor * unit * d
                after = self.slopes.values(t, moved, p)
                large = np.abs(before) + np.abs(after) + np.abs(J) @ (np.abs(z) + np.abs(moved))
                answer = (after - before) / (factor * unit)
                expected = answer if expected is None else expected
                if not np.all(np.abs(answer - expected) * abs(factor * unit) <= ROUNDING * large):
                    return False
        return True

    def _quanta(self, flat: FlatDiagram, d: np.ndarray) -> np.ndarray:
        """Return the quanta of the inputs that a block rounds, where a shift moves them; 0 elsewhere."""
        block, found = flat.table.blocks[self.path], np.zeros(len(d))
        for name, parameter in block.quanta.items():
            found[self.slopes.columns.slices[f"u {name}"]] = np.ravel(getattr(block, parameter))
        return np.where(d != 0.0, found, 0.0)

"""Stairs as their mean slope: rounding taken out of a block's equations, and the slopes that are left.

Blocks that name their steps (`Block.quanta`), as of a converter or an encoder, are taken so in every linear model;
stairs of other blocks where they are asked for.

The mean of ⌊v⌋ is v − ½, that of ⌈v⌉ is v + ½. In equations whose slope by an input is zero everywhere, every rounding
is replaced by its mean; the slope of the result is the mean slope of the stairs, 1 for a quantizer. Comparisons have no
mean slope, as theirs depends on the amplitude: a relay stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Finding, Layout, kinds
from ...blocks.tracing import NEXT
from ..flat import FlatDiagram, Instant
from ..results import OperatingPoint
from .block_slopes import BlockSlopes, slopes_of
from .kinks import read_arguments
from .left_out_effects import MeanSlope, StepsOnly

MEANS = {ca.OP_FLOOR: -0.5, ca.OP_CEIL: 0.5}
"""Mean of a rounded value, less the value."""


@dataclass(frozen=True, eq=False)
class Stair:
    """A way through a block that goes in stairs, with its mean slope."""

    path: str
    row: str  # its output, "u y", or state, "x level"
    source: str
    slope: np.ndarray  # mean slope, shape (entries of the row, entries of the input)
    # whether it is taken because all stairs were asked for: the block does not name the steps of this input
    asked: bool = False


class Stairs:
    """Stairs of a diagram that a linear model replaces by their mean slopes.

    The row of a stair gets a signal e in addition to its own value, and v is the input of the stair; then e = K v.
    """

    def __init__(self, stairs: Sequence[Stair] = ()):
        self.stairs = tuple(stairs)
        self.e = Layout.of({str(i): (len(s.slope),) for i, s in enumerate(self.stairs)})
        self.v = Layout.of({str(i): (s.slope.shape[1],) for i, s in enumerate(self.stairs)})
        self.K = np.zeros((self.e.total, self.v.total))
        for i, stair in enumerate(self.stairs):
            self.K[self.e.slices[str(i)], self.v.slices[str(i)]] = stair.slope

    @classmethod
    def of(cls, flat: FlatDiagram, at: OperatingPoint, *, every: bool) -> Stairs:
        """Return the stairs with their mean slopes at an operating point: of all blocks, or of those that name them."""
        found = []
        for path in sorted(set(flat.checked.traced).difference(flat.in_model_exchange)):
            named = flat.table.blocks[path].quanta
            if not every and not named:
                continue
            slopes = slopes_of(flat.checked.traced[path])
            if slopes.has_stairs:
                z, p = read_arguments(flat, at, path, slopes)
                for row, source, K in mean_slopes(slopes, at.t, z, p):
                    found.append(Stair(path, row, source[2:], K, asked=source[2:] not in named))
        return cls([s for s in found if (s.path, s.source) in flat.table.wires and (every or not s.asked)])

    @property
    def places(self) -> tuple[Any, ...]:
        """The places of the stairs, without their slopes: functions with the signals e and v depend on them alone."""
        return tuple((s.path, s.row, s.source, s.slope.shape) for s in self.stairs)

    def add(self, instant: Instant, path: str, made: dict[str, Any], e: Any) -> dict[int, Any]:
        """Add e to what a block has made; return what it was without, by the number of the stair."""
        own = {}
        for i, stair in enumerate(self.stairs):
            kind, name = stair.row.split(" ", 1)
            if stair.path != path:
                continue
            part = e[self.e.slices[str(i)]]
            if kind == "u" and name in made:
                own[i] = made[name]
                made[name] = made[name] + part
            elif kind == "x" and NEXT in made:
                where = instant.layout.states.of_block[path].slices[name]
                above = where.start - instant.layout.states.slices[path].start
                below = made[NEXT].numel() - above - part.numel()
                own[i] = made[NEXT][above : above + part.numel()]
                made[NEXT] = made[NEXT] + ca.vertcat(ca.MX.zeros(above), part, ca.MX.zeros(below))

        return own

    def join(self, own: Mapping[int, Any]) -> Any:
        """Return the stairs' own values as one column; zeros for a block that has made none."""
        sizes = {i: len(stair.slope) for i, stair in enumerate(self.stairs)}
        columns = [ca.densify(ca.MX(own[i])) if i in own else ca.MX.zeros(n) for i, n in sizes.items()]
        return ca.vertcat(*columns) if columns else ca.MX(0, 1)

    def read(self, instant: Instant) -> Any:
        """Return v at an instant."""
        columns = [ca.densify(ca.MX(instant.source(s.path, s.source))) for s in self.stairs]
        return ca.vertcat(*columns) if columns else ca.MX(0, 1)

    def close(self, found: dict[Any, np.ndarray], names: Sequence[str], arguments: Sequence[str]) -> None:
        """Eliminate e and v from derivatives by name and argument."""
        if not self.stairs:
            return
        back = np.eye(self.e.total) - self.K @ found["v", "e"]
        e_by = {a: np.linalg.solve(back, self.K @ found["v", a]) for a in arguments}
        for name in names:
            for a in arguments:
                found[name, a] = found[name, a] + found[name, "e"] @ e_by[a]

    def replace_findings(self, findings: Sequence[Finding]) -> tuple[Finding, ...]:
        """Return findings with the mean slopes in place of the stairs that they replace."""
        means: dict[tuple[str, str, str], MeanSlope] = {}
        for s in self.stairs:
            steepest = float(s.slope.flat[int(np.argmax(np.abs(s.slope)))])
            means[s.path, s.row[2:], s.source] = MeanSlope(s.path, s.row[2:], s.source, steepest, s.asked)
        return tuple(means.get((f.block, f.port, f.source), f) if isinstance(f, StepsOnly) else f for f in findings)


def mean_slopes(slopes: BlockSlopes, t: float, z: np.ndarray, p: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Return the pairs of a row and an input that goes into it in stairs, with the mean slope where it is not zero."""
    found = []
    for pairs, J in ((slopes.steps_of_equations, _mean_of_equations), (slopes.steps_of_events, _mean_of_events)):
        if pairs:
            whole = J(slopes, t, z, p)
            for row, source in pairs:
                K = whole[slopes.rows.slices[row], slopes.columns.slices[source]]
                if np.any(K) and np.all(np.isfinite(K)):
                    found.append((row, source, K))
    return found


def _mean_of_equations(slopes: BlockSlopes, t: float, z: np.ndarray, p: np.ndarray) -> np.ndarray:
    symbols = ca.SX.sym("t"), ca.SX.sym("z", len(z)), ca.SX.sym("p", len(p))
    scalar = slopes.function.expand() if slopes.scalar is None else slopes.scalar  # of a large matrix it is not kept
    made = _means(scalar, slopes.split_symbols(*symbols))[: len(slopes.outputs) + 1]
    J = ca.jacobian(ca.vertcat(*map(ca.densify, made)), symbols[1])
    return np.asarray(ca.Function("mean", [*symbols], [ca.densify(J)])(t, z, p))


def _mean_of_events(slopes: BlockSlopes, t: float, z: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the mean slopes after the jumps of all events."""
    symbols = ca.SX.sym("t"), ca.SX.sym("z", len(z)), ca.SX.sym("p", len(p))
    arguments, jump = slopes.split_symbols(*symbols), slopes.jump.expand()
    fired = ca.SX.ones(jump.numel_in(jump.n_in() - 1))
    arguments[1] = _means(jump, [*arguments, fired])[0]
    made = _means(slopes.scalar, arguments)[: len(slopes.outputs) + 1]
    J = ca.jacobian(ca.vertcat(*map(ca.densify, made)), symbols[1])
    return np.asarray(ca.Function("mean", [*symbols], [ca.densify(J)])(t, z, p))


def _means(f: Any, arguments: Sequence[Any]) -> list[Any]:
    """Return the results of a CasADi function with every rounded value replaced by its mean."""
    work: dict[int, Any] = {}
    results = [ca.SX(f.sparsity_out(i)) for i in range(f.n_out())]
    dense = [ca.densify(a) for a in arguments]
    for k in range(f.n_instructions()):
        op, to, of = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if op == ca.OP_OUTPUT:
            results[to[0]].nz[to[1]] = work[of[0]]
        elif op == ca.OP_INPUT:
            work[to[0]] = dense[of[0]].nz[of[1]]
        elif op == ca.OP_CONST:
            work[to[0]] = ca.SX(f.instruction_constant(k))
        elif op in MEANS:
            work[to[0]] = work[of[0]] + MEANS[op]
        elif len(of) == 1:
            work[to[0]] = ca.SX.unary(op, work[of[0]])
        else:
            work[to[0]] = ca.SX.binary(op, work[of[0]], work[of[1]])
    return results


A_TREATMENT = kinds.choice("gain", "zero").worded(
    '"gain", which takes all stairs as their mean slope, "zero", which takes all by their slope of zero, or None, '
    "which takes those of quantizers and encoders as their mean slope",
    "Choose one.",
    kinds.by_name,
)
"""Treatments of stairs that can be asked for."""
NO_STAIRS = Stairs()
"""No stairs are replaced."""


def replace_stairs(flat: FlatDiagram, at: OperatingPoint, stairs: str | None) -> Stairs:
    """Return the stairs that are replaced by their mean slopes.

    These are those of blocks that name their steps, with "gain" those of all blocks, and with "zero" none.
    """
    return NO_STAIRS if stairs == "zero" else Stairs.of(flat, at, every=stairs == "gain")

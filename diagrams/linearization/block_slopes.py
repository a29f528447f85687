"""Slopes of one block's equations: exact ones at a point, and the stairs and branches that they don't show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from ...blocks.core import Block, Layout
from ...blocks.tracing import NEXT, Traced, has_large_product, size
from ...fmus.fmu_block import Derivation, DerivativeMethod, FmuLinearization

BRANCHES = frozenset(
    {
        ca.OP_LT,
        ca.OP_LE,
        ca.OP_EQ,
        ca.OP_NE,
        ca.OP_NOT,
        ca.OP_AND,
        ca.OP_OR,
        ca.OP_IF_ELSE_ZERO,
        ca.OP_FLOOR,
        ca.OP_CEIL,
        ca.OP_FABS,
        ca.OP_SIGN,
        ca.OP_FMIN,
        ca.OP_FMAX,
        ca.OP_FMOD,
        ca.OP_REMAINDER,
        ca.OP_COPYSIGN,
    }
)
"""CasADi's operations that are not smooth."""
ROUNDINGS = frozenset({ca.OP_FLOOR, ca.OP_CEIL})
"""Those of them that make stairs."""
MOST_JUMPS = 10
"""Rounds of events after which a block counts as settled."""


class Side(NamedTuple):
    """One side of the map: names of ports or states, each with its entries; ``ports`` are those that are no state."""

    slices: Mapping[str, slice]
    ports: frozenset[str]
    total: int

    def name_at(self, entry: int) -> str:
        """Return the name of the port or state that an entry belongs to."""
        return next(name for name, where in self.slices.items() if where.start <= entry < where.stop)


def _side(ports: Mapping[str, Any], states: Mapping[str, Any], *, states_first: bool) -> Side:
    named = [("x " + n, s) for n, s in states.items()]
    of_ports = [("u " + n, s) for n, s in ports.items()]
    layout = Layout.of(dict(named + of_ports if states_first else of_ports + named))
    return Side(layout.slices, frozenset(n for n, _ in of_ports), layout.total)


class BlockSlopes:
    """Values and slopes of a block's outputs and next states (or rates) by its states and inputs.

    Columns are the states, then the inputs; rows the outputs, then the next states. Names begin with ``x `` for a
    state and ``u `` for a port, as an output may be a state of the same name.
    """

    def __init__(self, trace: Traced):
        # the trace itself is not kept: it is the key of a weak dictionary
        self.function, self.indicators, self.jump = trace.function, trace.indicators, trace.jump
        self.inputs, self.outputs, self.depends = tuple(trace.inputs), tuple(trace.outputs), trace.depends
        self.is_opaque = trace.foreign is not None  # any Python, without exact derivatives
        self.columns = _side(trace.inputs, trace.states, states_first=True)
        advance = trace.states if trace.function.numel_out(len(trace.outputs)) else {}
        self.rows = _side(trace.outputs, advance, states_first=False)
        self._sizes = [Layout.of(trace.states).total, *(size(s) for s in trace.inputs.values())]
        self.is_large = has_large_product(trace.function)  # a large matrix, which is not written out by entries
        try:
            self.scalar: Any = None if self.is_large else trace.function.expand()
        except RuntimeError:  # a table, or an opaque block
            self.scalar = None

    @cached_property
    def has_branches(self) -> bool:
        """Whether an operation of the equations is not smooth, or can't be looked at."""
        f = self.function if self.is_large else self.scalar
        unsmooth = {*BRANCHES, ca.OP_CALL}
        return f is None or any(f.instruction_id(k) in unsmooth for k in range(f.n_instructions()))

    @cached_property
    def is_simple(self) -> bool:
        """Whether the equations are smooth, with slopes that are the same everywhere."""
        if self.has_branches or self.indicators is not None:
            return False
        z, results, _, _ = self._expressions
        return not ca.depends_on(ca.jacobian(results, z), z)

    @cached_property
    def _expressions(self) -> tuple[Any, Any, Any, Any]:
        """Symbols of z = (x, u), the results by them, and symbols of t and p."""
        f = self.function if self.scalar is None else self.scalar
        symbol = ca.MX if self.scalar is None else ca.SX
        z, t, p = symbol.sym("z", self.columns.total), symbol.sym("t"), symbol.sym("p", f.numel_in(f.n_in() - 1))
        made = f.call(self.split_symbols(t, z, p), self.is_large, False)
        return z, ca.vertcat(*(ca.densify(y) for y in made[: len(self.outputs) + 1])), t, p

    def split_symbols(self, t: Any, z: Any, p: Any) -> list[Any]:
        """Return the arguments of the block's function from t, z and p."""
        parts = ca.vertsplit(z, np.cumsum([0, *self._sizes]).tolist()) if self.columns.total else [z] * len(self._sizes)
        return [t, *parts, p]

    @cached_property
    def _with_slopes(self) -> Any:
        z, results, t, p = self._expressions
        return ca.Function("slopes", [t, z, p], [results, ca.densify(ca.jacobian(results, z))])

    @cached_property
    def _with_curvature(self) -> Any:
        z, results, t, p = self._expressions
        J = ca.densify(ca.jacobian(results, z))
        bends = [ca.densify(ca.jacobian(J[:, i], z[i])) for i in range(z.numel())]
        return ca.Function("curvature", [t, z, p], [results, J, ca.horzcat(*bends)])

    @cached_property
    def _values(self) -> Any:
        z, results, t, p = self._expressions
        return ca.Function("values", [t, z, p], [results])

    def values(self, t: float, z: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the rows at a point."""
        return np.asarray(self._values(t, z, p)).ravel()

    def slopes(self, t: float, z: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and their exact slopes at a point, shape (rows, columns)."""
        f, J = self._with_slopes(t, z, p)
        return np.asarray(f).ravel(), np.asarray(J)

    def curvature(self, t: float, z: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rows, their slopes, and the slope of each entry's slope by its own column."""
        f, J, H = self._with_curvature(t, z, p)
        return np.asarray(f).ravel(), np.asarray(J), np.asarray(H)

    # --- events ------------------------------------------------------------------------------------------------------

    def settle(self, block: Block, t: float, z0: np.ndarray, z: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return z with the states after the events that fire on the way from z0 to z, and whether any does."""
        if self.indicators is None:
            return z, False
        z, any_fired = z.copy(), False
        before = self._indicators(t, z0, p) > 0
        for _ in range(MOST_JUMPS):
            after = self._indicators(t, z, p) > 0
            fired = np.array(
                [
                    (e.direction != "falling" and not was and now) or (e.direction != "rising" and was and not now)
                    for e, was, now in zip(block.events.values(), before, after, strict=True)
                ],
                dtype=float,
            )
            before = after
            if not fired.any():
                break
            any_fired = True
            n = self._sizes[0]
            z[:n] = np.asarray(self.jump(t, *self._split(z), p, fired)).ravel()
        return z, any_fired

    def _indicators(self, t: float, z: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.asarray(self.indicators(t, *self._split(z), p)).ravel()

    def _split(self, z: np.ndarray) -> list[np.ndarray]:
        return np.split(z, np.cumsum(self._sizes)[:-1])

    # --- dependence --------------------------------------------------------------------------------------------------

    @cached_property
    def events_depend(self) -> frozenset[str]:
        """The inputs that events, or what they do, depend on."""
        if self.indicators is None:
            return frozenset()
        functions = (self.indicators, self.jump)
        return frozenset(
            name for i, name in enumerate(self.inputs, 2) if any(f.jac_sparsity(0, i).nnz() for f in functions)
        )

    def follows(self, port: str, source: str) -> bool:
        """Whether an output depends on an input: at once, by the states, or by events."""
        depends = self.depends
        by_states = depends[NEXT] | self.events_depend
        return source in depends[port] or ("x" in depends[port] and source in by_states)

    @cached_property
    def steps(self) -> tuple[tuple[str, str], ...]:
        """Pairs (row, column) of a port or state that depends on an input with a slope that is zero everywhere.

        A state is named only if no output of the block follows the input in steps.
        """
        found = [*self.steps_of_equations, *self.steps_of_events]
        named = {column for row, column in found if row in self.rows.ports}
        return tuple(dict.fromkeys((r, c) for r, c in found if r in self.rows.ports or c not in named))

    @cached_property
    def steps_of_equations(self) -> tuple[tuple[str, str], ...]:
        """Those of the pairs that the equations make, of all rows."""
        return tuple(self._find_steps_of_equations())

    @cached_property
    def steps_of_events(self) -> tuple[tuple[str, str], ...]:
        """Those of the pairs that events make."""
        return tuple(self._find_steps_of_events())

    @cached_property
    def has_stairs(self) -> bool:
        """Whether a row depends on an input in steps, and a rounding is in the equations."""
        functions = [f for f in (self.scalar, None if self.jump is None else self.jump.expand()) if f is not None]
        rounds = any(f.instruction_id(k) in ROUNDINGS for f in functions for k in range(f.n_instructions()))
        return self.scalar is not None and rounds and bool(self.steps_of_equations or self.steps_of_events)

    def _find_steps_of_equations(self) -> Iterator[tuple[str, str]]:
        if (self.scalar is None and not self.is_large) or not self.has_branches:
            return
        z, results, _, _ = self._expressions
        for row, rows in self.rows.slices.items():
            y = results[rows]
            for column in self.columns.ports:
                u = z[self.columns.slices[column]]
                if u.numel() and y.numel() and ca.depends_on(y, u):
                    slope = ca.jacobian(y, u)
                    entries: list[Any] = [slope] if self.is_large else slope.nonzeros()
                    if all(e.is_zero() for e in entries):
                        yield row, column

    def _find_steps_of_events(self) -> Iterator[tuple[str, str]]:
        depends = self.depends
        for port in self.outputs:
            for source in self.inputs:
                smooth = source in depends[port] or ("x" in depends[port] and source in depends[NEXT])
                if not smooth and "x" in depends[port] and source in self.events_depend:
                    yield "u " + port, "u " + source


_KNOWN: WeakKeyDictionary[Traced, BlockSlopes] = WeakKeyDictionary()  # diagrams share traces


def slopes_of(trace: Traced) -> BlockSlopes:
    """Return the slopes of a trace, made once."""
    if trace not in _KNOWN:
        _KNOWN[trace] = BlockSlopes(trace)
    return _KNOWN[trace]


def linearize_block(block: Block, trace: Traced, t: float, x: np.ndarray, u: np.ndarray) -> FmuLinearization:
    """Return the linear model of a block's equations in continuous time at a point, exact; as that of an FMU."""
    values, J = slopes_of(trace).slopes(t, np.concatenate([x, u]), trace.pack(block, np.inf))
    m, n = len(values) - x.size, x.size  # the outputs come first
    states, inputs, outputs = (tuple(Layout.of(ports).labels) for ports in (trace.states, trace.inputs, trace.outputs))
    return FmuLinearization(
        A=J[m:, :n],
        B=J[m:, n:],
        C=J[:m, :n],
        D=J[:m, n:],
        states=states,
        inputs=inputs,
        outputs=outputs,
        t=t,
        h=None,
        x0=x,
        u0=u,
        f=values[m:],
        y0=values[:m],
        derivation=Derivation(DerivativeMethod.TRACED),
        uncertainty=np.zeros(J.shape),
    )

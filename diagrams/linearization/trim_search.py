"""Trim: operating points at which a diagram is at rest, or at which states and signals have wanted values.

The unknowns are the states of all blocks and FMUs, the FMUs' outputs, the values of algebraic loops, and the free
parameters. The equations say that every state stays the same, or has its wanted rate, that the FMUs' outputs follow
from their states, and that the signals have their targets. They are solved by least squares within bounds, with a
trust-region reflective method and then Gauss-Newton steps. The derivatives are exact: those of the traced functions,
and the linear models of the FMUs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ...blocks.core import (
    Layout,
    NonFiniteError,
    OptionError,
    SimulationError,
    accepts,
    check_argument,
    elements,
    kinds,
)
from ..flat import (
    Apart,
    Derivative,
    FlatDiagram,
    WiredDiagram,
    evaluate,
    join_columns,
    loop_mismatch,
    next_x,
    plant_inputs,
    rates,
    trace_schedule,
)
from ..frequency import first_largest
from ..results import FreeDirection, OperatingPoint, PointOrigin, layout_of
from .exchanged import evaluators_at
from .operating_points import PointLike, copy_point, operating_point, values_of, with_residual
from .start_branches import leave_start
from .trim_plants import RUN_INSTEAD, ExchangedPlants, Plants, check_drift
from .trim_request import Free, Target, free_parameters, index_states, read_targets, set_states

UNDETERMINED = 1e-10
"""Relative size of a singular value of the equations' derivative up to which a direction counts as free."""
TOLERANCE = 1e-9
"""Largest residual of a solved equation, relative to 1 + the size of its quantity."""
Residual: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Residual, its derivative by the unknowns, and the FMUs' inputs z."""


class _Equations:
    """The residual of a trim as a function of the unknowns, with its exact derivative.

    The unknowns are, one after the other, free entries of x (states, values of algebraic loops), w, free states of the
    FMUs, and free parameters.
    """

    def __init__(self, diagram: WiredDiagram, flat: FlatDiagram, at: OperatingPoint, free: list[Free], target: Target):
        self.diagram, self.flat, self.at, self.parameters, self.target = diagram, flat, at, free, target
        self.plants = Plants(flat, at, diagram, rest=target.rest)
        self.exchanged = ExchangedPlants(diagram, flat, at, free)
        traced = flat.checked.traced
        self.sampled = flat.states.entries(p for p in flat.states.slices if traced[p].advance != "derivative")
        loops = flat.loops.entries(flat.loops.slices)
        movable = sorted({*flat.continuous.tolist(), *self.sampled})
        self.free_x = np.array([i for i in movable if i not in target.fixed] + loops, dtype=int)
        n = self.plants.total
        self.free_p = np.array([i for i in range(n) if flat.width + i not in target.fixed], dtype=int)
        self.free_q = Layout.of({f.name: (f.start.size,) for f in free})
        """Layout of the free parameters among the unknowns."""
        sizes = {"x": len(self.free_x), "w": at.w.size, "plants": len(self.free_p), "q": self.free_q.total}
        self.unknowns = Layout.of({name: (size,) for name, size in sizes.items()})
        self.acting = frozenset(flat.clocks.values())
        self.loops = len(flat.active_loops(self.acting))
        self.function = self._trace_residuals()
        self._memory: tuple[bytes, Residual] | None = None
        self.names, self.wanted, self.keep = self._list_rows()

    def _trace_residuals(self) -> Derivative:
        """Return the function of the residuals of rates, ticks, loops and targets, of z, and of their derivatives."""
        flat, symbols = self.flat, self.flat.symbols()

        def results(apart: Apart) -> Mapping[str, Any]:
            instant = evaluate(flat, flat.blocks, self.acting, **symbols, apart=apart, begun=True)
            change = (next_x(instant) - symbols["x"])[self.sampled] if self.sampled else ca.MX(0, 1)
            y = join_columns([instant.values[port][list(entries)] for port, entries in self.target.signals])
            loop, z = loop_mismatch(instant), plant_inputs(instant)
            return {"dx": rates(instant), "change": change, "loop": loop, "y": y, "z": z}

        by = ("x", "w", "p") if self.parameters else ("x", "w")
        return Derivative(trace_schedule("trim", symbols, results), [(name, None) for name in by])

    def _list_rows(self) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return for every equation its name, its wanted value, and whether it counts."""
        flat, states, target = self.flat, self.flat.labels, self.target
        loops = self.loops
        names = [
            *(f"d/dt {states[i]}" for i in flat.continuous),
            *(f"{states[i]} per tick" for i in self.sampled),
            *(f"loop[{i + 1}]" for i in range(loops)),
            *target.labels,
            *flat.plant_outputs.labels,
            *self.plants.equations,
        ]

        def wanted_rates(states: Iterable[int], seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rates = np.array([target.rates.get(int(i), 0.0 if target.rest else np.nan) for i in states])
            keep = np.isfinite(rates)
            return np.where(keep, rates, 0.0) * seconds, keep

        traced = flat.checked.traced
        period = np.ones(flat.width)
        for path, where in flat.states.slices.items():
            rate = flat.table.rate(flat.table.subsystem_of[path]) if path in traced else None
            period[where] = 1.0 if rate is None else float(rate)
        groups = [
            wanted_rates(flat.continuous, np.ones(flat.continuous.size)),
            wanted_rates(self.sampled, period[self.sampled]),
            (np.zeros(loops), np.ones(loops, bool)),
            (target.wanted, np.ones(target.wanted.size, bool)),
            (np.zeros(self.at.w.size), np.ones(self.at.w.size, bool)),
            wanted_rates(flat.width + np.arange(self.plants.total), self.plants.seconds),
        ]
        wanted, keep = (np.concatenate([g[i] for g in groups]) for i in (0, 1))
        return names, wanted, keep.astype(bool)

    @property
    def unknown_names(self) -> list[str]:
        """Names of the unknowns; empty for signals, which follow from states and parameters."""
        states = len(self.flat.states.labels)
        parameters = [label for f in self.parameters for label in elements(f.name, np.shape(f.shape_value(f.start)))]
        return [
            *(self.flat.labels[i] if i < states else "" for i in self.free_x),
            *([""] * self.at.w.size),
            *(self.plants.states.labels[i] for i in self.free_p),
            *parameters,
        ]

    def start(self) -> np.ndarray:
        """Return the unknowns at the beginning of the search."""
        q = [f.start for f in self.parameters]
        return np.concatenate([self.at.x[self.free_x], self.at.w, self.plants.x0[self.free_p], *q])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds of the unknowns."""
        low, high = np.full(self.unknowns.total, -np.inf), np.full(self.unknowns.total, np.inf)
        for i, where in enumerate([*self.free_x, *([-1] * self.at.w.size), *(self.flat.width + self.free_p)]):
            if where in self.target.bounds:
                low[i], high[i] = self.target.bounds[int(where)]
        if self.parameters:
            low[self.unknowns.slices["q"]] = np.concatenate([f.low for f in self.parameters])
            high[self.unknowns.slices["q"]] = np.concatenate([f.high for f in self.parameters])
        return low, high

    def split(self, unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return x, w, the FMUs' states and the values of the free parameters."""
        parts = self.unknowns.split(unknown)
        x, xp = self.at.x.copy(), self.plants.x0.copy()
        x[self.free_x], xp[self.free_p] = parts["x"], parts["plants"]
        return x, parts["w"], xp, [*self.free_q.split(parts["q"]).values()]

    def residual_at(self, unknown: np.ndarray) -> Residual:
        """Return the residual, its derivative, and z; those of the last unknowns are kept."""
        key = unknown.tobytes()
        if self._memory is None or self._memory[0] != key:
            self._memory = key, self._evaluate(unknown)
        return self._memory[1]

    def _evaluate(self, unknown: np.ndarray) -> Residual:
        flat, (x, w, xp, q) = self.flat, self.split(unknown)
        p, by_q = flat.p.copy(), np.zeros((flat.p.size, self.free_q.total))
        for f, value, columns in zip(self.parameters, q, self.free_q.slices.values(), strict=True):
            if f.where is not None:
                p[f.where] = f.pack_value(value)
                by_q[f.where, columns] = f.slope(value)[0]
        numbers = self.function(self.at.t, x, w, p, evaluators=self.exchanged.evaluators(q))
        values, rest = numbers[:5], numbers[5:]
        moved = self.exchanged.differentiate(q, values, lambda e: self.function(self.at.t, x, w, p, evaluators=e)[:5])
        many, where = 3 if self.parameters else 2, self.unknowns.slices

        def derivative(i: int) -> np.ndarray:
            J = np.zeros((values[i].size, self.unknowns.total))
            found = zip(rest[many * i : many * (i + 1)], (x.size, w.size, p.size), strict=False)
            by = [b.reshape(values[i].size, n) for b, n in found]
            J[:, where["x"]] = by[0][:, self.free_x]
            J[:, where["w"]] = by[1]
            if self.parameters:
                J[:, where["q"]] = by[2] @ by_q + moved[i]
            return J

        rows, slopes = values[:4], [derivative(i) for i in range(4)]
        z = values[4]
        m = self.plants.evaluate(xp, z, self.parameters, q)
        z_by = derivative(4)
        own = where["plants"]
        of_w = np.zeros((w.size, self.unknowns.total))
        of_w[:, where["w"]] = np.eye(w.size)
        of_w -= m.D @ z_by
        of_w[:, own] -= m.C[:, self.free_p]
        of_f = m.B @ z_by
        of_f[:, own] += m.A[:, self.free_p]
        if self.parameters:
            of_w[:, where["q"]] -= m.y_by_q
            of_f[:, where["q"]] += m.f_by_q
        rows, slopes = [*rows, w - m.y, m.f], [*slopes, of_w, of_f]
        r, keep = np.concatenate(rows) - self.wanted, self.keep
        return np.where(keep, r, 0.0), np.where(keep[:, None], np.vstack(slopes), 0.0), z

    def scale_residual(self, unknown: np.ndarray) -> np.ndarray:
        """Return the residual relative to 1 + the size of each equation's quantity."""
        r, _, _ = self.residual_at(unknown)
        x, w, xp, _ = self.split(unknown)
        n = self.loops
        sizes = [x[self.flat.continuous], x[self.sampled], np.zeros(n), self.target.wanted, w, xp]
        relative: np.ndarray = np.abs(r) / (1.0 + np.abs(np.concatenate(sizes)))
        return relative


def solve(equations: _Equations) -> np.ndarray:
    """Return the unknowns with the smallest residual within the bounds."""
    from scipy.optimize import least_squares

    low, high = equations.bounds()
    unknown = equations.start()
    if not unknown.size:
        return unknown
    pinned = low == high
    unknown = np.clip(unknown, low, high)
    moves = ~pinned

    def fill_in(part: np.ndarray) -> np.ndarray:
        every = np.array(unknown)
        every[moves] = part
        return every

    inside = np.where(np.isfinite(high - low), 1e-9 * (high - low), 0.0)[moves]
    begin = np.clip(unknown[moves], low[moves] + inside, high[moves] - inside)
    found = least_squares(
        lambda v: equations.residual_at(fill_in(v))[0],
        begin,
        jac=lambda v: _check_finite(equations.residual_at(fill_in(v))[1][:, moves]),
        bounds=(low[moves], high[moves]),
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=200,
    )
    best = fill_in(np.asarray(found.x))
    for _ in range(5):  # Gauss-Newton steps give the last digits and reach a bound
        r, J, _ = equations.residual_at(best)
        step = np.zeros(best.size)
        step[moves] = np.linalg.lstsq(J[:, moves], -r, rcond=1e-12)[0]
        trial = np.clip(best + step, low, high)
        if not np.max(equations.scale_residual(trial), initial=0.0) < np.max(
            equations.scale_residual(best), initial=0.0
        ):
            break
        best = trial
    return best


def _check_finite(slopes: np.ndarray) -> np.ndarray:
    """Return the derivatives of a trim's equations; refuse those that are not finite, as that of a root at 0."""
    if not np.isfinite(slopes).all():
        raise NonFiniteError(
            "trim: found a derivative of the diagram's equations that is not finite; expected finite numbers, and a "
            "root has none at 0. Begin elsewhere: at= another time, or with other initial states."
        )
    return slopes


def find_free_directions(equations: _Equations, unknown: np.ndarray) -> tuple[FreeDirection, ...]:
    """Return the directions of states and parameters along which all equations stay solved, to first order.

    They are the null space of the derivative, relative to the sizes of unknowns and rows, in reduced echelon form.
    """
    low, high = equations.bounds()
    moves = np.flatnonzero(low < high)
    J = equations.residual_at(unknown)[1][:, moves]
    if not moves.size:
        return ()
    sizes = 1.0 + np.abs(unknown[moves])
    scaled = J * sizes
    scaled = scaled / np.maximum(np.max(np.abs(scaled), axis=1, initial=0.0), 1e-300)[:, None]
    _, values, rows = np.linalg.svd(scaled)
    rank = int(np.sum(values > UNDETERMINED * max(1.0, float(values.max(initial=0.0)))))
    basis = _make_basis(rows[rank:]) * sizes
    names = [equations.unknown_names[i] for i in moves]
    found = []
    for direction in basis:
        share = direction / direction[first_largest(np.abs(direction))]
        entries = [(n, round(float(v), 12)) for n, v in zip(names, share, strict=True) if abs(v) > 1e-9 and n]
        if entries:
            found.append(FreeDirection(tuple(sorted(entries, key=lambda e: (-abs(e[1]), e[0])))))
    return tuple(sorted(found, key=lambda f: f.entries[0][0]))


def _make_basis(rows: np.ndarray) -> np.ndarray:
    """Return the basis of a space in which each row has 1 in one column, where the others have 0.

    Singular vectors of one value may be turned against each other. The columns are chosen by their lengths in the
    space, which a turn leaves as they are.
    """
    pivots: list[int] = []
    rest = rows.copy()
    for _ in range(len(rows)):
        lengths = np.linalg.norm(rest, axis=0)
        pivots.append(first_largest(lengths))
        axis = rest[:, pivots[-1]] / lengths[pivots[-1]]
        rest = rest - np.outer(axis, axis @ rest)
    return np.asarray(np.linalg.solve(rows[:, pivots], rows))


def trim(
    diagram: WiredDiagram,
    free: Mapping[str, Any] | Iterable[str] | None = None,
    targets: Mapping[str, Any] | None = None,
    *,
    rates: Mapping[str, Any] | None = None,
    fixed: Iterable[str] = (),
    at: PointLike = None,
    tolerance: float = TOLERANCE,
    **options: Any,
) -> OperatingPoint:
    """Find an operating point; see `Diagram.trim`."""
    if free is not None and not isinstance(free, Mapping) and (isinstance(free, str) or not kinds.names.holds(free)):
        raise OptionError(
            f"found free={free!r}; expected names with bounds, or a list of names. Write, for instance, "
            "free={'force.value': (-10, 10)}.",
            block=diagram.name,
            port="free",
        )
    targets, rates = ({} if given is None else given for given in (targets, rates))
    for name, given, kind in (
        ("targets", targets, kinds.mapping),
        ("rates", rates, kinds.mapping),
        ("fixed", fixed, kinds.names),
        ("tolerance", tolerance, kinds.number),
    ):
        check_argument(given, kind, name, diagram.name)
    asked: dict[str, Any] = dict(free) if isinstance(free, Mapping) else dict.fromkeys(() if free is None else free)
    guess = operating_point(diagram, at, options)
    base = diagram.replace(guess.parameters) if guess.parameters else diagram
    flat = base.flatten_like(guess)
    states = index_states(flat, guess)
    parameters, searched = free_parameters(base, {n: b for n, b in asked.items() if n not in states})
    flat, known = searched.flatten_like(guess), layout_of(flat)
    if layout_of(flat) != known:  # a freed zero was structure, and its block has other states without it
        guess = copy_point(base, guess, searched)
        flat, states = searched.flatten_like(guess), index_states(flat, guess)
    base = searched
    bounds = {n: b for n, b in asked.items() if n in states}
    target = read_targets(flat, states, targets, rates, [fixed] if isinstance(fixed, str) else fixed, bounds)
    return _solve_trim(base, diagram, flat, guess, parameters, target, tolerance, PointOrigin.TRIM)


@accepts("operating_point", states=kinds.mapping)
def point_from_states(
    diagram: WiredDiagram, t: float, states: Mapping[str, Any], options: Mapping[str, Any]
) -> OperatingPoint:
    """Return the operating point with states given by name; the others are those at the time t.

    Signals and the FMUs' outputs follow from the states. See `Diagram.operating_point`.
    """
    guess = operating_point(diagram, t, options, begun=False)
    flat = diagram.flatten_like(guess)
    guess = set_states(flat, guess, states)
    known = index_states(flat, guess)
    target = read_targets(flat, known, {}, {}, list(known), {})
    target.rest = False

    def solve_signals(guess: OperatingPoint) -> OperatingPoint:
        return _solve_trim(diagram, diagram, flat, guess, [], target, TOLERANCE, PointOrigin.GIVEN)

    found = solve_signals(guess)
    begun = leave_start(flat, found.x, found.values)  # it depends on the signals
    return found if begun is found.x else solve_signals(set_states(flat, replace(guess, x=begun), states))


def _solve_trim(
    base: WiredDiagram,
    diagram: WiredDiagram,
    flat: FlatDiagram,
    guess: OperatingPoint,
    parameters: list[Free],
    target: Target,
    tolerance: float,
    how: PointOrigin,
) -> OperatingPoint:
    equations = _Equations(base, flat, guess, parameters, target)
    unknown = solve(equations)
    left = equations.scale_residual(unknown)
    order = [i for i in np.argsort(-left, kind="stable") if equations.keep[i]]
    residuals = {equations.names[i]: float(left[i]) for i in order}
    worst = float(left[order[0]]) if order else 0.0
    x, w, xp, q = equations.split(unknown)
    free = find_free_directions(equations, unknown) if how is PointOrigin.TRIM else ()
    changed, z = equations.plants.change_blocks(parameters, q), equations.residual_at(unknown)[2]
    if not worst <= tolerance:
        shown = "; ".join(f"{name}: {value:.3g}" for name, value in list(residuals.items())[:5])
        hidden = equations.plants.find_unmoved(xp, z, residuals, changed, tolerance)
        stuck = [f.name for f, v in zip(parameters, q, strict=True) if f.is_at_bound(v)]
        raise SimulationError(
            f"no operating point was found: relative to 1 + their size, these equations have the residuals {shown}; "
            f"expected at most {tolerance:g}. {_advise(hidden, stuck)}",
            block=diagram.name,
            t=guess.t,
        )
    values = {f.name: f.shape_value(v) for f, v in zip(parameters, q, strict=True)}
    final = diagram.replace({**guess.parameters, **values})
    if layout_of(final.flatten_like(guess)) != layout_of(flat):
        raise SimulationError(
            f"no operating point was found: {', '.join(n for n, v in values.items() if not np.all(v))} came out as 0, "
            "which is structure: the block has other states with it. Give bounds without 0, such as "
            "free={…: (1e-6, 10)}, or free other parameters.",
            block=diagram.name,
            t=guess.t,
        )
    plants = equations.plants.points(xp, z, changed)
    # an FMU that lists no states may move, though no equation holds it
    drift = equations.plants.drift(plants, changed) if how is PointOrigin.TRIM else {}
    check_drift(drift, tolerance, diagram.name, guess.t)
    residuals = dict(sorted((residuals | drift).items(), key=lambda r: -r[1]))
    parameters_found = {**guess.parameters, **values}
    facts = {"parameters": parameters_found, "residuals": residuals, "how": how, "free": free}
    point = _complete_point(final, guess, x, w, plants, facts)
    most = max(drift, key=drift.__getitem__, default="")
    return replace(point, residual=drift[most], largest=most) if most and drift[most] > point.residual else point


def _advise(hidden: Sequence[str], stuck: Sequence[str]) -> str:
    """Return the next step where no point was found: ``hidden`` are FMUs with a memory, ``stuck`` names at a bound."""
    if hidden:
        many = len(hidden) > 1
        said = "FMUs list no states in their descriptions" if many else "FMU lists no states in its description"
        return f"The {said} ({', '.join(hidden)}), so a trim can't move the outputs to their rest. {RUN_INSTEAD}"
    at_bound = f"{', '.join(stuck)} is at its bound. " if stuck else ""
    return (
        f"{at_bound}Free more parameters or states, widen bounds, begin nearer with at=…, or take the nearest point "
        "with tolerance=…."
    )


def _complete_point(
    diagram: WiredDiagram,
    guess: OperatingPoint,
    x: np.ndarray,
    w: np.ndarray,
    plants: Mapping[str, Any],
    more: dict[str, Any],
) -> OperatingPoint:
    """Return the operating point with all its signals; subsystems hold their outputs."""
    flat = diagram.flatten_like(guess)
    at_tick = flat.at_tick(frozenset(flat.clocks.values()))
    x_next, z, log, _ = at_tick(guess.t, x, w, flat.p, evaluators=evaluators_at(flat, guess))
    values = values_of(flat, log)
    x = x.copy()
    for name, where in flat.held.slices.items():
        x[where] = np.ravel(values[name])
    point = replace(guess, x=x, w=w.copy(), z=z, plants=plants, values=values, **more)
    return with_residual(flat, point, x_next)

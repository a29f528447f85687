"""Rules of a traced block: results, derivatives and dependencies are NumPy's; see `check_block`."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ...blocks.core import GuardError, ShapeError, TraceError, lay_out
from ...blocks.tracing import GUARDS, NEXT, Point, bundle
from .exercise import Bench
from .value_rules import rule_error

_STEP = 1e-6  # of differences, relative to 1 + |v|

Pair = tuple[str, str]


def check_shapes(bench: Bench) -> None:
    """Compare the shapes of NumPy's results with the declared and traced ones."""
    own = [n for n in bench.traced.outputs if n not in bench.traced.states]
    for point in bench.points[:6]:
        for name, value in bench.evaluate_with_numpy(point, own).items():
            if value.shape != bench.traced.outputs[name]:
                raise rule_error(
                    "shapes",
                    f"with numbers its output has shape {value.shape} in a {bench.kind} subsystem, traced "
                    f"{bench.traced.outputs[name]}; expected one shape. Build it with np.stack.",
                    bench.block,
                    name,
                    ShapeError,
                )


def check_trace(bench: Bench) -> float:
    """Compare NumPy's results with the traced ones, and return the largest relative difference."""
    worst, block = 0.0, bench.block
    if block.opaque:
        return worst
    own = ["derivative"] if bench.traced.advance == "derivative" else []
    update = NEXT if bench.traced.advance == "update" else ""
    for point in bench.points:
        columns = point.columns()
        traced = dict(zip(bench.names, bench.evaluate_trace(columns), strict=True))
        names = [*bench.traced.outputs, GUARDS, update, *own]
        if bench.traced.indicators is not None:
            names += ["indicators", "jump"]
            traced["indicators"] = bench.evaluate("indicators", columns)
            traced["jump"] = bench.evaluate("jump", columns, np.array(list(point.fired.values())))
        traced["derivative"] = traced[NEXT]
        for name, value in bench.evaluate_with_numpy(point, names).items():
            flat, found = np.ravel(value), np.ravel(traced[name])[: value.size]
            with np.errstate(all="ignore"):
                off = np.abs(found - flat) / (1.0 + np.abs(flat))
            off = np.where(np.isfinite(flat), np.where(np.isnan(off), np.inf, off), 0.0)
            worst = max(worst, float(np.max(off, initial=0.0)))
            if worst > 1e-9:
                raise rule_error(
                    "trace",
                    f"in a {bench.kind} subsystem its traced {name} is {found[:3]} where NumPy gives {flat[:3]} "
                    f"({point}); expected the same. Use np.where and np.stack in place of math.…, float(…), masks, "
                    "and branches on values or types, which trace wrongly.",
                    block,
                    kind=TraceError,
                )
    return worst


def check_derivatives(bench: Bench) -> float:
    """Compare derivatives of the trace with differences, and return the largest relative difference."""
    if bench.block.opaque:
        return 0.0
    function, worst = bench.traced.function, 0.0
    symbols = function.mx_in()
    results = function.call(symbols)[: len(bench.traced.outputs) + 1]
    shown, wanted = ca.densify(ca.vertcat(*results)), ca.vertcat(*symbols[1:-1])
    if not shown.numel() or not wanted.numel():
        return 0.0
    values = ca.Function("values", symbols, [shown])
    slopes = ca.Function("slopes", symbols, [ca.densify(ca.jacobian(shown, wanted))])
    rows = [f"{n}[{i + 1}]" for n, r in zip(bench.names, results, strict=False) for i in range(r.numel())]
    columns = [
        f"{n}[{i + 1}]"
        for n, s in zip(("x", *bench.traced.inputs), symbols[1:-1], strict=True)
        for i in range(s.numel())
    ]
    for point in [*bench.points[:8], *_origin(bench)]:
        at = point.columns()
        flat = np.concatenate(at[1:]) if len(at) > 1 else np.zeros(0)
        parts = lay_out(np.size(v) for v in at[1:])
        h = np.diag(_STEP * (1.0 + np.abs(flat)))
        # all points around this one at once: both sides, and half the distance, which shows whether it is smooth there
        many = flat[:, None] + np.hstack([h, -h, 0.5 * h, -0.5 * h, 0.0 * h[:, :1]])
        y = np.array(values.call([at[0], *(many[part] for part in parts), bench.p])[0])
        n, d = len(flat), np.diag(h)
        y0 = y[:, -1:]
        up, down, half = (
            (y[:, :n] - y0) / d,
            (y0 - y[:, n : 2 * n]) / d,
            (y[:, 2 * n : 3 * n] - y[:, 3 * n : 4 * n]) / d,
        )
        measured = 0.5 * (up + down)
        J = np.array(slopes.call([*at, bench.p])[0])
        size = 1.0 + np.abs(measured) + np.abs(y0)
        with np.errstate(all="ignore"):
            smooth = (np.abs(up - down) < 1e-3 * size) & (np.abs(measured - half) < 1e-4 * size)
            off = np.where(smooth, np.abs(J - measured) / size, 0.0)
        # a derivative that is no number is wrong wherever differences are one
        off = np.where(np.isnan(off), np.inf, off)
        i, j = np.unravel_index(int(np.argmax(off)), off.shape)
        if off[i, j] > 1e-4:
            raise rule_error(
                "derivatives",
                f"in a {bench.kind} subsystem the traced derivative of {rows[i]} by {columns[j]} is {J[i, j]:.6g} "
                f"where differences give {measured[i, j]:.6g} ({point}); expected the same. Write the equation so that "
                "it is smooth there in every operation: u*u, not np.sqrt(u**4); no np.where for a single point.",
                bench.block,
            )
        worst = max(worst, float(off[i, j]))
    return worst


def _origin(bench: Bench) -> list[Point]:
    """Return the start with all inputs zero if their ranges include zero: many operations have an edge there."""
    exercise = bench.exercise
    if exercise.signals or any(np.any((low > 0) | (high < 0)) for low, high in exercise.ranges.values()):
        return []
    first = bench.points[0]
    return [Point(0.0, first.x, {n: np.zeros(s) for n, s in exercise.shapes.items()}, first.fired)]


def check_feedthrough(bench: Bench) -> tuple[set[Pair], set[Pair]]:
    """Return the pairs (input, output) in which the output changed with the input, and those of the trace alone."""
    outputs, own = list(bench.traced.outputs), [n for n in bench.traced.outputs if n not in bench.traced.states]
    depends = bench.traced.depends
    traced = {(u, y) for y in outputs for u in depends[y] if u in bench.traced.inputs}
    measured: set[Pair] = set()
    for number, point in enumerate(bench.points if own else []):
        before = bench.evaluate_with_numpy(point, own)
        for name in bench.traced.inputs:
            for other in (bench.points[number - 1], bench.points[number - 7]):
                after = bench.evaluate_with_numpy(point.with_input(name, other.u[name]), own)
                shows = (y for y in before.keys() & after.keys() if before[y].tobytes() != after[y].tobytes())
                measured |= {(name, y) for y in shows}
    for u, y in sorted(measured - traced):
        raise rule_error(
            "feedthrough",
            f"in a {bench.kind} subsystem the output {y!r} changes with the input {u!r}, and the trace doesn't show "
            "it; expected every dependency in the trace, which orders the blocks. Use NumPy functions of u alone, no "
            "branches on values.",
            bench.block,
            y,
        )
    return measured, traced - measured


def find_swallowed(bench: Bench, pairs: set[Pair]) -> set[Pair]:
    """Return the pairs (input, output) in which a NaN never comes through, though numbers do."""
    found = set(pairs)
    for point in bench.points:
        for name in {u for u, _ in found}:
            columns = point.with_input(name, np.full(np.shape(point.u[name]), np.nan)).columns()
            made = dict(zip(bench.names, bench.evaluate_trace(columns), strict=True))
            found -= {(u, y) for u, y in found if u == name and np.any(np.isnan(made[y]))}
    return found


def check_guards(bench: Bench) -> int:
    """Check that guards are numbers at points, and that each has an error; return the number of guards."""
    block, names = bench.block, [n for n in bench.traced.guards if n.isidentifier()]
    for point in bench.points[:3] if names else []:
        _, x, u, _ = point.arguments()
        made = bench.evaluate_trace(point.columns())
        y = {n: v.reshape(s) for (n, s), v in zip(bench.traced.outputs.items(), made, strict=False)}
        for name in names:
            error = block.guard_error(name, -1.0, bundle("u", u), bundle("y", y), bundle("x", x))
            if not isinstance(error, GuardError):
                raise rule_error(
                    "guards",
                    f"guard_error gave {error!r} for the guard {name!r}; expected a GuardError. Return one.",
                    block,
                )
    return len(names)

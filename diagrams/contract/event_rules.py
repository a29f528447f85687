"""Rules of a block in continuous time: instants, smoothness between them, and events; see `check_block`."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

import casadi as ca
import numpy as np

from ...blocks.core import Block, LoopwrightError, is_before, left_of, right_of
from ...blocks.library import Clock
from ...blocks.tracing import Columns, Point, bundle, initial_state, switching_times
from .exercise import Bench
from .value_rules import rule_error

N = TypeVar("N", float, np.ndarray)

_INSTANTS = 20_000  # of those that a block announces, looked at, at most
_TIMES, _OPAQUE_TIMES = 20_000, 2_001  # at which equations are looked at, and those of an opaque block
_SAME_INSTANT = 100  # jumps that may follow each other at one instant
_FINENESS = 13  # refinements of an interval, by 8 each
_TIME = np.zeros(1), np.ones(1)  # the time as a straight line


def find_instants(block: Block, end: float) -> list[float]:
    """Return the instants up to an end that a block announces, and check that they rise."""
    found: list[float] = []
    t = 0.0
    while len(found) < _INSTANTS:
        following = block.next_instant(t)
        good = isinstance(following, int | float) and following > t and block.next_instant(t) == following
        if not good:
            raise rule_error(
                "next_instant",
                f"next_instant({t!r}) gave {following!r}; expected a later time, the same at every call, or math.inf. "
                "Return the first instant strictly after t.",
                block,
            )
        between = t + 0.5 * (min(following, end) - t)
        if following <= end and block.next_instant(between) != following:
            raise rule_error(
                "next_instant",
                f"next_instant({t!r}) gave {following!r}, but next_instant({between!r}) "
                f"{block.next_instant(between)!r}; expected the same one from all times before it. Return the first "
                "instant strictly after t.",
                block,
            )
        if following > end:
            break
        found.append(float(following))
        t = float(following)
    return found


def check_smooth(bench: Bench, announced: list[float], duration: float) -> int:
    """Look for jumps that ``announced`` instants don't explain, within ``duration``; return the number of intervals."""
    if bench.sampled or not (bench.traced.outputs or bench.traced.states) or bench.block.memory:
        return 0
    searched = 0
    clocks = [name for name, signal in bench.exercise.signals.items() if isinstance(signal.source, Clock)]
    on_clock = [1 + list(bench.traced.inputs).index(name) for name in clocks]  # inputs that are the time itself
    hidden = {} if bench.block.opaque else switching_times(bench.traced, bench.p, dict.fromkeys(clocks, _TIME))
    hidden = {t: late for t, late in hidden.items() if 0.0 < t < duration and not _is_known(t, announced)}
    edges = np.unique([0.0, *announced[:24], *sorted(hidden)[:24], duration])
    points = _OPAQUE_TIMES if bench.block.opaque else _TIMES // (len(edges) - 1) + 65
    function = bench.traced.function
    symbols = function.mx_in()
    *outputs, rates, _ = function.call(symbols)
    rows = [*outputs, *([rates] if bench.traced.advance == "derivative" else [])]
    if not bench.block.opaque:
        rows.append(ca.jacobian(ca.vertcat(*outputs), symbols[0]))
    in_time = ca.Function("in_time", symbols, [ca.densify(ca.vertcat(*rows))])
    rest = bench.points[1].columns()[1:]

    def at(t: np.ndarray) -> Columns:
        return [t[None] if i in on_clock else column for i, column in enumerate(rest)]

    for t in sorted(hidden):
        sides = np.array([left_of(t), right_of(t)])
        before, after = np.array(in_time.call([sides[None], *at(sides), bench.p])[0]).T
        if np.any(np.abs(after - before) > 1e-7 * (1.0 + np.abs(before))):
            raise _jump_error(bench, t)
    for left, right in pairwise(edges):
        margin = 1e-6 * (right - left)

        def time_at(s: N, first: float = left + margin, span: float = right - left - 2.0 * margin) -> N:
            return first + s * span

        def values_at(s: np.ndarray, time_at: Callable[[np.ndarray], np.ndarray] = time_at) -> np.ndarray:
            return np.array(in_time.call([time_at(s)[None], *at(time_at(s)), bench.p])[0])

        def domains_at(s: float, time_at: Callable[[float], float] = time_at) -> tuple[bool, ...]:
            return _evaluate_domains(bench, [time_at(s), *at(np.array([time_at(s)]))])

        where = _find_jump(values_at, domains_at, points)
        searched += 1
        if where is not None:
            raise _jump_error(bench, time_at(where))
    return searched + _search_signals(bench)


def _is_known(t: float, announced: list[float]) -> bool:
    return any(not is_before(t, known) and not is_before(known, t) for known in announced)


def _jump_error(bench: Bench, t: float) -> LoopwrightError:
    return rule_error(
        "next_instant",
        f"its outputs, or their rates, jump at t = {t:.9g} s, and next_instant does not announce it; expected smooth "
        "outputs between instants. Return this time from next_instant, or make an Event.",
        bench.block,
    )


def _search_signals(bench: Bench) -> int:
    """Look for jumps of outputs and rates along straight lines between two points, in inputs and continuous states."""
    shown = len(bench.traced.outputs) + (bench.traced.advance == "derivative")
    pairs = list(zip(bench.points[1:11], bench.points[2:12], strict=True))
    for number, (one, other) in enumerate(pairs):
        u = {n: other.u[n] for n in bench.exercise.ranges}
        for name in bench.exercise.signals:  # as near as two of its samples
            i = int(np.searchsorted(bench.exercise.times, one.t))
            u[name] = bench.exercise.samples[name][min(i + 1, len(bench.exercise.times) - 1)]
        x = {n: v if bench.block.states[n].discrete else other.x[n] for n, v in one.x.items()}
        ends = [one.columns(), Point(one.t, x if number % 2 else one.x, {n: u[n] for n in one.u}, one.fired).columns()]

        def columns_at(s: np.ndarray, ends: list[Columns] = ends) -> Columns:
            pairs = zip(*(e[1:] for e in ends), strict=True)
            return [ends[0][0], *(np.outer(a, 1.0 - s) + np.outer(b, s) for a, b in pairs)]

        def values_at(s: np.ndarray) -> np.ndarray:
            found = [v for v in bench.evaluate_trace(columns_at(s))[:shown] if v.size]
            return np.vstack([np.broadcast_to(v, (len(v), len(s))) for v in found]) if found else np.zeros((0, len(s)))

        where = _find_jump(values_at, lambda s: _evaluate_domains(bench, columns_at(np.array([s]))))
        if where is not None:
            near = [[float(f"{v:.6g}") for v in np.ravel(part)] for part in columns_at(np.array([where]))[1:]]
            shown_at = dict(zip(("x", *one.u), near, strict=True))
            raise rule_error(
                "events",
                f"in a continuous subsystem its outputs or derivatives jump at {shown_at} and no indicator crosses "
                "zero there; expected every discontinuity to be an event. Declare an Event with an indicator that "
                "does, and keep the branch in a State(discrete=True).",
                bench.block,
            )
    return len(pairs)


def _evaluate_domains(bench: Bench, columns: Columns) -> tuple[bool, ...]:
    return () if bench.traced.indicators is None else tuple(bench.evaluate("indicators", columns) > 0.0)


def _find_jump(
    values_at: Callable[[np.ndarray], np.ndarray], domains_at: Callable[[float], tuple[bool, ...]], points: int = 65
) -> float | None:
    """Return a place in [0, 1] at which a row of a function jumps without a change of domains, or None."""
    # The part with the largest change is refined again and again. The change of a smooth function shrinks with it, that
    # of a jump stays.
    grid = np.linspace(0.0, 1.0, points)
    coarse = values_at(grid)
    for row in range(len(coarse)):
        s, values = grid, coarse[row]
        if not np.all(np.isfinite(values)):
            continue
        scale = 1.0 + np.max(np.abs(values))
        first = np.max(np.abs(np.diff(values))) / scale
        for _ in range(_FINENESS):
            change = np.abs(np.diff(values)) / scale
            i = int(np.argmax(change))
            if not change[i] > 1e-3 * first or not change[i] > 1e-7:
                break
            s = np.linspace(s[i], s[i + 1], 9)
            values = values_at(s)[row]
        else:
            low, high = max(s[0] - 1e-7, 0.0), min(s[-1] + 1e-7, 1.0)
            if domains_at(low) == domains_at(high):
                return float(s[-1])
    return None


# --- events -----------------------------------------------------------------------------------------------------------


def check_events(bench: Bench) -> tuple[int, set[str]]:
    """Go along the exercise in small steps, with jumps; return the number of events fired, and those that never did."""
    block, exercise = bench.block, bench.exercise
    if bench.traced.indicators is None:
        return 0, set()
    names, kinds = list(block.events), [port.direction for port in block.events.values()]
    x, shown = np.asarray(bench.points[0].columns()[1]), np.zeros(len(names), dtype=int)
    if block.starts_from_inputs:
        first = {n: np.asarray(v) for n, v in exercise.inputs_at(0).items()}
        x = initial_state(block, bench.traced.states, bundle("u", first))
    above = None
    h = exercise.times[1]
    for i, t in enumerate(exercise.times):
        inputs = [np.ravel(v) for v in exercise.inputs_at(i).values()]
        # jumps follow each other at one instant until nothing fires, as in a run
        for count in range(_SAME_INSTANT + 1):
            z = bench.evaluate("indicators", [t, x, *inputs])
            if not np.all(np.isfinite(z)):
                bad = names[int(np.argmin(np.isfinite(z)))]
                raise rule_error(
                    "events",
                    f"its indicator is {z.tolist()} at t = {t:.6g} s, x = {x.tolist()}; expected finite numbers. "
                    "Guard the operation that fails with np.where.",
                    block,
                    bad,
                )
            now = z > 0.0
            above = now if above is None else above
            changes = {"both": now != above, "rising": now & ~above, "falling": above & ~now}
            fired = np.array([changes[kind][j] for j, kind in enumerate(kinds)])
            above = now
            if not fired.any():
                break
            if count == _SAME_INSTANT:
                again = ", ".join(n for n, f in zip(names, fired, strict=True) if f)
                raise rule_error(
                    "events",
                    f"at t = {t:.6g} s its events keep firing ({again}), {count} times at one instant; expected a "
                    "jump after which nothing fires. Let it lead to a state in which the indicator keeps its sign.",
                    block,
                )
            shown += fired
            x = bench.evaluate("jump", [t, x, *inputs], fired.astype(float))
        # Euler's method: where events fire matters here, and not how exact the states are
        if bench.traced.advance == "derivative":
            x = x + h * np.ravel(bench.evaluate_trace([t, x, *inputs])[len(bench.traced.outputs)])
    return int(shown.sum()), {n for n, count in zip(names, shown, strict=True) if not count}

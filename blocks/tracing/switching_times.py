"""Times at which equations switch: comparisons, limits and absolute values of the time alone, read from a trace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from .traced import Traced

Line: TypeAlias = tuple[np.ndarray, np.ndarray]
"""A signal that is a straight line in time: its value at t = 0 and its slope, flat."""

_SWITCHES = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_FMIN, ca.OP_FMAX}
_SIDES = {ca.OP_SIGN, ca.OP_FABS}
_LARGEST = 20_000  # operations beyond which a trace is not searched


def switching_times(traced: Traced, p: np.ndarray, lines: Mapping[str, Line]) -> dict[float, bool]:
    """Return the times at which outputs or rates may not be smooth, where ``lines`` are the inputs that are lines.

    Each comes with whether the equations still have the value from before at the time itself, as ``t > 0.5`` has.
    """
    try:
        function = traced.function.expand()
    except RuntimeError:  # a table, or an opaque block
        return {}
    if function.n_instructions() > _LARGEST:
        return {}
    t = ca.SX.sym("t")
    x = ca.SX.sym("x", function.size1_in(1))
    u = [
        ca.SX(ca.DM(lines[name][0])) + ca.SX(ca.DM(lines[name][1])) * t if name in lines else ca.SX.sym(name, size)
        for i, name in enumerate(traced.inputs)
        for size in [function.size1_in(2 + i)]
    ]
    results = function.call([t, x, *u, ca.DM(p)])
    times: dict[float, bool] = {}
    for operation, switch in _find_switches(results):
        e = ca.SX(switch)
        if not _is_of(e, t):
            continue
        slope = ca.jacobian(e, t)
        if ca.symvar(slope) or slope.is_zero():
            continue
        at_zero = float(ca.evalf(ca.substitute(e, t, ca.SX(0.0))))
        rate = float(ca.evalf(slope))
        root = -at_zero / rate
        late = (operation == ca.OP_LT and rate < 0) or (operation == ca.OP_LE and rate > 0)
        if np.isfinite(root):
            times[root] = times.get(root, False) or late
    return times


def _find_switches(results: list[Any]) -> list[tuple[int, Any]]:
    """Return the operations that switch, anywhere in some results, each with the expression whose sign decides."""
    todo = [e for result in results for e in result.nonzeros()]
    seen, found = set[int](), list[tuple[int, Any]]()
    while todo:
        e = todo.pop()
        key = e.element_hash()
        if key in seen:
            continue
        seen.add(key)
        if e.is_leaf():
            continue
        parts = [e.dep(i) for i in range(e.n_dep())]
        if e.op() in _SWITCHES:
            found.append((e.op(), parts[0] - parts[1]))
        elif e.op() in _SIDES:
            found.append((e.op(), parts[0]))
        todo += parts
    return found


def _is_of(e: Any, t: Any) -> bool:
    names = ca.symvar(e)
    return len(names) == 1 and bool(ca.is_equal(names[0], t))

"""What a block computes by plain Python, traced for exported code: its start states, numbers of its parameters.

A run computes them with Python. An exported diagram has none: there its start and a change of a parameter need them as
functions. A block for which that can't be done is left as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ..core import Block
from .discretization import hold_of_symbols
from .equations import match_ports
from .structure import traced_parameters
from .symbols import bundle, flat_column, size, wrap
from .traced import Traced, _Tracer, constants_of

_SAME = 1e-9  # relative difference between a traced result and Python's, beyond which it is another one


def trace_initial(
    block: Block, traced: Traced, sampled: bool, at: Mapping[str, np.ndarray], p: np.ndarray, expected: np.ndarray
) -> Any:
    """Return the states that ``initial`` computes, as a function of the inputs' columns and p; None if that fails."""
    # it is compared with the states that Python's `initial` returns at the inputs `at`; all are flat
    try:
        tracer = _Tracer(block, dict(traced.inputs), sampled, traced.method, True)
        u = bundle("u", {n: wrap(c, s) for (n, s), c in zip(traced.inputs.items(), tracer.u, strict=True)})
        made = match_ports(tracer._shadow().initial(u), traced.states, "initial")[0]
        q = ca.MX.sym("p", len(p))
        states = ca.substitute([ca.densify(ca.vertcat(*made.values()))], [tracer.p], [q[: tracer.p.numel()]])
        function = ca.Function("initial", [*tracer.u, q], states)
        found = function(*at.values(), p).full().ravel()
    except Exception:  # whatever can't be traced
        return None
    return function if np.allclose(found, expected, rtol=_SAME, atol=_SAME) else None


def trace_numbers(block: Block, traced: Traced, T: float, p: np.ndarray) -> Any:
    """Return all numbers behind the parameters in p as a CasADi function of these; None if that fails."""
    # T is NaN in continuous time; the function is compared with p, as `Traced.pack` gives it
    entries = [*traced_parameters(block)]
    count = sum(int(np.size(value)) for _, value in entries)
    try:
        tracer = _Tracer(block, dict(traced.inputs), bool(np.isfinite(T)), traced.method, True)
        numbers: list[Any] = [tracer.p[:count], ca.MX(T)]
        if tracer.constants:
            made = constants_of(tracer._shadow(), T, traced.method)
            numbers += [_column(made[name], np.shape(value)) for name, value in tracer.constants.items()]
        if traced.system_matrix is not None:
            n = sum(size(s) for s in traced.states.values())
            A = ca.reshape(traced.system_matrix(ca.vertcat(*numbers)), n, n)
            numbers += [_column(part, (n, n)) for part in hold_of_symbols(A, T, traced.method)]
        q = ca.MX.sym("q", count)
        every = ca.densify(ca.vertcat(*(part for part in numbers if part.numel())))
        whole = ca.substitute([every], [tracer.p], [ca.vertcat(q, ca.MX(tracer.p.numel() - count, 1))])
        function = ca.Function("numbers", [q], [ca.densify(whole[0])[count:]])
        found = function(p[:count]).full().ravel()
    except Exception:  # whatever can't be traced
        return None
    return function if np.allclose(found, p[count:], rtol=_SAME, atol=_SAME, equal_nan=True) else None


def _column(value: Any, shape: tuple[int, ...]) -> Any:
    found = flat_column(value)
    assert found.numel() == size(shape)
    return found

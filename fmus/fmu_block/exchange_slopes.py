"""Derivatives of an FMU in model exchange at a point of its run: differences, and its own held against them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ...blocks.core import Layout
from ..archive import FmuVariable
from ..calls import is_smooth
from .difference_quotients import Column, Differences, differentiate
from .fmu import Fmu
from .linearization import EQUATIONS
from .slope_check import SlopeCheck, check_slopes


def find_exchange_slopes(
    block: Fmu,
    wired: Sequence[str],
    values: Callable[[np.ndarray, np.ndarray], np.ndarray],
    x: np.ndarray,
    u: np.ndarray,
) -> Differences:
    """Return the derivative of ``values(x, u)``, flat, by (x, u) of model exchange, by differences.

    Wired inputs are moved; others, and those without derivatives, have zero columns.
    """
    about, places = block.description, Layout.of({p: v.shape for p, v in block.input_variables.items()}).slices
    moved = {port: v for port, v in block.input_variables.items() if port in wired and is_smooth(v)}
    parts = [(v, x, where) for v, where in _states_in(block)]
    parts += [(v, u, places[port]) for port, v in moved.items()]
    base = values(x, u)
    many = x.size + u.size
    made = Differences(np.zeros((base.size, 0)), np.zeros((base.size, 0)), np.zeros(0), base).place([], many)
    for variable, vector, where in parts:
        column = Column(about, [variable.name], vector[where], EQUATIONS)

        def evaluate(name: str, moved: np.ndarray, vector: np.ndarray = vector, where: slice = where) -> np.ndarray:
            changed = vector.copy()
            changed[where] = moved
            return values(changed, u) if vector is x else values(x, changed)

        first = where.start if vector is x else x.size + where.start
        made += differentiate(column, base, evaluate).place([*range(first, first + variable.size)], many)
    return made


def _states_in(block: Fmu) -> Iterator[tuple[FmuVariable, slice]]:
    """Yield the variables of the continuous states, and where they are among these."""
    about = block.description
    layout = about.layout(about.states).slices
    yield from ((about.find(name), layout[name]) for name in about.states)


def check_exchange_slopes(
    block: Fmu,
    wired: Sequence[str],
    values: Callable[[np.ndarray, np.ndarray], np.ndarray],
    x: np.ndarray,
    u: np.ndarray,
    J: np.ndarray,
) -> SlopeCheck:
    """Return the FMU's own derivatives ``J`` of values by (x, u), held against differences; see `check_slopes`."""
    places = Layout.of({p: v.shape for p, v in block.input_variables.items()}).slices
    n = x.size
    nominals, low, high = np.ones(n + u.size), np.full(n + u.size, -np.inf), np.full(n + u.size, np.inf)
    moved = np.arange(n + u.size) < n
    parts = list(_states_in(block))
    for port, v in block.input_variables.items():
        where = slice(n + places[port].start, n + places[port].stop)
        moved[where] = port in wired and is_smooth(v)
        parts.append((v, where))
    for v, where in parts:
        nominals[where] = np.ravel(v.nominals)
        low[where], high[where] = (np.ravel(side) for side in v.limits)
    return check_slopes(J, lambda at: values(at[:n], at[n:]), np.concatenate([x, u]), nominals, (low, high), moved)

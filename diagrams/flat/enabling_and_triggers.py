"""Logic of truth values and symbols alike: the signals that enable and trigger subsystems.

A condition is a Python ``bool`` where it is known while a diagram is traced, else a CasADi symbol; so whatever is known
is left out of the traced function.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from .program import AND, CHOOSE, LESS, NOT, OR, TRUE_OF, Cells

TRUE = 0.5
"""A logic signal is true above this."""


def is_true(value: Any) -> Any:
    """Whether a logic signal (a column of one entry) is true."""
    if isinstance(value, Cells):
        return value.program.apply(TRUE_OF, value)
    if isinstance(value, ca.MX):
        return value > TRUE
    return bool(float(np.ravel(np.array(value))[0]) > TRUE)


def above_true(value: Any) -> Any:
    """Return by how much a logic signal is above the value from which it is true."""
    return value.program.apply(LESS, value) if isinstance(value, Cells) else value - TRUE


def logic_and(a: Any, b: Any) -> Any:
    """Logic and, of truth values or symbols."""
    if isinstance(a, bool):
        return b if a else False
    if isinstance(b, bool):
        return a if b else False
    if isinstance(a, Cells):
        return a.program.apply(AND, a, b)
    return ca.logic_and(a, b)


def logic_or(a: Any, b: Any) -> Any:
    """Logic or, of truth values or symbols."""
    if isinstance(a, bool) and isinstance(b, bool):
        return a or b
    if isinstance(a, Cells) or isinstance(b, Cells):
        program = a.program if isinstance(a, Cells) else b.program
        return program.apply(OR, *(np.array([float(v)]) if isinstance(v, bool) else v for v in (a, b)))
    return ca.logic_or(a, b)


def logic_not(a: Any) -> Any:
    """Logic not, of a truth value or a symbol."""
    if isinstance(a, Cells):
        return a.program.apply(NOT, a)
    return not a if isinstance(a, bool) else ca.logic_not(a)


def to_number(a: Any) -> Any:
    """Return 1.0 or 0.0 for a truth value; a symbol stays."""
    return np.array([float(a)]) if isinstance(a, bool) else a


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` where the condition holds, else ``b``; NaN in the other one does no harm."""
    if isinstance(condition, bool):
        return a if condition else b
    if isinstance(condition, Cells):
        return condition.program.apply(CHOOSE, condition, a, b)
    return ca.if_else(condition, a, b)

"""Newton's method for the algebraic loops of a tick, as C knows it: `fmus/runtime/newton.c`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .bound_functions import TickStructure


class NewtonStructure(ctypes.Structure):
    """The algebraic loops of a tick, as C knows them."""

    _fields_ = [
        ("n", ctypes.c_int64),
        ("equations", TickStructure),
        *((name, ctypes.c_void_p) for name in ("where", "r", "J", "v", "before", "direction", "column", "lu", "rows")),
        *((name, ctypes.c_double) for name in ("tolerance", "rounding", "singular")),
        *((name, ctypes.c_int64) for name in ("iterations", "halvings")),
        ("help", ctypes.c_void_p),
    ]


@dataclass(frozen=True)
class NewtonOptions:
    """Newton's method for the algebraic loops of a tick.

    Attributes
    ----------
    where : sequence of int
        Entries of x that hold the values of the loops.
    tolerance, rounding : float
        Residuals, relative to 1 + the size of the values: up to the one a loop counts as solved, up to the other it is
        solved no further.
    singular : float
        Least singular value of the derivative that surely determines the values, relative to 1 + the loop's gain.
    iterations, halvings : int
        Steps, and halvings of a step, at most.
    solver : callable
        ``solver(t, x, call, r, J)`` returns Python's function that solves the loops where C can't: with the vectors t
        and x, and ``call``, which evaluates the mismatch r and its derivative J.
    """

    where: Sequence[int]
    tolerance: float
    rounding: float
    singular: float
    iterations: int
    halvings: int
    solver: Callable[..., Callable[[], None]]

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
    """Newton's method for the algebraic loops of a tick."""

    where: Sequence[int]  # entries of x that hold the values of the loops
    tolerance: float  # residual, relative to 1 + the size of the values, at which a loop counts as solved
    rounding: float  # residual below which it is solved no further
    singular: float  # least singular value that determines the values, relative to 1 + the loop's gain
    iterations: int
    halvings: int
    # solver(t, x, call, r, J): Python's, where C can't; call evaluates r and J
    solver: Callable[..., Callable[[], None]]

"""Methods of integration, bound for the loop in C, which has their steps, norms and control; SciPy has coefficients."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..solvers import METHODS, MethodKind
from .bound_functions import MemoryForC
from .hybrid_structures import MethodStructure, ProblemStructure
from .library_method import LibraryMethod
from .method_coefficients import error_exponent, radau_numbers, tableau

_MOST_STAGES = 17  # at most 16 stages, those of DOP853 with its end, and three for its dense output


@dataclass(frozen=True, eq=False)
class MethodOptions:
    """A method of integration."""

    name: str  # one of `METHODS`
    rtol: float
    atol: np.ndarray  # shape (n,)
    longest: float  # longest step in s; of a method of fixed step, its step


class IntegrationMethod:
    """A method of integration, bound to the differential equation of a run.

    ``labels`` are the names of the integrated states; ``step`` is the address of a generated step, or None.
    """

    def __init__(self, options: MethodOptions, problem: ProblemStructure, labels: Sequence[str], step: int | None):
        n, facts, memory = len(labels), METHODS[options.name], MemoryForC()
        self.name, self.kept = options.name, memory.kept
        self.tolerance = np.broadcast_to(options.atol, (n,)).astype(float)
        self.structure = of = MethodStructure(
            kind=facts.kind,
            stages=facts.stages,
            n=n,
            of=ctypes.addressof(problem),
            rtol=options.rtol,
            atol=memory.own(self.tolerance),
            longest=options.longest,
            planned=np.nan,
            step=step,
            K=memory.zeros(_MOST_STAGES * n),
            D=memory.zeros(7 * n),
            **{name: memory.zeros(n) for name in ("x", "x_old", "f", "y", "g")},
        )
        if facts.kind in (MethodKind.EXPLICIT, MethodKind.EIGHT):
            _set_embedded(of, options.name, memory)
        elif facts.kind is MethodKind.RADAU:
            _set_radau(of, n, options.rtol, memory)
        self.library: LibraryMethod | None = None
        """A library's method, which is asked for steps by a callback into Python; None where C takes the steps."""
        if facts.kind is MethodKind.LIBRARY:
            self.library = LibraryMethod(options.name, options.rtol, options.atol, options.longest, labels, problem, of)

    def set_absolute_tolerance(self, atol: np.ndarray) -> None:
        """Take another absolute tolerance, shape (n,)."""
        self.tolerance[:] = atol
        if self.library is not None:
            self.library.set_absolute_tolerance(atol)


def _set_embedded(of: MethodStructure, name: str, memory: MemoryForC) -> None:
    """Give C the coefficients of an embedded method."""
    found = tableau(name)
    for letter, values in found.items():
        setattr(of, letter, memory.own(values))
    of.stages, of.exponent = len(found["B"]), error_exponent(name)
    of.order = 7 if name == "DOP853" else found["P"].shape[1]
    of.extra = len(found.get("C_extra", ()))


def _set_radau(of: MethodStructure, n: int, rtol: float, memory: MemoryForC) -> None:
    """Give C the numbers of Radau IIA, and room for its linear equations."""
    of.order, of.exponent = 3, 3
    of.A = memory.own(radau_numbers())
    of.tolerance = max(10 * np.finfo(float).eps / rtol, min(0.03, rtol**0.5))
    of.J, of.lu, of.lu_complex = (memory.zeros(k * n * n) for k in (1, 1, 2))
    of.Z, of.W, of.F = (memory.zeros(3 * n) for _ in range(3))
    of.error, of.scale = (memory.zeros(n) for _ in range(2))
    of.pivots, of.pivots_complex = (memory.own(np.zeros(n, dtype=np.int64)) for _ in range(2))

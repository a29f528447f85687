"""Methods of integration, bound for the loop in C: those whose steps C takes, and those of SciPy and SUNDIALS."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...blocks.called_back import CalledBack
from ..solvers import METHODS, AcceptedStep, MethodKind, Problem, Solver, make_solver
from .bound_functions import MemoryForC
from .compiled_libraries import load_runtime
from .hybrid_structures import MethodStructure, ProblemStructure
from .method_coefficients import error_exponent, radau_numbers, tableau

_MOST_STAGES = 17  # at most 16 stages, those of DOP853 with its end, and three for its dense output
MOST_POWERS = 12
"""Highest order of their dense output: that of Adams' methods."""
_BEGIN, _STEP_ON, _EXPAND = range(3)
_PASSED, _FAILED = range(2)
_Library = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int32)


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


@dataclass(frozen=True)
class StepFailure:
    """A step that a library could not take."""

    error: BaseException  # of the solver, or what was raised in a call
    beyond: tuple[float, np.ndarray] | None  # time in s and states of the last trial with a rate that was not finite
    edge: float  # the end of the stretch in s, and the last time before it
    left: float


class LibraryMethod:
    """A method of another library, bound to the differential equation of a run.

    Its dense output is a polynomial from the start of each step, x + Σ cₖ uᵏ, which C evaluates: the coefficients of
    BDF come from its backward differences, those of LSODA from its Nordsieck array, those of CVODE from derivatives at
    the start. The method's own polynomial has the same degree, so that both are equal but for rounding. ``names`` are
    those of the states, for messages.
    """

    def __init__(
        self,
        name: str,
        rtol: float,
        atol: np.ndarray,
        longest: float,
        names: Sequence[str],
        problem: ProblemStructure,
        method: MethodStructure,
    ):
        n = len(names)
        self._name, self._rtol, self._atol, self._longest = name, rtol, atol.copy(), longest
        self._problem, self._method = problem, method
        self._of = Problem(n, self._rate, self._slope, names)
        self._trial, self._rates, self._zeros = np.zeros(n), np.zeros(n), np.zeros(n)
        self._slopes = np.zeros((n, n) if METHODS[name].uses_slope else 0)
        self._end, self._powers = np.zeros(n), np.zeros((MOST_POWERS, n))
        method.x, method.D = self._end.ctypes.data, self._powers.ctypes.data
        runtime = load_runtime()
        self._evaluate, self._differentiate = runtime["loopwright_rates"], runtime["loopwright_slope"]
        for function, result in ((self._evaluate, None), (self._differentiate, ctypes.c_int)):
            function.restype = result
            function.argtypes = (ctypes.c_void_p, ctypes.c_double, *[ctypes.c_void_p] * 2)
        self._at = ctypes.addressof(problem), self._trial.ctypes.data, self._rates.ctypes.data, self._slopes.ctypes.data
        self._called = CalledBack()
        method.library = self._called.function(_Library, self._answer, _FAILED)
        self._beyond: tuple[float, np.ndarray] | None = None
        self._step: AcceptedStep | None = None
        self._solver = self._make_solver()

    def begin_again(self) -> None:
        """Forget the run before."""
        self._beyond = self._step = None
        self._called.take_error()
        self._solver = self._make_solver()

    def set_absolute_tolerance(self, atol: np.ndarray) -> None:
        """Take other absolute tolerances from the next discontinuity on."""
        if not np.array_equal(atol, self._atol):
            self._atol = atol.copy()
            self._solver.set_absolute_tolerance(self._atol)

    def take_failure(self) -> StepFailure | None:
        """Return why the last step could not be taken; None if it could."""
        error = self._called.take_error()
        return None if error is None else StepFailure(error, self._beyond, self._problem.edge, self._problem.left)

    def _make_solver(self) -> Solver:
        longest = self._longest if np.isfinite(self._longest) else None
        return make_solver(self._name, self._of, rtol=self._rtol, atol=self._atol, max_step=longest)

    # --- calls of C --------------------------------------------------------------------------------------------------

    def _answer(self, wanted: int) -> int:
        """Take a step, or write the last one's dense output."""
        if wanted == _EXPAND:
            self._expand()
        else:
            self._take_step(begins=wanted == _BEGIN)
        return _PASSED

    def _take_step(self, *, begins: bool) -> None:
        method, solver = self._method, self._solver
        if begins:
            solver.restart(method.t, self._end, self._problem.stop)
        self._step = solver.step()
        self._end[:] = self._step.x
        method.t = self._step.t

    def _expand(self) -> None:
        self._method.order, self._powers[0] = 1, np.nan  # if this fails, C goes no further
        assert self._step is not None
        found = self._step.prepare().coefficients
        self._method.order = len(found)
        self._powers[: self._method.order] = found

    # --- calls of the library ----------------------------------------------------------------------------------------

    def _rate(self, t: float, x: np.ndarray) -> np.ndarray:
        problem, trial, rates, _ = self._at
        self._trial[:] = x
        self._evaluate(problem, t, trial, rates)
        if self._zeros.dot(self._rates) != 0.0:  # one of them is not finite
            self._beyond = t, self._trial.copy()
        return self._rates

    def _slope(self, t: float, x: np.ndarray) -> np.ndarray:
        problem, trial, _, slopes = self._at
        self._trial[:] = x
        if not self._differentiate(problem, t, trial, slopes):
            self._slopes[:] = np.nan
        return self._slopes

"""CVODE, the multistep solver of SUNDIALS, in compiled code.

FMPy, which Loopwright needs anyway, brings SUNDIALS for Linux and Windows (x86_64) and macOS (arm64), so nothing else
is to be installed. The calls go through ctypes: one step at a time up to a stop time, the method's own dense output,
the exact Jacobian, and a cheap start after each discontinuity.

============  ================  ======================================  ================================================
name          order             each step is solved by                  choose it for
============  ================  ======================================  ================================================
CVODE_BDF     1 to 5            Newton, with the exact Jacobian          stiff
CVODE_Adams   1 to 12           fixed point                             not stiff, tight tolerances, costly rates
============  ================  ======================================  ================================================

The dense output has the order of the step. Reference: A. C. Hindmarsh et al., SUNDIALS: Suite of nonlinear and
differential/algebraic equation solvers, ACM Trans. Math. Softw. 31 (2005), 363-396.
"""

from __future__ import annotations

import ctypes
import functools
import weakref
from collections.abc import Callable
from ctypes import CFUNCTYPE, POINTER, byref, c_char_p, c_double, c_int, c_int64, c_void_p
from typing import Any

import numpy as np

from ...blocks.called_back import CalledBack
from ...blocks.core import NonFiniteError, OptionError
from ...blocks.interrupts import INTERRUPTS
from .base import AcceptedStep, Polynomial, Problem, Solver
from .dense_output import from_derivatives

_ADAMS, _BDF, _ONE_STEP = 1, 2, 2
_MEMORY = -20  # this code and those below are misuse or lack of memory, not mathematics
_RATE = CFUNCTYPE(c_int, c_double, c_void_p, c_void_p, c_void_p)
_JACOBIAN = CFUNCTYPE(c_int, c_double, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p)
_MESSAGE = CFUNCTYPE(None, c_int, c_char_p, c_char_p, c_char_p, c_int, c_void_p, c_void_p)

_FUNCTIONS: dict[str, dict[str, tuple[Any, ...]]] = {  # library → function → result, arguments
    "sundials_core": {
        "SUNContext_Create": (c_int, c_int, POINTER(c_void_p)),
        "SUNContext_Free": (c_int, POINTER(c_void_p)),
        "SUNContext_ClearErrHandlers": (c_int, c_void_p),
        "SUNContext_PushErrHandler": (c_int, c_void_p, _MESSAGE, c_void_p),
        "N_VGetArrayPointer": (c_void_p, c_void_p),
        "N_VDestroy": (None, c_void_p),
        "SUNMatDestroy": (None, c_void_p),
        "SUNLinSolFree": (c_int, c_void_p),
        "SUNDIALSGetVersionNumber": (c_int, POINTER(c_int), POINTER(c_int), POINTER(c_int), c_char_p, c_int),
    },
    "sundials_nvecserial": {"N_VNew_Serial": (c_void_p, c_int64, c_void_p)},
    "sundials_sunmatrixdense": {
        "SUNDenseMatrix": (c_void_p, c_int64, c_int64, c_void_p),
        "SUNDenseMatrix_Data": (c_void_p, c_void_p),
    },
    "sundials_sunlinsoldense": {"SUNLinSol_Dense": (c_void_p, c_void_p, c_void_p, c_void_p)},
    "sundials_cvode": {
        "CVodeCreate": (c_void_p, c_int, c_void_p),
        "CVodeFree": (None, POINTER(c_void_p)),
        "CVodeInit": (c_int, c_void_p, c_void_p, c_double, c_void_p),
        "CVodeReInit": (c_int, c_void_p, c_double, c_void_p),
        "CVodeSVtolerances": (c_int, c_void_p, c_double, c_void_p),
        "CVodeSetLinearSolver": (c_int, c_void_p, c_void_p, c_void_p),
        "CVodeSetJacFn": (c_int, c_void_p, c_void_p),
        "CVodeSetNonlinearSolver": (c_int, c_void_p, c_void_p),
        "CVodeSetMaxStep": (c_int, c_void_p, c_double),
        "CVodeSetMaxErrTestFails": (c_int, c_void_p, c_int),
        "CVodeSetMaxConvFails": (c_int, c_void_p, c_int),
        "CVodeSetMaxHnilWarns": (c_int, c_void_p, c_int),
        "CVodeSetStopTime": (c_int, c_void_p, c_double),
        "CVode": (c_int, c_void_p, c_double, c_void_p, POINTER(c_double), c_int),
        "CVodeGetDky": (c_int, c_void_p, c_double, c_int, c_void_p),
        "CVodeGetLastOrder": (c_int, c_void_p, POINTER(c_int)),
        "CVodeGetCurrentStep": (c_int, c_void_p, POINTER(c_double)),
        "SUNNonlinSol_FixedPoint": (c_void_p, c_void_p, c_int, c_void_p),
        "SUNNonlinSolFree": (c_int, c_void_p),
    },
}


class _Library:
    """The functions of `_FUNCTIONS`, by name."""

    def __init__(self, libraries: Any):
        for library, functions in _FUNCTIONS.items():
            for name, (result, *arguments) in functions.items():
                function = getattr(libraries, library)[name]  # [] makes a new one: FMPy's own keeps its types
                function.restype, function.argtypes = result, arguments
                setattr(self, name, function)

    def __getattr__(self, name: str) -> Callable[..., int]:  # for type checkers: all attributes are set above
        raise AttributeError(name)


@functools.cache
def _load_library() -> _Library:
    try:
        from fmpy.sundials import libraries

        library = _Library(libraries)
    except (ImportError, OSError, AttributeError) as error:
        raise OptionError(
            f"SUNDIALS can't be loaded: {error}. Expected version 7, as FMPy brings it for Linux and Windows (x86_64) "
            "and macOS (arm64) from 0.3.28 on: pip install -U fmpy, or take solver='BDF', the same kind of method."
        ) from error
    major = c_int()
    library.SUNDIALSGetVersionNumber(byref(major), byref(c_int()), byref(c_int()), ctypes.create_string_buffer(8), 8)
    if major.value != 7:
        raise OptionError(
            f"found SUNDIALS {major.value} in FMPy; expected 7. Install another version of FMPy, or take solver='BDF'."
        )
    return library


class _CvodeCalls(CalledBack):
    """What CVODE calls: the rates, their derivative, and where its messages go."""

    def __init__(self, problem: Problem, library: _Library):
        super().__init__()
        self.problem, self.library = problem, library
        self.stop, self.message = 0.0, ""
        self._views: dict[int, np.ndarray] = {}
        self.rate, self.jacobian = self.function(_RATE, self._rate, -1), self.function(_JACOBIAN, self._jacobian, -1)
        self.say = _MESSAGE(self._say)

    def view(self, address: int, size: int) -> np.ndarray:
        """Return the memory at this address as an array."""
        if address not in self._views:
            self._views[address] = np.frombuffer(memoryview((c_double * size).from_address(address)).cast("B"))
        return self._views[address]

    def vector(self, handle: int) -> np.ndarray:
        """Return the memory of a vector as an array."""
        return self.view(self.library.N_VGetArrayPointer(handle), self.problem.size)

    def _rate(self, t: float, x: int, f: int, _: object) -> int:
        rates = self.vector(f)
        rates[:] = self.problem.rate(min(t, self.stop), self.vector(x))
        return 0 if np.isfinite(rates).all() else 1  # 1: try a shorter step

    def _jacobian(self, t: float, x: int, f: int, matrix: int, *_: object) -> int:
        n = self.problem.size
        columns = self.view(self.library.SUNDenseMatrix_Data(matrix), n * n).reshape(n, n)
        columns.T[:] = self.problem.jacobian(min(t, self.stop), self.vector(x))
        return 0 if np.isfinite(columns).all() else 1

    def _say(self, line: int, function: bytes, file: bytes, message: bytes, code: int, *_: object) -> None:
        self.message = message.decode("utf-8", "replace")


class Cvode(Solver):
    """CVODE with variable-order BDF (stiff) or Adams (not stiff). It selects its first step again at each restart."""

    def __init__(self, name: str, problem: Problem, rtol: float, atol: float | np.ndarray, max_step: float):
        super().__init__(name, problem, rtol, atol, max_step)
        self._library = library = _load_library()
        self._calls = calls = _CvodeCalls(problem, library)
        context = c_void_p()
        library.SUNContext_Create(0, byref(context))
        library.SUNContext_ClearErrHandlers(context)
        library.SUNContext_PushErrHandler(context, calls.say, None)
        adams, n = name == "CVODE_Adams", problem.size
        self._x, self._dky, tolerances = (library.N_VNew_Serial(n, context) for _ in range(3))
        self._memory = memory = library.CVodeCreate(_ADAMS if adams else _BDF, context)
        calls.vector(self._x)[:] = 0.0
        calls.vector(tolerances)[:] = atol
        library.CVodeInit(memory, calls.rate, 0.0, self._x)
        library.CVodeSVtolerances(memory, rtol, tolerances)
        matrix = linear = fixed_point = None
        if adams:
            fixed_point = library.SUNNonlinSol_FixedPoint(self._x, 0, context)
            library.CVodeSetNonlinearSolver(memory, fixed_point)
        else:
            matrix = library.SUNDenseMatrix(n, n, context)
            linear = library.SUNLinSol_Dense(self._x, matrix, context)
            library.CVodeSetLinearSolver(memory, linear, matrix)
            library.CVodeSetJacFn(memory, calls.jacobian)
        library.CVodeSetMaxErrTestFails(memory, 30)
        library.CVodeSetMaxConvFails(memory, 40)
        library.CVodeSetMaxHnilWarns(memory, -1)
        library.CVodeSetMaxStep(memory, 0.0 if max_step == np.inf else max_step)  # 0: none
        vectors = (self._x, self._dky, tolerances)
        weakref.finalize(self, _free, calls, memory, (matrix, linear, fixed_point), vectors, context)
        self._tolerances = tolerances
        self._t, self._x_old, self._t_new = 0.0, np.empty(0), c_double()

    def set_absolute_tolerance(self, atol: float | np.ndarray) -> None:
        """Take another absolute tolerance; see `Integration.set_absolute_tolerance`."""
        super().set_absolute_tolerance(atol)
        self._calls.vector(self._tolerances)[:] = atol
        self._library.CVodeSVtolerances(self._memory, self.rtol, self._tolerances)

    def _start(self, t: float, x: np.ndarray) -> None:
        self._calls.stop, self._t, self._x_old = self.stop, t, x
        self._calls.take_error()
        self._calls.vector(self._x)[:] = x
        self._check(self._library.CVodeReInit(self._memory, t, self._x))
        self._check(self._library.CVodeSetStopTime(self._memory, self.stop))

    def _advance(self) -> AcceptedStep:
        t, x_old = self._t, self._x_old
        with INTERRUPTS.kept():  # one that comes as CVODE calls Python
            code = self._library.CVode(self._memory, self.stop, self._x, byref(self._t_new), _ONE_STEP)
        self._check(code)
        self._t, self._x_old = self._t_new.value, self._calls.vector(self._x).copy()
        self.check_finite(self._t, self._x_old, "state")
        return AcceptedStep(t, self._t, self._x_old.copy(), lambda: self._prepare_dense(t, x_old))

    def _prepare_dense(self, t_old: float, x_old: np.ndarray) -> Polynomial:
        order = c_int()
        self._check(self._library.CVodeGetLastOrder(self._memory, byref(order)))
        derivatives = np.empty((order.value, self.problem.size))
        for k in range(order.value):
            self._check(self._library.CVodeGetDky(self._memory, t_old, k + 1, self._dky))
            derivatives[k] = self._calls.vector(self._dky)
        return from_derivatives(t_old, x_old, self._t - t_old, derivatives)

    def _check(self, code: int) -> None:
        if code >= 0:
            return
        self._calls.check()
        if code <= _MEMORY:
            raise RuntimeError(f"CVODE: {self._calls.message} (code {code})")
        h = c_double()
        self._library.CVodeGetCurrentStep(self._memory, byref(h))
        failure = self.failure(self._t, self._x_old, h.value)
        if not isinstance(failure, NonFiniteError):
            failure.message += f" CVODE says: {self._calls.message}"
        raise failure


def _free(
    calls: _CvodeCalls, memory: int, solvers: tuple[int | None, ...], vectors: tuple[int, ...], context: c_void_p
) -> None:
    library = calls.library  # the callbacks live until CVODE is gone
    library.CVodeFree(byref(c_void_p(memory)))
    for handle, free in zip(solvers, ("SUNMatDestroy", "SUNLinSolFree", "SUNNonlinSolFree"), strict=True):
        if handle:
            getattr(library, free)(handle)
    for vector in vectors:
        library.N_VDestroy(vector)
    library.SUNContext_Free(byref(context))

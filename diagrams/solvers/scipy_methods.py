"""SciPy's multistep methods.

========  =====================  ==============================================================================
name      order                  reference
========  =====================  ==============================================================================
BDF       1 to 5 (quasi-const.)  L. F. Shampine, M. W. Reichelt, SIAM J. Sci. Comput. 18 (1997), 1-22
LSODA     1 to 12, BDF to 5      L. Petzold, SIAM J. Sci. Stat. Comput. 4 (1983), 136-148
========  =====================  ==============================================================================

Their dense outputs have the order of the step.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from .base import AcceptedStep, Polynomial, Problem, Solver
from .dense_output import from_differences, from_nordsieck

if TYPE_CHECKING:
    from scipy.integrate import OdeSolver

_DENSE = {"BDF": from_differences, "LSODA": from_nordsieck}
_RETRIES = 30  # of one step; of steps in a row each counts 3, and a step at once gives 1 back


class SciPySolver(Solver):
    """One of `scipy.integrate`'s multistep methods, given the exact Jacobian; a restart begins at order 1 again."""

    _inner: OdeSolver
    stiff = True

    def __init__(self, name: str, problem: Problem, rtol: float, atol: float | np.ndarray, max_step: float):
        import scipy.integrate

        super().__init__(name, problem, rtol, atol, max_step)
        self._method: Callable[..., OdeSolver] = getattr(scipy.integrate, name)
        self._options: dict[str, object] = {"rtol": rtol, "atol": atol, "max_step": max_step}
        self._options["jac"] = self._usable_jacobian
        self._last_jacobian: np.ndarray | None = None
        self._retried = 0  # grows if many steps have to be taken again
        self._strange = False  # a rate was not finite since the flag was cleared
        self._nothing = np.zeros(problem.size)

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """Evaluate the rates; see `Integration.rate`."""
        f = super().rate(t, x)
        if self._nothing.dot(f) != 0.0:  # one of them is not finite
            self._strange = True
        return f

    def set_absolute_tolerance(self, atol: float | np.ndarray) -> None:
        """Take another absolute tolerance; see `Integration.set_absolute_tolerance`."""
        super().set_absolute_tolerance(atol)
        self._options["atol"] = atol

    def _usable_jacobian(self, t: float, x: np.ndarray) -> np.ndarray:
        """Return the Jacobian, or the last finite one: a predictor may reach beyond the domain of the rates."""
        jacobian = self.jacobian(t, x)
        if np.isfinite(jacobian).all():
            self._last_jacobian = jacobian
        elif self._last_jacobian is not None:
            return self._last_jacobian.copy()
        else:
            self.check_finite(t, super().rate(t, x), "rate")
            self.check_finite(t, jacobian.sum(axis=1), "row in the Jacobian")
        return jacobian

    def _start(self, t: float, x: np.ndarray) -> None:
        self._strange = False
        self._create(t, x, None)

    def _create(self, t: float, x: np.ndarray, first: float | None) -> None:
        with np.errstate(all="ignore"):
            self._inner = self._method(self.rate, t, x, self.stop, first_step=first, **self._options)
            if self.name != "LSODA" and not math.isfinite(self._inner.h_abs):  # the trial of a first step went astray
                first = 1e-6 * (self.stop - t)
                self._inner = self._method(self.rate, t, x, self.stop, first_step=first, **self._options)

    def _advance(self) -> AcceptedStep:
        inner = self._inner
        if self._strange and inner.t_old is None:  # the first step: perhaps the start itself is the cause
            self.check_finite(inner.t, super().rate(inner.t, inner.y), "rate")
        t_old, x_old = self._attempt_step()
        inner = self._inner
        return AcceptedStep(float(t_old), float(inner.t), inner.y.copy(), lambda: self._prepare_dense(t_old, x_old))

    def _attempt_step(self) -> tuple[float, np.ndarray]:
        """Take a step, a shorter one where it ends at rates that are not finite; return the time and state before."""
        first = self._inner
        for _ in range(_RETRIES if self._retried < _RETRIES else 1):
            inner = self._inner
            t, x = inner.t, inner.y
            self._strange = False
            with np.errstate(all="ignore"), warnings.catch_warnings():
                if self.name == "LSODA":  # it warns where it fails; the status says so, too
                    warnings.simplefilter("ignore")
                inner.step()
            if inner.status == "failed":
                break
            if self._is_sound(inner):
                self._retried = max(0, self._retried - 1) if inner is first else self._retried + 3
                return t, x
            h = 0.25 * (inner.t - t)
            if h < 10 * math.ulp(t):
                break
            self._create(t, x, h)
        if self._strange:
            self.check_finite(t, super().rate(t, x), "rate")
        raise self.failure(t, x, 10 * math.ulp(t))

    def _is_sound(self, inner: OdeSolver) -> bool:
        """Return whether an accepted step is finite: a method may have met a NaN on the way and shortened its step."""
        if self.name == "LSODA":  # it accepts a NaN
            return not self._strange
        return bool(np.isfinite(inner.y).all() and not math.isnan(inner.h_abs))

    def _prepare_dense(self, t_old: float, x_old: np.ndarray) -> Polynomial:
        return _DENSE[self.name](self._inner.dense_output(), t_old, x_old)

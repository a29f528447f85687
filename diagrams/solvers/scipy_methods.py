"""SciPy's variable-step solvers, and the default that chooses among them.

========  =====================  ======  ==============================================================================
name      order (estimate)       stages  reference
========  =====================  ======  ==============================================================================
RK23      3(2)                   4       P. Bogacki, L. F. Shampine, Appl. Math. Lett. 2 (1989), 321-325
RK45      5(4)                   7       J. R. Dormand, P. J. Prince, J. Comp. Appl. Math. 6 (1980), 19-26
DOP853    8(5,3)                 12      E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations I
Radau     5(3)                   3       E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, IV.8
BDF       1 to 5 (quasi-const.)  –       L. F. Shampine, M. W. Reichelt, SIAM J. Sci. Comput. 18 (1997), 1-22
LSODA     1 to 12, BDF to 5      –       L. Petzold, SIAM J. Sci. Stat. Comput. 4 (1983), 136-148
========  =====================  ======  ==============================================================================

Their dense outputs have order 3, 4, 7, 3 and, for the multistep methods, the order of the step.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from ...blocks.core import SimulationError
from .base import AcceptedStep, Dense, Problem, VariableStep
from .dense_output import OneStepDense, from_differences, from_nordsieck

_ATTEMPT = {"RK23": 3, "RK45": 6, "DOP853": 12}  # evaluations of the rates per attempted step
_MULTISTEP = {"BDF": from_differences, "LSODA": from_nordsieck}
_RETRIES = 30  # of one step; of steps in a row each counts 3, and a step at once gives 1 back


class _Method(Protocol):
    """The part of SciPy's solver objects that is used here."""

    t: float
    t_old: float | None
    t_bound: float
    y: np.ndarray
    y_old: np.ndarray | None
    h_abs: float
    atol: float | np.ndarray
    status: str
    f: np.ndarray
    """Rates at (t, y), of the one-step methods."""
    K: np.ndarray
    """Rates of the last step's stages, of the explicit methods."""
    A: np.ndarray
    n_stages: int
    J: np.ndarray
    """Jacobian, of the implicit methods."""

    def step(self) -> str | None:
        """Take a step."""

    def dense_output(self) -> Dense:
        """Return the interpolant of the last step."""


class SciPySolver(VariableStep):
    """One of `scipy.integrate`'s solvers, given the exact Jacobian if it is implicit.

    After a restart a one-step method goes on with the step that it would have taken next. A multistep method starts
    again at order 1, and selects its first step anew.
    """

    _inner: _Method

    def __init__(self, name: str, problem: Problem, rtol: float, atol: float | np.ndarray, max_step: float):
        import scipy.integrate

        super().__init__(name, problem, rtol, atol, max_step)
        self._method: Callable[..., _Method] = getattr(scipy.integrate, name)
        self._attempt, self.stiff = _ATTEMPT.get(name), name not in _ATTEMPT
        self._options: dict[str, object] = {"rtol": rtol, "atol": atol, "max_step": max_step}
        if not self._attempt:
            self._options["jac"] = self._usable_jacobian
        self.statistics.rejected = 0 if self._attempt else None
        self.planned: float | None = None  # the step that the method would take next
        self._last_jacobian: np.ndarray | None = None
        self._started = False  # whether there is an object of SciPy's
        self.stuck: tuple[float, np.ndarray] | None = None  # where no step was small enough
        self._retried = 0  # grows if many steps have to be taken again
        self._strange = False  # a rate was not finite since the flag was cleared
        self._nothing = np.zeros(problem.size)

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """Evaluate the rates; see `Solver.rate`."""
        f = super().rate(t, x)
        if self._nothing.dot(f) != 0.0:  # one of them is not finite
            self._strange = True
        return f

    def save(self) -> dict[str, Any]:
        """Return the step that it would take next; see `Solver.save`."""
        return {"planned": self.planned}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Plan the step that was saved; see `Solver.restore`."""
        self.planned = saved.get("planned", self.planned)

    def set_absolute_tolerance(self, atol: float | np.ndarray) -> None:
        """Take another absolute tolerance; see `Solver.set_absolute_tolerance`."""
        super().set_absolute_tolerance(atol)
        self._options["atol"] = atol
        if self._started:
            self._inner.atol = atol

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
        first = None if self.planned is None else min(self.planned, self.stop - t)
        self._strange = False
        if self._attempt and self._started and first is not None:  # a new object would cost a third of a step
            inner = self._inner
            inner.t, inner.y, inner.t_bound, inner.t_old = t, x, self.stop, None
            inner.h_abs, inner.status = first, "running"
            inner.f = self.rate(t, x)
        else:
            self._create(t, x, first)

    def _create(self, t: float, x: np.ndarray, first: float | None) -> None:
        with np.errstate(all="ignore"):
            self._inner = self._method(self.rate, t, x, self.stop, first_step=first, **self._options)
            if self.name != "LSODA" and not math.isfinite(self._inner.h_abs):  # the trial of a first step went astray
                first = 1e-6 * (self.stop - t)
                self._inner = self._method(self.rate, t, x, self.stop, first_step=first, **self._options)
        self._started = True

    def _advance(self) -> AcceptedStep:
        inner = self._inner
        before = self.statistics.rate_evaluations
        planned = 0.0 if self.name == "LSODA" else inner.h_abs
        if self._strange and inner.t_old is None:  # the first step: perhaps the start itself is the cause
            self.check_finite(inner.t, super().rate(inner.t, inner.y), "rate")
        t_old, x_old = self._attempt_step()
        inner = self._inner
        if self._attempt and self.statistics.rejected is not None:
            self.statistics.rejected += (self.statistics.rate_evaluations - before) // self._attempt - 1
        if self.name not in _MULTISTEP:  # a step that was cut at the stop says little about the next
            self.planned = max(planned, inner.h_abs) if inner.t == self.stop else inner.h_abs
        self.statistics.steps += 1
        return AcceptedStep(float(t_old), float(inner.t), inner.y.copy(), lambda: self._prepare_dense(t_old, x_old))

    def _attempt_step(self) -> tuple[float, np.ndarray]:
        """Take a step, a shorter one where it ends at rates that are not finite; return the time and state before."""
        first = self._inner
        for _ in range(_RETRIES if self._retried < _RETRIES else 1):
            inner = self._inner
            t, x = inner.t, inner.y
            self._strange = False
            with np.errstate(all="ignore"):
                if self.name == "LSODA":
                    with warnings.catch_warnings():  # LSODA warns where it fails; the status says so, too
                        warnings.simplefilter("ignore")
                        inner.step()
                else:
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
            f = super().rate(t, x)
            self.check_finite(t, f, "rate")
        self.stuck = (t, x)
        raise self.failure(t, x, 10 * math.ulp(t))

    def _is_sound(self, inner: _Method) -> bool:
        """Return whether an accepted step is finite: a method may have met a NaN on the way and shortened its step."""
        if self.name == "LSODA":  # it accepts a NaN
            return not self._strange
        if self._attempt and not self._strange:
            return True
        finite = np.isfinite(inner.y).all() and np.isfinite(getattr(inner, "f", 0.0)).all()
        return bool(finite and not math.isnan(inner.h_abs))

    def _prepare_dense(self, t_old: float, x_old: np.ndarray) -> Dense:
        dense = self._inner.dense_output()
        expand = _MULTISTEP.get(self.name)
        return OneStepDense(dense, self.name) if expand is None else expand(dense, t_old, x_old)


_STABLE = {"RK45": 3.25, "DOP853": 6.1}  # h|λ| at the border of the stable region on the real axis
_COUNTS = ("_hits", "_misses", "_easy")
_HITS, _MISSES, _LOOK_EVERY, _EASY = 15, 6, 10, 20


class AutoSolver(VariableStep):
    """The default: RK45 (DOP853 for rtol < 1e-8) as long as the problem is not stiff, Radau where it is.

    Stiff means that stability bounds the step, not accuracy. Two evaluations at the end of each explicit step give an
    estimate of the dominant eigenvalue (E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, IV.2). If
    h|λ| stays beyond the border of the stable region for 15 looks, and the leftmost eigenvalue of the exact Jacobian
    agrees, Radau goes on. It hands back when h‖J‖ < 1 for 20 steps: an explicit method would take them too. Each change
    is told in `Statistics.messages`.
    """

    def __init__(self, name: str, problem: Problem, rtol: float, atol: float | np.ndarray, max_step: float):
        super().__init__(name, problem, rtol, atol, max_step)
        self._explicit = SciPySolver("RK45" if rtol >= 1e-8 else "DOP853", problem, rtol, atol, max_step)
        self._implicit = SciPySolver("Radau", problem, rtol, atol, max_step)
        self._active = self._explicit
        self._explicit.statistics = self._implicit.statistics = self.statistics
        self.statistics.solver = f"auto ({self._explicit.name})"
        self.statistics.rejected = 0
        self._hits = self._misses = self._easy = self._switches = 0

    def set_absolute_tolerance(self, atol: float | np.ndarray) -> None:
        """Take another absolute tolerance; see `Solver.set_absolute_tolerance`."""
        super().set_absolute_tolerance(atol)
        self._explicit.set_absolute_tolerance(atol)
        self._implicit.set_absolute_tolerance(atol)

    def save(self) -> dict[str, Any]:
        """Return the name of the active method, the steps that both plan, and the counts of signs of stiffness."""
        counts = {name: getattr(self, name) for name in _COUNTS}
        methods = {method.name: method.save() for method in (self._explicit, self._implicit)}
        return {"counts": counts, "active": self._active.name, "methods": methods}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go on with the method that was active; see `Solver.restore`."""
        for name, count in saved.get("counts", {}).items():
            setattr(self, name, count)
        for method in (self._explicit, self._implicit):
            method.restore(saved.get("methods", {}).get(method.name, {}))
            if method.name == saved.get("active"):
                self._active = method

    def _start(self, t: float, x: np.ndarray) -> None:
        self._active.restart(t, x, self.stop)

    def _advance(self) -> AcceptedStep:
        try:
            step = self._active.step()
        except SimulationError:
            if self._active is self._implicit or self._explicit.stuck is None:
                raise
            t, x = self._explicit.stuck
            self._explicit.stuck = None
            self._switch(self._implicit, t, x, None, why="no step is small enough")
            step = self._active.step()
        h = step.t - step.t_old
        if self._active is self._explicit:
            if (self._hits or not self.statistics.steps % _LOOK_EVERY) and self._is_stiff(step):
                self._switch(self._implicit, step.t, step.x, h, why=f"stiff at steps of {h:.2g} s")
        elif self._has_eased(step):
            self._switch(self._explicit, step.t, step.x, h, why="no longer stiff")
        return step

    def decide(self, t: float, x: np.ndarray, h: float) -> bool:
        """Decide at (t, x), after signs of stiffness or of none at steps of h in s, which method goes on.

        Returns
        -------
        bool
            Whether it is another one; it starts at the next `restart`.
        """
        self.stop = t
        if self._active is self._implicit:
            self._switch(self._explicit, t, x, h, why="no longer stiff")
            return True
        stiff = -h * self._leftmost_eigenvalue(t, x) > 0.5 * _STABLE[self._explicit.name]
        if stiff:
            self._switch(self._implicit, t, x, h, why=f"stiff at steps of {h:.2g} s")
        return stiff

    def _switch(self, to: SciPySolver, t: float, x: np.ndarray, h: float | None, *, why: str) -> None:
        self._hits = self._misses = self._easy = 0
        self._switches += 1
        if self._switches <= 10:
            self.statistics.messages.append(f"t = {t:.6g} s: {why}; {self._active.name} → {to.name}")
        elif self._switches == 11:
            self.statistics.messages.append("… and more such changes")
        self.statistics.solver = f"auto ({self._explicit.name}, Radau)"
        self.statistics.rejected = None
        self._active, to.planned = to, h
        if t < self.stop:
            to.restart(t, x, self.stop)

    def _is_stiff(self, step: AcceptedStep) -> bool:
        inner, border = self._explicit._inner, _STABLE[self._explicit.name]
        h, stages, last = step.t - step.t_old, inner.K, inner.n_stages - 1
        if inner.y_old is None or inner.y is None:
            return False
        weights = 1 / (self.atol + self.rtol * np.abs(step.x))
        with np.errstate(all="ignore"):
            argument = inner.y_old + h * (stages[:last].T @ inner.A[last, :last])
            apart = np.linalg.norm((step.x - argument) * weights)
            h_lambda = h * np.linalg.norm((stages[last + 1] - stages[last]) * weights) / apart if apart else 0.0
        if not h_lambda > border:
            self._misses += 1
            if self._misses >= _MISSES:
                self._hits = self._misses = 0
            return False
        self._hits, self._misses = self._hits + 1, 0
        if self._hits < _HITS:
            return False
        self._hits = 0
        return -h * self._leftmost_eigenvalue(step.t, step.x) > 0.5 * border

    def _leftmost_eigenvalue(self, t: float, x: np.ndarray) -> float:
        """Return the real part of the leftmost eigenvalue: that of the fastest decaying mode."""
        jacobian = self.jacobian(t, x)
        if self.problem.size > 300:  # the eigenvalues would cost more than many steps; trust the estimate
            return -math.inf
        return float(np.linalg.eigvals(jacobian).real.min()) if np.isfinite(jacobian).all() else 0.0

    def _has_eased(self, step: AcceptedStep) -> bool:
        scale = self.atol + self.rtol * np.abs(step.x)
        with np.errstate(all="ignore"):
            norm = (np.abs(self._implicit._inner.J) @ scale / scale).max()  # in the units of the error control
        self._easy = self._easy + 1 if (step.t - step.t_old) * norm < 1 else 0
        return self._easy >= _EASY

"""SciPy's variable-step solvers, and the default that chooses among them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ._solvers import Dense, Problem, Solver, Step

_STAGES = {"RK23": 3, "RK45": 6, "DOP853": 12}  # evaluations of the rates per attempted step
_IMPLICIT = ("Radau", "BDF", "LSODA")


class SciPySolver(Solver):
    """One of `scipy.integrate`'s solvers."""

    def __init__(self, name: str, problem: Problem, rtol: float, atol: Any, max_step: float):
        import scipy.integrate

        super().__init__(name, problem, rtol, atol, max_step)
        self._method: Any = getattr(scipy.integrate, name)
        self._stages = _STAGES.get(name)
        self._options: dict[str, Any] = {"rtol": rtol, "atol": atol, "max_step": max_step}
        if name in _IMPLICIT:
            self._options["jac"] = self.jacobian
        self.statistics.rejected = 0 if self._stages else None
        self._next: float | None = None  # the step that the method would take next
        self._inner: Any = None

    def restart(self, t: float, x: np.ndarray, stop: float) -> None:
        """Start at (t, x), up to ``stop``, with the step that was good last."""
        t, self.stop = float(t), float(stop)
        first = None if self._next is None else min(self._next, self.stop - t)
        self._inner = self._method(self.rate, t, np.array(x, dtype=float), self.stop, first_step=first, **self._options)

    def step(self) -> Step:
        """Take one step."""
        inner = self._inner
        before = self.statistics.rate_evaluations
        planned = self._planned()
        with np.errstate(all="ignore"):
            inner.step()
        if inner.status == "failed":
            raise self.failure(inner.t, inner.y, planned)
        if self._stages:
            assert self.statistics.rejected is not None
            self.statistics.rejected += (self.statistics.rate_evaluations - before) // self._stages - 1
        self._next = max(planned, self._planned()) if inner.t == self.stop else self._planned()
        self.statistics.steps += 1
        return Step(inner.t_old, inner.t, inner.y.copy(), self._dense)

    def _planned(self) -> float:
        inner = self._inner
        return float(inner._lsoda_solver._integrator.rwork[11] if self.name == "LSODA" else inner.h_abs)

    def _dense(self) -> Dense:
        return self._inner.dense_output()  # type: ignore[no-any-return]


class AutoSolver(SciPySolver):
    """The default."""

    def __init__(self, name: str, problem: Problem, rtol: float, atol: Any, max_step: float):
        super().__init__("RK45" if rtol >= 1e-8 else "DOP853", problem, rtol, atol, max_step)

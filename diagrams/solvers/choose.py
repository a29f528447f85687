"""The choice of a method by name, its options checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import OptionError, accepts, kinds
from .base import FIXED, METHODS, Integration, Library, Problem, Solver, solver_name
from .cvode import Cvode
from .scipy_methods import SciPySolver

_STABLE = {"RK45": 3.25, "DOP853": 6.1}  # h|λ| at the border of the stable region on the real axis
_MOST_CHANGES = 10  # that are reported
_LARGE = 300  # states of which no eigenvalues are computed


def _as_it_is(name: str, value: Any) -> str:
    return f"{name} is {value!r}"


_SECONDS = kinds.one_of_class((int, float, np.number), "a positive number of seconds, such as 1e-3").where(
    lambda value: value > 0
)


@accepts(
    None,
    rtol=kinds.number.where(lambda value: isinstance(value, int | float | np.number) and 3e-14 <= value < 1).worded(
        "3e-14 <= rtol < 1", "1e-6 serves most diagrams.", _as_it_is
    ),
    step=_SECONDS.worded(step="Give one.", found=_as_it_is),
    max_step=_SECONDS.worded(step="Give one.", found=_as_it_is),
)
def _check(
    name: str,
    size: int,
    *,
    rtol: float,
    atol: float | np.ndarray,
    step: float | None = None,
    max_step: float | None = None,
) -> tuple[str, float | np.ndarray]:
    """Return the name as `SOLVERS` spells it, and the absolute tolerance; refuse options out of their ranges."""
    name = solver_name(name)
    if name in FIXED and step is None:
        raise OptionError(f"solver={name!r} has a fixed step and step is None; give step=1e-3 or so, in s.")
    try:
        absolute = np.asarray(atol, dtype=float)
    except (TypeError, ValueError):
        absolute = np.full((), -1.0)
    if name not in FIXED and (absolute.shape not in ((), (size,)) or not (absolute >= 0).all()):
        raise OptionError(
            f"atol is {atol!r}; expected a number, such as 1e-9, or an array of shape ({size},), not negative."
        )
    return name, absolute if absolute.ndim else float(absolute)


def make_solver(
    name: str,
    problem: Problem,
    *,
    rtol: float = 1e-6,
    atol: float | np.ndarray = 1e-9,
    max_step: float | None = None,
) -> Solver:
    """Return the multistep method of a name, as a library has it; capitals don't matter."""
    name, tolerance = _check(name, problem.size, rtol=rtol, atol=atol, max_step=max_step)
    longest = math.inf if max_step is None else float(max_step)
    return (Cvode if METHODS[name].library is Library.SUNDIALS else SciPySolver)(
        name, problem, rtol, tolerance, longest
    )


class Method(Integration):
    """The method of a run: with what it keeps from one discontinuity to the next.

    "auto" is RK45 (DOP853 for rtol < 1e-8) as long as the problem is not stiff, and Radau where it is. Stiff means that
    stability bounds the step, not accuracy. Two evaluations at the end of each explicit step give an estimate of the
    dominant eigenvalue (E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, IV.2). If h|λ| stays beyond
    the border of the stable region for 15 looks, and the leftmost eigenvalue of the exact Jacobian agrees, Radau
    continues. It hands back when h‖J‖ < 1 for 20 steps: an explicit method would take them, too. Each change is
    reported.
    """

    def __init__(
        self,
        name: str,
        problem: Problem,
        *,
        rtol: float,
        atol: float | np.ndarray,
        step: float,
        max_step: float | None,
    ):
        name, absolute = _check(name, problem.size, rtol=rtol, atol=atol, step=step, max_step=max_step)
        self.fixed = name in FIXED
        bound = math.inf if max_step is None else float(max_step)
        super().__init__(name, problem, rtol, absolute, step if self.fixed else bound)
        by_stiffness = ("RK45" if rtol >= 1e-8 else "DOP853", "Radau")
        self.names = ("euler",) if not problem.size else by_stiffness if name == "auto" else (name,)
        """Names of the methods that may continue; with "auto" the one for problems that are not stiff comes first."""
        self.active = self.names[0]
        """Name of the method that continues."""
        self.planned: dict[str, float | None] = dict.fromkeys(self.names)
        """Steps in s that the methods would take next; None where they choose their first step."""
        self._changes = 0

    def save(self) -> dict[str, Any]:
        """Return what is needed to continue from here."""
        return {"active": self.active, "planned": dict(self.planned)}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go back to what `save` returned; of another method's memory nothing is used."""
        if saved.get("active") in self.names:
            self.active = saved["active"]
        self.planned = {name: saved.get("planned", {}).get(name) for name in self.names}

    def begin_again(self) -> None:
        """Forget the run before."""
        self.active, self.planned, self._changes = self.names[0], dict.fromkeys(self.names), 0

    def decide(self, t: float, x: np.ndarray, h: float, *, stuck: bool) -> tuple[str, ...]:
        """Decide at (t, x), after a sign at steps of h in s, which method continues; return what to report of it."""
        explicit, implicit = self.names[0], self.names[-1]
        if self.active == implicit:
            return self._change(explicit, t, h, "no longer stiff")
        if stuck:
            return self._change(implicit, t, None, "no step is small enough")
        self.stop = t
        if -h * self.leftmost_eigenvalue(t, x) > 0.5 * _STABLE[explicit]:
            return self._change(implicit, t, h, f"stiff at steps of {h:.2g} s")
        return ()

    def _change(self, to: str, t: float, h: float | None, why: str) -> tuple[str, ...]:
        message = f"t = {t:.6g} s: {why}; {self.active} → {to}"
        self.active, self.planned[to] = to, h
        self._changes += 1
        if self._changes > _MOST_CHANGES:
            return ("… and more such changes",) if self._changes == _MOST_CHANGES + 1 else ()
        return (message,)

    def leftmost_eigenvalue(self, t: float, x: np.ndarray) -> float:
        """Return the real part of the leftmost eigenvalue: that of the fastest decaying mode."""
        if self.problem.size > _LARGE:  # the eigenvalues would cost more than many steps; trust the estimate
            return -math.inf
        jacobian = self.jacobian(t, x)
        return float(np.linalg.eigvals(jacobian).real.min()) if np.isfinite(jacobian).all() else 0.0

    def named(self, name: str) -> Integration:
        """Return the method that continues by its own name, for its errors."""
        made = Integration(name, self.problem, self.rtol, self.atol, self.max_step)
        made.fixed, made.stiff, made.stop = self.fixed, METHODS[name].uses_slope, self.stop
        return made

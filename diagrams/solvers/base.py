"""Solvers of ordinary differential equations behind one interface: x' = f(t, x) between two discontinuities.

`rtol` and `atol` bound the error of one step; the error of a run is usually 1 to 100 times that. The choice:

============== ======================== ====================================================================
name           method                   choose it for
============== ======================== ====================================================================
auto           RK45 or DOP853, Radau    nearly everything: it starts non-stiff and changes where it is stiff
RK45           Runge-Kutta 5(4)         non-stiff, rtol from 1e-3 to 1e-8
DOP853         Runge-Kutta 8(5,3)       non-stiff, rtol below 1e-8
RK23           Runge-Kutta 3(2)         non-stiff and crude; many discontinuities close together
Radau          implicit Runge-Kutta 5   stiff, few states; also lightly damped fast modes; tight tolerances
BDF            multistep, 1 to 5        stiff, many states, few discontinuities
LSODA          Adams and BDF            changes between stiff and not; few discontinuities
CVODE_BDF      multistep, 1 to 5        as BDF, in compiled code (also called CVODE)
CVODE_Adams    multistep, 1 to 12       non-stiff, rates that are costly to evaluate, few discontinuities
rk4            Runge-Kutta 4, fixed     a fixed step: real-time code, or a result that must be smooth in parameters
heun           Runge-Kutta 2, fixed     as rk4, half its cost per step
euler          Runge-Kutta 1, fixed     to see the effect of a controller's forward Euler
============== ======================== ====================================================================

The multistep methods start again at order 1 after every discontinuity, so that a sampled controller costs them most.

A solver never evaluates the rates beyond its `stop`, and lands on it exactly: discontinuities in time are put there.
The state at times inside a step comes from the method's own dense output, with a fixed step from a shorter step.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...blocks.core import NonFiniteError, OptionError, SimulationError, near

Dense = Callable[[float], np.ndarray]

_STRETCH = 2_000  # steps between two looks at the progress
_HOPELESS = 1e7  # steps to go, at which a run is given up


@dataclass(frozen=True)
class Problem:
    """The differential equation x' = rate(t, x).

    Parameters
    ----------
    size : int
        Number of states.
    rate : callable
        ``rate(t, x)``: the derivative. It may return the same array at every call.
    jacobian : callable
        ``jacobian(t, x)``: ∂rate/∂x, size × size.
    names : sequence of str
        Name of each entry of x, for messages: ``"block.state[i]"``.
    """

    size: int
    rate: Callable[[float, np.ndarray], np.ndarray]
    jacobian: Callable[[float, np.ndarray], np.ndarray]
    names: Sequence[str]


@dataclass
class Statistics:
    """Counts of a solver's work, and its messages; ``rejected`` is None where the method does not count them."""

    solver: str
    steps: int = 0
    rejected: int | None = 0
    rate_evaluations: int = 0
    jacobian_evaluations: int = 0
    messages: list[str] = field(default_factory=list)


class Polynomial(NamedTuple):
    """The state over a step as a polynomial: x + Σ cₖ ((time − t)/h)ᵏ, k ≥ 1, with cₖ the columns of coefficients."""

    t: float
    h: float
    x: np.ndarray
    coefficients: np.ndarray


class AcceptedStep:
    """One accepted step, from ``t_old`` to ``t``, where the state is ``x``."""

    __slots__ = ("_dense", "_prepare", "t", "t_old", "x")

    def __init__(self, t_old: float, t: float, x: np.ndarray, prepare: Callable[[], Dense]):
        self.t_old, self.t, self.x, self._prepare = t_old, t, x, prepare
        self._dense: Dense | None = None

    def interpolate(self, t: float) -> np.ndarray:
        """Return the state at ``t`` in [t_old, t]; valid until the solver's next step or restart."""
        if t == self.t:
            return self.x.copy()
        if self._dense is None:
            self._dense = self._prepare()
        return self._dense(t)

    def interpolate_many(self, times: np.ndarray) -> np.ndarray:
        """Return the states at several such times, which ascend, one row each; to rounding those of `interpolate`."""
        if self._dense is None:
            self._dense = self._prepare()
        many = getattr(self._dense, "many", None)
        found: np.ndarray = np.array([self._dense(float(t)) for t in times]) if many is None else many(times)
        if times[-1] == self.t:
            found[-1] = self.x
        return found

    def polynomial(self) -> Polynomial | None:
        """Return the state as a polynomial, to rounding that of `interpolate`; None if the method has another form."""
        if self._dense is None:
            self._dense = self._prepare()
        of = getattr(self._dense, "polynomial", None)
        return None if of is None else of()


class Solver(ABC):
    """The interface of all solvers: `restart`, then `step` until ``t == stop``."""

    fixed = False
    stiff = False  # made for stiff problems

    def __init__(self, name: str, problem: Problem, rtol: float, atol: float | np.ndarray, max_step: float):
        self.name, self.problem, self.rtol, self.atol, self.max_step = name, problem, rtol, atol, max_step
        self.statistics = Statistics(name)
        self.stop = -math.inf

    @abstractmethod
    def restart(self, t: float, x: np.ndarray, stop: float) -> None:
        """Start at (t, x), up to ``stop``: after each discontinuity, and at the start."""

    @abstractmethod
    def step(self) -> AcceptedStep:
        """Take one step that the error control accepts, at most to ``stop``."""

    def save(self) -> dict[str, Any]:
        """Return the solver's memory beside the state, such as the step that it would take next."""
        return {}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take over the memory that `save` returned; of another method's memory nothing is used."""
        return

    def set_absolute_tolerance(self, atol: float | np.ndarray) -> None:
        """Take another absolute tolerance; it counts from the next `restart` on."""
        self.atol = atol

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """Evaluate the rates, never beyond ``stop`` (t + h can be one ulp above it). The array is the caller's own."""
        self.statistics.rate_evaluations += 1
        return np.array(self.problem.rate(min(t, self.stop), x), dtype=float)

    def jacobian(self, t: float, x: np.ndarray) -> np.ndarray:
        """Evaluate the exact Jacobian. The array is the caller's own."""
        self.statistics.jacobian_evaluations += 1
        return np.array(self.problem.jacobian(min(t, self.stop), x), dtype=float)

    def check_finite(self, t: float, values: np.ndarray, quantity: str) -> None:
        """Raise a `NonFiniteError` if an entry is not finite; ``quantity`` is "state" or "rate"."""
        if not np.isfinite(values).all():
            i = int(np.flatnonzero(~np.isfinite(values))[0])
            growth = "a step too long for a fast mode (try a tenth of it)" if self.fixed else "unbounded growth"
            error = NonFiniteError(
                f"The {quantity} of {self.problem.names[i]} is {values[i]:g} with solver={self.name!r}; expected a "
                f"finite number. Look for a division by zero, a root or a logarithm of a negative number, or {growth}.",
                t=t,
            )
            error.state = self.problem.names[i]
            raise error

    def failure(self, t: float, x: np.ndarray, h: float, found: str = "") -> SimulationError:
        """Return the error for a step that can't be made small enough, at the accepted point (t, x).

        It names the entry with the largest weighted error there in a step of Euler's method.
        """
        f = self.rate(t, x)
        try:
            self.check_finite(t, f, "rate")
        except NonFiniteError as error:
            return error
        h = max(abs(h), 16 * math.ulp(t))
        with np.errstate(all="ignore"):
            change = h * (self.rate(t + h, x + h * f) - f)
            weighted = np.abs(change) / (self.atol + self.rtol * np.abs(x))
        i = int(np.argmax(np.where(np.isnan(weighted), np.inf, weighted)))
        found = found or f"can't meet rtol = {self.rtol:g} even with a step of {h:.2g} s"
        beyond = "changes fastest" if np.isfinite(weighted[i]) else "is not finite just beyond"
        other = "a larger atol" if self.stiff else "a larger atol or, if it is stiff, solver='Radau'"
        stuck = SimulationError(
            f"{self.name} {found}: the rate of {self.problem.names[i]} = {x[i]:.6g} is {f[i]:.6g} there and {beyond}. "
            "Expected rates that are finite, and smooth between events; look for growth to infinity, a root or a "
            "logarithm that leaves its domain, a jump that is no event, or noise in an opaque block. If there is none, "
            f"try {other}.",
            t=t,
        )
        stuck.state = self.problem.names[i]
        return stuck


class VariableStep(Solver):
    """Base of the variable-step solvers: one step of Heun's method crosses an interval of a few ulps."""

    _sliver: tuple[float, np.ndarray] | None = None
    _count, _mark = 0, 0.0

    def restart(self, t: float, x: np.ndarray, stop: float) -> None:
        """Start at (t, x), up to ``stop``."""
        t, x, self.stop = float(t), np.array(x, dtype=float), float(stop)
        sliver = self.stop - t <= 100 * math.ulp(max(abs(t), abs(self.stop)))
        self._sliver = (t, x) if sliver else None
        self._count, self._mark = 0, t
        if not sliver:
            self._start(t, x)

    def step(self) -> AcceptedStep:
        """Take one step that the error control accepts, at most to ``stop``."""
        if self._sliver is None:
            step = self._advance()
            self._count += 1
            if self._count % _STRETCH == 0:
                self._check_progress(step)
            return step
        t, x = self._sliver
        f = self.rate(t, x)
        self.check_finite(t, f, "rate")
        self.statistics.steps += 1
        return AcceptedStep(t, self.stop, _heun(self.rate, t, x, f, self.stop), lambda: lambda time: x + (time - t) * f)

    def _check_progress(self, step: AcceptedStep) -> None:
        """Raise if the last steps were so small that the run would never end, as at a jump that is no event."""
        h, self._mark = (step.t - self._mark) / _STRETCH, step.t
        if self.stop - step.t > _HOPELESS * h:
            found = f"got no further than {h:.2g} s per step in {_STRETCH} steps, with {self.stop - step.t:.3g} s to go"
            raise self.failure(step.t, step.x, h, found)

    @abstractmethod
    def _start(self, t: float, x: np.ndarray) -> None:
        """Start the method at (t, x), up to ``self.stop``."""

    @abstractmethod
    def _advance(self) -> AcceptedStep:
        """Take one step of the method."""


class FixedStep(Solver):
    """Explicit Runge-Kutta methods of fixed step.

    A stop that is further away than ``step`` is reached in equal steps of at most ``step``.
    """

    fixed = True

    def __init__(self, name: str, problem: Problem, step: float, formula: Callable[..., np.ndarray]):
        super().__init__(name, problem, math.nan, math.nan, step)
        self._formula, self._t, self._x = formula, 0.0, np.empty(0)
        self._start, self._done, self._count = 0.0, 0, 0

    def restart(self, t: float, x: np.ndarray, stop: float) -> None:
        """Start at (t, x), up to ``stop``."""
        self._start = self._t = float(t)
        self._x, self.stop, self._done = np.array(x, dtype=float), float(stop), 0
        self._count = max(1, math.ceil((self.stop - self._t) / self.max_step * (1 - 1e-9)))

    def step(self) -> AcceptedStep:
        """Take one step."""
        t, x = self._t, self._x
        self._done += 1
        last = self._done >= self._count
        t_new = self.stop if last else self._start + self._done * ((self.stop - self._start) / self._count)
        if self.problem.size:
            with np.errstate(all="ignore"):
                f = self.rate(t, x)
                self.check_finite(t, f, "rate")
                x_new = self._formula(self.rate, t, x, f, t_new)
            self.check_finite(t_new, x_new, "state")
        else:
            f = x_new = x
        self._t, self._x = t_new, x_new
        self.statistics.steps += 1
        return AcceptedStep(t, t_new, x_new.copy(), lambda: lambda time: self._formula(self.rate, t, x, f, time))


def euler(rate: Callable[..., np.ndarray], t: float, x: np.ndarray, f: np.ndarray, t_new: float) -> np.ndarray:
    """Forward Euler, order 1, one stage: x + h f(t, x). Stable for |1 + hλ| < 1: h < 2/|λ| for a real pole.

    Reference for all three methods: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I, II.1.
    """
    return x + (t_new - t) * f


def _heun(rate: Callable[..., np.ndarray], t: float, x: np.ndarray, f: np.ndarray, t_new: float) -> np.ndarray:
    """Heun's method, order 2, two stages: the mean of the rates at both ends. Stable for h < 2/|λ| for a real pole."""
    h = t_new - t
    x_new: np.ndarray = x + (0.5 * h) * (f + rate(t_new, x + h * f))
    return x_new


def _rk4(rate: Callable[..., np.ndarray], t: float, x: np.ndarray, f: np.ndarray, t_new: float) -> np.ndarray:
    """Classical Runge-Kutta method, order 4, four stages. Stable for h < 2.78/|λ| (real), h < 2.83/|λ| (imaginary)."""
    h = t_new - t
    middle = t + 0.5 * h
    k2 = rate(middle, x + (0.5 * h) * f)
    k3 = rate(middle, x + (0.5 * h) * k2)
    k4 = rate(t_new, x + h * k3)
    x_new: np.ndarray = x + (h / 6) * (f + 2 * (k2 + k3) + k4)
    return x_new


FIXED = {"euler": euler, "heun": _heun, "rk4": _rk4}
_SCIPY = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")
SUNDIALS = ("CVODE_BDF", "CVODE_Adams")

SOLVERS: tuple[str, ...] = ("auto", *FIXED, *_SCIPY, *SUNDIALS)


class NoStates(FixedStep):
    """Solver of a diagram without continuous states: one step to ``stop``, or several of ``max_step``."""

    fixed = False


def solver_name(name: str) -> str:
    """Return the name as `SOLVERS` spells it; capitals don't matter.

    Raises
    ------
    OptionError
        If it is none of them.
    """
    spelled = {known.lower(): known for known in SOLVERS} | {"cvode": "CVODE_BDF"}
    if not isinstance(name, str) or name.lower() not in spelled:
        hint = near(str(name).lower(), spelled)
        for lower, known in spelled.items():
            hint = hint.replace(repr(lower), repr(known))
        raise OptionError(f"there is no solver {name!r}; expected one of {', '.join(SOLVERS)}. {hint}")
    return spelled[name.lower()]

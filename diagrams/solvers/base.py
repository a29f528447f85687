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
rk3            Runge-Kutta 3, fixed     as rk4, three quarters of its cost per step; Simulink's ode3
heun           Runge-Kutta 2, fixed     as rk4, half its cost per step
euler          Runge-Kutta 1, fixed     to see the effect of a controller's forward Euler
============== ======================== ====================================================================

The multistep methods start again at order 1 after every discontinuity, so that a sampled controller costs them most.

The loop in C takes the steps of all one-step methods, `fmus/runtime/methods.c`; here are the multistep methods, which
are those of libraries. No method evaluates the rates beyond its `stop`, and each lands on it exactly: discontinuities
in time are put there. The state at times inside a step comes from the method's own dense output, with a fixed step from
a shorter step.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum

import numpy as np

from ...blocks.core import NonFiniteError, OptionError, SimulationError, near

STRETCH = 2_000  # steps between two looks at the progress
HOPELESS = 1e7  # steps to go, at which a run is given up
LARGE = 1e6  # size of a state compared with its scale, from which on its growth is what an error names


@dataclass(frozen=True)
class Problem:
    """The differential equation x' = rate(t, x)."""

    size: int
    rate: Callable[[float, np.ndarray], np.ndarray]  # it may return the same array at every call
    jacobian: Callable[[float, np.ndarray], np.ndarray]  # ∂rate/∂x, size × size
    names: Sequence[str]  # of each entry of x, for messages: "block.state[i]"


@dataclass(frozen=True)
class Polynomial:
    """The state over a step of a method: x + Σ cₖ ((time − t)/h)ᵏ, k ≥ 1."""

    t: float
    h: float
    x: np.ndarray  # at t
    coefficients: np.ndarray  # c₁ to c_q, shape (q, n)

    def __call__(self, t: float) -> np.ndarray:
        """Return the state at a time within the step."""
        u = (t - self.t) / self.h
        change = np.zeros_like(self.x)
        for c in self.coefficients[::-1]:
            change = (change + c) * u
        return np.asarray(self.x + change)


@dataclass(frozen=True)
class AcceptedStep:
    """One accepted step, from ``t_old`` to ``t``, where the state is ``x``; both in s."""

    t_old: float
    t: float
    x: np.ndarray
    prepare: Callable[[], Polynomial]  # of the dense output; valid until the solver's next step or restart


class Integration:
    """A differential equation, the method that integrates it, and its tolerances; with the errors of that method."""

    fixed = False
    stiff = False  # made for stiff problems

    def __init__(self, name: str, problem: Problem, rtol: float, atol: float | np.ndarray, max_step: float):
        # With a fixed step tolerances are NaN, and max_step is that step.
        self.name, self.problem, self.rtol, self.atol, self.max_step = name, problem, rtol, atol, max_step
        self.stop = -math.inf
        """The next discontinuity in s, beyond which the rates are not evaluated."""

    def set_absolute_tolerance(self, atol: float | np.ndarray) -> None:
        """Take another absolute tolerance; it counts from the next discontinuity on."""
        self.atol = atol

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """Evaluate the rates, never beyond ``stop`` (t + h can be one ulp above it). The array is the caller's own."""
        return np.array(self.problem.rate(min(t, self.stop), x), dtype=float)

    def jacobian(self, t: float, x: np.ndarray) -> np.ndarray:
        """Evaluate the exact Jacobian. The array is the caller's own."""
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
        """Return the error for a step that can't be made small enough, at the accepted point (t, x)."""
        # It names the entry with the largest weighted error in a step of Euler's method.
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
        if self._grows(i, t, x, f):
            text = (
                f"{self.problem.names[i]} grows without limit: it is {x[i]:.6g} and its rate {f[i]:.6g}; expected a "
                "state that stays bounded. Look at the sign of a feedback, for a plant that is unstable without its "
                f"controller, or for growth to infinity in finite time. {self.name} {found}."
            )
            stuck = SimulationError(text, t=t)
            stuck.state = self.problem.names[i]
            return stuck
        stuck = SimulationError(
            f"{self.name} {found}: the rate of {self.problem.names[i]} = {x[i]:.6g} is {f[i]:.6g} there and {beyond}. "
            "Expected rates that are finite, and smooth between events; look for growth to infinity, a root or a "
            "logarithm that leaves its domain, a jump that is no event, or noise in an opaque block. If there is none, "
            f"try {other}.",
            t=t,
        )
        stuck.state = self.problem.names[i]
        return stuck

    def _grows(self, i: int, t: float, x: np.ndarray, f: np.ndarray) -> bool:
        """Whether a state is on its way to infinity: far above its scale, and growing fast for the time so far."""
        # The scale of a state is that at which both its tolerances are equal. A growth at the present rate by a factor
        # of e takes less than a tenth of the time so far.
        scale = float(np.broadcast_to(self.atol, x.shape)[i]) / self.rtol
        return bool(abs(x[i]) > LARGE * scale and (x[i] > 0.0) == (f[i] > 0.0) and abs(x[i]) < 0.1 * t * abs(f[i]))

    def no_progress(self, t: float, x: np.ndarray, h: float) -> SimulationError:
        """Return the error of steps of a mean length h, in s, that are so small that the run would never end."""
        found = f"got no further than {h:.2g} s per step in {STRETCH} steps, with {self.stop - t:.3g} s to go"
        return self.failure(t, x, h, found)


class Solver(Integration, ABC):
    """A method of a library: `restart`, then `step` until ``t == stop``."""

    _count, _mark = 0, 0.0  # steps since the restart, and the time of the last look at the progress

    # C crosses intervals of a few ulps by itself, so that each stretch is longer than that.

    def restart(self, t: float, x: np.ndarray, stop: float) -> None:
        """Start at (t, x), up to ``stop``: after each discontinuity, and at the start."""
        self.stop = float(stop)
        self._count, self._mark = 0, float(t)
        self._start(float(t), np.array(x, dtype=float))

    def step(self) -> AcceptedStep:
        """Take one step that the error control accepts, at most to ``stop``."""
        step = self._advance()
        self._count += 1
        if self._count % STRETCH == 0:
            h, self._mark = (step.t - self._mark) / STRETCH, step.t
            if self.stop - step.t > HOPELESS * h:
                raise self.no_progress(step.t, step.x, h)
        return step

    @abstractmethod
    def _start(self, t: float, x: np.ndarray) -> None:
        """Start the method at (t, x), up to ``self.stop``."""

    @abstractmethod
    def _advance(self) -> AcceptedStep:
        """Take one step of the method."""


class MethodKind(IntEnum):
    """Kinds of methods, as `fmus/runtime/problem.c` numbers them."""

    FIXED_STEP, EXPLICIT, EIGHT, RADAU, LIBRARY = range(5)


class Library(Enum):
    """Libraries whose methods are taken; the value names them in messages."""

    SCIPY, SUNDIALS = "SciPy", "SUNDIALS"


@dataclass(frozen=True)
class MethodFacts:
    """Facts of a method."""

    title: str
    kind: MethodKind = MethodKind.EXPLICIT
    library: Library | None = None
    stages: int = 0  # evaluations of a fixed step, by which `fmus/runtime/fixed_step.c` knows the method
    uses_slope: bool = False  # whether it needs the derivative of the rates by the states


METHODS = {
    "euler": MethodFacts("Euler", MethodKind.FIXED_STEP, stages=1),
    "heun": MethodFacts("Heun", MethodKind.FIXED_STEP, stages=2),
    "rk3": MethodFacts("Runge-Kutta 3", MethodKind.FIXED_STEP, stages=3),
    "rk4": MethodFacts("Runge-Kutta 4", MethodKind.FIXED_STEP, stages=4),
    "RK23": MethodFacts("Bogacki-Shampine 3(2)"),
    "RK45": MethodFacts("Dormand-Prince 5(4)"),
    "DOP853": MethodFacts("Dormand-Prince 8(5,3)", MethodKind.EIGHT),
    "Radau": MethodFacts("Radau IIA 5", MethodKind.RADAU, uses_slope=True),
    "BDF": MethodFacts("BDF", MethodKind.LIBRARY, Library.SCIPY, uses_slope=True),
    "LSODA": MethodFacts("LSODA", MethodKind.LIBRARY, Library.SCIPY, uses_slope=True),
    "CVODE_BDF": MethodFacts("CVODE_BDF", MethodKind.LIBRARY, Library.SUNDIALS, uses_slope=True),
    "CVODE_Adams": MethodFacts("CVODE_Adams", MethodKind.LIBRARY, Library.SUNDIALS),
}
"""All methods, by the name that ``solver`` takes."""
SOLVERS: tuple[str, ...] = ("auto", *METHODS)
OTHER_NAMES = {
    **dict.fromkeys(("ode45", "dopri5", "dopri", "rkdp54", "rkf45", "rkck54", "runge-kutta"), "RK45"),
    **dict.fromkeys(("ode23", "rkbs32", "rkf21", "bogacki-shampine"), "RK23"),
    **dict.fromkeys(("ode78", "ode89", "dopri8", "rkdp87", "rkf78", "rkv65"), "DOP853"),
    **dict.fromkeys(("ode23s", "ode23t", "ode23tb", "ode14x", "esdirk32", "esdirk43", "esdirk54", "esdirk85"), "Radau"),
    **dict.fromkeys(("ode15s", "ode15i", "ida", "dassl", "vode", "gear21", "gear32", "gear43", "gear52a"), "BDF"),
    **dict.fromkeys(("ode113", "adams"), "CVODE_Adams"),
    **dict.fromkeys(("odeint", "lsode", "auto-switching"), "LSODA"),
    **dict.fromkeys(("ode1", "euf", "forward_euler", "explicit_euler"), "euler"),
    **dict.fromkeys(("ode2", "ssprk22", "rk2"), "heun"),
    **dict.fromkeys(("ode3", "ssprk33", "ssprk34"), "rk3"),
    **dict.fromkeys(("ode4", "ode5", "ode8"), "rk4"),
    **dict.fromkeys(("variable", "variablestepauto", "fixedstepauto"), "auto"),
}
"""Solvers of other tools (Simulink, SciPy, OpenModelica, pathsim) in small letters, and the one here of their kind."""
FIXED = tuple(name for name, facts in METHODS.items() if facts.kind is MethodKind.FIXED_STEP)


def solver_name(name: str) -> str:
    """Return the name as `SOLVERS` spells it; capitals don't matter."""
    spelled = {known.lower(): known for known in SOLVERS} | {"cvode": "CVODE_BDF"}
    if not isinstance(name, str) or name.lower() not in spelled:
        alike = OTHER_NAMES.get(str(name).lower())
        if alike is not None:
            raise OptionError(f"there is no solver {name!r}. A method of its kind is {alike!r}: give solver={alike!r}.")
        hint = near(str(name).lower(), spelled)
        for lower, known in spelled.items():
            hint = hint.replace(repr(lower), repr(known))
        raise OptionError(f"there is no solver {name!r}; expected one of {', '.join(SOLVERS)}. {hint}")
    return spelled[name.lower()]

"""The choice of a solver by name, its options checked."""

from __future__ import annotations

import math

import numpy as np

from ...blocks.core import OptionError
from .base import FIXED, SUNDIALS, FixedStep, NoStates, Problem, Solver, euler, solver_name
from .cvode import Cvode
from .scipy_methods import AutoSolver, SciPySolver


def make_solver(
    name: str,
    problem: Problem,
    *,
    rtol: float = 1e-6,
    atol: float | np.ndarray = 1e-9,
    step: float | None = None,
    max_step: float | None = None,
) -> Solver:
    """Return the solver of a name; capitals don't matter.

    Parameters
    ----------
    name : str
        One of `SOLVERS`.
    problem : Problem
        The differential equation.
    rtol, atol : float, float or ndarray
        They hold each step's error in entry i below about atol[i] + rtol·|x[i]|.
    step : float, optional
        Step of a fixed-step method, s; the others take none.
    max_step : float, optional
        Upper bound of the step of a variable-step method, s.

    Raises
    ------
    OptionError
        If the name is unknown or an option is out of its range.
    """
    name = solver_name(name)
    size = problem.size
    for option, value in (("step", step), ("max_step", max_step)):
        if value is not None and not (isinstance(value, int | float | np.number) and value > 0):
            raise OptionError(f"{option} is {value!r}; expected a positive number of seconds, such as 1e-3.")
    if name in FIXED:
        if step is None:
            raise OptionError(f"solver={name!r} has a fixed step and step is None; give step=1e-3 or so, in s.")
        return FixedStep(name, problem, step, FIXED[name])
    bound = math.inf if max_step is None else float(max_step)
    if isinstance(rtol, bool) or not isinstance(rtol, int | float | np.number) or not 3e-14 <= rtol < 1:
        raise OptionError(f"rtol is {rtol!r}; expected 3e-14 <= rtol < 1. 1e-6 serves most diagrams.")
    try:
        absolute = np.asarray(atol, dtype=float)
    except (TypeError, ValueError):
        absolute = np.full((), -1.0)
    if absolute.shape not in ((), (size,)) or not (absolute >= 0).all():
        raise OptionError(
            f"atol is {atol!r}; expected a number, such as 1e-9, or an array of shape ({size},), not negative."
        )
    if not size:
        return NoStates(name, problem, bound, euler)
    tolerance = absolute if absolute.ndim else float(absolute)
    if name in SUNDIALS:
        return Cvode(name, problem, rtol, tolerance, bound)
    return (AutoSolver if name == "auto" else SciPySolver)(name, problem, rtol, tolerance, bound)

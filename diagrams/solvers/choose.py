"""The choice of a solver by name, its options checked."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...blocks.core import OptionError, accepts, kinds
from .base import FIXED, SUNDIALS, FixedStep, NoStates, Problem, Solver, euler, solver_name
from .cvode import Cvode
from .scipy_methods import AutoSolver, SciPySolver


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
    if name in FIXED:
        if step is None:
            raise OptionError(f"solver={name!r} has a fixed step and step is None; give step=1e-3 or so, in s.")
        return FixedStep(name, problem, step, FIXED[name])
    bound = math.inf if max_step is None else float(max_step)
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

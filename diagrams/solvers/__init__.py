"""Solvers of fixed and variable step behind one interface."""

from .base import SUNDIALS, AcceptedStep, Polynomial, Problem, Solver, solver_name
from .choose import make_solver
from .scipy_methods import AutoSolver

__all__ = [
    "SUNDIALS",
    "AcceptedStep",
    "AutoSolver",
    "Polynomial",
    "Problem",
    "Solver",
    "make_solver",
    "solver_name",
]

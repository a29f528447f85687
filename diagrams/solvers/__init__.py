"""The method of a run, and the multistep methods of libraries behind one interface."""

from .base import SOLVERS, SUNDIALS, AcceptedStep, Polynomial, Problem, Solver, solver_name
from .choose import Method, make_solver

__all__ = [
    "SOLVERS",
    "SUNDIALS",
    "AcceptedStep",
    "Method",
    "Polynomial",
    "Problem",
    "Solver",
    "make_solver",
    "solver_name",
]

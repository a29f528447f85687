"""The methods by name, the method of a run, and the multistep methods of libraries behind one interface."""

from .base import FIXED, METHODS, SOLVERS, AcceptedStep, MethodKind, Problem, Solver, solver_name
from .choose import Method, make_solver

__all__ = [
    "FIXED",
    "METHODS",
    "SOLVERS",
    "AcceptedStep",
    "Method",
    "MethodKind",
    "Problem",
    "Solver",
    "make_solver",
    "solver_name",
]

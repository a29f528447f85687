"""Solvers of fixed and variable step behind one interface."""

from .base import Problem, Step, solver_name
from .choose import make_solver

__all__ = [
    "Problem",
    "Step",
    "make_solver",
    "solver_name",
]

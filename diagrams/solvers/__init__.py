"""Solvers of fixed and variable step behind one interface."""

from .base import AcceptedStep, Problem, solver_name
from .choose import make_solver

__all__ = [
    "AcceptedStep",
    "Problem",
    "make_solver",
    "solver_name",
]

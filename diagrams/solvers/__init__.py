"""Solvers of fixed and variable step behind one interface."""

from .base import AcceptedStep, Polynomial, Problem, solver_name
from .choose import make_solver

__all__ = [
    "AcceptedStep",
    "Polynomial",
    "Problem",
    "make_solver",
    "solver_name",
]

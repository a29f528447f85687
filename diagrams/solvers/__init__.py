"""Solvers of fixed and variable step behind one interface."""

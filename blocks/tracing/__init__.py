"""Equations of blocks as CasADi functions, and their discretization."""

"""Admittance that an environment feels, and coupled stability."""

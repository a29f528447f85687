"""Blocks of everybody's diagrams."""

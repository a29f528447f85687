"""A second process that makes parts of a result while this one makes the others."""

from .process import SecondProcess

__all__ = ["SecondProcess"]

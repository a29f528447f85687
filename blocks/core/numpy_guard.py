"""Refusal of NumPy's functions, powers and other operations on signals, whose values come with the run.

An operator with an array on the left would be NumPy's; it is passed on to the signal's own.
"""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np

from .errors import WiringError

_OPERATORS: dict[Any, tuple[str, str]] = {  # array * signal is a Gain, as signal * array is
    np.add: ("__add__", "__radd__"),
    np.subtract: ("__sub__", "__rsub__"),
    np.multiply: ("__mul__", "__rmul__"),
    np.matmul: ("__matmul__", "__rmatmul__"),
    np.divide: ("__truediv__", "__rtruediv__"),
    np.power: ("__pow__", "__rpow__"),
    np.equal: ("__eq__", "__eq__"),
    np.not_equal: ("__ne__", "__ne__"),
    np.less: ("__lt__", "__gt__"),
    np.less_equal: ("__le__", "__ge__"),
    np.greater: ("__gt__", "__lt__"),
    np.greater_equal: ("__ge__", "__le__"),
}


class NoNumber:
    """Base of signals, calls and blocks: refuses operations that need numbers, and says what to write instead."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if ufunc in _OPERATORS and method == "__call__" and not options:
            own, reflected = _OPERATORS[ufunc]
            left, right = inputs
            result: Any
            if isinstance(left, NoNumber):
                result = getattr(type(left), own, _unknown)(left, right)
            else:
                result = getattr(type(right), reflected, _unknown)(right, left)
            if result is not NotImplemented:
                return result
            if own in ("__eq__", "__ne__"):
                return own == "__ne__"
        raise self._number_error(f"np.{ufunc.__name__}", f"Function(np.{ufunc.__name__})({_arguments(ufunc.nin)})")

    def _number_error(self, operation: str, instead: str) -> WiringError:
        """Return the error of an operation that needs numbers."""
        return WiringError(
            f"{operation} can't be applied to a signal: its values come with the run. Use {instead}, or write a Block "
            "whose equation does it.",
            block=self._source_name(),
        )

    def _source_name(self) -> str | None:
        """Return the name of the block that the signal comes from, for messages."""
        source = getattr(self, "source", None) or getattr(self, "block", self)
        return getattr(source, "label", None)

    def __pow__(self, other: Any) -> NoReturn:
        if isinstance(other, NoNumber):
            raise self._number_error("**", "Function(np.power)(a, b)")
        raise self._number_error("**", f"Function(lambda u: u**{other!r})(u)")

    def __rpow__(self, other: Any) -> NoReturn:
        raise self._number_error("**", f"Function(lambda u: {other!r}**u)(u)")

    def __rtruediv__(self, other: Any) -> NoReturn:
        raise self._number_error("/", f"Function(lambda u: {other!r} / u)(u)")

    def __abs__(self) -> NoReturn:
        raise self._number_error("abs", "Function(np.abs)(u)")

    def __float__(self) -> NoReturn:
        raise self._number_error("a function of numbers", "Function(np.sin)(u), say, with NumPy's functions")

    def __rshift__(self, other: Any) -> NoReturn:
        raise WiringError(
            "blocks are wired by calls, not by >>. Call the second block with the first: second(first).",
            block=self._source_name(),
        )

    def __mod__(self, other: Any) -> NoReturn:
        raise self._number_error("%", "Function(lambda u: np.mod(u, …))(u)")

    def __floordiv__(self, other: Any) -> NoReturn:
        raise self._number_error("//", "Function(lambda u: np.floor(u / …))(u)")


def _unknown(left: Any, right: Any) -> Any:
    return NotImplemented


def _arguments(n: int) -> str:
    return "u" if n == 1 else ", ".join("ab" if n == 2 else (f"u{i + 1}" for i in range(n)))

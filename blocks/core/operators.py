"""Operators and NumPy's functions on signals: each makes the block that does it.

``a / b`` is ``Function(np.divide)(a, b)``, ``a < 3.0`` is ``Compare("<")(a, 3.0)``, ``np.minimum(a, b)`` is
``Minimum()(a, b)``. The block is named after the operation and its operands. Operations that jump or need numbers are
refused, since a signal's values come with the run; the error says what to write.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any, Generic, NoReturn, TypeVar

import numpy as np

from .control_systems import as_block, system_text
from .errors import ShapeError, WiringError
from .numpy_functions import RULES, NumpyCall, Place

S = TypeVar("S")
"""Type of the results: `Signal`, of which this file knows no more."""
_LONGEST = 48
"""Characters of a name that is made of operands: a longer one is the operation's alone, numbered where it repeats."""


class Operators(Generic[S]):
    """Base of signals, calls and blocks: their operators, and what NumPy's functions do with them."""

    def _signal(self) -> S:
        raise NotImplementedError

    def _operate(self, block: str, name: str, *operands: Any, **parameters: Any) -> S:
        made: S = operate(block, name, *operands, **parameters)
        return made

    def __add__(self, other: Any) -> S:
        return _add(self, self, other, "++")

    def __radd__(self, other: Any) -> S:
        return _add(self, other, self, "++")

    def __sub__(self, other: Any) -> S:
        return _add(self, self, other, "+-")

    def __rsub__(self, other: Any) -> S:
        return _add(self, other, self, "+-")

    def __neg__(self) -> S:
        # a sum keeps the unit, which a gain would not
        return self._operate("Sum", f"minus_{_operand(self)}", self, signs="-")

    def __pos__(self) -> S:
        return self._signal()

    def __mul__(self, other: Any) -> S:
        return _multiply(self, other)

    def __rmul__(self, other: Any) -> S:
        return _multiply(self, other)

    def __matmul__(self, other: Any) -> S:
        return self._operate("Function", f"{_operand(self)}_times_{_operand(other)}", self, other, function=np.matmul)

    def __rmatmul__(self, other: Any) -> S:
        if not has_signals(other) and np.ndim(other) == 2:
            return self._operate("Gain", f"gain_of_{_operand(self)}", self, gain=other)
        return self._operate("Function", f"{_operand(other)}_times_{_operand(self)}", other, self, function=np.matmul)

    def __truediv__(self, other: Any) -> S:
        if has_signals(other):
            return _divide(self, self, other)
        return self * (1.0 / np.asarray(other, dtype=float))

    def __rtruediv__(self, other: Any) -> S:
        return _divide(self, other, self)

    def __pow__(self, other: Any) -> S:
        if not has_signals(other) and np.ndim(other) == 0:
            words = {2.0: "square", 3.0: "cube", 0.5: "root", -1.0: "inverse"}
            return self._operate(
                "Power", f"{words.get(float(other), 'power')}_of_{_operand(self)}", self, exponent=other
            )
        return self._operate("Function", f"power_of_{_operand(self)}", self, other, function=np.power)

    def __rpow__(self, other: Any) -> S:
        return self._operate("Function", f"power_of_{_operand(other)}", other, self, function=np.power)

    def __abs__(self) -> S:
        return self._operate("Function", f"abs_of_{_operand(self)}", self, function=np.absolute)

    def __lt__(self, other: Any) -> S:
        return _compare(self, other, "<", "below")

    def __le__(self, other: Any) -> S:
        return _compare(self, other, "<=", "at_most")

    def __gt__(self, other: Any) -> S:
        return _compare(self, other, ">", "above")

    def __ge__(self, other: Any) -> S:
        return _compare(self, other, ">=", "at_least")

    def __and__(self, other: Any) -> S:
        return self._operate("And", f"{_operand(self)}_and_{_operand(other)}", self, other)

    def __rand__(self, other: Any) -> S:
        return self._operate("And", f"{_operand(other)}_and_{_operand(self)}", other, self)

    def __or__(self, other: Any) -> S:
        return self._operate("Or", f"{_operand(self)}_or_{_operand(other)}", self, other)

    def __ror__(self, other: Any) -> S:
        return self._operate("Or", f"{_operand(other)}_or_{_operand(self)}", other, self)

    def __invert__(self) -> S:
        return self._operate("Not", f"not_{_operand(self)}", self)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method == "__call__" and not options:
            if ufunc in _OPERATORS:
                own, reflected = _OPERATORS[ufunc]
                left, right = inputs
                if isinstance(left, Operators):
                    result = getattr(type(left), own)(left, right)
                else:
                    result = getattr(type(right), reflected)(right, left)
                if result is not NotImplemented:
                    return result
                return own == "__ne__"
            if ufunc in _BLOCKS:
                return _BLOCKS[ufunc](*inputs)
            if ufunc in RULES:
                return _function(ufunc, ufunc.__name__, *inputs)
        name = f"np.{ufunc.__name__}" + ("" if method == "__call__" else f".{method}")
        raise self._number_error(name, _INSTEAD.get(ufunc, ""))

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function in _BLOCKS:
            return _BLOCKS[function](*args, **kwargs)
        if function in RULES:
            return _numpy_call(function, args, kwargs)
        if function is np.atleast_1d:  # it arranges Python's objects, too
            atleast_1d: Any = function
            return atleast_1d._implementation(*args, **kwargs)
        raise self._number_error(f"np.{function.__name__}", _INSTEAD.get(function, ""))

    def _number_error(self, operation: str, instead: str = "") -> WiringError:
        """Return the error of an operation that needs numbers."""
        step = instead or "Write it as the function of a Function, or as the equation of a Block"
        return WiringError(
            f"{operation} can't be applied to a signal: its values come with the run. {step}.",
            block=self._source_name(),
        )

    def _source_name(self) -> str | None:
        """Return the name of the block that the signal comes from, for messages."""
        source = getattr(self, "source", None) or getattr(self, "block", self)
        return getattr(source, "label", None)

    def __float__(self) -> NoReturn:
        raise self._number_error(
            "a function of numbers", "Use NumPy's functions, which make blocks: np.sin(u) for math.sin"
        )

    def __complex__(self) -> NoReturn:
        raise self._number_error(
            "a function of complex numbers",
            "A linear system of python-control is made a block first: TransferFunction.from_control(system)(u) for "
            "system(u)",
        )

    def __round__(self, digits: int | None = None) -> NoReturn:
        raise self._number_error("round", _INSTEAD[np.round])

    def __rshift__(self, other: Any) -> NoReturn:
        raise WiringError(
            "blocks are wired by calls, not by >>. Call the second block with the first: second(first).",
            block=self._source_name(),
        )

    def __mod__(self, other: Any) -> NoReturn:
        raise self._number_error("%", _INSTEAD[np.remainder])

    def __floordiv__(self, other: Any) -> NoReturn:
        raise self._number_error("//", _INSTEAD[np.floor_divide])


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
    np.bitwise_and: ("__and__", "__rand__"),
    np.bitwise_or: ("__or__", "__ror__"),
}

_JUMPS = (
    "It jumps, where a solver would not land. Write {} in a sampled subsystem, and a Block with an Event in continuous "
    "time"
)
_INSTEAD: dict[Any, str] = {
    np.remainder: _JUMPS.format("Function(lambda u: np.mod(u, …))(u)"),
    np.floor_divide: _JUMPS.format("Function(lambda u: np.floor(u / …))(u)"),
    np.sign: "Write (u > 0.0) - (u < 0.0), whose comparisons are events, or np.tanh(u / width), which is smooth",
    np.interp: "Use Lookup1D(breakpoints=…, values=…)(u)",
    np.rint: "Use Quantizer(quantum=1.0)(u)",
    np.round: "Use Quantizer(quantum=1.0)(u)",
    np.shape: "Its shape follows when the diagram is built",
    np.ndim: "Its shape follows when the diagram is built",
    np.size: "Its shape follows when the diagram is built",
}
_INSTEAD |= {f: _JUMPS.format(f"Function(np.{f.__name__})(u)") for f in (np.floor, np.ceil, np.trunc, np.fmod)}


def has_signals(value: Any) -> bool:
    """Return whether a value is a signal, or a collection with one in it."""
    if isinstance(value, Operators):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(isinstance(entry, Operators) for entry in value.flat)
    return isinstance(value, list | tuple) and any(has_signals(v) for v in value)


def operate(block: str, name: str, *operands: Any, **parameters: Any) -> Any:
    """Return the output of a block that an operator makes; its name in the diagram is numbered where it repeats."""
    # the block's class is looked up in the package by name: operators make blocks, and blocks have operators
    package = sys.modules[__name__.rpartition(".core.")[0]]
    made = getattr(package, block)(**parameters)
    if len(name) <= _LONGEST:
        object.__setattr__(made, "_hint", name)
    return (made(*operands) if operands else made)._signal()


def _operand(value: Any) -> str:
    if not isinstance(value, Operators):
        return "_and_".join(map(_operand, value)) if has_signals(value) else "constant"
    signal: Any = value._signal()
    if signal.wire:
        return str(signal.wire)
    outputs = getattr(signal.source, "outputs", ())
    primary = [p for p in outputs if not (isinstance(outputs, Mapping) and getattr(outputs[p], "secondary", False))]
    return str(signal.source.label if len(primary) == 1 else signal.port)


def _add(owner: Operators[S], left: Any, right: Any, signs: str) -> S:
    word = {"++": "plus", "+-": "minus"}[signs]
    return owner._operate("Sum", f"{_operand(left)}_{word}_{_operand(right)}", left, right, signs=signs)


def _multiply(left: Operators[S], other: Any) -> S:
    if has_signals(other):
        return left._operate("Product", f"{_operand(left)}_times_{_operand(other)}", left, other)
    other = np.asarray(other) if isinstance(other, list | tuple) else other
    if made := as_block(other, "(u)"):
        raise ShapeError(f"found {system_text(other)}; expected a number, a vector or another signal. {made}.")
    if not isinstance(other, int | float | np.number | np.ndarray) or np.ndim(other) > 1:
        raise ShapeError(
            f"found a factor of shape {np.shape(other)}; expected a number, a vector or another signal. Apply a "
            "matrix as K @ signal."
        )
    return left._operate("Gain", f"gain_of_{_operand(left)}", left, gain=other)


def _divide(owner: Operators[S], left: Any, right: Any) -> S:
    return owner._operate("Function", f"{_operand(left)}_over_{_operand(right)}", left, right, function=np.divide)


def _compare(left: Operators[S], other: Any, relation: str, word: str) -> S:
    return left._operate("Compare", f"{_operand(left)}_{word}_{_operand(other)}", left, other, relation=relation)


def _function(function: Any, word: str, *operands: Any) -> Any:
    name = f"{word}_of_{'_and_'.join(map(_operand, operands))}"
    return operate("Function", name, *operands, function=function)


def _least(*signals: Any) -> Any:
    return operate("Minimum", f"least_of_{'_and_'.join(map(_operand, signals))}", *signals, count=len(signals))


def _largest(*signals: Any) -> Any:
    return operate("Maximum", f"largest_of_{'_and_'.join(map(_operand, signals))}", *signals, count=len(signals))


def _clip(a: Any, a_min: Any = None, a_max: Any = None, **limits: Any) -> Any:
    """Return the signal limited to a range: by `Saturation` between numbers, by `Maximum` and `Minimum` of signals."""
    low, high = limits.pop("min", a_min), limits.pop("max", a_max)
    if limits:
        raise a._number_error(f"np.clip(…, {next(iter(limits))}=…)", "Write np.clip(u, low, high)")
    if not has_signals(a) or has_signals(low) or has_signals(high):
        raised = a if low is None else _largest(a, low)
        return raised if high is None else _least(raised, high)
    return operate("Saturation", f"limited_{_operand(a)}", a, lower=low, upper=high)


def _where(condition: Any, *branches: Any) -> Any:
    if len(branches) != 2:
        raise condition._number_error("np.where with one argument", "Write np.where(condition, then, otherwise)")
    then, otherwise = branches
    name = f"{_operand(then)}_if_{_operand(condition)}_else_{_operand(otherwise)}"
    return operate("Switch", name, condition, then, otherwise)


def stack(values: Any, axis: int = 0) -> Any:
    """Return the signal whose entries, or rows, are the given ones."""
    if axis != 0:
        return _numpy_call(np.stack, (values, axis), {})
    return operate("Stack", _operand(values), *values, count=len(values), rows=True)


def concatenate(values: Any, axis: int | None = 0) -> Any:
    """Return the signal with the entries of the given ones in a row."""
    if axis != 0:
        return _numpy_call(np.concatenate, (values, axis), {})
    return operate("Stack", _operand(values), *values, count=len(values))


def _dot(a: Any, b: Any) -> Any:
    if isinstance(a, Operators):
        return a @ b
    return type(b).__rmatmul__(b, a)


_BLOCKS: Mapping[Any, Callable[..., Any]] = {
    np.absolute: abs,
    np.negative: lambda a: -a,
    np.positive: lambda a: +a,
    np.square: lambda a: a**2,
    np.minimum: _least,
    np.maximum: _largest,
    np.logical_and: lambda a, b: a & b if isinstance(a, Operators) else b & a,
    np.logical_or: lambda a, b: a | b if isinstance(a, Operators) else b | a,
    np.logical_not: lambda a: ~a,
    np.invert: lambda a: ~a,
    np.clip: _clip,
    np.where: _where,
    np.stack: stack,
    np.hstack: concatenate,
    np.concatenate: concatenate,
    np.dot: _dot,
}


def _numpy_call(function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
    """Return the result of a NumPy function of signals and of numbers, which stay as they are."""
    signals: list[Any] = []

    def note(value: Any) -> Any:
        if isinstance(value, Operators):
            signals.append(value)
            return Place(len(signals) - 1)
        if has_signals(value):
            return tuple(note(v) for v in value)
        return value

    call = NumpyCall(function, tuple(note(a) for a in args), {key: note(v) for key, v in kwargs.items()})
    names = ("u",) if len(signals) == 1 else tuple(f"u{i + 1}" for i in range(len(signals)))
    name = f"{function.__name__}_of_{'_and_'.join(map(_operand, signals))}"
    return operate("Function", name, *signals, function=call.simplified(), arguments=names)

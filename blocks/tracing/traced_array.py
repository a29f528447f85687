"""Arrays of symbols with NumPy's results where CasADi's own array interface has others, without a word.

`as_traced` gives an `ArrayInterface` these operations; everything that is computed from it has them, too:

- ``np.mod``, ``%``, ``np.floor_divide``, ``//`` and ``np.divmod`` by the remainder of C, which is exact: 1.0 modulo 0.1
  is 0.09999999999999995, since the floating-point number 0.1 is a little more than a tenth;
- truth values: ``(u > 0) + (u > 1)`` is a logical or, thus 0 or 1; ``&``, ``|``, ``^`` and ``~`` work on them;
- the functions of `traced_functions`, such as ``np.sort`` and ``np.polyval``, methods such as ``clip``, and ``None`` as
  an index.

An operation that can't be traced raises a `NotTracedError`, which says what to write.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from .traced_functions import (
    ARRAY,
    FUNCTIONS,
    INDEX,
    LOGIC,
    NUMBER,
    ROUND,
    TRUTH,
    NotTracedError,
    advise,
    advise_on_arguments,
    argmax,
    argmin,
)

_Array: Any = ArrayInterface  # its stubs leave out what is used here
_KNOWN = (ArrayInterface, np.ndarray, np.generic, int, float)
_COMPARISONS = ("__lt__", "__le__", "__gt__", "__ge__", "__eq__", "__ne__", "all", "any")
_MOVES = ("reshape", "transpose", "squeeze", "flatten", "ravel")
_ARITHMETIC = (
    *(f"__{r}{name}__" for name in ("sub", "mul", "truediv", "pow", "matmul") for r in ("", "r")),
    *("__neg__", "__pos__", "__abs__", "sum", "mean", "prod", "max", "min", "ptp", "var", "std"),
)
_CHOICES = {"out", "where", "initial"}
_DEEPEST = 20  # calls of NumPy within one another that CasADi's interface makes; it has reason for three
_depth: ContextVar[int] = ContextVar("loopwright_trace_depth", default=0)
_JOINS = (np.where, np.stack, np.concatenate, np.hstack, np.vstack, np.reshape, np.transpose, np.squeeze, np.ravel)


def as_traced(value: Any) -> Any:
    """Return an array of symbols with the operations of this module."""
    return _own(value, False)


def _own(value: Any, truth: bool) -> Any:
    """Return what an operation made, arrays with the operations of this module; ``truth``: of truth values."""
    if isinstance(value, tuple | list):
        return type(value)(_own(v, truth) for v in value)
    if not isinstance(value, _Array) or (isinstance(value, TracedArray) and value.is_truth == truth):
        return value
    kind: Any = type(value)
    made: Any = object.__new__(_class_like(kind))
    made._v, made._ndim, made._shapeN = value._v, value._ndim, value._shapeN
    made.is_truth = truth
    return made


@lru_cache(maxsize=8)
def _class_like(kind: type) -> type:
    """Return the class with our operations for one of CasADi's, which differ in the symbols that they hold."""
    return kind if issubclass(kind, TracedArray) else type("TracedArray", (TracedArray, kind), {})


def _remainder(x: Any, y: Any) -> Any:
    """Return the remainder of x / y, exactly, with the sign of y."""
    rest = ca.fmod(x, y)
    return ca.if_else(_points_away(rest, y), rest + y, rest)


def _floor_divide(x: Any, y: Any) -> Any:
    """Return how many whole times y goes into x, exactly, towards minus infinity."""
    rest = ca.fmod(x, y)
    quotient = (x - rest) / y - _points_away(rest, y)  # a whole number, but for its rounding
    whole = ca.floor(quotient)
    return ca.if_else(y == 0, x / y, ca.if_else(quotient - whole > 0.5, whole + 1, whole))


def _points_away(rest: Any, y: Any) -> Any:
    """Whether a remainder has the sign of the dividend and not that of the divisor y."""
    return ca.logic_and(rest != 0, (rest < 0) != (y < 0))


def _binary(operation: Callable[[Any, Any], Any], truth: bool = False) -> Callable[[Any, Any], Any]:
    def apply(a: Any, b: Any) -> Any:
        return _own(_Array._binop(a, b, operation), truth)

    return apply


def _are_truth(*values: Any) -> bool:
    """Whether all values are truth values: of a comparison or of logic, or Python's or NumPy's."""
    for value in values:
        if isinstance(value, _Array):
            if not getattr(value, "is_truth", False):
                return False
        elif not isinstance(value, bool | np.bool_ | np.ndarray) or np.asarray(value).dtype != bool:
            return False
    return True


def _of_truth(operation: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a logical operation on truth values; not implemented for others."""
    apply = _binary(operation, truth=True)
    return lambda a, b: apply(a, b) if _are_truth(a, b) else NotImplemented


def _invert(a: Any) -> Any:
    return _own(_Array._wrap(ca.logic_not(a._v), a._ndim), True) if _are_truth(a) else NotImplemented


def _truth_of(operation: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda a: _own(_Array._wrap(operation(a._v), a._ndim), True)


def _accumulate(choose: Any, a: Any, axis: int = 0) -> Any:
    """Return the smallest or largest entry so far along a vector."""
    if a.ndim != 1:
        return NotImplemented
    made = [a[0]]
    for i in range(1, a.shape[0]):
        made.append(choose(made[-1], a[i]))
    return np.stack(made)


def _without_new_axes(a: Any, index: tuple[Any, ...]) -> Any:
    """Return an array indexed with ``None`` among the parts, each of which is an axis of length one."""
    rest = tuple(part for part in index if part is not None)
    plain = a[rest] if rest else a
    sizes, shape = list(plain.shape), list[int]()
    for part in index:
        if part is None:
            shape.append(1)
        elif part is Ellipsis:
            shape += sizes
            sizes = []
        elif not isinstance(part, int | np.integer):
            shape.append(sizes.pop(0))
    return plain.reshape(tuple(shape + sizes))


_mod, _floordiv = _binary(_remainder), _binary(_floor_divide)
_or, _and, _xor = _of_truth(ca.logic_or), _of_truth(ca.logic_and), _of_truth(lambda a, b: a != b)
_UFUNCS: dict[np.ufunc, Callable[..., Any]] = {
    np.remainder: _mod,
    np.floor_divide: _floordiv,
    np.divmod: lambda a, b: (_floordiv(a, b), _mod(a, b)),
    np.add: _or,  # of truth values; of others it is not implemented here
    np.bitwise_or: _or,
    np.bitwise_and: _and,
    np.bitwise_xor: _xor,
    np.invert: _invert,
    np.isnan: _truth_of(lambda v: ca.logic_not(v <= np.inf)),  # CasADi takes v != v for false
    np.isfinite: _truth_of(lambda v: ca.fabs(v) < np.inf),
    np.isinf: _truth_of(lambda v: ca.fabs(v) == np.inf),
}
_TRUTH: set[np.ufunc] = {np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal}
_TRUTH |= {np.logical_and, np.logical_or, np.logical_not, np.logical_xor, np.signbit}


def _number(a: Any, convert: Callable[[], Any], text: str) -> Any:
    """Return what a conversion of a constant gives; raise an error with the text for a symbol."""
    try:
        return convert()
    except (RuntimeError, TypeError, NotImplementedError):
        raise NotTracedError(text) from None


def _logic(operation: Callable[[Any, Any], Any], a: Any, b: Any) -> Any:
    made = operation(a, b)
    if made is NotImplemented:
        raise NotTracedError(LOGIC)
    return made


def _hand_on(name: str, compute: Callable[[], Any]) -> Any:
    """Return what CasADi's interface computes."""
    # arguments that it does not know it hands back to NumPy, which asks it again, without end: that is an error
    depth = _depth.get()
    if depth >= _DEEPEST:
        raise NotTracedError(advise_on_arguments(name))
    token = _depth.set(depth + 1)
    try:
        return compute()
    finally:
        _depth.reset(token)


class TracedArray(_Array):  # type: ignore[misc]
    """Array of symbols; see the module. ``is_truth`` says whether its entries are truth values."""

    is_truth = False

    @property
    def T(self) -> Any:  # noqa: N802 - NumPy's name
        """The transpose."""
        return _own(super().T, self.is_truth)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method == "__call__" and not options and ufunc in _UFUNCS:
            made = _UFUNCS[ufunc](*inputs)
            if made is not NotImplemented:
                return made
        if method == "accumulate" and ufunc in (np.minimum, np.maximum):
            return _accumulate(ufunc, *inputs, **options)
        name = ufunc.__name__ + (f".{method}" if method != "__call__" else "")
        made = _hand_on(name, lambda: super(TracedArray, self).__array_ufunc__(ufunc, method, *inputs, **options))
        if made is NotImplemented and all(
            isinstance(i, _Array | np.ndarray | np.generic | int | float) for i in inputs
        ):
            raise NotTracedError((advise_on_arguments if _CHOICES & options.keys() else advise)(name))
        return _own(made, ufunc in _TRUTH)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function in FUNCTIONS:
            made = FUNCTIONS[function](*args, **kwargs)
            if made is not NotImplemented:
                return made
        truth = False
        if function in _JOINS and args:
            joined = args[1:] if function is np.where else args[0] if isinstance(args[0], tuple | list) else args[:1]
            truth = _are_truth(*joined)
        made = _hand_on(
            function.__name__, lambda: super(TracedArray, self).__array_function__(function, types, args, kwargs)
        )
        if made is NotImplemented:
            raise NotTracedError(advise(function.__name__))
        return _own(made, truth)

    def __getitem__(self, index: Any) -> Any:
        parts = index if isinstance(index, tuple) else (index,)
        if any(isinstance(part, _Array) for part in parts):
            raise NotTracedError(INDEX)
        if any(part is None for part in parts):
            return _own(_without_new_axes(self, parts), self.is_truth)
        return _own(super().__getitem__(index), self.is_truth)

    def __bool__(self) -> bool:
        return bool(_number(self, super().__bool__, TRUTH))

    def __float__(self) -> float:
        return float(_number(self, super().__float__, NUMBER))

    def __int__(self) -> int:
        return int(_number(self, super().__float__, NUMBER))

    def __round__(self, digits: int | None = None) -> Any:
        raise NotTracedError(ROUND)

    def __array__(self, *args: Any, **options: Any) -> Any:
        return _number(self, lambda: super(TracedArray, self).__array__(*args, **options), ARRAY)

    def clip(self, low: Any = None, high: Any = None) -> Any:
        """Return the entries limited to a range."""
        return np.clip(self, low, high)

    def dot(self, other: Any) -> Any:
        """Return the product with a vector or matrix."""
        return np.dot(self, other)

    def cumsum(self) -> Any:
        """Return the sums so far."""
        return np.cumsum(self)

    def argmax(self) -> Any:
        """Return the place of the first largest entry."""
        return argmax(self)

    def argmin(self) -> Any:
        """Return the place of the first smallest entry."""
        return argmin(self)

    def copy(self) -> Any:
        """Return the array itself, which never changes."""
        return self

    def astype(self, kind: Any) -> Any:
        """Return the array as one of numbers; whole numbers are none while it is traced."""
        if np.dtype(kind) == np.dtype(float):
            return _own(_Array._wrap(self._v, self._ndim), False)
        raise NotTracedError(f"entries are floating-point numbers; expected astype(float), not {kind}. Write np.floor")

    def tolist(self) -> Any:
        """Return the entries, in lists for each axis."""
        return self if self.ndim == 0 else [self[i].tolist() for i in range(self.shape[0])]

    def __add__(self, other: Any) -> Any:
        return _or(self, other) if _are_truth(self, other) else _own(super().__add__(other), False)

    def __radd__(self, other: Any) -> Any:
        return _or(other, self) if _are_truth(self, other) else _own(super().__radd__(other), False)

    def __mod__(self, other: Any) -> Any:
        return _mod(self, other)

    def __rmod__(self, other: Any) -> Any:
        return _mod(other, self)

    def __floordiv__(self, other: Any) -> Any:
        return _floordiv(self, other)

    def __rfloordiv__(self, other: Any) -> Any:
        return _floordiv(other, self)

    def __divmod__(self, other: Any) -> Any:
        return _floordiv(self, other), _mod(self, other)

    def __rdivmod__(self, other: Any) -> Any:
        return _floordiv(other, self), _mod(other, self)

    def __or__(self, other: Any) -> Any:
        return _logic(_or, self, other)

    def __and__(self, other: Any) -> Any:
        return _logic(_and, self, other)

    def __xor__(self, other: Any) -> Any:
        return _logic(_xor, self, other)

    __ror__, __rand__, __rxor__ = __or__, __and__, __xor__

    def __invert__(self) -> Any:
        made = _invert(self)
        if made is NotImplemented:
            raise NotTracedError("expected truth values behind ~. Write ~(u > 0)")
        return made


def _carried_over(name: str) -> Callable[..., Any]:
    """Return a method of CasADi's array whose results have the operations of this module."""
    inherited = getattr(_Array, name)

    def method(self: TracedArray, *args: Any, **options: Any) -> Any:
        truth = name in _COMPARISONS or (name in _MOVES and self.is_truth)
        return _own(inherited(self, *args, **options), truth)

    return method


for _name in (*_COMPARISONS, *_MOVES, *_ARITHMETIC):
    if hasattr(_Array, _name):
        setattr(TracedArray, _name, _carried_over(_name))

"""NumPy functions of arrays of symbols that CasADi's own interface does not have, and advice on those that nobody has.

They are written in operations that trace: comparisons, `np.where`, sums. A function returns `NotImplemented` for
arguments of a kind that it does not take.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

MOST_SORTED = 64
"""Entries at most that are sorted: the number of comparisons grows with the square."""


class NotTracedError(TypeError):
    """Operation on symbols that can't be traced; the text says what to write."""


def _ndim(value: Any) -> int:
    shape = getattr(value, "shape", None)  # np.ndim does not work on symbols
    return len(np.shape(value) if shape is None else shape)


def sort(a: Any, axis: int = -1) -> Any:
    """Return the entries of a vector in rising order."""
    if _ndim(a) != 1 or not 1 <= a.shape[0] <= MOST_SORTED:
        return NotImplemented
    entries = [a[i] for i in range(a.shape[0])]
    for end in range(len(entries) - 1, 0, -1):
        for i in range(end):
            left, right = entries[i], entries[i + 1]
            swap = right < left  # a permutation, also of NaN
            entries[i], entries[i + 1] = np.where(swap, right, left), np.where(swap, left, right)
    return np.stack(entries)


def median(a: Any, axis: int | None = None) -> Any:
    """Return the median of a vector; NaN if an entry is."""
    ordered = sort(a)
    if ordered is NotImplemented:
        return NotImplemented
    n = a.shape[0]
    middle = ordered[n // 2] if n % 2 else 0.5 * (ordered[n // 2 - 1] + ordered[n // 2])
    return np.where(np.any(np.isnan(a)), np.nan, middle)


def argmax(a: Any, axis: int | None = None) -> Any:
    """Return the place of the first largest entry of a vector."""
    return _place(a, lambda new, best: new > best)


def argmin(a: Any, axis: int | None = None) -> Any:
    """Return the place of the first smallest entry of a vector."""
    return _place(a, lambda new, best: new < best)


def _place(a: Any, is_better: Callable[[Any, Any], Any]) -> Any:
    if _ndim(a) != 1:
        return NotImplemented
    best, place = a[0], 0.0 * a[0]
    for i in range(1, a.shape[0]):
        better = is_better(a[i], best) | (np.isnan(a[i]) & ~np.isnan(best))
        best, place = np.where(better, a[i], best), np.where(better, float(i), place)
    return np.where(np.isnan(a[0]), 0.0, place)


def polyval(p: Any, x: Any) -> Any:
    """Return a polynomial's value by Horner's scheme, the highest power first, as NumPy does."""
    if _ndim(p) != 1:
        return NotImplemented
    y = 0.0 * x
    for i in range(np.shape(p)[0] if not hasattr(p, "shape") else p.shape[0]):
        y = y * x + p[i]
    return y


def norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:  # noqa: A002 - NumPy's name
    """Return the norm of a vector along its only axis."""
    if _ndim(x) != 1 or axis not in (0, -1) or keepdims:
        return NotImplemented
    return np.linalg.norm(x, ord)


def tensordot(a: Any, b: Any, axes: Any = 2) -> Any:
    """Return the inner product of two vectors."""
    return np.dot(a, b) if _ndim(a) == _ndim(b) == 1 and axes in (1, ((0,), (0,)), (0, 0)) else NotImplemented


def expand_dims(a: Any, axis: int) -> Any:
    """Return an array with a further axis of length one."""
    if not isinstance(axis, int) or _ndim(a) > 1:
        return NotImplemented
    shape = list(np.shape(a)) if not hasattr(a, "shape") else list(a.shape)
    shape.insert(axis if axis >= 0 else axis + len(shape) + 1, 1)
    return a.reshape(tuple(shape))


def tile(A: Any, reps: Any) -> Any:
    """Return a vector repeated a number of times."""
    if _ndim(A) > 1 or not isinstance(reps, int) or reps < 1:
        return NotImplemented
    return np.concatenate([np.atleast_1d(A)] * reps)


def block(arrays: Any) -> Any:
    """Return an array of blocks: a list of vectors, or rows of matrices."""
    if not isinstance(arrays, list) or not arrays:
        return NotImplemented
    if not isinstance(arrays[0], list):
        wide = max(_ndim(a) for a in arrays) > 1
        return np.hstack(arrays) if wide else np.concatenate([np.atleast_1d(a) for a in arrays])
    rows = [[a if _ndim(a) == 2 else np.reshape(a, (1, -1)) for a in row] for row in arrays]
    return np.vstack([np.hstack(row) for row in rows])


def piecewise(x: Any, condlist: Sequence[Any], funclist: Sequence[Any]) -> Any:
    """Return pieces of functions, where their conditions hold; of several that hold the last one counts."""
    conditions, pieces = list(condlist), list(funclist)
    values = [piece(x) if callable(piece) else piece + 0.0 * x for piece in pieces]
    made = values.pop() if len(values) == len(conditions) + 1 else 0.0 * x
    for condition, value in zip(conditions, values, strict=True):
        made = np.where(condition, value, made)
    return made


def searchsorted(a: Any, v: Any, side: str = "left", sorter: Any = None) -> Any:
    """Return the places of symbols among sorted numbers."""
    if not isinstance(a, list | tuple | np.ndarray) or _ndim(a) != 1 or sorter is not None:
        return NotImplemented
    return sum(np.where(v > e if side == "left" else v >= e, 1.0, 0.0) for e in np.asarray(a, dtype=float).tolist())


def _same(a: Any, *args: Any, **options: Any) -> Any:
    return a


FUNCTIONS: Mapping[Any, Callable[..., Any]] = {
    np.sort: sort,
    np.median: median,
    np.argmax: argmax,
    np.argmin: argmin,
    np.polyval: polyval,
    np.linalg.norm: norm,
    np.tensordot: tensordot,
    np.expand_dims: expand_dims,
    np.tile: tile,
    np.block: block,
    np.piecewise: piecewise,
    np.searchsorted: searchsorted,
    np.real: _same,
    np.copy: _same,
}
"""NumPy's functions that are computed here."""

_INSTEAD: Mapping[str, str] = {
    "argsort": "Write np.sort for the values",
    "array": "Write np.stack([a, b]) for a vector of symbols",
    "dstack": "Write np.stack or np.concatenate",
    "nonzero": "Write np.where(condition, a, b)",
    "rint": "Write np.floor(v + 0.5)",
    "unique": "Write np.sort for the values in order",
}


def advise(name: str) -> str:
    """Return what to write in place of a function of NumPy that can't be traced."""
    return f"np.{name} can't be traced. {_INSTEAD.get(name, 'Write it in sums, products, comparisons and np.where')}"


def advise_on_arguments(name: str) -> str:
    """Return what to write for a function of NumPy that traces, but not with symbols in these arguments."""
    return (
        f"np.{name} can't be traced with symbols in these arguments. Give symbols by position, leave out=, where= and "
        "initial= out, and write np.where(condition, a, b) for what depends on a condition"
    )


TRUTH = (
    "a symbol has no truth value while it is traced, so that if, and, or, not, min(), max(), sorted() and chains such "
    "as 0 < u < 1 don't work. Write np.where(condition, a, b) for if, (u > 0) & (u < 1) for and, | for or, ~ for not, "
    "np.minimum, np.maximum or np.min for min and max, np.sort for sorted"
)
NUMBER = (
    "a symbol is no number while it is traced, so that float(), int(), range() and functions of math don't work. Write "
    "NumPy's functions, such as np.sin for math.sin and np.floor for int"
)
ARRAY = (
    "symbols can't be in an array of numbers. Write np.stack([a, b]) for np.array([a, b]), and leave np.asarray "
    "out: the argument is an array already"
)
LOGIC = (
    "expected truth values on both sides of &, | and ^. Put comparisons in parentheses, (u > 0) & (u < 1), as & comes "
    "before them"
)
INDEX = (
    "a symbol is no index while it is traced. Write np.where(mask, u, 0.0) for u[mask], and np.interp or a sum over "
    "np.where(i == k, u[k], 0.0) for u[i]"
)
ROUND = "round() can't be traced. Write np.floor(v + 0.5), which is the same in NumPy and in a trace"

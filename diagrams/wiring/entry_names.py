"""Entries of arrays in names of signals and parameters: ``name[i]``, or ``name[i,j]`` of a matrix, counted from 1."""

from __future__ import annotations

import re
from collections.abc import Collection

import numpy as np

from ...blocks.core import ParameterError, UnknownNameError, shorten

Entry = tuple[int, ...]
"""Numbers in brackets behind a name, counted from 1; none for the whole array."""


def split_entry(name: str, known: Collection[str]) -> tuple[str, Entry]:
    """Return a name and the entry behind it; a known name may end in brackets, too."""
    found = re.fullmatch(r"(.+)\[(\d+(?:,\d+)*)\]", name)
    if found is None or name in known:
        return name, ()
    return found[1], tuple(int(i) for i in found[2].split(","))


def index_of(entry: Entry, shape: tuple[int, ...], name: str) -> tuple[int, ...]:
    """Return the index of an entry in an array of a shape, counted from 0."""
    if len(entry) == len(shape) and all(1 <= i <= n for i, n in zip(entry, shape, strict=True)):
        return tuple(i - 1 for i in entry)
    if len(entry) == 1 and 1 <= entry[0] <= int(np.prod(shape)) and shape:
        return tuple(int(i) for i in np.unravel_index(entry[0] - 1, shape))
    raise UnknownNameError(
        f"{name!r} has no entry {list(entry)}; expected one within its shape {shape}, counted from 1."
        if shape
        else f"{name!r} has no entry {list(entry)}, as it is a scalar. Leave the brackets out."
    )


def with_entry(array: object, entry: Entry, value: object, name: str) -> object:
    """Return an array of numbers with another value of one entry: an array, or lists if it was none."""
    whole = np.asarray(array)
    if whole.dtype.kind not in "iuf":
        raise UnknownNameError(f"{name!r} is {shorten(array)}, without entries that are numbers. Name it alone.")
    place = index_of(entry, whole.shape, name)
    number = np.asarray(value)
    if number.ndim or number.dtype.kind not in "iuf":
        raise ParameterError(
            f"found {shorten(value)} for entry {list(entry)}; expected one number. Give the whole array as {name!r}.",
            port=name,
        )
    changed = whole.astype(np.result_type(whole, number))
    changed[place] = number
    return changed if isinstance(array, np.ndarray) else changed.tolist()

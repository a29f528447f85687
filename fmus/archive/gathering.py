"""Scalars ``s[1]``, ``s[2]``, … become one array ``s``, so that FMUs of FMI 2.0 and 3.0 fit the same wires."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .variables import FmuVariable

_INDEXED = re.compile(r"(?P<stem>.*[^\[\]])\[(?P<index>\d+(?: *, *\d+)*)\](?P<tail>\)*)")

Elements = dict[str, tuple[str, tuple[int, ...]]]
"""Array and index, from 0 on, of scalars that were gathered, by their names."""


def gather(scalars: Mapping[str, FmuVariable], taken: frozenset[str]) -> tuple[dict[str, FmuVariable], Elements]:
    """Gather scalars with indices into arrays, where they are contiguous from 0 or 1, and alike.

    Alike are scalars of one type, causality, variability, ``initial`` and unit, that all or none have start values. A
    derivative ``der(s[1])`` gathers into ``der(s)``. An array takes the place of its first scalar.

    Parameters
    ----------
    scalars : mapping
        All variables by name; those with a shape, and those without an index, stay.
    taken : frozenset of str
        Further names that an array can't have.

    Returns
    -------
    dict, dict
        Variables by name, and array and index of each scalar that was gathered.
    """
    groups: dict[str, list[tuple[tuple[int, ...], FmuVariable]]] = {}
    stem_of: dict[str, str] = {}
    for name, variable in scalars.items():
        match = _INDEXED.fullmatch(name) if not variable.shape else None
        if match is not None:
            stem = match["stem"] + match["tail"]
            index = tuple(int(i) for i in match["index"].split(","))
            groups.setdefault(stem, []).append((index, variable))
            stem_of[name] = stem
    found: dict[str, FmuVariable] = {}
    elements: Elements = {}
    arrays = {
        stem: array
        for stem, group in groups.items()
        if stem not in scalars and stem not in taken and (array := _array(stem, group)) is not None
    }
    for name, variable in scalars.items():
        stem = stem_of.get(name, "")
        if stem not in arrays:
            found[name] = variable
        elif stem not in found:
            found[stem] = arrays[stem][0]
            elements.update({v.name: (stem, index) for v, index in arrays[stem][1]})
    return found, elements


def _array(
    name: str, group: list[tuple[tuple[int, ...], FmuVariable]]
) -> tuple[FmuVariable, list[tuple[FmuVariable, tuple[int, ...]]]] | None:
    """Return the array of scalars with indices, and the scalars in its order; None if they make none."""
    if len({len(index) for index, _ in group}) > 1:
        return None
    group = sorted(group, key=lambda pair: pair[0])  # a complete grid is in C order then
    indices, members = [index for index, _ in group], [variable for _, variable in group]
    base = min(min(index) for index in indices)
    shape = tuple(int(n) for n in np.max(indices, axis=0) - base + 1)
    complete = len(set(indices)) == len(indices) == np.prod(shape, dtype=int)
    if base not in (0, 1) or not complete or len({_kind(v) for v in members}) > 1:
        return None
    first = members[0]
    array = replace(
        first,
        name=name,
        references=tuple(r for v in members for r in v.references),
        shape=shape,
        start=None if first.start is None else np.array([v.start for v in members], dtype=float).reshape(shape),
        minimum=_common([v.minimum for v in members], -np.inf, shape),
        maximum=_common([v.maximum for v in members], np.inf, shape),
        nominal=_common([v.nominal for v in members], 1.0, shape),
    )
    return array, [(v, tuple(i - base for i in index)) for v, index in zip(members, indices, strict=True)]


def _kind(v: FmuVariable) -> tuple[Any, ...]:
    return v.type, v.causality, v.variability, v.initial, v.unit, v.start is None, tuple(v.items.items()), v.clocks


def _common(values: list[Any], default: float, shape: tuple[int, ...]) -> Any:
    """Return the value that all have, else each one's, with a default for those without."""
    if len(set(values)) == 1:
        return values[0]
    return np.array([default if value is None else value for value in values]).reshape(shape)

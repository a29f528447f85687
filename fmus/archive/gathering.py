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
Join = tuple[tuple[FmuVariable, tuple[int, ...]], ...]
"""Scalars of an array that the user has put together, with their indices from 0 on, in C order."""


def read_index(name: str) -> tuple[str, tuple[int, ...]]:
    """Return the array and the index of an element's name, ``("s", (1,))`` of ``"s[1]"``; no index for other names."""
    match = _INDEXED.fullmatch(name)
    if match is None:
        return name, ()
    return match["stem"] + match["tail"], tuple(int(i) for i in match["index"].split(","))


def gather(
    scalars: Mapping[str, FmuVariable], taken: frozenset[str], joins: Mapping[str, Join] | None = None
) -> tuple[dict[str, FmuVariable], Elements, dict[str, str]]:
    """Gather scalars with indices into arrays, where they are contiguous from 0 or 1, and alike.

    Alike are scalars of one type, causality, variability, ``initial`` and unit, that all or none have start values. A
    derivative ``der(s[1])`` gathers into ``der(s)``. An array takes the place of its first scalar. Names in ``taken``
    are for none; ``joins`` are arrays that the user has put together, by their ports: an array of the FMU's own that
    has one of their scalars is not gathered.

    Returned are variables by name, array and index of each scalar that was gathered, and the ports of the joins by the
    names of their arrays: the port's, where no variable has it, else those of the scalars.
    """
    joins = joins or {}
    port_of = {v.name: port for port, join in joins.items() for v, _ in join}
    groups: dict[str, list[tuple[tuple[int, ...], FmuVariable]]] = {}
    stem_of: dict[str, str] = {}
    for name, variable in scalars.items():
        stem, index = read_index(name) if not variable.shape else (name, ())
        if index:
            groups.setdefault(stem, []).append((index, variable))
            stem_of[name] = stem
    found: dict[str, FmuVariable] = {}
    elements: Elements = {}
    arrays = {
        stem: array
        for stem, group in groups.items()
        if stem not in scalars
        and stem not in taken
        and not any(v.name in port_of for _, v in group)
        and (array := _array(stem, group)) is not None
    }
    names = {
        port: port if not (port in scalars or port in taken or port in arrays) else ", ".join(v.name for v, _ in join)
        for port, join in joins.items()
    }
    for name, variable in scalars.items():
        stem = stem_of.get(name, "")
        if name in port_of:
            array_name, join = names[port_of[name]], joins[port_of[name]]
            if array_name not in found:
                found[array_name] = _join(array_name, join)
                elements.update({v.name: (array_name, index) for v, index in join})
        elif stem not in arrays:
            found[name] = variable
        elif stem not in found:
            found[stem] = arrays[stem][0]
            elements.update({v.name: (stem, index) for v, index in arrays[stem][1]})
    return found, elements, {array: port for port, array in names.items()}


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
    array = _make_array(name, members, shape)
    return array, [(v, tuple(i - base for i in index)) for v, index in zip(members, indices, strict=True)]


def _join(name: str, join: Join) -> FmuVariable:
    """Return the array of scalars that the user has put together; it has a start value if all of them have."""
    members, shape = [v for v, _ in join], tuple(int(n) + 1 for n in np.max([index for _, index in join], axis=0))
    same = len({v.initial for v in members}) == 1
    return replace(_make_array(name, members, shape), initial=members[0].initial if same else "calculated")


def _make_array(name: str, members: list[FmuVariable], shape: tuple[int, ...]) -> FmuVariable:
    has_start = all(v.start is not None for v in members)
    return replace(
        members[0],
        name=name,
        references=tuple(r for v in members for r in v.references),
        shape=shape,
        start=np.array([v.start for v in members], dtype=float).reshape(shape) if has_start else None,
        minimum=_common([v.minimum for v in members], -np.inf, shape),
        maximum=_common([v.maximum for v in members], np.inf, shape),
        nominal=_common([v.nominal for v in members], 1.0, shape),
    )


def _kind(v: FmuVariable) -> tuple[Any, ...]:
    return v.type, v.causality, v.variability, v.initial, v.unit, v.start is None, tuple(v.items.items()), v.clocks


def _common(values: list[Any], default: float, shape: tuple[int, ...]) -> Any:
    """Return the value that all have, else each one's, with a default for those without."""
    if len(set(values)) == 1:
        return values[0]
    return np.array([default if value is None else value for value in values]).reshape(shape)

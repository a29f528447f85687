"""Continuous states of an FMU and their derivatives, by the model structure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from .gathering import Elements
from .variables import FmuVariable


def read_derivatives(model: Any) -> dict[str, str]:
    """Return the derivatives' names by those of their states, in order; none if one of these is no variable."""
    pairs = {
        u.variable.derivative.name: u.variable.name for u in model.derivatives if u.variable.derivative is not None
    }
    return pairs if len(pairs) == len(model.derivatives) else {}


def find_states(
    pairs: Mapping[str, str], scalars: Mapping[str, FmuVariable], variables: dict[str, FmuVariable], elements: Elements
) -> tuple[dict[str, str], tuple[int, ...]]:
    """Return states with their derivatives, and the order of their elements (FMI 2.0, 2.2.8; FMI 3.0, 2.4.8).

    There are none if one is missing or no Float64. Variables are added where gathered arrays don't fit: a scalar state
    of an array with elements that are no states, and an array for derivatives that are not gathered like their states.
    ``pairs`` are of `read_derivatives`, ``scalars`` the variables before they were gathered. The order has the place of
    each of the FMU's states among the elements of those returned.
    """
    names = {*pairs, *pairs.values()}
    if any(n not in scalars or scalars[n].type != "Float64" for n in names):
        return {}, ()
    members: dict[str, list[str]] = {}
    for name, (array, _) in elements.items():
        members.setdefault(array, []).append(name)  # in the array's order
    states: dict[str, str] = {}
    place: dict[str, int] = {}
    total = 0
    for name in pairs:
        if name in place:
            continue
        array = elements[name][0] if name in elements else name
        parts = members.get(array, [name])
        if not all(part in pairs for part in parts):
            array, parts = name, [name]
            variables[name] = replace(scalars[name], causality="local")
        states[array] = _derivative(array, [pairs[part] for part in parts], scalars, variables, elements, members)
        place.update({part: total + i for i, part in enumerate(parts)})
        total += variables[array].size
    order = tuple(place[name] + i for name in pairs for i in range(scalars[name].size))
    return states, order


def _derivative(
    state: str,
    parts: list[str],
    scalars: Mapping[str, FmuVariable],
    variables: dict[str, FmuVariable],
    elements: Elements,
    members: dict[str, list[str]],
) -> str:
    """Return the name of the variable whose elements are the derivatives of a state's; it is added if there is none."""
    first = parts[0]
    if first in elements and members[elements[first][0]] == parts:
        return elements[first][0]
    if len(parts) == 1 and scalars[first].shape == variables[state].shape:
        if first not in variables:
            variables[first] = replace(scalars[first], causality="local")
        return first
    name = f"der({state})"
    while name in variables:
        name = f"der({name})"
    references = tuple(scalars[part].reference for part in parts)
    variables[name] = replace(
        scalars[first], name=name, references=references, shape=variables[state].shape, start=None, causality="local"
    )
    return name

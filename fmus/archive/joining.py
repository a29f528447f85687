"""Scalars with unrelated names become elements of an array port: ``rename={"s_Y": "position[1]", …}``."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...blocks.core import ParameterError
from .aliases import find_aliases
from .description import FmuDescription
from .gathering import Join, gather, read_index
from .states import find_states
from .variables import FmuVariable

_PORT = "rename"


def join_scalars(description: FmuDescription, rename: Mapping[str, str], label: str) -> FmuDescription:
    """Return the description with arrays of the scalars that are renamed to elements, such as ``position[1]``.

    All that holds for scalars ``s[1]``, ``s[2]`` of the FMU's own, which `gather` puts together, holds for these.
    """
    if not rename or not any("[" in new for new in rename.values()):
        return description
    return _join(description, tuple(rename.items()), label)


@lru_cache(maxsize=64)
def _join(description: FmuDescription, rename: tuple[tuple[str, str], ...], label: str) -> FmuDescription:
    groups: dict[str, list[tuple[str, tuple[int, ...]]]] = {}
    for old, new in rename:
        stem, index = read_index(new)
        if index and old in description.names and old not in description.aliases:
            groups.setdefault(stem, []).append((old, index))
    joins: dict[str, Join] = {}
    for port, members in groups.items():
        joins[port] = _check(description, port, sorted(members, key=lambda pair: pair[1]), label)
    if not joins:
        return description
    return _gather(description, joins, dict(rename))


def _check(
    description: FmuDescription, port: str, members: list[tuple[str, tuple[int, ...]]], label: str
) -> tuple[tuple[FmuVariable, tuple[int, ...]], ...]:
    """Return the members of an array with their indices from 0 on, in C order."""

    def refuse(found: str, expected: str, step: str) -> ParameterError:
        return ParameterError(
            f"found {found} for the port {port!r}; expected {expected}. {step}", block=label, port=_PORT
        )

    def element(index: tuple[int, ...]) -> str:
        return f"{port}[{','.join(map(str, index))}]"

    # Each member is a scalar, is there once, and has as many indices as the others.
    pairs = [(description.scalars.get(name, description.find(name)), index) for name, index in members]
    for variable, index in pairs:
        if variable.shape:
            raise refuse(
                f"{variable.name!r} of shape {variable.shape} as its element {element(index)}",
                "a scalar",
                "Give an array a name without an index, or name its elements.",
            )
    first, its_index = pairs[0]
    for (a, i), (b, j) in itertools.pairwise(pairs):
        if i == j:
            raise refuse(f"both {a.name!r} and {b.name!r} as {element(i)}", "each element once", "Rename one of them.")
    if len({len(index) for _, index in pairs}) > 1:
        other = next(index for _, index in pairs if len(index) != len(its_index))
        raise refuse(
            f"{element(its_index)} and {element(other)}",
            "as many indices for each element",
            "Give them alike.",
        )
    # Counting begins at 0 or 1, as the names do, and leaves no gap.
    base = min(min(index) for _, index in pairs)
    indices = [index for _, index in pairs]
    ends = np.max(indices, axis=0)
    start = min(base, 1)
    missing = [i for i in itertools.product(*(range(start, int(end) + 1) for end in ends)) if i not in indices]
    if missing:
        shown = ", ".join(element(i) for i in missing[:3]) + (", …" if len(missing) > 3 else "")
        raise refuse(
            f"no variable that is renamed to {shown}",
            f"all of its elements from {element((start,) * len(ends))} to {element(tuple(map(int, ends)))}",
            "Rename those, too, or count without gaps.",
        )
    # One port has one type and one meaning: what the members say of themselves must agree.
    for variable, _ in pairs[1:]:
        for what, mine, its in (
            ("type", first.type, variable.type),
            ("causality", first.causality, variable.causality),
            ("variability", first.variability, variable.variability),
            ("unit", first.unit, variable.unit),
            ("enumeration", ", ".join(first.items), ", ".join(variable.items)),
            ("clock", ", ".join(first.clocks), ", ".join(variable.clocks)),
        ):
            if mine != its:
                raise refuse(
                    f"{first.name!r} with the {what} {mine or '(none)'} and {variable.name!r} with the {what} "
                    f"{its or '(none)'}",
                    f"one {what}",
                    "Give them their own ports, by names without an index.",
                )
    return tuple((variable, tuple(k - start for k in index)) for variable, index in pairs)


def _gather(base: FmuDescription, joins: Mapping[str, Join], rename: Mapping[str, str]) -> FmuDescription:
    """Return the description with its scalars gathered once more, those of the joins first."""
    variables, elements, joined = gather(base.scalars, frozenset(base.other), joins)
    states, order = find_states(base.derivatives, base.scalars, variables, elements)
    variables, aliases = find_aliases(variables)
    for name, first in base.aliases.items():  # further names of a variable that is an element now
        if name in variables and name not in aliases:
            aliases[name] = first
            if variables[name].causality == "input":
                variables[name] = replace(variables[name], causality="local")
    members = {v.name: v for join in joins.values() for v, _ in join}
    known = {*variables, *elements, *base.other}
    spelled = {rename[name]: name for name in members if rename[name] not in known}
    return replace(
        base,
        variables=variables,
        elements=elements,
        states=states,
        state_order=order,
        aliases=aliases,
        joined=joined,
        members=members,
        spelled=spelled,
    )

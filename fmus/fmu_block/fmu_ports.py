"""Ports of an FMU's block: which of its variables they are, and their names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

from ...blocks.core import ParameterError, UnknownNameError, near
from ..archive import FmuDescription, FmuVariable, OtherVariable, read_index


@dataclass(frozen=True, eq=False)
class FmuPorts:
    """Variables of an FMU by the names of their ports, in the order of the file."""

    inputs: dict[str, FmuVariable]
    outputs: dict[str, FmuVariable]
    texts: dict[str, OtherVariable]
    """Texts and binary data that are recorded."""


@lru_cache(maxsize=64)
def choose_ports(
    description: FmuDescription, rename: tuple[tuple[str, str], ...], chosen: tuple[str, ...] | None, label: str
) -> FmuPorts:
    """Return the ports of a block; ``chosen`` are the variables that are ports, None for all inputs and outputs.

    Scalars of a gathered array that are renamed are their own ports, and so are the array's other scalars; those that
    are renamed to elements are one port (`join_scalars`).
    """
    members = {n: description.elements[n][0] for n in description.members}
    names = {n: port for n, port in rename if n not in members} | dict(description.joined)
    if chosen is not None:
        chosen = tuple(part for name in chosen for part in taken_apart(description, name) or (name,))
        _check_chosen(description, chosen, label)
        chosen = _choose_joined(description, chosen, members, label)
    # an array is taken apart where one of its scalars is named
    named, elements = (*names, *(chosen or ())), description.elements
    split = {elements[n][0] for n in named if n in elements and n not in description.variables}
    split -= set(chosen or ())
    both: tuple[dict[str, FmuVariable], dict[str, FmuVariable]] = {}, {}
    known: list[str] = []
    for variable in _variables(description, split):
        name, array = variable.name, description.elements.get(variable.name, ("",))[0]
        if chosen is None:
            side = {"input": 0, "output": 1}.get(variable.causality)
        else:
            side = _side(variable) if name in chosen or (array in chosen and array in split) else None
        if side is None:
            continue
        known.append(name)
        port = names.get(name, name)
        if port in both[0] or port in both[1]:
            raise ParameterError(
                "found one name for two ports; rename them to different names.", block=label, port="rename"
            )
        both[side][port] = variable
    texts: dict[str, OtherVariable] = {}
    for name, text in description.texts.items():
        if text.causality == "output" if chosen is None else name in chosen:
            known.append(name)
            texts[names.get(name, name)] = text
    known += [n for n, array in members.items() if array in known]
    for old in (n for n in dict(rename) if n not in known):
        if array := members.get(old, ""):
            joined = description.find(old)
            raise ParameterError(
                f"found {old!r}, a {joined.variability} {joined.causality}, as an element of the port "
                f"{description.joined[array]!r}; expected an input or an output, or a variable that ports= names. "
                "Add it there.",
                block=label,
                port="rename",
            )
        if old in description.aliases:
            raise ParameterError(other_name(description, old), block=label, port="rename")
        raise UnknownNameError(f"it has no port {old!r} to rename. {near(old, known)}", block=label, port="rename")
    return FmuPorts(*both, texts)


def taken_apart(description: FmuDescription, array: str) -> tuple[str, ...]:
    """Return the scalars of an array that would have been gathered, were some not elements of another port now."""
    if array in description.names or array in description.other:
        return ()
    parts = tuple(n for n in description.scalars if read_index(n)[0] == array)
    return parts if any(part in description.members for part in parts) else ()


def _choose_joined(
    description: FmuDescription, chosen: tuple[str, ...], members: Mapping[str, str], label: str
) -> tuple[str, ...]:
    """Return the names of ``ports`` with the arrays that the user has put together in place of their scalars."""
    own = [description.spelled.get(name, name) for name in chosen]
    for name, array in members.items():
        among = [n for n, other in members.items() if other == array and n in own]
        if among and name not in own:
            raise ParameterError(
                f"found {among[0]!r} and not {name!r}, which rename makes elements of one port, "
                f"{description.joined[array]!r}; expected all of them. Add it, or leave ports out.",
                block=label,
                port="ports",
            )
    return tuple(dict.fromkeys(members.get(name, name) for name in own))


def _variables(description: FmuDescription, split: set[str]) -> Iterator[FmuVariable]:
    """Yield all variables, and the scalars of the arrays that are split in their place."""
    parts: dict[str, list[str]] = {array: [] for array in split}
    for name, (array, _) in description.elements.items():
        if array in parts:
            parts[array].append(name)
    for name, variable in description.variables.items():
        if name in parts:
            yield from (description.element(part) for part in parts[name])
        else:
            yield variable


def _side(variable: FmuVariable) -> int | None:
    """Return 0 for a variable that a wire can set, 1 for one that is read, None for others."""
    if variable.causality == "input" or (variable.causality == "parameter" and variable.variability == "tunable"):
        return 0
    return 1 if variable.causality in ("output", "local", "calculatedParameter") else None


def other_name(description: FmuDescription, alias: str) -> str:
    """Return the text of an error on a further name of an input or parameter."""
    first = description.aliases[alias]
    kind = description.find(first).causality
    return f"{alias!r} is another name of its {kind} {first!r}, and the two are one variable. Use {first!r}."


def _check_chosen(description: FmuDescription, chosen: tuple[str, ...], label: str) -> None:
    for name in chosen:
        if name in description.aliases:
            raise ParameterError(other_name(description, name), block=label, port="ports")
        other = description.other.get(name)
        if other is not None and other.is_text and other.causality in ("output", "local", "calculatedParameter"):
            continue
        if other is not None and other.type_is_clock:
            raise ParameterError(
                f"found {name!r}, a {other.interval_variability} {other.causality} clock; expected a number, as no "
                "wire carries a clock. Leave it out: input clocks tick by themselves, triggered ones where an input "
                "that they clock changes.",
                block=label,
                port="ports",
            )
        if other is not None and other.negated_of:
            raise ParameterError(f"found {name!r}, {other.refusal}", block=label, port="ports")
        if other is not None:
            raise ParameterError(
                f"found {name!r}, a {other.causality} of type {other.type}, which no wire carries; expected a "
                "number, or a text or binary output, which is recorded. Leave it out.",
                block=label,
                port="ports",
            )
        if name not in description.names:
            raise UnknownNameError(
                f"the FMU has no variable {name!r}. {near(name, description.names)}", block=label, port="ports"
            )
        variable = description.find(name)
        if _side(variable) is None:
            raise ParameterError(
                f"found {name!r}, a {variable.variability} {variable.causality}; expected an input, an output, a local "
                "variable or a tunable parameter. Give it a value in start= instead.",
                block=label,
                port="ports",
            )


def find_element(
    description: FmuDescription, outputs: Mapping[str, FmuVariable], name: str, label: str
) -> tuple[str, int] | None:
    """Return the port of a vector and the place in it that an FMU's name of an element means; None for other names."""
    array, index = description.elements.get(description.spelled.get(name, name), ("", ()))
    ports = [port for port, v in outputs.items() if v.name == array]
    if not ports:
        return None
    if len(index) != 1:
        raise UnknownNameError(
            f"found {name!r}, an element of the matrix {ports[0]!r}, and a wire takes rows alone. Wire "
            f"plant[{ports[0]!r}][{index[0]}], or make its elements ports: rename={{{name!r}: …}}.",
            block=label,
        )
    return ports[0], index[0]

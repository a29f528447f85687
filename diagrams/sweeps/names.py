"""Names of parameters in a sweep: dotted paths, as `Diagram.replace` takes them, each with one spelling."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import Block, OptionError, UnknownNameError, Value, elements, near
from ..wiring import CheckedDiagram, index_of, split_entry, split_path

_OF_A_SUBSYSTEM = ("sample_time", "method", "offset", "delay")


def find_parameter(diagram: CheckedDiagram, name: object) -> str:
    """Return the full path of a parameter, a start value, a subsystem's setting or a block, for `Diagram.replace`.

    A start value of an FMU is found without ``start`` as well: ``"plant.mass"`` is ``"plant.start.mass"``. An entry of
    an array is one, too, counted from 1: ``"motor.denominator[1]"``.

    Parameters
    ----------
    name : str
        The path, or its unique end.

    Raises
    ------
    OptionError
        If it is no text.
    UnknownNameError
        If nothing, or more than one thing, is called that; near names are offered.
    """
    if not isinstance(name, str) or not name:
        raise OptionError(
            f"found {name!r} as the name of a parameter; expected a dotted path, such as 'controller.gain'.",
            block=diagram.name,
        )
    table = diagram.structure
    if name in table.blocks:
        return name
    head, _, last = name.rpartition(".")
    if last in _OF_A_SUBSYSTEM:
        found = [path for path in table.subsystems if path and head and (path == head or path.endswith("." + head))]
        if len(found) == 1:
            return f"{found[0]}.{last}"
    ends = [path for path in table.blocks if path.endswith("." + name)]
    if len(ends) == 1:
        return ends[0]
    path, keys = split_path(table, name, diagram.name)
    return ".".join([path, *_inside(table.blocks[path], path, keys)])


def _inside(block: Block, path: str, keys: list[str]) -> list[str]:
    """Return the names that lead to a parameter in a block."""
    specs = type(block).parameter_specs
    whole = ".".join(keys)
    array, entry = split_entry(keys[-1], _start_values(block))
    if entry and whole not in _start_values(block) and ".".join(keys[1:]) not in _start_values(block):
        return _entry_inside(block, path, [*keys[:-1], array], entry)
    if keys[0] not in specs:
        starts = _start_values(block)
        if whole in starts:
            return ["start", *keys]
        raise UnknownNameError(f"it has no parameter {whole!r}. {near(whole, [*specs, *starts])}", block=path)
    inner: Any = block
    for place, key in enumerate(keys):
        if isinstance(inner, Value):
            if key not in type(inner).parameter_specs:
                raise UnknownNameError(
                    f"it has no parameter {whole!r}. {near(key, type(inner).parameter_specs)}", block=path
                )
            inner = inner.__dict__[key]
        elif isinstance(inner, Mapping):
            rest = ".".join(keys[place:])
            known = _start_values(block) if keys[0] == "start" else [str(k) for k in inner]
            if rest not in known:
                raise UnknownNameError(f"it has no entry {rest!r} in {keys[0]!r}. {near(rest, known)}", block=path)
            break
        else:
            raise UnknownNameError(
                f"it has no parameter {whole!r}: {'.'.join(keys[:place])!r} is {inner!r}, without parts. "
                "Name it alone.",
                block=path,
            )
    return keys


def _entry_inside(block: Block, path: str, keys: list[str], entry: tuple[int, ...]) -> list[str]:
    """Return the names that lead to an entry of an array in a block."""
    keys = _inside(block, path, keys)
    inner: Any = block
    for key in keys[:-1]:
        inner = inner.__dict__[key] if isinstance(inner, Value) else inner[key]
    if not isinstance(inner, Value):
        raise UnknownNameError(
            f"found an entry of {keys[-1]!r}; expected a whole start value, as the FMU has no variable of the entry's "
            "own. Name it alone.",
            block=path,
        )
    array = np.asarray(inner.__dict__[keys[-1]])
    if array.dtype.kind not in "iuf":
        raise UnknownNameError(f"{keys[-1]!r} has no entries that are numbers. Name it alone.", block=path)
    try:
        place = index_of(entry, array.shape, keys[-1])
    except UnknownNameError as error:
        raise error.at(block=path) from None
    return [*keys[:-1], elements(keys[-1], array.shape)[int(np.ravel_multi_index(place, array.shape))]]


def _start_values(block: Block) -> list[str]:
    """Return the names of the start values that a block of an FMU takes."""
    if "start" not in type(block).parameter_specs or not hasattr(block, "description"):
        return []
    about: Any = block
    return [*about.description.variables, *about.description.elements]

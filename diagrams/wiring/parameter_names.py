"""Names of parameters: dotted paths, or their unique ends, each with one spelling in full.

All that takes parameters by name finds them here: variants, sweeps, sensitivities, worst cases and trims. Behind the
name of a parameter or a signal may be an entry of an array: ``name[i]``, or ``name[i,j]`` of a matrix, counted from 1.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from ...blocks.core import (
    Block,
    OptionError,
    ParameterError,
    UnknownNameError,
    Value,
    elements,
    enumerate_some,
    near,
    shorten,
)
from .structure import Structure

OF_A_SUBSYSTEM = ("sample_time", "method", "offset", "delay")
"""Settings of a subsystem that have names like parameters."""
Entry = tuple[int, ...]
"""Numbers in brackets behind a name, counted from 1; none for the whole array."""


def find_name(table: Structure, name: object, diagram: str) -> str:
    """Return the full path of a parameter, a start value, a subsystem's setting or a block."""
    # A start value of an FMU is found without ``start`` as well: "plant.mass" is "plant.start.mass". An entry of an
    # array is one, too, counted from 1: "motor.denominator[1]".
    name = check_name(name, diagram)
    if name in table.blocks:
        return name
    head, _, last = name.rpartition(".")
    if last in OF_A_SUBSYSTEM:
        found = [path for path in table.subsystems if path and head and (path == head or path.endswith("." + head))]
        if len(found) == 1:
            return f"{found[0]}.{last}"
    ends = [path for path in table.blocks if path.endswith("." + name)]
    if len(ends) == 1:
        return ends[0]
    path, keys = find_place(table, name, diagram)
    return ".".join([path, *keys])


def check_name(name: object, diagram: str) -> str:
    """Return a name of a parameter; refuse what is no text."""
    if not isinstance(name, str) or not name:
        raise OptionError(
            f"found {shorten(name)} as the name of a parameter; expected a text. Give a dotted path, such as "
            "'controller.gain'.",
            block=diagram,
        )
    return name


def find_place(table: Structure, name: str, diagram: str) -> tuple[str, list[str]]:
    """Return the path of a block, and the names that lead to a parameter in it, from its path or the end of one."""
    path, keys = split_path(table, name, diagram)
    return path, _inside(table.blocks[path], path, keys)


def find_control(table: Structure, name: object, diagram: str) -> tuple[str, list[str]]:
    """Return the path of a block, and the names that lead to a parameter in it, of what is moved by hand in a run."""
    # Next to a parameter (`find_place`), a source is named by its own name, or by that of the wire that comes out of
    # it: ``value`` of the `Constant` or `Reference` there is meant.
    name = check_name(name, diagram)
    found = [name] if name in table.blocks else [path for path in table.blocks if path.endswith("." + name)]
    if not found and name in table.names:
        found = [table.names[name].block]
    if len(found) != 1:
        return find_place(table, name, diagram)
    path, block = found[0], table.blocks[found[0]]
    if "value" not in type(block).parameter_specs:
        what = "a block" if name in path else f"a wire that comes out of {path}"
        raise UnknownNameError(
            f"{name!r} is {what}, {type(block).__name__}, which has no value to be moved by hand; expected a Constant, "
            f"or a parameter: {name_parameters(block, path)}.",
            block=diagram,
        )
    return path, ["value"]


def split_path(table: Structure, path: str, diagram: str) -> tuple[str, list[str]]:
    """Split a dotted path into the path of a block and the names of a parameter in it, which are not looked at."""
    parts = path.split(".")
    for cut in range(len(parts) - 1, 0, -1):
        try:
            return find_path(".".join(parts[:cut]), table.blocks, "block", diagram), parts[cut:]
        except UnknownNameError:
            continue
    last = split_entry(path, ())[0]
    owners = [p for p, block in sorted(table.blocks.items()) if last in type(block).parameter_specs]
    if len(owners) == 1:
        return owners[0], [path]
    if owners:
        raise UnknownNameError(
            f"{path!r} is a parameter of {', '.join(owners)}; write the path, such as '{owners[0]}.{path}'."
        )
    if other := _describe_other(table, path):
        raise UnknownNameError(f"{path!r} is {other}", block=diagram)
    known = {f"{p}.{q}" for p, block in table.blocks.items() for q in type(block).parameter_specs} | set(table.blocks)
    raise UnknownNameError(f"nothing is called {path!r} in diagram {diagram!r}. {near(path, known)}")


def name_parameters(block: Block, path: str) -> str:
    """Return the paths of a block's parameters in a row, for messages."""
    names = enumerate_some([f"{path}.{name}" for name in type(block).parameter_specs], 8)
    return names or "it has none"


def _describe_other(table: Structure, path: str) -> str:
    """Return what a name that is no parameter's means, and the parameters there; "" if nothing is called that."""

    def ends(known: Iterable[str]) -> list[str]:
        return [p for p in known if p and (p == path or p.endswith("." + path))]

    expected = "expected a parameter"
    for full in ends(table.blocks):
        block = table.blocks[full]
        return f"a block, {type(block).__name__}; {expected} of it: {name_parameters(block, full)}."
    for full in ends(table.subsystems):
        inside = enumerate_some([p for p, at in table.subsystem_of.items() if at == full], 8)
        settings = enumerate_some([f"{full}.{name}" for name in OF_A_SUBSYSTEM])
        return f"a subsystem; {expected} of a block in it ({inside}), or one of its settings: {settings}."
    for full in ends(table.names):
        wire = table.names[full]
        own = name_parameters(table.blocks[wire.block], wire.block)
        return f"a wire, from {wire}; {expected} of a block, such as its own: {own}."
    return ""


def find_path(path: str, known: Mapping[str, object], kind: str, diagram: str) -> str:
    """Return the full path that ``path``, or the unique end of one, names."""
    if not isinstance(path, str):
        raise UnknownNameError(f"found {path!r}; expected the path of a {kind}, such as {next(iter(known), '')!r}.")
    if path in known:
        return path
    found = sorted(p for p in known if p.endswith("." + path))
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownNameError(f"{path!r} stands for several {kind}s: {', '.join(found)}. Write more of the path.")
    raise UnknownNameError(f"no {kind} {path!r} in diagram {diagram!r}. {near(path, known)}")


def _inside(block: Block, path: str, keys: list[str]) -> list[str]:
    """Return the names that lead to a parameter in a block."""
    specs = type(block).parameter_specs
    if len(keys) == 1 and keys[0] in specs:
        return keys
    whole, starts = ".".join(keys), block.entries_of("start") if "start" in specs else ()
    array, entry = split_entry(keys[-1], starts)
    if entry and whole not in starts and ".".join(keys[1:]) not in starts:
        return _entry_inside(block, path, [*keys[:-1], array], entry)
    if keys[0] not in specs:
        if whole in starts:
            return ["start", *keys]
        raise UnknownNameError(f"it has no parameter {whole!r}. {near(whole, [*specs, *starts])}", block=path)
    inner: object = block
    for place, key in enumerate(keys):
        if isinstance(inner, Value):
            if key not in type(inner).parameter_specs:
                raise UnknownNameError(
                    f"it has no parameter {whole!r}. {near(key, type(inner).parameter_specs)}", block=path
                )
            inner = inner.__dict__[key]
        elif isinstance(inner, Mapping):
            rest = ".".join(keys[place:])
            known = {*map(str, inner), *(block.entries_of(keys[0]) if place == 1 else ())}
            if rest not in known:
                raise UnknownNameError(f"it has no entry {rest!r} in {keys[0]!r}. {near(rest, known)}", block=path)
            break
        else:
            raise UnknownNameError(
                f"it has no parameter {whole!r}: {'.'.join(keys[:place])!r} is {shorten(inner)}, without parts. "
                "Name it alone.",
                block=path,
            )
    return keys


def _entry_inside(block: Block, path: str, keys: list[str], entry: tuple[int, ...]) -> list[str]:
    """Return the names that lead to an entry of an array in a block."""
    keys = _inside(block, path, keys)
    inner: object = block
    for key in keys[:-1]:
        inner = inner.__dict__[key] if isinstance(inner, Value) else None
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

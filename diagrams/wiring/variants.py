"""Variants of a diagram: other blocks, parameters, sample times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from ...blocks.core import (
    Block,
    LoopwrightError,
    OptionError,
    UnknownNameError,
    Value,
    WiringError,
    as_block,
    enumerate_some,
    near,
    shorten,
)
from .parameter_names import OF_A_SUBSYSTEM, check_name, find_path, find_place, name_parameters, split_entry, with_entry
from .structure import Structure

V = TypeVar("V", bound=Value)


def apply_changes(table: Structure, changes: Iterable[tuple[object, object]], diagram: str) -> Structure:
    """Return the structure of a variant; see `Diagram.replace`."""
    # Blocks come first, then whole parameters, then parts of them. So no change takes another one back, in any order.
    table = table.copy()
    named = [(check_name(name, diagram), value) for name, value in changes]
    blocks = [isinstance(value, Block) and _names_block(table, path) for path, value in named]
    given: dict[str, str] = {}
    for (path, value), is_block in zip(named, blocks, strict=True):
        if is_block and isinstance(value, Block):
            _refuse_subsystem(table, path, diagram)
            full = find_path(path, table.blocks, "block", diagram)
            _check_once(given, full, path, diagram)
            value.check_place(table.blocks[full], *_used_ports(table, full))
            table.blocks[full] = value.replace(name=full.rpartition(".")[2])
    others = [one for one, is_block in zip(named, blocks, strict=True) if not is_block]
    found = [(*_find_target(table, path, diagram), path, value) for path, value in others]
    of_block: dict[str, list[tuple[list[str], object]]] = {}
    for full, keys, path, value in sorted(found, key=lambda one: place_of_change((one[1], None))):
        _check_once(given, ".".join([full, *keys]), path, diagram)
        if keys and full not in table.subsystems:
            of_block.setdefault(full, []).append((keys, value))
        else:
            _change(table, full, keys, value)
    for full, of_it in of_block.items():
        try:
            table.blocks[full] = change_parameters(table.blocks[full], of_it)
        except LoopwrightError as error:
            raise error.at(block=full) from None
    return table


def _check_once(given: dict[str, str], full: str, path: str, diagram: str) -> None:
    """Note a name under its full path; refuse a second one of the same block, parameter or setting."""
    if full in given:
        raise OptionError(
            f"found two names of one parameter, {given[full]!r} and {path!r}; give it once.", block=diagram, port=full
        )
    given[full] = path


def _refuse_subsystem(table: Structure, path: str, diagram: str) -> None:
    """Refuse a block in the place of a subsystem: its wires lead to blocks inside, and none to the subsystem."""
    if _find_owner(table, path):
        return
    for full in (p for p in table.subsystems if p and (p == path or p.endswith("." + path))):
        inside = enumerate_some([p for p, at in table.subsystem_of.items() if at == full], 8)
        raise UnknownNameError(
            f"{path!r} is a subsystem, and a block takes the place of a block only. Replace a block in it ({inside}), "
            "or build the diagram with the block in place of the subsystem.",
            block=diagram,
        )


def _find_owner(table: Structure, path: str) -> str:
    """Return the path of the block that a path, or the unique end of one, names; "" if there is none."""
    if path in table.blocks:
        return path
    found = [p for p in table.blocks if p.endswith("." + path)]
    return found[0] if len(found) == 1 else ""


def _names_block(table: Structure, path: str) -> bool:
    """Whether a block given for a path takes a block's place, and is not the value of a parameter."""
    head, _, last = path.rpartition(".")
    owner = table.blocks.get(_find_owner(table, head)) if head else None
    return owner is None or last not in type(owner).parameter_specs


def _find_target(table: Structure, path: str, diagram: str) -> tuple[str, list[str]]:
    """Return the path of a block or a subsystem, and the names that lead to a parameter of it; none for the block."""
    head, _, last = path.rpartition(".")
    if last in OF_A_SUBSYSTEM and (subsystem := _find_subsystem(table, head, last, diagram)) is not None:
        return subsystem, [last]
    if path in table.blocks:
        return path, []
    try:
        return find_place(table, path, diagram)
    except UnknownNameError:
        if not (full := _find_owner(table, path)):
            raise
        return full, []


def _change(table: Structure, path: str, keys: list[str], value: object) -> None:
    """Change a setting of the subsystem at a path; a block has to be named with a parameter."""
    if not keys:
        made = as_block(value)
        raise WiringError(
            f"found {shorten(value)}; expected a block in its place, such as Fmu('other.fmu'), or the name of a "
            f"parameter of it: {name_parameters(table.blocks[path], path)}." + f" {made}." * bool(made),
            block=path,
        )
    table.subsystems[path] = table.subsystems[path].changed(keys[0], value)


def _used_ports(table: Structure, path: str) -> tuple[set[str], set[str]]:
    """Return the inputs of a block that are wired, and its outputs that are wired to something or named."""
    wires = (*table.wires.values(), *table.names.values(), *table.controls.values(), *table.results.values())
    return {port for block, port in table.wires if block == path}, {w.port for w in wires if w.block == path}


def _find_subsystem(table: Structure, path: str, key: str, diagram: str) -> str | None:
    """Return the path of the subsystem whose ``key`` is meant; None where it may be a block's parameter."""
    known = {subsystem: None for subsystem in table.subsystems if subsystem}
    if path:
        found = [f for f in known if f == path or f.endswith("." + path)]
        return find_path(path, known, "subsystem", diagram) if found else None
    if any(key in type(block).parameter_specs for block in table.blocks.values()):
        return None
    offered = ", ".join(f"{subsystem}.{key}" for subsystem in known)
    step = f"its subsystems have: {offered}" if offered else "leave it out: this diagram has no subsystem"
    raise UnknownNameError(f"a diagram has no {key!r}; {step}.")


def change_parameter(block: V, keys: list[str], value: object) -> V:
    """Return ``block`` with the parameter at a path of names changed; the last may be an entry, ``"x[1]"``."""
    return change_parameters(block, [(keys, value)])


def change_parameters(block: V, changes: Iterable[tuple[list[str], object]]) -> V:
    """Return ``block`` with several of its parameters changed at once: checked with all of them, and built once."""
    found: dict[str, Any] = {}
    specs = type(block).parameter_specs
    for keys, value in sorted(changes, key=place_of_change):  # whole parameters, then their entries and parts
        name = keys[0]
        whole, entry = split_entry(name, specs) if len(keys) == 1 else (name, ())
        if whole in found and whole in specs and (entry or len(keys) > 1) and not isinstance(found[whole], np.ndarray):
            block, found = block.replace(**found), {}  # it has the whole in the form that parts belong to
        if len(keys) == 1:
            is_entry = bool(entry) and whole in specs
            now = found.get(whole, block.__dict__.get(whole))
            found[whole if is_entry else name] = with_entry(now, entry, value, whole) if is_entry else value
            continue
        inner = found.get(name, block.__dict__.get(name))
        if isinstance(inner, Value):
            found[name] = change_parameter(inner, keys[1:], value)
        elif isinstance(inner, Mapping):
            found[name] = {**inner, ".".join(keys[1:]): value}
        else:
            raise UnknownNameError(f"it has no parameter {'.'.join(keys)!r}. {near(name, specs)}")
    return block.replace(**found)


def place_of_change(change: tuple[list[str], object]) -> tuple[int, bool]:
    """Return the place in the order of changes of one block: whole parameters, then entries, then parts of parts."""
    keys, _ = change
    return len(keys), "[" in "".join(keys)

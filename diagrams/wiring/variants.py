"""Variants of a diagram: other blocks, parameters, sample times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace as replace_fields
from typing import Any, TypeVar

from ...blocks.core import Block, LoopwrightError, OptionError, UnknownNameError, Value, WiringError, near, shorten
from ...blocks.tracing import check_method
from .entry_names import split_entry, with_entry
from .parameter_names import OF_A_SUBSYSTEM, check_name, find_path, find_place, name_parameters
from .structure import Structure, SubsystemSettings
from .subsystems import check_delay, exact_offset, exact_time

V = TypeVar("V", bound=Value)


def apply_changes(table: Structure, changes: Iterable[tuple[object, object]], diagram: str) -> Structure:
    """Return the structure of a variant; see `Diagram.replace`.

    Blocks come first, then whole parameters, then parts of them. So no change takes another one back, in any order.
    """
    table = table.copy()
    named = [(check_name(name, diagram), value) for name, value in changes]
    blocks = [isinstance(value, Block) and _names_block(table, path) for path, value in named]
    given: dict[str, str] = {}
    for (path, value), is_block in zip(named, blocks, strict=True):
        if is_block and isinstance(value, Block):
            full = find_path(path, table.blocks, "block", diagram)
            _check_once(given, full, path, diagram)
            value.check_place(table.blocks[full], *_used_ports(table, full))
            table.blocks[full] = value.replace(name=full.rpartition(".")[2])
    others = [one for one, is_block in zip(named, blocks, strict=True) if not is_block]
    found = [(*_find_target(table, path, diagram), path, value) for path, value in others]
    for full, keys, path, value in sorted(found, key=lambda one: (len(one[1]), "[" in "".join(one[1]))):
        _check_once(given, ".".join([full, *keys]), path, diagram)
        _change(table, full, keys, value)
    return table


def _check_once(given: dict[str, str], full: str, path: str, diagram: str) -> None:
    """Note a name under its full path; refuse a second one of the same block, parameter or setting."""
    if full in given:
        raise OptionError(
            f"found two names of one parameter, {given[full]!r} and {path!r}; give it once.", block=diagram, port=full
        )
    given[full] = path


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
    """Change a parameter of the block, or a setting of the subsystem, at a path."""
    if not keys:
        raise WiringError(
            f"found {shorten(value)}; expected a block in its place, such as Fmu('other.fmu'), or the name of a "
            f"parameter of it: {name_parameters(table.blocks[path], path)}.",
            block=path,
        )
    if path in table.subsystems:
        table.subsystems[path] = _change_subsystem(table.subsystems[path], keys[0], value)
        return
    try:
        table.blocks[path] = change_parameter(table.blocks[path], keys, value)
    except LoopwrightError as error:
        raise error.at(block=path) from None


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
    raise UnknownNameError(f"a diagram has no {key!r} of its own; {step}.")


def _change_subsystem(settings: SubsystemSettings, key: str, value: Any) -> SubsystemSettings:
    """Return a subsystem's settings with another sample time, method, offset or delay."""
    new, path = value, settings.path
    if key == "sample_time" and value is not None:
        new = exact_time(value, block=path)
    elif key == "method" and value is not None:
        check_method(value)
    elif key == "offset":
        new = exact_offset(value, settings.sample_time, block=path)
    elif key == "delay":
        new = check_delay(value, settings.sample_time, block=path)
    changed: dict[str, Any] = {key: new}
    if key == "sample_time":
        exact_offset(settings.offset, new, block=path)
        check_delay(settings.delay, new, block=path)
    return replace_fields(settings, **changed)


def change_parameter(block: V, keys: list[str], value: object) -> V:
    """Return ``block`` with the parameter at a path of attribute names or mapping keys changed.

    The last name may be an entry of an array: ``"denominator[1]"``.
    """
    name = keys[0]
    if len(keys) == 1:
        whole, entry = split_entry(name, type(block).parameter_specs)
        if entry and whole in type(block).parameter_specs:
            name, value = whole, with_entry(block.__dict__[whole], entry, value, whole)
        return block.replace(**{name: value})
    inner = block.__dict__.get(name)
    if isinstance(inner, Value):
        return block.replace(**{name: change_parameter(inner, keys[1:], value)})
    if isinstance(inner, Mapping):
        return block.replace(**{name: {**inner, ".".join(keys[1:]): value}})
    raise UnknownNameError(f"it has no parameter {'.'.join(keys)!r}. {near(name, type(block).parameter_specs)}")

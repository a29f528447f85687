"""Variants of a diagram: other blocks, parameters, sample times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace as replace_fields
from typing import Any, TypeVar

from ...blocks.core import Block, LoopwrightError, UnknownNameError, Value, WiringError, near
from ...blocks.tracing import check_method
from .entry_names import split_entry, with_entry
from .parameter_names import OF_A_SUBSYSTEM, check_name, find_path, find_place
from .structure import Structure, SubsystemSettings
from .subsystems import check_delay, exact_offset, exact_time

V = TypeVar("V", bound=Value)


def apply_changes(table: Structure, changes: Mapping[str, object], diagram: str) -> Structure:
    """Return the structure of a variant; see `Diagram.replace`."""
    table = table.copy()
    for path, value in changes.items():
        _change(table, check_name(path, diagram), value, diagram)
    return table


def _find_owner(table: Structure, path: str) -> str:
    """Return the path of the block that a path, or the unique end of one, names; "" if there is none."""
    if path in table.blocks:
        return path
    found = [p for p in table.blocks if p.endswith("." + path)]
    return found[0] if len(found) == 1 else ""


def _change(table: Structure, path: str, value: object, diagram: str) -> None:
    head, _, last = path.rpartition(".")
    owner = table.blocks.get(_find_owner(table, head)) if head else None
    if isinstance(value, Block) and not (owner is not None and last in type(owner).parameter_specs):
        full = find_path(path, table.blocks, "block", diagram)
        value.check_place(table.blocks[full], *_used_ports(table, full))
        table.blocks[full] = value.replace(name=full.rpartition(".")[2])
    elif last in OF_A_SUBSYSTEM and (subsystem := _find_subsystem(table, head, last, diagram)) is not None:
        table.subsystems[subsystem] = _change_subsystem(table.subsystems[subsystem], last, value)
    elif path in table.blocks:
        raise WiringError(
            f"found {value!r}; expected a block in its place, such as Fmu('other.fmu'), or the name of a parameter "
            f"({path}.…).",
            block=path,
        )
    else:
        full, keys = find_place(table, path, diagram)
        try:
            table.blocks[full] = change_parameter(table.blocks[full], keys, value)
        except LoopwrightError as error:
            raise error.at(block=full) from None


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

"""Diagrams with the functions of another one: those that differ from it in numbers alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields

from ...blocks.core import Block, LoopwrightError, identity
from ..wiring import CheckedDiagram, Structure

OF_A_RUN = frozenset({"start"})
"""Parameters of a stepped block that a run gives to it, and that no function of the diagram has in it."""
_STRUCTURE = tuple(f.name for f in fields(Structure) if f.name != "blocks")


def find_other_numbers(diagram: CheckedDiagram, other: CheckedDiagram) -> dict[str, Block] | None:
    """Return the blocks of another diagram that differ from those of a diagram; None where its functions differ.

    Functions are those of the traces: with equal wires and the very traces of the diagram, what differs are values of
    parameters, which the functions take as an argument. A stepped block has no equations in them: its start values
    may differ.
    """
    one, two = diagram.scheduled, other.scheduled
    if diagram.loops != other.loops or one.blocks.keys() != two.blocks.keys():
        return None
    if any(getattr(one, name) != getattr(two, name) for name in _STRUCTURE):
        return None
    if diagram.checked.shapes != other.checked.shapes or diagram.checked.traced.keys() != other.checked.traced.keys():
        return None
    changed = {path: block for path, block in two.blocks.items() if block is not one.blocks[path]}
    if any(trace is not other.checked.traced[path] for path, trace in diagram.checked.traced.items()):
        return None
    try:
        same = all(_has_same_functions(one, path, block) for path, block in changed.items())
    except LoopwrightError:  # the file of an FMU has gone or has changed, which the run tells
        return None
    return changed if same else None


def _has_same_functions(table: Structure, path: str, block: Block) -> bool:
    """Return whether a diagram has the same functions with another block at a path, whose trace is the same one."""
    old = table.blocks[path]
    if type(block) is not type(old) or block.transport or block.evaluated_outside:
        return False
    if block.stepped:
        names = type(old).parameter_specs.keys() - OF_A_RUN
        return old.stepped and _facts(block, names) == _facts(old, names) and _shapes(block) == _shapes(old)
    free = [port for port in old.inputs if (path, port) not in table.wires]  # their defaults are constants in them
    defaults = all(identity(block.inputs[port].default) == identity(old.inputs[port].default) for port in free)
    return defaults and _list_events(block) == _list_events(old)


def _facts(block: Block, names: Iterable[str]) -> object:
    return block._content, {name: identity(block.__dict__[name]) for name in names}


def _shapes(block: Block) -> object:
    ports = {**{("in", n): p for n, p in block.inputs.items()}, **{("out", n): p for n, p in block.outputs.items()}}
    return {key: (port.shape, port.unit) for key, port in ports.items()}


def _list_events(block: Block) -> list[tuple[str, str, float]]:
    return [(name, event.direction, getattr(event, "hysteresis", 0.0)) for name, event in block.events.items()]

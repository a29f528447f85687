"""Units along the wires: followed from output to input, checked, and converted where a block asks for that."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from typing import Any

from ...blocks.core import (
    Block,
    PortUnit,
    Shape,
    UnitError,
    describe_mismatch,
    is_uncertain,
    parse_unit,
    same_dimension,
    same_unit,
)
from ...blocks.library import UnitConversion
from .structure import Structure, Wire, join

Unit = PortUnit
Port = tuple[str, str]
_MOST_ROUNDS = 100
_MOST_CHANGES = 1000
"""Changes of an output's unit while those of a loop of sums follow from each other; without a loop they end by
themselves."""


def follow_units(
    table: Structure, converted: Mapping[Port, Unit], shapes: Mapping[Port, Shape] | None = None
) -> dict[Port, Unit]:
    """Return the unit of every output that has one: declared, or that of the input which the output is like."""
    # ``converted``: units to which wires are converted, by the input at their end; ``shapes``: of outputs, if known.
    units: dict[Port, Unit] = {}
    for path, block in table.blocks.items():
        for name, port in block.outputs.items():
            if port.unit is not None:
                units[path, name] = port.unit
    followers: dict[Port, list[tuple[Port, Port, Wire]]] = {}  # outputs with the unit of an input
    for path, block in table.blocks.items():
        for name, port in block.outputs.items():
            like = getattr(port, "like", None)
            wire = table.wires.get((path, like)) if like and not hasattr(port, "start") else None
            if wire is not None and (path, name) not in units:
                followers.setdefault((wire.block, wire.port), []).append(((path, name), (path, str(like)), wire))
    rules: dict[Port, list[str]] = {}  # blocks whose outputs have units that follow from several inputs
    for path in _with_rules(table):
        for name in table.blocks[path].inputs:
            if (wire := table.wires.get((path, name))) is not None:
                rules.setdefault((wire.block, wire.port), []).append(path)
    waiting, changes = deque(units), dict.fromkeys(units, _MOST_CHANGES)  # a declared unit stays

    def put(output: Port, unit: Unit) -> None:
        """Note a unit, which may differ from that before: a difference is known only with both of its ends."""
        if changes.get(output, 0) < _MOST_CHANGES and _identity(unit) != _identity(units.get(output)):
            changes[output] = changes.get(output, 0) + 1
            if unit is None:
                del units[output]
            else:
                units[output] = unit
            waiting.append(output)

    while waiting:
        source = waiting.popleft()
        for path in rules.get(source, ()):
            with suppress(UnitError):  # check_units raises it
                inputs = _input_units(table, units, converted, path, shapes)
                for name, unit in table.blocks[path].output_units(inputs).items():
                    put((path, name), unit)
        for output, end, wire in followers.get(source, ()):
            put(output, converted.get(end) or _part_unit(units, wire))
    return units


def _identity(unit: Unit) -> Any:
    """Return what differs between two units: their names may be the same, as of kelvins and differences in K."""
    return tuple(map(parse_unit, unit)) if isinstance(unit, tuple) else unit and parse_unit(unit)


def check_units(table: Structure, shapes: Mapping[Port, Shape]) -> dict[Port, Unit]:
    """Check the units at the ends of all wires, and return those of all outputs that have a certain one."""
    units = follow_units(table, {}, shapes)
    for path, block in sorted(table.blocks.items()):
        first: tuple[Wire, Unit] | None = None
        inputs = block.inputs
        alike = _alike(block, inputs)
        for name, spec in inputs.items():
            wire = table.wires.get((path, name))
            unit = None if wire is None else _part_unit(units, wire)
            if wire is None or unit is None:
                continue
            expected, relation = spec.unit, "expected"
            if name in alike:
                if first is None:
                    first = (wire, unit)
                expected, relation = first[1], f"{first[0]} next to it is"
            a, b = next(_mismatches(unit, expected), ("", ""))
            if a:
                ends = (block, table.blocks[wire.block])
                advice = ", or give its FMU convert_units=True"
                can = same_dimension(a, b) and any(end.converts_units is False for end in ends)
                raise UnitError(
                    f"{wire} is in {_text(unit)}; {relation} in {_text(expected)}: {describe_mismatch(a, b)}"
                    f"{advice if can else ''}",
                    block=path,
                    port=name,
                )
    for path in _with_rules(table):
        try:
            table.blocks[path].output_units(_input_units(table, units, {}, path, shapes))
        except UnitError as error:
            wire = table.wires[path, str(error.port)]
            error.message = f"{wire} is in {_text(_part_unit(units, wire))}; {error.message}"
            raise error.blame(path) from None
    return {port: unit for port, unit in units.items() if not any(map(is_uncertain, _entries(unit)))}


def _entries(unit: Unit) -> tuple[str, ...]:
    return unit if isinstance(unit, tuple) else () if unit is None else (unit,)


def _with_rules(table: Structure) -> Iterator[str]:
    """Yield the blocks whose outputs have units that follow from those of their inputs by a rule."""
    yield from (p for p, block in sorted(table.blocks.items()) if type(block).output_units is not Block.output_units)


def _input_units(
    table: Structure,
    units: Mapping[Port, Unit],
    converted: Mapping[Port, Unit],
    path: str,
    shapes: Mapping[Port, Shape] | None,
) -> dict[str, Unit]:
    """Return the unit of each input of a block, None where it is not known."""
    wires = {name: table.wires.get((path, name)) for name in table.blocks[path].inputs}
    found = {
        name: converted.get((path, name)) or (None if wire is None else _part_unit(units, wire))
        for name, wire in wires.items()
    }
    if shapes is not None and table.blocks[path].units_by_entry:
        for name, unit in found.items():
            wire = wires[name]
            if (
                isinstance(unit, str)
                and wire is not None
                and (shape := shapes.get((wire.block, wire.port))) is not None
            ):
                found[name] = (unit,) * math.prod(shape if wire.index is None else wire.entries(shape).shape)
    return found


def add_unit_conversions(table: Structure) -> Structure:
    """Return the structure with a `UnitConversion` in each wire between two units where one of its blocks converts."""
    # The block is in the subsystem of the consumer, called ``convert_`` and the names of the consumer and its input.
    # A block whose inputs are all in one unit, such as a sum, takes that of the first input whose source does not
    # convert.
    if not any(block.converts_units for block in table.blocks.values()):
        return table
    inputs = {path: block.inputs for path, block in table.blocks.items()}
    found: dict[Port, tuple[Unit, Unit]] = {}
    for _ in range(_MOST_ROUNDS):  # a conversion changes the units of outputs that are like the input
        units = follow_units(table, {end: to for end, (_, to) in found.items()})
        fresh: dict[Port, tuple[Unit, Unit]] = {}
        for (path, port), wire in table.wires.items():
            block, unit = table.blocks[path], _part_unit(units, wire)
            if unit is None or not (block.converts_units or table.blocks[wire.block].converts_units):
                continue
            spec, alike = inputs[path].get(port), _alike(block, inputs[path])
            declared = None if spec is None else spec.unit
            expected = _shared_unit(table, units, path, alike) if port in alike else declared
            differing = [*_mismatches(unit, expected)]
            if differing and all(same_dimension(a, b) for a, b in differing):
                fresh[path, port] = unit, expected
        if fresh == found:
            break
        found = fresh
    return _insert(table, found)


def _insert(table: Structure, conversions: Mapping[Port, tuple[Unit, Unit]]) -> Structure:
    table = table.copy()
    for (path, port), (unit, expected) in sorted(conversions.items(), key=lambda item: item[0]):
        subsystem = table.subsystem_of[path]
        base = f"convert_{path.rpartition('.')[2]}_{port if port.isidentifier() else 'input'}"
        name, count = base, 2
        while join(subsystem, name) in table.blocks:
            name, count = f"{base}_{count}", count + 1
        made = join(subsystem, name)
        table.blocks[made] = UnitConversion(from_unit=unit, to_unit=expected, name=name)
        table.subsystem_of[made] = subsystem
        table.wires[made, "u"] = table.wires[path, port]
        table.wires[path, port] = Wire(made, "y")
    return table


def _alike(block: Block, inputs: Collection[str]) -> Collection[str]:
    """Return those of a block's inputs that must be in one unit."""
    return block.same_units if isinstance(block.same_units, tuple) else inputs if block.same_units else ()


def _shared_unit(table: Structure, units: dict[Port, Unit], path: str, alike: Collection[str]) -> Unit:
    """Return the unit that such inputs get: of the first whose source does not convert, else of the first."""
    wires = [table.wires[path, name] for name in alike if (path, name) in table.wires]
    known = [(wire, unit) for wire in wires if (unit := _part_unit(units, wire)) is not None]
    firm = [unit for wire, unit in known if not table.blocks[wire.block].converts_units]
    return firm[0] if firm else known[0][1] if known else None


def _part_unit(units: Mapping[Port, Unit], wire: Wire) -> Unit:
    unit = units.get((wire.block, wire.port))
    if isinstance(unit, tuple) and wire.index is not None:
        return unit[wire.index]
    return unit


def _text(unit: Unit) -> str:
    return ", ".join(unit) if isinstance(unit, tuple) else str(unit)


def _mismatches(found: Unit, expected: Unit) -> Iterator[tuple[str, str]]:
    """Yield the pairs of units, entry by entry, that are not the same."""
    if found is None or expected is None:
        return
    n = max(len(u) if isinstance(u, tuple) else 1 for u in (found, expected))
    left, right = (u if isinstance(u, tuple) else (u,) * n for u in (found, expected))
    yield from ((a, b) for a, b in zip(left, right, strict=False) if not same_unit(a, b))

"""Checks of a diagram's wiring: ports, shapes, units, frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..blocks._block import Block
from ..blocks._errors import ShapeError, UnitError, UnknownNameError, UnwiredInputError, WiringError, near
from ..blocks._ports import Shape
from ..blocks._tracing import Traced, trace
from ..blocks._units import describe_mismatch, same_unit
from ._structure import Structure, Wire

Unit = str | tuple[str, ...] | None


@dataclass(frozen=True)
class Checked:
    """What the checks found out: traces, and shape and unit of every output."""

    traced: dict[str, Traced]
    shapes: dict[tuple[str, str], Shape]
    units: dict[tuple[str, str], Unit]


def check(table: Structure) -> Checked:
    """Check the wiring, and trace every block for the shapes it is wired to.

    Raises
    ------
    WiringError
        `UnknownNameError`, `UnwiredInputError`, `ShapeError`, `UnitError`, `SampleTimeError`.
    TraceError
        A block whose equations can't be traced.
    """
    _check_ports(table)
    traced, shapes = _infer_shapes(table)
    return Checked(traced, shapes, _check_units(table, shapes))


def sources(table: Structure, path: str) -> dict[str, Wire | None]:
    """Return the wire of every input of a block, None where its default is used."""
    return {port: table.wires.get((path, port)) for port in table.blocks[path].inputs}


def part_shape(shape: Shape, wire: Wire, who: str, port: str) -> Shape:
    """Return the shape of the part of an output that a wire takes."""
    if wire.index is None:
        return shape
    if not shape:
        raise ShapeError(
            f"{wire} takes a part of a scalar; wire the whole of {wire.block}.{wire.port}.", block=who, port=port
        )
    try:
        return np.empty(shape)[wire.index].shape
    except IndexError:
        raise ShapeError(f"{wire} is out of range: the port has shape {shape}.", block=who, port=port) from None


def _check_ports(table: Structure) -> None:
    for path, block in sorted(table.blocks.items()):
        for (consumer, port), wire in table.wires.items():
            if wire.block == path and wire.port not in block.outputs:
                raise UnknownNameError(
                    f"it has no output {wire.port!r}, which {consumer}.{port} is wired to. "
                    f"{near(wire.port, block.outputs)}",
                    block=path,
                )
        for port, spec in block.inputs.items():
            if (path, port) not in table.wires and spec.default is None:
                raise UnwiredInputError("nothing is wired to it; wire it in the block's call.", block=path, port=port)
    for (consumer, port), wire in table.wires.items():
        if port not in table.blocks[consumer].inputs:
            raise UnknownNameError(
                f"it has no input {port!r}, which {wire} is wired to. {near(port, table.blocks[consumer].inputs)}",
                block=consumer,
            )


def _infer_shapes(table: Structure) -> tuple[dict[str, Traced], dict[tuple[str, str], Shape]]:
    traced: dict[str, Traced] = {}
    shapes: dict[tuple[str, str], Shape] = {
        (path, name): port.shape
        for path, block in table.blocks.items()
        for name, port in block.outputs.items()
        if port.shape is not None
    }
    waiting = sorted(table.blocks)
    assumed: dict[tuple[str, str], Shape] = {}
    while waiting:
        still = []
        for path in waiting:
            block = table.blocks[path]
            inputs = _input_shapes(table, shapes, path, assumed)
            if inputs is None:
                still.append(path)
            elif not block.opaque:
                frame = table.frames[table.frame_of[path]]
                traced[path] = _trace(block, inputs, frame.sample_time is not None, frame.method, path)
                shapes.update({(path, name): shape for name, shape in traced[path].outputs.items()})
        if len(still) == len(waiting):
            assumed.update(_assume(table, shapes, still))
        waiting = still
    for (path, port), shape in assumed.items():
        wire = table.wires[path, port]
        found = part_shape(shapes[wire.block, wire.port], wire, path, port)
        if found != shape:
            raise ShapeError(
                f"{wire} has shape {found}, where the loop that it closes asks for {shape}. Give the loop's shape "
                "where it starts, for instance UnitDelay(initial_value=…).",
                block=path,
                port=port,
            )
    return traced, shapes


def _trace(block: Block, shapes: dict[str, Shape], sampled: bool, method: str, path: str) -> Traced:
    try:
        return trace(block, shapes, sampled=sampled, method=method)
    except WiringError as error:
        error.block = path
        raise


def _assume(table: Structure, shapes: dict[tuple[str, str], Shape], stuck: list[str]) -> dict[tuple[str, str], Shape]:
    """Return an assumption that lets a loop of unknown shapes go on; it is checked once the shapes are known.

    A block's unknown inputs are assumed to have the shape of a known one beside them, else of its first state.
    """

    def known(path: str) -> list[Shape]:
        wires = ((port, table.wires.get((path, port))) for port in table.blocks[path].inputs)
        return [
            part_shape(shapes[w.block, w.port], w, path, port)
            for port, w in wires
            if w is not None and (w.block, w.port) in shapes
        ]

    path = min(stuck, key=lambda p: (not known(p), not table.blocks[p].states, p))
    block = table.blocks[path]
    starts = [port.start_value(block, dict.fromkeys(block.inputs, ())).shape for port in block.states.values()]
    shape = next(iter([*known(path), *starts]), ())
    return {
        (path, port): shape
        for port, spec in block.inputs.items()
        if spec.shape is None and (w := table.wires.get((path, port))) is not None and (w.block, w.port) not in shapes
    }


def _input_shapes(
    table: Structure,
    shapes: dict[tuple[str, str], Shape],
    path: str,
    assumed: dict[tuple[str, str], Shape],
) -> dict[str, Shape] | None:
    found: dict[str, Shape] = {}
    unknown = False
    for port, spec in table.blocks[path].inputs.items():
        wire = table.wires.get((path, port))
        if wire is None:
            assert spec.default is not None
            found[port] = np.shape(spec.default)
            continue
        whole = shapes.get((wire.block, wire.port))
        if (path, port) in assumed:
            found[port] = assumed[path, port]
            continue
        if whole is None:
            if spec.shape is None:
                unknown = True
            else:
                found[port] = spec.shape
            continue
        shape = part_shape(whole, wire, path, port)
        if spec.shape is not None and shape != spec.shape:
            raise ShapeError(
                f"{wire} has shape {shape}; expected {spec.shape}. Index the signal, or wire another one.",
                block=path,
                port=port,
            )
        found[port] = shape
    return None if unknown else found


def _check_units(table: Structure, shapes: dict[tuple[str, str], Shape]) -> dict[tuple[str, str], Unit]:
    units: dict[tuple[str, str], Unit] = {}
    for path, block in table.blocks.items():
        for name, port in block.outputs.items():
            if port.unit is not None:
                units[path, name] = port.unit
    changed = True
    while changed:  # outputs that take over an input's unit
        changed = False
        for path, block in sorted(table.blocks.items()):
            for name, port in block.outputs.items():
                like = getattr(port, "like", None)
                wire = table.wires.get((path, like)) if like and not hasattr(port, "start") else None
                if wire is not None and (path, name) not in units:
                    unit = _part_unit(units, wire)
                    if unit is not None:
                        units[path, name] = unit
                        changed = True
    for path, block in sorted(table.blocks.items()):
        seen: tuple[Wire, Unit] | None = None
        for name, spec in block.inputs.items():
            wire = table.wires.get((path, name))
            unit = None if wire is None else _part_unit(units, wire)
            if wire is None or unit is None:
                continue
            expected, what = spec.unit, "expected"
            if block.same_units:
                if seen is None:
                    seen = (wire, unit)
                expected, what = seen[1], f"{seen[0]} beside it is"
            problem = _mismatch(unit, expected)
            if problem:
                raise UnitError(
                    f"{wire} is in {_text(unit)}; {what} in {_text(expected)}: {problem}", block=path, port=name
                )
    return units


def _part_unit(units: dict[tuple[str, str], Unit], wire: Wire) -> Unit:
    unit = units.get((wire.block, wire.port))
    if isinstance(unit, tuple) and wire.index is not None:
        return unit[wire.index]
    return unit


def _text(unit: Unit) -> str:
    return ", ".join(unit) if isinstance(unit, tuple) else str(unit)


def _mismatch(found: Unit, expected: Unit) -> str:
    if found is None or expected is None:
        return ""
    n = max(len(u) if isinstance(u, tuple) else 1 for u in (found, expected))
    pairs: Any = zip(*(u if isinstance(u, tuple) else (u,) * n for u in (found, expected)), strict=False)
    return next((describe_mismatch(a, b) for a, b in pairs if not same_unit(a, b)), "")

"""Checks of a diagram's wiring: ports, shapes, units, subsystems."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import (
    Block,
    LoopwrightError,
    SampleTimeError,
    Shape,
    ShapeError,
    UnknownNameError,
    UnwiredInputError,
    WiringError,
    describe_shape,
    near,
)
from ...blocks.library import FixedSampleTime
from ...blocks.tracing import Traced, describe_model_exchange, start_shapes, trace, traced_parameters
from .structure import Structure, Wire
from .wire_units import Unit, check_units

Port = tuple[str, str]


@dataclass(frozen=True)
class Checked:
    """Results of the checks: traces of the blocks, and shape and unit of every output."""

    traced: dict[str, Traced]
    shapes: dict[Port, Shape]
    units: dict[Port, Unit]


def check(table: Structure) -> Checked:
    """Check the wiring, and trace every block for the shapes it is wired to."""
    _check_ports(table)
    traced, shapes = _infer_shapes(table)
    _check_subsystems(table, traced, shapes)
    _check_stops(table, shapes)
    return Checked(traced, shapes, check_units(table, shapes))


def part_shape(shape: Shape, wire: Wire, consumer: str, port: str) -> Shape:
    """Return the shape of the part of an output that a wire takes."""
    if wire.index is None:
        return shape
    if not shape:
        raise ShapeError(
            f"found {wire}, a part of a scalar; wire the whole of {wire.block}.{wire.port}.", block=consumer, port=port
        )
    try:
        return wire.entries(shape).shape
    except IndexError:
        raise ShapeError(
            f"{wire} is out of range, counted from 1: the port has shape {shape}. Index within it, in Python from 0.",
            block=consumer,
            port=port,
        ) from None


def _check_ports(table: Structure) -> None:
    inputs = {path: block.inputs for path, block in table.blocks.items()}  # each access makes them again
    for (consumer, port), wire in table.wires.items():
        outputs = table.blocks[wire.block].outputs
        if wire.port not in outputs:
            raise UnknownNameError(
                f"it has no output {wire.port!r}, which {consumer}.{port} is wired to. {near(wire.port, outputs)}",
                block=wire.block,
            )
    for path in sorted(table.blocks):
        for port, spec in inputs[path].items():
            if (path, port) not in table.wires and spec.default is None:
                advice = table.blocks[path].advise_unwired([port])
                raise UnwiredInputError(
                    f"nothing is wired to it; wire it in the block's call.{advice}", block=path, port=port
                )
    for (consumer, port), wire in table.wires.items():
        if port not in inputs[consumer]:
            raise UnknownNameError(
                f"it has no input {port!r}, which {wire} is wired to. {near(port, inputs[consumer])}",
                block=consumer,
            )


def _infer_shapes(table: Structure) -> tuple[dict[str, Traced], dict[Port, Shape]]:
    """Trace every block as soon as the shapes at its inputs are known, then compare both ends of every wire."""
    traced: dict[str, Traced] = {}
    shapes: dict[Port, Shape] = {
        (path, name): port.shape
        for path, block in table.blocks.items()
        for name, port in block.outputs.items()
        if port.shape is not None
    }
    assumed: dict[Port, Shape] = {}
    shared: dict[Any, Traced] = {}  # traces of users' classes, for this build alone: their closures may change
    consumers: dict[Port, list[Port]] = {}
    fed: dict[Port, list[str]] = {}
    unknown: dict[str, set[str]] = {path: set() for path in table.blocks}
    inputs = {path: block.inputs for path, block in table.blocks.items()}
    for (path, port), wire in table.wires.items():
        source = (wire.block, wire.port)
        fed.setdefault(source, []).append(path)
        if inputs[path][port].shape is None and source not in shapes:
            unknown[path].add(port)
            consumers.setdefault(source, []).append((path, port))
    ready = [path for path, ports in unknown.items() if not ports]
    heapq.heapify(ready)
    waiting = set(table.blocks) - set(ready)
    stuck: list[tuple[bool, bool, str]] | None = None  # blocks to make the next assumption for, the best one first
    while ready or waiting:
        if not ready:
            if stuck is None:
                stuck = [(not _known_shapes(table, shapes, p), not table.blocks[p].states, p) for p in waiting]
                heapq.heapify(stuck)
            while (path := heapq.heappop(stuck)[2]) not in waiting:
                pass
            assumed.update(_assume(table, shapes, path))
            unknown[path].clear()
            waiting.discard(path)
            heapq.heappush(ready, path)
        path = heapq.heappop(ready)
        block = table.blocks[path]
        if not table.is_traced(path):
            if not block.transport:
                continue
            found = {"y": _input_shapes(table, shapes, path, assumed)["u"]}
        else:
            traced[path] = _trace(block, _input_shapes(table, shapes, path, assumed), table, path, shared)
            found = traced[path].outputs
        for name, shape in found.items():
            if (path, name) not in shapes:
                shapes[path, name] = shape
                for consumer in fed.get((path, name), ()):
                    if stuck is not None and consumer in waiting:
                        heapq.heappush(stuck, (False, not table.blocks[consumer].states, consumer))
                for consumer, port in consumers.get((path, name), ()):
                    unknown[consumer].discard(port)
                    if not unknown[consumer] and consumer in waiting:
                        waiting.discard(consumer)
                        heapq.heappush(ready, consumer)
    _check_shapes(table, traced, shapes, assumed)
    return traced, shapes


def _next_step(found: Shape, expected: Shape | None) -> str:
    """Return the next step where a signal has another shape: a scalar has no entry to index."""
    if found:
        return "Index the signal, or wire another one."
    if expected and set(expected) == {1}:
        return (
            "A vector of one entry is no scalar: give the block parameters for a scalar (a matrix of one column or row "
            "as a plain list of its numbers), or wire a vector."
        )
    return "Wire a signal of that shape."


def _check_shapes(
    table: Structure, traced: dict[str, Traced], shapes: dict[Port, Shape], assumed: dict[Port, Shape]
) -> None:
    for (path, port), wire in sorted(table.wires.items()):
        found = part_shape(shapes[wire.block, wire.port], wire, path, port)
        expected = traced[path].inputs[port] if path in traced else table.blocks[path].inputs[port].shape
        if path not in traced and expected is None:  # a transport delay
            expected = shapes[path, "y"]
        if found == expected:
            continue
        has = f"{wire} has shape {found}" if found else f"{wire} is a scalar"
        if (path, port) in assumed:
            raise ShapeError(
                f"{has}, where the loop that it closes asks for {describe_shape(expected)}. Give the loop's shape "
                "where it starts, for instance UnitDelay(initial_value=…).",
                block=path,
                port=port,
            )
        raise ShapeError(
            f"{has}; expected {describe_shape(expected)}. {_next_step(found, expected)}",
            block=path,
            port=port,
        )
    for name, wire in sorted(table.names.items()):
        part_shape(shapes[wire.block, wire.port], wire, wire.block, f"{wire.port} (named {name!r})")


def _check_subsystems(table: Structure, traced: dict[str, Traced], shapes: dict[Port, Shape]) -> None:
    """Check the signals that control subsystems, and the blocks in them."""
    for gated, wire in sorted(table.controls.items()):
        kind = table.subsystems[gated].control
        port = {"enabled": "enable", "triggered": "trigger"}[kind]
        found = part_shape(shapes[wire.block, wire.port], wire, gated, port)
        if found != ():
            raise ShapeError(
                f"{wire} has shape {found}; expected a logic signal, one number. Index it.", block=gated, port=port
            )
    # A subsystem can hold or delay only what a block in it makes, not a signal that passes through it.
    for (path, port), handed in sorted(table.handed.items()):
        for passing, output in handed:
            settings, clock = table.subsystems[passing], table.clock(table.subsystem_of[path])
            same = clock is not None and (clock.sample_time, clock.offset) == (settings.sample_time, settings.offset)
            if not (settings.control or settings.delay) and (settings.sample_time is None or same):
                continue
            kind = settings.control or ("delayed" if settings.delay else "sampled")
            raise WiringError(
                f"found {passing}.{output}, a signal from outside that the {kind} subsystem only passes through; "
                "expected the output of a block in it. Put a block between, such as Gain(gain=1.0), or wire the signal "
                "itself.",
                block=path,
                port=port,
            )
    for path in sorted(table.blocks):
        gates = table.gates(table.subsystem_of[path])
        # Time can't wait in an FMU or a transport delay, while the subsystem around it does.
        if gates and (path not in traced or table.blocks[path].in_model_exchange):
            kind = "a transport delay" if table.blocks[path].transport else "a block that is stepped, such as an FMU,"
            kind = "an FMU in model exchange" if path in traced else kind
            raise WiringError(
                f"{kind} can't be in a subsystem that is {table.subsystems[gates[-1]].control} ({gates[-1]}): its "
                "time continues while the subsystem waits. Put it outside, and wire its outputs in.",
                block=path,
            )
        # What is triggered acts at no regular distance: nothing in it may need one.
        triggered = table.triggered_around(table.subsystem_of[path])
        if triggered is None:
            continue
        trace = traced[path]
        if trace.advance not in ("none", "update") or _reads_sample_time(table.blocks[path], trace):
            raise SampleTimeError(
                f"it needs a sample time, and the triggered subsystem {triggered} has none: that acts whenever it is "
                "triggered. Put the block outside, or take one that counts samples.",
                block=path,
            )
        inner = table.clock(table.subsystem_of[path])
        outer = table.clock(triggered)
        if inner is not outer:
            raise SampleTimeError(
                f"the subsystem {inner.path if inner else ''} has its own sample time inside the triggered "
                f"subsystem {triggered}; expected none, as it acts whenever {triggered} is triggered. Leave it out.",
                block=path,
            )


def _check_stops(table: Structure, shapes: dict[Port, Shape]) -> None:
    for path, block in sorted(table.blocks.items()):
        if block.stops is None:
            continue
        if block.stops not in block.outputs:
            raise UnknownNameError(
                f"found stops = {block.stops!r}; expected the name of an output. {near(block.stops, block.outputs)}",
                block=path,
            )
        if shapes[path, block.stops] != ():
            raise ShapeError(
                f"found shape {shapes[path, block.stops]}; expected one number: the run ends where it is above 0.5. "
                "Put out np.max of it, for instance.",
                block=path,
                port=block.stops,
            )


def _reads_sample_time(block: Block, trace: Traced) -> bool:
    """Whether a block's equations, or its precomputed numbers, depend on the sample time."""
    position = sum(int(np.size(value)) for _, value in traced_parameters(block))
    last = trace.function.n_in() - 1
    columns = (trace.function.jac_sparsity(i, last).get_col() for i in range(trace.function.n_out()))
    computes = hasattr(block, "constants") and not block.computed_from
    return computes or any(position in column for column in columns)


def _trace(block: Block, shapes: dict[str, Shape], table: Structure, path: str, shared: dict[Any, Traced]) -> Traced:
    subsystem = table.subsystem_of[path]
    sampled, method, rate = table.is_sampled(subsystem), table.method(subsystem), table.rate(subsystem)
    try:
        if rate is not None and isinstance(block, FixedSampleTime):
            block.check_rate(float(rate))
        if block.in_model_exchange:
            return describe_model_exchange(block, shapes, sampled=sampled)
        return trace(block, shapes, sampled=sampled, method=method, cache=shared)
    except LoopwrightError as error:
        error.blame(path)
        raise


def _known_shapes(table: Structure, shapes: dict[Port, Shape], path: str) -> list[Shape]:
    """Return the known shapes among the signals that are wired to a block."""
    wires = ((port, table.wires.get((path, port))) for port in table.blocks[path].inputs)
    return [
        part_shape(shapes[w.block, w.port], w, path, port)
        for port, w in wires
        if w is not None and (w.block, w.port) in shapes
    ]


def _assume(table: Structure, shapes: dict[Port, Shape], path: str) -> dict[Port, Shape]:
    """Assume the unknown input shapes of a block in a loop; `_check_shapes` compares them with the wires later."""
    # They become the shape of one of its known inputs, else that of its first state.
    block = table.blocks[path]
    shape = next(iter([*_known_shapes(table, shapes, path), *start_shapes(block)]), ())
    return {
        (path, port): shape
        for port, spec in block.inputs.items()
        if spec.shape is None and (w := table.wires.get((path, port))) is not None and (w.block, w.port) not in shapes
    }


def _input_shapes(
    table: Structure, shapes: dict[Port, Shape], path: str, assumed: dict[Port, Shape]
) -> dict[str, Shape]:
    """Return the input shapes to trace a block with; `_check_shapes` compares them with the wires later."""
    found: dict[str, Shape] = {}
    for port, spec in table.blocks[path].inputs.items():
        wire = table.wires.get((path, port))
        if wire is None:
            found[port] = np.shape(np.asarray(spec.default)) if spec.shape is None else spec.shape
        elif spec.shape is not None:
            found[port] = spec.shape
        elif (path, port) in assumed:
            found[port] = assumed[path, port]
        else:
            found[port] = part_shape(shapes[wire.block, wire.port], wire, path, port)
    return found

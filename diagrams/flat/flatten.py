"""Flattening: a checked diagram becomes one vector of states, and functions of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from fractions import Fraction

import numpy as np

from ...blocks.core import Block, Layout, SampleTimeError, Shape, one_thread, without_collection
from ..wiring import Checked, Order, Structure, join, stepped_blocks
from .clocks import TickPattern
from .flat_diagram import FlatDiagram
from .flat_layout import FlatEvent, StateLayout, sample_time_of
from .plant_ticks import own_step, suggested_step

_BLOCKS_FOR_ONE_THREAD = 300
"""Blocks from which on it pays to limit BLAS to one thread, which takes some 20 ms."""


@without_collection
def flatten(
    table: Structure,
    checked: Checked,
    orders: tuple[Order, Order],
    step: Fraction | None = None,
    *,
    asked: bool | None = None,
    name: str = "",
    between: bool = False,
) -> FlatDiagram:
    """Flatten a checked diagram; ``orders`` are those of evaluation at an instant, and of initialization.

    ``step``, in s, is required where there is no other clock; ``asked``: a user has, by default if it is given.
    ``between``: outputs are evaluated between ticks though nothing happens there, so that all sampled ones are held.
    """
    base, clocks = _clocks(table, step, name)
    traced, blocks = checked.traced, table.blocks
    paths = sorted(traced)
    order, start_order = orders
    events = tuple(_events(table, checked))
    between = between or bool(events) or any(traced[path].advance == "derivative" for path in paths)
    between = between or any(block.transport and path not in traced for path, block in blocks.items())
    around = {subsystem: table.gates(subsystem) for subsystem in table.subsystems}
    gated = {path: around[table.subsystem_of[path]] for path in paths}

    states = StateLayout.of_blocks({path: traced[path].states for path in paths})
    position = states.total

    def lay(shapes: Mapping[str, Shape]) -> Layout:
        nonlocal position
        layout = Layout.of(shapes, position)
        position += layout.total
        return layout

    def is_held(path: str) -> bool:
        clock = clocks.get(table.subsystem_of[path])
        return bool(gated[path]) or (clock is not None and (between or clock != TickPattern()))

    held = lay({join(p, q): s for p in paths if is_held(p) for q, s in traced[p].outputs.items()})
    gates = lay(dict.fromkeys(sorted(table.controls), ()))
    resets = [p for p in paths if any(table.subsystems[g].when == "reset" for g in gated[p]) and states.shapes[p][0]]
    starts = lay({path: states.shapes[path] for path in resets})
    torn = dict.fromkeys(sorted({*order.torn, *start_order.torn}))
    loops = lay({join(*port): traced[port[0]].outputs[port[1]] for port in torn})

    stepped = sorted(path for path in blocks if path not in traced)
    plant_outputs = Layout.of({join(p, q): checked.shapes[p, q] for p in stepped for q in blocks[p].outputs})
    plant_inputs = Layout.of(
        {
            join(p, q): _input_shape(table, checked, p, q)
            for p in stepped
            for q in blocks[p].inputs
            if (p, q) in table.wires
        }
    )
    with one_thread() if len(paths) > _BLOCKS_FOR_ONE_THREAD else nullcontext():  # matrices of a few states each
        packed = {path: traced[path].pack(blocks[path], sample_time_of(table, path)) for path in paths}
    log_shapes = dict(plant_outputs.shapes) | {join(p, q): s for p in paths for q, s in traced[p].outputs.items()}
    start_values = [
        np.ravel(port.start_value(blocks[path], traced[path].inputs))
        for path in paths
        for port in blocks[path].states.values()
    ]
    ports = {join(*port): port for port in checked.shapes} | {join(*port): port for port in table.wires}
    return FlatDiagram(
        table=table,
        checked=checked,
        base=base,
        clocks=clocks,
        states=states,
        held=held,
        gates=gates,
        starts=starts,
        loops=loops,
        plant_outputs=plant_outputs,
        plant_inputs=plant_inputs,
        parameters=Layout.of({path: v.shape for path, v in packed.items()}),
        log=Layout.of(log_shapes),
        continuous=_continuous(checked, table, states),
        events=events,
        x0=np.concatenate([*start_values, np.zeros(position - states.total)]),
        p=np.concatenate([*packed.values(), np.zeros(0)]),
        order=order,
        start_order=start_order,
        ports=ports,
        asked=step is not None if asked is None else asked,
        apart=frozenset(path for path in paths if blocks[path].in_model_exchange),
    )


def renumber(flat: FlatDiagram, blocks: Mapping[str, Block]) -> FlatDiagram:
    """Return a flattened diagram whose blocks have other numbers alone: traces and functions are the same ones."""
    table = flat.table.with_blocks(blocks)
    p, x0 = flat.p.copy(), flat.x0.copy()
    write_numbers(flat, blocks, p, x0)
    return flat.with_numbers(table, p, x0)


def write_numbers(flat: FlatDiagram, blocks: Mapping[str, Block], p: np.ndarray, x0: np.ndarray) -> None:
    """Write the parameters and start values of blocks into those of a flattened diagram; see `renumber`."""
    for path, block in blocks.items():
        if path not in flat.checked.traced:
            continue
        p[flat.parameters.slices[path]] = flat.pack(path, block)
        inputs = flat.checked.traced[path].inputs
        if values := [np.asarray(port.start_value(block, inputs)).ravel() for port in block.states.values()]:
            x0[flat.states.slices[path]] = np.concatenate(values)


def _input_shape(table: Structure, checked: Checked, path: str, port: str) -> Shape:
    declared = table.blocks[path].inputs[port].shape
    if declared is not None:
        return declared
    wire = table.wires[path, port]
    return wire.entries(checked.shapes[wire.block, wire.port]).shape


def _continuous(checked: Checked, table: Structure, states: StateLayout) -> np.ndarray:
    """Return the entries of x that a solver integrates."""
    found: list[int] = []
    for path, own in states.of_block.items():
        if checked.traced[path].advance == "derivative":
            ports = table.blocks[path].states
            found += own.entries(name for name in own.slices if not ports[name].discrete)
    return np.array(found, dtype=int)


def _events(table: Structure, checked: Checked) -> Iterator[FlatEvent]:
    """Yield the events of all blocks and subsystems in continuous subsystems, by path."""
    for path in sorted([*checked.traced, *table.controls]):
        if path in table.controls:
            if table.is_event(path):
                subsystem = table.subsystems[path]
                edge = "both" if subsystem.control == "enabled" else subsystem.when
                yield FlatEvent(path, {"enabled": "enable", "triggered": "trigger"}[subsystem.control], edge, 0.0, True)
            continue
        trace = checked.traced[path]
        if trace.indicators is not None:
            for name, event in table.blocks[path].events.items():
                yield FlatEvent(path, name, event.direction, getattr(event, "hysteresis", 0.0), False)


def _clocks(table: Structure, step: Fraction | None, name: str) -> tuple[Fraction, dict[str, TickPattern]]:
    """Return the seconds between two ticks, and the ticks of every subsystem that is sampled."""
    found = {path: clock for path in table.subsystems if (clock := table.clock(path)) is not None}
    used = {c.path: c for c in found.values()}
    own = {path: wanted for path, plant in stepped_blocks(table).items() if (wanted := own_step(plant)) is not None}
    base = step
    if base is None:
        if not used and not own:
            asked = [size for plant in stepped_blocks(table).values() if (size := suggested_step(plant))]
            said = f"{min(asked):g}" if asked else "1e-3"
            why = ", which an FMU's default experiment has" if asked else ""
            raise SampleTimeError(
                f"no subsystem has a sample time, so there is no clock. Give simulate(…, step={said}){why}, or a "
                f"@subsystem(sample_time={said}).",
                block=name or None,
            )
        times = [*own.values(), *(t for c in used.values() for t in (c.sample_time, c.offset) if t)]
        whole = math.lcm(*(t.denominator for t in times))
        base = Fraction(math.gcd(*(int(t * whole) for t in times)), whole)
    for subsystem in used.values():
        for what, time in (("sample time", subsystem.sample_time), ("offset", subsystem.offset)):
            if time is not None and (time / base).denominator != 1:
                raise SampleTimeError(
                    f"its {what} {float(time):g} s is no multiple of the step {float(base):g} s; choose a step that "
                    f"divides it.",
                    block=subsystem.path or name or None,
                )
    for path, wanted in own.items():
        if (wanted / base).denominator != 1:
            raise SampleTimeError(
                f"its communication step {float(wanted):g} s is no multiple of the step {float(base):g} s; choose a "
                "step that divides it.",
                block=path,
            )
    return base, {
        path: TickPattern(int(c.sample_time / base), int(c.offset / base))
        for path, c in found.items()
        if c.sample_time is not None
    }

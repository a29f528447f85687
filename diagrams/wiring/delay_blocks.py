"""Replaces delays by blocks, so that the scheduler sees blocks only.

A subsystem's computational delay becomes a `Delay` at each output that leaves it. A transport delay in a sampled
subsystem becomes a delay by whole samples.
"""

from __future__ import annotations

from dataclasses import replace

from ...blocks.core import LoopwrightError
from ...blocks.library import Delay
from .structure import Structure, Wire, join


def add_delay_blocks(table: Structure) -> Structure:
    """Return the structure with a delay block for every output that leaves a subsystem with a computational delay."""
    # The block acts at the subsystem's ticks, and is called ``delay_`` and the output's name, numbered where two share
    # one. Blocks inside still read the output without delay. A wire that is named inside and leaves the subsystem
    # is the one that its consumers outside get: with the delay.
    sampled = {}
    for path, block in sorted(table.blocks.items()):
        rate = table.rate(table.subsystem_of[path])
        if block.transport and rate is not None:
            try:
                sampled[path] = block.discretize(rate)
            except LoopwrightError as error:
                error.blame(path)
                raise
    late = [path for path in sorted(table.subsystems, key=lambda p: (-p.count("."), p)) if table.subsystems[path].delay]
    if not late and not sampled:
        return table
    table = table.copy()
    table.blocks.update(sampled)
    for subsystem in late:
        _delay_outputs(table, subsystem)
    return table


def _is_inside(subsystem: str, path: str) -> bool:
    return path == subsystem or path.startswith(f"{subsystem}.")


def _delay_outputs(table: Structure, subsystem: str) -> None:
    made: dict[tuple[str, str], str] = {}

    def delay(wire: Wire) -> Wire:
        key = (wire.block, wire.port)
        if key not in made:
            base = path = join(subsystem, f"delay_{wire.port if wire.port.isidentifier() else 'output'}")
            count = 2
            while path in table.blocks:
                path, count = f"{base}_{count}", count + 1
            made[key] = path
            table.blocks[path] = Delay(steps=table.subsystems[subsystem].delay, name=path.rpartition(".")[2])
            table.subsystem_of[path] = subsystem
            table.wires[path, "u"] = replace(wire, index=None)
        return Wire(made[key], "y", wire.index)

    def leaves(wire: Wire, consumer_subsystem: str) -> bool:
        return _is_inside(subsystem, table.subsystem_of[wire.block]) and not _is_inside(subsystem, consumer_subsystem)

    for key, wire in sorted(table.wires.items()):
        if leaves(wire, table.subsystem_of[key[0]]):
            table.wires[key] = delay(wire)
    for path, wire in sorted(table.controls.items()):
        if leaves(wire, path.rpartition(".")[0]):
            table.controls[path] = delay(wire)
    leaving = [
        wire
        for (path, _), wire in table.results.items()
        if path == subsystem and _is_inside(subsystem, table.subsystem_of[wire.block])
    ]
    for name, wire in sorted(table.names.items()):
        if leaves(wire, name.rpartition(".")[0]) or any(_overlap(wire, result) for result in leaving):
            table.names[name] = delay(wire)
    for (path, output), wire in sorted(table.results.items()):
        outside = path == subsystem or not _is_inside(subsystem, path)
        if outside and (wire.block, wire.port) in made:
            table.results[path, output] = delay(wire)


def _overlap(a: Wire, b: Wire) -> bool:
    """Whether two wires have an entry in common; parts of a port that are counted from its end may have one."""
    if (a.block, a.port) != (b.block, b.port):
        return False
    for one, other in ((a.index, b.index), (b.index, a.index)):
        if isinstance(one, int) and isinstance(other, int) and min(one, other) >= 0:
            return one == other
        if isinstance(one, int) and one >= 0 and isinstance(other, slice):
            start, stop, step = other.start or 0, other.stop, other.step or 1
            if start >= 0 and step > 0 and (stop is None or stop >= 0):
                return one in range(start, one + 1 if stop is None else stop, step)
    return True

"""The structure of a diagram: every block with its path, every input with its source; and as a table.

Wires lead from block to block, across the borders of subsystems.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core import Block, Grid, Shape, Sheet, count_of, explain_calls
from .subsystem_settings import SubsystemSettings


@explain_calls
@dataclass(frozen=True)
class Wire:
    """The source end of a wire: an output port, or a part of it."""

    block: str
    port: str
    index: int | slice | None = None

    def __str__(self) -> str:
        return f"{self.block}.{self.port}{self.part}"

    @property
    def part(self) -> str:
        """The part of the port as text, "" for the whole: entries are counted from 1, up to and including the last."""
        if isinstance(self.index, slice):
            start, stop = self.index.start or 0, self.index.stop
            return f"[{start + (start >= 0)}:{'' if stop is None else stop if stop >= 0 else stop - 1}]"
        return "" if self.index is None else f"[{self.index + (self.index >= 0)}]"

    def entries(self, shape: Shape) -> np.ndarray:
        """Return the numbers of the entries of a port of some shape that it carries, in the shape of what it carries.

        Raises `IndexError` if the port hasn't as many.
        """
        every = np.arange(math.prod(shape)).reshape(shape)
        return every if self.index is None else np.asarray(every[self.index])


@dataclass
class Structure:
    """Blocks, subsystems and wires of a diagram, by path.

    ``subsystem_of``: path of the subsystem that a block is in, by the block's path.
    ``subsystems``: settings of every subsystem by its path, the diagram's own under "".
    ``wires``: the source of every wired input, by (block path, input).
    ``controls``: the source of the signal that enables or triggers a subsystem, by the subsystem's path.
    ``handed``: for an input, by (block path, input): the subsystems, each with its output, that only pass its signal
    through.
    ``results``: the source of every output of a subsystem, by (the subsystem's path, output).
    ``arguments``: the source of every input of a subsystem, by (the subsystem's path, input).
    """

    blocks: dict[str, Block] = field(default_factory=dict)
    subsystem_of: dict[str, str] = field(default_factory=dict)
    subsystems: dict[str, SubsystemSettings] = field(default_factory=dict)
    wires: dict[tuple[str, str], Wire] = field(default_factory=dict)
    names: dict[str, Wire] = field(default_factory=dict)
    controls: dict[str, Wire] = field(default_factory=dict)
    handed: dict[tuple[str, str], tuple[tuple[str, str], ...]] = field(default_factory=dict)
    results: dict[tuple[str, str], Wire] = field(default_factory=dict)
    arguments: dict[tuple[str, str], Wire] = field(default_factory=dict)

    def copy(self) -> Structure:
        """Return a structure with its own dictionaries."""
        return Structure(*(dict(getattr(self, f.name)) for f in fields(self)))

    def with_blocks(self, blocks: Mapping[str, Block]) -> Structure:
        """Return a structure with other blocks in some places; it shares all dictionaries but that of the blocks."""
        found = copy.copy(self)
        found.__dict__["blocks"] = {**self.blocks, **blocks}
        return found

    def clock(self, subsystem: str) -> SubsystemSettings | None:
        """Return the subsystem whose sample time holds in one: itself, or the nearest around it; None without any."""
        while subsystem and self.subsystems[subsystem].sample_time is None:
            subsystem = subsystem.rpartition(".")[0]
        found = self.subsystems[subsystem]
        return None if found.sample_time is None else found

    def method(self, subsystem: str) -> str:
        """Return the discretization of continuous blocks in a subsystem: its own, or that of the nearest around it."""
        while subsystem and self.subsystems[subsystem].method is None:
            subsystem = subsystem.rpartition(".")[0]
        return self.subsystems[subsystem].method or "exact"

    def rate(self, subsystem: str) -> Fraction | None:
        """Return the sample time that holds in a subsystem, None where it is continuous."""
        found = self.clock(subsystem)
        return None if found is None else found.sample_time

    def subsystems_around(self, subsystem: str) -> list[SubsystemSettings]:
        """Return a subsystem and all those around it, from outside in; the diagram itself is none."""
        parts = subsystem.split(".") if subsystem else []
        return [self.subsystems[".".join(parts[: i + 1])] for i in range(len(parts))]

    def gates(self, subsystem: str) -> tuple[str, ...]:
        """Return the paths of the enabled and triggered subsystems around a block in ``subsystem``, from outside in."""
        return tuple(f.path for f in self.subsystems_around(subsystem) if f.control)

    def triggered_around(self, subsystem: str) -> str | None:
        """Return the path of the innermost triggered subsystem around a block in ``subsystem``; None without any."""
        return next((f.path for f in reversed(self.subsystems_around(subsystem)) if f.control == "triggered"), None)

    def is_event(self, path: str) -> bool:
        """Whether a subsystem is enabled or triggered in continuous time, by an event, and not at ticks."""
        return path in self.controls and self.rate(path) is None and not self.is_sampled(path.rpartition(".")[0])

    def is_traced(self, path: str) -> bool:
        """Whether a run evaluates a block's equations: a stepped block and a continuous transport delay have none."""
        block = self.blocks[path]
        return not block.stepped and (not block.transport or self.is_sampled(self.subsystem_of[path]))

    def is_sampled(self, subsystem: str) -> bool:
        """Whether blocks in a subsystem act at instants only: at ticks, or when it is triggered."""
        return self.rate(subsystem) is not None or self.triggered_around(subsystem) is not None


def stepped_blocks(table: Structure, inside: str = "") -> dict[str, Block]:
    """Return the blocks that a run steps from outside, such as FMUs, sorted by path; ``inside``: those in a place."""
    paths = [p for p, b in table.blocks.items() if b.stepped and (not inside or f"{p}.".startswith(f"{inside}."))]
    return {path: table.blocks[path] for path in sorted(paths)}


def join(subsystem: str, name: str) -> str:
    """Return the dotted path of ``name`` in a subsystem."""
    return f"{subsystem}.{name}" if subsystem else name


def sheet_of_structure(name: str, table: Structure) -> Sheet:
    """Return a diagram as it is shown: its subsystems with their rates, its blocks, its named wires."""
    subsystems = [(path, settings) for path, settings in table.subsystems.items() if path]
    rate = table.rate("")
    rows = []
    for path, settings in subsystems:
        own = table.rate(path)
        inside = sum(f"{at}.".startswith(f"{path}.") for at in table.subsystem_of.values())
        clock = "continuous" if own is None else f"{float(own):g} s"
        rows.append((path, clock, settings.control, inside, ", ".join(settings.inputs), ", ".join(settings.outputs)))
    columns = "subsystem", "sample time", "", "blocks", "inputs", "outputs"
    return Sheet(
        f"diagram {name!r}: {count_of(len(table.blocks), 'block')}",
        (("sample time", "" if rate is None else f"{float(rate):g} s"),),
        (
            Grid("Subsystems", columns, tuple(rows)),
            Grid("Blocks", ("block", "kind"), tuple((path, b.drawn_as) for path, b in table.blocks.items())),
            Grid("Named wires", ("wire", "from"), tuple((wire, str(source)) for wire, source in table.names.items())),
        ),
    )


def explain_absent_state(blocks: Mapping[str, Any], name: str) -> str:
    """Return why a state whose path is, or ends in, ``name`` is left out, with a next step; "" if none is."""
    for path, block in blocks.items():
        for state, reason in getattr(block, "absent_states", {}).items():
            full = join(path, state)
            if full == name or full.endswith("." + name):
                return f"{path!r} has no state {state!r}: {reason}."
    return ""

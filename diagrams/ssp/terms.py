"""Values that arrive at the inputs of FMUs, followed backwards through gains, sums and conversions of units."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...blocks.core import Block, Constant, Demux, Gain, Stack, Sum
from ...blocks.library import UnitConversion
from ..flat import WiredDiagram
from ..wiring import Wire
from .value_table import ValueTable


@dataclass(frozen=True)
class Term:
    """Value of one entry of a signal: factor · source + offset, or what a table has for the source.

    ``source``: block, port and entry where it comes from; None for a number, which is then ``offset``.
    ``stopped``: path of the block that is no transformation of one value; empty for others.
    """

    source: tuple[str, str, int | None] | None = None
    factor: float = 1.0
    offset: float = 0.0
    table: tuple[tuple[float, float], ...] = ()
    stopped: str = ""

    @property
    def is_plain(self) -> bool:
        """Whether it is the source as it is."""
        return self.factor == 1.0 and self.offset == 0.0 and not self.table

    def scaled(self, factor: float, offset: float) -> Term:
        """Return the term behind a linear transformation."""
        if self.stopped:
            return self
        return replace(self, factor=factor * self.factor, offset=factor * self.offset + offset)


@dataclass
class Terms:
    """Terms of a diagram's wires.

    ``sources``: blocks at which a term ends: FMUs, what is exported, and constants that become inputs.
    """

    wired: WiredDiagram
    sources: set[str]
    through: set[str] = field(default_factory=set)
    """Blocks that were passed, or whose value was taken: they are in the connections, or in start values."""

    def shape(self, wire: Wire) -> tuple[int, ...]:
        """Return the shape of a wire."""
        return wire.entries(self.wired.checked.shapes[wire.block, wire.port]).shape

    def entries(self, wire: Wire) -> list[Term]:
        """Return the terms of a wire's entries, in order; one of a scalar."""
        shape = self.shape(wire)
        if not shape:
            return [self.entry(wire, None)]
        return [self.entry(wire, i) for i in range(int(np.prod(shape)))]

    def entry(self, wire: Wire, i: int | None) -> Term:
        """Return the term of one entry of a wire."""
        full = self.wired.checked.shapes[wire.block, wire.port]
        if wire.index is not None:
            i = int(np.ravel(wire.entries(full))[i or 0])
        return self._of_port(wire.block, wire.port, i if full else None)

    def _of_port(self, path: str, port: str, i: int | None) -> Term:
        if path in self.sources:
            return Term((path, port, i))
        table = self.wired.scheduled
        block, subsystem = table.blocks[path], table.subsystem_of[path]
        acts_at_ticks = table.is_sampled(subsystem) or bool(table.gates(subsystem))
        if acts_at_ticks and not isinstance(block, Constant):
            return Term(stopped=path)
        found = self._passed(path, block, port, i)
        if found is None or found.stopped:
            return found or Term(stopped=path)
        self.through.add(path)
        return found

    def _input(self, path: str, name: str, i: int | None) -> Term:
        wire = self.wired.scheduled.wires.get((path, name))
        if wire is None:
            default = self.wired.scheduled.blocks[path].inputs[name].default
            return Term(offset=float(np.ravel(np.asarray(default, dtype=float))[0]), factor=0.0)
        return self.entry(wire, i if self.shape(wire) else None)

    def _passed(self, path: str, block: Block, port: str, i: int | None) -> Term | None:
        """Return the term behind a block; None where it is no transformation of one value."""

        def part(values: Any) -> float:
            return float(np.ravel(np.asarray(values, dtype=float))[i or 0 if np.ndim(values) else 0])

        if isinstance(block, Constant):
            return Term(factor=0.0, offset=part(block.value))
        if isinstance(block, UnitConversion):
            factor, offset = block.law
            return self._input(path, "u", i).scaled(part(factor), part(offset))
        if isinstance(block, Gain):
            if np.ndim(block.gain) < 2:
                return self._input(path, "u", i).scaled(part(block.gain), 0.0)
            row = np.asarray(block.gain, dtype=float)[i or 0]
            used = np.flatnonzero(row)
            if len(used) > 1:
                return None
            entry = int(used[0]) if len(used) else 0
            return self._input(path, "u", entry).scaled(float(row[entry]), 0.0)
        if isinstance(block, ValueTable):
            inner = self._input(path, "u", i)
            pairs = tuple((float(a), float(b)) for a, b in block.table.items())
            if inner.stopped or inner.source is None or not inner.is_plain:
                return inner if inner.stopped else None
            return replace(inner, table=pairs)
        if isinstance(block, Stack) and not block.rows:
            at = i or 0
            for name in block.inputs:
                shape = self.shape(self.wired.scheduled.wires[path, name])
                size = int(np.prod(shape))
                if at < size:
                    return self._input(path, name, at if shape else None)
                at -= size
        if isinstance(block, Demux):
            counts = block.counts
            n = int(port[1:]) - 1
            return self._input(path, "u", sum(counts[:n]) + (i or 0))
        if isinstance(block, Sum):
            return self._sum(path, block, i)
        return None

    def _sum(self, path: str, block: Sum, i: int | None) -> Term | None:
        """Return the term of a sum, of which all inputs but one are numbers."""
        found = [
            (1.0 if sign == "+" else -1.0, self._input(path, name, i))
            for sign, name in zip(block.signs, block.inputs, strict=True)
        ]
        for _, term in found:
            if term.stopped:
                return term
        varying = [(sign, term) for sign, term in found if term.source is not None]
        rest = sum(sign * term.offset for sign, term in found if term.source is None)
        if not varying:
            return Term(factor=0.0, offset=rest)
        if len(varying) > 1 or varying[0][1].table:
            return None
        return varying[0][1].scaled(varying[0][0], rest)

"""The signals of a record: which entries of a sample's vector they are, which of these are recorded, their units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import Layout, PortUnit, UnknownNameError, check_argument, kinds
from ..flat import FlatDiagram
from ..wiring import Wire, index_of, join, split_entry
from .signal_names import BlockOutputs, find_blocks, outputs_of, resolve

Place = tuple[tuple[int, ...], slice | np.ndarray]
"""Shape of a signal, and its columns in a run's data."""


@dataclass(frozen=True, eq=False)
class RecordedSignals:
    """The signals of a record.

    A sample's vector has the ports of ``layout``, one after the other, then the states, up to ``width`` entries. A
    record keeps ``columns`` of it.
    """

    layout: Layout
    wires: Mapping[str, Wire]
    """The named wires."""
    units: Mapping[str, PortUnit]
    """Units of the ports, by path."""
    width: int
    columns: np.ndarray | None = None
    """Entries of the vector that are recorded, ascending; None for all."""
    has_states: bool = True
    blocks: Mapping[str, Any] = field(default_factory=dict)
    """The diagram's blocks, for names of blocks and for errors; none of a run on disk."""
    stored_outputs: BlockOutputs | None = None
    """Outputs by their blocks' paths, secondary ones aside, where there are no blocks that have them."""
    _places: dict[str, Place] = field(init=False, default_factory=dict)
    """Places by the names that were asked for; the runs of one recording share them."""

    @classmethod
    def of(cls, flat: FlatDiagram, blocks: Mapping[str, Any] | None = None) -> RecordedSignals:
        """Return all signals of a diagram; ``blocks`` where its own are others, such as before it was flattened."""
        table = flat.table
        units = {join(*port): unit for port, unit in flat.checked.units.items()}
        own = table.blocks if blocks is None else blocks
        return cls(flat.log, table.names, units, flat.log.total + flat.width, blocks=own)

    def choose(self, record: Iterable[str] | None, *, states: bool = True) -> RecordedSignals:
        """Return the signals of a record that keeps a selection of them.

        A name is one that ``run[name]`` takes, or a subsystem or block for all its signals; ``record`` None keeps all.
        """
        return replace(self, columns=self._select(record, states=states), has_states=states)

    def _select(self, record: Iterable[str] | None, *, states: bool) -> np.ndarray | None:
        """Return the entries of the vector that a selection keeps, ascending; None for all."""
        total = self.layout.total
        if record is None:
            return None if states else np.arange(total)
        kept: set[int] = set()
        for name in (record,) if isinstance(record, str) else record:
            whole = find_blocks(name, self.blocks) if isinstance(name, str) else []
            within = f"{whole[0]}." if len(whole) == 1 else f"{name}."
            inside = [where for port, where in self.layout.slices.items() if port.startswith(within)]
            try:
                full = resolve(name, self.wires, self.layout.slices, {} if inside else self.blocks)
                kept.update(self.entries(full).ravel().tolist())
            except UnknownNameError:
                if not inside:
                    raise
                for where in inside:
                    kept.update(range(where.start, where.stop))
        if states:
            kept.update(range(total, self.width))
        return np.array(sorted(kept), dtype=int)

    # --- names and entries --------------------------------------------------------------------------------------------

    def resolve(self, name: str) -> str:
        """Return the full name that ``name`` means; see `signal_names.resolve`."""
        return resolve(name, self.wires, self.layout.slices, self.blocks, self.stored_outputs)

    def entries(self, full: str) -> np.ndarray:
        """Return the numbers of a signal's entries in the vector, in the signal's shape."""
        name, entry = split_entry(full, {*self.wires, *self.layout.slices})
        wire = self.wires.get(name)
        whole = self.layout.index(name if wire is None else f"{wire.block}.{wire.port}")
        part = whole if wire is None or wire.index is None else np.asarray(whole[wire.index])
        return np.asarray(part[index_of(entry, part.shape, name)]) if entry else part

    def port_of(self, name: str) -> tuple[str, str]:
        """Return the block and the port that a signal is of."""
        full, _ = split_entry(self.resolve(name), {*self.wires, *self.layout.slices})
        wire = self.wires.get(full)
        return (wire.block, wire.port) if wire is not None else (full.rpartition(".")[0], full.rpartition(".")[2])

    @property
    def outputs(self) -> BlockOutputs:
        """Outputs by their blocks' paths, secondary ones aside."""
        return outputs_of(self.blocks) if self.stored_outputs is None else self.stored_outputs

    # --- what is recorded ---------------------------------------------------------------------------------------------

    @cached_property
    def names(self) -> list[str]:
        """Names of all recorded signals: the wires' names, then the ports' paths."""
        return [n for n in (*sorted(self.wires), *self.layout.slices) if self.find_columns(n) is not None]

    @cached_property
    def _position(self) -> np.ndarray | None:
        """Column of every entry of the vector in a run's data; -1 where it has none."""
        if self.columns is None:
            return None
        position = np.full(max([self.layout.total, *(self.columns + 1)]), -1)
        position[self.columns] = np.arange(len(self.columns))
        return position

    @property
    def first_state(self) -> int:
        """Column of the first state in a run's data."""
        total = self.layout.total
        return total if self.columns is None else int(np.searchsorted(self.columns, total))

    def find_columns(self, full: str) -> np.ndarray | None:
        """Return the columns of a signal in a run's data, in its shape; None if not all were recorded."""
        where = self.entries(full)
        where = where if self._position is None else self._position[where]
        return where if np.all(where >= 0) else None

    def __contains__(self, name: str) -> bool:
        try:
            return self.find_columns(self.resolve(name)) is not None
        except UnknownNameError:
            return False

    def place(self, name: str) -> Place:
        """Return a signal's shape, and its columns in a run's data."""
        if isinstance(name, str) and name in self._places:
            return self._places[name]
        full = self.resolve(name)
        if (where := self.find_columns(full)) is None:
            raise UnknownNameError(
                f"the signal {full!r} was not recorded in this run, as the selection left it out. Run again with "
                f"record=[…, {full!r}], or without record for all signals."
            )
        columns = where.ravel()
        together = columns.size and np.array_equal(columns, np.arange(columns[0], columns[0] + columns.size))
        at = slice(int(columns[0]), int(columns[0]) + columns.size) if together else columns
        self._places[name] = where.shape, at
        return self._places[name]

    def to_export(self, names: Iterable[str], block: str) -> list[str]:
        """Return signals, each once: those given, else all that were recorded, but for ports that wires cover."""
        names = list(names)
        for name in names:
            check_argument(name, kinds.text, "names", block)
        if names:
            return list(dict.fromkeys(names))
        every = {name: self.entries(name) for name in self.names}
        named = [name for name in every if name in self.wires]
        covered = {int(k) for name in named for k in np.ravel(every[name])}
        return [
            *named,
            *(n for n, own in every.items() if n not in self.wires and not covered.issuperset(np.ravel(own))),
        ]

    # --- units --------------------------------------------------------------------------------------------------------

    def unit(self, name: str) -> PortUnit:
        """Return the unit of a signal, None where it is not declared."""
        full, entry = split_entry(self.resolve(name), {*self.wires, *self.layout.slices})
        wire = self.wires.get(full)
        unit = self.units.get(full if wire is None else f"{wire.block}.{wire.port}")
        if not isinstance(unit, tuple):
            return unit
        part = unit if wire is None or wire.index is None else unit[wire.index]
        return part[entry[0] - 1] if entry and isinstance(part, tuple) else part

    def units_of(self, name: str) -> list[str]:
        """Return the unit of each entry of a signal, "" where it is not declared."""
        size, unit = int(np.prod(self.place(name)[0])), self.unit(name)
        if not isinstance(unit, tuple):
            return [unit or ""] * size
        return list(unit) if len(unit) == size else [", ".join(unit)] * size

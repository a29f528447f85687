"""The signals of a page: what a sample has, and which curves a plot has."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import OptionError, check_argument, kinds, primary_outputs
from ..flat import FlatDiagram
from ..results import RecordedSignals
from ..wiring import join

PlotNames = Sequence[str | Sequence[str]]
"""Names of signals: each is a plot, and a list of them is one plot."""
_MOST_CURVES, _MOST_PLOTS = 4, 6


@dataclass(frozen=True)
class ShownColumn:
    """An entry of a signal, which every sample has.

    ``name``, ``unit``: the name of the signal, with the entry, and its unit; empty without one.
    """

    name: str
    unit: str
    block: str
    port: str
    entry: int
    place: int


@dataclass
class ShownColumns:
    """The columns of a page's samples, in the order in which they were asked for."""

    flat: FlatDiagram
    name: str
    found: list[ShownColumn] = field(default_factory=list)

    @cached_property
    def signals(self) -> RecordedSignals:
        """All signals of the diagram."""
        return RecordedSignals.of(self.flat)

    def add(self, name: str) -> list[int]:
        """Return the numbers of the columns of a signal; new ones are appended.

        Raises `UnknownNameError` if there is no such signal.
        """
        places = self.signals.entries(self.signals.resolve(name))
        names = [name] if not places.ndim else [f"{name}[{_number(i)}]" for i in np.ndindex(places.shape)]
        return [self._add(each, int(place)) for each, place in zip(names, places.ravel(), strict=True)]

    def add_wires(self) -> None:
        """Append the named wires that no column has yet, under whatever name."""
        known = {(column.block, column.port, column.entry) for column in self.found}
        for name in self.flat.table.names:
            columns = len(self.found)
            for i in self.add(name):
                one = self.found[i]
                if i >= columns and (one.block, one.port, one.entry) in known:
                    del self.found[columns:]
                    break
            known |= {(column.block, column.port, column.entry) for column in self.found[columns:]}

    def _add(self, name: str, place: int) -> int:
        port = next(p for p, where in self.flat.log.slices.items() if where.start <= place < where.stop)
        block, output = self.flat.ports[port]
        entry = place - self.flat.log.slices[port].start
        for number, known in enumerate(self.found):
            if (known.block, known.port, known.entry, known.name) == (block, output, entry, name):
                return number
        unit: Any = self.flat.checked.units.get((block, output))
        if isinstance(unit, tuple):
            unit = unit[entry] if entry < len(unit) else None
        self.found.append(ShownColumn(name, "" if unit in (None, "1") else str(unit), block, output, entry, place))
        return len(self.found) - 1


def _number(index: tuple[int, ...]) -> str:
    return ",".join(str(i + 1) for i in index)


def plots_of(columns: ShownColumns, plots: PlotNames | None) -> list[dict[str, Any]]:
    """Return the plots of a page: the unit and the columns of each.

    Without a choice the named wires are drawn, those of one unit together; where there are none, outputs of blocks.

    Raises `OptionError, UnknownNameError`: for what are no names; for a name that no signal has.
    """
    if plots is None:
        return _default_plots(columns)
    if isinstance(plots, str):
        plots = [plots]
    check_argument(plots, kinds.several, "plots", columns.name)
    made = []
    for one in plots:
        if not isinstance(one, str) and not (isinstance(one, Iterable) and all(isinstance(n, str) for n in one)):
            raise OptionError(
                f"found {one!r} among the plots; expected the name of a signal, or a list of names for one plot.",
                port="plots",
            )
        curves = [i for name in ([one] if isinstance(one, str) else one) for i in columns.add(name)]
        units = {columns.found[i].unit for i in curves}
        made.append({"unit": units.pop() if len(units) == 1 else "", "curves": curves})
    return made


def _default_plots(columns: ShownColumns) -> list[dict[str, Any]]:
    table = columns.flat.table
    names = list(table.names)
    if not names:
        of = ((path, name) for path, block in table.blocks.items() for name in primary_outputs(block.outputs))
        names = [join(*port) for port in of if join(*port) in columns.flat.log.slices][-_MOST_PLOTS:]
    short = {name: name.rpartition(".")[2] for name in names}
    made: list[dict[str, Any]] = []
    seen: set[tuple[tuple[str, str, int], ...]] = set()
    for name in names:
        alone = list(short.values()).count(short[name]) == 1 and short[name] not in names
        curves = columns.add(short[name] if alone else name)
        places = tuple((c.block, c.port, c.entry) for c in (columns.found[i] for i in curves))
        if places in seen:
            continue
        seen.add(places)
        units = {columns.found[i].unit for i in curves}
        unit = units.pop() if len(units) == 1 else ""
        last = next(
            (one for one in made if one["unit"] == unit and len(one["curves"]) + len(curves) <= _MOST_CURVES), None
        )
        if last is None:
            made.append({"unit": unit, "curves": curves})
        else:
            last["curves"] = [*last["curves"], *curves]
    return made[:_MOST_PLOTS]

"""What of a diagram is constant on a target, and which members the struct has for the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from .loop_spec import Placed
from .model_spec import Variable
from .scalar_operations import Scalars, Tables
from .target_members import GROUPS, Group, Member, name_members
from .target_spec import TargetNumbers, TargetSpec

STATES, INPUTS, PARAMETERS = 1, 2, 3
"""Arguments x, w and p of the functions of a tick."""
_VECTORS: Mapping[Group, int] = {"parameters": PARAMETERS, "numbers": PARAMETERS, "inputs": INPUTS, "states": STATES}
_Found = list[tuple[Variable, tuple[int, ...], np.ndarray]]


@dataclass(frozen=True, eq=False)
class RenewedNumbers:
    """Numbers that are computed again when parameters of their block have been set.

    ``entries``: by number: its result of ``scalars``, and its entry of p.
    """

    spec: TargetNumbers
    scalars: Scalars
    entries: tuple[tuple[int, int], ...]


class TargetLayout:
    """The operations of ticks, with what is constant computed, and the members that these read and write.

    ``ticks``: the operations of each kind of tick.
    ``members``: members of the struct, by group.
    ``renewed``: numbers to compute when a parameter has been set.
    """

    def __init__(self, spec: TargetSpec, tables: Tables):
        self._spec = spec
        ticks = [Scalars.of(tick.function, tick.lookups, tables) for tick in spec.ticks]
        numbers = [(one, Scalars.of(one.function, (), tables)) for one in spec.numbers]
        fixed = {i for first, end in spec.fixed for i in range(first, end)}
        self._tunable = [one for one in spec.loop.parameters if not fixed.intersection(one.places)]
        self._changes = {
            i for one in ticks for i, node in enumerate(one.results[0]) if not is_entry(one, node, STATES, i)
        }
        self._free = self._find_free(numbers)
        self.ticks = [one.folded(self._known) for one in ticks]
        self._numbers = [(one, scalars.folded(self._known_behind(one.first))) for one, scalars in numbers]
        self.renewed: list[RenewedNumbers] = []
        self.members = {group: name_members(group, found) for group, found in self._find_members().items()}
        self._places = {
            (vector, place): (member, entry)
            for group, vector in _VECTORS.items()
            for member in self.members[group]
            for entry, place in enumerate(member.places)
        }

    def place(self, argument: int, entry: int) -> tuple[Member, int] | None:
        """Return the member, and its entry, that has an entry of an argument; None for a constant."""
        return self._places.get((argument, entry))

    def all_members(self, groups: Iterable[Group] = GROUPS) -> list[Member]:
        """Return the members of some groups."""
        return [member for group in groups for member in self.members[group]]

    def start_value(self, argument: int, entry: int) -> float:
        """Return the start value of a state or a parameter."""
        return float(self._spec.start["p" if argument == PARAMETERS else "x"][entry])

    # --- constants ----------------------------------------------------------------------------------------------------

    def _find_free(self, numbers: Iterable[tuple[TargetNumbers, Scalars]]) -> set[int]:
        """Return the entries of p that are not constant: what can be set, and what is computed from that."""
        offered = {place for one in self._tunable for place in one.places}
        free = set(offered)
        for one, scalars in numbers:
            for i, root in enumerate(scalars.results[0]):
                if any(one.first + entry in offered for entry in _entries_read(scalars, [root])):
                    free.add(one.first + one.parameters + i)
        return free

    def _known(self, argument: int, entry: int) -> float | None:
        """Return the value of an input of a tick that is constant."""
        is_constant = (argument == STATES and entry not in self._changes) or (
            argument == PARAMETERS and entry not in self._free
        )
        return self.start_value(argument, entry) if is_constant else None

    def _known_behind(self, first: int) -> Callable[[int, int], float | None]:
        """Return the same for a block's parameters, which begin at an entry of p."""
        return lambda _, entry: self._known(PARAMETERS, first + entry)

    # --- members ------------------------------------------------------------------------------------------------------

    def _find_members(self) -> Mapping[Group, _Found]:
        """Return what is read or written: states that change, parameters that are used, all inputs and outputs."""
        loop, start = self._spec.loop, self._spec.start
        read = set[int]()
        for scalars in self.ticks:
            read |= _entries_read(scalars, [n for row in scalars.results for n in row], PARAMETERS)
        computed = self._find_numbers(read)

        def started(found: Iterable[Placed], vector: str) -> _Found:
            return [(one.variable, one.places, start[vector][list(one.places)]) for one in found]

        states: _Found = []
        for kept in self._spec.kept:
            places = tuple(range(kept.first, kept.first + kept.variable.size))
            if self._changes.intersection(places):
                states.append((kept.variable, places, start["x"][list(places)]))
        return {
            "parameters": started((one for one in self._tunable if read.intersection(one.places)), "p"),
            "numbers": computed,
            "inputs": started(loop.inputs, "w"),
            "outputs": [(one.variable, one.places, self._output_start(one)) for one in loop.outputs],
            "signals": [(one.variable, one.places, self._output_start(one)) for one in loop.signals],
            "states": states,
        }

    def _find_numbers(self, read: set[int]) -> _Found:
        """Return the computed numbers that ticks read and that depend on parameters; note the parameters as read."""
        found: _Found = []
        for one, scalars in self._numbers:
            entries, wanted = [], set[int]()
            for i in range(one.count):
                place = one.first + one.parameters + i
                if place in read and (inputs := _entries_read(scalars, [scalars.results[0][i]])):
                    entries.append((i, place))
                    wanted |= inputs
            read |= {one.first + i for i in wanted}
            if entries:
                self.renewed.append(RenewedNumbers(one, scalars, tuple(entries)))
                places = tuple(place for _, place in entries)
                variable = Variable("numbers", shape=(len(places),), description=f"of {one.block}")
                object.__setattr__(variable, "name", one.block)  # a path, which users' variables can't have
                found.append((variable, places, self._spec.start["p"][list(places)]))
        return found

    def _output_start(self, placed: Placed) -> np.ndarray:
        values = self._spec.start.get("log", np.zeros(0))
        found = values[list(placed.places)] if values.size else np.zeros(len(placed.places))
        return np.where(np.isfinite(found), found, 0.0)


def _entries_read(scalars: Scalars, roots: Iterable[int], argument: int | None = None) -> set[int]:
    """Return the entries of an argument, or of any, that some values are computed from."""
    nodes = (scalars.nodes[node] for node in scalars.needed(roots))
    places = (node.place for node in nodes if node.operation == ca.OP_INPUT)
    return {entry for which, entry in places if argument in (None, which)}


def is_entry(scalars: Scalars, node: int, argument: int, entry: int) -> bool:
    """Whether a value is an entry of an argument as it is."""
    one = scalars.nodes[node]
    return one.operation == ca.OP_INPUT and one.place == (argument, entry)

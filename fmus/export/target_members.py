"""Variables of C for a target: their names, ranges and start values as C text, and the outcomes of a tick."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from .c_text import distinct, identifier, in_comment
from .model_spec import Variable

Number = Literal["double", "float"]
Group = Literal["parameters", "numbers", "inputs", "outputs", "signals", "states"]
GROUPS: tuple[Group, ...] = ("parameters", "numbers", "inputs", "outputs", "signals", "states")
"""Groups of variables, in the order of the struct; ``numbers`` are computed from parameters."""
NAMED: tuple[Group, ...] = ("parameters", "inputs", "outputs", "signals")
"""Groups whose variables are set and got by name."""


@dataclass(frozen=True, eq=False)
class Member:
    """A variable, which may be a member of the struct.

    ``places``: its entries in the vector of its group.
    """

    group: Group
    name: str
    variable: Variable
    places: tuple[int, ...]
    start: np.ndarray

    @property
    def count(self) -> int:
        """Number of entries."""
        return len(self.places)

    @property
    def is_settable(self) -> bool:
        """Whether it may be set by name."""
        return self.group in ("parameters", "inputs")

    def access(self, entry: int, instance: str = "c->") -> str:
        """Return the C text of an entry."""
        return f"{instance}{self.group}.{self.name}" + (f"[{entry}]" if self.variable.shape else "")

    @property
    def declaration(self) -> str:
        """The member's name with its size."""
        return f"{self.name}[{self.count}]" if self.variable.shape else self.name

    def describe(self, shown: str) -> str:
        """Return the comment next to it: name, if it is shown by another; unit, description, range, start value."""
        variable = self.variable
        parts = [variable.name] if variable.name != shown else []
        if variable.unit:
            parts.append(f"unit {variable.unit}")
        if len(variable.shape) > 1:
            parts.append(f"{' x '.join(map(str, variable.shape))}, row by row")
        if variable.description:
            parts.append(variable.description)
        if variable.minimum is not None or variable.maximum is not None:
            parts.append(_describe_range(variable.minimum, variable.maximum))
        if self.group in ("parameters", "inputs", "states"):
            parts.append(f"start {_describe_values(self.start.tolist())}")
        return "; ".join(in_comment(part).replace("\n", " ") for part in parts)


def _describe_range(minimum: float | None, maximum: float | None) -> str:
    is_open = minimum == float(np.finfo(float).tiny)  # the least number above an open bound 0
    low = "above 0" if is_open else "" if minimum is None else f"from {minimum:g}"
    high = "" if maximum is None else f"to {maximum:g}"
    return " ".join(text for text in (low, high) if text)


def _describe_values(values: Sequence[float]) -> str:
    if len({*values}) == 1:
        return f"{values[0]:g}"
    return ", ".join(f"{value:g}" for value in values[:4]) + (", ..." if len(values) > 4 else "")


def name_members(group: Group, found: Iterable[tuple[Variable, tuple[int, ...], np.ndarray]]) -> list[Member]:
    """Return the members of a group, of variables with their places and start values; names are distinct."""
    taken = set[str]()
    return [
        Member(group, distinct(identifier(variable.name), taken), variable, places, start)
        for variable, places, start in found
    ]


def label_members(members: Iterable[Member]) -> dict[Member, str]:
    """Return the end of the enumerator of each member; names that differ in case alone are numbered."""
    taken = set[str]()
    return {one: distinct(f"{one.group[:-1]}_{one.name}".upper(), taken) for one in members}


class Status(NamedTuple):
    """An outcome of a tick: the end of its enumerator, and its text."""

    label: str
    text: str


def list_statuses(
    guards: Iterable[tuple[str, str]], failure: Status
) -> tuple[list[Status], Mapping[tuple[str, str], str]]:
    """Return the outcomes of a tick, and the label of each guard that may fail.

    ``guards``: block and name.
    ``failure``: the outcome where a number isn't finite.
    """
    taken = set[str]()
    labels = {guard: f"GUARD_{distinct(identifier('_'.join(guard)).upper(), taken)}" for guard in dict.fromkeys(guards)}
    failed = [Status(label, f"{block}: {name} is not positive") for (block, name), label in labels.items()]
    return [Status("OK", "the tick is done"), failure, *failed], labels

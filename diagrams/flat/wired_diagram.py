"""A wired diagram that gives its functions."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from fractions import Fraction
from typing import ClassVar, Protocol, Self

from ...blocks.core import Block
from ..wiring import CheckedDiagram, Structure, exact_time, stepped_blocks
from .flat_diagram import FlatDiagram
from .flatten import flatten, renumber
from .plant_ticks import own_step
from .same_functions import find_other_numbers

VARIANTS = 8
"""Variants with functions of their own that a diagram remembers, as long as they are in use."""


class HasBase(Protocol):
    """Anything that says where the ticks are."""

    @property
    def base(self) -> Fraction:
        """Seconds between two ticks."""

    @property
    def asked(self) -> bool:
        """Whether ``base`` was asked for, as a ``step``."""


class WiredDiagram(CheckedDiagram):
    """A wired diagram with its functions, each made once: the diagram that runs, and that linear models are made of."""

    contact_port: ClassVar[str | None] = None
    """Port at which an environment pushes unless a contact names another; known where the kind of diagram is."""
    _flat: dict[tuple[Fraction | None, bool], FlatDiagram]
    _origin: tuple[WiredDiagram, dict[str, Block]] | None
    _variants: list[weakref.ref[WiredDiagram]]

    def _set(self, name: str, table: Structure, loops: str) -> None:
        super()._set(name, table, loops)
        self.__dict__.update(_flat={}, _origin=None, _variants=[])

    def with_structure(self, structure: Structure, loops: str | None = None) -> Self:
        """Return the diagram of another structure.

        It shares the functions of this diagram, or of one that was made of it lately, where it differs from that in
        numbers alone.
        """
        found = super().with_structure(structure, loops)
        own = self if self._origin is None else self._origin[0]
        for origin in (own, *(other for ref in reversed(own._variants) if (other := ref()) is not None)):
            blocks = find_other_numbers(origin, found)
            if blocks is not None:
                found.__dict__["_origin"] = (origin, blocks)
                break
        else:
            own._variants.append(weakref.ref(found))
            del own._variants[:-VARIANTS]
        return found

    def renumbered(self, blocks: Mapping[str, Block]) -> Self:
        """Return a variant with other numbers, which shares the functions of this diagram; nothing is checked again.

        Parameters
        ----------
        blocks : mapping of str to Block
            Blocks by path that differ from those of this diagram in numbers alone: their traces are the same ones.
        """
        found = type(self).__new__(type(self))
        found.__dict__.update(self.__dict__)
        structure, scheduled = self.structure.copy(), self.scheduled.copy()
        structure.blocks.update(blocks)
        scheduled.blocks.update(blocks)
        found.__dict__.update(
            structure=structure, scheduled=scheduled, _flat={}, _origin=(self, dict(blocks)), _variants=[]
        )
        return found

    def flatten(self, step: float | Fraction | None = None) -> FlatDiagram:
        """Return the diagram as one CasADi function of a tick.

        Parameters
        ----------
        step : float or Fraction, optional
            Seconds between two ticks, where no subsystem has a sample time (or to look between samples).
        """
        return self.flattened(None if step is None else exact_time(step, block=self.name))

    @property
    def has_base(self) -> bool:
        """Whether the time between two ticks follows from sample times, or from communication steps of FMUs."""
        return self.has_clock or any(own_step(plant) is not None for plant in stepped_blocks(self.structure).values())

    def flatten_like(self, other: HasBase) -> FlatDiagram:
        """Return the diagram with the ticks of an operating point, or of another flat diagram."""
        return self.flattened(other.base, asked=other.asked)

    def flattened(self, step: Fraction | None, *, asked: bool | None = None) -> FlatDiagram:
        """Return the diagram for a step that is exact already; None takes that of the clocks.

        Parameters
        ----------
        step : Fraction, optional
            Seconds between two ticks.
        asked : bool, optional
            Whether it was asked for, and is not that of the clocks; by default it was if it is given.
        """
        asked = step is not None if asked is None else asked
        key = (step, asked)
        if key not in self._flat and self._origin is not None:
            origin, blocks = self._origin
            self._flat[key] = renumber(origin.flattened(step, asked=asked), blocks)
        if key not in self._flat:
            self._flat[key] = flatten(self.scheduled, self.checked, self.orders, step, asked=asked, name=self.name)
        return self._flat[key]

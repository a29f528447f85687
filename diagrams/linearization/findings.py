"""Findings about a linear model: the effects that it leaves out.

A finding has its facts as fields, and its text as ``str(…)``. `Linearization.findings` holds all of them; select a kind
by its class: ``[f for f in model.findings if isinstance(f, StepsOnly)]``.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A limit of a linear model; the classes below are its kinds."""


@dataclass(frozen=True)
class StepsOnly(Finding):
    """An output that depends on an input only in steps, such as a quantizer's: its slope is zero.

    Attributes
    ----------
    block, port : str
        Path of the block, and its output.
    source : str
        Input that the output depends on.
    """

    block: str
    port: str
    source: str

    def __str__(self) -> str:
        return f"{self.block}.{self.port} follows {self.source!r} in steps only: it linearizes to zero"


@dataclass(frozen=True)
class EventWithinPeriod(Finding):
    """An event within the period of the model; the model is that of the motion without it.

    Attributes
    ----------
    block, event : str
        Path of the block, and name of its event.
    t : float
        Start of the period in s.
    """

    block: str
    event: str
    t: float

    def __str__(self) -> str:
        return (
            f"{self.block}: its event {self.event!r} fires within the period from t = {self.t:.9g} s; the model is "
            "that of the motion without it"
        )


@dataclass(frozen=True)
class MemoryActs(Finding):
    """A block's memory that affects the motion, so that it counts as a state.

    Attributes
    ----------
    block : str
        Path of the block.
    slope : float
        Largest derivative of a state by the memory.
    """

    block: str
    slope: float

    def __str__(self) -> str:
        return f"{self.block}: its memory affects the motion (slope {self.slope:.3g}): it counts as a state"


@dataclass(frozen=True)
class UnusualStart(Finding):
    """A start at which the diagram behaves in another way than at every later tick."""

    def __str__(self) -> str:
        return "the start is unlike every later tick, as a block has a first tick of its own; linearize at a later time"


@dataclass(frozen=True)
class EntryTaken(Finding):
    """An entry of a signal that was asked for by its name, ``"motor_force[1]"``.

    Names count entries from 1 since version 0.2.0; before, these names counted from 0. This finding says which entry is
    meant, for one release.

    Attributes
    ----------
    name : str
        Name of the signal.
    entry : tuple of int
        Numbers of the entry, counted from 1.
    """

    name: str
    entry: tuple[int, ...]

    def __str__(self) -> str:
        text, before = (",".join(str(i - first) for i in self.entry) for first in (0, 1))
        return (
            f"{self.name}[{text}] is the entry {text}, counted from 1 as in all names (until version 0.1 it was called "
            f"{self.name}[{before}] here)"
        )

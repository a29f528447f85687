"""Findings about a linear model: the things that it does not follow.

Each finding has its facts as fields, and its text as ``str(…)``. `Linearization.findings` has them all; ask for a kind
by its class: ``[f for f in model.findings if isinstance(f, StepsOnly)]``.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A limit of a linear model that its reader has to know; its kinds are the classes below."""


@dataclass(frozen=True)
class StepsOnly(Finding):
    """An output that depends on an input only by steps, such as a quantizer's: its slope is zero.

    Attributes
    ----------
    block, port : str
        Path of the block, and its output.
    source : str
        The input that the output follows, or ``"t"``.
    """

    block: str
    port: str
    source: str

    def __str__(self) -> str:
        return f"{self.block}.{self.port} follows {self.source!r} in steps only: it linearizes to zero"


@dataclass(frozen=True)
class EventWithinPeriod(Finding):
    """An event within the period of the model, which is that of the motion without it.

    Attributes
    ----------
    block, event : str
        Path of the block, and the name of its event.
    t : float
        Start of the period in s.
    """

    block: str
    event: str
    t: float

    def __str__(self) -> str:
        return (
            f"{self.block}: its event {self.event!r} comes within the period from t = {self.t:.9g} s; the model is "
            "that of the motion without it"
        )


@dataclass(frozen=True)
class MemoryActs(Finding):
    """A block's memory that acts on the motion, so that it counts as a state.

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
        return f"{self.block}: its memory acts on what follows ({self.slope:.3g}): it counts as a state"


@dataclass(frozen=True)
class UnusualStart(Finding):
    """A start at which the diagram acts in another way than at every later tick."""

    def __str__(self) -> str:
        return (
            "the start is unlike every later tick (a block does something else at its first one); linearize at a later "
            "time"
        )

"""Findings about a linear model: the effects that it leaves out.

A finding has its facts as fields, and its text as ``str(…)``. `Linearization.findings` holds all of them; select a kind
by its class: ``[f for f in model.findings if isinstance(f, StepsOnly)]``. Those that lie on a loop go with the
loop, and with every number that is made from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from ...blocks.core import Finding, explain_calls

MEASURE = (
    "Linearize where it has a slope, linearize(point), or measure the loop with the amplitude that is meant: "
    "frequency_response(wire, …, amplitude=…)."
)
"""What to do where a block has no slope at a point."""


@dataclass(frozen=True)
class BlockFinding(Finding):
    """A finding about the way from one signal of a block to another.

    Attributes
    ----------
    block, port : str
        Path of the block, and its output or its state.
    source : str
        Input or state that the port depends on.
    """

    block: str
    port: str
    source: str


@explain_calls
@dataclass(frozen=True)
class StepsOnly(BlockFinding):
    """An output or a state that depends on an input only in steps, such as a quantizer's: its slope is zero.

    Attributes
    ----------
    rounds : bool
        Whether the steps come from rounding, which has a mean slope.
    """

    rounds: bool = field(default=False, compare=False)

    @property
    def remedy(self) -> str:
        """Take rounding by its mean slope; measure a relay."""
        return 'Take the mean slope of rounding: linearize(…, stairs="gain").' if self.rounds else MEASURE

    def __str__(self) -> str:
        return f"{self.block}.{self.port} follows {self.source!r} in steps only: it linearizes to zero"


@dataclass(frozen=True)
class EventsOnly(StepsOnly):
    """An output of an FMU in model exchange next to a discrete input, which acts at events: that slope is left out."""

    def __str__(self) -> str:
        return (
            f"{self.block}.{self.port} may follow {self.source!r}, a discrete input in model exchange, which acts at "
            "events: the model leaves that way out. Take interface='co_simulation' for this FMU, or have the input "
            "exported as continuous"
        )


@explain_calls
@dataclass(frozen=True)
class MeanSlope(BlockFinding):
    """An output or a state that depends on an input in stairs, which the model replaces by their mean slope.

    Attributes
    ----------
    slope : float
        Largest entry of the mean slope.
    asked : bool
        Whether it was asked for, as the block is no `Quantizer` or `Encoder`: its steps may be as large as the motion.
    """

    slope: float
    asked: bool = False

    @property
    def puts_in_doubt(self) -> bool:
        """Whether the mean slope was asked for: that of a converter or an encoder holds for motions of many steps."""
        return self.asked

    def __str__(self) -> str:
        return f"{self.block}.{self.port} follows {self.source!r} in stairs: taken as their mean slope {self.slope:.6g}"


@explain_calls
@dataclass(frozen=True)
class ApproximateDelay(BlockFinding):
    """A transport delay that the model replaces by Padé's approximation.

    Attributes
    ----------
    order : int
        Order of the approximation.
    delay : float
        The delay in s.
    limit : float
        Frequency in rad/s up to which the approximation is right to 1 % of the signal.
    """

    order: int
    delay: float
    limit: float

    def __str__(self) -> str:
        return (
            f"{self.block}: the delay of {self.delay:.6g} s is Padé's approximation of order {self.order}, right to "
            f"1 % up to {self.limit:.4g} rad/s"
        )


@explain_calls
@dataclass(frozen=True)
class Kink(BlockFinding):
    """A point at which the slopes to both sides differ, or the value jumps.

    Attributes
    ----------
    below, above : float
        Slopes to smaller and to larger values of the source, of the pair of entries that differs most.
    jump : float
        Change of the value at the point, 0 where it has none.
    slope : float, optional
        Slope of the model at the point: one of the two, or their mean, as of |u| at 0.
    """

    below: float
    above: float
    jump: float = 0.0
    slope: float | None = None

    @property
    def remedy(self) -> str:
        """Take another point, or measure."""
        return MEASURE

    def __str__(self) -> str:
        where = f"{self.block}.{self.port} is at a kink of its dependence on {self.source!r}"
        if self.jump:
            return f"{where}: it jumps by {self.jump:.6g} there, and the model leaves the jump out"
        both = f"{where}: slope {self.below:.6g} below the point and {self.above:.6g} above"
        return both if self.slope is None else f"{both}; the model has {self.slope + 0.0:.6g}"


@explain_calls
@dataclass(frozen=True)
class ZeroSlope(BlockFinding):
    """A slope that is zero at the point, although the value changes over the nominal range of the source.

    Attributes
    ----------
    span : float
        Distance to both sides that the source was moved by: the port's nominal value, or 1 + its size without one.
    change : float
        Change of the port from the lower to the upper end.
    """

    span: float
    change: float

    @property
    def remedy(self) -> str:
        """Take another point, or measure."""
        return MEASURE

    def __str__(self) -> str:
        return (
            f"{self.block}.{self.port} has the slope zero by {self.source!r} at this point, but changes by "
            f"{self.change:.3g} from {self.span:.3g} below to {self.span:.3g} above it"
        )


@dataclass(frozen=True)
class CutFromTracking(Finding):
    """A cut that separates a block's tracking input from the output that it follows in the closed loop."""

    wire: str
    block: str
    port: str  # tracking input
    output: str  # the output that it has the true value of
    offered: str  # wire that feeds the tracking input
    to: tuple[str, ...]  # its other consumers on the loop: loop(offered, to=to) leaves the tracking as it is

    def __str__(self) -> str:
        step = f" For the loop without it take loop({self.offered!r}, to={_shown(self.to)})." if self.to else ""
        return (
            f"the cut at {self.wire!r} separates {self.block}.{self.port} from {self.block}.{self.output}, which it "
            f"follows in the closed loop: L contains the controller's own tracking.{step}"
        )


@dataclass(frozen=True)
class SharedCut(Finding):
    """A cut that also takes the controller's own way back, such as the model of a Smith predictor or an observer."""

    wire: str
    # inputs of the plant: loop(wire, to=to) is the loop there; empty where no single cut separates them
    to: tuple[str, ...]
    own: tuple[str, ...]  # the other consumers, from which the wire is reached again without the plant
    at: str = ""  # wire that feeds the inputs of the plant, where it is not the cut wire but one behind it

    def __str__(self) -> str:
        step = (
            f"For that take loop({self.at or self.wire!r}, to={_shown(self.to)})"
            if self.to
            else "For that take loop(…) of the wire into the plant"
        )
        return (
            f"the cut at {self.wire!r} also takes {', '.join(self.own)}, the controller's own way back: L is not the "
            f"loop at the plant's input. {step}"
        )


@dataclass(frozen=True)
class ParallelWays(Finding):
    """A cut wire with several ways back, of which nothing says which one is the plant's."""

    limits_numbers: ClassVar[bool] = False
    wire: str
    # wires and inputs at which each way can be cut alone: the wire itself, or one behind blocks without states
    cuts: tuple[tuple[str, tuple[str, ...]], ...]

    @property
    def to(self) -> tuple[str, ...]:
        """The inputs that lead back to the wire."""
        return tuple(dict.fromkeys(to for _, inputs in self.cuts for to in inputs))

    def __str__(self) -> str:
        each = " or ".join(f"loop({wire!r}, to={_shown(inputs)})" for wire, inputs in self.cuts)
        return (
            f"{self.wire!r} is cut for {', '.join(self.to)}, which all lead back to it. If one of them is a model of "
            f"the controller's own, the loop at the plant's input is {each}"
        )


def _shown(to: tuple[str, ...]) -> str:
    return repr(to[0]) if len(to) == 1 else repr(to)


@dataclass(frozen=True)
class InertConsumer(Finding):
    """A consumer of a cut wire from which nothing follows at the operating point: L is the loop through the others."""

    wire: str
    block: str
    port: str
    to: tuple[str, ...]  # the other consumers on the loop

    def __str__(self) -> str:
        return (
            f"{self.wire!r} also feeds {self.block}.{self.port}, from which nothing follows at this point: L is the "
            f"loop through {', '.join(self.to) or 'nothing else'}"
        )


@dataclass(frozen=True)
class EventWithinPeriod(Finding):
    """An event within the period of the model; the model is that of the motion without it."""

    block: str
    event: str
    t: float  # start of the period in s

    def __str__(self) -> str:
        return (
            f"{self.block}: its event {self.event!r} fires within the period from t = {self.t:.9g} s; the model is "
            "that of the motion without it"
        )


@dataclass(frozen=True)
class MemoryActs(Finding):
    """A block's memory that affects the motion, so that it counts as a state."""

    limits_numbers: ClassVar[bool] = False
    block: str
    slope: float  # largest derivative of a state by the memory

    def __str__(self) -> str:
        return f"{self.block}: its memory affects the motion (slope {self.slope:.3g}): it counts as a state"


@dataclass(frozen=True)
class UnusualStart(Finding):
    """A start at which the diagram behaves in another way than at every later tick."""

    def __str__(self) -> str:
        return (
            "the start is unlike every later tick, as a block has a first tick of its own; linearize at a later time, "
            "or give that block an after_start(x, u, T)"
        )


@explain_calls
@dataclass(frozen=True)
class InexactDerivatives(Finding):
    """Directional derivatives of an FMU that differ from differences of its own values.

    Attributes
    ----------
    block : str
        Path of the FMU.
    gap : float
        Largest distance, relative to the size of the derivatives; NaN where it is not known.
    """

    block: str
    gap: float

    @property
    def leaves_error_unknown(self) -> bool:
        """Whether the gap is not known."""
        return math.isnan(self.gap)

    def __str__(self) -> str:
        if math.isnan(self.gap):
            return (
                f"{self.block}: its directional derivatives could not be held against differences of its own values, "
                "which are stairs, jump, or are not computed beside this point: their error is not known"
            )
        return (
            f"{self.block}: its directional derivatives are right to {self.gap:.2g} of their size alone, by "
            "differences of its own values"
        )


@explain_calls
@dataclass(frozen=True)
class RefutedDerivatives(Finding):
    """Directional derivatives of an FMU that are plainly wrong: differences of its own values replace them.

    Attributes
    ----------
    block : str
        Path of the FMU.
    gap : float
        Largest distance, relative to the size of the derivatives.
    """

    limits_numbers: ClassVar[bool] = False
    block: str
    gap: float

    def __str__(self) -> str:
        return (
            f"{self.block}: its directional derivatives are wrong, by {self.gap:.2g} of their size; differences of its "
            "own values stand in for them. Tell its makers"
        )


@explain_calls
@dataclass(frozen=True)
class CoarseValues(Finding):
    """Values of an FMU without directional derivatives that are too coarse to tell all their slopes by differences.

    They move in steps (a converter, single precision with a large offset), or have a kink at the point.

    Attributes
    ----------
    block : str
        Path of the FMU.
    error : float
        Largest error of a derivative, relative to the largest change of the value that it belongs to.
    """

    block: str
    error: float

    def __str__(self) -> str:
        return (
            f"{self.block}: its values move in steps, or have a kink at this point: differences tell their slopes to "
            f"{self.error:.2g} of the largest change alone. Take an FMU with directional derivatives, or in double "
            "precision"
        )


@dataclass(frozen=True)
class EntryTaken(Finding):
    """An entry of a signal that was asked for by its name, ``"motor_force[1]"``.

    Names count entries from 1 since version 0.2.0; before, these names counted from 0. This finding says which entry is
    meant, for one release.
    """

    limits_numbers: ClassVar[bool] = False
    name: str
    entry: tuple[int, ...]

    def __str__(self) -> str:
        text, before = (",".join(str(i - first) for i in self.entry) for first in (0, 1))
        return (
            f"{self.name}[{text}] is the entry {text}, counted from 1 as in all names (until version 0.1 it was called "
            f"{self.name}[{before}] here)"
        )

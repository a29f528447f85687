"""Options of the co-simulation of one FMU."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, Flag, auto
from fractions import Fraction
from functools import reduce
from operator import or_
from typing import Any

from ...blocks.core import Kind, ParameterError, accepts, explain_calls, kinds
from ..archive import FmuDescription
from .fmi_calls import FmiCalls


class StepTime(Enum):
    """Arithmetic by which the start of a communication step is computed."""

    MULTIPLIED = "multiplied"
    """t = i·h, rounded once: it never drifts from the diagram's ticks."""
    ADDED = "added"
    """t += h after each step, as some tools do: their records are then met bit for bit."""


def _seconds(step: str, condition: Callable[[Any], object]) -> Kind:
    return Kind(
        "seconds, positive, or None",
        lambda value: isinstance(value, float | int | Fraction) and not isinstance(value, bool) and condition(value),
        step,
        kinds.as_written,
    )


_FLAG = kinds.one_of_class(bool, "True or False").worded(step="Give one of them.")


@explain_calls
@accepts(
    "stepping",
    ParameterError,
    tolerance=kinds.one_of_class((float, int), "a positive number, or None")
    .where(lambda value: 0.0 < value < math.inf)
    .worded(step="Give one such as 1e-6.", found=kinds.as_written),
    event_mode=_FLAG,
    early_return=_FLAG,
    retries=kinds.integer(0, 50).worded(step="Give the number of times that a step is halved."),
    rollback=_FLAG,
    input_derivatives=_FLAG,
    time=Kind(
        " or ".join(repr(kind.value) for kind in StepTime),
        lambda value: (
            isinstance(value, StepTime) or (isinstance(value, str) and value in [kind.value for kind in StepTime])
        ),
        "Give one.",
    ),
    communication_step=_seconds("Give a multiple of the ticks, such as 0.01.", lambda value: 0 < value < math.inf),
    stop_time=_seconds("Give the end of the longest run, such as 100.0.", lambda value: value > 0.0),
)
@dataclass(frozen=True)
class StepOptions:
    """Options of the co-simulation of one FMU: ``Fmu(file, stepping=StepOptions(event_mode=True))``.

    Parameters
    ----------
    tolerance : float, optional
        Relative tolerance that the FMU is given (toleranceDefined); None leaves it to the FMU.
    event_mode : bool, optional
        Use Event Mode (FMI 3.0, 4.2.1): events end a step, discrete inputs and tunable parameters change there, and
        periodic input clocks tick. None: where the FMU has clocks and ``hasEventMode``, and is none of Loopwright's,
        which make the same ticks themselves, in less time.
    early_return : bool, optional
        Allow a step to end early; the rest follows at once, with the inputs held. None: where Event Mode is used.
    retries : int
        Number of times that a discarded step is halved. It is done where the FMU takes steps of any length and is in a
        known state: in FMI 3.0 that before the step, in FMI 2.0 that at its lastSuccessfulTime.
    rollback : bool
        Save the FMU's state before each step, so that a discarded one is taken again from there (FMI 2.0, 4.2.2), by
        the length that its lastSuccessfulTime says, or half of it. The FMU must be able to save its state.
    input_derivatives : bool
        Let real inputs continue with their slopes within a step, by the difference from the step before: in FMI 1.0 and
        2.0 where the FMU has ``canInterpolateInputs``; in FMI 3.0 for inputs with ``intermediateUpdate`` where it has
        ``providesIntermediateUpdate``. This helps where inputs are smooth; where they are held
        or jump, it overshoots.
    time : StepTime or {"multiplied", "added"}
        Arithmetic by which the FMU's time is computed.
    communication_step : float or Fraction, optional
        Seconds between two communication points of the FMU, a multiple of the run's base. None: at the ticks of the
        subsystems that it is wired to, or at those of the run's ``step``.
    stop_time : float, optional
        End of the experiment in s that the FMU is given (stopTimeDefined). Some FMUs take no step beyond it, or beyond
        their default experiment without it. None: it is open.

    Raises
    ------
    ParameterError
        For a value out of its range.
    """

    tolerance: float | None = None
    event_mode: bool | None = None
    early_return: bool | None = None
    retries: int = 10
    rollback: bool = False
    input_derivatives: bool = False
    time: StepTime | str = StepTime.MULTIPLIED
    communication_step: float | Fraction | None = None
    stop_time: float | None = None

    def __post_init__(self) -> None:
        """Read the name of an arithmetic."""
        object.__setattr__(self, "time", StepTime(self.time))


def check_offered(options: StepOptions, about: FmuDescription, label: str) -> None:
    """Refuse options that an FMU does not offer."""
    slopes = "providesIntermediateUpdate" if about.fmi.startswith("3") else "canInterpolateInputs"
    for name, offered, needed in (
        ("event_mode", about.has_event_mode, "hasEventMode is false in its description"),
        ("early_return", about.fmi.startswith("3"), f"only FMI 3.0 has that, and it is of FMI {about.fmi}"),
        ("rollback", about.can_save, f"{about.state_flags[0]} is false in its description"),
        ("input_derivatives", about.interpolates_inputs, f"{slopes} is not true in its description"),
    ):
        if getattr(options, name) and not offered:
            raise ParameterError(
                f"found True; the FMU does not offer it: {needed}. Leave it out.",
                block=label,
                port=f"stepping.{name}",
            )


class StepParts(Flag):
    """What belongs to a step of an FMU besides setting its inputs, stepping, and getting its outputs."""

    EVENTS = auto()
    """Event Mode before it, within it and at its end: discrete inputs, clocks, time events (FMI 3.0, 4.2.1)."""
    EARLY_RETURN = auto()
    """It may end early; the rest follows at once (FMI 3.0, 4.2.1)."""
    SLOPES = auto()
    """Real inputs continue with their slopes within it (FMI 2.0, 4.2.1; FMI 3.0, 4.2.2)."""
    ROLLBACK = auto()
    """The state before it is saved, from which it is taken again where it is discarded (FMI 2.0, 4.2.2)."""
    ADDED_TIME = auto()
    """It begins at the sum of the lengths of those before it, see `StepTime.ADDED`."""


def parts_of_step(about: FmuDescription, options: StepOptions) -> StepParts:
    """Return what belongs to the steps of an FMU."""
    # FMUs with clocks that Loopwright has exported make their ticks without Event Mode
    clocks = any(v.type_is_clock for v in about.other.values()) and not about.generation_tool.startswith("Loopwright")
    events = about.has_event_mode and (clocks if options.event_mode is None else options.event_mode)
    chosen = {
        StepParts.EVENTS: events,
        StepParts.EARLY_RETURN: events if options.early_return is None else options.early_return,
        StepParts.SLOPES: options.input_derivatives,
        StepParts.ROLLBACK: options.rollback,
        StepParts.ADDED_TIME: options.time is StepTime.ADDED,
    }
    return reduce(or_, (part for part, belongs in chosen.items() if belongs), StepParts(0))


def choose_modes(fmi: FmiCalls, about: FmuDescription, options: StepOptions) -> None:
    """Tell the calls of co-simulation of FMI 3.0, before `FmiCalls.instantiate`, how the FMU is stepped."""
    parts = parts_of_step(about, options)
    fmi.event_mode_used = StepParts.EVENTS in parts
    fmi.early_return_allowed = StepParts.EARLY_RETURN in parts
    if options.input_derivatives and about.fmi.startswith("3"):
        inputs = about.of("input").values()
        fmi.intermediate_inputs = tuple(
            r for v in inputs if v.intermediate and v.type == "Float64" for r in v.references
        )

"""Members of an instance that its steps need."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from ...blocks.core import FmuRuntimeError
from ..archive import FmuDescription
from .fmi_calls import FmiCalls, StepCall
from .fmu_block import FmuBlock
from .saved_state import FmuState
from .transfer import Transfer, UnfitError

R = TypeVar("R")


class SteppedInstance(Protocol):
    """Members of an instance that its steps need."""

    fmi: FmiCalls
    ends_run: bool
    """Whether the FMU has asked to end the simulation."""

    @property
    def block(self) -> FmuBlock:
        """Its block."""

    @property
    def description(self) -> FmuDescription:
        """The FMU's description."""

    def call(self, purpose: str, function: Callable[..., R], *arguments: Any) -> R:
        """Call a method of ``fmi``; an error begins with the purpose."""

    def add_note(self, text: str) -> None:
        """Add a message of the run."""

    def set_span(self, t: float, h: float) -> None:
        """Set start and length of the next step in s."""

    def end_step(self, status: int, t: float, h: float) -> None:
        """Wait for a step that is pending, and raise the error of one that has failed."""

    def check_flags(self, call: StepCall, t: float, h: float) -> None:
        """Raise the error of a step that has ended early, elsewhere, or asks for the end."""

    def report(self, action: str, status: int, t: float, advice: str = "") -> FmuRuntimeError:
        """Return the error of an action that has failed."""

    def take_end(self, t: float, h: float, reached: float) -> None:
        """Note that the FMU asks to end the simulation, or raise its error."""

    def check_end(self, t: float, h: float, reached: float) -> None:
        """Raise the error of an FMU that has asked to end the simulation before the end of a step."""

    def judge(self, action: str, status: int, t: float) -> None:
        """Note a warning; raise the error of a status that is worse."""

    def check_limits(self, inputs: Transfer, t: float) -> None:
        """Refuse inputs out of the range that the FMU states."""

    def refuse_input(self, error: UnfitError, t: float) -> FmuRuntimeError:
        """Return the error of an input that doesn't fit."""

    def refuse_output(self, error: UnfitError, t: float) -> FmuRuntimeError:
        """Return the error of an output that doesn't fit."""

    def note_retry(self, t: float, h: float, count: int) -> None:
        """Keep the message of a step that was taken in parts."""


class SavedInstance(SteppedInstance, Protocol):
    """Instance whose state can be saved."""

    def save(self) -> FmuState:
        """Save its state."""

    def go_back(self, state: FmuState) -> None:
        """Set the FMU back to a state, and nothing else."""

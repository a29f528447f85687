"""Members of the block `Fmu` that a loaded library needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

from ...blocks.core import FmuRuntimeError
from ..archive import FmuDescription, FmuVariable, ModelExchangeInfo, OtherVariable
from .step_options import StepOptions


class FmuBlock(Protocol):
    """A block of an FMU: its file, its start values and its ports."""

    @property
    def label(self) -> str:
        """Name for messages."""

    @property
    def description(self) -> FmuDescription:
        """The FMU's description, read and checked."""

    @property
    def isolate(self) -> object:
        """Whether it is loaded in its own process, or the limits of that process; None to decide by its origin."""

    @property
    def start(self) -> Mapping[str, Any]:
        """Start values by the FMU's names."""

    @property
    def input_variables(self) -> Mapping[str, FmuVariable]:
        """Variables that are set in a run, by their ports."""

    @property
    def output_variables(self) -> Mapping[str, FmuVariable]:
        """Variables that are read in a run, by their ports."""

    @property
    def text_variables(self) -> Mapping[str, OtherVariable]:
        """Texts and binary data that are recorded in a run, by their ports."""

    @property
    def model_exchange_info(self) -> ModelExchangeInfo | None:
        """Its model exchange, with the dependencies that hold for it; None without one."""

    @property
    def dependencies(self) -> str:
        """Dependencies of its outputs and derivatives in model exchange: "declared" or "all"."""

    @property
    def stepping(self) -> StepOptions:
        """Options of its co-simulation."""

    @property
    def variable_step(self) -> bool:
        """Whether communication steps may differ in length."""


def check_next_time(block: FmuBlock, found: float, t: float) -> float:
    """Return the time of a next event in s, as an event at time t has set it; refuse one that is no number."""
    if math.isnan(found):
        raise FmuRuntimeError(
            f"the event at t = {t:.9g} s sets the time of its next one (nextEventTime) to NaN; expected a time, or "
            "nextEventTimeDefined = false. Look up its inputs and parameters there, or report it to its makers.",
            block=block.label,
            t=t,
        )
    return found

"""An FMU as it is loaded: its description, start values, ports and options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..archive import FmuDescription, FmuVariable, ModelExchangeInfo, OtherVariable
from ..isolation import Isolation
from ..platform import is_built_here
from .step_options import StepOptions


@dataclass(frozen=True, eq=False)
class FmuSetup:
    """All that the instances of a block's FMU know of the block. Start values are by the FMU's names, ports by theirs.

    A block makes it when its FMU is loaded, and checks the file once for that.
    """

    label: str
    """Name for messages."""
    description: FmuDescription
    start: Mapping[str, Any]
    input_variables: Mapping[str, FmuVariable]
    output_variables: Mapping[str, FmuVariable]
    text_variables: Mapping[str, OtherVariable]
    """Texts and binary data that are recorded in a run."""
    stepping: StepOptions
    isolate: bool | Isolation | None
    """Whether it is loaded in its own process, or the limits of that process; None to decide by its origin."""
    model_exchange_info: ModelExchangeInfo | None
    """Its model exchange, with the dependencies that hold for it; None without one."""
    dependencies: str
    """Dependencies of its outputs and derivatives in model exchange: "declared" or "all"."""

    @property
    def process_limits(self) -> Isolation | None:
        """Limits of the process in which it is loaded; None for this process.

        An FMU that Loopwright has not built is loaded in its own process, unless its block says otherwise.
        """
        given = self.isolate
        if given is None:
            given = not is_built_here(self.description.digest)
        if isinstance(given, Isolation):
            return given
        return Isolation() if given else None

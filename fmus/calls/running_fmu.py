"""An instance in a run: its inputs are checked, its statuses judged, its texts recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.core import FmuRuntimeError, SimulationError
from ..archive import FmuVariable
from .bound_calls import WARNING
from .fmu_block import FmuBlock
from .loaded_library import LoadedFmu
from .text_values import Text, TextRecord
from .transfer import OutOfRangeError, Transfer, UnfitError


class RunningFmu(LoadedFmu):
    """Instance in a run.

    Attributes
    ----------
    inputs : dict of str to FmuVariable
        Variables of the input ports that are wired.
    record : TextRecord
        Texts and binary data that are recorded.
    ends_run : bool
        Whether the FMU has asked to end the simulation (terminateSimulation).
    is_trial : bool
        Whether a step may be taken back; an input out of its range is then kept in `refused`, and no error yet.
    refused : SimulationError or None
        Error of an input that was out of its range in a trial step.
    """

    ends_run = is_trial = False
    refused: SimulationError | None = None

    def __init__(self, block: FmuBlock, wired: Sequence[str], *, model_exchange: bool = False):
        super().__init__(block, model_exchange=model_exchange)
        variables = block.input_variables
        self.inputs = {port: variables[port] for port in wired}
        self.record = TextRecord(self.fmi, block.text_variables)

    @property
    def texts(self) -> Mapping[str, list[tuple[float, Text]]]:
        """Texts and binary data by port: each value with the time in s from which on it held."""
        return self.record.values

    def begin_texts(self, t: float) -> None:
        """Let the record of texts continue from a time in s."""
        for text in self.call("reading its texts", self.record.go_back, t):
            self.add_note(text)

    def note_texts(self, t: float) -> None:
        """Record the texts that have changed, at a time in s."""
        if self.record.variables:
            self.call("reading its texts", self.record.note, t)

    def operating_point(self) -> dict[str, Any]:
        """Return the present ``t``, ``state`` and ``inputs``, for `Fmu.linear_model` and `Fmu.step_difference`."""
        about = self.description

        def read(variable: FmuVariable) -> np.ndarray:
            return self.read_variables([variable]).reshape(variable.shape)

        state = {name: read(about.find(name)) for name in (*about.states, *about.discrete_states)}
        inputs = {port: read(variable) for port, variable in self.block.input_variables.items()}
        return {"t": self.t, "state": state, "inputs": inputs}

    def judge(self, action: str, status: int, t: float) -> None:
        """Note a warning, once for each action; raise the error of a status that is worse."""
        if status > WARNING:
            raise self.report(action, status, t)
        if status:
            self.log.warn(action, self.fmi.status_name(status), t)

    def report(self, action: str, status: int, t: float) -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        raise NotImplementedError

    def check_limits(self, inputs: Transfer, t: float) -> None:
        """Refuse inputs out of the range that the FMU states, in a trial step only if it is accepted."""
        try:
            inputs.check_limits()
        except UnfitError as error:
            refused = self.refuse(error, t)
            if not self.is_trial:
                raise refused from None
            self.refused = self.refused or refused

    def refuse(self, error: UnfitError, t: float) -> FmuRuntimeError:
        """Return the error of an input or output that doesn't fit."""
        if isinstance(error, OutOfRangeError):
            advice = "Limit the signal before this input, with Saturation, say."
        elif error.port in self.inputs:
            advice = "Convert the signal before this input, with Quantizer, say."
        else:
            advice = "Leave this output out, by ports=."
        return FmuRuntimeError(f"{error.reason}. {advice}", block=self.block.label, port=error.port, t=t)

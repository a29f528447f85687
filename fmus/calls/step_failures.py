"""Failures of a communication step: what is wrong with its inputs, its end and its outputs, and their errors."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence

import numpy as np

from ...blocks.core import FmuProcessError, FmuRuntimeError
from .fmi_calls import DISCARD, ERROR, FATAL, PENDING, StepCall
from .fmu_block import FmuBlock
from .saved_state import FmuState, SavingFmu
from .transfer import Transfer, UnfitError

NEAR = 1e-6
"""Distance from the end of a step, in steps, within which a time is that end."""
ROUNDED = 1e-9
"""Part of a step within which two times are one."""


class StepFailures(SavingFmu):
    """Instance that judges its steps.

    Attributes
    ----------
    now, width : ctypes.c_double
        Start and length of the step in s, as the arguments of the FMU's function.
    is_stepping : bool
        Whether a step is under way.
    on_end : callable or None
        Called when the FMU asks to end the simulation at the end of its step; without it the request is an error.
    """

    is_stepping = False
    on_end: Callable[[], None] | None = None
    _has_retried = _has_been_off = False

    def __init__(self, block: FmuBlock, wired: Sequence[str]):
        super().__init__(block, wired)
        self.vector = np.zeros(0)
        """Values of all inputs."""
        self.now, self.width = self.fmi.variable(ctypes.c_double), self.fmi.variable(ctypes.c_double)

    @property
    def t(self) -> float:
        """Time of the instance in s."""
        return self.now.value + self.width.value if self._running else self._began

    def reset(self) -> None:
        """Return to the state before the initialization; see `LoadedFmu.reset`."""
        super().reset()
        self.ends_run, self.refused = False, None

    def lose(self, error: FmuProcessError) -> FmuProcessError:
        """Note that the process of the FMU has ended, in a step at its start."""
        if self.is_stepping:
            self.width.value = 0.0
        return super().lose(error)

    def go_back(self, state: FmuState) -> None:
        """Set the FMU back to a state, without its outputs; for steps that are taken again."""
        self.ends_run = False
        super().go_back(state)

    def set_span(self, t: float, h: float) -> None:
        """Set start and length of the next step in s."""
        self.now.value, self.width.value = t, h

    def set_inputs(self, inputs: Transfer, t: float) -> None:
        """Set inputs at a time in s."""
        self.check_limits(inputs, t)
        try:
            status = inputs.set()
        except UnfitError as error:
            raise self.refuse(error, t) from None
        self.judge("setting the inputs", status, t)

    # ---- failures of a step (FMI 2.0, 2.1.3 and 4.2.2; FMI 3.0, 2.2.3 and 4.2.1) ----

    def report(self, action: str, status: int, t: float, advice: str = "") -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        if self.ends_run:  # an FMU that has ended need not give its outputs any more
            return self.termination(self.now.value, self.width.value, t)
        self.failed, self.fatal = status >= ERROR, status >= FATAL  # a call that is discarded changes nothing
        return FmuRuntimeError(
            f"{action} failed with {self.fmi.status_name(status)}{self._quote_messages()} The inputs "
            f"({', '.join(v.name for v in self.inputs.values())}) were {self.vector.tolist()}. "
            f"{advice or 'Look at the last samples of error.run, or take a smaller step.'}"
            f"{self.fmi.describe_memory()}",
            block=self.block.label,
            t=t,
        )

    def step_error(self, status: int, t: float, h: float) -> FmuRuntimeError:
        """Return the error of a step from t over h, both in s, that has failed with a status."""
        self.width.value = 0.0  # the instance stays where it was
        action = f"the step from t = {t:.9g} s by {h:g} s"
        if status == PENDING:
            action = f"{action} was still pending after {self.fmi.patience:g} s: it"
        if status != DISCARD:
            return self.report(action, status, t, self._beyond_the_end(t + h))
        steps = "" if self.block.variable_step else " from the start: this FMU takes steps of one length only"
        return self.report(
            f"{action} was discarded, as the FMU can't compute it: it",
            status,
            t,
            f"Take a smaller step{steps}, or check the FMU's inputs there.",
        )

    def _beyond_the_end(self, end: float) -> str:
        """Return the next step where a step ends in s beyond the end that the FMU knows; "" where it doesn't."""
        given, default = self.block.stepping.stop_time, self.description.stop_time
        stop = default if given is None else given
        if stop is None or end <= stop * (1 + ROUNDED):
            return ""
        if given is None:
            return (
                f"Its default experiment ends at {stop:g} s, beyond which some FMUs take no step. Tell it a later end: "
                "stepping=StepOptions(stop_time=…)."
            )
        return f"It was told the end {stop:g} s, by stepping=StepOptions(stop_time=…). Give a later one."

    def take_end(self, t: float, h: float, reached: float) -> None:
        """Note that the FMU asks to end the simulation, at a time in s within a step from t over h.

        Raises
        ------
        FmuRuntimeError
            If the step has not come to its end, and where nobody asks for ends; its ``ends_at`` is the time.
        """
        self.ends_run = True
        reached = t + h if math.isnan(reached) else min(max(reached, t), t + h)
        if self.on_end is None or reached < t + h - h * NEAR:
            raise self.termination(t, h, reached)
        self.on_end()

    def check_end(self, t: float, h: float, reached: float) -> None:
        """Raise the error of an FMU that has asked to end the simulation in a part of a step, before the step's end."""
        if self.ends_run and reached < t + h - h * NEAR:
            raise self.termination(t, h, reached)

    def termination(self, t: float, h: float, reached: float) -> FmuRuntimeError:
        """Return the error of an FMU that asks to end the simulation at a time in a step from t over h, all in s."""
        self.now.value, self.width.value = reached, 0.0  # the instance stays there
        error = FmuRuntimeError(
            f"the FMU asks to end the simulation (terminateSimulation) at {reached:.9g} s, in the step from "
            f"t = {t:.9g} s by {h:g} s{self._quote_messages()} End before, or look up the reason in the FMU's "
            "documentation.",
            block=self.block.label,
            t=t,
        )
        error.ends_at = reached
        return error

    def check_flags(self, call: StepCall, t: float, h: float) -> None:
        """Raise the error of a step that has ended early or elsewhere; see `take_end` for one that ends the run."""
        _, terminate, early, _ = call.flags
        if terminate:
            self.take_end(t, h, call.reached.value)
            return
        if early:
            raise FmuRuntimeError(
                f"the step from t = {t:.9g} s by {h:g} s returned early, at {call.reached.value:.9g} s (earlyReturn), "
                f"though the FMU was told that it must not (earlyReturnAllowed = false){self._quote_messages()} Take "
                "steps that end where its events are, or export it without early return.",
                block=self.block.label,
                t=t,
            )
        reached, near = call.reached.value, h * NEAR + 1e-12 * abs(t)
        own = self.description.fixed_internal_step
        if reached > t + h + max(near, 1.001 * (own or 0.0)):
            raise FmuRuntimeError(
                f"the step from t = {t:.9g} s by {h:g} s ended at {reached:.9g} s (lastSuccessfulTime); expected "
                f"{t + h:.9g} s{self._quote_messages()} Its outputs belong to another time than the diagram's: report "
                "it to its makers.",
                block=self.block.label,
                t=t,
            )
        if abs(reached - t - h) > near and not self._has_been_off:
            self._has_been_off = True
            where = (
                "before it began" if reached < t - near else "short of its end" if reached < t + h else "beyond its end"
            )
            advice = f"Take steps that are multiples of its own, {own:g} s" if own else "Report it to its makers"
            self.add_note(
                f"t = {t:.9g} s: the FMU says that a step of {h:g} s ended at {reached:.9g} s (lastSuccessfulTime), "
                f"{where}; its outputs are taken as those of {t + h:.9g} s. {advice}"
            )

    def note_retry(self, t: float, h: float, count: int) -> None:
        """Keep the message of the first step that was discarded."""
        if not self._has_retried:
            self._has_retried = True
            self.add_note(
                f"t = {t:.9g} s: the FMU discarded a step of {h:g} s; it was taken in {count} parts, and so are later "
                "ones that it discards"
            )

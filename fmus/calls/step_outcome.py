"""Outcome of communication steps: failures, ends at another time, requests to end the run, and their errors."""

from __future__ import annotations

import ctypes
import math

import numpy as np

from ...blocks.core import FmuRuntimeError
from .fmi_calls import DISCARD, ERROR, FATAL, PENDING, StepCall
from .loaded_fmu import LoadedFmu

NEAR = 1e-6
"""Distance from the end of a step, in steps, within which a time is that end."""
ROUNDED = 1e-9
"""Part of a step within which two times are one."""


class StepOutcome:
    """Start, length and outcome of an instance's steps: whether they have failed, ended elsewhere, or end the run.

    Attributes
    ----------
    now, width : ctypes.c_double
        Start and length of the step in s, as the arguments of the FMU's function.
    vector : ndarray
        Values of all inputs, for messages.
    is_stepping : bool
        Whether a step is under way.
    """

    def __init__(self, fmu: LoadedFmu):
        self._fmu, self.vector, self.is_stepping = fmu, np.zeros(0), False
        self.now, self.width = fmu.fmi.variable(ctypes.c_double), fmu.fmi.variable(ctypes.c_double)
        self._has_retried = self._has_been_off = False

    @property
    def t(self) -> float:
        """Time in s at the end of the step."""
        return self.now.value + self.width.value

    def set_span(self, t: float, h: float) -> None:
        """Set start and length of the next step in s."""
        self.now.value, self.width.value = t, h

    # ---- failures of a step (FMI 2.0, 2.1.3 and 4.2.2; FMI 3.0, 2.2.3 and 4.2.1) ----

    def report(self, action: str, status: int, t: float, advice: str = "") -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        fmu = self._fmu
        if fmu.ends_run:  # an FMU that has ended need not give its outputs any more
            return self.termination(self.now.value, self.width.value, t)
        fmu.failed, fmu.fatal = status >= ERROR, status >= FATAL  # a call that is discarded changes nothing
        if fmu.inputs:
            names = ", ".join(v.name for v in fmu.inputs.values())
            given, general = (
                f"The inputs ({names}) were {self.vector.tolist()}. ",
                "look at the last samples of error.run",
            )
        else:
            given, general = "", "check its start values"
        return FmuRuntimeError(
            f"{action} failed with {fmu.fmi.status_name(status)}{fmu.quote_messages()} {given}"
            f"{advice or f'Take a smaller step, or {general}.'}{fmu.fmi.describe_memory()}",
            block=fmu.setup.label,
            t=t,
        )

    def step_error(self, status: int, t: float, h: float) -> FmuRuntimeError:
        """Return the error of a step from t over h, both in s, that has failed with a status."""
        fmu, self.width.value = self._fmu, 0.0  # the instance stays where it was
        action = f"the step from t = {t:.9g} s by {h:g} s"
        if status == PENDING and not fmu.fmi.table.reports_step:
            action = f"{action} was still pending after {fmu.fmi.patience:g} s: it"
        if status != DISCARD:
            return self.report(action, status, t, self._beyond_the_end(t + h))
        steps = "" if fmu.description.variable_step else " from the start: this FMU takes steps of one length only"
        return self.report(
            f"{action} was discarded, as the FMU can't compute it: it",
            status,
            t,
            f"Take a smaller step{steps}, or check the FMU's inputs there.",
        )

    def _beyond_the_end(self, end: float) -> str:
        """Return the next step where a step ends in s beyond the end that the FMU knows; "" where it doesn't."""
        given, default = self._fmu.setup.stepping.stop_time, self._fmu.description.stop_time
        stop = default if given is None else given
        if stop is None or end <= stop * (1 + ROUNDED):
            return ""
        if given is None:
            return (
                f"Its default experiment ends at {stop:g} s, beyond which some FMUs take no step. Give a later one: "
                "stepping=StepOptions(stop_time=…)."
            )
        return f"Its end is {stop:g} s, by stepping=StepOptions(stop_time=…). Give a later one."

    def take_end(self, t: float, h: float, reached: float) -> None:
        """Note that the FMU asks to end the simulation, at a time in s within a step from t over h.

        Raises
        ------
        FmuRuntimeError
            If the step has not come to its end, and where nobody asks for ends; its ``ends_at`` is the time.
        """
        self._fmu.ends_run = True
        reached = t + h if math.isnan(reached) else min(max(reached, t), t + h)
        if self._fmu.on_end is None or reached < t + h - h * NEAR:
            raise self.termination(t, h, reached)
        self._fmu.on_end()

    def check_end(self, t: float, h: float, reached: float) -> None:
        """Raise the error of an FMU that has asked to end the simulation in a part of a step, before the step's end."""
        if self._fmu.ends_run and reached < t + h - h * NEAR:
            raise self.termination(t, h, reached)

    def termination(self, t: float, h: float, reached: float) -> FmuRuntimeError:
        """Return the error of an FMU that asks to end the simulation at a time in a step from t over h, all in s."""
        self.now.value, self.width.value = reached, 0.0  # the instance stays there
        error = FmuRuntimeError(
            f"the FMU asks to end the simulation (terminateSimulation) at {reached:.9g} s, in the step from "
            f"t = {t:.9g} s by {h:g} s{self._fmu.quote_messages()} End before, or look up the reason in the FMU's "
            "documentation.",
            block=self._fmu.setup.label,
            t=t,
        )
        error.ends_at = reached
        return error

    def check_flags(self, call: StepCall, t: float, h: float) -> None:
        """Raise the error of a step that has ended early or elsewhere; see `take_end` for one that ends the run."""
        fmu, (_, terminate, early, _) = self._fmu, call.flags
        if terminate:
            self.take_end(t, h, call.reached.value)
            return
        if early:
            raise FmuRuntimeError(
                f"the step from t = {t:.9g} s by {h:g} s returned early, at {call.reached.value:.9g} s (earlyReturn), "
                f"though it must not (earlyReturnAllowed = false){fmu.quote_messages()} Take "
                "steps that end where its events are, or export it without early return.",
                block=fmu.setup.label,
                t=t,
            )
        reached, near = call.reached.value, h * NEAR + 1e-12 * abs(t)
        own = fmu.description.fixed_internal_step
        if reached > t + h + max(near, 1.001 * (own or 0.0)):
            raise FmuRuntimeError(
                f"the step from t = {t:.9g} s by {h:g} s ended at {reached:.9g} s (lastSuccessfulTime); expected "
                f"{t + h:.9g} s{fmu.quote_messages()} Its outputs belong to another time than the diagram's: report "
                "it to its makers.",
                block=fmu.setup.label,
                t=t,
            )
        if abs(reached - t - h) > near and not self._has_been_off:
            self._has_been_off = True
            where = (
                "before it began" if reached < t - near else "short of its end" if reached < t + h else "beyond its end"
            )
            advice = f"Take steps that are multiples of its own, {own:g} s" if own else "Report it to its makers"
            fmu.add_note(
                f"t = {t:.9g} s: the FMU says that a step of {h:g} s ended at {reached:.9g} s (lastSuccessfulTime), "
                f"{where}; its outputs are taken as those of {t + h:.9g} s. {advice}"
            )

    def note_retry(self, t: float, h: float, count: int) -> None:
        """Keep the message of the first step that was discarded."""
        if not self._has_retried:
            self._has_retried = True
            self._fmu.add_note(
                f"t = {t:.9g} s: the FMU discarded a step of {h:g} s; it was taken in {count} parts, and so are later "
                "ones that it discards"
            )

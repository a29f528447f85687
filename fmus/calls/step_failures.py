"""Failures of a communication step: their errors, and steps that are taken again in parts."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable

import numpy as np

from ...blocks.core import FmuRuntimeError
from ..archive import FmuVariable
from .fmi_calls import DISCARD, ERROR, FATAL, PENDING, WARNING, StepCall
from .loaded_library import LoadedFmu
from .native_step import RemoteStep
from .shared_steps import QuietSteps, SharedSteps
from .stepped_instance import SteppedInstance
from .stepping import CarefulSteps
from .texts import TextRecord, TextWatch
from .transfer import OutOfRangeError, Transfer, UnfitError

NEAR = 1e-6
"""Distance from the end of a step, in steps, within which a time is that end."""
ROUNDED = 1e-9
"""Part of a step within which two times are one."""


class StepFailures(LoadedFmu):
    """Part of an instance that judges its steps."""

    step: Callable[[float, float], None]
    """Set the inputs, take a step from a time over a length, both in s, and get the outputs."""

    _inputs: dict[str, FmuVariable]
    _vector: np.ndarray
    _now: ctypes.c_double
    _width: ctypes.c_double
    _call: StepCall | None = None
    _shared: SharedSteps | None = None
    _quiet: QuietSteps | None = None
    _careful: CarefulSteps | None = None
    _watch: TextWatch | None = None
    _texts: TextRecord
    is_stepping = False
    _has_retried = _has_been_off = False
    ends_run = False
    """Whether the FMU has asked to end the simulation."""
    is_trial = False
    """Whether a step may be taken back; an input out of its range is then kept in `refused`, and no error yet."""
    refused: FmuRuntimeError | None = None
    """Error of an input that was out of its range in a trial step; `restore` takes it back."""
    on_end: Callable[[], None] | None = None
    """Told when the FMU asks to end the simulation at the end of its step; without it the request is an error."""

    @property
    def now(self) -> ctypes.c_double:
        """Start of the step in s, as the argument of the FMU's function."""
        return self._now

    @property
    def width(self) -> ctypes.c_double:
        """Length of the step in s, as the argument of the FMU's function."""
        return self._width

    def reset(self) -> None:
        """Return to the state before the initialization; see `LoadedFmu.reset`."""
        super().reset()
        self.ends_run, self.refused = False, None

    def set_span(self, t: float, h: float) -> None:
        """Set start and length of the next step in s."""
        self._now.value, self._width.value = t, h

    def refuse_input(self, error: UnfitError, t: float) -> FmuRuntimeError:
        """Return the error of an input that doesn't fit."""
        action, block = ("Limit", "Saturation") if isinstance(error, OutOfRangeError) else ("Convert", "Quantizer")
        return self._unfit(error, t, f"{action} the signal before this input, with {block}, say.")

    def check_limits(self, inputs: Transfer, t: float) -> None:
        """Refuse inputs out of the range that the FMU states, in a trial step only if it is accepted."""
        try:
            inputs.check_limits()
        except UnfitError as error:
            refused = self.refuse_input(error, t)
            if not self.is_trial:
                raise refused from None
            self.refused = self.refused or refused

    def judge(self, action: str, status: int, t: float) -> None:
        """Note a warning, once for each action; raise the error of a status that is worse."""
        if status > WARNING:
            raise self.report(action, status, t)
        if status:
            self.log.warn(action, self.fmi.status_name(status), t)

    def refuse_output(self, error: UnfitError, t: float) -> FmuRuntimeError:
        """Return the error of an output that doesn't fit."""
        self.failed = True
        return self._unfit(error, t, "Leave this output out, by ports=.")

    def _unfit(self, error: UnfitError, t: float, advice: str) -> FmuRuntimeError:
        return FmuRuntimeError(f"{error.reason}. {advice}", block=self.block.label, port=error.port, t=t)

    # ---- failures of a step (FMI 2.0, 2.1.3 and 4.2.2; FMI 3.0, 2.2.3 and 4.2.1) ----

    def _mark_failure(self, status: int) -> None:
        self.failed = status >= ERROR  # a call that is discarded changes nothing
        self.fatal = status >= FATAL

    def report(self, action: str, status: int, t: float, advice: str = "") -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        if self.ends_run:  # an FMU that has ended need not give its outputs any more
            return self.termination(self._now.value, self._width.value, t)
        self._mark_failure(status)
        return FmuRuntimeError(
            f"{action} failed with {self.fmi.status_name(status)}{self._quote_messages()} The inputs "
            f"({', '.join(v.name for v in self._inputs.values())}) were {self._vector.tolist()}. "
            f"{advice or 'Look at the last samples of error.run, or take a smaller step.'}"
            f"{self.fmi.describe_memory()}",
            block=self.block.label,
            t=t,
        )

    def end_step(self, status: int, t: float, h: float) -> None:
        """Wait for the end of a step that is pending, and raise the error of one that has failed."""
        if status == WARNING:
            self.judge("a step", status, t)
            return
        status, ends = self.fmi.end_step(status)
        if ends:
            reached = self.fmi.time_after_discard(t, h)
            self.take_end(t, h, t if reached is None else reached)
            return
        again = status == DISCARD and self._call is not None and not self.block.stepping.rollback
        if again and self._call is not None and retry_discarded(self, self._call, t, h):
            return
        if status > 1:
            raise self._step_error(status, t, h)

    def _step_error(self, status: int, t: float, h: float) -> FmuRuntimeError:
        self._width.value = 0.0  # the instance stays where it was
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
        told, default = self.block.stepping.stop_time, self.description.stop_time
        stop = default if told is None else told
        if stop is None or end <= stop * (1 + ROUNDED):
            return ""
        if told is None:
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
            If the step has not come to its end, and where nobody is told of ends; its ``ends_at`` is the time.
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
        self._now.value, self._width.value = reached, 0.0  # the instance stays there
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

    def judge_native(self, stage: int, status: int, t: float, h: float) -> None:
        """Judge a step in C from t over h, both in s, that was out of the ordinary: raise its error, or accept it.

        It is one of a library in this process; for others see `finish_remote`.

        Parameters
        ----------
        stage : {0, 1, 2}
            What was done last: setting the inputs, the step, reading the outputs.
        status : int
            Status of that.
        """
        assert self._call is not None
        if stage == 0 and status == WARNING:  # nothing is lost by setting the inputs once more
            self.step(t, h)
            return
        if stage != 1 and status > WARNING:
            raise self.report("setting the inputs" if stage == 0 else "reading the outputs", status, t)
        if stage == 1 and status > WARNING:
            self.end_step(status, t, h)
        elif stage == 1:
            self.judge("a step", status, t)
        self.check_flags(self._call, t, h)

    @property
    def remote(self) -> RemoteStep | None:
        """Its step in another process as C asks for it; None in this one, and where Python has to take each step."""
        steps = self._quiet or self._shared
        return None if steps is None else steps.remote

    def finish_remote(self, t: float, h: float) -> None:
        """End a step from t over h, both in s, that C has begun in another process, and get the outputs."""
        if self._quiet is not None:
            self._step_marked(self._quiet.finish, t, h)
        else:
            assert self._shared is not None
            self._shared.take_over(t, h)
            self._shared.finish()
        if self._texts.variables:
            self._note_texts(t + h)

    def _note_texts(self, t: float) -> None:
        each = self._careful is not None and self._shared is None
        if each or self._watch is None or self._watch.take():
            self.call("reading its texts", self._texts.note, t)
            if self._watch is not None:
                self._watch.take()

    def _step_marked(self, step: Callable[[float, float], None], t: float, h: float) -> None:
        self.is_stepping = True
        step(t, h)
        self.is_stepping = False
        if self._quiet is not None:
            self._quiet.renew()

    def note_retry(self, t: float, h: float, count: int) -> None:
        """Keep the message of the first step that was discarded."""
        if not self._has_retried:
            self._has_retried = True
            self.add_note(
                f"t = {t:.9g} s: the FMU discarded a step of {h:g} s; it was taken in {count} parts, and so are later "
                "ones that it discards"
            )


def retry_discarded(instance: SteppedInstance, call: StepCall, t: float, h: float) -> bool:
    """Take a step that was discarded in smaller ones; return whether that has worked.

    In FMI 3.0 the FMU is where it was before (4.2.1); in FMI 2.0 it is where its lastSuccessfulTime says (4.2.2), and
    where it says nothing, the step is not taken again.

    Parameters
    ----------
    instance : SteppedInstance
        The instance.
    call : StepCall
        The FMU's step.
    t, h : float
        Start and length of the step in s.
    """
    options, about = instance.block.stepping, instance.description
    smallest = h * 0.5**options.retries
    if not options.retries or not about.variable_step:
        return False
    end, now, part, count = t + h, t, h, 0
    status = DISCARD
    while True:
        if status == DISCARD:
            known = instance.fmi.time_after_discard(now, part)
            if known is None or part <= smallest * (1.0 + ROUNDED):
                return False
            now = min(max(known, now), end)
            part = min(0.5 * part, end - now)
        elif status > 1:
            return False
        else:
            now, count = now + part, count + 1
        if end - now <= ROUNDED * smallest:
            break
        part = min(part, end - now)
        instance.set_span(now, part)
        status, ends = instance.fmi.end_step(call.function(*call.arguments))
        if ends or (status > 1 and status != DISCARD):
            instance.end_step(status, now, part)
            status = 0
        elif status <= 1 and call.any_flag.value:
            instance.check_flags(call, now, part)
        if status <= 1:
            instance.check_end(t, h, now + part)
    instance.set_span(t, h)
    instance.note_retry(t, h, count)
    return True

"""Instance of an FMU in a run: communication steps and saved states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property

import numpy as np

from ...blocks.core import FmuProcessError, FmuRuntimeError
from .loaded_fmu import LoadedFmu
from .loading import FmuSetup
from .native_calls import NativeStep, RemoteStep
from .saved_state import FmuState, SavedStates
from .step import InstanceStep, StepMemory
from .step_outcome import StepOutcome


class FmuInstance(LoadedFmu):
    """Loaded FMU that takes one step at a time, through vectors that are shared with the scheduler.

    Saving and serializing its state depend on the FMU: `can_save`, `can_serialize`.
    """

    step: Callable[[float, float], None]
    """Set the inputs, take a step from a time over a length, both in s, and get the outputs (after `bind`)."""
    start_step: Callable[[float, float], None]
    """Begin a step, as `step`; one in another process continues by itself until `finish_step` (after `bind`)."""
    finish_step: Callable[[], None]
    """End the step that `start_step` has begun, and get the outputs."""
    exchange: Callable[[], None]
    """In Initialization Mode: set the inputs and get the outputs (after `bind`)."""
    read: Callable[[float], None]
    """Get the outputs at a time in s (after `bind`)."""
    judge_native: Callable[[int, int, float, float], None]
    """Judge a step that a loop in C has taken in this process; see `InstanceStep.judge_native`."""
    finish_remote: Callable[[float, float], None]
    """End a step from t over h, both in s, that a loop in C has begun in another process."""

    def __init__(self, setup: FmuSetup, wired: Sequence[str]):
        super().__init__(setup, wired)
        self.states, self._outcome = SavedStates(self), StepOutcome(self)
        self._step: InstanceStep | None = None
        self.read = lambda t: None

    @property
    def t(self) -> float:
        """Time of the instance in s."""
        return self._outcome.t if self.is_running else self._began

    def bind(self, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Bind the vectors of the inputs to set and of the outputs to get, and get the outputs once."""
        self._bind(inputs, outputs)
        self.read(self._began)

    def _bind(self, inputs: np.ndarray, outputs: np.ndarray) -> InstanceStep:
        self._step = step = InstanceStep(self, self.states, self._outcome, inputs, outputs)
        self.step, self.start_step, self.finish_step = step.function(), step.start, step.finish
        self.judge_native, self.finish_remote = step.judge_native, step.finish_native
        self.exchange, self.read = step.exchange, step.read
        return step

    def _bind_own(self) -> InstanceStep:
        """Bind vectors that nobody else has, for events without a run."""
        sizes = [sum(v.size for v in ports.values()) for ports in (self.inputs, self.setup.output_variables)]
        return self._bind(np.zeros(sizes[0]), np.zeros(sizes[1]))

    @property
    def native(self) -> NativeStep | None:
        """Its step as addresses; None in another process, and where a step is more than three calls."""
        return None if self._step is None else self._step.native

    @property
    def remote(self) -> RemoteStep | None:
        """Its step in another process as C asks for it; None in this one, and where Python has to take each step."""
        return None if self._step is None else self._step.remote

    def report(self, action: str, status: int, t: float) -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        return self._outcome.report(action, status, t)

    def lose(self, error: FmuProcessError) -> FmuProcessError:
        """Note that the process of the FMU has ended, in a step at its start."""
        if self.is_running and self._outcome.is_stepping:
            self._outcome.width.value = 0.0
        return super().lose(error)

    # ---- the start ----

    def begin(self) -> None:
        """Leave Initialization Mode and read the outputs at the start of the run."""
        with self.host if self._starts.bound is None else nullcontext():
            super().begin()
            self._outcome.set_span(self._began, 0.0)
            if self.fmi.event_mode_used:  # it is in Event Mode now
                (self._step or self._bind_own()).begin(self._began)
            self.read(self._began)
            if self.record.variables:
                self.begin_texts(self._began)

    def reset(self) -> None:
        """Return to the state before the initialization; states of an instance that is made again are freed."""
        if not self.is_built_here:
            self.states.close()
        super().reset()
        self.states.final.value = not self.states.kept  # no earlier state is left to go back to
        if self._step is not None:
            self._step.forget()

    def start_again(self, values: Mapping[str, np.ndarray]) -> None:
        """Reset it, set start values and enter Initialization Mode at t = 0, as `reset` and `initialize` do.

        An FMU that Loopwright has built, with a plain step (`native`), is started by a few calls that are bound once.

        Parameters
        ----------
        values : mapping of str to array
            Start values besides those of the block, which they override, by the FMU's names.
        """
        self.reset()
        self._began = 0.0
        if self._starts_by_bound_calls:
            try:
                if self._starts.enter_bound({**self.setup.start, **values}):
                    return
            except Exception as error:
                raise self._initialization_error(error) from error
            self.reset()
        self.initialize(None, values=values)

    @cached_property
    def _starts_by_bound_calls(self) -> bool:
        return self.is_built_here and self.native is not None

    def begin_texts(self, t: float) -> None:
        """Let the record of texts continue from a time in s."""
        if self._step is not None:
            self._step.look_at_texts()
        super().begin_texts(t)

    # ---- saved states ----

    @property
    def can_save(self) -> bool:
        """Whether its state can be saved and restored."""
        return self.description.can_save

    @property
    def can_serialize(self) -> bool:
        """Whether a saved state can be turned into bytes."""
        return self.description.can_serialize

    def save(self) -> FmuState:
        """Save the present state with all its parts: states, inputs, parameters, memory of the solver and of its steps.

        Returns
        -------
        FmuState
            For `restore` and `serialize` of the same instance.

        Raises
        ------
        FmuError
            If the FMU can't save its state (`can_save`).
        FmuRuntimeError
            If the FMU's function fails.
        """
        state = self.states.save()
        state.steps = None if self._step is None else self._step.memory()
        return state

    def restore(self, state: FmuState) -> None:
        """Restore a saved state, earlier or later, and get the outputs there; this is allowed after an error, too.

        Raises
        ------
        FmuError
            If the state belongs to another instance, or has been freed.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self.states.restore(state)
        self.refused = None
        self._outcome.set_span(state.t, 0.0)
        if self._step is not None:
            self._step.return_to(state.t, state.steps if isinstance(state.steps, StepMemory) else None)
        self.read(state.t)
        self.begin_texts(state.t)

    def serialize(self, state: FmuState | None = None) -> bytes:
        """Return a saved state, or the present one, as bytes.

        An FMU of the same content on the same platform can read them, so that a run continues in another process.

        Raises
        ------
        FmuError
            If the FMU can't serialize its state (`can_serialize`), or the state belongs to another instance.
        FmuRuntimeError
            If the FMU's function fails.
        """
        return self.states.serialize(state)

    def deserialize(self, data: bytes) -> FmuState:
        """Return a state of this instance, made from bytes; `restore` it after `begin`.

        Raises
        ------
        FmuError
            If the bytes are no state of this FMU on this platform.
        FmuRuntimeError
            If the FMU's function fails.
        """
        return self.states.deserialize(data)

    def close(self) -> None:
        """Free the saved states, then terminate and free the instance."""
        if self.is_open:
            self.states.close()
        super().close()

"""Instance of an FMU in a run: communication steps and saved states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext

import numpy as np

from .fmu_block import FmuBlock
from .native_step import NativeStep, RemoteStep
from .saved_state import FmuState
from .step import InstanceStep, StepMemory
from .step_failures import StepFailures
from .transfer import BoundStart


class FmuInstance(StepFailures):
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

    def __init__(self, block: FmuBlock, wired: Sequence[str]):
        super().__init__(block, wired)
        self._outputs = dict(block.output_variables)
        self._step: InstanceStep | None = None
        self.read = lambda t: None
        self._starts: dict[tuple[str, ...], BoundStart | None] = {}

    def bind(self, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Bind the vectors of the inputs to set and of the outputs to get, and get the outputs once."""
        self.vector = inputs
        self._step = step = InstanceStep(self, self._outputs, inputs, outputs)
        self.step, self.start_step, self.finish_step = step.function(), step.start, step.finish
        self.judge_native, self.finish_remote = step.judge_native, step.finish_native
        self.exchange, self.read = step.exchange, step.read
        self.read(self._began)

    @property
    def native(self) -> NativeStep | None:
        """Its step as addresses; None in another process, and where a step is more than three calls."""
        return None if self._step is None else self._step.native

    @property
    def remote(self) -> RemoteStep | None:
        """Its step in another process as C asks for it; None in this one, and where Python has to take each step."""
        return None if self._step is None else self._step.remote

    # ---- the start ----

    def begin(self) -> None:
        """Leave Initialization Mode and read the outputs at the start of the run."""
        with self.host if self._start is None else nullcontext():
            super().begin()
            self.set_span(self._began, 0.0)
            self.read(self._began)
            if self.record.variables:
                self.begin_texts(self._began)

    def start_again(self, values: Mapping[str, np.ndarray]) -> None:
        """Reset it, set start values and enter Initialization Mode at t = 0, as `reset` and `initialize` do.

        An FMU that Loopwright has built, with a plain step (`native`), is started by a few calls that are bound once.

        Parameters
        ----------
        values : mapping of str to array
            Start values besides those of the block, which they override, by the FMU's names.
        """
        self.reset()
        if self._step is not None:
            self._step.forget()
        given = {**self.block.start, **values}
        if (names := tuple(given)) not in self._starts:
            fits = self.is_built_here and self.native is not None and BoundStart.fits(self.description, names)
            self._starts[names] = BoundStart(self.fmi, self.description, names) if fits else None
        start = self._starts[names]
        if start is not None:
            self._began, self._given = 0.0, given
            try:
                entered = start.enter(given, self.block.stepping.tolerance)
            except Exception as error:
                raise self._initialization_error(error) from error
            if entered:
                self._start = start
                return
            self.reset()
        self.initialize(None, values=values)

    def _settle_start(self) -> None:
        if self._step is None:
            super()._settle_start()
        else:
            self._step.begin(self._began)

    def begin_texts(self, t: float) -> None:
        """Let the record of texts continue from a time in s."""
        if self._step is not None:
            self._step.look_at_texts()
        super().begin_texts(t)

    # ---- states ----

    def save(self) -> FmuState:
        """Save the present state with all its parts, and what its steps keep besides it; see `SavingFmu.save`."""
        state = super().save()
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
        super().restore(state)
        self.refused = None
        self.set_span(state.t, 0.0)
        if self._step is not None:
            self._step.return_to(state.t, state.steps if isinstance(state.steps, StepMemory) else None)
        self.read(state.t)
        self.begin_texts(state.t)

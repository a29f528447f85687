"""A run in the making: it continues, is saved, restored and read.

The page docs/explanation/time.md says what happens in which order. The loop over time is in C, `fmus/runtime`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core import Block, OptionError, SimulationError, accepts, explain_calls, kinds
from ..coupling import note_loops, note_steps
from ..flat import EVERY, FlatDiagram, WiredDiagram, with_movable
from ..results import (
    Occurrence,
    OperatingPoint,
    Recorder,
    Recording,
    Run,
    RunState,
    Stopped,
    check_fits,
    not_open_error,
)
from .controls import Controls
from .engine import Engine
from .held_inputs import note_held_inputs
from .live_run import FRAME, LiveRun, Pace
from .progress import Interrupted, ProgressOption, compiler_notes, progress_bar
from .run_options import RunOptions, default_step, refuse_rest, ticks_in
from .save import broken_off_error, can_save, restore_state, save_state
from .start_at_point import apply_point
from .view import SimulationView, describe_simulation


@explain_calls
class Simulation:
    """A run in the making: made by `Diagram.simulation`, used in a ``with`` statement.

    ``advance`` continues, ``save`` returns the complete state, ``restore`` goes back to one, ``run`` is what was
    recorded. ``view`` shows the instant that it has reached.

    Examples
    --------
    >>> from loopwright import Diagram
    >>> from loopwright.blocks import Constant, Integrator
    >>> diagram = Diagram("ramp", Integrator()(Constant(value=1.0)).named("y"))
    >>> with diagram.simulation(step=0.25) as simulation:
    ...     simulation.advance(0.5)
    ...     half = simulation.save()
    ...     simulation.advance(0.5)
    ...     print(simulation.run()["y"])
    [0.   0.25 0.5  0.75 1.  ]
    >>> diagram.simulate(0.5, step=0.25, start=half, progress=False)["y"]
    array([0.5 , 0.75, 1.  ])
    """

    def __init__(self, diagram: WiredDiagram, options: RunOptions | None = None, *, duration: float | None = None):
        options = options or RunOptions()
        self._asked = diagram, options, duration
        start, step = options.start, options.step
        self._point = start if isinstance(start, OperatingPoint) else None
        if self._point is not None:
            diagram = apply_point(diagram, self._point)
            if not diagram.is_continuous and not diagram.has_base:
                step = step or self._point.base
        diagram, fused = options.apply_fuse(diagram)
        self.wired = diagram
        saved = None if isinstance(start, OperatingPoint) else start
        base = default_step(diagram, step, duration, options.solver, saved)
        self.recipe = options.with_step(base).recipe
        self.flat: FlatDiagram = diagram.flatten(base) if base is step else diagram.flattened(base)
        if saved is not None:
            check_fits(saved, self.flat, diagram.name)
        self._recording = Recording(
            self.flat,
            diagram.name,
            diagram.blocks,
            options.record,
            options.every,
            options.states,
            options.to,
            options.overwrite,
        )
        self._stack, self._loaded = ExitStack(), ExitStack()
        self._start_state = saved
        every_tick = base is not None or EVERY in self.flat.visited
        self._last: int | None = None
        if duration is not None:
            count, rest = ticks_in(duration, self.flat.base, diagram.name)
            if rest:
                refuse_rest(self.flat, count, duration, diagram.name)
                count += 1  # one more sample
            self._last = count + (0 if start is None else start.tick)
            self._recording.check_memory(count, every_tick=every_tick)
        self._engine = Engine(self.flat, diagram.name, options, every_tick=every_tick, on_event=self._on_event)
        fine = note_steps(self.flat, step=base)
        self._notes = (
            *fused,
            *fine,
            *note_loops(self.flat, self._engine.coupling),
            *note_held_inputs(self.flat),
        )
        self._elapsed, self._begun = 0.0, False
        self._open: bool | None = None  # until it begins; False once it has ended
        self._live: LiveRun | None = None  # the last one
        self._recorder = self._new_recorder()

    def __repr__(self) -> str:
        return describe_simulation(self.wired.name, self.view, is_open=self._open)

    @property
    def diagram(self) -> Any:
        """The `Diagram` that it runs."""
        return self.wired.facade

    def _new_recorder(self) -> Recorder:
        every_tick = self._engine.every_tick
        return self._recording.begin(None if self._last is None or not every_tick else self._last + 1)

    def __enter__(self) -> Simulation:
        if self._open is not None:
            raise not_open_error(self._open, self.wired.name)
        try:
            self._open = True
            self._load()
            self._stack.push(self._finish)
            self._begin()
        except BaseException:
            self._open = False
            self._stack.__exit__(*sys.exc_info())
            raise
        return self

    def __exit__(self, *error: Any) -> None:
        self._open = False
        self._stack.__exit__(*error)

    def _load(self) -> None:
        try:
            self._engine.load(self._stack.enter_context(self._loaded), 0.0 if self._point is None else self._point.t)
        except SimulationError as error:
            raise self._with_run(error) from error.__cause__

    def _finish(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        """End a run on disk that `run` was not asked for."""
        if self._recorder.is_open:
            cut = [] if error is None else [f"This run was cut off at t = {self.t:g} s: {kind.__name__}: {error}"]
            texts = {name: text.to_json() for name, text in self._engine.take_texts().items()}
            self._recorder.finish(**self._take_facts(*cut), texts=texts)

    def _begin(self) -> None:
        engine = self._engine
        try:
            engine.initialize()
            if self._start_state is None:
                engine.take_first_tick(self._point, self._recorder)
                self._begun = True
            else:
                self.restore(self._start_state)
        except SimulationError as error:
            culprit = engine.blame(error).at(t=self.t)
            raise self._with_run(culprit) from culprit.__cause__

    @accepts(k=kinds.whole)
    def time_of(self, k: int) -> float:
        """Return the time of tick ``k`` in s."""
        return self._engine.position.time_of(k)

    @property
    def t(self) -> float:
        """Time that the run has reached in s."""
        return self._engine.position.t

    @property
    def reached(self) -> Mapping[str, int]:
        """Tick that each plant has reached, by path: one between its communication points is behind the run."""
        steps = self._engine.steps
        return dict.fromkeys(steps.reached, self._engine.position.tick) if steps.regular else dict(steps.reached)

    @property
    def coupling(self) -> str:
        """Coupling of the FMUs in words; empty for the default, and where nothing is coupled."""
        coupled = self._engine.coupled
        return "" if coupled is None else str(coupled.coupling)

    @property
    def coupling_order(self) -> tuple[str, ...]:
        """Paths of the FMUs in the order in which they step; empty where they step together."""
        return () if self._engine.coupled is None else self._engine.coupled.order

    @property
    def stopped(self) -> Stopped | None:
        """The stop condition or FMU that has ended the run."""
        return self._engine.position.stopped

    @property
    def view(self) -> SimulationView:
        """The instant that it has reached, to be read: its states, signals and plants."""
        return self._engine.view

    # --- continuing ------------------------------------------------------------------------------------------------

    @accepts(progress=kinds.progress.or_none())
    def advance(self, duration: float, *, progress: ProgressOption = False) -> None:
        """Continue for a duration in s; one that is no multiple of the step between ticks ends the run.

        Parameters
        ----------
        duration : float
            Duration in s.
        progress : bool or callable, optional
            Show a progress bar, or a function that is called with the time; by default neither.

        Raises
        ------
        SimulationError
            See `Diagram.simulate`; ``error.run`` holds what was recorded until then.
        OptionError
            A duration that is not positive, or no multiple of the step where an FMU takes steps of one length
            only; a run that has not begun, has ended, has failed or was interrupted (`restore` lets it continue from a
            saved state).
        """
        self._refuse_second_driver()
        if not self._open:
            raise not_open_error(self._open, self.wired.name)
        position = self._engine.position
        count, rest = ticks_in(duration, self.flat.base, self.wired.name)
        if rest:
            refuse_rest(self.flat, count, duration, self.wired.name)
        if position.end is not None:
            raise OptionError(
                f"the run has ended at t = {position.end:g} s, between two ticks, and can't continue from "
                f"there. Let it continue in multiples of {float(self.flat.base):g} s, and end between them only "
                "at last.",
                block=self.wired.name,
                port="duration",
            )
        if position.is_broken_off:
            raise broken_off_error(position.t, self.wired.name, "continue from there")
        last = position.tick + count
        end = float(position.tick * self.flat.base + count * self.flat.base + rest) if rest else None
        started = time.perf_counter()

        begun = float(self.t)
        position.is_broken_off = True  # until it has come to the end
        try:
            with progress_bar(self.wired.name, begun, begun + float(duration), progress) as show:

                def arrive(t: float) -> None:
                    self._recorder.flush()
                    show(t)

                if self.stopped is None:
                    if count:
                        self._engine.go(last, self._recorder, arrive, ends_there=end is None)
                    if end is not None and self.stopped is None:
                        self._engine.end_between_ticks(end, self._recorder, arrive)
        except SimulationError as error:
            self._elapsed += time.perf_counter() - started
            raise self._with_run(error) from error.__cause__
        except KeyboardInterrupt as interrupt:
            self._elapsed += time.perf_counter() - started
            raise Interrupted(self.run(final=False)) from interrupt
        position.is_broken_off = False
        self._elapsed += time.perf_counter() - started

    @accepts(
        duration=kinds.positive.or_none(),
        speed=kinds.positive,
        inputs=kinds.mapping.or_none(),
        frame=kinds.positive,
        catch_up=kinds.number.where(lambda value: value >= 0).worded("0 s or more"),
        stop=kinds.function.or_none(),
        on_frame=kinds.function.or_none(),
        background=kinds.flag,
        clock=kinds.function,
        sleep=kinds.function,
    )
    def run_realtime(
        self,
        duration: float | None = None,
        *,
        speed: float = 1.0,
        inputs: Mapping[str, Any] | None = None,
        frame: float = FRAME,
        catch_up: float = 0.25,
        stop: Callable[[], object] | None = None,
        on_frame: Callable[[SimulationView], object] | None = None,
        background: bool = False,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], object] = time.sleep,
    ) -> LiveRun:
        """Continue at the pace of the clock, with parameters that are moved by hand; see docs/howto/live.md.

        Without a ``with`` statement the simulation begins and ends here. Ctrl-C ends the run after the frame that
        runs, and what was recorded is kept.

        Parameters
        ----------
        duration : float, optional
            Simulated time in s; without one the run continues until it is stopped.
        speed : float
            Simulated seconds in a second of the clock.
        inputs : mapping of str, optional
            What is moved, by dotted path as `Diagram.replace` takes it; the name of a `Constant`, or of the wire that
            comes out of it, is its ``value``. Each is a function of the simulated time in s, an object with a
            ``value`` (a slider of ipywidgets) or a number. They are read at the beginning of every frame; a value
            acts after the samples of that time.
        frame : float
            Seconds of the clock between two looks at the inputs, rounded to whole ticks, one at least.
        catch_up : float
            Seconds of the clock that a delay may have to be caught up. A longer one is given up: simulated time is
            then behind for good, and a warning says so once.
        stop : callable, optional
            Called before every frame and while the run waits; it ends when this returns true, such as
            ``threading.Event().is_set``.
        on_frame : callable, optional
            Called after every frame with the `view`, for a figure that follows.
        background : bool
            Return at once while a thread runs it: a notebook passes a slider's moves on only between its cells.
        clock, sleep : callable
            The clock in s, and what waits for some seconds of it.

        Returns
        -------
        LiveRun
            With ``run``, overruns, and how late frames began.

        Raises
        ------
        SimulationError
            As `advance`; a function of ``inputs`` that fails.
        UnknownNameError, ParameterError, OptionError
            A name that is no parameter; one that a run can't take over, see `set_parameters`; an option out of range.
        """
        self._refuse_second_driver()
        pace = Pace(float(speed), float(frame), float(catch_up), clock, sleep)
        live = LiveRun(self.wired.name, pace)
        controls = Controls(self.wired.structure, inputs or {}, self.wired.name)
        self._let_move(controls)
        self._live = live
        live.drive(self, duration, controls, on_frame, stop, background=bool(background))
        return live

    def _let_move(self, controls: Controls) -> None:
        """Take functions in which zeros that are moved are numbers; a run that has begun keeps those that it has."""
        diagram, options, duration = self._asked
        free = with_movable(diagram, controls.targets)
        if self._open is None and free is not diagram:
            if self._recorder.is_open:
                self._recorder.finish()
                options = replace(options, overwrite=True)
            self.__init__(free, options, duration=duration)  # type: ignore[misc]

    def _refuse_second_driver(self) -> None:
        """Refuse a call while a live run in the background advances this simulation."""
        if self._live is not None and self._live.is_running_elsewhere:
            raise OptionError(
                f"a live run in the background drives this simulation, now at t = {self._live.t:.9g} s; expected it to "
                "have ended. Call its stop(), then wait(). What is moved meanwhile are its inputs=….",
                block=self.wired.name,
            )

    def prepare(self) -> None:
        """Make what the first tick needs, before a clock runs."""
        self._engine.prepare(self._recorder)

    @property
    def is_open(self) -> bool:
        """Whether it has begun, and has not ended."""
        return bool(self._open)

    def _on_event(self, event: Occurrence) -> None:
        self._recorder.event(event)

    @accepts(path=kinds.text, block=kinds.one_of_class(Block, "a block"))
    def set_parameters(self, path: str, block: Block) -> None:
        """Let a block continue with the parameters of a variant of it, from this instant.

        The states stay as they are. A saved state does not hold parameters, and `diagram` stays as it was.

        Parameters
        ----------
        path : str
            Path of the block.
        block : Block
            The variant, such as ``simulation.diagram[path].replace(gain=2.0)``.

        Raises
        ------
        UnknownNameError
            If no block that is evaluated is there; a plant that is stepped takes no parameters in a run.
        ParameterError
            If the block's equations change, or how fast a source in continuous time changes: steps are limited by that.
        """
        self._refuse_second_driver()
        self._engine.set_parameters(path, block)

    def take_over(self, x: np.ndarray, of: FlatDiagram) -> None:
        """Put the blocks to the states of another diagram, by their names, and evaluate this tick again.

        States that only this diagram has, such as those of a delay, take the values that they settle at while the
        others are held; plants stay as they are, and so do the samples that were recorded.

        Parameters
        ----------
        x : ndarray, shape (n,)
            The states, laid out as ``of`` says.
        of : FlatDiagram
            The other diagram.

        Raises
        ------
        OptionError
            If the run has not begun, or has ended.
        SimulationError
            If a value is not finite there, or a guard fails.
        """
        self._refuse_second_driver()
        if not self._open:
            raise not_open_error(self._open, self.wired.name)
        self._engine.take_over(x, of)

    # --- its record --------------------------------------------------------------------------------------------------

    def _with_run(self, error: SimulationError) -> SimulationError:
        return error if error.run is not None else error.keep(self.run(final=False))

    @accepts(final=kinds.flag, last=kinds.flag)
    def run(self, *, final: bool = True, last: bool = False) -> Run:
        """Return what was recorded since the start, or since `restore`; afterwards recording begins again.

        Parameters
        ----------
        final : bool
            Whether the complete state at the end is kept with it, as ``run.final_state``, where that can be had.
        last : bool
            End the FMUs first, so that the run's messages name those that do not end well; nothing runs on.
        """
        self._refuse_second_driver()
        recorder = self._recorder
        state = self.save() if final and self.can_save else None
        if final and self._begun and not (self._engine.is_ahead or self._engine.position.is_broken_off):
            recorder.last(self.t, self._engine.workspace.log)
        texts = self._engine.take_texts()
        if last:
            self._loaded.close()
        facts = self._take_facts()
        written = {name: text.to_json() for name, text in texts.items()}
        t, data = recorder.finish(**facts, texts=written)
        run = Run(
            t=t,
            data=data,
            signals=self._recording.signals,
            diagram=self.diagram,
            **facts,
            texts=texts,
            events=recorder.events,
            residual=recorder.residual,
            final_state=state,
            recipe=self.recipe,
        )
        self._recording.stay_in_memory()  # the samples that come now do not replace it
        self._recorder, self._elapsed = self._new_recorder(), 0.0
        return run

    def record_instant(self) -> None:
        """Record the instant that it has reached: after `run`, as the first sample of what comes."""
        self._recorder.row(self.t, self._engine.workspace.log)

    def _take_facts(self, *more: str) -> dict[str, Any]:
        tier, messages = self._engine.take_tier(), (*self._messages, *self._recorder.describe_lost(), *more)
        return {"elapsed": self._elapsed, "tier": tier, "messages": messages, "stopped": self.stopped}

    @property
    def _messages(self) -> tuple[str, ...]:
        engine = self._engine
        coupled = () if engine.coupled is None else engine.coupled.messages
        of_plants = (m for p in engine.loaded.values() for m in p.messages)
        return (*self._notes, *engine.messages, *engine.workspace.messages, *coupled, *of_plants)

    @property
    def can_save(self) -> bool:
        """Whether the complete state can be saved: every FMU can turn its state into bytes, and none has ended it."""
        alive = bool(self._open or not self._engine.has_plants)
        return self._begun and alive and can_save(self._engine)

    def save(self) -> RunState:
        """Return the complete state at this tick, with that of the FMUs. See ``start`` of `simulate` for its bits.

        Raises
        ------
        FmuError
            If an FMU can't save its state, can't turn it into bytes, or has asked for the end of the run.
        OptionError
            If the run has not begun, or has ended and its FMUs are freed, or has ended between two ticks, or has failed
            or was interrupted.
        """
        self._refuse_second_driver()
        if not self._begun or (self._engine.has_plants and not self._open):
            raise not_open_error(self._open, self.wired.name)
        return save_state(self._engine)

    def restore(self, state: RunState) -> None:
        """Go back, or ahead, to a state; what was recorded before is forgotten, and the state is the first sample.

        Raises
        ------
        OptionError
            If it is no state of such a diagram: another base, other blocks or states. If the run has not begun, or has
            ended.
        """
        self._refuse_second_driver()
        if not self._open:
            raise not_open_error(self._open, self.wired.name)
        check_fits(state, self.flat, self.wired.name)
        restore_state(self._engine, state)
        self._engine.take_texts()
        self._elapsed, self._begun = 0.0, True
        if self._recorder.is_open:
            self._recorder.finish()
            self._recording.allow_overwriting()
        self._recorder = self._new_recorder()
        self._recorder.row(state.t, self._engine.workspace.log)


def simulate(diagram: WiredDiagram, duration: float, options: RunOptions, *, progress: ProgressOption = None) -> Run:
    """Run a diagram; see `Diagram.simulate`."""
    span: float | None = duration  # None is a user's slip, and no run without an end
    if span is None:
        ticks_in(span, Fraction(1), diagram.name)  # refused
    with ExitStack() as stack:
        with compiler_notes(progress, diagram.name):
            simulation = stack.enter_context(Simulation(diagram, options, duration=duration))
        if simulation.stopped is None:
            simulation.advance(duration, progress=progress)
        return simulation.run(last=True)

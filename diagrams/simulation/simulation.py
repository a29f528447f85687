"""Simulation: what happens in which order.

**Time.** Everything sampled happens at integer ticks of one common base, the greatest common divisor of all sample
times and offsets (and of ``step``, where one is given). Tick k is at k·numerator / denominator seconds, rounded once:
time never accumulates, and two rates never drift. A box with sample time T and offset d acts at d, d + T, …; between
its ticks its outputs are held, before its first one they are what it puts out at the start. Visited are the ticks at
which a box acts, or every tick where there is an FMU, a ``step``, or a solver of fixed step.

**At one instant**, in this order:

1. The outputs of the FMUs are those at the end of their last step: a co-simulation FMU has no feedthrough between
   communication points (FMI 3.0, Step Mode). The continuous states are what the solver arrived at, from the left.
2. Discontinuities of sources in time (a step, an edge of a pulse) take effect: a source's value at t is its value from
   the right.
3. Indicators of events are looked at. Those that have changed their domain fire, all together: each jump sees the
   instant before all of them. Then they are looked at again, until none fires. The same happens between ticks wherever
   the solver finds a change. A box that is enabled or triggered in continuous time is such an event.
4. If the instant is a tick: all blocks are evaluated once, each port after what it depends on (`evaluation_order`). A
   box acts if its clock ticks and whatever enables or triggers it says so. The next states of sampled blocks, and what
   is held, take effect. Then point 3 is gone through again, for what the boxes have changed.
5. What is to be recorded is evaluated and recorded: the values from the right, after all events.
6. A stop condition that is true ends the run; nothing steps beyond.
7. The continuous states go on to the next tick, with everything sampled and the FMUs' outputs held; then the inputs of
   the FMUs, held since this tick, are set, and every FMU steps to the next one.

**Between ticks** the solver integrates all continuous blocks as one system. It lands on every tick at which something
acts, on every discontinuity that a source announces (`Block.next_instant`), where it takes values from the left, and on
every event. Other samples come from its dense output, or, where the relative tolerance is below 1e-9, it lands on them,
too. Memory of blocks (a projection's last foot point) and the last
solution of an algebraic loop are renewed at accepted steps only.

**At the start** initial states are computed in an order of their own (a block may need its inputs for it), FMUs and
blocks are evaluated until their values agree, and indicators are taken as they are: nothing fires.

**Order of definition and hashing never matter**: blocks, states, events and boxes are taken by path.

If a value is not finite or a guard fails, the instant is evaluated again block by block to name the first one that is
concerned; the run until then is kept in the error.
"""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from fractions import Fraction
from typing import Any

from ...blocks.core.errors import SimulationError
from ..flat.evaluate import TRUE
from ..flat.flat_diagram import FlatDiagram
from ..flat.wired_diagram import WiredDiagram
from ..results.operating_point import OperatingPoint
from ..results.recorder import Recorder
from ..results.recording import Recording
from ..results.run import Run
from ..results.saved_state import RunState, check_fits, layout_of, not_open_error
from ..results.stored import Occurrence, Stopped
from ..solvers.base import solver_name
from ..wiring.structure import join
from .continuous import Continuous, check_solver
from .diagnosis import failure
from .duration import default_step, ticks_in
from .initialize import initialize
from .plants import bind, has_plants, loaded
from .progress import progress_bar
from .run_options import RunOptions
from .start_at_point import place, placed
from .ticks import CHUNK, run_ticks
from .workspace import Machine


class Simulation:
    """A run in the making: made by `Diagram.simulation`, used in a ``with`` statement.

    ``advance`` goes on, ``save`` returns the complete state, ``restore`` goes back to one, ``run`` is what was
    recorded.

    Examples
    --------
    >>> from loopwright.blocks import Constant, Integrator
    >>> from loopwright.diagrams import Diagram
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

    def __init__(
        self,
        diagram: WiredDiagram,
        options: RunOptions | None = None,
        *,
        duration: float | None = None,
    ):
        options = options or RunOptions()
        start, step = options.start, options.step
        self._point = start if isinstance(start, OperatingPoint) else None
        if self._point is not None:
            diagram = placed(diagram, self._point)
            if not diagram.is_continuous and not diagram.has_clock:
                step = step or self._point.base
        self.diagram = diagram
        saved = None if isinstance(start, OperatingPoint) else start
        base = default_step(diagram, step, duration, options.solver, saved)
        self.recipe = options.with_step(base).recipe
        self.flat: FlatDiagram = diagram.flatten(base) if base is step else diagram.flattened(base)
        if saved is not None:
            check_fits(saved, self.flat, diagram.name)
        self._recording = Recording(
            self.flat, diagram.name, options.record, options.every, options.states, options.to, options.overwrite
        )
        self._stack = ExitStack()
        self._start_state = saved
        self._machine = Machine(self.flat)
        self._plants: list[tuple[str, Any]] = []
        self._every_tick = base is not None or has_plants(self.flat)
        self._last: int | None = None
        if duration is not None:
            self._last = ticks_in(duration, self.flat.base, diagram.name)
            first = 0 if start is None else start.tick
            self._last += first
            self._recording.check_memory(self._last - first, every_tick=self._every_tick)
        self._continuous: Continuous | None = None
        if self.flat.hybrid:
            self._continuous = Continuous(
                self._machine,
                diagram.name,
                options.solver,
                options.rtol,
                options.atol,
                options.max_step,
                self._on_event,
            )
            self._continuous.is_stopped = self._is_stopped
            self._every_tick |= self._continuous.fixed
        elif options.solver != "auto":
            solver_name(options.solver)  # an unknown one is an error here, too
        self._stops = self._stop_ports()
        self._tick, self._count, self._elapsed, self._begun = 0, 0, 0.0, False
        self._stopped: Stopped | None = None
        self._open: bool | None = None  # until it begins; False once it has ended
        self._recorder = self._new_recorder()

    # --- what belongs to it ------------------------------------------------------------------------------------------

    def _new_recorder(self) -> Recorder:
        every_tick = self._every_tick or not self.flat.distinct
        return self._recording.begin(None if self._last is None or not every_tick else self._last + 1)

    def _stop_ports(self) -> list[tuple[int, str]]:
        """Return the entries of the log that end the run, with the blocks that they belong to."""
        found = []
        for path in sorted(self.flat.checked.traced):
            port = self.flat.table.blocks[path].stops
            if port is not None:
                found.append((self.flat.log.slices[join(path, port)].start, path))
        return found

    def __enter__(self) -> Simulation:
        if self._open is not None:
            raise not_open_error(self._open, self.diagram.name)
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
        since = 0.0 if self._point is None else self._point.t
        try:
            for path, plant in loaded(self.flat, self._stack, since):
                self._plants.append((path, plant))
        except SimulationError as error:
            self._attach(error)
            raise

    def _finish(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        """End a run on disk that `run` was not asked for."""
        if self._recorder.is_open:
            cut = [] if error is None else [f"This run was cut off at t = {self.t:g} s: {kind.__name__}: {error}"]
            self._recorder.finish(elapsed=self._elapsed, messages=(*self._messages, *cut), stopped=self._stopped)

    def _begin(self) -> None:
        machine = self._machine
        try:
            bind(machine, self._plants)
            delays = None if self._continuous is None else self._continuous.delays
            initialize(machine, self._plants, delays)
            for _, plant in self._plants:
                plant.begin()
            if self._start_state is not None:
                self.restore(self._start_state)
                return
            first = 0 if self._point is None else place(self, self._point)
            if self._continuous is not None:
                self._continuous.begin()
            self._begun = True
            self._at_tick(first)
        except SimulationError as error:
            culprit = self._who(error)
            culprit.at(t=self.t)
            self._attach(culprit)
            raise culprit from culprit.__cause__

    def time_of(self, k: int) -> float:
        """Return the time of tick ``k`` in s."""
        return k * self.flat.base.numerator / self.flat.base.denominator

    @property
    def t(self) -> float:
        """Time that the run has reached in s."""
        return self.time_of(self._tick) if self._stopped is None else self._stopped.t

    @property
    def stopped(self) -> Stopped | None:
        """The stop condition that has ended the run."""
        return self._stopped

    def advance(self, duration: float, *, progress: Any = None) -> None:
        """Go on for a duration in s, a multiple of the step between ticks.

        Raises
        ------
        SimulationError
            See `Diagram.simulate`; ``error.run`` holds what was recorded until then.
        OptionError
            A duration that is not positive, or no multiple of the step; a run that has not begun, or has ended.
        """
        if not self._open:
            raise not_open_error(self._open, self.diagram.name)
        last = self._tick + ticks_in(duration, self.flat.base, self.diagram.name)
        started = time.perf_counter()

        def tell(t: float) -> None:
            self._recorder.flush()
            if progress is not None:
                progress(t)

        try:
            if self._stopped is None:
                self._go(last, tell)
        except SimulationError as error:
            self._elapsed += time.perf_counter() - started
            self._attach(error)
            raise
        except KeyboardInterrupt as interrupt:
            self._elapsed += time.perf_counter() - started
            interrupt.run = self.run(final=False)  # type: ignore[attr-defined]
            raise
        self._elapsed += time.perf_counter() - started

    def _go(self, last: int, progress: Any) -> None:
        try:
            if self._continuous is not None:
                self._go_hybrid(last, progress)
            else:
                run_ticks(
                    self._machine,
                    [plant for _, plant in self._plants],
                    self._tick,
                    last,
                    every=self._every_tick,
                    row=self._recorder.row,
                    arrived=self._arrived,
                    progress=progress,
                )
        except SimulationError as error:
            culprit = self._who(error)
            raise culprit from culprit.__cause__

    def _go_hybrid(self, last: int, progress: Any) -> None:
        """Run ticks up to ``last`` with a solver between them."""
        continuous = self._continuous
        assert continuous is not None
        clocks, count, width = self.flat.distinct, 0, float(self.flat.base)
        while self._tick < last:
            k = self._tick
            sampled = self._every_tick or not clocks
            every = continuous.fixed or self._plants or (continuous.lands and sampled)
            following = k + 1 if every else min([*(c.after(k) for c in clocks), last])
            between = range(k + 1, following) if sampled else range(0)
            now = self.time_of(k)

            def sample(t: float, progress: Any = progress) -> bool:
                self._recorder.row(t, self._machine.log)
                self._count += 1
                if self._count % CHUNK == 0:
                    progress(t)
                return self._is_stopped()

            ended = continuous.advance(now, self.time_of(following), map(self.time_of, between), sample)
            if ended is not None:
                self._note_stop(ended)
                return
            for _, plant in self._plants:
                plant.step(now, width)
            self._at_tick(following)
            if self._stopped is not None:
                return
            count += 1
            if count % 16 == 0:
                progress(self.t)
        progress(self.t)

    def _at_tick(self, k: int) -> None:
        """Evaluate and record tick ``k``: at the start, and in a hybrid run."""
        machine, continuous = self._machine, self._continuous
        machine.here.t[0] = now = self.time_of(k)
        acting = self.flat.acting(k)
        if continuous is not None:
            continuous.at(now)
            if k > 0 and acting:
                continuous.settle(now)  # what changes by itself at this instant, boxes see changed
        machine.tick(acting)()
        if not machine.ok[0]:
            raise failure(machine, acting).at(t=now)
        machine.here.x[:] = machine.x_next
        if continuous is not None:
            continuous.at(now)
            if (acting or self._plants) and continuous.delays is not None:
                continuous.delays.edge(now)  # what is held has jumped
            before = machine.log[self.flat.log.total :].copy()
            if continuous.settle(now):
                taken = self.flat.taken_at(acting)
                machine.log[self.flat.log.total :][taken] = before[taken]
        self._recorder.row(now, machine.log)
        self._tick = k
        self._ended()

    def _on_event(self, event: Occurrence) -> None:
        self._recorder.event(event)

    def _arrived(self, k: int) -> bool:
        """Take note of a tick that has been recorded; return whether it ends the run."""
        self._tick = k
        return bool(self._stops) and self._ended()

    def _is_stopped(self) -> bool:
        return any(self._machine.log[i] > TRUE for i, _ in self._stops)

    def _ended(self) -> bool:
        """Whether a stop condition is true at this tick, which then ends the run."""
        if self._stopped is None and self._is_stopped():
            self._note_stop(self.t)
        return self._stopped is not None

    def _note_stop(self, t: float) -> None:
        path = next(path for i, path in self._stops if self._machine.log[i] > TRUE)
        self._stopped = Stopped(t, path)

    # --- what it has made --------------------------------------------------------------------------------------------

    def _who(self, error: SimulationError) -> SimulationError:
        for path, plant in self._plants:
            if plant.failed:
                error.block = path
        return check_solver(error, self._machine, self._continuous)

    def _attach(self, error: SimulationError) -> None:
        if error.run is None:
            error.run = self.run(final=False)

    def run(self, *, final: bool = True) -> Run:
        """Return what was recorded since the start, or since `restore`; afterwards recording begins anew.

        Parameters
        ----------
        final : bool
            Whether the complete state at the end is kept with it, as ``run.final_state``, where that can be had.
        """
        recorder, machine = self._recorder, self._machine
        state = self.save() if final and self.can_save else None
        if final and self._begun:
            recorder.last(self.t if self._stopped is None else self._stopped.t, machine.log)
        messages = self._messages
        t, data = recorder.finish(elapsed=self._elapsed, messages=messages, stopped=self._stopped)
        run = Run(
            t=t,
            data=data,
            layout=self.flat.log,
            wires=dict(self.flat.table.names),
            units=self._recording.units,
            diagram=self.diagram,
            elapsed=self._elapsed,
            messages=messages,
            events=recorder.events,
            stopped=self._stopped,
            residual=recorder.residual,
            columns=recorder.columns,
            has_states=self._recording.states,
            final_state=state,
            recipe=self.recipe,
        )
        self._recording.to = None  # what comes now does not replace it
        self._recorder, self._elapsed = self._new_recorder(), 0.0
        return run

    @property
    def _messages(self) -> tuple[str, ...]:
        return tuple(m for _, plant in self._plants for m in plant.messages)

    @property
    def can_save(self) -> bool:
        """Whether the complete state can be saved: every FMU can turn its state into bytes."""
        begun = self._begun and (self._open or not self._plants)
        return begun and all(plant.can_serialize and not plant.failed for _, plant in self._plants)

    def save(self) -> RunState:
        """Return the complete state at this tick, that of the FMUs included.

        Raises
        ------
        FmuError
            If an FMU can't save its state, or can't turn it into bytes.
        OptionError
            If the run has not begun, or has ended and its FMUs are freed.
        """
        if not self._begun or (self._plants and not self._open):
            raise not_open_error(self._open, self.diagram.name)
        machine = self._machine
        return RunState(
            t=self.t if self._stopped is None else self._stopped.t,
            tick=self._tick,
            base=self.flat.base,
            diagram=self.diagram.name,
            x=machine.here.x.copy(),
            w=machine.here.w.copy(),
            z=machine.z.copy(),
            log=machine.log.copy(),
            layout=layout_of(self.flat),
            continuous=None if self._continuous is None else self._continuous.save(),
            fmus={path: plant.serialize() for path, plant in self._plants},
            stopped=self._stopped,
        )

    def restore(self, state: RunState) -> None:
        """Go back, or ahead, to a state; what was recorded before is forgotten, and the state is the first sample.

        Raises
        ------
        OptionError
            If it is no state of such a diagram: another base, other blocks or states. If the run has not begun, or has
            ended.
        """
        if not self._open:
            raise not_open_error(self._open, self.diagram.name)
        check_fits(state, self.flat, self.diagram.name)
        machine = self._machine
        for path, plant in self._plants:
            plant.restore(plant.deserialize(state.fmus[path]))
        machine.here.t[0] = state.t
        machine.here.x[:], machine.here.w[:], machine.z[:], machine.log[:] = state.x, state.w, state.z, state.log
        if self._continuous is not None and state.continuous is not None:
            self._continuous.restore(state.continuous)
        self._tick, self._stopped, self._elapsed, self._begun = state.tick, state.stopped, 0.0, True
        if self._recorder.is_open:
            self._recorder.finish()
            self._recording.overwrite = True
        self._recorder = self._new_recorder()
        self._recorder.row(state.t, machine.log)


def simulate(diagram: WiredDiagram, duration: float, options: RunOptions, *, progress: bool | None = None) -> Run:
    """Run a diagram; see `Diagram.simulate`."""
    span: float | None = duration  # None is a user's slip, and no run without an end
    if span is None:
        ticks_in(span, Fraction(1), diagram.name)  # refused
    with Simulation(diagram, options, duration=duration) as simulation:
        first = simulation.t
        with progress_bar(diagram.name, first, first + float(duration), progress) as show:
            if simulation.stopped is None:
                simulation.advance(duration, progress=show)
        return simulation.run()

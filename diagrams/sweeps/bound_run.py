"""Runs of one diagram with many numbers, bound once: FMUs are reset, states and parameters are set in place."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ...fmus.calls import FmuInstance
from ..coupling import note_loops, note_steps
from ..flat import EVERY, FlatDiagram, WiredDiagram, renumber
from ..results import Occurrence, Recorder, Recording, Run, Stopped
from ..simulation import Engine, RunOptions, TracedStartValues, default_step, note_held_inputs, refuse_rest, ticks_in
from .variation import Numbers

LOADING = threading.Lock()
"""Held while FMUs are loaded, and begun for the first time: loading changes what the whole process shares."""

Progress = Callable[[float], None]


class BoundRun:
    """Runs of a diagram over one duration in s, one after the other, each with its own numbers.

    It is used in a ``with`` statement, which loads the FMUs and frees them. Runs begin at t = 0 and stay in memory.
    """

    def __init__(self, diagram: WiredDiagram, duration: float, options: RunOptions):
        self._name = diagram.name
        run, fused = options.apply_fuse(diagram)
        base = default_step(run, options.step, duration, options.solver)
        self.flat: FlatDiagram = run.flatten(base) if base is options.step else run.flattened(base)
        self.count, rest = ticks_in(duration, self.flat.base, diagram.name)
        if rest:
            refuse_rest(self.flat, self.count, duration, diagram.name)
        self.end = float(self.count * self.flat.base + rest) if rest else None  # in s, where it is between two ticks
        record, every, states = options.record, options.every, options.states
        self._recording = Recording(self.flat, diagram.name, diagram.blocks, record, every, states, None, False)
        every_tick = base is not None or EVERY in self.flat.visited
        self._recording.check_memory(self.count, every_tick=every_tick)
        self.engine = Engine(self.flat, diagram.name, options, every_tick=every_tick, on_event=self._note)
        rows = self.count + 2 if self.engine.every_tick else None
        self.recorder: Recorder = self._recording.begin(rows)
        fine = note_steps(self.flat, step=base)
        self._notes: tuple[str, ...] = (
            *fused,
            *fine,
            *note_loops(self.flat, self.engine.coupling),
            *note_held_inputs(self.flat),
        )
        self._has_begun = False
        self._messages_before: dict[str, int] = {}
        self._start = TracedStartValues(self.engine.workspace) if TracedStartValues.fits(self.flat) else None
        self._stack = ExitStack()

    def __enter__(self) -> BoundRun:
        with LOADING:
            try:
                self.engine.load(self._stack, 0.0)
                self._notes += self.take_messages()
                self._forget_messages()
                self.engine.initialize()
                self.take_messages()  # of numbers that are no sample's
            except BaseException:
                self._stack.close()
                raise
        return self

    def __exit__(self, *error: Any) -> None:
        with LOADING:
            self._stack.close()

    @property
    def obstacle(self) -> str:
        """Why its runs can't follow each other, as a clause; empty if each leaves nothing behind for the next one."""
        engine, flat = self.engine, self.flat
        if opaque := [path for path in flat.checked.traced if flat.table.blocks[path].opaque]:
            return f"{opaque[0]} is evaluated by Python, and may keep something of a run"
        if engine.can_begin_again:
            return ""
        if engine.exchanged:
            return f"{next(iter(engine.exchanged.blocks))} is an FMU in model exchange, loaded for each"
        if engine.coupled is not None:
            return "their FMUs are coupled by another scheme than 'jacobi'"
        for path, plant in engine.plants.items():
            if not (isinstance(plant, FmuInstance) and plant.native is not None):
                return f"{path} takes more calls than one for a step, and is loaded for each of them"
        return (
            f"there is no generated code of what is between their ticks ({' '.join(engine.messages) or 'compile=True'})"
        )

    def fits(self, numbers: Numbers) -> bool:
        """Whether a run with the numbers of a sample can follow: the solver has the same tolerances and step limits."""
        continuous = self.engine.continuous
        return continuous is None or continuous.fits(self.flat.table.blocks, numbers.blocks)

    @property
    def is_compiled(self) -> bool:
        """Whether it goes by generated code."""
        return self.engine.is_compiled

    @property
    def is_broken(self) -> bool:
        """Whether an FMU of it has failed for good, so that it can't be reset."""
        return any(isinstance(p, FmuInstance) and p.fatal for p in self.engine.plants.values())

    def run(self, numbers: Numbers, progress: Progress) -> Run:
        """Run with the numbers of a sample; an exception that ``progress`` raises ends the run."""
        engine, recorder, started = self.engine, self.recorder, perf_counter()
        recorder.begin_again()
        try:
            self.begin(numbers)
            engine.take_first_tick(None, recorder)
            if engine.position.stopped is None:
                if self.count:
                    engine.go(self.count, recorder, progress, ends_there=self.end is None)
                if self.end is not None and engine.position.stopped is None:
                    engine.end_between_ticks(self.end, recorder, progress)
        except SimulationError as error:
            culprit = engine.blame(error).at(t=engine.position.t)
            raise culprit.keep(self._take_record(started)) from culprit.__cause__
        except BaseException:
            recorder.finish()
            raise
        if not engine.is_ahead:
            recorder.last(engine.position.t, engine.workspace.log)
        return self._take_record(started)

    def begin(self, numbers: Numbers) -> None:
        """Go back to t = 0 with a sample's numbers, which the engine's workspace then holds, and begin its plants."""
        with nullcontext() if self._has_begun else LOADING:  # the first start traces functions
            self._forget_messages()
            for path, plant in self.engine.plants.items():
                assert isinstance(plant, FmuInstance)
                plant.start_again(numbers.starts.get(path, {}))
            find_start = None if self._start is None else self._start.set
            self.engine.begin_again(renumber(self.flat, numbers.blocks), find_start)
            self._has_begun = True

    def _take_record(self, started: float) -> Run:
        lost = self.recorder.describe_lost()
        t, data = self.recorder.finish()
        stopped, residual = self.engine.position.stopped, self.recorder.residual
        return self.make_run(t, data, stopped, started, (*self.take_messages(), *lost), residual)

    def make_run(
        self,
        t: np.ndarray,
        data: np.ndarray,
        stopped: Stopped | None,
        started: float,
        messages: Sequence[str],
        residual: np.ndarray | None,
    ) -> Run:
        """Return a run from samples as the recorder keeps them; ``started`` is the clock's reading at its start."""
        return Run(
            t=t,
            data=data,
            signals=self._recording.signals,
            diagram=None,
            elapsed=perf_counter() - started,
            tier=self.engine.take_tier(),
            events=self.recorder.events,
            residual=residual,
            messages=(*self._notes, *self.engine.messages, *messages),
            stopped=stopped,
            diagram_name=self._name,
        )

    def _note(self, event: Occurrence) -> None:  # the engine is made before its recorder
        self.recorder.event(event)

    def _forget_messages(self) -> None:
        """Let FMUs forget the messages of earlier runs: a run's messages, and its error, quote its own."""
        for path, plant in self.engine.plants.items():
            if isinstance(plant, FmuInstance):
                plant.log.begin_again()
                self._messages_before[path] = len(plant.messages)

    def take_messages(self) -> tuple[str, ...]:
        """Return the messages of the start and of FMUs since the last run."""
        found = [*self.engine.workspace.messages]
        for path, plant in self.engine.plants.items():
            texts = plant.messages
            found += texts[self._messages_before.get(path, 0) :]
            self._messages_before[path] = len(texts)
        return tuple(found)

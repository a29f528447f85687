"""A run that keeps pace with the clock, with parameters that are moved by hand meanwhile.

Time is cut into frames of whole ticks. A frame is due when the clock has come to its beginning; then the inputs are
read, and the run continues to the end of the frame at once. So a value that is moved acts within a frame, and the
numbers are those of a run that gets the same parameters at the same ticks, whatever the clock does.
"""

from __future__ import annotations

import signal
import threading
import time
import warnings
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any, Protocol

import numpy as np

from ...blocks.core import (
    Block,
    OptionError,
    Sheet,
    ShownAsTable,
    SimulationError,
    brief,
    count_of,
    explain_calls,
)
from ..flat import FlatDiagram, WiredDiagram
from ..results import Run, Stopped
from .controls import Controls
from .run_options import ticks_in
from .view import SimulationView

FRAME = 1 / 60
"""Seconds of the clock in a frame, about."""
_LONGEST_SLEEP = 0.05
"""Seconds after which a run that waits for the clock looks whether it is to stop."""
_ENDS = {"duration": "its duration has passed", "stop": "it was stopped", "Ctrl-C": "it was stopped by Ctrl-C"}


class Advancing(Protocol):
    """What a live run needs of a `Simulation`, which see."""

    wired: WiredDiagram
    flat: FlatDiagram

    def __enter__(self) -> Any: ...

    def __exit__(self, *error: Any) -> None: ...

    @property
    def is_open(self) -> bool:
        """Whether it has begun, and has not ended."""

    @property
    def t(self) -> float:
        """Time that it has reached in s."""

    @property
    def stopped(self) -> Stopped | None:
        """What has ended it."""

    @property
    def view(self) -> SimulationView:
        """The instant that it has reached."""

    def prepare(self) -> None:
        """Make what the first tick needs."""

    def advance(self, duration: float) -> None:
        """Continue for a duration in s."""

    def set_parameters(self, path: str, block: Block) -> None:
        """Let a block continue with other parameters."""

    def run(self, *, final: bool = True) -> Run:
        """Return what was recorded, with the complete state at its end or without it."""


@dataclass(frozen=True)
class Pace:
    """How a live run keeps pace."""

    speed: float = 1.0  # simulated seconds in a second of the clock
    frame: float = FRAME  # seconds of the clock
    catch_up: float = 0.25  # seconds of the clock that are caught up after a delay; of a longer one all are given up
    clock: Callable[[], float] = time.perf_counter
    sleep: Callable[[float], object] = time.sleep


@explain_calls
class LiveRun(ShownAsTable):
    """A run that keeps pace with the clock, or has: made by `Simulation.run_realtime`.

    Attributes
    ----------
    run : Run
        What was recorded. It is there once the run has ended, by an error too.
    t : float
        Simulated time in s that has been reached.
    is_running : bool
        Whether it still runs.
    ended_by : str
        Why it has ended: "duration", "stop", "Ctrl-C", "error", or the path of the stop condition or FMU that has
        ended the run; empty while it runs.
    frames, overruns : int
        Number of frames, and of those that weren't done when the next one was due.
    lateness : ndarray, shape (frames,)
        Seconds by which each frame began after it was due.
    slipped : float
        Seconds of the clock that were given up, because the run was more than ``catch_up`` behind.
    load : float
        Part of the time of the frames that was spent in computing: above 1 the machine is too slow.
    changes : list of tuple
        What was moved: time in s, parameter, and value, which acts after the samples of that time.
    message : str
        How far the run was behind, and what to do; empty if it never was.

    Methods
    -------
    stop()
        End the run after the frame that runs.
    wait(timeout=None)
        Wait for its end.
    """

    def __init__(self, name: str, pace: Pace):
        self._name, self._pace = name, pace
        self._late, self._busy, self._due_in_all = array("d"), 0.0, 0.0
        self._in_functions = 0.0  # seconds of the clock in functions of the user's
        self._thread: threading.Thread | None = None
        self._worst, self._longest = 0.0, 0.0
        self._stop, self._done = threading.Event(), threading.Event()
        self._is_stopped: Callable[[], object] = bool
        self._run: Run | None = None
        self._error: BaseException | None = None
        self.t, self.ended_by = 0.0, ""
        self.overruns, self.slipped = 0, 0.0
        self.changes: list[tuple[float, str, object]] = []
        self._simulated = 0.0

    # --- what is read ------------------------------------------------------------------------------------------------

    @property
    def is_running(self) -> bool:
        """Whether it still runs."""
        return not self._done.is_set()

    @property
    def is_running_elsewhere(self) -> bool:
        """Whether another thread runs it."""
        return self.is_running and self._thread is not None and self._thread is not threading.current_thread()

    @property
    def run(self) -> Run:
        """What was recorded.

        Raises
        ------
        OptionError
            If it still runs.
        """
        if self._run is None:
            if self._error is not None:  # before anything was recorded
                raise self._error
            raise OptionError(
                f"found a run that has come to t = {self.t:g} s; expected one that has ended. Call stop(), then "
                "wait().",
                block=self._name,
                port="run",
            )
        return self._run

    @property
    def frames(self) -> int:
        """Number of frames that were run."""
        return len(self._late)

    @property
    def lateness(self) -> np.ndarray:
        """Seconds by which each frame began after it was due."""
        return np.array(self._late)

    @property
    def load(self) -> float:
        """Part of the time of the frames that was spent in computing."""
        return self._busy / self._due_in_all if self._due_in_all else 0.0

    @property
    def message(self) -> str:
        """How far the run was behind, and what to do; empty if it never was."""
        if not self.overruns:
            return ""
        lost = f", and gave up {self.slipped:.3g} s of the clock" if self.slipped else ""
        return (
            f"The live run of {self._name!r} was {1e3 * self._worst:.3g} ms behind the clock at most{lost}: "
            f"{self.overruns} of {count_of(self.frames, 'frame')} took longer than they last. {self._advise()}"
        )

    def _advise(self) -> str:
        if self.load < 0.7:
            return (
                f"Computing takes {self.load:.0%} of the time, so that something else held the machine up: close it, "
                f"or take a longer frame than {self._pace.frame:.3g} s."
            )
        if self._in_functions > 0.5 * self._busy:
            return (
                f"Functions of inputs= and on_frame= take {self._in_functions / self._due_in_all:.0%} of the time, and "
                f"computing {(self._busy - self._in_functions) / self._due_in_all:.0%}: let them do less, or take a "
                f"longer frame than {self._pace.frame:.3g} s."
            )
        slower = float(f"{0.7 * self._simulated / self._busy:.1g}")
        return (
            f"Computing takes {self.load:.0%} of the time: run it with speed={slower:g}, a larger step, or record=[…] "
            "with fewer signals."
        )

    def __repr__(self) -> str:
        state = "runs" if self.is_running else "failed" if self._error is not None else "ended"
        late = f"{count_of(self.overruns, 'overrun')} in {count_of(self.frames, 'frame')}"
        then = ".stop(), .wait()" if self.is_running else ".run, .lateness"
        return brief(f"live run of {self._name!r}", f"{state} at t = {self.t:.9g} s", late, then=then)

    def _sheet(self) -> Sheet:
        late = 1e3 * self.lateness
        end = "it runs" if self.is_running else _ENDS.get(self.ended_by, self.ended_by)
        jitter = ""
        if late.size:
            middle, most = np.percentile(late, [50, 99])
            jitter = f"median {middle:.3g} ms, 99 of 100 within {most:.3g} ms, all within {late.max():.3g} ms"
        longest = f", the longest by {1e3 * self._longest:.3g} ms" if self.overruns else ""
        facts = (
            ("time", f"{self.t:.9g} s at speed {self._pace.speed:g}; {end}"),
            ("frames", f"{self.frames}, of {1e3 * self._pace.frame:.3g} ms of the clock"),
            ("began late", jitter),
            ("overruns", f"{self.overruns}{longest}"),
            ("given up", f"{self.slipped:.3g} s of the clock" if self.slipped else ""),
            ("load", f"{self.load:.1%}"),
            ("moved", count_of(len(self.changes), "change") if self.changes else ""),
        )
        failure = () if self._error is None else (str(self._error),)
        return Sheet(f"Live run of {self._name!r}", facts, notes=(*((self.message,) if self.message else ()), *failure))

    # --- its end -----------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """End the run after the frame that runs; it may be called from another thread."""
        self._stop.set()

    def wait(self, timeout: float | None = None) -> LiveRun:
        """Wait for the end of a run in the background, and return it.

        Parameters
        ----------
        timeout : float, optional
            Seconds to wait at most.

        Raises
        ------
        SimulationError
            What has ended the run; ``error.run`` holds what was recorded until then.
        """
        self._done.wait(timeout)
        if self._error is not None:
            raise self._error
        return self

    # --- how it goes -------------------------------------------------------------------------------------------------

    def drive(
        self,
        simulation: Advancing,
        duration: float | None,
        controls: Controls,
        on_frame: Callable[[SimulationView], object] | None,
        stop: Callable[[], object] | None,
        *,
        background: bool,
    ) -> None:
        """Let a simulation run to its end; it is opened and closed here if it has not begun."""
        self._is_stopped = stop or self._is_stopped

        def drive() -> None:
            try:
                with nullcontext() if simulation.is_open else simulation:
                    try:
                        self.ended_by = self._go(simulation, duration, controls, on_frame)
                    except SimulationError as error:
                        self._run = error.run if error.run is not None else simulation.run(final=False)
                        error.keep(self._run)
                        raise
                    run = simulation.run()
                    self._run = replace(run, messages=(*run.messages, self.message)) if self.message else run
            except BaseException as error:
                self.ended_by, self._error = "error", error
                if not background:
                    raise
            finally:
                self._done.set()

        if background:
            self._thread = threading.Thread(target=drive, name=f"live run of {self._name}", daemon=True)
            self._thread.start()
        else:
            drive()

    def _go(
        self,
        simulation: Advancing,
        duration: float | None,
        controls: Controls,
        on_frame: Callable[[SimulationView], object] | None,
    ) -> str:
        """Run frame by frame; return what has ended the run."""
        pace, base, self.t = self._pace, float(simulation.flat.base), simulation.t
        in_a_frame = max(1, round(pace.frame * pace.speed / base))
        left, rest = (None, 0.0) if duration is None else self._ticks_of(simulation, duration)
        simulation.prepare()
        done, origin = 0, pace.clock()
        with _interrupts() as interrupted:
            while simulation.stopped is None and (left is None or left > 0 or rest):
                # Frames are due by counting from the start: a sum of pauses would drift.
                due = origin + self.slipped + done * base / pace.speed
                ended = self._await(due, interrupted)
                if ended:
                    return ended
                began = pace.clock()
                late = max(0.0, began - due)
                self._late.append(late)
                # A small delay is caught up; after a long one (a laptop that slept) the clock is moved instead.
                if late > pace.catch_up:
                    self.slipped += late
                    due += late
                self._worst = max(self._worst, late)
                ticks = in_a_frame if left is None else min(in_a_frame, left)
                span = ticks * base if ticks else rest
                changes, blocks = controls.read(simulation.t)
                self.changes += changes
                for path, block in blocks.items():
                    simulation.set_parameters(path, block)
                moved = pace.clock()
                simulation.advance(span)
                self.t, computed = simulation.t, pace.clock()
                if on_frame is not None:
                    _call("on_frame", lambda: on_frame(simulation.view), self.t, self._name)
                self._in_functions += moved - began + pace.clock() - computed
                self._account(began, due, span)
                if ticks:
                    done += ticks
                    left = None if left is None else left - ticks
                else:
                    rest = 0.0
            if simulation.stopped is not None:
                return simulation.stopped.block
            if duration is None:
                return "stop"
            return self._await(origin + self.slipped + duration / pace.speed, interrupted) or "duration"

    def _account(self, began: float, due: float, span: float) -> None:
        """Note what a frame took that was due at a time of the clock; report the first one that is too late."""
        pace, ended = self._pace, self._pace.clock()
        lasts = span / pace.speed
        self._busy, self._due_in_all = self._busy + ended - began, self._due_in_all + lasts
        self._simulated += span
        over = ended - (due + lasts)
        if over > 0.0:
            self.overruns += 1
            self._longest, self._worst = max(self._longest, over), max(self._worst, over)
            if over > pace.catch_up and not self._reported:
                self._reported = True
                warnings.warn(self.message, RuntimeWarning, stacklevel=6)

    _reported = False

    def _await(self, due: float, interrupted: threading.Event) -> str:
        """Wait until a time of the clock; return what ends the run meanwhile."""
        while True:
            if interrupted.is_set():
                return "Ctrl-C"
            if self._stop.is_set() or _call("stop", self._is_stopped, self.t, self._name):
                return "stop"
            wait = due - self._pace.clock()
            if wait <= 0.0:
                return ""
            self._pace.sleep(min(wait, _LONGEST_SLEEP))

    @staticmethod
    def _ticks_of(simulation: Advancing, duration: float) -> tuple[int, float]:
        count, rest = ticks_in(duration, simulation.flat.base, simulation.wired.name)
        return int(count), float(rest)


def _call(option: str, function: Callable[[], object], t: float, name: str) -> object:
    """Call a function of the user's; what it raises ends the run as an error of it, with what was recorded."""
    try:
        return function()
    except Exception as error:
        raise SimulationError(
            f"the function given as {option} failed: {type(error).__name__}: {error}. Correct it; error.run has what "
            "was recorded.",
            block=name,
            port=option,
            t=t,
        ) from error


@contextmanager
def _interrupts() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets, so that a run ends after a frame; a second one interrupts as ever."""
    came = threading.Event()
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield came
        return

    def note(number: int, frame: FrameType | None) -> None:
        if came.is_set():
            signal.default_int_handler(number, frame)
        came.set()

    signal.signal(signal.SIGINT, note)
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)

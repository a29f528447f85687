"""The progress of a run, drawn on a terminal or in a notebook, and its interruption."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from ...blocks.core import check_argument, kinds
from ...fmus.build_notes import hear_builds
from ..results import Run

ProgressOption = bool | Callable[[Any], object] | None
"""Option of whatever may take long: shown or not, a function that is called instead, or None: shown on a terminal."""
LATE = 2.0
"""Time in s that some work takes before its progress is shown."""


def _is_shown(show: ProgressOption, name: str) -> bool:
    """Whether progress is shown: where it is asked for; by default on a terminal and in a notebook."""
    if show is not None:
        check_argument(show, kinds.progress, "progress", name)
        return not callable(show) and bool(show)
    return sys.stderr.isatty() or _in_notebook()


def _in_notebook() -> bool:
    """Whether a notebook's kernel runs this: it has a display, and no terminal."""
    kernel = sys.modules.get("ipykernel.zmqshell")
    return kernel is not None and kernel.ZMQInteractiveShell.initialized()


class _NotebookLine:
    """A line of text below a notebook's cell that changes while the cell runs, and is empty at the end."""

    # It is plain text, so a saved notebook keeps no widget without a kernel behind it. Work under 2 s leaves no output.

    def __init__(self) -> None:
        self._begun = self._changed = time.monotonic()
        self._shown: Any = None

    def say(self, text: str, *, at_once: bool = False) -> None:
        """Show a text; without ``at_once`` from 2 s on, five times a second at most."""
        from IPython.display import display

        now = time.monotonic()
        if not at_once and (now - self._begun < LATE or now - self._changed < 0.2):
            return
        self._changed = now
        content = {"text/plain": f"{text}  {now - self._begun:.0f} s"}
        if self._shown is None:
            self._shown = display(content, raw=True, display_id=True)
        else:
            self._shown.update(content, raw=True)

    def clear(self) -> None:
        """Empty the line."""
        if self._shown is not None:
            self._shown.update({"text/plain": ""}, raw=True)


@contextmanager
def progress_bar(
    name: str, start: float, end: float, show: ProgressOption, shown: str = "{task.completed:.2f} / {task.total:g} s"
) -> Iterator[Any]:
    """Yield a function that takes the simulated time, or another count: the one given, or one that draws a bar."""
    if not _is_shown(show, name):
        yield show if callable(show) else lambda t: None
        return
    if _in_notebook():
        line = _NotebookLine()

        def note(t: float) -> None:
            done = min(max((t - start) / (end - start), 0.0), 1.0) if end > start else 1.0
            count = shown.format(task=SimpleNamespace(completed=t - start, total=end - start))
            line.say(f"{name}  {'█' * round(30 * done):░<30}  {count}")

        try:
            yield note
        finally:
            line.clear()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(shown))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=end - start)
        yield lambda t: bar.update(task, completed=t - start)


@contextmanager
def late_progress(name: str, start: float, end: float) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes how far some work is; it is drawn as by `progress_bar` once it has taken 2 s."""
    begun = time.monotonic()
    with ExitStack() as stack:
        draw: Callable[[float], None] | None = None

        def note(t: float) -> None:
            nonlocal draw
            if draw is None and time.monotonic() - begun > LATE:
                draw = stack.enter_context(progress_bar(name, start, end, None))
            if draw is not None:
                draw(t)

        yield note


@contextmanager
def work_notes(name: str, show: ProgressOption = None) -> Iterator[Callable[[str], Any]]:
    """Yield a function that takes in words what is computed: the one given, or one that shows it, and the time."""
    if not _is_shown(show, name):
        yield show if callable(show) else lambda said: None
        return
    if _in_notebook():
        line = _NotebookLine()
        try:
            yield lambda said: line.say(f"{name}: {said if ' ' in said else said.replace('_', ' ')}")
        finally:
            line.clear()
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    drawn = Progress(*columns, console=Console(stderr=True), transient=True)
    task, begun = drawn.add_task(name, total=None), time.monotonic()

    def note(said: str) -> None:
        drawn.update(task, description=f"{name}: {said if ' ' in said else said.replace('_', ' ')}")
        if not drawn.live.is_started and time.monotonic() - begun > LATE:
            drawn.start()

    try:
        yield note
    finally:
        drawn.stop()


@contextmanager
def compiler_notes(show: ProgressOption, name: str) -> Iterator[None]:
    """Say within the ``with`` statement that a compiler runs, where progress is shown: a run may wait for it."""
    if not _is_shown(show, name):
        yield
        return
    if _in_notebook():
        line = _NotebookLine()
        with hear_builds(lambda note: line.say(note, at_once=True) if note else line.clear()):
            yield
        return
    from rich.console import Console

    status = Console(stderr=True).status("")

    def say(note: str) -> None:
        if note:
            status.update(note)
            status.start()
        else:
            status.stop()

    with hear_builds(say):
        yield


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in a run: a `KeyboardInterrupt` that keeps what was recorded until then.

    Attributes
    ----------
    run : Run
        The run until the last sample before the interrupt. It has no ``final_state``; its messages say so.
    """

    def __init__(self, run: Run):
        where = f"at t = {run.t[-1]:.9g} s" if len(run.t) else "before the first sample"
        super().__init__(f"interrupted {where}")
        message = f"This run was interrupted {where}, within a step: it has no final_state to continue from."
        self.run = run if message in run.messages else replace(run, messages=(*run.messages, message))

    def __reduce__(self) -> tuple[type[Interrupted], tuple[Run]]:
        return type(self), (self.run,)

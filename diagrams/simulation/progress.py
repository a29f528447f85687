"""The progress of a run, drawn on a terminal or in a notebook, and its interruption."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

from ...blocks.core import check_argument, kinds
from ...fmus.build_notes import hear_builds
from ..results import Run

ProgressOption = bool | Callable[[Any], object] | None
"""Option of whatever may take long: shown or not, a function that is called instead, or None: shown on a terminal."""
LATE = 2.0
"""Time in s that some work takes before its progress is shown."""


def _is_shown(show: ProgressOption, name: str) -> bool:
    """Whether progress is shown: where it is asked for; by default on a terminal and in a notebook with widgets."""
    if show is not None:
        check_argument(show, kinds.progress, "progress", name)
        return not callable(show) and bool(show)
    widgets = "ipykernel" in sys.modules and find_spec("ipywidgets") is not None
    return sys.stderr.isatty() or widgets


@contextmanager
def progress_bar(
    name: str, start: float, end: float, show: ProgressOption, shown: str = "{task.completed:.2f} / {task.total:g} s"
) -> Iterator[Any]:
    """Yield a function that takes the simulated time, or another count: the one given, or one that draws a bar."""
    if not _is_shown(show, name):
        yield show if callable(show) else lambda t: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(shown))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=end - start)
        yield lambda t: bar.update(task, completed=t - start)


@contextmanager
def late_progress(
    name: str, start: float, end: float, show: ProgressOption = None
) -> Iterator[Callable[[float], None]]:
    """Yield a function that is told how far some work is; it is drawn as by `progress_bar` once it has taken 2 s."""
    begun = time.monotonic()
    with ExitStack() as stack:
        draw: Callable[[float], None] | None = None

        def note(t: float) -> None:
            nonlocal draw
            if draw is None and time.monotonic() - begun > LATE:
                draw = stack.enter_context(progress_bar(name, start, end, show))
            if draw is not None:
                draw(t)

        yield note


@contextmanager
def work_notes(name: str, show: ProgressOption = None) -> Iterator[Callable[[str], Any]]:
    """Yield a function that takes in words what is being computed: the one given, or one that shows it with the time.

    It is shown once the work has taken 2 s; without a choice on a terminal, and in a notebook with widgets.
    """
    if not _is_shown(show, name):
        yield show if callable(show) else lambda said: None
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

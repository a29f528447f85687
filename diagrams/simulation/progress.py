"""The progress of a run, drawn on a terminal or in a notebook, and its interruption."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from ..results import Run


@contextmanager
def progress_bar(
    name: str, start: float, end: float, show: bool | None, shown: str = "{task.completed:.2f} / {task.total:g} s"
) -> Iterator[Any]:
    """Yield a function that is told the simulated time, or another count, and draws it where that is wanted."""
    if show is None:
        import sys

        widgets = "ipykernel" in sys.modules and find_spec("ipywidgets") is not None
        show = sys.stderr.isatty() or widgets
    if not show:
        yield lambda t: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(shown))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=end - start)
        yield lambda t: bar.update(task, completed=t - start)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in a run: a `KeyboardInterrupt` that keeps what was recorded until then.

    Attributes
    ----------
    run : Run
        The run until the last sample before the interrupt.
    """

    def __init__(self, run: Run):
        where = f"at t = {run.t[-1]:.9g} s" if len(run.t) else "before the first sample"
        super().__init__(f"interrupted {where}")
        self.run = run

    def __reduce__(self) -> tuple[type[Interrupted], tuple[Run]]:
        return type(self), (self.run,)

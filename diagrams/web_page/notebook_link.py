"""The record of a page in a notebook, which comes back to Python while the page runs.

A page is an inline frame, the same in every notebook and on every web page. Where a kernel runs, a widget without a
view (anywidget) listens to that frame, and passes its samples on. So a notebook that is opened without a kernel shows
the page, and nothing is missing but the way back. The page's run can be repeated in Python: the same diagram, and the
same moves after the same samples.
"""

from __future__ import annotations

import secrets
import sys
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from ...blocks.core import OptionError
from ..results import Run
from .sliders import Slider


@dataclass(frozen=True)
class Change:
    """A number that was moved on a page.

    ``after``: number of samples since the reset that there were; it acts at the next one.
    ``t``: time of the last one of them in s; None: there was none, so that it is a start value.
    """

    after: int
    t: float | None
    name: str
    value: float


@dataclass
class PageRecord:
    """Samples that a page has sent since its last reset, and what was moved.

    ``width``: numbers of a sample: the time and the columns.
    ``key``: what a page and its listener know each other by.
    """

    width: int
    key: str = field(default_factory=lambda: secrets.token_hex(8))
    _of: tuple[object, object] | None = None
    _parts: list[np.ndarray] = field(default_factory=list)
    _changes: dict[tuple[int, str], Change] = field(default_factory=dict)
    _first: int = 0
    _listener: Any = None
    message: str = ""

    @property
    def rows(self) -> np.ndarray:
        """All samples, one a row."""
        if len(self._parts) != 1:
            self._parts = [np.concatenate([np.empty((0, self.width)), *self._parts])]
        return self._parts[0]

    @property
    def changes(self) -> list[Change]:
        """What was moved, in order."""
        return list(self._changes.values())

    def take(self, _: object, content: Mapping[str, Any], buffers: Sequence[Any]) -> None:
        """Take a message of a page: samples from a number on, and changes.

        The page that was shown or reset last has the record. One that begins to listen late gets all that there is.
        """
        of, first = (content.get("view"), content.get("run")), int(content["first"])
        rows = np.frombuffer(bytes(buffers[0]), dtype="<f8").reshape(int(content["count"]), self.width)
        if of != self._of:
            self._of, self._parts, self._changes, self._first = of, [], {}, first
        known = sum(map(len, self._parts)) + self._first
        if first < known:
            self._parts = [self.rows[: max(0, first - self._first)]]
        elif first > known:  # the page has dropped what it couldn't keep
            self._parts, self._first = [], first
        self._parts.append(rows)
        for one in content["changes"]:
            made = Change(int(one["after"]), one["t"], str(one["name"]), float(one["value"]))
            self._changes[made.after, made.name] = made
        self.message = str(content.get("message", ""))

    def listen(self) -> bool:
        """Let the notebook pass on what the page sends; False where there is no kernel, or no anywidget."""
        if self._listener is None and runs_in_kernel():
            try:
                self._listener = _make_listener(self.key, self.take)
            except ImportError:
                return False
        return self._listener is not None


def runs_in_kernel() -> bool:
    """Return whether this is a notebook's process."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def _make_listener(key: str, take: Callable[..., None]) -> Any:
    """Return the widget that listens; it is never shown."""
    import anywidget
    import traitlets

    class PageListener(anywidget.AnyWidget):
        _esm = files(__package__).joinpath("page", "notebook.js").read_text(encoding="utf-8")
        key = traitlets.Unicode().tag(sync=True)

    made = PageListener(key=key)
    made.on_msg(take)
    return made


def repeat(
    diagram: Any, sliders: Mapping[str, Slider], changes: Sequence[Change], duration: float, options: Mapping[str, Any]
) -> Run:
    """Return the run in Python.

    ``sliders``: what is moved, by the names of the page.
    ``duration``: simulated time in s.
    Raises `OptionError` if a parameter of an FMU was moved while the page ran.
    """
    start: dict[str, float] = {}
    moves: dict[str, list[Change]] = {}
    for one in changes:
        slider = sliders[one.name]
        if one.t is None:
            start[slider.parameter] = one.value
        elif not slider.of_plant:
            moves.setdefault(slider.parameter, []).append(one)
        else:
            raise OptionError(
                f"{one.name!r} was moved at t = {one.t:g} s; expected parameters of FMUs to be moved before the run "
                "begins, as Python sets them at the start alone. Set it on the page, then reset it.",
                block=slider.path,
                port="simulate",
            )
    now = [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    moved = diagram.replace(start) if start else diagram
    live = moved.simulation(**options).run_realtime(
        duration,
        inputs={name: _follow(each, _value(moved, sliders, name)) for name, each in moves.items()},
        frame=1e-9,  # one tick
        clock=lambda: now[0],
        sleep=sleep,
    )
    run: Run = live.run
    return run


def _follow(moves: Sequence[Change], first: float) -> Callable[[float], float]:
    """Return the value of a parameter after the samples of a time."""
    times = [float(one.t) for one in moves if one.t is not None]
    values = [first, *(one.value for one in moves)]
    return lambda t: values[bisect_right(times, t)]


def _value(diagram: Any, sliders: Mapping[str, Slider], name: str) -> float:
    """Return the value of a parameter with which a diagram starts."""
    one = next(slider for slider in sliders.values() if slider.parameter == name)
    return one.value_in(diagram[one.path])

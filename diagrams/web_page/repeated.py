"""A page's run again in Python: the same diagram, and the same moves after the same samples."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ...blocks.core import OptionError
from ..results import Run
from .notebook_link import Change
from .sliders import Slider


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

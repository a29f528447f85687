"""An operating point of one diagram, for another one that has its blocks and some more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...blocks.core import Layout, OptionError
from ..flat import WiredDiagram
from ..results import OperatingPoint
from .operating_points import operating_point


def copy_point(diagram: WiredDiagram, point: OperatingPoint, other: WiredDiagram) -> OperatingPoint:
    """Return the operating point of another diagram with the states of a point, wherever a name is in both.

    States that only the other diagram has are those of its start. An FMU may be in co-simulation in one diagram and in
    model exchange in the other.

    Parameters
    ----------
    diagram : Diagram
        Diagram of the point.
    point : OperatingPoint
        The point.
    other : Diagram
        The other diagram.

    Raises
    ------
    OptionError
        If the point stands on no tick of the other diagram.
    """
    from ..simulation import copy_states

    old = diagram.flatten_like(point)
    guess = operating_point(other, None, {} if other.has_base else {"step": point.base})
    flat = other.flatten_like(guess)
    tick = point.tick * point.base / flat.base
    if tick.denominator != 1:
        raise OptionError(
            f"found the operating point at t = {point.t:.9g} s; expected it on a tick of {float(flat.base):g} s. Take "
            "one that is on a tick.",
            block=other.name,
            port="operating point",
            t=point.t,
        )
    x, w, z = guess.x.copy(), guess.w.copy(), guess.z.copy()
    copy_states(point.x, old, flat, x)
    _copy(point.w, old.plant_outputs, flat.plant_outputs, w)
    _copy(point.z, old.plant_inputs, flat.plant_inputs, z)
    states: dict[str, dict[str, Any]] = {path: known["state"] for path, known in point.plants.items()}
    for path, known in point.exchanged.items():
        states[path] = {**known["state"], **old.states.of_block[path].split(point.x)}
    plants, exchanged = dict(guess.plants), dict(guess.exchanged)
    for group in (plants, exchanged):
        for path in group.keys() & states.keys():
            own = {**group[path]["state"], **states[path]}
            group[path] = {**group[path], "t": point.t, "state": {name: own[name] for name in group[path]["state"]}}
    for path in exchanged.keys() & states.keys():
        _copy_state(flat.states.of_block[path], states[path], x)
    return replace(
        guess, t=point.t, tick=int(tick), x=x, w=w, z=z, plants=plants, exchanged=exchanged,
        values={**guess.values, **{name: v for name, v in point.values.items() if name in guess.values}},
        residual=point.residual, largest=point.largest, how=point.how,
    )  # fmt: skip


def _copy(values: np.ndarray, old: Layout, new: Layout, into: np.ndarray) -> None:
    for name, where in old.slices.items():
        if name in new.slices and new.shapes[name] == old.shapes[name]:
            into[new.slices[name]] = values[where]


def _copy_state(layout: Layout, state: dict[str, Any], x: np.ndarray) -> None:
    for name, where in layout.slices.items():
        if name in state:
            x[where] = np.ravel(state[name])

"""Operating points: where a diagram is linearized."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from ..blocks._errors import OptionError
from ._flat import FlatDiagram
from ._run import Snapshot
from ._structure import join

if TYPE_CHECKING:
    from ._diagram import Diagram


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """An instant of a diagram: everything that its linear model depends on.

    Made by `Diagram.operating_point` (from a run), `Diagram.trim`, or from a recorded instant, ``run.at(t)``.

    Attributes
    ----------
    t : float
        Time in s.
    tick : int
        Its tick, on the base ``base`` (seconds, exact).
    x : ndarray
        The vector x of the flattened diagram, as it is before the tick.
    w, z : ndarray
        Outputs of the FMUs then, and their inputs from then on.
    plants : mapping
        Time, states and inputs of each FMU by path, as `Fmu.linear_model` takes them.
    residual : float
        How far it is from an equilibrium: the largest change of a state over the next tick, and of a continuous state in
        one second, relative to 1 + its size.
    largest : str
        The state with that residual.
    how : str
        "run", "trim" or "given".
    """

    t: float
    tick: int
    base: Fraction
    x: np.ndarray = field(repr=False)
    w: np.ndarray = field(repr=False)
    z: np.ndarray = field(repr=False)
    plants: Mapping[str, Any] = field(default_factory=dict, repr=False)
    residual: float = float("nan")
    largest: str = ""
    how: str = "run"
    values: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Every signal by its path, then."""


def capture(simulation: Any, how: str = "run") -> OperatingPoint:
    """Return the operating point at the tick that a simulation has reached."""
    flat: FlatDiagram = simulation.flat
    machine = simulation._machine
    n = flat.log.total
    x = machine.log[n : n + flat.width].copy()
    w = machine.log[: flat.plant_outputs.total].copy()
    plants = {path: plant.operating_point() for path, plant in simulation._plants}
    values = {name: machine.log[s].reshape(flat.log.shapes[name]).copy() for name, s in flat.log.slices.items()}
    residual, largest = from_equilibrium(flat, simulation.t, x, w, machine.x_next)
    return OperatingPoint(
        simulation.t,
        simulation._tick,
        flat.base,
        x,
        w,
        machine.z.copy(),
        plants,
        residual,
        largest,
        how,
        values,
    )


def from_equilibrium(flat: FlatDiagram, t: float, x: np.ndarray, w: np.ndarray, x_next: np.ndarray) -> tuple[float, str]:
    """Return the largest relative change of a state, and whose it is."""
    found, who = 0.0, ""
    rates = np.zeros(flat.width)
    if flat.continuous.size:
        rates[flat.continuous] = np.ravel(np.array(flat.flow(t, x, w, flat.p)))
    for path, where in flat.states.slices.items():
        change = np.maximum(np.abs(x_next[where] - x[where]), np.abs(rates[where])) / (1.0 + np.abs(x[where]))
        if change.size and change.max() > found:
            found, who = float(change.max()), path
    return found, who


def operating_point(diagram: Diagram, point: Any, options: Mapping[str, Any]) -> OperatingPoint:
    """Return an operating point from what a user gives: one, a recorded instant, a time in s, or None for the start.

    Raises
    ------
    OptionError
        Anything else.
    """
    if isinstance(point, OperatingPoint):
        return point
    if isinstance(point, Snapshot):
        run = getattr(point, "run", None)
        recipe = dict(getattr(run, "recipe", {}) or {})
        recipe.update(options)
        return at_time(diagram, point.t, recipe)
    if point is None:
        return at_time(diagram, 0.0, options)
    if isinstance(point, int | float) and not isinstance(point, bool):
        return at_time(diagram, float(point), options)
    raise OptionError(
        f"found {point!r}; expected an operating point: run.at(t), a time in s, diagram.operating_point(…), "
        "diagram.trim(…), or None for the start.",
        block=diagram.name,
        port="operating point",
    )


def at_time(diagram: Diagram, t: float, options: Mapping[str, Any]) -> OperatingPoint:
    """Run a diagram to a time, and return the operating point there."""
    from ._simulation import Simulation

    options = dict(options)
    start = options.get("start")
    if options.get("step") is None and diagram.is_continuous and not diagram.has_clock and not diagram.has_fmu:
        options["step"] = Fraction(repr(float(t))) if t > 0 else Fraction(1, 1000)
    with Simulation(diagram, **options) as simulation:
        span = t - (0.0 if start is None else start.t)
        if span > 0:
            simulation.advance(span)
        return capture(simulation)


def names_of_states(flat: FlatDiagram) -> list[str]:
    """Return what every entry of x is: ``block.state[i]``, ``held(port)[i]``, and so on."""
    names: list[str] = []
    for path in flat.states.slices:
        for name, shape in flat.checked.traced[path].states.items():
            names += elements(join(path, name), shape)
    for layout, kind in ((flat.held, "held"), (flat.gates, "gate"), (flat.starts, "start"), (flat.loops, "loop")):
        for name, shape in layout.shapes.items():
            names += [f"{kind}({e})" for e in elements(name, shape)]
    return names


def elements(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of the elements of an array, counted from 0."""
    return [f"{name}[{','.join(map(str, index))}]" if index else name for index in np.ndindex(*shape)]

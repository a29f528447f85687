"""Operating points: where a diagram is linearized."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core import OptionError, UnknownNameError, near
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint, PointOrigin, Snapshot, layout_of

OPTIONS = ("step", "solver", "rtol", "atol", "max_step", "start")
"""How to run to an operating point."""
AGAIN = 1e-3
"""How far a run may be from where it was the first time, as its solver takes other steps; relative to 1 + its size."""
MORE = {"linearize": ("inputs", "outputs", "openings", "plants"), "operating_point": ("t",)}


def capture(simulation: Any, how: PointOrigin = PointOrigin.RUN) -> OperatingPoint:
    """Return the operating point at the tick that a simulation has reached."""
    flat: FlatDiagram = simulation.flat
    view = simulation.view
    plants = {path: plant.operating_point() for path, plant in view.plants.items()}
    values = {name: view.log[s].reshape(flat.log.shapes[name]).copy() for name, s in flat.log.slices.items()}
    point = OperatingPoint(
        view.t,
        view.tick,
        flat.base,
        view.x.copy(),
        view.w.copy(),
        view.z.copy(),
        plants,
        how=how,
        values=values,
        layout=layout_of(flat),
    )
    return judged(flat, point, view.x_next)


def judged(flat: FlatDiagram, point: OperatingPoint, x_next: np.ndarray) -> OperatingPoint:
    """Return an operating point with its residual: the largest relative change of a state, and whose it is."""
    from .plant_models import plant_changes

    x, found, who = point.x, 0.0, ""
    rates = np.zeros(flat.width)
    if flat.continuous.size:
        rates[flat.continuous] = flat.flow(point.t, x, point.w, flat.p)[0]
    changes = {
        path: np.maximum(np.abs(x_next[where] - x[where]), np.abs(rates[where])) / (1.0 + np.abs(x[where]))
        for path, where in flat.states.slices.items()
    }
    for name, change in (changes | plant_changes(flat, point)).items():
        worst = float(np.max(change, initial=0.0))
        if worst > found or np.isnan(worst):
            found, who = worst, name
        if np.isnan(found):
            break
    return replace(point, residual=found, largest=who)


def check_options(diagram: WiredDiagram, options: Mapping[str, Any], what: str) -> None:
    """Refuse what is no option of how to run to an operating point.

    Raises
    ------
    UnknownNameError
        If something else is given.
    """
    for name in options:
        if name not in OPTIONS:
            raise UnknownNameError(
                f"{what} takes no {name!r}. {near(name, (*OPTIONS, *MORE.get(what, ())))}", block=diagram.name
            )


def operating_point(diagram: WiredDiagram, point: Any, options: Mapping[str, Any]) -> OperatingPoint:
    """Return an operating point from what a user gives: one, a recorded instant, a time in s, or None for the start.

    Raises
    ------
    OptionError
        Anything else.
    """
    if isinstance(point, OperatingPoint):
        return point
    if isinstance(point, Snapshot):
        _check_whose(diagram, point)
        recipe = dict(getattr(point.run, "recipe", {}) or {})
        found = at_time(diagram, point.t, {**recipe, **options})
        _check_found_again(diagram, point, found)
        return found
    if point is None:
        start = options.get("start")
        return at_time(diagram, 0.0 if start is None else start.t, options)
    if isinstance(point, int | float | np.floating | np.integer) and not isinstance(point, bool):
        return at_time(diagram, float(point), options)
    raise OptionError(
        f"found {point!r}; expected an operating point: run.at(t), a time in s, diagram.operating_point(…), "
        "diagram.trim(…), or None for the start.",
        block=diagram.name,
        port="operating point",
    )


def _check_whose(diagram: WiredDiagram, given: Snapshot) -> None:
    """Refuse an instant of a run of a diagram that has nothing to do with this one."""
    whose = getattr(given.run, "diagram_name", diagram.name)
    if whose != diagram.name and not {path.partition(".")[0] for path in given.values} <= _tops(diagram):
        raise OptionError(
            f"found an instant of a run of the diagram {whose!r}, which has other blocks. Take one of a run of this "
            "diagram, or a time in s.",
            block=diagram.name,
            port="operating point",
        )


def _tops(diagram: WiredDiagram) -> set[str]:
    return {path.partition(".")[0] for path in diagram.blocks}


def _check_found_again(diagram: WiredDiagram, given: Snapshot, found: OperatingPoint) -> None:
    """Refuse an instant of a run that does not come again: one that was restored from a state on the way."""
    if getattr(given.run, "diagram", None) is not diagram or given.state.shape != found.x.shape:
        return
    off = float(np.max(np.abs(found.x - given.state) / (1.0 + np.abs(found.x)), initial=0.0))
    if not off <= AGAIN:
        raise OptionError(
            f"run again to t = {given.t:g} s, the diagram is not where it was in this run: a state is off by "
            f"{off:.3g}. The run was restored from a state on its way, or an FMU does not repeat itself. Give "
            "the state that it began with: linearize(t, start=…).",
            block=diagram.name,
            port="operating point",
        )


def at_time(diagram: WiredDiagram, t: float, options: Mapping[str, Any]) -> OperatingPoint:
    """Run a diagram to a time, and return the operating point there."""
    from ..simulation import RunOptions, Simulation

    check_options(diagram, options, "operating_point")
    options = dict(options)
    start = options.get("start")
    first = 0.0 if start is None else float(start.t)
    if not first <= t < np.inf:
        raise OptionError(
            f"found an operating point at t = {t!r} s; expected a time from {first:g} s on, where the run begins.",
            block=diagram.name,
            port="operating point",
        )
    if not diagram.has_clock:
        if start is not None:
            options.setdefault("step", start.base)
        elif not _is_tick(options, t, diagram.has_fmu):
            options["step"] = _any_step(diagram, t)
            t = 0.0 if t == 0 else float(options["step"])
    with Simulation(diagram, RunOptions.of(options, block=diagram.name)) as simulation:
        if t > first:
            _check_tick(diagram, simulation.flat.base, t)
            simulation.advance(t - first)
        if simulation.stopped is not None and simulation.t < t:
            raise OptionError(
                f"the run is stopped at t = {simulation.t:.9g} s by {simulation.stopped.block!r}, before the operating "
                f"point at t = {t:g} s. Choose an earlier one.",
                block=diagram.name,
                port="operating point",
            )
        events = simulation.view.events
        if events:
            raise OptionError(
                f"at t = {t:g} s the event {events[-1].event!r} of {events[-1].block!r} fires, so there is no linear "
                "model at that instant. Choose a time before or after it.",
                block=diagram.name,
                port="operating point",
            )
        return capture(simulation)


def _is_tick(options: Mapping[str, Any], t: float, has_fmu: bool) -> bool:
    """Whether the step that was given is kept: it is one of communication, or of the solver, or meets the time."""
    if options.get("step") is None:
        return False
    steps = t / float(options["step"])
    return has_fmu or options.get("solver") in ("euler", "heun", "rk4") or abs(steps - round(steps)) <= 1e-12 * steps


def _check_tick(diagram: WiredDiagram, base: Fraction, t: float) -> None:
    n = round(Fraction(t) / base)
    if abs(Fraction(t) - n * base) > Fraction(t) * Fraction(1, 10**12):
        raise OptionError(
            f"t = {t!r} s is between two ticks, {float(base):g} s apart. Take {float(n * base)!r} s, or a step=… of "
            "which both this time and all sample times are multiples.",
            block=diagram.name,
            port="operating point",
        )


def _any_step(diagram: WiredDiagram, t: float) -> Fraction:
    """Return a step on which a time is a tick, where nothing else asks for one."""
    if not t > 0:
        return Fraction(1, 1000)
    if diagram.has_fmu:
        raise OptionError(
            f"to run to t = {t:g} s the FMU needs a communication step. Give one, operating_point({t:g}, step=1e-3), "
            "and linearize there.",
            block=diagram.name,
            port="step",
        )
    return Fraction(max(1, round(t * 10**9)), 10**9)

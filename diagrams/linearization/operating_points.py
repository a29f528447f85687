"""Operating points of a diagram, found by runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ...blocks import Constant, Reference
from ...blocks.core import Layout, OptionError, Source, UnknownArgumentError, accepts, kinds
from ...blocks.names_of_other_tools import POINT
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint, PointOrigin, Snapshot, layout_of, units_of
from ..solvers import FIXED
from .start_branches import leave_start

if TYPE_CHECKING:
    from ..simulation import Simulation

PointLike: TypeAlias = OperatingPoint | Snapshot | float | None
"""Values that give an operating point: one, a recorded instant, a time in s, or None for the start."""
RUN_OPTIONS = ("step", "solver", "rtol", "atol", "max_step", "start", "coupling", "start_exchange")
"""Options of a run to an operating point."""
AGAIN = 1e-3
"""Largest deviation of a repeated run, whose solver takes other steps, relative to 1 + the size of a state."""
MORE = {
    "linearize": ("inputs", "outputs", "openings", "plants", "stairs", "delays", "order"),
    "operating_point": ("t",),
}
"""Further arguments of methods that run to an operating point."""


def capture(simulation: Simulation, how: PointOrigin = PointOrigin.RUN) -> OperatingPoint:
    """Return the operating point at the tick that a simulation has reached."""
    flat, view = simulation.flat, simulation.view
    plants = {path: plant.operating_point() for path, plant in view.plants.items()}
    for path, reached in simulation.reached.items():
        if reached != view.tick:
            now, after = (float(k * flat.base) for k in (reached, flat.next_step(path, view.tick)))
            raise OptionError(
                f"at t = {view.t:g} s it is on its way from its communication point at {now:g} s to that at {after:g} "
                "s, as it takes steps of one length only; expected an operating point at a communication point. Take "
                f"one of these times, or step={float(flat.base):g}.",
                block=path,
                port="operating point",
                t=view.t,
            )
    values = values_of(flat, view.log)
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
        asked=flat.asked,
        coupling=simulation.coupling,
        coupling_order=simulation.coupling_order,
        exchanged={path: block.operating_point() for path, block in view.exchanged.items()},
        units=units_of(simulation.wired.blocks, (*view.plants, *view.exchanged)),
    )
    return with_residual(flat, point, view.x_next)


def with_residual(flat: FlatDiagram, point: OperatingPoint, x_next: np.ndarray) -> OperatingPoint:
    """Return an operating point with its residual, the largest relative change of a state, and that state's name."""
    from .exchanged import evaluators_at, fmu_at, pass_on
    from .plant_models import plant_changes, plant_paths

    x, found, who = point.x, 0.0, ""
    rates = np.zeros(flat.width)
    if flat.continuous.size:
        evaluators = evaluators_at(flat, point)
        rates[flat.continuous] = flat.flow(point.t, x, point.w, flat.p, evaluators=evaluators)[0]
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
    unjudged = tuple(path for path in plant_paths(flat) if not fmu_at(flat, path).description.states)
    return pass_on(point, replace(point, residual=found, largest=who, unjudged=unjudged))


def check_options(options: Mapping[str, Any], caller: str) -> None:
    """Refuse options that a run to an operating point does not have; ``caller`` is the name of the method."""
    for name in options:
        if name not in RUN_OPTIONS:
            words = POINT if caller == "linearize" else {}
            raise UnknownArgumentError(name, (*RUN_OPTIONS, *MORE.get(caller, ())), block=caller, elsewhere=words)


def operating_point(
    diagram: WiredDiagram, point: PointLike, options: Mapping[str, Any], *, begun: bool = True
) -> OperatingPoint:
    """Return an operating point: as it is, or by a run to a recorded instant, to a time in s or to the start (None).

    It is past the branches of the start that blocks have, unless ``begun`` is False.
    """
    if isinstance(point, OperatingPoint):
        return point
    if isinstance(point, Snapshot):
        _check_run(diagram, point)
        recipe = dict(getattr(point.run, "recipe", {}) or {})
        found = run_to(diagram, point.t, {**recipe, **options}, begun=begun)
        _check_found_again(diagram, point, found)
        return found
    if point is None:
        start = options.get("start")
        return run_to(diagram, 0.0 if start is None else start.t, options, begun=begun)
    if isinstance(point, int | float | np.floating | np.integer) and not isinstance(point, bool):
        return run_to(diagram, float(point), options, begun=begun)
    raise OptionError(
        f"found {point!r}; expected an operating point. Give run.at(t), a time in s, diagram.operating_point(…), "
        "diagram.trim(…), or None for the start.",
        block=diagram.name,
        port="operating point",
    )


def _check_run(diagram: WiredDiagram, given: Snapshot) -> None:
    """Refuse an instant of a run of another diagram."""
    whose = getattr(given.run, "diagram_name", diagram.name)
    if whose != diagram.name and not {path.partition(".")[0] for path in given.values} <= _top_paths(diagram):
        raise OptionError(
            f"found an instant of a run of the diagram {whose!r}, which has other blocks; expected one of a run of "
            "this diagram. Give that, or a time in s.",
            block=diagram.name,
            port="operating point",
        )


def _top_paths(diagram: WiredDiagram) -> set[str]:
    return {path.partition(".")[0] for path in diagram.blocks}


def _check_found_again(diagram: WiredDiagram, given: Snapshot, found: OperatingPoint) -> None:
    """Refuse an instant that a repeated run does not reach again: the first run was restored from a saved state."""
    if getattr(getattr(given.run, "diagram", None), "wired", None) is not diagram or given.state.shape != found.x.shape:
        return
    off = float(np.max(np.abs(found.x - given.state) / (1.0 + np.abs(found.x)), initial=0.0))
    if not off <= AGAIN:
        raise OptionError(
            f"run again to t = {given.t:g} s, the diagram is not where it was in this run: found a state off by "
            f"{off:.3g}; expected at most {AGAIN:g}. The run was restored from a saved state, or an FMU does not "
            "repeat itself. Give the state that the run began with: linearize(t, start=…).",
            block=diagram.name,
            port="operating point",
        )


@accepts("operating_point", t=kinds.real)
def run_to(diagram: WiredDiagram, t: float, options: Mapping[str, Any], *, begun: bool = True) -> OperatingPoint:
    """Run a diagram to a time in s, and return the operating point there; see `operating_point`."""
    from ..simulation import RunOptions, Simulation

    check_options(options, "operating_point")
    options = dict(options)
    start = options.get("start")
    first = 0.0 if start is None else float(start.t)
    if not first <= t < np.inf:
        raise OptionError(
            f"found t = {t!r} s; expected a time from {first:g} s on, where the run begins. Choose a later one.",
            block=diagram.name,
            port="operating point",
        )
    # nothing says where ticks are: one step that ends at the time, if it may be chosen
    if not diagram.has_base:
        if start is not None:
            options.setdefault("step", start.base)
        elif not _keeps_step(options, t, diagram.has_fmu):
            options["step"] = _choose_step(diagram, t)
            t = 0.0 if t == 0 else float(options["step"])
    with Simulation(diagram, RunOptions.of(options, block=diagram.name)) as simulation:
        if t > first:
            _check_tick(diagram, simulation.flat.base, t)
            simulation.advance(t - first)
        if simulation.stopped is not None and simulation.t < t:
            raise OptionError(
                f"the run is stopped at t = {simulation.t:.9g} s by {simulation.stopped.block!r}, before the operating "
                f"point at t = {t:g} s. Choose an earlier time.",
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
        if begun:
            view = simulation.view
            x = leave_start(simulation.flat, view.x, values_of(simulation.flat, view.log))
            if x is not view.x:
                simulation.take_over(x, simulation.flat)
        return capture(simulation)


def values_of(flat: FlatDiagram, log: np.ndarray) -> dict[str, np.ndarray]:
    """Return all signals by the paths of their ports."""
    return {name: log[s].reshape(flat.log.shapes[name]).copy() for name, s in flat.log.slices.items()}


def _keeps_step(options: Mapping[str, Any], t: float, has_fmu: bool) -> bool:
    """Whether the given step is kept: it is a communication step, a solver's step, or the time is a multiple of it."""
    if options.get("step") is None:
        return False
    steps = t / float(options["step"])
    return has_fmu or options.get("solver") in FIXED or abs(steps - round(steps)) <= 1e-12 * steps


def _check_tick(diagram: WiredDiagram, base: Fraction, t: float) -> None:
    """Refuse a time between two ticks."""
    n = round(Fraction(t) / base)
    if abs(Fraction(t) - n * base) > Fraction(t) * Fraction(1, 10**12):
        raise OptionError(
            f"t = {t!r} s is between two ticks, which are {float(base):g} s apart. Take {float(n * base)!r} s, or a "
            "step=… that divides this time and all sample times.",
            block=diagram.name,
            port="operating point",
        )


def _choose_step(diagram: WiredDiagram, t: float) -> Fraction:
    """Return a step that has a tick at a time, for a diagram without sampling."""
    if not t > 0:
        return Fraction(1, 1000)
    if diagram.has_fmu:
        raise OptionError(
            f"to run to t = {t:g} s the FMU needs a communication step. Give one: operating_point({t:g}, step=1e-3).",
            block=diagram.name,
            port="step",
        )
    return Fraction(max(1, round(t * 10**9)), 10**9)


def refine_ticks(diagram: WiredDiagram, point: OperatingPoint, parts: int) -> OperatingPoint:
    """Return an operating point on ticks that divide the time between two of its ticks; FMUs step to each of them.

    Between ticks at which something acts, more signals are held than without such ticks: they have their values at the
    point.
    """
    from ..simulation import copy_states

    if parts == 1:
        return point
    made = replace(point, base=point.base / parts, tick=point.tick * parts, asked=True)
    old, new = diagram.flatten_like(point), diagram.flatten_like(made)
    x = new.x0.copy()
    copy_states(point.x, old, new, x)
    for name, where in new.held.slices.items():
        if name in point.values and name not in old.held.slices:
            x[where] = np.ravel(point.values[name])
    return replace(made, x=x, layout=layout_of(new) if point.layout else point.layout)


def copy_point(diagram: WiredDiagram, point: OperatingPoint, other: WiredDiagram) -> OperatingPoint:
    """Return the operating point of another diagram with the states of a point, wherever a name is in both.

    States that only the other diagram has are those of its start. An FMU may be in co-simulation in one diagram and in
    model exchange in the other.
    """
    from ..simulation import copy_states

    point.check_units(other.blocks, other.name)
    old = diagram.flatten_like(point)
    guess = operating_point(other, None, {} if other.has_base else {"step": point.base}, begun=False)
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
    # in model exchange the solver has the continuous states of an FMU, in co-simulation its saved point has them
    for path, known in point.exchanged.items():
        states[path] = {**known["state"], **old.states.of_block[path].split(point.x)}
    plants, exchanged = dict(guess.plants), dict(guess.exchanged)
    for group in (plants, exchanged):
        for path in group.keys() & states.keys():
            own = {**group[path]["state"], **states[path]}
            group[path] = {**group[path], "t": point.t, "state": {name: own[name] for name in group[path]["state"]}}
    for path in exchanged.keys() & states.keys():
        _copy_state(flat.states.of_block[path], states[path], x)
    values = {**guess.values, **{name: v for name, v in point.values.items() if name in guess.values}}
    return replace(
        guess,
        t=point.t,
        tick=int(tick),
        x=leave_start(flat, x, values),
        w=w,
        z=z,
        plants=plants,
        exchanged=exchanged,
        values=values,
        residual=point.residual,
        largest=point.largest,
        how=point.how,
    )


def hold_sources(diagram: WiredDiagram, values: Mapping[str, Any]) -> WiredDiagram:
    """Return a diagram whose sources keep their values at an operating point, given by the paths of ports."""
    changes: dict[str, Any] = {}
    for path, block in diagram.blocks.items():
        if isinstance(block, Source) and not isinstance(block, Constant | Reference) and f"{path}.y" in values:
            value = np.asarray(values[f"{path}.y"], dtype=float)
            name = path.rpartition(".")[2]
            if type(block).y.shape == (3,):
                changes[path] = Reference(float(value[0]), unit=block.unit, name=name)
            else:
                changes[path] = Constant(value=value, unit=block.unit, name=name)
    return diagram.replace(changes) if changes else diagram


def _copy(values: np.ndarray, old: Layout, new: Layout, into: np.ndarray) -> None:
    for name, where in old.slices.items():
        if name in new.slices and new.shapes[name] == old.shapes[name]:
            into[new.slices[name]] = values[where]


def _copy_state(layout: Layout, state: dict[str, Any], x: np.ndarray) -> None:
    for name, where in layout.slices.items():
        if name in state:
            x[where] = np.ravel(state[name])

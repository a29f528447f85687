"""The complete state of a run at a tick: saved, kept, and continued from, in another process too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core.errors import OptionError
from ..flat.flat_diagram import FlatDiagram
from .stored import Stopped, own_version

VERSION = 2
"""Version of a state's vectors and their layout."""


@dataclass(frozen=True, eq=False)
class RunState:
    """The complete state of a run at a tick: states of all blocks, what boxes hold, the solver's memory, the FMUs.

    It can be pickled. `Diagram.simulate` goes on from it with ``start=``: the diagram that it comes from, or a variant
    with other parameters (a branch), but the same blocks and states.

    Attributes
    ----------
    t : float
        Time in s.
    tick : int
        Tick number on the base ``base`` (seconds, exact).
    fmus : mapping
        State of each FMU, as bytes, by path.
    version : int
        Version of what is saved; another version of loopwright may not read it.
    made_by : str
        Version of loopwright that made it.
    """

    t: float
    tick: int
    base: Fraction
    diagram: str
    x: np.ndarray = field(repr=False)
    w: np.ndarray = field(repr=False)
    z: np.ndarray = field(repr=False)
    log: np.ndarray = field(repr=False)
    layout: tuple[Any, ...] = field(repr=False)
    continuous: Mapping[str, Any] | None = field(default=None, repr=False)
    fmus: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    stopped: Stopped | None = None
    version: int = VERSION
    made_by: str = field(default_factory=own_version)


def layout_of(flat: FlatDiagram) -> tuple[Any, ...]:
    """Return what a state's vectors mean: two diagrams with one of these can exchange states."""
    layouts = (flat.states, flat.held, flat.gates, flat.starts, flat.loops, flat.log, flat.plant_inputs)
    names = tuple(tuple((n, layout.shapes[n]) for n in layout.slices) for layout in layouts)
    return (*names, tuple((e.path, e.name) for e in flat.events))


def check_fits(state: RunState, flat: FlatDiagram, name: str) -> None:
    """Refuse a state that another kind of diagram has made.

    Raises
    ------
    OptionError
        Another version, another base, other blocks, states or ports.
    """
    if not isinstance(state, RunState):
        raise OptionError(
            f"found {state!r}; expected a state, as run.final_state or Simulation.save() give it.",
            block=name,
            port="start",
        )
    if state.version != VERSION:
        raise OptionError(
            f"found a state of version {state.version}, made by loopwright {state.made_by}; this loopwright "
            f"{own_version()} reads version {VERSION}. Go on from it there, or make it again.",
            block=name,
            port="start",
        )
    if state.base != flat.base:
        raise OptionError(
            f"it was saved on ticks of {float(state.base):g} s; this run has ticks of {float(flat.base):g} s. Give "
            f"step={float(state.base):g}, or the sample times that it was saved with.",
            block=name,
            port="start",
        )
    here = layout_of(flat)
    if state.layout == here:
        return
    kinds = ("state", "held output", "box", "reset state", "solved loop", "signal", "input of an FMU", "event")
    for kind, mine, theirs in zip(kinds, here, state.layout, strict=True):
        for missing, whose in ((set(theirs) - set(mine), "it has"), (set(mine) - set(theirs), "it lacks")):
            if missing:
                first = min(map(str, (m[0] for m in missing)))
                raise OptionError(
                    f"it is the state of a run of {state.diagram!r} with other blocks: {whose} the {kind} of "
                    f"{first!r}. A branch may change parameters, not blocks or wires.",
                    block=name,
                    port="start",
                )


def not_open_error(opened: bool | None, name: str) -> OptionError:
    """Return the error of a run that is used before it has begun (``opened`` is None), or after it has ended."""
    found = "has not begun" if opened is None else "has ended, and its FMUs are freed"
    return OptionError(
        f"this run {found}; expected it to be used inside of its with statement, once: with diagram.simulation(…) as "
        "simulation: …. To go on later, keep simulation.save() and give it as start=….",
        block=name,
    )

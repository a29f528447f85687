"""The complete state of a run at a tick, from which a run can continue, in another process too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core import OptionError, brief, explain_calls, shorten
from ..flat import FlatDiagram
from ..wiring import explain_absent_state
from .stored import Stopped, own_version

VERSION = 3
"""Version of a state's vectors and their layout."""

StateLayout = tuple[tuple[tuple[str, object], ...], ...]
"""Names and shapes of a state's entries, kind by kind."""


@explain_calls
@dataclass(frozen=True, eq=False)
class RunState:
    """The complete state of a run at a tick: of all blocks and FMUs, of outputs that are held, and of the solver.

    It can be pickled. `Diagram.simulate` continues from it with ``start=``. The diagram may be a variant with other
    parameters (a branch), with the same blocks and states.

    Attributes
    ----------
    t : float
        Time in s.
    tick : int
        Tick number on the base ``base`` (seconds, exact).
    fmus : mapping
        State of each FMU, as bytes, by path.
    version : int
        Version of the saved data; another version of loopwright may not read it.
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
    layout: StateLayout = field(repr=False)
    continuous: Mapping[str, Any] | None = field(default=None, repr=False)
    fmus: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    plant_steps: Mapping[str, Any] | None = field(default=None, repr=False)
    proposed_step: float | None = field(default=None, repr=False)
    stopped: Stopped | None = None
    version: int = VERSION
    made_by: str = field(default_factory=own_version)

    def __repr__(self) -> str:
        ended = "" if self.stopped is None else f"stopped by {self.stopped.block}"
        facts = f"t = {self.t:.9g} s", f"tick {self.tick} of {float(self.base):g} s", ended
        return brief(f"state of a run of {self.diagram!r}", *facts, then="diagram.simulate(…, start=state)")


def layout_of(flat: FlatDiagram) -> StateLayout:
    """Return the layout of a state, by names, as parameters may leave states out; equal ones can exchange states."""
    return flat.keep("layout of a saved state", lambda: _lay_out(flat))


def _lay_out(flat: FlatDiagram) -> StateLayout:
    layouts = (flat.states.each, flat.held, flat.gates, flat.starts, flat.loops, flat.log, flat.plant_inputs)
    names = tuple(tuple((n, layout.shapes[n]) for n in layout.slices) for layout in layouts)
    return (*names, tuple((e.path, e.name) for e in flat.events))


def check_fits(state: RunState, flat: FlatDiagram, name: str) -> None:
    """Refuse a state that another kind of diagram has made."""
    if not isinstance(state, RunState):
        raise OptionError(
            f"found {shorten(state)}; expected a saved state. {_next_step(state)}",
            block=name,
            port="start",
        )
    if state.version != VERSION:
        raise OptionError(
            f"found a state of version {state.version}, made by loopwright {state.made_by}; this loopwright "
            f"{own_version()} reads version {VERSION}. Continue from it there, or make it again.",
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
    kinds = ("state", "held output", "subsystem", "reset state", "solved loop", "signal", "input of an FMU", "event")
    for kind, mine, theirs in zip(kinds, here, state.layout, strict=True):
        for missing, whose in ((set(theirs) - set(mine), "it has"), (set(mine) - set(theirs), "it lacks")):
            if missing:
                first = min(map(str, (m[0] for m in missing)))
                reason = explain_absent_state(flat.table.blocks, first)
                raise OptionError(
                    f"found the state of a run of {state.diagram!r} with other blocks: {whose} the {kind} of "
                    f"{first!r}.{reason and f' Here {reason}'} Continue with the same blocks and wires; a branch may "
                    "change parameters.",
                    block=name,
                    port="start",
                )


def _next_step(state: object) -> str:
    t = getattr(state, "t", None)
    if isinstance(t, float):  # an instant of a run, which lacks the FMUs' states and the solver's
        return f"Give diagram.operating_point({t!r}), which runs to that instant, or the final_state of a run until it."
    return "Give run.final_state, the result of Simulation.save(), or an operating point."


def not_open_error(opened: bool | None, name: str) -> OptionError:
    """Return the error of a run that is used before it has begun (``opened`` is None), or after it has ended."""
    found = "has not begun" if opened is None else "has ended, and its FMUs are freed"
    return OptionError(
        f"this run {found}; expected it to be used inside of its with statement, once: with diagram.simulation(…) as "
        "simulation: …. To continue later, keep simulation.save() and give it as start=….",
        block=name,
    )

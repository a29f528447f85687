"""A run that starts at an operating point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...blocks.core import FmuError, LoopwrightError, OptionError
from ..compiled import Delays
from ..flat import FlatDiagram, TickPattern, WiredDiagram
from ..results import OperatingPoint, PointOrigin
from .workspace import Workspace

SAME = 1e-9
"""Distance between two states of an FMU, absolute and relative, up to which it need not be set."""
_AT_REST = 1e-6
"""Largest residual of a point of a run, and largest difference between both ends of a dead time, that count as rest."""
PASSES = 120
"""Most ticks that states without a value, such as those of a delay, get to take one."""


def apply_point(diagram: WiredDiagram, point: OperatingPoint) -> WiredDiagram:
    """Return the diagram with the parameters of an operating point, and with its FMUs started in their states there."""
    point.check_units(diagram.blocks, diagram.name)
    changes: dict[str, Any] = dict(point.parameters)
    variant = diagram.replace(changes) if changes else diagram
    blocks: dict[str, Any] = {}
    for path, known in (*point.plants.items(), *_settable(variant, point)):
        block: Any = variant.blocks[path]
        try:
            blocks[path] = block.replace(start={**block.start, **known["state"]})
        except LoopwrightError as error:
            there = _started_there(block, known)
            if there is not None:
                blocks[path] = there
                continue
            reached = point.how is PointOrigin.RUN
            step = "Leave start out, and run from t = 0." if reached else "Let a run settle there, and give its time."
            raise FmuError(
                f"a run can't start at this operating point, because a state can't be set at the FMU's start: "
                f"{error.message} {step}",
                block=path,
            ) from error
    return variant.replace(blocks) if blocks else variant


def _started_there(block: Any, known: Mapping[str, Any]) -> Any:
    """Return an FMU that starts in its states at a point, as far as they can be set; None where the others differ."""
    about, ports = block.description, block.input_variables
    exact = {n: v for n, v in known["state"].items() if about.find(n).initial == "exact"}
    made = block.replace(start={**block.start, **exact})
    inputs = {ports[port].name: value for port, value in known["inputs"].items()}
    with made.replace(start={**made.start, **inputs}).instantiate((), None, start_time=known["t"]) as instance:
        found = instance.operating_point()["state"]
    same = all(np.allclose(found[n], v, rtol=SAME, atol=SAME) for n, v in known["state"].items())
    return made if same else None


def _settable(diagram: WiredDiagram, point: OperatingPoint) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the FMUs in model exchange, with those states at a point that they take as start values."""
    # Their continuous states are in x, so that a run begins with these in any case.
    for path, known in point.exchanged.items():
        block: Any = diagram.blocks[path]
        exact = {n: v for n, v in known["state"].items() if block.description.find(n).initial == "exact"}
        yield path, {"state": exact}


def copy_states(values: np.ndarray, old: FlatDiagram, new: FlatDiagram, into: np.ndarray) -> None:
    """Write a vector x of one diagram into that of another, whatever is under the same name in both."""
    others = [(getattr(old, name), getattr(new, name)) for name in ("held", "gates", "starts", "loops")]
    for theirs, mine in ((old.states.each, new.states.each), *others):
        for key, where in theirs.slices.items():
            if key in mine.slices and mine.shapes[key] == theirs.shapes[key]:
                into[mine.slices[key]] = values[where]


def start_at(workspace: Workspace, point: OperatingPoint, name: str) -> int:
    """Put a run that has been initialized to the instant just before an operating point's tick; return that tick."""
    flat, here = workspace.flat, workspace.here
    tick = point.tick * point.base / flat.base
    if tick.denominator != 1:
        raise OptionError(
            f"the operating point is at t = {point.t:.9g} s; this run has ticks of {float(flat.base):g} s, and none of "
            f"them is there. Give step={float(point.base):g}, or find the point with this step.",
            block=name,
            port="start",
        )
    if point.x.size != here.x.size or point.w.size != here.w.size:
        raise OptionError(
            f"it is the operating point of another diagram: found {point.x.size} entries of state, expected "
            f"{here.x.size}. Find one with diagram.trim(…) or diagram.operating_point(…) of this diagram.",
            block=name,
            port="start",
        )
    workspace.put(point.t, point.x, point.w)
    return int(tick)


def check_past(point: OperatingPoint, delays: Delays, name: str) -> None:
    """Refuse to start a run with dead times from a point of a run that moves: what has gone in before is unknown."""
    if point.how is not PointOrigin.RUN:  # at rest what has gone in is what comes out, as where states are given
        return
    moved = [
        np.abs(point.z[where] - point.w[out]) / (1.0 + np.abs(point.w[out]))
        for where, out in zip(delays.inputs, delays.outputs, strict=True)
    ]
    most = max(float(np.max(np.concatenate(moved))), point.residual)
    if not most <= _AT_REST:
        raise OptionError(
            f"the operating point at t = {point.t:.9g} s moves (by {most:.3g} relative to 1 + its size; expected at "
            f"most {_AT_REST:g}), and it doesn't hold what is inside the diagram's TransportDelay. Continue the run "
            "itself with start=run.final_state, or start from a point at rest: diagram.trim(…).",
            block=name,
            port="start",
        )


def take_over(workspace: Workspace, x: np.ndarray, of: FlatDiagram, acting: frozenset[TickPattern]) -> None:
    """Put a run to the states of another diagram, whatever is under the same name in both, and go through a tick."""
    # States that only this diagram has, such as those of a delay, take the values that they settle at while the others
    # are held.
    flat, here = workspace.flat, workspace.here
    marked = np.zeros(flat.width)
    copy_states(x, of, flat, here.x)
    copy_states(np.ones(x.size), of, flat, marked)
    known, kept = marked > 0, here.x.copy()
    for _ in range(PASSES):
        workspace.evaluate(acting)
        new = np.where(known, kept, workspace.x_next)
        if np.array_equal(new, here.x):
            break
        here.x[:] = new
    workspace.tick(acting)

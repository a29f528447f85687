"""Variants of a diagram: as it is implemented, and the linear model of each at its operating point.

Each runs to its own point, or takes over a given one by the names of states.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import BetweenTicksError, Finding, LoopwrightError, OptionError, PeriodicLoopError
from ..flat import FlatDiagram, WiredDiagram
from ..frequency import Number, margins
from ..linearization import (
    FreeMotions,
    Linearization,
    capture,
    find_signal,
    linearize,
    operating_point,
    with_passed_values,
)
from ..plotting import BLUE, DARK, GREEN, PURPLE, STONE, VERMILION
from ..results import OperatingPoint, PointOrigin, Snapshot
from ..simulation import apply_point
from ..studies import is_zero
from .wires_on_loops import ways_through

AT_REST = 1e-6
"""Largest change of a state, relative to 1 + its size, at which nothing is said to move."""
STEP = Fraction(1, 1000)
"""Communication step in s at which a diagram without a clock is run to its operating point."""


class Implementation(StrEnum):
    """A way in which a diagram is implemented; its value is in dotted paths."""

    CONTINUOUS = "continuous"
    """Everything that is sampled is taken as ideal."""
    SAMPLED = "sampled_d0"
    """As it is sampled, without computational delay."""
    DELAYED = "sampled_d1"
    """As it is sampled, with a sample of computational delay."""
    OWN = "sampled_own"
    """As it is sampled, with its own delays, which are neither none nor one sample each."""

    @property
    def delay(self) -> int:
        """Samples of computational delay."""
        return 1 if self is Implementation.DELAYED else 0


LOOKS: Mapping[str, tuple[str, Any]] = {
    Implementation.CONTINUOUS: (STONE, "-"),
    Implementation.SAMPLED: (GREEN, "-"),
    Implementation.DELAYED: (VERMILION, (0, (4, 2))),
}
OTHER = ((PURPLE, (0, (4, 2))), (DARK, (0, (1, 1.5))), (PURPLE, (0, (1, 1.5))))


def look_of(key: str, i: int) -> dict[str, Any]:
    """Return the color and line of the i-th variant of a report; the first, the diagram as it is, is blue."""
    if i == 0:
        return {"color": BLUE, "linestyle": "-", "linewidth": 1.7, "zorder": 3}
    color, line = LOOKS.get(key) or OTHER[i % len(OTHER)]
    return {"color": color, "linestyle": line}


class Cut(StrEnum):
    """A way in which a loop is cut; the value of all but the plain one is in dotted paths."""

    PLAIN = ""
    """All other loops closed, L at one rate."""
    SLOW_OPEN = "slow_open"
    """The loops of slower subsystems open."""
    PERIODIC = "periodic"
    """All other loops closed, with a channel for each renewal of the wire."""

    def loop(self, model: Linearization, *wires: str) -> Any:
        """Return the loop transfer function of a linear model at wires."""
        if self is Cut.SLOW_OPEN:
            return model.loop(*wires, slow="open")
        return model.loop(*wires, lifted=self is Cut.PERIODIC)


@dataclass(eq=False)
class Variant:
    """A diagram that is analysed: itself, without sampling, with a delay."""

    key: str  # its part of dotted paths, such as ``sampled_d0``
    title: str
    diagram: WiredDiagram
    where: Any  # the operating point, or where it is looked for; the start without it
    implementation: Implementation
    # Others than the design show what a real plant adds to it; they get margins, but no figures, and python-control is
    # not asked about them.
    is_design: bool = True
    is_actual: bool = False  # whether it is the diagram as it is, with nothing left out and nothing added
    problem: str = ""  # why it can't be analysed
    source: WiredDiagram | None = None  # the diagram of an operating point that is taken over
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    stairs: str | None = None
    required: tuple[str, ...] = ()  # wires and ports: a motion that changes one of them is not free
    every_state: bool = False  # whether free motions count as any other: the strict rule
    _loops: dict[tuple[Any, ...], Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def point(self) -> OperatingPoint:
        """Its operating point."""
        return point_of(self.diagram, self.where, self.source)

    @cached_property
    def model(self) -> Linearization:
        """Its linear model."""
        return linearize(self.diagram, self.point, inputs=self.inputs, outputs=self.outputs, stairs=self.stairs)

    @property
    def free(self) -> FreeMotions:
        """Its free motions, which are no instability; none by the strict rule."""
        if self.every_state:
            return FreeMotions.none(len(self.model.states))
        flat = self.diagram.flatten_like(self.point)
        return self.model.free_motions([name for name in self.required if _has(flat, name)])

    @property
    def poles(self) -> np.ndarray:
        """Poles of its linear model but for those of memory and of free motions."""
        return self.model.poles_without(self.free)

    def loop(self, *wires: str, cut: Cut = Cut.PLAIN) -> Any:
        """Return the loop transfer function at wires, computed once."""
        if (wires, cut) not in self._loops:
            self._loops[wires, cut] = cut.loop(self.model, *wires)
        return self._loops[wires, cut]

    def loop_ahead(self, wire: str, inputs: Iterable[str]) -> Any:
        """Return the loop transfer function of a wire ahead of some consumers, computed once; of all without them.

        Where the loops through slower subsystems make the loop periodic, they are open.
        """
        key = (wire, *inputs, "ahead")
        if key not in self._loops:
            try:
                self._loops[key] = self.model.loop(wire, to=tuple(inputs))
            except PeriodicLoopError:
                self._loops[key] = self.model.loop(wire, to=tuple(inputs), slow="open")
        return self._loops[key]

    def number_ahead(self, name: str, wire: str, inputs: Iterable[str]) -> Number | None:
        """Return a number of the loop at a wire ahead of some consumers; NaN where it has none.

        None where nothing comes back from these consumers at the operating point.
        """
        try:
            L = self.loop_ahead(wire, inputs)
            if is_zero(L):
                return None
            numbers: Mapping[str, Number] = margins(L).numbers()
        except LoopwrightError:
            return Number(math.nan, "1", 0.0, "")
        return numbers.get(name, Number(math.nan, "1", 0.0, ""))

    def fullest_loop(self, wire: str) -> tuple[Cut, str, Any]:
        """Return the cut that leaves the most closed at one rate, its title, and the loop transfer function.

        Where the loops through slower subsystems make the loop periodic, they are open.
        """
        if (wire, "fullest") not in self._loops:
            try:
                found = Cut.PLAIN, self.title, self.loop(wire)
            except PeriodicLoopError:
                found = Cut.SLOW_OPEN, f"{self.title}, slow loops open", self.loop(wire, cut=Cut.SLOW_OPEN)
            self._loops[wire, "fullest"] = found
        return self._loops[wire, "fullest"]  # type: ignore[no-any-return]

    def acts_between_ticks(self, wire: str) -> bool:
        """Return whether a wire has no loop as it changes between ticks, and blocks in continuous time use it there."""
        try:
            self.fullest_loop(wire)
        except BetweenTicksError:
            return True
        except LoopwrightError:
            return False
        return False

    def goes_by_slower(self, wire: str) -> bool:
        """Return whether nothing comes back to a wire but through slower subsystems, as behind a fast sensor."""
        try:
            cut, _, L = self.fullest_loop(wire)
        except LoopwrightError:
            return False
        return cut is Cut.SLOW_OPEN and is_zero(L)

    def loops_elsewhere(self, wire: str, others: Iterable[str]) -> tuple[str, ...]:
        """Return those of other wires that each loop through a wire without a loop at its own ticks goes through."""
        # none where the wire has such a loop, and where a loop goes through none of the others
        others = tuple(other for other in others if not self.goes_by_slower(other))
        if not others or not (self.acts_between_ticks(wire) or self.goes_by_slower(wire)):
            return ()
        return ways_through(self.diagram.flatten_like(self.point), wire, others)

    def findings(self, *wires: str) -> tuple[Finding, ...]:
        """Return the findings that limit the numbers of the loop at wires."""
        found: tuple[Finding, ...] = self.loop(*wires).findings
        return found

    @property
    def rests(self) -> bool:
        """Whether nothing moves at its operating point; False where it can't be analysed there."""
        try:
            moves = max(self.point.residual, float(np.max(np.abs(self.model.affine), initial=0.0)))
        except LoopwrightError:
            return False
        return moves < AT_REST

    @property
    def moves_most(self) -> str:
        """State that moves most at its operating point, free motions aside."""
        if not self.free:
            return self.point.largest
        V, affine = self.free.V, self.model.affine
        return str(self.model.states[int(np.argmax(np.abs(affine - V @ np.linalg.lstsq(V, affine)[0])))])

    @property
    def moving_alone(self) -> tuple[str, ...]:
        """States that move at its operating point though nothing depends on them; empty where others move as well."""
        model = self.model
        moving = [i for i, change in enumerate(model.affine) if not abs(change) <= AT_REST]
        if moving and self.free:
            V = self.free.V
            left = model.affine - V @ np.linalg.lstsq(V, model.affine)[0]
            if np.max(np.abs(left)) <= AT_REST:
                return tuple(model.states[i] for i in moving)
        fed = model.A - np.eye(len(model.A)) if model.dt else model.A
        if model.delays is not None:
            fed = np.vstack([fed, model.delays.Z])
        if not moving or np.max(np.abs(fed[:, moving])) > 1e-9 * (model.dt or 1.0):
            return ()
        return tuple(model.states[i] for i in moving)

    def with_parameters(self, changes: Mapping[str, Any], where: Any = ...) -> Variant:
        """Return the variant with other parameters, at its own operating point, or at another one."""
        where = self.where if where is ... else where
        return replace(self, diagram=self.diagram.replace(changes), where=where, problem="")


def _has(flat: FlatDiagram, name: str) -> bool:
    """Whether a diagram has a wire or port; variants may have other ones."""
    try:
        return bool(find_signal(flat, name).entries)
    except LoopwrightError:
        return False


def in_s(poles: Any, dt: float) -> np.ndarray:
    """Return poles in 1/s; of those of a sampled model, z, without those at z = 0: memory, or a delay."""
    values = np.asarray(poles, dtype=complex)
    return np.asarray(np.log(values[np.abs(values) > 1e-12]) / dt if dt else values)


def point_of(diagram: WiredDiagram, where: Any, source: WiredDiagram | None = None) -> OperatingPoint:
    """Return the operating point of a variant.

    The variant is run to a time in s, or to that of a point which a run has reached. A point that was found or given is
    taken over by the names of its states; ``source`` is its diagram.
    """
    options: dict[str, Any] = {}
    if diagram.has_fmu and not diagram.has_clock:
        options["step"] = STEP
    if isinstance(where, Snapshot) or (isinstance(where, OperatingPoint) and where.how is PointOrigin.RUN):
        where = where.t
    if not isinstance(where, OperatingPoint):
        return operating_point(diagram, where, options)
    try:
        where.check_fits(diagram.flatten_like(where), diagram.name)
    except OptionError:
        return _taken_over(diagram, where, diagram if source is None else source, options)
    return with_passed_values(diagram, where)


def _taken_over(
    diagram: WiredDiagram, point: OperatingPoint, source: WiredDiagram, options: dict[str, Any]
) -> OperatingPoint:
    """Return a point of another diagram as one of this diagram: its FMUs', and its blocks' states by their names.

    States that only this diagram has, such as those of a delay, take the values that they settle at while all others
    are held.
    """
    from ..simulation import RunOptions, Simulation

    old = source.flatten_like(point)
    if not diagram.has_clock:
        options = {**options, "step": point.base}
    with Simulation(apply_point(diagram, point), RunOptions.of(options, block=diagram.name)) as simulation:
        simulation.take_over(point.x, old)
        return replace(capture(simulation, point.how), parameters=point.parameters)

"""An operating point: an instant of a diagram at which it is linearized, or a run begins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from typing import Any, ClassVar, cast

import numpy as np

from ...blocks.core import (
    Finding,
    Grid,
    OptionError,
    Sheet,
    ShownAsTable,
    brief,
    count_of,
    enumerate_some,
    explain_calls,
    same_unit,
    shorten,
)
from ..flat import FlatDiagram
from ..wiring import explain_absent_state
from .saved_state import StateLayout, layout_of


class PointOrigin(StrEnum):
    """The origin of an operating point."""

    RUN = "run"
    """A run has reached it."""
    TRIM = "trim"
    """A trim has found it."""
    GIVEN = "given"
    """Its states were given."""


@dataclass(frozen=True)
class FreeDirection(Finding):
    """A direction in which a trim is not unique: states and parameters that may change together.

    Attributes
    ----------
    entries : tuple of (str, float)
        Name and share of each; the largest share is 1.
    """

    limits_numbers: ClassVar[bool] = False
    entries: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        shares = ", ".join(f"{name} by {share:.6g}" for name, share in self.entries)
        return (
            f"the trim is not unique: nothing determines the change of {shares}; it stays near where the search began"
        )


def units_of(blocks: Mapping[str, Any], paths: Iterable[str]) -> dict[str, str]:
    """Return the units of the states and ports of some FMUs, by their dotted paths, as far as they have any."""
    found: dict[str, str] = {}
    for path in paths:
        block = blocks[path]
        if not hasattr(block, "output_variables"):  # a user's block that is stepped, and no FMU
            continue
        about = block.description
        variables = {name: about.find(name) for name in (*about.states, *about.discrete_states)}
        for name, variable in {**variables, **block.output_variables, **block.input_variables}.items():
            if variable.unit is not None:
                found[f"{path}.{name}"] = variable.unit
    return found


@explain_calls
@dataclass(frozen=True, eq=False)
class OperatingPoint(ShownAsTable):
    """An instant of a diagram: everything that its linear model depends on.

    `Diagram.operating_point` makes one by a run, `Diagram.trim` by solving for it. ``diagram.linearize(run.at(t))``
    makes one of a recorded instant.

    Attributes
    ----------
    t : float
        Time in s.
    tick : int
        Its tick, on the base ``base`` (seconds, exact).
    x : ndarray
        The vector x of the flattened diagram just before the tick.
    w, z : ndarray
        Outputs of the FMUs at the tick, and their inputs from then on.
    plants : mapping
        Time, states and inputs of each FMU by path, as `Fmu.linear_model` takes them.
    residual : float
        Distance from an equilibrium: the largest change of a state over the next tick, and of a continuous state in
        one second, relative to 1 + its size. States of FMUs count by their rates, or by their change over a step where
        an FMU doesn't give its rates. It means the same for points of all origins; ``residuals`` holds the remainders
        of a trim's equations.
    largest : str
        The block with that residual, of an FMU its state; empty where nothing moves.
    unjudged : tuple of str
        Paths of the FMUs that list no states: ``residual`` leaves out what they may hide. A trim watches their outputs
        for 10 steps from their start, with held inputs, and ``residuals`` has how far they move.
    how : PointOrigin
        Its origin: "run", "trim" or "given".
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
    unjudged: tuple[str, ...] = ()
    how: PointOrigin = PointOrigin.RUN
    exchanged: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Time, states and inputs of each FMU in model exchange by path; its continuous states are in x, too."""
    values: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Every signal at the tick by its path."""
    layout: StateLayout = field(default=(), repr=False)
    """Names and shapes of the entries of its vectors: diagrams with equal layouts can exchange operating points."""
    units: Mapping[str, str] = field(default_factory=dict, repr=False)
    """Units of the FMUs' states and ports at the point, by their dotted paths."""
    asked: bool = False
    """Whether ``base`` was asked for, as a ``step``: FMUs step at every tick then."""
    coupling: str = ""
    """Coupling of the FMUs in the run that has reached it, where it is not the default."""
    coupling_order: tuple[str, ...] = ()
    """Paths of the FMUs in the order in which they step there, where one steps after the other."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that a trim has found with it, by path, as `Diagram.replace` takes them."""
    free: tuple[FreeDirection, ...] = ()
    """Directions that a trim left free, to first order: with targets or fixed states for them it is unique."""
    residuals: Mapping[str, float] = field(default_factory=dict, repr=False)
    """Remainder of each equation of a trim by name, largest first, relative to 1 + the size of its quantity."""

    def check_fits(self, flat: FlatDiagram, name: str) -> None:
        """Refuse the operating point of a diagram with other blocks, states or ports."""
        sizes = (self.x.size, self.w.size, self.z.size)
        needed = (flat.width, flat.plant_outputs.total, flat.plant_inputs.total)
        if sizes == needed and (not self.layout or self.layout == layout_of(flat)):
            return
        blocks = flat.table.blocks
        here, there = (dict(layout[0]) if layout else {} for layout in (layout_of(flat), self.layout))
        reasons = [f" Here {r}" for name in there if name not in here and (r := explain_absent_state(blocks, name))]
        lacking = [f" It lacks the state {name!r}." for name in here if there and name not in there]
        raise OptionError(
            "found the operating point of a diagram with other blocks or wires; expected one of this diagram."
            f"{next(iter((*reasons, *lacking)), '')} Make it with diagram.operating_point(t), or linearize(t).",
            block=name,
            port="operating point",
        )

    def check_units(self, blocks: Mapping[str, Any], name: str) -> None:
        """Refuse the operating point of a diagram whose FMUs have their states or ports in other units.

        Its numbers are in the units of the FMUs that it was found with; in another unit they would be others.
        """
        here = units_of(blocks, (*self.plants, *self.exchanged))
        for path, unit in self.units.items():
            if path in here and not same_unit(unit, here[path]):
                raise OptionError(
                    f"found an operating point with {path} in {unit}; expected {here[path]}, the unit of the FMU in "
                    "this diagram. Make the point with this diagram: diagram.operating_point(t).",
                    block=name,
                    port="operating point",
                )

    def __repr__(self) -> str:
        moves = f"residual {self.residual:.3g}" + (f" by {self.largest}" if self.largest else "")
        found = enumerate_some(f"{name} = {shorten(value)}" for name, value in self.parameters.items())
        facts = (
            self.how.value,
            count_of(self.x.size, "state"),
            moves,
            found,
            count_of(len(self.free), "free direction") * bool(self.free),
        )
        return brief(f"operating point at t = {self.t:.9g} s", *facts, then="diagram.linearize(point)")

    def _sheet(self) -> Sheet:
        moves = f"{self.residual:.3g}" + (f" by {self.largest}" if self.largest else "")
        return Sheet(
            f"operating point at t = {self.t:.9g} s",
            (("origin", self.how.value), ("residual", moves), ("not judged", enumerate_some(self.unjudged))),
            (
                Grid("Parameters", ("name", "value"), tuple(self.parameters.items())),
                Grid("States", ("state", "value", "unit"), tuple(self._state_rows())),
            ),
            tuple(map(str, self.free)),
        )

    @property
    def states(self) -> dict[str, np.ndarray]:
        """States of blocks and FMUs by their dotted paths, in their shapes and units, just before the tick.

        An exported controller that begins at the point is given them: see docs/howto/export_a_controller.md.
        """
        found, first = {}, 0
        for name, shape in self.layout[0] if self.layout else ():
            size = math.prod(cast("tuple[int, ...]", shape))
            found[name] = np.array(self.x[first : first + size]).reshape(cast("tuple[int, ...]", shape))
            first += size
        for path, about in {**self.plants, **self.exchanged}.items():
            if path not in self.exchanged:  # whose continuous states are in x, too
                found |= {f"{path}.{name}": np.array(value) for name, value in about["state"].items()}
        return found

    def _state_rows(self) -> Iterator[tuple[str, Any, str]]:
        """Yield the name, value and unit of each state, those of FMUs too."""
        for name, values in self.states.items():
            yield from _entries(name, np.ravel(values), self.units.get(name, ""))


def _entries(name: str, values: np.ndarray, unit: str) -> Iterator[tuple[str, Any, str]]:
    for k, value in enumerate(values):
        yield f"{name}[{k + 1}]" if len(values) > 1 else name, float(value), unit

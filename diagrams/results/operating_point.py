"""An operating point: an instant of a diagram at which it is linearized, or a run begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core.errors import OptionError
from ..flat.flat_diagram import FlatDiagram
from .saved_state import layout_of


class PointOrigin(StrEnum):
    """The way in which an operating point was made."""

    RUN = "run"
    """A run has reached it."""
    TRIM = "trim"
    """A trim has found it."""
    GIVEN = "given"
    """Its states were given."""


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
        How far it is from an equilibrium: the largest change of a state over the next tick, and of a continuous state
        in one second, relative to 1 + its size. States of FMUs count: by their rates, or by their change over a step
        where the rates are not to be had. It means the same however the point was found; what a trim has left of its
        equations is in ``residuals``.
    largest : str
        The block with that residual, of an FMU its state; empty where nothing moves.
    how : PointOrigin
        The way in which it was made: "run", "trim" or "given".
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
    how: PointOrigin = PointOrigin.RUN
    values: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Every signal by its path, then."""
    layout: tuple[Any, ...] = field(default=(), repr=False)
    """What its vectors mean: two diagrams with one of these can exchange operating points."""

    def check_fits(self, flat: FlatDiagram, name: str) -> None:
        """Refuse the operating point of a diagram with other blocks, states or ports.

        Raises
        ------
        OptionError
            If it is one.
        """
        sizes = (self.x.size, self.w.size, self.z.size)
        needed = (flat.width, flat.plant_outputs.total, flat.plant_inputs.total)
        if sizes == needed and (not self.layout or self.layout == layout_of(flat)):
            return
        raise OptionError(
            "it is the operating point of a diagram with other blocks or wires. Make one of this diagram: "
            "diagram.operating_point(t), or linearize(t).",
            block=name,
            port="operating point",
        )

    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that belong to it, where a trim has found them, by path, as `Diagram.replace` takes them."""
    residuals: Mapping[str, float] = field(default_factory=dict, repr=False)
    """What a trim has left of each of its equations, by name, largest first, relative to 1 + the size of what they
    belong to."""

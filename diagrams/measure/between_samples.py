"""Instants between two samples at which a step response is read, as the plant moves on there.

A sampled loop's response at its ticks says little about a plant that rings between them: a mode near 2π/T looks at
rest at every tick. So signals that are not held are read several times in each sample, and the linear model says what
may still lie between two of these instants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...blocks.core import LoopwrightError
from ..flat import FlatDiagram, WiredDiagram, own_step, takes_any_step
from ..linearization import Linearization, find_flow_poles, linearize_within
from ..results import OperatingPoint
from ..wiring import stepped_blocks

LEAST, MOST = 8, 64
"""Instants in a sample: fewest and most."""
TURN = 0.25
"""Part of a mode's time constant, or of a radian of it, from one instant to the next."""
LOOKED = 4
"""Instants at which the linear model is looked at, for each one that is read."""
ROWS = 200_000
"""Rows of a record up to which there are more instants than the fewest."""
SMOOTH = 0.5
"""Part of a mode's time constant, or of a radian of it, in a sample, up to which parabolas bound what lies between."""
BETWEEN = 0.01
"""Motion between communication points, relative to the whole response, from which on FMUs take shorter steps."""


@dataclass(frozen=True)
class Instants:
    """Instants of a sample at which signals are read."""

    finer: int = 1  # ticks of the run for each tick of the diagram
    count: int = 1  # instants in a sample; they divide its ticks evenly
    looked: int = 1  # parts of a tick of the diagram at which the linear model is looked at
    turns: float = 0.0  # time constants of the fastest mode between two ticks, or radians of it, in a sample


def moves_between(flat: FlatDiagram, port: tuple[str, str]) -> bool:
    """Return whether a block's signal follows continuous states, or time, between two ticks."""
    output = flat.output(port)
    return bool(output.depends("y", "x")[:, flat.continuous].any() or output.depends("y", "t").any())


def choose_instants(diagram: WiredDiagram, point: OperatingPoint, ticks: int, samples: int) -> Instants:
    """Return the instants of so many samples that are ``ticks`` of the diagram long, by its poles between two ticks."""
    try:
        poles = find_flow_poles(diagram, point)
    except LoopwrightError:  # an FMU that gives no equations
        poles = np.zeros(0)
    period = float(point.base * ticks)
    most = min(MOST, max(LEAST, ROWS // max(samples, 1)))
    turns = period * float(np.max(np.abs(poles), initial=0.0))
    wanted = int(np.clip(np.ceil(turns / TURN), LEAST, most))
    finer = -(-wanted // ticks)
    count = min(n for n in range(1, ticks * finer + 1) if ticks * finer % n == 0 and n >= wanted)
    return Instants(finer, count, finer * max(1, -(-LOOKED * count // (ticks * finer))), turns)


def can_step_finer(diagram: WiredDiagram) -> bool:
    """Return whether every FMU of a diagram takes shorter communication steps than its ticks."""
    plants = stepped_blocks(diagram.structure).values()
    return all(takes_any_step(plant) and own_step(plant) is None for plant in plants)


def _without_own_steps(diagram: WiredDiagram) -> WiredDiagram:
    """Return a diagram whose FMUs step at any tick: a linear model of their equations does."""
    plants = stepped_blocks(diagram.structure).items()
    own = {
        f"{path}.stepping": replace(given, communication_step=None)
        for path, plant in plants
        if own_step(plant) is not None and (given := getattr(plant, "stepping", None)) is not None
    }
    return diagram.replace(own)


class WithinSamples:
    """The linear model between the ticks of a sampled diagram, with one input that is held over each sample.

    Its ``outputs`` are as many at each instant; instants divide the period evenly (`linearize_within`).
    """

    def __init__(self, model: Linearization, outputs: int):
        self.model, self.outputs = model, outputs
        self.instants = len(model.C) // outputs

    @classmethod
    def of(
        cls,
        diagram: WiredDiagram,
        point: OperatingPoint,
        parts: int,
        wire: str,
        names: Sequence[str],
        outputs: int,
        stairs: str | None,
    ) -> WithinSamples | None:
        """Return the model from a wire to it and to other signals, of so many entries; None where there is none."""
        try:
            free = _without_own_steps(diagram)
            model = linearize_within(free, point, parts, inputs=[wire], outputs=[wire, *names], stairs=stairs)
        except LoopwrightError:
            return None
        return cls(model, outputs)

    def respond(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the outputs of all instants to an input with a value for each sample, and the state at the end.

        The outputs have a row for each instant up to the first one of the last sample. The state is that at the
        beginning of the last sample.
        """
        model, n = self.model, len(self.model.A)
        z, states = np.zeros(n), np.zeros((len(d), n))
        for k, value in enumerate(d):
            states[k] = z
            z = model.A @ z + model.B[:, 0] * value
        rows = (states @ model.C.T + np.outer(d, model.D[:, 0])).reshape(-1, self.outputs)
        return rows[: len(rows) - self.instants + 1], states[-1]

    def read(self, rows: np.ndarray, count: int) -> np.ndarray:
        """Return the rows of ``count`` instants of each sample."""
        return rows[:: self.instants // count]

    def between(self, rows: np.ndarray, count: int) -> np.ndarray:
        """Return the largest size of each output, less that at ``count`` instants of each sample.

        Between the instants at which the model is looked at there are parabolas.
        """
        parts = rows[:-1].reshape(-1, self.instants, self.outputs)
        bend = np.max(np.abs(np.diff(parts, 2, axis=1)), axis=(0, 1), initial=0.0) / 8
        return np.asarray(np.max(np.abs(rows), axis=0) + bend - np.max(np.abs(self.read(rows, count)), axis=0))

    def moves_by(self, samples: int, entries: np.ndarray) -> float:
        """Return the largest motion between samples of some outputs, relative to their size, after a step.

        It is the distance of the outputs from a straight line from one sample to the next.
        """
        rows, _ = self.respond(np.ones(samples))
        rows, n = rows[:, entries], self.instants
        ends, part = rows[::n], (np.arange(n) / n)[None, :, None]
        lines = ends[:-1, None] * (1.0 - part) + ends[1:, None] * part
        off = np.max(np.abs(rows[:-1].reshape(lines.shape) - lines), axis=(0, 1))
        size = np.max(np.abs(rows), axis=0)
        return float(np.max(np.divide(off, size, out=np.zeros_like(off), where=size > 0.0)))

"""Communication steps of an FMU from states and inputs next to an operating point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .fmu import Fmu, setup_of
from .fmu_point import FmuPoint, initialize_to_step, step_from


def take_shifted_steps(
    block: Fmu, h: float, t: float, state: Any, inputs: Any, shifts: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return states and outputs at the end of a step: from an operating point, then from each shifted point.

    Shifts are of all states and all inputs, as `FmuPoint.states` and `FmuPoint.inputs` lay them out.
    """
    point = FmuPoint(setup_of(block), t, state, inputs)
    about = point.about
    names = [*point.states, *point.inputs]
    layout = about.layout(names)
    moved = {n for n in names if any(np.any(np.concatenate(shift)[layout.slices[n]]) for shift in shifts)}
    point.check_states("Judge it by its linear model.")
    with initialize_to_step(point) as instance:
        at = np.concatenate([instance.values(point.states), instance.values(point.inputs)])

        def step(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            parts = layout.split(values)
            step_from(point, instance, h, {n: parts[n] for n in names if n in moved}, "steps can't be compared")
            return instance.values(point.states), instance.values(point.outputs)

        return [step(at + np.concatenate(shift)) for shift in ((0.0 * at, np.zeros(0)), *shifts)]

"""Sensitivities that a second computation has confirmed: differences of the margins themselves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

from ...blocks.core import ConfirmationError, accepts, kinds
from ..frequency import Confirmation
from ..linearization import loop_of_variant, trim
from .numbers import compared_numbers
from .sensitivity import Sensitivities, Sensitivity
from .varied_parameters import changed_entry

AGREEMENT = 1e-3
"""Relative difference up to which a difference of margins confirms a slope."""
STEP = 1e-3
"""Change of a parameter for a confirmation, relative to its size."""


@accepts(
    found=kinds.one_of_class(Sensitivities, "the result of Diagram.sensitivities"),
    row=kinds.one_of_class(Sensitivity, "one of the sensitivities found, such as found[name, 'ms']"),
    delay=kinds.whole,
    skew=kinds.number,
)
def confirm_sensitivity(found: Sensitivities, row: Sensitivity, *, delay: int = 0, skew: float = 0.0) -> Sensitivity:
    """Return a sensitivity that a second computation has confirmed: differences of the margin itself.

    The diagram is changed by ±0.1 % of the parameter, linearized at the point again, and its margin is computed.

    Raises
    ------
    ConfirmationError
        If the two disagree.
    """
    return confirm_parameter(found, row.parameter, [row.quantity], delay=delay, skew=skew)[0]


def confirm_parameter(
    found: Sensitivities, parameter: str, quantities: Iterable[str], *, delay: int = 0, skew: float = 0.0
) -> list[Sensitivity]:
    """Return the sensitivities of some numbers to one parameter, confirmed as by `confirm_sensitivity`.

    Raises
    ------
    ConfirmationError
        If a slope and the differences disagree.
    """
    model, rows = found.model, [found[parameter, quantity] for quantity in quantities]
    if model is None or not rows:
        return rows
    h = STEP * (abs(rows[0].value) or 1.0)

    def numbers(change: float) -> dict[str, float]:
        diagram = model.wired.replace(changed_entry(model.wired, parameter, rows[0].value + change))
        L, rests = loop_of_variant(model, found.wires, diagram, model.point)
        if model.is_equilibrium and not rests and not rows[0].rest_lost:
            point = trim(diagram, None, None, rates=None, fixed=(), at=model.point, tolerance=1e-9)
            L, rests = loop_of_variant(model, found.wires, diagram, point)
        return compared_numbers(L, [row.quantity for row in rows], delay, skew)

    def differences(h: float) -> dict[str, float]:
        high, low = numbers(h), numbers(-h)
        return {row.quantity: (high[row.quantity] - low[row.quantity]) / (2.0 * h) for row in rows}

    wide, narrow = differences(h), dict[str, float]()
    made = []
    for row in rows:
        if not math.isfinite(row.slope.value):
            made.append(row)
            continue
        other = wide[row.quantity]
        rounding = 10 * row.number.tolerance / h + AGREEMENT * abs(row.number.value * STEP) / h
        allowed = max(AGREEMENT * abs(row.slope.value), rounding, row.slope.tolerance)
        if not abs(other - row.slope.value) <= allowed:  # the margin may bend over the step: extrapolate to none
            narrow = narrow or differences(h / 2.0)
            other = (4.0 * narrow[row.quantity] - other) / 3.0
        if not abs(other - row.slope.value) <= allowed:
            raise ConfirmationError(
                f"found {row.slope.value:.9g} as the derivative of {row.quantity} by {parameter}, but differences of "
                f"the margin give {other:.9g}; expected the same to {AGREEMENT:g}. Look at the crossings near it: the "
                "margin may have a kink there.",
                block=model.wired.name,
            )
        how = Confirmation(row.slope.confirmed_by).and_by(
            f"differences of the margin of the changed diagram give {other:.6g}",
            "differences of the margin of the changed diagram",
        )
        made.append(replace(row, slope=replace(row.slope, confirmed_by=how)))
    return made

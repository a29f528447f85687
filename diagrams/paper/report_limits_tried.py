"""Limits tried in time domain, and what is not modelled."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from ...blocks.core.errors import ConfirmationError, LoopwrightError
from ..admittance.compliance_loop import AdmittanceLoop
from ..admittance.coupled import growth_rate
from ..frequency.number import Number
from ..report.case import FRICTION, Case
from ..report.model import Section, Table
from .moored_gantry import deviation, measured_growth, moored_diagram
from .report_admittance import VARIANTS, Loops

TITLE = "Limits tried in time domain"
FACTORS = {"below": 0.97, "above": 1.03}
START, SPAN, WINDOW = 3.5, 1.0, 1.0  # s: when the growth is taken, over what, in windows of which length
WITHIN = 0.01  # 1/s: the growth factor over 1 s is then within 1 %
TRIED = (
    ("perp", "ke_limit", "sampled_d0", 10.0),
    ("perp", "ke_limit", "sampled_d1", 0.0),
    ("par", "ke_limit", "sampled_d0", 10.0),
    ("perp", "ke_limit" + FRICTION, "sampled_d0", 0.0),
    ("perp", "force_tracking.ke_limit", "sampled_d0", 10.0),
)
"""Which limits are tried: direction, which of its limits, implementation, damping in N s/m."""


def time_domain(case: Case, loops: Loops, limits: dict[str, Number]) -> Section:
    """Return the section in which the nonlinear co-simulation is run on both sides of limits.

    Parameters
    ----------
    case : Case
        What is analysed.
    loops : Loops
        Its reduced loops.
    limits : dict
        The numbers of the section on admittances.

    Raises
    ------
    ConfirmationError
        If the co-simulation does not grow as predicted.
    """
    text = [
        (
            "A gantry with the plant's parameters, whose linear model is the plant's own, under the same controller, "
            "with the environment inside its FMU in "
            "continuous time, is pushed by 1e-5 m/s at 0.97 and at 1.03 of a limit. Its growth rate is "
            "read off the energy "
            "of the position in two like windows 1 s apart; predicted is the real part of the slowest pole."
        ),
    ]
    if case.plant_model is None:
        text.append("Not done: the plant is not the gantry, and has no variant with an environment inside.")
        return Section("time_domain", TITLE, tuple(text))
    if case.has_events:
        text.append("Not done: the plant has discrete states, which the gantry with an environment inside does not.")
        return Section("time_domain", TITLE, tuple(text))
    numbers: dict[str, Number] = {}
    rows: list[tuple[Any, ...]] = []
    for side, key, name, damping in TRIED:
        path = f"{side}.{key}.{name}.be_{damping:g}"
        limit = limits.get(path)
        if limit is None or not math.isfinite(limit.value) or limit.value <= 0.0:
            continue
        kinds = {k: loop for k, _, loop in loops.kinds(side)}
        loop = kinds[key].replace(**VARIANTS[name])
        try:
            for where, number, predicted in _tried(loop, limit, damping, path):
                numbers[f"{path}.{where}.growth_rate"] = number
                k = FACTORS[where] * limit.value
                rows.append((path, f"{FACTORS[where]:g}", f"{k:.6g} N/m", number, f"{predicted:.6g} 1/s"))
        except ConfirmationError:
            raise
        except LoopwrightError as error:
            text.append(f"{path}: {error}")
    columns = ("limit", "of it", "k_e", "growth rate, measured", "predicted")
    return Section("time_domain", TITLE, tuple(text), (Table("Growth", columns, tuple(rows)),), (), numbers)


def not_tried(text: tuple[str, ...]) -> Section:
    """Return the section where there are no limits to try; ``text`` says why."""
    return Section("time_domain", TITLE, text)


def _tried(loop: AdmittanceLoop, limit: Number, damping: float, path: str) -> Iterator[tuple[str, Number, float]]:
    for where, factor in FACTORS.items():
        stiffness = factor * limit.value
        predicted = float(growth_rate(loop, stiffness=stiffness, damping=damping))
        run = moored_diagram(loop, 1e-5, stiffness=stiffness, damping=damping).simulate(
            START + SPAN + WINDOW, progress=False, record=["plant.position"], states=False
        )
        measured = measured_growth(deviation(loop, run), loop.sample_time, START, SPAN, WINDOW)
        if not abs(measured - predicted) < WITHIN or (measured < 0) is not (predicted < 0):
            raise ConfirmationError(
                f"found a growth rate of {measured:.5g} 1/s in the co-simulation at {factor:g} of the limit "
                f"{limit.value:.6g} N/m, predicted {predicted:.5g} 1/s; expected them within {WITHIN:g} 1/s.",
                block=path,
            )
        how = f"σ = {predicted:.6g} 1/s predicted by the eigenvalues of the reduced loop"
        yield where, Number(measured, "1/s", WITHIN, how), predicted


def not_modelled(case: Case, reduced: bool) -> Section:
    """Return the section on what the numbers above leave out."""
    text = [
        (
            "Linear models describe small motions around the operating points; saturation, limits of the path "
            "reference and "
            "changing path points are not in the margins."
        ),
    ]
    for v in case.usable():
        text += [f"{v.title}: {note}" for note in v.model.notes]
    for path, block in sorted(case.diagram.blocks.items()):
        kind = type(block).__name__
        if kind in ("Saturation", "Encoder", "Quantizer", "DeadZone", "Relay", "Backlash", "RateLimiter"):
            text.append(f"{path} ({kind}) acts by its slope at the operating point only.")
        if getattr(block, "has_limits", False):
            text.append(f"{path}: the limits of its path reference act on large motions only, and are not modelled.")
    if any(v.delay for v in case.usable()):
        text.append(
            "The computational delay is a whole number of samples. Jitter, lost samples and a delay of "
            "parts of a sample "
            "are not modelled; what a delay behind the controller does within a sample is delayed_hold_margin."
        )
    for v in case.usable():
        if v.model.uncertainty:
            text.append(
                f"{v.title}: the FMU was differenced; entries of its model are uncertain by {v.model.uncertainty:.3g}."
            )
    if reduced:
        text += [
            (
                "The environment acts in one direction, at one point, at rest. On a curved path the frame "
                "turns under a static "
                "force, which the reduced model leaves out; so does it the change of q with ξ."
            ),
            (
                "The rendered admittance of a sampled loop is its fundamental: aliases of a motion are "
                "not in it. Re Y ≥ 0 "
                "does not prove passivity."
            ),
            "Elasticity of drives and tool, sensor noise and filters are not in the model of the gantry.",
        ]
    if case.has_friction:
        text.append(
            "Friction is the smooth law F_c tanh(v/w): its slope at rest F_c/w is the largest; stiction "
            "is not modelled. "
            "In motion beyond w the slope is that of the viscous friction alone, and numbers lie near "
            "those without friction."
        )
    return Section("limits", "What is not modelled", tuple(dict.fromkeys(text)))

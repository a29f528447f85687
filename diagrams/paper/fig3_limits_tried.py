"""Limits of coupled stability, tried in the co-simulation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from ...blocks.core import ConfirmationError, LoopwrightError
from ..frequency import Confirmation, Number
from ..report import Implementation, Section, TableForm, Texts
from .compliance_loop import AdmittanceLoop
from .coupled_stability import growth_rate
from .fig3_admittance import not_shown
from .fig3_case import Fig3Case
from .moored_gantry import deviation, measured_growth, moored_diagram
from .reduced_loops import FRICTION, ReducedLoops, each_implementation

TEXTS = Texts(__package__, "limits_tried")
TITLE = "Limits tried in time domain"
FACTORS = {"below": 0.97, "above": 1.03}
START, SPAN, WINDOW = 3.5, 1.0, 1.0  # s: when the growth is taken, over what, in windows of which length
WITHIN = 0.01  # 1/s: the growth factor over 1 s is then within 1 %
TRIED = (
    ("perp", "ke_limit", Implementation.SAMPLED, 10.0),
    ("perp", "ke_limit", Implementation.DELAYED, 0.0),
    ("par", "ke_limit", Implementation.SAMPLED, 10.0),
    ("perp", "ke_limit" + FRICTION, Implementation.SAMPLED, 0.0),
    ("perp", "force_tracking.ke_limit", Implementation.SAMPLED, 10.0),
)
"""Which limits are tried: direction, which of its limits, implementation, damping in N s/m."""

GROWTH = TableForm(
    "Growth",
    {
        "limit": "limit",
        "share of it": "share",
        "k_e [N/m]": "stiffness",
        "growth rate, measured": "measured",
        "predicted [1/s]": "predicted",
    },
    {"measured": "{path}.{where}.growth_rate"},
)


def is_tried(case: Fig3Case) -> bool:
    """Return whether there are limits to try, or it is to be said here why there are none."""
    return isinstance(case.reduced, ReducedLoops) or (case.reduced is not None and "admittance" not in case.keys)


def limits_tried(case: Fig3Case) -> Section:
    """Return the section in which the nonlinear co-simulation is run on both sides of limits.

    Raises
    ------
    ConfirmationError
        If the co-simulation does not grow as predicted.
    """
    loops = case.reduced
    if not isinstance(loops, ReducedLoops):
        return Section("time_domain", TITLE, not_shown(case))
    text = [*TEXTS.paragraphs("pushed", below=FACTORS["below"], above=FACTORS["above"], span=SPAN)]
    if case.plant_model is None:
        return Section("time_domain", TITLE, (*text, TEXTS.line("no_gantry")))
    if case.has_events:
        return Section("time_domain", TITLE, (*text, TEXTS.line("discrete_states")))
    rows: list[dict[str, Any]] = []
    for side, key, implementation, damping in TRIED:
        path = f"{side}.{key}.{implementation}.be_{damping:g}"
        if key not in loops.kinds(side):
            continue
        limit = loops.limit(side, key, implementation, damping).number
        if not math.isfinite(limit.value) or limit.value <= 0.0:
            continue
        loop = each_implementation(loops.kinds(side)[key].loop)[implementation]
        variant = implementation + loops.kinds(side)[key].suffix
        title = case.variants[variant].title if variant in case.variants else variant
        said = TEXTS.line("limit", along=side == "par", tracking="." in key, damping=damping, variant=title)
        try:
            for where, number, predicted in _tried(loop, limit, damping, path):
                share = FACTORS[where]
                facts = {"limit": said, "share": share, "stiffness": share * limit.value, "predicted": predicted}
                rows.append({**facts, "measured": number, "path": path, "where": where})
        except ConfirmationError:
            raise
        except LoopwrightError as error:
            text.append(f"{path}: {error}")
    return Section("time_domain", TITLE, tuple(text), (GROWTH.fill(rows),))


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
        how = Confirmation(
            f"σ = {predicted:.6g} 1/s predicted by the eigenvalues of the reduced loop",
            "the prediction by the eigenvalues of the reduced loop",
        )
        yield where, Number(measured, "1/s", WITHIN, how), predicted

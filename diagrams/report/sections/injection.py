"""The injection check: linear models against sines added to wires of the running co-simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError, PeriodicLoopError
from ...frequency import Confirmation, Number
from ...linearization import Linearization, hold_sources
from ...measure import LEAST_SINE, FrequencyResponse, find_least_sine, frequency_response
from ...results import PointOrigin
from .. import figures
from ..case import Case, InjectionPlan
from ..error_sentences import say
from ..pages import Section, TableForm, Texts
from ..stability import Stability
from ..variant import Implementation, Variant

TEXTS = Texts(__package__, "injection")

WIRES = 2
"""Wires at most at which is measured: the first that can be."""
REFUTED = 0.05
"""A relative deviation beyond which a linear model is wrong."""
CONFIRMED = 1e-3

INJECTED = TableForm(
    "Injected against linearized",
    {
        "wire": "wire",
        "variant": "variant",
        "frequencies": "span",
        "largest deviation": "deviation",
        "uncertainty": "uncertainty",
        f"within {CONFIRMED:g}": "confirmed",
    },
    {"deviation": "{loop}.{key}.deviation", "uncertainty": "{loop}.{key}.uncertainty"},
)


def injected(case: Case) -> Section | None:
    """Return the section that compares each sampled loop with its measured response."""
    rows: list[dict[str, Any]] = []
    text: list[str] = []
    plots = []
    taken, skipped = 0, list[str]()
    shortened: InjectionPlan | None = None
    for key, wire in case.loop_wires().items():
        if taken == WIRES:
            break
        measured = {}
        refused = False  # by the wire itself: another one may be measured
        for v in case.usable(Implementation.SAMPLED, Implementation.DELAYED, Implementation.OWN):
            if v.implementation.delay and not (v.is_design or v.is_actual):
                continue
            if Stability.of(v) is Stability.UNSTABLE:
                text.append(TEXTS.line("unstable", variant=v.title, wire=wire))
                continue
            if not v.rests:
                text.append(TEXTS.line("moving", variant=v.title, wire=wire, **_moving(v)))
                continue
            try:
                case.notify(f"injection at {wire}, {v.title}")
                L = v.loop(wire)  # a wire without a loop at one rate needs no measurement
                plan = case.excitation(v, wire)
                least = find_least_sine(plan.variant.diagram, plan.variant.point, wire, L, plan.frequencies)
                if least is not None and least[0] > plan.amplitude:
                    said = {"usual": plan.amplitude, "block": least[1].converter, "many": LEAST_SINE}
                    plan = plan._replace(amplitude=least[0])
                    text.append(TEXTS.line("enlarged", variant=v.title, wire=wire, amplitude=plan.amplitude, **said))
                found, model = _measured(plan, wire), plan.variant.model
                if plan.left_out:
                    shortened = plan
                deviation = found.deviation(model, "L")
            except PeriodicLoopError:
                refused = True
                text.append(TEXTS.line("periodic", variant=v.title, wire=wire))
                continue
            except LoopwrightError as error:
                refused = True
                text.append(TEXTS.line("failed", variant=v.title, wire=wire, message=say(error)))
                continue
            worst, own = float(np.max(deviation)), float(np.max(found.uncertainty))
            if not np.isfinite(own):
                text.append(TEXTS.line("moved", variant=v.title, wire=wire, moved=found.moved))
                continue
            if own > REFUTED and least is not None:
                text.append(
                    TEXTS.line("no_range", variant=v.title, wire=wire, uncertainty=own, block=least[1].converter)
                )
            if worst - 10 * own > REFUTED:
                text.append(TEXTS.line("refuted", variant=v.title, wire=wire, deviation=worst))
            low, high = float(found.omega[0]), float(found.omega[-1])
            how = Confirmation(
                f"{len(found.omega)} sines from {low:.4g} to {high:.4g} rad/s, amplitude {found.amplitude:g}",
                "sines at these frequencies in the running co-simulation",
            )
            windows = "the last windows, a second amplitude, and the movement of the operating point"
            rows.append(
                {
                    "wire": wire,
                    "variant": v.title,
                    "loop": key,
                    "key": v.key,
                    "span": f"{low:.4g} … {high:.4g} rad/s",
                    "deviation": Number(worst, "1", max(own, 1e-12), how),
                    "uncertainty": Number(own, "1", own, windows),
                    "confirmed": "yes" if worst <= CONFIRMED and own <= CONFIRMED else "no",
                }
            )
            measured[v.key] = _curve(v.title, found, L)
        if refused and not measured:
            skipped.append(wire)
        else:
            taken += 1
        if measured:
            plots.append(figures.injected(wire, measured, case.axes, case.looks, f"injection_{key}"))
    if skipped:
        text.append(TEXTS.line("skipped", wires=", ".join(skipped), many=WIRES))
    if not rows:
        return Section("injection", "Injection check", tuple(text)) if text else None
    if shortened is not None:
        count, samples = len(shortened.frequencies), shortened.samples
        text = [TEXTS.line("shortened", count=count, every=count + shortened.left_out, samples=samples), *text]
    text = [*TEXTS.paragraphs("measurement"), *text]
    return Section("injection", "Injection check", tuple(text), (INJECTED.fill(rows),), tuple(plots))


def _moving(v: Variant) -> dict[str, Any]:
    """Return the state that moves most at an operating point, and how far; a measurement would wander off along it."""
    nothing = {"state": "", "change": 0.0, "period": False}
    try:
        moves = np.abs(v.model.affine)
    except LoopwrightError:
        return nothing
    if not moves.size or len(moves) != len(v.model.states) or not np.max(moves) > 0.0:
        return nothing
    most = int(np.argmax(moves))
    return {"state": v.model.states[most], "change": moves[most], "period": bool(v.model.dt)}


def _measured(plan: InjectionPlan, wire: str) -> FrequencyResponse:
    diagram, point = plan.variant.diagram, plan.variant.point
    at = point.t if point.how is PointOrigin.RUN else point
    if at == 0.0:  # a step of the diagram's own would move it away from its start
        diagram = hold_sources(diagram, point.values)
    return frequency_response(diagram, wire, plan.frequencies, amplitude=plan.amplitude, at=at, compile=True)


def _curve(title: str, found: FrequencyResponse, L: Linearization) -> figures.MeasuredCurve:
    """Return the measured points with the linear model's L."""
    w = np.geomspace(found.omega[0], found.omega[-1], 200)
    points = np.array([complex(np.ravel(v)[0]) for v in np.moveaxis(np.atleast_1d(found.L.frdata), -1, 0)])
    return figures.MeasuredCurve(title, w, figures.response(L, w), found.omega, points)

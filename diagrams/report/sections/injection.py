"""The injection check: linear models against sines added to wires of the running co-simulation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
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
"""A relative deviation, and uncertainty, up to which it is confirmed."""
MANY = 10.0
"""Multiple of a measurement's uncertainty by which it has to be off to refute a linear model."""

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


def is_refuted(deviation: float, uncertainty: float) -> bool:
    """Whether a measured response contradicts the linear model: it is off by far more than its own uncertainty."""
    return deviation - MANY * uncertainty > REFUTED


@dataclass(frozen=True)
class Injection:
    """A test signal at a wire of a variant: remarks on it, and its response where one was measured.

    ``refused``: whether the wire itself can't be measured, so that another one is tried.
    """

    text: tuple[str, ...]
    refused: bool = False
    plan: InjectionPlan | None = None
    row: Mapping[str, Any] | None = None
    curve: figures.MeasuredCurve | None = None


def injected(case: Case) -> Section | None:
    """Return the section that compares each sampled loop with its measured response."""
    text, skipped, shortened = list[str](), list[str](), list[InjectionPlan]()
    measured: dict[str, list[tuple[Variant, Injection]]] = {}  # by the key of the wire's loop
    wires = case.loop_wires()
    for key, wire in wires.items():
        if len(measured) == WIRES:
            break
        tried = [(v, _inject(case, v, key, wire)) for v in _injected_variants(case)]
        text += [line for _, one in tried for line in one.text]
        shortened += [one.plan for _, one in tried if one.plan is not None and one.plan.left_out]
        got = [(v, one) for v, one in tried if one.row is not None]
        if any(one.refused for _, one in tried) and not got:
            skipped.append(wire)
        else:
            measured[key] = got
    found = [one for got in measured.values() for _, one in got]
    if skipped:
        text.append(TEXTS.line("skipped", wires=", ".join(skipped), many=WIRES))
    if not found:
        return Section("injection", "Injection check", tuple(text)) if text else None
    if shortened:
        count, samples = len(shortened[-1].frequencies), shortened[-1].samples
        text = [TEXTS.line("shortened", count=count, every=count + shortened[-1].left_out, samples=samples), *text]
    plots = [
        figures.injected(
            wires[key],
            {v.key: one.curve for v, one in got if one.curve is not None},
            case.axes,
            case.looks,
            f"injection_{key}",
        )
        for key, got in measured.items()
        if got
    ]
    rows = [one.row for one in found if one.row is not None]
    text = [*TEXTS.paragraphs("measurement"), *text]
    return Section("injection", "Injection check", tuple(text), (INJECTED.fill(rows),), tuple(plots))


def _injected_variants(case: Case) -> Iterator[Variant]:
    """Yield the sampled variants, those with a delay more only where they are the design or the diagram as it is."""
    for v in case.usable(Implementation.SAMPLED, Implementation.DELAYED, Implementation.OWN):
        if not v.implementation.delay or v.is_design or v.is_actual:
            yield v


def _inject(case: Case, v: Variant, key: str, wire: str) -> Injection:
    """Return what a test signal at a wire of a variant shows."""
    said: dict[str, Any] = {"variant": v.title, "wire": wire}
    if Stability.of(v) is Stability.UNSTABLE:
        return Injection((TEXTS.line("unstable", **said),))
    if not v.rests:
        return Injection((TEXTS.line("moving", **said, **_moving(v)),))
    text: list[str] = []
    try:
        case.notify(f"injection at {wire}, {v.title}")
        L = v.loop(wire)  # a wire without a loop at one rate needs no measurement
        plan = case.excitation(v, wire)
        least = find_least_sine(plan.variant.diagram, plan.variant.point, wire, L, plan.frequencies)
        if least is not None and least[0] > plan.amplitude:
            quanta = {"usual": plan.amplitude, "block": least[1].converter, "many": LEAST_SINE}
            plan = plan._replace(amplitude=least[0])
            text.append(TEXTS.line("enlarged", **said, amplitude=plan.amplitude, **quanta))
        found = _measured(plan, wire)
        deviation = found.deviation(plan.variant.model, "L")
    except PeriodicLoopError:
        return Injection((*text, TEXTS.line("periodic", **said)), refused=True)
    except LoopwrightError as error:
        return Injection((*text, TEXTS.line("failed", **said, message=say(error))), refused=True)
    worst, own = float(np.max(deviation)), float(np.max(found.uncertainty))
    if not np.isfinite(own):
        return Injection((*text, TEXTS.line("moved", **said, moved=found.moved)), plan=plan)
    if own > REFUTED and least is not None:
        text.append(TEXTS.line("no_range", **said, uncertainty=own, block=least[1].converter))
    if is_refuted(worst, own):
        text.append(TEXTS.line("refuted", **said, deviation=worst))
    low, high = float(found.omega[0]), float(found.omega[-1])
    how = Confirmation(
        f"{len(found.omega)} sines from {low:.4g} to {high:.4g} rad/s, amplitude {found.amplitude:g}",
        "sines at these frequencies in the running co-simulation",
    )
    windows = "the last windows, a second amplitude, and the movement of the operating point"
    row = {
        **said,
        "loop": key,
        "key": v.key,
        "span": f"{low:.4g} … {high:.4g} rad/s",
        "deviation": Number(worst, "1", max(own, 1e-12), how),
        "uncertainty": Number(own, "1", own, windows),
        "confirmed": "yes" if worst <= CONFIRMED and own <= CONFIRMED else "no",
    }
    return Injection(tuple(text), plan=plan, row=row, curve=_curve(v.title, found, L))


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

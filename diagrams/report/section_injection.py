"""The injection check: linear models against sines added to wires of the running co-simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...blocks import Constant, Reference, Step
from ...blocks.core.errors import LoopwrightError
from ..frequency.number import Number
from ..measure.frequency_response import frequency_response
from . import plots as figures
from .case import FRICTION, Case, Variant, in_s, with_parameters
from .model import Plot, Section, Table
from .section_loops import wires_on_loops
from .templating import Texts

TEXTS = Texts(__package__, "injection")

FREQUENCIES = np.geomspace(1.0, 150.0, 9)
"""In rad/s, for Fig. 3; elsewhere they are spread around the loop's crossover."""
AMPLITUDE = 1e-4
REFUTED = 0.05
"""A relative deviation beyond which a linear model is wrong."""
CONFIRMED = 1e-3


def injected(case: Case) -> Section | None:
    """Return the section that compares each sampled loop with its measured response."""
    numbers: dict[str, Number] = {}
    rows: list[tuple[Any, ...]] = []
    text: list[str] = []
    plots = []
    for key, wire in list(wires_on_loops(case).items())[:2]:
        measured = {}
        for v in case.usable("sampled_d0", "sampled_d1", "sampled_d0" + FRICTION):
            if not v.rests:
                text.append(TEXTS.line("moving", variant=v.title, wire=wire, **_moving(v)))
                continue
            try:
                L = v.loop(wire)  # a wire without a loop at one rate needs no measurement
                found, model = _measured(case, v, wire)
                deviation = found.deviation(model, "L")
            except LoopwrightError as error:
                text.append(TEXTS.line("failed", variant=v.title, wire=wire, message=error.message))
                continue
            worst, own = float(np.max(deviation)), float(np.max(found.uncertainty))
            if worst - 10 * own > REFUTED:
                text.append(TEXTS.line("refuted", variant=v.title, wire=wire, deviation=worst))
            where = f"{key}.{v.key}"
            low, high = float(found.omega[0]), float(found.omega[-1])
            how = f"{len(found.omega)} sines from {low:.4g} to {high:.4g} rad/s, amplitude {found.amplitude:g}"
            numbers[f"{where}.deviation"] = Number(worst, "1", max(own, 1e-12), how)
            numbers[f"{where}.uncertainty"] = Number(own, "1", own, "differences of the last windows")
            span = f"{low:.4g} … {high:.4g} rad/s"
            shown = (numbers[f"{where}.{n}"] for n in ("deviation", "uncertainty"))
            verdict = "yes" if worst <= CONFIRMED else "no"
            rows.append((wire, v.title, span, *shown, verdict))
            measured[v.title] = (found, L)
        if measured:
            plots.append(_plot(key, wire, measured))
    if not rows:
        return Section("injection", "Injection check", tuple(text)) if text else None
    text = [*TEXTS.paragraphs("measurement"), *text]
    columns = ("wire", "variant", "frequencies", "largest deviation", "uncertainty", f"within {CONFIRMED:g}")
    table = Table("Injected against linearized", columns, tuple(rows))
    return Section("injection", "Injection check", tuple(text), (table,), tuple(plots), numbers)


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


def _measured(case: Case, v: Variant, wire: str) -> tuple[Any, Any]:
    frequencies, amplitude = FREQUENCIES, AMPLITUDE
    if case.is_fig3:
        v = _at_rest(v)
    else:
        w = np.abs(in_s(v.model.poles, v.model.dt))
        w = w[(w > 1e-6) & (w < 0.3 * np.pi / v.model.dt)]
        centre = float(np.median(w)) if len(w) else 0.03 * np.pi / v.model.dt
        frequencies = np.geomspace(centre / 10, min(centre * 3, 0.5 * np.pi / v.model.dt), 5)
        value = np.ravel(v.point.values.get(_source(v, wire), 0.0))
        amplitude = AMPLITUDE * (1.0 + float(np.max(np.abs(value), initial=0.0)))
    found = frequency_response(v.diagram, wire, frequencies, amplitude=amplitude, at=v.point.t)
    return found, v.model


def _source(v: Variant, wire: str) -> str:
    source = v.diagram.names.get(wire)
    return wire if source is None else f"{source.block}.{source.port}"


def _at_rest(v: Variant) -> Variant:
    """Return Fig. 3 with its references held, set-points and desired forces at zero, so that it stays where it is."""
    changes: dict[str, Any] = {
        path: Constant(value=0.0, unit=block.unit, name=path)
        for path, block in v.diagram.blocks.items()
        if path in ("set_point", "desired_force_par", "desired_force_perp") and isinstance(block, Step)
    }
    for name in ("eta_d", "xi_d"):
        if f"{name}.y" in v.point.values:
            changes[name] = Reference(float(np.ravel(v.point.values[f"{name}.y"])[0]), unit="m", name=name)
    return with_parameters(v, changes)


def _plot(key: str, wire: str, measured: dict[str, tuple[Any, Any]]) -> Plot:
    """Draw the measured points over the linear model's L."""
    curves = {}
    for title, (found, L) in measured.items():
        w = np.geomspace(found.omega[0], found.omega[-1], 200)
        points = np.array([complex(np.ravel(v)[0]) for v in np.moveaxis(np.atleast_1d(found.L.frdata), -1, 0)])
        curves[title] = (w, figures.response(L, w), found.omega, points)
    return figures.injected(f"injection_{key}", wire, curves)

"""Target and rendered admittance, passivity, and the environments that Fig. 3's compliance loop can touch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...blocks.core import ConfirmationError
from ..contact import SIDES
from ..frequency import Number, with_findings
from ..report import Implementation, Plot, Section, Table, Texts
from .compliance_loop import AdmittanceLoop
from .coupled_stability import growth_rate, stability_limit
from .fig3_admittance_figures import RULE, TARGET, draw_admittances, draw_stability
from .fig3_case import Fig3Case
from .fig3_contact import DAMPINGS, SPRING, again, contact_sections, find_contacts
from .reduced_loops import FRICTION, OPTIONS, ReducedLoops, each_implementation
from .rendered_admittance import passivity, rendered_admittance, target_admittance

TEXTS = Texts(__package__, "admittance")
TITLE = "Admittance and coupled stability"
SAMPLED, DELAYED = Implementation.SAMPLED, Implementation.DELAYED
ROUGH = SAMPLED + FRICTION
"""Key of the sampled variant with friction."""


def has_admittance(case: Fig3Case) -> bool:
    """Return whether there are admittances in both directions, and the diagram could be analysed."""
    return case.reduced is not None


def admittance(case: Fig3Case) -> Section:
    """Return the section about the admittances.

    Where the diagram has friction, ``ke_limit`` is that of the design without it, and ``ke_limit_friction`` that of
    ``stiffness_limits(AdmittanceLoop.of(diagram))``. Where the plant is not shown to be the reduced model, the numbers
    are those of `Diagram.contact`; where it has none, the section says why.
    """
    if not isinstance(case.reduced, ReducedLoops):
        contacts = find_contacts(case)
        if contacts is None:
            return Section("admittance", TITLE, not_shown(case))
        try:
            parts = contact_sections(contacts, {key: v.title for key, v in case.variants.items()})
        except ConfirmationError as error:  # a limit that is refuted is none; the rest of the report holds
            return Section("admittance", TITLE, (*not_shown(case), str(error)))
        return Section("admittance", TITLE, (*TEXTS.paragraphs("contacts"), str(case.reduced)), sections=parts)
    titles = {key: v.title for key, v in case.variants.items()}
    parts = tuple(_side(case.reduced, side, titles, case.looks) for side in SIDES)
    return Section("admittance", TITLE, TEXTS.paragraphs("limits"), sections=parts)


def not_shown(case: Fig3Case) -> tuple[str, ...]:
    """Return why there are no reduced loops."""
    return (*TEXTS.paragraphs("not_shown"), str(case.reduced))


def _side(loops: ReducedLoops, side: str, titles: Mapping[str, str], looks: Mapping[str, dict[str, Any]]) -> Section:
    loop = loops.plain[side]
    numbers: dict[str, Number] = {}
    a = loop.admittance
    for name, value, unit in (
        ("mass", a.mass, "kg"),
        ("damping", float(a.effective_damping), "N.s/m"),
        ("stiffness", a.stiffness, "N/m"),
    ):
        numbers[f"target.{name}"] = Number(value, unit, 1e-15 * abs(value), "given", given=True)
    tables = [
        _passivity(loops, side, numbers, titles),
        *_limits(loops, side, numbers, titles),
        *_masses(loops, side, numbers, titles),
    ]
    plots = (_rendered(loops, side, titles, looks), _map(loops, side, titles, looks))
    symbol = "along the path, ∥" if side == "par" else "across the path, ⊥"
    text = (*TEXTS.paragraphs("asked", loop=loop), passivity(loop).caveat)
    return Section(side, f"Direction {symbol}", text, tuple(tables), plots, numbers)


def _passivity(loops: ReducedLoops, side: str, numbers: dict[str, Number], titles: Mapping[str, str]) -> Table:
    rows = []
    for suffix, loop in loops.suffixed(side).items():
        for name, variant in each_implementation(loop).items():
            p = passivity(variant)
            how = "sign of Re Y just below and just above"
            if math.isfinite(p.frequency):
                values = [float(rendered_admittance(variant, p.frequency * f).real) for f in (1 - 1e-6, 1 + 1e-6)]
                if not values[0] > 0 > values[1] and p.frequency > p.scanned[0]:
                    how = "Re Y changes its sign within rounding there"
            else:
                how = f"Re Y ≥ 0 on the whole scan up to {p.scanned[1]:.6g} rad/s"
            path = f"first_non_passive.{name}{suffix}"
            error = p.tolerance * p.frequency if math.isfinite(p.frequency) else 0.0
            numbers[path] = Number(p.frequency, "rad/s", error, how, findings=p.findings)
            spans = ", ".join(f"{low:.5g} … {high:.5g}" for low, high in p.intervals) or "none"
            rows.append((titles.get(name + suffix, name + suffix), numbers[path], spans, "yes" if p.stable else "no"))
    columns = ("variant", "first Re Y < 0 at", "all of Re Y < 0 [rad/s]", "stable alone")
    return Table("Sign of Re Y(jω)", columns, tuple(rows))


def _limits(loops: ReducedLoops, side: str, numbers: dict[str, Number], titles: Mapping[str, str]) -> Iterator[Table]:
    for key, kind in loops.kinds(side).items():
        rows = []
        for name in OPTIONS:
            for b in DAMPINGS:
                found = loops.limit(side, key, name, b)
                rule = Number(found.rule_of_thumb, "N/m", 0.0, "closed form (d + b_e)/T_d")
                frequency = None
                if math.isfinite(found.frequency):
                    frequency = with_findings(
                        Number(found.frequency, "rad/s", 1e-6 * found.frequency, found.confirmed_by), found.findings
                    )
                shown = {"ke_limit": found.number, "rule_of_thumb": rule, "ke_frequency": frequency}
                place = f"{name}.be_{b:g}"
                numbers |= {f"{kind.key_of(of)}.{place}": n for of, n in shown.items() if n is not None}
                title = titles.get(name + kind.suffix, name + kind.suffix)
                rows.append((title, b, *shown.values(), again(found)))
        columns = ("variant", "b_e [N·s/m]", "largest k_e", "rule of thumb", "oscillates at", "stable again")
        yield Table(f"Largest stiffness of the environment, {kind.title}", columns, tuple(rows))


def _masses(loops: ReducedLoops, side: str, numbers: dict[str, Number], titles: Mapping[str, str]) -> Iterator[Table]:
    rows = []
    # without any stiffness the robot drifts, and there is no limit to lose
    moored: dict[str, Any] = {} if loops.plain[side].admittance.stiffness > 0 else {"stiffness": SPRING}
    for suffix, loop in loops.suffixed(side).items():
        for name, variant in each_implementation(loop).items():
            shown = []
            for over, key in (("mass", "me_limit"), ("tool_mass", "tool_mass_limit")):
                found = stability_limit(variant, over, **moored)
                path = f"{key}{suffix}.{name}"
                numbers[path] = found.number
                shown += [numbers[path], again(found)]
            rows.append((titles.get(name + suffix, name + suffix), *shown))
    columns = ("variant", "largest m_e", "stable again", "largest tool mass", "stable again")
    how = f"on a spring of {SPRING:g} N/m" if moored else "without spring and damper"
    yield Table(f"Largest masses, {how}", columns, tuple(rows))


def _rendered(loops: ReducedLoops, side: str, titles: Mapping[str, str], looks: Mapping[str, dict[str, Any]]) -> Plot:
    loop = loops.plain[side]
    a = loop.admittance
    centre = math.sqrt(a.stiffness / a.mass) if a.stiffness > 0 else float(a.effective_damping) / a.mass
    w = np.geomspace(centre / 50, 0.999 * math.pi / loop.sample_time, 500)
    curves: dict[str, tuple[str, np.ndarray]] = {TARGET: ("target", target_admittance(loop, w))}
    for name, variant in each_implementation(loop).items():
        curves[name] = (titles.get(name, name), rendered_admittance(variant, w))
    if side in loops.rough:
        curves[ROUGH] = (titles.get(ROUGH, ROUGH), rendered_admittance(loops.rough[side], w))
    return draw_admittances(f"admittance_{side}", w, curves, looks, along=side == "par")


def _map(loops: ReducedLoops, side: str, titles: Mapping[str, str], looks: Mapping[str, dict[str, Any]]) -> Plot:
    loop = loops.plain[side]
    k, b = np.geomspace(10.0, 1e6, 120), np.geomspace(0.1, 1e3, 41)

    def growth(of: AdmittanceLoop) -> np.ndarray:
        return np.asarray(growth_rate(of, stiffness=k[None, :], damping=b[:, None]))

    shown = growth(loop)
    lines: dict[str, tuple[str, np.ndarray]] = {
        Implementation.SAMPLED: (titles.get(SAMPLED, SAMPLED), _first(k, shown)),
        Implementation.DELAYED: (titles.get(DELAYED, DELAYED), _first(k, growth(loop.replace(delay=1)))),
    }
    if side in loops.rough:
        lines[ROUGH] = (titles.get(ROUGH, ROUGH), _first(k, growth(loops.rough[side])))
    d = float(loop.admittance.effective_damping) / loop.scale
    lines[RULE] = ("rule of thumb, no delay", (d + b) / (0.5 * loop.sample_time))
    return draw_stability(f"stability_{side}", k, b, shown, lines, looks, along=side == "par")


def _first(k: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """Return where each row of growth rates first becomes positive, interpolated; NaN where it doesn't."""
    found = np.full(len(growth), np.nan)
    for row, sigma in enumerate(growth):
        beyond = np.flatnonzero(sigma > 0)
        if len(beyond) and beyond[0] > 0:
            i = beyond[0]
            share = sigma[i - 1] / (sigma[i - 1] - sigma[i])
            found[row] = math.exp((1 - share) * math.log(k[i - 1]) + share * math.log(k[i]))
    return found

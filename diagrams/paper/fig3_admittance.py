"""Target and rendered admittance, passivity, and the environments that Fig. 3's compliance loop can touch.

Where the plant is shown to be a rigid gantry, the numbers are those of the reduced loops; for any other plant they are
those of `Diagram.contact`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks import AdmittanceFilter
from ...blocks.core import ConfirmationError, LoopwrightError, OptionError
from ..contact import SIDES, Contact, PortNames, make_contact, try_limit
from ..frequency import Number
from ..linearization import StepsOnly
from ..report import (
    DOTTED,
    Implementation,
    Plot,
    Section,
    Table,
    TableForm,
    Texts,
    draw_admittances,
    fill_growth,
    look_of,
)
from ..report.sections import contacts
from ..results import legend_above, new_figure, style
from .compliance_loop import AdmittanceLoop
from .coupled_stability import growth_rate, stability_limit
from .fig3_case import Fig3Case
from .reduced_loops import FRICTION, OPTIONS, ReducedLoops, each_implementation
from .rendered import passivity, rendered_admittance, target_admittance

TEXTS = Texts(__package__, "admittance")
TITLE = "Admittance and coupled stability"
SAMPLED, DELAYED = Implementation.SAMPLED, Implementation.DELAYED
ROUGH = SAMPLED + FRICTION
"""Key of the sampled variant with friction."""
TARGET, RULE = "target", "rule_of_thumb"
"""Curves besides those of variants."""
Looks = Mapping[str, Mapping[str, Any]]
"""Color and line of each variant by its key, as of `Case.looks`."""

SIGN = TableForm(
    "Sign of Re Y(jω)", {"variant": "variant", **contacts.SIGN}, {"first": "first_non_passive.{key}{suffix}"}
)
STIFFNESS = TableForm(
    "Largest stiffness of the environment{kind}",
    {
        "variant": "variant",
        "b_e [N·s/m]": "damping",
        "largest k_e": "limit",
        "rule of thumb": "rule",
        **contacts.FOUND,
    },
    {
        "limit": "{prefix}ke_limit{suffix}.{key}.be_{damping:g}",
        "rule": "{prefix}rule_of_thumb{suffix}.{key}.be_{damping:g}",
        "frequency": "{prefix}ke_frequency{suffix}.{key}.be_{damping:g}",
    },
)
MASSES = TableForm(
    "Largest masses, {held}",
    {"variant": "variant", "mass": "mass", "largest": "limit", **contacts.FOUND},
    {"limit": "{name}{suffix}.{key}"},
)
IN_RUNS = TableForm(
    "Limits of stiffness at b_e = {damping:g} N·s/m, tried in the nonlinear run",
    {"variant": "variant", **contacts.TRIED},
    {"measured": "tried.ke_limit.{key}.be_{damping:g}.{side}.growth_rate"},
)


def has_admittance(case: Fig3Case) -> bool:
    """Return whether there are admittances in both directions, and the diagram could be analysed."""
    return case.reduced is not None


def admittance(case: Fig3Case) -> Section:
    """Return the section about the admittances; it says why where it has no numbers.

    Where the diagram has friction, ``ke_limit`` is that of the design without it, and ``ke_limit_friction`` that of
    ``stiffness_limits(AdmittanceLoop.of(diagram))``.
    """
    if isinstance(case.reduced, ReducedLoops):
        parts = tuple(_reduced_side(case, case.reduced, side) for side in SIDES)
        return Section("admittance", TITLE, TEXTS.paragraphs("limits"), sections=parts)
    found = _find_contacts(case)
    if found is None:
        return Section("admittance", TITLE, not_shown(case))
    try:
        parts = tuple(_contact_side(case, found[side], side) for side in SIDES)
    except ConfirmationError as error:  # a limit that is refuted is none; the rest of the report holds
        return Section("admittance", TITLE, (*not_shown(case), str(error)))
    return Section("admittance", TITLE, (*TEXTS.paragraphs("contacts"), str(case.reduced)), sections=parts)


def not_shown(case: Fig3Case) -> tuple[str, ...]:
    """Return why there are no reduced loops."""
    return (*TEXTS.paragraphs("not_shown"), str(case.reduced))


def _section(side: str, text: Sequence[str], a: AdmittanceFilter, tables: Sequence[Table], *plots: Plot) -> Section:
    """Return the section of a direction; ``a`` is its admittance filter."""
    target = {
        "mass": (a.mass, "kg"),
        "damping": (float(a.effective_damping), "N.s/m"),
        "stiffness": (a.stiffness, "N/m"),
    }
    numbers = {
        f"target.{name}": Number(value, unit, 1e-15 * abs(value), "given", given=True)
        for name, (value, unit) in target.items()
    }
    symbol = "along the path, ∥" if side == "par" else "across the path, ⊥"
    return Section(side, f"Direction {symbol}", tuple(text), tuple(tables), plots, numbers)


def _held(a: AdmittanceFilter) -> tuple[dict[str, Any], str]:
    """Return what holds a mass, as an environment and in words: without any stiffness the robot drifts."""
    if a.stiffness > 0:
        return {}, "without spring and damper"
    return {"stiffness": contacts.SPRING}, f"on a spring of {contacts.SPRING:g} N/m"


def _span(a: AdmittanceFilter, top: float) -> np.ndarray:
    """Return the frequencies in rad/s at which admittances are drawn."""
    centre = math.sqrt(a.stiffness / a.mass) if a.stiffness > 0 else float(a.effective_damping) / a.mass
    return np.geomspace(centre / 50, top, 500)


# --- a rigid gantry: reduced loops ------------------------------------------------------------------------------------


def _reduced_side(case: Fig3Case, loops: ReducedLoops, side: str) -> Section:
    loop, titles = loops.plain[side], {key: v.title for key, v in case.variants.items()}
    variants = [
        ({"variant": titles.get(key + suffix, key + suffix), "key": key, "suffix": suffix}, variant)
        for suffix, of in loops.suffixed(side).items()
        for key, variant in each_implementation(of).items()
    ]
    signs = ({**facts, **_reduced_sign(v)} for facts, v in variants)
    environment, held = _held(loop.admittance)
    masses = (
        {
            **facts,
            "name": contacts.LIMITS[vary],
            "mass": contacts.WORDS[vary],
            "limit": found.number,
            "again": contacts.stable_again(found.restabilizes, found.unit) or "no",
        }
        for facts, v in variants
        for vary in ("mass", "tool_mass")
        if (found := stability_limit(v, vary, **environment))
    )
    tables = (SIGN.fill(signs), *_reduced_stiffness(loops, side, titles), MASSES.fill(masses, held=held))
    text = (*TEXTS.paragraphs("asked", loop=loop), passivity(loop).caveat)
    plots = _reduced_admittances(loops, side, titles, case.looks), _stability_map(loops, side, titles, case.looks)
    return _section(side, text, loop.admittance, tables, *plots)


def _reduced_sign(loop: AdmittanceLoop) -> dict[str, Any]:
    """Return the facts of a loop's sign of Re Y; passivity with aliases is that of contacts alone."""
    sign = contacts.sign_of_admittance(passivity(loop), lambda w: rendered_admittance(loop, w))
    return {**sign, "passive": None}


def _reduced_stiffness(loops: ReducedLoops, side: str, titles: Mapping[str, str]) -> Iterator[Table]:
    for key, kind in loops.kinds(side).items():
        rows = []
        for implementation in OPTIONS:
            variant = implementation + kind.suffix
            for b in contacts.DAMPINGS:
                found = loops.limit(side, key, implementation, b)
                rows.append(
                    {
                        "variant": titles.get(variant, variant),
                        "key": implementation,
                        "prefix": kind.prefix,
                        "suffix": kind.suffix,
                        "damping": b,
                        "limit": found.number,
                        "rule": Number(found.rule_of_thumb, "N/m", 0.0, "closed form (d + b_e)/T_d"),
                        "frequency": contacts.frequency_number(found.frequency, found.confirmed_by, found.findings),
                        "again": contacts.stable_again(found.restabilizes, found.unit) or "no",
                    }
                )
        yield STIFFNESS.fill(rows, kind=f", {kind.title}")


def _reduced_admittances(loops: ReducedLoops, side: str, titles: Mapping[str, str], looks: Looks) -> Plot:
    loop = loops.plain[side]
    w = _span(loop.admittance, 0.999 * math.pi / loop.sample_time)
    curves: dict[str, tuple[str, np.ndarray]] = {TARGET: ("target", target_admittance(loop, w))}
    for name, variant in each_implementation(loop).items():
        curves[name] = (titles.get(name, name), rendered_admittance(variant, w))
    if side in loops.rough:
        curves[ROUGH] = (titles.get(ROUGH, ROUGH), rendered_admittance(loops.rough[side], w))
    return _draw_admittances(side, w, curves, looks)


def _stability_map(loops: ReducedLoops, side: str, titles: Mapping[str, str], looks: Looks) -> Plot:
    loop = loops.plain[side]
    k, b = np.geomspace(10.0, 1e6, 120), np.geomspace(0.1, 1e3, 41)

    def growth(of: AdmittanceLoop) -> np.ndarray:
        return np.asarray(growth_rate(of, stiffness=k[None, :], damping=b[:, None]))

    shown = growth(loop)
    lines: dict[str, tuple[str, np.ndarray]] = {
        SAMPLED: (titles.get(SAMPLED, SAMPLED), _first_unstable(k, shown)),
        DELAYED: (titles.get(DELAYED, DELAYED), _first_unstable(k, growth(loop.replace(delay=1)))),
    }
    if side in loops.rough:
        lines[ROUGH] = (titles.get(ROUGH, ROUGH), _first_unstable(k, growth(loops.rough[side])))
    d = float(loop.admittance.effective_damping) / loop.scale
    lines[RULE] = ("rule of thumb, no delay", (d + b) / (0.5 * loop.sample_time))
    with style():
        figure = new_figure(2.9)
        ax = figure.subplots()
        fill_growth(ax, k, b, shown, least=-100.0)
        for name, (title, x) in lines.items():
            ax.plot(x, b, label=title, **(DOTTED if name == RULE else looks.get(name, {})))
        legend_above(figure, ax)
    return Plot(f"stability_{side}", TEXTS.line("map", along=side == "par"), figure)


def _first_unstable(k: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """Return where each row of growth rates first becomes positive, interpolated; NaN where it doesn't."""
    found = np.full(len(growth), np.nan)
    for row, sigma in enumerate(growth):
        beyond = np.flatnonzero(sigma > 0)
        if len(beyond) and beyond[0] > 0:
            i = beyond[0]
            share = sigma[i - 1] / (sigma[i - 1] - sigma[i])
            found[row] = math.exp((1 - share) * math.log(k[i - 1]) + share * math.log(k[i]))
    return found


# --- any other plant: contacts ----------------------------------------------------------------------------------------


def _find_contacts(case: Fig3Case) -> Mapping[str, Mapping[Implementation, Contact]] | None:
    """Return the contacts of all variants by direction, or None where the linear models don't show them.

    Stairs that linearize to zero, and a plant with discrete states, have none.
    """
    if case.has_events:
        return None
    found: dict[str, dict[Implementation, Contact]] = {side: {} for side in SIDES}
    try:
        for side, v in ((side, v) for side in SIDES for v in case.designs(*Implementation)):
            options = {} if v.stairs is None else {"stairs": v.stairs}
            found[side][v.implementation] = make_contact(v.diagram, PortNames(), side, v.point, options)
    except LoopwrightError:
        return None
    every = [contact for side in found.values() for contact in side.values()]
    blind = any(isinstance(finding, StepsOnly) for contact in every for finding in contact.findings)
    return None if blind or any(contact.filter is None for contact in every) or not every else found


def _contact_side(case: Fig3Case, found: Mapping[Implementation, Contact], side: str) -> Section:
    variants = [
        ({"variant": case.variants[key].title, "key": key, "prefix": "", "suffix": ""}, contact)
        for key, contact in found.items()
    ]
    one = variants[0][1]
    a = one.filter
    assert a is not None  # _find_contacts looks
    signs = ({**facts, **contacts.contact_sign(c)} for facts, c in variants)
    stiffness = (
        {**facts, **_limit(c, "stiffness", damping=b), "damping": b} for facts, c in variants for b in contacts.DAMPINGS
    )
    environment, held = _held(a)
    masses = (
        {**facts, **_limit(c, vary, **environment), "name": contacts.LIMITS[vary], "mass": contacts.WORDS[vary]}
        for facts, c in variants
        for vary in ("mass", "tool_mass")
    )
    tried, remarks = _tried(variants)
    tables = (SIGN.fill(signs), STIFFNESS.fill(stiffness, kind=""), MASSES.fill(masses, held=held), *tried)
    seen = one.passivity()
    text = (*TEXTS.paragraphs("asked_of", filter=a, scale=one.scale), seen.caveat, str(seen.port), *remarks)
    periods = [c.sample_time for c in found.values() if c.sample_time]
    w = _span(a, 0.999 * math.pi / max(periods) if periods else 1e5)
    target = one.admittance(w).target
    assert target is not None  # as there is a filter
    curves: dict[str, tuple[str, np.ndarray]] = {TARGET: ("target", target)}
    curves |= {facts["key"]: (facts["variant"], c.admittance(w).rendered) for facts, c in variants}
    return _section(side, text, a, tables, _draw_admittances(side, w, curves, case.looks))


def _limit(contact: Contact, vary: str, **environment: Any) -> dict[str, Any]:
    """Return the facts of a limit, with words where there is no direction and no change beyond."""
    facts = contacts.limit_facts(contact.stability_limit(vary, **environment))
    return {**facts, "direction": facts["direction"] or "–", "again": facts["again"] or "no"}


def _tried(variants: Sequence[tuple[Mapping[str, Any], Contact]]) -> tuple[list[Table], list[str]]:
    """Return the table of limits that were tried in the nonlinear run, and why others were not.

    A run that contradicts a limit however small the push raises its `ConfirmationError`.
    """
    rows: list[dict[str, Any]] = []
    remarks: dict[str, None] = {}
    damping = contacts.TRIED_DAMPING
    for facts, contact in variants:
        if not contact.sample_time:
            continue  # a run exchanges signals with the FMU at ticks only
        limit = contact.stability_limit("stiffness", damping=damping)
        if not (math.isfinite(limit.value) and limit.value > 0.0):
            continue
        try:
            found = try_limit(contact, limit)
        except OptionError as error:
            remarks[str(error)] = None
            continue
        trials = contacts.trial_facts(found, "the nonlinear run with the environment inside the plant")
        rows += [{**facts, **trial, "damping": damping} for trial in trials]
    return [IN_RUNS.fill(rows, damping=damping)] if rows else [], list(remarks)


def _draw_admittances(side: str, w: np.ndarray, curves: Mapping[str, tuple[str, np.ndarray]], looks: Looks) -> Plot:
    """Return the figure of admittances over ω in rad/s; curves have the keys of their variants."""
    drawn = [
        (title, Y, DOTTED if name == TARGET else looks.get(name) or look_of(name, i))
        for i, (name, (title, Y)) in enumerate(curves.items())
    ]
    return Plot(f"admittance_{side}", TEXTS.line("rendered", along=side == "par"), draw_admittances(w, drawn))

"""Target and rendered admittance, passivity, and the environments that Fig. 3's compliance loop can touch.

Where the plant is shown to be a rigid gantry, the numbers are those of the reduced loops; for any other plant they are
those of `Diagram.contact`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import AdmittanceFilter
from ...blocks.core import ConfirmationError, LoopwrightError, OptionError
from ..contact import SIDES, Contact, ContactLimit, PortNames, make_contact, try_limit
from ..frequency import Number
from ..linearization import StepsOnly
from ..plotting import legend_above, new_figure, style
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
from .compliance_loop import AdmittanceLoop
from .coupled_stability import growth_rate
from .fig3_case import Fig3Case
from .reduced_loops import FRICTION, OPTIONS, ReducedLoops, each_implementation
from .rendered import passivity, rendered_admittance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEXTS = Texts(__package__, "admittance")
TITLE = "Admittance and coupled stability"
SAMPLED, DELAYED = Implementation.SAMPLED, Implementation.DELAYED
ROUGH = SAMPLED + FRICTION
"""Key of the sampled variant with friction."""
UNSHOWN = {"passive": None, "direction": None}
"""Facts that a reduced loop's tables don't show: its contact has one direction alone, or the frame of the path."""
Variants = Sequence[tuple[Mapping[str, Any], Contact]]
"""Contacts of variants, each with the facts of its rows: its title, its key, and the end of that."""

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


def _section(
    case: Fig3Case,
    side: str,
    variants: Variants,
    text: Sequence[str],
    tables: Sequence[Table],
    tried: Sequence[Table] = (),
    plots: Sequence[Plot] = (),
) -> Section:
    """Return the section of a direction, with the largest masses and the admittances of its variants."""
    a = variants[0][1].filter
    assert a is not None  # a reduced loop has one, and _find_contacts looks
    target = {
        "mass": (a.mass, "kg"),
        "damping": (float(a.effective_damping), "N.s/m"),
        "stiffness": (a.stiffness, "N/m"),
    }
    numbers = {
        f"target.{name}": Number(value, unit, 1e-15 * abs(value), "given", given=True)
        for name, (value, unit) in target.items()
    }
    environment, held = _held(a)
    masses = (
        {**_facts(c.stability_limit(vary, **environment)), **facts, "name": contacts.LIMITS[vary], "mass": word}
        for facts, c in variants
        for vary, word in contacts.WORDS.items()
        if vary in ("mass", "tool_mass")
    )
    tables = (*tables, MASSES.fill(masses, held=held), *tried)
    symbol = "along the path, ∥" if side == "par" else "across the path, ⊥"
    plots = (_draw_admittances(case, side, variants, a), *plots)
    return Section(side, f"Direction {symbol}", tuple(text), tables, plots, numbers)


def _facts(found: ContactLimit) -> dict[str, Any]:
    """Return the facts of a limit, with words where there is no direction and no change beyond."""
    facts = contacts.limit_facts(found)
    return {**facts, "direction": facts["direction"] or "–", "again": facts["again"] or "no"}


def _held(a: AdmittanceFilter) -> tuple[dict[str, Any], str]:
    """Return what holds a mass, as an environment and in words: without any stiffness the robot drifts."""
    if a.stiffness > 0:
        return {}, "without spring and damper"
    return {"stiffness": contacts.SPRING}, f"on a spring of {contacts.SPRING:g} N/m"


def _draw_admittances(case: Fig3Case, side: str, variants: Variants, a: AdmittanceFilter) -> Plot:
    """Return the figure of admittances over ω in rad/s; with friction that of the sampled variant alone."""
    periods = [c.sample_time for _, c in variants if c.sample_time]
    centre = math.sqrt(a.stiffness / a.mass) if a.stiffness > 0 else float(a.effective_damping) / a.mass
    w = np.geomspace(centre / 50, 0.999 * math.pi / max(periods) if periods else 1e5, 500)
    drawn: list[tuple[str, Any, Mapping[str, Any]]] = [("target", variants[0][1].admittance(w).target, DOTTED)]
    for facts, c in variants:
        if (key := facts["key"] + facts["suffix"]) == ROUGH or not facts["suffix"]:
            look = case.looks.get(key) or look_of(key, len(drawn))
            drawn.append((facts["variant"], c.admittance(w).rendered, look))
    return Plot(f"admittance_{side}", TEXTS.line("rendered", along=side == "par"), lambda: draw_admittances(w, drawn))


# --- a rigid gantry: reduced loops ------------------------------------------------------------------------------------


def _reduced_side(case: Fig3Case, loops: ReducedLoops, side: str) -> Section:
    loop, titles = loops.plain[side], {key: v.title for key, v in case.variants.items()}
    variants, signs = [], []
    for suffix, of in loops.suffixed(side).items():
        for key, variant in each_implementation(of).items():
            facts = {"variant": titles.get(key + suffix, key + suffix), "key": key, "suffix": suffix, **UNSHOWN}
            variants.append((facts, variant.contact))
            sign = contacts.sign_of_admittance(passivity(variant), partial(rendered_admittance, variant))
            signs.append({**sign, **facts})
    text = (*TEXTS.paragraphs("asked", loop=loop), passivity(loop).caveat)
    tables = (SIGN.fill(signs), *_reduced_stiffness(loops, side, titles))
    return _section(case, side, variants, text, tables, plots=[_stability_map(case, loops, side, titles)])


def _reduced_stiffness(loops: ReducedLoops, side: str, titles: Mapping[str, str]) -> Iterator[Table]:
    for key, kind in loops.kinds(side).items():
        rows = []
        for implementation in OPTIONS:
            variant = titles.get(implementation + kind.suffix, implementation + kind.suffix)
            facts = {"variant": variant, "key": implementation, "prefix": kind.prefix, "suffix": kind.suffix, **UNSHOWN}
            for b in contacts.DAMPINGS:
                found = loops.limit(side, key, implementation, b)
                rule = Number(found.rule_of_thumb, "N/m", 0.0, "closed form (d + b_e)/T_d")
                rows.append({**_facts(found), **facts, "damping": b, "rule": rule})
        yield STIFFNESS.fill(rows, kind=f", {kind.title}")


def _stability_map(case: Fig3Case, loops: ReducedLoops, side: str, titles: Mapping[str, str]) -> Plot:
    draw = partial(_draw_stability_map, loops, side, titles, case.looks)
    return Plot(f"stability_{side}", TEXTS.line("map", along=side == "par"), draw)


def _draw_stability_map(
    loops: ReducedLoops, side: str, titles: Mapping[str, str], looks: Mapping[str, dict[str, Any]]
) -> Figure:
    loop = loops.plain[side]
    k, b = np.geomspace(10.0, 1e6, 120), np.geomspace(0.1, 1e3, 41)

    def growth(of: AdmittanceLoop) -> np.ndarray:
        return np.asarray(growth_rate(of, stiffness=k[None, :], damping=b[:, None]))

    shown = growth(loop)
    lines: dict[str, np.ndarray] = {SAMPLED: shown, DELAYED: growth(loop.replace(delay=1))}
    if side in loops.rough:
        lines[ROUGH] = growth(loops.rough[side])
    d = float(loop.admittance.effective_damping) / loop.scale
    with style():
        figure = new_figure(2.9)
        ax = figure.subplots()
        fill_growth(ax, k, b, shown, least=-100.0)
        for name, rates in lines.items():
            ax.plot(_first_unstable(k, rates), b, label=titles.get(name, name), **looks.get(name, {}))
        ax.plot((d + b) / (0.5 * loop.sample_time), b, label="rule of thumb, no delay", **DOTTED)
        legend_above(figure, ax)
    return figure


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
    """Return contacts by direction; None where linear models don't show them: stairs of slope 0, discrete states."""
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
    signs = ({**facts, **contacts.contact_sign(c)} for facts, c in variants)
    stiffness = (
        {**facts, **_facts(c.stability_limit("stiffness", damping=b)), "damping": b}
        for facts, c in variants
        for b in contacts.DAMPINGS
    )
    tried, remarks = _tried(variants)
    one = variants[0][1]
    seen = one.passivity()
    text = (*TEXTS.paragraphs("asked_of", filter=one.filter, scale=one.scale), seen.caveat, str(seen.port), *remarks)
    return _section(case, side, variants, text, (SIGN.fill(signs), STIFFNESS.fill(stiffness, kind="")), tried)


def _tried(variants: Variants) -> tuple[list[Table], list[str]]:
    """Return the table of limits that were tried in runs, and why others were not; a contradiction is raised."""
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

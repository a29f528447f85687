"""Admittance and coupled stability of a diagram of Fig. 3 whose plant is not shown to be the rigid gantry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError
from ..contact import SIDES, Contact, ContactLimit, PortNames, make_contact, try_limit
from ..frequency import Number, with_findings
from ..linearization import StepsOnly
from ..report import SIGN_COLUMNS, Implementation, Plot, Section, Table, Texts, sign_of_admittance
from .coupled_stability import StabilityLimit
from .fig3_admittance_figures import TARGET, draw_admittances
from .fig3_case import Fig3Case

TEXTS = Texts(__package__, "admittance")
DAMPINGS = (0.0, 10.0, 100.0)
TRIED_DAMPING = 10.0
"""Damping in N·s/m of the environment at which limits are tried in the nonlinear run."""
SPRING = 10.0
"""Spring in N/m that holds a mass where the admittance has no stiffness."""
Contacts = Mapping[str, Mapping[Implementation, Contact]]


def find_contacts(case: Fig3Case) -> Contacts | None:
    """Return the contacts of all variants by direction, or None where the linear models don't tell them.

    Stairs that linearize to zero, and a plant with discrete states, have none.
    """
    if case.has_events:
        return None
    variants = list(case.designs(*Implementation))
    found: dict[str, dict[Implementation, Contact]] = {side: {} for side in SIDES}
    try:
        for side, v in ((side, v) for side in SIDES for v in variants):
            options = {} if v.stairs is None else {"stairs": v.stairs}
            found[side][v.implementation] = make_contact(v.diagram, PortNames(), side, v.point, options)
    except LoopwrightError:
        return None
    every = [contact for side in found.values() for contact in side.values()]
    blind = any(isinstance(finding, StepsOnly) for contact in every for finding in contact.findings)
    return None if blind or any(contact.filter is None for contact in every) or not every else found


def contact_sections(contacts: Contacts, titles: Mapping[str, str]) -> tuple[Section, ...]:
    """Return the sections of both directions; ``titles`` are those of the variants by their keys."""
    return tuple(_side(contacts[side], side, titles) for side in SIDES)


def _side(variants: Mapping[Implementation, Contact], side: str, titles: Mapping[str, str]) -> Section:
    one = next(iter(variants.values()))
    numbers: dict[str, Number] = {}
    a = one.filter
    assert a is not None  # find_contacts looks
    for name, value, unit in (
        ("mass", a.mass, "kg"),
        ("damping", float(a.effective_damping), "N.s/m"),
        ("stiffness", a.stiffness, "N/m"),
    ):
        numbers[f"target.{name}"] = Number(value, unit, 1e-15 * abs(value), "given", given=True)
    tried, said = _tried(variants, numbers, titles)
    tables = (
        _passivity(variants, numbers, titles),
        _limits(variants, numbers, titles),
        _masses(variants, a.stiffness > 0, numbers, titles),
        *tried,
    )
    symbol = "along the path, ∥" if side == "par" else "across the path, ⊥"
    seen = one.passivity()
    text = (*TEXTS.paragraphs("asked_of", filter=a, scale=one.scale), seen.caveat, str(seen.port), *said)
    return Section(side, f"Direction {symbol}", text, tables, (_rendered(variants, side, titles),), numbers)


def _passivity(
    variants: Mapping[Implementation, Contact], numbers: dict[str, Number], titles: Mapping[str, str]
) -> Table:
    rows = []
    for name, contact in variants.items():
        row = sign_of_admittance(contact)
        numbers[f"first_non_passive.{name}"] = row[0]
        rows.append((titles.get(name, name), *row))
    return Table("Sign of Re Y(jω)", ("variant", *SIGN_COLUMNS), tuple(rows))


def _limits(variants: Mapping[Implementation, Contact], numbers: dict[str, Number], titles: Mapping[str, str]) -> Table:
    rows = []
    for name, contact in variants.items():
        for b in DAMPINGS:
            found = contact.stability_limit("stiffness", damping=b)
            place = f"{name}.be_{b:g}"
            shown = _enter(found, "ke_limit", place, "ke_frequency", numbers)
            rows.append((titles.get(name, name), b, *shown))
    columns = ("variant", "b_e [N·s/m]", "largest k_e", "oscillates at", "moves", "stable again")
    return Table("Largest stiffness of the environment", columns, tuple(rows))


def _tried(
    variants: Mapping[Implementation, Contact], numbers: dict[str, Number], titles: Mapping[str, str]
) -> tuple[list[Table], list[str]]:
    """Return the table of limits that were tried in the nonlinear run, and why others were not.

    Raises
    ------
    ConfirmationError
        If the run contradicts a limit however small the push.
    """
    rows, said = [], dict[str, None]()
    for name, contact in variants.items():
        if not contact.sample_time:
            continue  # a run exchanges signals with the FMU at ticks only
        limit = contact.stability_limit("stiffness", damping=TRIED_DAMPING)
        if not (math.isfinite(limit.value) and limit.value > 0.0):
            continue
        try:
            found = try_limit(contact, limit)
        except OptionError as error:
            said[str(error)] = None
            continue
        for where, trial in zip(("below", "above"), found.trials, strict=True):
            path = f"tried.ke_limit.{name}.be_{TRIED_DAMPING:g}.{where}.growth_rate"
            how = "the nonlinear run with the environment inside the plant, beside the linear loop's poles"
            numbers[path] = Number(trial.measured, "1/s", found.within, how)
            rows.append(
                (titles.get(name, name), f"{trial.factor:g}", trial.value, numbers[path],
                 float(f"{trial.predicted:.4g}"), float(f"{trial.fastest:.2g}"))
            )  # fmt: skip
    columns = ("variant", "of the limit", "k_e [N/m]", "growth rate, measured", "predicted [1/s]", "speeds up to [m/s]")
    title = f"Limits of stiffness at b_e = {TRIED_DAMPING:g} N·s/m, tried in the nonlinear run"
    return ([Table(title, columns, tuple(rows))] if rows else []), list(said)


def _masses(
    variants: Mapping[Implementation, Contact],
    has_spring: bool,
    numbers: dict[str, Number],
    titles: Mapping[str, str],
) -> Table:
    rows = []
    # without any stiffness the robot drifts, and there is no limit to lose
    moored: dict[str, Any] = {} if has_spring else {"stiffness": SPRING}
    for name, contact in variants.items():
        for vary, key in (("mass", "me_limit"), ("tool_mass", "tool_mass_limit")):
            found = contact.stability_limit(vary, **moored)
            shown = _enter(found, key, str(name), "", numbers)
            rows.append((titles.get(name, name), "m_e" if vary == "mass" else "tool", *shown))
    where = f"on a spring of {SPRING:g} N/m" if moored else "without spring and damper"
    columns = ("variant", "mass", "largest", "oscillates at", "moves", "stable again")
    return Table(f"Largest masses, {where}", columns, tuple(rows))


def _enter(found: ContactLimit, key: str, place: str, frequency_key: str, numbers: dict[str, Number]) -> Iterator[Any]:
    """Enter the numbers of a limit, and yield its cells: value, frequency, direction and changes beyond."""
    numbers[f"{key}.{place}"] = found.number
    yield found.number
    frequency = None
    if math.isfinite(found.frequency):
        error = 1e-6 * found.frequency
        frequency = with_findings(Number(found.frequency, "rad/s", error, found.confirmed_by), found.findings)
        if frequency_key:
            numbers[f"{frequency_key}.{place}"] = frequency
    yield frequency
    yield "(" + ", ".join(f"{v:.3g}" for v in found.direction) + ")" if found.direction else "–"
    yield again(found)


def _rendered(variants: Mapping[Implementation, Contact], side: str, titles: Mapping[str, str]) -> Plot:
    one = next(iter(variants.values()))
    a = one.filter
    assert a is not None  # find_contacts looks
    centre = math.sqrt(a.stiffness / a.mass) if a.stiffness > 0 else float(a.effective_damping) / a.mass
    periods = [c.sample_time for c in variants.values() if c.sample_time]
    w = np.geomspace(centre / 50, 0.999 * math.pi / max(periods) if periods else 1e5, 500)
    target = one.admittance(w).target
    assert target is not None  # as there is a filter
    curves: dict[str, tuple[str, np.ndarray]] = {TARGET: ("target", target)}
    curves |= {n: (titles.get(n, n), c.admittance(w).rendered) for n, c in variants.items()}
    return draw_admittances(f"admittance_{side}", w, curves, {}, along=side == "par")


def again(found: StabilityLimit | ContactLimit) -> str:
    """Return the text on values beyond a limit at which stability changes again."""
    if not found.restabilizes:
        return "no"
    text, values = [], list(found.restabilizes)
    for low, high in zip(values[::2], [*values[1::2], None], strict=False):
        text.append(f"from {low:.6g}" + (f" to {high:.6g}" if high is not None else "") + f" {found.unit}")
    return ", ".join(text)

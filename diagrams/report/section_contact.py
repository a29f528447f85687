"""Contacts of environments with the plant: admittances, limits of coupled stability, and these limits tried in runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...blocks.core import ConfirmationError, LoopwrightError, OptionError
from .. import report_figures as figures
from ..admittance import Contact, ContactLimit, try_limit
from ..flat import WiredDiagram
from ..frequency import Number, with_findings
from ..report_writing import Plot, Section, Table, Texts
from .content_hash import content_hash

TEXTS = Texts(__package__, "contact")
DAMPINGS = (0.0, 10.0, 100.0)
"""Dampings in N·s/m of the environments whose stiffness is limited."""
TRIED_DAMPING = 10.0
"""Damping of the environment whose limit is tried in the nonlinear run."""
SPRING = 10.0
"""Spring in N/m that holds a mass."""
WIDE = 50.0
"""Factor of the limit of stiffness to both ends of a map, and of the damping k/ω that belongs to it."""


def check_contacts(diagram: WiredDiagram, contacts: Mapping[str, Any]) -> Mapping[str, Contact]:
    """Return contacts by the names of their sections, which stand in dotted paths.

    Raises
    ------
    OptionError
        If there is something else, a name with a dot, or a contact of another diagram.
    """
    own = content_hash(diagram)
    for name, contact in contacts.items():
        if not isinstance(contact, Contact):
            raise OptionError(
                f"found {contact!r} for {name!r}; expected a contact. Give diagram.contact(…).", port="contacts"
            )
        if not str(name).isidentifier():
            raise OptionError(
                f"found the name {name!r}; expected letters, digits and underscores, as it stands in dotted paths.",
                port="contacts",
            )
        if content_hash(contact.diagram) != own:
            raise OptionError(
                f"found a contact of another diagram under {name!r}; expected one of {diagram.name!r} with its present "
                "parameters. Make it by diagram.contact(…).",
                port="contacts",
            )
    return contacts


def contact_sections(contacts: Mapping[str, Contact]) -> Section:
    """Return the section on contacts, each in a section of its own."""
    parts = tuple(_contact(name, contact) for name, contact in contacts.items())
    return Section("contact", "Contact with an environment", TEXTS.paragraphs("meaning"), sections=parts)


def _contact(name: str, contact: Contact) -> Section:
    numbers: dict[str, Number] = {}
    soft = contact.stability_limit("stiffness")
    tables = [_passivity(contact, numbers), _stiffness(contact, soft, numbers), _masses(contact, numbers)]
    tried, said = _tried(contact, numbers)
    parts = contact.parts
    text = TEXTS.paragraphs(
        "place", port=f"{contact.plant}.{contact.ports.force}", measured=contact.measured, entry=contact.entry,
        t=contact.point.t,
        direction=", ".join(f"{v:.4g}" for v in contact.direction), derivation=str(contact.derivation),
        sample_time=parts.sample_time, ticks=len(parts.ticks), caveat=contact.passivity().caveat,
    )  # fmt: skip
    plots = (_admittance(name, contact), *_map(name, contact, soft))
    return Section(name, f"Contact {name!r}", (*text, *said), (*tables, *tried), plots, numbers)


def sign_of_admittance(contact: Contact) -> tuple[Number, str, str]:
    """Return the first frequency at which Re Y is negative, all such spans, and whether the loop alone is stable.

    The number is confirmed by the sign of Re Y on its two sides.
    """
    p = contact.passivity()
    known = f"Re Y ≥ 0 on the whole scan up to {p.scanned[1]:.6g} rad/s"
    if math.isfinite(p.frequency):
        below, above = contact.admittance([p.frequency * f for f in (1 - 1e-6, 1 + 1e-6)]).rendered.real
        known = "sign of Re Y just below and just above"
        if not below > 0 > above:
            known = "Re Y changes its sign within rounding there"
    error = p.tolerance * p.frequency if math.isfinite(p.frequency) else 0.0
    spans = ", ".join(f"{low:.5g} … {high:.5g}" for low, high in p.intervals) or "none"
    return Number(p.frequency, "rad/s", error, known, findings=p.findings), spans, "yes" if p.stable else "no"


def _passivity(contact: Contact, numbers: dict[str, Number]) -> Table:
    rows = (sign_of_admittance(contact),)
    numbers["first_non_passive"] = rows[0][0]
    return Table("Sign of Re Y(jω)", ("first Re Y < 0 at", "all of Re Y < 0 [rad/s]", "stable alone"), rows)


def _stiffness(contact: Contact, soft: ContactLimit, numbers: dict[str, Number]) -> Table:
    rows = []
    for b in DAMPINGS:
        found = soft if b == 0.0 else contact.stability_limit("stiffness", damping=b)
        again = f"{found.second_look:.6g} N/m" if math.isfinite(found.second_look) else ""
        rows.append((f"{b:g}", *_enter(found, "ke_limit", f"be_{b:g}", numbers), again))
    columns = ("b_e [N·s/m]", "largest k_e", "oscillates at", "moves", "stable again", "from Re Y = 0")
    return Table("Largest stiffness of the environment", columns, tuple(rows))


def _masses(contact: Contact, numbers: dict[str, Number]) -> Table:
    rows = []
    kinds = {"mass": ("me_limit", "m_e")}
    if contact.measured is not None:
        kinds["tool_mass"] = ("tool_mass_limit", "tool")
    for vary, (key, symbol) in kinds.items():
        found = contact.stability_limit(vary, stiffness=SPRING)
        rows.append((symbol, *_enter(found, key, f"ke_{SPRING:g}", numbers)))
    columns = ("mass", "largest", "oscillates at", "moves", "stable again")
    return Table(f"Largest masses, on a spring of {SPRING:g} N/m", columns, tuple(rows))


def _enter(found: ContactLimit, key: str, place: str, numbers: dict[str, Number]) -> Iterator[Any]:
    """Enter the numbers of a limit, and yield its cells: value, frequency, direction and changes beyond."""
    numbers[f"{key}.{place}"] = found.number
    yield found.number
    frequency = None
    if math.isfinite(found.frequency):
        frequency = Number(found.frequency, "rad/s", 1e-6 * found.frequency, found.confirmed_by)
        frequency = numbers[f"{key}_frequency.{place}"] = with_findings(frequency, found.findings)
    yield frequency
    yield "(" + ", ".join(f"{v:.3g}" for v in found.direction) + ")" if found.direction else ""
    spans = [*found.restabilizes, None]
    yield ", ".join(
        f"from {low:.6g}" + (f" to {high:.6g}" if high is not None else "") + f" {found.unit}"
        for low, high in zip(found.restabilizes[::2], spans[1::2], strict=False)
    )


def _tried(contact: Contact, numbers: dict[str, Number]) -> tuple[list[Table], tuple[str, ...]]:
    """Return the table of the limit that was tried in the nonlinear run, and what is to be said of it."""
    limit = contact.stability_limit("stiffness", damping=TRIED_DAMPING)
    if not (math.isfinite(limit.value) and limit.value > 0.0):
        return [], TEXTS.paragraphs("nothing_to_try", limit=limit.value)
    try:
        found = try_limit(contact, limit)
    except ConfirmationError as error:
        return [], TEXTS.paragraphs("refuted", message=str(error))
    except LoopwrightError as error:
        return [], TEXTS.paragraphs("not_tried", message=str(error))
    rows = []
    for where, trial in zip(("below", "above"), found.trials, strict=True):
        path = f"tried.ke_limit.be_{TRIED_DAMPING:g}.{where}.growth_rate"
        how = f"the nonlinear run with {found.method.value}, beside the linear loop's poles"
        numbers[path] = Number(trial.measured, "1/s", found.within, how)
        rows.append((
            f"{trial.factor:g}", f"{trial.value:.6g} N/m", numbers[path], f"{trial.predicted:.4g} 1/s",
            f"{trial.fastest:.2g} m/s",
        ))  # fmt: skip
    columns = ("of the limit", "k_e", "growth rate, measured", "predicted", "speeds up to")
    title = f"Limit of stiffness at b_e = {TRIED_DAMPING:g} N·s/m, tried in the nonlinear run"
    held = TEXTS.paragraphs("tried", method=found.method.value, tried=found.tried, limit=limit.value)
    return [Table(title, columns, tuple(rows))], held


def _admittance(name: str, contact: Contact) -> Plot:
    T, first = contact.shortest, contact.passivity().frequency
    top = 0.999 * math.pi / T if T else 1e3 * (first if math.isfinite(first) else 10.0)
    w = np.geomspace(top / 3e4, top, 400)
    shown = contact.admittance(w)
    return figures.contact_admittance(f"contact_admittance_{name}", name, w, shown.rendered, shown.target)


def _map(name: str, contact: Contact, soft: ContactLimit) -> Iterator[Plot]:
    """Yield the map of growth rates over stiffness and damping, around the limit of a spring alone."""
    if not (math.isfinite(soft.value) and soft.value > 0.0 and soft.frequency > 0.0):
        return
    damping = soft.value / soft.frequency
    k = np.geomspace(soft.value / WIDE, soft.value * WIDE, 41)
    found = contact.stability_map(k, np.geomspace(damping / WIDE, damping, 10))
    yield figures.contact_map(f"contact_map_{name}", name, found.x_values, found.y_values, found.growth)

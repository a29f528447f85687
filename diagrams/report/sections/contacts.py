"""Contacts of environments with the plant: admittances, limits of coupled stability, and these limits tried in runs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ....blocks.core import ConfirmationError, LoopwrightError, OptionError, UnknownNameError, near, print_unit
from ...contact import Contact, ContactLimit, try_limit
from ...flat import WiredDiagram
from ...frequency import Number, with_findings
from ...requirements import ContactLimits, Reason, RequirementResult, Requirements, TomlFile, Verdict, judge
from ...studies import ContactTask
from .. import figures
from ..content_hash import content_hash
from ..pages import Plot, Section, Table, Texts

TEXTS = Texts(__package__, "contact")
KEY = "contact"
"""Key of the section, table of a TOML file, and the variant that its verdicts belong to."""
LIMITS = {"stiffness": "ke_limit", "damping": "be_limit", "mass": "me_limit", "tool_mass": "tool_mass_limit"}
"""Names of limits in dotted paths, by the property that varies."""
SYMBOLS = {"stiffness": "ke", "damping": "be", "mass": "me", "tool_mass": "tool"}
"""Names of an environment's properties in dotted paths."""
WORDS = {"stiffness": "k_e", "damping": "b_e", "mass": "m_e", "tool_mass": "tool"}
"""Properties of an environment in tables."""
ALONE = "alone"
"""Environment with nothing but what varies, in tables."""
SCANNED = {"stiffness": 1e8, "damping": 1e8, "mass": 1e4, "tool_mass": 1e4}
"""Upper ends of the scans; one beyond a required limit is taken where that is larger."""
BEYOND = 1.1
"""Factor by which a scan goes beyond a required limit."""
DAMPINGS = (0.0, 10.0, 100.0)
"""Dampings in N·s/m of the environments whose stiffness is limited."""
TRIED_DAMPING = 10.0
"""Damping of the environment whose limit is tried in the nonlinear run."""
SPRING = 10.0
"""Spring in N/m that holds a mass."""
SIGN_COLUMNS = ("first Re Y < 0 at", "all of Re Y < 0 [rad/s]", "stable alone", "passive")
"""Columns of `sign_of_admittance`; the last is the verdict against all passive environments, with all aliases."""
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


@dataclass
class ReportedContacts:
    """Contacts of a report, with the limits that are required of them.

    Attributes
    ----------
    contacts : mapping of str to Contact
        Contacts by their names.
    limits : mapping of str to tuple of ContactLimits
        Required limits by the contacts' names; those of all contacts have the name "".
    weakest : list of tuple
        Row of each contact on the first page, once its section is made.
    refuted : set of str
        Paths of limits that a nonlinear run contradicts.
    """

    contacts: Mapping[str, Contact]
    limits: Mapping[str, tuple[ContactLimits, ...]]
    weakest: list[tuple[Any, ...]] = field(default_factory=list)
    refuted: set[str] = field(default_factory=set)

    def limits_of(self, name: str) -> tuple[ContactLimits, ...]:
        """Return the limits that are required of a contact: those of all, but for what it has limits of its own."""
        own = self.limits.get(name, ())
        mine = {(vary, _place(vary, one.environment)) for one in own for vary in one.limits}
        found = []
        for one in self.limits.get("", ()):
            left = {vary for vary in one.limits if (vary, _place(vary, one.environment)) not in mine}
            if left:
                kept = {vary: tuple(one.limits[vary]) for vary in one.limits if vary in left}
                found.append(ContactLimits({**kept, "with": dict(one.environment)}))
        return (*found, *own)

    def results(self, numbers: Mapping[str, Number]) -> Iterator[RequirementResult]:
        """Yield the verdicts on the limits."""
        if not self.contacts:
            for one in self.limits.get("", ()):
                for vary, limit in one.limits.items():
                    name = f"{KEY}.{vary}"
                    yield RequirementResult(name, "", KEY, limit, Verdict.UNDECIDED, Reason.NO_NUMBER)
        for name in self.contacts:
            for one in self.limits_of(name):
                for vary, limit in one.limits.items():
                    path = f"{KEY}.{name}.{LIMITS[vary]}.{_place(vary, one.environment)}"
                    result = RequirementResult(f"{KEY}.{vary}", name, KEY, limit, Verdict.UNDECIDED, Reason.NO_NUMBER)
                    if path in numbers:
                        verdict, reason, distance = judge(numbers[path], limit)
                        if path in self.refuted:
                            verdict, reason = Verdict.UNDECIDED, Reason.REFUTED
                        result = replace(result, verdict=verdict, reason=reason, distance=distance, path=path)
                        result = replace(result, number=numbers[path], detail=_describe(one.environment))
                    yield result


def read_contacts(
    diagram: WiredDiagram,
    given: Mapping[str, Any] | ContactTask | str | os.PathLike[str] | None,
    file: TomlFile | None,
    asked: Requirements | None,
) -> ReportedContacts | None:
    """Return the contacts of a report and the limits that are required of them; None without both.

    Parameters
    ----------
    diagram : Diagram
        The diagram.
    given : mapping, ContactTask or path, optional
        The option of the report.
    file : TomlFile, optional
        The file of its requirements, which may have the tables.
    asked : Requirements, optional
        The requirements.

    Raises
    ------
    OptionError, UnknownNameError
        As `check_contacts`; contacts from two places; a file that asks for something that isn't there; limits of a
        contact that the report does not have.
    """
    if file is not None and file.table(KEY):
        if given:
            raise file.error("found contacts here, and others in contacts; expected one place. Leave one out.", KEY)
        given = ContactTask.read(file)
    if isinstance(given, str | os.PathLike):
        given = ContactTask.read(given)
    own = {} if asked is None else dict(asked.contacts)
    if isinstance(given, ContactTask):
        contacts = given.find(diagram)
        for name, limits in given.limits.items():
            own[name] = (*own.get(name, ()), *limits)
    else:
        contacts = check_contacts(diagram, given or {})
    for name in own:
        if name and name not in contacts:
            raise UnknownNameError(
                f"found requirements on a contact {name!r}; expected one of the report. {near(name, contacts)}",
                block=diagram.name,
            )
    return ReportedContacts(contacts, own) if contacts or own else None


def contact_sections(reported: ReportedContacts) -> Section:
    """Return the section on contacts, each in a section of its own."""
    parts = tuple(_contact(name, contact, reported) for name, contact in reported.contacts.items())
    return Section(KEY, "Contact with an environment", TEXTS.paragraphs("meaning"), sections=parts)


def contacts_on_first_page(reported: ReportedContacts) -> Table:
    """Return the weakest limit of stiffness of each contact."""
    columns = ("contact", "stable up to k_e", "with", "oscillates at", "first Re Y < 0 at")
    return Table("Contacts: weakest limits of stiffness", columns, tuple(reported.weakest), digits=4)


def _place(vary: str, environment: Mapping[str, float]) -> str:
    """Return the name of an environment in a dotted path."""
    parts = [f"{SYMBOLS[p]}_{environment[p]:g}".replace(".", "_") for p in SYMBOLS if p in environment]
    return "_".join(parts) or ("be_0" if vary == "stiffness" else "alone")


def _describe(environment: Mapping[str, float]) -> str:
    """Return the properties of an environment in words, empty without any."""
    units = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "tool_mass": "kg"}
    parts = (f"{WORDS[p]} = {environment[p]:g} {print_unit(units[p])}" for p in WORDS if p in environment)
    return ", ".join(parts)


def _contact(name: str, contact: Contact, reported: ReportedContacts) -> Section:
    numbers: dict[str, Number] = {}
    required = reported.limits_of(name)
    soft = contact.stability_limit("stiffness")
    tables = [_passivity(contact, numbers), _stiffness(contact, soft, numbers), _masses(contact, numbers)]
    tables += _required(contact, required, numbers)
    reported.weakest.append(_find_weakest(name, required, numbers))
    tried, said, refuted = _tried(contact, required, numbers)
    reported.refuted |= {f"{KEY}.{name}.{path}" for path in refuted}
    parts, seen = contact.parts, contact.passivity()
    text = TEXTS.paragraphs(
        "place", port=f"{contact.plant}.{contact.ports.force}", measured=contact.measured, entry=contact.entry,
        t=contact.point.t,
        direction=", ".join(f"{v:.4g}" for v in contact.direction), derivation=str(contact.derivation),
        sample_time=parts.sample_time, ticks=len(parts.ticks), caveat=f"{seen.caveat} {seen.port}",
    )  # fmt: skip
    plots = (_admittance(name, contact), *_map(name, contact, soft))
    return Section(name, f"Contact {name!r}", (*text, *said), (*tables, *tried), plots, numbers)


def sign_of_admittance(contact: Contact) -> tuple[Number, str, str, str]:
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
    number = Number(p.frequency, "rad/s", error, known, findings=p.findings)
    passive = None if p.port is None else p.port.passive
    return number, spans, "yes" if p.stable else "no", {True: "yes", False: "no", None: "–"}[passive]


def _passivity(contact: Contact, numbers: dict[str, Number]) -> Table:
    rows = (sign_of_admittance(contact),)
    numbers["first_non_passive"] = rows[0][0]
    return Table("Sign of Re Y(jω)", SIGN_COLUMNS, rows)


def _stiffness(contact: Contact, soft: ContactLimit, numbers: dict[str, Number]) -> Table:
    rows = []
    for b in DAMPINGS:
        found = soft if b == 0.0 else contact.stability_limit("stiffness", damping=b)
        again = found.second_look if math.isfinite(found.second_look) else None
        rows.append((f"{b:g}", *_enter(found, "ke_limit", f"be_{b:g}", numbers), again))
    columns = ("b_e [N·s/m]", "largest k_e", "oscillates at", "moves", "stable again", "from Re Y = 0 [N/m]")
    return Table("Largest stiffness of the environment", columns, tuple(rows))


def _masses(contact: Contact, numbers: dict[str, Number]) -> Table:
    rows = []
    kinds = {"mass": ("me_limit", "m_e")}
    if contact.measured is not None and not contact.parts.tool.problem:
        kinds["tool_mass"] = ("tool_mass_limit", "tool")
    for vary, (key, symbol) in kinds.items():
        found = contact.stability_limit(vary, stiffness=SPRING)
        rows.append((symbol, *_enter(found, key, f"ke_{SPRING:g}", numbers)))
    columns = ("mass", "largest", "oscillates at", "moves", "stable again")
    return Table(f"Largest masses, on a spring of {SPRING:g} N/m", columns, tuple(rows))


def _required(contact: Contact, required: tuple[ContactLimits, ...], numbers: dict[str, Number]) -> list[Table]:
    """Return the table of the limits that are required."""
    rows = []
    for one in required:
        for vary, limit in one.limits.items():
            if contact.parts.tool.problem and "tool_mass" in {vary, *one.environment}:
                continue
            ends = [end for end in limit if math.isfinite(end)]
            high = max([SCANNED[vary], *(BEYOND * end for end in ends)])
            environment: dict[str, Any] = dict(one.environment)
            found = contact.stability_limit(vary, high=high, **environment)
            cells = _enter(found, LIMITS[vary], _place(vary, one.environment), numbers)
            asked = f"{limit} {print_unit(found.unit)}"
            rows.append((WORDS[vary], _describe(one.environment) or ALONE, asked, *cells))
    columns = ("largest", "with", "required", "found", "oscillates at", "moves", "stable again")
    return [Table("Limits that are required", columns, tuple(rows))] if rows else []


def _find_weakest(name: str, required: tuple[ContactLimits, ...], numbers: Mapping[str, Number]) -> tuple[Any, ...]:
    """Return the row of a contact on the first page: its weakest limit of stiffness."""
    key = LIMITS["stiffness"]
    environments: list[Mapping[str, float]] = [*({"damping": b} for b in DAMPINGS), *(o.environment for o in required)]
    words = {_place("stiffness", one): _describe(one) or ALONE for one in environments}
    words[_place("stiffness", {})] = ALONE
    places = [path.partition(".")[2] for path in numbers if path.startswith(f"{key}.")]
    place = min(places, key=lambda p: numbers[f"{key}.{p}"].value)
    frequency = numbers.get(f"{key}_frequency.{place}", "–")
    return name, numbers[f"{key}.{place}"], words[place], frequency, numbers["first_non_passive"]


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


def _tried(
    contact: Contact, required: tuple[ContactLimits, ...], numbers: dict[str, Number]
) -> tuple[list[Table], tuple[str, ...], list[str]]:
    """Return the table of the limit that was tried in the nonlinear run, what is to be said of it, and what it refutes.

    The first limit of stiffness that is required is tried, or that with a damper.
    """
    wanted = (dict(one.environment) for one in required if "stiffness" in one.limits)
    environment: dict[str, Any] = next(wanted, {"damping": TRIED_DAMPING})
    place = _place("stiffness", environment)
    limit = contact.stability_limit("stiffness", **environment)
    if not (math.isfinite(limit.value) and limit.value > 0.0):
        return [], TEXTS.paragraphs("nothing_to_try", limit=limit.value, environment=_describe(environment)), []
    try:
        found = try_limit(contact, limit)
    except ConfirmationError as error:
        return [], TEXTS.paragraphs("refuted", message=str(error)), [f"{LIMITS['stiffness']}.{place}"]
    except LoopwrightError as error:
        return [], TEXTS.paragraphs("not_tried", message=str(error)), []
    rows = []
    for where, trial in zip(("below", "above"), found.trials, strict=True):
        path = f"tried.ke_limit.{place}.{where}.growth_rate"
        how = f"the nonlinear run with {found.method.value}, beside the linear loop's poles"
        numbers[path] = Number(trial.measured, "1/s", found.within, how)
        rows.append((
            f"{trial.factor:g}", trial.value, numbers[path], float(f"{trial.predicted:.4g}"),
            float(f"{trial.fastest:.2g}"),
        ))  # fmt: skip
    columns = ("of the limit", "k_e [N/m]", "growth rate, measured", "predicted [1/s]", "speeds up to [m/s]")
    besides = f" with {_describe(environment)}" if environment else ""
    title = f"Limit of stiffness{besides}, tried in the nonlinear run"
    held = TEXTS.paragraphs("tried", method=found.method.value, tried=found.tried, limit=limit.value)
    return [Table(title, columns, tuple(rows))], held, []


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

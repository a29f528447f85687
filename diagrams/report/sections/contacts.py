"""Contacts of environments with the plant: admittances, limits of coupled stability, and these limits tried in runs."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ....blocks.core import ConfirmationError, Finding, LoopwrightError, OptionError, UnknownNameError, near, print_unit
from ...contact import Contact, ContactConfirmation, ContactLimit, Passivity, try_limit
from ...flat import WiredDiagram
from ...frequency import Number, with_findings
from ...requirements import ContactLimits, Reason, RequirementResult, Requirements, TomlFile
from ...studies import ContactTask
from .. import figures
from ..content_hash import content_hash
from ..error_sentences import say
from ..pages import Plot, Section, Table, TableForm, Texts

TEXTS = Texts(__package__, "contact")
KEY = "contact"
"""Key of the section, table of a TOML file, and the variant that its verdicts belong to."""
LIMITS = {"stiffness": "ke_limit", "damping": "be_limit", "mass": "me_limit", "tool_mass": "tool_mass_limit"}
"""Names of limits in dotted paths, by the property that varies."""
SYMBOLS = {"stiffness": "ke", "damping": "be", "mass": "me", "tool_mass": "tool"}
"""Names of an environment's properties in dotted paths."""
WORDS = {"stiffness": "k_e", "damping": "b_e", "mass": "m_e", "tool_mass": "tool"}
"""Properties of an environment in tables."""
UNITS = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "tool_mass": "kg"}
ALONE = "alone"
"""Environment with nothing but what varies, in tables."""
SCANNED = {"stiffness": 1e8, "damping": 1e8, "mass": 1e4, "tool_mass": 1e4}
"""Upper ends of the scans; one beyond a required limit is taken where that is larger."""
BEYOND = 1.1
"""Factor by which a scan goes beyond a required limit."""
DAMPINGS = (0.0, 10.0, 100.0)
"""Dampings in N·s/m of the environments whose stiffness is limited."""
TRIED_DAMPING = 10.0
"""Damping in N·s/m of the environment whose limit is tried in the nonlinear run."""
SPRING = 10.0
"""Spring in N/m that holds a mass."""
WIDE = 50.0
"""Factor of the limit of stiffness to both ends of a map, and of the damping k/ω that belongs to it."""

# --- tables -----------------------------------------------------------------------------------------------------------

SIGN = {
    "first Re Y < 0 at": "first",
    "all of Re Y < 0 [rad/s]": "spans",
    "stable alone": "stable",
    "passive": "passive",  # against all passive environments, with all aliases
}
FOUND = {"oscillates at": "frequency", "moves": "direction", "stable again": "again"}
LIMIT_PATHS = {"limit": "{key}.{place}", "frequency": "{key}_frequency.{place}"}
TRIED = {
    "of the limit": "factor",
    "k_e [N/m]": "value",
    "growth rate, measured": "measured",
    "predicted [1/s]": "predicted",
    "speeds up to [m/s]": "fastest",
}

WEAKEST = TableForm(
    "Contacts: weakest limits of stiffness",
    {
        "contact": "contact",
        "stable up to k_e": "limit",
        "with": "environment",
        "oscillates at": "frequency",
        "first Re Y < 0 at": "first",
    },
    digits=4,
)
PASSIVITY = TableForm("Sign of Re Y(jω)", SIGN, {"first": "first_non_passive"})
STIFFNESS = TableForm(
    "Largest stiffness of the environment",
    {"b_e [N·s/m]": "damping", "largest k_e": "limit", **FOUND, "from Re Y = 0 [N/m]": "second_look"},
    LIMIT_PATHS,
)
MASSES = TableForm(
    f"Largest masses, on a spring of {SPRING:g} N/m", {"mass": "mass", "largest": "limit", **FOUND}, LIMIT_PATHS
)
REQUIRED = TableForm(
    "Limits that are required",
    {"largest": "property", "with": "environment", "required": "required", "found": "limit", **FOUND},
    LIMIT_PATHS,
)
IN_RUNS = TableForm(
    "Limit of stiffness{environment}, tried in the nonlinear run",
    TRIED,
    {"measured": "tried.ke_limit.{place}.{side}.growth_rate"},
)


def sign_of_admittance(p: Passivity, admittance: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """Return the facts of `SIGN`; the first frequency is confirmed by the sign of Re Y, in m/(N·s), around it."""
    known, error = f"Re Y ≥ 0 on the whole scan up to {p.scanned[1]:.6g} rad/s", 0.0
    if math.isfinite(p.frequency):
        below, above = admittance(p.frequency * np.array([1 - 1e-6, 1 + 1e-6])).real
        known, error = "sign of Re Y just below and just above", p.tolerance * p.frequency
        if not below > 0 > above:
            known = "Re Y changes its sign within rounding there"
    passive = None if p.port is None else p.port.passive
    return {
        "first": Number(p.frequency, "rad/s", error, known, findings=p.findings),
        "spans": ", ".join(f"{low:.5g} … {high:.5g}" for low, high in p.intervals) or "none",
        "stable": "yes" if p.stable else "no",
        "passive": {True: "yes", False: "no", None: "–"}[passive],
    }


def contact_sign(contact: Contact) -> dict[str, Any]:
    """Return the facts of `SIGN` of a contact."""
    return sign_of_admittance(contact.passivity(), lambda w: contact.admittance(w).rendered)


def limit_facts(found: ContactLimit) -> dict[str, Any]:
    """Return the limit of a contact, its frequency, and what `FOUND` shows of it; texts are empty without a limit."""
    return {
        "limit": found.number,
        "frequency": frequency_number(found.frequency, found.confirmed_by, found.findings),
        "direction": "(" + ", ".join(f"{v:.3g}" for v in found.direction) + ")" if found.direction else "",
        "again": stable_again(found.restabilizes, found.unit),
    }


def frequency_number(frequency: float, confirmed_by: str, findings: Sequence[Finding]) -> Number | None:
    """Return the frequency in rad/s at which the loop oscillates at a limit; None without one (NaN)."""
    if not math.isfinite(frequency):
        return None
    return with_findings(Number(frequency, "rad/s", 1e-6 * frequency, confirmed_by), tuple(findings))


def stable_again(restabilizes: Sequence[float], unit: str) -> str:
    """Return the values beyond a limit at which the loop is stable again as text; empty without any."""
    ends = [*restabilizes, None]
    return ", ".join(
        f"from {low:.6g}" + (f" to {high:.6g}" if high is not None else "") + f" {unit}"
        for low, high in zip(restabilizes[::2], ends[1::2], strict=False)
    )


def trial_facts(found: ContactConfirmation, how: str) -> Iterator[dict[str, Any]]:
    """Yield the facts of `TRIED` for the runs below and above a limit."""
    for side, trial in zip(("below", "above"), found.trials, strict=True):
        yield {
            "side": side,
            "factor": f"{trial.factor:g}",
            "value": trial.value,
            "measured": Number(trial.measured, "1/s", found.within, f"{how}, beside the linear loop's poles"),
            "predicted": float(f"{trial.predicted:.4g}"),
            "fastest": float(f"{trial.fastest:.2g}"),
        }


# --- the contacts of a report -----------------------------------------------------------------------------------------


def check_contacts(diagram: WiredDiagram, contacts: Mapping[str, Any]) -> Mapping[str, Contact]:
    """Return contacts by the names of their sections; refuse others, those of another diagram, and names with dots."""
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
        if content_hash(contact.wired) != own:
            raise OptionError(
                f"found a contact of another diagram under {name!r}; expected one of {diagram.name!r} with its present "
                "parameters. Make it by diagram.contact(…).",
                port="contacts",
            )
    return contacts


@dataclass
class ReportedContacts:
    """Contacts of a report, with the limits that are required of them, by their names; "" is that of all contacts."""

    contacts: Mapping[str, Contact]
    limits: Mapping[str, tuple[ContactLimits, ...]]
    weakest: list[Mapping[str, Any]] = field(default_factory=list)  # of each contact, for the first page
    refuted: set[str] = field(default_factory=set)

    def limits_of(self, name: str) -> tuple[ContactLimits, ...]:
        """Return the limits that are required of a contact: its own, and the general ones that it doesn't replace."""
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
                    yield RequirementResult(name, "", KEY, limit, unit=UNITS[vary])
        for name in self.contacts:
            for one in self.limits_of(name):
                for vary, limit in one.limits.items():
                    path = f"{KEY}.{name}.{LIMITS[vary]}.{_place(vary, one.environment)}"
                    result = RequirementResult(f"{KEY}.{vary}", name, KEY, limit, unit=UNITS[vary])
                    if path in numbers:
                        result = result.judged(numbers[path], path)
                        result = result.undecided(Reason.REFUTED) if path in self.refuted else result
                        result = replace(result, detail=_describe(one.environment))
                    yield result


def read_contacts(
    diagram: WiredDiagram,
    given: Mapping[str, Any] | ContactTask | str | os.PathLike[str] | None,
    file: TomlFile | None,
    required: Requirements | None,
) -> ReportedContacts | None:
    """Return the contacts of a report and the limits that are required of them; None without both.

    ``given`` is the option of the report; ``file``, that of its requirements, may have the tables in its place.
    """
    if file is not None and file.table(KEY):
        if given:
            raise file.error("found contacts here, and others in contacts; expected one place. Leave one out.", KEY)
        given = ContactTask.read(file)
    if isinstance(given, str | os.PathLike):
        given = ContactTask.read(given)
    own = {} if required is None else dict(required.contacts)
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


# --- the sections -----------------------------------------------------------------------------------------------------


def contact_sections(reported: ReportedContacts) -> Section:
    """Return the section on contacts, with a section for each."""
    parts = tuple(_contact(name, contact, reported) for name, contact in reported.contacts.items())
    return Section(KEY, "Contact with an environment", TEXTS.paragraphs("meaning"), sections=parts)


def contacts_on_first_page(reported: ReportedContacts) -> Table:
    """Return the weakest limit of stiffness of each contact."""
    return WEAKEST.fill(reported.weakest)


def _place(vary: str, environment: Mapping[str, float]) -> str:
    """Return the name of an environment in a dotted path."""
    parts = [f"{SYMBOLS[p]}_{environment[p]:g}".replace(".", "_") for p in SYMBOLS if p in environment]
    return "_".join(parts) or ("be_0" if vary == "stiffness" else "alone")


def _describe(environment: Mapping[str, float]) -> str:
    """Return the properties of an environment in words, empty without any."""
    return ", ".join(f"{WORDS[p]} = {environment[p]:g} {print_unit(UNITS[p])}" for p in WORDS if p in environment)


def _contact(name: str, contact: Contact, reported: ReportedContacts) -> Section:
    required = reported.limits_of(name)
    soft = contact.stability_limit("stiffness")
    sign = contact_sign(contact)
    stiffness = _stiffness(contact, soft)
    limits = list(_required(contact, required))
    tables = [PASSIVITY.fill([sign]), STIFFNESS.fill(stiffness), MASSES.fill(_masses(contact))]
    tables += [REQUIRED.fill(limits)] if limits else []
    candidates = [*stiffness, *(row for row in limits if row["key"] == LIMITS["stiffness"])]
    weakest = min(candidates, key=lambda row: row["limit"].value)
    shown = {"frequency": "–"} | {fact: v for fact, v in weakest.items() if v is not None}
    reported.weakest.append({**shown, "contact": name, "first": sign["first"]})
    tried, remarks, refuted = _tried(contact, required)
    reported.refuted |= {f"{KEY}.{name}.{path}" for path in refuted}
    parts, seen = contact.parts, contact.passivity()
    text = TEXTS.paragraphs(
        "place",
        port=f"{contact.plant}.{contact.ports.force}",
        measured=contact.measured,
        entry=contact.entry,
        t=contact.point.t,
        direction=", ".join(f"{v:.4g}" for v in contact.direction),
        derivation=str(contact.derivation),
        sample_time=parts.sample_time,
        ticks=len(parts.ticks),
        caveat=f"{seen.caveat} {seen.port}",
    )
    plots = (_admittance(name, contact), *_map(name, contact, soft))
    return Section(name, f"Contact {name!r}", (*text, *remarks), (*tables, *tried), plots)


def _row(found: ContactLimit, vary: str, environment: Mapping[str, float]) -> dict[str, Any]:
    """Return the facts of a limit with the name of its environment, in dotted paths and in words."""
    place, words = _place(vary, environment), _describe(environment) or ALONE
    return {**limit_facts(found), "key": LIMITS[vary], "place": place, "environment": words}


def _stiffness(contact: Contact, soft: ContactLimit) -> list[dict[str, Any]]:
    rows = []
    for b in DAMPINGS:
        found = soft if b == 0.0 else contact.stability_limit("stiffness", damping=b)
        second = found.second_look if math.isfinite(found.second_look) else None
        row = _row(found, "stiffness", {"damping": b} if b else {})
        rows.append({**row, "damping": f"{b:g}", "second_look": second})
    return rows


def _masses(contact: Contact) -> Iterator[dict[str, Any]]:
    has_tool = contact.measured is not None and not contact.parts.tool.problem
    for vary in ("mass", "tool_mass") if has_tool else ("mass",):
        found = contact.stability_limit(vary, stiffness=SPRING)
        yield {**_row(found, vary, {"stiffness": SPRING}), "mass": WORDS[vary]}


def _required(contact: Contact, required: Sequence[ContactLimits]) -> Iterator[dict[str, Any]]:
    for one in required:
        for vary, limit in one.limits.items():
            if contact.parts.tool.problem and "tool_mass" in {vary, *one.environment}:
                continue
            ends = [end for end in limit if math.isfinite(end)]
            high = max([SCANNED[vary], *(BEYOND * end for end in ends)])
            environment: dict[str, Any] = dict(one.environment)
            found = contact.stability_limit(vary, high=high, **environment)
            shown = {"property": WORDS[vary], "required": f"{limit} {print_unit(found.unit)}"}
            yield {**_row(found, vary, one.environment), **shown}


def _tried(contact: Contact, required: Sequence[ContactLimits]) -> tuple[list[Table], tuple[str, ...], list[str]]:
    """Return the table of the limit that was tried in the nonlinear run, remarks on it, and paths that it refutes."""
    wanted = (dict(one.environment) for one in required if "stiffness" in one.limits)
    environment: dict[str, Any] = next(wanted, {"damping": TRIED_DAMPING})
    place, words = _place("stiffness", environment), _describe(environment)
    limit = contact.stability_limit("stiffness", **environment)
    if not (math.isfinite(limit.value) and limit.value > 0.0):
        return [], TEXTS.paragraphs("nothing_to_try", limit=limit.value, environment=words), []
    try:
        found = try_limit(contact, limit)
    except ConfirmationError as error:
        return [], TEXTS.paragraphs("refuted", message=say(error)), [f"{LIMITS['stiffness']}.{place}"]
    except LoopwrightError as error:
        return [], TEXTS.paragraphs("not_tried", message=say(error)), []
    rows = ({**row, "place": place} for row in trial_facts(found, f"the nonlinear run with {found.method.value}"))
    remarks = TEXTS.paragraphs("tried", method=found.method.value, tried=found.tried, limit=limit.value)
    return [IN_RUNS.fill(rows, environment=f" with {words}" if words else "")], remarks, []


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

"""The analysis of a diagram for a report, and the parts of a report about any diagram."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from functools import wraps
from typing import Any, TypeVar

from ...blocks.core import Kind, OptionError, accepts, kinds, offer_elsewhere, on_one_thread
from ...fmus.fmu_block import Fmu
from ..flat import WiredDiagram
from ..linearization import find_signal
from ..plotting import AxisUnits
from ..requirements import REQUIREMENTS, Requirements, TomlFile, read_requirements, write_requirements
from ..simulation import ProgressOption, work_notes
from ..studies import ContactTask, WorstCase, WorstCaseTask
from ..sweeps import processors
from .case import Case, ReportedExperiment
from .case_verdicts import review
from .content_hash import content_hash
from .pages import DEFINITIONS, Report
from .report_parts import ReportKind, ReportPart
from .sections.contacts import contact_sections, contacts_on_first_page, read_contacts
from .sections.injection import injected
from .sections.loops import inner
from .sections.measured_loops import measured_loops, read_measured
from .sections.not_modelled import not_modelled
from .sections.poles import closed_loops, memory
from .sections.sensitivity import sensitivity
from .sections.step_responses import steps
from .sections.subject import operating_points, remarks, subject, versions
from .sections.summary import all_requirements, summarize, with_words
from .sections.worst_case import find_reported, read_task, worst_case_of
from .variant import STEP

F = TypeVar("F", bound=Callable[..., Any])
_HEADING = ("title", "author", "project", "date", "revision")  # lines of ``about``
SUBJECT = ReportPart("subject", subject)
REMARKS = ReportPart("subject", remarks)
OPERATING_POINTS = ReportPart("operating_points", operating_points)
CLOSED_LOOPS = ReportPart("poles", closed_loops)
MEMORY = ReportPart("poles", memory)
INNER_LOOPS = ReportPart("inner", inner)
STEPS = ReportPart("steps", steps)
SENSITIVITY = ReportPart("sensitivity", sensitivity)
INJECTION = ReportPart("injection", injected)
LIMITS = ReportPart("limits", not_modelled)

ANY_DIAGRAM = ReportKind(
    Case,
    (SUBJECT, REMARKS, OPERATING_POINTS, CLOSED_LOOPS, MEMORY, INNER_LOOPS, STEPS, SENSITIVITY, INJECTION, LIMITS),
    DEFINITIONS,
)
"""The report of a diagram of which nothing is known but its structure."""


def _is_diagram(value: Any) -> bool:
    return isinstance(getattr(value, "wired", None), WiredDiagram)


_REPORTED = Kind(
    "a Diagram, or an experiment", lambda value: _is_diagram(value) or _is_diagram(getattr(value, "diagram", None))
)


def _with_notes(function: F) -> F:
    """Make a function get a function for ``progress``, also where that is True, False or None."""

    @wraps(function)
    def noted(diagram: Any, **options: Any) -> Any:
        subject = diagram if _is_diagram(diagram) else diagram.diagram
        with work_notes(subject.name, options.pop("progress", False)) as notify:
            return function(diagram, **options, progress=notify)

    return noted  # type: ignore[return-value]  # of the signature of the function that it wraps


@accepts(
    diagram=_REPORTED,
    loops=kinds.names,
    only=kinds.names,
    requirements=kinds.either(REQUIREMENTS, kinds.path).worded(step=write_requirements),
    about=kinds.mapping,
    decibels=kinds.flag,
    hertz=kinds.flag,
    progress=kinds.progress,
    summary=kinds.flag,
    appendix=kinds.flag,
    measured=kinds.mapping,
    contacts=kinds.either(kinds.mapping, kinds.one_of_class(ContactTask, "a ContactTask"), kinds.path),
    workers=kinds.integer(1).worded("1, or 2 for a second process", "Give one of them."),
)
@on_one_thread
@offer_elsewhere(**{name: f"about={{'{name}': …}}" for name in _HEADING})
@_with_notes
def analyse(
    diagram: Any,
    *,
    at: Any = None,
    point: Any = None,
    loops: Iterable[str] | None = None,
    experiment: ReportedExperiment | None = None,
    only: tuple[str, ...] | None = None,
    stairs: str | None = None,
    requirements: Requirements | str | os.PathLike[str] | None = None,
    about: Mapping[str, str] | None = None,
    decibels: bool = False,
    hertz: bool = False,
    progress: ProgressOption = False,
    measured: Mapping[str, Any] | None = None,
    worst_case: WorstCase | WorstCaseTask | str | os.PathLike[str] | None = None,
    contacts: Mapping[str, Any] | ContactTask | str | os.PathLike[str] | None = None,
    workers: int | None = None,
    summary: bool = False,
    appendix: bool = True,
    _written: bool = False,  # the report is written next: its figures are drawn
) -> Report:
    """Analyse a diagram, and return the content of its report.

    Any diagram gets its parameters, operating points, poles, and the margins at every named wire on a loop: continuous,
    and sampled without and with a sample of delay. A diagram of `fig3` also gets what the paper claims, its
    admittances, the environments that they can touch, and these limits tried in the co-simulation. Parts that don't
    apply are left out. Where the plant is not shown to be the rigid robot that admittances and limits are reduced to,
    the section on them has no numbers, and says why.

    Parameters
    ----------
    diagram : Diagram or Experiment
        The diagram.
    at : OperatingPoint, Snapshot or float, optional
        Where: a time in s to which each variant is run, ``run.at(t)``, or a point of this diagram; the start without
        it. ``point`` is another name of it.
    loops : iterable of str, optional
        Wires at which loops are looked at, in place of all named ones on loops; not for a diagram of `fig3`.
    experiment : Experiment, optional
        Where the diagram comes from, for the report's heading.
    only : tuple of str, optional
        The sections that are made, by their keys; all without it.
    stairs : {"gain", "zero"}, optional
        Treatment of stairs in all linear models, as of `Diagram.linearize`. Without it those of quantizers and encoders
        have their mean slope.
    requirements : Requirements or path, optional
        Requirements on the design, or a TOML file of them. `Report.review` has the verdicts, which the first page and
        the JSON show.
    about : mapping of str to str, optional
        Lines of the heading: ``title``, ``author``, ``project``, ``date``, ``revision``, or any other.
    decibels, hertz : bool
        Whether magnitudes are drawn in dB, and over a frequency in Hz; without it plain, over rad/s.
    measured : mapping of str to data, optional
        Loops that were measured, by their wires: data as `measured_margins` takes them, or the path of a CSV file (see
        `read_frequency_data`). Their margins, with intervals, are given next to the model's, and requirements hold
        for them as for the model's: passed only if the whole interval is within the limits.
    contacts : mapping of str to Contact, or path, optional
        Contacts of an environment with the plant, by names that are parts of dotted paths: ``{"tool":
        diagram.contact(…)}``; or a TOML file with tables ``[contact.NAME]``, which may be that of ``requirements``,
        too. Each gets its admittance, the limits of coupled stability, a map of them, a trial in the nonlinear run, and
        a row on the first page. Limits that are required of it get verdicts.
    worst_case : WorstCase or path, optional
        A worst case of this diagram, of `Diagram.worst_case`, or a TOML file with a table ``[worst_case]``, which may
        be that of ``requirements``, too: it gets a section, with a run that confirms it, and a line on the first page.
        The limits that it was looked for with get separate verdicts. Limits of its numbers fail where it is
        unstable. One that can't be looked for, as at a wire without a loop, is left out with the reason.
    progress : bool or callable, optional
        Show the key of each section before it is made, and what is being computed or confirmed in it (margins, steps,
        sensitivities and measurements, at which wire and of which variant, and cases of a worst case), or a function
        that is called with it. By default neither; `Diagram.report` shows it on a terminal.
    workers : int, optional
        1 makes all sections in this process; with 2, a second process makes some of a diagram with FMUs. The report is
        the same. Without it there are two where the report is written, and two processors.
    summary : bool
        Whether the page, the PDF and the notebook show the summary alone: two pages. All numbers are computed, and
        are in the JSON.
    appendix : bool
        Whether they show the appendix: all numbers, definitions and details.

    Returns
    -------
    Report
        `Report.numbers` returns every number by its dotted path, such as ``inner.par.sampled_d0.phase_margin_deg``.

    Raises
    ------
    ConfirmationError
        If a number and its independent confirmation disagree.
    OptionError
        An unknown section; a contact of another diagram; both ``at`` and ``point``.
    UnknownNameError
        If there is no wire with a name in ``loops``, or no loop, variant or wire with one in ``requirements``.
    """
    if at is not None and point is not None:
        raise OptionError(
            "found at and point, two names of one option; expected one of them. Give at=… alone.", port="at"
        )
    point = point if at is None else at
    if not _is_diagram(diagram):
        experiment, diagram = diagram, diagram.diagram
    kind: ReportKind[Any] = diagram.report_kind if hasattr(type(diagram), "report_kind") else ANY_DIAGRAM
    wired: WiredDiagram = diagram.wired
    kind.check_keys(only or ())
    wires = None if loops is None else tuple([loops] if isinstance(loops, str) else loops)
    for wire in (*(wires or ()), *(measured or ())):
        find_signal(wired.flatten(None if wired.has_clock else STEP), wire)
    notify: Any = progress  # a function: see `_with_notes`
    file = None if isinstance(requirements, Requirements | None) else TomlFile.read(requirements, "requirements")
    asked = requirements if isinstance(requirements, Requirements | None) else read_requirements(file or requirements)
    touched = read_contacts(wired, contacts, file, asked)
    if asked is None and touched is not None and touched.limits:
        asked = Requirements(stable=False)  # a robot that yields to a force may drift, and has a pole on the limit
    task = read_task(wired, worst_case, file, asked)
    axes, names = AxisUnits(decibels, hertz), tuple(measured or ())
    if workers is None:  # a second process is worth its start where figures are drawn, too
        workers = min(processors(), 2) if _written else 1
    how: dict[str, Any] = {"workers": workers, "drawn": _written and not summary}
    case, sections = kind.sections(wired, point, experiment, wires, only, notify, stairs, asked, axes, names, **how)
    loops_measured = read_measured(case, measured) if measured else ()
    if loops_measured:
        sections = (*sections, measured_loops(case, loops_measured))
    searched = None if task is None else find_reported(wired, task, asked, point, stairs, notify, case.loop_places)
    if searched is not None:
        sections = (*sections, worst_case_of(searched))
    if touched is not None and touched.contacts:
        notify("contact")
        sections = (*sections, contact_sections(touched))
    whole = Report("", sections)
    made, absent = whole.numbers(), whole.absent()
    reviewed = None
    if asked is not None:
        reviewed = with_words(case, review(case, asked, made, loops_measured, searched, touched, absent))
    if only is None or asked is not None or summary:
        more = [] if touched is None or not touched.contacts else [contacts_on_first_page(touched)]
        first = summarize(case, reviewed, made, searched, more, sections), all_requirements(reviewed)
        sections = (*(section for section in first if section is not None), *sections)
    name = wired.name if experiment is None else f"Experiment {experiment.letter}: {wired.name}"
    lines = {str(key): str(text) for key, text in (about or {}).items()}
    title = lines.pop("title", f"Design report: {name}")
    meta: dict[str, Any] = {
        "diagram": wired.name,
        **lines,
        "revision": content_hash(wired),
        "made": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "versions": versions(),
        "variants": {key: v.title if not v.problem else f"left out: {v.problem}" for key, v in case.variants.items()},
        "definitions": dict(kind.definitions),
        "fmus": {path: b.description.digest for path, b in wired.blocks.items() if isinstance(b, Fmu)},
    }
    return Report(title, sections, meta, reviewed, summary, appendix)

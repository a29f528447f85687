"""The analyses of a report: sections of numbers about any diagram, and what Fig. 3 has besides."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from ...blocks.core.errors import OptionError
from ..flat.wired_diagram import WiredDiagram
from ..frequency.one_thread import on_one_thread
from ..linearization.derivatives import find_signal
from ..paper.report_admittance import admittance
from ..paper.report_limits_tried import not_modelled, not_tried, time_domain
from .case import Case
from .model import Report, Section
from .points import STEP
from .section_injection import injected
from .section_loops import inner
from .section_poles import poles
from .section_subject import operating_points, subject, versions
from .terms import DEFINITIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from ..paper.experiments import Experiment

SECTIONS = ("subject", "operating_points", "poles", "inner", "admittance", "time_domain", "injection", "limits")
"""Keys of the sections, in order; each starts the dotted paths of its numbers."""


@on_one_thread
def analyse(
    diagram: WiredDiagram | Experiment,
    *,
    point: Any = None,
    loops: Iterable[str] | None = None,
    experiment: Experiment | None = None,
    only: tuple[str, ...] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Analyse a diagram, and return what a report of it holds.

    Any diagram gets its parameters, operating points, poles, and the margins at every named wire on a loop: continuous,
    and sampled without and with a sample of delay. Fig. 3 gets besides what the paper claims, its admittances, the
    environments that they can touch, and these limits tried in the co-simulation. Sections that don't apply are left
    out. Where the plant is not shown to be the rigid robot that admittances and limits are reduced to, the section on
    them has no numbers, and says why.

    Parameters
    ----------
    diagram : Diagram or Experiment
        What is analysed.
    point : OperatingPoint, Snapshot or float, optional
        Where: a time in s to which each variant is run, ``run.at(t)``, or a point of this diagram; the start without
        it.
    loops : iterable of str, optional
        Wires at which loops are looked at, in place of all named ones on loops; not for Fig. 3.
    experiment : Experiment, optional
        Where the diagram comes from, for the report's heading.
    only : tuple of str, optional
        The sections that are made, by their keys; all without it.
    progress : callable, optional
        Told the key of each section before it is made.

    Returns
    -------
    Report
        `Report.numbers` returns every number by its dotted path, such as ``inner.par.sampled_d0.phase_margin_deg``.

    Raises
    ------
    ConfirmationError
        If a number and its independent confirmation disagree.
    OptionError
        An unknown section.
    UnknownNameError
        If there is no wire with a name in ``loops``.
    """
    if not isinstance(diagram, WiredDiagram):
        experiment, diagram = diagram, diagram.diagram
    for key in only or ():
        if key not in SECTIONS:
            raise OptionError(f"there is no section {key!r}; expected some of {', '.join(SECTIONS)}.", port="only")
    wanted = set(SECTIONS if only is None else only)
    tell = progress or (lambda key: None)
    tell("variants")
    wires = None if loops is None else tuple([loops] if isinstance(loops, str) else loops)
    for wire in wires or ():
        find_signal(diagram.flatten(None if diagram.has_clock else STEP), wire)
    case = Case(diagram, point, experiment, wires)
    sections: list[Section | None] = []
    found: Any = None
    reduced: Any = None
    limits: dict[str, Any] = {}
    for key in SECTIONS:
        if key not in wanted and not (key == "admittance" and "time_domain" in wanted):
            continue
        tell(key)
        if key == "subject":
            sections.append(subject(case))
        elif key == "operating_points":
            sections.append(operating_points(case))
        elif key == "poles":
            sections.append(poles(case))
        elif key == "inner":
            sections.append(inner(case))
        elif key == "admittance":
            found = admittance(case)
            if found is not None:
                reduced = found[1]
                limits = {f"{part.key}.{path}": n for part in found[0].sections for path, n in part.numbers.items()}
                sections.append(found[0] if key in wanted else None)
        elif key == "time_domain":
            if reduced is not None:
                sections.append(time_domain(case, reduced, limits))
            elif found is not None and "admittance" not in wanted:
                sections.append(not_tried(found[0].text))
        elif key == "injection":
            sections.append(injected(case))
        else:
            sections.append(not_modelled(case, reduced is not None))
    name = diagram.name if experiment is None else f"Experiment {experiment.letter}: {diagram.name}"
    meta: dict[str, Any] = {
        "diagram": diagram.name,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "variants": {key: v.title if not v.problem else f"left out: {v.problem}" for key, v in case.variants.items()},
        "definitions": dict(DEFINITIONS),
        "fmus": {path: b.description.digest for path, b in diagram.blocks.items() if hasattr(b, "description")},
    }
    return Report(f"Design report: {name}", tuple(s for s in sections if s is not None), meta)

"""Parts of a report: each applies to a case or doesn't, and makes a section, or adds to the one of its key.

A kind of diagram that is known better than by its structure has its own report: a `ReportKind` with its own case,
parts and definitions, which the diagram gives as its ``report_kind``. The parts of this package serve there as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from typing import Any, Generic, TypeVar, cast

from ...blocks.core import OptionError
from ..flat import WiredDiagram
from ..plotting import AxisUnits
from ..requirements import Requirements
from ..results import Snapshot
from ..second_process import SecondProcess
from .case import Case, ReportedExperiment
from .case_verdicts import check_names
from .pages import Section, draw_section, keep_drawings

RADIANS = AxisUnits()
LONG = 4
"""Sections from which on a second process is worth its start."""
C = TypeVar("C", bound=Case)
C_contra = TypeVar("C_contra", bound=Case, contravariant=True)


def always(case: Case) -> bool:
    """Return True: a part that applies to every case."""
    return True


@dataclass(frozen=True)
class ReportPart(Generic[C_contra]):
    """A part of a report.

    ``key``: key of its section, which starts the dotted paths of its numbers. Parts of one key are one section, in
    their order, under the title of the first.
    ``make``: returns the section of a case, or what is added to it; None where nothing is to be said.
    ``applies``: whether the part applies to a case.
    """

    key: str
    make: Callable[[C_contra], Section | None]
    applies: Callable[[C_contra], bool] = always


@dataclass(frozen=True)
class ReportKind(Generic[C]):
    """A kind of report.

    ``parts``: the parts in the order of the report.
    ``definitions``: definitions of the terms in the paths of numbers.
    ``titles``: titles of sections, by their keys, in place of those that their parts give.
    """

    case: Callable[
        [WiredDiagram, Any, ReportedExperiment | None, tuple[str, ...] | None, str | None, Requirements | None], C
    ]
    parts: tuple[ReportPart[C], ...]
    definitions: Mapping[str, str] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the sections in their order."""
        return tuple(dict.fromkeys(part.key for part in self.parts))

    def check_keys(self, keys: Iterable[str]) -> None:
        """Refuse keys of sections that it doesn't have."""
        if isinstance(keys, str):
            raise OptionError(f"found {keys!r}; expected a list of sections. Write only=[{keys!r}].", port="only")
        for key in keys:
            if key not in self.keys:
                raise OptionError(
                    f"there is no section {key!r}; expected some of {', '.join(self.keys)}. Name these.",
                    port="only",
                )

    def sections(
        self,
        diagram: WiredDiagram,
        point: Any,
        experiment: ReportedExperiment | None,
        wires: tuple[str, ...] | None,
        only: Iterable[str] | None,
        notify: Callable[[str], None],
        stairs: str | None = None,
        requirements: Requirements | None = None,
        axes: AxisUnits = RADIANS,
        measured: Collection[str] = (),
        *,
        workers: int = 1,
        drawn: bool = False,
    ) -> tuple[Case, tuple[Section, ...]]:
        """Return the case of a diagram, and its sections.

        ``notify`` gets the key of each section before it is made. With two workers, a second process makes sections of
        a diagram with FMUs, from the last one on; where they are ``drawn``, it draws their figures, too.
        """
        notify("variants")
        wanted = set(self.keys if only is None else only)
        keys = tuple(key for key in self.keys if key in wanted)
        task = SectionTask(self, diagram, point, wires, stairs, requirements, axes, tuple(measured), keys, drawn)
        foreign = any(block.stepped or block.in_model_exchange for block in diagram.blocks.values())
        long = foreign and len(keys) >= LONG and not isinstance(point, Snapshot)
        with contextlib.ExitStack() as stack:
            second: SecondProcess[tuple[Section | None, tuple[str, ...]]] | None = None
            if workers > 1 and long:
                second = stack.enter_context(SecondProcess(task.make, diagram.name))
            case = task.make_case(experiment)

            def make(key: str) -> tuple[Section | None, tuple[str, ...]]:
                return self.make_section(case, key, notify), ()

            case.notify = notify
            if requirements is not None:
                check_names(case, requirements, measured)
            made = list(map(make, keys)) if second is None else second.share(keys, make, notify)
        for section, pictures in made:
            if section is not None and pictures:
                keep_drawings(section, pictures)
        return case, tuple(section for section, _ in made if section is not None)

    def make_section(self, case: Case, key: str, notify: Callable[[str], None]) -> Section | None:
        """Return the section of a key; None where nothing is to be said."""
        own = cast("C", case)
        parts = [part for part in self.parts if part.key == key and part.applies(own)]
        if not parts:
            return None
        notify(key)
        made = [section for part in parts if (section := part.make(own)) is not None]
        if not made:
            return None
        whole = joined(made)
        return replace(whole, title=self.titles.get(key, whole.title))


@dataclass(frozen=True, eq=False)
class SectionTask:
    """Makes the sections of a case, in any process; its fields are as of `ReportKind.sections`."""

    kind: ReportKind[Any]
    diagram: WiredDiagram
    point: Any
    wires: tuple[str, ...] | None
    stairs: str | None
    requirements: Requirements | None
    axes: AxisUnits
    measured: tuple[str, ...]
    keys: tuple[str, ...]
    drawn: bool

    def make_case(self, experiment: ReportedExperiment | None = None) -> Case:
        """Return the case of the diagram."""
        case: Case = self.kind.case(self.diagram, self.point, experiment, self.wires, self.stairs, self.requirements)
        case.axes, case.keys = self.axes, self.keys
        return case

    @cached_property
    def _case(self) -> Case:
        return self.make_case()

    def make(self, key: str, notify: Callable[[str], None]) -> tuple[Section | None, tuple[str, ...]]:
        """Return the section of a key, and its figures as SVG where they are to be drawn."""
        self._case.notify = notify
        made = self.kind.make_section(self._case, key, notify)
        return made, draw_section(made) if self.drawn and made is not None else ()


def joined(sections: list[Section]) -> Section:
    """Return one section with everything of several, under the key and title of the first."""
    return Section(
        sections[0].key,
        sections[0].title,
        tuple(chain.from_iterable(s.text for s in sections)),
        tuple(chain.from_iterable(s.tables for s in sections)),
        tuple(chain.from_iterable(s.plots for s in sections)),
        {path: number for s in sections for path, number in s.numbers.items()},
        tuple(chain.from_iterable(s.sections for s in sections)),
        tuple(chain.from_iterable(s.overview for s in sections)),
        {path: why for s in sections for path, why in s.absent.items()},
    )

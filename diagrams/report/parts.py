"""Parts of a report: each applies to a case or doesn't, and makes a section, or adds to the one of its key.

A kind of diagram that is known better than by its structure has a report of its own: a `ReportKind` with its own case,
parts and definitions, which the diagram gives as its ``report_kind``. The parts of this package serve there as well.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from ...blocks.core import OptionError
from ..flat import WiredDiagram
from ..report_figures import AxisUnits
from ..report_writing import Section
from ..requirements import Requirements
from .case import Case, ReportedExperiment
from .review import check_names

RADIANS = AxisUnits()
C = TypeVar("C", bound=Case)
C_contra = TypeVar("C_contra", bound=Case, contravariant=True)


def always(case: Case) -> bool:
    """Return True: a part that applies to every case."""
    return True


@dataclass(frozen=True)
class ReportPart(Generic[C_contra]):
    """A part of a report.

    Attributes
    ----------
    key : str
        Key of its section, which starts the dotted paths of its numbers. Parts of one key are one section, in their
        order, under the title of the first.
    make : callable
        Returns the section of a case, or what is added to it; None where nothing is to be said.
    applies : callable
        Whether the part applies to a case.
    """

    key: str
    make: Callable[[C_contra], Section | None]
    applies: Callable[[C_contra], bool] = always


class MakesSections(Protocol):
    """A kind of report, as `analyse` uses it."""

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions of the terms in the paths of numbers."""

    def check_keys(self, keys: Iterable[str]) -> None:
        """Refuse keys of sections that it doesn't have."""

    def sections(
        self,
        diagram: WiredDiagram,
        point: Any,
        experiment: ReportedExperiment | None,
        wires: tuple[str, ...] | None,
        only: Iterable[str] | None,
        tell: Callable[[str], None],
        stairs: str | None = None,
        requirements: Requirements | None = None,
        axes: AxisUnits = RADIANS,
        measured: Collection[str] = (),
    ) -> tuple[Case, tuple[Section, ...]]:
        """Return the case of a diagram, and its sections."""


@runtime_checkable
class HasReportKind(Protocol):
    """A diagram that says itself which kind of report it gets."""

    @property
    def report_kind(self) -> MakesSections:
        """The kind of report."""


@dataclass(frozen=True)
class ReportKind(Generic[C]):
    """A kind of report.

    Attributes
    ----------
    case : type of Case
        Makes the case of a diagram: its variants.
    parts : tuple of ReportPart
        The parts in the order in which they stand in the report.
    definitions : mapping
        Definitions of the terms in the paths of numbers.
    titles : mapping
        Titles of sections, by their keys, in place of those that their parts give.
    """

    case: Callable[[WiredDiagram, Any, ReportedExperiment | None, tuple[str, ...] | None, str | None], C]
    parts: tuple[ReportPart[C], ...]
    definitions: Mapping[str, str] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the sections in their order."""
        return tuple(dict.fromkeys(part.key for part in self.parts))

    def check_keys(self, keys: Iterable[str]) -> None:
        """Refuse keys of sections that it doesn't have.

        Raises
        ------
        OptionError
            An unknown section.
        """
        for key in keys:
            if key not in self.keys:
                raise OptionError(f"there is no section {key!r}; expected some of {', '.join(self.keys)}.", port="only")

    def sections(
        self,
        diagram: WiredDiagram,
        point: Any,
        experiment: ReportedExperiment | None,
        wires: tuple[str, ...] | None,
        only: Iterable[str] | None,
        tell: Callable[[str], None],
        stairs: str | None = None,
        requirements: Requirements | None = None,
        axes: AxisUnits = RADIANS,
        measured: Collection[str] = (),
    ) -> tuple[Case, tuple[Section, ...]]:
        """Return the case of a diagram, and its sections.

        Parameters
        ----------
        diagram, point, experiment, wires, stairs
            As `Case` takes them.
        only : iterable of str, optional
            Keys of the sections that are made; all without it.
        requirements : Requirements, optional
            Requirements on the design, which decide on the variants and steps that are tried.
        axes : AxisUnits
            Units of the axes of frequency responses.
        measured : collection of str
            Wires of loops that were measured, on which there may be requirements, too.
        tell : callable
            Told "variants" before the case is made, and the key of each section before it is made; of the injection
            check each measurement, too.
        """
        tell("variants")
        case = self.case(diagram, point, experiment, wires, stairs)
        case.axes = axes
        case.tell = tell
        if requirements is not None:
            case.requirements = requirements
            check_names(case, requirements, measured)
        wanted = set(self.keys if only is None else only)
        case.keys = tuple(key for key in self.keys if key in wanted)
        return case, tuple(self._made(case, tell))

    def _made(self, case: C, tell: Callable[[str], None]) -> Iterator[Section]:
        for key in case.keys:
            parts = [part for part in self.parts if part.key == key and part.applies(case)]
            if parts:
                tell(key)
                made = [section for part in parts if (section := part.make(case)) is not None]
                if made:
                    whole = joined(made)
                    yield replace(whole, title=self.titles.get(key, whole.title))


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
    )

"""Worst cases: the smallest margins of a loop over ranges of parameters, found by samples and a local search.

The worst samples are where searches begin. A search goes downhill along the exact derivatives of the margins, within
the ranges (L-BFGS-B); where a margin changes from one crossing to another its slope jumps, so that steps along single
parameters follow. Corners of the ranges are tried, too. Whatever can't be analysed is data: it counts as the worst.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ...blocks.core import (
    Grid,
    OptionError,
    Sheet,
    ShownAsTable,
    accepts,
    brief,
    enumerate_some,
    explain_calls,
    kinds,
)
from ..flat import WiredDiagram
from ..frequency import Number, order_key
from ..linearization import carry_point
from ..requirements import REQUIREMENTS, Requirements
from ..sweeps import Box, read_samples
from .cases import CaseOrigin, CaseState, Goal, StudyCase, describe, make_goal
from .confirmed_cases import RunConfirmation, confirm_case
from .loop_places import OtherCuts, place_loops, write_open_loop
from .measures import ContactMeasure, FunctionMeasure, Measure
from .varied_parameters import check_parameters, check_ranges, read_boxes
from .worst_case_plot import plot_cases
from .worst_case_search import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@explain_calls
@dataclass(frozen=True)
class WorstCase(ShownAsTable):
    """Worst case of a loop's numbers over ranges of parameters.

    ``diagram.simulate(…)`` of ``found.diagram`` runs it; ``found.parameters`` are its parameters for `replace`.

    Attributes
    ----------
    worst : StudyCase
        The worst of all cases.
    nominal : tuple of StudyCase
        The diagram as it is, at each operating point.
    cases : tuple of StudyCase
        All cases in the order in which they were computed.
    boxes : mapping of str to Box
        The ranges; empty where the samples were a table.
    goal : Goal
        The numbers and their limits.
    base : Diagram
        The diagram as it is.
    points : tuple
        The operating points as they were asked for.
    options : mapping
        Options of the linear models.
    measure : Measure, optional
        The number, where it is no loop's.
    elsewhere : mapping of str to mapping
        Numbers of the worst case's loop at other cuts of its wire by their inputs, where several blocks may be the
        plant.
    given : WiredDiagram, optional
        The diagram as it was given; ``base`` has names for wires that are cut ahead of some consumers.
    """

    worst: StudyCase
    nominal: tuple[StudyCase, ...]
    cases: tuple[StudyCase, ...] = field(repr=False)
    boxes: Mapping[str, Box] = field(repr=False)
    goal: Goal = field(repr=False)
    wired: WiredDiagram = field(repr=False)
    points: tuple[Any, ...] = field(repr=False)
    options: Mapping[str, Any] = field(default_factory=dict, repr=False)
    measure: Measure | None = field(default=None, repr=False)
    elsewhere: Mapping[str, Mapping[str, Number]] = field(default_factory=dict, repr=False)
    given: WiredDiagram | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        found = enumerate_some(f"{name} = {_short(value)}" for name, value in self.worst.parameters.items())
        facts = describe(self.worst), found
        return brief(
            f"worst of {len(self.cases)} cases", *facts, then="print(…) shows all, .diagram, .confirm(), .plot()"
        )

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters of the worst case, as `Diagram.replace` takes them."""
        return self.worst.parameters

    @property
    def diagram(self) -> Any:
        """The diagram with the parameters of the worst case, ready to be simulated."""
        return self._worst_wired.facade

    @property
    def base(self) -> Any:
        """The `Diagram` as it is."""
        return self.wired.facade

    @property
    def _worst_wired(self) -> WiredDiagram:
        return self.wired.replace(self.worst.parameters) if self.worst.parameters else self.wired

    @property
    def unstable(self) -> tuple[StudyCase, ...]:
        """The cases with an unstable loop."""
        return tuple(case for case in self.cases if case.state is CaseState.UNSTABLE)

    @property
    def failures(self) -> tuple[StudyCase, ...]:
        """The cases that could not be analysed; each has its reason."""
        return tuple(case for case in self.cases if case.state is CaseState.FAILED)

    @property
    def worst_analysed(self) -> StudyCase:
        """The worst of the cases that could be analysed."""
        return min((c for c in self.cases if c.state is not CaseState.FAILED), key=lambda c: (c.goodness, c.index))

    @property
    def worst_sample(self) -> StudyCase:
        """The worst of the samples, where the search began."""
        mine = [case for case in self.cases if case.origin is CaseOrigin.SAMPLE]
        return min(mine, key=lambda case: case.goodness)

    def table(self) -> list[dict[str, Any]]:
        """Return all cases as mappings, the worst first; ``pandas.DataFrame(found.table())`` shows them."""
        return [case.as_dict() for case in sorted(self.cases, key=lambda case: (order_key(case.goodness), case.index))]

    def confirm(self, amplitude: float | None = None) -> RunConfirmation:
        """Confirm the worst case by a run of the diagram with its parameters.

        The margin of a stable one is measured with a sine at the frequency that decides it; the signal of an unstable
        one has to grow as its pole says.

        Parameters
        ----------
        amplitude : float, optional
            Size of the test signal in the wire's unit; 1e-6 of 1 + the wire's size without it.

        Raises
        ------
        OptionError
            If the worst case failed, or has a number or a loop that one sine can't measure.
        """
        if self.worst.state is CaseState.FAILED:
            raise OptionError(
                f"found a worst case that failed: {self.worst.reason} Expected one that was analysed. The worst of "
                f"those, found.worst_analysed, has {describe(self.worst_analysed)}: mend the reason, or give ranges "
                "without the cases that failed, found.failures, and confirm what is found then.",
                block=self.wired.name,
            )
        if self.measure is not None:
            point, diagram = self.points[self.worst.point], self._worst_wired
            return self.measure.confirm(diagram, point(diagram.facade) if callable(point) else point)
        options = {name: value for name, value in self.options.items() if name != "delay"}
        return confirm_case(
            self._worst_wired, self.worst, self.points[self.worst.point], amplitude, self.options["delay"], options
        )

    def _sheet(self) -> Sheet:
        worst, nominal = self.worst, min(self.nominal, key=lambda case: case.goodness)
        counts = {state: sum(case.state is state for case in self.cases) for state in CaseState}
        several = len(self.points) > 1
        analysed, failed = self.worst_analysed, worst.state is CaseState.FAILED
        shown = {"Parameters of the worst case": worst.parameters}
        if failed:
            shown["Parameters of the worst case that was analysed, found.worst_analysed"] = analysed.parameters
        return Sheet(
            f"worst of {len(self.cases)} cases",
            (
                ("worst", describe(worst)),
                ("worst analysed", describe(analysed) if failed else ""),
                ("as it is", describe(nominal)),
                ("found by", worst.origin.value),
                ("cases", ", ".join(f"{count} {state.value}" for state, count in counts.items() if count)),
                ("operating point", f"{worst.point} of {len(self.points)}" if several else ""),
                ("not looked at", ", ".join(self.goal.left_out)),
                ("at other cuts", self._other_cuts()),
            ),
            tuple(
                Grid(
                    title,
                    ("parameter", "value", "from", "to"),
                    tuple((name, value, *self._range(name)) for name, value in parameters.items()),
                )
                for title, parameters in shown.items()
            ),
            (f"{counts[CaseState.FAILED]} cases failed, the first: {self.failures[0].reason}",)
            if counts[CaseState.FAILED]
            else (),
        )

    def _other_cuts(self) -> str:
        quantity = self.worst.quantity
        shown = [f"{n[quantity].value:.6g} at {at}" for at, n in self.elsewhere.items() if quantity in n]
        return f"{', '.join(shown)}: give the plant's inputs as to=…" if shown else ""

    def _range(self, name: str) -> tuple[Any, Any]:
        box = self.boxes.get(name)
        return (None, None) if box is None else (box.low, box.high)

    def plot(self, parameters: Sequence[str] | None = None) -> Figure:
        """Return a scatter of the number over each parameter: samples, search, the worst case and the limit.

        Raises
        ------
        OptionError
            If there is no such parameter, or none with one entry.
        """
        return plot_cases(self.cases, self.worst, self.goal, self.boxes, parameters)


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


_FROM_0 = kinds.integer(0).worded(step="Give one.", found=kinds.by_name)


@accepts(
    "worst_case",
    loop=kinds.names,
    to=kinds.names,
    quantity=kinds.either(kinds.text, kinds.function),
    starts=_FROM_0,
    steps=_FROM_0,
    delay=_FROM_0,
    requirements=REQUIREMENTS,
    progress=kinds.function,
)
def find_worst_case(
    diagram: WiredDiagram,
    parameters: Mapping[str, Any] | None,
    loop: str | Iterable[str] | None = None,
    *,
    to: str | Iterable[str] | None = None,
    quantity: str | Callable[[Any], Any] | None = None,
    requirements: Requirements | None = None,
    contact: Mapping[str, Any] | None = None,
    samples: Any = "latin",
    count: int | None = None,
    seed: int = 0,
    starts: int = 3,
    steps: int = 15,
    at: Any = None,
    points: Sequence[Any] | None = None,
    delay: int = 0,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> WorstCase:
    """Return the worst case of a loop's numbers over ranges of parameters; see `Diagram.worst_case`."""
    whole, others, given_loop = diagram, dict[str, OtherCuts](), loop
    measure = _make_measure(diagram, loop, quantity, requirements, contact, options)
    if quantity is None and requirements is None and measure is None:
        quantity = "disk_margin"
    if points is not None and at is not None:
        raise OptionError("found at and points; expected one of them. Give points=[…] alone.", block=diagram.name)
    # A function as quantity cuts no loop, so it sees the diagram as it is.
    if measure is not None:
        goal = Goal({(measure.place,): {measure.name: None}})
    else:
        assert not callable(quantity)
        diagram, loop, requirements, others = place_loops(diagram, loop, requirements, to)
        at = carry_point(whole, at, diagram)
        points = None if points is None else [carry_point(whole, point, diagram) for point in points]
        goal = make_goal(loop, quantity, requirements, diagram.name)
    # The samples, and the ranges in which a search may move.
    if isinstance(samples, str) and samples == "latin" and count is None:
        count = 100
    drawn = read_samples(diagram, parameters, samples, count=count, seed=seed)
    check_parameters(diagram, drawn.names, "a worst case", blocks=True)
    boxes = read_boxes(drawn)
    check_ranges(diagram, boxes)
    places = tuple(points) if points is not None else (at,)
    study = Study(diagram, goal, boxes, places, delay, options, progress or (lambda text: None), measure)
    # Without a nominal case there is nothing that a worst case could be compared with.
    # Slopes and loops of variants begin with its linear model.
    nominal = study.run({}, CaseOrigin.NOMINAL)
    if all(case.state is CaseState.FAILED for case in nominal):
        way_out = "Mend that first."
        if study.periodic is not None and study.periodic == given_loop:
            name = next(iter(goal.loops[study.periodic,]))
            way_out = (
                "A worst case takes a loop at its own rate as a function: leave loop out, and give "
                f"quantity={write_open_loop(study.periodic, name, points if at is None else at)}."
            )
        raise OptionError(
            f"the diagram as it is can't be analysed: {nominal[0].reason} {way_out}",
            block=diagram.name,
            port="loop" if study.has_no_loop else "",
        )
    # The worst case is linearized as a whole, for its findings: the others come from their loops' matrices.
    for sample in drawn:
        study.run(sample.parameters, CaseOrigin.SAMPLE)
    if boxes and starts > 0:
        study.try_corners()
        study.search(starts, steps)
    # Equal cases: the first one, so that the result doesn't depend on the search.
    worst = study.with_findings(min(study.cases, key=lambda case: (order_key(case.goodness), case.index)))
    study.cases[worst.index] = worst
    cases = tuple(study.cases)
    there = others.get(worst.loop[0], ()) if len(worst.loop) == 1 else ()
    elsewhere = study.numbers_at_other_cuts(worst, there)
    options |= {"delay": delay}
    return WorstCase(worst, tuple(nominal), cases, boxes, goal, diagram, places, options, measure, elsewhere, whole)


def _make_measure(
    diagram: WiredDiagram,
    loop: str | Iterable[str] | None,
    quantity: object,
    requirements: Requirements | None,
    contact: Mapping[str, Any] | None,
    options: Mapping[str, Any],
) -> Measure | None:
    """Return the number that is no loop's: a contact's limit, or a function; None of a loop's."""
    if contact is None and not callable(quantity):
        return None
    given = {"loop": loop, "requirements": requirements, "quantity": None if contact is None else quantity}
    for name, value in given.items():
        if value is not None and value != ():
            said = "contact" if contact is not None else "a function as quantity"
            raise OptionError(
                f"found {said} and {name}={value!r}; expected one of them. Leave one out.",
                block=diagram.name,
                port=name,
            )
    if contact is not None:
        return ContactMeasure(contact, diagram, options)
    assert callable(quantity)
    return FunctionMeasure(quantity, diagram.name)

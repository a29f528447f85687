"""The search of a worst case: cases computed one after the other, corners of the ranges, and the way downhill."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError, PeriodicLoopError, UnknownArgumentError
from ..flat import WiredDiagram
from ..frequency import Number, find_hidden_unstable, margin_slopes, order_key, realize
from ..linearization import (
    Linearization,
    differentiate_loop,
    linearize,
    loop_of_variant,
    operating_point,
    rational_loop,
)
from ..results import OperatingPoint
from ..sweeps import Box
from .cases import CaseOrigin, CaseState, Goal, StudyCase, describe
from .loop_places import OtherCuts, numbers_at_other_cuts, numbers_of
from .measures import Measure
from .varied_parameters import Ranges

if TYPE_CHECKING:
    from control import StateSpace

    from ..linearization import LoopSlope

MOST_CORNERS = 5
"""Number of parameters up to which all corners of the ranges are tried."""
UNSTABLE = -1e6
"""Goodness of a loop on the limit of stability; below it, less its growth, that of an unstable one."""
FAILED = -1e9
"""Goodness of a case that can't be analysed."""
PATTERN = (0.1, 0.03, 0.01, 0.003)
"""Steps along single parameters that end a search, in shares of the ranges."""
DIFFERENCE = 1e-4
"""Step of a difference by a parameter without an exact derivative, in shares of its range."""
SAME_POINT = 1e-9
"""Distance of two points in shares of the ranges up to which one case serves both: far below a difference's step."""


class Study:
    """Cases of a diagram, computed one after the other and kept."""

    def __init__(
        self,
        diagram: WiredDiagram,
        goal: Goal,
        boxes: Mapping[str, Box],
        points: tuple[Any, ...],
        delay: int,
        options: Mapping[str, Any],
        notify: Callable[[str], None],
        measure: Measure | None = None,
    ):
        self.diagram, self.goal, self.boxes, self.points = diagram, goal, boxes, points
        self.delay, self.options, self.notify, self.measure = delay, options, notify, measure
        self.cases: list[StudyCase] = []
        self.ranges = Ranges(boxes)
        self.smooth = {name for name in boxes if not _is_start_value(diagram, name)}
        self._bases: dict[int, Linearization] = {}
        self._loops: dict[int, dict[tuple[str, ...], StateSpace]] = {}
        self._asked: dict[int, tuple[WiredDiagram, OperatingPoint]] = {}
        self._places: list[tuple[np.ndarray, list[StudyCase]]] = []  # in the ranges, with their cases
        self.has_no_loop = False  # at a wire of the diagram as it is
        self.periodic: str | None = None  # a wire of it at which its loop is periodic

    # --- cases --------------------------------------------------------------------------------------------------------

    def run(self, parameters: Mapping[str, Any], origin: CaseOrigin) -> list[StudyCase]:
        """Return the cases of some parameters at all points; a search doesn't compute those that are known again."""
        where = self.ranges.fractions_of(parameters) if parameters and parameters.keys() == self.boxes.keys() else None
        if where is not None and origin in (CaseOrigin.CORNER, CaseOrigin.SEARCH):
            for known, cases in self._places:
                if np.max(np.abs(known - where)) <= SAME_POINT:
                    return cases
        made = []
        for place in range(len(self.points)):
            case = self._analyse(parameters, place, origin)
            made.append(case)
            self.cases.append(case)
        if where is not None:
            self._places.append((where, made))
        worst = min(made, key=lambda case: case.goodness)
        self.notify(f"{origin.value} {len(self.cases)}: {describe(worst)}")
        return made

    def _analyse(self, parameters: Mapping[str, Any], place: int, origin: CaseOrigin) -> StudyCase:
        start = StudyCase(len(self.cases), origin, dict(parameters), place, CaseState.FAILED, FAILED)
        try:
            diagram = self.diagram.replace(parameters) if parameters else self.diagram
            point = self.points[place]
            asked = point(diagram.facade) if callable(point) else point
            if self.measure is not None:
                return self._take(start, self.measure, self.measure(diagram, asked))
            if not parameters:
                self._bases[place] = linearize(diagram, asked, **self.options)
                self._loops[place] = self._open_loops(self._bases[place])
            base = self._bases.get(place)
            if base is None:
                raise OptionError("the diagram as it is can't be analysed at this operating point.", block=diagram.name)
            run = {name: value for name, value in self.options.items() if name not in ("plants", "stairs")}
            at = base.point if not parameters else operating_point(diagram, asked, run)
            self._asked[start.index] = (diagram, at)
            return self._judge(start, base, diagram, at, self._loops[place] if not parameters else {})
        except UnknownArgumentError:
            raise  # no case has it
        except LoopwrightError as error:
            return replace(start, reason=str(error))

    def _open_loops(self, base: Linearization) -> dict[tuple[str, ...], StateSpace]:
        """Return the loops of the diagram as it is, and note where it has none."""
        try:
            return {wires: base.loop(*wires) for wires in self.goal.loops}
        except LoopwrightError as error:
            self.has_no_loop = True
            if isinstance(error, PeriodicLoopError) and len(self.goal.loops) == 1:
                ((self.periodic, *others),) = self.goal.loops
                self.periodic = None if others else self.periodic
            raise

    def _take(self, case: StudyCase, measure: Measure, number: Number) -> StudyCase:
        """Return a case with a number that is no loop's."""
        place, name = (measure.place,), measure.name
        if math.isnan(number.value):
            return replace(case, reason=f"found no {name}; expected a number. Look at the diagram with its parameters.")
        goodness = self.goal.goodness(place, name, number.value)
        return replace(
            case, state=CaseState.STABLE, goodness=goodness, loop=place, quantity=name, numbers={place: {name: number}}
        )

    def with_findings(self, case: StudyCase) -> StudyCase:
        """Return a stable case with the numbers of the whole linear model, which reports what it leaves out.

        The numbers of many cases come from their loops' matrices alone, without the model's checks and findings.
        """
        if self.measure is not None or case.state not in (CaseState.STABLE, CaseState.MOVING):
            return case
        diagram, at = self._asked[case.index]
        try:
            model = linearize(diagram, at, **self.options)
            loops = {wires: model.loop(*wires) for wires in self.goal.loops}
        except LoopwrightError as error:
            return replace(case, state=CaseState.FAILED, goodness=FAILED, loop=(), quantity="", reason=str(error))
        return self._judge(case, self._bases[case.point], diagram, at, loops)

    def numbers_at_other_cuts(self, case: StudyCase, others: OtherCuts) -> dict[str, dict[str, Number]]:
        """Return the numbers of a case's loop at other cuts of its wire, by their inputs."""
        if not others or case.index not in self._asked or case.state not in (CaseState.STABLE, CaseState.MOVING):
            return {}
        diagram, at = self._asked[case.index]
        return numbers_at_other_cuts(linearize(diagram, at, **self.options), others, self.delay)

    def _judge(
        self,
        case: StudyCase,
        base: Linearization,
        diagram: WiredDiagram,
        at: OperatingPoint,
        loops: Mapping[tuple[str, ...], Any],
    ) -> StudyCase:
        """Return a case with its numbers and its goodness; ``loops`` are those that are known."""
        numbers: dict[tuple[str, ...], dict[str, Number]] = {}
        worst: tuple[float, tuple[str, ...], str] = (math.inf, (), "")
        unstable: tuple[str, ...] = ()
        growth, rests = -math.inf, True
        for wires in self.goal.loops:
            L, still = loop_of_variant(base, wires, diagram, at)
            L, rests = loops.get(wires, L), rests and still
            r = realize(L, delay=self.delay)
            own = r.logarithm(r.eigenvalues()) if r.order and not r.is_stable() else np.zeros(0)
            hidden = np.array(find_hidden_unstable(r))  # poles of other loops, which this one does not move
            beyond = [*own.real, *(np.log(np.abs(hidden)) / r.dt if r.dt else hidden.real)]
            if beyond:
                if max(beyond) > growth:
                    growth, unstable = float(max(beyond)), wires
                continue
            found = numbers[wires] = numbers_of(L, self.delay)
            for quantity in self.goal.loops[wires]:
                if quantity not in found or math.isnan(found[quantity].value):
                    continue
                goodness = self.goal.goodness(wires, quantity, found[quantity].value)
                if goodness < worst[0] or not worst[1]:  # an infinite margin is a number, too
                    worst = (goodness, wires, quantity)
        if unstable:
            return replace(
                case,
                state=CaseState.UNSTABLE,
                goodness=UNSTABLE - max(growth, 0.0),
                loop=unstable,
                growth=growth,
                numbers=numbers,
            )
        if not worst[1]:
            asked = ", ".join(dict.fromkeys(name for limits in self.goal.loops.values() for name in limits))
            there = ", ".join(dict.fromkeys(name for found in numbers.values() for name in found)) or "none"
            return replace(case, reason=f"found no {asked}; expected a number of its loops. Take one of: {there}.")
        state = CaseState.STABLE if rests or not base.is_equilibrium else CaseState.MOVING
        return replace(case, state=state, goodness=worst[0], loop=worst[1], quantity=worst[2], numbers=numbers)

    # --- search -------------------------------------------------------------------------------------------------------

    def try_corners(self) -> None:
        """Run the corners of the ranges: all of a few parameters."""
        n = len(self.ranges.names)
        if n <= MOST_CORNERS:
            for corner in itertools.product((0.0, 1.0), repeat=n):
                self.run(self.ranges.parameters_at(np.array(corner)), CaseOrigin.CORNER)

    def search(self, starts: int, steps: int) -> None:
        """Go downhill from the worst cases that could be analysed; an unstable one is bad enough."""
        known = (c for c in self.cases if c.parameters and c.quantity and math.isfinite(c.goodness))
        ranked = sorted(known, key=lambda c: (order_key(c.goodness), c.index))
        begun: list[np.ndarray] = []
        for case in ranked:
            if len(begun) == starts or self._is_lost():
                break
            fractions = self.ranges.fractions_of(case.parameters)
            if any(np.max(np.abs(fractions - other)) < 0.05 for other in begun):
                continue
            begun.append(fractions)
            self._descend(fractions, steps)
        if not self._is_lost():
            self._polish()

    def _worst_at(self, fractions: np.ndarray) -> StudyCase:
        return min(self.run(self.ranges.parameters_at(fractions), CaseOrigin.SEARCH), key=lambda c: c.goodness)

    def _is_lost(self) -> bool:
        return any(case.state is CaseState.UNSTABLE for case in self.cases)

    def _descend(self, fractions: np.ndarray, steps: int) -> None:
        """Go downhill along the gradient, within the ranges, and try the corner that it points to."""
        from scipy.optimize import minimize

        ends = list[np.ndarray]()

        def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
            case = self._worst_at(x)
            if case.state in (CaseState.UNSTABLE, CaseState.FAILED):
                raise _LostError
            gradient = self.gradient(case, x)
            ends.append(gradient)
            return case.goodness, gradient

        try:
            minimize(
                evaluate,
                fractions,
                jac=True,
                method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * fractions.size,
                options={"maxiter": steps, "maxfun": 2 * steps},
            )
        except _LostError:
            return
        if ends and len(self.ranges.names) > MOST_CORNERS:
            corner = np.where(ends[-1] > 0.0, 0.0, 1.0)
            self.run(self.ranges.parameters_at(np.where(ends[-1] == 0.0, fractions, corner)), CaseOrigin.CORNER)

    def gradient(self, case: StudyCase, fractions: np.ndarray) -> np.ndarray:
        """Return the derivative of a case's goodness by the fractions, exact where the parameters are traced.

        A number that is no loop's has differences alone.
        """
        if self.measure is not None or not self.smooth:
            return np.array([self._difference(case, fractions, i) for i in range(fractions.size)])
        diagram, at = self._asked[case.index]
        model, found = linearize(diagram, at, **self.options), np.zeros(fractions.size)
        L = model.loop(*case.loop)
        point = self.points[case.point]
        find = (lambda d: point(d.facade)) if callable(point) else None  # users' functions take a Diagram
        names = [name for name in self.boxes if name in self.smooth]
        made = differentiate_loop(model, case.loop, names, find=find, left_out={})
        slopes: list[LoopSlope | None] = []
        for name, box in self.boxes.items():
            mine = [one for one in made if one.parameter == name or one.parameter.startswith(f"{name}[")]
            slopes += mine if len(mine) == box.size else [None] * box.size
        known = [s for s in slopes if s is not None]
        by_matrices = margin_slopes(rational_loop(L), [s.slopes for s in known], delay=self.delay)
        exact = iter(by_matrices[case.quantity].slopes)
        by_number = self.goal.slope(case.loop, case.quantity, case.value)
        widths = self.ranges.widths_at(case.parameters)
        for i, slope in enumerate(slopes):
            value = math.nan if slope is None else next(exact)
            if math.isfinite(value):
                found[i] = by_number * value * widths[i]
            else:
                found[i] = self._difference(case, fractions, i)
        return found

    def _difference(self, case: StudyCase, fractions: np.ndarray, i: int) -> float:
        side = -1.0 if fractions[i] > 0.5 else 1.0
        moved = fractions.copy()
        moved[i] += side * DIFFERENCE
        other = self._worst_at(moved)
        change = (other.goodness - case.goodness) / (side * DIFFERENCE)
        bad = other.state in (CaseState.UNSTABLE, CaseState.FAILED)
        return change if math.isfinite(change) and not bad else 0.0

    def _polish(self) -> None:
        """Step along single parameters from the worst case on: a kink in the margin stops a gradient, but not these."""
        known = [c for c in self.cases if c.parameters and c.quantity]
        if not known:
            return
        best = min(known, key=lambda c: (order_key(c.goodness), c.index))
        for step in PATTERN:
            better = True
            while better and not self._is_lost():
                better, middle = False, self.ranges.fractions_of(best.parameters)
                for i, side in itertools.product(range(middle.size), (1.0, -1.0)):
                    moved = middle.copy()
                    moved[i] = np.clip(moved[i] + side * step, 0.0, 1.0)
                    if moved[i] == middle[i]:
                        continue
                    case = self._worst_at(moved)
                    if case.goodness < best.goodness - 1e-9 * (1.0 + abs(best.goodness)):
                        best, better = case, True
                        break


class _LostError(Exception):
    """The search has come to a case that is unstable or can't be analysed."""


def _is_start_value(diagram: WiredDiagram, name: str) -> bool:
    return any(
        name.startswith(f"{path}.start.")
        for path, block in diagram.blocks.items()
        if block.stepped or block.in_model_exchange
    )

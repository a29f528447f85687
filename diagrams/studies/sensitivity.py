"""Sensitivity of a loop's margins to the parameters of its diagram."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    ConfirmationError,
    Grid,
    LoopwrightError,
    PeriodicLoopError,
    Sheet,
    ShownAsTable,
    UnknownNameError,
    accepts,
    brief,
    enumerate_some,
    explain_calls,
    kinds,
    near,
)
from ..flat import WiredDiagram
from ..frequency import Confirmation, MarginSlope, Number, margin_slopes, margins, order_key
from ..linearization import (
    Linearization,
    LoopSlope,
    PointFinder,
    carry_point,
    differentiate_loop,
    linearize,
    loop_of_variant,
    rational_loop,
    trim,
)
from ..plotting import BLUE, DARK, VERMILION, shown_figure
from ..results import OperatingPoint
from .loop_places import compared_numbers, place_loops, write_open_loop
from .varied_parameters import changed_entry, check_parameters, list_parameters, unit_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUNDING = 1e-9
"""Relative error of a slope by rounding alone."""
PEAK_ERROR = 1e-6
"""Relative error of the slope of a disk margin of several channels, whose frequency is searched for."""
BY_DERIVATIVE = "exact derivative of the linear model"
BY_DIFFERENCES = "differences of linear models with changed start values"
AGREEMENT = 1e-3
"""Relative difference up to which a difference of margins confirms a slope."""
STEP = 1e-3
"""Change of a parameter for a confirmation, relative to its size."""


@explain_calls
@dataclass(frozen=True)
class Sensitivity:
    """The derivative of one number of a loop by one number of a parameter.

    Attributes
    ----------
    parameter, value, unit : str, float, str
        Path of the parameter, with the entry of an array, its value, and its unit ("" where none is declared).
    quantity : str
        Name of the loop's number, such as ``"phase_margin_deg"``.
    number : Number
        The loop's number.
    slope : Number
        Its derivative by the parameter, in the number's unit over the parameter's.
    is_exact : bool
        Whether no difference is part of the slope.
    kink : bool
        Whether another crossing has nearly the same margin: beyond it the slope is another one.
    rest_lost : bool
        Whether the operating point does not stay at rest when the parameter changes; the states are held then.
    """

    parameter: str
    value: float
    unit: str
    quantity: str
    number: Number
    slope: Number
    is_exact: bool = True
    kink: bool = False
    rest_lost: bool = False

    def __repr__(self) -> str:
        change = f"{self.per_percent.value:+.4g} per 1 %"
        facts = f"of {self.quantity} = {self.number} by {self.parameter} = {self.value:g} {self.unit}".rstrip(), change
        return brief("sensitivity", *facts, then=".slope, .per_percent")

    @property
    def per_percent(self) -> Number:
        """Change of the number when the parameter grows by 1 %, in the number's unit, to first order."""
        s, share = self.slope, abs(self.value) / 100.0
        return replace(s, value=s.value * share, tolerance=s.tolerance * share, unit=self.number.unit)

    @property
    def relative(self) -> float:
        """Relative change of the number over the relative change of the parameter; NaN where one of them is 0."""
        size = self.number.value
        return self.slope.value * self.value / size if size and math.isfinite(size) else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return the facts by name."""
        return {
            "parameter": self.parameter,
            "value": self.value,
            "unit": self.unit,
            "quantity": self.quantity,
            "number": self.number.value,
            "slope": self.slope.value,
            "tolerance": self.slope.tolerance,
            "per_percent": self.per_percent.value,
            "relative": self.relative,
            "kink": bool(self.kink),
            "rest_lost": bool(self.rest_lost),
        }


@explain_calls
@dataclass(frozen=True)
class Sensitivities(ShownAsTable, Sequence[Sensitivity]):
    """Sensitivities of a loop's numbers to parameters, in the order of the parameters.

    ``found["pid.kp", "phase_margin_deg"]`` is one of them, ``found.of("ms")`` those of one number, the largest first.

    Attributes
    ----------
    wires : tuple of str
        Wires that the loop is cut at.
    rows : tuple of Sensitivity
        All of them.
    stable : bool
        Whether the closed loop is stable. The numbers and slopes of an unstable one are NaN.
    without_effect : tuple of str
        Parameters that change nothing in the loop.
    left_out : mapping
        Parameters that have no derivative here, with the reason.
    model : Linearization
        The linear model.
    """

    wires: tuple[str, ...]
    rows: tuple[Sensitivity, ...]
    stable: bool
    without_effect: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    model: Linearization | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        names = enumerate_some(dict.fromkeys(row.parameter for row in self.rows))
        facts = names if self.rows else "none", "" if self.stable else "the closed loop is unstable"
        then = "print(…) shows all, .of('disk_margin'), .plot()"
        return brief(f"sensitivities of the loop at {', '.join(self.wires)}", *facts, then=then)

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Sensitivity]:
        return iter(self.rows)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, int | slice):
            return self.rows[key]
        if not (isinstance(key, tuple) and len(key) == 2 and all(isinstance(part, str) for part in key)):
            raise UnknownNameError(
                f"found {key!r}; expected a parameter and a number, such as found['pid.kp', 'phase_margin_deg']."
            )
        name, quantity = key
        names = tuple(dict.fromkeys(row.parameter for row in self.rows))
        full = [n for n in names if n == name or n.endswith(f".{name}")]
        if len(full) != 1 and self.model is not None:  # other short names, as those of FMUs' start values
            with suppress(LoopwrightError):
                full = [n for n in names if n == self.model.wired.find_parameter(name)]
        if len(full) != 1:
            raise UnknownNameError(f"found no sensitivity to {name!r}. {near(str(name), names)}")
        for row in self.rows:
            if (row.parameter, row.quantity) == (full[0], quantity):
                return row
        raise UnknownNameError(f"the loop has no {quantity!r}. {near(str(quantity), self.quantities)}")

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the loop's numbers."""
        return tuple(dict.fromkeys(row.quantity for row in self.rows))

    @accepts(quantity=kinds.text, count=kinds.count)
    def of(self, quantity: str, count: int | None = None) -> list[Sensitivity]:
        """Return the sensitivities of one number, the largest change per 1 % first.

        Raises
        ------
        UnknownNameError
            If the loop has no such number.
        """
        if self.rows and quantity not in self.quantities:
            raise UnknownNameError(f"the loop has no {quantity!r}. {near(str(quantity), self.quantities)}")
        mine = [row for row in self.rows if row.quantity == quantity and math.isfinite(row.slope.value)]
        return sorted(mine, key=lambda row: (-order_key(abs(row.per_percent.value)), row.parameter))[:count]

    def table(self) -> list[dict[str, Any]]:
        """Return all rows as mappings; ``pandas.DataFrame(found.table())`` shows them."""
        return [row.as_dict() for row in self.rows]

    def _sheet(self) -> Sheet:
        grids = []
        for quantity in self.quantities:
            if mine := self.of(quantity):
                title = f"{quantity} = {mine[0].number}"
                columns = "parameter", "value", "unit", "change per 1 %", "derivative", "±", ""
                grids.append(Grid(title, columns, tuple(_row(row) for row in mine)))
        return Sheet(
            f"sensitivities of the loop at {', '.join(self.wires)}",
            (
                ("closed loop", "stable" if self.stable else "unstable: it has no margins"),
                ("without effect", ", ".join(self.without_effect)),
            ),
            tuple(grids),
            tuple(f"left out: {name}: {reason}" for name, reason in self.left_out.items()),
        )

    def plot(self, quantity: str = "disk_margin", count: int = 8) -> Figure:
        """Return a bar for each of the largest changes per 1 % of a parameter."""
        from matplotlib.ticker import MaxNLocator

        mine = self.of(quantity, count)[::-1]
        values = [row.per_percent.value for row in mine]
        unit = "" if not mine or mine[0].number.unit == "1" else f" in {mine[0].number.unit}"
        with shown_figure(0.7 + 0.27 * max(len(mine), 1)) as figure:
            axes = figure.subplots()
            axes.barh([row.parameter for row in mine], values, color=[BLUE if v >= 0 else VERMILION for v in values])
            axes.axvline(0.0, color=DARK, linewidth=0.8)
            axes.set_xlabel(f"change of {quantity}{unit} per 1 % of the parameter")
            axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            axes.grid(visible=False, axis="y")
        return figure


def _row(row: Sensitivity) -> tuple[Any, ...]:
    """Return the row of a table: the error as a text where it is not known."""
    marks = ", ".join(("kink",) * row.kink + ("states held",) * row.rest_lost)
    error = row.slope.tolerance
    known = "error unknown" if math.isnan(error) else f"{error:.1g}"
    change = float(f"{row.per_percent.value:.4g}")
    return row.parameter, row.value, row.unit, change, row.slope.value, known, marks


@accepts("sensitivity", loop=kinds.names, to=kinds.names, parameters=kinds.names, delay=kinds.whole, skew=kinds.number)
def find_sensitivities(
    diagram: WiredDiagram,
    loop: str | Iterable[str],
    parameters: str | Iterable[str] | None = None,
    *,
    to: str | Iterable[str] | None = None,
    at: Any = None,
    delay: int = 0,
    skew: float = 0.0,
    plants: str | None = None,
    stairs: str | None = None,
    **options: Any,
) -> Sensitivities:
    """Return the derivatives of a loop's margins by parameters; see `Diagram.sensitivities`."""
    whole = diagram
    diagram, wires, _, _ = place_loops(diagram, loop, None, to)
    find: PointFinder | None = None
    if callable(at) and not isinstance(at, OperatingPoint):

        def find(variant: WiredDiagram) -> OperatingPoint:
            found: OperatingPoint = at(variant.facade)
            return found

    point = find(diagram) if find is not None else carry_point(whole, at, diagram)
    model = linearize(diagram, point, plants=plants, stairs=stairs, **options)
    try:
        return sensitivities_of(model, tuple(wires), parameters, find=find, delay=delay, skew=skew)
    except PeriodicLoopError as error:
        if len(wires) == 1 and wires[0] in ([loop] if isinstance(loop, str) else list(loop)):
            way = write_open_loop(wires[0], "phase_margin_deg", at)
            error.add(
                f" Sensitivities take neither: take differences of f = {way}, such as f(diagram.replace({{…}})), or "
            )
            error.add("worst_case({…}, quantity=f).")
        raise


def sensitivities_of(
    model: Linearization,
    wires: tuple[str, ...],
    parameters: str | Iterable[str] | None = None,
    *,
    find: PointFinder | None = None,
    delay: int = 0,
    skew: float = 0.0,
) -> Sensitivities:
    """Return the derivatives of the margins of a linear model's loop by parameters of its diagram."""
    diagram = model.wired
    left_out: dict[str, str] = {}
    if parameters is None:
        names, left_out = list_parameters(diagram)
    else:
        given = [parameters] if isinstance(parameters, str) else list(parameters)
        names = list(dict.fromkeys(diagram.find_parameter(name) for name in given))
        check_parameters(diagram, names, "a sensitivity")
    L = model.loop(*wires)
    refused = left_out if parameters is None else None
    slopes: list[LoopSlope] = differentiate_loop(model, wires, names, find=find, left_out=refused)
    acting = [one for one in slopes if any(np.any(M) for M in one.slopes)]
    rational = rational_loop(L)
    known = margins(L, delay=delay, skew=skew) if rational is not L and L.ninputs == 1 else None
    found = margin_slopes(rational, [one.slopes for one in acting], delay=delay, skew=skew, found=known)
    bounds = _bound_errors(rational, acting, found, delay, skew)
    rows = []
    for i, one in enumerate(acting):
        unit = unit_of(diagram, one.parameter)
        for quantity, slope in found.items():
            value = slope.slopes[i]
            rounding = PEAK_ERROR if len(wires) > 1 or L.ninputs > 1 else ROUNDING
            tolerance = rounding * abs(value) + bounds[quantity][i]
            how = BY_DERIVATIVE if one.is_exact else BY_DIFFERENCES
            over = _over(slope.number.unit, unit)
            number = Number(value, over, tolerance, how, findings=slope.number.findings)
            made = Sensitivity(one.parameter, one.value, unit, quantity, slope.number, number)
            rows.append(replace(made, is_exact=one.is_exact, kink=slope.kink, rest_lost=one.rest_lost))
    without = tuple(one.parameter for one in slopes if one not in acting)
    stable = not any(math.isnan(f.number.value) for name, f in found.items() if name in ("ms", "disk_margin"))
    return Sensitivities(wires, tuple(rows), stable, without, left_out, model)


def _over(unit: str, below: str) -> str:
    if not below or below == "1":
        return unit
    return f"{unit}/({below})" if any(c in below for c in "/*·") else f"{unit}/{below}"


def _bound_errors(
    L: Any, slopes: Sequence[LoopSlope], found: Mapping[str, MarginSlope], delay: int, skew: float
) -> dict[str, np.ndarray]:
    """Return bounds of the slopes' errors that come of errors of the matrices' entries, by the numbers' names."""
    bounds = {name: np.zeros(len(slopes)) for name in found}
    rough = [i for i, one in enumerate(slopes) if not one.is_exact]
    if not rough:
        return bounds
    shapes = [M.shape for M in (L.A, L.B, L.C, L.D)]
    places = [(k, place) for k, shape in enumerate(shapes) for place in np.ndindex(*shape)]
    needed = [(k, p) for k, p in places if any(slopes[i].errors[k][p] for i in rough)]
    units = []
    for k, place in needed:
        four = [np.zeros(shape) for shape in shapes]
        four[k][place] = 1.0
        units.append((four[0], four[1], four[2], four[3]))
    by_entry = margin_slopes(L, units, delay=delay, skew=skew)
    for name, one in by_entry.items():
        gradient = np.nan_to_num(np.abs(one.slopes))
        for i in rough:
            errors = np.array([slopes[i].errors[k][place] for k, place in needed])
            bounds[name][i] = float(gradient @ errors)
    return bounds


@accepts(
    found=kinds.one_of_class(Sensitivities, "the result of Diagram.sensitivities"),
    row=kinds.one_of_class(Sensitivity, "one of the sensitivities found, such as found[name, 'ms']"),
    delay=kinds.whole,
    skew=kinds.number,
)
def confirm_sensitivity(found: Sensitivities, row: Sensitivity, *, delay: int = 0, skew: float = 0.0) -> Sensitivity:
    """Return a sensitivity that a second computation has confirmed: differences of the margin itself.

    The diagram is changed by ±0.1 % of the parameter, linearized at the point again, and its margin is computed.

    Raises
    ------
    ConfirmationError
        If the two disagree.
    """
    return confirm_parameter(found, row.parameter, [row.quantity], delay=delay, skew=skew)[0]


def confirm_parameter(
    found: Sensitivities, parameter: str, quantities: Iterable[str], *, delay: int = 0, skew: float = 0.0
) -> list[Sensitivity]:
    """Return the sensitivities of some numbers to one parameter, confirmed as by `confirm_sensitivity`.

    Raises
    ------
    ConfirmationError
        If a slope and the differences disagree.
    """
    model, rows = found.model, [found[parameter, quantity] for quantity in quantities]
    if model is None or not rows:
        return rows
    h = STEP * (abs(rows[0].value) or 1.0)

    def numbers(change: float) -> dict[str, float]:
        diagram = model.wired.replace(changed_entry(model.wired, parameter, rows[0].value + change))
        L, rests = loop_of_variant(model, found.wires, diagram, model.point)
        if model.is_equilibrium and not rests and not rows[0].rest_lost:
            point = trim(diagram, None, None, rates=None, fixed=(), at=model.point, tolerance=1e-9)
            L, rests = loop_of_variant(model, found.wires, diagram, point)
        return compared_numbers(L, [row.quantity for row in rows], delay, skew)

    def differences(h: float) -> dict[str, float]:
        high, low = numbers(h), numbers(-h)
        return {row.quantity: (high[row.quantity] - low[row.quantity]) / (2.0 * h) for row in rows}

    wide, narrow = differences(h), dict[str, float]()
    made = []
    for row in rows:
        if not math.isfinite(row.slope.value):
            made.append(row)
            continue
        other = wide[row.quantity]
        rounding = 10 * row.number.tolerance / h + AGREEMENT * abs(row.number.value * STEP) / h
        allowed = max(AGREEMENT * abs(row.slope.value), rounding, row.slope.tolerance)
        if not abs(other - row.slope.value) <= allowed:  # the margin may bend over the step: extrapolate to none
            narrow = narrow or differences(h / 2.0)
            other = (4.0 * narrow[row.quantity] - other) / 3.0
        if not abs(other - row.slope.value) <= allowed:
            raise ConfirmationError(
                f"found {row.slope.value:.9g} as the derivative of {row.quantity} by {parameter}, but differences of "
                f"the margin give {other:.9g}; expected the same to {AGREEMENT:g}. Look at the crossings near it: the "
                "margin may have a kink there.",
                block=model.wired.name,
            )
        how = Confirmation(row.slope.confirmed_by).and_by(
            f"differences of the margin of the changed diagram give {other:.6g}",
            "differences of the margin of the changed diagram",
        )
        made.append(replace(row, slope=replace(row.slope, confirmed_by=how)))
    return made

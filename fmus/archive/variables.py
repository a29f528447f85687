"""Variables of an FMU, of FMI 2.0 or 3.0, in one form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import Grid, explain_calls
from .unit_definitions import FmuUnits

_FMI2_TYPES = {"Real": "Float64", "Integer": "Int32"}
_INTEGERS = {
    f"{sign}Int{bits}": (0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for sign in ("", "U")
    for bits in (8, 16, 32, 64)
}
_EXACT = 2**53
"""Largest integer up to which a float64 holds every integer."""
WIRE_TYPES = ("Float64", "Float32", *_INTEGERS, "Boolean", "Enumeration")
"""Types that a wire carries, as FMI 3.0 names them."""
TEXT_TYPES = ("String", "Binary")
"""Types that no wire carries, but that are set at the start and recorded."""


@explain_calls
@dataclass(frozen=True, eq=False)
class FmuVariable:
    """Variable of an FMU with numbers as values: a scalar, an array, or scalars that were gathered into an array."""

    name: str
    references: tuple[int, ...]
    """Value references: one of a variable of the FMU, one for each element where scalars were gathered."""
    causality: str
    shape: tuple[int, ...]
    unit: str | None
    start: Any
    description: str
    minimum: float | np.ndarray | None
    maximum: float | np.ndarray | None
    nominal: float | np.ndarray | None = None
    variability: str = "continuous"
    initial: str = "exact"
    """FMI's ``initial``; "exact" means that it starts at its start value (FMI 2.0, 2.2.7; FMI 3.0, 2.4.7.4)."""
    type: str = "Float64"
    """Type as FMI 3.0 names it; FMI 2.0's Real is Float64, its Integer is Int32."""
    items: Mapping[str, int] = field(default_factory=dict)
    """Values of an enumeration by their names."""
    intermediate: bool = False
    """Whether it can be set or read within a step (intermediateUpdate of FMI 3.0)."""
    clocks: tuple[str, ...] = ()
    """Names of the clocks at whose ticks alone it may be set (FMI 3.0)."""

    @property
    def reference(self) -> int:
        """Value reference, the first one of scalars that were gathered."""
        return self.references[0]

    @property
    def keys(self) -> tuple[tuple[str, int], ...]:
        """Type and value reference of each scalar, or of the array: alike for all names of a variable."""
        return tuple((self.type, reference) for reference in self.references)

    @cached_property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def is_integer(self) -> bool:
        """Whether only integers are values of its type; a Boolean has the values 0 and 1."""
        return self.type not in ("Float64", "Float32")

    @cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest value of each element, infinite without one, in the variable's shape."""
        low, high = (
            np.broadcast_to(np.asarray(default if bound is None else bound, dtype=float), self.shape)
            for bound, default in ((self.minimum, -np.inf), (self.maximum, np.inf))
        )
        return low, high

    @property
    def range_text(self) -> str:
        """Smallest and largest value with the unit, such as "0 to 5 in mm" or "at least 0"."""
        low, high = self.limits
        unit = f" in {self.unit}" if self.unit else ""
        if np.ptp(np.nan_to_num(low)) or np.ptp(np.nan_to_num(high)):
            return f"{low.tolist()} to {high.tolist()}{unit}"
        least, most = float(np.max(low)), float(np.min(high))
        if np.isfinite(least) and np.isfinite(most):
            return f"{least:g} to {most:g}{unit}"
        if least == np.finfo(float).tiny:  # an open bound, which FMI can't write
            return f"numbers above 0{unit}"
        return f"at least {least:g}{unit}" if np.isfinite(least) else f"at most {most:g}{unit}"

    @property
    def nominals(self) -> np.ndarray:
        """Size of the usual values of each element, 1 where the FMU states none."""
        given = 1.0 if self.nominal is None else self.nominal
        found = np.abs(np.broadcast_to(np.asarray(given, dtype=float), self.shape))
        return np.where(found > 0.0, found, 1.0)

    @property
    def range_of_type(self) -> tuple[float, float] | None:
        """Least and greatest number for which `complaint` is empty; None if some whole number between is none."""
        if self.type == "Float64":
            return -math.inf, math.inf
        if self.type == "Float32":
            limit = float(np.finfo(np.float32).max)
            return -limit, limit
        low, high = (0, 1) if self.type == "Boolean" else _INTEGERS.get(self.type, _INTEGERS["Int64"])
        if self.items:
            known = {*self.items.values()}
            if len(known) != max(known) - min(known) + 1:
                return None
            low, high = max(low, min(known)), min(high, max(known))
        return float(max(low, -_EXACT)), float(min(high, _EXACT))

    def complaint(self, values: np.ndarray) -> str:
        """Return the reason why values can't be those of this type, as "found …; expected …"; empty if they can.

        Examples
        --------
        >>> count = FmuVariable("n", (0,), "input", (), None, 0, "", None, None, type="Int8")
        >>> count.complaint(np.array(0.5))
        'found 0.5; expected an integer, as it is of type Int8'
        """
        if self.type == "Float64":
            return ""
        numbers = np.ravel(np.asarray(values, dtype=float))
        if self.type == "Float32":
            limit = float(np.finfo(np.float32).max)
            wrong = np.isfinite(numbers) & (np.abs(numbers) > limit)
            return f"found {numbers[wrong][0]:.9g}; expected a number of type Float32" if wrong.any() else ""
        whole = numbers == np.rint(numbers)  # false for NaN
        if not whole.all():
            kind = "0 or 1" if self.type == "Boolean" else "an integer"
            return f"found {numbers[~whole][0]:.9g}; expected {kind}, as it is of type {self.type}"
        low, high = (0, 1) if self.type == "Boolean" else _INTEGERS.get(self.type, _INTEGERS["Int64"])
        wrong = (numbers < max(low, -_EXACT)) | (numbers > min(high, _EXACT))
        if wrong.any():
            value = numbers[wrong][0]
            if low <= value <= high:
                return (
                    f"found {value:.17g}; expected at most 2**53 in size, up to which a signal holds every integer of "
                    f"its type {self.type}"
                )
            return f"found {value:.17g}; expected {low} to {high}, as it is of type {self.type}"
        if self.items:
            wrong = ~np.isin(numbers, list(self.items.values()))
            if wrong.any():
                known = ", ".join(f"{value} ({name})" for name, value in self.items.items())
                return f"found {numbers[wrong][0]:.9g}; expected one of its enumeration: {known}"
        return ""


@dataclass(frozen=True)
class OtherVariable:
    """Variable of an FMU that no wire carries: a text, binary data, a clock, or a negated alias of FMI 1.0."""

    name: str
    type: str
    causality: str
    reference: int = 0
    shape: tuple[int, ...] = ()
    variability: str = "discrete"
    interval_variability: str = ""
    """Kind of a clock: constant, fixed, tunable, changing, countdown or triggered."""
    interval: float | None = None
    """Interval of a periodic clock in s, where the description states one."""
    shift: float = 0.0
    """First tick of a periodic clock in s."""
    negated_of: str = ""
    """Variable whose value a negated alias of FMI 1.0 has with the opposite sign; empty for other variables."""

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def refusal(self) -> str:
        """The reason why no wire carries it, as the end of an error's text."""
        if not self.negated_of:
            return f"of type {self.type}; expected numbers, which alone a wire carries."
        return (
            f"a negated alias of FMI 1.0: it has the value of {self.negated_of} with the opposite sign, which is not "
            f"applied here; expected a variable with its own sign. Take {self.negated_of} and negate it (Gain)."
        )

    @property
    def is_text(self) -> bool:
        """Whether it is a text or binary data, which can be set at the start and is recorded."""
        return self.type in TEXT_TYPES and not self.negated_of

    @property
    def type_is_clock(self) -> bool:
        """Whether it is a clock."""
        return self.type == "Clock"

    @property
    def is_periodic(self) -> bool:
        """Whether it is a clock that ticks at instants that are known ahead."""
        return self.type_is_clock and self.interval_variability in ("constant", "fixed", "tunable")

    def __str__(self) -> str:
        if self.negated_of:
            return f"{self.name} (negated alias)"
        kind = f"{self.interval_variability} Clock" if self.interval_variability else self.type
        return f"{self.name} ({kind})"


def read_other(v: Any, dropped: Mapping[str, str]) -> OtherVariable:
    """Return a variable without numbers as values that FMPy has read; ``dropped`` holds attributes that it drops."""
    found = OtherVariable(
        v.name, v.type, v.causality or "local", v.valueReference, tuple(v.shape or ()), v.variability or "discrete"
    )
    if v.type != "Clock":
        return found
    interval: str | float | None = dropped.get("intervalDecimal")
    shift: str | float = dropped.get("shiftDecimal", 0.0)
    if interval is None and "intervalCounter" in dropped and "resolution" in dropped:
        resolution = float(dropped["resolution"])
        interval = float(dropped["intervalCounter"]) / resolution
        shift = float(dropped.get("shiftCounter", 0)) / resolution
    return replace(
        found,
        interval_variability=dropped.get("intervalVariability", ""),
        interval=None if interval is None else float(interval),
        shift=float(shift),
    )


def inexact(values: np.ndarray) -> bool:
    """Whether integers of 64 bits can't all be held by a float64."""
    return bool(np.any((values > _EXACT) | (values < -_EXACT)))


def read_variable(v: Any, dropped: Mapping[str, str], units: FmuUnits) -> FmuVariable:
    """Return a variable that FMPy has read; ``dropped`` holds attributes that it drops."""
    declared = v.declaredType

    def attribute(name: str) -> Any:
        found = getattr(v, name, None)
        found = dropped.get(name) if found is None else found
        return getattr(declared, name, None) if found is None else found

    shape, type_ = tuple(v.shape or ()), fmi3_type(v.type)
    items = {item.name: int(item.value) for item in declared.items} if declared is not None else {}
    return FmuVariable(
        v.name,
        (v.valueReference,),
        v.causality or "local",
        shape,
        units.find(attribute("unit"), relative=attribute("relativeQuantity") in (True, "true", "1")),
        None if v.start is None else _start(v.start, shape),
        v.description or (declared.description if declared is not None else None) or "",
        _number("min", attribute("min")),
        _number("max", attribute("max")),
        _number("nominal", attribute("nominal")),
        v.variability or "continuous",
        v.initial or ("calculated" if v.causality in ("output", "local", None) else "exact"),
        type_,
        items if type_ == "Enumeration" else {},
        dropped.get("intermediateUpdate") in ("true", "1"),
        tuple(clock.name for clock in getattr(v, "clocks", None) or ()),
    )


def fmi3_type(name: str) -> str:
    """Return FMI 3.0's name of a type of FMI 2.0 or 3.0."""
    return _FMI2_TYPES.get(name, name)


def _number(name: str, text: Any) -> float | None:
    """Return a number of an attribute; the ValueError of what is none names the attribute."""
    try:
        return None if text is None else float(text)
    except ValueError:
        raise ValueError(f"{name}={text!r}; expected a number") from None


def _start(text: Any, shape: tuple[int, ...]) -> np.ndarray:
    words = {"true": 1.0, "false": 0.0}
    try:
        if not shape and isinstance(text, str) and len(text.split()) == 1 and text not in words:
            return np.array(float(text))  # most variables, of thousands
        found = text.split() if isinstance(text, str) else np.ravel(text)
        values = np.array([words[x] if x in words else float(x) for x in found])
    except ValueError:
        raise ValueError(f"start={text!r}; expected {'numbers' if shape else 'a number'}") from None
    n = int(np.prod(shape, dtype=int))
    if values.size not in (1, n):
        raise ValueError(f"{values.size} start values; expected {n}, as its dimensions say, or one")
    full = np.broadcast_to(values, (n,)) if values.size == 1 else values
    return np.array(full).reshape(shape)


def variable_grid(title: str, variables: Mapping[str, FmuVariable], started: Mapping[str, Any]) -> Grid:
    """Return a table of variables by the names of their ports; ``started`` has start values that replace their own."""
    rows = tuple(
        (
            name,
            "" if name == v.name else v.name,
            _plain_start(started.get(v.name, v.start)),
            "" if v.unit in (None, "1") else v.unit,
            "" if v.type == "Float64" else v.type,
            " × ".join(map(str, v.shape)),
            v.description,
        )
        for name, v in variables.items()
    )
    return Grid(title, ("name", "in the FMU", "start", "unit", "type", "shape", "description"), rows)


def _plain_start(value: Any) -> Any:
    """Return a start value: a number as such, where its array has no dimensions."""
    return value.item() if isinstance(value, np.ndarray | np.generic) and np.ndim(value) == 0 else value

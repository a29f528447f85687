"""A number of a loop with its unit, tolerance, confirmation and findings; findings pass from systems to numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from ...blocks.core import ConfirmationError, Finding, decibels, explain_calls
from .state_space import findings_of, inexactness_of

P = ParamSpec("P")
R = TypeVar("R")
MARK = "†"
"""Mark of a number with findings."""
NOT_IN_DATA = "not in the data"


class Confirmation(str):
    """Text on how a number was confirmed, with ``method``: the same without values that differ between numbers."""

    method: str
    at_steps_only: bool  # whether a signal is known at communication points alone

    def __new__(cls, text: str, method: str | None = None, *, at_steps_only: bool = False) -> Confirmation:
        """Make a text with its method."""
        made = super().__new__(cls, text)
        made.method = method_of(text) if method is None else method
        made.at_steps_only = at_steps_only
        return made

    def and_by(self, text: str, method: str | None = None, *, at_steps_only: bool = False) -> Confirmation:
        """Return this confirmation followed by a further one; an empty method leaves the method as it is."""
        own = method_of(text) if method is None else method
        both = "; ".join(part for part in (self.method, own) if part)
        return Confirmation(f"{self}; {text}", both, at_steps_only=at_steps_only or self.at_steps_only)


def is_at_steps_only(text: str) -> bool:
    """Return whether a confirmation says that a signal is known at communication points alone."""
    return isinstance(text, Confirmation) and text.at_steps_only


def method_of(text: str) -> str:
    """Return the method of a confirmation, which is all of a plain text."""
    return text.method if isinstance(text, Confirmation) else str(text)


@explain_calls
@dataclass(frozen=True)
class Number:
    """A number with unit, tolerance, and the computation that confirmed it.

    Parameters
    ----------
    value : float
        Value; infinite where there is no limit, NaN where the quantity does not exist.
    unit : str
        Unit, "1" of a pure number.
    tolerance : float
        Absolute bound of the numerical error of the value, in its unit; NaN where it is not known, as one of the
        findings says.
    confirmed_by : str
        The independent computation that agreed. A `Confirmation` gives its method, too, without the single case's
        values.
    given : bool
        Whether it is a given, such as a parameter, with nothing to confirm.
    findings : tuple of Finding
        Effects that the linear model behind it leaves out, such as a kink at the operating point: the number is right
        for the model, and may be wrong for the diagram. Its text ends with †.

    Examples
    --------
    >>> float(Number(71.25, "deg", 1e-9, "closed-loop eigenvalues"))
    71.25
    """

    value: float
    unit: str
    tolerance: float
    confirmed_by: str
    given: bool = False
    findings: tuple[Finding, ...] = ()
    is_gain: bool = field(default=False, repr=False, compare=False)
    """Whether it is a factor of the gain, whose text has decibels as well."""

    def __post_init__(self) -> None:
        for name in ("value", "tolerance"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if not self.given and any(finding.leaves_error_unknown for finding in self.findings):
            object.__setattr__(self, "tolerance", math.nan)

    def __float__(self) -> float:
        return self.value

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.value:.6g}{unit}{self.gain_text}" + (f" {MARK}" if self.findings else "")

    @property
    def gain_text(self) -> str:
        """Text of a factor of the gain in decibels, in brackets; empty for other numbers, and for 0 and infinity."""
        text = decibels(self.value) if self.is_gain else ""
        return f" ({text})" if text else ""

    def as_dict(self) -> dict[str, Any]:
        """Return the four entries by name, as in a report's JSON, and ``findings`` if there are any."""
        found = {name: getattr(self, name) for name in ("value", "unit", "tolerance", "confirmed_by")}
        return found | ({"findings": [f.as_dict() for f in self.findings]} if self.findings else {})


@dataclass(frozen=True)
class Interval:
    """A number and the least and largest value that the data's uncertainty allows; NaN where it is not in the data."""

    value: float
    low: float
    high: float
    unit: str

    def __float__(self) -> float:
        return self.value

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        if math.isnan(self.value):
            return NOT_IN_DATA
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]" + ("" if self.unit == "1" else f" {self.unit}")


def carries_findings(function: Callable[P, R]) -> Callable[P, R]:
    """Give a result the findings of the systems among the arguments, and explain equations without a solution."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        given = [*args, *kwargs.values()]
        try:
            with explain_singular(function.__name__):
                made = function(*args, **kwargs)
        except ConfirmationError as error:
            for system in given:
                _add_inexactness(error, cast("Any", system))
            raise
        return with_findings(made, tuple(f for system in given for f in findings_of(cast("Any", system))))

    return run


@contextmanager
def explain_singular(name: str) -> Iterator[None]:
    """Raise a ConfirmationError of a function for an equation that rounding leaves without a solution."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise ConfirmationError(
            f"found an equation of the loop without a solution ({error}); expected one at every frequency off the "
            "poles. The realization is ill-conditioned: give the loop as a state space with balanced states, or as its "
            "transfer function.",
            block=name,
        ) from error


def _add_inexactness(error: ConfirmationError, system: Any) -> None:
    """Add to an error that its system is not known well enough, if it isn't."""
    inexactness = inexactness_of(system)
    if inexactness:
        why = "; ".join(map(str, findings_of(system)))
        error.add(
            f" The loop itself is known to {inexactness:.1g} of its largest entry alone"
            f"{f' ({why})' if why else ', by differences of an FMU'}: a pole and a zero that cancel may seem apart."
        )


def with_findings(value: R, findings: tuple[Finding, ...]) -> R:
    """Return a number, a system, or a collection or result of them, with findings added to each number and system."""
    if not findings:
        return value
    return cast("R", _add(value, findings))


def _add(value: Any, findings: tuple[Finding, ...]) -> Any:
    from control import StateSpace

    if isinstance(value, Number):  # one that has them already stays itself: tables and paths find it by its identity
        joined = _join(value.findings, tuple(f for f in findings if f.limits_numbers))
        return value if joined == value.findings else replace(value, findings=joined)
    if isinstance(value, StateSpace):
        value.findings = _join(findings_of(value), findings)
        return value
    if isinstance(value, Mapping):
        return {key: _add(entry, findings) for key, entry in value.items()}
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(_add(entry, findings) for entry in value)
    if is_dataclass(value) and not isinstance(value, Finding | type):
        changed = {f.name: _add(getattr(value, f.name), findings) for f in fields(value) if f.name != "findings"}
        if any(f.name == "findings" for f in fields(value)):
            changed["findings"] = _join(getattr(value, "findings"), findings)  # noqa: B009 - of any dataclass
        return replace(value, **changed)
    return value


def _join(first: tuple[Finding, ...], second: tuple[Finding, ...]) -> tuple[Finding, ...]:
    return tuple(dict.fromkeys((*first, *second)))

"""A number of a report, with its unit, its tolerance and its confirmation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ...blocks.core import Finding, explain_calls

MARK = "†"
"""Mark of a number with findings."""


class Confirmation(str):
    """Text on how a number was confirmed, with the values of the single case.

    Parameters
    ----------
    text : str
        The text.
    method : str, optional
        The same without values that differ from number to number, for a table of many; without it that of the text.

    Examples
    --------
    >>> Confirmation("eigenvalues: stable at 0.99, unstable at 1.01", "eigenvalues on both sides").method
    'eigenvalues on both sides'
    """

    method: str

    def __new__(cls, text: str, method: str | None = None) -> Confirmation:
        """Make a text with its method."""
        made = super().__new__(cls, text)
        made.method = method_of(text) if method is None else method
        return made

    def and_by(self, text: str, method: str | None = None) -> Confirmation:
        """Return this confirmation with a further one behind it.

        Parameters
        ----------
        text : str
            The further one; it brings its own method, if it is a `Confirmation`.
        method : str, optional
            Its method; empty if only single cases have it.
        """
        own = method_of(text) if method is None else method
        return Confirmation(f"{self}; {text}", "; ".join(part for part in (self.method, own) if part))


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

    def __post_init__(self) -> None:
        for name in ("value", "tolerance"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if not self.given and any(finding.leaves_error_unknown for finding in self.findings):
            object.__setattr__(self, "tolerance", math.nan)

    def __float__(self) -> float:
        return self.value

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.value:.6g}{unit}" + (f" {MARK}" if self.findings else "")

    def as_dict(self) -> dict[str, Any]:
        """Return the four entries by name, as in a report's JSON, and ``findings`` if there are any."""
        found = {name: getattr(self, name) for name in ("value", "unit", "tolerance", "confirmed_by")}
        return found | ({"findings": [f.as_dict() for f in self.findings]} if self.findings else {})

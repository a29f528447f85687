"""Values as a report writes them: digits that the tolerance bears, units as they are printed."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ....blocks.core import print_unit
from ...frequency import MARK, Number

NOTHING = 1e-9
"""Size below which a number within its own tolerance is written as 0."""
ROUNDING = 1e-15
"""Size below which any number is written as 0."""
_POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(value: float, digits: int = 6) -> str:
    """Return a number with so many significant digits at most, in print.

    Examples
    --------
    >>> plain(-1.25e-7), plain(71.2498), plain(float("inf"))
    ('−1.25×10⁻⁷', '71.2498', '∞')
    """
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return with_power(mantissa, exponent)


def with_power(mantissa: str, exponent: str) -> str:
    """Return a number in print by the parts of its program's notation: its mantissa, and its exponent or nothing."""
    power = f"×10{str(int(exponent)).translate(_POWERS)}" if exponent else ""
    return mantissa.replace("-", "−") + power


def value_text(number: Number, most: int = 6) -> str:
    """Return a number's value with the digits that its tolerance bears, at most so many."""
    value, tolerance = number.value, number.tolerance
    if abs(value) < NOTHING and (abs(value) <= tolerance or abs(value) < ROUNDING):
        return "0"
    digits = most
    if math.isfinite(value) and value and tolerance > 0 and math.isfinite(tolerance):
        digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(tolerance)) + 1
    return plain(value, min(max(digits, 2), most))


def quantity(number: Number, most: int = 6) -> str:
    """Return a number with its unit, with so many significant digits at most."""
    text, unit = value_text(number, most), print_unit(number.unit)
    if not unit or text == "–":
        return text + number.gain_text.replace("-", "−") + mark(number)
    return text + ("" if unit == "°" else "\u202f") + unit + mark(number)


def mark(number: Number) -> str:
    """Return the mark of a number with findings, empty without any."""
    return MARK if number.findings else ""


def reason(number: Number) -> str:
    """Return the confirmation of a number, and what the linear model behind it leaves out."""
    return "; ".join([number.confirmed_by, *(f"{MARK} {finding}" for finding in number.findings)])


def tolerance_text(number: Number) -> str:
    """Return a tolerance: ± and its size."""
    if math.isnan(number.tolerance):
        return "–"
    return f"±{plain(number.tolerance, 1 if number.tolerance else 6)}"


def cell(value: Any) -> str:
    """Return the content of a table's cell as text."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value).replace("-", "−")
    if isinstance(value, float | np.floating):
        return plain(float(value))
    if isinstance(value, complex | np.complexfloating):
        sign = "−" if value.imag < 0 else "+"
        return f"{plain(float(value.real))} {sign} {plain(abs(float(value.imag)))}j"
    if isinstance(value, np.ndarray | list | tuple):
        return ", ".join(cell(v) for v in value)
    if isinstance(value, Number):
        return quantity(value)
    return re.sub(r"(?<![\w.)])-(?=\d)", "−", str(value))


def is_numeric(values: Sequence[Any]) -> bool:
    """Return whether a column holds numbers: it is set flush right then."""
    kinds = (Number, int, float, np.integer, np.floating)
    given = [v for v in values if v is not None and v not in ("", "–", "-")]
    return bool(given) and all(isinstance(v, kinds) and not isinstance(v, bool) for v in given)

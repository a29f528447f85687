"""Properties of an environment, by name: their units, and values of them and of other arguments, read and checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import Array, Kind, OptionError, ParameterError, UnknownArgumentError, kinds

UNITS = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "tool_mass": "kg"}
"""Unit of each property."""


A_FREQUENCY = kinds.positive.worded("a positive frequency in rad/s", "Give one.")


def points_in_a_decade(fewest: int) -> Kind:
    """Return the kind of the numbers of points in a decade that are enough."""
    return kinds.whole.where(lambda value: value >= fewest).worded(
        f"at least {fewest}, a whole number", "Give more.", lambda name, value: f"found {value!r} points in a decade"
    )


def read_number(value: Any, port: str, unit: str) -> float:
    """Return a number that is finite and not negative."""
    found = _as_array(value)
    if found is None or found.ndim != 0 or not 0.0 <= float(found) < math.inf:
        raise ParameterError(
            f"found {value!r}; expected one finite number in {unit} that is not negative. Give one.",
            block="environment",
            port=port,
        )
    return float(found)


def read_row(value: Any, name: str, *, rising: bool) -> np.ndarray:
    """Return a row of finite values of a property that are not negative; with ``rising``, positive ones that rise."""
    unit = UNITS[name]
    found = _as_array(value)
    if found is None or found.ndim != 1 or not len(found) or not np.all(np.isfinite(found)):
        raise OptionError(f"found {value!r}; expected a row of finite values in {unit}. Give a list.", port=name)
    if rising and (len(found) < 2 or not (found[0] > 0.0 and np.all(np.diff(found) > 0.0))):
        raise OptionError(
            f"found the values {found.tolist()}; expected positive ones that rise, two at least. Give others.",
            port=name,
        )
    if not np.all(found >= 0.0):
        raise OptionError(
            f"found the values {found.tolist()}; expected none that is negative. Leave it out.", port=name
        )
    return found


def read_vector(value: Any) -> np.ndarray | None:
    """Return a row of real numbers; None of anything else."""
    found = _as_array(value)
    return None if found is None else np.atleast_1d(found)


def check_property(name: Any, port: str) -> str:
    """Return a property of an environment."""
    if not isinstance(name, str) or name not in UNITS:
        raise UnknownArgumentError(str(name), UNITS, block=None, found="an environment has no").at(port=port)
    return name


def check_environment(**values: Array | None) -> None:
    """Refuse a property of the environment that is NaN, infinite or negative."""
    for name, value in values.items():
        numbers = np.asarray(0.0 if value is None else value, dtype=float)
        if not np.all((numbers >= 0.0) & np.isfinite(numbers)):
            raise ParameterError(
                f"found {value!r}; expected finite numbers that are not negative. Correct it.",
                block="environment",
                port=name,
            )


def check_properties(held: Mapping[str, Any], vary: str) -> dict[str, float]:
    """Return the properties of an environment that are held, as numbers."""
    check_property(vary, "vary")
    for name in held:
        check_property(name, str(name))
        if name == vary:
            raise OptionError(
                f"found it among the held properties, as {held[name]!r}; expected it only as the one that varies. "
                "Leave it out.",
                port=name,
            )
    return {name: read_number(value, name, UNITS[name]) for name, value in held.items()}


def _as_array(value: Any) -> np.ndarray | None:
    """Return real numbers as an array; None of anything else, such as texts, truth values and complex numbers."""
    try:
        found = np.asarray(value)
    except ValueError:  # lists of different lengths
        return None
    return found.astype(float) if found.dtype.kind in "iuf" or not found.size else None

"""Properties of an environment, by name: their units, and the kinds of them and of other arguments of a contact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import Kind, OptionError, ParameterError, UnknownArgumentError, check_argument, kinds

UNITS = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "tool_mass": "kg"}
"""Unit of each property."""


A_FREQUENCY = kinds.positive.worded("a positive frequency in rad/s", "Give one.")
A_PROPERTY = kinds.finite.where(lambda value: float(value) >= 0.0)
"""One value of a property."""
VALUES = kinds.numbers.where(lambda value: np.all((np.asarray(value) >= 0.0) & np.isfinite(value))).worded(
    "finite numbers that are not negative", "Correct it."
)
"""Values of a property, in any shape."""


def points_in_a_decade(fewest: int) -> Kind:
    """Return the kind of the numbers of points in a decade that are enough."""
    return kinds.whole.where(lambda value: value >= fewest).worded(
        f"at least {fewest}, a whole number", "Give more.", lambda name, value: f"found {value!r} points in a decade"
    )


def read_row(value: Any, name: str, *, rising: bool) -> np.ndarray:
    """Return a row of finite values of a property that are not negative; with ``rising``, positive ones that rise."""
    check_argument(value, kinds.row.worded(f"a row of finite values in {UNITS[name]}", "Give a list."), name, None)
    found = np.asarray(value, dtype=float)
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


def check_property(name: Any, port: str) -> str:
    """Return a property of an environment."""
    if not isinstance(name, str) or name not in UNITS:
        raise UnknownArgumentError(str(name), UNITS, block=None, found="an environment has no").at(port=port)
    return name


def check_properties(held: Mapping[str, Any], vary: str) -> dict[str, float]:
    """Return the properties of an environment that are held, as numbers."""
    check_property(vary, "vary")
    for name, value in held.items():
        check_property(name, str(name))
        if name == vary:
            raise OptionError(
                f"found it among the held properties, as {value!r}; expected it only as the one that varies. Leave it "
                "out.",
                port=name,
            )
        kind = A_PROPERTY.worded(f"one finite number in {UNITS[name]} that is not negative", "Give one.")
        check_argument(value, kind, name, "environment", ParameterError)
    return {name: float(value) for name, value in held.items()}

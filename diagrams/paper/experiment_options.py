"""Options of the experiments: their defaults, and the checks of what is given."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from fractions import Fraction
from numbers import Real
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks import Ellipse, OptionError, Path
from ...blocks.core import FINEST, SampleTimeError, near
from ..wiring import exact_time

ELLIPSE = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
"""The path of the experiments, equation (16)."""

DEFAULTS: Mapping[str, Any] = MappingProxyType(
    {
        "plant": None,
        "path": ELLIPSE,
        "sample_time": 1e-3,
        "coulomb_scale": 1.0,
        "viscous_scale": 1.0,
        "friction_width": 0.01,
        "tool_mass": 0.0,
        "encoder": 0.0,
        "delay": 0,
        "motor_force_limit": None,
        "velocity_limit": None,
        "acceleration_limit": None,
        "admittance_method": "exact",
    }
)
"""Options of every experiment, with their defaults.

``plant``: path of an FMU, or an `Fmu`, in place of the gantry. ``coulomb_scale``, ``viscous_scale``: factors on the
plant's friction only. ``friction_width``: w of plant and model, m/s. A plant of one's own keeps its values of these
three unless they are given. ``tool_mass``: kg beyond the force sensor. ``encoder``: quantum in m. ``delay``: 0 or 1
samples. ``motor_force_limit``: N, a number or one for each axis. ``velocity_limit``, ``acceleration_limit``: of the
path reference, m/s and m/s², a number or one for each direction (∥, ⊥); experiments with admittance only. In a pair of
limits None (or infinity) is no limit. ``sample_time``: s, a number or a `Fraction` that divides the experiment's
duration. ``admittance_method``: ``exact`` or ``semi_implicit``.
"""

_NOT_NEGATIVE = ("a number that is not negative", lambda value: is_number(value) and value >= 0, float)
KINDS: Mapping[str, tuple[str, Callable[[Any], bool], Callable[[Any], Any]]] = {
    "friction_width": ("a positive number", lambda value: is_number(value) and value > 0, float),
    **dict.fromkeys(("coulomb_scale", "viscous_scale", "tool_mass", "encoder"), _NOT_NEGATIVE),
    "delay": ("0 or 1 samples", lambda value: is_number(value) and value in (0, 1), int),
    "admittance_method": (
        "'exact' or 'semi_implicit'",
        lambda value: isinstance(value, str) and value in ("exact", "semi_implicit"),
        str,
    ),
    "path": ("a path, such as Ellipse(…)", lambda value: isinstance(value, Path), lambda value: value),
}
"""Options that are conditions on one value: what is expected, whether a value is that, and the form it takes."""
LIMITS = ("motor_force_limit", "velocity_limit", "acceleration_limit")


def merge(letter: str, duration: float, given: Mapping[str, Any], **own: Any) -> dict[str, Any]:
    """Merge what is given with the defaults; check it, and bring numbers into one form.

    The sample time divides the duration in s. ``own`` are options of this experiment alone, True or False.
    """
    known = {**DEFAULTS, **own}
    for name in given:
        if name not in known:
            raise OptionError(f"experiment {letter} has no option {name!r}. {near(name, known)}", port=name)
    options = {**known, **given}

    def refuse(name: str, expected: str) -> OptionError:
        return OptionError(f"found {options[name]!r}; expected {expected}.", block=f"experiment {letter}", port=name)

    for name in own:
        if not isinstance(options[name], bool | np.bool_):
            raise refuse(name, "True or False")
        options[name] = bool(options[name])
    for name, (expected, holds, made) in KINDS.items():
        if not holds(options[name]):
            raise refuse(name, expected)
        options[name] = made(options[name])
    for name in LIMITS:
        options[name] = _limit(options[name], lambda expected, name=name: refuse(name, expected))
    if isinstance(options["plant"], str | os.PathLike) and os.path.isdir(os.path.expanduser(options["plant"])):
        raise OptionError(
            f"{str(options['plant'])!r} is a folder; expected an FMU, a file that ends in .fmu. Name the file.",
            block=f"experiment {letter}",
            port="plant",
        )
    options["sample_time"] = _sample_time(options["sample_time"], duration, refuse)
    return options


def is_number(value: Any) -> bool:
    """Whether it is a finite real number, and no truth value."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def _limit(value: Any, refuse: Any) -> float | tuple[float | None, ...] | None:
    """Return a limit as None, a number, or a pair whose entries are None where there is no limit."""

    def entry(item: Any) -> float | None:
        if item is None or (isinstance(item, Real) and item == math.inf):
            return None
        if not is_number(item) or item <= 0:
            raise refuse("a positive number, a pair of them, or None (in a pair, too, None is no limit)")
        return float(item)

    if not isinstance(value, list | tuple | np.ndarray) or (isinstance(value, np.ndarray) and not value.ndim):
        return entry(value.item() if isinstance(value, np.ndarray) else value)
    if len(value) not in (1, 2):
        entry(value)  # refuses it
    pair = tuple(entry(item) for item in value) * (2 // len(value))
    return None if pair == (None, None) else pair


def _sample_time(value: Any, duration: float, refuse: Any) -> float:
    """Return the sample time in s, after checking that it divides the duration."""
    if not is_number(value) or value <= 0:
        raise refuse("sample_time", "a positive number")
    span = exact_time(duration)
    try:
        time = exact_time(value)
    except SampleTimeError:
        time = Fraction(float(value))  # finer than the clock's base of 1 ns
    if (time / FINEST).denominator == 1 and (span / time).denominator == 1:
        return float(time)
    below, above = _divisors_near(time, span)
    fits = " or ".join(f"{float(t):.9g}" for t in (below, above) if t is not None)
    raise refuse(
        "sample_time",
        f"a whole number of nanoseconds of which a whole number make the experiment's {duration:g} s, such as {fits}",
    )


def _divisors_near(time: Fraction, span: Fraction) -> tuple[Fraction | None, Fraction | None]:
    """Return the largest part of ``span`` that is not above ``time``, and the smallest one that is not below it."""
    total = int(span / FINEST)
    small = [n for n in range(1, math.isqrt(total) + 1) if total % n == 0]
    parts = sorted({*small, *(total // n for n in small)})
    wanted = time / FINEST
    below = [n for n in parts if n <= wanted]
    above = [n for n in parts if n >= wanted]
    return (below[-1] * FINEST if below else None), (above[0] * FINEST if above else None)

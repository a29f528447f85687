"""Options of the experiments: their defaults, and the checks of what is given."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks import Ellipse, OptionError, Path
from ...blocks.core import FINEST, Kind, SampleTimeError, check_argument, kinds, near
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

_POSITIVE = kinds.positive.worded(found=kinds.as_written)
_NOT_NEGATIVE = kinds.finite.where(lambda value: value >= 0).worded(
    "a number that is not negative", found=kinds.as_written
)
_FLAG = kinds.flag.worded(found=kinds.as_written)


def _is_limit(value: Any) -> bool:
    """Whether a value is a limit: None or infinity for none, a positive number, or one or two of these in a list."""
    entries = np.array(value, dtype=object)
    some = entries.ndim == 0 or entries.shape in ((1,), (2,))
    return some and all(v is None or v == math.inf or _POSITIVE.holds(v) for v in np.ravel(entries))


def _to_limit(value: Any) -> float | tuple[float | None, ...] | None:
    """Return a limit as None, a number, or a pair whose entries are None where there is no limit."""
    entries = [None if v is None or v == math.inf else float(v) for v in np.ravel(np.array(value, dtype=object))]
    if np.ndim(np.array(value, dtype=object)) == 0:
        return entries[0]
    pair = tuple(entries) * (2 // len(entries))
    return None if pair == (None, None) else pair


LIMITS = ("motor_force_limit", "velocity_limit", "acceleration_limit")
_LIMIT = Kind(
    "a positive number, a pair of them, or None (in a pair, too, None is no limit)", _is_limit, found=kinds.as_written
)
KINDS: Mapping[str, tuple[Kind, Callable[[Any], Any]]] = {
    "friction_width": (_POSITIVE, float),
    **dict.fromkeys(("coulomb_scale", "viscous_scale", "tool_mass", "encoder"), (_NOT_NEGATIVE, float)),
    "delay": (kinds.finite.where(lambda value: value in (0, 1)).worded("0 or 1 samples", found=kinds.as_written), int),
    "admittance_method": (kinds.choice("exact", "semi_implicit").worded(found=kinds.as_written), str),
    "path": (kinds.one_of_class(Path, "a path, such as Ellipse(…)").worded(found=kinds.as_written), lambda path: path),
    **dict.fromkeys(LIMITS, (_LIMIT, _to_limit)),
}
"""Kinds of the options that are conditions on one value, and the form that it takes."""


def merge(letter: str, duration: float, given: Mapping[str, Any], **own: Any) -> dict[str, Any]:
    """Merge what is given with the defaults; check it, and bring numbers into one form.

    The sample time divides the duration in s. ``own`` are options of this experiment alone, True or False.
    """
    known, who = {**DEFAULTS, **own}, f"experiment {letter}"
    for name in given:
        if name not in known:
            raise OptionError(f"experiment {letter} has no option {name!r}. {near(name, known)}", port=name)
    options = {**known, **given}
    for name, (kind, convert) in {**dict.fromkeys(own, (_FLAG, bool)), **KINDS}.items():
        check_argument(options[name], kind, name, who)
        options[name] = convert(options[name])
    if isinstance(options["plant"], str | os.PathLike) and os.path.isdir(os.path.expanduser(options["plant"])):
        raise OptionError(
            f"{str(options['plant'])!r} is a folder; expected an FMU, a file that ends in .fmu. Name the file.",
            block=who,
            port="plant",
        )
    options["sample_time"] = _sample_time(options["sample_time"], duration, who)
    return options


def _sample_time(value: Any, duration: float, who: str) -> float:
    """Return the sample time in s, after checking that it divides the duration."""
    check_argument(value, _POSITIVE, "sample_time", who)
    span = exact_time(duration)
    try:
        time = exact_time(value)
    except SampleTimeError:
        time = Fraction(float(value))  # finer than the clock's base of 1 ns
    if (time / FINEST).denominator == 1 and (span / time).denominator == 1:
        return float(time)
    below, above = _divisors_near(time, span)
    fits = " or ".join(f"{float(t):.9g}" for t in (below, above) if t is not None)
    raise OptionError(
        f"found {value!r}; expected a whole number of nanoseconds of which a whole number make the experiment's "
        f"{duration:g} s, such as {fits}.",
        block=who,
        port="sample_time",
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

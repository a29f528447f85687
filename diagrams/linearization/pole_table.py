"""The table of a linear model's poles, with frequency and damping."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Iterator

from ..frequency import order_key

REAL = 1e-4
"""Imaginary part, relative to the pole, below which it is shown as real. Of a multiple pole it is rounding alone."""


def pole_rows(poles: Iterable[complex], T: float) -> Iterator[tuple[object, ...]]:
    """Yield a row for each real pole and for each pair, with its frequency and damping in continuous time."""
    found = [complex(p) for p in poles]
    found = [p if abs(p.imag) > REAL * abs(p) else complex(p.real, 0.0) for p in found if p.imag >= -REAL * abs(p)]
    for p in sorted(found, key=lambda p: (-order_key(abs(p)), order_key(p.real))):
        s = p if not T else cmath.log(p) / T if p else None
        turns = s is not None and abs(s) > 0.0 and math.isfinite(abs(s))
        text = f"{p.real + 0.0:.4g} ± {p.imag:.4g}j" if p.imag else f"{p.real + 0.0:.4g}"
        speed = () if s is None or not turns else (float(f"{abs(s):.4g}"), float(f"{-s.real / abs(s) + 0.0:.4g}"))
        yield text, *(speed or (None, None)), *((float(f"{abs(p):.6g}"),) if T else ())

"""Wires at which one and the same loop is cut: their numbers agree, so that its figures are drawn once."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..frequency import Number

SAME = 1e-6
"""Relative difference of two numbers up to which they are those of one loop: far above rounding, far below what a
figure shows."""


def find_same(loops: Mapping[str, Mapping[str, Number]]) -> dict[str, str]:
    """Return the keys of loops that another one shows, with that one's key.

    ``loops`` has the numbers of each loop by its key, by paths that name the variant: a loop is shown by one that has
    the same numbers, and may have those of further variants.
    """
    ranked = sorted((key for key in loops if loops[key]), key=lambda key: -len(loops[key]))  # ties in their order
    shown: dict[str, str] = {}
    for i, key in enumerate(ranked):
        others = (other for other in ranked[:i] if other not in shown)
        found = next((other for other in others if _contains(loops[other], loops[key])), None)
        if found is not None:
            shown[key] = found
    return shown


def _contains(whole: Mapping[str, Number], part: Mapping[str, Number]) -> bool:
    return all(path in whole and is_same(whole[path].value, number.value) for path, number in part.items())


def is_same(a: float, b: float) -> bool:
    """Whether two numbers are those of one loop."""
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=SAME)

"""C code over vectors for the continuous states of a diagram: one step of a fixed length from tick to tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

from ...blocks.core import left_of
from .scalar_calls import ScalarFunctions

METHODS: Mapping[str, str] = {
    "euler": "EACH_RATE next[where[i]] = x[where[i]] + h * k1[i];",
    "heun": """
    RATES(to, EACH_RATE stage[where[i]] = x[where[i]] + h * k1[i], k2)
    EACH_RATE next[where[i]] = x[where[i]] + (0.5 * h) * (k1[i] + k2[i]);""",
    "rk4": """
    RATES(middle, EACH_RATE stage[where[i]] = x[where[i]] + (0.5 * h) * k1[i], k2)
    RATES(middle, EACH_RATE stage[where[i]] = x[where[i]] + (0.5 * h) * k2[i], k3)
    RATES(to, EACH_RATE stage[where[i]] = x[where[i]] + h * k3[i], k4)
    EACH_RATE next[where[i]] = x[where[i]] + (h / 6.0) * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);""",
}
"""Methods of fixed step, as in compiled/methods.c."""

_TEXT = Template("""
/* A step of the continuous states from tick to tick. Its end is seen from the left, as in problem.c: a source that
   jumps there still has its value from before. */
static inline void step_states(double from, double end, vec *x, const vec *w, const vec *p, const vec *kept) {
    static const int where[] = {$where};
    vec k1[$n], k2[$n], k3[$n], k4[$n], stage[N_X], next[N_X], t[1];
    const double h = end - from;
    const vec first = splat(from), middle = splat(from + 0.5 * h);
    const vec to = splat(fmax(from, end - $left * fabs(end)));
#define EACH_RATE for (int i = 0; i < $n; i++)
#define RATES(at, set, into) set; t[0] = at; flow(t, stage, w, p, kept, into);
    (void)k2, (void)k3, (void)k4, (void)to, (void)middle;
    memcpy(stage, x, sizeof stage);
    memcpy(next, x, sizeof next);
    RATES(first, , k1)
    $method
    memcpy(x, next, sizeof next);
}
""")


@dataclass(frozen=True, eq=False)
class FlowSource:
    """The rates of a diagram's continuous states, and the method that integrates them.

    Attributes
    ----------
    rates : casadi.Function
        ``(t, x, w, p) -> dx``.
    where : sequence of int
        Entries of x that they belong to.
    method : str
        One of `METHODS`.
    """

    rates: Any
    where: Sequence[int]
    method: str


def write_flow(source: FlowSource, scalars: ScalarFunctions) -> tuple[str, int]:
    """Write the C code of a step; return it with the number of vectors that are kept.

    Raises
    ------
    NoLanesError
        For an operation that has no form over vectors.
    """
    code = scalars.write_calls("flow", source.rates, ("t", "x", "w", "p"), {3})
    where = ", ".join(map(str, source.where))
    step = _TEXT.substitute(
        where=where, n=len(source.where), method=METHODS[source.method], left=(1.0 - left_of(1.0)).hex()
    )
    return code.text + step, code.kept

"""C code over vectors for the continuous states of a diagram: one step of a fixed length from tick to tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

from ...blocks.core import left_of
from ..solvers import METHODS
from .vector_code import ScalarFunctions, write_methods

_RATES = Template("""
typedef struct { const vec *x, *w, *p, *kept; } states;

/* The rates of the continuous states y, which are among all states. */
INLINE int flow_rate(const states *e, double at, const vec *y, vec *f) {
    static const int where[] = {$where};
    vec t[1] = {splat(at)}, all[N_X];
    memcpy(all, e->x, sizeof all);
    for (int i = 0; i < $n; i++) all[where[i]] = y[i];
    flow(t, all, e->w, e->p, e->kept, f);
    return 0;
}
""")
_STEP = Template("""
/* A step of the continuous states from tick to tick. Its end is seen from the left, as in problem.c: a source that
   jumps there still has its value from before. */
static inline void step_states(double from, double end, vec *x, const vec *w, const vec *p, const vec *kept) {
    static const int where[] = {$where};
    const states e = {x, w, p, kept};
    vec k1[$n], K[$rows], stage[$n], now[$n];
    const double h = end - from, to = fmax(from, end - $left * fabs(end));
    for (int i = 0; i < $n; i++) now[i] = x[where[i]];
    flow_rate(&e, from, now, k1);
    flow_lw_fixed(&e, $n, $stages, from, h, to, now, k1, K, stage, now);
    for (int i = 0; i < $n; i++) x[where[i]] = now[i];
}
""")


@dataclass(frozen=True, eq=False)
class FlowSource:
    """The rates of a diagram's continuous states, and the method that integrates them."""

    rates: Any  # (t, x, w, p) -> dx
    where: Sequence[int]  # entries of x that they belong to
    method: str  # of fixed step


def write_flow(source: FlowSource, scalars: ScalarFunctions) -> tuple[str, int]:
    """Write the C code of a step; return it with the number of vectors that are kept."""
    code = scalars.write_calls("flow", source.rates, ("t", "x", "w", "p"), {3})
    n, stages = len(source.where), METHODS[source.method].stages
    sizes = {"where": ", ".join(map(str, source.where)), "n": str(n)}
    step = _STEP.substitute(sizes, stages=stages, rows=max(1, stages - 1) * n, left=(1.0 - left_of(1.0)).hex())
    return code.text + _RATES.substitute(sizes) + write_methods("flow", "const states") + step, code.kept

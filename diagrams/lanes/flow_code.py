"""C code over vectors for the continuous states of a diagram: one step of a fixed length from tick to tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

from ...blocks.core import left_of
from .methods import write_methods
from .scalar_calls import ScalarFunctions

METHODS: Mapping[str, str] = {
    "euler": "$n, h, now, k1, now",
    "heun": "&e, $n, h, to, now, k1, k2, stage, now",
    "rk4": "&e, $n, from, h, to, now, k1, k2, k3, k4, stage, now",
}
"""Methods of fixed step in fmus/runtime/fixed_step.c, with their arguments in `_TEXT`."""

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
    vec k1[$n], k2[$n], k3[$n], k4[$n], stage[$n], now[$n];
    const double h = end - from, to = fmax(from, end - $left * fabs(end));
    (void)k2, (void)k3, (void)k4, (void)stage, (void)to;
    for (int i = 0; i < $n; i++) now[i] = x[where[i]];
    flow_rate(&e, from, now, k1);
    flow_lw_$method($arguments);
    for (int i = 0; i < $n; i++) x[where[i]] = now[i];
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
    sizes = {"where": ", ".join(map(str, source.where)), "n": str(len(source.where))}
    step = _STEP.substitute(
        sizes,
        method=source.method,
        arguments=Template(METHODS[source.method]).substitute(sizes),
        left=(1.0 - left_of(1.0)).hex(),
    )
    return code.text + _RATES.substitute(sizes) + write_methods("flow", "const states") + step, code.kept

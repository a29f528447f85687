"""C code over vectors of the algebraic loops at a tick: Newton's method, in which each lane goes its own way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

import casadi as ca

from ..compiled import NewtonOptions
from .vector_code import ScalarFunctions

_TEXT = Template("""
/* Solve the loops of a tick from the values in x on, where a run is alive; return where they are not solved. */
static mask ${name}(const vec *t, vec *x, const vec *w, const vec *p, const vec *kept, mask alive) {
    static const int64_t where[] = {$where};
    vec r[$n], J[$n * $n], v[$n], direction[$n];
    mask going = alive, bad = {0};
    for (int i = 0; i < $n; i++) v[i] = x[where[i]];
#define EVALUATE_LOOPS ${name}_equations(t, x, w, p, kept, r, J)
#define SMALL(bound) (largest_of(r, $n) / (1.0 + largest_of(v, $n)) <= (bound))
    EVALUATE_LOOPS;
    bad |= going & ~(finite_of(r, $n) & finite_of(J, $n * $n));
    going &= ~bad;
    vec size = length_of(r, $n);
    for (int k = 0; k < $iterations; k++) {
        going &= ~SMALL($rounding);
        if (!any(going)) break;
        bad |= going & ~newton_direction($n, J, r, direction, going);
        going &= ~bad;
        vec best = splat(0.0), step = splat(1.0);
        mask trying = going;
        for (int j = 0; j < $halvings && any(trying); j++) {
            for (int i = 0; i < $n; i++) x[where[i]] = choose(trying, v[i] - step * direction[i], x[where[i]]);
            EVALUATE_LOOPS;
            bad |= trying & ~(finite_of(r, $n) & finite_of(J, $n * $n));
            going &= ~bad;
            trying &= ~bad;
            const vec now = length_of(r, $n);
            const mask better = trying & (now < size);
            const mask over = trying & ~better & (best != 0.0);
            best = choose(better, step, best);
            size = choose(better, now, size);
            trying &= ~(over | (best == 1.0));
            step = choose(trying, step * 0.5, step);
        }
        const mask back = going & (best != step); /* the best step was not the last one */
        for (int i = 0; i < $n; i++) x[where[i]] = choose(back, v[i] - best * direction[i], x[where[i]]);
        if (any(back)) EVALUATE_LOOPS;
        going &= best != 0.0;
        for (int i = 0; i < $n; i++) v[i] = choose(going, x[where[i]], v[i]);
    }
    for (int i = 0; i < $n; i++) v[i] = x[where[i]];
    return alive & (bad | ~SMALL($tolerance) | ~are_determined($n, $singular, J, alive));
#undef EVALUATE_LOOPS
#undef SMALL
}
""")


@dataclass(frozen=True, eq=False)
class LoopSource:
    """The algebraic loops at a tick."""

    equations: Any  # (t, x, w, p) -> (r, J): the mismatch at the values in x, and its derivative
    options: NewtonOptions


def write_loops(name: str, source: LoopSource, arguments: Sequence[str], scalars: ScalarFunctions) -> tuple[str, int]:
    """Write the C code of ``NAME(t, x, w, p, kept, alive)``; return it with the number of vectors that are kept."""
    f, options = source.equations, source.options
    symbols = f.sx_in() if f.is_a("SXFunction") else f.mx_in()
    r, slopes = f.call(symbols)
    columns = ca.Function("equations", symbols, [ca.densify(r), ca.vec(ca.densify(slopes))])
    code = scalars.write_calls(f"{name}_equations", columns, arguments, {3})
    n = len(options.where)
    text = _TEXT.substitute(
        name=name,
        n=n,
        where=", ".join(map(str, options.where)),
        iterations=options.iterations,
        halvings=options.halvings,
        rounding=options.rounding.hex(),
        tolerance=options.tolerance.hex(),
        singular=options.singular.hex(),
    )
    return f"{code.text}\n{text}", code.kept

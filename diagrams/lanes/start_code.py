"""C code over vectors for the start of runs: the tick with which they begin, and what is computed before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..flat import TickPattern
from .lane_plants import LanePlant
from .lane_ticks import TickSources
from .vector_code import ScalarFunctions

_START = ("x", "w", "p", "left")
_FIRST_TICK = """
/* The tick with which a run begins. */
VISIBLE void loopwright_first_tick(const vec *x, const vec *w, const vec *p, vec *x_next, vec *z, vec *log, vec *ok,
                                   vec *kept) {{
    vec t[1] = {{splat(0.0)}};
    first_tick_prepare(p, kept);
    first_tick(t, x, w, p, kept, x_next, z, log, ok);
}}

/* Outputs of the FMUs before it, with the inputs in z; without z with those at hand. */
VISIBLE void loopwright_first_outputs(vec *plant, const vec *z, vec *w) {{
    {plants}
}}
"""
_VALUES = """
VISIBLE void loopwright_start{i}(const vec *x, const vec *w, const vec *p, const vec *left, vec *out) {{
    vec kept[AT_LEAST_1({kept})];
    start{i}_prepare(kept);
    start{i}(x, w, p, left, kept, out);
}}
"""


@dataclass(frozen=True, eq=False)
class StartSource:
    """Functions from which runs start."""

    clocks: frozenset[TickPattern]  # that act at the tick with which they begin
    values: Sequence[Any]  # each (x, w, p, left) -> columns
    key: Any  # equal keys, equal functions of one diagram


def write_start(
    source: StartSource, plants: Sequence[LanePlant], ticks: TickSources, scalars: ScalarFunctions
) -> tuple[str, int]:
    """Write the C code, which comes after that of the FMUs; return it with the vectors that the first tick needs."""
    tick = ticks.write("first_tick", source.clocks)
    looks, at = list[str](), 0
    for i, plant in enumerate(plants):
        place = f"plant + {at}"
        looks.append(
            f"{{ plant{i} of; plant{i}_begin(&of, {place}); plant{i}_look(&of, z, w); plant{i}_end(&of, {place}); }}"
        )
        at += plant.width
    parts = [tick.text, _FIRST_TICK.format(plants=" ".join(looks))]
    for i, function in enumerate(source.values):
        is_scalar = function.is_a("SXFunction")
        symbols = function.sx_in() if is_scalar else function.mx_in()
        kind: Any = ca.SX if is_scalar else ca.MX
        joined = ca.vertcat(kind(0, 1), *(ca.densify(column) for column in function.call(symbols)))
        joined = ca.cse(joined) if is_scalar else joined
        code = scalars.write_calls(f"start{i}", ca.Function("start", symbols, [joined]), _START, ())
        parts += [code.text, _VALUES.format(i=i, kept=code.kept)]
    return "".join(parts), tick.kept

"""C code over vectors for the start of runs: the tick with which they begin, and what is computed before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from .lane_plants import LanePlant
from .vector_code import write_vectors

_TICK, _START = ("t", "x", "w", "p"), ("x", "w", "p", "left")
_FIRST_TICK = """
/* The tick with which a run begins. */
VISIBLE void loopwright_first_tick(const vec *x, const vec *w, const vec *p, vec *x_next, vec *z, vec *log, vec *ok) {{
    vec t[1] = {{splat(0.0)}}, kept[AT_LEAST_1({kept})];
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
    """Functions from which runs start.

    Attributes
    ----------
    tick : casadi.Function
        ``(t, x, w, p) -> (x_next, z, log, ok)`` of the tick with which they begin, of scalar operations.
    values : sequence of casadi.Function
        Each ``(x, w, p, left) -> columns``, of scalar operations.
    key : object
        Equal keys, equal functions of one diagram.
    """

    tick: Any
    values: Sequence[Any]
    key: Any


def write_start(source: StartSource, plants: Sequence[LanePlant]) -> str:
    """Write the C code; it stands behind that of the FMUs, ``plant0`` and so on.

    Raises
    ------
    NoLanesError
        For an operation that has no form over vectors.
    """
    tick = write_vectors("first_tick", source.tick, _TICK, {3})
    looks, at = list[str](), 0
    for i, plant in enumerate(plants):
        place = f"plant + {at}"
        looks.append(
            f"{{ plant{i} of; plant{i}_begin(&of, {place}); plant{i}_look(&of, z, w); plant{i}_end(&of, {place}); }}"
        )
        at += plant.width
    parts = [tick.text, _FIRST_TICK.format(kept=tick.kept, plants=" ".join(looks))]
    for i, function in enumerate(source.values):
        symbols = function.sx_in()
        columns = [ca.densify(column) for column in function.call(symbols)]
        joined = ca.Function("start", symbols, [ca.cse(ca.vertcat(ca.SX(0, 1), *columns))])
        code = write_vectors(f"start{i}", joined, _START, ())
        parts += [code.text, _VALUES.format(i=i, kept=code.kept)]
    return "".join(parts)

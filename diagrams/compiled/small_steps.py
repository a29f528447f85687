"""C code of steps for one small differential equation: its rates are inlined into every stage of a method."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from ...fmus.runtime import read_sources
from ..flat import share_terms
from .generated_text import write_functions
from .method_coefficients import error_exponent, tableau

STEPS = {"rk4": "step_rk4", "RK23": "step_rk23", "RK45": "step_rk45"}
"""Names of the C functions, by method."""
_MOST_STATES, _MOST_OPERATIONS = 8, 120
_CASADI = re.compile(r"\b(_?(?:casadi|CASADI)_)")


def write_steps(rates: Any, where: Sequence[int]) -> str:
    """Return the C code of steps for rates by (t, x, w, p); empty where they are too large to be inlined."""
    n = len(where)
    if not (0 < n <= _MOST_STATES and rates.is_a("SXFunction") and rates.n_instructions() <= _MOST_OPERATIONS):
        return ""
    text = write_functions("rates", [share_terms(rates, "rates")]).replace(
        "static int casadi_f0(", "INLINE int casadi_f0("
    )
    numbers = f"#define N {n}\n#define WIDTH {rates.numel_in(1)}\n#define PLACES {', '.join(map(str, where))}\n"
    numbers += "#define INLINE static inline __attribute__((always_inline))\n"
    named = _CASADI.sub(r"of_\1", text) + "#define RATES(a, r) of_casadi_f0(a, r, NULL, NULL, 0)\n"
    return "\n".join([read_sources("newton.c", "problem.c"), numbers, named, read_sources("small.c"), _embedded()])


@lru_cache(maxsize=1)
def _embedded() -> str:
    """Return the steps of embedded methods, with the coefficients of SciPy's methods."""
    return "".join(map(_write_embedded, ("RK23", "RK45")))


def _write_embedded(name: str) -> str:
    found = tableau(name)
    texts = [
        f"    static const double {letter}[] = {{{', '.join(map(float.hex, found[letter].ravel().tolist()))}}};\n"
        for letter in "ABCE"
    ]
    numbers = f"{len(found['B'])}, A, B, C, E, NULL, {float(error_exponent(name))}"
    call = f"    return step_small(m, &(lw_tableau){{{numbers}}});\n"
    return f"\nVISIBLE int {STEPS[name]}(method *m) {{\n" + "".join(texts) + call + "}\n"

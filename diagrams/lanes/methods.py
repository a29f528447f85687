"""Methods of fixed step over vectors: the text that runs and exported FMUs use, with vectors as its numbers."""

from __future__ import annotations

import re

from ...fmus.runtime import read_sources


def write_methods(name: str, equation: str) -> str:
    """Write ``NAME_lw_rk4`` and so on, for the C type of an equation, behind its rates ``NAME_rate(e, t, x, f)``."""
    needs = {"EQUATION": equation, "NUMBER": "vec", "RATE": f"{name}_rate", "INLINE": "INLINE"}
    text = "".join(f"#define LW_{key} {value}\n" for key, value in needs.items())
    return re.sub(r"\b(lw|LW)_", rf"{name}_\1_", f"{text}{read_sources('fixed_step.c')}\n")

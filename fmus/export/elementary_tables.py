"""Tables of the elementary functions in exported FMUs, computed in decimal arithmetic: no platform's function is asked.

The functions themselves are in ``fmu_sources/elementary.c``, those of single precision in
``fmu_sources/elementary_single.c``. The equations of a generated ``model.c`` call them under their own names, so that
an FMU computes the same bits on every platform.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from decimal import Context, Decimal, localcontext
from functools import lru_cache
from importlib import resources
from math import factorial, frexp, ldexp

import numpy as np

from .c_text import c_array

FUNCTIONS = ("sin", "cos", "tanh", "exp", "expm1", "log", "pow")
"""The functions that are our own; others (such as atan2) are the platform's."""
SINGLE_FUNCTIONS = (*FUNCTIONS, "floor", "ceil", "fmin", "fmax")
"""Those of single precision: with what a processor for it has no instruction for."""
_NODES = 306  # of tanh, up to which it differs from 1
_DIGITS = 60
_PER_LINE = 6


def read_fmu_source(name: str) -> str:
    """Return the text of a C file of ``fmu_sources/``."""
    return (resources.files(__package__) / "fmu_sources" / name).read_text(encoding="utf-8")


def prepare_functions(equations: str) -> str:
    """Return the C text that goes before equations: the tables of the functions that they call, and their names.

    Returns: empty if it calls none of `FUNCTIONS`. After the text, ``sin`` is ``lw_sin`` and so on; `restore_functions`
    ends that.
    """
    called = [name for name in FUNCTIONS if re.search(rf"\b{name}\(", equations)]
    if not called:
        return ""
    needs = [f"#define LW_NEEDS_{name.upper()} 1\n" for name in called]
    names = [f"#define {name} lw_{name}\n" for name in called]
    tables = dict.fromkeys(table for name in called for table in _OF[name])
    with localcontext(Context(prec=_DIGITS)):
        texts = [_TABLES[table]() for table in tables]
    return "".join(["#include <stdint.h>\n", *needs, *texts, '#include "elementary.c"\n', *names])


def restore_functions() -> str:
    """Return the C text that goes after the equations: the names of math.h are its own again."""
    return "".join(f"#undef {name}\n" for name in FUNCTIONS)


def prepare_single(called: Iterable[str]) -> str:
    """Return the C text that goes before functions of single precision: their tables, and which are called.

    ``called``: of `SINGLE_FUNCTIONS`. ``sin`` is ``lw_sinf`` in C, and so on.
    """
    needs = [f"#define LW_NEEDS_{name.upper()}_SINGLE 1\n" for name in called]
    tables = dict.fromkeys(table for name in called for table in _OF_SINGLE.get(name, ()))
    with localcontext(Context(prec=_DIGITS)):
        texts = [_SINGLE_TABLES[table]() for table in tables]
    return "".join([*needs, *texts, '#include "elementary_single.c"\n'])


def _write_single(value: Decimal) -> str:
    """Return the float nearest to a value as C text; the shortest that reads as this float."""
    nearest = np.float32(float(value))  # rounded twice: the values here are not so near to a middle
    return f"{np.format_float_scientific(nearest, unique=True, trim='0')}f"


def _single_array(name: str, values: Iterable[Decimal]) -> str:
    return c_array("float", f"{name}_single", map(_write_single, values), per_line=_PER_LINE)


def _single_constants(**values: Decimal) -> str:
    return "".join(f"#define LW_{name.upper()}_SINGLE {_write_single(value)}\n" for name, value in values.items())


def _write(value: Decimal) -> str:
    """Return the double nearest to a value as C text, exactly."""
    return float(value).hex()  # float() of a decimal rounds correctly


def _array(name: str, values: Iterable[Decimal], of: str = "double") -> str:
    texts = (_write(v) if of == "double" else f"0x{int(v):08x}u" for v in values)
    return c_array(of, name, texts, per_line=_PER_LINE)


def _constants(**values: Decimal) -> str:
    return "".join(f"#define LW_{name.upper()} {_write(value)}\n" for name, value in values.items())


def _upper(value: Decimal, bits: int) -> Decimal:
    """Return a value cut to so many bits."""
    fraction, exponent = frexp(float(value))
    unit = Decimal(2) ** (exponent - bits)
    return (value / unit).to_integral_value(rounding="ROUND_DOWN") * unit if fraction else Decimal(0)


def _split(value: Decimal, *bits: int) -> list[Decimal]:
    """Return parts of a value: each cut to so many bits of what is left, then the rest."""
    parts = []
    for count in bits:
        parts.append(_upper(value, count))
        value -= parts[-1]
    return [*parts, value]


@lru_cache(maxsize=1)
def _pi(digits: int) -> Decimal:
    """Return π by Machin's formula, 16 arctan(1/5) - 4 arctan(1/239)."""
    one = 10 ** (digits + 10)

    def arctan_of_inverse(n: int) -> int:
        term, total, k = one // n, 0, 0
        while term:
            total += (term if k % 2 == 0 else -term) // (2 * k + 1)
            term, k = term // (n * n), k + 1
        return total

    return Decimal(16 * arctan_of_inverse(5) - 4 * arctan_of_inverse(239)).scaleb(-(digits + 10))


def _tanh_tables() -> str:
    """Return the series about 0, and for each point i/16 tanh in two parts, -tanh² and the other coefficients."""
    tangents = [Decimal(1)]  # of tanh x = Σ c_k x^(2k+1): its derivative is 1 - tanh², term by term
    for k in range(1, 9):
        tangents.append(-sum((tangents[i] * tangents[k - 1 - i] for i in range(k)), Decimal(0)) / (2 * k + 1))
    rows: list[Decimal] = []
    for i in range(_NODES):
        growth = (Decimal(i) / 8).exp()
        c = [(growth - 1) / (growth + 1)]
        for k in range(10):
            square = sum((c[j] * c[k - j] for j in range(k + 1)), Decimal(0))
            c.append(((1 if k == 0 else 0) - square) / (k + 1))
        nearest = Decimal(float(c[0]))
        rows += [nearest, c[0] - nearest, c[1] - 1, *c[2:]]
    end = _constants(tanh_end=Decimal(2 * _NODES - 1) / 32)
    return end + _array("lw_tanh_series", tangents[1:]) + _array("lw_tanh_table", rows)


def _exp_tables() -> str:
    """Return ln 2/128 in two parts, and 2^(i/128) as a double with the rest, relative to it."""
    step = Decimal(2).ln() / 128
    high, low = _split(step, 35)
    rows: list[Decimal] = []
    for i in range(128):
        exact = (step * i).exp()
        nearest = Decimal(float(exact))
        rows += [nearest, exact / nearest - 1]
    return _constants(ln2_hi=high, ln2_lo=low) + _array("lw_exp_table", rows)


def _expm1_tables() -> str:
    return _array("lw_expm1_series", (1 / Decimal(factorial(k)) for k in range(3, 12)))


def _log_tables() -> str:
    """Return ln 2 in two parts; for each of 128 intervals of m an inverse of 10 bits, and -ln of it in two parts."""
    high, low = _split(Decimal(2).ln(), 32)
    offset = 0x3FE6B00000000000
    rows: list[Decimal] = []
    for i in range(128):
        ends = [_from_bits(offset + (j << 45)) for j in (i, i + 1)]  # m from about √½ to √2
        middle = (ends[0] + ends[1]) / 2
        inverse = Decimal(1) if ends[0] <= 1 <= ends[1] else (1024 / middle).to_integral_value() / 1024
        logarithm = -inverse.ln()
        first, rest = _split(logarithm, 42 + min(0, frexp(float(logarithm))[1])) if logarithm else [Decimal(0)] * 2
        rows += [inverse, first, rest]
    return _constants(log2_hi=high, log2_lo=low) + _array("lw_log_table", rows)


def _log_series() -> str:
    return _array("lw_log_series", (Decimal((-1) ** k) / -k for k in range(3, 11)))


def _from_bits(bits: int) -> Decimal:
    return Decimal(ldexp((bits & (1 << 52) - 1) + (1 << 52), (bits >> 52) - 1075))


def _circle_tables() -> str:
    """Return π/2 in parts, 2/π in words of 32 bits, and the series of sine and cosine."""
    with localcontext(Context(prec=420)):
        half = _pi(400) / 2
        words = (2 ** Decimal(32 * 40) / half).to_integral_value(rounding="ROUND_DOWN")
        bits = int(words)
    first, second, third, fourth = _split(half, 33, 33, 33)
    upper, lower = _split(half, 26)
    return (
        _constants(half_pi_1=first, half_pi_2=second, half_pi_3=third, half_pi_4=fourth, half_pi_second=half - first)
        + _constants(half_pi_upper=upper, half_pi_lower=lower)
        + _array("lw_two_over_pi", (Decimal(bits >> 32 * (39 - i) & 0xFFFFFFFF) for i in range(40)), "uint32_t")
        + _array("lw_sin_series", (Decimal((-1) ** k) / factorial(2 * k + 1) for k in range(1, 9)))
        + _array("lw_cos_series", (Decimal((-1) ** k) / factorial(2 * k) for k in range(2, 10)))
    )


_TABLES = {
    "circle": _circle_tables,
    "tanh": _tanh_tables,
    "exp": _exp_tables,
    "expm1": _expm1_tables,
    "log": _log_tables,
    "series": _log_series,
}
_OF = {
    "sin": ("circle",),
    "cos": ("circle",),
    "tanh": ("tanh",),
    "exp": ("exp",),
    "expm1": ("exp", "expm1"),
    "log": ("log", "series"),
    "pow": ("exp", "log"),
}


def _single_exp() -> str:
    """Return ln 2/16 in two parts, and 2^(i/16) as a float with the rest, relative to it."""
    step = Decimal(2).ln() / 16
    high, low = _split(step, 12)
    rows: list[Decimal] = []
    for i in range(16):
        exact = (step * i).exp()
        nearest = Decimal(float(np.float32(float(exact))))
        rows += [nearest, exact / nearest - 1]
    constants = _single_constants(inverse_step=1 / step, step_hi=high, step_lo=low, twenty_fourth=1 / Decimal(24))
    return constants + _single_array("lw_exp_table", rows)


def _single_log() -> str:
    """Return ln 2 in two parts; for each of 64 intervals of m an inverse of 9 bits, and -ln of it in two parts."""
    high, low = _split(Decimal(2).ln(), 15)
    rows: list[Decimal] = []
    for i in range(64):
        ends = [_from_single_bits(0x3F350000 + (j << 17)) for j in (i, i + 1)]  # m from about √½ to √2
        inverse = Decimal(1) if ends[0] <= 1 <= ends[1] else (512 / (ends[0] + ends[1])).to_integral_value() / 256
        logarithm = -inverse.ln()
        first, rest = _split(logarithm, 15 + min(0, frexp(float(logarithm))[1])) if logarithm else [Decimal(0)] * 2
        rows += [inverse, first, rest]
    return _single_constants(log2_hi=high, log2_lo=low) + _single_array("lw_log_table", rows)


def _from_single_bits(bits: int) -> Decimal:
    return Decimal(float(np.uint32(bits).view(np.float32)))


def _single_circle() -> str:
    """Return π/2 in two parts, 2/π in words of 32 bits behind one of zeros, and the series of sine and cosine."""
    with localcontext(Context(prec=120)):
        half = _pi(110) / 2
        bits = int((2 ** Decimal(32 * 7) / half).to_integral_value(rounding="ROUND_DOWN"))
    words = [0, *(bits >> 32 * (6 - i) & 0xFFFFFFFF for i in range(7))]
    upper, lower = _split(half, 12)
    table = ", ".join(f"0x{word:08x}u" for word in words)
    return (
        _single_constants(half_pi_upper=upper, half_pi_lower=lower)
        + f"static const uint32_t lw_two_over_pi_single[] = {{{table}}};\n"
        + _single_array("lw_sin_series", (Decimal((-1) ** k) / factorial(2 * k + 1) for k in range(1, 5)))
        + _single_array("lw_cos_series", (Decimal((-1) ** k) / factorial(2 * k) for k in range(2, 6)))
    )


_SINGLE_TABLES = {
    "third": lambda: _single_constants(third=1 / Decimal(3)),
    "circle": _single_circle,
    "exp": _single_exp,
    "expm1": lambda: _single_array("lw_expm1_series", (1 / Decimal(factorial(k)) for k in range(3, 8))),
    "tanh": lambda: _single_array(
        "lw_tanh_series", [Decimal(-1) / 3, Decimal(2) / 15, Decimal(-17) / 315, Decimal(62) / 2835]
    ),
    "log": _single_log,
}
_OF_SINGLE = {
    "sin": ("circle",),
    "cos": ("circle",),
    "tanh": ("third", "exp", "expm1", "tanh"),
    "exp": ("third", "exp"),
    "expm1": ("third", "exp", "expm1"),
    "log": ("third", "log"),
    "pow": ("third", "exp", "log"),
}

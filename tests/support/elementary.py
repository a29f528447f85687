"""The elementary functions of exported FMUs as a library of their own, and arguments for them."""

import math
from importlib import resources

import numpy as np

import loopwright.fmus.export as export
from loopwright.fmus.export.elementary_tables import (
    FUNCTIONS,
    SINGLE_FUNCTIONS,
    prepare_functions,
    prepare_single,
    restore_functions,
)

RUNTIME = resources.files(export) / "fmu_sources" / "elementary.c"
RUNTIME_SINGLE = resources.files(export) / "fmu_sources" / "elementary_single.c"
ONE_FUNCTION = """
#ifdef _WIN32
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
void many_{0}(const double *x, const double *z, double *y, long long n) {{
    (void)z;
    for (long long i = 0; i < n; i++) y[i] = lw_{0}(x[i]{1});
}}
"""


def source() -> str:
    text = prepare_functions(" ".join(f"{name}(x)" for name in FUNCTIONS)) + restore_functions()
    return text + "".join(ONE_FUNCTION.format(name, ", z[i]" if name == "pow" else "") for name in FUNCTIONS)


def source_single() -> str:
    """The functions of single precision, called in the same way."""
    text = "#include <stdint.h>\n" + prepare_single(SINGLE_FUNCTIONS)
    for name in SINGLE_FUNCTIONS:
        more = ", z[i]" if name in ("pow", "fmin", "fmax") else ""
        text += ONE_FUNCTION.format(name, more).replace("double", "float").replace(f"lw_{name}(", f"lw_{name}f(")
    return text


def signed(rng, sizes):
    return sizes * rng.choice([-1.0, 1.0], len(sizes))


def arguments(name, n, rng):
    """Yield arrays of arguments: the whole range, about 0 and 1, and where two of a function's forms meet."""
    if name in ("sin", "cos"):
        yield rng.uniform(-7, 7, n)
        yield signed(rng, 10 ** rng.uniform(-12, 6, n))
        yield signed(rng, 10 ** rng.uniform(6, 308, n))
        yield np.arange(1, n) * (math.pi / 2)  # as near to its zeros as doubles come
        yield signed(rng, rng.uniform(1599, 1601, n))
        yield signed(rng, 2.0**20 + rng.uniform(-1, 1, n))
    elif name == "tanh":
        yield signed(rng, 10 ** rng.uniform(-12, 1.4, n))
        yield signed(rng, rng.uniform(0.15, 0.25, n))
        yield rng.uniform(18.5, 19.5, n)
    elif name == "exp":
        yield rng.uniform(-690, 690, n)
        yield signed(rng, 10 ** rng.uniform(-18, 0, n))
    elif name == "expm1":
        yield rng.uniform(-45, 690, n)
        yield signed(rng, 10 ** rng.uniform(-18, 0, n))
        yield signed(rng, rng.uniform(0.15, 0.4, n))
    elif name == "log":
        yield 10 ** rng.uniform(-323, 308, n)
        yield 1 + signed(rng, 10 ** rng.uniform(-16, -1, n))
        yield rng.uniform(0.5, 2, n)


def powers(n, rng):
    """Yield pairs whose power is neither tiny nor near overflow."""
    for low, high in ((-12, -6), (-6, -2), (-2, -0.5)):
        x = 1 + signed(rng, 10 ** rng.uniform(low, high, n))
        yield x, rng.uniform(-690, 690, n) / np.log(x)
    x = 10 ** rng.uniform(-300, 300, n)
    yield x, rng.uniform(-1, 1, n)
    yield -np.floor(10 ** rng.uniform(0, 3, n)), np.floor(rng.uniform(-90, 90, n))

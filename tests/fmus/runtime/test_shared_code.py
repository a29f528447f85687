"""C that runs of diagrams, exported FMUs and vectors of runs share: standard C99, and right against other tools' numbers."""

import ctypes
import math
import zipfile

import numpy as np
import pytest
from numpy.ctypeslib import as_ctypes
from scipy.integrate import RK45

from loopwright.fmus import build_fmu
from loopwright.fmus.export import compile_shared
from loopwright.fmus.runtime import read_sources
from support.exported import bouncing_ball

SHARED = ("linear.c", "fixed_step.c", "embedded.c", "crossings.c")
UNIT = (
    """
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#if defined(_WIN32)
#define VISIBLE __declspec(dllexport)
#else
#define VISIBLE __attribute__((visibility("default")))
#endif

/* x'' = -x + t, as a vector of two. */
static int rate(int *calls, double t, const double *x, double *f) {
    f[0] = x[1];
    f[1] = t - x[0];
    return ++*calls < 0;
}
/* Indicator i is t^3 - i, for a negative i -t^3 - i. */
static double indicator(int *calls, int64_t i, double t, bool *lost) {
    (void)lost;
    ++*calls;
    return (i < 0 ? -t : t) * t * t - (double)i;
}
#define LW_EQUATION int
#define LW_NUMBER double
#define LW_RATE rate
#define LW_SEARCH int
#define LW_VALUE indicator
"""
    + "".join(f'#include "{name}"\n' for name in SHARED)
    + """
VISIBLE void fixed(int method, double t, double h, const double *x, double *out) {
    double k[8], y[2];
    int calls = 0;
    rate(&calls, t, x, k);
    if (method == 1) lw_euler(2, h, x, k, out);
    if (method == 2) lw_heun(&calls, 2, h, t + h, x, k, k + 2, y, out);
    if (method == 4) lw_rk4(&calls, 2, t, h, t + h, x, k, k + 2, k + 4, k + 6, y, out);
}
VISIBLE double embedded(const double *A, const double *B, const double *C, const double *E, double *t, double h,
                        double tolerance, double *x, double *next) {
    const lw_tableau numbers = {6, A, B, C, E, NULL, 4.0};
    const double absolute[2] = {tolerance, tolerance};
    const lw_tolerance allowed = {absolute, tolerance};
    lw_attempt step = {.t = *t, .stop = INFINITY, .h = h, .least = 0.0};
    double K[14], y[2], end[2];
    int calls = 0;
    rate(&calls, *t, x, K);
    if (!lw_take_step(&calls, 2, &numbers, &allowed, &step, x, K, y, end)) return NAN;
    memcpy(x, end, sizeof end);
    *t = step.to;
    *next = step.h * step.factor;
    return step.h;
}
VISIBLE bool solve(double *a, int64_t n, int64_t *pivots, double *b) {
    if (!lw_factor(a, pivots, n, 1)) return false;
    lw_solve(a, pivots, n, b);
    return true;
}
VISIBLE double leave(int64_t i, double low, double high, double a, double b, int *calls, bool *lost) {
    const double za = indicator(calls, i, a, lost), zb = indicator(calls, i, b, lost);
    return lw_leave(calls, i, low, high, a, za, b, zb, 0.0, lost);
}
VISIBLE bool is_finite(const double *x, int64_t n) { return lw_are_finite(x, n); }
"""
)
REAL = ctypes.c_double


@pytest.fixture(scope="module")
def code(tmp_path_factory):
    out = tmp_path_factory.mktemp("shared") / "code.so"
    files = {"code.c": UNIT, **{name: f"{read_sources(name)}\n" for name in SHARED}}
    strict = ("-std=c99", "-pedantic-errors", "-Wall", "-Werror", "-Wno-unused-function")
    compile_shared(files, out, compiled=["code.c"], more_flags=strict)
    library = ctypes.CDLL(str(out))
    library.embedded.restype = library.leave.restype = REAL
    library.solve.restype = library.is_finite.restype = ctypes.c_bool
    return library


def exact(t):
    """The solution from x = (1, 0) on, in closed form."""
    return np.array([math.cos(t) - math.sin(t) + t, -math.sin(t) - math.cos(t) + 1])


def at(values):
    return as_ctypes(values)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_steps_of_fixed_length_have_their_order(code, order):
    errors = []
    for n in (64, 128):
        x, h = np.array([1.0, 0.0]), 2.0 / n
        for k in range(n):
            code.fixed(order, REAL(k * h), REAL(h), at(x), at(x))
        errors.append(abs(x - exact(2.0)).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


def test_steps_of_an_embedded_method_are_those_of_scipy(code):
    A = np.zeros((6, 6))
    A[:, :5] = RK45.A
    theirs = RK45(lambda t, x: [x[1], t - x[0]], 0.0, [1.0, 0.0], np.inf, rtol=1e-6, atol=1e-6, first_step=1.5)
    x, t, h = np.array([1.0, 0.0]), np.zeros(1), np.array([1.5])
    for _ in range(20):
        theirs.step()
        code.embedded(*map(at, (A, RK45.B, RK45.C, RK45.E)), at(t), REAL(h[0]), REAL(1e-6), at(x), at(h))
        np.testing.assert_allclose([*x, t[0], h[0]], [*theirs.y, theirs.t, theirs.h_abs], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_linear_equations_are_solved(code, n):
    rng = np.random.default_rng(n)
    a, b = rng.normal(size=(n, n)), rng.normal(size=n)
    a[0, 0] = 0.0 if n > 1 else a[0, 0]  # rows have to be exchanged
    want = np.linalg.solve(a, b)
    assert code.solve(at(a.copy()), n, at(np.zeros(n, dtype=np.int64)), at(b))
    np.testing.assert_allclose(b, want, rtol=1e-12)


def test_a_singular_matrix_has_no_factors(code):
    assert not code.solve(at(np.ones((2, 2))), 2, at(np.zeros(2, dtype=np.int64)), at(np.ones(2)))


@pytest.mark.parametrize(("level", "low", "high"), [(2, -math.inf, 0.0), (5, -math.inf, 0.25), (-3, 5e-324, math.inf)])
def test_an_indicator_leaves_its_domain_where_it_crosses_the_border(code, level, low, high):
    calls, lost = ctypes.c_int(0), ctypes.c_bool(False)
    t = code.leave(level, REAL(low), REAL(high), REAL(0.0), REAL(3.0), ctypes.byref(calls), ctypes.byref(lost))
    assert t == pytest.approx((abs(level) + (high if level > 0 else 0.0)) ** (1 / 3), rel=8 * np.finfo(float).eps)
    assert not low <= math.copysign(t, level) * t * t - level <= high  # it is outside there, whatever rounding does
    assert calls.value < 25  # a bisection takes 50


@pytest.mark.parametrize("wrong", [math.inf, -math.inf, math.nan])
def test_numbers_that_are_none_are_found(code, wrong):
    values = np.array([1.0, -1e308, wrong, 0.0])
    assert code.is_finite(at(values), 2)
    assert not code.is_finite(at(values), 4)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_exported_fmu_is_compiled_from_the_shared_files(fmi):
    with zipfile.ZipFile(build_fmu(bouncing_ball(), fmi=fmi)) as archive:
        for name in SHARED:
            assert archive.read(f"sources/{name}").decode().rstrip() == read_sources(name).rstrip()
        code = archive.read("sources/integrators.c").decode() + archive.read("sources/events.c").decode()
    assert "lw_find_root" not in code
    assert "lw_rk4(" in code

"""C code over vectors: its functions beside mpmath, its operations beside CasADi's, lanes that know nothing of each other."""

import ctypes

import casadi as ca
import mpmath
import numpy as np
import pytest

from loopwright.diagrams.compiled import load_compiled
from loopwright.diagrams.lanes import NoLanesError
from loopwright.diagrams.lanes.lane_code import FLAGS, read_source
from loopwright.diagrams.lanes.vector_code import write_vectors
from loopwright.fmus.export import processor_flags

BOUNDS = {"exp": 1.0, "expm1": 1.5, "tanh": 2.0, "log": 0.9, "sin": 0.8, "cos": 0.8}
"""Largest errors in ulp that docs/howto/sweeps.md states."""
CALLED = (*BOUNDS, "floor", "ceil", "sqrt")
SPECIAL = [0.0, -0.0, np.inf, -np.inf, np.nan, 1e-310, -1e-310, 710.0, -750.0, 1e300, -1e300, 2.5, -2.5, 0.3, 4.6e15]


def every_operation():
    """A function of t, x and fixed parameters p with every operation that has C code over vectors."""
    t, x, w, p = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("w", 2), ca.SX.sym("p", 3)
    a, b, c = ca.vertsplit(x)
    d, e = ca.vertsplit(w)
    k, m, n = ca.vertsplit(p)
    small, positive = a / 4.0, ca.fabs(b) + 0.1
    yes, no = a < b, ca.logic_or(c <= d, ca.logic_and(ca.eq(a, a), k < m))
    found = [
        a + b,
        a - b,
        a * b + c * d,
        a * b - c,
        c - a * a,
        a / b,
        a / m,
        (k + m) / n,
        a / (k * n),
        -a,
        2 * a,
        1 / b,
        ca.exp(a),
        ca.log(positive),
        positive**a,
        positive**2.5,
        ca.sqrt(positive),
        ca.sin(a),
        ca.cos(a),
        ca.tan(a),
        ca.asin(small),
        ca.acos(small),
        ca.atan(a),
        yes,
        no,
        ca.ne(a, b),
        ca.logic_not(yes),
        ca.logic_not(a),
        ca.floor(a),
        ca.ceil(a),
        ca.fmod(a, positive),
        ca.sign(a),
        ca.copysign(a, b),
        ca.if_else(yes, c, d),
        ca.if_else(k < m, a, b),
        ca.if_else(yes, ca.log(a - b), 0),
        ca.if_else(a, b, c),
        ca.erf(a),
        ca.fmin(a, b),
        ca.fmax(a, k),
        ca.sinh(a),
        ca.cosh(a),
        ca.tanh(a),
        ca.asinh(a),
        ca.acosh(1 + positive),
        ca.atanh(small),
        ca.atan2(a, b),
        ca.log1p(positive),
        ca.expm1(a),
        ca.hypot(a, b),
        ca.remainder(a, positive),
        3.25,
        -0.0,
        k,
        m * n,
        ca.sin(k) + t,
        yes + no,
        (a * b) * (a * b) + a * b,
        ca.SX.inf(),
        a**2,
        ca.if_else(ca.logic_and(k < m, yes), n, e),
    ]
    return ca.Function("f", [t, x, w, p], [ca.vertcat(*found), ca.vertcat(0, a)])


class Vectors:
    """Functions over vectors of some number of lanes."""

    def __init__(self, lanes):
        self.lanes, self.f = lanes, every_operation()
        code = write_vectors("f", self.f, ("t", "x", "w", "p"), {3})
        parts = [f"#define LANES {lanes}\n", read_source("vectors.h"), code.text]
        parts += [
            f"VISIBLE void many_{name}(const vec *x, vec *y, int64_t n) {{"
            f" for (int64_t i = 0; i < n; i++) y[i] = vec_{name}(x[i]); }}\n"
            for name in CALLED
        ]
        parts.append(
            f"VISIBLE void call_f(const vec *t, const vec *x, const vec *w, const vec *p, vec *y, vec *z) {{"
            f" vec kept[{code.kept + 1}]; f_prepare(p, kept); f(t, x, w, p, kept, y, z); }}\n"
        )
        self.library = load_compiled("".join(parts), (*processor_flags(), *FLAGS))

    def aligned(self, *shape):
        memory = np.zeros(8 * int(np.prod(shape)) + 256, dtype=np.uint8)
        begin = -memory.ctypes.data % 128
        return memory[begin : begin + 8 * int(np.prod(shape))].view(float).reshape(shape)

    def __call__(self, name, x):
        rows = -(-len(x) // self.lanes)
        given, made = self.aligned(rows, self.lanes), self.aligned(rows, self.lanes)
        given.ravel()[: len(x)] = x
        self.library[f"many_{name}"](*(ctypes.c_void_p(v.ctypes.data) for v in (given, made)), ctypes.c_int64(rows))
        return made.ravel()[: len(x)].copy()

    def evaluate(self, columns):
        """Return the results of all operations for arguments with a column for each lane."""
        given = []
        for column in columns:
            given.append(self.aligned(*column.shape))
            given[-1][:] = column
        made = [self.aligned(self.f.numel_out(i), self.lanes) for i in (0, 1)]
        self.library["call_f"](*(ctypes.c_void_p(v.ctypes.data) for v in (*given, *made)))
        return [m.copy() for m in made]


@pytest.fixture(scope="module")
def four():
    return Vectors(4)


def draw(name, rng, count):
    """Return arguments of a function: spread evenly, by their exponents, and where it is hard."""
    low, high = {"exp": (-740, 709), "expm1": (-50, 709), "tanh": (-25, 25), "log": (1e-300, 1e3)}.get(
        name, (-1e6, 1e6)
    )
    sign = rng.choice([-1.0, 1.0], count) if low < 0 else 1.0
    found = [rng.uniform(low, high, count), np.exp(rng.uniform(-40, np.log(high), count)) * sign]
    if name in ("sin", "cos"):
        found += [rng.uniform(-10, 10, count), np.pi / 2 * rng.integers(-600_000, 600_000, count)]
    if name == "log":
        found += [
            np.exp(rng.uniform(-740, 709, count)),
            1 + rng.uniform(-0.3, 0.4, count),
            1 + 1e-5 * rng.uniform(-1, 1, count),
        ]
    return np.concatenate(found)


def worst_ulp(name, x, y):
    with mpmath.workprec(200):
        exact = [getattr(mpmath, name)(mpmath.mpf(float(a))) for a in x]
        errors = [
            abs(mpmath.mpf(float(b)) - e) / float(np.spacing(abs(float(e)))) for b, e in zip(y, exact, strict=True)
        ]
    return float(max(errors))


@pytest.mark.parametrize("name", BOUNDS)
def test_functions_over_vectors_are_as_near_to_the_exact_ones_as_is_stated(four, name):
    x = draw(name, np.random.default_rng(5), 300)
    assert worst_ulp(name, x, four(name, x)) < BOUNDS[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", BOUNDS)
def test_many_functions_over_vectors_are_as_near_to_the_exact_ones_as_is_stated(four, name):
    x = draw(name, np.random.default_rng(6), 20_000)
    assert worst_ulp(name, x, four(name, x)) < BOUNDS[name]


@pytest.mark.parametrize("name", CALLED)
def test_functions_over_vectors_meet_special_values_as_numpys_do(four, name):
    with np.errstate(all="ignore"):
        want = getattr(np, name)(np.array(SPECIAL))
    found = four(name, SPECIAL)
    np.testing.assert_allclose(found, want, rtol=1e-15, atol=0)
    numbers = ~np.isnan(want)
    assert np.array_equal(np.signbit(found[numbers]), np.signbit(want[numbers]))


def arguments(rng, lanes):
    return [rng.uniform(-2, 2, (size, lanes)) for size in (1, 3, 2)] + [rng.uniform(0.5, 2, (3, lanes))]


def test_every_operation_has_the_value_that_casadi_computes(four):
    rng = np.random.default_rng(1)
    for _ in range(20):
        columns = arguments(rng, 4)
        found = four.evaluate(columns)
        for lane in range(4):
            want = four.f(*(column[:, lane] for column in columns))
            for made, expected in zip(found, want, strict=True):
                np.testing.assert_allclose(made[:, lane], np.array(expected).ravel(), rtol=2e-14, atol=1e-15)


def test_a_lane_depends_on_no_other_and_not_on_their_number(four):
    rng = np.random.default_rng(2)
    eight = Vectors(8)
    columns = arguments(rng, 8)
    together = eight.evaluate(columns)[0]
    columns[1][0, 3] = np.nan  # of a run that has failed
    beside = eight.evaluate(columns)[0]
    others = [lane for lane in range(8) if lane != 3]
    assert together[:, others].tobytes() == beside[:, others].tobytes()
    halves = [four.evaluate([column[:, k : k + 4] for column in columns])[0] for k in (0, 4)]
    assert beside.tobytes() == np.concatenate(halves, axis=1).tobytes()


def test_an_operation_without_a_form_over_vectors_is_refused():
    x = ca.SX.sym("x")
    with pytest.raises(NoLanesError, match="no form over vectors"):
        write_vectors("f", ca.Function("f", [x], [ca.erfinv(x)]), ("x",), ())

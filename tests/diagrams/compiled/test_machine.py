"""The virtual machine: every operation with CasADi's bits, and what becomes of functions that it doesn't have."""

import ctypes

import casadi as ca
import numpy as np
import pytest
from scipy.special import erfinv

from loopwright.diagrams.compiled.bound_functions import Machine, operation_names
from loopwright.diagrams.compiled.compiled_libraries import load_runtime
from loopwright.diagrams.compiled.machine import make_program

SPECIAL = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1e-310, 1e300, -1e300, np.inf, -np.inf, np.nan, 3.0, 1e16, np.pi]
EXACT = {"ASSIGN", "LIFT", "INPUT", "OUTPUT"}  # no operation of their own on numbers
UNARY = {
    "NEG",
    "SQ",
    "TWICE",
    "INV",
    "SQRT",
    "FABS",
    "SIGN",
    "FLOOR",
    "CEIL",
    "NOT",
    "EXP",
    "EXPM1",
    "LOG",
    "LOG1P",
    "SIN",
    "COS",
    "TAN",
    "ASIN",
    "ACOS",
    "ATAN",
    "SINH",
    "COSH",
    "TANH",
    "ASINH",
    "ACOSH",
    "ATANH",
    "ERF",
}


def evaluate(function, *arguments):
    """Evaluate a function by the machine, with its results as a column."""
    given = [np.ascontiguousarray(a, dtype=float) for a in arguments]
    made = np.zeros(function.nnz_out(0))
    bound = Machine(load_runtime()).find(function).bind(given, [made])
    of = bound.structure
    call = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)(of.evaluate)
    assert call(of.arguments, of.results, of.iw, of.w, 0) == 0
    return made


def assert_same(found, expected):
    """Assert equal bits, but for the sign and the rest of a NaN."""
    expected = np.array(expected).ravel()
    for one, other in zip(found, expected, strict=True):
        assert one.tobytes() == other.tobytes() or (np.isnan(one) and np.isnan(other)), (one, other)


@pytest.mark.parametrize("name", [*sorted(set(operation_names(load_runtime())) - EXACT)])
def test_an_operation_has_the_bits_of_casadi(name):
    x, y = ca.SX.sym("x", len(SPECIAL) ** 2), ca.SX.sym("y", len(SPECIAL) ** 2)
    op = getattr(ca, f"OP_{name}")
    made = ca.SX.unary(op, x) if name in UNARY else ca.SX.binary(op, x, y)
    a, b = (v.ravel() for v in np.meshgrid(SPECIAL, SPECIAL))
    if name in ("FMIN", "FMAX"):
        b[(a == 0.0) & (b == 0.0)] = 1.0  # C leaves open which zero it is
    f = ca.Function("f", [x, y], [made])
    found = evaluate(f, a, b)
    assert_same(found, f(a, b))
    assert len({v.tobytes() for v in found}) > 1


def test_random_functions_have_the_bits_of_casadi_whatever_the_order_of_their_operations():
    random = np.random.default_rng(3)
    x = ca.SX.sym("x", 12)
    values = [*ca.vertsplit(x), ca.SX(1.5), ca.SX(-0.25)]
    for _ in range(400):
        i, j = random.integers(len(values), size=2)
        one, other = values[i], values[j]
        choices = (
            lambda a, b: a + b,
            lambda a, b: a * b,
            lambda a, b: a - 0.5 * b,
            lambda a, b: ca.sin(a),
            lambda a, b: ca.if_else(a < b, a, ca.tanh(b)),
            lambda a, b: ca.fmax(a, 1.0 + ca.fabs(b)),
        )
        values.append(choices[random.integers(len(choices))](one, other))
    f = ca.Function("f", [x], [ca.vertcat(*values[-200:])])
    program = make_program(f, operation_names(load_runtime()))
    assert program.runs < f.n_instructions() / 4  # they are sorted
    for _ in range(5):
        given = random.normal(size=12)
        assert_same(evaluate(f, given), f(given))


def test_a_function_of_matrices_is_called_in_python():
    x = ca.MX.sym("x")
    table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 10.0, 40.0])
    f = ca.Function("f", [x], [table(x)])
    np.testing.assert_allclose(evaluate(f, [1.5]), [25.0], rtol=1e-15)


def test_an_error_within_such_a_function_is_no_result(monkeypatch):
    x = ca.MX.sym("x")
    table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 10.0, 40.0])
    f = ca.Function("f", [x], [table(x)])

    class Failing:
        def call(self):
            raise RuntimeError("no value")

    monkeypatch.setattr("loopwright.diagrams.compiled.bound_functions.bind_function", lambda *_: Failing())
    made = np.array([7.0])
    bound = Machine(load_runtime()).find(f).bind([np.array([1.5])], [made])
    call = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)(bound.structure.evaluate)
    assert call(bound.structure.arguments, bound.structure.results, None, None, 0) == 1
    assert made[0] == 7.0


def test_an_operation_that_it_does_not_have_is_done_by_python():
    x = ca.SX.sym("x")
    f = ca.Function("f", [x], [2.0 * ca.erfinv(x)])
    np.testing.assert_allclose(evaluate(f, [0.3]), [2.0 * erfinv(0.3)], rtol=1e-14)

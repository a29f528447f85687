"""NumPy's functions of symbols have NumPy's values, and those that can't be traced say what to write."""

import math

import casadi as ca
import numpy as np
import pytest

from loopwright.blocks import Constant, Function, TraceError
from loopwright.blocks.tracing import trace, wrap
from loopwright.diagrams import Diagram

EDGES = [-1.0, 0.0, 0.5]
POINTS = [np.array(p) for p in ([0.3, -1.2, 2.5], [2.0, 2.0, -1.0], [0.0, 0.5, 0.5], [-3.0, -2.0, -1.0])]
WITH_NAN = [np.array(p) for p in ([math.nan, 1.0, 2.0], [1.0, math.nan, 0.0], [3.0, math.inf, -math.inf])]


def values(function, point):
    """Return the values of a function that is traced, and of NumPy, at a vector."""
    u = ca.MX.sym("u", 3)
    made = function(wrap(u, (3,)))
    f = ca.Function("f", [u], [made.to_casadi()])
    got = [np.array(g(point)) for g in (f, f.expand())]
    assert np.array_equal(*got, equal_nan=True)
    with np.errstate(all="ignore"):
        expected = np.asarray(function(point), dtype=float)
    assert made.shape == expected.shape
    return got[0].reshape(expected.shape), expected


@pytest.mark.parametrize(
    "function",
    [
        np.sort,
        np.median,
        lambda u: np.argmax(u) + 0.0,
        lambda u: np.argmin(u) + 0.0,
        lambda u: u.argmax() * u.argmin() * 1.0,
        lambda u: np.polyval([1.0, 2.0, 3.0], u),
        lambda u: np.polyval(u, 2.0),
        lambda u: np.polyval(u, u[0]),
        lambda u: np.linalg.norm(u, axis=0),
        lambda u: np.linalg.norm(u, np.inf, axis=-1),
        lambda u: np.tensordot(u, u, 1),
        lambda u: np.tile(u, 2),
        lambda u: np.tile(u[0], 3),
        lambda u: np.block([u, u]),
        lambda u: np.block([u[0], u]),
        lambda u: np.block([[np.outer(u, u), np.outer(u, u)], [np.eye(3), np.zeros((3, 3))]]),
        lambda u: np.piecewise(u, [u < 0, u > 1], [lambda v: -v, lambda v: v * v, 3.0]),
        lambda u: np.piecewise(u, [u < 1, u > 0], [lambda v: -v, lambda v: v * v]),
        lambda u: np.searchsorted(EDGES, u) + 0.0,
        lambda u: np.searchsorted(EDGES, u, side="right") + 0.0,
        lambda u: np.minimum.accumulate(u),
        lambda u: np.maximum.accumulate(u),
        lambda u: u[:, None] * u[None, :],
        lambda u: u[np.newaxis, 1:] * 2.0,
        lambda u: u[0][None] * 2.0,
        lambda u: np.expand_dims(u, 1) * 1.0,
        lambda u: u.clip(-1.0, 1.0),
        lambda u: u.dot(u) + u.cumsum(),
        lambda u: (u > 0).astype(float) + u.copy(),
        lambda u: np.stack(u.tolist()) + np.real(u),
        lambda u: np.where((u > 0) & ~(u > 1) | (u < -1), u, 0.0),
    ],
)
def test_a_function_of_symbols_has_numpys_values(function):
    for point in POINTS:
        got, expected = values(function, point)
        assert got == pytest.approx(expected, rel=1e-15, abs=1e-15)


@pytest.mark.parametrize(
    "function",
    [
        lambda u: np.where(np.isnan(u), 1.0, 0.0),
        lambda u: np.where(np.isfinite(u), 1.0, 0.0),
        lambda u: np.where(np.isinf(u), 1.0, 0.0),
        np.median,
        lambda u: np.argmax(u) + 0.0,
        lambda u: np.argmin(u) + 0.0,
        lambda u: np.polyval([1.0, 2.0], np.where(np.isinf(u), 0.0, u)),
        lambda u: np.where(np.isnan(np.sum(np.sort(u))), 1.0, 0.0),
    ],
)
def test_nan_and_infinity_are_not_swallowed(function):
    for point in (*WITH_NAN, *POINTS):
        got, expected = values(function, point)
        assert np.array_equal(got, expected, equal_nan=True)


def test_derivatives_go_through_the_order_of_entries():
    u = ca.MX.sym("u", 3)
    slope = ca.Function("J", [u], [ca.jacobian(np.sort(wrap(u, (3,))).to_casadi().T, u)])
    assert np.array_equal(np.array(slope([3.0, -1.0, 2.0])), [[0, 1, 0], [0, 0, 1], [1, 0, 0]])


def test_a_median_filter_runs_in_a_diagram():
    middle = Function(lambda u: np.median(u), name="middle")
    run = Diagram("d", middle(Constant(value=np.array([3.0, -1.0, 7.0]))).named("y")).simulate(0.1, step=0.1)
    assert run["y"].tolist() == [3.0, 3.0]


@pytest.mark.parametrize(
    ("function", "text"),
    [
        (lambda u: min(u[0], u[1]), r"min\(\), max\(\), sorted\(\).*np\.minimum, np\.maximum or np\.min for min"),
        (lambda u: np.stack(sorted(u)), r"np\.sort for sorted"),
        (lambda u: u if u[0] > 0 else -u, r"Write np\.where\(condition, a, b\) for if"),
        (lambda u: np.where(0 < u[0] < 1, 1.0, 0.0), r"0 < u < 1 .*\(u > 0\) & \(u < 1\) for and"),
        (lambda u: np.where(not u[0] > 0, 1.0, 0.0), r"~ for not"),
        (lambda u: np.where(u & 1.0, 1.0, 0.0), r"Put comparisons in parentheses, \(u > 0\) & \(u < 1\)"),
        (lambda u: np.where((u > 0) | u, 1.0, 0.0), r"expected truth values on both sides"),
        (lambda u: np.where(~u, 1.0, 0.0), r"Write ~\(u > 0\)"),
        (lambda u: math.sin(u[0]), r"np\.sin for math\.sin"),
        (lambda u: float(u[0]), r"float\(\)"),
        (lambda u: u[0] * int(u[1]), r"np\.floor for int"),
        (lambda u: np.array([u[0], u[1]]), r"np\.stack\(\[a, b\]\) for np\.array"),
        (lambda u: np.asarray(u) * 2.0, r"leave np\.asarray out"),
        (lambda u: round(u[0]), r"np\.floor\(v \+ 0\.5\)"),
        (lambda u: np.sum(u[u > 0]), r"np\.where\(mask, u, 0\.0\) for u\[mask\]"),
        (lambda u: np.argsort(u) + 0.0, r"np\.argsort can't be traced\. Write np\.sort"),
        (lambda u: np.unwrap(u), r"np\.unwrap can't be traced\. Write it in sums"),
        (lambda u: np.nextafter(u, 1.0), r"np\.nextafter can't be traced"),
        (lambda u: u.astype(int), r"Write np\.floor"),
    ],
)
def test_an_operation_that_can_not_be_traced_says_what_to_write(function, text):
    with pytest.raises(TraceError, match=text) as caught:
        trace(Function(function, name="f"), {"u": (3,)}, sampled=False)
    assert "or take PythonFunction, which is not traced" in str(caught.value)


def test_an_assignment_into_an_array_says_what_to_write():
    def assigned(u):
        y = np.zeros(2)
        y[0] = u[0]
        return y

    with pytest.raises(TraceError, match=r"'y\[0\] = u\[0\]'.*np\.stack for vectors"):
        trace(Function(assigned, name="f"), {"u": (3,)}, sampled=False)

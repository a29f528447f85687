"""A trace gives NumPy's numbers where CasADi's own array interface gives others: remainders, sums of truth values."""

import itertools
import math
import operator
from decimal import Decimal, localcontext

import casadi as ca
import numpy as np
import pytest
from casadi import ArrayInterface

from loopwright.blocks import Constant, Function
from loopwright.blocks.tracing import as_traced, wrap
from loopwright.diagrams import Diagram

VALUES = [0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -2.5, 0.1, 0.3, -7.3, 1e9, -1e9, 1e-9, 6.283185307179586, math.inf]
LOGIC = [(a, b) for a in (0.0, 1.0) for b in (0.0, 1.0)]


def traced(function, arguments):
    """Return the values of a function that is traced, shape (results, points)."""
    symbols = [ca.MX.sym("a"), ca.MX.sym("b")]
    made = function(*(wrap(s, ()) for s in symbols))
    made = made if isinstance(made, tuple) else (made,)
    call = ca.Function("f", symbols, [m.to_casadi() for m in made]).expand()
    return np.array([[float(v) for v in call.call([a, b])] for a, b in arguments]).T


@pytest.mark.parametrize(
    "function", [np.mod, np.remainder, np.floor_divide, np.divmod, np.fmod, operator.mod, operator.floordiv, divmod]
)
def test_remainders_and_whole_parts_are_those_of_numpy(function):
    pairs = list(itertools.product(VALUES, VALUES))
    with np.errstate(all="ignore"):
        expected = np.array([np.atleast_1d(function(np.float64(a), np.float64(b))) for a, b in pairs]).T
    assert np.array_equal(traced(function, pairs), expected, equal_nan=True)


@pytest.mark.parametrize(("a", "b"), [(1.0, 0.1), (1e9, 2 * math.pi), (-1e9, 2 * math.pi), (123456789.0, 1e-3)])
def test_a_remainder_is_exact(a, b):
    """Against the decimal numbers that the floating-point ones are."""
    with localcontext() as context:
        context.prec = 200
        x, y = Decimal(a), Decimal(b)
        exact = float(x - y * (x / y).to_integral_value(rounding="ROUND_FLOOR"))
    assert traced(np.mod, [(a, b)])[0, 0] == exact
    run = Diagram("d", Function(lambda u: np.mod(u, b))(Constant(value=a))).simulate(0.1, step=0.1, progress=False)
    assert run["function.y"].tolist() == [exact, exact]


@pytest.mark.parametrize("kind", [lambda f: f, lambda f: lambda a, b: f(np.stack([a, b])[0], b)])
@pytest.mark.parametrize(
    "function",
    [
        lambda a, b: (a > 0.5) + (b > 0.5),
        lambda a, b: np.add(a > 0.5, b > 0.5) + 1.0,
        lambda a, b: (a > 0.5) * (b > 0.5),
        lambda a, b: (a > 0.5) & (b > 0.5),
        lambda a, b: (a > 0.5) | (b > 0.5),
        lambda a, b: (a > 0.5) ^ (b > 0.5),
        lambda a, b: ~(a > 0.5) + 0.0 * b,
        lambda a, b: np.logical_or(a > 0.5, b > 0.5) + np.logical_not(b > 0.5),
        lambda a, b: np.stack([a > 0.5, b > 0.5])[0] + np.stack([a > 0.5, b > 0.5])[1],
        lambda a, b: np.where(a > 0.5, b > 0.5, a > 0.5) + (b > 0.5),
        lambda a, b: np.sum(np.stack([a > 0.5, b > 0.5])),  # NumPy counts here
        lambda a, b: sum([a > 0.5, b > 0.5]),  # 0 + …: numbers
        lambda a, b: (a > 0.5) + 1.0 * (b > 0.5),
        lambda a, b: (a > 0.5) + True,
        lambda a, b: True + (b > 0.5),
    ],
)
def test_truth_values_add_up_as_numpys_do(kind, function):
    expected = [float(kind(function)(np.float64(a), np.float64(b))) for a, b in LOGIC]
    assert traced(kind(function), LOGIC)[0].tolist() == expected


def test_logic_on_numbers_is_refused_as_numpy_refuses_it():
    for function in (lambda a, b: a & b, lambda a, b: (a > 0) | b, lambda a, b: ~a):
        with pytest.raises(TypeError):
            traced(function, [(1.0, 1.0)])
        with pytest.raises(TypeError):
            function(np.float64(1.0), np.float64(1.0))


def test_everything_computed_from_a_traced_array_has_its_operations():
    x = as_traced(ArrayInterface(ca.MX.sym("x", 1, 4), ndim=1))
    kind = type(x)
    made = [x + 1, 1 + x, x - 1, 1 - x, x * 2, x / 2, 2 / x, x**2, 2**x, -x, +x, abs(x), x[0], x[1:], x.T, x.sum()]
    made += [np.sin(x), np.stack([x, x]), np.concatenate([x, x]), np.where(x > 0, x, 0.0), np.ones((4, 4)) @ x, x @ x]
    made += [x.reshape(2, 2), x.max(), x.min(), np.sum(x), np.mean(x), np.clip(x, 0, 1), np.arange(4.0) * x, x % 1]
    made += [np.minimum(x, 0), np.cross(x[:3], x[1:]), np.dot(x, x), np.linalg.norm(x), *divmod(x, 2), *x]
    assert [type(m) is kind for m in made] == [True] * len(made)

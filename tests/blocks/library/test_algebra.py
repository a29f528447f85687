"""Algebraic blocks, against NumPy on the same numbers."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    DeadZone,
    Gain,
    Input,
    Integrator,
    Maximum,
    Minimum,
    Output,
    ParameterError,
    Product,
    Saturation,
    ShapeError,
    Stack,
    StateSpace,
    Sum,
    WiringError,
)
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram

RNG = np.random.default_rng(7)


def results(block, *inputs):
    """All outputs of a block for inputs by position."""
    given = {name: np.asarray(value, dtype=float) for name, value in zip(block.inputs, inputs, strict=True)}
    made = trace(block, {name: value.shape for name, value in given.items()}, sampled=False)
    columns = [value.ravel() for value in given.values()]
    raw = made.function.call([0.0, np.zeros(0), *columns, made.pack(block, np.nan)])
    return [np.array(r).reshape(shape) for r, shape in zip(raw, made.outputs.values(), strict=False)]


def result(block, *inputs):
    return results(block, *inputs)[0]


# --- sums -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("signs", ["+", "-", "++", "+-", "-+", "--", "-+-", "+--+-"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)
def test_a_sum_adds_with_the_sign_of_each_input(signs, shape):
    values = RNG.standard_normal((len(signs), *shape))
    weights = np.array([1.0 if sign == "+" else -1.0 for sign in signs])
    got = result(Sum(signs=signs), *values)
    assert got.shape == shape
    np.testing.assert_allclose(got, np.tensordot(weights, values, axes=1), rtol=0, atol=4e-15)


def test_a_sum_adds_two_unless_told():
    assert list(Sum().inputs) == ["u1", "u2"]
    assert result(Sum(), 2.0, 5.0) == 7.0


@pytest.mark.parametrize("signs", ["", "+*", "+ -", "1"])
def test_signs_that_are_none_are_refused(signs):
    with pytest.raises(ParameterError, match=r"sum\.signs: found .*; expected a \+ or - for each input, such as '\+-'"):
        Sum(signs=signs)


# --- gains ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)
def test_a_number_scales_every_element(shape):
    u = RNG.standard_normal(shape)
    np.testing.assert_array_equal(result(Gain(gain=-2.5), u), -2.5 * u)


def test_an_array_scales_element_by_element():
    assert result(Gain(gain=(2.0, -3.0, 0.5)), (1.0, 10.0, 100.0)).tolist() == [2.0, -30.0, 50.0]
    assert result(Gain(gain=(2.0, -3.0, 0.5)), 4.0).tolist() == [8.0, -12.0, 2.0]


@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (3, 2), (2, 3), (1, 3), (3, 1)])
def test_a_matrix_multiplies_a_vector_from_the_left(rows, columns):
    K, u = RNG.standard_normal((rows, columns)), RNG.standard_normal(columns)
    got = result(Gain(gain=K), u)
    assert got.shape == (rows,)
    want = [sum(K[i, j] * u[j] for j in range(columns)) for i in range(rows)]
    np.testing.assert_allclose(got, want, rtol=0, atol=2e-15)


def test_a_matrix_with_zeros_keeps_its_places():
    # exact zeros are left out of the trace: what is left must stay where it was
    K = np.array([[0.0, 2.0, 0.0], [3.0, 0.0, 5.0]])
    assert result(Gain(gain=K), (1.0, 10.0, 100.0)).tolist() == [20.0, 503.0]


def test_a_matrix_multiplies_a_matrix():
    K, U = RNG.standard_normal((2, 3)), RNG.standard_normal((3, 4))
    want = [[sum(K[i, k] * U[k, j] for k in range(3)) for j in range(4)] for i in range(2)]
    np.testing.assert_allclose(result(Gain(gain=K), U), want, rtol=0, atol=4e-15)


# --- products ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (3,), (2, 2)], ids=str)
def test_a_product_multiplies_element_by_element(shape):
    a, b = RNG.standard_normal((2, *shape))
    want = [x * y for x, y in zip(a.ravel(), b.ravel(), strict=True)]
    np.testing.assert_array_equal(result(Product(), a, b).ravel(), want)


def test_a_scalar_factor_scales_a_vector():
    assert result(Product(), -2.0, (1.0, 3.0)).tolist() == [-2.0, -6.0]


# --- stacks -----------------------------------------------------------------------------------------------------------


def test_a_stack_has_the_entries_of_its_inputs_in_a_row():
    assert result(Stack(), 1.0, 2.0).tolist() == [1.0, 2.0]
    assert result(Stack(count=3), 1.0, (2.0, 3.0), 4.0).tolist() == [1.0, 2.0, 3.0, 4.0]
    assert result(Stack(count=1), 5.0).tolist() == [5.0]


@pytest.mark.parametrize("make", [tuple, list, np.stack, np.hstack, lambda signals: np.array(signals)])
def test_several_signals_are_wired_to_a_vector_input_as_one(make):
    """x' = −x + u entry by entry, with u = 2 and the other block's e^(−t): 2 (1 − e^(−t)) and t e^(−t)."""
    other = Integrator(initial_value=1.0, name="other")
    decay = other(-other.y)
    lags = StateSpace(A=-np.eye(2), B=np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), name="lags")
    diagram = Diagram("lags", lags(make([Constant(value=2.0, name="two"), decay])).named("y"))
    run = diagram.simulate(2.0, rtol=1e-10, atol=1e-12, progress=False)
    want = np.column_stack([2.0 * (1.0 - np.exp(-run.t)), run.t * np.exp(-run.t)])
    np.testing.assert_allclose(run["y"], want, atol=1e-8)
    assert "two_and_other" in diagram.blocks


def test_a_signal_and_numbers_are_one_vector():
    diagram = Diagram("mixed", Gain(gain=1.0, name="gain")((1.5, Constant(value=2.0, name="two"), 3.0)).named("y"))
    assert diagram.simulate(0.1, step=0.1, progress=False)["y"][-1].tolist() == [1.5, 2.0, 3.0]


def test_lists_of_lists_and_matrices_are_no_vector():
    one = Constant(value=1.0, name="one")
    with pytest.raises(WiringError, match=r"gain\.u: found a list of lists with signals in it; expected one list"):
        Gain(gain=1.0, name="gain")([[one, 2.0], [3.0, one]])
    with pytest.raises(ShapeError, match=r"stack\.u2: found shape \(2, 2\); expected a scalar or a vector"):
        Diagram("matrix", Stack(name="stack")(one, np.eye(2)))
    with pytest.raises(WiringError, match=r"lag: 2 signals for 1 inputs \(u\)\. For one vector of them give a tuple"):
        Gain(gain=1.0, name="lag")(one, one)


# --- saturation -------------------------------------------------------------------------------------------------------


def test_a_saturation_limits_both_sides_and_gives_what_it_cut_off():
    u = np.array([-7.0, -2.5, -2.0, -0.0, 1.0, 2.0, 2.25])
    y, excess = results(Saturation(limit=2.0), u)
    assert y.tolist() == [-2.0, -2.0, -2.0, 0.0, 1.0, 2.0, 2.0]
    assert excess.tolist() == [-5.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.25]


def test_each_element_can_have_a_limit_of_its_own():
    y, excess = results(Saturation(limit=(1.0, 10.0, 0.5)), (-3.0, -3.0, 3.0))
    assert y.tolist() == [-1.0, -3.0, 0.5]
    assert excess.tolist() == [-2.0, 0.0, 2.5]


def test_nothing_is_cut_off_of_what_is_within_the_limits():
    u = RNG.uniform(-1.0, 1.0, 50)
    y, excess = results(Saturation(limit=1.0), u)
    assert y.tobytes() == u.tobytes()
    assert not excess.any()


def test_what_is_no_number_passes_through():
    y, excess = results(Saturation(limit=1.0), (np.nan, 5.0, -np.inf))
    assert np.isnan(y[0])
    assert np.isnan(excess[0])
    assert y[1:].tolist() == [1.0, -1.0]
    assert excess[1] == 4.0


@pytest.mark.parametrize("limit", [0.0, -1.0, (1.0, 0.0)])
def test_a_limit_that_is_not_positive_is_refused(limit):
    with pytest.raises(ParameterError, match=r"Saturation\.limit: found .*; expected a value above 0"):
        Saturation(limit=limit)


@pytest.mark.parametrize(
    ("limits", "low", "high"),
    [
        ({"limit": 1.5}, -1.5, 1.5),
        ({"lower": -1.0, "upper": 2.0}, -1.0, 2.0),
        ({"lower": (0.0, 1.0, -2.0), "upper": 3.0}, [0.0, 1.0, -2.0], 3.0),
        ({"lower": 0.0}, 0.0, np.inf),
        ({"upper": (0.5, 0.0, -1.0)}, -np.inf, [0.5, 0.0, -1.0]),
    ],
    ids=str,
)
def test_limits_of_all_kinds_cut_off_and_leave_over(limits, low, high):
    for u in 3.0 * RNG.standard_normal((20, 3)):
        y, excess = results(Saturation(**limits), u)
        np.testing.assert_array_equal(y, np.clip(u, low, high))
        np.testing.assert_array_equal(excess, u - np.clip(u, low, high))
        np.testing.assert_array_equal(result(DeadZone(**limits), u), u - np.clip(u, low, high))


def test_a_dead_zone_is_zero_within_and_lets_what_is_no_number_through():
    assert result(DeadZone(limit=1.0), (-1.5, -1.0, 0.3, 1.0, 4.0)).tolist() == [-0.5, 0.0, 0.0, 0.0, 3.0]
    assert np.isnan(result(DeadZone(lower=0.0, upper=1.0), np.nan))
    assert np.isnan(result(Saturation(lower=0.0), np.nan))


@pytest.mark.parametrize("cls", [Saturation, DeadZone])
@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ({}, r"limit: found no limit; expected limit=… for ±limit, or lower=… or upper=… or both"),
        ({"limit": 1.0, "upper": 2.0}, r"limit: found limit and upper; expected limit=…"),
        ({"lower": 1.0, "upper": 1.0}, r"lower: found lower=1 and upper=1; expected lower below upper"),
        (
            {"lower": (0.0, 3.0), "upper": 2.0},
            r"lower: found lower=\[0\.0, 3\.0\] and upper=2; expected lower below upper",
        ),
    ],
)
def test_limits_that_are_none_are_refused(cls, limits, text):
    with pytest.raises(ParameterError, match=text):
        cls(**limits)


# --- smallest and largest ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cls", "oracle"), [(Minimum, np.minimum), (Maximum, np.maximum)])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_smallest_and_the_largest_of_all_inputs(cls, oracle, count):
    u = RNG.integers(-3, 4, (count, 2, 3)).astype(float)
    np.testing.assert_array_equal(result(cls(count=count), *u), oracle.reduce(u))
    assert result(cls(), (1.0, 5.0), 3.0).tolist() == oracle((1.0, 5.0), 3.0).tolist()


@pytest.mark.parametrize("cls", [Minimum, Maximum])
def test_an_input_that_is_no_number_makes_neither_smallest_nor_largest(cls):
    for values in ((np.nan, 1.0), (1.0, np.nan), (np.nan, np.nan)):
        assert np.isnan(result(cls(), *values))
    assert np.isnan(result(cls(count=3), 1.0, np.nan, 2.0))


@pytest.mark.parametrize("cls", [Minimum, Maximum])
def test_how_many_inputs_is_a_positive_number(cls):
    with pytest.raises(ParameterError, match=r"\.count: found 0; expected a value at least 1"):
        cls(count=0)


# --- in a diagram -----------------------------------------------------------------------------------------------------


def test_they_compute_the_same_in_a_diagram():
    class Source(Block):
        y = Output(shape=(2,))

        def output(self, t, x, u):
            return np.stack([3.0 * t, 1.0 - t])

    class Pair(Block):
        u = Input(shape=(3,))
        y = Output(shape=(3,))

        def output(self, t, x, u):
            return 1.0 * u.u

    K = np.array([[1.0, 2.0], [0.0, -1.0], [4.0, 0.5]])
    source = Source()
    wide = Gain(gain=K)(source())
    limited = Saturation(limit=3.0)(wide)
    total = Sum(signs="-+")(limited.y, Product()(wide, limited.excess))
    run = Diagram("algebra", Pair()(total).y.named("y")).simulate(2.0, step=0.5, progress=False)
    u = np.stack([3.0 * run.t, 1.0 - run.t], axis=1) @ K.T
    cut = np.clip(u, -3.0, 3.0)
    np.testing.assert_allclose(run["y"], -cut + u * (u - cut), rtol=1e-14, atol=1e-14)
    assert np.abs(u).max() > 3.0

"""Delays: of whole samples against shifted inputs, Padé's against python-control's and against itself."""

from fractions import Fraction

import control
import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from loopwright.blocks import Delay, Hold, PadeDelay, ParameterError, SampleTimeError, ShapeError, TransportDelay
from loopwright.blocks.tracing.traced import trace
from support.stepped import Alone, response

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("shape", [(), (3,)], ids=str)
@pytest.mark.parametrize("steps", [1, 2, 7])
def test_a_delay_gives_the_input_of_so_many_ticks_ago(steps, shape):
    u = RNG.standard_normal((20, *shape))
    got = Alone(Delay(steps=steps), T=0.1, u=shape).ticks(u=u)["y"]
    np.testing.assert_array_equal(got, np.concatenate([[u[0]] * steps, u[:-steps]]))
    got = Alone(Delay(steps=steps, initial_value=4.0), T=0.1, u=shape).ticks(u=u)["y"]
    np.testing.assert_array_equal(got, np.concatenate([np.full((steps, *shape), 4.0), u[:-steps]]))


def test_a_delay_of_many_steps_is_a_few_operations_a_step():
    made = trace(Delay(steps=5000, initial_value=0.0), {"u": ()}, sampled=True)
    assert made.function.n_instructions() < 3 * 5000
    assert made.depends["y"] == {"x"}


@pytest.mark.parametrize("block", [Delay(steps=2), Hold()], ids=lambda block: block.label)
def test_sampled_blocks_are_refused_in_a_continuous_frame(block):
    with pytest.raises(SampleTimeError, match=rf"{block.label}: .*continuous subsystem; put it into a @subsystem"):
        trace(block, {"u": ()}, sampled=False)


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)], ids=str)
def test_a_hold_is_its_input_at_the_ticks(shape):
    u = RNG.standard_normal((5, *shape))
    np.testing.assert_array_equal(Alone(Hold(), T=0.1, u=shape).ticks(u=u)["y"], u)


def test_a_matrix_and_a_start_of_another_shape_are_refused():
    with pytest.raises(ShapeError, match=r"delay.u: found shape \(2, 2\); expected a scalar or a vector"):
        trace(Delay(steps=2), {"u": (2, 2)}, sampled=True)
    with pytest.raises(ShapeError, match="found a start value of shape"):
        trace(Delay(steps=2, initial_value=[1.0, 2.0]), {"u": (3,)}, sampled=True)


@pytest.mark.parametrize("changes", [{"steps": 0}, {"steps": 1.5}])
def test_steps_are_a_whole_number_of_at_least_one(changes):
    with pytest.raises(ParameterError, match=r"Delay\.steps: found"):
        Delay(**changes)


# --- transport delay --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("delay", "T", "steps"), [(0.3, 0.1, 3), (0.0021, 0.0007, 3), (1.0, Fraction(1, 3), 3), (0.1, 0.1, 1)]
)
def test_a_transport_delay_in_a_sampled_frame_is_one_by_whole_samples(delay, T, steps):
    block = TransportDelay(delay=delay, initial_value=[1.0, 2.0], name="pipe")
    assert block.transport
    assert block.discretize(T) == Delay(steps=steps, initial_value=[1.0, 2.0])
    assert block.discretize(T).label == "pipe"


@pytest.mark.parametrize(
    ("delay", "text"),
    [
        (0.25, r"transport_delay.delay: found a delay of 0.25 s .* time of 0.1 s; .* nearest: 0.2 s or 0.3 s"),
        (0.05, r"The nearest: 0.1 s\. Change one of the two"),
    ],
)
def test_a_delay_that_is_no_multiple_names_the_nearest(delay, text):
    with pytest.raises(SampleTimeError, match=text):
        TransportDelay(delay=delay).discretize(0.1)


def test_a_transport_delay_has_no_equation_of_its_own():
    with pytest.raises(SampleTimeError, match=r"Use Delay\(steps=…\) in a sampled subsystem, PadeDelay"):
        trace(TransportDelay(delay=0.1), {"u": ()}, sampled=False)


# --- Padé -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 3, 4, 7, 10])
def test_the_rational_function_is_pades(order):
    found = Alone(PadeDelay(delay=0.3, order=order)).matrices(["u"], "y")
    b, a = control.pade(0.3, order)
    for s in (2j, 15j, 1.0 + 3.0j):
        assert response(found, s)[0, 0] == pytest.approx(np.polyval(b, s) / np.polyval(a, s), rel=1e-12)


@pytest.mark.parametrize("order", [1, 2, 5, 12, 30])
def test_it_is_an_all_pass_in_balanced_form(order):
    A, B, C, _ = found = Alone(PadeDelay(delay=0.3, order=order)).matrices(["u"], "y")
    for w in (0.1, 10.0, 1e3, 1e6):
        assert abs(response(found, 1j * w)[0, 0]) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(0.15 * solve_continuous_lyapunov(A, -B @ B.T), np.eye(order), rtol=0, atol=1e-9)
    np.testing.assert_allclose(solve_continuous_lyapunov(A.T, -C.T @ C) / 0.15, np.eye(order), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("order", "bound"), [(3, 1e-6), (5, 1e-11), (8, 1e-14), (30, 1e-14)])
def test_a_higher_order_is_nearer_to_the_delay(order, bound):
    found = Alone(PadeDelay(delay=0.3, order=order)).matrices(["u"], "y")
    error = abs(response(found, 2j)[0, 0] - np.exp(-0.6j))  # about (ω τ)^(2n + 1) n!² / (2n)! (2n + 1)!
    assert error < bound


def test_it_starts_at_rest_at_its_initial_value():
    alone = Alone(PadeDelay(delay=0.3, order=4, initial_value=2.5))
    got = alone.run(lambda t: {"u": 2.5}, np.linspace(0.0, 1.0, 5))["y"]
    np.testing.assert_allclose(got, 2.5, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_smooth_input_comes_out_later():
    def smooth(t):
        return np.exp(-((t - 1.5) ** 2) / 0.1)

    times = np.linspace(0.0, 3.0, 31)
    got = Alone(PadeDelay(delay=0.4, order=8)).run(lambda t: {"u": smooth(t)}, times)["y"]
    np.testing.assert_allclose(got, smooth(times - 0.4), rtol=0, atol=1e-7)

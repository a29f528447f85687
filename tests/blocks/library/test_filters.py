"""Discrete integrator and filters: against recurrences by hand and SciPy's filters."""

import numpy as np
import pytest
from scipy import signal

from loopwright.blocks import FIR, IIR, DiscreteIntegrator, MovingAverage, ParameterError, SampleTimeError
from loopwright.blocks.tracing.traced import trace
from support.stepped import Alone

RNG = np.random.default_rng(9)
U = RNG.standard_normal(80)
T = 0.02


@pytest.mark.parametrize("gain", [1.0, -2.5])
@pytest.mark.parametrize("method", ["forward", "backward", "trapezoidal"])
def test_a_discrete_integrator_is_the_sum_of_its_rule(method, gain):
    got = Alone(DiscreteIntegrator(method=method, gain=gain, initial_value=0.3), T=T).ticks(u=U)
    past = np.r_[0.0, U[:-1]]
    area = {"forward": past, "backward": U, "trapezoidal": 0.5 * (past + U)}[method]
    np.testing.assert_allclose(got["y"], 0.3 + gain * T * np.cumsum(area), rtol=0, atol=1e-13)
    b, a = {"forward": ([0, T], [1, -1]), "backward": ([T, 0], [1, -1]), "trapezoidal": ([T / 2, T / 2], [1, -1])}[
        method
    ]
    np.testing.assert_allclose(got["y"], 0.3 + gain * signal.lfilter(b, a, U), rtol=0, atol=1e-13)


def test_only_the_forward_rule_feeds_nothing_through():
    for method in ("forward", "backward", "trapezoidal"):
        made = trace(DiscreteIntegrator(method=method), {"u": (), "reset": ()}, sampled=True)
        assert ("u" in made.depends["y"]) == (method != "forward")
        assert made.depends["before"] == {"x"}


@pytest.mark.parametrize("method", ["forward", "backward", "trapezoidal"])
def test_nothing_winds_up_beyond_its_limits(method):
    u = np.r_[np.full(30, 3.0), np.full(30, -3.0)]
    got = Alone(DiscreteIntegrator(method=method, lower=-0.5, upper=0.4), T=T).ticks(u=u)["y"]
    assert got.max() == 0.4
    assert got.min() == -0.5
    first = 31 if method == "forward" else 30
    steps = {"trapezoidal": [0.5], "backward": [1.0], "forward": [1.0]}[method]
    assert got[first] == pytest.approx(0.4 - 3.0 * T * steps[0], abs=1e-14)  # it leaves at once
    assert got[first + 1] == pytest.approx(got[first] - 3.0 * T, abs=1e-14)


def test_an_edge_resets_in_its_own_tick():
    reset = [1, 1, 0, 1, 1, 0]
    got = Alone(DiscreteIntegrator(initial_value=5.0), T=1.0).ticks(u=np.ones(6), reset=reset)
    assert got["y"].tolist() == [5.0, 6.0, 7.0, 5.0, 6.0, 7.0]
    assert got["before"].tolist() == [5.0, 6.0, 7.0, 8.0, 6.0, 7.0]
    alone = Alone(DiscreteIntegrator(method="backward", reset_to_input=True), T=1.0, u=(2,), value=(2,))
    got = alone.ticks(u=np.ones((3, 2)), reset=[0, 0, 1], value=np.full((3, 2), [10.0, 20.0]))["y"]
    assert got.tolist() == [[1.0, 1.0], [2.0, 2.0], [11.0, 21.0]]
    got = alone.ticks(u=np.ones((2, 2)), reset=[1, 1], value=np.full((2, 2), 9.0))["y"]
    assert got.tolist() == [[1.0, 1.0], [2.0, 2.0]]  # true at the start is no edge


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"method": "euler"}, "method: found 'euler'; expected one of 'forward', 'backward', 'trapezoidal'"),
        ({"lower": 2.0, "upper": 1.0}, "found lower=2 and upper=1"),
        ({"upper": -1.0}, "initial_value: found 0.0; expected a value within the limits"),
    ],
)
def test_what_can_not_be_integrated_is_refused(parameters, text):
    with pytest.raises(ParameterError, match=text):
        DiscreteIntegrator(**parameters)


# --- filters ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (2,)], ids=str)
def test_a_fir_filter_is_a_convolution(shape):
    c, u = [0.5, 0.0, -0.25, 2.0], RNG.standard_normal((30, *shape))
    got = Alone(FIR(coefficients=c, initial_value=0.0), T=T, u=shape).ticks(u=u)["y"]
    np.testing.assert_allclose(got, signal.lfilter(c, [1.0], u, axis=0), rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", [(), (2,)], ids=str)
def test_filters_of_past_inputs_start_as_if_the_first_had_been_there_for_ever(shape):
    u = RNG.standard_normal((30, *shape))
    padded = np.concatenate([[u[0]] * 3, u])
    c = [0.5, 0.0, -0.25, 2.0]
    got = Alone(FIR(coefficients=c), T=T, u=shape).ticks(u=u)["y"]
    np.testing.assert_allclose(got, signal.lfilter(c, [1.0], padded, axis=0)[3:], rtol=0, atol=1e-14)
    got = Alone(MovingAverage(samples=4), T=T, u=shape).ticks(u=u)["y"]
    np.testing.assert_allclose(got, [padded[k : k + 4].mean(axis=0) for k in range(30)], rtol=0, atol=1e-14)


def test_a_moving_average_gathers_no_error():
    u = np.r_[np.full(20, 1e16), np.full(20, 0.1)]  # a running sum would be off by 1e16's rounding for ever
    assert Alone(MovingAverage(samples=5), T=T).ticks(u=u)["y"][-1] == pytest.approx(0.1, abs=1e-16)


@pytest.mark.parametrize(
    ("b", "a"), [([0.1], [1.0, -0.9]), ([2.0, 0.5, 1.0], [2.0]), ([1.0, 0.0, -0.3], [2.0, 0.1, 0.4, -0.2])]
)
def test_an_iir_filter_is_scipys(b, a):
    np.testing.assert_allclose(Alone(IIR(b=b, a=a), T=T).ticks(u=U)["y"], signal.lfilter(b, a, U), rtol=0, atol=1e-13)


@pytest.mark.parametrize("order", [2, 7])
def test_sections_are_filters_one_after_another(order):
    sections = signal.ellip(order, 1.0, 60.0, 0.05, output="sos")
    got = Alone(IIR.from_sos(sections), T=T).ticks(u=U)["y"]
    np.testing.assert_allclose(got, signal.sosfilt(sections, U), rtol=0, atol=1e-14)


def test_what_is_no_filter_is_refused():
    with pytest.raises(ParameterError, match=r"iir.b: found b of shape \(2,\) and a of shape \(1, 2\); expected two"):
        IIR(b=[1.0, 2.0], a=[[1.0, 2.0]])
    with pytest.raises(ParameterError, match=r"iir.a: found a first coefficient of zero"):
        IIR(b=[1.0, 2.0], a=[0.0, 2.0])
    with pytest.raises(ParameterError, match=r"found one coefficient each; expected two or more. Use Gain"):
        IIR(b=[1.0], a=[2.0])
    with pytest.raises(ParameterError, match=r"f.sections: found shape \(2, 5\); expected rows of six numbers"):
        IIR.from_sos(np.ones((2, 5)), name="f")
    with pytest.raises(ParameterError, match=r"fir.coefficients: found .* expected two coefficients or more. Use Gain"):
        FIR(coefficients=[1.0])


@pytest.mark.parametrize(
    "block",
    [DiscreteIntegrator(), FIR(coefficients=[1.0, 2.0]), IIR(b=[1.0], a=[1.0, 0.5]), MovingAverage(samples=2)],
    ids=lambda block: block.label,
)
def test_they_are_refused_in_a_continuous_frame(block):
    with pytest.raises(SampleTimeError, match=rf"{block.label}: .*continuous subsystem; put it into a @subsystem"):
        trace(block, dict.fromkeys(block.inputs, ()), sampled=False)

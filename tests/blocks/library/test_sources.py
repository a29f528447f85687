"""Sources, against closed forms: the smooth step against the one polynomial that its end conditions leave."""

import math

import numpy as np
import pytest
from scipy.interpolate import BPoly

from loopwright.blocks import Constant, ParameterError, Pulse, Reference, Sine, SmoothStep, Step, Sum, UnitError
from loopwright.diagrams import Diagram

# s(0) = 0, s(1) = 1, and three derivatives that vanish at both ends: eight conditions on a polynomial of 7th order
UNIT_STEP = BPoly.from_derivatives([0, 1], [[0, 0, 0, 0], [1, 0, 0, 0]])


def sampled(source, duration=2.0, step=0.01):
    """The output at every tick, and the ticks."""
    run = Diagram("sources", source.y.named("y")).simulate(duration, step=step, progress=False)
    return run.t, run["y"]


def smooth(t, start, duration, initial, final):
    """Value, rate and acceleration of one step, from the end conditions."""
    z, rise = np.clip((np.asarray(t) - start) / duration, 0.0, 1.0), final - initial
    parts = [rise * UNIT_STEP.derivative(n)(z) / duration**n for n in range(3)]
    return np.stack([initial + parts[0], *parts[1:]], axis=-1)


# --- constants and references -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [3.5, (1.0, -2.0, 0.0), ((1.0, 2.0, 3.0), (4.0, 5.0, -6.0))], ids=["0", "1", "2"])
def test_a_constant_has_the_shape_and_the_value_given(value):
    t, y = sampled(Constant(value=value), 0.1, 0.05)
    assert y.shape == (3, *np.shape(value))
    assert np.array_equal(y, np.broadcast_to(value, y.shape))
    assert len(t) == 3


def test_a_reference_is_a_value_at_rest():
    assert sampled(Reference(-0.7), 0.1, 0.05)[1].tolist() == [[-0.7, 0.0, 0.0]] * 3


# --- sine -------------------------------------------------------------------------------------------------------------


def test_a_sine_has_amplitude_frequency_phase_and_bias():
    source = Sine(amplitude=-1.5, frequency=0.75, phase=0.4, bias=2.25)
    t, y = sampled(source)
    want = [-1.5 * math.sin(2.0 * math.pi * 0.75 * s + 0.4) + 2.25 for s in t]
    np.testing.assert_allclose(y, want, rtol=0, atol=4e-15)


def test_a_phase_leads():
    # a quarter turn makes the cosine: 1 at once, 0 after a quarter of the period of 0.8 s
    _, y = sampled(Sine(frequency=1.25, phase=math.pi / 2), 0.8, 0.2)
    np.testing.assert_allclose(y, [1, 0, -1, 0, 1], atol=1e-15)
    _, y = sampled(Sine(frequency=1.25), 0.8, 0.2)
    np.testing.assert_allclose(y, [0, 1, 0, -1, 0], atol=1e-15)


def test_a_sine_of_no_frequency_rests_at_its_phase():
    _, y = sampled(Sine(frequency=0.0, phase=0.3, amplitude=2.0, bias=1.0), 0.1, 0.05)
    np.testing.assert_allclose(y, 1.0 + 2.0 * math.sin(0.3), rtol=1e-15)
    with pytest.raises(ParameterError, match=r"Sine\.frequency: found -1; expected"):
        Sine(frequency=-1)


# --- steps ------------------------------------------------------------------------------------------------------------


def test_steps_act_from_their_times_on():
    source = Step(times=(0.1, 0.35, 0.4), values=(2.0, -1.0, 0.5), initial_value=7.0)
    _, y = sampled(source, 0.5, 0.05)
    assert y.tolist() == [7, 7, 2, 2, 2, 2, 2, -1, 0.5, 0.5, 0.5]


def test_a_step_of_one_number_starts_at_zero_unless_told():
    assert sampled(Step(times=0.2, values=-3), 0.4, 0.1)[1].tolist() == [0, 0, -3, -3, -3]
    assert sampled(Step(times=0.0, values=4, initial_value=1), 0.1, 0.1)[1].tolist() == [4, 4]
    assert sampled(Step(times=0.15, values=4, initial_value=1), 0.2, 0.1)[1].tolist() == [1, 1, 4]


@pytest.mark.parametrize(
    ("times", "values"), [((0.1, 0.2), (1.0,)), (0.1, (1.0, 2.0)), ((0.2, 0.1), (1, 2)), ((0.1, 0.1), (1, 2))]
)
def test_times_and_values_that_do_not_fit_are_refused(times, values):
    with pytest.raises(ParameterError, match=r"step\.times: found times .*; expected rising times, one value each"):
        Step(times=times, values=values)


@pytest.mark.parametrize("source", [Step(times=1, values=1, unit="N"), Constant(value=1.0, unit="N")], ids=["s", "c"])
def test_the_unit_of_a_source_is_checked(source):
    with pytest.raises(UnitError, match=r"\.y is in m; .*\.y next to it is in N"):
        Diagram("units", Sum()(source, Constant(value=1.0, unit="m", name="other")))


# --- smooth steps -----------------------------------------------------------------------------------------------------


def test_a_smooth_step_is_the_polynomial_of_its_end_conditions_with_both_derivatives():
    t, y = sampled(SmoothStep(levels=(0.2, -1.3), start_times=(0.37,), durations=(1.1,)))
    want = smooth(t, 0.37, 1.1, 0.2, -1.3)
    assert y.shape == (201, 3)
    np.testing.assert_allclose(y, want, rtol=0, atol=2e-14)  # |r''| <= 7.52 * 1.5/1.1^2 < 10
    assert np.abs(want).max(axis=0) == pytest.approx(
        [1.3, 35 / 16 * 1.5 / 1.1, 84 / 5**2.5 * 5 * 1.5 / 1.1**2], rel=1e-3
    )


def test_a_smooth_step_goes_half_way_in_half_the_time_and_is_even_about_it():
    # s(1/2) = 1/2, s'(1/2) = 35/16, s''(1/2) = 0
    _, y = sampled(SmoothStep(levels=(1.0, 3.0), start_times=0.5, durations=2.0), 3.0, 0.25)
    np.testing.assert_allclose(y[6], [2.0, 35 / 16, 0.0], atol=1e-14)
    np.testing.assert_allclose(y[2:11, 0] - 2.0, 2.0 - y[10:1:-1, 0], atol=1e-14)
    assert y[:3].tolist() == [[1.0, 0.0, 0.0]] * 3
    np.testing.assert_allclose(y[10:], [[3.0, 0.0, 0.0]] * 3, atol=1e-14)


def test_smooth_steps_follow_each_other_through_their_levels():
    source = SmoothStep(levels=(0.1, 0.6, -0.2, 0.3), start_times=(0.2, 0.7, 1.4), durations=(0.5, 0.4, 0.6))
    t, y = sampled(source)
    want = smooth(t, 0.2, 0.5, 0.1, 0.6)
    want += smooth(t, 0.7, 0.4, 0.0, -0.8)
    want += smooth(t, 1.4, 0.6, 0.0, 0.5)
    np.testing.assert_allclose(y, want, rtol=0, atol=4e-14)  # |r''| <= 7.52 * 0.8/0.4^2 < 40
    levels = [y[round(s / 0.01), 0] for s in (0.0, 0.7, 1.2, 2.0)]
    np.testing.assert_allclose(levels, [0.1, 0.6, -0.2, 0.3], atol=1e-14)


def test_smooth_steps_that_overlap_or_do_not_fit_are_refused():
    with pytest.raises(ParameterError, match=r"start_times: found a step that starts before the one before it ends"):
        SmoothStep(levels=(0, 1, 2), start_times=(0.0, 0.9), durations=(1.0, 1.0))
    with pytest.raises(ParameterError, match=r"levels: found 2 levels, 2 start times and 2 durations"):
        SmoothStep(levels=(0, 1), start_times=(0.0, 2.0), durations=(1.0, 1.0))
    with pytest.raises(ParameterError, match=r"durations: found 0; expected a value above 0 in s"):
        SmoothStep(levels=(0, 1), start_times=0.0, durations=0)


# --- pulses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flank", [None, 0.35], ids=["default", "0.35 s"])
def test_a_pulse_rises_holds_and_falls(flank):
    rise = 0.2 if flank is None else flank
    given = {} if flank is None else {"rise_time": flank}
    t, y = sampled(Pulse(start_time=0.45, end_time=1.65, amplitude=-2.5, **given))
    up, down = (smooth(t, at, rise, 0.0, 1.0)[:, 0] for at in (0.45, 1.65 - rise))
    np.testing.assert_allclose(y, -2.5 * (up - down), rtol=0, atol=2e-14)
    assert not np.any(y[t <= 0.45])
    np.testing.assert_allclose(y[t >= 1.65], 0.0, atol=2e-14)
    top = (t > 0.45 + rise + 1e-9) & (t < 1.65 - rise - 1e-9)
    assert top.sum() > 40
    np.testing.assert_allclose(y[top], -2.5, rtol=1e-14)


def test_a_pulse_shorter_than_its_flanks_is_refused():
    assert sampled(Pulse(start_time=0.1, end_time=0.5, amplitude=1.0), 0.3, 0.1)[1][-1] == pytest.approx(1.0)
    with pytest.raises(ParameterError, match=r"end_time: found 0\.3 s .*; expected at least the two flanks, 0\.4 s"):
        Pulse(start_time=0.1, end_time=0.4, amplitude=1.0)

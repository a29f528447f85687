"""Numbers of a step of a run: closed forms, python-control's step_info, and what is refused."""

import control
import numpy as np
import pytest

from loopwright.blocks import PT1, OptionError, Step, TransferFunction
from loopwright.diagrams import Diagram, subsystem

DAMPING = 0.3


def oscillator(*, at=0.5, height=2.0, name="step"):
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 2 * DAMPING, 1.0], name="plant")
    return Diagram("ringing", plant(Step(times=at, values=height, name=name)).named("y"))


@pytest.fixture(scope="module")
def run():
    return oscillator().simulate(40.5, step=0.01, progress=False)


def test_the_numbers_are_those_of_the_closed_form(run):
    """1/(s² + 2 ζ s + 1): the overshoot is exp(−π ζ/√(1 − ζ²)), at π/√(1 − ζ²)."""
    info, omega = run.step_info("y"), np.sqrt(1.0 - DAMPING**2)
    assert info.overshoot == pytest.approx(np.exp(-np.pi * DAMPING / omega), rel=1e-4)
    assert info.peak_time == pytest.approx(np.pi / omega, abs=0.01)
    assert info.peak == pytest.approx(2.0 + 2.0 * info.overshoot, rel=1e-4)
    assert (info.start_value, info.undershoot, info.since) == (0.0, 0.0, 0.5)
    assert info.steady_state_value == pytest.approx(2.0, rel=1e-4)


def test_they_are_those_of_python_control_by_its_names(run):
    t = np.arange(0.0, 40.0, 0.01)
    wanted = control.step_info(2.0 * control.tf([1.0], [1.0, 2 * DAMPING, 1.0]), t)
    found = run.step_info("y").as_dict()
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name] == pytest.approx(float(value), rel=2e-3, abs=0.02), name


def test_a_step_from_another_value_downwards_and_times_of_a_lag():
    """A lag with the time constant T rises in T ln 9, and is within 2 % after T ln 50."""
    lag = PT1(time_constant=0.5, initial_value=4.0)(Step(times=1.0, values=1.0, initial_value=4.0)).named("y")
    info = Diagram("lag", lag).simulate(8.0, step=1e-3, progress=False).step_info("y")
    assert (info.start_value, info.overshoot) == (4.0, 0.0)
    assert info.rise_time == pytest.approx(0.5 * np.log(9.0), rel=1e-4)
    assert info.settling_time == pytest.approx(0.5 * np.log(50.0), rel=1e-4)
    assert info.peak == info.settling_min == pytest.approx(1.0, abs=1e-5)


def test_an_undershoot_of_a_zero_in_the_right_half_plane():
    plant = TransferFunction(numerator=[-1.0, 1.0], denominator=[1.0, 2.0, 1.0], name="plant")
    run = Diagram("zero", plant(Step(times=0.2, values=1.0)).named("y")).simulate(20.0, step=1e-3, progress=False)
    t = np.linspace(0.0, 10.0, 100_001)
    closed = 1.0 - np.exp(-t) - 2.0 * t * np.exp(-t)
    assert run.step_info("y").undershoot == pytest.approx(-closed.min(), rel=1e-5)


def test_a_held_signal_is_measured_at_its_samples():
    @subsystem(sample_time=0.5)
    def half(u):
        return PT1(time_constant=1.0, name="lag")(u).named("y")

    plant = TransferFunction(numerator=[1.0], denominator=[0.01, 1.0], name="plant")
    run = Diagram("held", plant(half(Step(times=1.0, values=1.0)))).simulate(12.0, step=0.05, progress=False)
    expected = 0.5 * np.ceil(np.log(50.0) / 0.5)
    assert run.step_info("y").settling_time == pytest.approx(expected, abs=1e-9)


def test_a_signal_that_is_not_at_rest_has_a_peak_alone():
    info = oscillator().simulate(5.0, progress=False).step_info("y")
    assert np.isnan([info.overshoot, info.settling_time, info.rise_time, info.steady_state_value]).all()
    assert not info.is_settled
    assert info.peak == pytest.approx(2.0 + 2.0 * np.exp(-np.pi * DAMPING / np.sqrt(1 - DAMPING**2)), rel=1e-3)
    assert "The signal still moves at the end" in str(info)
    assert np.isinf(oscillator().simulate(60.0, progress=False).step_info("y", final=2.2).settling_time)


def test_what_is_shown(run):
    lines = [" ".join(line.split()) for line in str(run.step_info("y")).splitlines()]
    assert lines[0] == "step of 'y' at 0.5 s, until 40.5 s"
    assert "overshoot 0.372327 37.2 %" in lines or any(line.startswith("overshoot 0.372") for line in lines)
    assert repr(run.step_info("y")).startswith("<step of 'y' at 0.5 s: overshoot 37.2")


@pytest.mark.parametrize(
    ("ask", "text"),
    [
        (lambda run: run.step_info("plant.u"), "no signal"),
        (lambda run: run.step_info("y", since=40.49), r"y\.since: found 2 samples from 40.49 s"),
        (lambda run: run.step_info("y").SettlingTime, r"Write info\.settling_time"),
        (lambda run: run.step_inf, "Did you mean 'step_info'"),
        (lambda run: run.overshoot, r'Write run\.step_info\("wire"\)'),
    ],
)
def test_what_is_refused(run, ask, text):
    with pytest.raises((LookupError, AttributeError, OptionError), match=text):
        ask(run)


def test_several_steps_ask_for_the_one_that_is_meant():
    lag = PT1(time_constant=0.2)
    target, load = Step(times=0.1, values=1.0, name="target"), Step(times=5.0, values=-0.5, name="load")
    run = Diagram("two", lag(target + load).named("y")).simulate(10.0, step=1e-3, progress=False)
    with pytest.raises(OptionError, match=r"target at 0.1 s, load at 5 s; .* since=0\.1, until=5\."):
        run.step_info("y")
    first, second = run.step_info("y", since=0.1, until=5.0), run.step_info("y", since=5.0)
    assert (first.steady_state_value, second.start_value) == pytest.approx((1.0, 1.0), abs=1e-6)
    assert first.settling_time == pytest.approx(0.2 * np.log(50.0), rel=1e-3)
    assert second.steady_state_value == pytest.approx(0.5, abs=1e-6)

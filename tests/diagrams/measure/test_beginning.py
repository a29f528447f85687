"""Measurements that begin at any operating point, against closed forms."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PID, Constant, Integrator, OptionError, TransferFunction, TransportDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.measure import step_response
from loopwright.diagrams.measure.beginning import divide_time
from loopwright.fmus import Fmu
from support.misstated import A, B, misstated_fmu

DT = 0.01


def lag_loop():
    """L = 2 / (s + 1) behind a set point of 1."""
    plant = TransferFunction(numerator=[2.0], denominator=[1.0, 1.0], name="plant")
    return Diagram("lag", plant((Constant(value=1.0, name="wish") - plant.y).named("u")))


@pytest.mark.parametrize("t", [1000.0, 0.37, 1e-3, 1 / 3])
@pytest.mark.parametrize("length", [2.0, 0.002, 30.0])
@pytest.mark.drawn(2)
def test_a_continuous_diagram_answers_a_step_at_any_time(t, length):
    """T = 2 / (s + 3): 2/3 (1 − e^(−3 t)), whatever has gone before."""
    found = step_response(lag_loop().wired, "u", size=0.1, length=length, at=t, outputs=["plant.y"])
    exact = 2 / 3 * (1 - np.exp(-3 * found.t))
    assert length <= found.t[-1] < 1.01 * length + 2 * found.dt
    np.testing.assert_allclose(found.answer(), exact, atol=1e-6)  # of two solved runs
    np.testing.assert_allclose(found.answer(linear=True), exact, atol=1e-12)
    assert found.wire_before == pytest.approx(1 / 3 + 2 / 3 * np.exp(-3 * (t + found.dt)), abs=1e-5)


@pytest.mark.parametrize("t", [1000.0, 0.37])
@pytest.mark.parametrize("how", ["time", "point", "instant"])
@pytest.mark.drawn(1)
def test_a_continuous_diagram_is_measured_at_any_time(t, how):
    diagram = lag_loop()
    given = {"time": lambda: t, "point": lambda: diagram.operating_point(t), "instant": lambda: _instant(diagram, t)}
    found = diagram.frequency_response("u", [1.0, 3.0], amplitude=1e-3, at=given[how]())
    error = np.abs(found.L.frdata[0, 0] / (2 / (1j * found.omega + 1)) - 1)
    assert np.all(error < found.uncertainty + 1e-8)
    assert np.all(error < (5e-3 if how == "instant" else 1e-5))  # that run had tolerances of its own
    assert np.all(found.settled) == (t == 1000.0)  # at 0.37 s it still moves


def _instant(diagram, t):
    return diagram.simulate(t, progress=False).at(t)


def test_a_measurement_finds_the_diagram_where_a_reference_has_brought_it():
    """A cube at the plant's input: its slope is 3 u² with u³ = the ramp's end."""
    plant = Integrator(name="plant")
    error = (Constant(value=8.0, name="wish") - plant.y).named("e")
    diagram = Diagram("cubic", plant((error * error * error).named("u") - Constant(value=1.0, name="load")))
    found = step_response(diagram.wired, "e", size=1e-5, length=1.0, at=100.0)
    np.testing.assert_allclose(found.answer(), 1 - np.exp(-3 * found.t), atol=2e-5)


def test_the_past_of_a_delay_is_part_of_the_beginning():
    """After 3.2 s of a delay's 5 s nothing has come back yet: an integrator's ramp, and a step on top of it."""
    delay, plant = TransportDelay(delay=5.0, initial_value=1.0, name="delay"), Integrator(name="plant")
    diagram = Diagram("late", plant((0.1 * (Constant(value=0.25, name="wish") - delay(plant.y))).named("u")))
    s = diagram.frequency_response("u", [0.2], amplitude=1e-3, at=3.2)
    w = s.omega
    np.testing.assert_allclose(s.L.frdata[0, 0], 0.1 * np.exp(-5j * w) / (1j * w), rtol=1e-5)


@pytest.mark.parametrize(("t", "longest"), [("1000", "1/7"), ("1/3", "1/1000"), ("1/1000", "1/10"), ("0", "1/10")])
def test_a_time_is_a_whole_number_of_steps(t, longest):
    step = divide_time(Fraction(t), Fraction(longest))
    assert (Fraction(t) / step).denominator == 1
    assert Fraction(longest) / 2 < step <= Fraction(longest) or step == Fraction(t)


def hidden_state_loop(tmp_path, interface="co_simulation"):
    """A mass on a spring, an FMU whose states can't be set, with a sampled PI law of its place."""
    plant = Fmu(misstated_fmu(tmp_path, 3, hides_state=True), interface=interface, ports=["u", "x"], name="plant")

    @subsystem(sample_time=DT)
    def controller(x):
        return PID(kp=20.0, ki=60.0, name="pid")(Constant(value=0.2, name="wish"), x)

    return Diagram("loop", plant(u=controller(plant["x"]).named("u")))


def hidden_state_answer(samples):
    """The recurrence of the plant, held over DT, and of the PI law by forward Euler: states x, v, integral."""
    held = expm(np.block([[A, B], [np.zeros((1, 3))]]) * DT)[:2]
    law = np.array([[-20.0, 0.0, 1.0]])  # u = −kp x + integral
    M = np.zeros((3, 3))
    M[:2, :2], M[2, 2] = held[:, :2], 1.0
    M[2, 0] = -60.0 * DT
    z, found = np.zeros(3), []
    for k in range(samples):
        d = 1.0 if k else 0.0
        v = float((law @ z)[0])
        found.append(-v)
        z = M @ z + np.append(held[:, 2] * (v + d), 0.0)
    return np.array(found)


@pytest.mark.slow
def test_a_plant_whose_states_cannot_be_set_is_run_to_the_point(tmp_path):
    diagram = hidden_state_loop(tmp_path)
    for at in (2.0, diagram.operating_point(2.0)):
        found = step_response(diagram.wired, "u", size=0.1, length=1.0, at=at)
        assert found.prediction is not None
        exact = hidden_state_answer(len(found.t) + 1)
        np.testing.assert_allclose(found.answer(linear=True), found.answer(), atol=1e-7)
        shift = [np.abs(found.answer() - exact[k : k + len(found.t)]).max() for k in (0, 1)]
        assert min(shift) < 1e-7


def test_a_point_that_a_repeated_run_does_not_reach_is_refused(tmp_path):
    """It was reached from other states of the diagram's start."""
    diagram = hidden_state_loop(tmp_path)
    other = diagram.replace({"controller.wish.value": 0.9})
    point = other.operating_point(2.0)
    with pytest.raises(OptionError, match="found a state off by .* after a run from the start to t = 2 s"):
        step_response(diagram.wired, "u", size=0.1, length=1.0, at=point)


@pytest.mark.slow
def test_a_report_at_a_trimmed_point_injects_there():
    """At its start a sampled cubic law is 2 off its rest, with four times the slope."""
    plant = Integrator(name="plant")

    @subsystem(sample_time=DT)
    def controller(y):
        error = Constant(value=3.0, name="wish") - y
        return (error * error * error).named("u")

    diagram = Diagram("cubic", plant(controller(plant.y) - Constant(value=1.0, name="load")))
    numbers = diagram.report(at=diagram.trim(targets={"plant.y": 2.0}), only=("injection",)).numbers()
    assert numbers["injection.u.sampled_d0.deviation"].value < 1e-5


@pytest.mark.parametrize("at", [1000.0, 0.0])
@pytest.mark.drawn(1)
def test_a_report_has_the_steps_of_a_continuous_diagram_at_any_time(at):
    numbers = lag_loop().report(at=at, only=("steps",)).numbers()
    assert numbers["steps.u.continuous.rise"].value == pytest.approx(np.log(9.0) / 3.0, rel=1e-3)

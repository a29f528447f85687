"""Continuous blocks in sampled subsystems: recurrences written by hand, matrix exponentials, and order against SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import Block, Constant, Input, SampleTimeError, State, hold
from loopwright.diagrams import Diagram, subsystem
from support.sampled import TICKS, Pendulum, Rotor, T, Wave, run_of, states, wave

EULER = pytest.mark.parametrize("method", ["forward", "semi_implicit"])


# --- nonlinear blocks: Euler's methods --------------------------------------------------------------------------------


def pendulum_by_hand(method, torques, stiffness=9.0, damping=0.4, h=T):
    angle, rate, rows = 1.2, -0.5, []
    for k, torque in enumerate(torques):
        rows.append((angle, rate))
        acceleration = -stiffness * np.sin(angle) - damping * rate + (1.0 + 0.5 * k * h) * torque
        if method == "semi_implicit":  # the rate first, then the angle with the new rate
            rate = rate + h * acceleration
            angle = angle + h * rate
        else:
            angle, rate = angle + h * rate, rate + h * acceleration
    return np.array(rows)


@pytest.mark.parametrize("method", ["forward", "semi_implicit", "exact"])
def test_a_pendulum_goes_by_the_recurrence_of_the_named_method(method):
    # what is not linear in its states has no exact discretization: forward Euler then
    run = run_of(Pendulum(name="p"), Wave()().y[0], method)
    torques = [wave(k * T)[0] for k in range(TICKS + 1)]
    got = states(run, "p.angle", "p.rate")
    np.testing.assert_allclose(got, pendulum_by_hand(method, torques), rtol=0, atol=1e-12)
    other = pendulum_by_hand("semi_implicit" if method != "semi_implicit" else "forward", torques)
    assert np.abs(got - other).max() > 0.01  # they are told apart


def test_parameters_of_a_nonlinear_block_act():
    run = run_of(Pendulum(name="p", stiffness=4.0, damping=1.5), Wave()().y[0], "semi_implicit")
    torques = [wave(k * T)[0] for k in range(TICKS + 1)]
    want = pendulum_by_hand("semi_implicit", torques, stiffness=4.0, damping=1.5)
    np.testing.assert_allclose(states(run, "p.angle", "p.rate"), want, rtol=0, atol=1e-12)


@EULER
def test_states_are_renewed_from_the_last_to_the_first_each_with_those_already_new(method):
    run = run_of(Rotor(name="r"), Wave()(), method)
    a, b, c = 1.0, -0.4, 2.0
    rows = []
    for k in range(TICKS + 1):
        rows.append((a, b, c))
        u = wave(k * T)
        if method == "semi_implicit":
            c = c + T * 0.3 * a * b
            b = b + T * (-0.9 * c * a + u[1])
            a = a + T * (0.7 * b * c + u[0])
        else:
            a, b, c = a + T * (0.7 * b * c + u[0]), b + T * (-0.9 * c * a + u[1]), c + T * 0.3 * a * b
    np.testing.assert_allclose(states(run, "r.across", "r.along"), rows, rtol=1e-12, atol=1e-12)


class Bilinear(Block):
    """Its rate is proportional to state and input: linear in the state, with a matrix that is not constant."""

    u = Input()
    x = State(start=1.0, output=True)

    def derivative(self, t, x, u):
        return -x.x * u.u


def test_a_matrix_that_depends_on_the_input_is_not_taken_for_a_constant_one():
    run = run_of(Bilinear(name="b"), Wave()().y[1])
    want = np.cumprod([1.0, *(1.0 - T * wave(k * T)[1] for k in range(TICKS))])
    np.testing.assert_allclose(run["b.x"], want, rtol=1e-12)


@EULER
def test_both_are_of_first_order(method):
    torque, errors, steps = 0.8, [], (0.02, 0.01, 0.005)
    exact = solve_ivp(
        lambda t, x: (x[1], -9.0 * np.sin(x[0]) - 0.4 * x[1] + (1.0 + 0.5 * t) * torque),
        (0.0, 1.0),
        (1.2, -0.5),
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    ).y[:, -1]
    for h in steps:
        run = run_of(Pendulum(name="p"), Constant(value=torque), method, h, round(1.0 / h))
        errors.append(np.abs(states(run, "p.angle", "p.rate")[-1] - exact).max())
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.15)
    assert errors[-1] > 1e-4  # of the size of the step, far from rounding


# --- rates and integrals ----------------------------------------------------------------------------------------------------


def test_the_sample_time_is_that_of_the_frame():
    # two rates: looked at every 10 ms, one pendulum's every 20 ms, the other's every 50 ms, held between
    @subsystem(sample_time=0.05)
    def slow(u):
        return Pendulum(name="slow")(u)

    @subsystem(sample_time=T)
    def fast(u):
        return Pendulum(name="fast")(u)

    signal = Wave()().y[0]
    run = Diagram("rates", *slow(signal), *fast.replace(name="f")(signal)).simulate(2.0, step=0.01, progress=False)
    assert np.diff(run.t) == pytest.approx(0.01)
    for name, every, ticks in (("slow", 5, 40), ("fast", 2, 100)):
        h = 0.01 * every
        want = pendulum_by_hand("forward", [wave(k * h)[0] for k in range(ticks)], h=h)
        got = states(run, f"{name}.angle", f"{name}.rate")[:-1]
        np.testing.assert_allclose(got, np.repeat(want, every, axis=0), rtol=0, atol=1e-12)


class Integrator(Block):
    """The integral of its input."""

    u = Input()
    x = State(start=0.25, output=True)

    def derivative(self, t, x, u):
        return 3.0 * u.u


@pytest.mark.parametrize("method", ["exact", "forward", "semi_implicit"])
def test_an_integral_of_held_inputs_is_their_sum(method):
    run = run_of(Integrator(name="i"), Wave()().y[0], method)
    want = 0.25 + 3.0 * T * np.cumsum([0.0, *(wave(k * T)[0] for k in range(TICKS))])
    np.testing.assert_allclose(run["i.x"], want, rtol=0, atol=1e-12)


# --- the hold itself --------------------------------------------------------------------------------------------------


def test_the_exact_hold_of_an_oscillator_turns_and_decays():
    # x'' + 2 d x' + (d^2 + w^2) x = f from its closed form
    d, w, h = 0.7, 5.0, 0.13
    transition, forcing = hold(np.array([[0.0, 1.0], [-(d**2 + w**2), -2.0 * d]]), h, "exact")
    c, s, decay = np.cos(w * h), np.sin(w * h), np.exp(-d * h)
    want = decay * np.array([[c + d / w * s, s / w], [-(d**2 + w**2) / w * s, c - d / w * s]])
    np.testing.assert_allclose(transition, want, rtol=0, atol=1e-14)
    np.testing.assert_allclose(forcing[:, 1], [(1 - want[0, 0]) / (d**2 + w**2), want[0, 1]], rtol=0, atol=1e-14)


@EULER
def test_the_holds_of_eulers_methods_are_their_recurrences(method):
    rng, h = np.random.default_rng(8), 0.07
    A, x, g = rng.standard_normal((4, 4)), rng.standard_normal(4), rng.standard_normal(4)
    new = x.copy()
    for i in (3, 2, 1, 0):
        new[i] = x[i] + h * (A[i] @ (new if method == "semi_implicit" else x) + g[i])
    transition, forcing = hold(A, h, method)
    np.testing.assert_allclose(transition @ x + forcing @ g, new, rtol=1e-13, atol=1e-14)


def test_a_method_that_is_none_is_refused():
    with pytest.raises(
        SampleTimeError, match=r"found the method 'euler'; expected one of exact, forward, semi_implicit, trap"
    ):
        hold(np.eye(1), 0.1, "euler")
    with pytest.raises(
        SampleTimeError, match=r"subsystem\.method: found the method 'implicit'; .* Did you mean 'semi_im"
    ):
        subsystem(sample_time=0.1, method="implicit")(lambda u: Integrator()(u))

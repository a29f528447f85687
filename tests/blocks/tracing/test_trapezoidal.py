"""Trapezoidal steps in sampled subsystems: recurrences solved by hand, order against SciPy, steps without a solution."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import Block, Constant, GuardError, Input, SampleTimeError, State, hold
from loopwright.blocks.library.piecewise_functions import piecewise
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import NonFiniteError
from support.sampled import TICKS, Pendulum, Rotor, T, Wave, network, run_of, states, wave


def solved_by_iteration(f, x, t, h):
    """The step of a slow system: the fixed point of x⁺ = x + h/2 (f(t, x) + f(t + h, x⁺)), iterated to the last bit."""
    new = x + h * f(t, x)
    for _ in range(200):
        new = x + h / 2 * (f(t, x) + f(t + h, new))
    return new


def pendulum(torque):
    return lambda t, x: np.array([x[1], -9.0 * np.sin(x[0]) - 0.4 * x[1] + (1.0 + 0.5 * t) * torque])


def test_a_nonlinear_block_goes_by_the_solution_of_the_step():
    run = run_of(Pendulum(name="p"), Wave()().y[0], "trapezoidal")
    x, rows = np.array([1.2, -0.5]), []
    for k in range(TICKS + 1):
        rows.append(x)
        x = solved_by_iteration(pendulum(wave(k * T)[0]), x, k * T, T)
    np.testing.assert_allclose(states(run, "p.angle", "p.rate"), rows, rtol=0, atol=1e-12)


def test_states_that_are_vectors_are_solved_together():
    run = run_of(Rotor(name="r"), Wave()(), "trapezoidal")
    x, rows = np.array([1.0, -0.4, 2.0]), []
    for k in range(TICKS + 1):
        rows.append(x)
        a, b = wave(k * T)
        x = solved_by_iteration(
            lambda t, x, a=a, b=b: np.array([0.7 * x[1] * x[2] + a, -0.9 * x[2] * x[0] + b, 0.3 * x[0] * x[1]]),
            x,
            k * T,
            T,
        )
    np.testing.assert_allclose(states(run, "r.across", "r.along"), rows, rtol=1e-11, atol=1e-11)


def test_a_linear_block_goes_by_the_recurrence_of_the_trapezoidal_rule():
    block = network(4).replace(name="n")
    run = run_of(block, Wave()(), "trapezoidal")
    x, rows, eye = block.start.copy(), [], np.eye(len(block.g))
    for k in range(TICKS + 1):
        rows.append(x)
        drive = block.B @ wave(k * T) + block.g
        x = np.linalg.solve(eye - T / 2 * block.A, x + T / 2 * block.A @ x + T * drive)
    np.testing.assert_allclose(run["n.x"], rows, rtol=1e-11, atol=1e-11)


class Drift(Block):
    """Linear in its state, with a rate that depends on time; without damping an integral of time alone."""

    damping = 0.0
    u = Input()
    x = State(start=1.0, output=True)

    def derivative(self, t, x, u):
        return -self.damping * x.x + np.sin(3.0 * t) + u.u


class Damped(Drift):
    """With damping."""

    damping = 2.0


@pytest.mark.parametrize("block", [Drift, Damped])
def test_what_depends_on_time_is_the_mean_of_both_ends(block):
    run = run_of(block(name="d"), Constant(value=0.25), "trapezoidal")
    a, x, rows = block.damping, 1.0, []
    for k in range(TICKS + 1):
        rows.append(x)
        g = (np.sin(3.0 * k * T) + np.sin(3.0 * (k + 1) * T)) / 2 + 0.25
        x = ((1 - a * T / 2) * x + T * g) / (1 + a * T / 2)
    np.testing.assert_allclose(run["d.x"], rows, rtol=0, atol=1e-12)


@pytest.mark.parametrize("stiffness", [9.0, 900.0])
def test_it_is_of_second_order(stiffness):
    torque, errors, steps = 0.8, [], np.array([0.02, 0.01, 0.005, 0.0025]) * 3.0 / np.sqrt(stiffness)
    exact = solve_ivp(
        lambda t, x: (x[1], -stiffness * np.sin(x[0]) - 0.4 * x[1] + (1.0 + 0.5 * t) * torque),
        (0.0, 0.6),
        (1.2, -0.5),
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    ).y[:, -1]
    for h in steps:
        h = float(f"{h:.6g}")
        run = run_of(Pendulum(name="p", stiffness=stiffness), Constant(value=torque), "trapezoidal", h, round(0.6 / h))
        errors.append(np.abs(states(run, "p.angle", "p.rate")[-1] - exact).max())
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.05)
    assert errors[-1] > 1e-8


class Stiff(Block):
    """x' = -k (x - cos t) - x^3: stiff, and slow once it is there."""

    u = Input()
    x = State(start=0.0, output=True)

    def derivative(self, t, x, u):
        return -u.u * (x.x - np.cos(t)) - x.x**3


def test_a_stiff_block_does_not_blow_up():
    # 1e5 1/s with a step of 20 ms: forward Euler would grow by 2000 a tick
    run = run_of(Stiff(name="s"), Constant(value=1e5), "trapezoidal", ticks=2000)
    assert np.abs(run["s.x"]).max() < 2.1
    assert np.abs(run["s.x"][-1] - np.cos(40.0)) < 0.3  # the jump at the start rings out slowly, as it must


class Spring(Block):
    """x'' = -force(x) with a force given as a table: what looks something up is no scalar function."""

    u = Input()
    x = State(start=1.5, output=True)
    v = State(start=0.0, output=True)

    def derivative(self, t, x, u):
        force = piecewise(
            np.array([-2.0, 0.0, 1.0, 2.0]),
            np.array([[[-8.0, 4.0]], [[0.0, 2.0]], [[2.0, 6.0]]]),
            x.x,
        )
        return x.v, u.u - force[0]


@pytest.mark.slow
def test_a_table_is_solved_too():
    run = run_of(Spring(name="s"), Constant(value=0.1), "trapezoidal")
    x, rows = np.array([1.5, 0.0]), []
    for _ in range(TICKS + 1):
        rows.append(x)
        x = solved_by_iteration(
            lambda t, x: np.array([x[1], 0.1 - np.interp(x[0], [-2, 0, 1, 2], [-8, 0, 2, 8])]), x, 0.0, T
        )
    np.testing.assert_allclose(states(run, "s.x", "s.v"), rows, rtol=0, atol=1e-11)


class Burst(Block):
    """x' = x^2: the trapezoidal step from x has a solution for 4 T (1 + x T / 2) x <= 2 only."""

    u = Input()
    x = State(start=1.0, output=True)

    def derivative(self, t, x, u):
        return x.x**2


def test_a_step_without_a_solution_is_an_error_and_not_a_number():
    with pytest.raises(GuardError, match=r"b, t = 0 s: its trapezoidal step is not solved: .* a smaller sample time"):
        run_of(Burst(name="b"), Constant(value=0.0), "trapezoidal", sample_time=0.9)
    run = run_of(Burst(name="b"), Constant(value=0.0), "trapezoidal", sample_time=0.1, ticks=4)
    want = [1.0]
    for _ in range(4):  # the smaller root of T/2 y^2 - y + x + T/2 x^2 = 0
        c = want[-1] + 0.05 * want[-1] ** 2
        want.append((1.0 - np.sqrt(1.0 - 4 * 0.05 * c)) / 0.1)
    np.testing.assert_allclose(run["b.x"], want, rtol=1e-12)


def test_an_undefined_rate_is_named_as_such_and_not_as_a_step_that_is_not_solved():
    class Tank(Block):
        u = Input()
        level = State(start=0.01, output=True)

        def derivative(self, t, x, u):
            return -np.sqrt(x.level) + u.u

    with pytest.raises(NonFiniteError, match=r"tank.*found \[nan\]"):
        run_of(Tank(name="tank"), Constant(value=0.0), "trapezoidal", sample_time=1.0, ticks=3)


def test_own_guards_stay_beside_that_of_the_step():
    class Guarded(Pendulum):
        def guards(self, t, x, u):
            return {"upright": 3.0 - np.abs(x.angle)}

    traced = trace(Guarded(), {"torque": ()}, sampled=True, method="trapezoidal")
    assert traced.guards == ("upright", "trapezoidal step")
    with pytest.raises(GuardError, match="guard 'upright' is"):
        run_of(Guarded(name="p"), Constant(value=40.0), "trapezoidal")


# --- the hold ---------------------------------------------------------------------------------------------------------


def test_the_trapezoidal_hold_of_a_lag_and_of_an_oscillator():
    transition, forcing = hold(np.array([[-4.0]]), 0.1, "trapezoidal")
    np.testing.assert_allclose([transition, forcing], [[[0.8 / 1.2]], [[0.1 / 1.2]]], rtol=1e-15)
    transition, _ = hold(np.array([[0.0, 5.0], [-5.0, 0.0]]), 0.2, "trapezoidal")  # a rotation by 2 atan(w T / 2)
    angle = 2.0 * np.arctan(0.5)
    want = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    np.testing.assert_allclose(transition, want, rtol=1e-14)


def test_a_trapezoidal_hold_that_does_not_exist_is_refused():
    with pytest.raises(SampleTimeError, match=r"step of 0.5 s has no solution: a pole is at 2/T = 4 1/s"):
        hold(np.array([[4.0]]), 0.5, "trapezoidal")

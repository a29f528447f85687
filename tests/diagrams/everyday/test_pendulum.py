"""An inverted pendulum on a cart: `control.dlqr` and a stationary Kalman filter at 100 Hz.

Cart 0.5 kg with friction 0.1 N s/m, pendulum 0.2 kg, l = 0.3 m to its center of mass, J = 6 g m². The position of the
cart and the angle are measured. K: weights (100, 1, 100, 1) and 1 of the force; the filter: variances (10⁻⁶, 10⁻²,
10⁻⁶, 10⁻¹) of the states a sample, 10⁻⁵ of both measurements. The filter predicts with the force that the controller
sends: x̂[k + 1] = A x̂ + B u + L (y − C x̂).

By hand. The loop is the one at the plant's input: C(z) = K (z − A + B K + L C)⁻¹ L, with the filter's model inside,
times the plant. Its crossover is at 14.9 rad/s; 45.7° of phase margin, gain margins 0.45 and 3.67, M_s = 1.45.
(Cutting the force ahead of the filter as well would give the loop of the state feedback alone.) A step of 0.1 m
overshoots by 2 % and settles in 2.1 s. Verdict: passed.

Breaking: three samples of computing time, which the filter does not know: 30 ms · 14.9 rad/s = 25.7° less, 20.0°. The
phase margin at the force fails, and with it the gain margin (1.66) and M_s (3.3). The step response hardly changes.

Harmless: a pendulum of 0.25 kg: 46.8°, gain margins 0.45 and 3.45.
"""

import control
import numpy as np
import pytest

from loopwright.blocks import Block, Gain, Input, State, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, discretize, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

CART, ARM, TURNING, ROLLING, G, T, SIZE = 0.5, 0.3, 0.006, 0.1, 9.81, 0.01, 0.1
C = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
STATES = ["x1", "x2", "x3", "x4"]


def linear(mass):
    """Return the matrices of position, speed, angle from upright and its rate."""
    inertia = TURNING + mass * ARM**2
    p = TURNING * (CART + mass) + CART * mass * ARM**2
    A = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [0.0, -inertia * ROLLING / p, (mass * ARM) ** 2 * G / p, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [0.0, -mass * ARM * ROLLING / p, mass * G * ARM * (CART + mass) / p, 0.0],
        ]
    )
    return A, np.array([0.0, inertia / p, 0.0, mass * ARM / p])


AD, BD = discretize(*linear(0.2), T)
K = control.dlqr(AD, BD, np.diag([100.0, 1.0, 100.0, 1.0]), [[1.0]])[0][0]
L = control.dlqr(AD.T, C.T, np.diag([1e-6, 1e-2, 1e-6, 1e-1]), 1e-5 * np.eye(2))[0].T


def law_of(delay):
    late = [f"late{i}" for i in range(delay)]

    def law(k, x, memory, wanted, wire):
        seen = np.array([memory[name] for name in STATES])
        u = -(K @ seen - K[0] * wanted)
        news = np.array([x[0], x[2]]) - C @ seen
        new = AD @ seen + BD @ np.atleast_2d(u).reshape(1, *np.shape(u)) + L @ news
        for name, value in zip(STATES, new, strict=True):
            memory[name] = value
        for name in late:
            memory[name], u = u, memory[name]
        return wire("force", u)

    return law, [*STATES, *late]


def by_hand(mass=0.2, delay=0):
    law, names = law_of(delay)
    loop = SampledLoop(*linear(mass), law, names, T)
    inertia = TURNING + mass * ARM**2

    def rates(x, force):
        _, v, angle, rate = x
        s, c = np.sin(angle), np.cos(angle)
        pushed = force - ROLLING * v - mass * ARM * rate**2 * s
        p = (CART + mass) * inertia - (mass * ARM * c) ** 2
        a = (inertia * pushed + (mass * ARM) ** 2 * G * c * s) / p
        turned = (mass * ARM * c * pushed + (CART + mass) * mass * ARM * G * s) / p
        return np.array([v, a, rate, turned])

    t, x = run(rates, law, [0.0] * 4, dict.fromkeys(names, 0.0), T, 8.0, SIZE)
    return of("force", loop.margins("force")) | of("wanted to position", step_numbers(t, x[:, 0], SIZE))


class Pendulum(Block):
    """Pendulum on a cart; the angle is zero upright."""

    mass: float = parameter(unit="kg", above=0.0)
    force = Input(unit="N")
    position = State(unit="m", output=True)
    speed = State(unit="m/s")
    angle = State(unit="rad", output=True)
    rate = State(unit="rad/s")

    def derivative(self, t, x, u):
        s, c = np.sin(x.angle), np.cos(x.angle)
        arm, inertia = self.mass * ARM, TURNING + self.mass * ARM**2
        pushed = u.force - ROLLING * x.speed - arm * x.rate**2 * s
        p = (CART + self.mass) * inertia - (arm * c) ** 2
        a = (inertia * pushed + arm**2 * G * c * s) / p
        return x.speed, a, x.rate, (arm * c * pushed + (CART + self.mass) * arm * G * s) / p


class Observer(Block):
    """Stationary Kalman filter of the linear pendulum: x̂[k + 1] = A x̂ + B u + L (y - C x̂)."""

    force = Input(unit="N")
    position = Input(unit="m")
    angle = Input(unit="rad")
    estimate = State(shape=(4,), start=0.0, output=True)

    def update(self, t, x, u):
        news = np.stack([u.position - x.estimate[0], u.angle - x.estimate[2]])
        return AD @ x.estimate + BD[:, 0] * u.force + L @ news


def diagram(mass=0.2, delay=0):
    pendulum, observer = Pendulum(mass=mass, name="pendulum"), Observer(name="observer")

    @subsystem(sample_time=T, delay=delay)
    def controller(wanted, position, angle):
        force = (K[0] * wanted - Gain(gain=K[None, :], name="feedback")(observer.estimate)[0]).named("force")
        observer(force=force, position=position, angle=angle)
        return force

    wanted = Step(times=0.5, values=SIZE, unit="m").y.named("wanted")
    return Diagram("upright", pendulum(controller(wanted, pendulum.position, pendulum.angle)))


PROJECT = Project(
    asked={
        "loops": {"force": {"phase_margin_deg": 30, "gain_margin_high": 2.2, "gain_margin_low": 0.6, "ms": 2.0}},
        "step": [{"input": "wanted", "output": "position", "size": SIZE, "overshoot": 0.1, "settling": 3.0}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=0.5,
    duration=8.0,
    more_delay={"delay": 3},
    breaking={"delay": 3},
    harmless={"mass": 0.25},
    broken=("force: phase_margin_deg", "force: gain_margin_high", "force: ms"),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_pendulum_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_pendulum(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_pendulum_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_pendulum_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

"""The attitude of a quadrotor: P control of roll, pitch and yaw around P control of their rates, at 400 Hz.

J = diag(0.012, 0.012, 0.022) kg m², torques behind the rotors' lag of 25 ms, Euler's equations and the kinematics of
Euler angles. Rates: 0.18 N m s/rad, for yaw 0.176; angles: 4 1/s, for yaw 2.5.

By hand. At hover the axes are three single loops. Torque: L = kr (s + ka)/(J s² (0.025 s + 1)); for roll and pitch
the crossover is at 14.6 rad/s, 54°, and the disk margin 1/max|(S − T)/2| is 1.00; for yaw 8.2 rad/s, 61°, 1.16. One
factor for each axis at once, whatever they are, ends stability no earlier than the worst axis: the disk margin of the
three channels is 1.00. Rates: 1.29 and 1.28 at the wire rates_wanted. A step of 0.2 rad in roll does not overshoot,
settles in 0.74 s, and turns neither pitch nor yaw. Verdict: passed.

Breaking: heavy propellers, a lag of 80 ms. The crossover of roll at 11.6 rad/s loses atan(0.93) = 43° in place of
20°: 27°, disk margin 0.48, which fails at the wire torques; that at rates_wanted, 0.87, suffices, and the step still
settles in 0.82 s.

Harmless: a camera below the hub, J = (0.014, 0.014, 0.022): 54°, 1.02.
"""

import numpy as np
import pytest

from loopwright.blocks import Block, Gain, Input, State, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

T, SIZE = 2.5e-3, 0.2
RATE_GAINS, ANGLE_GAINS = (0.18, 0.18, 0.176), (4.0, 4.0, 2.5)
YAW = 0.022


def by_hand(inertia=0.012, lag=0.025):
    inertias = (inertia, inertia, YAW)
    torques, rates_wanted = [], []
    for J, kr, ka in zip(inertias, RATE_GAINS, ANGLE_GAINS, strict=True):

        def law(k, x, memory, wanted, wire, kr=kr, ka=ka):
            return wire("torques", kr * (wire("rates_wanted", ka * (wanted - x[2])) - x[1]))

        A = np.array([[-1 / lag, 0.0, 0.0], [1 / J, 0.0, 0.0], [0.0, 1.0, 0.0]])
        B = np.array([1 / lag, 0.0, 0.0])
        loop = SampledLoop(A, B, law, [], T)
        torques.append(loop.margins("torques")["disk_margin"])
        rates_wanted.append(loop.margins("rates_wanted")["disk_margin"])
        if inertia == J:
            t, x = run(lambda x, u, A=A, B=B: A @ x + B * u, law, [0.0] * 3, {}, T, 4.0, SIZE)
    return {
        "torques: disk_margin": min(torques),
        "rates_wanted: disk_margin": min(rates_wanted),
    } | of("wanted[1] to angles[1]", step_numbers(t, x[:, 2], SIZE))


class Quadrotor(Block):
    """Attitude of a quadrotor: rotors with a lag, Euler's equations, and angles of roll, pitch and yaw."""

    inertia: float = parameter(unit="kg.m2", above=0.0)
    lag: float = parameter(unit="s", above=0.0)
    torques_wanted = Input(shape=(3,), unit="N.m")
    torques = State(shape=(3,), unit="N.m")
    rates = State(shape=(3,), unit="rad/s", output=True)
    angles = State(shape=(3,), unit="rad", output=True)

    def derivative(self, t, x, u):
        J = np.stack([self.inertia, self.inertia, YAW])
        p, q, r = x.rates[0], x.rates[1], x.rates[2]
        gyroscopic = np.stack([(J[1] - J[2]) * q * r, (J[2] - J[0]) * r * p, (J[0] - J[1]) * p * q])
        s, c, tan = np.sin(x.angles[0]), np.cos(x.angles[0]), np.tan(x.angles[1])
        turning = np.stack([p + (q * s + r * c) * tan, q * c - r * s, (q * s + r * c) / np.cos(x.angles[1])])
        return (u.torques_wanted - x.torques) / self.lag, (x.torques + gyroscopic) / J, turning


def diagram(inertia=0.012, lag=0.025, delay=0):
    quadrotor = Quadrotor(inertia=inertia, lag=lag, name="quadrotor")

    @subsystem(sample_time=T, delay=delay)
    def controller(wanted, angles, rates):
        rates_wanted = Gain(gain=np.array(ANGLE_GAINS), name="angle_gains")(wanted - angles).named("rates_wanted")
        return Gain(gain=np.array(RATE_GAINS), name="rate_gains")(rates_wanted - rates).named("torques")

    roll = Step(times=0.5, values=SIZE, unit="rad", name="roll")
    wanted = Gain(gain=np.array([1.0, 0.0, 0.0]), name="roll_only")(roll).named("wanted")
    return Diagram("hover", quadrotor(controller(wanted, quadrotor.angles, quadrotor.rates)))


PROJECT = Project(
    asked={
        "loops": {"torques": {"disk_margin": 0.75}, "rates_wanted": {"disk_margin": 0.7}},
        "step": [{"input": "wanted[1]", "output": "angles[1]", "size": SIZE, "overshoot": 0.1, "settling": 1.2}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=0.5,
    duration=4.0,
    more_delay={"delay": 20},
    breaking={"lag": 0.08},
    harmless={"inertia": 0.014},
    broken=("torques: disk_margin",),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_quadrotor_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_quadrotor(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_quadrotor_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_quadrotor_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

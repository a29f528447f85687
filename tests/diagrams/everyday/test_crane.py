"""A bridge crane with a hanging load: state feedback by LQR at 20 Hz moves the trolley without leaving a swing.

Trolley 1000 kg with rolling friction 200 N s/m, load 2000 kg on a rope of 8 m. The nonlinear equations are (M + m) ẍ
+ m l (θ̈ cos θ − θ̇² sin θ) = F − d ẋ and l θ̈ + ẍ cos θ + g sin θ = 0. F = −K (x − x_wanted, ẋ, θ, θ̇) with K =
(1910, 3150, 700, 11180): `control.dlqr` of the linearized crane, weights 1 of the position, 40 of the angle, 2.5·10⁻⁷
of the force, rounded.

By hand. The load alone swings at √((1 + m/M) g/l) = 1.92 rad/s. The closed loop has −0.56 ± 1.94j and −0.44 ± 0.64j
1/s. The loop at the force has crossovers at 0.91, 1.63 and 2.70 rad/s; the smallest phase margin is 69°, gain margin
23, M_s = 1.05: what LQR promises (60°, 2 and 1), less the sampling. A step of 1 m overshoots by 9.5 %, settles in 8.4
s, and swings by 0.044 rad. Verdict: passed.

Breaking: the load is hoisted to 5 m, same gains. The swing becomes √(3 g/5) = 2.43 rad/s, the feedback is tuned to
another one: poles −0.08 ± 2.64j. The phase margin at the force is 19° and fails, with it M_s = 3.0 and the settling
time, ln(50)/0.08 of what the step stirs up: 30 s. The overshoot (20 %) and the swing (0.064 rad) stay within their
limits.

Harmless: half the load, 1000 kg: 63°, 15 %, 11 s.
"""

import numpy as np
import pytest

from loopwright.blocks import Block, Input, State, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

TROLLEY, ROLLING, G, T, SIZE = 1000.0, 200.0, 9.81, 0.05, 1.0
K = np.array([1910.0, 3150.0, 700.0, 11180.0])


def law(k, x, memory, wanted, wire):
    return wire("force", -(K[0] * (x[0] - wanted) + K[1] * x[1] + K[2] * x[2] + K[3] * x[3]))


def by_hand(load=2000.0, rope=8.0):
    A = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [0.0, -ROLLING / TROLLEY, load * G / TROLLEY, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [0.0, ROLLING / (TROLLEY * rope), -(TROLLEY + load) * G / (TROLLEY * rope), 0.0],
        ]
    )
    loop = SampledLoop(A, [0.0, 1 / TROLLEY, 0.0, -1 / (TROLLEY * rope)], law, [], T)

    def rates(x, force):
        _, v, angle, rate = x
        s, c = np.sin(angle), np.cos(angle)
        a = (force - ROLLING * v + load * rope * rate**2 * s + load * G * c * s) / (TROLLEY + load * s * s)
        return np.array([v, a, rate, -(a * c + G * s) / rope])

    t, x = run(rates, law, [0.0] * 4, {}, T, 100.0, SIZE)
    swing = np.abs(x[:, 2]).max()
    return (
        of("force", loop.margins("force"))
        | of("wanted to position", step_numbers(t, x[:, 0], SIZE))
        | {"wanted to angle: peak": swing}
    )


class Crane(Block):
    """Trolley with a load on a rope: the angle is zero where the load hangs, positive towards the trolley's motion."""

    load: float = parameter(unit="kg", above=0.0)
    rope: float = parameter(unit="m", above=0.0)
    force = Input(unit="N")
    position = State(unit="m", output=True)
    speed = State(unit="m/s", output=True)
    angle = State(unit="rad", output=True)
    rate = State(unit="rad/s", output=True)

    def derivative(self, t, x, u):
        s, c = np.sin(x.angle), np.cos(x.angle)
        pull = self.load * (self.rope * x.rate**2 + G * c) * s
        a = (u.force - ROLLING * x.speed + pull) / (TROLLEY + self.load * s**2)
        return x.speed, a, x.rate, -(a * c + G * s) / self.rope


def diagram(load=2000.0, rope=8.0, delay=0):
    crane = Crane(load=load, rope=rope, name="crane")

    @subsystem(sample_time=T, delay=delay)
    def controller(wanted, position, speed, angle, rate):
        return (K[0] * (wanted - position) - K[1] * speed - K[2] * angle - K[3] * rate).named("force")

    wanted = Step(times=1.0, values=SIZE, unit="m").y.named("wanted")
    force = controller(wanted, crane.position, crane.speed, crane.angle, crane.rate)
    return Diagram("bridge", crane(force))


PROJECT = Project(
    asked={
        "loops": {"force": {"phase_margin_deg": 45, "gain_margin_high": 3, "ms": 1.5}},
        "step": [
            {"input": "wanted", "output": "position", "size": SIZE, "overshoot": 0.25, "settling": 18.0},
            {"input": "wanted", "output": "angle", "size": SIZE, "peak": 0.1},
        ],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=1.0,
    duration=100.0,
    more_delay={"delay": 5},
    breaking={"rope": 5.0},
    harmless={"load": 1000.0},
    broken=("force: phase_margin_deg", "force: ms", "wanted to position: settling"),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_crane_by_hand(variant):
    check_by_hand(PROJECT, variant)


@pytest.mark.slow
@reports(quick=True)
def test_the_report_has_the_verdict_of_a_crane(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_crane_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_crane_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

"""A P position loop around a servo drive in velocity mode, at 500 Hz.

The drive follows its velocity command with a lag of τ = 5 ms. P control with kv = 30 1/s, as machine tools have it.

By hand. L = kv/(s (τ s + 1)): crossover at 29.7 rad/s, phase margin 90° − atan(29.7 · 5 ms) − 29.7 · 1 ms = 90 − 8.4
− 1.7 = 79.9°. The phase is −180° where atan(ω τ) + ω · 1 ms = 90°, at 433 rad/s: a gain margin of 433 · 2.4/30 = 34.
M_s = 1.13. No overshoot (ζ = 1/(2 √(kv τ)) = 1.29), settled in about 4/kv = 0.11 s, bandwidth 37 rad/s. A P
controller has no integrator: the only pole at s = 0 is the position, which is fed back. Verdict: passed.

Breaking: kv = 10 1/s. All margins grow, but the bandwidth falls to 10.6 rad/s and settling takes 4/kv ≈ 0.37 s: the
bandwidth fails, and the settling time with it.

Harmless: kv = 45 1/s: 75°, M_s 1.19.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Integrator, Step, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, of, reports

LAG, T, SIZE = 5e-3, 2e-3, 0.02


def by_hand(kv=30.0):
    A, B = np.array([[-1 / LAG, 0.0], [1.0, 0.0]]), np.array([1 / LAG, 0.0])

    def law(k, x, memory, wanted, wire):
        return wire("velocity_wanted", kv * (wanted - x[1]))

    loop = SampledLoop(A, B, law, [], T)
    t, x = run(lambda x, u: A @ x + B * u, law, [0.0, 0.0], {}, T, 2.0, SIZE)
    margins = of("velocity_wanted", loop.margins("velocity_wanted"))
    return margins | of("wanted to position", step_numbers(t, x[:, 1], SIZE))


def diagram(kv=30.0):
    drive = TransferFunction(numerator=[1.0], denominator=[LAG, 1.0], name="drive")
    axis = Integrator(name="axis")
    position = axis.y.named("position")

    @subsystem(sample_time=T)
    def controller(wanted, position):
        return PID(kp=kv)(wanted, position).named("velocity_wanted")

    wanted = Step(times=0.1, values=SIZE).y.named("wanted")
    return Diagram("axis", axis(drive(controller(wanted, position))))


PROJECT = Project(
    asked={
        "loops": {"velocity_wanted": {"phase_margin_deg": 60, "gain_margin_high": 6, "ms": 1.4, "bandwidth": 20}},
        "step": [{"input": "wanted", "output": "position", "size": SIZE, "overshoot": 0.02, "settling": 0.25}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=0.1,
    duration=2.0,
    breaking={"kv": 10.0},
    harmless={"kv": 45.0},
    broken=("velocity_wanted: bandwidth", "wanted to position: settling"),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_p_position_loop_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports(quick=True)
def test_the_report_has_the_verdict_of_a_p_position_loop(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_p_position_loop_is_that_by_hand(variant):
    check_run(PROJECT, variant)

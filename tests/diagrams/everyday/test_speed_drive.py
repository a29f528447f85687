"""A drive whose speed is controlled while its angle runs on: PI control of the voltage at 1 kHz.

The motor of `loopwright.fmus.dc_motor` (R = 1.2 Ω, L = 2 mH, K = 0.05, J = 2·10⁻⁵ kg m², b = 10⁻⁵ N m s) against a
load of 10 mN m. kp = 0.0587 V s/rad, ki = 7.87 V/rad, ±24 V. Nobody uses the angle, so that its integrator is no part
of any loop.

By hand. The motor is K/((L s + R)(J s + b) + K²) = 1.25·10⁶/((s + 134)(s + 466)), and the zero ki/kp = 134 1/s
cancels its slower pole: L = 7.3·10⁴/(s (s + 466)), crossover 145 rad/s. Phase margin 90° − atan(145/466) − 145 · 0.5
ms = 90 − 17.3 − 4.1 = 68.6° (67° with the exact hold), delay margin 1.17/145 = 8.1 ms. The closed loop has ω_n =
√7.3·10⁴ = 271 rad/s and ζ = 466/(2 · 271) = 0.86: an overshoot of 0.5 % (2.9 % with the hold), settled in 25 ms.
Verdict: passed, at rest and at 100 rad/s alike: the equations are linear.

Breaking: four samples of computing time. They cost 4 ms · 145 rad/s = 33°: 34° remain, so the phase margin fails;
with it M_s ≈ 1/(2 sin 17°) = 1.7 or more (2.7), the gain margin (14.8 to 1.8) and the overshoot (44 %). The delay
margin is 4 ms less, 4.1 ms, and suffices; so does the settling time, 76 ms.

Harmless: a warm winding, R = 1.6 Ω: the crossover falls to 119 rad/s, 63°, overshoot 8 %.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Step
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, dc_motor
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

INDUCTANCE, CONSTANT, INERTIA, VISCOUS = 2e-3, 0.05, 2e-5, 1e-5
KP, KI, T, SIZE = 0.0587, 7.87, 1e-3, 5.0


def law_of(delay):
    late = [f"late{i}" for i in range(delay)]

    def law(k, x, memory, wanted, wire):
        error = wanted - x[1]
        u = KP * error + memory["integral"]
        memory["integral"] = memory["integral"] + KI * T * error
        for name in late:
            memory[name], u = u, memory[name]
        return wire("voltage", u)

    return law, ["integral", *late]


def by_hand(resistance=1.2, delay=0):
    A = np.array([[-resistance / INDUCTANCE, -CONSTANT / INDUCTANCE], [CONSTANT / INERTIA, -VISCOUS / INERTIA]])
    B = np.array([1 / INDUCTANCE, 0.0])
    law, names = law_of(delay)
    loop = SampledLoop(A, B, law, names, T)
    t, x = run(lambda x, u: A @ x + B * u, law, [0.0, 0.0], dict.fromkeys(names, 0.0), T, 0.5, SIZE)
    return of("voltage", loop.margins("voltage")) | of("wanted to speed", step_numbers(t, x[:, 1], SIZE))


def diagram(resistance=1.2, delay=0):
    motor = Fmu(dc_motor.build(), name="motor", start={"resistance": resistance})

    @subsystem(sample_time=T, delay=delay)
    def controller(wanted, speed):
        return PID(kp=KP, ki=KI, lower=-24.0, upper=24.0, name="pi")(wanted, speed).named("voltage")

    wanted = Step(times=[0.1, 0.6], values=[100.0, 100.0 + SIZE], unit="rad/s").y.named("wanted")
    load = Step(times=0.3, values=0.01, unit="N.m", name="load")
    return Diagram("drive", motor(voltage=controller(wanted, motor.speed), load_torque=load))


PROJECT = Project(
    asked={
        "loops": {"voltage": {"phase_margin_deg": 50, "gain_margin_high": 4, "ms": 1.6, "delay_margin_s": 2e-3}},
        "step": [{"input": "wanted", "output": "speed", "size": SIZE, "overshoot": 0.15, "settling": 0.12}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=0.6,
    duration=0.5,
    more_delay={"delay": 6},
    breaking={"delay": 4},
    harmless={"resistance": 1.6},
    broken=("voltage: phase_margin_deg", "voltage: ms", "voltage: gain_margin_high", "wanted to speed: overshoot"),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_speed_drive_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports(quick=True)
def test_the_report_has_the_verdict_of_a_speed_drive(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_report_at_100_rad_per_s_has_the_same_verdict(variant):
    """The angle grows by 100 rad a second there, which is no motion of anything that is asked about."""
    check_report(PROJECT, variant, at=0.59)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_speed_drive_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_speed_drive_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

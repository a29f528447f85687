"""A motor in field weakening: PI control of its speed at 1 kHz, its torque constant in a table over the speed.

k(ω) = 1.2 N m/A up to 150 rad/s and 1.2 · 150/ω above, as a table with points every 50 rad/s; J = 0.05 kg m², b =
0.01 N m s, a load of 5 N m; the current follows with a lag of 2 ms. kp = 2.5 A s/rad, ki = 25 A/rad, ±40 A. The motor
is judged where it works, at 275 rad/s, between two points of the table.

By hand. There k = 0.66 N m/A, its slope −2.4·10⁻³, the current at rest (5 + 2.75)/0.66 = 11.7 A; the table's slope
damps by 2.4·10⁻³ · 11.7 = 0.028 N m s. L = (kp + ki/s) · 0.66/((2 ms s + 1)(0.05 s + 0.038)): crossover near 2.5 ·
0.66/0.05 = 33 rad/s, where the integral costs atan(10/34) = 16°, the lag 4°, the hold 1°, while the damping gives 1°:
70°, M_s = 1.07, bandwidth 45 rad/s. A step of 2 rad/s overshoots by 15 % (the zero of PI control), settled in 0.28 s.
Verdict: passed.

Breaking: 470 rad/s. k = 0.384: crossover and bandwidth fall as k, to 21 and 29 rad/s. The bandwidth fails, the rest
stays well within: 63°, 20 %, 0.35 s.

Harmless: a load of 8 N m at 275 rad/s: the damping by the table's slope grows, 70.4°.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Constant, Integrator, Lookup1D, Product, Step, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, of, reports

INERTIA, VISCOUS, LAG, T, SIZE = 0.05, 0.01, 2e-3, 1e-3, 2.0
KP, KI, LARGEST = 2.5, 25.0, 40.0
SPEEDS = np.array([0.0, 150.0, 200.0, 250.0, 300.0, 350.0, 400.0, 450.0, 500.0, 550.0, 600.0])
CONSTANTS = 1.2 * np.minimum(1.0, 150.0 / np.maximum(SPEEDS, 150.0))


def law(k, x, memory, wanted, wire):
    error = wanted - x[1]
    current = KP * error + memory["integral"]
    memory["integral"] = memory["integral"] + KI * T * error
    return wire("current_wanted", current)


def by_hand(speed=275.0, load=5.0):
    i = np.searchsorted(SPEEDS, speed) - 1
    slope = (CONSTANTS[i + 1] - CONSTANTS[i]) / (SPEEDS[i + 1] - SPEEDS[i])
    k = np.interp(speed, SPEEDS, CONSTANTS)
    rest = (load + VISCOUS * speed) / k
    A = [[-1 / LAG, 0.0], [k / INERTIA, (slope * rest - VISCOUS) / INERTIA]]
    loop = SampledLoop(A, [1 / LAG, 0.0], law, ["integral"], T)

    def rates(x, wanted):
        torque = np.interp(x[1], SPEEDS, CONSTANTS) * x[0] - VISCOUS * x[1] - load
        return np.array([(wanted - x[0]) / LAG, torque / INERTIA])

    t, x = run(rates, law, [rest, speed], {"integral": rest}, T, 2.0, speed + SIZE)
    assert x[:, 0].max() < LARGEST
    margins = of("current_wanted", loop.margins("current_wanted"))
    return margins | of("wanted to speed", step_numbers(t, x[:, 1], SIZE))


def diagram(speed=275.0, load=5.0):
    turning = Integrator(name="turning")
    current = TransferFunction(numerator=[1.0], denominator=[LAG, 1.0], name="current")
    constant = Lookup1D(breakpoints=SPEEDS, values=CONSTANTS, name="constant")
    speed_now = turning.y.named("speed")
    torque = Product(name="torque")(constant(speed_now), current.y)

    @subsystem(sample_time=T)
    def controller(wanted, speed):
        return PID(kp=KP, ki=KI, lower=-LARGEST, upper=LARGEST)(wanted, speed).named("current_wanted")

    wanted = Step(times=[0.0, 6.0], values=[speed, speed + SIZE]).y.named("wanted")
    rest = torque - VISCOUS * speed_now - Constant(value=load, name="load")
    return Diagram("spindle", turning((1 / INERTIA) * rest), current(controller(wanted, speed_now)))


PROJECT = Project(
    asked={
        "loops": {"current_wanted": {"phase_margin_deg": 50, "ms": 1.3, "bandwidth": 36}},
        "step": [{"input": "wanted", "output": "speed", "size": SIZE, "overshoot": 0.3, "settling": 0.6}],
    },
    by_hand=by_hand,
    diagram=diagram,
    at=5.0,
    step_at=6.0,
    duration=2.0,
    breaking={"speed": 470.0},
    harmless={"load": 8.0},
    broken=("current_wanted: bandwidth",),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_motor_in_field_weakening_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_motor_in_field_weakening(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_motor_in_field_weakening_is_that_by_hand(variant):
    check_run(PROJECT, variant)

"""A drive with three rates: current at 10 kHz, speed at 1 kHz, angle at 250 Hz, measured by an encoder of 2¹⁷ lines.

The motor of `loopwright.fmus.dc_motor`: R = 1.2 Ω, L = 2 mH, K = 0.05 N m/A, J = 2·10⁻⁵ kg m², b = 10⁻⁵ N m s. PI
control of the current (3 V/A, 1800 V/(A s), ±24 V), PI control of the speed (0.06 A s/rad, 1.8 A/rad, ±6 A), both
with anti-windup, P control of the angle (25 1/s). The speed is the difference of two angles over 1 ms.

By hand, with each hold as half its sample and the difference as half a millisecond. Current: crossover near 3/L =
1500 rad/s, 86°. Speed: crossover 0.06 K/J = 150 rad/s; the holds, the difference and the current loop cost 150 · (0.5
+ 0.5 + 0.7) ms = 15°, the integral atan(30/150) = 11°, the angle's loop atan(25/150) = 9°: 55°. Angle: crossover at
28 rad/s, 82°. All of these are confirmed below by the eigenvalues of the map over 4 ms. A step of 0.1 rad does not
overshoot and has settled in 0.16 s. Verdict: passed.

Breaking: three samples of computing time in the speed loop. At 140 rad/s they cost 3 ms · 140 = 24°: about 32°, so
the phase margin at the wire current_reference fails. The gain margin there falls from 8.7 to 2.3, which suffices, and
M_s at the angle's wire hardly moves (1.32).

Harmless: 15 in place of 25 1/s for the angle: slower (0.26 s), margins larger.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Constant, Encoder, Step
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, dc_motor
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

RESISTANCE, INDUCTANCE, CONSTANT, INERTIA, VISCOUS = 1.2, 2e-3, 0.05, 2e-5, 1e-5
T, SIZE = 1e-4, 0.1
CURRENT, SPEED = (3.0, 1800.0), (0.06, 1.8)
MOTOR = [
    [-RESISTANCE / INDUCTANCE, -CONSTANT / INDUCTANCE, 0.0],
    [CONSTANT / INERTIA, -VISCOUS / INERTIA, 0.0],
    [0.0, 1.0, 0.0],
]
VOLTAGE = [1 / INDUCTANCE, 0.0, 0.0]


def law_of(kp, delay):
    late = [f"late{i}" for i in range(delay)]

    def law(k, x, memory, wanted, wire):
        current, _, angle = x
        if k % 40 == 0:
            memory["speed_reference"] = wire("speed_reference", kp * (wanted - angle))
        if k % 10 == 0:
            error = memory["speed_reference"] - (angle - memory["last"]) / 1e-3
            reference = SPEED[0] * error + memory["speed_integral"]
            memory["last"] = angle
            memory["speed_integral"] = memory["speed_integral"] + SPEED[1] * 1e-3 * error
            for name in late:
                memory[name], reference = reference, memory[name]
            memory["current_reference"] = wire("current_reference", reference)
        error = memory["current_reference"] - current
        voltage = CURRENT[0] * error + memory["current_integral"]
        memory["current_integral"] = memory["current_integral"] + CURRENT[1] * T * error
        return wire("voltage", voltage)

    names = ["speed_reference", "last", "speed_integral", "current_reference", "current_integral", *late]
    return law, names


def by_hand(kp=25.0, delay=0):
    law, names = law_of(kp, delay)
    loop = SampledLoop(MOTOR, VOLTAGE, law, names, T, ticks=40)

    def rates(x, voltage):
        i, speed, _ = x
        return np.array(
            [
                (voltage - RESISTANCE * i - CONSTANT * speed) / INDUCTANCE,
                (CONSTANT * i - VISCOUS * speed) / INERTIA,
                speed,
            ]
        )

    t, x = run(rates, law, [0.0] * 3, dict.fromkeys(names, 0.0), T, 0.6, SIZE, steps=2)
    return (
        of("voltage", loop.periodic_margins("voltage"))
        | of("current_reference", loop.periodic_margins("current_reference"))
        | of("speed_reference", loop.margins("speed_reference"))
        | of("angle_wanted to angle", step_numbers(t, x[:, 2], SIZE))
    )


def diagram(kp=25.0, delay=0):
    motor = Fmu(dc_motor.build(), name="motor")

    @subsystem(sample_time=1e-3)
    def sensor(angle, speed):
        return Encoder(quantum=2 * np.pi / 2**17, name="encoder")(angle, speed)

    @subsystem(sample_time=4e-3)
    def angle_loop(wanted, angle):
        return PID(kp=kp)(wanted, angle).named("speed_reference")

    @subsystem(sample_time=1e-3, delay=delay)
    def speed_loop(reference, speed):
        return PID(kp=SPEED[0], ki=SPEED[1], lower=-6.0, upper=6.0)(reference, speed).named("current_reference")

    @subsystem(sample_time=1e-4)
    def current_loop(reference, current):
        return PID(kp=CURRENT[0], ki=CURRENT[1], lower=-24.0, upper=24.0)(reference, current).named("voltage")

    wanted = Step(times=0.1, values=SIZE, unit="rad").y.named("angle_wanted")
    angle, speed = sensor(motor.angle, motor.speed)
    voltage = current_loop(speed_loop(angle_loop(wanted, angle), speed), motor.current)
    return Diagram("drive", motor(voltage=voltage, load_torque=Constant(value=0.0, name="load")))


PROJECT = Project(
    asked={
        "loops": {
            "voltage": {"phase_margin_deg": 60, "gain_margin_high": 4},
            "current_reference": {"phase_margin_deg": 45, "gain_margin_high": 2},
            "speed_reference": {"phase_margin_deg": 60, "ms": 1.6},
        },
        "step": [{"input": "angle_wanted", "output": "angle", "size": SIZE, "overshoot": 0.1, "settling": 0.4}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=0.1,
    duration=0.6,
    more_delay={"delay": 5},
    breaking={"delay": 3},
    harmless={"kp": 15.0},
    broken=("current_reference: phase_margin_deg",),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_drive_with_three_rates_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_drive_with_three_rates(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_drive_with_three_rates_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_drive_with_three_rates_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

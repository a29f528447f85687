"""Cruise control of a car at 30 m/s: PI control of the driving force at 20 Hz; an odometer counts the way.

m = 1500 kg, air drag 0.4 v² N, rolling resistance 150 N, an engine with a lag of 0.3 s. kp = 750 N s/m, ki = 37 N/m,
force 0 … 5000 N: 510 N hold 30 m/s. The way runs on at 30 m/s and is fed back nowhere.

By hand. The drag's slope is 0.8 · 30 = 24 N s/m: the car is 1/(1500 s + 24), crossover near 750/1500 = 0.5 rad/s.
Phase: car −88.2°, engine −atan(0.15) = −8.5°, integral −atan(37/(750 · 0.5)) = −5.6°, hold −0.5 · 25 ms = −0.7°: 77°,
delay margin 1.34/0.5 = 2.7 s. M_s = 1.12. A step of 1 m/s overshoots by 5 %; it ends with the slow tail of the
integral (ki/kp = 0.05 1/s): 28 s. Verdict: passed.

Breaking: ki = 500 N/m. The crossover moves to 0.68 rad/s, the integral costs atan(500/(750 · 0.68)) = 44°: 34°, so
the phase margin fails, and with it M_s (1.73) and the overshoot (45 %). The delay margin is then 0.59/0.68 = 0.87 s,
less than 1.5 s, and fails, too. Settling is faster.

Harmless: five people and luggage, m = 1900 kg: crossover 0.39 rad/s, 77°, 35 s.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Block, Input, State, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

DRAG, ROLLING, LAG, SPEED, KP, T, SIZE = 0.4, 150.0, 0.3, 30.0, 750.0, 0.05, 1.0


def by_hand(mass=1500.0, ki=37.0):
    def law(k, x, memory, wanted, wire):
        error = wanted - x[0]
        force = KP * error + memory["integral"]
        memory["integral"] = memory["integral"] + ki * T * error
        return wire("force_wanted", force)

    A = [[-2.0 * DRAG * SPEED / mass, 1 / mass], [0.0, -1 / LAG]]
    loop = SampledLoop(A, [0.0, 1 / LAG], law, ["integral"], T)
    rest = DRAG * SPEED**2 + ROLLING

    def rates(x, wanted):
        return np.array([(x[1] - DRAG * x[0] ** 2 - ROLLING) / mass, (wanted - x[1]) / LAG])

    t, x = run(rates, law, [SPEED, rest], {"integral": rest}, T, 250.0, SPEED + SIZE)
    return of("force_wanted", loop.margins("force_wanted")) | of("wanted to speed", step_numbers(t, x[:, 0], SIZE))


class Car(Block):
    """Car with an engine's lag, drag and rolling resistance, and an odometer."""

    mass: float = parameter(unit="kg", above=0.0)
    force_wanted = Input(unit="N")
    speed = State(start=SPEED, unit="m/s", output=True)
    force = State(start=DRAG * SPEED**2 + ROLLING, unit="N", output=True)
    distance = State(unit="m", output=True)

    def derivative(self, t, x, u):
        resistance = DRAG * x.speed**2 + ROLLING
        return (x.force - resistance) / self.mass, (u.force_wanted - x.force) / LAG, x.speed


def diagram(mass=1500.0, ki=37.0, delay=0):
    car = Car(mass=mass, name="car")

    @subsystem(sample_time=T, delay=delay)
    def cruise(wanted, speed):
        pi = PID(kp=KP, ki=ki, lower=0.0, upper=5000.0, initial_output=DRAG * SPEED**2 + ROLLING)
        return pi(wanted, speed).named("force_wanted")

    wanted = Step(times=10.0, values=SPEED + SIZE, initial_value=SPEED, unit="m/s").y.named("wanted")
    return Diagram("car", car(cruise(wanted, car.speed)))


PROJECT = Project(
    asked={
        "loops": {"force_wanted": {"phase_margin_deg": 60, "ms": 1.4, "delay_margin_s": 1.5}},
        "step": [{"input": "wanted", "output": "speed", "size": SIZE, "overshoot": 0.2, "settling": 50.0}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=10.0,
    duration=250.0,
    more_delay={"delay": 30},
    breaking={"ki": 500.0},
    harmless={"mass": 1900.0},
    broken=(
        "force_wanted: phase_margin_deg",
        "force_wanted: ms",
        "force_wanted: delay_margin_s",
        "wanted to speed: overshoot",
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_cruise_control_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_cruise_control(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_cruise_control_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_cruise_control_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

"""Temperature of an oven with dead time: a continuous PI controller by the SIMC rule.

2.5 K for each percent of heating, a lag of 180 s, and θ = 25 s until the sensor sees it; 40 % hold 120 °C in a hall
of 20 °C. SIMC with a wanted lag of θ: Kc = 180/(2.5 · 2 · 25) = 1.44 %/K, T_i = 180 s, output 0 … 100 %.

By hand. The zero cancels the lag: L = Kc · 2.5/180 · e^(−θ s)/s = 0.02 e^(−25 s)/s. Crossover 0.02 rad/s, phase
margin 90° − 0.02 · 25 rad = 61.35°, gain margin π/(2 · 0.02 · 25) = π, delay margin (π/2 − 0.5)/0.02 = 53.5 s, M_s =
1.59 (the SIMC rule's own number). A step of the set-point of 10 K overshoots by 4 % and settles in 152 s; it moves
the heating by 14 %, far from its limits. Verdict: passed.

Breaking: the sensor moves down the duct, θ = 40 s, same controller. Phase margin 90° − 45.8° = 44.2°, which fails;
the gain margin π/1.6 = 1.96 and M_s = 2.28 fail with it, and so do overshoot (30 %) and settling (364 s). The delay
margin, 38.5 s, suffices.

Harmless: θ = 18 s: 69.4°, gain margin 4.4.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, StateSpace, Step, TransportDelay
from loopwright.diagrams import Diagram
from support.by_hand import loop_numbers, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

GAIN, LAG, KC, TI, SIZE = 2.5, 180.0, 1.44, 180.0, 10.0


def by_hand(dead_time=25.0):
    def L(omega):
        s = 1j * np.atleast_1d(omega)
        return KC * (1 + 1 / (TI * s)) * GAIN / (LAG * s + 1) * np.exp(-dead_time * s)

    h = 0.1  # s; the lag and the integral are exact for an error that is held as long
    steps, decay = round(dead_time / h), np.exp(-h / LAG)
    y, integral, moved = 0.0, 0.0, [0.0] * (steps + 1)
    for _ in range(20000):
        error = SIZE - moved[-1 - steps]
        y = decay * y + (1 - decay) * GAIN * (KC * error + integral)
        integral += KC / TI * error * h
        moved.append(y)
    seen = np.array(moved[: len(moved) - steps])
    numbers = step_numbers(h * np.arange(len(seen)), seen, SIZE)
    return of("heating", loop_numbers(L, 1e-4, 1.0)) | of("wanted to temperature", numbers)


def diagram(dead_time=25.0, more_dead_time=0.0):
    oven = StateSpace(A=[[-1 / LAG]], B=[GAIN / LAG], C=[1.0], initial_state=[100.0], name="oven")
    duct = TransportDelay(delay=dead_time + more_dead_time, initial_value=None, name="duct")
    temperature = duct.y.named("temperature")
    wanted = Step(times=100.0, values=120.0 + SIZE, initial_value=120.0).y.named("wanted")
    control = PID(kp=KC, ki=KC / TI, lower=0.0, upper=100.0, initial_output=40.0, name="control")
    heating = control(wanted, temperature).named("heating")
    return Diagram("oven", duct(oven(heating) + 20.0))


PROJECT = Project(
    asked={
        "loops": {"heating": {"phase_margin_deg": 50, "gain_margin_high": 2.5, "ms": 1.8, "delay_margin_s": 30.0}},
        "step": [{"input": "wanted", "output": "temperature", "size": SIZE, "overshoot": 0.1, "settling": 250.0}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=100.0,
    duration=1500.0,
    sampled_every=0.1,
    more_delay={"more_dead_time": 45.0},
    breaking={"dead_time": 40.0},
    harmless={"dead_time": 18.0},
    broken=(
        "heating: phase_margin_deg",
        "heating: gain_margin_high",
        "heating: ms",
        "wanted to temperature: overshoot",
        "wanted to temperature: settling",
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_an_oven_with_dead_time_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_an_oven_with_dead_time(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_an_oven_with_dead_time_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_an_oven_with_dead_time_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

"""A buck converter with average current mode: current at 200 kHz with a sample of delay, voltage at 50 kHz.

24 V to 12 V, L = 22 µH with 20 mΩ, C = 220 µF with 10 mΩ, load 2 Ω (6 A); averaged over a switching period. Current:
0.0576 1/A and 288 1/(A s), duty cycle 0 … 1, one sample (5 µs) from measurement to modulator. Voltage: 2 A/V and 3000
A/(V s), current 0 … 15 A.

By hand. Current: crossover 0.0576 · 24/22 µH = 62.8·10³ rad/s; delay and hold cost 62.8·10³ · 7.5 µs = 27°, the
integral atan(5/62.8) = 5°, the capacitor's resonance is far below: 52°, gain margin 3.2. Voltage: crossover near
2/220 µF = 9·10³ rad/s, less the load's conductance: 7·10³; the current loop answers within 1/62.8·10³ = 16 µs, the
hold takes 10 µs. The gain margin is the ratio to where all these lags have 90°, 53 … 64·10³: 8 … 9 (9.3 by the map
over a period). M_s = 1.17. A step of 0.5 V settles in 0.8 ms; a load step of 1 A costs 0.30 V. Verdict: passed.

Breaking: an aged capacitor, 68 µF. The voltage's crossover rises as 1/C while the lags stay: gain margin 9.3 · 68/220
≈ 2.9, which fails at the wire current_wanted, and M_s (1.65) with it. The current loop keeps 36°, and a load step
costs 0.39 V, still less than 0.5 V.

Harmless: half the load, 4 Ω.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Block, Input, Output, State, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

SUPPLY, INDUCTANCE, WINDING, ESR = 24.0, 22e-6, 0.02, 0.01
CURRENT, VOLTAGE, T, SIZE = (0.0576, 288.0), (2.0, 3000.0), 5e-6, 0.5
NAMES = ["current_wanted", "voltage_integral", "current_integral", "late"]


def by_hand(capacitance=220e-6, load=2.0):
    share = load / (load + ESR)
    A = np.array(
        [
            [-(WINDING + share * ESR) / INDUCTANCE, -share / INDUCTANCE],
            [share / capacitance, -1.0 / ((load + ESR) * capacitance)],
        ]
    )
    B = np.array([SUPPLY / INDUCTANCE, 0.0])
    C = np.array([share * ESR, share])
    drawn = np.array([share * ESR / INDUCTANCE, -share / capacitance])

    def law_with(extra):
        def law(k, x, memory, wanted, wire):
            if k % 4 == 0:
                error = wanted - (C[0] * x[0] + C[1] * x[1] - share * ESR * extra)
                current = VOLTAGE[0] * error + memory["voltage_integral"]
                memory["voltage_integral"] = memory["voltage_integral"] + VOLTAGE[1] * 4 * T * error
                memory["current_wanted"] = wire("current_wanted", current)
            error = memory["current_wanted"] - x[0]
            duty = CURRENT[0] * error + memory["current_integral"]
            memory["current_integral"] = memory["current_integral"] + CURRENT[1] * T * error
            memory["late"], duty = duty, memory["late"]
            return wire("duty", duty)

        return law

    loop = SampledLoop(A, B, law_with(0.0), NAMES, T, ticks=4)
    rest = dict.fromkeys(NAMES, 0.0)
    t, x = run(lambda x, u: A @ x + B * u, law_with(0.0), [0.0, 0.0], rest, T, 0.01, SIZE)
    wanted = step_numbers(t, x @ C, SIZE)
    _, x = run(lambda x, u: A @ x + B * u + drawn, law_with(1.0), [0.0, 0.0], rest, T, 0.005)
    sag = np.abs(x @ C - share * ESR).max()
    return (
        of("duty", loop.periodic_margins("duty"))
        | of("current_wanted", loop.margins("current_wanted"))
        | of("wanted to voltage", wanted)
        | {"extra_load to voltage: peak": sag}
    )


class Buck(Block):
    """Averaged buck converter: L i' = d V - r i - v, C v_c' = i - v / R - i_x, v = v_c + ESR (i - v / R - i_x)."""

    capacitance: float = parameter(unit="F", above=0.0)
    load: float = parameter(unit="Ohm", above=0.0)
    duty = Input(description="duty cycle, 0 to 1")
    extra_load = Input(unit="A", description="current drawn next to the load")
    current = State(start=lambda block: 12.0 / block.load, unit="A", output=True)
    stored = State(start=12.0, unit="V", description="voltage of the capacitor")
    voltage = Output(unit="V")

    def output(self, t, x, u):
        return (x.stored + ESR * (x.current - u.extra_load)) / (1.0 + ESR / self.load)

    def derivative(self, t, x, u):
        v = self.output(t, x, u)
        inductor = u.duty * SUPPLY - WINDING * x.current - v
        return inductor / INDUCTANCE, (x.current - v / self.load - u.extra_load) / self.capacitance


def diagram(capacitance=220e-6, load=2.0, delay=0):
    buck = Buck(capacitance=capacitance, load=load, name="buck")
    drawn = 12.0 / load

    @subsystem(sample_time=4 * T, delay=delay)
    def voltage_loop(wanted, voltage):
        pi = PID(kp=VOLTAGE[0], ki=VOLTAGE[1], lower=0.0, upper=15.0, initial_output=drawn)
        return pi(wanted, voltage).named("current_wanted")

    @subsystem(sample_time=T, delay=1)
    def current_loop(wanted, current):
        pi = PID(kp=CURRENT[0], ki=CURRENT[1], lower=0.0, upper=1.0, initial_output=(12.0 + WINDING * drawn) / SUPPLY)
        return pi(wanted, current).named("duty")

    wanted = Step(times=1e-3, values=12.0 + SIZE, initial_value=12.0, unit="V").y.named("wanted")
    extra = Step(times=11e-3, values=1.0, unit="A").y.named("extra_load")
    duty = current_loop(voltage_loop(wanted, buck.voltage), buck.current)
    return Diagram("converter", buck(duty=duty, extra_load=extra))


PROJECT = Project(
    asked={
        "loops": {
            "duty": {"phase_margin_deg": 30, "gain_margin_high": 2},
            "current_wanted": {"phase_margin_deg": 60, "gain_margin_high": 4, "ms": 1.4},
        },
        "step": [
            {"input": "wanted", "output": "voltage", "size": SIZE, "overshoot": 0.15, "settling": 3e-3},
            {"input": "extra_load", "output": "voltage", "size": 1.0, "peak": 0.5},
        ],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=(1e-3, 11e-3),
    duration=5e-3,
    more_delay={"delay": 6},
    breaking={"capacitance": 68e-6},
    harmless={"load": 4.0},
    broken=("current_wanted: gain_margin_high", "current_wanted: ms"),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_buck_converter_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_buck_converter(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_buck_converter_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_buck_converter_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

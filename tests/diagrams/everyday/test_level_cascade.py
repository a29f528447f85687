"""A level cascade: PI control of the level every 5 s around PI control of the flow every 0.5 s.

A tank of A = 1.5 m² whose outlet takes c √h, c = 0.01 m²·⁵/s; at 1 m that is 10 l/s. A valve that gives 0.2 l/s for
each percent, with a lag of 2 s. Flow: 5000 % s/m³ and 2500 %/m³, valve 0 … 100 % (50 % at rest). Level: 0.075 m²/s,
T_i = 80 s, flow 0 … 20 l/s.

By hand. Flow: the zero cancels the lag, L = 0.5/s, crossover 0.46 … 0.5 rad/s, 90° − 0.5 · 0.25 rad = 83° (77° with
the level's loop closed). Level: the tank is 1/(A s + c/(2 √h)) = (1/1.5)/(s + 0.0033), crossover near 0.075/1.5 =
0.05 rad/s. Phase: tank −86°, integral −atan(1/(0.05 · 80)) = −14°, flow loop −0.05 · 2.2 s = −6°, hold −0.05 · 2.5 s
= −7°: a phase margin of 67°, M_s = 1.22. A step of 0.1 m overshoots by 12 % and settles in 195 s; the valve moves to
90 % and stays off its limits. Verdict: passed.

Breaking: T_i = 15 s. The integral costs atan(1/(0.069 · 15)) = 44° in place of 14°, the crossover is at 0.069 rad/s:
27 … 31°, so the phase margin at the wire flow_wanted fails; M_s (2.2) and overshoot (54 %) fail with it. The flow
loop does not notice, and 217 s of settling suffice.

Harmless: a tank of 2 m²: 66°, 15 % overshoot, 225 s.
"""

import numpy as np
import pytest

from loopwright.blocks import PID, Block, Input, State, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from support.by_hand import SampledLoop, run, step_numbers
from support.everyday import VARIANTS, Project, check_by_hand, check_report, check_run, check_stability, of, reports

OUTLET, LEVEL, VALVE, LAG, T = 0.01, 1.0, 2e-4, 2.0, 0.5
FLOW, KP, SIZE = (5000.0, 2500.0), 0.075, 0.1


def law_of(integral_time):
    def law(k, x, memory, wanted, wire):
        if k % 10 == 0:
            error = wanted - x[1]
            flow = KP * error + memory["level_integral"]
            memory["level_integral"] = memory["level_integral"] + KP / integral_time * 5.0 * error
            memory["flow_wanted"] = wire("flow_wanted", flow)
        error = memory["flow_wanted"] - x[0]
        opening = FLOW[0] * error + memory["flow_integral"]
        memory["flow_integral"] = memory["flow_integral"] + FLOW[1] * T * error
        return wire("valve", opening)

    return law


def by_hand(area=1.5, integral_time=80.0):
    law, names = law_of(integral_time), ["level_integral", "flow_wanted", "flow_integral"]
    slope = OUTLET / (2.0 * np.sqrt(LEVEL))
    A = [[-1 / LAG, 0.0], [1 / area, -slope / area]]
    loop = SampledLoop(A, [VALVE / LAG, 0.0], law, names, T, ticks=10)
    rest = OUTLET * np.sqrt(LEVEL)

    def rates(x, opening):
        return np.array([(VALVE * opening - x[0]) / LAG, (x[0] - OUTLET * np.sqrt(x[1])) / area])

    start = dict(zip(names, (rest, rest, rest / VALVE), strict=True))
    t, x = run(rates, law, [rest, LEVEL], start, T, 1500.0, LEVEL + SIZE)
    return (
        of("valve", loop.periodic_margins("valve"))
        | of("flow_wanted", loop.margins("flow_wanted"))
        | of("wanted to level", step_numbers(t, x[:, 1], SIZE))
    )


class Tank(Block):
    """Tank behind a valve: 2 s q' = k u - q and A h' = q - c √h."""

    area: float = parameter(unit="m2", above=0.0)
    opening = Input(description="percent of the valve")
    flow = State(start=OUTLET * LEVEL**0.5, unit="m3/s", output=True)
    level = State(start=LEVEL, unit="m", output=True)

    def derivative(self, t, x, u):
        return (VALVE * u.opening - x.flow) / LAG, (x.flow - OUTLET * np.sqrt(x.level)) / self.area


def diagram(area=1.5, integral_time=80.0, delay=0):
    tank = Tank(area=area, name="tank")
    rest = OUTLET * LEVEL**0.5

    @subsystem(sample_time=5.0, delay=delay)
    def level_loop(wanted, level):
        pi = PID(kp=KP, ki=KP / integral_time, lower=0.0, upper=0.02, initial_output=rest)
        return pi(wanted, level).named("flow_wanted")

    @subsystem(sample_time=T)
    def flow_loop(wanted, flow):
        pi = PID(kp=FLOW[0], ki=FLOW[1], lower=0.0, upper=100.0, initial_output=rest / VALVE)
        return pi(wanted, flow).named("valve")

    wanted = Step(times=50.0, values=LEVEL + SIZE, initial_value=LEVEL, unit="m").y.named("wanted")
    return Diagram("level", tank(flow_loop(level_loop(wanted, tank.level), tank.flow)))


PROJECT = Project(
    asked={
        "loops": {
            "valve": {"phase_margin_deg": 60, "gain_margin_high": 4},
            "flow_wanted": {"phase_margin_deg": 50, "gain_margin_high": 4, "ms": 1.5},
        },
        "step": [{"input": "wanted", "output": "level", "size": SIZE, "overshoot": 0.3, "settling": 350.0}],
    },
    by_hand=by_hand,
    diagram=diagram,
    step_at=50.0,
    duration=1500.0,
    more_delay={"delay": 2},
    breaking={"integral_time": 15.0},
    harmless={"area": 2.0},
    broken=("flow_wanted: phase_margin_deg", "flow_wanted: ms", "wanted to level: overshoot"),
)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_verdict_of_a_level_cascade_by_hand(variant):
    check_by_hand(PROJECT, variant)


@reports()
def test_the_report_has_the_verdict_of_a_level_cascade(variant):
    check_report(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_run_of_a_level_cascade_is_that_by_hand(variant):
    check_run(PROJECT, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_more_delay_ends_the_stability_of_a_level_cascade_only_where_the_margin_is_broken(variant):
    check_stability(PROJECT, variant)

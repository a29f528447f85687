"""What happens in which order: each sentence of the page in `loopwright.diagrams`' module of simulations."""

import os
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Constant,
    Counter,
    Ellipse,
    Event,
    Function,
    Gain,
    Hold,
    Input,
    Integrator,
    OptionError,
    Output,
    PathProjection,
    PulseTrain,
    PythonFunction,
    Ramp,
    Relay,
    SimulationError,
    Sine,
    State,
    StateSpace,
    Step,
    Sum,
    Switch,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Interrupted, NonFiniteError, subsystem
from loopwright.diagrams.simulation.workspace import Workspace
from support import TESTS
from support.hybrid_blocks import TIGHT, Ball, Crossings, Falls, Lag, Takes, Twice, counting, decay


def two_rates(duration, **options):
    return Diagram("rates", counting(1e-3, "a")().named("a"), counting(7e-4, "b")().named("b")).simulate(
        duration, progress=False, **options
    )


# --- time -------------------------------------------------------------------------------------------------------------


def test_ticks_are_multiples_of_the_common_base_and_each_time_is_rounded_once():
    run = two_rates(0.014)
    acting = sorted({Fraction(k, 1000) for k in range(15)} | {Fraction(7 * k, 10000) for k in range(21)})
    assert run.t.tolist() == [float(t) for t in acting]
    assert run["a"].tolist() == [1 + t // Fraction(1, 1000) for t in acting]
    assert run["b"].tolist() == [1 + t // Fraction(7, 10000) for t in acting]


@pytest.mark.slow
def test_two_rates_count_ten_million_ticks_without_drift():
    run = two_rates(4200.0, every=100_000)  # 1 + 4.2e6 and 1 + 6e6 ticks, of which 0.6e6 are common
    assert run.t[-1] == 4200.0
    assert (run["a"][-1], run["b"][-1]) == (4_200_001, 6_000_001)
    exact = [Fraction(round(t * 10_000), 10_000) for t in run.t]
    assert run.t.tolist() == [float(t) for t in exact]
    assert run["a"].tolist() == [1 + t // Fraction(1, 1000) for t in exact]
    assert run["b"].tolist() == [1 + t // Fraction(7, 10000) for t in exact]


def test_two_rates_do_not_drift_beside_a_solver_either():
    drive = Integrator(name="i")(Constant(value=1.0)).named("time")
    diagram = Diagram("rates", counting(1e-3, "a")().named("a"), counting(7e-4, "b")().named("b"), drive)
    run = diagram.simulate(0.7, progress=False)
    exact = [Fraction(round(t * 10_000), 10_000) for t in run.t]
    assert run.t.tolist() == [float(t) for t in exact]
    assert run["b"].tolist() == [1 + t // Fraction(7, 10000) for t in exact]
    assert np.max(np.abs(run["time"] - run.t)) < 1e-13


def test_visited_are_the_ticks_at_which_a_box_acts_or_every_one_where_a_step_is_given():
    def diagram():
        return Diagram("d", counting(0.3, "a")().named("a"), counting(0.2, "b")().named("b"))

    assert diagram().simulate(0.7, progress=False).t.tolist() == [0.0, 0.2, 0.3, 0.4, 0.6, 0.7]
    assert np.array_equal(diagram().simulate(0.7, step=0.1, progress=False).t, np.arange(8) / 10)


def test_every_tick_is_visited_with_a_solver_of_fixed_step():
    diagram = Diagram("d", counting(0.3, "a")().named("a"), counting(0.2, "b")().named("b"), Falls(name="f"))
    assert np.array_equal(diagram.simulate(0.7, solver="rk4", progress=False).t, np.arange(8) / 10)
    assert diagram.simulate(0.7, progress=False).t.tolist() == [0.0, 0.2, 0.3, 0.4, 0.6, 0.7]


@pytest.mark.parametrize("times", [(8.0, 1e-3, 8000), (0.3, 0.1, 3), (4.2, 0.7e-3, 6000)])
def test_a_comparison_with_the_time_of_a_tick_is_exact_at_that_tick(times):
    limit, T, k = times

    @subsystem(sample_time=T)
    def box(t):
        return (Compare(">", name="after")(t, limit), Compare(">=", name="reached")(t, limit))

    run = Diagram("clock", box(Clock())).simulate(round((k + 2) * T, 9), progress=False)
    assert np.argmax(run["reached.y"] > 0.5) == k
    assert np.argmax(run["after.y"] > 0.5) == k + 1


# --- at one instant ---------------------------------------------------------------------------------------------------


def test_a_fast_box_sees_what_a_slow_one_puts_out_at_their_common_tick():
    slow = counting(0.2, "slow")()

    @subsystem(sample_time=0.1)
    def fast(u):
        return Gain(gain=1.0, name="g")(u).named("seen")

    run = Diagram("d", fast(slow)).simulate(0.6, progress=False)
    assert run["seen"].tolist() == [1, 1, 2, 2, 3, 3, 4]


def test_sampled_states_change_together_after_the_instant_was_evaluated():
    @subsystem(sample_time=1.0)
    def swap():
        a, b = UnitDelay(initial_value=1.0, name="a"), UnitDelay(initial_value=2.0, name="b")
        return a(b.y), b(a.y)

    run = Diagram("d", *swap()).simulate(3.0, progress=False)
    assert run["a.y"].tolist() == [1, 2, 1, 2]
    assert run["b.y"].tolist() == [2, 1, 2, 1]


def test_a_box_holds_its_outputs_between_its_ticks_while_the_solver_goes_on():
    """Ẏ = −2 y + 3 (1 − y_k): the closed form of the zero-order hold."""

    @subsystem(sample_time=0.1)
    def control(e):
        return Gain(gain=3.0)(e)

    plant = Lag(k=2.0, name="plant")
    run = Diagram("loop", plant(control(1.0 - plant.y).named("u"))).simulate(2.0, step=0.01, **TIGHT)
    y, expected, held = 0.0, [0.0], [3.0]
    for k in range(200):
        if k % 10 == 0:
            u, y0 = 3.0 * (1.0 - y), y
        tau = (k % 10 + 1) / 100
        y = y0 * np.exp(-2 * tau) + u * (1 - np.exp(-2 * tau)) / 2
        expected.append(y)
        held.append(3.0 * (1.0 - y) if k % 10 == 9 else u)
    assert np.max(np.abs(run["plant.y"] - expected)) < 2e-12
    assert np.max(np.abs(run["u"] - held)) < 6e-12


def test_a_sampled_box_sees_what_a_source_has_made_jump_at_its_tick():
    jump = Takes(name="jump")

    @subsystem(sample_time=0.5)
    def box(u):
        return Gain(gain=1.0, name="g")(u).named("sampled")

    wired = jump(Constant(value=7.0), Step(times=0.5, values=1.0))
    run = Diagram("d", box(wired), Falls(name="f")).simulate(1.0, progress=False)
    assert run.t.tolist() == [0.0, 0.5, 1.0]
    assert run["jump.y"].tolist() == [0.0, 7.0, 7.0]
    assert run["sampled"].tolist() == [0.0, 7.0, 7.0]


def test_what_a_box_makes_jump_at_its_tick_is_recorded_after_the_jump_and_sampled_at_the_next_tick():
    jump = Takes(name="jump")

    @subsystem(sample_time=0.5)
    def trigger(t):
        return Gain(gain=1.0, name="g")(t).named("trigger")

    @subsystem(sample_time=0.5)
    def box(u):
        return Gain(gain=1.0, name="g")(u).named("sampled")

    wired = jump(Constant(value=7.0), trigger(Step(times=0.5, values=1.0)))
    run = Diagram("d", box(wired), Falls(name="f")).simulate(1.0, progress=False)
    assert run["jump.y"].tolist() == [0.0, 7.0, 7.0]
    assert run["sampled"].tolist() == [0.0, 0.0, 7.0]


def test_a_sampled_box_in_an_enabled_one_acts_while_that_is_true_at_its_tick():
    @subsystem(sample_time=0.1)
    def count(one):
        n = UnitDelay(initial_value=0.0, name="n")
        n(Sum(name="next")(n.y, one))
        return n.y

    @subsystem(enabled="held")
    def gate(one):
        return count(one)

    pulse = PulseTrain(period=1.0, duty=0.5)
    run = Diagram("d", gate(Constant(value=1.0), enable=pulse).named("n")).simulate(2.5, progress=False)
    ticks = np.arange(26)
    acting = ticks % 10 < 5  # tick k is at k/10 s, an edge belongs to the tick at it
    assert run["n"].tolist() == np.where(acting, np.cumsum(acting) - 1, np.cumsum(acting) - 1).tolist()


@pytest.mark.drawn(1)
@pytest.mark.parametrize("frequency", [5.0, 49.0, 50.0, 100.0])
@pytest.mark.parametrize("options", [{}, {"solver": "rk4", "step": 0.1}])
@pytest.mark.parametrize("duration", [1.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_events_of_a_fast_source_are_found_however_long_the_steps_are(frequency, options, duration):
    relay = Relay(on_point=0.1, off_point=-0.1)(Sine(frequency=frequency))
    run = Diagram("d", Integrator(name="i")(relay)).simulate(duration, progress=False, **options)
    assert len(run.events) == 2 * frequency * duration
    assert run["i.y"][-1] == pytest.approx(duration / 2, abs=1e-3)


@pytest.mark.slow
def test_an_indicator_that_crosses_for_a_small_part_of_a_step_is_followed():
    count = Counter(name="count")(Compare(">")(Sine(frequency=50.0), 0.99))
    run = Diagram("d", count, Integrator()(Constant(value=1.0))).simulate(2.0, progress=False)
    assert run["count.y"][-1] == 100.0


@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", ["auto", "LSODA", "BDF", "CVODE_BDF", "CVODE_Adams"])
def test_no_solver_lets_a_ball_through_the_floor(solver):
    with pytest.raises(SimulationError, match="shows Zeno behaviour"):
        Diagram("d", Ball(name="ball")).simulate(6.0, solver=solver, progress=False)


def test_a_source_at_a_tick_has_its_value_from_the_right():
    @subsystem(sample_time=0.1)
    def box(u):
        return Hold()(u).named("held")

    run = Diagram("d", box(Step(times=0.3, values=1.0).named("u"))).simulate(0.5, progress=False)
    assert run["held"].tolist() == [0, 0, 0, 1, 1, 1]


def test_events_of_one_instant_fire_together_and_each_jump_sees_the_instant_before_all_of_them():
    a, b = Takes(name="a", start=1.0), Takes(name="b", start=2.0)
    trigger = Compare(">", name="trigger")(Clock(), 0.55)
    run = Diagram("swap", a(b.y, trigger), b(a.y, trigger)).simulate(1.0, step=0.1, progress=False)
    k = np.argmax(run.t > 0.55)
    assert (run["a.y"][k - 1], run["b.y"][k - 1]) == (1.0, 2.0)
    assert (run["a.y"][k], run["b.y"][k]) == (2.0, 1.0)
    assert [(e.block, e.event) for e in run.events] == [("trigger", "cross"), ("a", "take"), ("b", "take")]
    assert len({e.t for e in run.events}) == 1


def test_an_event_that_another_one_causes_fires_at_the_same_instant_and_sees_its_jump():
    first = Takes(name="first")
    second = Takes(name="second")
    wired = second(first(Constant(value=5.0), Compare(">", name="c")(Clock(), 0.25)), first.y)
    run = Diagram("chain", wired).simulate(1.0, step=0.5, progress=False)
    assert run["second.y"].tolist() == [0.0, 5.0, 5.0]
    assert [e.block for e in run.events] == ["c", "first", "second"]
    assert len({e.t for e in run.events}) == 1
    assert run.events[0].t == pytest.approx(0.25, abs=1e-15)


def test_an_event_between_ticks_lets_no_sampled_box_act():
    trigger = Compare(">", name="c")(Clock(), 0.25)
    run = Diagram("d", counting(0.1)().named("n"), Takes(name="a")(Constant(value=1.0), trigger)).simulate(
        0.5, step=0.01, progress=False
    )
    assert len(run.events) == 2
    assert run["n"].tolist() == [1 + k // 10 for k in range(51)]


def test_an_occurrence_tells_the_states_before_and_after():
    run = Diagram("ball", Ball(name="ball")).simulate(1.0, **TIGHT)
    first = run.events[0]
    v = np.sqrt(2 * 9.81)
    assert (first.block, first.event) == ("ball", "impact")
    assert first.t == pytest.approx(np.sqrt(2 / 9.81), rel=1e-12)
    assert first.before["velocity"] == pytest.approx(-v, rel=1e-12)
    assert first.after["velocity"] == pytest.approx(0.8 * v, rel=1e-12)
    assert abs(first.before["height"]) < 1e-14


def test_nothing_fires_at_the_start():
    ball = Ball(name="ball")
    state = Crossings(name="c")(Constant(value=3.0))
    run = Diagram("d", state, ball).simulate(0.1, progress=False)
    assert run.events == ()
    assert run["c.count"][-1] == 0


def test_initial_states_are_computed_in_an_order_of_their_own():
    """Each takes its first input; they stand in a ring that only the delays close."""

    @subsystem(sample_time=1.0)
    def box(u):
        z = UnitDelay(name="z")  # without an initial value it takes its first input
        y = UnitDelay(name="a")
        return y(z(u) + 1.0)

    run = Diagram("d", box(Constant(value=3.0)).named("y")).simulate(2.0, progress=False)
    assert run["y"].tolist() == [4.0, 4.0, 4.0]


# --- between ticks ----------------------------------------------------------------------------------------------------


@pytest.mark.drawn(4)
@pytest.mark.parametrize("solver", ["DOP853", "RK45", "Radau", "BDF", "LSODA", "CVODE_BDF", "auto"])
def test_a_step_of_a_source_inside_a_step_of_the_solver_is_landed_on(solver):
    diagram = Diagram("d", Lag(name="lag")(Step(times=(0.35, 0.62), values=(1.0, -2.0))))
    run = diagram.simulate(1.0, rtol=1e-9, atol=1e-12, solver=solver, progress=False)
    t = run.t
    late = lambda t0: np.where(t > t0, 1 - decay(np.maximum(t - t0, 0)), 0)  # noqa: E731
    assert np.max(np.abs(run["lag.y"] - late(0.35) + 3 * late(0.62))) < 2e-7


def test_a_pulse_shorter_than_any_step_of_the_solver_is_seen():
    pulse = Step(times=(50.0, 50.0001), values=(1e4, 0.0))
    run = Diagram("d", Lag(name="lag", k=0.01)(pulse)).simulate(100.0, step=25.0, progress=False)
    exact = 1e4 / 0.01 * (1 - np.exp(-1e-6)) * np.exp(-0.01 * (75 - 50.0001))
    assert run["lag.y"][3] == pytest.approx(exact, rel=1e-6)


def test_values_before_a_discontinuity_are_taken_from_the_left():
    """A polynomial of degree one on each side: forward Euler and Heun are exact if no side sees the other."""
    for solver, tolerance in (("euler", 1e-15), ("heun", 1e-15), ("rk4", 1e-15), ("RK23", 1e-14)):
        run = Diagram("d", Integrator(name="i")(Step(times=0.25, values=4.0))).simulate(
            1.0, step=0.1, solver=solver, progress=False
        )
        assert np.max(np.abs(run["i.y"] - np.where(run.t > 0.25, 4 * (run.t - 0.25), 0))) <= tolerance


@pytest.mark.drawn(2)
@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("heun", 2), ("rk4", 4)])
def test_the_order_of_a_fixed_step_survives_edges_inside_and_at_steps(solver, order):
    """ẏ = u − y, u a train of pulses whose edges fall on and between the steps."""
    train = PulseTrain(period=0.7, duty=0.35)
    edges = [e for k in range(5) for e in (0.7 * k, 0.7 * k + 0.245) if e < 3.0]
    exact = sum((1 - 2 * (i % 2)) * (1 - np.exp(-(3.0 - e))) for i, e in enumerate(edges))
    errors = []
    steps = (20, 40, 80)
    for n in steps:
        run = Diagram("d", Lag(name="lag")(train)).simulate(3.0, step=Fraction(3, n), solver=solver, progress=False)
        errors.append(abs(run["lag.y"][-1] - exact))
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.35)
    assert errors[-1] < {1: 2e-2, 2: 2e-4, 4: 2e-8}[order]


def test_samples_between_steps_are_as_accurate_as_the_steps():
    run = Diagram("d", Lag(name="lag", start=1.0)(Constant(value=0.0))).simulate(2.0, step=1e-3, **TIGHT)
    assert len(run.t) == 2001
    assert np.max(np.abs(run["lag.y"] - decay(run.t))) < 1e-11


def test_a_sample_at_the_time_of_a_source_step_is_that_from_the_right():
    run = Diagram("d", Lag(name="lag")(Step(times=0.5, values=1.0).named("u"))).simulate(1.0, step=0.1, progress=False)
    assert run["u"].tolist() == [0.0] * 5 + [1.0] * 6


def test_linear_blocks_beside_a_sampled_box_agree_with_the_matrix_exponential():
    A = np.array([[0.0, 1.0], [-4.0, -0.4]])
    B = np.array([0.0, 4.0])
    plant = StateSpace(A=A, B=B, C=np.eye(2), D=np.zeros(2), name="plant")

    @subsystem(sample_time=0.1, offset=0.03)
    def control(y):
        return Gain(gain=-0.5, name="g")(y[0]) + 1.0

    run = Diagram("loop", plant(control(plant.y).named("u"))).simulate(3.0, **TIGHT)
    phi = lambda h: expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * h)  # noqa: E731
    z = np.array([0.0, 0.0, 1.0])  # before its first tick: what it puts out at the start
    expected = {0: z[:2]}
    z = phi(0.03) @ z
    for k in range(30):
        z[2] = 1.0 - 0.5 * z[0]
        expected[3 + 10 * k] = z[:2].copy()
        z = phi(0.1) @ z
    ticks = np.rint(run.t * 100).astype(int)
    found = [(run["plant.y"][i], expected[k]) for i, k in enumerate(ticks) if k in expected]
    assert len(found) == 31
    assert max(np.max(np.abs(a - b)) for a, b in found) < 1e-11


@pytest.mark.slow
def test_a_projection_in_continuous_time_starts_from_the_foot_point_of_the_last_accepted_step():
    """Round an ellipse: the ideal run stays near the finely sampled one."""
    path = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))

    @subsystem(sample_time=1e-3)
    def box(position):
        return PathProjection(path, name="projection")(position).named("theta")

    position = Integrator(initial_value=(0.9, 0.5), name="position")
    swirl = Function(
        lambda p: np.stack([-(p[1] - 0.5) * 2.0, (p[0] - 0.5) * 2.0]), arguments={"p": 2}, results={"v": 2}
    )
    diagram = Diagram("ellipse", box(position(swirl(position.y))))
    ideal = diagram.continuous().simulate(4.0, step=0.01, rtol=1e-9, max_step=0.01, progress=False)
    sampled = diagram.simulate(4.0, step=1e-3, rtol=1e-9, progress=False)
    assert np.max(np.abs(ideal["theta"] - sampled["theta"][::10])) < 1e-6
    assert ideal["theta"][-1] > 0.5 * path.length  # it did go round


# --- independence, failures, interrupts --------------------------------------------------------------------------------


def network(order):
    """Named blocks in a loop with a sampled box, events and two orders of adding up, defined in a given order."""
    parts = {}
    make = {
        "lag_a": lambda: Lag(name="lag_a", k=0.7),
        "lag_b": lambda: Lag(name="lag_b", k=1.3, start=0.4),
        "sum": lambda: Sum(signs="++-", name="sum"),
        "compare": lambda: Compare(">", name="compare"),
        "switch": lambda: Switch(name="switch"),
        "ball": lambda: Ball(name="ball"),
        "sine": lambda: Sine(frequency=0.9, name="sine"),
        "count": lambda: Crossings(name="count"),
    }
    keys = list(make)
    for i in order:
        parts[keys[i]] = make[keys[i]]()
    p = parts

    @subsystem(sample_time=0.05)
    def box(u):
        return Gain(gain=0.9, name="g")(u)

    calls = [
        lambda: p["lag_a"](p["sum"].y),
        lambda: p["lag_b"](p["switch"].y),
        lambda: p["sum"](box(p["lag_b"].y), p["sine"], p["lag_a"].y),
        lambda: p["compare"](p["lag_a"].y, p["lag_b"].y),
        lambda: p["switch"](p["compare"].y, p["sine"].y, p["lag_a"].y),
        lambda: p["count"](p["sine"].y),
    ]
    made = [calls[i]() for i in order if i < len(calls)]
    return Diagram("network", *made, p["ball"])


def test_the_order_of_definition_changes_no_bit_of_a_result():
    rng = np.random.default_rng(3)
    runs = [network(rng.permutation(8)).simulate(2.0, step=0.01, progress=False) for _ in range(4)]
    first = runs[0]
    assert len(first.events) > 5
    for run in runs[1:]:
        assert run.names == first.names
        assert np.array_equal(run.data, first.data)
        assert [(e.t, e.block) for e in run.events] == [(e.t, e.block) for e in first.events]


@pytest.mark.slow
def test_hashing_changes_no_bit_of_a_result():
    code = (
        "import sys, hashlib; sys.path[:0] = sys.argv[1:]\n"
        "from test_order_at_an_instant import network\n"
        "run = network(range(8)).simulate(1.0, step=0.01, progress=False)\n"
        "print(hashlib.sha256(run.data.tobytes()).hexdigest(), [(e.t, e.block) for e in run.events])"
    )
    here = os.path.dirname(__file__)
    found = {
        subprocess.run(
            [sys.executable, "-c", code, here, str(TESTS)],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2", "77")
    }
    assert len(found) == 1


def test_a_value_that_is_not_finite_names_the_first_block_and_keeps_the_run():
    log = Twice(name="behind")

    class Root(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return np.sqrt(u.u)

    diagram = Diagram("d", log(Root(name="root")(Ramp(slope=-1.0, initial_value=0.5))), Falls(name="f"))
    with pytest.raises(NonFiniteError, match=r"root\.y, t = 0\.\d+ s: found \[nan\].*first block") as caught:
        diagram.simulate(1.0, step=0.1, solver="rk4", progress=False)
    run = caught.value.run
    assert run.t[-1] == 0.5
    assert np.all(np.isfinite(run.data))


def test_an_exception_of_an_opaque_block_names_it_keeps_the_run_and_is_chained():
    def breaks(u):
        if u > 0.52:
            raise ZeroDivisionError("no way on")
        return u

    for extra in ((), (Falls(name="f"),)):  # a sampled run, and one with a solver

        @subsystem(sample_time=0.1)
        def box(t):
            return PythonFunction(breaks, name="foreign", results={"y": ()})(t)

        with pytest.raises(SimulationError, match=r"foreign.*t = 0\.6 s.*ZeroDivisionError: no way on") as caught:
            Diagram("d", box(Clock()), *extra).simulate(1.0, progress=False)
        assert isinstance(caught.value.__cause__, ZeroDivisionError)
        assert caught.value.block == "box.foreign"
        assert caught.value.t == 0.6
        assert caught.value.run.t[-1] == 0.5


def test_an_exception_of_an_opaque_block_between_ticks_names_it():
    def breaks(u):
        if u > 0.55:
            raise ValueError("too much")
        return u

    wired = Lag(name="lag")(PythonFunction(breaks, name="foreign", results={"y": ()})(Clock()))
    with pytest.raises(SimulationError, match=r"foreign.*ValueError: too much") as caught:
        Diagram("d", wired).simulate(1.0, step=0.1, progress=False)
    assert isinstance(caught.value.__cause__, ValueError)
    assert caught.value.run.t[-1] <= 0.5


def test_opaque_blocks_feed_through_within_a_tick():
    @subsystem(sample_time=0.1)
    def box(t):
        once = PythonFunction(lambda u: u + 1.0, name="once")(t)
        return PythonFunction(lambda u: 2.0 * u, name="twice")(Gain(gain=10.0, name="g")(once))

    run = Diagram("d", box(Clock()).named("y")).simulate(0.3, progress=False)
    assert np.allclose(run["y"], 20 * (run.t + 1), rtol=1e-15)


@pytest.mark.parametrize("continuous", [False, True])
def test_an_interrupt_keeps_the_run(continuous):
    def interrupts(u):
        if u > 0.52:
            raise KeyboardInterrupt
        return u

    @subsystem(sample_time=0.1)
    def box(t):
        return PythonFunction(interrupts, name="foreign", results={"y": ()})(t).named("y")

    extra = (Falls(name="f"),) if continuous else ()
    with pytest.raises(KeyboardInterrupt) as caught:
        Diagram("d", box(Clock()), *extra).simulate(1.0, progress=False)
    assert isinstance(caught.value, Interrupted)
    run = caught.value.run
    assert run.t[-1] == 0.5
    assert np.array_equal(run["y"], run.t)


def test_a_diagram_of_events_alone_runs():
    run = Diagram("d", Crossings(name="c")(Sine(frequency=1.0, phase=0.1))).simulate(2.0, step=0.05, progress=False)
    assert run["c.count"][-1] == 4
    assert [e.t for e in run.events] == pytest.approx([0.5 * k - 0.1 / (2 * np.pi) for k in (1, 2, 3, 4)], abs=1e-13)


@pytest.mark.slow
def test_an_event_whose_jump_changes_nothing_does_not_change_the_solution():
    class Watched(Block):
        y = State(output=True, start=1.0)
        cross = Event("both")

        def derivative(self, t, x, u):
            return -x.y

        def indicators(self, t, x, u):
            return x.y - 0.5

        def jump(self, t, x, u, fired):
            return x.y

    run = Diagram("d", Watched(name="w")).simulate(2.0, **TIGHT)
    assert run.events[0].t == pytest.approx(np.log(2), abs=5e-12)
    assert np.max(np.abs(run["w.y"] - decay(run.t))) < 1e-11


@pytest.mark.parametrize("solver", ["rk4", "DOP853", "Radau"])
def test_an_interrupt_that_comes_once_inside_a_trial_of_a_solver_ends_the_run(solver):
    """Ctrl-C meets an opaque block somewhere; it is not taken for a NaN that a shorter step gets over."""
    calls = []

    def interrupted(u):
        calls.append(u)
        if len(calls) == 40:
            raise KeyboardInterrupt
        return u

    wired = Lag(name="lag")(PythonFunction(interrupted, name="foreign", results={"y": ()})(Clock()))
    with pytest.raises(KeyboardInterrupt) as caught:
        Diagram("d", wired).simulate(10.0, step=0.1, solver=solver, progress=False)
    assert caught.value.run.t[-1] < 10.0


def test_an_exception_that_a_solver_got_over_is_not_taken_for_a_later_error():
    """In its first trials the function fails; what ends the run later is another block."""
    failed = []

    def once(u):
        if not failed and u > 0.0:
            failed.append(u)
            raise ValueError("only once")
        return 0.0

    wired = Lag(name="lag")(PythonFunction(once, name="foreign", results={"y": ()})(Clock()))
    with pytest.raises(SimulationError, match=r"ball, t = 4\.06.*Zeno"):
        Diagram("d", wired, Ball(name="ball")).simulate(6.0, progress=False)
    assert failed


def test_of_two_opaque_blocks_with_one_function_the_one_that_failed_is_named():
    def root(u):
        if u < 0:
            raise ValueError("negative")
        return u

    first, second = (PythonFunction(root, name=n, results={"y": ()}) for n in ("first", "second"))

    @subsystem(sample_time=0.1)
    def box(t):
        return first(t), second(0.35 - t)

    with pytest.raises(SimulationError, match=r"box\.second, t = 0\.4 s"):
        Diagram("d", *box(Clock())).simulate(1.0, progress=False)


@pytest.mark.drawn(3)
@pytest.mark.parametrize("duration", [0, -1.0, float("nan"), float("inf"), "1 s"])
def test_a_duration_that_is_none_is_refused_for_a_continuous_diagram_too(duration):
    with pytest.raises(OptionError, match=r"d\.duration: found a duration of .*; expected seconds, positive"):
        Diagram("d", Falls(name="f")).simulate(duration, progress=False)


def test_an_unknown_solver_is_refused_with_near_names_whether_or_not_it_is_needed():
    for diagram in (Diagram("d", Falls(name="f")), Diagram("d", counting(0.1)())):
        with pytest.raises(OptionError, match=r"no solver 'RK54'; expected one of auto, .*Did you mean .*'RK45'"):
            diagram.simulate(1.0, solver="RK54", progress=False)


def test_recording_goes_on_where_it_was_asked_for():
    with Diagram("d", Falls(name="f"), counting(0.1)().named("n")).simulation() as simulation:
        simulation.advance(0.3)
        assert simulation.run().t.tolist() == [0.0, 0.1, 0.2, 0.3]
        simulation.advance(0.2)
        assert simulation.run()["n"].tolist() == [5, 6]


def test_an_event_at_the_very_end_is_in_the_last_sample():
    run = Diagram("d", Crossings(name="c")(1.0 - Clock())).simulate(1.0, step=0.25, progress=False)
    assert [e.t for e in run.events] == [1.0]
    assert run["c.count"].tolist() == [0, 0, 0, 0, 1]


# --- what a run is asked for, and who is to blame ---------------------------------------------------------------------


def test_a_continuous_run_takes_any_duration():
    run = Diagram("d", Integrator()(Constant(value=1.0)).named("y")).simulate(np.pi, progress=False)
    assert (len(run.t), run.t[-1]) == (1001, np.pi)
    assert abs(run["y"][-1] - np.pi) < 1e-14


def test_a_continuous_run_goes_on_for_another_duration_on_the_same_samples():
    diagram = Diagram("d", Integrator()(Constant(value=1.0)).named("y"))
    run = diagram.simulate(2.5, start=diagram.simulate(1.0, progress=False).final_state, progress=False)
    assert (run.t[1] - run.t[0], run.t[-1]) == (pytest.approx(1e-3), 3.5)
    assert abs(run["y"][-1] - 3.5) < 1e-13


def test_a_rate_that_is_not_finite_names_the_block_that_made_it_so():
    bad = Function(lambda u: 1.0 / (1.0 - np.where(u > 0.5, 1.0, 0.0)), name="bad")
    diagram = Diagram("d", Integrator(name="i")(bad(Integrator(name="ramp")(Constant(value=1.0)))))
    with pytest.raises(
        NonFiniteError, match=r"^bad\.y, t = 0\.5.* s: found \[inf\].* The solver could not continue"
    ) as e:
        diagram.simulate(1.0, progress=False)
    assert (e.value.block, e.value.port) == ("bad", "y")
    assert 0.49 < e.value.run.t[-1] <= 0.5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"every": 0}, "found every=0; expected a positive integer"),
        ({"atol": "x"}, "atol is 'x'; expected a number"),
        ({"rtol": "x"}, "rtol is 'x'; expected"),
        ({"max_step": "x"}, "max_step is 'x'; expected a positive number"),
        ({"record": 3}, "d: found record=3; expected names of signals"),
        ({"to": 3}, "d: found to=3; expected the path of a folder"),
    ],
)
def test_options_that_are_none_are_refused(options, words):
    with pytest.raises(OptionError, match=words):
        Diagram("d", Integrator()(Constant(value=1.0))).simulate(1.0, **options)


def test_the_derivative_that_implicit_solvers_are_given_is_that_of_the_rates():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(3, 3))
    plant = StateSpace(A=A, B=np.zeros(3), C=np.eye(3), D=np.zeros(3), name="plant")
    flat = Diagram("d", plant(Constant(value=0.0)), Lag(name="after", k=7.0)(Constant(value=1.0))).flatten(0.1)
    workspace = Workspace(flat)  # its functions write into its vectors
    slope = workspace.jacobian()(0.0, rng.normal(size=4))
    assert np.allclose(slope, np.block([[np.array([[-7.0]]), np.zeros((1, 3))], [np.zeros((3, 1)), A]]), rtol=1e-13)

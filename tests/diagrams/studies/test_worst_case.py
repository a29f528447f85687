"""Worst cases of margins and requirements over ranges of parameters."""

import math
import re

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    Gain,
    Input,
    Integrator,
    OptionError,
    Output,
    Saturation,
    TransferFunction,
    TransportDelay,
    UnknownNameError,
    parameter,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.linearization import loop_of_variant
from loopwright.diagrams.requirements import Requirements
from loopwright.diagrams.studies import CaseOrigin, CaseState, ConfirmationKind, worst_case_search
from loopwright.diagrams.sweeps import Box
from support.tuned_loops import Tank, make_pi_loop, pi_phase_margin

RANGES = {"p.gain": (0.5, 2.0), "ki.gain": (0.2, 4.0), "rate.gain": (1.0, 3.0)}


@pytest.mark.slow
def test_the_worst_disk_margin_of_fig3_is_no_better_than_of_1000_random_points():
    """The random points' margins are read from a grid of frequencies; the worst case is confirmed by a run."""
    robot = experiments.compliance().diagram
    ranges = {"pid_perp.a2": (90.0, 150.0), "pid_perp.a1": (3600.0, 6000.0), "pid_perp.a0": (48e3, 80e3)}
    ranges["feedback_linearization.model.coulomb_scale"] = (0.8, 1.02)
    found = robot.worst_case(ranges, "v_perp", quantity="disk_margin", count=20, seed=1)
    rng, worst = np.random.default_rng(3), math.inf
    model = robot.linearize()
    omega = np.geomspace(1.0, 0.999 * np.pi / model.dt, 400)
    for _ in range(1000):
        changed = robot.replace({name: rng.uniform(low, high) for name, (low, high) in ranges.items()})
        L, _ = loop_of_variant(model, ["v_perp"], changed.wired, model.point)
        values = L(np.exp(1j * omega * model.dt))
        worst = min(worst, float(np.min(np.abs(2 * (1 + values) / (1 - values)))))
    assert found.worst.value <= worst * (1 + 1e-9)
    confirmed = found.confirm()
    assert confirmed.agrees, confirmed


@pytest.mark.slow
def test_friction_that_is_compensated_twofold_is_unstable_in_linear_model_and_run():
    robot = experiments.compliance().diagram
    found = robot.worst_case(
        {"plant.coulomb_scale": (0.5, 2.0), "plant.viscous_scale": (0.5, 2.0)}, "v_perp", count=4, seed=1
    )
    assert found.worst.state is CaseState.UNSTABLE
    assert found.parameters == {"plant.start.coulomb_scale": 0.5, "plant.start.viscous_scale": 0.5}
    confirmed = found.confirm()
    assert confirmed.kind is ConfirmationKind.GROWTH
    assert confirmed.agrees, confirmed


def make_lag_loop(a0=0.1, a1=1.0, b=2.0, k=3.0):
    motor = TransferFunction(numerator=[b], denominator=[a0, a1], name="motor")
    return Diagram("lag", motor(Gain(gain=k, name="k")(Constant(value=0.0, name="r") - motor.y).named("u")))


def lag_delay_margin(a0, a1, b=2.0, k=3.0):
    """The delay margin of L = k b/(a0 s + a1)."""
    w = math.sqrt((k * b) ** 2 - a1**2) / a0
    return (math.pi - math.atan2(a0 * w, a1)) / w


def test_entries_of_an_array_are_ranges_by_the_names_that_sensitivity_gives():
    diagram = make_lag_loop()
    slopes = diagram.sensitivities("u", ["motor.denominator[1]", "motor.numerator"])
    assert [row.parameter for row in slopes.of("delay_margin_s")] == ["motor.numerator[1]", "motor.denominator[1]"]
    h = 1e-5
    by_hand = (lag_delay_margin(0.1 + h, 1.0) - lag_delay_margin(0.1 - h, 1.0)) / (2 * h)
    assert slopes["motor.denominator[1]", "delay_margin_s"].slope.value == pytest.approx(by_hand, rel=1e-6)
    ranges = {"motor.denominator[1]": (0.05, 0.2), "motor.denominator[2]": (0.5, 2.0)}
    found = diagram.worst_case(ranges, "u", quantity="delay_margin_s", count=2, starts=1, steps=2)
    assert found.parameters["motor.denominator[1]"] == 0.05
    assert found.worst.value == pytest.approx(
        lag_delay_margin(0.05, found.parameters["motor.denominator[2]"]), rel=1e-9
    )
    assert found.worst.value <= lag_delay_margin(0.05, 0.5) * (1.0 + 1e-12)
    assert found.diagram.blocks["motor"].denominator[0] == 0.05


@pytest.mark.drawn(1)
@pytest.mark.parametrize("quantity", ["phase_margin_deg", "delay_margin_s", "gain_margin_high"])
def test_an_infinite_margin_is_as_good_as_can_be(quantity):
    """L = k/(s + 1) has no crossover below k = 1, and never a limit of its gain."""
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
    diagram = Diagram("lag", plant(Gain(gain=0.8, name="k")(Constant(value=0.0, name="r") - plant.y).named("u")))
    found = diagram.worst_case({"k.gain": (0.5, 3.0)}, "u", quantity=quantity, count=4, seed=1, steps=5)
    assert not found.failures
    assert found.nominal[0].value == math.inf
    margin = math.pi - math.atan(math.sqrt(8.0))
    by_hand = {"phase_margin_deg": math.degrees(margin), "delay_margin_s": margin / math.sqrt(8.0)}
    assert found.worst.value == pytest.approx(by_hand.get(quantity, math.inf), rel=1e-9)


def draw(count, seed=5):
    rng = np.random.default_rng(seed)
    return [tuple(rng.uniform(low, high) for low, high in RANGES.values()) for _ in range(count)]


@pytest.mark.slow
def test_the_worst_phase_margin_of_a_pi_loop_is_no_better_than_of_1000_random_points():
    """The closed form gives the random points' margins."""
    found = make_pi_loop().worst_case(RANGES, "u", quantity="phase_margin_deg", count=20, seed=1)
    random = min(pi_phase_margin(*values) for values in draw(1000))
    assert found.worst.value <= random
    values = [found.parameters[name] for name in RANGES]
    assert found.worst.value == pytest.approx(pi_phase_margin(*values), rel=1e-9)
    confirmed = found.confirm()
    assert confirmed.agrees
    assert confirmed.kind is ConfirmationKind.INJECTION


def test_a_search_goes_down_to_the_worst_corner():
    found = make_pi_loop().worst_case(
        {"p.gain": (0.5, 2.0)}, "u", quantity="phase_margin_deg", count=2, seed=1, starts=1, steps=4
    )
    assert found.worst.value == pytest.approx(pi_phase_margin(0.5, 0.5, 2.0), rel=1e-9)
    assert found.parameters == {"p.gain": 0.5}
    assert found.worst.goodness <= found.worst_sample.goodness
    assert found.diagram.blocks["p"].gain == 0.5
    assert {row["origin"] for row in found.table()} >= {"nominal", "sample", "corner"}
    assert len(found.plot().axes) == 1
    assert re.search(r"^  found by +corner$", str(found), re.MULTILINE)


def test_the_gradient_of_the_search_is_that_of_the_margin():
    from loopwright.diagrams.studies.cases import make_goal
    from loopwright.diagrams.studies.worst_case_search import Study

    diagram = make_pi_loop()
    boxes = {"p.gain": Box(0.5, 2.0), "ki.gain": Box(0.2, 4.0, "log")}
    goal = make_goal("u", "phase_margin_deg", None, "pi")
    study = Study(diagram.wired, goal, boxes, (None,), 0, {}, lambda text: None)
    study.run({}, CaseOrigin.NOMINAL)
    at = np.array([0.4, 0.6])
    case = study.run(study.ranges.parameters_at(at), CaseOrigin.SEARCH)[0]
    found = study.gradient(case, at)

    def margin(x):
        values = study.ranges.parameters_at(x)
        return pi_phase_margin(values["p.gain"], values["ki.gain"], 2.0)

    h = 1e-4
    for i, direction in enumerate(np.eye(2)):
        assert found[i] == pytest.approx((margin(at + h * direction) - margin(at - h * direction)) / (2 * h), rel=1e-6)


def test_requirements_are_compared_by_their_distance():
    asked = Requirements(phase_margin_deg=60, ms=1.3)
    found = make_pi_loop().worst_case({"p.gain": [0.5, 1.0, 2.0]}, "u", requirements=asked, samples="grid", starts=0)
    by_hand = {kp: pi_phase_margin(kp, 0.5, 2.0) / 60 - 1 for kp in (0.5, 1.0, 2.0)}
    for case in found.cases:
        if case.parameters and case.quantity == "phase_margin_deg":
            assert case.goodness == pytest.approx(by_hand[case.parameters["p.gain"]], rel=1e-9)
    assert found.worst.goodness == min(case.goodness for case in found.cases)


def test_an_unstable_case_is_the_worst_and_a_run_grows():
    found = make_pi_loop().worst_case({"p.gain": (-2.0, 2.0)}, "u", count=4, seed=0)
    assert found.worst.state is CaseState.UNSTABLE
    assert found.parameters["p.gain"] == -2.0
    roots = np.roots([1.0, 2.0 + 2.0 * -2.0, 2.0 * 0.5])
    assert found.worst.growth == pytest.approx(roots.real.max(), rel=3e-7)  # a double root: the square root of rounding
    assert all(case.growth <= found.worst.growth for case in found.unstable)
    confirmed = found.confirm()
    assert confirmed.kind is ConfirmationKind.GROWTH
    assert confirmed.agrees, confirmed


def make_tank():
    tank = Tank(outlet=0.7, area=2.0, start=1.44, name="tank")
    inflow = Constant(value=0.7 * math.sqrt(1.44), name="inflow")
    u = Gain(gain=2.0, name="k")(1.44 - tank.level).named("u")
    return Diagram("tank", tank(inflow=inflow + u))


def test_a_case_that_cannot_be_analysed_counts_as_the_worst_and_tells_why():
    found = make_tank().worst_case(
        None, "u", quantity="bandwidth", samples=[{"tank.start": 1.44}, {"tank.start": -1.0}], starts=0
    )
    assert found.worst.state is CaseState.FAILED
    assert found.parameters == {"tank.start": -1.0}
    assert "tank" in found.worst.reason
    assert found.worst_analysed.state is not CaseState.FAILED
    assert "1 cases failed" in str(found) or "failed" in str(found)
    with pytest.raises(OptionError, match=r"failed.*found\.worst_analysed, has bandwidth = .*found\.failures"):
        found.confirm()


def test_with_cases_that_failed_the_printed_worst_case_has_the_worst_of_the_others():
    """An infinite gain is refused; the other two are analysed."""
    samples = [{"p.gain": 0.5}, {"p.gain": 1.5}, {"p.gain": math.inf}]
    found = make_pi_loop().worst_case(None, "u", quantity="phase_margin_deg", samples=samples, starts=0)
    assert found.worst.state is CaseState.FAILED
    shown = str(found)
    number = found.worst_analysed.numbers["u",]["phase_margin_deg"]
    assert found.worst_analysed.parameters in samples[:2]
    assert re.search(rf"worst analysed +phase_margin_deg = {re.escape(str(number))} at u", shown)
    value = found.worst_analysed.parameters["p.gain"]
    assert re.search(rf"that was analysed, found\.worst_analysed\n.*\np\.gain +{value}", shown)
    margins = [case.value for case in found.cases if case.parameters in samples[:2]]
    assert number.value == min(margins)
    assert "worst analysed" not in str(make_pi_loop().worst_case(None, "u", samples=samples[:2], starts=0))


def test_a_point_that_no_longer_rests_says_so():
    found = make_tank().worst_case(None, "u", quantity="bandwidth", samples=[{"tank.outlet": 1.4}], starts=0)
    assert [case.state for case in found.cases] == [CaseState.STABLE, CaseState.MOVING]
    trimmed = make_tank().worst_case(
        None, "u", quantity="bandwidth", samples=[{"tank.outlet": 1.4}], starts=0, at=lambda d: d.trim()
    )
    assert [case.state for case in trimmed.cases] == [CaseState.STABLE, CaseState.STABLE]


def test_several_operating_points_are_tried():
    found = make_tank().worst_case(
        {"k.gain": (1.0, 2.0)},
        "u",
        quantity="bandwidth",
        count=2,
        starts=0,
        points=[lambda d: d.trim(), lambda d: d.replace({"inflow.value": 2.0}).trim()],
    )
    assert {case.point for case in found.cases} == {0, 1}
    assert len(found.nominal) == 2


def test_wrong_questions_are_refused():
    diagram = make_pi_loop()
    with pytest.raises(UnknownNameError):
        diagram.worst_case({"p.gian": (0.5, 2.0)}, "u", count=2)
    with pytest.raises(OptionError, match="expected one of them"):
        diagram.worst_case({"p.gain": (0.5, 2.0)}, "u", quantity="ms", requirements=Requirements(ms=2))
    with pytest.raises(OptionError, match="ms"):
        diagram.worst_case({"p.gain": (0.5, 2.0)}, "u", quantity="mss")
    with pytest.raises(OptionError, match=r"pi.loop: found .ms. of 2 wires; .*=Requirements\(ms=…\)"):
        diagram.worst_case({"p.gain": (0.5, 2.0)}, ["u", "x.y"], quantity="ms")
    with pytest.raises(OptionError, match="no loop"):
        diagram.worst_case({"p.gain": (0.5, 2.0)}, quantity="ms")
    with pytest.raises(OptionError, match="limit no number"):
        diagram.worst_case({"p.gain": (0.5, 2.0)}, "u", requirements=Requirements(step={"overshoot": 0.1}))


class Switched(Block):
    u = Input()
    y = Output()
    on: bool = parameter(default=True)
    times: int = parameter(default=2)
    mode: str = parameter(default="plain")

    def output(self, t, x, u):
        return self.times * u.u if self.on else u.u


def make_switched():
    state = Integrator(name="x")

    @subsystem(sample_time=0.1)
    def control(y):
        return Switched(name="switch")(Constant(value=0.0, name="r") - y).named("u")

    return Diagram("switched", state(control(state.y)))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("control.sample_time", "a sample time of a subsystem"),
        ("control.delay", "a delay of a subsystem"),
        ("control.offset", "an offset of a subsystem"),
        ("control.method", "a method of a subsystem"),
        ("control.switch.on", "a parameter that is true or false"),
        ("control.switch.times", "a whole number"),
        ("control.switch.mode", "a parameter that is no number"),
    ],
)
def test_structure_is_no_parameter_of_a_study(name, kind):
    told, diagram = list[str](), make_switched()
    head, _, last = name.rpartition(".")
    with pytest.raises(OptionError, match=rf"{head}.{last}: found {kind} .* a worst case; .*replace") as caught:
        diagram.worst_case({name: (0.0, 1.0)}, "control.u", progress=told.append)
    assert (caught.value.block, caught.value.port, told) == (head, last, [])
    with pytest.raises(OptionError, match=rf"{head}.{last}: found {kind} among the parameters of a sensitivity"):
        diagram.sensitivities("control.u", [name])


@pytest.mark.slow
def test_a_worst_bandwidth_is_confirmed_by_a_run_at_it():
    """T = (p s + ki) a/(s² + a (1 + p) s + ki a); it was measured as NaN, and refuted."""
    found = make_pi_loop(a=2.0).worst_case({"p.gain": [0.5, 1.0]}, "u", quantity="bandwidth", samples="grid", starts=0)
    confirmed = found.confirm()
    p = found.parameters.get("p.gain", 1.0)

    def excess(w):
        s = 1j * w
        return abs((p * s + 0.5) * 2.0 / (s * s + 2.0 * (1.0 + p) * s + 1.0)) - math.sqrt(0.5)

    expected = brentq(excess, 1e-2, 1e3)
    assert found.worst.value == pytest.approx(expected, rel=1e-6)
    assert confirmed.agrees
    assert confirmed.measured == pytest.approx(expected, rel=1e-3)


def limited(start, gain_limit=3.0, leak=0.5, T=0.02):
    """x' = leak x + k sat(PI(−x)): unstable with a small gain k."""
    x, gain = Integrator(initial_value=start, name="x"), Gain(gain=1.0, name="k")

    @subsystem(sample_time=T)
    def controller(y):
        v = PID(kp=2.0, ki=1.0, name="pid")(Constant(value=0.0, name="r"), y)
        return Saturation(limit=gain_limit, name="sat")(v).y.named("u")

    return Diagram("limited", x(gain(controller(x.y)) + leak * x.y))


def test_a_worst_case_that_leaves_a_moving_point_into_its_limits_is_confirmed():
    """Saturated, the wire shows no growth; x grows by e^(0.5 t), faster than the loop's pole of 0.15 1/s."""
    found = limited(0.5).worst_case({"k.gain": [0.1, 1.0]}, "u", quantity="ms", samples="grid", starts=0)
    assert found.worst.state is CaseState.UNSTABLE
    run = found.confirm()
    assert (run.kind, run.agrees) == (ConfirmationKind.DEPARTURE, True)
    assert run.predicted == found.worst.growth == pytest.approx(0.1513, abs=1e-3)
    assert run.measured == pytest.approx(0.5, rel=2e-3)


def test_a_motion_that_ends_in_a_limit_cycle_is_no_departure():
    """x[k+1] = x[k] − 2.5 sat(x[k]) jumps to and fro between bounds, though its pole is at −1.5."""
    x, gain = Integrator(initial_value=0.4, name="x"), Gain(gain=1.0, name="k")

    @subsystem(sample_time=1.0)
    def controller(y):
        return Saturation(limit=0.5, name="sat")(Gain(gain=-1.0, name="law")(y)).y.named("u")

    diagram = Diagram("cycle", x(gain(controller(x.y))))
    found = diagram.worst_case({"k.gain": [0.5, 2.5]}, "u", quantity="ms", samples="grid", starts=0)
    assert not found.confirm().agrees


def test_a_search_computes_no_case_twice_and_finds_the_least_value():
    """(k − 0.7)² + (1 − p)² has its least value, 0.01, at k = 0.7 and the end p = 0.9 of its range."""
    diagram, seen = make_pi_loop(), list[tuple[float, float]]()

    def bowl(changed):
        values = changed.blocks["p"].gain, changed.blocks["ki"].gain
        seen.append(values)
        return (values[0] - 0.7) ** 2 + (1.0 - values[1]) ** 2

    found = diagram.worst_case({"p.gain": (0.1, 1.0), "ki.gain": (0.0, 0.9)}, quantity=bowl, count=6, seed=2)
    assert found.worst.value == pytest.approx(0.01, abs=1e-5)
    ran = seen[1:]  # the first is the diagram as it is
    near = [(i, k) for i in range(len(ran)) for k in range(i) if np.max(np.abs(np.subtract(ran[i], ran[k]))) < 5e-10]
    assert near == []
    assert len(ran) == len(found.cases) - 1


def test_slopes_by_differences_need_no_further_linear_model(monkeypatch):
    made, linearize = [], worst_case_search.linearize
    monkeypatch.setattr(
        worst_case_search, "linearize", lambda *of, **options: made.append(1) or linearize(*of, **options)
    )
    monkeypatch.setattr(worst_case_search, "_is_start_value", lambda diagram, name: True)  # as an FMU's parameter
    found = make_pi_loop().worst_case({"p.gain": (0.5, 2.0)}, "u", quantity="ms", count=3, starts=1, steps=3)
    s = 1j * np.geomspace(0.1, 100.0, 2001)
    by_hand = max(np.max(1 / np.abs(1 + (kp * s + 0.5) * 2.0 / (s * (s + 2.0)))) for kp in np.linspace(0.5, 2.0, 61))
    assert found.worst.value >= by_hand - 1e-6
    make_pi_loop().worst_case({"p.gain": (0.5, 2.0)}, "u", quantity="ms", count=5, starts=0)
    assert len(made) == 4  # of both searches: the diagram as it is, and the worst case with its findings


def test_equal_samples_are_cases_of_their_own():
    ranges = {"p.gain": [0.5, 0.5, 1.0]}
    found = make_pi_loop().worst_case(ranges, "u", quantity="ms", samples="grid", starts=0)
    assert [case.origin for case in found.cases].count(CaseOrigin.SAMPLE) == 3


@pytest.mark.parametrize(
    ("name", "ends", "said"),
    [
        ("dead.delay", (0.0, 0.9), "found a range from 0 to 0.9; expected values above 0 s"),
        pytest.param("dead.delay", Box(-0.5, 0.9), "expected values above 0 s", marks=pytest.mark.slow),
    ],
)
def test_a_range_with_an_end_that_the_parameter_refuses_is_refused_before_anything_is_computed(name, ends, said):
    told = []
    lag = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")
    y = TransportDelay(delay=0.2, name="dead")(lag.y)
    diagram = Diagram("late", lag(Gain(gain=2.0, name="k")(-1.0 * y).named("u")))
    with pytest.raises(OptionError, match=rf"^{re.escape(name)}: .*{re.escape(said)}"):
        diagram.worst_case({name: ends}, "u", count=2, progress=told.append)
    assert not told
    found = diagram.worst_case({name: (0.1, 0.3)}, "u", quantity="phase_margin_deg", count=2, starts=0)
    assert not found.failures


def test_ends_that_only_other_parameters_refuse_are_left_to_the_cases():
    """A lower limit of 2 to 3 goes with an upper one of 4 to 5, and not with the present one, 1."""
    diagram = Diagram("limited", Saturation(lower=-1.0, upper=1.0, name="limits")(Constant(value=9.0)).named("y"))
    ranges = {"limits.lower": (2.0, 3.0), "limits.upper": (4.0, 5.0)}
    found = diagram.worst_case(ranges, quantity=lambda d: d.operating_point(0.0).values["limits.y"], count=2, starts=1)
    assert not found.failures
    assert min(case.value for case in found.cases if case.parameters) == 4.0

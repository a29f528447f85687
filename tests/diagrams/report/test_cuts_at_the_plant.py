"""Loops of designs whose blocks are side by side, cut at the plant's input or not decided; by python-control."""

import control
import numpy as np
import pytest

from loopwright import Fmu
from loopwright.blocks import (
    Block,
    Constant,
    DiscreteObserver,
    DiscreteStateSpace,
    Gain,
    Input,
    Integrator,
    Observer,
    Saturation,
    State,
    StateFeedback,
    StateSpace,
    TransferFunction,
    TransportDelay,
)
from loopwright.diagrams import Diagram, Requirements, subsystem
from loopwright.diagrams.requirements import Reason, Verdict
from loopwright.diagrams.studies import find_places
from loopwright.fmus import mass_spring_damper
from support.predictors import T, observed, smith
from support.public_calls import drive

A, B, C = np.array([[0.0, 1.0], [20.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
UPRIGHT = control.ss(A, B, C, 0.0)
K, L = np.array([[75.0, 12.0]]), control.place(A.T, C.T, [-20.0, -22.0]).T
BY_HAND = control.ss(A - B @ K - L @ C, L, K, 0.0) * UPRIGHT
"""The loop at the plant's input, with the observer inside."""
ASKED = {"phase_margin_deg": 45, "ms": 1.5}


class OwnObserver(Block):
    """An observer that nothing declares as one."""

    u = Input()
    y = Input()
    estimate = State(shape=(2,), start=0.0, output=True)

    def derivative(self, t, x, u):
        return A @ x.estimate + B[:, 0] * u.u + L[:, 0] * (u.y - x.estimate[0])


def verdicts(report):
    return {r.quantity: (r.verdict, r.reason) for r in report.review.results if r.loop}


def place(diagram, wire):
    (found,) = find_places(diagram.wired, {wire: wire}, None).values()
    return found


def with_observer(kind, limited=False):
    """A pendulum with state feedback and observer, all in continuous time and side by side."""
    plant = StateSpace.from_control(UPRIGHT, name="plant")
    law = StateFeedback(gain=K, name="law")
    force = law.y.named("force")
    sent = Saturation(limit=1e3, name="limit")(force).y if limited else force
    return Diagram("balanced", plant(sent), law(kind()(sent, plant.y)))


def library():
    return Observer(UPRIGHT, L, name="observer")


def own():
    return OwnObserver(name="observer")


@pytest.mark.drawn(1)
@pytest.mark.parametrize("limited", [False, True])
def test_a_report_cuts_at_the_plant_beside_an_observer_at_top_level(limited):
    """Behind the wire both ways are cut: 64° and M_s = 1, whatever the observer; at the plant 33° and 1.8."""
    _, margin, distance = control.stability_margins(BY_HAND)[:3]
    report = with_observer(library, limited).report(only=("inner",), requirements=Requirements(**ASKED))
    numbers = report.numbers()
    assert numbers["inner.force.continuous.phase_margin_deg"].value == pytest.approx(margin, abs=1e-4)
    assert numbers["inner.force.continuous.ms"].value == pytest.approx(1.0 / distance, rel=1e-5)
    assert {verdict for verdict, _ in verdicts(report).values()} == {Verdict.FAILED}
    assert place(with_observer(library, limited), "force").to == (("plant", "u"),)


def test_a_worst_case_is_looked_for_at_the_plant_beside_an_observer():
    found = with_observer(library, True).worst_case(
        {"law.gain": [K, 1.1 * K]}, "force", quantity="phase_margin_deg", samples="grid", starts=0
    )
    assert found.nominal[0].value == pytest.approx(control.stability_margins(BY_HAND)[1], abs=1e-4)


@pytest.mark.slow
def test_a_verdict_is_open_where_an_observer_is_not_declared():
    """Its graph is that of two tanks in line, both fed by the wire: 33° at one, 64° for both."""
    diagram = with_observer(own)
    report = diagram.report(only=("inner",), requirements=Requirements(**ASKED))
    assert set(verdicts(report).values()) == {(Verdict.UNDECIDED, Reason.SEVERAL_CUTS)}
    assert report.review.verdict is Verdict.UNDECIDED
    said = str(report.review)
    margin = control.stability_margins(BY_HAND)[1]
    assert f"{margin:.4g}° at plant.u" in said
    assert "° at all of them" in said
    assert "name the plant's inputs as to=… in the requirements' loops, or to=[] for all blocks together" in said
    for to, verdict in (("plant.u", Verdict.FAILED), ([], Verdict.PASSED)):
        asked = Requirements(loops={"force": {"phase_margin_deg": 45, "to": to}})
        decided = diagram.report(only=("inner",), requirements=asked)
        assert verdicts(decided)["phase_margin_deg"] == (verdict, Reason.COMPARED)


@pytest.mark.slow
def test_a_verdict_counts_where_all_cuts_have_it():
    report = observed(boxed=False).report(only=("inner",), requirements=Requirements(**ASKED))
    assert {verdict for verdict, _ in verdicts(report).values()} == {Verdict.PASSED}
    report = observed(boxed=False).report(only=("inner",), requirements=Requirements(phase_margin_deg=60))
    assert set(verdicts(report).values()) == {(Verdict.UNDECIDED, Reason.SEVERAL_CUTS)}


def test_a_worst_case_says_what_other_cuts_have():
    diagram, ranges = with_observer(own), {"law.gain": [K, 1.1 * K]}
    found = diagram.worst_case(ranges, "force", quantity="phase_margin_deg", samples="grid", starts=0)
    gain = found.parameters.get("law.gain", K)
    there = control.ss(A - B @ gain - L @ C, L, gain, 0.0) * UPRIGHT
    expected = control.stability_margins(there)[1]
    assert found.elsewhere["plant.u"]["phase_margin_deg"].value == pytest.approx(expected, abs=1e-4)
    assert f"{expected:.6g} at plant.u" in str(found)


@pytest.mark.slow
def test_a_worst_case_at_the_plants_input_is_one_of_the_diagram_that_was_given():
    diagram = with_observer(library)
    found = diagram.worst_case(
        {"law.gain": [K, 1.1 * K]}, "force", quantity="phase_margin_deg", samples="grid", starts=0
    )
    report = diagram.report(only=("inner",), requirements=Requirements(phase_margin_deg=45), worst_case=found)
    assert verdicts(report)["phase_margin_deg"] == (Verdict.FAILED, Reason.COMPARED)


def predictor():
    """A Smith predictor in continuous time, its blocks side by side."""
    plant = TransferFunction(numerator=[1.3], denominator=[5.0, 1.0], name="plant")
    late = TransferFunction(numerator=[1.0], denominator=[3.0, 1.0], name="late")
    model = TransferFunction(numerator=[1.0], denominator=[5.0, 1.0], name="model")
    model_late = TransferFunction(numerator=[1.0], denominator=[3.0, 1.0], name="model_late")
    error = Constant(value=0.0) - (late(plant.y) + model.y - model_late(model.y))
    u = Gain(gain=8.0, name="law")(error).named("u")
    return Diagram("predictor", plant(u), model(u))


@pytest.mark.slow
def test_a_verdict_is_open_beside_a_predictor_whose_blocks_are_side_by_side():
    s = control.tf("s")
    inner, lag = 8.0 / (5 * s + 1), 1 / (3 * s + 1)
    at_plant = control.minreal(1.3 * inner * lag / (1 + inner * (1 - lag)), verbose=False)
    everywhere = inner * (1 - lag) + 1.3 * inner * lag
    report = predictor().report(only=("inner",), requirements=Requirements(ms=1.05))
    w = 1j * np.geomspace(1e-3, 1e3, 40001)
    assert np.max(np.abs(1 / (1 + everywhere(w)))) < 1.04 < 1.09 < np.max(np.abs(1 / (1 + at_plant(w))))
    assert verdicts(report)["ms"] == (Verdict.UNDECIDED, Reason.SEVERAL_CUTS)
    place_of = place(predictor(), "u")
    assert place_of.to == ()
    assert ("u", ("plant.u",)) in place_of.others
    assert place(smith(), "controller.u").to == (("plant", "u"),)


def test_a_verdict_is_open_beside_a_predictor_in_continuous_time_of_a_sampled_law():
    """What comes back to the law is one signal, as of two parallel parts of a plant."""
    plant = TransferFunction(numerator=[2.0], denominator=[10.0, 1.0], name="plant")
    model = TransferFunction(numerator=[2.0], denominator=[10.0, 1.0], name="model")
    law = subsystem(sample_time=0.1, name="law")(lambda e: Gain(gain=-1.5, name="gain")(e).y.named("u"))
    u = law(TransportDelay(delay=8.0, name="dead_time")(plant.y) + model.y - TransportDelay(delay=8.0)(model.y))
    found = place(Diagram("predicted", plant(u), model(u)), "law.u")
    assert found.to == ()
    assert {to for _, to in found.others} == {("plant.u",), ("model.u",)}


def anti_windup(sample_time=None):
    """PI control with back-calculation, block by block: the saturated signal less the signal goes to the integrator."""
    plant = TransferFunction(numerator=[1.0], denominator=[4.0, 5.0, 1.0], name="plant")
    limit = Saturation(limit=4.0, name="limit")

    def law(y):
        error = Constant(value=0.0) - y
        integral = Integrator(name="integral")
        u = (3.0 * error + integral.y).named("u")
        return limit(u).y, integral(2.0 * error + 5.0 * (limit.y - u))

    if sample_time is None:
        sent, integral = law(plant.y)
        return Diagram("level", plant(sent), integral)
    sent, integral = subsystem(sample_time=sample_time, name="box")(law)(plant.y)
    return Diagram("level", plant(sent), integral)


def test_the_way_of_an_anti_windup_leaves_the_loop_at_the_plant():
    expected = control.margin(control.tf([3.0, 2.0], [4.0, 5.0, 1.0, 0.0]))[1]
    report = anti_windup().report(only=("inner",), requirements=Requirements(phase_margin_deg=expected - 1))
    found = report.numbers()["inner.u.continuous.phase_margin_deg"]
    assert found.value == pytest.approx(expected, abs=1e-6)
    assert verdicts(report)["phase_margin_deg"] == (Verdict.PASSED, Reason.COMPARED)
    sampled = place(anti_windup(T), "box.u")
    assert (sampled.at, sampled.to) == ("box.limit.y", (("plant", "u"),))


def test_a_pi_law_of_single_blocks_is_decided():
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
    error = (Constant(value=0.0) - plant.y).named("error")
    diagram = Diagram("pi", plant(2.0 * error + 2.0 * Integrator(name="integral")(error)))
    report = diagram.report(only=("inner",), requirements=Requirements(phase_margin_deg=60, ms=1.3))
    assert {verdict for verdict, _ in verdicts(report).values()} == {Verdict.PASSED}


@pytest.mark.slow
@pytest.mark.parametrize("wire", ["e", "y"])
@pytest.mark.parametrize(("ms", "verdict"), [(2.6, Verdict.PASSED), (2.3, Verdict.FAILED)])
def test_an_error_that_enters_a_sampled_pi_law_is_one_wire(wire, ms, verdict):
    """M_s 2.462 where the error is cut; 1.769 and 2.078 ahead of either part of the law, which nobody means."""
    report = drive().report(only=("inner",), requirements=Requirements(loops={wire: {"ms": ms}}))
    assert set(verdicts(report).values()) == {(verdict, Reason.COMPARED)}
    plant = control.sample_system(control.ss([[0.0, 1.0], [-9.0, -0.6]], [[0.0], [9.0]], [[1.0, 0.0]], 0.0), 0.02)
    z = np.exp(0.02j * np.linspace(1.0, 10.0, 20001))
    of_plant = plant.C @ np.linalg.solve(z[:, None, None] * np.eye(2) - plant.A, plant.B)
    L = of_plant[:, 0, 0] * (0.2 + 0.3 * 0.02 / (z - 1.0))
    (number,) = (r.number for r in report.review.results if r.quantity == "ms")
    assert number.value == pytest.approx(np.max(1.0 / np.abs(1.0 + L)), rel=1e-6)


class Disturbance(Block):
    """Observer of the disturbance d of v' = u + d, from the force and the speed, with its declared model."""

    u = Input(models_plant=True)
    v = Input()
    z = State()
    d = State(output=True)

    def derivative(self, t, x, u):
        return u.u + x.d + 20.0 * (u.v - x.z), 100.0 * (u.v - x.z)


def test_a_block_can_declare_the_input_of_its_model():
    """u = −k v − d̂: at the plant's input L = (k (s² + 20 s) + 100 (s + k)) / (s² (s + 20)) − …, by its parts."""
    mass, seen, k = Integrator(name="mass"), Disturbance(name="seen"), 4.0
    u = (-k * mass.y - seen.d).named("u")
    diagram = Diagram("disturbance", mass(u), seen(u=u, v=mass.y))
    model = diagram.linearize()
    one, found = model.loop("u", to="mass.u"), place(diagram, "u")
    assert (found.to, found.own) == ((("mass", "u"),), (("seen", "u"),))
    for s in (0.7j, 5j, 30j):
        own = 100.0 / (s * s + 20.0 * s + 100.0)  # d̂ = own · (s v − u)
        assert one(s) == pytest.approx((k + s * own) / (1.0 - own) / s, rel=1e-9)
    asked = Requirements(ms=2.0)
    value = diagram.report(only=("inner",), requirements=asked).numbers()["inner.u.continuous.ms"].value
    w = 1j * np.geomspace(1e-1, 1e2, 2001)
    assert value == pytest.approx(np.max(1.0 / np.abs(1.0 + one(w))), rel=1e-4)


def test_the_plant_is_the_fmu_that_drives_an_observer():
    plant = Fmu(mass_spring_damper.build(), name="plant")

    class Seen(OwnObserver):
        """Observer of the mass."""

    seen = Seen(name="seen")
    u = (-1.0 * seen.estimate[0] - seen.estimate[1]).named("u")
    found = place(Diagram("mass", plant(force=u), seen(u=u, y=plant.position)), "u")
    assert (found.to, found.own, found.others) == ((("plant", "force"),), (("seen", "u"),), ())


def test_a_discrete_observer_at_the_clock_of_its_plant_is_the_controllers_own():
    sampled = control.c2d(UPRIGHT, 0.01)
    gain = control.place(np.asarray(sampled.A), np.asarray(sampled.B), [0.9, 0.91])
    seen = control.place(np.asarray(sampled.A).T, np.asarray(sampled.C).T, [0.8, 0.81]).T

    @subsystem(sample_time=0.01)
    def everything():
        plant = DiscreteStateSpace.from_control(sampled, name="plant")
        law = StateFeedback(gain=gain, name="law")
        force = law.y.named("force")
        observer = DiscreteObserver(sampled, seen, name="observer")
        law(observer(force, plant.y).x_hat)
        return plant(force)

    found = place(Diagram("sampled", Gain(gain=1.0, name="shown")(everything())), "everything.force")
    assert found.to == (("everything.plant", "u"),)

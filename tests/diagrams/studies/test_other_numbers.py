"""Worst cases of numbers that are no loop's: limits of contacts, and functions of a user's own."""

import control
import numpy as np
import pytest

from loopwright.blocks import Gain, OptionError
from loopwright.diagrams import Diagram, Requirements
from loopwright.diagrams.report import analyse
from loopwright.diagrams.studies import CaseState, ConfirmationKind, WorstCaseTask
from loopwright.fmus import Fmu, dc_motor
from support.carts import DRAG, SHARE, TAU, M, cart_diagram
from support.tuned_loops import make_pi_loop

CONTACT = {"port": "cart.push", "position": "cart.position", "velocity": "cart.velocity", "force": "felt"}
CONTACT |= {"direction": [1.0], "damping": 2.0}
RANGES = {"share.gain": (2.0, 5.0), "drive.denominator[1]": (0.01, 0.05), "drag.gain": (4.0, 10.0)}


def spring_limit(share=SHARE, lag=TAU, drag=DRAG, damper=2.0):
    """Routh: M τ s³ + (M + b τ) s² + (d + k τ + b (1 + S)) s + k (1 + S) has its roots on the axis."""
    return (M + damper * lag) * (drag + damper * (1 + share)) / (lag * (M * share - damper * lag))


def test_the_limit_of_a_contact_is_that_of_its_closed_form():
    found = cart_diagram().worst_case({"share.gain": [2.0, 5.0]}, contact=CONTACT, samples="grid", starts=0)
    assert found.parameters == {"share.gain": 5.0}
    for case in found.cases:
        assert case.value == pytest.approx(spring_limit(case.parameters.get("share.gain", SHARE)), rel=1e-6)


@pytest.mark.slow
def test_the_worst_limit_of_a_contact_is_no_better_than_of_1000_random_points():
    found = cart_diagram().worst_case(RANGES, contact=CONTACT, count=2, starts=1, steps=2, seed=1)
    assert found.nominal[0].value == pytest.approx(spring_limit(), rel=1e-6)
    assert found.parameters == {"share.gain": 5.0, "drive.denominator[1]": 0.05, "drag.gain": 4.0}
    assert found.worst.value == pytest.approx(spring_limit(5.0, 0.05, 4.0), rel=1e-6)
    assert (found.worst.loop, found.worst.quantity) == (("cart.push",), "stiffness_limit")
    random = [np.random.default_rng(3).uniform(low, high, 1000) for low, high in RANGES.values()]
    assert found.worst.value <= np.min(spring_limit(*random))
    assert {row["quantity"] for row in found.table()} == {"stiffness_limit"}


@pytest.mark.slow
def test_the_worst_limit_of_a_contact_is_confirmed_by_runs_beside_it():
    found = cart_diagram().worst_case(RANGES, contact=CONTACT, count=1, starts=0)
    confirmed = found.confirm()
    assert confirmed.agrees, confirmed
    assert confirmed.kind is ConfirmationKind.CONTACT
    assert confirmed.measured > 0.0
    report = analyse(cart_diagram(), worst_case=found, only=("poles",))
    assert report.numbers()["worst_case.worst.stiffness_limit"].value == found.worst.value


def test_a_search_goes_downhill_by_differences():
    """The bottom lies inside the ranges: a bowl in the gains, without a corner."""

    def bowl(diagram):
        x, y = (diagram.blocks[name].gain for name in ("p", "ki"))
        return (x - 0.9) ** 2 + 3.0 * (y - 1.1) ** 2 + (x - 0.9) * (y - 1.1)

    found = make_pi_loop().worst_case({"p.gain": (0.5, 2.0), "ki.gain": (0.2, 4.0)}, quantity=bowl, count=4, seed=1)
    assert found.parameters == pytest.approx({"p.gain": 0.9, "ki.gain": 1.1}, abs=0.01)
    assert found.worst.quantity == "bowl"
    assert found.worst.value < 1e-3
    with pytest.raises(OptionError, match="'bowl', a function of your own"):
        found.confirm()


def test_functions_that_fail_or_give_no_number_are_cases_that_failed():
    def odd(diagram):
        gain = diagram.blocks["p"].gain
        return 1 / 0 if gain > 1.6 else float("nan") if gain < 0.6 else gain

    found = make_pi_loop().worst_case({"p.gain": [0.5, 1.0, 2.0]}, quantity=odd, samples="grid", starts=0)
    assert [case.state for case in found.cases] == [
        CaseState.STABLE,
        CaseState.FAILED,
        CaseState.STABLE,
        CaseState.FAILED,
    ]
    assert "ZeroDivisionError" in found.failures[1].reason
    assert "gives nan; expected one number" in found.failures[0].reason


def test_wrong_questions_are_refused():
    cart = cart_diagram()
    with pytest.raises(OptionError, match=r"contact: a contact's limit has no 'dampng'. Did you mean 'damping'"):
        cart.worst_case(RANGES, contact={**CONTACT, "dampng": 1.0})
    with pytest.raises(OptionError, match="quantity: found contact and quantity='ms'; expected one of them"):
        cart.worst_case(RANGES, contact=CONTACT, quantity="ms")
    with pytest.raises(OptionError, match="loop: found a function as quantity and loop='u'"):
        make_pi_loop().worst_case({"p.gain": (0.5, 2.0)}, "u", quantity=lambda diagram: 1.0)


def test_requirements_that_are_not_looked_for_are_named():
    asked = Requirements(ms=1.6, step={"overshoot": 0.1}, numbers={"poles.continuous.slowest": (-10.0, -0.1)})
    found = make_pi_loop().worst_case({"p.gain": [0.5, 1.0]}, "u", requirements=asked, samples="grid", starts=0)
    named = Requirements(ms=1.6, loops={"inner": {"ms": 2.0}})
    assert "not looked at  loops.inner" in str(
        make_pi_loop().worst_case({"p.gain": [0.5]}, "u", requirements=named, samples="grid", starts=0)
    )
    assert "not looked at  step.overshoot, numbers.poles.continuous.slowest" in str(found)


def test_a_file_asks_for_the_limit_of_a_contact(tmp_path):
    file = tmp_path / "worst.toml"
    text = """[worst_case]
samples = "grid"
starts = 0
[worst_case.ranges]
"share.gain" = [2.0, 5.0]
[worst_case.contact]
port = "cart.push"
position = "cart.position"
velocity = "cart.velocity"
force = "felt"
direction = [1.0]
damping = 2.0
"""
    file.write_text(text, encoding="utf-8")
    found = WorstCaseTask.read(file).find(cart_diagram().wired)
    assert found.worst.value == pytest.approx(spring_limit(5.0), rel=1e-6)
    file.write_text(text.replace("damping", "dampng"), encoding="utf-8")
    with pytest.raises(OptionError, match=r"worst.toml, line 6: worst_case.contact: a contact's limit has no 'dampng'"):
        WorstCaseTask.read(file).find(cart_diagram().wired)


@pytest.mark.slow
def test_start_values_of_an_fmu_in_model_exchange_are_varied():
    """Without its default in the block, an FMU's parameter has that of its description."""
    motor = Fmu(dc_motor.build(), name="motor", interface="model_exchange")
    made = Diagram("loop", motor(voltage=Gain(gain=-3.0, name="kp")(motor.speed).named("u"), load_torque=0.0))
    found = made.worst_case(
        {"motor.inertia": [1e-5, 5e-5], "motor.start.inductance": [2e-3, 4e-3]},
        "u",
        quantity="phase_margin_deg",
        samples="grid",
        starts=1,
        steps=2,
    )
    k, b, R = dc_motor.nominal.motor_constant, dc_motor.nominal.friction, dc_motor.nominal.resistance
    for case in found.cases:
        J = case.parameters.get("motor.start.inertia", dc_motor.nominal.inertia)
        L = case.parameters.get("motor.start.inductance", dc_motor.nominal.inductance)
        expected = control.margin(control.tf([3.0 * k], np.polyadd(np.polymul([L, R], [J, b]), [k * k])))[1]
        assert case.value == pytest.approx(expected, abs=1e-4)


def test_parameters_that_an_fmu_in_model_exchange_sets_are_among_the_sensitivities():
    """One derivative of the phase margin is that of the closed form, by central differences."""
    motor = Fmu(dc_motor.build(), name="motor", interface="model_exchange", start={"inertia": 2e-5})
    made = Diagram("loop", motor(voltage=Gain(gain=-3.0, name="kp")(motor.speed).named("u"), load_torque=0.0))
    k, b, R = dc_motor.nominal.motor_constant, dc_motor.nominal.friction, dc_motor.nominal.resistance
    L = dc_motor.nominal.inductance

    def phase_margin(J):
        return control.margin(control.tf([3.0 * k], np.polyadd(np.polymul([L, R], [J, b]), [k * k])))[1]

    slope = made.sensitivities("u")["motor.inertia", "phase_margin_deg"].slope.value
    assert slope == pytest.approx((phase_margin(2.002e-5) - phase_margin(1.998e-5)) / 4e-8, rel=1e-5)


@pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])
@pytest.mark.drawn(1)
def test_a_trim_frees_a_parameter_of_an_fmu(interface):
    """At rest the motor's torque is friction: k (V − k w)/R = b w."""
    k, R, V, w = dc_motor.nominal.motor_constant, dc_motor.nominal.resistance, 5.0, 70.0
    friction = k * (V - k * w) / (R * w)
    motor = Fmu(dc_motor.build(), name="motor", interface=interface, start={"friction": 0.5 * friction})
    made = Diagram("drive", motor(voltage=V, load_torque=0.0))
    found = made.trim(["motor.friction"], {"motor.speed": w}, rates={"motor.angle": w})
    assert found.parameters["motor.start.friction"] == pytest.approx(friction, rel=1e-9)

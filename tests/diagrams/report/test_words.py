"""What a report says of its numbers: tolerances around FMUs, points that move, loops without margins, definitions."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq, minimize_scalar

from loopwright.blocks import PID, Constant, Encoder, Integrator, Quantizer, UnknownNameError
from loopwright.diagrams import Diagram, analyse, subsystem
from loopwright.diagrams.paper.fig3_report import FIG3
from loopwright.diagrams.report.pages.definitions import definition
from loopwright.fmus import Fmu, FmuError, dc_motor

T, KP, KI = 1e-3, 0.05, 2.0
M = dc_motor.nominal
A = np.array(
    [
        [-M.resistance / M.inductance, -M.motor_constant / M.inductance],
        [M.motor_constant / M.inertia, -M.friction / M.inertia],
    ]
)
B = np.array([1.0 / M.inductance, 0.0])


def pi_loop(speed=100.0):
    motor = Fmu(dc_motor.build(), name="motor")

    @subsystem(sample_time=T)
    def control(reference, measured):
        return PID(kp=KP, ki=KI, name="pi")(reference, measured).named("u")

    return Diagram("pi", motor(voltage=control(Constant(value=speed), motor.speed), load_torque=0.0))


@cache
def moving_report():
    return analyse(pi_loop(), only=("operating_points", "poles", "inner"))


def texts(section):
    yield from section.text
    for part in section.sections:
        yield from texts(part)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1])
def test_tolerances_hold_the_exact_loop_where_an_fmu_was_differenced(delay):
    whole = expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * T)
    Ad, Bd = whole[:2, :2], whole[:2, 2]

    def loop(w):
        z = np.exp(1j * w * T)
        return np.linalg.solve(z * np.eye(2) - Ad, Bd)[1] * (KP + KI * T / (z - 1)) * z**-delay

    numbers = moving_report().numbers()

    def holds(name, exact):
        n = numbers[f"inner.u.sampled_d{delay}.{name}"]
        assert abs(n.value - exact) <= n.tolerance <= 1e-3 * abs(exact)
        assert "FMUs' linear models are right to" in n.confirmed_by

    w = brentq(lambda w: abs(loop(w)) - 1, 50, 90, xtol=1e-13)
    holds("phase_margin_deg", 180 + np.degrees(np.angle(loop(w))))
    holds("gain_crossover_1.frequency", w)
    near = numbers[f"inner.u.sampled_d{delay}.phase_crossover_1.frequency"].value
    w = brentq(lambda w: np.angle(-loop(w)), 0.9 * near, 1.1 * near, xtol=1e-12)
    holds("gain_margin_high", 1 / abs(loop(w)))
    peak = minimize_scalar(
        lambda w: -1 / abs(1 + loop(w)), bounds=(200, 800), method="bounded", options={"xatol": 1e-9}
    )
    holds("ms", -peak.fun)


@pytest.mark.slow
def test_tolerances_stay_where_derivatives_are_exact():
    n = moving_report().numbers()["inner.u.continuous.phase_margin_deg"]
    assert n.tolerance < 1e-9
    assert "FMU" not in n.confirmed_by


@pytest.mark.slow
def test_the_tables_have_the_tolerances_of_the_numbers():
    part = moving_report().sections[2].sections[0]
    cells = {id(cell) for table in part.tables for row in table.rows for cell in row}
    assert id(part.numbers["sampled_d0.phase_margin_deg"]) in cells


@pytest.mark.slow
def test_the_tables_have_them_where_the_numbers_carry_a_finding_as_well():
    motor = Fmu(dc_motor.build(), name="motor")

    @subsystem(sample_time=T)
    def control(reference, measured):
        seen = Quantizer(quantum=1e-3, name="encoder")(measured)
        return PID(kp=KP, ki=KI, name="pi")(reference, seen).named("u")

    made = Diagram("pi", motor(voltage=control(Constant(value=100.0), motor.speed), load_torque=0.0))
    part = analyse(made, only=("inner",)).sections[-1].sections[0]
    number = part.numbers["sampled_d0.phase_margin_deg"]
    assert number.findings
    assert "FMUs' linear models are right to" in number.confirmed_by
    assert id(number) in {id(cell) for table in part.tables for row in table.rows for cell in row}


@pytest.mark.slow
def test_an_fmu_that_moves_is_no_equilibrium():
    assert any("not an equilibrium" in t and "motor.current" in t for t in moving_report().sections[0].text)


@pytest.mark.slow
def test_a_turning_angle_on_which_nothing_depends_is_told_apart():
    motor = Fmu(dc_motor.build(), name="motor")
    diagram = Diagram("turning", motor(voltage=Constant(value=12.0), load_torque=0.0))
    point = diagram.trim(rates={"motor.angle": None}, step=T)
    said = [t for t in analyse(diagram, point=point, only=("operating_points",)).sections[0].text if "not an eq" in t]
    assert said
    assert all("only motor.angle moves, and nothing depends on it" in t for t in said)


def test_an_integrator_outside_the_loop_is_named_and_is_no_instability():
    poles = moving_report().sections[1]
    assert [row[2] for row in poles.tables[0].rows] == ["yes"] * 3
    assert "motor.angle drifts: nothing feeds it back" in poles.text[0]


def test_a_wire_that_is_not_there_is_refused():
    with pytest.raises(UnknownNameError, match=r"no signal 'contrl\.u'.*Did you mean 'control\.u'"):
        analyse(pi_loop(), loops=["contrl.u"], only=("inner",))


def test_a_loop_through_an_encoder_is_there_with_slope_zero():
    motor = Fmu(dc_motor.build(), name="motor")

    @subsystem(sample_time=T)
    def control(reference, angle, speed):
        return PID(kp=5.0)(reference, Encoder(quantum=1e-3)(angle, speed).measured_position).named("u")

    diagram = Diagram("enc", motor(voltage=control(Constant(value=1.0), motor.angle, motor.speed), load_torque=0.0))
    said = " ".join(texts(analyse(diagram, only=("inner",), stairs="zero").sections[0]))
    assert "control.u lies on a loop, but the loop's slope is zero" in said
    assert "control.encoder.measured_position follows 'position' in steps only" in said
    assert "No wire of this diagram" not in said


def test_a_named_wire_off_all_loops_is_said_to_be_off_them():
    diagram = Diagram("open", Integrator(name="x")(Constant(value=1.0).named("r")).named("y"))
    assert "r does not lie on a loop." in list(texts(analyse(diagram, loops=["r"], only=("inner",)).sections[0]))


# --- definitions, and other words -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "term"),
    [
        ("subject.control.pi.kp", "subject"),
        ("subject.control.amplifier.gain", "subject"),
        ("subject.plant.mean", "subject"),
        ("inner.u.continuous.control.phase_margin_deg", "control"),
        ("inner.control.continuous.phase_margin_deg", "phase_margin_deg"),
        ("inner.u.continuous.gain_crossover_1.frequency", "frequency"),
        ("inner.u.continuous.gain_crossover_1.phase_margin_deg", "gain_crossover.phase_margin_deg"),
        ("poles.par.sampled_d0.pole_1_real", "pole"),
        ("poles.par.sampled_d0.gain_a1", "gain_a1"),
        ("admittance.par.ke_limit_friction.sampled_d0.be_10", "ke_limit_friction"),
        ("admittance.par.ke_frequency_friction.sampled_d0.be_10", "ke_frequency"),
    ],
)
def test_names_that_users_choose_are_not_taken_for_terms(path, term):
    found = definition(path, FIG3.definitions)
    assert found is not None
    assert found[0] == term


@pytest.mark.parametrize("path", ["injection.gain.sampled_d0.nothing", "inner.control.continuous.nothing"])
def test_a_wires_name_defines_nothing(path):
    assert definition(path, FIG3.definitions) is None


def test_where_python_control_gives_no_value_it_is_not_called_right():
    numbers = moving_report().numbers()
    theirs = {path: n for path, n in numbers.items() if ".control." in path and np.isnan(n.value)}
    assert theirs
    assert all("right: ours" in n.confirmed_by for n in theirs.values())


def test_variants_stand_in_a_table_with_their_part_of_paths():
    diagram = Diagram("open", Integrator(name="x")(Constant(value=1.0)))
    (section,) = analyse(diagram, only=("subject",)).sections
    assert ("as it is", "continuous", "continuous, order 1") in section.tables[0].rows


@pytest.mark.slow
def test_identification_that_was_asked_for_does_not_say_that_an_fmu_gives_no_derivatives():
    with pytest.raises(FmuError, match=r"identified from its responses only at rest.*still moves") as e:
        pi_loop().linearize(0.01, plants="identified")
    assert "no derivatives" not in str(e.value)

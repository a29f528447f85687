"""The numbers of a report: closed forms, paths that stay, and diagrams other than Fig. 3."""

import math
from functools import cache

import numpy as np
import pytest

from loopwright.blocks import PID, Constant, ErrorDynamics, Gain, Integrator, OptionError, Sine, Step, TransferFunction
from loopwright.diagrams import ConfirmationError, Diagram, analyse, experiments, subsystem
from loopwright.diagrams.paper.fig3_case import Fig3Case
from loopwright.diagrams.report.case import delayed_subsystems
from loopwright.diagrams.report.variant import point_of
from loopwright.diagrams.report.wires_on_loops import wires_on_loops
from loopwright.fmus import Fmu, dc_motor

DESIGN = ("continuous", "sampled_d0", "sampled_d1")
MARGINS = (
    "phase_margin_deg",
    "gain_margin_low",
    "gain_margin_high",
    "delay_margin_s",
    "modulus_margin",
    "disk_margin",
    "ms",
    "mt",
    "bandwidth",
)


@cache
def fig3_part(*keys):
    return analyse(experiments.compliance(), only=keys)


def fig3_loops():
    return fig3_part("operating_points", "inner")


@cache
def fig3_wires():
    """Return them with the loops at the motor forces at one place: those at six take most of the time."""
    first = Fig3Case.places
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Fig3Case, "places", lambda case: first(case)[:1])
        return fig3_part.__wrapped__("operating_points", "inner")


def fig3_poles():
    return fig3_part("poles")


def fig3_admittance():
    return fig3_part("admittance")


def value(path):
    part = {"poles": fig3_poles, "admittance": fig3_admittance}.get(path.partition(".")[0], fig3_wires)
    return part().numbers()[path].value


def speed_control(sample_time=1e-3, voltage=0.0, step_at=100.0):
    motor = Fmu(dc_motor.build(), name="motor")

    @subsystem(sample_time=sample_time)
    def controller(reference, speed):
        return PID(kp=0.05, ki=2.0, initial_output=voltage, name="pi")(reference, speed).named("voltage")

    wanted = Step(times=step_at, values=100.0, name="wanted")
    u = controller(wanted, motor.speed.named("speed"))
    return Diagram("speed_control", motor(voltage=u, load_torque=Constant(value=0.0, name="load")))


@cache
def speed_report():
    return analyse(speed_control())


# --- Fig. 3 ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("side", ["par", "perp"])
@pytest.mark.parametrize("suffix", ["", "_friction"])
def test_continuous_margins_are_those_of_the_closed_form_whatever_the_pole(side, suffix):
    start = f"inner.{side}.continuous{suffix}."
    # L = (3p s² + 3p² s + p³)/s³ with p = 1: |L| = 1 where ω⁶ = 9 ω⁴ + 3 ω² + 1
    w = np.sqrt(max(np.roots([1.0, -9.0, -3.0, -1.0]).real))
    L = (3 * (1j * w) ** 2 + 3j * w + 1) / (1j * w) ** 3
    assert value(start + "phase_margin_deg") == pytest.approx(180.0 + math.degrees(np.angle(L)), abs=1e-9)
    assert value(start + "phase_margin_deg") == pytest.approx(71.2498, abs=5e-5)
    assert value(start + "gain_margin_low") == pytest.approx(1 / 9, abs=1e-9)
    assert value(start + "gain_margin_high") == math.inf
    assert value(start + "mt") == pytest.approx(9 / 7, abs=1e-9)
    assert value(start + "disk_margin") == pytest.approx(1.2, abs=1e-9)


def test_sampled_margins_of_the_design_are_those_of_a_held_double_integrator():
    assert value("inner.par.sampled_d0.phase_margin_deg") == pytest.approx(69.56012827, abs=1e-7)
    assert value("inner.perp.sampled_d0.phase_margin_deg") == pytest.approx(67.88699231, abs=1e-7)
    assert value("inner.par.sampled_d1.phase_margin_deg") == pytest.approx(66.06, abs=5e-3)
    # a sample of delay takes ω T of the phase, and a sample of the delay margin
    for side, p in (("par", 20.0), ("perp", 40.0)):
        d0, d1 = (value(f"inner.{side}.sampled_d{n}.phase_margin_deg") for n in (0, 1))
        w = value(f"inner.{side}.sampled_d0.gain_crossover_1.frequency")
        assert d0 - d1 == pytest.approx(math.degrees(w * 1e-3), abs=1e-8)
        both = [value(f"inner.{side}.sampled_d{n}.delay_margin_samples") for n in (0, 1)]
        assert both[0] - both[1] == pytest.approx(1.0, abs=1e-9)
        assert value(f"inner.{side}.sampled_d0.gain_margin_high") == pytest.approx(2 / (3 * p * 1e-3), rel=1e-9)


def test_compensated_friction_at_rest_changes_the_sampled_margins():
    assert value("inner.par.sampled_d0_friction.phase_margin_deg") == pytest.approx(68.0419, abs=1e-3)
    plain, rough = (value(f"inner.motor_force.sampled_d0{s}.eta_0mm_xi_0mm.disk_margin") for s in ("", "_friction"))
    assert rough < 0.3 * plain


@pytest.mark.parametrize("part", [fig3_wires, pytest.param(fig3_loops, marks=pytest.mark.slow)])
@pytest.mark.parametrize("side", ["par", "perp"])
@pytest.mark.parametrize("variant", DESIGN)
def test_the_paths_that_are_promised_exist(side, variant, part):
    numbers = part().numbers()
    for name in MARGINS:
        assert f"inner.{side}.{variant}.{name}" in numbers
    assert f"operating_points.{variant}.residual" in numbers


@pytest.mark.slow
@pytest.mark.parametrize("side", ["par", "perp"])
@pytest.mark.parametrize("variant", DESIGN)
def test_the_paths_of_poles_and_limits_exist(side, variant):
    numbers = fig3_admittance().numbers()
    for b in ("be_0", "be_10", "be_100"):
        for kind in ("ke_limit", "ke_limit_friction", "force_tracking.ke_limit"):
            assert f"admittance.{side}.{kind}.{variant}.{b}" in numbers
    assert f"poles.{side}.{variant}.polynomial_difference" in fig3_poles().numbers()


PARTS = [
    fig3_wires,
    *(pytest.param(part, marks=pytest.mark.slow) for part in (fig3_loops, fig3_poles, fig3_admittance)),
]


@pytest.mark.slow
@pytest.mark.parametrize("report", [*PARTS, speed_report])
def test_every_number_is_complete(report):
    for path, number in report().numbers().items():
        assert number.unit, path
        assert number.confirmed_by, path
        assert not number.tolerance < 0, path
        if not path.count(".control."):  # python-control's may be missing
            assert not math.isnan(number.value), path
            assert math.isfinite(number.tolerance), path
        assert set(number.as_dict()) == {"value", "unit", "tolerance", "confirmed_by"}


@pytest.mark.parametrize("report", PARTS)
def test_each_table_shows_the_numbers_of_its_section(report):
    def walk(section):
        yield section
        for inner in section.sections:
            yield from walk(inner)

    known = {id(n) for n in report().numbers().values()}
    for section in (s for top in report().sections for s in walk(top)):
        assert not section.numbers or section.tables, section.key
        assert {id(n) for n in section.numbers.values()} <= known


@pytest.mark.slow
def test_poles_got_are_those_asked_in_continuous_time_and_others_sampled():
    for side, p in (("par", 20.0), ("perp", 40.0)):
        assert value(f"poles.{side}.continuous.polynomial_difference") < 1e-12
        assert value(f"poles.{side}.continuous.mean") == pytest.approx(-p, rel=1e-9)
        assert value(f"poles.{side}.sampled_d0.polynomial_difference") < 1e-12
        assert value(f"poles.{side}.sampled_d1.polynomial_difference") < 1e-12
        assert value(f"poles.{side}.sampled_d0.pole_3_real") < -1.3 * p
        gains = [value(f"poles.{side}.sampled_d0.gain_{a}") for a in ("a2", "a1", "a0")]
        # (z − 1)³ + … with these gains is (z − exp(−p T))³
        T = 1e-3
        a2, a1, a0 = gains
        got = np.array([1.0, -3.0, 3.0, -1.0])
        got[1:] += [a1 * T**2 / 2 + a2 * T, -2 * a2 * T + a0 * T**3 / 2, a2 * T - a1 * T**2 / 2 + a0 * T**3 / 2]
        np.testing.assert_allclose(got, np.poly([math.exp(-p * T)] * 3), atol=1e-11)


@pytest.mark.slow
def test_decoupling_and_independence_of_the_point_hold_and_break_as_claimed():
    claims = "poles.claims."
    for key in ("continuous", "sampled_d0", "continuous_friction"):
        assert value(f"{claims}{key}.coupling") < 1e-9
        assert value(f"{claims}{key}.polynomial_spread") < 1e-9
    assert value(claims + "mass_10.coupling") < 1e-9  # the same error in both axes couples nothing
    assert value(claims + "mass_10.from_matched") > 0.05
    assert value(claims + "mass_unequal.coupling") > 0.01
    assert value(claims + "friction_10.from_matched") > 0.05


@pytest.mark.slow
def test_stiffness_limits_lie_by_the_rule_of_thumb_and_friction_at_rest_lowers_them():
    start = "admittance.perp."
    for b in (0, 10):
        limit, rule = (value(f"{start}{kind}.sampled_d0.be_{b}") for kind in ("ke_limit", "rule_of_thumb"))
        assert rule == pytest.approx((12.0 + b) / 0.5e-3)
        assert limit == pytest.approx(rule, rel=0.1)
        assert value(f"{start}ke_limit_friction.sampled_d0.be_{b}") < 0.6 * limit
        assert value(f"{start}ke_limit.sampled_d1.be_{b}") < limit
        assert value(f"{start}ke_limit.continuous.be_{b}") == math.inf
    assert value("admittance.perp.ke_limit.sampled_d0.be_10") == pytest.approx(46785.893, rel=1e-6)


@pytest.mark.slow
def test_the_limits_grow_in_the_co_simulation_as_predicted():
    report = analyse(experiments.compliance(), only=("time_domain",))
    numbers = report.numbers()
    assert len(numbers) == 10
    assert [s.key for s in report.sections] == ["time_domain"]
    for path, number in numbers.items():
        assert (number.value < 0) is (".below." in path)


@pytest.mark.slow
def test_a_delay_of_the_experiments_own_is_taken_out():
    keys = ("inner.perp.sampled_d0.phase_margin_deg", "inner.perp.sampled_d1.phase_margin_deg")
    delayed = analyse(experiments.compliance(delay=1), only=("inner",)).numbers()
    for key in keys:
        assert delayed[key].value == pytest.approx(value(key), abs=1e-9)


SLOW = [pytest.param(e, marks=pytest.mark.slow) for e in (experiments.path_following, experiments.force_tracking)]


@pytest.mark.slow
@pytest.mark.parametrize("start", [experiments.hand_guiding, *SLOW])
def test_other_experiments_have_the_same_inner_loops(start):
    numbers = analyse(start(), only=("inner",)).numbers()
    for side in ("par", "perp"):
        key = f"inner.{side}.sampled_d0.phase_margin_deg"
        if start is not experiments.force_tracking:  # there the held spring is in the loop
            assert numbers[key].value == pytest.approx(value(key), abs=1e-7)
        assert numbers[f"inner.{side}.continuous.stable"].value == 1.0


# --- other diagrams --------------------------------------------------------------------------------------------------


def test_a_users_loop_around_an_fmu_gets_a_report_without_the_sections_of_fig3():
    report = speed_report()
    keys = ["summary", "subject", "operating_points", "poles", "inner", "steps", "sensitivity", "injection", "limits"]
    assert [s.key for s in report.sections] == keys
    numbers = report.numbers()
    # u = (kp + ki/s) e, ω = K/((L s + R)(J s + b) + K²) u
    w = numbers["inner.voltage.continuous.gain_crossover_1.frequency"].value
    s = 1j * w
    motor = dc_motor.nominal
    electric, mechanic = motor.inductance * s + motor.resistance, motor.inertia * s + motor.friction
    L = (0.05 + 2.0 / s) * motor.motor_constant / (electric * mechanic + motor.motor_constant**2)
    assert abs(L) == pytest.approx(1.0, rel=1e-9)
    margin = numbers["inner.voltage.continuous.phase_margin_deg"].value
    assert margin == pytest.approx(180.0 + math.degrees(np.angle(L)), abs=1e-7)
    assert numbers["injection.voltage.sampled_d0.deviation"].value < 1e-3
    assert numbers["injection.voltage.sampled_d1.deviation"].value < 1e-3


@pytest.mark.slow
def test_a_source_that_steps_later_does_not_move_the_injection():
    numbers = analyse(speed_control(step_at=0.1), loops=["controller.voltage"], only=("injection",)).numbers()
    for quantity in ("deviation", "uncertainty"):
        assert numbers[f"injection.controller_voltage.sampled_d0.{quantity}"].value < 1e-3


@pytest.mark.slow
def test_a_source_that_steps_during_the_injection_after_a_run_leaves_no_number():
    report = analyse(speed_control(step_at=0.1), loops=["controller.voltage"], only=("injection",), at=0.05)
    assert not report.numbers()
    (section,) = report.sections
    assert all("the operating point moved by" in text for text in section.text)


@pytest.mark.slow
def test_loops_can_be_named():
    numbers = analyse(speed_control(), loops=["controller.voltage"], only=("inner",)).numbers()
    assert "inner.controller_voltage.sampled_d0.phase_margin_deg" in numbers
    assert not any(path.startswith("inner.speed") for path in numbers)


def test_a_diagram_without_a_loop_gets_a_report():
    report = analyse(Diagram("open", Gain(gain=2.0)(Sine(frequency=1.0)).named("wave")))
    assert {s.key for s in report.sections} == {"summary", "subject", "operating_points", "limits"}
    assert not [path for path in report.numbers() if path.startswith("inner.")]


def test_only_the_boxes_that_act_on_what_is_continuous_are_delayed():
    assert delayed_subsystems(experiments.compliance().diagram.wired) == ["controller"]
    assert delayed_subsystems(speed_control().wired) == ["controller"]


def test_wires_off_all_loops_are_left_out():
    assert wires_on_loops(speed_control().wired) == {"speed": "speed", "voltage": "controller.voltage"}


def test_an_unknown_section_is_refused():
    with pytest.raises(OptionError, match=r"no section 'margins'; expected some of subject"):
        analyse(speed_control(), only=("margins",))


def test_a_given_point_is_taken_over_by_variants_by_the_names_of_their_states():
    @subsystem(sample_time=0.01)
    def controller(reference, y):
        return PID(kp=0.5, ki=2.0, name="pi")(reference, y).named("u")

    plant = TransferFunction(numerator=[2.0], denominator=[1.0, 1.0], name="plant")
    diagram = Diagram("lag", plant(controller(Constant(value=0.0, name="wanted"), plant.y.named("y"))))
    trimmed = diagram.trim(free=["wanted.value"], targets={"y": 3.0})
    for variant in (diagram.replace({"controller.delay": 2}), diagram.continuous()):
        found = point_of(variant.wired, trimmed, diagram.wired)
        assert found.values["plant.y"] == pytest.approx(3.0, rel=1e-9)
        assert found.values["controller.pi.u"] == pytest.approx(1.5, rel=1e-6)
        assert found.how == "trim"
        assert variant.linearize(found).is_equilibrium


def test_a_section_on_poles_needs_error_dynamics_only_for_what_was_asked():
    assert not any(isinstance(b, ErrorDynamics) for b in speed_control().blocks.values())
    assert "poles.sampled_d0.slowest" in speed_report().numbers()


def held_integrator(gain, sample_time=0.1):
    plant = Integrator(name="plant")

    @subsystem(sample_time=sample_time)
    def controller(y):
        return (-gain * y).named("u")

    return Diagram("held_integrator", plant(controller(plant.y)))


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("gain", [1.0, 10.0])
def test_an_integrator_under_a_sampled_gain_has_its_margins(gain):
    # L = g T/(z − 1): stable up to g T = 2; g T = 1 is deadbeat, and bears exactly one sample of delay
    found = analyse(held_integrator(gain), only=("inner",)).numbers()
    assert found["inner.u.sampled_d0.gain_margin_high"].value == pytest.approx(20.0 / gain, rel=1e-9)
    if gain == 10.0:
        assert found["inner.u.sampled_d0.delay_margin_samples"].value == pytest.approx(1.0, abs=1e-9)


def test_values_of_python_control_that_fail_leave_the_margins_in_a_report(monkeypatch):
    def fails(*args):
        raise ConfirmationError("found something else", block="gain_margin_low")

    monkeypatch.setattr("loopwright.diagrams.report.sections.loops.compare_margins", fails)
    report = analyse(held_integrator(1.0), only=("inner",))
    assert report.numbers()["inner.u.sampled_d0.gain_margin_high"].value == pytest.approx(20.0, rel=1e-9)
    (part,) = next(s for s in report.sections if s.key == "inner").sections
    assert any("python-control's values can't be judged" in note for note in part.text)

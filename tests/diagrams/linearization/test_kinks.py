"""Kinks, stairs and slopes of zero: found at the point, and carried to the numbers that depend on them."""

import json
import math
from dataclasses import replace

import control
import numpy as np
import pytest

from loopwright.blocks import (
    Backlash,
    Compare,
    Constant,
    DeadZone,
    Encoder,
    Function,
    Gain,
    Integrator,
    Lookup1D,
    OptionError,
    ParameterError,
    PythonFunction,
    Quantizer,
    RateLimiter,
    Relay,
    Saturation,
    Sum,
    Switch,
    UnitDelay,
)
from loopwright.blocks.core import Finding
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.frequency import Number, with_findings
from loopwright.diagrams.requirements import Limit, Reason, Verdict, judge
from loopwright.frequency import disk_margin, gang_of_four, margins, nyquist_count
from loopwright.types import Kink, MeanSlope, StepsOnly, ZeroSlope
from support.reviewed import judge_again

T = 0.01


def around(block, u=0.0):
    """A block between an integrator and a constant error u: the loop at the wire "v" goes through it."""
    x = Integrator(name="x", initial_value=-u)
    return Diagram("d", x(block(Gain(gain=-1.0, name="minus")(x.y)).named("v")))


def sampled(block, u=0.0):
    x = Integrator(name="x", initial_value=-u)

    @subsystem(sample_time=T)
    def box(x):
        return block(Gain(gain=-1.0, name="minus")(x))

    return Diagram("d", x(box(x.y).named("v")))


def on(f):
    return Function(f, name="block")


KINKS = {
    "saturation at its upper limit": (Saturation(limit=0.5, name="block"), 0.5, 1.0, 0.0),
    "saturation at its lower limit": (Saturation(lower=0.0, upper=3.0, name="block"), 0.0, 0.0, 1.0),
    "dead zone at its edge": (DeadZone(limit=0.25, name="block"), 0.25, 0.0, 1.0),
    "abs": (on(lambda u: 3.0 * np.abs(u)), 0.0, -3.0, 3.0),
    "where": (on(lambda u: np.where(u > 0.2, 5.0 * (u - 0.2), u - 0.2)), 0.2, 1.0, 5.0),
    "maximum": (on(lambda u: np.maximum(u, 2.0 * u)), 0.0, 1.0, 2.0),
    "of any Python": (PythonFunction(lambda u: abs(u), name="block"), 0.0, -1.0, 1.0),
    "table": (Lookup1D(breakpoints=[-1.0, 0.5, 2.0], values=[0.0, 3.0, 1.5], name="block"), 0.5, 2.0, -1.0),
    "a kink beside the point": (on(lambda u: np.where(u > 1e-7, 4.0 * (u - 1e-7), 0.5 * (u - 1e-7))), 0.0, 0.5, 4.0),
}


@pytest.mark.drawn(5)
@pytest.mark.parametrize("case", KINKS)
def test_the_slopes_to_both_sides_are_found_where_they_differ(case):
    block, u, below, above = KINKS[case]
    lin = around(block, u).linearize()
    (kink,) = [f for f in lin.findings if f.port == "y"]
    assert isinstance(kink, Kink)
    assert (kink.block, kink.source, kink.jump) == ("block", "u", 0.0)
    assert (kink.below, kink.above) == pytest.approx((below, above), rel=1e-6)  # by hand
    assert lin.loop("v").findings == (kink,)
    assert lin.findings_on_loops == (kink,)
    (slope,) = np.ravel(0.0 - lin.A)  # ẋ = block(−x)
    assert kink.slope == slope
    assert f"the model has {slope:.6g}" in str(kink)


def test_the_model_of_an_absolute_value_has_the_mean_of_both_slopes_at_zero():
    lin = around(on(lambda u: 2.0 * u + 3.0 * np.abs(u))).linearize()
    (kink,) = lin.findings
    assert (kink.below, kink.above, kink.slope) == pytest.approx((-1.0, 5.0, 2.0), rel=1e-12)
    assert str(kink).endswith("slope -1 below the point and 5 above; the model has 2")


SMOOTH = {
    "in the middle of a saturation": (Saturation(limit=9.0, name="block"), 0.0),
    "a steep place": (on(lambda u: np.tanh(u / 1e-6) + np.maximum(u, -5.0)), 0.0),
    "a kink of the second derivative": (on(lambda u: u + np.where(u > 0.0, u * u, 0.0)), 0.0),
    "a kink of the curvature like a contact's": (on(lambda u: u + np.maximum(u, 0.0) ** 1.5), 0.0),
    "an extremum": (on(lambda u: np.where(u < 50.0, u * u, 0.0)), 0.0),
    "a tiny kink": (on(lambda u: u + 1e-5 * np.abs(u)), 0.0),
    "a table between its points": (Lookup1D(breakpoints=[-1.0, 3.0], values=[0.0, 3.0], name="block"), 0.5),
}


@pytest.mark.parametrize("case", SMOOTH)
def test_nothing_is_found_where_the_slope_is_right(case):
    block, u = SMOOTH[case]
    assert around(block, u).linearize().findings == ()


ZEROS = {
    "dead zone": (DeadZone(limit=0.5, name="block"), 0.0, 1.0),
    "saturation beyond its limit": (Saturation(limit=1.0, name="block"), 1.5, 2.0),
    "cube": (on(lambda u: u**3), 0.0, 2.0),
    "drag": (on(lambda u: u * np.abs(u)), 0.0, 2.0),
    "where": (on(lambda u: np.where(u > 0.7, 3.0, np.where(u < -0.7, -1.0, 0.0))), 0.0, 4.0),
}


@pytest.mark.parametrize("case", ZEROS)
def test_a_slope_of_zero_is_found_where_the_value_changes_over_the_nominal_range(case):
    block, u, change = ZEROS[case]
    if case == "where":  # every slope of it is zero
        assert around(block, u).linearize().findings == (StepsOnly("block", "y", "u"),)
        return
    found = [f for f in around(block, u).linearize().findings if f.port == "y"]
    assert found == [ZeroSlope("block", "y", "u", 1.0 + abs(u), pytest.approx(change, rel=1e-12))]  # f(u + span) − f(…)


def test_the_nominal_value_of_a_port_is_the_range_that_is_looked_at():
    from loopwright.blocks import Block, Input, Output

    class Hole(Block):
        """Zero within ±0.5."""

        u = Input(nominal=0.2)
        y = Output()

        def output(self, t, x, u):
            return np.where(np.abs(u.u) < 0.5, 0.0, u.u)

    assert around(Hole(name="block")).linearize().findings == ()
    wide = type("Wide", (Hole,), {"u": Input(nominal=2.0)})
    assert around(wide(name="block")).linearize().findings == (ZeroSlope("block", "y", "u", 2.0, 4.0),)


STEPS = {
    "relay in continuous time": around(Relay(on_point=0.3, off_point=-0.3, off_value=-1.0, name="block")),
    "quantizer in continuous time": around(Quantizer(quantum=0.1, name="block"), 0.32),
    "sign": around(on(np.sign)),
    "quantizer": sampled(Quantizer(quantum=0.1, name="block"), 0.32),
}


@pytest.mark.parametrize("case", STEPS)
def test_steps_and_events_are_told(case):
    lin = STEPS[case].linearize(stairs="zero")
    path = "block" if "." not in lin.findings[0].block else "box.block"
    assert lin.findings == (StepsOnly(path, "y", "u"),)
    assert lin.loop("v").findings == lin.findings


def test_a_switch_that_nothing_reaches_over_the_nominal_range_is_not_told():
    for far, number in ((0.9, 1), (1.1, 0)):  # the nominal range of u = 0 is ±1
        relay = Relay(on_point=far, off_point=-far, on_value=1.0, name="block")
        guard = on(lambda u, far=far: np.where(np.abs(u) > far, 1.0, 0.0))
        for diagram in (around(relay), sampled(relay), around(guard)):
            assert len(diagram.linearize().findings) == number


def test_a_relay_at_its_point_jumps():
    (found,) = (
        sampled(Relay(on_point=0.0, off_point=0.0, on_value=2.0, off_value=-1.0, name="block")).linearize().findings
    )
    assert isinstance(found, Kink)
    assert found.jump == pytest.approx(3.0, rel=1e-12)
    assert "jumps by 3" in str(found)


def test_backlash_at_rest_has_no_slope_and_a_rate_limiter_at_its_rate_two():
    (found,) = sampled(Backlash(width=0.2, name="block")).linearize().findings
    assert found == ZeroSlope("box.block", "y", "u", 1.0, pytest.approx(1.8, rel=1e-12))  # ±(1 − b/2)
    v, x = Integrator(name="v"), Integrator(name="x")
    play = Backlash(width=0.2, with_rate=True, name="play")(Gain(gain=-1.0)(x.y), Gain(gain=-1.0)(v.y))
    found = Diagram("d", x(v.y), v(play)).linearize().findings
    assert ZeroSlope("play", "y", "u", 1.0, pytest.approx(1.8, rel=1e-12)) in found

    x = Integrator(name="x", initial_value=-0.5)

    @subsystem(sample_time=T)
    def box(x):
        return RateLimiter(rising=50.0, initial_value=0.0, name="block")(Gain(gain=-1.0)(x))

    lin = Diagram("d", x(box(x.y).named("v"))).linearize()
    kinks = {f.source: (f.below, f.above) for f in lin.findings if isinstance(f, Kink)}
    assert kinks["u"] == pytest.approx((1.0, 0.0), abs=1e-9)
    assert lin.loop("v").findings == lin.findings


# --- who carries them -------------------------------------------------------------------------------------------------


def two_loops():
    """Two loops side by side, the second one with a kink; both feed a third signal."""
    a, b = Integrator(name="a"), Integrator(name="b")
    clean = a(Gain(gain=-2.0, name="ga")(a.y).named("u"))
    bent = b(on(lambda e: np.where(e > 0, 3.0 * e, e))(Gain(gain=-1.0, name="gb")(b.y)).named("v"))
    return Diagram("two", clean, bent, Sum(signs="++", name="both")(a.y, b.y).named("w"))


def test_only_numbers_that_depend_on_a_finding_carry_it():
    lin = two_loops().linearize(inputs=["u"], outputs=["w"])
    (kink,) = lin.findings
    assert lin.loop("u").findings == ()
    assert lin.loop("v").findings == (kink,)
    assert lin.sensitivity("v").findings == lin.complementary("v").findings == (kink,)
    assert lin.system.findings == lin.carried == ()
    assert two_loops().linearize(inputs=["v"], outputs=["w"]).carried == (kink,)
    clean, bent = margins(lin.loop("u")), margins(lin.loop("v"))
    assert not clean.findings
    assert "†" not in str(clean)
    assert bent.findings == (kink,)
    assert all(number.findings == (kink,) for number in bent.numbers().values())
    assert all(c.frequency.findings == (kink,) for c in bent.gain_crossovers)
    assert str(bent.phase_margin_deg).endswith(" deg †")
    assert str(bent).splitlines()[-1] == f"† {kink}"
    assert clean.phase_margin_deg.as_dict().keys() == {"value", "unit", "tolerance", "confirmed_by"}
    (fact,) = bent.as_dict()["phase_margin_deg"]["findings"]
    assert fact == {
        "kind": "Kink",
        "block": "block",
        "port": "y",
        "source": "e",
        "below": kink.below,
        "above": kink.above,
        "jump": 0.0,
        "slope": kink.slope,
        "text": str(kink),
    }
    assert json.dumps(fact)


def test_everything_made_from_a_loop_carries_its_findings():
    L = two_loops().linearize().loop("v")
    (kink,) = L.findings
    assert disk_margin(L).alpha.findings == disk_margin(L).findings == (kink,)
    assert nyquist_count(L).findings == (kink,)
    assert gang_of_four(L, control.ss([], [], [], 1.0)).S.findings == (kink,)
    assert with_findings((margins(L).ms, {"a": 1.0}), (kink,))[0].findings == (kink,)
    plain = control.ss(L.A, L.B, L.C, L.D)
    assert margins(plain).findings == ()
    assert margins(plain).ms.value == margins(L).ms.value


def test_a_switched_path_is_told_only_on_the_loop_through_the_switch():
    x, y = Integrator(name="x", initial_value=1.0), Integrator(name="y")
    level = Compare(">", name="above")(x.y, Constant(value=0.5, name="half"))
    chosen = Switch(name="switch")(level, Gain(gain=-1.0, name="slow")(x.y), Gain(gain=-2.0, name="fast")(x.y))
    lin = Diagram("d", x(chosen.named("v")), y(Gain(gain=-1.0, name="own")(y.y).named("w"))).linearize()
    assert {f.block for f in lin.loop("v").findings} >= {"above"}
    assert lin.loop("w").findings == ()


@pytest.mark.slow
def test_a_report_marks_the_numbers_and_its_json_has_the_facts(tmp_path):
    report = servo().report(
        tmp_path / "servo.html", json=True, point=2 * T, only=("poles", "inner", "limits"), stairs="zero"
    )
    numbers = report.numbers()
    margin = numbers["inner.u.sampled_d0.phase_margin_deg"]
    steps = StepsOnly("controller.encoder", "measured_position", "position")
    assert steps in margin.findings
    assert steps in numbers["inner.u.sampled_d0.stable"].findings
    assert steps in numbers["poles.sampled_d0.slowest"].findings
    html = (tmp_path / "servo.html").read_text("utf-8")
    assert f"†</sup> Limit of the linear model: {steps}.".replace("'", "&#39;") in html
    leaf = json.loads((tmp_path / "servo.json").read_text("utf-8"))["inner"]["u"]["sampled_d0"]["phase_margin_deg"]
    assert leaf["findings"][0]["kind"] == "StepsOnly"
    answered = servo().report(point=2 * T, only=("inner",)).numbers()
    assert answered["inner.u.sampled_d0.phase_margin_deg"].value == pytest.approx(by_hand(), abs=1e-6)


# --- stairs as their mean slope ----------------------------------------------------------------------------------------

KP, KD = 25.0, 8.0


def servo(start=0.3):
    """A double integrator under −kp q(x) − kd v, with an encoder of 1 µm for x."""
    v, x = Integrator(name="v"), Integrator(name="x", initial_value=start)

    @subsystem(sample_time=T)
    def controller(x, v):
        measured, _ = Encoder(quantum=1e-6, name="encoder")(x, v)
        return Sum(signs="--", name="sum")(Gain(gain=KP, name="kp")(measured), Gain(gain=KD, name="kd")(v))

    return Diagram("servo", x(v.y), v(controller(x.y, v.y).named("u")))


def by_hand():
    """Return the phase margin of (kd s + kp)/s² with a hold, by python-control."""
    plant = control.sample_system(control.ss([[0, 1], [0, 0]], [[0], [1]], [[KP, KD]], 0), T, method="zoh")
    return control.margin(plant)[1]


def test_the_margin_of_an_encoder_as_a_gain_is_that_of_the_loop_without_it():
    lin = servo().linearize(2 * T, stairs="gain")
    found = margins(lin.loop("u"))
    assert found.phase_margin_deg.value == pytest.approx(by_hand(), abs=1e-6)
    assert MeanSlope("controller.encoder", "measured_position", "position", 1.0) in found.findings
    A = [[1.0 - KP * T * T / 2, T - KD * T * T / 2], [-KP * T, 1.0 - KD * T]]
    assert np.sort_complex(lin.poles)[-2:] == pytest.approx(np.sort_complex(np.linalg.eigvals(A)), rel=1e-12)
    without = margins(servo().linearize(2 * T, stairs="zero").loop("u"))
    assert without.phase_margin_deg.value == pytest.approx(87.7076, abs=1e-4)  # of the velocity alone


def test_the_mean_slope_of_velocities_by_differences_is_that_of_the_differences():
    def loop(measured):
        v, x = Integrator(name="v"), Integrator(name="x", initial_value=0.3)

        @subsystem(sample_time=T)
        def box(x, v):
            if measured:
                x, v = Encoder(quantum=1e-6, name="encoder")(x, v)
            else:
                v = Gain(gain=1.0 / T)(Sum(signs="+-")(x, UnitDelay(name="last")(x)))
            return Sum(signs="--")(Gain(gain=KP)(x), Gain(gain=KD)(v))

        return Diagram("d", x(v.y), v(box(x.y, v.y).named("u")))

    ours, exact = loop(True).linearize(2 * T, stairs="gain").loop("u"), loop(False).linearize(2 * T).loop("u")
    for w in (1.0, 10.0, 100.0):
        z = np.exp(1j * w * T)
        assert ours(z) == pytest.approx(exact(z), rel=1e-12)


def test_a_quantizer_in_continuous_time_is_a_gain_wherever_the_loop_is_cut():
    x = Integrator(name="x", initial_value=0.32)
    held = Quantizer(quantum=0.1, name="quantizer")(x.y).named("q")
    diagram = Diagram("d", x(Gain(gain=-2.0, name="back")(held).named("u")))
    assert diagram.linearize(stairs="zero").A.tolist() == [[0.0]]
    lin = diagram.linearize()
    assert pytest.approx(np.array([[-2.0]]), rel=1e-14) == lin.A
    assert lin.findings == (MeanSlope("quantizer", "y", "u", pytest.approx(1.0, rel=1e-14)),)
    for wire in ("q", "u"):
        assert lin.loop(wire)(3.0j) == pytest.approx(2.0 / 3.0j, rel=1e-14)
    assert lin.loop("q").findings == lin.findings


def test_the_mean_slope_is_that_of_differences_over_many_steps():
    def stairs(u):
        return 0.3 * np.floor(4.0 * u + 0.2) - np.ceil(u)

    assert around(on(stairs)).linearize().findings == (StepsOnly("block", "y", "u"),)  # a gear has no slope by itself
    (found,) = around(on(stairs)).linearize(stairs="gain").findings
    assert found.asked
    far = 1e6
    assert found.slope == pytest.approx((stairs(far) - stairs(-far)) / (2 * far), rel=1e-5)


def test_a_relay_has_no_mean_slope_and_wrapping_is_not_stairs():
    relay = sampled(Relay(on_point=0.5, off_point=-0.5, name="block"))
    assert relay.linearize(stairs="gain").findings == relay.linearize().findings
    wrapped = on(lambda u: u - 2.0 * np.floor(u / 2.0 + 0.5))
    for given in (None, "gain"):
        lin = around(wrapped, 0.3).linearize(stairs=given)
        assert lin.A.tolist() == [[-1.0]]
        assert lin.findings == ()


def test_encoders_and_quantizers_have_their_mean_slope_without_being_asked():
    lin = servo().linearize(2 * T)
    assert margins(lin.loop("u")).phase_margin_deg.value == pytest.approx(by_hand(), abs=1e-6)
    assert lin.notes == servo().linearize(2 * T, stairs="gain").notes
    assert sampled(Quantizer(quantum=0.1, name="block"), 0.32).linearize().findings == (
        MeanSlope("box.block", "y", "u", pytest.approx(1.0, rel=1e-14)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("stairs", [None, pytest.param("gain", marks=pytest.mark.slow)])
def test_a_mean_slope_of_a_converter_meets_requirements_and_one_that_was_asked_for_does_not(stairs):
    reports = {s: servo(0.0).report(only=("inner", "poles"), stairs=s) for s in (stairs, "zero")}

    def verdict(stairs, **limits):
        found = judge_again(servo(0.0), reports[stairs], **limits)
        return {r.quantity: (r.verdict, r.reason) for r in found.results}

    margin = float(by_hand())
    found = verdict(stairs, phase_margin_deg=margin - 1.0)
    assert found == dict.fromkeys(("stable", "phase_margin_deg"), (Verdict.PASSED, Reason.COMPARED))
    found = verdict(stairs, phase_margin_deg=margin + 1.0)
    assert found["phase_margin_deg"] == (Verdict.FAILED, Reason.COMPARED)
    found = verdict("zero", phase_margin_deg=margin - 1.0)
    assert found["phase_margin_deg"] == (Verdict.UNDECIDED, Reason.FINDINGS)
    gear = Number(50.0, "deg", 1e-9, "eigenvalues", findings=(MeanSlope("gear", "y", "u", 1.0, asked=True),))
    encoder = replace(gear, findings=(MeanSlope("encoder", "measured_position", "position", 1.0),))
    kink = replace(gear, findings=(*encoder.findings, Kink("limit", "y", "u", 0.0, 1.0)))
    found = [judge(number, Limit(45.0, math.inf))[0] for number in (gear, encoder, kink)]
    assert found == [Verdict.UNDECIDED, Verdict.PASSED, Verdict.UNDECIDED]


FLAT = {
    "relay": (Relay(on_point=0.5, off_point=-0.5, name="block"), "frequency_response(wire, …, amplitude=…)"),
    "dead zone": (DeadZone(limit=0.5, name="block"), "linearize(point)"),
    "sign": (on(np.sign), "frequency_response(wire, …, amplitude=…)"),
    "abs": (on(np.abs), "linearize(point)"),
    "gear": (on(lambda u: np.floor(u / 10.0)), 'linearize(…, stairs="gain")'),
    "quantizer": (Quantizer(quantum=0.1, name="block"), 'linearize(…, stairs="gain")'),
}


@pytest.mark.drawn(3)
@pytest.mark.parametrize("case", FLAT)
def test_a_loop_without_a_slope_names_the_block_and_the_argument(case):
    block, argument = FLAT[case]
    loop = sampled(block).linearize(stairs="zero").loop("v")
    with pytest.raises(ParameterError, match=r"the constant 0: .*; box\.block\.y .*; expected dynamics") as error:
        margins(loop)
    assert argument in str(error.value)
    assert "Look at the wire" not in str(error.value)


def test_an_unknown_treatment_of_stairs_is_refused():
    with pytest.raises(
        OptionError, match="found stairs='round'; expected \"gain\", which takes all stairs as their mean"
    ):
        servo().linearize(stairs="round")


def test_findings_have_their_facts_as_fields():
    assert isinstance(StepsOnly("a", "y", "u"), Finding)
    assert ZeroSlope("a", "y", "u", 1.0, 2.0).as_dict()["change"] == 2.0

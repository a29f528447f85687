"""Verdicts of diagrams with free motions: what only drifts passes and is named, what looks like it does not pass."""

import json
import math

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Constant,
    Gain,
    Integrator,
    Saturation,
    StateSpace,
    TransferFunction,
)
from loopwright.diagrams import Diagram, Requirements, analyse, subsystem
from loopwright.diagrams.cli.command_line import main
from loopwright.diagrams.cli.report import verdict_text
from loopwright.diagrams.report.pages.json import to_json
from loopwright.diagrams.requirements import Reason
from loopwright.types import Verdict
from support.hidden_states import Hidden

pytestmark = pytest.mark.usefixtures("without_drawings")

DRIFTS = "angle.y drifts: nothing feeds it back"


def drive(*more, name="", sample_time=None):
    """A motor 1/(s + 1) under PI control of its speed: poles at (−3 ± √−11)/2. Its angle runs on."""
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name=f"{name}motor")
    angle = Integrator(name=f"{name}angle")
    pi = PID(kp=2.0, ki=5.0, name=f"{name}pi")

    def controller(speed):
        return pi(Constant(value=0.0, name=f"{name}r"), speed).named(f"{name}voltage")

    voltage = (controller if sample_time is None else subsystem(sample_time=sample_time)(controller))(motor.y)
    return [angle(motor(voltage)), *(block(angle.y) for block in more)]


def judge(outputs, at=None, **asked):
    return analyse(Diagram("d", *outputs), at=at, requirements=Requirements(**asked), only=("poles",))


def stable_of(report):
    (found,) = (result for result in report.review.results if result.quantity == "stable")
    return found


@pytest.mark.drawn(1)
@pytest.mark.parametrize("sample_time", [None, 0.01], ids=["continuous", "sampled"])
def test_a_drive_passes_and_its_angle_is_named_wherever_the_verdict_is(sample_time):
    report = analyse(
        Diagram("d", *drive(sample_time=sample_time)),
        requirements=Requirements(phase_margin_deg=45),
        only=("poles", "inner"),
    )
    assert report.review.verdict is Verdict.PASSED
    found = stable_of(report)
    assert (found.verdict, found.reason) == (Verdict.PASSED, Reason.COMPARED)
    if sample_time is None:
        assert found.number.value == pytest.approx(-1.5, abs=1e-9)
    assert [str(motion) for motion in report.review.free] == [DRIFTS]
    assert verdict_text(report.review).splitlines() == ["Requirements: passed.", f"  {DRIFTS}"]
    assert json.loads(to_json(report))["requirements"]["free"] == [DRIFTS]
    first, second, *_ = report.sections[0].text
    assert str(first).startswith("Verdict: passed.")
    assert second.startswith(f"{DRIFTS}. A forgotten wire looks the same")


def test_the_strict_rule_counts_every_state():
    found = stable_of(judge(drive(), stable="every state"))
    assert (found.verdict, found.reason) == (Verdict.UNDECIDED, Reason.ON_THE_LIMIT)
    assert found.number.value == pytest.approx(0.0, abs=1e-12)


def test_the_command_and_a_file_know_both_rules(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("loopwright.diagrams.report.analyse", lambda *of, **how: analyse(*of, only=("poles",), **how))
    (tmp_path / "mine.py").write_text(
        "from loopwright.blocks import PID, Constant, Integrator, TransferFunction\n"
        "from loopwright.diagrams import Diagram\n"
        "motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name='motor')\n"
        "u = PID(kp=2.0, ki=5.0, name='pi')(Constant(value=0.0, name='r'), motor.y)\n"
        "loop = Diagram('d', Integrator(name='angle')(motor(u)))\n"
    )
    for rule, status, words in (("true", 0, "passed"), ('"every state"', 4, "not decided")):
        (tmp_path / "asked.toml").write_text(f"stable = {rule}\n")
        code = main(["report", "mine.py:loop", "--requirements", "asked.toml", "--check", "--json"])
        said = capsys.readouterr().out
        assert code == status
        assert f"Requirements: {words}." in said
        assert (DRIFTS in said) == (status == 0)


def test_two_drives_side_by_side_pass():
    report = judge([*drive(name="left_"), *drive(name="right_")])
    assert report.review.verdict is Verdict.PASSED
    assert {motion.state for motion in report.review.free} == {"left_angle.y", "right_angle.y"}


def test_a_drive_that_turns_passes_at_its_speed():
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle, lag = Integrator(name="angle"), TransferFunction(numerator=[1.0], denominator=[0.1, 1.0], name="lag")
    pi = PID(kp=2.0, ki=5.0, name="pi")
    outputs = [angle(motor(pi(Constant(value=3.0, name="r"), motor.y))), lag(angle.y)]
    report = judge(outputs, at=40.0)
    assert report.review.verdict is Verdict.PASSED


# --- what must not pass -----------------------------------------------------------------------------------------------


def hidden(**what):
    plant = Hidden(**what, name="plant")
    return [plant(Gain(gain=-2.0, name="gain")(plant.y).named("u"))]


def pendulum_without_position():
    """x'' = u − φ, φ'' = 11 φ − u, u = 60 φ + 12 φ': φ is stable, the cart rolls away with its speed."""
    A = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1], [0, 0, 11, 0]])
    plant = StateSpace(A=A, B=[0.0, 1.0, 0.0, -1.0], C=np.eye(4), D=np.zeros(4), name="plant")
    return [plant(Gain(gain=60.0, name="k1")(plant.y[2]) + Gain(gain=12.0, name="k2")(plant.y[3]))]


def position_loop(link, reference):
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle = Integrator(name="angle")
    return [angle(motor(link(Constant(value=reference, name="wanted") - angle.y)))]


def without_wire():
    """A position loop whose controller gets its own reference in place of the angle."""
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle, wanted = Integrator(name="angle"), Constant(value=0.0, name="wanted")
    speed = PID(kp=2.0, ki=5.0, name="speed")(PID(kp=4.0, name="position")(wanted, wanted), motor.y)
    return [angle(motor(speed.named("voltage")))]


@pytest.mark.parametrize(
    ("outputs", "verdict", "reason"),
    [
        (hidden(growth=0.5), Verdict.FAILED, Reason.UNSTABLE),
        (hidden(growth=1e-3, frequency=3.0), Verdict.FAILED, Reason.UNSTABLE),
        (hidden(frequency=3.0), Verdict.UNDECIDED, Reason.ON_THE_LIMIT),
        (pendulum_without_position(), Verdict.UNDECIDED, Reason.ON_THE_LIMIT),
        (drive(Integrator(name="integral")), Verdict.UNDECIDED, Reason.ON_THE_LIMIT),
    ],
    ids=["hidden growth", "hidden growing pair", "hidden undamped pair", "cart", "ramp"],
)
def test_every_other_mode_counts_as_ever(outputs, verdict, reason):
    found = stable_of(judge(outputs))
    assert (found.verdict, found.reason) == (verdict, reason)


def test_a_saturated_actuator_hides_no_feedback():
    # far from its goal the actuator is at its limit, and the angle does not act
    report = judge(position_loop(Saturation(lower=-1.0, upper=1.0, name="link"), 10.0))
    assert report.review.verdict is not Verdict.PASSED
    assert report.review.free == ()


def test_a_left_out_wire_is_found_where_something_is_required_of_the_position():
    assert judge(without_wire()).review.verdict is Verdict.PASSED
    step = {"input": "wanted.y", "output": "angle.y", "overshoot": 0.2}
    found = stable_of(judge(without_wire(), step=step))
    assert (found.verdict, found.reason) == (Verdict.UNDECIDED, Reason.ON_THE_LIMIT)


def test_signals_on_which_something_is_required():
    asked = Requirements(
        step=[{"input": "wanted", "output": "angle", "rise": 1.0}, {"overshoot": 0.3}],
        loops={"voltage": {"ms": 1.6}},
        numbers={"inner.current.continuous.ms": (0.0, 2.0)},
    )
    assert asked.signals == ("wanted", "angle", "voltage", "current")
    assert not asked.every_state
    assert not math.isnan(stable_of(judge(drive(), loops={"voltage": {"ms": 1.6}})).number.value)


def test_what_moves_besides_a_free_motion_is_named():
    """After 0.5 s of a speed from 5 on, both the speed and the angle move, the angle faster: it may."""
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    pi = PID(kp=2.0, ki=5.0, name="pi")(Constant(value=5.0, name="r"), motor.y).named("voltage")
    angle = Integrator(name="angle")
    review = analyse(Diagram("d", angle(motor(pi))), only=("poles",), at=4.0, requirements=Requirements(ms=2.0)).review
    assert {str(motion) for motion in review.free} == {DRIFTS}
    details = {result.detail for result in review.results if result.reason is Reason.MOVING}
    assert details
    assert details <= {"motor.x[1]", "pi.integral"}

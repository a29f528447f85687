"""Reports of diagrams with several rates: fast wires are judged by periodic margins and by their own steps."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PT1, Constant, Gain, OptionError, StateSpace
from loopwright.diagrams import Diagram, Requirements, analyse, subsystem
from loopwright.diagrams.measure import step_response
from loopwright.diagrams.requirements import Reason
from loopwright.types import Verdict
from support.reviewed import judge_again

A = np.array([[-250.0, -50.0], [100.0, -0.1]])
B = np.array([500.0, 0.0])
FAST, RATIO = 2e-4, 5
INNER, OUTER = 2.0, 0.4


@cache
def cascade(inner=INNER):
    """A motor's current loop at 5 kHz in its speed loop at 1 kHz, both by a gain."""
    motor = StateSpace(A=A, B=B, C=np.eye(2), name="motor")

    @subsystem(sample_time=RATIO * FAST)
    def speed(w):
        return Gain(gain=OUTER, name="gain")(Constant(value=0.0, name="r") - w).named("current_wanted")

    @subsystem(sample_time=FAST)
    def current(i, wanted):
        return Gain(gain=inner, name="gain")(wanted - i).named("voltage")

    return Diagram("cascade", motor(current(motor.y[0], speed(motor.y[1]))))


def by_hand(samples, size, tick=0, inner=INNER):
    """Return the voltage after a step behind it at a tick, from the motor's exact samples and both gains."""
    E = expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * FAST)
    x, wanted, found = np.zeros(2), 0.0, []
    for k in range(samples):
        if (tick + k) % RATIO == 0:
            wanted = -OUTER * x[1]
        v = inner * (wanted - x[0])
        found.append(v)
        x = E[:2, :2] @ x + E[:2, 2] * (v + size)
    return np.array(found)


def test_a_step_at_a_fast_wire_is_sampled_at_each_renewal():
    got = step_response(cascade().wired, "voltage", size=0.01, length=0.02, outputs=["current_wanted"])
    assert got.dt == pytest.approx(FAST, rel=1e-12)
    begins = int(np.argmax(got.d != 0.0))
    expected = by_hand(len(got.v) - begins, 0.01, tick=begins + 1)  # the first sample is tick 1
    np.testing.assert_allclose(got.v[begins:], expected, atol=1e-9 * 0.01)
    assert got.prediction is None  # the linear model is that over the slow period


@pytest.mark.slow
def test_the_fast_wires_step_is_judged_by_its_peak_between_the_slow_samples():
    answer = -by_hand(2000, 1.0, tick=2, inner=14.0)
    final = answer[-1]
    overshoot = np.max(answer) / final - 1
    slow = np.max(answer[::RATIO]) / final - 1
    assert overshoot - slow > 0.01  # what the slow samples don't show
    limit = (overshoot + slow) / 2
    asked = Requirements(step={"overshoot": limit}, loops={"current_wanted": {"step": {"overshoot": 1.0}}})
    report = analyse(cascade(14.0), only=("poles", "inner", "steps"), requirements=asked)
    found = {(r.loop, r.quantity): r for r in report.review.results}
    result = found["voltage", "step.overshoot"]
    assert result.number.value == pytest.approx(overshoot, abs=3 * result.number.tolerance)
    assert result.verdict is Verdict.FAILED


@pytest.mark.slow
def test_margins_of_a_fast_wire_are_the_periodic_ones_and_others_are_not_decided():
    asked = Requirements(gain_margin_high=1.1, ms=3.0, bandwidth=10, loops={"voltage": {}})
    report = analyse(cascade(), only=("poles", "inner"), requirements=asked)
    found = {(r.loop, r.quantity): r for r in report.review.results}
    gain = found["voltage", "gain_margin_high"]
    assert gain.path.endswith(".periodic.gain_margin_high")
    for factor, stable in ((0.999, True), (1.001, False)):
        assert is_stable(factor * gain.number.value) is stable
    assert found["voltage", "ms"].path.endswith(".periodic.ms")
    assert found["voltage", "ms"].verdict is not Verdict.UNDECIDED
    result = found["voltage", "bandwidth"]
    assert (result.verdict, result.reason) == (Verdict.UNDECIDED, Reason.PERIODIC)
    assert "limit ms, disk_margin" in result.as_dict()["detail"]
    for name in ("ms", "bandwidth"):
        assert found["current_wanted", name].verdict is not Verdict.UNDECIDED
    assert report.review.verdict is Verdict.UNDECIDED
    rows = [row for row in report.sections[0].tables[0].rows if row[0].verdict is Verdict.UNDECIDED]
    assert all("several times in the period" in row[0] for row in rows)


def is_stable(factor):
    """Return whether the monodromy of the cascade has its eigenvalues in the unit circle, the voltage times a factor."""
    E = expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * FAST)
    ends = []
    for x0 in np.eye(2):
        x, wanted = x0, -OUTER * x0[1]
        for _ in range(RATIO):
            x = E[:2, :2] @ x + E[:2, 2] * factor * INNER * (wanted - x[0])
        ends.append(x)
    return bool(np.max(np.abs(np.linalg.eigvals(np.array(ends).T))) < 1)


def test_the_injection_check_says_in_words_why_a_fast_wire_is_not_measured():
    report = analyse(cascade(), loops=["voltage"], only=("injection",))
    (section,) = (s for s in report.sections if s.key == "injection")
    assert any("renewed several times in the period of all clocks" in text for text in section.text)
    assert not any("lifted=True" in text for text in section.text)


def test_the_injection_check_skips_wires_that_cannot_be_measured_and_names_them():
    wires = (
        "voltage",
        "motor.y",
        "current_wanted",
    )  # renewed five times in the period; a vector; as often as the period
    report = analyse(cascade(), only=("injection",), loops=wires)
    (section,) = (s for s in report.sections if s.key == "injection")
    assert "injection.current_wanted.sampled_d0.deviation" in report.numbers()
    (told,) = (str(line) for line in section.text if "Skipped" in str(line))
    assert "voltage, motor.y." in told


def test_the_operating_point_is_called_at_as_everywhere():
    at, point = (analyse(cascade(), only=("subject",), **{name: 0.01}) for name in ("at", "point"))
    assert [s.text for s in at.sections] == [s.text for s in point.sections]
    with pytest.raises(OptionError, match="at: found at and point, two names of one option"):
        analyse(cascade(), at=0.01, point=0.01)


def test_sensitivities_say_which_wires_have_none_without_programs_text():
    section = next(s for s in analyse(cascade(), only=("sensitivity",)).sections if s.key == "sensitivity")
    assert [part.key for part in section.sections] == ["current_wanted"]
    (line,) = (text for text in section.text if "voltage" in text)
    assert line.endswith("Sensitivities exist for wires that are renewed once in it.")
    assert "(" not in line


LEVEL, FILTER, EVERY = 3.0, 0.2, 4
"""Time constants of a tank and of its sensor's filter in s, and ticks of 0.1 s of the sensor for one of the law."""


def tank():
    """A tank whose level is filtered every 0.1 s, ahead of a P controller at 0.4 s, whose wish is renewed every 0.8 s."""
    level = PT1(gain=2.0, time_constant=LEVEL, name="tank")
    sensor = subsystem(sample_time=0.1, name="sensor")(lambda y: PT1(time_constant=FILTER)(y).y.named("seen"))
    planner = subsystem(sample_time=0.2 * EVERY, name="planner")(lambda y: Gain(gain=-0.2)(y).y.named("wish"))
    law = subsystem(sample_time=0.1 * EVERY, name="law")(lambda r, y: Gain(gain=2.0)(r - y).y.named("u"))
    seen = sensor(level.y)
    return Diagram("tank", level(law(planner(seen), seen)))


def tank_is_stable(factor):
    """Return whether tank and filter come to rest, u times a factor, from one tick of the planner to the next."""
    slow, fast, ends = np.exp(-0.1 / LEVEL), np.exp(-0.1 / FILTER), []
    for y, seen in np.eye(2):
        u, wish = 0.0, -0.2 * seen
        for k in range(2 * EVERY):
            u = 2.0 * factor * (wish - seen) if k % EVERY == 0 else u
            y, seen = slow * y + 2.0 * (1.0 - slow) * u, fast * seen + (1.0 - fast) * y
        ends.append([y, seen])
    return bool(np.max(np.abs(np.linalg.eigvals(np.array(ends)))) < 1.0)


@pytest.mark.slow
def test_a_sensor_that_is_faster_than_its_controller_leaves_the_verdict_to_the_controllers_wire():
    """With slower loops open nothing comes back to the sensor's wire: its loop was the constant 0, of no number."""
    asked = {"gain_margin_high": 2.0, "ms": 1.9, "loops": {"seen": {"gain_margin_high": 2.0, "bandwidth": 1.0}}}
    report = analyse(tank(), only=("poles", "inner"), requirements=Requirements(**asked))
    found = {(r.loop, r.quantity): r for r in report.review.results if r.loop}
    assert {key: r.verdict for key, r in found.items()} == {
        ("u", "gain_margin_high"): Verdict.PASSED,
        ("u", "ms"): Verdict.PASSED,
        ("wish", "gain_margin_high"): Verdict.PASSED,
        ("wish", "ms"): Verdict.PASSED,
        ("seen", "gain_margin_high"): Verdict.PASSED,
        ("seen", "bandwidth"): Verdict.UNDECIDED,
    }
    largest = found["seen", "gain_margin_high"].number.value
    assert found["u", "gain_margin_high"].number.value == pytest.approx(largest, rel=1e-8)
    assert tank_is_stable(0.999 * largest)
    assert not tank_is_stable(1.001 * largest)
    assert found["seen", "gain_margin_high"].path == "inner.seen.sampled_d0.periodic.gain_margin_high"
    assert found["seen", "bandwidth"].reason is Reason.PERIODIC
    said = "The loop at sensor.seen: it goes through slower subsystems alone, so it has no margins at its own rate; the"
    assert said in "\n".join(report.sections[0].text)
    above = judge_again(tank(), report, gain_margin_high=1.01 * largest)
    assert {r.loop: r.verdict for r in above.results if r.loop} == {"u": Verdict.FAILED, "wish": Verdict.PASSED}

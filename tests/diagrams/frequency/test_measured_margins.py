"""Margins from frequency-response data, against closed forms of the loops behind the data."""

import math

import control
import numpy as np
import pytest

from loopwright.blocks import OptionError
from loopwright.frequency import measured_margins, read_frequency_data


def loop(w):
    """4/(s + 1)³: |L| = 1 at w² = 4^(2/3) − 1, −180° at √3, where |L| = 1/2."""
    return 4 / (1j * w + 1) ** 3


CROSSOVER = math.sqrt(4 ** (2 / 3) - 1)
PHASE = 180 - 3 * math.degrees(math.atan(CROSSOVER))
DELAY = math.radians(PHASE) / CROSSOVER
MS = max(1 / np.abs(1 + loop(np.geomspace(0.1, 10, 200001))))


def frd(points, noise=0.0, seed=0):
    w = np.geomspace(0.05, 20.0, points)
    rng = np.random.default_rng(seed)
    wrong = noise * rng.uniform(0, 1, points) * np.exp(2j * np.pi * rng.uniform(0, 1, points))
    return control.frd(loop(w) * (1 + wrong), w)


def test_a_frequency_that_is_given_twice_is_refused_with_both_lines(tmp_path):
    file = tmp_path / "u.csv"
    file.write_text("hz,gain,phase_deg\n1,2,-90\n\n10,0.5,-120\n1,1.9,-91\n", encoding="utf-8")
    with pytest.raises(OptionError, match=r"u.csv.hz: found the frequency 1 in line 2 and again in line 5"):
        read_frequency_data(file)
    with pytest.raises(OptionError, match=r"data: found the frequency 1 rad/s more than once"):
        measured_margins(control.frd([2.0, 1.0, 0.5 + 0j], [1.0, 1.0, 2.0]))


def test_exact_data_give_the_closed_form():
    found = measured_margins(frd(200))
    assert float(found.phase_margin_deg) == pytest.approx(PHASE, abs=0.01)
    assert float(found.crossover) == pytest.approx(CROSSOVER, rel=1e-4)
    assert float(found.delay_margin_s) == pytest.approx(DELAY, rel=1e-3)
    assert float(found.gain_margin_high) == pytest.approx(2.0, rel=1e-4)
    assert float(found.ms) == pytest.approx(MS, rel=1e-3)
    assert math.isnan(found.gain_margin_low.value)
    assert found.notes == ()


@pytest.mark.parametrize("points", [12, 25, 100])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_the_intervals_hold_the_true_margins(points, noise):
    for seed in range(8 if noise else 1):
        found = measured_margins(frd(points, noise, seed), uncertainty=noise)
        assert PHASE in found.phase_margin_deg
        assert DELAY in found.delay_margin_s
        assert 2.0 in found.gain_margin_high
        assert MS in found.ms
        assert CROSSOVER in found.crossover


def test_more_points_and_less_noise_make_intervals_narrower():
    def width(points, noise):
        found = measured_margins(frd(points), uncertainty=noise).phase_margin_deg
        return found.high - found.low

    assert width(100, 0.0) < 0.1 * width(12, 0.0)
    assert width(100, 0.01) < 0.2 * width(100, 0.1)
    at_crossover = 2 * math.degrees(math.asin(0.05))
    assert at_crossover < width(400, 0.05) < 6 * at_crossover


def test_a_conditionally_stable_loop_has_both_gain_margins():
    w = np.geomspace(0.1, 100.0, 300)
    system = control.tf([10.0, 20.0, 10.0], [1.0, 0.0, 0.0, 0.0]) * control.tf([1.0], [0.0004, 0.04, 1.0])
    found = measured_margins(control.frd(system(1j * w), w))
    exact = control.stability_margins(system, returnall=True)[0]
    assert float(found.gain_margin_high) == pytest.approx(min(g for g in exact if g > 1), rel=1e-3)
    assert float(found.gain_margin_low) == pytest.approx(max(g for g in exact if g < 1), rel=1e-3)


def test_margins_beyond_the_data_are_not_in_the_data():
    w = np.geomspace(0.1, 0.5, 20)
    found = measured_margins(control.frd(loop(w), w))
    assert math.isnan(found.phase_margin_deg.value)
    assert math.isnan(found.gain_margin_high.value)
    assert "does not cross 1 between 0.1 and 0.5 rad/s" in found.notes[0]
    assert "not in the data" in str(found)


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("omega,real,imag,uncertainty", lambda w, L: (w, L.real, L.imag, 0 * w + 0.02)),
        ("Hz,gain_db,phase_deg", lambda w, L: (w / 2 / np.pi, 20 * np.log10(abs(L)), np.degrees(np.angle(L)))),
        ("rad/s, gain, phase_rad", lambda w, L: (w, abs(L), np.angle(L))),
    ],
)
def test_a_file_comes_in(tmp_path, header, columns):
    w = np.geomspace(0.05, 20.0, 100)[::-1]
    file = tmp_path / "loop.csv"
    file.write_text(
        "\n".join([header, *(",".join(f"{v:.12g}" for v in row) for row in zip(*columns(w, loop(w)), strict=True))])
    )
    found = measured_margins(read_frequency_data(file))
    assert float(found.phase_margin_deg) == pytest.approx(PHASE, abs=0.1)
    assert (found.phase_margin_deg.high - found.phase_margin_deg.low > 2 * math.degrees(0.02)) == ("uncert" in header)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "columns none; expected one of rad/s"),
        ("omega,gain\n1,2", "expected one of phase_deg, phase_rad"),
        ("omega,hz,real,imag\n1,2,3,4", "expected one of rad/s, omega"),
        ("omega,real,imag\n1,2,3\n2,x,1", "line 3 has no number in the column 'real'"),
        ("omega,real,imag\n1,2", "line 2 has no number in the column 'imag'"),
        ("omega,real,imag,Real\n1,2,3,4", "the column 'real' twice; expected each one once"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path, text, message):
    file = tmp_path / "loop.csv"
    file.write_text(text)
    with pytest.raises(OptionError, match=message) as caught:
        read_frequency_data(file)
    assert str(file) in str(caught.value)


W = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("data", "uncertainty", "message"),
    [
        (control.tf([1.0], [1.0, 1.0]), None, "found TransferFunction; expected frequency-response data"),
        (control.frd(np.ones((2, 2, 3)), W), None, "one input and one output"),
        (control.frd(np.ones(3), W), [0.1, 0.2], "one for each, or one for all"),
        (control.frd(np.ones(3), W), 1.0, "up to 1 for 3 frequencies"),
        (control.frd(np.ones(3), W), np.inf, "expected one for each"),
        (control.frd(np.array([1.0, np.nan, 1.0]), W), None, "1 of them with a value that is not finite"),
        (control.frd(np.ones(2), W[:2]), None, "at least 3"),
    ],
)
def test_data_that_do_not_fit_are_refused(data, uncertainty, message):
    with pytest.raises(OptionError, match=message):
        measured_margins(data, uncertainty)


@pytest.mark.slow
def test_a_measured_diagram_has_the_margins_of_its_linear_model():
    """An integrator under a sampled proportional controller; its uncertainty is that of the measurement."""
    from loopwright.blocks import Constant, Gain, Integrator
    from loopwright.diagrams import Diagram, subsystem
    from loopwright.frequency import margins

    place = Integrator(name="place")

    @subsystem(sample_time=0.1)
    def controller(y):
        return Gain(gain=4.0, name="kp")(Constant(value=0.0, name="r") - y)

    diagram = Diagram("d", place(controller(place.y).named("u")))
    found = diagram.frequency_response("u", np.geomspace(1.0, 30.0, 15), amplitude=1e-3)
    got, exact = measured_margins(found), margins(diagram.linearize().loop("u"))
    assert float(exact.phase_margin_deg) in got.phase_margin_deg
    assert got.phase_margin_deg.high - got.phase_margin_deg.low < 3.0
    assert float(exact.ms) in got.ms
    assert float(exact.delay_margin_s) in got.delay_margin_s


def test_the_largest_sensitivity_beyond_the_data_is_not_in_the_data():
    w = np.geomspace(0.05, 0.125, 10)  # far below the crossover: |S| is at most 0.26 here, and 1.57 later
    lag = control.tf([1.0], [1.0, 3.0, 2.0, 0.0])
    found = measured_margins(control.frd(lag(1j * w), w), uncertainty=0.02)
    assert math.isnan(found.ms.value)
    assert math.isnan(found.modulus_margin.value)
    assert "no modulus margin" in found.notes[-1]


def test_an_uncertain_crossing_at_the_end_of_the_data_is_not_in_the_data():
    w = np.geomspace(0.05, 1.01, 40)
    found = measured_margins(control.frd(np.exp(-1j * w) / (1j * w), w), uncertainty=0.15)
    assert math.isnan(found.phase_margin_deg.value)  # 32.7°, but 1.12 exp(−0.09j) L has 20.7°, beyond the data
    assert math.isnan(found.crossover.value)
    assert "may cross 1 outside the points between 0.05 and 1.01 rad/s" in found.notes[0]


def test_beyond_the_last_point_the_gain_stays_below_its_last_value():
    w = np.geomspace(0.05, 1.5, 40)
    lag = control.tf([1.0], [1.0, 1.0, 0.0])
    found = measured_margins(control.frd(lag(1j * w), w), uncertainty=0.01)
    assert found.ms.high >= 1.0 / (1.0 - abs(lag(1.5j)))

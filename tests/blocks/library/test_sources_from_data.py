"""Sawtooth and triangle against SciPy, recorded data from files and frames, delays that vary against NumPy."""

import numpy as np
import pandas as pd
import pytest
from scipy import signal

from loopwright.blocks import (
    Clock,
    Delay,
    GuardError,
    OptionError,
    ParameterError,
    Recorded,
    SampleTimeError,
    Sawtooth,
    Sine,
    Triangle,
    UnknownNameError,
    VariableDelay,
)
from loopwright.diagrams import Diagram, subsystem


def values(block, t):
    return np.array([block.output(time, None, None) for time in t])


# --- sawtooth and triangle -----------------------------------------------------------------------------------------------


def test_sawtooth_and_triangle_are_scipys():
    t = np.linspace(0.013, 4.0, 600)
    phase = 2 * np.pi * (t - 0.3) / 0.7
    after = t > 0.3
    saw = Sawtooth(amplitude=2.0, period=0.7, delay=0.3, bias=0.5)
    np.testing.assert_allclose(values(saw, t)[after], 0.5 + 2.0 * signal.sawtooth(phase)[after], atol=1e-12)
    for rise in (0.5, 0.2):
        triangle = Triangle(amplitude=2.0, period=0.7, rise=rise, delay=0.3, bias=0.5)
        want = 0.5 + 2.0 * signal.sawtooth(phase, rise)
        np.testing.assert_allclose(values(triangle, t)[after], want[after], atol=1e-12)
        assert set(values(triangle, t)[~after]) == {-1.5}
    assert set(values(saw, t)[~after]) == {-1.5}


def test_edges_are_at_their_decimal_times():
    saw, triangle = Sawtooth(period=0.1), Triangle(period=0.1, rise=0.3)
    assert [saw.next_instant(t) for t in (0.0, 0.1, 0.25)] == [0.1, 0.2, 0.3]
    assert [triangle.next_instant(t) for t in (0.0, 0.03, 0.1)] == [0.03, 0.1, 0.13]
    assert np.all(np.abs(values(saw, np.arange(1000) * 0.1) + 1.0) < 1e-11)
    run = Diagram("d", saw.named("y")).simulate(0.5, progress=False)
    assert np.max(run["y"]) <= 1.0


def test_a_triangle_needs_a_fall():
    with pytest.raises(ParameterError, match=r"rise: .*Use Sawtooth"):
        Triangle(period=1.0, rise=1.0)


# --- recorded data -------------------------------------------------------------------------------------------------------


def test_a_run_that_was_written_plays_again(tmp_path):
    first = Diagram("d", Sine(frequency=1.0, name="a").named("arc"), (2.0 * Clock(name="b")).named("ramp"))
    run = first.simulate(1.0, step=0.1, progress=False)
    run.to_csv(tmp_path / "run.csv", "arc", "ramp")
    for again in (
        Recorded.from_csv(tmp_path / "run.csv", ("arc", "ramp"), name="again"),
        Recorded.from_csv(tmp_path / "run.csv", time="t", name="again"),
        Recorded.from_pandas(run.to_pandas("arc", "ramp"), name="again"),
        Recorded.from_pandas(run.to_pandas("arc", "ramp").reset_index(), ["arc", "ramp"], time="t", name="again"),
    ):
        played = Diagram("d", again).simulate(1.0, step=0.1, progress=False)
        assert np.array_equal(played["again.y"], np.stack([run["arc"], run["ramp"]], axis=1))
    assert Recorded.from_csv(tmp_path / "run.csv", "ramp", unit="m").outputs["y"].unit == "m"
    assert Recorded.from_pandas(run.to_pandas("arc")["arc"]).values.tolist() == run["arc"].tolist()


def test_files_that_are_almost_right_say_what_to_change(tmp_path):
    file = tmp_path / "data.csv"
    file.write_text("0.0,1.0\n0.5,2e-3\n")
    with pytest.raises(
        ParameterError, match=r"numbers 0\.0, 1\.0 in the first line .* Put a line above them, such as t,y"
    ):
        Recorded.from_csv(file)
    file.write_text("t;y\n0,0;1,5\n")
    with pytest.raises(
        ParameterError, match=r"the row 2 of .* Write decimal points, or .* decimal=','\) and from_pandas"
    ):
        Recorded.from_csv(file, name="data")
    with pytest.raises(OptionError, match=r"is a folder; .* run = Run\.open\(path\), Recorded\(times=run\.t"):
        Recorded.from_csv(tmp_path)


def test_other_separators_and_rows_at_one_time(tmp_path):
    file = tmp_path / "measured.csv"
    file.write_text("time; speed\n0.0; 1.0\n0.5; 2.0\n0.5; 3.0\n1.0; 4.0\n", encoding="utf-8-sig")
    made = Recorded.from_csv(file, interpolation="previous")
    assert (made.times.tolist(), made.values.tolist()) == ([0.0, 0.5, 1.0], [1.0, 3.0, 4.0])
    with pytest.raises(ParameterError, match=r"Sort them, with their values, and leave out repeated ones"):
        Recorded.from_csv(file)


@pytest.mark.parametrize(
    ("text", "options", "error", "said"),
    [
        ("t,speed\n0,1\n1,2\n", {"columns": "sped"}, UnknownNameError, r"no column 'sped'\. Did you mean 'speed'"),
        ("t,speed\n0,1\n1,2\n", {"time": "T"}, UnknownNameError, r"Recorded: the data has no column 'T'"),
        ("t,speed\n0,1\n1,fast\n", {}, ParameterError, r"found the row 3 of .*; expected 2 numbers"),
        ("t,speed\n0,1,5\n", {"name": "a"}, ParameterError, r"a\.values: found the row 2 of"),
        (None, {}, OptionError, r"can't be read"),
        ("", {}, OptionError, r"is empty"),
        ("t,a\n0,1\n", {"columns": 3}, OptionError, r"Recorded\.columns: found 3; expected a name, or a list of names"),
    ],
)
def test_files_that_do_not_fit_are_named(tmp_path, text, options, error, said):
    if text is not None:
        (tmp_path / "a.csv").write_text(text)
    with pytest.raises(error, match=said):
        Recorded.from_csv(tmp_path / "a.csv", **options)


def test_a_frame_with_words_is_refused():
    with pytest.raises(ParameterError, match=r"found columns index, speed with other values than numbers"):
        Recorded.from_pandas(pd.DataFrame({"speed": ["a", "b"]}))
    with pytest.raises(OptionError, match=r"Recorded\.frame: found 'data\.csv'; expected a pandas DataFrame or Series"):
        Recorded.from_pandas("data.csv")


# --- delays that vary ----------------------------------------------------------------------------------------------------


def late(delay, **options):
    @subsystem(sample_time=0.1)
    def box(u, tau):
        return VariableDelay(samples=5, **options)(u, tau).named("y")

    wave = Sine(frequency=0.37, name="wave")
    times = np.arange(21) * 0.1
    shift = Recorded(times=times, values=delay(times), interpolation="previous", unit="s", name="shift")
    return times, Diagram("d", box(wave, shift)).simulate(2.0, progress=False)


def test_a_varying_delay_is_the_line_through_the_samples():
    times, run = late(lambda t: 0.25 + 0.2 * np.sin(3 * t))
    samples = np.sin(2 * np.pi * 0.37 * times)
    want = np.interp(times - 0.25 - 0.2 * np.sin(3 * times), times, samples)  # before the start the first value holds
    np.testing.assert_allclose(run["box.y"], want, atol=1e-14)


def test_whole_samples_are_a_delay():
    _, run = late(lambda t: np.full_like(t, 0.3), initial_value=7.0)

    @subsystem(sample_time=0.1)
    def box(u):
        return Delay(steps=3, initial_value=7.0)(u).named("y")

    other = Diagram("d", box(Sine(frequency=0.37))).simulate(2.0, progress=False)
    np.testing.assert_allclose(run["box.y"], other["box.y"], atol=1e-14)


@pytest.mark.parametrize(("delay", "guard"), [(0.6, "longest delay"), (-0.1, "delay of 0 or more")])
def test_a_delay_beyond_its_limits_stops_the_run(delay, guard):
    with pytest.raises(GuardError, match=rf"box\.variable_delay.*guard '{guard}'"):
        late(lambda t: np.where(t > 0.55, delay, 0.2))


def test_in_continuous_time_it_is_refused():
    with pytest.raises(SampleTimeError, match=r"variable_delay"):
        Diagram("d", VariableDelay(samples=3)(Clock(unit=None), 0.1))

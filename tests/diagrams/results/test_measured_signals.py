"""Measured data drawn over the signals of a run."""

import numpy as np
import pytest

from loopwright import Diagram
from loopwright.blocks import Gain, Sine, Step
from loopwright.diagrams import OptionError

T = np.linspace(0.0, 2.0, 41)


@pytest.fixture(scope="module")
def run():
    wave = Sine(frequency=1.0, name="wave")
    step = Step(times=0.5, values=3.0, name="step")
    two = Gain(gain=[1.0, 2.0], name="two")(wave)
    diagram = Diagram("d", (2.0 * wave).named("speed"), (1.0 * step).named("force"), two.named("pair"))
    return diagram.simulate(1.0, step=0.01, progress=False)


def lines_of(figure, axis=0):
    return {line.get_label(): line.get_xydata() for line in figure.axes[axis].get_lines()}


def drawn(t, y):
    return pytest.approx(np.column_stack([t, y]), abs=0.0)


@pytest.mark.parametrize("data", [(T, T**2), [T.tolist(), (T**2).tolist()], {"t": T, "speed": T**2, "other": T}])
@pytest.mark.parametrize("named", [True, False])
def test_a_pair_and_columns_are_drawn_over_the_run(run, data, named):
    lines = lines_of(run.plot("speed", against={"bench": data} if named else data))
    assert lines["bench" if named else "measured"] == drawn(T, T**2)
    assert lines["this run"] == drawn(run.t, run["speed"])


def test_a_frame_has_its_times_in_a_column_or_in_its_index(run):
    pandas = pytest.importorskip("pandas")
    for frame in (
        pandas.DataFrame({"time": T, "speed": 2.0 * T, "force": 3.0 * T}),
        pandas.DataFrame({"speed": 2.0 * T, "force": 3.0 * T}, index=T),
        run.to_pandas(),
    ):
        figure = run.plot("speed", "force", against={"bench": frame, "same": run})
        own = len(frame) == len(run.t)
        t = run.t if own else T
        assert lines_of(figure, 0)["bench"] == drawn(t, run["speed"] if own else 2.0 * T)
        assert lines_of(figure, 1)["bench"] == drawn(t, run["force"] if own else 3.0 * T)
        assert lines_of(figure, 0)["same"] == drawn(run.t, run["speed"])


def test_a_signal_that_was_not_measured_is_drawn_alone(run):
    figure = run.plot(["speed", "force"], "pair", against={"bench": {"t": T, "force": T}})
    assert [*lines_of(figure)] == ["speed, this run", "force, this run", "force, bench"]
    assert len(figure.axes[1].get_lines()) == 2


@pytest.mark.parametrize(
    ("names", "data", "words"),
    [
        (["speed"], (T, T[:7]), r"found 41 times and samples of shape \(7,\) of y"),
        (["speed"], {"t": T, "speeed": T}, "found the columns 'speeed'; expected one of the signals that are drawn"),
        (["speed", "force"], (T, T), r"found a pair \(t, y\), which is one signal, and 2 signals to draw"),
        (["pair"], (T, T), r"found samples of shape \(41,\) of pair, which is \(101, 2\) in the run"),
        (["speed"], (T, ["a"] * 41), "as y; expected numbers at times in s"),
        (["speed"], {"t": T}, r"found times of shape \(41,\) and 0 signals"),
        (["speed"], {"speed": np.arange(600.0)}, r"found \{'speed': <600 numbers>\}; expected runs by their names"),
        (["speed"], np.arange(600.0), "found <600 numbers>; expected runs"),
        (["speed"], 3.0, "found 3; expected runs"),
    ],
)
def test_what_is_no_measured_data_is_named_in_short(run, names, data, words):
    with pytest.raises(OptionError, match=words) as refused:
        run.plot(*names, against={"bench": data} if isinstance(data, tuple) else data)
    assert len(str(refused.value)) < 300
    with pytest.raises(OptionError, match=r"expected runs by their names") as refused:
        run.plot_path("speed", "force", against={"bench": (T, T)})
    assert len(str(refused.value)) < 300

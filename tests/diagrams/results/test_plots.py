"""Plots of runs: names where they hide nothing; several signals and runs in one axis; set-points, limits, events."""

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Constant,
    Gain,
    OptionError,
    Ramp,
    Requirement,
    StateSpace,
    Step,
    TransferFunction,
)
from loopwright.diagrams import Diagram, Run, subsystem


@pytest.mark.slow
def test_labels_of_neighbours_do_not_overlap_however_long_the_names_are():
    ramp = Ramp(slope=1.0, name="ramp")
    names = [f"a_{'long_' * k}name" for k in (0, 2, 4, 8, 10)]
    run = Diagram("d", *(Gain(gain=2.0, name=f"g{k}")(ramp).named(name) for k, name in enumerate(names))).simulate(
        1.0, step=0.1, progress=False
    )
    figure = run.plot(*names)
    figure.canvas.draw()
    boxes = [ax.yaxis.label.get_window_extent() for ax in figure.axes]
    boxes += [ax.title.get_window_extent() for ax in figure.axes]
    boxes += [ax._left_title.get_window_extent() for ax in figure.axes]
    boxes += [ax.get_window_extent() for ax in figure.axes]
    shown = [box for box in boxes if box.width > 1.0 and box.height > 1.0]
    assert len(shown) == 2 * len(names)
    for i, one in enumerate(shown):
        assert one.x0 >= 0.0
        assert one.x1 <= figure.bbox.width
        assert not any(one.overlaps(other) for other in shown[:i])
    told = [ax.get_ylabel() or ax.get_title(loc="left") for ax in figure.axes]
    assert told == names


def make(kp=2.0):
    """A motor whose controller is limited, and a requirement that its angle violates."""
    wish = Step(times=(0.5, 3.0), values=(1.0, 0.3), name="wish")
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0, 0.0], name="motor")

    @subsystem(sample_time=0.1)
    def controller(r, y):
        return PID(kp=kp, ki=0.3, lower=-1.2, upper=1.2, name="pid")(r=r, y=y).named("u")

    low = Requirement("stays low", upper=1.3, on_violation="record", name="low")
    return Diagram("loop", motor(controller(wish, motor.y)).named("angle"), low(motor.y))


@pytest.fixture(scope="module")
def runs():
    return [make(kp).simulate(6.0, progress=False) for kp in (2.0, 10.0)]


def lines(ax):
    return {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}


def test_a_list_is_one_axis_with_the_set_point_dashed_and_limits_and_events_marked(runs):
    run = runs[0]
    figure = run.plot("u", ["wish", "angle"])
    u, both = figure.axes
    assert lines(both)["wish"].is_dashed()
    assert not lines(both)["angle"].is_dashed()
    assert lines(both)["wish"].get_drawstyle() == lines(u)["u"].get_drawstyle() == "steps-post"
    assert lines(both)["angle"].get_drawstyle() == "default"
    assert np.array_equal(lines(both)["angle"].get_ydata(), run["motor.y"])
    assert [text.get_text() for text in both.get_legend().get_texts()] == ["wish", "angle"]
    figure.draw(figure.canvas.get_renderer())
    edge = both.get_window_extent()
    assert both.get_legend().get_window_extent().y0 >= edge.y1 - 1.0  # it hides no curve
    assert u.get_window_extent().y0 >= both.get_legend().get_window_extent().y1  # nor the axis above
    limits = [{line.get_ydata()[0] for line in ax.lines if line.get_label().startswith("_")} for ax in (u, both)]
    assert limits == [{-1.2, 1.2}, {1.3}]
    (event,) = run.events
    marks = [c for ax in figure.axes for c in ax.collections if c.get_gid() == "events"]
    assert [c.get_segments()[0][0][0] for c in marks] == [event.t, event.t]
    assert u.get_title(loc="left") == "ticks: events of low"
    assert both.get_xlabel() == "t [s]"


def test_runs_over_each_other_have_the_names_of_their_runs(runs):
    run, other = runs
    figure = run.plot("angle", "u", against={"kp = 10": other}, label="kp = 2")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["kp = 2", "kp = 10"]
    for ax, name in zip(figure.axes, ("angle", "u"), strict=True):
        assert np.array_equal(lines(ax)["kp = 2"].get_ydata(), run[name])
        assert np.array_equal(lines(ax)["kp = 10"].get_ydata(), other[name])
        assert lines(ax)["kp = 2"].get_color() != lines(ax)["kp = 10"].get_color()
    (ax,) = run.plot(["wish", "angle"], against=other).axes
    assert list(lines(ax)) == ["wish", "angle, this run", "angle, other run"]  # the set-point is that of both, once
    assert lines(ax)["angle, this run"].get_color() == lines(ax)["angle, other run"].get_color()
    for against, text in (({"this run": other}, "'this run' twice"), ([other], "expected runs by their names")):
        with pytest.raises(OptionError, match=text):
            run.plot("angle", against=against)


def test_times_that_are_shown_fill_the_axes(runs):
    run = runs[0]
    ax = run.plot("angle", xlim=(1.0, 2.0)).axes[0]
    inside = run["angle"][(run.t >= 1.0) & (run.t <= 2.0)]
    assert ax.get_xlim() == (1.0, 2.0)
    assert ax.get_ylim()[0] <= inside.min() < inside.max() <= ax.get_ylim()[1] < 1.2 * inside.max()
    for wrong in ((2.0, 1.0), 3.0, (1.0, float("nan"))):
        with pytest.raises(OptionError, match="two times in s, the first one below the other"):
            run.plot("angle", xlim=wrong)


def test_a_run_from_disk_is_drawn_without_its_diagram(runs, tmp_path):
    runs[0].save(tmp_path / "run")
    stored = Run.open(tmp_path / "run")
    assert np.array_equal(lines(stored.plot(["wish.y", "angle"]).axes[0])["angle"].get_ydata(), runs[0]["angle"])


def test_a_path_in_the_plane_has_equal_axes_where_the_units_are_equal(runs):
    A, B, C, D = [[0.0, -1.0], [1.0, 0.0]], [[0.0], [0.0]], np.eye(2), [[0.0], [0.0]]
    spin = StateSpace(A=A, B=B, C=C, D=D, initial_state=[1.0, 0.0], name="spin")
    rest = Diagram("circle", spin(Constant(value=[0.0], name="s")))
    circle = rest.simulate(1.5, step=0.1, progress=False)
    ax = circle.plot_path("spin").axes[0]
    x, y = ax.lines[0].get_data()
    assert np.allclose(np.hypot(x, y), 1.0, atol=1e-4)
    assert (x[-1], y[-1]) == pytest.approx((np.cos(1.5), np.sin(1.5)), abs=1e-4)
    assert ax.get_aspect() == 1.0
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("spin[1]", "spin[2]")
    ax = runs[0].plot_path("angle", "u", against={"kp = 10": runs[1]}).axes[0]
    assert np.array_equal(ax.lines[0].get_xdata(), runs[0]["angle"])
    for names, found in ((("angle",), "signals of 1 numbers"), (("spin", "s"), "signals of 2 and 1 numbers")):
        with pytest.raises(OptionError, match=f"{found}; expected one signal with two entries, or two with one each"):
            (runs[0] if "angle" in names else circle).plot_path(*names)


def test_a_sweep_draws_all_its_runs():
    sweep = make().sweep({"pid.kp": [1.0, 2.0]}, 1.0, signals=["angle", "u"], progress=False, workers=1, compile=False)
    figure = sweep.plot()
    assert [ax.get_ylabel() for ax in figure.axes] == ["angle", "u"]
    found = lines(figure.axes[0])
    assert list(found) == ["controller.pid.kp = 1", "controller.pid.kp = 2"]
    assert np.array_equal(found["controller.pid.kp = 2"].get_ydata(), sweep["angle"][1])
    with pytest.raises(OptionError, match="found 'angel' to draw.* Did you mean 'angle'"):
        sweep.plot("angel")
    many = make().sweep({"pid.kp": np.linspace(1.0, 2.0, 7)}, 0.2, signals=["u"], progress=False, workers=1)
    figure = many.plot("u")
    assert figure.axes[1].get_ylabel() == "controller.pid.kp"  # the scale of colors
    assert len({line.get_color() for line in figure.axes[0].lines}) == 7


def test_signals_of_another_run_are_drawn_in_the_units_of_the_first():
    """Of a plant that counts in rpm and degrees Celsius over one in rad/s and K; a newton is no speed."""
    rates = [Ramp(slope=1.0, unit=unit, name="ramp") for unit in ("rad/s", "rpm", "N")]
    heats = [Constant(value=300.0, unit=unit, name="heat") for unit in ("K", "degC", "K")]
    turning, counted, pushing = (
        Diagram("d", rate.named("a"), heat.named("b")).simulate(3.0, step=1.0, progress=False)
        for rate, heat in zip(rates, heats, strict=True)
    )
    speeds, temperatures = turning.plot("a", "b", against={"counted": counted}).axes
    np.testing.assert_allclose(speeds.lines[1].get_ydata(), np.arange(4.0) * 2.0 * np.pi / 60.0, rtol=1e-14)
    np.testing.assert_allclose(temperatures.lines[1].get_ydata(), 573.15, rtol=1e-14)
    assert [ax.get_ylabel() for ax in (speeds, temperatures)] == ["a [rad/s]", "b [K]"]

    (ax,) = turning.plot("a", against={"pushing": pushing}).axes
    assert [line.get_label() for line in ax.lines] == ["a [rad/s], this run", "a [N], pushing"]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), np.arange(4.0))

    (path,) = turning.plot_path("a", "b", against={"counted": counted}).axes
    curve = next(line for line in path.lines if line.get_label() == "counted")
    np.testing.assert_allclose(curve.get_data()[0], np.arange(4.0) * 2.0 * np.pi / 60.0, rtol=1e-14)
    np.testing.assert_allclose(curve.get_data()[1], 573.15, rtol=1e-14)
    assert (path.get_xlabel(), path.get_ylabel()) == ("a [rad/s]", "b [K]")
    (path,) = turning.plot_path("a", "b", against={"pushing": pushing}).axes
    assert (path.get_xlabel(), path.get_ylabel()) == ("a", "b [K]")

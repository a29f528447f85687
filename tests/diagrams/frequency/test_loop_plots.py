"""Loops that plot themselves: the curves against python-control and closed forms, overlays, and refusals."""

import control
import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, OptionError, TransferFunction, TransportDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.frequency.drawn_loops import drawn_loops, phase_of
from loopwright.frequency import margins

KP, KI, TAU = 5.0, 4.0, 0.05


def drive(sample_time=None):
    """PI control of 1/(s (τ s + 1)): the wires u and y."""
    lag, place = TransferFunction(numerator=[1.0], denominator=[TAU, 1.0], name="lag"), Integrator(name="place")
    pi = TransferFunction(numerator=[KP, KI], denominator=[1.0, 0.0], name="pi")

    @subsystem(sample_time=sample_time)
    def controller(y):
        return pi(Constant(value=0.0, name="r") - y)

    return Diagram("drive", place(lag(controller(place.y).named("u"))).named("y"))


@pytest.fixture(scope="module")
def loop():
    return drive().linearize().loop("u")


@pytest.fixture(scope="module")
def sampled():
    return drive(0.02).linearize().loop("u")


def exact(w):
    s = 1j * w
    return (KP * s + KI) / s, 1 / (s * (TAU * s + 1))


def data(line):
    return tuple(np.asarray(part, dtype=float) for part in line.get_data())


def curve(axes, i=0):
    """Return the curve of a loop, which has a name; marks have none."""
    return data([line for line in axes.lines if not line.get_label().startswith("_")][i])


def marks(axes, marker):
    """Return the points of the marks of a kind."""
    return [tuple(np.ravel(data(line))) for line in axes.lines if line.get_marker() == marker]


def thick(axes):
    """Return the margins that are drawn as thick lines: their ends."""
    return [data(line) for line in axes.lines if line.get_linewidth() == 2.0]


def test_a_loop_is_a_state_space_of_python_control(loop):
    assert isinstance(loop, control.StateSpace)
    assert type(2 * loop) is control.StateSpace
    assert loop.name == "L(u)"
    assert loop.wires == ("u",)
    assert control.margin(loop)[1] == pytest.approx(float(control.margin(control.ss(loop))[1]))


@pytest.mark.parametrize(("db", "hz"), [(True, False), (False, True)])
def test_bode_is_the_closed_form(loop, db, hz):
    figure = loop.bode(db=db, hz=hz)
    gain, phase = figure.axes
    w, size = curve(gain)
    w = w * (2 * np.pi if hz else 1.0)
    C, P = exact(w)
    assert np.allclose(10 ** (size / 20) if db else size, np.abs(C * P), rtol=1e-9)
    assert np.allclose(curve(phase)[1], np.degrees(np.unwrap(np.angle(C * P))), atol=1e-6)
    crossover = w[np.argmin(np.abs(np.abs(C * P) - 1))]
    assert w[0] < crossover / 20 < 20 * crossover < w[-1]
    assert ("Hz" in phase.get_xlabel()) == hz


def test_a_sampled_loop_ends_at_half_its_sampling_frequency_and_is_that_of_python_control(loop, sampled):
    figure = loop.bode(sampled)
    w, size = curve(figure.axes[0], 1)
    assert w[-1] == pytest.approx(np.pi / 0.02, rel=1e-2)
    assert w[-1] < np.pi / 0.02
    expected = np.abs(np.ravel(control.ss(sampled)(np.exp(0.02j * w))))
    assert np.allclose(10 ** (size / 20), expected, rtol=1e-6)
    assert curve(figure.axes[0], 0)[0][-1] > np.pi / 0.02 or w[-1] > 10


def test_nyquist_is_the_closed_form_with_its_mirror_and_crossings_in_view(loop):
    figure = loop.nyquist(omega=np.geomspace(0.5, 50.0, 40))
    C, P = exact(np.geomspace(0.5, 50.0, 40))
    axes = figure.axes[0]
    drawn = {tuple(np.round(data(line)[1][:3], 9)) for line in axes.lines}
    assert tuple(np.round((C * P).imag[:3], 9)) in drawn
    assert tuple(np.round(-(C * P).imag[:3], 9)) in drawn
    far = control.tf([20.0], [1.0, 3.0, 3.0, 1.0])  # crosses at −20/8
    assert loop.nyquist(far).axes[0].get_xlim()[0] < -2.5


@pytest.mark.slow
def test_nichols_is_gain_over_phase(loop):
    w = np.geomspace(0.5, 50.0, 40)
    phase, gain = curve(loop.nichols(omega=w).axes[0])
    C, P = exact(w)
    assert np.allclose(gain, 20 * np.log10(np.abs(C * P)), atol=1e-9)
    assert np.allclose(phase, np.degrees(np.unwrap(np.angle(C * P))), atol=1e-9)


DELAY, T = 0.3, 0.1
s_, atan = control.tf("s"), lambda x: np.degrees(np.arctan(x))
BRANCHES = {
    "stable": (2 / (s_ * (s_ + 1)), lambda w: -90 - atan(w)),
    "unstable": (3 / (s_ - 1), lambda w: -180 + atan(w)),
    "unstable with an integrator and a lead": (
        8 * (s_ + 1) / ((0.02 * s_ + 1) * s_ * (s_ - 1)),
        lambda w: -270 + 2 * atan(w) - atan(0.02 * w),
    ),
    "two integrators": ((s_ + 1) / s_**2, lambda w: -180 + atan(w)),
    "three integrators": (10 * (s_ + 1) ** 2 / s_**3, lambda w: -270 + 2 * atan(w)),
    "two unstable poles": (10 * s_ / (s_ - 1) ** 2, lambda w: -270 + 2 * atan(w)),
    "two unstable poles and an integrator": (10 * (s_ + 1) ** 2 / (s_ * (s_ - 1) ** 2), lambda w: -450 + 4 * atan(w)),
    "three unstable poles": (30 * (s_ + 1) ** 2 / (s_ - 1) ** 3, lambda w: -540 + 5 * atan(w)),
    "negative gain of an unstable plant": (-3 / (1 - s_), lambda w: -180 + atan(w)),
    "sampled": (control.tf([0.5], [1, -1], T), lambda w: -90 - np.degrees(w * T / 2)),
    "sampled, unstable": (
        control.tf([0.4], [1, -1.2], T),
        lambda w: -180 + np.degrees(np.arctan2(np.sin(w * T), 1.2 - np.cos(w * T))),
    ),
    "never 1": (control.tf([0.5], [1, 1]), lambda w: -atan(w)),
}


@pytest.mark.parametrize("name", BRANCHES)
@pytest.mark.drawn(6)
def test_the_phase_is_on_the_branch_on_which_the_phase_margin_is_read(name):
    system, phase = BRANCHES[name]
    (loop,) = drawn_loops([system], [name], None, marked=True)
    assert np.allclose(phase_of(loop), phase(loop.omega), atol=1e-6)
    for omega, margin in loop.gain_crossovers():
        assert margin == pytest.approx(phase(omega) + 180.0, abs=1e-6)


@pytest.mark.slow
def test_the_phase_of_a_loop_with_dead_time():
    level = Integrator(name="level")
    pipe = TransportDelay(delay=DELAY, name="pipe")
    slow = Diagram("d", level(pipe(Gain(gain=2.0, name="k")(-level.y)).named("u"))).linearize().loop("u")
    w, phase = curve(slow.bode().axes[1])
    assert np.allclose(phase, -90 - np.degrees(w * DELAY), atol=1e-6)


def test_margins_are_marked_in_all_three_diagrams():
    # L = K/(s (s + 1)²): −180° at 1 rad/s with K/2; |L| = 1 where ω (1 + ω²) = K; with K = 2·0.45 at ω₁
    K = 0.9
    real = np.roots([1.0, 0.0, 1.0, -K])
    omega = float(real[np.abs(real.imag) < 1e-9][0].real)
    phase = -90 - 2 * atan(omega)
    loop = Diagram("d", (plant := TransferFunction(numerator=[K], denominator=[1, 2, 1, 0], name="p"))(-plant.y))
    loop = loop.linearize().loop("p")
    gain_axes, phase_axes = loop.bode().axes
    assert marks(gain_axes, "o") == [pytest.approx((omega, 0.0))]
    assert marks(phase_axes, "s") == [pytest.approx((1.0, -180.0))]
    ((x, y),) = thick(phase_axes)
    assert x == pytest.approx([omega, omega])
    assert y == pytest.approx([-180.0, phase], abs=1e-6)
    ((x, y),) = thick(gain_axes)
    assert y == pytest.approx([0.0, 20 * np.log10(K / 2)])
    factor = 2 / K
    text = f"gain margin {factor:.4g} ({20 * np.log10(factor):.3g} dB), phase margin {phase + 180:.4g}°"
    assert gain_axes.get_title(loc="right") == text
    nichols = loop.nichols().axes[0]
    assert marks(nichols, "o") == [pytest.approx((phase, 0.0), abs=1e-6)]
    assert marks(nichols, "s") == [pytest.approx((-180.0, 20 * np.log10(K / 2)))]
    nyquist = loop.nyquist().axes[0]
    assert marks(nyquist, "o") == [pytest.approx((np.cos(np.radians(phase)), np.sin(np.radians(phase))))]
    assert marks(nyquist, "s") == [pytest.approx((-K / 2, 0.0))]
    plain = loop.bode(margins=False).axes[0]
    assert not marks(plain, "o")
    assert not plain.get_title(loc="right")


@pytest.mark.slow
def test_a_step_is_that_of_the_closed_loop(loop, sampled):
    axes = loop.step(sampled, t=3.0).axes[0]
    C, P = control.tf([KP, KI], [1.0, 0.0]), control.tf([1.0], [TAU, 1.0, 0.0])
    t, y = curve(axes)
    assert np.allclose(y, control.step_response(control.feedback(C * P, 1), T=t).y[0, 0], atol=1e-6)
    t, y = curve(axes, 1)
    assert np.allclose(np.diff(t), 0.02)
    assert np.allclose(y, control.step_response(control.feedback(control.ss(sampled), 1), T=t).y[0, 0], atol=1e-9)
    assert loop.step().axes[0].get_xlim()[1] == pytest.approx(30 / 4.9, rel=0.1)


@pytest.mark.slow
def test_the_gang_of_four_is_that_of_plant_and_controller(loop):
    w = np.geomspace(0.1, 100.0, 30)
    figure = loop.gang_of_four("y", omega=w)
    C, P = exact(w)
    S = 1 / (1 + C * P)
    expected = {"|S|": S, "|PS|": P * S, "|CS|": C * S, "|T|": 1 - S}
    assert {axes.get_ylabel() for axes in figure.axes} == set(expected)
    for axes in figure.axes:
        assert np.allclose(curve(axes)[1], np.abs(expected[axes.get_ylabel()]), rtol=1e-7)


@pytest.mark.slow
def test_several_loops_and_measured_data_stand_in_one_figure(loop):
    C, P = exact(np.array([1.0, 10.0]))
    data = control.frd(C * P, np.array([1.0, 10.0]), name="measured")
    plain = control.tf([KP], [TAU, 1.0, 0.0], name="plain")
    axes = loop.bode(plain, data, loop).axes[0]
    assert [text.get_text() for text in axes.figure.legends[0].get_texts()] == [
        "L(u) (1)",
        "plain",
        "measured",
        "L(u) (2)",
    ]
    w, size = curve(axes, 2)
    assert list(w) == [1.0, 10.0]
    assert np.allclose(10 ** (size / 20), np.abs(C * P))
    assert [line.get_marker() for line in axes.lines if line.get_label() == "measured"] == ["o"]
    own = loop.bode(plain, labels=["a", "b"]).legends[0].get_texts()
    assert [text.get_text() for text in own] == ["a", "b"]


@pytest.mark.slow
def test_each_figure_is_one_of_pyplots(loop):
    import matplotlib.pyplot as plt

    figures = [loop.bode(), loop.nyquist(), loop.nichols(), loop.step(), loop.gang_of_four("y")]
    assert [plt.figure(n) for n in plt.get_fignums()] == figures
    assert all(figure._repr_png_().startswith(b"\x89PNG") for figure in figures[:1])


def unstable():
    place = Integrator(name="place")
    return Diagram("d", place(Gain(gain=3.0, name="g")(place.y).named("u"))).linearize().loop("u")


@pytest.mark.parametrize(
    ("ask", "text"),
    [
        (lambda L: L.bode(labels=["a", "b"]), "2 labels for 1 loops; expected one for each"),
        (lambda L: L.bode(omega=[-1.0]), "expected positive frequencies"),
        (lambda L: L.bode(control.ss([[0.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])), "1 outputs and 2 inputs"),
        (lambda L: L.nyquist("u"), "found str; expected a loop"),
        (lambda L: L.step(t=0.0), "expected times in s above 0"),
        (lambda L: L.step(control.frd([1.0 + 0j], [1.0])), "data has no step response"),
        (lambda L: unstable().step(), r"a pole at 3\+0j, which is not stable"),
        (lambda L: L.gang_of_four("y", control.ss(L)), r"expected a loop of linearize\(\).loop"),
    ],
)
def test_what_does_not_fit_is_refused(loop, ask, text):
    with pytest.raises(OptionError, match=text):
        ask(loop)


def test_interconnected_systems_come_in_and_go_out():
    """python-control's own interconnection as a block: its step response in a run, and back again."""
    from loopwright.blocks import StateSpace, Step

    P = control.ss([[0, 1], [0, -2]], [[0], [1]], [[1, 0]], 0, name="P", inputs="u", outputs="y")
    C = control.tf([6, 1], [0.1, 1], name="C", inputs="e", outputs="u")
    closed = control.interconnect([P, C, control.summing_junction(["r", "-y"], "e")], inputs="r", outputs="y")
    block = StateSpace.from_control(closed, name="closed")
    run = Diagram("d", block(Step(times=0.0, values=1.0))).simulate(
        2.0, step=0.1, rtol=1e-9, atol=1e-11, progress=False
    )
    expected = control.step_response(control.ss(closed), T=run.t).y[0, 0]
    assert np.max(np.abs(run["closed.y"] - expected)) < 1e-7
    back = block.to_control()
    assert np.allclose(back(1j), closed(1j))
    assert back.input_labels == ["r"]


def test_interconnected_systems_of_several_signals_in_any_sample_time_come_in_and_go_out():
    """Two channels, dt=True: the run is python-control's response at the subsystem's own sample time."""
    from loopwright.blocks import DiscreteStateSpace

    plant = control.ss(
        [[0.5, 0.1], [0.0, 0.8]],
        [[1.0, 0.0], [0.0, 0.2]],
        [[1.0, 1.0], [0.0, 1.0]],
        0,
        True,
        name="P",
        inputs=["u1", "u2"],
        outputs=["y1", "y2"],
    )
    gains = control.ss([], [], [], np.diag([0.3, 0.4]), True, name="C", inputs=["e1", "e2"], outputs=["u1", "u2"])
    errors = control.summing_junction(["r", "-y"], "e", dimension=2, dt=True)
    closed = control.interconnect(
        [plant, gains, errors],
        connections=[
            *([f"P.u{i}", f"C.u{i}"] for i in (1, 2)),
            *([f"C.e{i}", f"{errors.name}.e[{i - 1}]"] for i in (1, 2)),
            *([f"{errors.name}.y[{i - 1}]", f"P.y{i}"] for i in (1, 2)),
        ],
        inplist=[f"{errors.name}.r[0]", f"{errors.name}.r[1]"],
        outlist=["P.y1", "P.y2"],
        inputs=["r1", "r2"],
        outputs=["y1", "y2"],
    )
    assert closed.dt is True
    block = DiscreteStateSpace.from_control(closed, name="closed")

    @subsystem(sample_time=0.1)
    def sampled(r):
        return block(r).named("y")

    run = Diagram("d", sampled(Constant(value=[1.0, -2.0], name="r"))).simulate(2.0, progress=False)
    r = np.tile([[1.0], [-2.0]], len(run.t))
    expected = control.forced_response(control.ss(closed.A, closed.B, closed.C, closed.D, 0.1), U=r).outputs
    np.testing.assert_allclose(run["sampled.y"], expected.T, atol=1e-12)
    back = block.to_control()
    assert (back.dt, back.input_labels, back.output_labels) == (True, ["r1", "r2"], ["y1", "y2"])
    np.testing.assert_allclose(back(1j), closed(1j), rtol=1e-12)


@pytest.mark.slow
def test_resonances_are_drawn_to_their_peaks_and_legends_stand_above(loop):
    """|1/(s² + 2 ζ s + 1)| is 1/(2 ζ √(1 − ζ²)) at its peak."""
    damping = 1e-3
    figure = loop.bode(control.tf([1.0], [1.0, 2 * damping, 1.0], name="resonant"), db=False)
    peak = np.max(curve(figure.axes[0], 1)[1])
    assert peak == pytest.approx(1 / (2 * damping * np.sqrt(1 - damping**2)), rel=1e-3)
    (legend,) = figure.legends
    figure.draw(figure.canvas.get_renderer())
    bottom = legend.get_window_extent().y0
    assert all(axes.get_window_extent().y1 <= bottom + 1 for axes in figure.axes)


@pytest.mark.parametrize("end", [0.6, 1.2, 1.4])  # divided by 0.2 s, they are just below a whole number
@pytest.mark.slow
def test_a_sampled_step_response_has_its_last_sample(end):
    figure = drive(0.2).replace({"pi.numerator": [1.0, 0.5]}).linearize().loop("u").step(t=end)
    assert figure.axes[0].lines[0].get_xdata()[-1] == pytest.approx(end, rel=1e-12)


def test_frequencies_beyond_a_sampled_loop_end_at_half_its_sampling_frequency_and_the_figure_says_so(sampled):
    figure = sampled.bode(omega=[200.0, 100.0, 1.0, 10.0, 1.0])  # in any order, one twice
    w, _ = curve(figure.axes[0])
    np.testing.assert_allclose(w, [1.0, 10.0, 100.0, np.pi / 0.02], rtol=2e-6)
    assert w[-1] < np.pi / 0.02
    assert figure.axes[0].get_title(loc="left") == "Ends: L(u) at π/T = 157.1 rad/s"
    assert not sampled.bode(omega=[1.0, 100.0]).axes[0].get_title(loc="left")


def test_the_gang_of_four_goes_to_half_the_sampling_frequency(sampled):
    for axes in sampled.gang_of_four("y").axes:
        assert curve(axes)[0][-1] == pytest.approx(np.pi / 0.02, rel=2e-6)


@pytest.mark.parametrize("kind", ["bode", "nyquist", "nichols"])
def test_frequencies_that_all_lie_beyond_a_sampled_loop_are_refused(sampled, kind):
    with pytest.raises(OptionError, match=r"omega: found .* none below π/T = 157\.08 rad/s"):
        getattr(sampled, kind)(omega=[200.0, 1000.0])


@pytest.mark.slow
def test_a_sampled_loop_is_drawn_up_to_half_its_sampling_frequency_with_the_crossovers_of_its_title(sampled):
    """A fast pole puts ω_180 84 times above ω_c: the curve reaches it, and π/T, and the margin is marked."""
    lag = TransferFunction(numerator=[0.8], denominator=[0.026, 1.0], name="lag")
    pi = TransferFunction(numerator=[0.5, 8.0], denominator=[1.0, 0.0], name="pi")

    @subsystem(sample_time=2e-3, delay=1)
    def controller(y):
        return pi(Constant(value=0.0, name="r") - y)

    slow = Diagram("slow", lag(controller(lag.y).named("u"))).linearize().loop("u")
    crossover = margins(slow).phase_crossovers[-1].frequency.value
    figure = slow.bode()
    w, _ = curve(figure.axes[0])
    assert w[-1] == pytest.approx(np.pi / 2e-3, rel=2e-6)
    assert [x for x, _ in marks(figure.axes[1], "s")] == pytest.approx([crossover])
    continuous = control.tf([1.0], [1.0, 0.0]) * control.tf([1.0], [1 / 300.0, 1.0]) ** 2  # ω_c = 1, ω_180 = 300
    assert curve(sampled.bode(continuous).axes[0], 1)[0][-1] > 800.0


@pytest.mark.parametrize(
    ("ask", "text"),
    [
        (lambda L: L.margins(), r"a loop has no 'margins'\. Write margins\(loop\): from loopwright import margins\."),
        (lambda L: L.nyqist, "Did you mean 'nyquist'"),
        (lambda L: margins(L).gain_margin, "Write margins.gain_margin_high, .* or margins.gain_margin_low"),
        (lambda L: margins(L).phase_margin_degrees, "Did you mean 'phase_margin_deg'"),
    ],
)
def test_names_that_a_loop_or_its_margins_do_not_have_lead_to_those_that_they_have(loop, ask, text):
    with pytest.raises(AttributeError, match=text):
        ask(loop)


def test_printed_margins_begin_with_the_crossovers():
    """|k/(jω (jω τ + 1))| = 1 where ω √(1 + ω² τ²) = k, for k = 2 and τ = 0.1 s."""
    plant = TransferFunction(numerator=[2.0], denominator=[0.1, 1.0, 0.0], name="plant")
    own = Diagram("servo", plant((Constant(value=0.0, name="r") - plant.y).named("u"))).linearize().loop("u")
    omega = np.sqrt((np.sqrt(1.0 + 4.0 * (2.0 * 0.1) ** 2) - 1.0) / (2.0 * 0.1**2))
    phase = 90.0 - np.degrees(np.arctan(0.1 * omega))
    lines = [" ".join(line.split()) for line in str(margins(own)).splitlines()]
    assert f"gain_crossover {omega:.6g} rad/s, phase margin {phase:.6g} deg" in lines
    assert repr(margins(own).gain_crossovers) == (
        f"(<gain crossover at {omega:.6g} rad/s: phase margin {phase:.6g} deg>,)"
    )

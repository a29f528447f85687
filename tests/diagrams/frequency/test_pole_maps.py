"""Root loci and maps of poles against closed forms: every point of a locus fulfils 1 + k L = 0."""

import control
import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, OptionError, TransferFunction, TransportDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.frequency.pole_maps import plot_root_locus
from loopwright.frequency import margins

T = 0.2


def model(sample_time=None, gain=2.0, denominator=(1.0, 3.0, 2.0, 0.0)):
    plant = TransferFunction(numerator=[1.0], denominator=denominator, name="p")

    @subsystem(sample_time=sample_time)
    def controller(y):
        return Gain(gain=gain, name="k")(Constant(value=0.0, name="r") - y).named("u")

    return Diagram("d", plant(controller(plant.y)).named("y")).linearize()


@pytest.fixture(scope="module")
def continuous():
    return model()


def points(axes, marker):
    (line,) = [line for line in axes.lines if line.get_marker() == marker]
    return np.sort_complex(np.asarray(line.get_xdata()) + 1j * np.asarray(line.get_ydata()))


def locus(axes):
    lines = [line for line in axes.lines if line.get_color() == "#0072B2" and line.get_marker() in ("", "None", ".")]
    return np.array([np.asarray(line.get_xdata()) + 1j * np.asarray(line.get_ydata()) for line in lines])


def in_view(axes, z):
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    return (z.real > left) & (z.real < right) & (z.imag > low) & (z.imag < high)


def test_a_locus_is_that_of_the_closed_form(continuous):
    axes = continuous.loop("u").root_locus().axes[0]
    branches = locus(axes)  # of L = 2/(s (s + 1) (s + 2))
    assert len(branches) == 3
    s = branches.ravel()
    gains = -s * (s + 1) * (s + 2) / 2
    assert np.all(np.abs(gains.imag) < 1e-9 * (1 + np.abs(gains)))
    assert gains.real.min() > -1e-9
    steps = np.abs(np.diff(branches, axis=1))
    assert steps[in_view(axes, branches[:, 1:])].max() < 0.1  # smooth
    meet = -1 + 1 / np.sqrt(3)  # where two branches leave the real axis
    assert np.abs(s - meet).min() < 0.02
    assert np.allclose(points(axes, "x"), [-2, -1, 0], atol=1e-9)
    assert np.allclose(points(axes, "s"), np.sort_complex(np.roots([1.0, 3.0, 2.0, 2.0])), atol=1e-9)
    assert np.allclose(points(axes, "d"), [1j * np.sqrt(2)], atol=1e-9)
    assert [t.get_text() for t in axes.texts if t.get_text().startswith("k =")] == ["k = 3 (9.54 dB)"]
    assert axes.get_xlabel() == "Re s [rad/s]"
    assert axes.get_aspect() == 1.0


def test_a_sampled_loop_has_the_unit_circle_in_view():
    axes = model(T, denominator=[1.0, 1.0, 0.0]).loop("u").root_locus().axes[0]
    a = np.exp(-T)  # the plant 1/(s (s + 1)) behind a hold
    numerator, denominator = 2 * np.array([T - 1 + a, 1 - a - T * a]), np.array([1.0, -1 - a, a])
    z = locus(axes).ravel()
    gains = -np.polyval(denominator, z) / np.polyval(numerator, z)
    shown = in_view(axes, z)
    assert np.all(np.abs(gains.imag[shown]) < 1e-6 * (1 + np.abs(gains[shown])))
    assert np.allclose(points(axes, "x"), np.sort([1.0, a]), atol=1e-9)
    assert np.allclose(points(axes, "o"), np.roots(numerator), atol=1e-8)
    limit = (1 - a) / (numerator[1])  # |z| = 1: the product of the poles is a + k n₁
    found = [t.get_text() for t in axes.texts if t.get_text().startswith("k =")]
    assert f"k = {limit:.4g} ({20 * np.log10(limit):.3g} dB)" in found
    circle = [
        line for line in axes.lines if np.allclose(np.hypot(*line.get_data()), 1.0) and len(line.get_xdata()) > 99
    ]
    assert len(circle) == 1
    assert axes.get_xlim()[0] < -1 < 1 < axes.get_xlim()[1]
    assert axes.get_ylim()[0] < -1 < 1 < axes.get_ylim()[1]


def test_gains_that_are_given(continuous):
    branches = locus(continuous.loop("u").root_locus([1.0, 3.0], margins=False).axes[0])
    assert branches.shape == (3, 2)
    assert np.allclose(np.sort_complex(branches[:, 1]), np.sort_complex(np.roots([1.0, 3.0, 2.0, 6.0])), atol=1e-7)


def test_maps_of_poles_and_zeros(continuous):
    axes = continuous.pzmap().axes[0]
    assert np.allclose(points(axes, "x"), np.sort_complex(np.roots([1.0, 3.0, 2.0, 2.0])), atol=1e-9)
    system = control.tf([1.0, 3.0], [1.0, 0.4, 1.0])
    plant = TransferFunction(numerator=[1.0, 3.0], denominator=[1.0, 0.4, 1.0], name="p")
    loop = Diagram("d", plant(-plant.y)).linearize().loop("p")
    axes = loop.pzmap().axes[0]
    assert np.allclose(points(axes, "x"), np.sort_complex(system.poles()), atol=1e-9)
    assert np.allclose(points(axes, "o"), [-3.0], atol=1e-9)
    closed = Diagram("d", plant(Constant(value=0.0, name="r") - plant.y)).linearize(inputs="r", outputs="p")
    assert np.allclose(points(closed.pzmap().axes[0], "o"), [-3.0], atol=1e-9)


@pytest.mark.parametrize(
    ("first", "second", "zeros"),
    [
        (([1.0, 3.0], [1.0, 0.0, 0.0]), ([1.0], [1.0, 0.0]), [-3.0]),  # all poles are at 0
        (([1.0], [1.0, 3.0, 3.0, 1.0]), ([1.0], [1.0, 6.0, 12.0, 8.0]), []),  # three zeros at infinity in each
        (([2.0, 1.0], [1.0, 1.0]), ([1.0, 5.0], [1.0, 2.0, 7.0]), [-5.0, -0.5]),
    ],
)
def test_zeros_at_infinity_are_not_drawn_with_several_channels_either(first, second, zeros):
    a = TransferFunction(numerator=first[0], denominator=first[1], name="a")
    b = TransferFunction(numerator=second[0], denominator=second[1], name="b")
    diagram = Diagram("d", a(Constant(value=0.0, name="u")), b(Constant(value=0.0, name="v")))
    axes = diagram.linearize(inputs=("u", "v"), outputs=("a", "b")).pzmap().axes[0]
    assert np.allclose(points(axes, "o") if zeros else [], zeros, atol=1e-9)
    assert any(line.get_marker() == "o" and len(line.get_xdata()) for line in axes.lines) == bool(zeros)


def test_a_loop_with_dead_time_has_no_locus_but_its_model_has_poles():
    level = Integrator(name="level")
    pipe = TransportDelay(delay=0.5, name="pipe")
    model = Diagram("d", level(pipe(Gain(gain=1.0, name="k")(-level.y)).named("u"))).linearize()
    for draw in (lambda L: L.root_locus(), lambda L: L.pzmap()):
        with pytest.raises(OptionError, match="loop with delays, whose poles are infinitely many"):
            draw(model.loop("u"))
    axes = model.pzmap().axes[0]
    s = points(axes, "x")
    assert np.allclose(s + np.exp(-0.5 * s), 0.0, atol=1e-8)  # the characteristic equation
    assert axes.get_title(loc="right") == "poles of d: the rightmost ones of infinitely many"


def test_a_limit_at_a_large_gain_lies_on_the_locus_and_limits_that_decide_alone_are_named():
    """L = c/(z⁶ (z − 1)) is at its first limit for k c = 2 sin(π/26), and at others for larger gains."""
    late = control.ss(control.tf([1e-5], [1.0, -1.0, 0, 0, 0, 0, 0, 0], 0.1))
    axes = plot_root_locus(late, "late", None, margins(late)).axes[0]
    limits = points(axes, "d")
    assert len(limits) > 2
    assert max(np.abs(locus(axes).ravel() - limit).min() for limit in limits) < 1e-6
    first = 2.0 * np.sin(np.pi / 26) / 1e-5
    named = [t.get_text() for t in axes.texts if t.get_text().startswith("k =")]
    assert named == [f"k = {first:.4g} ({20 * np.log10(first):.3g} dB)"]
    assert "limit of stability" in [text.get_text() for text in axes.figure.legends[0].get_texts()]


def test_a_loop_ahead_of_some_consumers_is_called_by_their_names():
    plant = TransferFunction(numerator=[2.0], denominator=[1.0, 3.0, 2.0, 0.0], name="plant")
    u = (Constant(value=0.0, name="r") - plant.y).named("u")
    loop = (
        Diagram("two", plant(u), Gain(gain=2.0, name="other")(u).named("monitor")).linearize().loop("u", to="plant.u")
    )
    assert loop.name == "L(u to plant_u)"
    assert loop.root_locus().axes[0].get_title(loc="right") == "root locus of L(u to plant_u)"

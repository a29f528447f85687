"""Frequency responses measured on the running diagram, against closed forms and against the linear model.

Every response is one of sampled signals: v, what the wire's port puts out, and u = v + d, what its consumers get.
"""

from fractions import Fraction

import control
import numpy as np
import pytest

from loopwright.blocks import (
    Constant,
    Ellipse,
    Function,
    Gain,
    Integrator,
    OptionError,
    Reference,
    Step,
    UnitDelay,
    WiringError,
)
from loopwright.diagrams import Channel, Diagram, Rig, fig3, subsystem
from loopwright.diagrams.linearization.taps import find_signal
from loopwright.diagrams.measure.injection import compute_phasors, inject_signal, plan_signal, times_of
from loopwright.diagrams.simulation import Simulation
from loopwright.fmus import Fmu, gantry, mass_spring_damper

PATH = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
BAND = np.geomspace(1.0, 150.0, 6)


def continuous_loop():
    """s² + 3 s + 40: L = (3 s + 40)/s² at the command of a double integrator."""
    place, speed = Integrator(name="place"), Integrator(name="speed")
    return Diagram("d", place(speed((-3.0 * speed.y - 40.0 * place.y).named("u"))))


def fig3_loop(xi=0.0, *, friction=True, **rig):
    """Fig. 3 with references that stand still: experiment A at rest."""
    model, start = gantry.nominal, {}
    if not friction:
        model, start = model.replace(coulomb_scale=0.0, viscous_scale=0.0), {"coulomb_scale": 0.0, "viscous_scale": 0.0}
    plant = Fmu(gantry.build(), name="plant", start={**start, "position": PATH.to_plane(0.12, xi)})
    par, perp = (Channel(Reference(v, unit="m", name=n)) for v, n in ((0.12, "eta_d"), (xi, "xi_d")))
    return fig3(plant, PATH, par, perp, model=model, rig=Rig(**rig))


@pytest.mark.slow
def test_a_continuous_loop_has_its_closed_form():
    found = continuous_loop().frequency_response("u", [1.0, 7.0, 30.0], amplitude=0.1, outputs=["place.y"])
    s = 1j * found.omega
    L = (3 * s + 40) / s**2
    for got, want in (
        (found.L, L),
        (found.S, 1 / (1 + L)),
        (found.T, L / (1 + L)),
        (found.response, 1 / (s**2 + 3 * s + 40)),
    ):
        assert isinstance(got, control.FrequencyResponseData)
        np.testing.assert_allclose(got.frdata[0, 0], want, rtol=1e-6)
        np.testing.assert_allclose(got.omega, found.omega)
    assert found.dt == 0
    assert np.all(found.settled)
    assert found.moved <= 1e-6


@pytest.mark.drawn(2)
@pytest.mark.parametrize("kind", ["sine", "multisine", "chirp"])
def test_a_sampled_loop_has_its_closed_form(kind):
    """x⁺ = 0.9 x − 0.3 x: L = 0.3/(z − 0.9)."""

    @subsystem(sample_time=0.01)
    def law():
        x = UnitDelay(initial_value=0.0, name="x")
        return x(0.9 * x.y + Gain(gain=-0.3, name="k")(x.y))

    found = Diagram("d", law()).frequency_response("law.k.y", [2.0, 20.0, 90.0], amplitude=1.0, kind=kind)
    L = 0.3 / (np.exp(1j * found.omega * 0.01) - 0.9)
    np.testing.assert_allclose(found.L.frdata[0, 0], L, rtol=1e-6)
    assert found.L.dt == 0.01
    np.testing.assert_allclose(found.omega, [2.0, 20.0, 90.0], rtol=0.01)


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    "options", [{}, {"xi": 0.03}, {"friction": False}, {"xi": 0.03, "friction": False}, {"delay": 1}], ids=str
)
@pytest.mark.parametrize("wire", ["v_perp", "v_par"])
def test_fig3_answers_an_injection_as_its_linear_model_does(options, wire):
    """The commanded accelerations v_perp and v_par at the ticks of 1 kHz; 1e-3 is asked for, rounding leaves 1e-6."""
    diagram = fig3_loop(**options)
    point = diagram.trim()
    found = diagram.frequency_response(wire, BAND, amplitude=1e-3, at=point)
    model = diagram.linearize(point)
    assert found.compare(model) <= 1e-5
    assert found.compare(model, "S") <= 1e-5
    assert found.compare(model, "T") <= 1e-5
    assert found.moved <= 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multisine", "chirp"])
def test_fig3_answers_other_test_signals_alike(kind):
    diagram = fig3_loop(xi=0.03)
    point = diagram.trim()
    found = diagram.frequency_response("v_perp", BAND, amplitude=1e-3, at=point, kind=kind)
    # at 1 rad/s rounding leaves 1e-4 of a chirp's u from window to window, and less of their mean
    assert np.all(found.deviation(diagram.linearize(point)) <= np.maximum(1e-5, found.uncertainty))
    assert np.sort(found.uncertainty)[-2] < 1e-5
    assert found.uncertainty.max() < 1e-3
    assert np.all(np.isnan(found.distortion)) == (kind == "chirp")


@pytest.mark.slow
def test_both_motor_forces_are_a_matrix():
    diagram = fig3_loop(xi=0.03)
    point = diagram.trim()
    found = diagram.frequency_response("motor_force", BAND[[0, 3, 5]], amplitude=1e-2, at=point)
    assert found.L.frdata.shape == (2, 2, 3)
    assert found.compare(diagram.linearize(point)) <= 1e-5


@pytest.mark.slow
def test_a_wire_out_of_an_fmu_is_one_like_any_other():
    diagram = fig3_loop()
    point = diagram.trim()
    found = diagram.frequency_response("velocity", BAND[[0, 3, 5]], amplitude=1e-6, at=point)
    assert found.compare(diagram.linearize(point)) <= 1e-5


def test_a_drift_is_no_part_of_a_phasor():
    part = next(plan_signal("sine", np.array([20.0]), 1e-3, 1.0))
    k = np.arange(part.samples + 1)
    angle = part.omega[0] * 1e-3 * k
    signal = 3.0 * np.cos(angle) - 4.0 * np.sin(angle) + 0.2 * np.sin(3 * angle) + 5.0 + 0.1 * k
    phasors, rest = compute_phasors(part, signal[:, None])
    np.testing.assert_allclose(phasors, [[3.0 + 4.0j]], rtol=1e-9)
    np.testing.assert_allclose(rest, 0.2 / 5.0, rtol=1e-9)


@pytest.mark.slow
def test_the_velocity_at_the_ticks_is_not_its_fundamental():
    """A mass under held forces: the sampled velocity's phasor differs from the fundamental's by the hold's ripple."""

    @subsystem(sample_time=0.1)
    def law(s, v):
        return Function(lambda s, v: -2.0 * s - 2.0 * v, name="law")(s, v)

    place, speed = Integrator(name="place"), Integrator(name="speed")
    diagram = Diagram("d", place(speed(law(place.y, speed.y).named("u"))))
    found = diagram.frequency_response("u", [8.0], amplitude=1.0, outputs=["speed.y"])
    h, w = 0.1, found.omega[0]
    z = np.exp(1j * w * h)
    u = found.u[0, 0, 0]
    np.testing.assert_allclose(found.y[0, 0, 0] / u, h / (z - 1), rtol=1e-6)  # of the sequence
    fundamental = (1 - 1 / z) / (1j * w * h) / (1j * w)  # zero-order hold, then 1/s
    assert abs(found.y[0, 0, 0] / u / fundamental - 1) > 0.05


@pytest.mark.slow
def test_several_rates_are_measured_over_their_common_period():
    """S and T as in the linear model; a wire that is renewed within the period is no loop for a held signal."""

    @subsystem(sample_time=2e-3, offset=1e-3)
    def slow(y):
        return Gain(gain=-40.0, name="kp")(y)

    @subsystem(sample_time=1e-3)
    def fast(v):
        return Gain(gain=-3.0, name="kd")(v)

    plant = Fmu(mass_spring_damper.build(), name="plant", start={"position": 0.0})
    diagram = Diagram("d", plant(force=(slow(plant.position) + fast(plant.velocity)).named("f")))
    for t in (0.004, 0.005):
        point = diagram.operating_point(t)
        model = diagram.linearize(point)
        found = diagram.frequency_response("f", [3.0, 30.0], amplitude=0.1, at=point)
        assert found.dt == pytest.approx(2e-3)
        assert found.compare(model, "S") <= 1e-5
        assert found.compare(model, "T") <= 1e-5
        assert found.compare(model) == found.compare(model, "S")
        with pytest.raises(OptionError, match="changes between two samples"):
            found.L  # noqa: B018


@pytest.mark.slow
def test_the_estimate_knows_when_the_amplitude_is_too_large():
    """−u³ beside −u: the third harmonic shows as distortion, the smaller amplitude is nearer to the linear model."""

    def loop():
        place = Integrator(name="x")
        return Diagram("d", place(Function(lambda x: -5.0 * x - 5.0 * x**3, name="law")(place.y)))

    diagram = loop()
    model = diagram.linearize()
    small, large = (diagram.frequency_response("law.y", [5.0], amplitude=a) for a in (1e-2, 2.0))
    assert small.distortion[0] < 1e-4 < 1e-2 < large.distortion[0]
    assert small.compare(model) < 1e-4 < 1e-2 < large.compare(model)


@pytest.mark.slow
def test_an_operating_point_that_moves_is_seen():
    ramp = Integrator(name="ramp")(Constant(value=1.0, name="rate"))
    place = Integrator(name="x")
    diagram = Diagram("d", place(Function(lambda x, r: -5.0 * (x - r), name="law")(place.y, ramp)))
    found = diagram.frequency_response("law.y", [5.0], amplitude=1e-2)
    assert found.moved > 1.0
    assert np.all(np.isinf(found.uncertainty))
    assert not found.settled.any()


def cubic(step_at=1e9, back_at=2e9):
    """ẋ = −x³ + u with u = r³ + 2 (r − x): L = 2/(s + 3 r²), and r is 2 between the two times, else 1."""
    x = Integrator(name="x", initial_value=1.0)
    r = Step(times=[step_at, back_at], values=[2.0, 1.0], initial_value=1.0, name="r")
    law = Function(lambda r, x: r**3 + 2.0 * (r - x), name="law")(r, x.y).named("u")
    return Diagram("cubic", x(Function(lambda x, u: -(x**3) + u, name="rate")(x.y, law)))


@pytest.mark.drawn(1)
@pytest.mark.parametrize("step_at", [0.1, 20.0])
def test_a_step_of_a_source_makes_the_uncertainty_infinite(step_at):
    found = cubic(step_at).frequency_response("u", [2.0], amplitude=1e-3)
    w = found.omega[0]
    assert abs(found.L.frdata[0, 0, 0] / (2.0 / (1j * w + 3.0)) - 1.0) > 0.5  # it is that of the other point
    assert found.moved == pytest.approx(0.5, rel=1e-3)  # of 1 + 1
    assert np.isinf(found.uncertainty[0])
    assert not found.settled[0]


@pytest.mark.slow
def test_a_source_that_steps_and_comes_back_is_in_the_uncertainty():
    """The first and the second measurement go over the frequencies in opposite orders."""
    quiet = cubic().frequency_response("u", [2.0, 4.0], amplitude=1e-3)
    assert np.max(quiet.uncertainty) < 1e-5
    windows = 2.0 * np.pi * (quiet.windows + 1) * np.array([16 / 2.0, 16 / 4.0])  # s, with that of the ramp
    found = cubic(0.0, 0.5 * windows[0]).frequency_response("u", [2.0, 4.0], amplitude=1e-3)
    assert np.max(found.uncertainty) > 0.1


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    ("options", "omega"),
    [
        ({"rtol": 1e-6, "atol": 1e-9}, 1.0),
        pytest.param({}, 1.0, marks=pytest.mark.slow),
        pytest.param({"rtol": 1e-8}, 1.0, marks=pytest.mark.slow),
        pytest.param({"rtol": 1e-7}, 7.0, marks=pytest.mark.slow),
    ],
)
def test_the_uncertainty_bounds_the_error_of_the_solver(options, omega):
    found = continuous_loop().frequency_response("u", [omega], amplitude=0.1, **options)
    s = 1j * found.omega
    error = np.abs(found.L.frdata[0, 0] / ((3 * s + 40) / s**2) - 1.0)
    assert np.all(error <= found.uncertainty)
    assert found.uncertainty[0] < 1e-3


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("amplitude", [0.03, 0.3, 1.0])
def test_the_uncertainty_bounds_what_the_amplitude_adds(amplitude):
    """−5 x − 5 x³: by the describing function the slope is 5 + 15/4 a² at the amplitude a of x."""
    place = Integrator(name="x")
    diagram = Diagram("d", place(Function(lambda x: -5.0 * x - 5.0 * x**3, name="law")(place.y)))
    found = diagram.frequency_response("law.y", [5.0], amplitude=amplitude)
    s = 1j * found.omega[0]
    error = abs(found.L.frdata[0, 0, 0] / (5.0 / s) - 1.0)
    a = abs(found.u[0, 0, 0]) * amplitude / abs(s)
    assert error == pytest.approx(0.75 * a * a, rel=0.25)  # 15/4 a² of 5: the harmonics add a little
    assert error <= found.uncertainty[0] < 10 * error + 1e-6
    once = diagram.frequency_response("law.y", [5.0], amplitude=amplitude, confirm=False)
    assert once.uncertainty[0] < error  # the windows alone don't know
    np.testing.assert_array_equal(once.v, found.v)


def test_an_operating_point_of_a_run_and_a_time_are_the_same():
    diagram = fig3_loop()
    run = diagram.simulate(0.2, progress=False)
    a, b, c = (
        diagram.frequency_response("v_perp", [30.0], amplitude=1e-3, at=at)
        for at in (0.2, run.at(0.2), diagram.operating_point(0.2))
    )
    np.testing.assert_array_equal(a.v, b.v)
    np.testing.assert_array_equal(a.v, c.v)


def test_the_injection_leaves_all_other_blocks_where_they_are():
    diagram = fig3_loop()
    flat = diagram.flatten()
    made = inject_signal(diagram.wired, find_signal(flat, "v_perp"), 1, (flat.base, 0 * flat.base))
    assert set(made.diagram.blocks) - set(diagram.blocks) == {made.source, made.sum}
    assert set(made.diagram.names) == set(diagram.names)
    silent = made.diagram.facade.simulate(0.2, progress=False)
    plain = diagram.simulate(0.2, progress=False)
    np.testing.assert_array_equal(silent["position"], plain["position"])


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"frequencies": [0.0]}, OptionError, "positive"),
        ({"frequencies": "slow"}, OptionError, "positive"),
        (
            {"frequencies": [1e4], "step": 1e-3},
            OptionError,
            "expected less than 3141.59 rad.s, as there is a sample every",
        ),
        ({"amplitude": 0.0}, OptionError, "amplitude"),
        ({"kind": "noise"}, OptionError, "'sine'"),
        ({"windows": 1}, OptionError, "at least 2"),
        ({"wire": "place.y", "unwired": True}, WiringError, "found nothing wired to it"),
    ],
)
def test_what_does_not_fit_is_refused(changes, error, text):
    given = {"wire": "u", "frequencies": [1.0], "amplitude": 0.1, **changes}
    diagram = continuous_loop()
    if given.pop("unwired", False):
        diagram = Diagram("d", Integrator(name="place")(Constant(value=0.0)))
    with pytest.raises(error, match=text):
        diagram.frequency_response(**given)


@pytest.mark.parametrize(
    "base", [Fraction(1, 1000), Fraction(7, 3000), Fraction(1, 3 * 10**9), Fraction(2**40 + 1, 2**60)]
)
def test_times_of_ticks_are_rounded_once(base):
    for ticks in (range(400), range(12_345, 20_000, 7), range(10**9, 10**9 + 5)):
        expected = [float(k * base) for k in ticks]  # a fraction becomes a float by one rounding
        assert times_of(ticks, base).tolist() == expected


def test_records_check_no_argument_at_each_sample(monkeypatch):
    monkeypatch.setattr(Simulation, "time_of", lambda *_: pytest.fail("asked at each sample"))
    found = continuous_loop().frequency_response("u", [20.0], amplitude=1e-3, windows=2, confirm=False)
    assert found.S.frdata.item() == pytest.approx(1.0 / (1.0 + (60j + 40.0) / -400.0), rel=1e-3)

"""Target and rendered admittance: closed forms, the running co-simulation, and the sign of the real part."""

import math
import re

import control
import numpy as np
import pytest

from loopwright.blocks import Circle, Ellipse, HandForce, OptionError, Step
from loopwright.diagrams import (
    passivity,
    rendered_admittance,
    rendered_response,
    rendered_system,
    stability_limit,
    target_admittance,
)
from support.contact import FREE, MIDDLE, ROUGH, SMOOTH, deviation, diagram, loop, moored_start

SIDE = pytest.mark.parametrize("side", ["par", "perp"])
OMEGA = np.geomspace(0.01, 2000.0, 60)
ELLIPSE = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))


def inner(model):
    """Numerator and denominator of the inner loop's T(s)."""
    pid = model.pid
    return [pid.a2, pid.a1, pid.a0], [1.0, pid.a2, pid.a1, pid.a0]


def filtered(model):
    """m s² + d s + k."""
    a = model.admittance
    return [a.mass, a.effective_damping, a.stiffness]


# --- continuous, in closed form --------------------------------------------------------------------------------------


@SIDE
@pytest.mark.parametrize("plant", [SMOOTH, ROUGH], ids=["smooth", "rough"])
@pytest.mark.parametrize("implementation", ["ideal", "continuous"])
@pytest.mark.drawn(4)
def test_a_matched_continuous_loop_renders_the_target(side, plant, implementation):
    model = loop(side, plant, implementation=implementation)
    np.testing.assert_allclose(rendered_admittance(model, OMEGA), target_admittance(model, OMEGA), rtol=1e-11)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("side", "factor"), [("par", 1.0 + 0.025 / 0.075), ("perp", 1.0)])
def test_off_the_path_motion_along_it_is_rendered_q_times_as_fast(side, factor):
    # E22: at theta = 0 the curvature is 1/0.075 m; outside by 25 mm q = 4/3, m, d and k appear divided by it
    model = loop(side, path=ELLIPSE, eta=0.0, xi=-0.025, implementation="continuous")
    m, d, k = filtered(model)
    s = 1j * OMEGA
    want = s / ((m * s**2 + d * s + k) / factor)
    np.testing.assert_allclose(target_admittance(model, OMEGA), want, rtol=1e-12)
    np.testing.assert_allclose(rendered_admittance(model, OMEGA), want, rtol=1e-11)


@SIDE
def test_without_feed_forward_the_inner_loop_shows(side):
    model = loop(side, implementation="continuous", feed_forward=0.0)
    s, (num, den) = 1j * OMEGA, inner(model)
    want = s * np.polyval(num, s) / np.polyval(den, s) / np.polyval(filtered(model), s)
    np.testing.assert_allclose(rendered_admittance(model, OMEGA), want, rtol=1e-10)


@SIDE
@pytest.mark.parametrize("share", [0.0, 0.5, 36.87])
@pytest.mark.drawn(2)
def test_force_that_is_not_cancelled_moves_the_error_dynamics(side, share):
    # M (p̈ − ë) = … − M (a2 ṗ_e + …) + (1 − β) F: what is left of F meets the stiffness of the error dynamics
    model = loop(side, implementation="continuous", cancelled=share)
    s, (_, den) = 1j * OMEGA, inner(model)
    M = SMOOTH.mass[("par", "perp").index(side)]
    want = s / np.polyval(filtered(model), s) + s * (1.0 - share) / M * s / np.polyval(den, s)
    np.testing.assert_allclose(rendered_admittance(model, OMEGA), want, rtol=1e-9)


@SIDE
def test_a_tool_adds_its_mass_to_the_target(side):
    # (M − m_tool) a = (M/m) (F − m_tool a − d ė − k e) where the loop is matched: solved for a with w = e
    tool = 0.3
    ideal = loop(side, implementation="ideal", tool_mass=tool)
    m, d, k = filtered(ideal)
    s = 1j * OMEGA
    np.testing.assert_allclose(rendered_admittance(ideal, OMEGA), s / ((m + tool) * s**2 + d * s + k), rtol=1e-12)
    real = loop(side, implementation="continuous", tool_mass=tool)
    M, (_, den) = SMOOTH.mass[("par", "perp").index(side)], inner(real)
    # p = E/(m s² + d s + k) (F − m_tool s² p) + m_tool s² p s/(M (s³ + …))
    on_error = tool / M * s**3 / np.polyval(den, s)
    want = s / np.polyval(filtered(real), s) / (1.0 + tool * s**2 / np.polyval(filtered(real), s) - on_error)
    np.testing.assert_allclose(rendered_admittance(real, OMEGA), want, rtol=1e-9)


def test_the_state_space_of_a_continuous_loop_is_the_rendered_admittance():
    model = loop(implementation="continuous", tool_mass=0.2, plant=ROUGH)
    system = rendered_system(model)
    assert isinstance(system, control.StateSpace)
    assert system.dt == 0
    assert (system.input_labels, system.output_labels) == (["F_perp"], ["velocity_perp"])
    assert system.state_labels == ["p_perp", "velocity_perp", "integral_perp", "e_perp", "e_rate_perp"]
    np.testing.assert_allclose(system(1j * OMEGA), rendered_admittance(model, OMEGA), rtol=1e-9)


def test_the_response_is_an_object_of_python_control():
    response = rendered_response(loop(), OMEGA)
    assert isinstance(response, control.FrequencyResponseData)
    assert (response.input_labels, response.output_labels) == (["F_perp"], ["velocity_perp"])
    np.testing.assert_array_equal(response.complex, rendered_admittance(loop(), OMEGA))


# --- sampled ---------------------------------------------------------------------------------------------------------


@SIDE
@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("method", ["exact", "semi_implicit"])
@pytest.mark.slow
def test_sampling_costs_the_first_order_in_the_sample_time(side, delay, method):
    omega = np.geomspace(0.1, 60.0, 20)
    target = target_admittance(loop(side), omega)
    times = np.array([1e-4, 5e-5, 2.5e-5])
    errors = [
        np.abs(rendered_admittance(loop(side, delay=delay, method=method, sample_time=T), omega) / target - 1.0).max()
        for T in times
    ]
    assert np.polyfit(np.log(times), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.1)


LOOPS = {
    "d0": {},
    "along, d1": {"side": "par", "delay": 1},
    "tool": {"tool_mass": 0.5},
    "less friction than compensated": {"model": ROUGH, "plant": ROUGH.replace(coulomb_scale=0.9)},
}


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("hertz", [1.0, 10.0, 60.0])
def test_the_fundamental_is_that_of_the_running_co_simulation(name, hertz):
    # A sine force inside the FMU. Velocities that are looked at n times a sample contain the aliases, like 1/n²:
    # taken from n = 1 and n = 10, the fundamental is left.
    model, amplitude, omega = loop(**LOOPS[name]), 1e-3, 2.0 * np.pi * hertz
    start = moored_start(model, 0.0) | {"amplitude": amplitude, "frequency": omega}
    run = diagram(model, start).simulate(7.0, step=1e-4, progress=False)
    last = slice(-10001, -1)  # one second: transients have fallen by exp(−2.7 · 6) or more
    velocity, t = deviation(model, run, "velocity")[last], run.t[last]
    fine, coarse = (
        2j * np.mean(velocity[::n] * np.exp(-1j * omega * t[::n])) / amplitude for n in (1, 10)
    )  # of sin, the phasor is −j
    want = rendered_admittance(model, omega)
    assert abs(coarse / want - 1.0) > 3e-6 * hertz  # the aliases are there
    assert abs((fine + (fine - coarse) / 99.0) / want - 1.0) < 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_the_discrete_system_is_that_of_a_held_force(name):
    model = loop(**LOOPS[name])
    force = Step(times=1e-3, values=1e-5, unit="N")

    def hand(position):
        return HandForce(model.path)(position, **{f"f_{model.side}": force})

    run = diagram(model, moored_start(model, 0.0), environment=hand).simulate(1.0, progress=False)
    system = rendered_system(model)
    assert system.dt == 1e-3
    held = np.where(np.arange(len(run.t)) >= 1, 1e-5, 0.0)
    want = control.forced_response(system, T=run.t, inputs=held).outputs
    np.testing.assert_allclose(deviation(model, run, "velocity"), want, atol=1e-8 * np.abs(want).max())


def test_a_force_on_both_sides_of_nyquist_is_refused():
    with pytest.raises(OptionError, match=re.escape("below the Nyquist frequency 3141.59 rad/s")):
        rendered_admittance(loop(), [1.0, math.pi / 1e-3])
    with pytest.raises(OptionError, match="expected them positive"):
        rendered_admittance(loop(implementation="continuous"), 0.0)


# --- passivity -------------------------------------------------------------------------------------------------------


@SIDE
def test_a_matched_continuous_loop_is_passive(side):
    found = passivity(loop(side, ROUGH, implementation="continuous"))
    assert found.frequency == math.inf
    assert found.intervals == ()
    assert found.stable
    assert "of it alone" in found.caveat


@SIDE
def test_without_feed_forward_passivity_ends_where_the_polynomial_says(side):
    # Re Y = 0 where Re(s N(s) conj(D(s))) = 0 at s = jω, a polynomial in ω
    model = loop(side, implementation="continuous", feed_forward=0.0)
    num, den = inner(model)
    at_jw = [np.polymul(num, [1.0, 0.0]), np.polymul(den, filtered(model))]
    turned = [np.array(c, complex) * 1j ** np.arange(len(c))[::-1] for c in at_jw]
    real = np.polymul(turned[0], turned[1].conj()).real
    roots = np.roots(real)
    want = min(r.real for r in roots if abs(r.imag) < 1e-9 * abs(r) and r.real > 1e-6)
    found = passivity(model)
    assert found.frequency == pytest.approx(want, rel=1e-9)
    assert found.intervals == ((found.frequency, 1e5),)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.drawn(1)
def test_a_sampled_loop_is_not_passive_and_a_spring_at_that_frequency_is_the_limit(name):
    # where Y = jB, the spring k = −ω/B oscillates undamped with it; the aliases shift that by 1e-6
    model = loop(**LOOPS[name])
    found, limit = passivity(model), stability_limit(model)
    Y = rendered_admittance(model, found.frequency)
    assert abs(Y.real) < 1e-8 * abs(Y)
    assert limit.frequency == pytest.approx(found.frequency, rel=1e-5)
    assert limit.value == pytest.approx(-found.frequency / Y.imag, rel=1e-5)
    assert "disproves passivity" in found.caveat
    assert "doesn't prove it" in found.caveat


def test_the_intervals_are_where_the_real_part_is_negative():
    found = passivity(loop("par", delay=1))
    (low, high), top = found.intervals[0], found.scanned[1]
    assert (found.frequency, top) == (low, pytest.approx(math.pi / 1e-3, rel=1e-6))
    for omega, negative in ((0.99 * low, False), (1.01 * low, True), (0.99 * high, True), (1.01 * high, False)):
        assert (rendered_admittance(loop("par", delay=1), omega).real < 0.0) is np.bool_(negative)


@pytest.mark.slow
def test_off_the_path_the_caveat_names_the_conjugate_force():
    circle = Circle(radius=0.2)
    assert "q F∥" in passivity(loop("par", SMOOTH, path=circle, eta=0.0, xi=0.02)).caveat
    assert "q F∥" not in passivity(loop("par", SMOOTH, path=circle, eta=0.0)).caveat
    assert "q F∥" not in passivity(loop("perp", SMOOTH, path=circle, eta=0.0, xi=0.02)).caveat
    assert "q F∥" not in passivity(loop("par", SMOOTH, eta=MIDDLE)).caveat


def test_equal_axes_render_the_same_everywhere():
    # with one mass and one friction for both axes, nothing couples the directions, and the angle does not matter
    equal = ROUGH.replace(translational_mass=(7.0, 7.0), equivalent_mass=(20.0, 20.0), **FREE)
    turned = loop("perp", equal, path=ELLIPSE, eta=0.2)
    assert turned.directions == ("perp",)
    np.testing.assert_allclose(
        rendered_admittance(turned, OMEGA), rendered_admittance(loop("perp", equal), OMEGA), rtol=1e-9
    )

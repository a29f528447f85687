"""Derivatives of a loop's linear model by parameters of the diagram."""

import numpy as np
import pytest

from loopwright.blocks import PID, Constant, Gain, Integrator, ParameterError
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.linearization import differentiate_loop
from support.tuned_loops import Tank

T = 0.05


def make_lag(rate=3.0, kp=2.0, ki=1.5, sample_time=T, method=None):
    """A lag of first order under a PI controller."""
    state, speed = Integrator(name="x"), Gain(gain=rate, name="rate")

    @subsystem(sample_time=sample_time)
    def controller(r, y):
        return PID(kp=kp, ki=ki, name="pid")(r=r, y=y)

    u = controller(Constant(value=0.0, name="r"), state.y).named("u")
    return Diagram("lag", state(speed(u - state.y)))


def make_tank(outlet=0.7, area=2.0, level=1.44, sample_time=None):
    tank = Tank(outlet=outlet, area=area, start=level, name="tank")

    @subsystem(sample_time=sample_time)
    def controller(r, y):
        return PID(kp=3.0, ki=1.0, name="pid")(r=r, y=y)

    u = controller(Constant(value=level, name="r"), tank.level).named("u")
    return Diagram("tank", tank(inflow=u))


def slopes_by(model, wire, *names, **options):
    return {one.parameter: one for one in differentiate_loop(model, [wire], names, **options)}


def at_change(make, wire, h, **options):
    """Return A, B, C, D of the loop by differences of fourth order, over changed values that ``make`` makes."""
    four = []
    for s in (1.0, -1.0, 2.0, -2.0):
        L = make(s * h).linearize(**options).loop(wire)
        four.append((L.A, L.B, L.C, L.D))
    return [(8 * (a - b) - (c - d)) / (12 * h) for a, b, c, d in zip(*four, strict=True)]


def test_a_held_lag_has_the_slope_of_its_exponential():
    model = make_lag().linearize()
    found = slopes_by(model, "u", "rate.gain")["rate.gain"]
    i = model.states.index("x.y")
    decay = np.exp(-3.0 * T)
    assert found.is_exact
    assert found.matrices[0][i, i] == pytest.approx(decay, rel=1e-14)
    assert found.slopes[0][i, i] == pytest.approx(-T * decay, rel=1e-13)
    assert found.slopes[1][i, 0] == pytest.approx(T * decay, rel=1e-13)


def test_the_same_lag_in_continuous_time_has_slopes_of_its_equations():
    model = make_lag(sample_time=None).linearize()
    found = slopes_by(model, "u", "rate.gain", "pid.kp", "pid.ki")
    i, j = (model.states.index(name) for name in ("x.y", "controller.pid.integral"))
    assert found["rate.gain"].slopes[0][i, i] == pytest.approx(-1.0, rel=1e-13)
    assert found["rate.gain"].slopes[1][i, 0] == pytest.approx(1.0, rel=1e-13)
    assert found["controller.pid.kp"].slopes[2][0, i] == pytest.approx(1.0, rel=1e-13)  # L = −(returning)/(injected)
    assert found["controller.pid.ki"].slopes[0][j, i] == pytest.approx(-1.0, rel=1e-13)


@pytest.mark.parametrize("sample_time", [None, T])
def test_an_equilibrium_follows_its_reference(sample_time):
    """The tank's pole −c/(2 A √r) moves with the reference r, by c/(4 A r^1.5); with the outlet c by −1/(2 A √r)."""
    outlet, area, level = 0.7, 2.0, 1.44
    diagram = make_tank(outlet, area, level, sample_time)
    model = diagram.linearize(diagram.trim())
    assert model.is_equilibrium
    i = model.states.index("tank.h")
    pole = -outlet / (2 * area * np.sqrt(level))
    by_level, by_outlet = outlet / (4 * area * level**1.5), -1 / (2 * area * np.sqrt(level))
    factor = 1.0 if sample_time is None else T * np.exp(pole * T)
    found = slopes_by(model, "u", "r.value", "tank.outlet")
    assert found["r.value"].slopes[0][i, i] == pytest.approx(factor * by_level, rel=1e-9)
    assert found["tank.outlet"].slopes[0][i, i] == pytest.approx(factor * by_outlet, rel=1e-9)
    assert not found["r.value"].rest_lost


@pytest.mark.slow
def test_a_point_that_is_found_anew_gives_the_slopes_of_the_equilibrium():
    diagram = make_tank()
    model = diagram.linearize(diagram.trim())
    followed = slopes_by(model, "u", "r.value", "tank.area")
    found = slopes_by(model, "u", "r.value", "tank.area", find=lambda d: d.facade.trim())
    for name, one in followed.items():
        assert not one.rest_lost
        error = found[name].errors[0].max()
        assert error <= 1e-5
        assert found[name].slopes[0] == pytest.approx(one.slopes[0], abs=1e-9 + error)


def test_a_rest_that_ends_with_a_parameter_is_told():
    level, inflow = Integrator(name="level"), Constant(value=0.0, name="inflow")
    controller = Gain(gain=0.0, name="none")
    u = (controller(level.y)).named("u")
    diagram = Diagram("drift", level(inflow + u))
    model = diagram.linearize(diagram.operating_point())
    found = slopes_by(model, "u", "inflow.value")["inflow.value"]
    assert found.rest_lost


@pytest.mark.slow
def test_a_moving_point_within_the_period_is_differentiated_along_its_motion():
    """Against differences of whole linear models, at an instant at which nothing rests."""

    def make(change):
        return make_tank(outlet=0.7 + change, level=1.44, sample_time=T)

    model = make_tank(level=1.44, sample_time=T).replace({"r.value": 2.0}).linearize(0.2)
    changed = at_change(lambda c: make(c).replace({"r.value": 2.0}), "u", 1e-3, at=0.2)
    found = slopes_by(model, "u", "tank.outlet", find=lambda d: d.facade.operating_point(0.2))["tank.outlet"]
    for mine, other in zip(found.slopes, changed, strict=True):
        assert mine == pytest.approx(other, abs=2e-8 * max(1.0, np.abs(other).max(initial=0.0)))


def test_a_parameter_of_zero_has_a_slope_too():
    """A trace takes an exact zero for structure; its slope is that of L by the derivative's gain nevertheless."""
    model = make_lag(kp=0.0).linearize()
    found = slopes_by(model, "u", "pid.kp")["controller.pid.kp"]
    i = model.states.index("x.y")
    assert found.value == 0.0
    assert found.slopes[2][0, i] == pytest.approx(1.0, rel=1e-12)


@pytest.mark.slow
def test_an_fmus_friction_has_the_slope_of_its_exponential():
    """At rest the gantry's axis decays by d = (d_v + F_c s/w)/m; over a step e^(−d T) falls with s by T F_c/(w m)."""
    experiment = experiments.compliance()
    model = experiment.diagram.linearize()
    variables = experiment.diagram.blocks["plant"].description.variables
    mass, coulomb, viscous = (
        np.asarray(variables[name].start, dtype=float)
        for name in ("translational_mass", "coulomb_friction", "viscous_friction")
    )
    found = slopes_by(model, "motor_force", "plant.start.coulomb_scale")["plant.start.coulomb_scale"]
    mass = mass + np.asarray(variables["equivalent_mass"].start, dtype=float)
    decay = np.exp(-(viscous + coulomb / 0.01) / mass * model.dt)
    expected = -model.dt * coulomb / (0.01 * mass) * decay
    where = [i for i, name in enumerate(model.states) if name.startswith("plant.velocity")]
    assert [found.matrices[0][i, i] for i in where] == pytest.approx(decay.tolist(), rel=1e-10)
    for i, slope in zip(where, expected, strict=True):
        assert abs(found.slopes[0][i, i] - slope) <= max(1e-9, found.errors[0][i, i])
    assert not found.is_exact


def test_structure_and_unknown_names_are_refused():
    model = make_lag().linearize()
    with pytest.raises(ParameterError, match="expected numbers"):
        slopes_by(model, "u", "pid.anti_windup")

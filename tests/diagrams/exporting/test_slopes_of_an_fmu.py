"""Directional and adjoint derivatives of exported diagrams (FMI 2.0, 2.1.9; FMI 3.0, 2.2.11)."""

import fmpy.validation
import numpy as np
import pytest

from loopwright import Fmu, build
from loopwright.blocks import PID, Constant, Function, Gain, Integrator, Sine, Sum, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from support import exported_diagrams
from support.instances import Instance3, open_instance

FMI = (2, 3)


@subsystem
def pendulum(torque):
    """dω/dt = torque − 9.81 sin θ − 0.5 ω, with its height 1 − cos θ."""
    omega, theta = Integrator(name="omega"), Integrator(name="theta")
    theta(omega.y)
    fall = Gain(gain=9.81, name="gravity")(Function(np.sin, name="sine")(theta.y))
    omega(Sum(signs="+--")(torque, fall, Gain(gain=0.5, name="friction")(omega.y)))
    height = Sum(signs="+-")(Constant(value=1.0), Function(np.cos, name="cosine")(theta.y))
    return {"angle": theta.y, "height": height}


def test_the_linear_model_of_what_is_built_is_that_of_the_diagram():
    """Oracle: the companion form of 2/(s² + 0.6 s + 4); by the FMU's own derivatives, without differences."""

    @subsystem
    def plant(u):
        return TransferFunction(numerator=[2.0], denominator=[1.0, 0.6, 4.0], name="p")(u).named("y")

    found = Fmu(build(plant), name="plant").linear_model(exact=True)
    assert sorted(np.linalg.eigvals(found.A).imag) == pytest.approx([-np.sqrt(3.91), np.sqrt(3.91)], rel=1e-13)
    assert -found.C @ np.linalg.solve(found.A, found.B) == pytest.approx(0.5, rel=1e-13)
    assert found.D == 0.0
    s = 1j * 1.7
    transfer = (found.C @ np.linalg.solve(s * np.eye(2) - found.A, found.B))[0, 0]
    assert transfer == pytest.approx(2.0 / (s**2 + 0.6 * s + 4.0), rel=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_a_nonlinear_diagram_has_the_slopes_of_its_equations(fmi):
    file = build(pendulum, fmi=fmi)
    assert fmpy.validation.validate_fmu(str(file)) == []
    fmu = Fmu(file, name="fmu")
    names = list(fmu.description.states)
    theta = 0.7
    at = {n: theta if n.startswith("theta") else 0.3 for n in names}
    found = fmu.linear_model(state=at, inputs={"torque": 0.2}, exact=True)
    i, j = (next(k for k, n in enumerate(found.states) if n.startswith(label)) for label in ("theta", "omega"))
    expected = np.zeros((2, 2))
    expected[i, j], expected[j, i], expected[j, j] = 1.0, -9.81 * np.cos(theta), -0.5
    np.testing.assert_allclose(found.A, expected, rtol=1e-14)
    assert found.B[j, 0] == 1.0
    rows = {name: k for k, name in enumerate(found.outputs)}
    assert found.C[rows["height"], i] == pytest.approx(np.sin(theta), rel=1e-14)
    assert found.f[j] == pytest.approx(0.2 - 9.81 * np.sin(theta) - 0.15, rel=1e-14)
    own = Diagram("own", pendulum(Constant(value=0.2, name="torque"))).linearize()
    start = fmu.linear_model(inputs={"torque": 0.2})
    np.testing.assert_allclose(np.poly(start.A), np.poly(own.A), rtol=1e-13)


@pytest.mark.slow
def test_the_adjoint_is_the_transpose(tmp_path):
    item = open_instance(build(pendulum), tmp_path)
    states = ["omega.y", "theta.y"]
    item.initialize(**dict(zip(states, (0.4, -0.2), strict=True)), torque=0.1)
    knowns = [*states, "torque", "gravity.gain", "time"]
    unknowns = ["angle", "height", *(f"der({n})" for n in states)]
    J = np.array([[item.directional(u, k, [1.0])[0] for k in knowns] for u in unknowns])
    np.testing.assert_allclose([[item.adjoint(u, k, [1.0])[0] for k in knowns] for u in unknowns], J, rtol=1e-15)
    theta = item[next(n for n in states if n.startswith("theta"))]
    gravity = J[2 + states.index(next(n for n in states if n.startswith("omega"))), knowns.index("gravity.gain")]
    assert gravity == pytest.approx(-np.sin(theta), rel=1e-14)
    assert not J[:, -1].any()
    item.free()


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_slopes_at_the_start_include_what_is_computed_there(fmi, tmp_path):
    """The filter of D begins with the level, so that u = kp (r − y) at the start; afterwards u moves with kd/T_f, too."""

    @subsystem(sample_time=0.01)
    def controller(reference, level):
        return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")

    item = open_instance(build(controller, fmi=fmi), tmp_path)
    enter = {} if fmi == 2 else {"startTime": 0.0}
    item["reference"], item["level"] = 1.0, 0.3
    if fmi == 2:
        item.fmu.setupExperiment(startTime=0.0)
    item.fmu.enterInitializationMode(**enter)
    assert item.directional("effort", "level", [1.0])[0] == pytest.approx(-2.0, rel=1e-14)
    assert item.directional("effort", "reference", [1.0])[0] == pytest.approx(2.0, rel=1e-14)
    assert item.directional("effort", "pid.kp", [1.0])[0] == pytest.approx(0.7, rel=1e-14)
    h, base = 1e-6, item["effort"]
    item["level"] = 0.3 + h
    assert (item["effort"] - base) / h == pytest.approx(-2.0, rel=1e-8)
    item.fmu.exitInitializationMode()
    assert item.directional("effort", "level", [1.0])[0] == pytest.approx(-2.0 - 0.1 / 0.02, rel=1e-14)
    item.step(0.0, 0.005)  # between two ticks it is held
    assert item.directional("effort", "level", [1.0])[0] == 0.0
    item.step(0.005, 0.005)
    assert item.directional("effort", "reference", [2.0])[0] == pytest.approx(4.0, rel=1e-14)
    item.free()


@pytest.mark.slow
def test_slopes_by_a_parameter_go_through_what_is_computed_from_it(tmp_path):
    """After a jump of the level by Δ, D = −kd Δ/T_f at the tick: its slope by T_f is kd Δ/T_f², by kd −Δ/T_f."""

    @subsystem(sample_time=0.01)
    def controller(reference, level):
        return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")

    item = open_instance(build(controller), tmp_path).initialize()
    item["level"] = 0.25
    assert item.directional("effort", "pid.filter_time", [1.0])[0] == pytest.approx(0.1 * 0.25 / 0.02**2, rel=1e-12)
    assert item.directional("effort", "pid.kd", [1.0])[0] == pytest.approx(-0.25 / 0.02, rel=1e-12)
    both = item.adjoint("effort", "pid.filter_time", [1.0])[0]
    assert both == pytest.approx(0.1 * 0.25 / 0.02**2, rel=1e-12)
    item.free()


@pytest.mark.slow
def test_in_event_mode_slopes_are_those_of_the_active_tick(tmp_path):
    item = Instance3(build(exported_diagrams.controller, clocks=True), tmp_path, eventModeUsed=True)
    item.initialize(wanted=1.0)
    assert item.directional("effort", "level", [1.0])[0] == 0.0
    item.fmu.setClock([item.references["clock"]], [True])
    assert item.directional("effort", "level", [1.0])[0] == -2.0
    item.fmu.updateDiscreteStates()
    assert item.directional("effort", "level", [1.0])[0] == 0.0
    item.free()


@pytest.mark.slow
@pytest.mark.parametrize("make", [exported_diagrams.sampled, exported_diagrams.continuous])
def test_rates_are_what_the_states_do(make, tmp_path):
    """Derivatives of states and outputs by time, against differences of short steps."""
    file = build(make(), tolerance=1e-12)
    item = open_instance(file, tmp_path).initialize()
    rates = [n for n in item.references if n.startswith("der(")]
    assert bool(rates) == (make is exported_diagrams.continuous)
    h = 1e-6
    for name in rates:
        state = name[4:-1]
        before, rate = np.ravel(item[state]), np.ravel(item[name])
        item.step(0.0, h)
        np.testing.assert_allclose((np.ravel(item[state]) - before) / h, rate, rtol=1e-5)
    item.free()


@pytest.mark.slow
def test_what_has_no_slopes_says_so(tmp_path):
    """With an algebraic loop, which C code solves, the flag is false and the function is refused."""

    total = Sum(signs="+-", name="total")
    made = total(Constant(value=0.0, name="u"), Gain(gain=0.5)(total.y)).named("y")
    looped = Diagram("looped", made, loops="solve")
    for fmi in FMI:
        about = fmpy.read_model_description(str(build(looped, outside=["u"], fmi=fmi)))
        assert not about.coSimulation.providesDirectionalDerivative
        assert not getattr(about.coSimulation, "providesAdjointDerivatives", False)
    item = open_instance(build(looped, outside=["u"]), tmp_path).initialize(u=3.0)
    assert item["y"] == pytest.approx(2.0, rel=1e-12)
    with pytest.raises(Exception, match="fmi3GetDirectionalDerivative failed"):
        item.directional("y", "u", [1.0])
    item.free()


@pytest.mark.slow
def test_what_depends_on_nothing_that_is_known_is_listed_so():
    """A source in continuous time depends on time alone; a rate lists its own input."""

    @subsystem
    def driven(u):
        return Sum(signs="++")(Integrator(name="x")(u), Sine(frequency=1.0, name="sine")()).named("y")

    about = fmpy.read_model_description(str(build(driven)))
    outputs = {one.variable.name: [v.name for v in one.dependencies] for one in about.outputs}
    assert "time" in outputs["y"]
    assert any(n.startswith("x.") for n in outputs["y"])
    assert "u" not in outputs["y"]
    (rate,) = about.derivatives
    assert [v.name for v in rate.dependencies] == ["u"]

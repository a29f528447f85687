"""The integrators of exported FMUs: their order, error control, stiff models, and states in the middle of a run."""

from dataclasses import replace

import casadi as ca
import fmpy
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks.core.errors import DefinitionError, ParameterError
from loopwright.fmus import build_fmu
from support.exported import D, K, M, driven, exact, explosive, mass_spring_damper, unbound, van_der_pol
from support.instances import fails

RK4, DOPRI5, RODAS = 1, 2, 3


def truth(f, x0, times, method="DOP853", rtol=1e-13, **options):
    return solve_ivp(f, (times[0], times[-1]), x0, method, times, rtol=rtol, atol=1e-14, **options).y.T


def driven_rhs(t, x, u=0.3):
    return [-x[0] * x[1] + np.sin(3 * t) + u, x[0] - x[1] ** 3 - 0.5 * x[1] * np.cos(t)]


def errors_by_step(item, counts, horizon, reference, **start):
    """Errors after `horizon` in n equal steps, behind a first second in which the step size grows."""
    names, found = ("x", "y") if "x" in item.references else ("position", "velocity"), []
    for n in counts:
        item.fmu.reset()
        item.initialize(internal_step=10.0, **start)
        item.step(0.0, 0.5)
        item.step(0.5, 0.5)
        x0 = [item[name] for name in names]
        for k in range(n):
            item.step(1.0 + k * horizon / n, horizon / n)
        found.append(np.abs(np.array([item[name] for name in names]) - reference(x0)).max())
    return found


@pytest.mark.parametrize(
    ("integrator", "order", "counts"),
    [(RK4, 4, (8, 12, 16, 24, 32)), (DOPRI5, 5, (8, 12, 16, 24)), (RODAS, 4, (16, 24, 32, 48))],
)
def test_order_on_a_linear_model(instance, integrator, order, counts):
    item = instance(build_fmu(unbound(mass_spring_damper())))
    errors = errors_by_step(item, counts, 2.0, lambda x0: exact(2.0, x0, 5.0), integrator=integrator, force=5.0)
    measured = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert measured == pytest.approx(order, abs=0.2), errors


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [RK4, RODAS])
def test_order_where_time_enters_a_nonlinear_model(instance, integrator):
    """Rosenbrock methods lose order here if the derivative by time is wrong; for DOPRI5, see the tolerances below."""
    item, counts = instance(build_fmu(unbound(driven()))), (8, 12, 16, 24, 32)
    errors = errors_by_step(
        item, counts, 1.2, lambda x0: truth(driven_rhs, x0, (1.0, 2.2))[-1], integrator=integrator, u=0.3
    )
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] == pytest.approx(4.0, abs=0.2), errors


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [DOPRI5, RODAS])
def test_the_error_follows_the_tolerance(instance, integrator):
    item, reference = instance(build_fmu(driven())), truth(driven_rhs, [1.0, 0.5], (0.0, 5.0))[-1]
    tolerances, errors = 10.0 ** -np.arange(4, 12), []
    for tolerance in tolerances:
        item.fmu.reset()
        item.initialize(integrator=integrator, u=0.3, tolerance=tolerance)
        item.step(0.0, 5.0)
        errors.append(np.abs(np.array([item["x"], item["y"]]) - reference).max())
    assert all(error < 5.0 * tolerance for error, tolerance in zip(errors, tolerances, strict=True)), errors
    assert 0.8 < np.polyfit(np.log(tolerances), np.log(errors), 1)[0] < 1.3, errors


@pytest.mark.slow
@pytest.mark.parametrize(("tolerance", "end"), [(1e-6, 900.0), (1e-6, 2000.0), (1e-8, 2000.0), (1e-10, 2000.0)])
def test_a_stiff_model_against_radau(instance, tolerance, end):
    """Van der Pol, mu = 1000: in 2000 s two periods and a half, through six layers of width 1/mu."""
    item = instance(build_fmu(van_der_pol()))
    item.initialize(tolerance=tolerance)
    times = np.arange(0.0, end + 50.0, 100.0)
    reference = truth(
        lambda t, x: [x[1], 1000.0 * (1.0 - x[0] ** 2) * x[1] - x[0]],
        [2.0, 0.0],
        times,
        "Radau",
        1e-10,
        jac=lambda t, x: [[0.0, 1.0], [-2000.0 * x[0] * x[1] - 1.0, 1000.0 * (1.0 - x[0] ** 2)]],
    )
    for t, (x, v) in zip(times[:-1], reference[1:], strict=True):
        item.step(t, 100.0)
        scale = 1.0 + 1000.0 * abs(1.0 / (1.0 - x**2))  # an error in time moves x by its rate
        assert item["x"] == pytest.approx(x, abs=20.0 * max(tolerance, 1e-9) * scale)
        assert item["v"] == pytest.approx(v, abs=20.0 * max(tolerance, 1e-9) * scale)


@pytest.mark.slow
def test_an_explicit_method_on_a_stiff_model_stays_accurate(instance):
    item = instance(build_fmu(van_der_pol()))
    item.initialize(integrator=DOPRI5)
    item.step(0.0, 1.0)
    x, v = truth(lambda t, x: [x[1], 1000 * (1 - x[0] ** 2) * x[1] - x[0]], [2, 0], (0, 1), "Radau", 1e-10)[-1]
    assert (item["x"], item["v"]) == (pytest.approx(x, abs=1e-7), pytest.approx(v, abs=1e-7))


def wavy(item, t, n, h=0.07):
    """Steps under an input that jumps now and then."""
    for k in range(n):
        item.step(t + k * h, h, u=float((k // 5) % 3))
    return [item[name] for name in ("time", "x", "y", "der(x)", "der(y)")]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [RK4, DOPRI5, RODAS])
def test_a_cut_run_continues_bit_identically(instance, integrator):
    path = build_fmu(driven())
    item = instance(path).initialize(integrator=integrator, internal_step=0.02)
    wavy(item, 0.0, 23)
    state = item.fmu.getFMUState()
    data = item.fmu.serializeFMUState(state)
    expected = wavy(item, 23 * 0.07, 40)
    item.fmu.setFMUState(state)
    assert wavy(item, 23 * 0.07, 40) == expected
    item.fmu.freeFMUState(state)
    fresh = instance(path)
    state = fresh.fmu.deserializeFMUState(data)
    fresh.fmu.setFMUState(state)
    fresh.fmu.freeFMUState(state)
    assert wavy(fresh, 23 * 0.07, 40) == expected


@pytest.mark.slow
def test_the_step_size_is_part_of_the_state(instance):
    """A run that starts anew at the cut, with a step size of its own, is another one: the test above can fail."""
    path = build_fmu(driven())
    item, fresh = instance(path).initialize(integrator=DOPRI5), instance(path, start_time=0.7)
    wavy(item, 0.0, 10)
    fresh.initialize(integrator=DOPRI5, x=item["x"], y=item["y"], u=item["u"])
    item.step(0.7, 0.07)
    fresh.step(0.7, 0.07)
    assert 0.0 < abs(item["x"] - fresh["x"]) < 1e-7


@pytest.mark.parametrize("integrator", [DOPRI5, RODAS])
def test_an_input_that_jumps_restarts_the_integrator(instance, integrator):
    """Bit by bit what a fresh instance does, which has no step size yet."""
    path = build_fmu(driven())
    item, fresh = instance(path).initialize(integrator=integrator), instance(path, start_time=5.0)
    item.step(0.0, 5.0)
    fresh.initialize(integrator=integrator, x=item["x"], y=item["y"])
    item.step(5.0, 0.3, u=2.0)
    fresh.step(5.0, 0.3, u=2.0)
    assert (item["x"], item["y"]) == (fresh["x"], fresh["y"])
    item.step(5.3, 0.3)  # and now it goes on


@pytest.mark.parametrize("integrator", [DOPRI5, RODAS])
def test_an_input_that_jumps(msd, instance, integrator):
    """Long after the step has grown: what is lost to a jump stays within the tolerance."""
    item = instance(msd).initialize(integrator=integrator, tolerance=1e-9)
    x = np.array([0.1, 0.0])
    for t, force in ((0.0, 0.0), (30.0, 1000.0), (30.5, -1000.0), (31.0, 0.0)):
        item.step(t, 30.0 if t == 0.0 else 0.5, force=force)
        x = exact(30.0 if t == 0.0 else 0.5, x, force)
        assert [item["position"], item["velocity"]] == pytest.approx(list(x), abs=1e-9 * 1000.0 / M)


def test_internal_step_can_be_changed_between_steps(msd, instance):
    """0.4 s in one piece, then in four: each is what an FMU of that internal_step does."""
    item, coarse, fine = (instance(msd).initialize(internal_step=h) for h in (0.4, 0.4, 0.1))
    item.step(0.0, 0.4)
    coarse.step(0.0, 0.4)
    fine.fmu.reset()
    fine.initialize(internal_step=0.1, position=coarse["position"], velocity=coarse["velocity"])
    item.step(0.4, 0.4, internal_step=0.1)
    fine.step(0.0, 0.4)
    assert (item["position"], item["velocity"]) == (fine["position"], fine["velocity"])
    fails(item, lambda: item.step(0.8, 0.1, internal_step=0.0), "internal_step was set to 0 s, expected a positive")


def test_the_importers_tolerance_counts_unless_the_parameter_is_set(instance):
    path, end = build_fmu(driven()), []
    for wished, given in ((1e-4, None), (None, 1e-4), (1e-4, 1e-10), (None, 1e-10)):
        item = instance(path)
        if given is not None:
            item["tolerance"] = given
        item["integrator"] = DOPRI5
        item.fmu.enterInitializationMode(tolerance=wished)
        item.fmu.exitInitializationMode()
        item.step(0.0, 3.0)
        end.append(item["x"])
    assert end[0] == end[1]
    assert end[2] == end[3]
    assert end[0] != end[2]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [DOPRI5, RODAS])
def test_a_solution_that_ends_stops_the_step(instance, integrator):
    """x' = x^2, x(0) = 1: no solution beyond t = 1."""
    item = instance(build_fmu(explosive())).initialize(integrator=integrator)
    before = [item[name] for name in ("time", "x")]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 2.0)
    assert [item[name] for name in ("time", "x")] == before
    message = item.log[-1][2]
    assert (
        "the integrator can't continue at t = 1" in message or "the integrator can't continue at t = 0.999" in message
    )
    assert "x (element 0)" in message


@pytest.mark.slow
def test_large_models_keep_their_scratch_elsewhere(instance):
    """100 states, a heat equation: beyond 64 they are not on the stack; the Jacobian is a band."""
    n, t, p, u = 100, ca.SX.sym("t"), ca.SX.sym("p", 0), ca.SX.sym("u", 0)
    x = ca.SX.sym("x", n)
    padded = ca.vertcat(0, x, 0)
    rate = 1e4 * (padded[2:] - 2 * x + padded[:-2])
    base = driven()
    start = np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
    spec = replace(
        base,
        name="heat",
        inputs=(),
        states=(replace(base.states[0], shape=(n,), start=start),),
        derivative=ca.Function("f", [t, x, u, p], [rate]),
        output=ca.Function("g", [t, x, u, p], [ca.SX(0, 1)]),
        integrator="rodas",
    )
    path = build_fmu(spec)
    decay = np.exp(-4e4 * np.sin(np.pi / 2 / (n + 1)) ** 2 * 0.05)  # of the lowest mode, which this is
    for integrator in (RK4, DOPRI5, RODAS):
        item = instance(path).initialize(integrator=integrator, internal_step=2e-5)
        item.step(0.0, 0.05)
        np.testing.assert_allclose(item["x"], start * decay, rtol=0, atol=1e-7)


def test_wrong_settings_are_refused(msd, instance):
    item = instance(msd)
    fails(item, lambda: item.initialize(integrator=2.5), "integrator was set to 2.5, expected 1 (rk4), 2 (dopri5) or 3")
    fails(item, lambda: item.initialize(integrator=4.0), "integrator", "from 1 to 3")
    fails(item, lambda: item.initialize(tolerance=0.0), "tolerance", "from 1e-14 to 0.1")
    with pytest.raises(ParameterError, match=r"mass_spring_damper.integrator: found 'euler', expected one of rk4"):
        mass_spring_damper(integrator="euler")
    with pytest.raises(ParameterError, match=r"tolerance: found 1.0, expected a number from 1e-14 to 0.1"):
        mass_spring_damper(tolerance=1.0)


def test_rodas_needs_derivatives(monkeypatch):
    monkeypatch.setattr(
        "loopwright.fmus.export.c_code.to_symbols", lambda spec: (_ for _ in ()).throw(RuntimeError("none"))
    )
    with pytest.raises(DefinitionError, match="without derivatives, which the integrator rodas needs"):
        build_fmu(mass_spring_damper(integrator="rodas", description="not in the cache"))


def test_all_integrators_agree_in_fmpy(msd):
    for integrator in (RK4, DOPRI5, RODAS):
        result = fmpy.simulate_fmu(
            str(msd),
            fmi_type="CoSimulation",
            stop_time=2.0,
            output_interval=0.01,
            start_values={"integrator": integrator, "tolerance": 1e-11},
        )
        for t, position in list(zip(result["time"], result["position"], strict=True))[::20]:
            assert position == pytest.approx(exact(t, (0.1, 0.0))[0], abs=1e-10)
    assert (M, D, K) == (2.0, 0.5, 10.0)

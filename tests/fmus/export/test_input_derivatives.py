"""Input derivatives of FMI 2.0 Co-Simulation: u(t) = u + u1 (t - t0) + u2 (t - t0)^2 / 2 + ... over a step."""

import ctypes

import fmpy
import fmpy.fmi2
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.fmus import Variable, build_fmu
from support.exported import counter, driven, make_model, mass_spring_damper, unbound, van_der_pol
from support.instances import fails

RK4, DOPRI5, RODAS = INTEGRATORS = (1, 2, 3)


def double_integrator():
    return make_model(
        "double_integrator",
        (Variable("x", "output", start=0.25, state=True), Variable("v", "output", start=-1.0, state=True)),
        (),
        (Variable("u", "input", start=0.5),),
        lambda t, x, u, p: [x[1], u[0]],
        lambda t, x, u, p: [u[0]],
        (Variable("y", "output"),),
    )


@pytest.fixture(scope="module")
def integrators2(cache):
    return build_fmu(double_integrator(), fmi=2)


@pytest.fixture(scope="module")
def driven2(cache):
    return build_fmu(unbound(driven()), fmi=2)


def move(item, *slopes, name="u"):
    """Set the derivatives of an input, from order 1 on."""
    orders = range(1, len(slopes) + 1)
    item.fmu.setRealInputDerivatives(item.references[name] * len(slopes), list(orders), list(slopes))


def polynomial(s, x, v, *u):
    """Position, velocity and input after s, in closed form; u and its derivatives."""
    x, now, factor = x + v * s, 0.0, 1.0
    for k, derivative in enumerate(u):
        now += derivative * s**k / factor
        v += derivative * s ** (k + 1) / (factor * (k + 1))
        x += derivative * s ** (k + 2) / (factor * (k + 1) * (k + 2))
        factor *= k + 1
    return x, v, now


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("slopes", [(2.0,), (-3.0, 4.0), (0.0, 1.5)])
def test_polynomials_up_to_the_order_of_the_integrator_are_exact(integrators2, instance, integrator, slopes):
    """The position is a polynomial of degree 3 or 4, which a method of order 4 integrates without error, in one step."""
    item = instance(integrators2)
    item.initialize(integrator=integrator, internal_step=10.0, tolerance=1e-12)
    item["u"] = 0.5
    move(item, *slopes)
    item.step(0.0, 1.25)
    assert [item[name] for name in "xvy"] == pytest.approx(polynomial(1.25, 0.25, -1.0, 0.5, *slopes), rel=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_all_orders(integrators2, instance, integrator):
    item = instance(integrators2)
    item.initialize(integrator=integrator, internal_step=1e-3, tolerance=1e-12)
    move(item, -1.0, 2.0, 3.0, -4.0)
    item.step(0.0, 0.75)
    truth = polynomial(0.75, 0.25, -1.0, 0.5, -1.0, 2.0, 3.0, -4.0)
    assert [item[name] for name in "xvy"] == pytest.approx(truth, rel=1e-11)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_they_hold_for_one_step(integrators2, instance, integrator):
    item = instance(integrators2)
    item.initialize(integrator=integrator, tolerance=1e-12)
    move(item, 2.0)
    item.step(0.0, 1.0, u=0.5)  # set after its derivative: the order of the two calls is free
    assert item["u"] == item["y"] == 2.5
    item.step(1.0, 1.0)  # the input stays where it has come to
    first = polynomial(1.0, 0.25, -1.0, 0.5, 2.0)
    assert [item[name] for name in "xvy"] == pytest.approx(polynomial(1.0, *first), rel=1e-12)


def wave(t):
    return 0.3 + np.sin(2.0 * t)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_broken_line_against_scipy(instance, integrator):
    """An importer that joins samples of a wave by lines."""
    item = instance(build_fmu(driven(), fmi=2))
    item.initialize(integrator=integrator, internal_step=1e-3, tolerance=1e-12)
    x, h = np.array([1.0, 0.5]), 0.1
    for k in range(20):
        t, u = k * h, wave(k * h)
        slope = (wave(t + h) - u) / h
        item["u"] = u
        move(item, slope)
        item.step(t, h)

        def rhs(s, x, t=t, u=u, slope=slope):
            force = u + slope * (s - t)
            return [-x[0] * x[1] + np.sin(3 * s) + force, x[0] - x[1] ** 3 - 0.5 * x[1] * np.cos(s)]

        x = solve_ivp(rhs, (t, t + h), x, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
        assert [item["x"], item["y"]] == pytest.approx(list(x), abs=2e-11)


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "order"), [(RK4, 4.0), (RODAS, 4.0), (DOPRI5, 5.0)])
def test_the_order_is_kept(driven2, instance, integrator, order):
    """One internal step for each communication step. Rosenbrock methods lose order if the input's rate is left out."""

    def rhs(t, x):
        return [-x[0] * x[1] + np.sin(3 * t) + wave(t), x[0] - x[1] ** 3 - 0.5 * x[1] * np.cos(t)]

    item, counts, errors = instance(driven2), (12, 16, 24, 32), []
    for n in counts:
        item.fmu.reset()
        item.initialize(integrator=integrator, internal_step=10.0)
        item.step(0.0, 0.5)
        item.step(0.5, 0.5)  # the adaptive step grows
        start, h = [item["x"], item["y"]], 1.2 / n
        for k in range(n):
            t = 1.0 + k * h
            item["u"] = wave(t)
            # of degree 4, it follows the wave to order 5
            move(item, 2 * np.cos(2 * t), -4 * np.sin(2 * t), -8 * np.cos(2 * t), 16 * np.sin(2 * t))
            item.step(t, h)
        x = solve_ivp(rhs, (1.0, 2.2), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        errors.append(np.abs(np.array([item["x"], item["y"]]) - x).max())
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] > order - 0.3, errors


def ramps(item, first, last, between=None):
    for k in range(first, last):
        item["u"] = np.sin(0.3 * k)
        move(item, np.cos(0.3 * k), -0.5)
        if between:
            item = between(item)
        item.step(0.07 * k, 0.07)
    return [item[name] for name in ("time", "x", "y", "u", "der(x)")]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_they_are_part_of_the_state(instance, integrator):
    path = build_fmu(driven(), fmi=2)

    def elsewhere(item):
        other = instance(path)
        other.fmu.setFMUState(other.fmu.deserializeFMUState(item.fmu.serializeFMUState(item.fmu.getFMUState())))
        return other

    item, cut = instance(path).initialize(integrator=integrator), instance(path).initialize(integrator=integrator)
    state = item.fmu.getFMUState()
    whole = ramps(item, 0, 8)
    assert ramps(cut, 0, 8, elsewhere) == whole
    item.fmu.setFMUState(state)
    assert ramps(item, 0, 8) == whole
    item.fmu.reset()
    assert ramps(item.initialize(integrator=integrator), 0, 8) == whole
    move(item, 1.0)
    item.fmu.reset()  # it has forgotten that
    item.initialize(integrator=integrator)
    item.step(0.0, 1.0, u=0.5)
    assert item["u"] == 0.5


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_derivatives_of_zero_change_no_bit(driven2, instance, integrator):
    found = []
    for slopes in ((), (0.0,), (-0.0, 0.0)):
        item = instance(driven2)
        item.initialize(integrator=integrator)
        for k in range(5):
            item["u"] = wave(k)
            move(item, *slopes) if slopes else None
            item.step(0.1 * k, 0.1)
        found.append((item["x"], item["y"]))
    assert found[0] == found[1] == found[2]


@pytest.mark.slow
def test_an_input_that_goes_on_is_no_jump(instance):
    """It is set to where it has moved to, but for rounding: the adaptive step isn't chosen anew."""
    path, found = build_fmu(driven(), fmi=2), []
    for shift in (0.0, 1e-15, 1e-9):
        item = instance(path).initialize(integrator=DOPRI5, tolerance=1e-6)
        item["u"] = 1.0
        move(item, 0.1)
        item.step(0.0, 1.0)
        item["u"] = item["u"] + shift
        move(item, 0.1)
        item.step(1.0, 1.0)
        found.append(item["x"])
    assert found[1] == pytest.approx(found[0], abs=1e-14)
    assert abs(found[2] - found[0]) > 5e-9  # a jump: other steps, other errors


def passes():
    """Counts the events at u = 1, and remembers the time of the last one."""
    return counter(lambda t, x, u, p, fired: [t, x[1] + 1.0], z=lambda t, x, u, p: [u[0] - 1.0])


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_events_by_a_moving_input(instance, integrator):
    """The input passes 1 upwards and comes back within one internal step; x remembers when."""
    item = instance(build_fmu(passes(), fmi=2))
    item.initialize(integrator=integrator, internal_step=10.0)
    item["u"] = 0.0
    move(item, 2.0)
    item.step(0.0, 1.0)
    assert (item["n"], item["x"]) == (1.0, pytest.approx(0.5, abs=1e-15))
    item["u"] = 0.0
    item.step(1.0, 1.0)
    assert item["n"] == 2.0
    item["u"] = 0.0  # above 1 from 0.49 to 0.51: 1 + 0.01^2 - (s - 0.5)^2, scaled
    top = 1.0 / 0.2499
    move(item, top, -2.0 * top)
    item.step(2.0, 1.0)
    assert (item["n"], item["x"]) == (4.0, pytest.approx(2.51, abs=1e-13))


@pytest.mark.parametrize("order", [0, 5])
def test_orders_that_are_refused(integrators2, instance, order):
    item = instance(integrators2).initialize()
    call = item.fmu.setRealInputDerivatives
    fails(item, lambda: call(item.references["u"], [order], [1.0]), f"derivative of u is {order}, expected 1 to 4")


@pytest.mark.slow
def test_what_is_refused(integrators2, instance):
    item = instance(integrators2).initialize()
    fails(item, lambda: move(item, 1.0, name="x"), "x is no continuous input")
    item.initialize()
    fails(item, lambda: move(item, 1.0, float("nan")), "derivative 2 of u was set to nan", "expected a finite number")
    item.initialize()
    fails(
        item, lambda: item.fmu.setRealInputDerivatives([99], [1], [1.0]), "no Float64 variable with value reference 99"
    )
    item = instance(build_fmu(passes(), fmi=2)).initialize()
    fails(item, lambda: move(item, 1.0, name="v"), "v is no continuous input")
    item = instance(build_fmu(van_der_pol(), fmi=2)).initialize()
    fails(item, lambda: item.fmu.setRealInputDerivatives([0], [1], [1.0]), "this FMU has no inputs")
    item = instance(integrators2, model_exchange=True).initialize()
    call = item.fmu.dll.fmi2SetRealInputDerivatives  # FMPy has it for Co-Simulation alone
    nothing = ctypes.c_void_p()
    assert call(ctypes.c_void_p(item.fmu.component), nothing, ctypes.c_size_t(0), nothing, nothing) == 3
    assert "this is a Model Exchange instance" in item.log[-1][2]


@pytest.mark.slow
def test_a_step_that_fails_keeps_them(instance):
    item = instance(build_fmu(mass_spring_damper(), fmi=2)).initialize(integrator=RK4)
    item["force"] = 1.0
    move(item, 2.0, name="force")
    state = item.fmu.getFMUState()
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.5, 1.0)
    item.fmu.setFMUState(state)
    item.step(0.0, 1.0)
    assert item["force"] == 3.0
    assert item["acceleration"] == pytest.approx(
        (3.0 - 0.5 * item["velocity"] - 10.0 * item["position"]) / 2.0, rel=1e-14
    )

"""Model Exchange in both versions: the calls, events, and the numbers under solvers that are not ours."""

import ctypes

import casadi as ca
import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.fmus import ModelSpec, Variable, build_fmu
from support.exported import (
    D,
    E,
    G,
    K,
    M,
    ball,
    bounces,
    bouncing_ball,
    driven,
    echoing_ball,
    exact,
    flight,
    heating,
    mass_spring_damper,
    pendulums,
    thermostat,
    van_der_pol,
)
from support.instances import fails, vector

TORQUE = [0.2, -0.1]
PENDULUM = [1.0, 2.0, 3.0, 4.0]  # its gain


@pytest.fixture(scope="module", params=[3, 2], ids=["fmi3", "fmi2"])
def fmi(request):
    return request.param


@pytest.fixture(scope="module")
def build(fmi):
    return lambda spec: build_fmu(spec, fmi=fmi)


# ---- the calls ----


@pytest.mark.slow
def test_the_right_hand_side_is_the_models(build, exchange):
    spec = pendulums()
    me = exchange(build(spec), start_time=0.5).start(torque=TORQUE)
    assert me.x == [0.3, -0.2, 0.0, 0.0, 7.0]
    rng = np.random.default_rng(1)
    for t in (0.5, 0.7, 0.6):  # back in time too
        x = rng.normal(size=5)
        expected = np.array(spec.derivative(t, x, TORQUE, PENDULUM)).ravel()
        np.testing.assert_allclose(me.rhs(t, x), expected, rtol=1e-14, atol=1e-15)
        assert me.item["time"] == t
        np.testing.assert_allclose(me.item["deflection"], np.sin(x[:2]), rtol=1e-15)
        np.testing.assert_allclose(me.item["der(rate)"], expected[2:4], rtol=1e-14)
    assert me.nominals == [1.0] * 5
    if me.fmi == 3:  # FMI 2.0 tells them in the model description alone
        assert (me.fmu.getNumberOfContinuousStates(), me.fmu.getNumberOfEventIndicators()) == (5, 0)
    assert me.fmu.completedIntegratorStep() == (False, False)


def test_outputs_follow_the_inputs_at_once(build, exchange):
    me = exchange(build(mass_spring_damper())).start()
    for force in (1.0, -2.0):
        me.item["force"] = force
        assert me.item["acceleration"] == me.item["der(velocity)"] == me.dx[1] == (force - K * 0.1) / M
    me.set(0.3, [0.2, 0.5])
    assert me.item["acceleration"] == pytest.approx((-2.0 - D * 0.5 - K * 0.2) / M, rel=1e-15)


@pytest.mark.drawn(1)
def test_derivatives_are_exact(build, exchange):
    spec = pendulums()
    me = exchange(build(spec)).start()
    me.item["torque"] = [0.5, 0.6]
    x = np.array([0.4, 1.1, -0.3, 0.2, 7.0])
    me.set(0.3, x)
    f = spec.derivative.expand()
    args = (0.3, x, [0.5, 0.6], PENDULUM)
    J = [np.array(b)[2:4] for b in f.jacobian()(*args, f(*args))]
    for known, block in (("angle", J[1][:, :2]), ("rate", J[1][:, 2:4]), ("torque", J[2]), ("time", J[0])):
        forward = [me.item.directional("der(rate)", known, e) for e in np.eye(block.shape[1])]
        np.testing.assert_allclose(np.transpose(forward), block, rtol=1e-12, atol=1e-13)
        if me.fmi == 3:
            reverse = [me.item.adjoint("der(rate)", known, e) for e in np.eye(2)]
            np.testing.assert_allclose(reverse, block, rtol=1e-12, atol=1e-13)
    if me.fmi == 3:
        fails(me.item, lambda: me.item.directional("angle", "deflection", [1.0, 1.0]), "deflection is no known")


def test_directional_derivatives_are_the_jacobian_of_the_rates(build, exchange):
    me = exchange(build(pendulums())).start(torque=TORQUE)
    me.set(0.3, [0.4, -0.3, 0.2, 0.1, 7.0])
    names = ["angle", "rate", "clock"]
    sizes = dict(zip(names, (2, 2, 1), strict=True))

    def column(known):
        return [
            np.concatenate([np.ravel(me.item.directional(f"der({n})", known, e)) for n in names])
            for e in np.eye(sizes[known])
        ]

    expected = np.zeros((5, 5))
    expected[:2, 2:4] = np.eye(2)
    expected[2:4, :2] = np.diag(-9.81 * np.cos([0.4, -0.3]))
    expected[2:4, 2:4] = -0.1 * np.eye(2)
    J = np.transpose([c for known in names for c in column(known)])
    np.testing.assert_allclose(J, expected, rtol=1e-12, atol=0)


@pytest.mark.slow
def test_derivatives_of_indicators(build, exchange):
    me = exchange(build(thermostat())).start()
    assert me.item.directional("too_warm.indicator", "temperature", [2.0]) == [2.0]
    assert me.item.directional("too_cold.indicator", "set_point", [1.0]) == [-1.0]
    assert me.item.directional("der(temperature)", "temperature", [1.0]) == [-0.1]


def test_indicators_have_a_hysteresis(build, exchange):
    """Away from 0 in its domain: at an event's restart none is 0; a stop just before the crossing fires the event."""
    me = exchange(build(bouncing_ball())).start()
    assert me.z == [pytest.approx(1.0)]
    me.set(0.4, [0.0, -1.0])
    assert me.z[0] == pytest.approx(1e-10) == me.item["bounce.indicator"]  # z = 0 is not yet past it
    me.set(0.4, [-0.999e-10, -1.0])
    assert me.z[0] > 0.0
    assert me.event() == [(False, True)]
    assert me.x == [-0.999e-10, 0.7]
    assert me.z[0] == pytest.approx(-1.999e-10)
    me.set(0.4 + 1e-9, [1e-11, 0.7])
    assert me.z[0] < 0.0  # seen only when it is well above
    assert me.event() == [(False, False)]
    assert me.z[0] == pytest.approx(1.1e-10)


@pytest.mark.slow
def test_discrete_inputs_and_parameters_are_set_in_event_mode(fmi, build, exchange):
    me = exchange(build(thermostat())).start()
    fails(me.item, lambda: me.item.__setitem__("set_point", 1.0), "set_point is a discrete input; set it in Event Mode")
    me.start()
    fails(me.item, lambda: me.item.__setitem__("heating", 1.0), "heating is a tunable parameter; set it in Event Mode")
    me.start()
    fails(me.item, lambda: me.item.__setitem__("on", 1.0), "on is a state")
    me.start()
    fails(me.item, lambda: me.item.__setitem__("time", 1.0), f"fmi{fmi}SetTime sets it")
    me.start()
    me.fmu.enterEventMode()
    me.item["set_point"], me.item["heating"] = 10.0, 2.0
    assert me.iterate() == [(False, False)]  # the switch is no continuous state
    assert me.item["on"] == 0.0
    assert me.item["power"] == 5.0


def test_calls_out_of_order(fmi, build, exchange):
    me = exchange(build(mass_spring_damper()))
    states = "GetContinuousStates" if fmi == 3 else "GetDerivatives"
    fails(me.item, lambda: me.x if fmi == 3 else me.dx, f"fmi{fmi}{states} was called in state Instantiated")
    me.fmu.setupExperiment() if fmi == 2 else None
    me.fmu.enterInitializationMode()
    assert me.x == [0.1, 0.0]
    fails(me.item, me.fmu.enterContinuousTimeMode, "called in state Initialization Mode, expected")
    me.start()
    iterate = f"fmi{fmi}{'UpdateDiscreteStates' if fmi == 3 else 'NewDiscreteStates'} was called in state "
    fails(me.item, me.update, iterate + "Continuous-Time Mode, expected Event Mode")
    me.start()
    fails(me.item, lambda: me.fmu.getContinuousStates(vector(1), 1), "found room for 1 values, expected 2")
    for t in (np.nan, np.inf):
        me.start()
        fails(me.item, lambda t=t: me.set(t, [0.0, 0.0]), f"fmi{fmi}SetTime: time was set to {t} s")
    for value in (np.nan, np.inf):
        me.start()
        fails(me.item, lambda v=value: me.set(0.0, [0.0, v]), f"velocity (element 0) became {value}", "finite")
    me.start()
    me.fmu.enterEventMode()
    fails(me.item, lambda: me.set(0.0, [0.0, 0.0]), f"fmi{fmi}SetContinuousStates was called in state Event Mode")
    me.start()
    me.fmu.terminate()
    fails(me.item, lambda: me.set(0.0, [0.0, 0.0]), "called in state Terminated, expected Continuous-Time Mode")


def test_functions_of_the_other_interface_are_refused(build, instance):
    slave = instance(build(mass_spring_damper())).initialize()
    component = slave.fmu.component
    if slave.fmi == 3:
        count = ctypes.c_size_t()
        fails(
            slave,
            lambda: slave.fmu.fmi3GetNumberOfContinuousStates(component, ctypes.byref(count)),
            "this is a Co-Simulation instance. Use fmi3InstantiateModelExchange",
        )
    else:
        set_time = slave.fmu.dll["fmi2SetTime"]
        set_time.argtypes = [ctypes.c_void_p, ctypes.c_double]
        assert set_time(component, 1.0) == fmpy.fmi2.fmi2Error
        assert "fmi2SetTime: this is a Co-Simulation instance" in slave.log[-1][2]


@pytest.mark.slow
def test_a_tunable_parameter_is_set_in_event_mode(build, exchange):
    me = exchange(build(echoing_ball())).start()
    fails(me.item, lambda: me.item.__setitem__("restitution", 0.5), "restitution", "set it in Event Mode")
    me.item.initialize(height=2.0)
    me.item["restitution"] = 0.5  # Event Mode
    assert me.item["restitution"] == 0.5


def test_states_belong_to_an_interface_type(build, exchange, instance):
    path = build(mass_spring_damper())
    me, slave = exchange(path).start(), instance(path).initialize()
    me.set(0.3, [0.2, 0.5])
    state = me.fmu.getFMUState()
    data = me.fmu.serializeFMUState(state)
    expected = me.dx
    me.rhs(1.0, [0.0, 0.0])
    me.fmu.setFMUState(state)
    me.fmu.freeFMUState(state)
    assert (me.item["time"], me.x, me.dx) == (0.3, [0.2, 0.5], expected)
    state = slave.fmu.deserializeFMUState(data)
    fails(slave, lambda: slave.fmu.setFMUState(state), "the state of a Model Exchange instance")
    slave.fmu.freeFMUState(state)
    stepped = slave.initialize().fmu.getFMUState()
    data = slave.fmu.serializeFMUState(stepped)
    slave.fmu.freeFMUState(stepped)
    state = me.fmu.deserializeFMUState(data)
    fails(me.item, lambda: me.fmu.setFMUState(state), "this is the state of a Co-Simulation instance")
    me.fmu.freeFMUState(state)


def test_reset_keeps_the_interface_type(build, exchange):
    me = exchange(build(mass_spring_damper())).start()
    me.fmu.reset()
    assert me.start().x == [0.1, 0.0]


@pytest.mark.slow
def test_outside_of_its_domain_the_importer_may_try_again(build, exchange):
    """sqrt(x) at x < 0: Discard asks for a shorter step (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3)."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u", 0), ca.SX.sym("p", 0)
    f, g = ca.Function("f", [t, x, u, p], [-ca.sqrt(x)]), ca.Function("g", [t, x, u, p], [x])
    spec = ModelSpec("tank", "", (), (Variable("y", "output"),), (), (Variable("x", start=4.0, state=True),), f, g)
    me = exchange(build(spec)).start()
    with pytest.raises(fmpy.fmi1.FMICallException) as caught:
        me.rhs(0.1, [-1.0])
    assert caught.value.status == (fmpy.fmi2.fmi2Discard if me.fmi == 2 else fmpy.fmi3.fmi3Discard)
    assert "der(x) (element 0) became" in me.item.log[-1][2]
    assert me.rhs(0.1, [9.0]) == [-3.0]


def test_when_it_has_ended_its_last_values_can_be_read(build, exchange):
    """In state Terminated states, derivatives and nominal values may be read (FMI 3.0, 2.3.8; FMI 2.0, 3.2.3)."""
    me = exchange(build(mass_spring_damper())).start()
    x, rates = me.x, me.dx
    me.fmu.terminate()
    assert (me.x, me.dx) == (x, rates)
    assert len(me.nominals) == len(x)
    fails(me.item, lambda: me.set(0.1, [1.0, 0.0]), "Terminated")


def test_null_is_refused_or_passed_over_and_nothing_crashes(build, exchange):
    me = exchange(build(mass_spring_damper())).start()
    lib, item = me.fmu.dll, ctypes.c_void_p(me.fmu.component)
    ok, error = 0, 3
    if me.fmi == 2:
        assert lib.fmi2CompletedIntegratorStep(item, 0, None, None) == ok
        assert lib.fmi2EnterEventMode(item) == ok
        assert lib.fmi2NewDiscreteStates(item, None) == ok
        assert lib.fmi2SetDebugLogging(item, 1, ctypes.c_size_t(1), None) == ok
        names = (ctypes.c_char_p * 1)(None)
        assert lib.fmi2SetDebugLogging(item, 1, ctypes.c_size_t(1), names) == 1  # a warning
        assert lib.fmi2SerializedFMUstateSize(item, None, None) == error
        assert lib.fmi2Reset(item) == ok
        assert lib.fmi2GetFMUstate(item, None) == error
    else:
        assert lib.fmi3CompletedIntegratorStep(item, ctypes.c_bool(False), None, None) == ok
        assert lib.fmi3SetDebugLogging(item, ctypes.c_bool(True), ctypes.c_size_t(1), None) == ok
        names = (ctypes.c_char_p * 1)(None)
        assert lib.fmi3SetDebugLogging(item, ctypes.c_bool(True), ctypes.c_size_t(1), names) == 1
        for call in ("GetNumberOfContinuousStates", "GetNumberOfEventIndicators"):
            assert lib[f"fmi3{call}"](item, None) == error
        assert lib.fmi3SerializedFMUStateSize(item, None, None) == error
        assert lib.fmi3Reset(item) == ok
        assert lib.fmi3GetFMUState(item, None) == error
        token, size = me.item.description.guid.encode(), ctypes.c_size_t
        made = lib["fmi3InstantiateCoSimulation"]  # without the types of arguments that FMPy gives it
        made.restype = ctypes.c_void_p
        false = ctypes.c_bool(False)
        assert made(b"i", token, None, false, false, false, false, None, size(1), None, None, None) is None


def test_a_state_is_read_into_a_pointer_that_holds_anything(build, exchange):
    me = exchange(build(mass_spring_damper())).start()
    state = me.fmu.getFMUState()
    data = bytes(me.fmu.serializeFMUState(state))
    name = "fmi2DeSerializeFMUstate" if me.fmi == 2 else "fmi3DeserializeFMUState"
    read, pointer = me.fmu.dll[name], ctypes.c_void_p(0xDEAD0)
    item, size = ctypes.c_void_p(me.fmu.component), ctypes.c_size_t(len(data))
    assert read(item, data, size, ctypes.byref(pointer)) == 0
    assert pointer.value not in (None, 0xDEAD0)
    changed = bytearray(data)
    changed[len(data) // 2] ^= 1
    fails(me.item, lambda: me.fmu.deserializeFMUState(bytes(changed)), "the checksum of these bytes is wrong")


# ---- events ----


@pytest.mark.drawn(1)
def test_event_iteration(build, exchange):
    """The bounce reverses the velocity; the echo fires at the same instant, in one more iteration."""
    me = exchange(build(echoing_ball())).start()
    assert me.flags == [(False, False)]
    assert me.event() == [(False, False)]  # nothing fires without a crossing
    fall = np.sqrt(2 / G)
    me.set(fall, [0.0, -G * fall])  # on the floor: z <= 0
    before = me.z
    assert me.event() == [(True, True), (False, False)]
    assert (me.item["bounces"], me.item["echoes"]) == (1.0, 1.0)
    np.testing.assert_allclose(me.x, [0.0, E * G * fall], rtol=1e-15)
    assert before[0] > 0 > me.z[0]  # never 0: what the importer sees has a hysteresis
    me.set(fall + 1e-3, [1e-3, 4.0])
    assert me.event() == [(False, False)]  # rising through the floor is not declared
    assert me.item["bounces"] == 1.0


def test_an_event_says_whether_it_has_moved_a_continuous_state(build, exchange):
    me = exchange(build(bouncing_ball())).start()
    me.set(0.5, [-1e-3, -4.0])
    assert me.event() == [(False, True)]
    me = exchange(build(thermostat())).start()
    me.set(1.0, [21.5])
    assert me.event() == [(False, False)]
    assert me.item["on"] == 0.0  # it has switched the heating off


@pytest.mark.drawn(1)
def test_a_saved_state_resumes_bit_identically_with_its_domains(build, exchange):
    path = build(echoing_ball())
    me, fresh = exchange(path).start(), exchange(path)
    me.set(0.3, [-1e-12, -2.0])
    me.event()
    me.item.copied_to(fresh.item)
    for one in (me, fresh):
        one.runge_kutta(0.3, 0.01)
    assert me.x == fresh.x
    assert me.z == fresh.z
    assert (me.item["bounces"], fresh.item["bounces"]) == (1.0, 1.0)


# ---- the numbers ----


def test_the_same_steps_give_the_same_bits_in_both_interfaces_and_versions(exchange, instance):
    runs = [exchange(build_fmu(mass_spring_damper(), fmi=fmi)).start(force=3.0) for fmi in (2, 3)]
    stepped = instance(build_fmu(mass_spring_damper(), fmi=2)).initialize(force=3.0, internal_step=1.0)
    h = 1.0 / 128.0
    for k in range(200):
        for me in runs:
            me.runge_kutta(k * h, h)
        stepped.step(k * h, h)
        expected = [stepped["position"], stepped["velocity"]]
        assert all(me.x == expected for me in runs)
        assert all(me.item["acceleration"] == stepped["acceleration"] for me in runs)


def test_scipy_integrates_it_to_the_matrix_exponential(build, exchange):
    me = exchange(build(mass_spring_damper())).start(force=5.0)
    x = solve_ivp(me.rhs, (0.0, 2.0), me.x, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    assert list(x) == pytest.approx(list(exact(2.0, (0.1, 0.0), 5.0)), abs=1e-11)


def test_scipy_integrates_vectors(build, exchange):
    me = exchange(build(pendulums())).start(torque=TORQUE)
    got = solve_ivp(me.rhs, (0, 1), me.x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]

    def right(t, x):
        torque = np.array([[1.0, 2.0], [3.0, 4.0]]) @ TORQUE
        return [*x[2:4], *(torque - 9.81 * np.sin(x[:2]) - 0.1 * x[2:4] + 0.5 * np.sin(3 * t)), 0.0]

    truth = solve_ivp(right, (0, 1), [0.3, -0.2, 0, 0, 7], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(got, truth, rtol=0, atol=1e-12)


def test_casadi_imports_fmi_2(tmp_path):
    """CasADi's own import: rates and, by our directional derivatives, their Jacobian."""
    fmpy.extract(str(build_fmu(pendulums(), fmi=2)), str(tmp_path))
    f = ca.DaeBuilder("pendulums", str(tmp_path)).create("f", ["x", "u"], ["ode"])
    x, u = np.array([0.3, -0.2, 0.1, 0.2, 7.0]), np.array([0.2, -0.1])
    trace = pendulums().derivative.expand()
    args = (0.0, x, u, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(f(x, u).full(), trace(*args).full(), rtol=1e-14, atol=1e-14)
    by_x, by_u = (J.full() for J in f.jacobian()(x, u, 0))
    exact = [J.full() for J in trace.jacobian()(*args, 0)]
    np.testing.assert_allclose(by_x, exact[1], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(by_u, exact[2], rtol=1e-12, atol=1e-14)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("interface", ["ModelExchange", "CoSimulation"])
def test_fmpy_agrees_with_scipy(build, interface):
    """Nonlinear, with time in it: CVode outside, or dopri5 inside, to their tolerances."""

    def rhs(t, x):
        return [-x[0] * x[1] + np.sin(3 * t) + 0.3, x[0] - x[1] ** 3 - 0.5 * x[1] * np.cos(t)]

    result = fmpy.simulate_fmu(
        str(build(driven(integrator="dopri5"))),
        fmi_type=interface,
        stop_time=5.0,
        output_interval=0.1,
        relative_tolerance=1e-10,
        start_values={"u": 0.3},
    )
    truth = solve_ivp(rhs, (0.0, 5.0), [1.0, 0.5], "DOP853", result["time"], rtol=1e-12, atol=1e-13).y
    bound = {"ModelExchange": 1e-7, "CoSimulation": 1e-9}[interface]  # CVode's error is some hundred tolerances
    assert np.abs(np.array([result["x"], result["y"]]) - truth).max() < bound


@pytest.mark.slow
def test_a_stiff_model_under_cvode(build):
    result = fmpy.simulate_fmu(
        str(build(van_der_pol())),
        fmi_type="ModelExchange",
        stop_time=200.0,
        output_interval=10.0,
        relative_tolerance=1e-8,
    )
    truth = solve_ivp(
        lambda t, x: [x[1], 1000.0 * (1.0 - x[0] ** 2) * x[1] - x[0]],
        (0.0, 200.0),
        [2.0, 0.0],
        "Radau",
        result["time"],
        rtol=1e-10,
        atol=1e-12,
    ).y
    assert np.abs(result["x"] - truth[0]).max() < 300.0 * 1e-8


def test_bounces_under_cvode(build):
    """The event comes a hysteresis of 1e-10 m late: 1e-10 / 4 s at the first bounce, 1e-10 / 0.7 s at the sixth."""
    result = fmpy.simulate_fmu(
        str(build(bouncing_ball())),
        fmi_type="ModelExchange",
        stop_time=2.3,
        output_interval=0.01,
        relative_tolerance=1e-10,
        record_events=True,
    )
    times, heights, velocities = (result[name] for name in ("time", "height", "velocity"))
    up = np.flatnonzero((velocities[1:] - velocities[:-1] > 0.1) & (velocities[:-1] < 0.0)) + 1
    found = list(zip(times[up], velocities[up], strict=True))
    expected = [(t, v) for t, v in bounces(8) if t < 2.3]
    assert len(found) == len(expected) == 6
    for (t, v), (t0, v0) in zip(found, expected, strict=True):
        assert t == pytest.approx(t0, abs=1e-9)
        assert v == pytest.approx(v0, abs=1e-8)
    assert max(abs(h - ball(t)[0]) for t, h in zip(times, heights, strict=True)) < 5e-9
    assert E * np.sqrt(2.0 * G) == pytest.approx(expected[0][1])


def test_a_hysteresis_under_cvode(build):
    result = fmpy.simulate_fmu(
        str(build(thermostat())),
        fmi_type="ModelExchange",
        stop_time=20.0,
        output_interval=0.5,
        relative_tolerance=1e-10,
        record_events=False,
    )
    assert len(result) == 41
    for t, temperature, on, _ in result:
        assert (temperature, on) == (pytest.approx(heating(t)[0], abs=5e-7), heating(t)[1])


def test_the_ball_bounces_in_fmpy(build):
    result = fmpy.simulate_fmu(
        str(build(echoing_ball())),
        fmi_type="ModelExchange",
        stop_time=2.0,
        output_interval=0.01,
        relative_tolerance=1e-9,
        record_events=False,
        output=["height", "bounces"],
    )
    exact = np.array([flight(t) for t in result["time"]])
    assert exact[-1, 2] == 4
    assert result["bounces"].tolist() == exact[:, 2].tolist()
    assert np.abs(result["height"] - exact[:, 0]).max() < 1e-6

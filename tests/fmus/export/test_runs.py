"""Exported FMUs of both versions at run time: the numbers, communication points, states, derivatives, errors."""

import ctypes
import re
import threading

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.fmus import build_fmu
from support.exported import D, K, M, echoing_ball, exact, explosive, flight, mass_spring_damper, pendulums, stiff
from support.instances import fails, open_instance, run

TORQUE = [0.2, -0.1]


@pytest.fixture(scope="module", params=[3, 2], ids=["fmi3", "fmi2"])
def fmi(request):
    return request.param


@pytest.fixture(scope="module")
def msd(fmi):
    return build_fmu(mass_spring_damper(), fmi=fmi)


@pytest.fixture(scope="module")
def pendulum(fmi):
    return build_fmu(pendulums(), fmi=fmi)


# ---- the numbers ----


def test_free_motion_against_the_matrix_exponential(msd):
    result = fmpy.simulate_fmu(str(msd), stop_time=2.0, output_interval=0.01, output=["position", "velocity"])
    for t, position, velocity in result[::20]:
        assert (position, velocity) == pytest.approx(exact(t, (0.1, 0.0)), abs=1e-12)


def error_of(item, internal_step, t_end=1.6, h=0.4):
    item.fmu.reset()
    item.initialize(internal_step=internal_step, position=0.1, velocity=-0.3)
    for k in range(round(t_end / h)):
        item.step(k * h, h, force=5.0)
    return np.abs(np.array([item["position"], item["velocity"]]) - exact(t_end, (0.1, -0.3), 5.0)).max()


def test_order_of_the_integrator_is_4(msd, instance):
    item = instance(msd)
    steps = 0.1 / 2.0 ** np.arange(5)
    errors = [error_of(item, step) for step in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.2)
    assert all(error < 2.0 * step**4 for error, step in zip(errors, steps, strict=True))


def test_substeps_are_the_ceiling_of_the_ratio(msd, instance):
    """0.4 / 0.1 is 4 pieces, 0.4 / 0.0999 is 5: the error shows it."""
    item = instance(msd)
    assert error_of(item, 0.1) == error_of(item, 0.1 * (1 - 1e-10))
    assert error_of(item, 0.0999) == error_of(item, 0.08)
    assert error_of(item, 0.0999) < error_of(item, 0.1)
    assert error_of(item, 0.4) == error_of(item, 10.0)


def test_arrays_and_time_against_dop853(pendulum, instance):
    def right(t, x):
        torque = np.array([[1.0, 2.0], [3.0, 4.0]]) @ TORQUE
        return [*x[2:], *(torque - 9.81 * np.sin(x[:2]) - 0.1 * x[2:] + 0.5 * np.sin(3 * t))]

    item = instance(pendulum, start_time=0.25).initialize(internal_step=1e-3, torque=TORQUE)
    for k in range(20):
        item.step(0.25 + 0.05 * k, 0.05)
    truth = solve_ivp(right, (0.25, 1.25), [0.3, -0.2, 0, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert item["time"] == pytest.approx(1.25, abs=1e-15)
    np.testing.assert_allclose(np.concatenate([item["angle"], item["rate"]]), truth, rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["deflection"], np.sin(truth[:2]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["der(rate)"], right(1.25, truth)[2:], rtol=0, atol=1e-9)
    assert item["clock"] == 7.0


@pytest.mark.slow
def test_the_same_bits_in_both_versions_with_arrays_and_without(instance):
    pair = [instance(build_fmu(mass_spring_damper(), fmi=fmi)).initialize() for fmi in (2, 3)]
    assert run(pair[0], 0.0, 300) == run(pair[1], 0.0, 300)
    two, three = (instance(build_fmu(pendulums(), fmi=fmi)).initialize(torque=TORQUE) for fmi in (2, 3))
    scalars = instance(build_fmu(pendulums(), arrays=False))
    scalars.initialize(**{"torque[1]": TORQUE[0], "torque[2]": TORQUE[1]})
    for k in range(100):
        for item in (three, scalars, two):
            item.step(0.02 * k, 0.02)
    for name in ("angle", "rate", "deflection", "der(rate)"):
        first, bracket, rest = name.partition(")")
        elements = [f"{first}[{i}]{bracket}{rest}" for i in (1, 2)]
        assert three[name].tolist() == two[name].tolist() == [scalars[n] for n in elements]


def test_variable_steps_end_where_the_master_says(msd, instance):
    item, t = instance(msd, start_time=3.0).initialize(), 3.0
    for h in (0.1, 0.013, 0.2, 1e-6, 0.087):
        assert item.step(t, h) == ((False, False, False, t + h) if item.fmi == 3 else None)
        t += h
        assert item["time"] == t
    assert item["position"] == pytest.approx(exact(t - 3.0, (0.1, 0.0))[0], abs=1e-12)


def test_start_values_are_set_and_reset(msd, instance):
    item = instance(msd, start_time=2.0).initialize(mass=4.0, position=0.5)
    assert (item["acceleration"], item["time"]) == (-K * 0.5 / 4.0, 2.0)
    item.step(2.0, 0.1)
    item.fmu.reset()
    assert (item["mass"], item["position"], item["time"]) == (M, 0.1, 0.0)
    assert item.initialize()["acceleration"] == -K * 0.1 / M


# ---- outputs belong to communication points (FMI 3.0, 4.2.1; FMI 2.0.5, 4.2.4) ----


def test_initialization_evaluates_what_is_set(msd, instance):
    item = instance(msd)
    item.fmu.setupExperiment() if item.fmi == 2 else None
    item.fmu.enterInitializationMode()
    for force, position in ((0.0, 0.1), (3.0, 0.1), (3.0, -0.4)):
        item["force"], item["position"] = force, position
        assert item["acceleration"] == item["der(velocity)"] == (force - K * position) / M


def test_setting_an_input_changes_no_output_before_the_next_step(msd, instance):
    item = instance(msd).initialize(force=1.0)
    for k in range(3):
        before = [item[name] for name in ("position", "acceleration", "der(velocity)")]
        item["force"], item["damping"] = 1.0 + k, D + k
        assert [item[name] for name in ("position", "acceleration", "der(velocity)")] == before
        assert (item["force"], item["damping"]) == (1.0 + k, D + k)
        item.step(k * 0.1, 0.1)
        expected = (1.0 + k - (D + k) * item["velocity"] - K * item["position"]) / M
        assert item["acceleration"] == item["der(velocity)"] == pytest.approx(expected, rel=1e-14)


def test_derivatives_read_late_are_still_those_of_the_step(msd, instance):
    """Also when they are first read after the input and a tunable parameter have changed."""
    early, late = instance(msd).initialize(force=2.0), instance(msd).initialize(force=2.0)
    for item in (early, late):
        item.step(0.0, 0.1)
    expected = early["der(velocity)"]
    late["force"], late["damping"] = 100.0, 50.0
    assert late["der(velocity)"] == expected
    late.fmu.terminate()
    assert late["der(velocity)"] == expected


# ---- states ----


def test_a_saved_state_resumes_bit_identically(msd, instance):
    item = instance(msd).initialize(internal_step=3e-3, stiffness=20.0)
    run(item, 0.0, 50)
    state = item.fmu.getFMUState()
    fresh = item.copied_to(instance(msd))
    expected = run(item, 0.5, 50)
    item.fmu.setFMUState(state)
    assert run(item, 0.5, 50) == expected
    item.fmu.freeFMUState(state)
    assert fresh["stiffness"] == 20.0
    assert run(fresh, 0.5, 50) == expected


def state_of(item):
    state = item.fmu.getFMUState()
    data = item.fmu.serializeFMUState(state)
    item.fmu.freeFMUState(state)
    return data


@pytest.mark.slow
def test_states_of_others_are_refused(fmi, msd, pendulum, instance):
    item = instance(msd)
    data = state_of(instance(pendulum))
    fails(item, lambda: item.fmu.deserializeFMUState(data), "no state of this FMU")
    fails(item, lambda: item.fmu.deserializeFMUState(b"nonsense"), "these 8 bytes are no state of this FMU")
    fails(item, lambda: item.fmu.setFMUState(None), "the state is NULL")
    like = instance(build_fmu(mass_spring_damper(internal_step=2e-3), fmi=fmi))  # same size, another model
    data = state_of(like)
    fails(item, lambda: item.fmu.deserializeFMUState(data), "no state of this FMU")
    fails(
        like, lambda: like.fmu.deserializeFMUState(data[:60] + b"?" + data[61:]), "the checksum of these bytes is wrong"
    )


def test_a_state_brings_a_failed_fmu_back(msd, instance):
    item = instance(msd).initialize()
    state = item.fmu.getFMUState()
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 0.1)
    assert "called in state Terminated, expected Step Mode" in item.log[-1][2]
    item.fmu.setFMUState(state)
    item.fmu.freeFMUState(state)
    item.step(0.0, 0.1, force=1.0)


def test_two_instances_in_two_threads_are_independent(msd, instance):
    alone = instance(msd).initialize()
    expected = run(alone, 0.0, 500)
    pair, results = [instance(msd).initialize() for _ in range(2)], {}
    pair[1].fmu.reset()
    pair[1].initialize(position=-0.7)
    threads = [threading.Thread(target=lambda i=i: results.update({i: run(pair[i], 0.0, 500)})) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results[0] == expected
    assert results[1] != expected


@pytest.mark.slow
def test_many_instances_leave_nothing_behind(msd, tmp_path):
    psutil = pytest.importorskip("psutil")
    item = open_instance(msd, tmp_path)
    process = psutil.Process()

    def cycle(n):
        for _ in range(n):
            item.free()
            item.instantiate()
            item.initialize()
            state = item.fmu.getFMUState()
            item.step(0.0, 0.01)
            item.fmu.freeFMUState(state)

    cycle(300)
    before = process.memory_info().rss, process.num_threads(), process.num_fds()
    cycle(2000)
    assert process.memory_info().rss - before[0] < 1_000_000  # 2000 instances of 1.5 kB each would be 3 MB
    assert (process.num_threads(), process.num_fds()) == before[1:]
    item.fmu.freeInstance()


# ---- derivatives ----


def test_directional_and_adjoint_derivatives_equal_the_trace_and_the_running_fmu(pendulum, instance):
    spec = pendulums()
    item = instance(pendulum).initialize(torque=TORQUE)
    item.step(0.0, 0.3)
    x = np.concatenate([item["angle"], item["rate"], [item["clock"]]])
    f, g = spec.derivative.expand(), spec.output.expand()
    args = [item["time"], x, item["torque"], np.ravel(item["gain"])]
    knowns = {"time": 0, "angle": 1, "rate": 1, "torque": 2, "gain": 3}
    columns = {"angle": slice(0, 2), "rate": slice(2, 4)}
    unknowns = ((g, "deflection", slice(0, 2)), (f, "der(rate)", slice(2, 4)), (f, "der(angle)", slice(0, 2)))
    for function, unknown, rows in unknowns:
        for known, i in knowns.items():
            J = np.array(function.jacobian()(*args, function(*args))[i])[rows, columns.get(known, slice(None))]
            forward = [item.directional(unknown, known, e) for e in np.eye(J.shape[1])]
            np.testing.assert_allclose(np.transpose(forward), J, rtol=1e-12, atol=1e-13)
            if item.fmi == 3:  # FMI 2.0 has no adjoint derivatives
                reverse = [item.adjoint(unknown, known, e) for e in np.eye(J.shape[0])]
                np.testing.assert_allclose(reverse, J, rtol=1e-12, atol=1e-13)
    for e in np.eye(2):  # only inputs act at a communication point, on the next step
        state, ends = item.fmu.getFMUState(), []
        for sign in (-1, 1):
            item.step(0.3, 1e-6, torque=TORQUE + sign * e)
            ends.append(item["der(rate)"])
            item.fmu.setFMUState(state)
        item.fmu.freeFMUState(state)
        np.testing.assert_allclose(item.directional("der(rate)", "torque", e), (ends[1] - ends[0]) / 2, rtol=1e-6)
    assert item.directional("angle", "angle", [2.0, 3.0]) == [2.0, 3.0]  # a state that is an output
    if item.fmi == 3:
        assert item.adjoint("angle", "angle", [2.0, 3.0]) == [2.0, 3.0]
        assert item.directional("angle", "torque", [2.0, 3.0]) == [0.0, 0.0]


def test_directional_derivatives_during_initialization(msd, instance):
    item = instance(msd)
    item.fmu.setupExperiment() if item.fmi == 2 else None
    item.fmu.enterInitializationMode()
    assert item.directional("acceleration", "mass", [1.0]) == [pytest.approx(K * 0.1 / M**2)]
    item.fmu.exitInitializationMode()
    fails(item, lambda: item.directional("acceleration", "mass", [1.0]), "mass is no known in Step Mode")
    item.initialize()
    fails(item, lambda: item.directional("velocity", "force", [1.0]), "velocity is no unknown")
    if item.fmi == 3:
        item.initialize()
        fails(
            item, lambda: item.directional("acceleration", "force", [1.0, 2.0]), "1 value(s) are left over after force"
        )


# ---- events and the adaptive integrators ----


@pytest.fixture(scope="module")
def echoing(fmi):
    return build_fmu(echoing_ball(), fmi=fmi)


@pytest.mark.parametrize("integrator", [1, 2, 3])
def test_the_ball_bounces_inside_a_step(echoing, instance, integrator):
    """Parabolas are exact for each method, so only rounding is left."""
    item = instance(echoing).initialize(integrator=integrator)
    for k in range(10):
        item.step(0.25 * k, 0.25)
        height, velocity, n = flight(0.25 * (k + 1))
        assert (item["bounces"], item["echoes"]) == (n, n)
        assert item["height"] == pytest.approx(height, abs=1e-12)
        assert item["velocity"] == pytest.approx(velocity, abs=1e-11)


def test_the_ball_falls_alike_in_both_versions(instance):
    pair = [instance(build_fmu(echoing_ball(), fmi=fmi)).initialize() for fmi in (2, 3)]
    for k in range(20):
        for item in pair:
            item.step(0.125 * k, 0.125)
        two, three = ([item[n] for n in ("height", "velocity", "bounces")] for item in pair)
        assert two == three


@pytest.mark.parametrize("integrator", [1, 2, 3])
def test_a_run_cut_between_steps_continues_bit_identically(echoing, instance, integrator):
    """The integrator's step size and the domains are part of the state."""
    item = instance(echoing).initialize(integrator=integrator)
    for k in range(8):
        item.step(0.1 * k, 0.1)
    fresh = item.copied_to(instance(echoing))
    for k in range(8, 24):
        for one in (item, fresh):
            one.step(0.1 * k, 0.1)
        assert [item[n] for n in ("height", "velocity", "energy")] == [
            fresh[n] for n in ("height", "velocity", "energy")
        ]


@pytest.mark.slow
def test_a_stiff_model_in_steps_a_thousand_times_its_time_constant(fmi, instance):
    item = instance(build_fmu(stiff(), fmi=fmi)).initialize()
    for k in range(100):
        item.step(0.01 * k, 0.01)
    assert abs(item["error"]) < 1e-8  # the tolerance
    assert item["x"] == pytest.approx(np.cos(1.0), abs=1e-8)
    item = instance(build_fmu(stiff(), fmi=fmi))
    fails(item, lambda: item.initialize(integrator=4.0), "integrator", "was set to 4")


@pytest.mark.slow
def test_the_importers_tolerance_counts_unless_the_parameter_is_set_in_fmi_2(instance):
    item = instance(build_fmu(stiff(), fmi=2))
    item.fmu.setupExperiment(tolerance=1e-5)
    assert item["tolerance"] == 1e-5
    item.fmu.reset()
    item["tolerance"] = 1e-6
    item.fmu.setupExperiment(tolerance=1e-5)
    assert item["tolerance"] == 1e-6


# ---- errors at run time ----


def test_wrong_references_and_types(fmi, pendulum, instance):
    item = instance(pendulum)
    get, set_, name = (
        (item.fmu.getFloat64, item.fmu.setFloat64, "Float64")
        if item.fmi == 3
        else (item.fmu.getReal, item.fmu.setReal, "Real")
    )
    fails(item, lambda: get([99]), f"fmi{fmi}Get{name}: there is no", "value reference 99")
    fails(item, lambda: set_([99], [1.0]), f"fmi{fmi}Set{name}", "value reference 99")
    whole, flag = ("Int32", "Boolean") if item.fmi == 3 else ("Integer", "Boolean")
    refused = f"all variables of this FMU are {name}"
    fails(item, lambda: getattr(item.fmu, f"get{whole}")([0]), f"fmi{fmi}Get{whole}", refused)
    fails(item, lambda: getattr(item.fmu, f"set{flag}")([0], [True]), f"fmi{fmi}Set{flag}", refused)


def test_wrong_sizes(instance):
    item = instance(build_fmu(pendulums()))  # FMI 2.0 has scalars alone
    get, set_ = item.fmu.getFloat64, item.fmu.setFloat64
    fails(item, lambda: get([99]), "no Float64 variable with value reference 99", "lists 0 to 13")
    angle = item.references["angle"]
    fails(item, lambda: get([angle], 1), "angle takes 2 value(s), but 1 are left")
    fails(item, lambda: get([angle], 3), "1 value(s) are left over after angle")
    fails(item, lambda: set_([angle], [1.0]), "angle takes 2 value(s), but 1 are left")


def test_values_that_are_refused(fmi, msd, instance):
    item = instance(msd).initialize()
    item.step(0.0, 0.5)
    fails(item, lambda: item.step(0.5, 0.1, force=np.nan), f"plant: fmi{fmi}Set", "force", "nan at t = 0.5 s", "finite")
    fails(item, lambda: item.initialize(mass=-1.0), "mass", "was set to -1", "from 1e-06 to inf")
    fails(item, lambda: item.initialize(internal_step=0.0), "internal_step was set to 0 s, expected a positive")
    fails(item, lambda: item.initialize(position=np.inf), "position", "inf")
    item.initialize(internal_step=1e-12)
    fails(item, lambda: item.step(0.0, 0.1), "more than 1e9 pieces")


def test_what_may_be_set_when(fmi, msd, instance):
    item = instance(msd)
    fails(item, lambda: item["acceleration"], "acceleration is calculated", f"fmi{fmi}EnterInitializationMode first")
    fails(item, lambda: item.initialize(acceleration=1.0), "acceleration is calculated")
    why = "time is the independent variable" if item.fmi == 3 else "fmi2DoStep advances it"
    fails(item, lambda: item.initialize(time=1.0), why)
    for name, why in (("mass", "fixed parameter"), ("position", "is a state"), ("integrator", "fixed parameter")):
        item.initialize()
        where = f"fmi{fmi}ExitInitializationMode"
        fails(item, lambda name=name: item.step(0.0, 0.1, **{name: 1.0}), name, why, where)
    item.initialize()
    item.fmu.terminate()
    assert item["position"] == 0.1
    fails(item, lambda: item.step(0.0, 0.1, force=1.0), "force can't be set in state Terminated")


def test_calls_out_of_order(fmi, msd, instance):
    item = instance(msd)
    fails(item, lambda: item.step(0.0, 0.1), f"fmi{fmi}DoStep was called in state Instantiated, expected Step Mode")
    leave = f"fmi{fmi}ExitInitializationMode was called in state Instantiated"
    fails(item, item.fmu.exitInitializationMode, leave)
    fails(item, item.fmu.terminate, f"fmi{fmi}Terminate")
    item.initialize()
    fails(item, item.fmu.enterInitializationMode, "called in state Step Mode, expected Instantiated")


def test_calls_of_one_version_out_of_order(msd, instance):
    item = instance(msd).initialize()
    if item.fmi == 3:
        fails(item, item.fmu.enterEventMode, "hasEventMode = false")
        fails(item, item.fmu.enterConfigurationMode, "no structural parameters")
        fails(item, lambda: item.fmu.getOutputDerivatives([1], [1]), "maxOutputDerivativeOrder is 0")
    else:
        fails(item, lambda: item.fmu.setupExperiment(), "fmi2SetupExperiment was called in state Step Mode", "FMI 2.0")
        fails(item, lambda: item.fmu.setupExperiment(startTime=np.inf), "startTime is inf s")
        fails(item, lambda: item.fmu.getRealOutputDerivatives([5], [1]), "maxOutputDerivativeOrder is 0")
        item.initialize()
        fails(item, item.fmu.cancelStep, "every step is complete when fmi2DoStep returns")


def test_steps_that_are_refused(msd, instance):
    item = instance(msd, stop_time=0.3).initialize()
    fails(item, lambda: item.step(0.5, 0.1), "currentCommunicationPoint is 0.5 s, but this FMU is at 0 s")
    for h in (0.0, -0.1):
        item.initialize()
        fails(item, lambda h=h: item.step(0.0, h), f"communication step is {h:g} s")
    item.initialize()
    for k in range(3):
        item.step(k * 0.1, 0.1)  # 0.2 + 0.1 > 0.3: rounding doesn't count
    given = ("fmi2SetupExperiment",) if item.fmi == 2 else ()
    fails(item, lambda: item.step(0.3, 0.1), "passes the stop time of 0.3 s", *given)


def test_the_status_of_a_step_in_fmi_2(instance):
    item = instance(build_fmu(mass_spring_damper(), fmi=2)).initialize()
    item.step(0.0, 0.1)
    time, ended = ctypes.c_double(), ctypes.c_int(7)
    last, terminated = fmpy.fmi2.fmi2LastSuccessfulTime, fmpy.fmi2.fmi2Terminated
    assert item.fmu.fmi2GetRealStatus(item.fmu.component, last, ctypes.byref(time)) == fmpy.fmi2.fmi2OK
    assert item.fmu.fmi2GetBooleanStatus(item.fmu.component, terminated, ctypes.byref(ended)) == fmpy.fmi2.fmi2OK
    assert (time.value, ended.value) == (0.1, 0)
    with pytest.raises(fmpy.fmi1.FMICallException) as caught:
        item.fmu.fmi2GetStatus(item.fmu.component, fmpy.fmi2.fmi2DoStepStatus, ctypes.byref(ended))
    assert caught.value.status == fmpy.fmi2.fmi2Discard
    assert "fmi2GetStatus: every step is complete" in item.log[-1][2]
    item.step(0.1, 0.1)  # it has done no harm


@pytest.mark.slow
def test_a_state_that_explodes_stops_the_step(fmi, instance):
    item = instance(build_fmu(explosive(), fmi=fmi)).initialize()
    item.step(0.0, 0.5 + 1e-3)
    before = [item[name] for name in ("time", "calm", "x", "y")]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.5 + 1e-3, 2.0)
    assert [item[name] for name in ("time", "calm", "x", "y")] == before
    message = item.log[-1][2]
    assert "x (element 0) became" in message
    when = float(message.split("t = ")[1].split(" s")[0])
    assert 1.0 < when < 1.05  # the substep, not the end of the step


@pytest.mark.slow
def test_an_output_that_is_not_finite_stops_the_step(fmi, instance):
    item = instance(build_fmu(explosive(), fmi=fmi))
    fails(item, lambda: item.initialize(x=2.0), "y (element 0) became inf at t = 0 s")
    item.initialize()
    before = item["y"]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 0.9)
    assert re.search(r"y \(element 0\) became -?nan at t = 0.9 s", item.log[-1][2])
    assert (item["time"], item["calm"], item["x"], item["y"]) == (0.0, 0.0, 1.0, before)


def test_logging_is_quiet_unless_asked_and_by_category(msd, instance):
    item = instance(msd, name="100 %s #1")
    warning, unknown = (fmpy.fmi3.fmi3Warning, "logAllOfIt") if item.fmi == 3 else (fmpy.fmi2.fmi2Warning, "logEvents")
    if item.fmi == 3:
        item.fmu.setDebugLogging(False, [])
        with pytest.raises(fmpy.fmi1.FMICallException):
            item["force"] = np.nan
        assert item.log == []
        item.fmu.reset()
    item.fmu.setDebugLogging(True, ["logStatusWarning"])
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    assert item.log == []
    item.fmu.reset()
    if item.fmi == 2:  # all categories by one name
        item.fmu.setDebugLogging(True, ["logAll"])
        fails(item, lambda: item.get([99]), "100 %s ##1: fmi2GetReal")  # '#' marks a reference
    item.fmu.setDebugLogging(True, [unknown])
    assert item.log[-1][0] == warning
    assert f"no log category {unknown}" in item.log[-1][2]


def test_a_wrong_token_is_refused(msd, instance):
    item = instance(msd, name="x#1")
    item.free()
    right, item.fmu.guid = item.fmu.guid, "another"
    with pytest.raises(Exception, match="Failed to instantiate"):
        item.instantiate()
    word = "instantiation token" if item.fmi == 3 else "GUID"
    assert f"x##1: the {word} is another, expected {right}" in item.log[-1][2]  # '#' marks a reference
    item.fmu.guid = right
    item.instantiate()

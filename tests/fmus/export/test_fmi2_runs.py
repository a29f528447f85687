"""FMI 2.0 FMUs in Co-Simulation: the numbers, states, derivatives, what is refused."""

import ctypes
import threading

import fmpy
import fmpy.build
import fmpy.fmi2
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.fmus.export.package import build_fmu
from support.exported import D, K, M, explosive, pendulums, run
from support.exported2 import Instance2, fails2

# ---- the numbers ----


def test_free_motion_against_the_matrix_exponential(msd2):
    result = fmpy.simulate_fmu(str(msd2), stop_time=2.0, output_interval=0.01, output=["position", "velocity"])
    A = np.array([[0, 1], [-K / M, -D / M]])
    for t, position, velocity in result[::20]:
        assert (position, velocity) == pytest.approx(expm(A * t) @ [0.1, 0.0], abs=1e-12)


def test_arrays_and_time_against_dop853(pendulums2, instance2):
    def right(t, x):
        torque = np.array([[1.0, 2.0], [3.0, 4.0]]) @ [0.2, -0.1]
        return [*x[2:], *(torque - 9.81 * np.sin(x[:2]) - 0.1 * x[2:] + 0.5 * np.sin(3 * t))]

    item = instance2(pendulums2, start_time=0.25).initialize(internal_step=1e-3, torque=[0.2, -0.1])
    for k in range(20):
        item.step(0.25 + 0.05 * k, 0.05)
    truth = solve_ivp(right, (0.25, 1.25), [0.3, -0.2, 0, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert item["time"] == pytest.approx(1.25, abs=1e-15)
    np.testing.assert_allclose(np.concatenate([item["angle"], item["rate"]]), truth, rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["deflection"], np.sin(truth[:2]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["der(rate)"], right(1.25, truth)[2:], rtol=0, atol=1e-9)
    assert item["clock"] == 7.0


def test_the_same_bits_as_fmi_3(msd, msd2, pendulums2, instance, instance2):
    assert run(instance2(msd2).initialize(), 0.0, 300) == run(instance(msd).initialize(), 0.0, 300)
    vectors, scalars = instance(build_fmu(pendulums())), instance(build_fmu(pendulums(), arrays=False))
    two = instance2(pendulums2).initialize(torque=[0.2, -0.1])
    vectors.initialize(torque=[0.2, -0.1])
    scalars.initialize(**{"torque[1]": 0.2, "torque[2]": -0.1})
    for k in range(100):
        for item in (vectors, scalars, two):
            item.step(0.02 * k, 0.02)
    for name in ("angle", "rate", "deflection", "der(rate)"):
        first, bracket, rest = name.partition(")")
        elements = [f"{first}[{i}]{bracket}{rest}" for i in (1, 2)]
        assert vectors[name].tolist() == two[name].tolist() == [scalars[n] for n in elements]


def test_outputs_belong_to_the_last_communication_point(msd2, instance2):
    """FMI 2.0, 4.2.1: an input that is set counts from the next step on."""
    item = instance2(msd2).initialize(force=1.0)
    for k in range(3):
        before = [item[name] for name in ("position", "acceleration", "der(velocity)")]
        item["force"], item["damping"] = 1.0 + k, D + k
        assert [item[name] for name in ("position", "acceleration", "der(velocity)")] == before
        item.step(k * 0.1, 0.1)
        expected = (1.0 + k - (D + k) * item["velocity"] - K * item["position"]) / M
        assert item["acceleration"] == pytest.approx(expected, rel=1e-14)


def test_start_values_are_set_and_reset(msd2, instance2):
    item = instance2(msd2, start_time=2.0).initialize(mass=4.0, position=0.5)
    assert (item["acceleration"], item["time"]) == (-K * 0.5 / 4.0, 2.0)
    item.step(2.0, 0.1)
    item.fmu.reset()
    assert (item["mass"], item["position"], item["time"]) == (M, 0.1, 0.0)
    assert item.initialize()["acceleration"] == -K * 0.1 / M


# ---- states and derivatives ----


def test_a_saved_state_resumes_bit_identically(msd2, instance2):
    item = instance2(msd2).initialize(internal_step=3e-3, stiffness=20.0)
    run(item, 0.0, 50)
    state = item.fmu.getFMUstate()
    data = item.fmu.serializeFMUstate(state)
    expected = run(item, 0.5, 50)
    item.fmu.setFMUstate(state)
    assert run(item, 0.5, 50) == expected
    item.fmu.freeFMUstate(state)

    fresh = instance2(msd2)
    restored = fresh.fmu.deSerializeFMUstate(data)
    fresh.fmu.setFMUstate(restored)
    fresh.fmu.freeFMUstate(restored)
    assert fresh["stiffness"] == 20.0
    assert run(fresh, 0.5, 50) == expected


def test_states_of_others_are_refused(msd2, pendulums2, instance2):
    item, other = instance2(msd2), instance2(pendulums2)
    state = other.fmu.getFMUstate()
    data = other.fmu.serializeFMUstate(state)
    other.fmu.freeFMUstate(state)
    fails2(item, lambda: item.fmu.deSerializeFMUstate(data), "no state of this FMU")
    fails2(item, lambda: item.fmu.setFMUstate(None), "the state is NULL")


def test_directional_derivatives_equal_the_trace_and_finite_differences(pendulums2, instance2):
    spec = pendulums()
    f, g = spec.derivative.expand(), spec.output.expand()
    item = instance2(pendulums2).initialize(torque=[0.2, -0.1])
    item.step(0.0, 0.3)
    x = np.concatenate([item["angle"], item["rate"], [7.0]])
    knowns = {"time": 0, "angle": 1, "rate": 1, "torque": 2, "gain": 3}
    args = [item["time"], x, item["torque"], item["gain"]]
    columns = {"angle": slice(0, 2), "rate": slice(2, 4)}
    unknowns = ((g, "deflection", slice(0, 2)), (f, "der(rate)", slice(2, 4)), (f, "der(angle)", slice(0, 2)))
    for function, unknown, rows in unknowns:
        for known, i in knowns.items():
            J = np.array(function.jacobian()(*args, function(*args))[i])[rows, columns.get(known, slice(None))]
            got = np.transpose([item.directional(unknown, known, e) for e in np.eye(J.shape[1])])
            np.testing.assert_allclose(got, J, rtol=1e-12, atol=1e-13)
    for i in range(2):  # by the running FMU itself: only inputs act at a communication point, on the next step
        state, e = item.fmu.getFMUstate(), np.eye(2)[i]
        ends = []
        for sign in (-1, 1):
            item.step(0.3, 1e-6, torque=np.array([0.2, -0.1]) + sign * e)
            ends.append(item["der(rate)"])
            item.fmu.setFMUstate(state)
        item.fmu.freeFMUstate(state)
        np.testing.assert_allclose(item.directional("der(rate)", "torque", e), (ends[1] - ends[0]) / 2, rtol=1e-6)


def test_two_instances_in_two_threads_are_independent(msd2, instance2):
    expected = run(instance2(msd2).initialize(), 0.0, 500)
    pair, results = [instance2(msd2).initialize(), instance2(msd2).initialize(position=-0.7)], {}
    threads = [threading.Thread(target=lambda i=i: results.update({i: run(pair[i], 0.0, 500)})) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results[0] == expected
    assert results[1] != expected


@pytest.mark.slow
def test_many_instances_leave_nothing_behind(msd2, tmp_path):
    psutil = pytest.importorskip("psutil")
    item = Instance2(msd2, tmp_path)
    process = psutil.Process()

    def cycle(n):
        for _ in range(n):
            item.fmu.fmi2FreeInstance(item.fmu.component)
            item.fmu.instantiate(callbacks=item.callbacks, loggingOn=True)
            item.initialize()
            state = item.fmu.getFMUstate()
            item.step(0.0, 0.01)
            item.fmu.freeFMUstate(state)

    cycle(300)
    before = process.memory_info().rss, process.num_threads(), process.num_fds()
    cycle(2000)
    assert process.memory_info().rss - before[0] < 1_000_000  # 2000 instances of 1.5 kB each would be 3 MB
    assert (process.num_threads(), process.num_fds()) == before[1:]
    item.fmu.freeInstance()


# ---- errors ----


def test_values_that_are_refused(msd2, instance2):
    item = instance2(msd2).initialize()
    item.step(0.0, 0.5)
    fails2(item, lambda: item.step(0.5, 0.1, force=np.nan), "plant: fmi2SetReal: force", "nan at t = 0.5 s", "finite")
    fails2(item, lambda: item.initialize(mass=-1.0), "mass", "was set to -1", "from 1e-06 to inf")
    fails2(item, lambda: item.fmu.getReal([99]), "fmi2GetReal: there is no", "value reference 99")
    fails2(item, lambda: item.fmu.getInteger([0]), "fmi2GetInteger: all variables of this FMU are Real")
    fails2(item, lambda: item.fmu.setBoolean([0], [1]), "fmi2SetBoolean: all variables of this FMU are Real")


def test_what_may_be_set_when(msd2, instance2):
    item = instance2(msd2)
    fails2(item, lambda: item["acceleration"], "acceleration is calculated", "fmi2EnterInitializationMode first")
    fails2(item, lambda: item.initialize(time=1.0), "fmi2DoStep advances it")
    for name, why in (("mass", "fixed parameter"), ("position", "is a state"), ("integrator", "fixed parameter")):
        item.initialize()
        fails2(item, lambda name=name: item.step(0.0, 0.1, **{name: 1.0}), name, why, "fmi2ExitInitializationMode")


def test_calls_out_of_order(msd2, instance2):
    item = instance2(msd2, stop_time=0.3)
    fails2(item, lambda: item.step(0.0, 0.1), "fmi2DoStep was called in state Instantiated", "FMI 2.0")
    fails2(item, item.fmu.exitInitializationMode, "fmi2ExitInitializationMode was called in state Instantiated")
    fails2(item, item.fmu.terminate, "fmi2Terminate")
    item.initialize()
    fails2(item, lambda: item.fmu.setupExperiment(), "fmi2SetupExperiment was called in state Step Mode")
    item.initialize()
    fails2(item, lambda: item.step(0.5, 0.1), "currentCommunicationPoint is 0.5 s, but this FMU is at 0 s")
    item.initialize()
    fails2(item, lambda: item.step(0.0, -0.1), "communication step is -0.1 s")
    item.initialize()
    for k in range(3):
        item.step(k * 0.1, 0.1)  # 0.2 + 0.1 > 0.3: rounding doesn't count
    fails2(item, lambda: item.step(0.3, 0.1), "passes the stop time of 0.3 s", "fmi2SetupExperiment")
    fails2(item, lambda: item.fmu.setupExperiment(startTime=np.inf), "startTime is inf s")


def test_refused_functions_say_why(msd2, instance2):
    item = instance2(msd2).initialize()
    fails2(item, lambda: item.fmu.getRealOutputDerivatives([5], [1]), "maxOutputDerivativeOrder is 0")
    fails2(item, item.fmu.cancelStep, "every step is complete when fmi2DoStep returns")


def test_status_of_a_step(msd2, instance2):
    item = instance2(msd2).initialize()
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


def test_a_state_that_explodes_stops_the_step(instance2):
    item = instance2(build_fmu(explosive(), fmi=2)).initialize()
    item.step(0.0, 0.5)
    before = [item[name] for name in ("time", "calm", "x", "y")]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.5, 2.0)
    assert [item[name] for name in ("time", "calm", "x", "y")] == before
    message = item.log[-1][2]
    assert "x (element 0) became" in message
    assert 1.0 < float(message.split("t = ")[1].split(" s")[0]) < 1.05  # the substep, not the end of the step


def test_logging_is_by_category_and_survives_percent_signs(msd2, instance2):
    item = instance2(msd2, name="100 %s #1")
    fails2(item, lambda: item.fmu.getReal([99]), "100 %s ##1: fmi2GetReal")  # '#' marks a reference
    item.fmu.setDebugLogging(True, ["logStatusWarning"])
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    assert len(item.log) == 1
    item.fmu.reset()
    item.fmu.setDebugLogging(True, ["logAll"])
    fails2(item, lambda: item.fmu.getReal([99]), "fmi2GetReal")
    item.fmu.setDebugLogging(True, ["logEvents"])
    assert item.log[-1][0] == fmpy.fmi2.fmi2Warning
    assert "no log category logEvents" in item.log[-1][2]


def test_wrong_guid_is_refused(msd2, instance2):
    item = instance2(msd2)
    item.fmu.fmi2FreeInstance(item.fmu.component)
    right, item.fmu.guid = item.fmu.guid, "another"
    with pytest.raises(Exception, match="Failed to instantiate"):
        item.fmu.instantiate(callbacks=item.callbacks, loggingOn=True)
    assert f"the GUID is another, expected {right}" in item.log[-1][2]
    item.fmu.guid = right
    item.fmu.instantiate(callbacks=item.callbacks)

"""Event Mode of FMI 3.0 Co-Simulation: doStep returns early, and the importer handles the event."""

import fmpy
import pytest

from loopwright.fmus import build_fmu
from support.exported import E, ball, bounces, bouncing_ball, counter
from support.instances import enter, fails

INTEGRATORS = (1, 2, 3)


@pytest.fixture(scope="module")
def ball_fmu(cache):
    return build_fmu(bouncing_ball())


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_do_step_returns_early_at_each_bounce(ball_fmu, instance, integrator):
    item = instance(ball_fmu, eventModeUsed=True, earlyReturnAllowed=True)
    enter(item, integrator=integrator)
    t = 0.0
    for when, speed in bounces(5):
        needed, terminate, early, last = item.step(t, 10.0)
        assert (needed, terminate, early) == (True, False, True)
        assert last == item["time"] == pytest.approx(when, abs=1e-12)
        assert item["velocity"] == pytest.approx(-speed / E, abs=1e-11)  # the jump is still to come
        assert -1e-14 < item["height"] <= 0.0
        item.fmu.enterEventMode()
        assert item.fmu.updateDiscreteStates() == (False, False, False, True, False, 0.0)
        assert item["velocity"] == pytest.approx(speed, abs=1e-11)
        assert item.fmu.updateDiscreteStates()[0] is False  # once is enough
        assert item["velocity"] == pytest.approx(speed, abs=1e-11)
        item.fmu.enterStepMode()
        t = last
    assert item.step(t, 0.01) == (False, False, False, t + 0.01)


def test_without_early_return_events_are_handled_inside(ball_fmu, instance):
    item = instance(ball_fmu, eventModeUsed=True)
    enter(item)
    assert item.step(0.0, 2.0) == (False, False, False, 2.0)
    assert [item["height"], item["velocity"]] == pytest.approx(list(ball(2.0)), abs=1e-11)


def test_an_unhandled_event_is_not_passed_over(ball_fmu, instance):
    item = instance(ball_fmu, eventModeUsed=True, earlyReturnAllowed=True)
    enter(item)
    last = item.step(0.0, 1.0)[3]
    assert item.step(last, 1.0) == (True, False, True, last)


@pytest.mark.slow
def test_outputs_follow_the_inputs_in_event_mode(instance):
    spec = counter(lambda t, x, u, p, fired: [x[0], x[1] + fired[0]])
    item = instance(build_fmu(spec), eventModeUsed=True, earlyReturnAllowed=True)
    enter(item)
    item["u"] = 0.5
    assert item["y"] == 0.0  # Step Mode: that of the last step
    item.fmu.enterEventMode()
    assert item["y"] == 0.5
    item["u"], item["v"] = 3.0, 1.0
    assert item["y"] == 3.0
    assert item.fmu.updateDiscreteStates() == (False, False, False, False, False, 0.0)  # n is no continuous state
    assert item["n"] == 1.0
    item["u"] = 0.0
    item.fmu.updateDiscreteStates()
    assert item["n"] == 2.0
    item.fmu.enterStepMode()
    assert item.step(0.0, 1.0) == (False, False, False, 1.0)
    assert item.step(1.0, 1.0, u=2.0) == (True, False, True, 1.0)  # the input's jump is an event at once


def test_event_mode_in_fmpy(ball_fmu):
    result = fmpy.simulate_fmu(
        str(ball_fmu),
        fmi_type="CoSimulation",
        stop_time=2.2,
        output_interval=0.02,
        use_event_mode=True,
        early_return_allowed=True,
        start_values={"integrator": 2},
    )
    errors = [abs(height - ball(t)[0]) for t, height in zip(result["time"], result["height"], strict=True)]
    assert max(errors) < 1e-11
    assert len(errors) > 110


def test_calls_out_of_order(ball_fmu, msd, instance):
    item = instance(ball_fmu)
    item.initialize()
    fails(item, item.fmu.enterEventMode, "no Event Mode. Instantiate it with eventModeUsed = fmi3True")
    item = instance(msd)
    item.initialize()
    fails(item, item.fmu.updateDiscreteStates, "hasEventMode = false")
    with pytest.raises(Exception, match="Failed to instantiate"):
        instance(msd, eventModeUsed=True)
    item = instance(ball_fmu, eventModeUsed=True)
    item.fmu.enterInitializationMode()
    item.fmu.exitInitializationMode()
    fails(item, lambda: item.step(0.0, 1.0), "fmi3DoStep was called in state Event Mode, expected Step Mode")
    enter(item)
    fails(item, item.fmu.updateDiscreteStates, "called in state Step Mode, expected Event Mode")
    enter(item)
    fails(item, item.fmu.enterStepMode, "called in state Step Mode, expected Event Mode")

"""Parameters without effect: what a report doesn't list changes no bit of a run."""

import numpy as np
import pytest

from loopwright import Diagram
from loopwright.blocks import PID, Gain, Integrator, Sine

VALUES = {"anti_windup": "clamping", "tracking_time": None, "clearance": 0.3, "b": 0.2, "c": 0.7}


@pytest.mark.parametrize(
    ("given", "idle"),
    [
        ({"kp": 4.0}, {"anti_windup", "tracking_time", "clearance", "c"}),
        ({"kp": 4.0, "kd": 1.0, "filter_time": 0.1}, {"anti_windup", "tracking_time", "clearance"}),
        ({"kp": 4.0, "ki": 2.0}, {"anti_windup", "tracking_time", "clearance", "c"}),
        ({"kp": 4.0, "ki": 2.0, "lower": -1.0, "upper": 1.0}, {"clearance", "c"}),
        (
            {"kp": 4.0, "ki": 2.0, "lower": -1.0, "upper": 1.0, "anti_windup": "clamping"},
            {"tracking_time", "c"},
        ),
        ({"kp": 0.0, "ki": 2.0}, {"anti_windup", "tracking_time", "clearance", "b", "c"}),
    ],
)
@pytest.mark.drawn(3)
def test_a_controllers_idle_parameters_change_no_bit(given, idle):
    def run(**more):
        plant = Integrator(name="plant")
        pid = PID(**{**given, **more}, name="pid")
        return np.asarray(Diagram("d", plant(pid(r=Sine(frequency=2.0), y=plant.y))).simulate(2.0)["plant.y"])

    assert PID(**given).idle_parameters == idle
    straight = run()
    for name in idle:
        if VALUES[name] is not None:
            assert np.array_equal(run(**{name: VALUES[name]}), straight), name
    if "clearance" in PID(kp=1.0).idle_parameters:
        assert Gain(gain=1.0).idle_parameters == frozenset()

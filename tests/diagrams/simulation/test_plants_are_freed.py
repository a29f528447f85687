"""Every FMU instance that a run makes is terminated and freed once, whatever happens to the run."""

from collections import Counter

import fmpy.fmi3
import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Gain, Input, Output, PathDomainError, Step
from loopwright.diagrams import Diagram, NonFiniteError, experiments
from loopwright.fmus import Fmu, FmuRuntimeError, gantry
from support.counted import stepped_by_python

pytestmark = pytest.mark.one_tier  # it counts calls

CALLS = ("instantiate", "exitInitializationMode", "terminate", "freeInstance", "freeLibrary")
REST = {"motor_force": (0.0, 0.0), "external_force": (0.0, 0.0)}


@pytest.fixture
def calls(monkeypatch):
    """What was called on instances, in order: pairs of instance and function. Each call is also made."""
    made = []

    def counting(name, call):
        def wrapper(self, *arguments, **keywords):
            made.append((id(self), name))
            kept.append(self)
            return call(self, *arguments, **keywords)

        return wrapper

    kept = []  # so that no two instances share an id
    for name in CALLS:
        monkeypatch.setattr(fmpy.fmi3.FMU3Slave, name, counting(name, getattr(fmpy.fmi3.FMU3Slave, name)))
    return made


def lives(calls):
    """What was called on each instance, in the order of their making."""
    found = {}
    for instance, name in calls:
        found.setdefault(instance, []).append(name)
    return list(found.values())


COMPLETE = ["instantiate", "exitInitializationMode", "terminate", "freeInstance", "freeLibrary"]


@pytest.fixture(scope="module")
def file():
    return gantry.build()


def resting(file, **start):
    return Fmu(file, name="plant", start={**REST, **start})


def test_after_a_run(calls, file):
    run = Diagram("d", resting(file)()).simulate(0.01, step=1e-3, progress=False)
    assert len(run.t) == 11
    assert lives(calls) == [COMPLETE]


def test_after_each_of_several_runs(calls, file):
    diagram = Diagram("d", resting(file)())
    first, second = (diagram.simulate(0.01, step=1e-3, progress=False) for _ in range(2))
    assert np.array_equal(first.data, second.data)
    assert lives(calls) == [COMPLETE] * 2


def test_after_a_run_with_two_plants(calls, file):
    Diagram("d", resting(file)(), resting(file).replace(name="other")()).simulate(0.01, step=1e-3, progress=False)
    assert lives(calls) == [COMPLETE] * 2


def test_after_a_guard_in_the_middle(calls):
    with pytest.raises(PathDomainError) as error:
        experiments.hand_guiding(tool_mass=5.0).simulate(progress=False)  # unstable (E25)
    assert len(error.value.run.t) > 10
    assert lives(calls) == [COMPLETE]


def test_after_a_value_that_is_not_finite(calls, file):
    class Root(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return np.sqrt(u.u)

    below = Gain(gain=-1.0)(Step(times=0.005, values=1.0))
    with pytest.raises(NonFiniteError) as error:
        Diagram("d", resting(file)(), Root(name="root")(below)).simulate(0.01, step=1e-3, progress=False)
    assert error.value.t == 0.005
    assert lives(calls) == [COMPLETE]


def test_after_a_step_that_failed_it_is_freed_but_not_terminated(calls, file):
    # FMI 3.0, 2.3.1: after an error terminate is not allowed, freeing is
    light = resting(file, translational_mass=(1e-10, 1.0), equivalent_mass=(0.0, 1.0))
    push = Gain(gain=(1.0, 0.0))(Step(times=0.005, values=1e300))
    with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0\.005 s"):
        Diagram("d", light(motor_force=push)).simulate(0.01, step=1e-3, progress=False)
    assert lives(calls) == [["instantiate", "exitInitializationMode", "freeInstance", "freeLibrary"]]


def test_after_an_initialization_that_failed(calls, file, monkeypatch):
    def fail(self):
        raise RuntimeError("refused")

    monkeypatch.setattr(fmpy.fmi3.FMU3Slave, "exitInitializationMode", fail)
    with pytest.raises(FmuRuntimeError, match="initialization failed"):
        Diagram("d", resting(file)()).simulate(0.01, step=1e-3, progress=False)
    assert lives(calls) == [["instantiate", "freeInstance", "freeLibrary"]]


def test_the_first_plant_too_where_the_second_one_cannot_start(calls, file, monkeypatch):
    count = Counter()
    go = fmpy.fmi3.FMU3Slave.exitInitializationMode

    def second_fails(self):
        count["calls"] += 1
        if count["calls"] == 2:
            raise RuntimeError("refused")
        return go(self)

    monkeypatch.setattr(fmpy.fmi3.FMU3Slave, "exitInitializationMode", second_fails)
    with pytest.raises(FmuRuntimeError, match="initialization failed"):
        Diagram("d", resting(file)(), resting(file).replace(name="other")()).simulate(0.01, step=1e-3, progress=False)
    assert lives(calls) == [COMPLETE, ["instantiate", "freeInstance", "freeLibrary"]]


def test_after_an_interruption(calls, file, monkeypatch):
    # Ctrl-C within a step of the plant, in the 51st tick
    from loopwright.fmus.fmu_block.fmu import FmuInstance

    bind = FmuInstance.bind

    def interrupted(self, *arguments):
        bind(self, *arguments)
        step, count = self.step, Counter()

        def stepping(t, h):
            count["steps"] += 1
            if count["steps"] == 51:
                raise KeyboardInterrupt
            step(t, h)

        self.step = stepping

    monkeypatch.setattr(FmuInstance, "bind", interrupted)
    stepped_by_python(monkeypatch)
    with pytest.raises(KeyboardInterrupt) as error:
        Diagram("d", resting(file)()).simulate(0.1, step=1e-3, progress=False)
    assert lives(calls) == [COMPLETE]
    assert len(error.value.run.t) == 51  # the tick from which that step starts was recorded
    monkeypatch.undo()
    again = Diagram("d", resting(file)()).simulate(0.1, step=1e-3, progress=False)
    assert np.array_equal(error.value.run.data, again.data[:51])


def test_a_plant_is_neither_loaded_nor_kept_without_a_run(calls, file):
    plant = resting(file)
    Diagram("d", plant(), Constant(value=1.0)).flatten(1e-3)
    assert calls == []

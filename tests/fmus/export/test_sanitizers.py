"""The C of exported FMUs under AddressSanitizer and UndefinedBehaviorSanitizer: no report, both versions."""

import os
import shutil
import subprocess
import sys

import pytest

from support import TESTS

# Each interface of both versions: a run, states, what is refused, a reset, the end. Runs in a process of its own, as the
# sanitizers have to be loaded before Python.
SCENARIO = """
import ctypes, pathlib, sys
import fmpy, fmpy.fmi2, fmpy.fmi3
from loopwright import build
from support.exported_diagrams import diagrams
from support.exported import bouncing_ball, mass_spring_damper, pendulums, thermostat, van_der_pol
from support.instances import open_instance
from loopwright.fmus import build_fmu

folder = pathlib.Path(sys.argv[1])


def refused(item, *calls):
    for call in calls:
        try:
            call()
        except fmpy.fmi1.FMICallException:
            item.fmu.reset()
            item.initialize()
        else:
            raise AssertionError("not refused")


def step(item, integrator):
    two = item.fmi == 2
    item.initialize(integrator=integrator)
    for k in range(20):
        item.step(0.05 * k, 0.05)
    fmu = item.fmu
    state = fmu.getFMUState()
    data = fmu.serializeFMUState(state)
    fmu.freeFMUState(state)
    state = fmu.deserializeFMUState(data)
    fmu.setFMUState(state)
    fmu.freeFMUState(state)
    item.step(1.0, 0.05)
    get = fmu.getReal if two else fmu.getFloat64
    refused(item, lambda: get([999]), lambda: item.step(0.0, float("nan")), lambda: fmu.deserializeFMUState(b"x"))


def exchange(item, n, n_events):
    two = item.fmi == 2
    fmu, vector = item.fmu, lambda m: (ctypes.c_double * m)()
    for _ in range(2):
        item.initialize()
        x, z, dx = vector(n), vector(n_events), vector(n)
        for k in range(200):
            while (fmu.newDiscreteStates() if two else fmu.updateDiscreteStates())[0]:
                pass
            fmu.enterContinuousTimeMode()
            fmu.getContinuousStates(x, n)
            (fmu.getDerivatives if two else fmu.getContinuousStateDerivatives)(dx, n)
            fmu.setTime(0.01 * (k + 1))
            fmu.setContinuousStates((ctypes.c_double * n)(*(a + 0.01 * b for a, b in zip(x, dx))), n)
            if n_events:
                fmu.getEventIndicators(z, n_events)
            fmu.enterEventMode()
        refused(item, lambda: fmu.getContinuousStates(x, n + 1), lambda: fmu.setTime(float("nan")))
        fmu.reset()


models = ((bouncing_ball, 2, 1), (mass_spring_damper, 2, 0), (pendulums, 5, 0), (thermostat, 1, 2), (van_der_pol, 2, 0))
for make, n, n_events in models:
    for fmi in (2, 3):
        path = build_fmu(make(), fmi=fmi)
        for integrator in (3,) if make is van_der_pol else (1, 2, 3, None):  # it is stiff
            where, me = folder / f"{make.__name__}-{fmi}-{integrator}", integrator is None
            item = open_instance(path, where, model_exchange=me)
            exchange(item, n, n_events) if me else step(item, integrator)
            item.free()


# Diagrams: every function in every state; what is refused there is an error, and the instance is reset.
def in_every_state(path, where):
    item = open_instance(path, where)
    fmu, two = item.fmu, item.fmi == 2
    get, put = (fmu.getReal, fmu.setReal) if two else (fmu.getFloat64, fmu.setFloat64)

    def states():
        state = fmu.getFMUState()
        data = fmu.serializeFMUState(state)
        fmu.setFMUState(state)
        fmu.freeFMUState(state)
        state = fmu.deserializeFMUState(data)
        fmu.setFMUState(state)
        fmu.freeFMUState(state)

    def variables():
        for name in item.references:

            item[name]
            refused_or_not(lambda: item.__setitem__(name, item[name]))

    def step():
        t = get([0], 1)[0] if not two else get([0])[0]
        fmu.doStep(t, 0.013)
        fmu.doStep(t + 0.013, 0.2)

    def refused_or_not(call):
        try:
            call()
        except fmpy.fmi1.FMICallException:
            return False
        return True

    to_state = (
        lambda: None,
        lambda: fmu.enterInitializationMode(**({} if two else {"startTime": 0.0})),
        lambda: fmu.exitInitializationMode(),
        step,
        fmu.terminate,
    )
    calls = (variables, states, step, fmu.terminate, fmu.reset, lambda: fmu.enterInitializationMode(),
             lambda: fmu.exitInitializationMode(), lambda: get([9999]), lambda: put([9999], [0.0]))
    done = 0
    for depth in range(len(to_state) + 1):
        for call in calls:
            fmu.reset()
            for go in to_state[:depth]:
                go()
            done += refused_or_not(call)
    assert done > 20, done
    item.free()


for diagram in diagrams():
    for fmi in (2, 3):
        in_every_state(build(diagram, fmi=fmi), folder / f"{diagram.wired.name}-{fmi}")
print("all done")
"""


@pytest.mark.slow
def test_no_report(tmp_path):
    gcc = shutil.which("gcc")
    if gcc is None or sys.platform != "linux":
        pytest.skip("the sanitizers are those of gcc on Linux")

    def library(name):
        done = subprocess.run([gcc, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    flags = "-g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer"
    environment = os.environ | {
        "LOOPWRIGHT_CACHE": str(tmp_path / "cache"),
        "LOOPWRIGHT_CC": f"{gcc} {flags}",
        "LD_PRELOAD": f"{library('libasan.so')}:{library('libubsan.so')}",
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join([str(TESTS), *filter(None, sys.path)]),
    }
    command = [sys.executable, "-c", SCENARIO, str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("all done\n")
    assert "runtime error" not in done.stderr

"""Exported FMUs of both versions under FMPy's low-level interface, by names, with what they log."""

import ctypes
import os
from functools import cache

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np
import pytest


def described(path):
    """Return FMPy's description of an FMU, read once for each file."""
    return _described(str(path), os.stat(path).st_mtime_ns)


@cache
def _described(path, changed):
    return fmpy.read_model_description(path)


class Instance:
    """An FMU of FMI 2.0 or 3.0, stepped or for Model Exchange; a vector is read and set as a whole in both."""

    fmi: int

    def __init__(self, path, folder, *, start_time=0.0, stop_time=None):
        self.description = described(path)
        self.folder, self.start_time, self.stop_time, self.log = folder, start_time, stop_time, []
        self.n_states = self.description.numberOfContinuousStates
        self.n_events = self.description.numberOfEventIndicators
        fmpy.extract(str(path), str(folder))

    def initialize(self, **start):
        for name, value in start.items():
            self[name] = value
        self.begin()
        return self

    def step(self, t, h, **inputs):
        for name, value in inputs.items():
            self[name] = value
        return self.fmu.doStep(t, h)

    def copied_to(self, other):
        """Bring the state of this instance into another one, as bytes."""
        state = self.fmu.getFMUState()
        data = self.fmu.serializeFMUState(state)
        self.fmu.freeFMUState(state)
        restored = other.fmu.deserializeFMUState(data)
        other.fmu.setFMUState(restored)
        other.fmu.freeFMUState(restored)
        return other


class Instance3(Instance):
    fmi = 3

    def __init__(self, path, folder, name="plant", model_exchange=False, start_time=0.0, stop_time=None, **options):
        super().__init__(path, folder, start_time=start_time, stop_time=stop_time)
        variables = self.description.modelVariables
        self.references = {v.name: v.valueReference for v in variables}
        self.sizes = {v.name: int(np.prod([d.start for d in v.dimensions] or [1])) for v in variables}
        self.fmu = (fmpy.fmi3.FMU3Model if model_exchange else fmpy.fmi3.FMU3Slave)(
            guid=self.description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=self.description.modelName,
            instanceName=name,
        )
        self.options = options
        self.instantiate()

    def instantiate(self):
        self.fmu.instantiate(loggingOn=True, logMessage=self._logged, **self.options)

    def free(self):
        """Free the instance; its library stays loaded."""
        self.fmu.fmi3FreeInstance(self.fmu.component)

    def _logged(self, environment, status, category, message):
        self.log.append((status, category.decode(), message.decode()))

    def begin(self):
        self.fmu.enterInitializationMode(startTime=self.start_time, stopTime=self.stop_time)
        self.fmu.exitInitializationMode()

    def get(self, references, count=None):
        return self.fmu.getFloat64(references, count)

    def __getitem__(self, name):
        values = self.get([self.references[name]], self.sizes[name])
        return values[0] if self.sizes[name] == 1 else np.array(values)

    def __setitem__(self, name, value):
        self.fmu.setFloat64([self.references[name]], np.ravel(value).tolist())

    def directional(self, unknown, known, seed):
        vr = self.references
        return self.fmu.getDirectionalDerivative([vr[unknown]], [vr[known]], list(seed), self.sizes[unknown])

    def adjoint(self, unknown, known, seed):
        vr = self.references
        return self.fmu.getAdjointDerivative([vr[unknown]], [vr[known]], list(seed), self.sizes[known])


class Instance2(Instance):
    fmi = 2

    def __init__(self, path, folder, name="plant", model_exchange=False, start_time=0.0, stop_time=None):
        super().__init__(path, folder, start_time=start_time, stop_time=stop_time)
        self.references = {}
        for v in self.description.modelVariables:
            self.references.setdefault(v.name, []).append(v.valueReference)
            if v.name.endswith("]"):
                self.references.setdefault(v.name.partition("[")[0], []).append(v.valueReference)
            elif v.name.endswith("])"):
                self.references.setdefault(v.name.partition("[")[0] + ")", []).append(v.valueReference)
        self.fmu = (fmpy.fmi2.FMU2Model if model_exchange else fmpy.fmi2.FMU2Slave)(
            guid=self.description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=self.description.modelName,
            instanceName=name,
        )
        self.callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        self.callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(self._logged)
        self.instantiate()

    def instantiate(self):
        self.fmu.instantiate(callbacks=self.callbacks, loggingOn=True)

    def free(self):
        """Free the instance; its library stays loaded."""
        self.fmu.fmi2FreeInstance(self.fmu.component)

    def _logged(self, environment, name, status, category, message):
        self.log.append((status, category.decode(), message.decode() % ()))  # a printf format

    def begin(self):
        self.fmu.setupExperiment(startTime=self.start_time, stopTime=self.stop_time)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def get(self, references):
        return self.fmu.getReal(references)

    def __getitem__(self, name):
        values = self.get(self.references[name])
        return values[0] if len(values) == 1 else np.array(values)

    def __setitem__(self, name, value):
        references = self.references[name]
        self.fmu.setReal(references, np.broadcast_to(np.ravel(value), len(references)).tolist())

    def directional(self, unknown, known, seed):
        return self.fmu.getDirectionalDerivative(self.references[unknown], self.references[known], list(seed))


def open_instance(path, folder, **options):
    """Instantiate an FMU of either version."""
    kind = Instance2 if described(path).fmiVersion == "2.0" else Instance3
    return kind(path, folder, **options)


def fails(item, call, *parts):
    """The call fails, and the log says why; the FMU is reset."""
    before = len(item.log)
    with pytest.raises(fmpy.fmi1.FMICallException):
        call()
    assert len(item.log) == before + 1, item.log[before:]
    status, category, message = item.log[-1]
    error = fmpy.fmi2.fmi2Error if item.fmi == 2 else fmpy.fmi3.fmi3Error
    assert (status, category) == (error, "logStatusError")
    for part in parts:
        assert part in message
    item.fmu.reset()


def run(item, t, n, h=0.01):
    for k in range(n):
        item.step(t + k * h, h, force=np.sin(t + k * h))
    return [item[name] for name in ("time", "position", "velocity", "acceleration", "der(velocity)")]


def enter(item, **start):
    """Initialize, and leave the Event Mode that follows."""
    for name, value in start.items():
        item[name] = value
    item.fmu.enterInitializationMode()
    item.fmu.exitInitializationMode()
    assert item.fmu.updateDiscreteStates() == (False, False, False, False, False, 0.0)
    item.fmu.enterStepMode()


def vector(n, values=()):
    return (ctypes.c_double * n)(*values)


class Exchange:
    """An instance for Model Exchange, of either version, with vectors as lists."""

    def __init__(self, item):
        self.item, self.fmu, self.fmi = item, item.fmu, item.fmi
        self.update = item.fmu.newDiscreteStates if item.fmi == 2 else item.fmu.updateDiscreteStates

    def start(self, **start):
        self.item.initialize(**start)
        self.flags = self.iterate()
        return self

    def iterate(self):
        """The event iteration; which calls ask for another one, and which have moved a continuous state."""
        flags = []
        while not flags or flags[-1][0]:
            done = self.update()
            assert done[1:3] == (False, False)
            assert done[4] is False
            flags.append((done[0], done[3]))
        self.fmu.enterContinuousTimeMode()
        return flags

    def event(self):
        self.fmu.enterEventMode()
        self.flags = self.iterate()
        return self.flags

    def _get(self, function, n):
        found = vector(n)
        function(found, n)
        return list(found)

    @property
    def x(self):
        return self._get(self.fmu.getContinuousStates, self.item.n_states)

    @property
    def dx(self):
        get = self.fmu.getDerivatives if self.fmi == 2 else self.fmu.getContinuousStateDerivatives
        return self._get(get, self.item.n_states)

    @property
    def z(self):
        return self._get(self.fmu.getEventIndicators, self.item.n_events)

    @property
    def nominals(self):
        return self._get(self.fmu.getNominalsOfContinuousStates, self.item.n_states)

    def set(self, t, x):
        self.fmu.setTime(t)
        self.fmu.setContinuousStates(vector(len(x), x), len(x))

    def rhs(self, t, x):
        self.set(t, x)
        return self.dx

    def runge_kutta(self, t, h):
        """One step in the operations of the runtime's own."""
        x = np.array(self.x)
        k1 = np.array(self.rhs(t, x))
        k2 = np.array(self.rhs(t + h / 2.0, x + h / 2.0 * k1))
        k3 = np.array(self.rhs(t + h / 2.0, x + h / 2.0 * k2))
        k4 = np.array(self.rhs(t + h, x + h * k3))
        self.set(t + h, x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4))
        assert self.fmi == 3 or self.fmu.completedIntegratorStep() == (False, False)

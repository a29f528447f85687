"""An FMI 2.0 FMU under FMPy's low-level interface, for the tests of its export."""

import fmpy
import fmpy.fmi2
import numpy as np
import pytest


class Instance2:
    """By names, a vector by the name without its indices; with what it logs."""

    def __init__(self, path, folder, name="plant", kind=fmpy.fmi2.FMU2Slave, start_time=0.0, stop_time=None):
        description = fmpy.read_model_description(str(path))
        self.references = {}
        for v in description.modelVariables:
            self.references.setdefault(v.name, []).append(v.valueReference)
            if v.name.endswith("]"):
                self.references.setdefault(v.name.partition("[")[0], []).append(v.valueReference)
            elif v.name.endswith("])"):
                self.references.setdefault(v.name.partition("[")[0] + ")", []).append(v.valueReference)
        self.log = []
        self.folder, self.start_time, self.stop_time = folder, start_time, stop_time
        fmpy.extract(str(path), str(folder))
        self.fmu = kind(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.modelName,
            instanceName=name,
        )
        self.callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        self.callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(self._logged)
        self.fmu.instantiate(callbacks=self.callbacks, loggingOn=True)

    def _logged(self, environment, name, status, category, message):
        self.log.append((status, category.decode(), message.decode() % ()))  # a printf format

    def initialize(self, **start):
        self.fmu.setupExperiment(startTime=self.start_time, stopTime=self.stop_time)
        for name, value in start.items():
            self[name] = value
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self

    def __getitem__(self, name):
        values = self.fmu.getReal(self.references[name])
        return values[0] if len(values) == 1 else np.array(values)

    def __setitem__(self, name, value):
        references = self.references[name]
        self.fmu.setReal(references, np.broadcast_to(np.ravel(value), len(references)).tolist())

    def step(self, t, h, **inputs):
        for name, value in inputs.items():
            self[name] = value
        return self.fmu.doStep(t, h)

    def directional(self, unknown, known, seed):
        return self.fmu.getDirectionalDerivative(self.references[unknown], self.references[known], list(seed))


def fails2(item, call, *parts):
    """The call fails, and the log says why; the FMU is reset."""
    before = len(item.log)
    with pytest.raises(fmpy.fmi1.FMICallException):
        call()
    assert len(item.log) == before + 1, item.log[before:]
    status, category, message = item.log[-1]
    assert (status, category) == (fmpy.fmi2.fmi2Error, "logStatusError")
    for part in parts:
        assert part in message
    item.fmu.reset()

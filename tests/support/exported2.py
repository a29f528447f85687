"""FMI 2.0 FMUs under FMPy's low-level interface, an importer for Model Exchange, and models with events: for the tests."""

import ctypes
import math

import casadi as ca
import fmpy
import fmpy.fmi2
import numpy as np
import pytest

from loopwright.fmus.export.model import EventSpec, ModelSpec, Variable


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


class Model:
    """An instance for Model Exchange, of FMI 2.0 or 3.0: rates, indicators and events by NumPy."""

    def __init__(self, item, n, n_events=0):
        self.item, self.fmu, self.n, self.n_events = item, item.fmu, n, n_events
        self.two = isinstance(item, Instance2)

    def start(self, **values):
        self.item.initialize(**values)
        self.flags = self.iterate()
        return self

    def iterate(self):
        """The event iteration; which calls ask for another one and which have moved a continuous state."""
        flags = []
        while not flags or flags[-1][0]:
            done = self.fmu.newDiscreteStates() if self.two else self.fmu.updateDiscreteStates()
            assert done[1:3] == (False, False)
            assert done[4] is False
            flags.append((done[0], done[3]))
        self.fmu.enterContinuousTimeMode()
        return flags

    def event(self):
        self.fmu.enterEventMode()
        self.flags = self.iterate()
        return self.flags

    def _vector(self, function, n):
        values = (ctypes.c_double * n)()
        function(values, n)
        return np.array(values)

    @property
    def x(self):
        return self._vector(self.fmu.getContinuousStates, self.n)

    @property
    def rates(self):
        return self._vector(self.fmu.getDerivatives if self.two else self.fmu.getContinuousStateDerivatives, self.n)

    @property
    def indicators(self):
        return self._vector(self.fmu.getEventIndicators, self.n_events)

    def move(self, t, x):
        self.fmu.setTime(t)
        self.fmu.setContinuousStates((ctypes.c_double * self.n)(*x), self.n)

    def f(self, t, x):
        self.move(t, x)
        return self.rates

    def runge_kutta(self, t, h):
        """One step in the operations of the runtime's own."""
        x = self.x
        k1 = self.f(t, x)
        k2 = self.f(t + h / 2.0, x + h / 2.0 * k1)
        k3 = self.f(t + h / 2.0, x + h / 2.0 * k2)
        k4 = self.f(t + h, x + h * k3)
        self.move(t + h, x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))
        assert self.two is False or self.fmu.completedIntegratorStep() == (False, False)


G, E = 9.81, 0.7


def ball():
    """A ball that bounces on the floor and counts it; ``flash`` fires at the same instant, and ``echo`` of the count."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 4), ca.SX.sym("u", 0), ca.SX.sym("p", 2)
    fired = ca.SX.sym("fired", 2)
    velocity = ca.if_else(fired[0], -p[1] * x[1], x[1])
    return ModelSpec(
        name="ball",
        description="A bouncing ball",
        inputs=(),
        outputs=(Variable("energy", "output", unit="J/kg"),),
        parameters=(
            Variable("gravity", "parameter", "fixed", unit="m/s2", start=G),
            Variable("restitution", "parameter", "tunable", unit="1", start=E, minimum=0.0, maximum=1.0),
        ),
        states=(
            Variable("height", "output", unit="m", start=1.0, state=True),
            Variable("velocity", "local", unit="m/s", start=0.0, state=True, nominal=4.0),
            Variable("bounces", "output", "discrete", unit="1", start=0.0, state=True),
            Variable("echoes", "local", "discrete", unit="1", start=0.0, state=True),
        ),
        derivative=ca.Function("f", [t, x, u, p], [ca.vertcat(x[1], -p[0])]),
        output=ca.Function("g", [t, x, u, p], [p[0] * x[0] + x[1] ** 2 / 2]),
        events=(
            EventSpec("bounce", "falling", "The floor"),
            EventSpec("echo", "rising", "After a bounce, at the same instant"),
        ),
        indicators=ca.Function("z", [t, x, u, p], [ca.vertcat(x[0], x[2] - x[3] - 0.5)]),
        jump=ca.Function("j", [t, x, u, p, fired], [ca.vertcat(x[0], velocity, x[2] + fired[0], x[3] + fired[1])]),
        internal_step=1e-2,
    )


def flight(t, e=E):
    """Height, velocity and bounces until t, in closed form: parabolas, each with the fraction e of the speed."""
    begin, up, n = -math.sqrt(2 / G), math.sqrt(2 * G), 0
    while t > begin + 2 * up / G:
        begin, up, n = begin + 2 * up / G, e * up, n + 1
    return up * (t - begin) - G * (t - begin) ** 2 / 2, up - G * (t - begin), n


def stiff():
    """x' = -rate (x - cos t) - sin t, whose solution from x(0) = 1 is cos t."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u", 0), ca.SX.sym("p")
    f = ca.Function("f", [t, x, u, p], [-p * (x - ca.cos(t)) - ca.sin(t)])
    g = ca.Function("g", [t, x, u, p], [x - ca.cos(t)])
    rate = (Variable("rate", "parameter", start=1e6, variability="fixed"),)
    state = (Variable("x", start=1.0, state=True),)
    return ModelSpec("stiff", "", (), (Variable("error", "output"),), rate, state, f, g, integrator="rodas")

"""Diagrams of many kinds leave as an FMU and come back: the numbers of their runs, or refused by the block's path.

The oracle is the run of the diagram itself, by the virtual machine, between whose samples nothing is exchanged; a wire
is compared where it is not just renewed by a tick, which an FMU takes with its next step.
"""

import numpy as np
import pytest

from loopwright import Fmu, build
from loopwright.blocks import (
    PID,
    Compare,
    Constant,
    DefinitionError,
    DiscreteStateSpace,
    Gain,
    Integrator,
    Lookup1D,
    OptionError,
    PulseTrain,
    PythonFunction,
    Relay,
    Sine,
    StateMachine,
    Step,
    Sum,
    Switch,
    TransferFunction,
    TransportDelay,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem

LAG = {"numerator": [1.0], "denominator": [0.1, 1.0]}


def cascade():
    """Three rates, with a plant in continuous time."""
    plant, motor = TransferFunction(**LAG, name="plant"), TransferFunction(numerator=[2.0], denominator=[0.02, 1.0])

    @subsystem(sample_time=0.02)
    def outer(wanted, speed):
        return PID(kp=1.0, ki=4.0)(wanted, speed).named("current_wanted")

    @subsystem(sample_time=0.005)
    def inner(wanted, current):
        return PID(kp=0.5, ki=30.0, lower=-5, upper=5)(wanted, current).named("voltage")

    @subsystem(sample_time=0.001)
    def drive(voltage):
        return Gain(gain=0.9)(voltage).named("bridge")

    current = motor(drive(inner(outer(Step(times=0.03, values=1.0), plant.y), motor.y))).named("current")
    return Diagram("cascade", plant(current).named("speed")), 0.5, 0.01, ("speed", "current"), 1e-6


def thermostat():
    """Events of a relay in continuous time."""
    room = TransferFunction(numerator=[0.3], denominator=[1.0, 0.1], name="room")
    relay = Relay(on_point=21.0, off_point=19.0, on_value=0.0, off_value=10.0, name="relay")
    return Diagram("thermostat", room(relay(room.y).named("heat")).named("warmth")), 30.0, 0.1, ("warmth", "heat"), 1e-4


def state_machine():
    """Modes in a sampled subsystem."""

    @subsystem(sample_time=0.01)
    def logic(level):
        machine = StateMachine(modes=("fill", "wait"), transitions={("fill", "wait"): "full", ("wait", "fill"): "old"})
        machine(full=Compare(">")(level, 0.8), old=Compare(">")(machine.time_in_mode, 0.3))
        return machine.fill.named("filling")

    tank = Integrator(name="tank")
    balance = Sum(signs="+-")(Gain(gain=2.0)(logic(tank.y)), Gain(gain=0.7)(tank.y))
    return Diagram("filling", tank(balance).named("level")), 3.0, 0.01, ("level",), 1e-6


def observer():
    """An observer with its state feedback, sampled."""
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 0.2, 0.0], name="plant")
    A = np.array([[0.998, 0.0], [0.00998, 1.0]])

    @subsystem(sample_time=0.01)
    def feedback(y):
        made = DiscreteStateSpace(A=A - 0.05, B=[0.3, 0.4], C=[1.2, 2.0], D=0.5, name="observer")(y)
        return Gain(gain=-1.0)(made).named("u")

    u = feedback(plant.y)
    drive = Sum(signs="++")(u, Step(times=0.1, values=1.0))
    return Diagram("observer", plant(drive).named("y")), 1.0, 0.01, ("y",), 1e-6


def dead_time():
    """A dead time in a sampled subsystem."""
    plant = TransferFunction(**LAG, name="plant")

    @subsystem(sample_time=0.01)
    def control(y):
        late = TransportDelay(delay=0.05, name="line")(y).named("late")
        return PID(kp=0.5, ki=2.0)(Constant(value=1.0), late).named("u")

    return Diagram("dead_time", plant(control(plant.y)).named("y")), 1.0, 0.01, ("y",), 1e-6


def table():
    """A table and a wave with edges in continuous time."""
    lookup = Lookup1D(breakpoints=[-1.0, 0.0, 1.0], values=[-2.0, 0.0, 0.5])
    wave = PulseTrain(amplitude=1.0, period=0.23, duty=0.4, delay=0.05)
    made = lookup(Sum(signs="+-")(Sine(frequency=2.0), wave)).named("looked_up")
    return Diagram("table", TransferFunction(**LAG)(made).named("y")), 1.0, 0.01, ("y", "looked_up"), 1e-6


def anti_windup():
    """Clamping in continuous time: the integral is held by events."""
    plant = TransferFunction(**LAG, name="plant")
    pid = PID(kp=2.0, ki=20.0, lower=-1.2, upper=1.2, anti_windup="clamping", name="pid")
    wanted = Step(times=(0.1, 0.6), values=(1.1, 0.4))
    return Diagram("clamped", plant(pid(wanted, plant.y).named("u")).named("y")), 1.0, 0.01, ("y", "u"), 1e-6


def triggered():
    """A subsystem that acts when a wave rises."""

    @subsystem(triggered="rising")
    def count(step):
        before = UnitDelay(initial_value=0.0, name="before")
        total = Sum(signs="++")(step, before.y)
        before(total)
        return total.named("number")

    wave = PulseTrain(amplitude=1.0, period=0.1, duty=0.5, delay=0.03)
    number = count(Constant(value=1.0), trigger=Compare(">")(wave, 0.5))
    return Diagram("triggered", TransferFunction(**LAG)(number).named("y")), 1.0, 0.01, ("y",), 1e-6


def solved_loop():
    """An algebraic loop that Newton's method solves, sampled, with a lag around it."""
    error, half = Sum(signs="+-", name="error"), Gain(gain=0.5, name="half")
    closing = error(Sine(frequency=1.0), half(error.y))
    return Diagram("solved", TransferFunction(**LAG)(closing).named("y"), loops="solve"), 1.0, 0.01, ("y",), 1e-6


def buck():
    """A converter with a switch at 1 kHz, by a sawtooth."""
    current, voltage = Integrator(name="current"), Integrator(name="voltage")
    pulses = PulseTrain(amplitude=1.0, period=1e-3, duty=0.4)
    source = Switch()(pulses, Constant(value=24.0), Constant(value=0.0))
    slope = Gain(gain=1 / 2e-3)(Sum(signs="+-")(source, voltage.y))
    charge = Gain(gain=1 / 1e-4)(Sum(signs="+-")(current.y, Gain(gain=0.5)(voltage.y)))
    return Diagram("buck", current(slope).named("i"), voltage(charge).named("v")), 0.01, 1e-4, ("v", "i"), 1e-5


KINDS = (cascade, thermostat, state_machine, observer, dead_time, table, anti_windup, triggered, solved_loop, buck)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_it_comes_back_with_the_numbers_of_its_run(kind, tmp_path):
    diagram, duration, h, names, tolerance = kind()
    options = {} if diagram.has_clock else {"step": h}
    run = diagram.simulate(duration, progress=False, rtol=1e-10, atol=1e-12, **options)
    fmu = Fmu(build(diagram, tmp_path, step_size=h, tolerance=1e-10), name="fmu")
    back = Diagram("back", Gain(gain=1.0)(getattr(fmu, names[0])).named("first"))
    found = back.simulate(duration, step=h, progress=False)
    index = np.round(found.t / (run.t[1] - run.t[0])).astype(int)
    np.testing.assert_allclose(run.t[index], found.t, rtol=1e-12)
    for name in names:
        scale = np.ptp(run[name])
        assert scale > 0.1
        np.testing.assert_allclose(found[f"fmu.{name}"][1:], run[name][index][1:], rtol=0, atol=tolerance * scale)


REFUSED = {
    "a Python function": (lambda: PythonFunction(lambda u: float(u) ** 2, name="own")(Sine(frequency=1.0)), "own"),
    "a dead time": (lambda: TransportDelay(delay=0.1, name="line")(Sine(frequency=1.0)), "line"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_leave_is_named_before_anything_is_built(kind):
    make, path = REFUSED[kind]
    diagram = Diagram("whole", TransferFunction(**LAG)(make()).named("y"))
    with pytest.raises(DefinitionError) as caught:
        build(diagram)
    assert caught.value.block == path


def test_a_solver_of_another_library_is_refused():
    diagram = Diagram("whole", TransferFunction(**LAG)(Sine(frequency=1.0)).named("y"))
    with pytest.raises(OptionError, match="'Radau' for a stiff diagram"):
        build(diagram, solver="BDF")

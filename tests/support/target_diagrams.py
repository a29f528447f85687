"""Sampled subsystems of several kinds in closed loops, for C that leaves: each diagram, the subsystem, its inputs."""

from functools import cache
from typing import Any

import numpy as np

from loopwright import Diagram, subsystem
from loopwright.blocks import (
    PID,
    And,
    Compare,
    Counter,
    DiscreteObserver,
    DiscreteStateSpace,
    Gain,
    Lookup1D,
    Lookup2D,
    RateLimiter,
    Saturation,
    Sine,
    SmoothStep,
    StateMachine,
    StateSpace,
    Step,
    Switch,
    TransferFunction,
)
from loopwright.diagrams.exporting import open_part, target_spec


@cache
def pid():
    """PID with a filtered derivative, that moves a first-order plant."""

    @subsystem(sample_time=1e-2)
    def controller(reference, level):
        """PI with a filtered derivative."""
        return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")

    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
    wanted = Step(times=0.05, values=1.0, name="wanted")
    return Diagram("level", plant(controller(wanted, plant.y)))


@cache
def cascade():
    """Three rates: current at 1 ms, speed at 2 ms, position at 6 ms with an offset, limits with anti-windup."""

    @subsystem(sample_time=1e-3)
    def current_loop(wanted, current):
        return PID(kp=1.5, ki=200.0, lower=-24.0, upper=24.0, name="pi")(wanted, current).named("voltage")

    @subsystem(sample_time=2e-3)
    def speed_loop(wanted, speed):
        return PID(kp=0.4, ki=3.0, lower=-5.0, upper=5.0, name="pi")(wanted, speed).named("wanted_current")

    @subsystem(sample_time=6e-3, offset=1e-3)
    def position_loop(wanted, position):
        return Saturation(lower=-20.0, upper=20.0, name="limit")(8.0 * (wanted - position)).named("wanted_speed")

    @subsystem(sample_time=1e-3)
    def controller(wanted, position, speed, current):
        return current_loop(speed_loop(position_loop(wanted, position), speed), current)

    A: Any = [[-200.0, -20.0, 0.0], [40.0, -1.0, 0.0], [0.0, 1.0, 0.0]]
    drive = StateSpace(A=A, B=[400.0, 0.0, 0.0], C=np.eye(3), D=np.zeros(3), name="drive")
    wanted = Step(times=0.0105, values=3.0, name="wanted")
    return Diagram("cascade", drive(controller(wanted, drive.y[2], drive.y[1], drive.y[0])))


@cache
def observer():
    """A discrete observer of a double integrator, with state feedback."""

    @subsystem(sample_time=0.02)
    def controller(wanted, y):
        A, B, C = [[1.0, 0.02], [0.0, 1.0]], [0.0002, 0.02], [1.0, 0.0]
        model = DiscreteStateSpace(A=A, B=B, C=C, D=0.0, dt=0.02)
        estimate = DiscreteObserver(model, [0.4, 2.2], name="observer")
        u = (9.0 * (wanted - estimate.x_hat[0]) - 5.0 * estimate.x_hat[1]).named("u")
        estimate(u, y)
        return u

    plant = StateSpace(A=[[0.0, 1.0], [0.0, -0.1]], B=[0.0, 1.0], C=[1.0, 0.0], D=0.0, name="plant")
    wanted = Step(times=0.1, values=1.0, name="wanted")
    return Diagram("observed", plant(controller(wanted, plant.y)))


@cache
def machine():
    """A state machine with logic: fill, hold, drain."""

    @subsystem(sample_time=0.05)
    def controller(level, permit):
        modes = StateMachine(
            modes=("idle", "fill", "drain"),
            transitions={("idle", "fill"): "go", ("fill", "drain"): "full", ("drain", "idle"): "empty"},
            name="modes",
        )
        full, empty = Compare(">=", name="is_full")(level, 1.0), Compare("<=", name="is_empty")(level, 0.2)
        modes(go=And(name="may_fill")(permit, empty), full=full, empty=empty)
        laps = Counter(name="laps")(full).named("laps")
        flow = Switch(name="valve")(modes.fill, 1.5, Gain(gain=-0.8, name="open")(modes.drain)).named("flow")
        return flow, laps

    tank = TransferFunction(numerator=[1.0], denominator=[1.0, 0.05], name="tank")
    flow, laps = controller(tank.y, Step(times=0.3, values=1.0, name="permit"))
    return Diagram("tank", tank(flow), laps)


@cache
def tables():
    """Tables of one and two inputs, a rate limit, elementary functions, time."""

    @subsystem(sample_time=0.01)
    def controller(angle):
        gain = Lookup1D(breakpoints=[-1.0, 0.0, 0.5, 2.0], values=[1.0, 3.0, 2.0, 4.0], name="gain")(angle)
        smooth = Lookup1D(
            breakpoints=[-2.0, -1.0, 0.0, 1.0, 2.0],
            values=[0.0, 0.4, 1.0, 0.2, 0.1],
            interpolation="cubic",
            name="cubic",
        )(angle)
        map_ = Lookup2D(
            rows=[0.0, 1.0, 3.0], columns=[-1.0, 1.0], values=[[0.0, 1.0], [2.0, 5.0], [3.0, 9.0]], name="map"
        )(gain, angle)
        wave = np.sin(3.0 * angle) + np.exp(-gain) + np.tanh(angle) + np.log(2.0 + np.abs(angle)) + np.sqrt(gain)
        slow = RateLimiter(rising=3.0, falling=2.0, name="slow")(wave + map_ + smooth)
        return (slow + SmoothStep(levels=[0.0, 1.0], start_times=[0.1], durations=[0.3], name="ramp").y[0]).named("u")

    return Diagram("tables", controller(Sine(amplitude=1.8, frequency=1.3, name="angle")))


@cache
def path_following():
    """The controller of the paper's Fig. 3, in experiment C."""
    from loopwright import experiments

    return experiments.EXPERIMENTS["C"]().diagram


DIAGRAMS = {one.__name__: one for one in (pid, cascade, observer, machine, tables, path_following)}


@cache
def spec_of(name):
    """Return the spec of the subsystem ``controller``."""
    return target_spec(open_part(DIAGRAMS[name]().wired, "controller", name), name=name, description="")


@cache
def run_of(name, ticks):
    """Return a run, and the inputs of the subsystem at its ticks."""
    diagram = DIAGRAMS[name]()
    run = diagram.simulate(ticks * float(diagram.subsystems["controller"].sample_time), progress=False)
    inputs = {}
    for (path, argument), wire in diagram.structure.arguments.items():
        if path == "controller":
            values = run[f"{wire.block}.{wire.port}"][:ticks]
            inputs[argument] = values if wire.index is None else values[:, wire.index]
    return run, inputs

"""Cost of an event: python benchmarks/events.py.

Everyday diagrams that switch often: a thermostat, a PWM by a comparator, a bouncing ball, a wheel that an anti-lock
brake holds by a relay; and, if asked for (python benchmarks/events.py antilock), a car that brakes with a fast valve,
with 12,900 events at 9,675 instants: 6,450 switches of the valve, and as often its torque reaches or leaves zero. With
"compiled" behind it (python benchmarks/events.py antilock compiled) they run by generated code. Printed are the events
of a run, the instants at which they fall, and the whole time of the run by its instants: the search, the solver, the
jumps, the record. Times are the processor's, the smallest of three runs; nothing else should run next to it.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import scipy.integrate  # noqa: F401  its import is no part of a run

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Event,
    Function,
    Gain,
    Input,
    Integrator,
    LimitedIntegrator,
    Relay,
    State,
    TransferFunction,
)
from loopwright.diagrams import Diagram, Run


class Ball(Block):
    """A ball that loses no energy."""

    h = State(start=1.0, output=True)
    v = State(output=True)
    impact = Event("falling")

    def derivative(self, t, x, u):
        return x.v, -9.81 + 0.0 * t

    def indicators(self, t, x, u):
        return x.h

    def jump(self, t, x, u, fired):
        return 0.0 * x.h, -x.v


class Wheel(Block):
    """A braked wheel: its slip at a constant speed of the car, with a friction that falls beyond its peak."""

    brake = Input()
    slip = State(start=0.0, output=True)
    pressure = State(output=True)

    def derivative(self, t, x, u):
        friction = 2.0 * x.slip / (0.1 + 10.0 * x.slip**2)
        return 5.0 * x.pressure - 8.0 * friction, 20.0 * (2.0 * u.brake - 1.0) * (1.0 + 0.0 * x.pressure)


def thermostat() -> tuple[Diagram, float, float]:
    """A first-order lag that a relay heats."""
    room, relay = (
        TransferFunction(numerator=1.0, denominator=[2.0, 1.0], name="room"),
        Relay(on_point=1.0, off_point=0.9),
    )
    return Diagram("thermostat", room(Gain(gain=-1.5)(relay(room.y)) + 1.5)), 200.0, 0.1


def pwm() -> tuple[Diagram, float, float]:
    """A carrier of 50 Hz against a level, into a lag."""
    carrier = Function(lambda t: np.sin(2 * np.pi * 50 * t), name="carrier")(Clock())
    return (
        Diagram("pwm", TransferFunction(numerator=1.0, denominator=[1.0, 1.0])(Compare(">")(carrier, 0.3))),
        4.0,
        1e-3,
    )


def ball() -> tuple[Diagram, float, float]:
    """Free flights between impacts."""
    return Diagram("ball", Ball()), 200.0, 0.1


def brake() -> tuple[Diagram, float, float]:
    """A relay that lets the pressure up and down about the slip of most friction."""
    wheel = Wheel(name="wheel")
    hold = Relay(on_point=-0.099, off_point=-0.101, name="hold")(Gain(gain=-1.0)(wheel.slip))
    return Diagram("brake", wheel(hold), Integrator(name="work")(wheel.pressure)), 10.0, 1e-3


class Car(Block):
    """A car on one braked wheel: m v' = −F, J ω' = R F − T with a friction F of the slip that falls beyond its peak."""

    torque = Input()
    v = State(start=25.0, output=True)
    omega = State(start=25.0 / 0.3, output=True)

    def derivative(self, t, x, u):
        slip = (x.v - 0.3 * x.omega) / x.v
        force = 400.0 * 9.81 * 2 * 0.9 * 0.15 * slip / (0.15**2 + slip**2)
        return -force / 400.0, 0.3 * force - u.torque


def antilock() -> tuple[Diagram, float, float]:
    """A car that brakes: a valve with a narrow hysteresis lets the torque up and down."""
    car, torque = Car(name="car"), LimitedIntegrator(lower=0.0, name="torque")
    valve = Relay(on_point=0.1701, off_point=0.1699, on_value=-1e7, off_value=1e7, name="valve")
    slip = Function(lambda v, omega: 1.0 - 0.3 * omega / v, name="slip")(car.v, car.omega)
    return Diagram("antilock", car(torque(valve(slip)))), 1.55, 0.01


def count(run: Run) -> tuple[int, int]:
    """Return the number of a run's events, and that of their instants: several may fall at one."""
    return len(run.events), len({event.t for event in run.events})


def measure(diagram: Diagram, duration: float, step: float, runs: int = 3, *, form: bool = False) -> tuple[Run, float]:
    """Return a run, and the least time in s that it took; with generated code, if asked for."""
    diagram.simulate(20 * step, step=step, progress=False, compile=form)
    total = np.inf
    for _ in range(runs):
        start = time.thread_time()
        run = diagram.simulate(duration, step=step, progress=False, compile=form)
        total = min(total, time.thread_time() - start)
    return run, total


if __name__ == "__main__":
    print(f"{'diagram':12s} {'events':>7s} {'instants':>9s} {'ms an instant':>14s} {'s a run':>8s}")
    makes = (antilock,) if "antilock" in sys.argv else (thermostat, pwm, ball, brake)
    for make in makes:
        run, total = measure(*make(), runs=1 if make is antilock else 3, form="compiled" in sys.argv)
        events, instants = count(run)
        print(f"{make.__name__:12s} {events:7d} {instants:9d} {1e3 * total / instants:14.4f} {total:8.3f}")

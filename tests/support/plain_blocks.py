"""Blocks in two forms: as Loopwright has them, and as plain equations for the reference loop, with random parameters.

Each function of `KINDS` takes a `Draw` and returns both. The plain form follows the equations in the block's docstring; it is
written without a look at its code. T is the sample time in s of the subsystem that it stands in, None in continuous time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.linalg import expm

from loopwright import blocks as lw
from loopwright.blocks import Block, Event, Input, State, parameter

from .reference_loop import Part

HUNDREDTH = Fraction(1, 100)


@dataclass
class Draw:
    """What a block is drawn from: random numbers, its name, its sample time, and the run's end in s."""

    rng: np.random.Generator
    name: str
    T: float | None
    end: Fraction

    def uniform(self, low, high):
        return float(self.rng.uniform(low, high))

    def choose(self, *options):
        return options[int(self.rng.integers(len(options)))]

    def time(self):
        """Return a time as it is written in decimals: at a tick, or between two, and at the start now and then."""
        hundredths = int(self.rng.integers(0, int(self.end / HUNDREDTH)))
        hundredths -= self.choose(0, hundredths % 6)  # many clocks tick every 0.06 s
        return hundredths * HUNDREDTH + self.choose(0, 0, Fraction(37, 10000), Fraction(1, 300))


@dataclass(frozen=True)
class Kind:
    """A kind of block: the types of its inputs and of its output, and where it may stand."""

    make: Callable[[Draw], Any]
    reads: tuple[str, ...]
    makes: str
    continuous: bool
    sampled: bool


KINDS: dict[str, Kind] = {}


def kind(reads="", makes="real", *, continuous=True, sampled=True):
    def note(make):
        KINDS[make.__name__] = Kind(make, tuple(reads.split()), makes, continuous, sampled)
        return make

    return note


# --- sources -----------------------------------------------------------------------------------------------------------


@kind()
def constant(d):
    value = d.uniform(-1, 1)
    return lw.Constant(value=value, name=d.name), Part(d.name, lambda t, x, k, u: value)


@kind()
def sine(d):
    f, phase = d.uniform(0.1, 2.0), d.uniform(0, 6)
    return (
        lw.Sine(frequency=f, phase=phase, name=d.name),
        Part(d.name, lambda t, x, z, u: np.sin(2 * np.pi * f * t + phase)),
    )


@kind()
def clock(d):
    return lw.Clock(name=d.name), Part(d.name, lambda t, x, z, u: t)


@kind()
def step(d):
    times = sorted({d.time() for _ in range(d.choose(1, 2, 3))})
    values = [d.uniform(-1, 1) for _ in range(len(times) + 1)]
    made = lw.Step(times=[float(t) for t in times], values=values[1:], initial_value=values[0], name=d.name)
    return made, Part(d.name, lambda t, x, k, u: values[k], breaks=tuple(times))


@kind()
def ramp(d):
    start, slope = d.time(), d.uniform(-1, 1)
    made = lw.Ramp(start_time=float(start), slope=slope, name=d.name)
    return made, Part(d.name, lambda t, x, k, u: slope * (t - float(start)) if k else 0.0, breaks=(start,))


def train(d, base, amplitude):
    period, duty = d.choose(7, 10, 23, 30, 47) * HUNDREDTH, d.choose(1, 2, 3) * Fraction(1, 4)
    delay = d.choose(0, 1, 5, 8) * HUNDREDTH
    made = lw.PulseTrain(
        period=float(period), duty=float(duty), delay=float(delay), base=base, amplitude=amplitude, name=d.name
    )
    first = [delay + k * period for k in range(int((d.end - delay) / period) + 2)]
    breaks = [t for begin in first for t in (begin, begin + duty * period)]
    return made, Part(d.name, lambda t, x, k, u: base + amplitude * (k % 2), breaks=tuple(breaks))


@kind()
def pulse_train(d):
    return train(d, d.uniform(-1, 1), d.uniform(-1, 1))


@kind()
def sawtooth(d):
    period, delay, size = d.choose(7, 10, 23, 30) * HUNDREDTH, d.choose(0, 1, 5) * HUNDREDTH, d.uniform(-1, 1)
    made = lw.Sawtooth(period=float(period), delay=float(delay), amplitude=size, bias=0.2, name=d.name)
    edges = [delay + k * period for k in range(int((d.end - delay) / period) + 2)]

    def out(t, x, k, u):
        return 0.2 - size if k == 0 else 0.2 + size * (2 * (t - float(edges[k - 1])) / float(period) - 1)

    return made, Part(d.name, out, breaks=tuple(edges))


@kind()
def triangle(d):
    period, rise, size = d.choose(7, 10, 23, 30) * HUNDREDTH, d.choose(1, 2, 3) * Fraction(1, 4), d.uniform(-1, 1)
    made = lw.Triangle(period=float(period), rise=float(rise), amplitude=size, name=d.name)
    corners = [k * period + more for k in range(int(d.end / period) + 2) for more in (0, rise * period)]

    def out(t, x, k, u):
        if k == 0:
            return -size
        since = (t - float(corners[k - 1])) / float(period)
        return size * (2 * since / float(rise) - 1 if k % 2 else 1 - 2 * since / float(1 - rise))

    return made, Part(d.name, out, breaks=tuple(corners))


@kind(makes="logic")
def logic_train(d):
    return train(d, 0.0, 1.0)


@kind()
def recorded(d):
    times = sorted({d.time() for _ in range(5)} | {Fraction(0)})
    values = [d.uniform(-1, 1) for _ in times]
    made = lw.Recorded(times=[float(t) for t in times], values=values, interpolation="previous", name=d.name)
    return made, Part(d.name, lambda t, x, k, u: values[max(k - 1, 0)], breaks=tuple(times))


# --- algebra -----------------------------------------------------------------------------------------------------------


@kind("real")
def gain(d):
    k = d.uniform(-1, 1)
    return lw.Gain(gain=k, name=d.name), Part(d.name, lambda t, x, z, u: k * u[0])


@kind("real real")
def difference(d):
    return lw.Sum(signs="+-", name=d.name), Part(d.name, lambda t, x, z, u: u[0] - u[1])


@kind("real real")
def product(d):
    return lw.Product(name=d.name), Part(d.name, lambda t, x, z, u: u[0] * u[1])


class Stacked:
    """A stack, and a block of the vector that it makes, as one block with the second one's name."""

    def __init__(self, stack, inner):
        self.stack, self.inner, self.y = stack, inner, inner.y

    def __call__(self, *signals):
        return self.inner(self.stack(*signals))


@kind("real real real")
def stack(d):
    row = [d.uniform(-0.5, 0.5) for _ in range(3)]
    inner = lw.Function(lambda v: np.dot(np.array(row), v), arguments=("v",), name=d.name)
    made = Stacked(lw.Stack(count=3, name=f"{d.name}_vector"), inner)
    return made, Part(d.name, lambda t, x, z, u: row[0] * u[0] + row[1] * u[1] + row[2] * u[2])


@kind("real")
def magnitude(d):
    return lw.Function(np.absolute, name=d.name), Part(
        d.name, lambda t, x, z, u: abs(u[0]), kinks=lambda t, x, z, u: (u[0],)
    )


@kind("real")
def bend(d):
    a, b = d.uniform(0.2, 0.8) * d.choose(-1, 1), d.uniform(0.3, 1.0)
    return lw.Function(lambda u: a * np.tanh(b * u), name=d.name), Part(
        d.name, lambda t, x, z, u: a * np.tanh(b * u[0])
    )


@kind("real")
def saturation(d):
    low, high = d.uniform(-0.6, -0.1), d.uniform(0.1, 0.6)
    return lw.Saturation(lower=low, upper=high, name=d.name), Part(
        d.name,
        lambda t, x, z, u: min(max(u[0], low), high),
        kinks=lambda t, x, z, u: (u[0] - low, u[0] - high),
    )


@kind("real")
def dead_zone(d):
    limit = d.uniform(0.1, 0.4)
    return lw.DeadZone(limit=limit, name=d.name), Part(
        d.name,
        lambda t, x, z, u: u[0] - min(max(u[0], -limit), limit),
        kinks=lambda t, x, z, u: (u[0] - limit, u[0] + limit),
    )


@kind("real real")
def maximum(d):
    return lw.Maximum(name=d.name), Part(d.name, lambda t, x, z, u: max(u), kinks=lambda t, x, z, u: u[0] - u[1])


# --- continuous states -------------------------------------------------------------------------------------------------


@kind("real")
def integrator(d):
    start = d.uniform(-1, 1)
    made = lw.Integrator(initial_value=start, name=d.name)
    if d.T is None:
        return made, Part(d.name, lambda t, x, z, u: x[0], x=(start,), rate=lambda t, x, z, u: u[0], direct=False)
    return made, Part(
        d.name, lambda t, x, z, u: z[0], z=(start,), update=lambda t, x, z, u: (z[0] + d.T * u[0],), direct=False
    )


@kind("real")
def lag(d):
    k, tau = d.uniform(-1.5, 1.5), d.uniform(0.1, 1.0)
    made = lw.TransferFunction(numerator=[k], denominator=[tau, 1.0], name=d.name)
    if d.T is None:
        return made, Part(
            d.name, lambda t, x, z, u: x[0], x=(0.0,), rate=lambda t, x, z, u: (k * u[0] - x[0]) / tau, direct=False
        )
    decay = np.exp(-d.T / tau)
    return made, Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(0.0,),
        update=lambda t, x, z, u: (decay * z[0] + (1 - decay) * k * u[0],),
        direct=False,
    )


@kind("real")
def pt2(d):
    k, tau, damping, start = d.uniform(-1, 1), d.uniform(0.1, 0.5), d.uniform(0.1, 1.5), d.uniform(-1, 1)
    made = lw.PT2(gain=k, time_constant=tau, damping_ratio=damping, initial_value=start, name=d.name)
    A, b = np.array([[0.0, 1.0], [-1 / tau**2, -2 * damping / tau]]), np.array([0.0, k / tau**2])
    if d.T is None:
        return made, Part(
            d.name,
            lambda t, x, z, u: x[0],
            x=(start, 0.0),
            rate=lambda t, x, z, u: tuple(A @ np.array(x) + b * u[0]),
            direct=False,
        )
    over = expm(A * d.T)
    held = np.linalg.solve(A, (over - np.eye(2)) @ b)
    return made, Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(start, 0.0),
        update=lambda t, x, z, u: tuple(over @ np.array(z) + held * u[0]),
        direct=False,
    )


@kind("real")
def lead_lag(d):
    k, ahead, tau = d.uniform(-1, 1), d.uniform(0, 0.5), d.uniform(0.1, 0.5)
    made = lw.LeadLag(gain=k, lead_time=ahead, lag_time=tau, name=d.name)
    if d.T is None:
        return made, Part(
            d.name,
            lambda t, x, z, u: k * (x[0] + ahead / tau * (u[0] - x[0])),
            x=(0.0,),
            rate=lambda t, x, z, u: (u[0] - x[0]) / tau,
        )
    decay = np.exp(-d.T / tau)
    return made, Part(
        d.name,
        lambda t, x, z, u: k * (z[0] + ahead / tau * (u[0] - z[0])),
        z=(0.0,),
        update=lambda t, x, z, u: (decay * z[0] + (1 - decay) * u[0],),
    )


@kind("real", sampled=False)
def oscillator(d):
    w, damping, b = d.uniform(1, 6), d.uniform(0.05, 0.8), d.uniform(1, 4)
    made = lw.TransferFunction(numerator=[b], denominator=[1.0, 2 * damping * w, w**2], name=d.name)
    return made, Part(
        d.name,
        lambda t, x, z, u: b * x[0],
        x=(0.0, 0.0),
        rate=lambda t, x, z, u: (x[1], u[0] - w**2 * x[0] - 2 * damping * w * x[1]),
        direct=False,
    )


@kind("real", sampled=False)
def lead(d):
    b, a0, b0 = d.uniform(-0.5, 0.5), d.uniform(0.5, 3), d.uniform(-1, 1)
    made = lw.TransferFunction(numerator=[b, b0], denominator=[1.0, a0], name=d.name)
    return made, Part(
        d.name,
        lambda t, x, z, u: b * u[0] + (b0 - b * a0) * x[0],
        x=(0.0,),
        rate=lambda t, x, z, u: u[0] - a0 * x[0],
    )


@kind("real", sampled=False)
def pendulum(d):
    w, damping, angle = d.uniform(1, 5), d.uniform(0.1, 0.5), d.uniform(-2, 2)
    return Pendulum(w=w, damping=damping, angle=angle, name=d.name), Part(
        d.name,
        lambda t, x, z, u: x[0],
        x=(angle, 0.0),
        rate=lambda t, x, z, u: (x[1], u[0] - w**2 * np.sin(x[0]) - damping * x[1]),
        direct=False,
    )


@kind("real", sampled=False)
def derivative(d):
    tau = d.uniform(0.1, 0.5)
    return lw.FilteredDerivative(time_constant=tau, name=d.name), Part(
        d.name,
        lambda t, x, z, u: (u[0] - x[0]) / tau,
        x=(0.0,),
        start=lambda u: ((u[0],), ()),
        rate=lambda t, x, z, u: (u[0] - x[0]) / tau,
    )


@kind("real")
def rate_limiter(d):
    rising, falling, tau = d.uniform(0.2, 1), d.uniform(0.2, 1), d.uniform(0.05, 0.2)
    made = lw.RateLimiter(rising=rising, falling=falling, time_constant=tau, name=d.name)
    if d.T is None:
        return made, Part(
            d.name,
            lambda t, x, z, u: x[0],
            x=(0.0,),
            start=lambda u: ((u[0],), ()),
            rate=lambda t, x, z, u: min(max((u[0] - x[0]) / tau, -falling), rising),
            kinks=lambda t, x, z, u: ((u[0] - x[0]) / tau - rising, (u[0] - x[0]) / tau + falling),
            direct=False,
        )

    def follow(t, x, z, u):
        return z[0] + min(max(u[0] - z[0], -falling * d.T), rising * d.T)

    return made, Part(
        d.name, follow, z=(0.0,), start=lambda u: ((), (u[0],)), update=lambda t, x, z, u: (follow(t, x, z, u),)
    )


@kind("real real")
def pid(d):
    kp, ki, kd = d.uniform(0.3, 1.2), d.uniform(0.2, 2), d.uniform(0.01, 0.1)
    b, c, tau, low, high = (
        d.uniform(0, 1),
        d.choose(0.0, 1.0),
        d.uniform(0.05, 0.2),
        d.uniform(-1, -0.3),
        d.uniform(0.3, 1),
    )
    made = lw.PID(kp=kp, ki=ki, kd=kd, b=b, c=c, filter_time=tau, lower=low, upper=high, name=d.name)

    def free(s, u):
        return kp * (b * u[0] - u[1]) + s[0] + kd * (c * u[0] - u[1] - s[1]) / tau

    def cut(v):
        return min(max(v, low), high)

    if d.T is None:
        return made, Part(
            d.name,
            lambda t, x, z, u: cut(free(x, u)),
            ports=("u",),
            x=(0.0, 0.0),
            start=lambda u: ((0.0, c * u[0] - u[1]), ()),
            rate=lambda t, x, z, u: (
                ki * (u[0] - u[1]) + (cut(free(x, u)) - free(x, u)) * ki / kp,
                (c * u[0] - u[1] - x[1]) / tau,
            ),
            kinks=lambda t, x, z, u: (free(x, u) - low, free(x, u) - high),
        )
    share, decay = 1 - np.exp(-d.T * ki / kp), np.exp(-d.T / tau)
    return made, Part(
        d.name,
        lambda t, x, z, u: cut(free(z, u)),
        ports=("u",),
        z=(0.0, 0.0),
        start=lambda u: ((), (0.0, c * u[0] - u[1])),
        update=lambda t, x, z, u: (
            z[0] + d.T * ki * (u[0] - u[1]) + share * (cut(free(z, u)) - free(z, u)),
            decay * z[1] + (1 - decay) * (c * u[0] - u[1]),
        ),
    )


# --- states with events ------------------------------------------------------------------------------------------------


@kind("real", sampled=False)
def limited_integrator(d):
    low, high, start = d.uniform(-0.4, -0.1), d.uniform(0.1, 0.4), d.uniform(-0.09, 0.09)

    def jump(t, x, z, u, fired):
        if fired[0]:
            return ((high,), (1.0,)) if abs(x[0] - high) < abs(x[0] - low) else ((low,), (-1.0,))
        return x, (0.0,)

    return lw.LimitedIntegrator(lower=low, upper=high, initial_value=start, name=d.name), Part(
        d.name,
        lambda t, x, z, u: x[0],
        x=(start,),
        z=(0.0,),
        rate=lambda t, x, z, u: 0.0 if z[0] else u[0],
        direct=False,
        events=(("reached", 1, 0.0), ("released", 1, 0.0)),
        indicators=lambda t, x, z, u: (-1.0 if z[0] else max(x[0] - high, low - x[0]), -z[0] * u[0] if z[0] else -1.0),
        jump=jump,
    )


@kind("real logic", sampled=False)
def resettable_integrator(d):
    start = d.uniform(-1, 1)
    return lw.ResettableIntegrator(initial_value=start, name=d.name), Part(
        d.name,
        lambda t, x, z, u: x[0],
        x=(start,),
        rate=lambda t, x, z, u: u[0],
        direct=False,
        events=(("restart", 1, 0.0),),
        indicators=lambda t, x, z, u: u[1] - 0.5,
        jump=lambda t, x, z, u, fired: ((start,), ()),
    )


@kind("real", sampled=False)
def ball(d):
    e, height = d.uniform(0.5, 0.9), d.uniform(0.5, 2)
    return Bouncing(restitution=e, height=height, name=d.name), Part(
        d.name,
        lambda t, x, z, u: (x[0], x[1]),
        ports=("h", "v"),
        x=(height, 0.0),
        rate=lambda t, x, z, u: (x[1], u[0] - 9.81),
        direct=False,
        events=(("bounce", -1, 0.0),),
        indicators=lambda t, x, z, u: x[0],
        jump=lambda t, x, z, u, fired: ((0.0, -e * x[1]), ()),
    )


@kind("real")
def relay(d):
    off, on = d.uniform(-0.3, 0.0), d.uniform(0.0, 0.3)
    low, high = d.uniform(-1, 0), d.uniform(0, 1)
    made = lw.Relay(on_point=on, off_point=off, off_value=low, on_value=high, name=d.name)

    def decide(z, u):
        return 1.0 if u[0] > on else 0.0 if u[0] <= off else z[0]

    start = lambda u: ((), (decide((0.0,), u),))  # noqa: E731
    if d.T is not None:
        return made, Part(
            d.name,
            lambda t, x, z, u: high if decide(z, u) else low,
            z=(0.0,),
            start=start,
            update=lambda t, x, z, u: (decide(z, u),),
            margins=lambda t, x, z, u: (u[0] - on, u[0] - off),
        )
    return made, Part(
        d.name,
        lambda t, x, z, u: high if z[0] else low,
        z=(0.0,),
        start=start,
        direct=False,
        events=(("rise", 1, 0.0), ("fall", -1, 0.0)),
        indicators=lambda t, x, z, u: (u[0] - on, u[0] - off),
        jump=lambda t, x, z, u, fired: (x, (1.0 if fired[0] else 0.0,)),
    )


@kind("real")
def quantizer(d):
    q = d.uniform(0.1, 0.4)
    made = lw.Quantizer(quantum=q, name=d.name)

    def nearest(u):
        return float(np.floor(u[0] / q + 0.5))

    if d.T is not None:
        return made, Part(
            d.name,
            lambda t, x, z, u: q * nearest(u),
            margins=lambda t, x, z, u: u[0] / q + 0.5 - np.round(u[0] / q + 0.5),
        )
    return made, Part(
        d.name,
        lambda t, x, z, u: q * z[0],
        z=(0.0,),
        start=lambda u: ((), (nearest(u),)),
        direct=False,
        events=(("up", 1, 0.0), ("down", 1, 0.0)),
        indicators=lambda t, x, z, u: (u[0] / q - z[0] - 0.5, z[0] - 0.5 - u[0] / q),
        jump=lambda t, x, z, u, fired: (
            x,
            (float(np.floor(u[0] / q + 0.5 + 1e-9) if fired[0] else np.ceil(u[0] / q - 0.5 - 1e-9)),),
        ),
    )


@kind("real", sampled=False)
def crossings(d):
    direction, width = d.choose("rising", "falling", "both"), d.choose(0.0, d.uniform(0.05, 0.3))
    return Crossings(direction=direction, width=width, name=d.name), Part(
        d.name,
        lambda t, x, z, u: (z[0], z[1]),
        ports=("count", "last"),
        z=(0.0, -1.0),
        direct=False,
        events=(("cross", {"rising": 1, "falling": -1, "both": 0}[direction], width),),
        indicators=lambda t, x, z, u: u[0],
        jump=lambda t, x, z, u, fired: (x, (z[0] + 1.0, t)),
    )


@kind("real logic", sampled=False)
def takes(d):
    start = d.uniform(-1, 1)
    return Takes(start=start, name=d.name), Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(start,),
        direct=False,
        events=(("take", 1, 0.0),),
        indicators=lambda t, x, z, u: u[1] - 0.5,
        jump=lambda t, x, z, u, fired: (x, (u[0],)),
    )


# --- logic -------------------------------------------------------------------------------------------------------------


@kind("real real", makes="logic")
def compare(d):
    name = d.choose(">", "<", ">=", "<=")
    sign, positive = {">": (1, 1.0), "<": (-1, 1.0), "<=": (1, 0.0), ">=": (-1, 0.0)}[name]
    made = lw.Compare(name, name=d.name)

    def holds(u):
        return positive if sign * (u[0] - u[1]) > 0 else 1.0 - positive

    if d.T is not None:
        return made, Part(d.name, lambda t, x, z, u: holds(u), margins=lambda t, x, z, u: u[0] - u[1])
    return made, Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(0.0,),
        start=lambda u: ((), (holds(u),)),
        direct=False,
        events=(("cross", 0, 0.0),),
        indicators=lambda t, x, z, u: sign * (u[0] - u[1]),
        jump=lambda t, x, z, u, fired: (x, (positive if fired[0] > 0 else 1.0 - positive,)),
    )


@kind(makes="logic", sampled=False)
def alarm(d, at=None):
    """True once an exact time has passed, or is there."""
    late, time = d.choose(0.0, 1.0), float(d.time() + HUNDREDTH if at is None else at)
    return Alarm(time=time, sign=1.0 - 2.0 * late, name=d.name), Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(0.0,),
        events=(("ring", 0, 0.0),),
        indicators=lambda t, x, z, u: (1.0 - 2.0 * late) * (t - time),
        jump=lambda t, x, z, u, fired: (x, (1.0,)),
    )


@kind("logic logic", makes="logic")
def both(d):
    return logical(d, lw.And(name=d.name), lambda u: float(u[0] > 0.5 and u[1] > 0.5), ("change1", "change2"))


@kind("logic logic", makes="logic")
def either(d):
    return logical(d, lw.Or(name=d.name), lambda u: float(u[0] > 0.5 or u[1] > 0.5), ("change1", "change2"))


@kind("logic", makes="logic")
def opposite(d):
    return logical(d, lw.Not(name=d.name), lambda u: float(u[0] <= 0.5), ("change",))


@kind("logic real real")
def switch(d):
    return logical(d, lw.Switch(name=d.name), lambda u: u[1] if u[0] > 0.5 else u[2], ("change",))


def logical(d, made, out, events):
    """A block without a state, whose logic inputs, the first ones, are events in continuous time."""
    if d.T is not None:
        return made, Part(d.name, lambda t, x, z, u: out(u))
    return made, Part(
        d.name,
        lambda t, x, z, u: out(u),
        events=tuple((name, 0, 0.0) for name in events),
        indicators=lambda t, x, z, u: tuple(u[i] - 0.5 for i in range(len(events))),
    )


@kind("logic logic", makes="logic")
def latch(d):
    def out(t, x, z, u):
        return 0.0 if u[1] > 0.5 else 1.0 if u[0] > 0.5 else z[0]

    made = lw.Latch(name=d.name)
    if d.T is not None:
        return made, Part(d.name, out, z=(0.0,), update=lambda t, x, z, u: (out(t, x, z, u),))

    def jump(t, x, z, u, fired):
        before = tuple(1.0 - v if f else v for v, f in zip(u, fired, strict=True))
        return x, (out(t, x, (out(t, x, z, before),), u),)

    return made, Part(
        d.name,
        out,
        z=(0.0,),
        events=(("sets", 0, 0.0), ("resets", 0, 0.0)),
        indicators=lambda t, x, z, u: (u[0] - 0.5, u[1] - 0.5),
        jump=jump,
    )


@kind("logic logic")
def counter(d):
    made = lw.Counter(name=d.name)
    if d.T is not None:

        def count(t, x, z, u):
            return 0.0 if u[1] > 0.5 else z[0] + float(u[0] > 0.5 >= z[1])

        return made, Part(
            d.name,
            count,
            z=(0.0, 0.0),
            start=lambda u: ((), (0.0, u[0])),
            update=lambda t, x, z, u: (count(t, x, z, u), u[0]),
        )
    return made, Part(
        d.name,
        lambda t, x, z, u: 0.0 if u[1] > 0.5 else z[0],
        z=(0.0,),
        events=(("edge", 1, 0.0), ("clear", 1, 0.0)),
        indicators=lambda t, x, z, u: (u[0] - 0.5, u[1] - 0.5),
        jump=lambda t, x, z, u, fired: (x, (0.0 if u[1] > 0.5 else z[0] + fired[0],)),
    )


# --- sampled states ----------------------------------------------------------------------------------------------------


@kind("real", continuous=False)
def unit_delay(d):
    return lw.UnitDelay(name=d.name), Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(0.0,),
        start=lambda u: ((), (u[0],)),
        update=lambda t, x, z, u: (u[0],),
        direct=False,
    )


@kind("real", continuous=False)
def delay(d):
    n, start = d.choose(2, 3, 4), d.uniform(-1, 1)
    return lw.Delay(steps=n, initial_value=start, name=d.name), Part(
        d.name,
        lambda t, x, z, u: z[0],
        z=(start,) * n,
        update=lambda t, x, z, u: (*z[1:], u[0]),
        direct=False,
    )


@kind("real", continuous=False)
def filter_of_second_order(d):
    r, angle = d.uniform(0.2, 0.9), d.uniform(0.3, 2)
    b, a = [d.uniform(-0.3, 0.3) for _ in range(3)], [1.0, -2 * r * np.cos(angle), r * r]
    made = lw.IIR(b=np.array(b), a=np.array(a), name=d.name)

    def out(t, x, z, u):
        return b[0] * u[0] + b[1] * z[0] + b[2] * z[1] - a[1] * z[2] - a[2] * z[3]

    return made, Part(
        d.name,
        out,
        z=(0.0,) * 4,
        update=lambda t, x, z, u: (u[0], z[0], out(t, x, z, u), z[2]),
    )


@kind("real", continuous=False)
def fir(d):
    c = [d.uniform(-0.5, 0.5) for _ in range(3)]
    return lw.FIR(coefficients=np.array(c), initial_value=0.3, name=d.name), Part(
        d.name,
        lambda t, x, z, u: c[0] * u[0] + c[1] * z[0] + c[2] * z[1],
        z=(0.3, 0.3),
        update=lambda t, x, z, u: (u[0], z[0]),
    )


@kind("real logic", continuous=False)
def discrete_integrator(d):
    method, start = d.choose("forward", "backward", "trapezoidal"), d.uniform(-1, 1)
    share = {"forward": 0.0, "backward": 1.0, "trapezoidal": 0.5}[method]
    made = lw.DiscreteIntegrator(method=method, initial_value=start, name=d.name)

    def out(t, x, z, u):
        return (start if u[1] > 0.5 >= z[1] else z[0]) + share * d.T * u[0]

    return made, Part(
        d.name,
        out,
        z=(start, 1.0),
        update=lambda t, x, z, u: (out(t, x, z, u) + (1 - share) * d.T * u[0], u[1]),
    )


@kind("real", continuous=False)
def hold(d):
    return lw.Hold(name=d.name), Part(d.name, lambda t, x, z, u: u[0])


@kind("logic", makes="logic", continuous=False)
def edge(d):
    which = d.choose("rising", "falling", "both")

    def out(t, x, z, u):
        now, before = u[0] > 0.5, z[0] > 0.5
        return float((now and not before and which != "falling") or (before and not now and which != "rising"))

    return lw.EdgeDetector(edge=which, name=d.name), Part(
        d.name, out, z=(0.0,), start=lambda u: ((), (u[0],)), update=lambda t, x, z, u: (u[0],)
    )


# --- blocks of the tests -----------------------------------------------------------------------------------------------


class Pendulum(Block):
    """Driven pendulum: φ'' = u − w² sin φ − d φ'."""

    w: float = parameter(default=3.0)
    damping: float = parameter(default=0.2)
    angle: float = parameter(default=1.0)
    u = Input()
    y = State(start="angle", output=True)
    v = State()

    def derivative(self, t, x, u):
        return x.v, u.u - self.w**2 * np.sin(x.y) - self.damping * x.v


class Bouncing(Block):
    """A ball in a wind u: h'' = u − g, and v⁺ = −e v at h = 0."""

    restitution: float = parameter(default=0.8)
    height: float = parameter(default=1.0)
    u = Input()
    h = State(start="height", output=True)
    v = State(output=True)
    bounce = Event("falling")

    def derivative(self, t, x, u):
        return x.v, u.u - 9.81

    def indicators(self, t, x, u):
        return x.h

    def jump(self, t, x, u, fired):
        return 0.0 * x.h, -self.restitution * x.v


class Crossings(Block):
    """Counts the crossings of zero of u, with a hysteresis, and keeps the time of the last one."""

    direction: str = parameter(default="both")
    width: float = parameter(default=0.0)
    u = Input()
    count = State(discrete=True, output=True)
    last = State(discrete=True, output=True, start=-1.0)

    @property
    def events(self):
        return {"cross": Event(self.direction, hysteresis=self.width, name="cross")}

    def indicators(self, t, x, u):
        return u.u

    def jump(self, t, x, u, fired):
        return x.count + 1.0, t + 0.0 * x.last


class Alarm(Block):
    """y = 1 from an instant on, which it finds as the zero of ± (t − time)."""

    time: float = parameter(default=0.5)
    sign: float = parameter(default=1.0)
    y = State(discrete=True, output=True)
    ring = Event("both")

    def indicators(self, t, x, u):
        return self.sign * (t - self.time)

    def jump(self, t, x, u, fired):
        return 1.0 + 0.0 * x.y


class Takes(Block):
    """At a rising trigger it takes over the value at u."""

    start: float = parameter(default=0.0)
    u = Input()
    trigger = Input()
    y = State(discrete=True, output=True, start="start")
    take = Event("rising")

    def indicators(self, t, x, u):
        return u.trigger - 0.5

    def jump(self, t, x, u, fired):
        return u.u + 0.0 * x.y

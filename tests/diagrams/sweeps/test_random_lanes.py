"""Random diagrams go side by side, with tables, loops, many blocks and continuous states: each near its run by itself."""

from inspect import Parameter, Signature

import numpy as np
import pytest

from loopwright.blocks import (
    Backlash,
    BandLimitedNoise,
    Compare,
    Constant,
    Counter,
    DeadZone,
    Delay,
    DiscreteTransferFunction,
    FilteredDerivative,
    Gain,
    Lookup1D,
    Lookup2D,
    Maximum,
    Minimum,
    PulseTrain,
    Quantizer,
    RateLimiter,
    Relay,
    Saturation,
    Sine,
    Step,
    Switch,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from loopwright.fmus import Fmu
from support.lanes import QUIET, T, lag

BOUND = 1e-10
"""Difference of a run in a lane from the run by itself, of each signal's largest value."""
DURATION = 0.6
SEEDS = range(200)


class Chooser:
    """Draws blocks, wires and numbers; names are numbered."""

    def __init__(self, seed):
        self.rng, self.is_continuous = np.random.default_rng([20260, seed]), seed % 3 == 2
        self.count = 0

    def name(self, kind):
        self.count += 1
        return f"{kind}{self.count}"

    def number(self, low, high):
        return round(float(self.rng.uniform(low, high)), 3)

    def pick(self, values):
        return values[int(self.rng.integers(len(values)))]

    def source(self):
        low, high = sorted((self.number(-2, 0), self.number(0, 2)))
        made = [
            lambda: Sine(frequency=self.number(0.5, 9), amplitude=self.number(0.5, 2), name=self.name("sine")),
            lambda: BandLimitedNoise(sample_time=self.pick((T, 3 * T)), variance=0.3, seed=5, name=self.name("noise")),
            lambda: PulseTrain(
                period=self.pick((0.08, 0.12 if self.is_continuous else 0.11)),
                amplitude=high - low,
                base=low,
                name=self.name("pulse"),
            ),
            lambda: Step(times=self.pick((0.0, 0.05)), values=self.number(-2, 2), name=self.name("step")),
            lambda: Constant(value=self.number(-2, 2), name=self.name("one")),
        ]
        return self.pick(made)()

    def block(self, inner):
        """Return a signal of a block of the signals inside of a subsystem; one in two ends at a limit of its kind."""
        u, v = self.pick(inner), self.pick(inner)
        limit = self.pick((0.25, 0.5, 1.0))  # numbers of few bits, which sources and steps hit exactly
        make = self.pick(
            [
                lambda n: Gain(gain=self.number(-0.9, 0.9), name=n("gain"))(u),
                lambda n: u - 0.5 * v,
                lambda n: Saturation(lower=-limit, upper=limit, name=n("clip"))(u),
                lambda n: DeadZone(lower=-limit, upper=limit, name=n("dead"))(u),
                lambda n: Quantizer(quantum=limit, name=n("steps"))(u + 0.01),
                lambda n: Relay(on_point=limit, off_point=-limit, name=n("relay"))(u),
                lambda n: RateLimiter(rising=20.0 * limit, name=n("slow"))(u),
                lambda n: Backlash(width=limit, name=n("play"))(u),
                lambda n: Delay(steps=int(self.rng.integers(1, 4)), name=n("late"))(u),
                lambda n: Minimum(name=n("least"))(u, v),
                lambda n: Maximum(name=n("most"))(u, v),
                lambda n: DiscreteTransferFunction(numerator=(0.3, 0.2), denominator=(1.0, -0.4), name=n("filter"))(u),
                lambda n: FilteredDerivative(time_constant=0.05, name=n("rate"))(u) * 0.05,
                lambda n: Switch(name=n("switch"))(Compare(">", name=n("above"))(u, v), u, v),
                lambda n: Counter(name=n("times"))(Compare(">", name=n("above"))(u, limit)) * 0.1,
                self.feedback(u),
                lambda n: Lookup1D(breakpoints=(-limit, 0.0, limit), values=self.numbers(3), name=n("curve"))(u),
                lambda n: Lookup2D(
                    rows=(-1.0, 0.0, 1.0), columns=(-1.0, 1.0), values=self.numbers(3, 2), name=n("map")
                )(u1=u, u2=v),
                self.implicit(u),
                self.wide(u),
            ]
        )
        return make(self.name)

    def feedback(self, u):
        def make(name):
            kept = UnitDelay(initial_value=self.number(-1, 1), name=name("kept"))
            kept(0.4 * kept.y + 0.3 * u)
            return kept.y

        return make

    def numbers(self, *shape):
        return np.round(self.rng.uniform(-1.0, 1.0, shape), 3)

    def implicit(self, u):
        """y = u − k y − y³ / 10, an algebraic loop with one solution."""

        def make(name):
            k = Gain(gain=self.number(0.1, 0.9), name=name("around"))
            y = u - k.y
            k(y + 0.1 * y * y * y)
            return y

        return make

    def wide(self, u):
        """The mean of lags of many time constants: several of them are more operations than are compiled as a whole."""

        def make(name):
            size = self.pick((5, 20, 250))
            kept = UnitDelay(initial_value=np.zeros(size), name=name("many"))
            poles = np.linspace(0.1, 0.8, size)
            y = Gain(gain=poles, name=name("poles"))(kept.y) + Gain(gain=1.0 - poles, name=name("rest"))(u)
            kept(y)
            return Gain(gain=np.full((1, size), 1.0 / size), name=name("mean"))(y)[0]

        return make

    def subsystem(self, signals):
        """Return some signals of a subsystem of a rate of its own; one in three is enabled or triggered."""
        size, steps, outputs = int(self.rng.integers(1, 4)), int(self.rng.integers(2, 9)), int(self.rng.integers(1, 3))
        chosen = [self.pick(signals) for _ in range(size)]

        def inside(**inputs):
            inner = [signal * 1.0 for signal in inputs.values()]
            for _ in range(steps):
                inner.append(self.block(inner))
            found = tuple(inner[-outputs:])
            return found if outputs > 1 else found[0]

        ports = [f"u{i}" for i in range(size)]
        inside.__signature__ = Signature([Parameter(port, Parameter.POSITIONAL_OR_KEYWORD) for port in ports])
        every = int(self.pick((1, 1, 2, 3)))
        control = self.pick(({}, {}, {}, {"enabled": "held"}, {"enabled": "reset"}))
        gate = subsystem(sample_time=T, name=self.name("gate"))(lambda u: Compare(">", name="on")(u, 0.1))
        more = {"enable": gate(self.pick(signals))} if control else {}
        offset = int(self.rng.integers(every)) * T
        box = subsystem(sample_time=every * T, offset=offset, name=self.name("box"), **control)(inside)
        made = box(**dict(zip(ports, chosen, strict=True)), **more)
        return list(made) if outputs > 1 else [made]


def random_diagram(seed):
    chooser = Chooser(seed)
    scale = Constant(value=1.0, name="scale")
    signals = [chooser.source() * scale for _ in range(3)]
    calls = []
    plants = [Fmu(lag(), name=f"plant{i}", start={"lag": 0.05 + 0.1 * i}) for i in range(int(chooser.rng.integers(5)))]
    signals += [signal for plant in plants for signal in (plant.x * 0.5, plant.mixed * 0.2)]
    if chooser.is_continuous:  # in continuous time, between sources, FMUs and controllers
        for _ in range(int(chooser.rng.integers(1, 4))):
            swing = (1.0, chooser.number(0.5, 5.0), chooser.number(4.0, 40.0))
            parts = chooser.pick(signals), chooser.pick(signals)
            y = TransferFunction(numerator=(swing[2],), denominator=swing, name=chooser.name("swing"))(
                parts[0] - parts[1]
            )
            signals.append(0.5 * y)
    found = []
    for _ in range(int(chooser.rng.integers(1, 4))):
        found += chooser.subsystem(signals)
    for i, plant in enumerate(plants):
        pushed = subsystem(sample_time=T, name=f"push{i}")(lambda u: Saturation(lower=-2.0, upper=2.0, name="most")(u))
        calls.append(plant(u=pushed(chooser.pick(found))))
    names = [f"y{i}" for i in range(len(found))]
    shown = [(1.0 * signal).named(name) for name, signal in zip(names, found, strict=True)]
    shown += [(1.0 * plant.x).named(f"x{i}") for i, plant in enumerate(plants)]
    shown.append((2.0 * scale).named("scaled"))
    return Diagram("random", *calls, *shown, loops="solve"), names + [f"x{i}" for i in range(len(plants))]


@pytest.mark.drawn(2)
@pytest.mark.parametrize("seed", SEEDS)
def test_random_diagrams_go_side_by_side_as_each_run_by_itself(seed):
    diagram, names = random_diagram(seed)
    table = [{"scale.value": value} for value in (0.6, 1.0, 1.37)]
    options = {"samples": table, "signals": names, "workers": 1, **QUIET}
    if seed % 3 == 2:
        options |= {"solver": ("rk4", "heun", "euler")[seed // 3 % 3], "step": T}
    found = diagram.sweep(None, DURATION, lanes=4, **options)
    alone = diagram.sweep(None, DURATION, compile=False, **options)
    assert not found.failures
    assert not [text for text in found.messages if "Not side by side" in text]
    assert DIFFER in found.messages
    for name in names:
        largest = max(np.abs(alone[name]).max(), 1e-3)
        assert np.abs(found[name] - alone[name]).max() <= BOUND * largest, name

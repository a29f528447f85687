"""Short pulses of tables and of blocks on a clock: a solver lands on them, and `check_block` finds those that hide."""

import numpy as np
import pytest

from loopwright.blocks import (
    BandLimitedNoise,
    Block,
    Clock,
    Constant,
    DefinitionError,
    Gain,
    Input,
    Integrator,
    Lookup1D,
    Lookup2D,
    Output,
    Product,
    PythonFunction,
    Ramp,
    Sum,
    TransferFunction,
    UnitDelay,
    parameter,
)
from loopwright.diagrams import Diagram, check_block, subsystem
from loopwright.diagrams.compiled import CompiledHybrid
from loopwright.diagrams.simulation import hybrid_ticks

WIDTH = 1e-3


class Pulse(Block):
    """A pulse of height 1/width in time, which says nothing of its edges."""

    begin: float = parameter(default=3.2, unit="s", description="beginning")
    y = Output()

    def output(self, t, x, u):
        return np.where((t > self.begin) & (t < self.begin + WIDTH), 1.0 / WIDTH, 0.0)


class OnClock(Block):
    """The same of an input."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return np.where(np.logical_and(u.u >= 3.2, u.u <= 3.2 + WIDTH), 1.0 / WIDTH, 0.0)


def triangle(**more):
    """A table with a triangle of area 1 around 3.2, of the width 2 ms."""
    return Lookup1D(breakpoints=[0.0, 3.2 - WIDTH, 3.2, 3.2 + WIDTH, 10.0], values=[0, 0, 1 / WIDTH, 0, 0], **more)


CASES = {
    "equation": (lambda: Pulse(), 1.0),
    "on a clock": (lambda: OnClock()(Clock()), 1.0),
    "on a faster clock": (lambda: OnClock()(Gain(gain=2.0)(Clock())), 0.5),
    "on a sum": (lambda: OnClock()(2.0 * Clock().y - Constant(value=1.0)), 0.5),
    "table": (lambda: triangle()(Clock()), 1.0),
    "table on a later clock": (lambda: triangle()(Clock().y - 2.0), 1.0),
    "cubic table": (lambda: triangle(interpolation="monotone")(Clock()), 1.0),
}


@pytest.mark.parametrize("solver", ["auto", "DOP853", "Radau", "CVODE_BDF", "rk4"])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.drawn(10)
def test_the_integral_of_a_short_pulse_is_its_area(case, solver):
    source, area = CASES[case]
    run = Diagram("d", Integrator()(source())).simulate(10.0, step=0.5, solver=solver, progress=False)
    assert run["integrator.y"][-1] == pytest.approx(area, rel=2e-6)


def test_a_table_of_two_arguments_lands_on_its_rows():
    rows = [0.0, 3.2 - WIDTH, 3.2, 3.2 + WIDTH, 10.0]
    table = Lookup2D(rows=rows, columns=[0.0, 1.0], values=[[0, 0], [0, 0], [1000, 3000], [0, 0], [0, 0]])
    run = Diagram("d", Integrator()(table(Clock(), Constant(value=0.5)))).simulate(10.0, step=0.5, progress=False)
    assert run["integrator.y"][-1] == pytest.approx(2.0, rel=1e-6)


def test_a_table_of_a_signal_that_is_not_the_time_is_left_alone():
    run = Diagram("d", Integrator()(triangle()(Ramp(slope=0.0)))).simulate(1.0, step=0.5, progress=False)
    assert run["integrator.y"][-1] == 0.0


def test_a_long_chain_of_sums_and_a_loop_of_them_are_followed_once():
    signal = Clock().y
    for i in range(60):  # 2 to the power of 60 ways lead back
        signal = (signal + signal).named(f"s{i}")
    run = Diagram("d", Integrator()(OnClock()(2.0**-60 * signal))).simulate(10.0, step=0.5, progress=False)
    assert run["integrator.y"][-1] == pytest.approx(1.0, rel=2e-6)
    e = Sum(signs="++", name="e")
    looped = Diagram("d", Integrator()(OnClock()(e(Clock(), Gain(gain=0.5)(e.y)))), loops="solve")
    assert np.isfinite(looped.simulate(1.0, step=0.5, progress=False)["integrator.y"]).all()


# --- check_block --------------------------------------------------------------------------------------------------------


class Narrow(Block):
    """A pulse once in 10 s, where the sine is almost one: no line in time, so nothing can be read from it."""

    y = Output()

    def output(self, t, x, u):
        return np.where(np.sin(2 * np.pi * t / 10.0) > 0.999999, 1.0, 0.0)


@pytest.mark.drawn(2)
@pytest.mark.parametrize("block", [Pulse(), Pulse(begin=7.77), Narrow()])
def test_a_pulse_anywhere_in_the_runs_duration_is_found(block):
    check_block(block)  # it is smooth in the first second
    with pytest.raises(DefinitionError, match=r"jump at t = .* s, and next_instant does not announce it"):
        check_block(block, duration=10.0)


def test_a_block_on_a_clock_is_looked_at_along_it():
    with pytest.raises(DefinitionError, match=r"jump at t = 3\.2 s, and next_instant does not announce it"):
        check_block(OnClock(), {"u": Clock()}, duration=10.0)


def test_foreign_code_on_a_clock_is_looked_at_along_it():
    function = PythonFunction(lambda u: 1.0 if 3.2 < u < 3.25 else 0.0, results={"y": ()})
    with pytest.raises(DefinitionError, match=r"jump at t = 3\.2"):
        check_block(function, {"u": Clock()}, duration=10.0)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["equation", "on a clock", "table"])
def test_a_linear_model_along_the_motion_passes_through_the_pulse(case):
    """Over 10 s the integral grows by the pulse's area, and its square by the area of it along the motion."""

    @subsystem(sample_time=10.0)
    def sampled(u):
        return UnitDelay(initial_value=0.0)(u)

    source, area = CASES[case]
    x = Integrator(name="x")(source())
    model = Diagram("d", sampled(Integrator(name="z")(Product()(x, x)))).linearize()
    grown = dict(zip(model.states, model.affine, strict=True))
    assert grown["x.y"] == pytest.approx(area, rel=1e-8)
    assert grown["z.y"] == pytest.approx(6.8, rel=1e-3)  # (10 s − 3.2 s), but for the width of the pulse


@pytest.mark.slow
@pytest.mark.one_tier
def test_instants_between_samples_are_asked_for_once(monkeypatch):
    """Noise that changes 6 times between two samples, by 1/(s + 1): each change is found once, however C is called."""
    asked, spent, found = [], [], BandLimitedNoise.next_instant

    def limit_budget(loop, seconds):
        spent.append(seconds)
        loop._hybrid.budget = 50

    monkeypatch.setattr(BandLimitedNoise, "next_instant", lambda self, t: (asked.append(t), found(self, t))[1])
    monkeypatch.setattr(CompiledHybrid, "limit_budget", limit_budget)
    monkeypatch.setattr(hybrid_ticks, "perf_counter", lambda: float(len(asked)))  # 1 s for each question
    T, count, held = 0.01, 6000, 6
    noise = BandLimitedNoise(sample_time=T, seed=3, variance=4.0, name="noise")
    lag = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")
    run = Diagram("noisy", lag(noise.y).named("out")).simulate(count * T, progress=False)
    assert count <= len(asked) < 1.1 * count
    assert len(spent) > count / 50 - 10
    assert not any(spent)  # what Python takes doesn't limit the steps of a call of C

    n = Diagram("noise", Gain(gain=1.0)(noise.y).named("n")).simulate(count * T, step=T, progress=False)["n"]
    expected, a = [0.0], np.exp(-T)
    for value in n[:count]:
        expected.append(a * expected[-1] + (1.0 - a) * value)
    np.testing.assert_allclose(run["out"], expected[::held], atol=1e-6)

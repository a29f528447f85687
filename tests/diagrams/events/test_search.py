"""Where the search within a step finds events, and how often it evaluates indicators for that."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import Block, Clock, Event, Gain, Input, PythonFunction, Relay, State
from loopwright.diagrams import Diagram
from support.hybrid_blocks import Crossings, Lag
from support.work_in_c import simulate_counted

pytestmark = pytest.mark.one_tier  # they count calls


def watch(indicator):
    """Return the events of one step of 1 s, and how often it takes an indicator, a function of the time."""
    calls = []

    def value(t):
        calls.append(t)
        return indicator(t)

    seen = PythonFunction(value, results={"y": ()}, name="value")(Clock())
    run = Diagram("d", Crossings(name="crossings")(seen)).simulate(1.0, step=1.0, progress=False)
    return [e.t for e in run.events], len(calls)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("f", "most"),  # calls for the root: 40 halvings would be as many
    [
        (lambda d: d, 5),
        (lambda d: math.sinh(3 * d), 10),
        (lambda d: math.atan(1e6 * d), 25),
        (lambda d: math.copysign(abs(d) ** 0.5, d), 50),
        (lambda d: -2.0 if d < 0.0 else 1e9, 60),
    ],
    ids=["line", "sinh", "atan", "root", "jump"],
)
@pytest.mark.drawn(2)
def test_a_root_is_found_to_the_resolution_and_from_its_far_side(f, most, side):
    _, quiet = watch(lambda t: side * f(t - 9.0))
    for root in (1e-3, 0.3, 0.7251, 0.999):

        def indicator(t, root=root):
            return side * f(t - root)

        (found,), calls = watch(indicator)
        assert 0.0 <= found - root <= 4 * math.ulp(1.0)
        assert abs(found - brentq(indicator, 0.0, 1.0, xtol=1e-15, rtol=1e-15)) <= 8 * math.ulp(1.0)
        assert f(found - root) >= 0.0
        assert calls - quiet < 70 + most  # 41 just behind it, 11 around it for its rounding errors


def test_an_event_of_a_controlled_lag_costs_some_evaluations_of_the_indicators():
    """In the step behind it 41, closer and closer to it; 11 around it; forty halvings to find it would be as many again."""
    calls = []

    def see(value):
        calls.append(value)
        return value

    lag, relay = Lag(name="lag", k=0.5), Relay(name="relay", on_point=1.0, off_point=0.6)
    seen = PythonFunction(see, results={"y": ()}, name="see")(lag.y)
    made = Diagram("thermostat", lag((Gain(gain=-1.0, name="g")(relay(seen)) + 1.0).named("heat")))
    run, work = simulate_counted(made, 20.0, step=0.1, solver="RK45")
    ways = np.tile([2.0 * math.log(1.0 / 0.6), 2.0 * math.log(1.4)], 11)  # down towards 0, up towards 2
    times = 2.0 * math.log(2.0) + np.concatenate([[0.0], np.cumsum(ways)])
    assert [e.t for e in run.events] == pytest.approx(times[times < 20.0].tolist(), abs=1e-4)
    assert len(calls) - work.rates - len(run.t) < 90 * len(run.events)


class Wave(Block):
    """Two indicators of the state, the time and an input."""

    u = Input()
    y = State(start=0.3, output=True)
    first = Event("rising")
    second = Event("both")

    def derivative(self, t, x, u):
        return np.cos(3.0 * t) + u.u

    def indicators(self, t, x, u):
        return x.y - np.sin(t), np.exp(x.y) - 1.2 - u.u

    def jump(self, t, x, u, fired):
        return x.y


@pytest.mark.parametrize("solver", ["RK45", "Radau", "BDF"])
def test_indicators_of_state_time_and_input_are_those_of_the_closed_form(solver):
    def y(t):
        return 0.3 + np.sin(3.0 * t) / 3.0 + 0.05 * t**2

    def roots(indicator, *, both):
        t = np.linspace(1e-6, 4.0, 4001)
        z = indicator(t)
        change = np.flatnonzero((z[:-1] < 0) & (z[1:] > 0) | both & (z[:-1] > 0) & (z[1:] < 0))
        return [brentq(indicator, t[i], t[i + 1], xtol=1e-14) for i in change]

    made = Diagram("d", Wave(name="wave")(Gain(gain=0.1)(Clock())))
    run = made.simulate(4.0, step=0.1, solver=solver, rtol=1e-9, atol=1e-11, progress=False)
    for name, expected in (
        ("first", roots(lambda t: y(t) - np.sin(t), both=False)),
        ("second", roots(lambda t: np.exp(y(t)) - 1.2 - 0.1 * t, both=True)),
    ):
        assert len(expected) >= 1
        assert [e.t for e in run.events if e.event == name] == pytest.approx(expected, abs=1e-6)

"""The work of the search for events, and its parts: the root, and indicators at many instants in one call."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import Block, Clock, Compare, Constant, Event, Function, Gain, Input, Relay, State
from loopwright.diagrams import Diagram
from loopwright.diagrams.events import Domains, ManyInstants
from loopwright.diagrams.events.bracket import find_root
from loopwright.diagrams.simulation.workspace import Workspace
from support.hybrid_blocks import Lag


def thermostat():
    lag, relay = Lag(name="lag", k=0.5), Relay(name="relay", on_point=1.0, off_point=0.6)
    return Diagram("thermostat", lag((Gain(gain=-1.0, name="g")(relay(lag.y)) + 1.0).named("heat")))


def pwm():
    carrier = Function(lambda t: np.sin(2 * np.pi * 5 * t), name="carrier")(Clock())
    return Diagram(
        "pwm", Lag(name="lag", k=0.5)(Compare(">", name="above")(carrier, Constant(value=0.3, name="level")))
    )


@pytest.fixture
def single_calls(monkeypatch):
    """Count the evaluations of the indicators at single instants."""
    count, original = [0], Workspace.indicators

    def counted(self):
        g, opened = original(self)

        def call(t, x):
            count[0] += 1
            return g(t, x)

        return call, opened

    monkeypatch.setattr(Workspace, "indicators", counted)
    return count


@pytest.mark.parametrize("make", [thermostat, pwm])
def test_an_event_costs_a_dozen_single_evaluations_of_the_indicators(make, single_calls):
    """Forty halvings after each event, one after the other, would be 60."""
    run = make().simulate(20.0, step=0.1, progress=False)
    assert len(run.events) > 15
    assert single_calls[0] < 13 * len(run.events)


# --- the root --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    "f",
    [lambda d: d, lambda d: math.sinh(3 * d), lambda d: math.copysign(abs(d) ** 0.5, d), lambda d: math.atan(1e6 * d)],
)
def test_a_root_is_found_to_the_resolution_and_from_its_far_side(f, side):
    resolution = 4 * math.ulp(1.0)
    for root in (1e-3, 0.3, 0.7251, 0.999):
        asked = []

        def g(t, root=root, asked=asked):
            asked.append(t)
            return side * f(t - root)

        found = find_root(g, 0.0, g(0.0), 1.0, g(1.0), resolution)
        assert 0.0 <= found - root <= resolution
        assert abs(found - brentq(g, 0.0, 1.0, xtol=1e-15, rtol=1e-15)) <= 2 * resolution
        assert f(found - root) >= 0.0
        assert len(asked) < 300


def test_a_jump_through_zero_is_bracketed():
    found = find_root(lambda t: -2.0 if t < 0.3 else 1e9, 0.0, -2.0, 1.0, 1e9, 1e-15)
    assert 0.0 <= found - 0.3 <= 1e-15


def test_a_straight_line_takes_few_evaluations():
    count = [0]

    def line(t):
        count[0] += 1
        return 2.0 * (t - 0.3)

    find_root(line, 0.0, -0.6, 1.0, 1.4, 1e-15)
    assert count[0] <= 4


# --- many instants ---------------------------------------------------------------------------------------------------


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


@pytest.fixture
def searched(monkeypatch):
    """Note what the search is made with."""
    found = []
    original = Domains.__init__

    def noted(self, flat, g, many, *rest):
        original(self, flat, g, many, *rest)
        found.append((g, many))

    monkeypatch.setattr(Domains, "__init__", noted)
    return found


@pytest.mark.parametrize("n", [1, 7, 64, 150])
def test_many_instants_are_single_calls_to_the_last_bit(n, searched):
    Diagram("d", Wave(name="wave")(Gain(gain=0.1)(Clock()))).simulate(0.5, step=0.1, progress=False)
    g, many = searched[0]
    assert isinstance(many, ManyInstants)
    times, states = np.linspace(0.01, 0.09, n), np.linspace(-1.0, 1.0, n)[:, None]
    z, opened = many(times, states)
    assert np.array_equal(z, [g(t, x).copy() for t, x in zip(times.tolist(), states, strict=True)])
    assert np.all(opened == 1.0)


class Line:
    """A step in which the state is a polynomial."""

    t_old, t = 1.0, 1.5

    def polynomial(self):
        from loopwright.diagrams.solvers import Polynomial

        return Polynomial(1.0, 0.5, np.array([0.3]), np.array([[0.2, -0.7]]))


def test_a_scan_says_what_numpy_says(searched):
    Diagram("d", Wave(name="wave")(Gain(gain=0.1)(Clock()))).simulate(0.5, step=0.1, progress=False)
    _, many = searched[0]
    times = np.linspace(1.0, 1.5, 11)
    u = (times - 1.0) / 0.5
    y = 0.3 + 0.2 * u - 0.7 * u**2
    expected = np.stack([y - np.sin(times), np.exp(y) - 1.2 - 0.1 * times], axis=1)
    wide = np.full(2, -9.0), np.full(2, 9.0)
    scan = many.scan(Line(), times, wide)
    assert scan.z == pytest.approx(expected, abs=1e-14)
    assert scan.size == pytest.approx(np.abs(expected).max(axis=0), abs=1e-14)
    assert scan.later == pytest.approx(np.abs(expected[1:]).max(axis=0), abs=1e-14)
    near = np.abs(expected)
    dips = (near[1:-1] <= near[:-2]) & (near[1:-1] <= near[2:])
    assert scan.trouble == dips.sum() == 1  # the second one crosses zero
    assert many.scan(Line(), times, (np.array([-9.0, 0.0]), wide[1])).trouble >= 1 + np.sum(expected[1:, 1] < 0.0)
    assert scan.value(1.25) == pytest.approx(expected[5], abs=1e-14)


def test_a_scan_with_a_value_that_is_not_finite_is_trouble(searched):
    class Root(Wave):
        def indicators(self, t, x, u):
            return np.sqrt(x.y), x.y + 5.0

    Diagram("d", Root(name="wave")(Gain(gain=0.1)(Clock()))).simulate(0.5, step=0.1, progress=False)
    _, many = searched[0]
    scan = many.scan(Line(), np.linspace(1.0, 1.5, 11), (np.full(2, -9.0), np.full(2, 9.0)))
    assert math.isnan(scan.trouble)

"""What a block declares of its events, and what is traced of them."""

import math

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    DefinitionError,
    Event,
    Input,
    Output,
    SampleTimeError,
    State,
    TraceError,
    parameter,
)
from loopwright.blocks.tracing.traced import trace


class Thermostat(Block):
    """Heats below 19 degC, rests above 21 degC."""

    low: float = parameter(default=19.0)
    high: float = parameter(default=21.0)
    outside = Input()
    temperature = State(start=20.0, output=True)
    heats = State(start=1.0, discrete=True, output=True)
    cold = Event("falling")
    warm = Event("rising")

    def derivative(self, t, x, u):
        return 5.0 * x.heats - 0.1 * (x.temperature - u.outside)

    def indicators(self, t, x, u):
        return x.temperature - self.low, x.temperature - self.high

    def jump(self, t, x, u, fired):
        return x.temperature, np.where(fired.cold > 0.5, 1.0, np.where(fired.warm > 0.5, 0.0, x.heats))


def traced(block, sampled=False):
    return trace(block, dict.fromkeys(block.inputs, ()), sampled=sampled)


def flat(column):
    return np.ravel(np.array(column)).tolist()


def test_indicators_jump_and_rates_are_those_written():
    found = traced(Thermostat())
    p = found.pack(Thermostat(), np.nan)
    arguments = [0.0, [18.5, 0.0], 10.0, p]
    assert np.allclose(np.ravel(np.array(found.indicators.call(arguments)[0])), [-0.5, -2.5])
    assert np.allclose(np.ravel(np.array(found.jump.call([*arguments, [1.0, 0.0]])[0])), [18.5, 1.0])
    assert np.allclose(np.ravel(np.array(found.jump.call([*arguments, [0.0, 0.0]])[0])), [18.5, 0.0])
    rates = np.ravel(np.array(found.function.call(arguments)[2]))
    assert np.allclose(rates, [-0.85, 0.0])  # the discrete state rests between events


def test_events_are_listed_in_the_order_of_their_declaration():
    assert list(Thermostat.events) == ["cold", "warm"]
    assert [e.direction for e in Thermostat.events.values()] == ["falling", "rising"]
    assert not {"cold", "warm"} & (Thermostat.inputs.keys() | Thermostat.outputs.keys() | Thermostat.states.keys())


def test_an_event_is_no_signal():
    with pytest.raises(AttributeError, match="'cold' is an event of Thermostat"):
        _ = Thermostat().cold


class Relay(Block):
    """1 above +width, 0 below -width, in between what it was: a jump of its events, or at the ticks its update."""

    width: float = parameter(default=0.5)
    u = Input(shape=None)
    on = State(like="u", discrete=True, output=True)
    up = Event("rising")
    down = Event("falling")

    def indicators(self, t, x, u):
        return u.u - self.width, u.u + self.width

    def jump(self, t, x, u, fired):
        return np.where(fired.up > 0.5, 1.0, np.where(fired.down > 0.5, 0.0, x.on))

    def update(self, t, x, u):
        return np.where(u.u > self.width, 1.0, np.where(u.u < -self.width, 0.0, x.on))


def test_a_block_with_events_and_an_update_stands_in_both_frames():
    found = traced(Relay())
    assert found.advance == "derivative"
    p = found.pack(Relay(), np.nan)
    assert float(found.function(0.0, [1.0], 0.3, p)[1]) == 0.0  # at rest between events
    assert [float(found.jump(0.0, [0.0], 0.3, p, f)) for f in ([1, 0], [0, 1], [0, 0])] == [1.0, 0.0, 0.0]
    found = traced(Relay(), sampled=True)
    assert (found.advance, found.indicators, found.jump) == ("update", None, None)
    p = found.pack(Relay(), 0.1)
    assert [float(found.function(0.0, [0.0], u, p)[1]) for u in (0.6, 0.4, -0.6)] == [1.0, 0.0, 0.0]
    assert [float(found.function(0.0, [1.0], u, p)[1]) for u in (0.6, 0.4, -0.6)] == [1.0, 1.0, 0.0]


def test_rates_go_before_an_update_in_a_continuous_frame():
    class Both(Relay):
        level = State()

        def jump(self, t, x, u, fired):
            return super().jump(t, x, u, fired), x.level

        def derivative(self, t, x, u):
            return -2.0 * x.level

        def update(self, t, x, u):
            return super().update(t, x, u), 5.0 * x.level

    found = traced(Both())
    p = found.pack(Both(), np.nan)
    assert flat(found.function(0.0, [1.0, 3.0], 0.0, p)[1]) == [0.0, -6.0]
    found = traced(Both(), sampled=True)
    assert flat(found.function(0.0, [1.0, 3.0], 0.0, found.pack(Both(), 0.1))[1]) == [1.0, 15.0]


def test_a_discrete_state_may_be_a_vector():
    class Sampler(Block):
        u = Input(shape=(3,))
        kept = State(like="u", discrete=True, output=True)
        count = State(discrete=True)
        tick = Event("rising")

        def indicators(self, t, x, u):
            return np.sin(t)

        def jump(self, t, x, u, fired):
            return np.where(fired.tick > 0.5, u.u, x.kept), x.count + fired.tick

    found = trace(Sampler(), {"u": (3,)}, sampled=False)
    p = found.pack(Sampler(), np.nan)
    assert flat(found.function(0.0, [1, 2, 3, 4], [5, 6, 7], p)[1]) == [0.0] * 4
    assert flat(found.jump(0.0, [1, 2, 3, 4], [5, 6, 7], p, 1)) == [5, 6, 7, 5]
    assert flat(found.jump(0.0, [1, 2, 3, 4], [5, 6, 7], p, 0)) == [1, 2, 3, 4]


def test_an_event_may_have_no_states_behind_it():
    class Edge(Block):
        u = Input()
        y = Output()
        edge = Event()

        def output(self, t, x, u):
            return np.where(u.u > 0.0, 1.0, -1.0)

        def indicators(self, t, x, u):
            return u.u

        def jump(self, t, x, u, fired):
            return ()

    found = traced(Edge())
    assert found.indicators is not None
    assert found.jump(0.0, [], 1.0, found.pack(Edge(), np.nan), 1).shape == (0, 1)
    assert traced(Edge(), sampled=True).indicators is None


def test_a_sampled_block_without_events_stays_refused_in_a_continuous_frame():
    kept = type("Kept", (Block,), {"u": Input(), "x": State(), "update": lambda self, t, x, u: u.u})
    with pytest.raises(SampleTimeError, match="a sampled block is in a continuous subsystem"):
        traced(kept())


def test_the_sample_time_is_none_in_a_continuous_frame_where_that_is_the_default():
    class Two(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u, T=None):
            return -u.u if T is None else T * u.u

    found = traced(Two())
    assert float(found.function(0.0, [], 3.0, found.pack(Two(), np.nan))[0]) == -3.0
    found = traced(Two(), sampled=True)
    assert float(found.function(0.0, [], 3.0, found.pack(Two(), 0.25))[0]) == 0.75


def test_events_know_no_sample_time():
    class Wrong(Relay):
        def indicators(self, t, x, u, T):
            return u.u - T, u.u + T

    with pytest.raises(TraceError, match=r"found indicators\(self, t, x, u, T\); expected indicators\(self, t, x, u\)"):
        traced(Wrong())


def test_nothing_stops_a_run_and_no_instant_is_special_unless_a_block_says_so():
    assert Relay().next_instant(1.0) == math.inf
    assert Relay.stops is None


def test_events_without_an_update_are_refused_in_a_sampled_frame():
    with pytest.raises(SampleTimeError, match=r"thermostat: it has events \(cold, warm\), and it is in a sampled"):
        traced(Thermostat(), sampled=True)


def test_an_event_needs_its_equations():
    found = type("Mute", (Block,), {"x": State(), "hit": Event(), "derivative": lambda self, t, x, u: -x.x})
    with pytest.raises(TraceError, match=r"mute: it declares the events hit but has no indicators; write it"):
        traced(found())


def test_a_discrete_state_needs_an_event():
    found = type("Stuck", (Block,), {"mode": State(discrete=True)})
    with pytest.raises(TraceError, match="stuck: its states mode are discrete but no event changes them"):
        traced(found())


def test_a_jump_that_traces_wrongly_is_found():
    class Wrong(Thermostat):
        def jump(self, t, x, u, fired):
            return x.temperature, np.where(fired.cold > 0.5, 1.0, 0.5 * hidden())

    calls = []

    def hidden():
        calls.append(1)
        return 1.0 * len(calls)  # another number at each call: what no trace can keep

    with pytest.raises(TraceError, match="its traced equation gives .* for 'jump' where NumPy gives"):
        traced(Wrong())


def test_a_rate_that_traces_wrongly_is_found():
    calls = []

    class Wrong(Thermostat):
        def derivative(self, t, x, u):
            calls.append(1)
            return x.temperature * len(calls)

    with pytest.raises(TraceError, match="its traced equation gives .* for 'derivative' where NumPy gives"):
        traced(Wrong())


@pytest.mark.parametrize("arguments", [{"direction": "down"}, {"nominal": 0.0}])
def test_a_wrong_declaration_is_refused(arguments):
    with pytest.raises(DefinitionError, match="found .*expected"):
        Event(**arguments)

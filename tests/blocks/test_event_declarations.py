"""What a block declares of its events, and what is traced of them."""

import numpy as np
import pytest

from loopwright.blocks import Block, DefinitionError, Event, Input, SampleTimeError, State, TraceError, parameter
from loopwright.blocks._tracing import trace


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


def test_events_are_refused_in_a_sampled_frame():
    with pytest.raises(SampleTimeError, match=r"thermostat: it has events \(cold, warm\), and it stands in a sampled"):
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

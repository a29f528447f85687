"""Sliding modes of an ideal relay: fixed steps go on, variable ones name the block and the hysteresis to declare."""

import re

import numpy as np
import pytest

from loopwright.blocks import Compare, Constant, Gain, Integrator, Relay, SimulationError, Sine
from loopwright.diagrams import Diagram
from support.hybrid_blocks import Lag


def ideal_relay(make):
    """ẏ = ½ sin t − sign y from 0.3: from there on Filippov's solution is y = 0, with the mean of sign y = ½ sin t."""
    y = Integrator(name="y", initial_value=0.3)
    on = make(y.y)
    sign = Gain(gain=2.0, name="two")(on) - 1.0
    push = Sine(amplitude=0.5, frequency=1 / (2 * np.pi), name="push")
    return Diagram("sliding", y(push - sign), Lag(name="lag")(sign))


RELAYS = {
    "c": lambda y: Compare(">", name="c")(y, 0.0),
    "r": lambda y: Relay(on_point=0.0, off_point=0.0, initially_on=True, name="r")(y),
}


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["euler", "rk4"])
@pytest.mark.drawn(2)
@pytest.mark.parametrize("name", RELAYS)
def test_a_fixed_step_goes_on_and_says_so(solver, name):
    """The lag of the relay's output follows that of its mean, by an error of the order of the step."""
    errors = []
    for h in (0.02, 0.005):
        run = ideal_relay(RELAYS[name]).simulate(3.0, step=h, solver=solver, progress=False)
        slides = run.t > 0.5
        assert np.max(np.abs(run["y.y"][slides])) < 2.0 * h
        reached = 0.3  # about: y = 0.3 + ½ (1 − cos t) − t is 0 a little later
        for _ in range(50):
            reached = 0.3 + 0.5 * (1 - np.cos(reached))
        start = 1 - np.exp(-reached)
        late = run.t[slides] - reached
        mean = 0.25 * (np.sin(run.t[slides]) - np.cos(run.t[slides]))
        mean += (start - 0.25 * (np.sin(reached) - np.cos(reached))) * np.exp(-late)
        errors.append(np.max(np.abs(run["lag.y"][slides] - mean)))
        assert len([m for m in run.messages if "sliding mode" in m]) >= 1
        assert re.search(rf"t = 0\.3\d* s: {name}\.\w+ switches back and forth", " ".join(run.messages))
    assert errors[0] < 0.05
    assert errors[1] < 0.4 * errors[0]


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["auto", "BDF"])
@pytest.mark.drawn(2)
@pytest.mark.parametrize("name", RELAYS)
def test_a_variable_step_names_the_block_and_the_hysteresis(solver, name):
    with pytest.raises(SimulationError, match="chatters.*sliding mode.*hysteresis") as caught:
        ideal_relay(RELAYS[name]).simulate(6.0, step=0.01, solver=solver, progress=False)
    error = caught.value
    assert error.block == name
    assert error.t == pytest.approx(0.326398, abs=1e-4)
    size = float(re.search(r"with one of (\S+) it would switch", str(error))[1])
    assert 0.005 <= size <= 0.02  # the indicator changes by 0.5 to 1.5 times the step
    cured = ideal_relay(lambda y: Relay(on_point=size / 2, off_point=-size / 2, initially_on=True, name="r")(y))
    run = cured.simulate(6.0, step=0.01, solver=solver, progress=False)
    assert np.max(np.abs(run["y.y"][run.t > 0.5])) <= size / 2 * (1 + 1e-3)


def test_events_are_located_again_when_the_sliding_mode_is_over():
    """The relay slides until a push of 2 exceeds it."""
    y = Integrator(name="y", initial_value=0.1)
    sign = Gain(gain=2.0, name="two")(Compare(">", name="c")(y.y, 0.0)) - 1.0
    push = Sine(amplitude=2.0, frequency=0.05, name="push")
    count = Compare(">", name="late")(Integrator(name="clock")(Constant(value=1.0)), 4.5678)
    run = Diagram("d", y(push - sign), count).simulate(5.0, step=0.01, solver="rk4", progress=False)
    leaves = np.arcsin(0.5) / (2 * np.pi * 0.05)
    t = run.t[run.t > leaves + 0.5]
    w = 2 * np.pi * 0.05
    expected = 2.0 / w * (np.cos(w * leaves) - np.cos(w * t)) - (t - leaves)
    assert run["y.y"][run.t > leaves + 0.5] == pytest.approx(expected, abs=0.03)
    assert [e.t for e in run.events if e.block == "late"] == pytest.approx([4.5678], abs=1e-12)

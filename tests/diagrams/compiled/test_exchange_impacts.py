"""Events of an FMU's own indicators in model exchange: C takes it through Event Mode, and Python only looks at contact."""

import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.diagrams.compiled.handed_over import HandedOver
from loopwright.fmus import Fmu, bouncing_ball

TIGHT = {"rtol": 1e-8, "atol": 1e-10, "progress": False}


@pytest.fixture
def returns(monkeypatch):
    """Times in s at which Python has looked at an FMU for C."""
    found, look = [], HandedOver._look

    def noted(self, path, t, call):
        found.append(t)
        look(self, path, t, call)

    monkeypatch.setattr(HandedOver, "_look", noted)
    return found


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("impacts")
    return {fmi: bouncing_ball.build(out=folder / f"ball{fmi}.fmu", fmi=fmi) for fmi in (2, 3)}


def ball(file, name="ball", **options):
    return Fmu(file, name=name, interface="model_exchange", **options)


def both(made, duration, **options):
    one, two = (made.simulate(duration, compile=c, **TIGHT, **options) for c in (False, True))
    assert (one.tier, two.tier) == ("interpreted", "compiled"), two.messages
    size = np.abs(one.data).max(axis=0)
    assert (np.abs(one.data - two.data) <= 100 * (1e-8 * size + 1e-10)).all()
    assert [(e.block, e.event) for e in one.events] == [(e.block, e.event) for e in two.events]
    np.testing.assert_allclose([e.t for e in one.events], [e.t for e in two.events], rtol=1e-7, atol=1e-9)
    for a, b in zip(one.events, two.events, strict=True):
        assert a.before.keys() == b.before.keys()
        for name in a.before:
            np.testing.assert_allclose(a.before[name], b.before[name], atol=1e-6)
            np.testing.assert_allclose(a.after[name], b.after[name], atol=1e-6)
    return two


def impacts(restitution, end):
    g = bouncing_ball.nominal.gravity
    t, found = np.sqrt(2.0 / g), []
    v = g * t
    while t < end:
        found.append(t)
        v *= restitution
        t += 2.0 * v / g
    return found


@pytest.mark.parametrize("isolate", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fmi", [2, 3])
def test_impacts_stay_in_c(file, returns, fmi, isolate):
    made = Diagram("d", ball(file[fmi], start={"height": 1.0, "restitution": 0.8}, isolate=isolate)())
    run = both(made, 3.0, step=0.01)
    np.testing.assert_allclose([e.t for e in run.events], impacts(0.8, 3.0), atol=1e-8)
    assert not returns


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_impact_is_one_event_of_the_run(file, fmi, compiled):
    made = Diagram("d", ball(file[fmi], start={"height": 1.0, "restitution": 0.8})())
    run = made.simulate(3.0, step=0.01, compile=compiled, **TIGHT)
    expected = impacts(0.8, 3.0)
    assert len(run.events) == len(expected)
    np.testing.assert_allclose([e.t for e in run.events], expected, atol=1e-8)


def test_two_balls_one_after_the_other(file, returns):
    """One waits for its impact where the other has one: each log has its own states."""
    first = ball(file[3], "first", start={"height": 1.0, "restitution": 0.8})()
    second = ball(file[2], "second", start={"height": 2.0, "restitution": 0.7})()
    run = both(Diagram("d", first, second), 1.5, step=0.01)
    assert {e.block for e in run.events} == {"first", "second"}
    assert not returns


def test_a_ball_that_comes_to_rest(file, returns):
    """Impacts follow each other ever faster; contact, and what follows, is Python's: the height is 0 in the end."""
    made = Diagram("d", ball(file[3], start={"height": 1.0, "restitution": 0.3})())
    one, two = ((made.simulate(2.0, step=0.01, compile=c, **TIGHT)) for c in (False, True))
    assert two.tier == "compiled"
    assert np.abs(two["ball.height"][-20:]).max() < 1e-6
    np.testing.assert_allclose(one["ball.height"], two["ball.height"], atol=1e-6)
    assert abs(len(one.events) - len(two.events)) <= 2
    assert len(returns) < 20

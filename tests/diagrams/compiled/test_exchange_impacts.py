"""Events of an FMU's own indicators in model exchange: C takes it through Event Mode, and Python looks at none of them."""

import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.diagrams.compiled.model_exchange_in_c import ModelExchangeHandOver
from loopwright.fmus import Fmu, bouncing_ball

TIGHT = {"rtol": 1e-8, "atol": 1e-10, "progress": False}


@pytest.fixture
def returns(monkeypatch):
    """Times in s at which Python has looked at an FMU for C."""
    found, look = [], ModelExchangeHandOver._look

    def noted(self, path, t, call):
        found.append(t)
        look(self, path, t, call)

    monkeypatch.setattr(ModelExchangeHandOver, "_look", noted)
    return found


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("impacts")
    return {fmi: bouncing_ball.build(out=folder / f"ball{fmi}.fmu", fmi=fmi) for fmi in (2, 3)}


def ball(file, name="ball", **options):
    return Fmu(file, name=name, interface="model_exchange", **options)


def both(made, duration, **options):
    """Return the runs of both forms of a diagram's functions; C's loop goes through both."""
    runs = [made.simulate(duration, compile=c, **TIGHT, **options) for c in (False, True)]
    assert [run.tier for run in runs] == ["interpreted", "compiled"], runs[1].messages
    return runs


def impacts(restitution, end, height=1.0):
    """Impacts of a ball from a height in m, in closed form: times, velocities before and after; at the last one it rests."""
    g, slowest = bouncing_ball.nominal.gravity, bouncing_ball.nominal.resting_speed
    t, found = np.sqrt(2.0 * height / g), []
    v = g * t
    while t < end:
        rests = restitution * v < slowest
        found.append((t, -v, 0.0 if rests else restitution * v))
        if rests:
            break
        v *= restitution
        t += 2.0 * v / g
    return found


def flight(restitution, t, height=1.0):
    """Height and velocity of that ball at times."""
    g, found = bouncing_ball.nominal.gravity, []
    hits = impacts(restitution, t[-1], height)
    for at in t:
        begun, h, v = 0.0, height, 0.0
        for hit, _, after in hits:
            begun, h, v = (hit, 0.0, after) if hit <= at else (begun, h, v)
        rests = h == v == 0.0
        found.append(
            (0.0, 0.0) if rests else (h + v * (at - begun) - 0.5 * g * (at - begun) ** 2, v - g * (at - begun))
        )
    return np.array(found)


def check(run, name, restitution, height=1.0):
    """Hold the motion of a ball and its impacts, with the states beside them, against the closed form."""
    expected = impacts(restitution, run.t[-1], height)
    events = [e for e in run.events if e.block == name and e.before["velocity"] != e.after["velocity"]]
    np.testing.assert_allclose([e.t for e in events], [t for t, *_ in expected], atol=1e-8)
    for e, (_, before, after) in zip(events, expected, strict=True):
        assert (e.before["height"], e.after["height"]) == pytest.approx((0.0, 0.0), abs=1e-7)
        assert (e.before["velocity"], e.after["velocity"]) == pytest.approx((before, after), abs=1e-6)
    moved = np.transpose([run[f"{name}.height"], run[f"{name}.velocity"]])
    np.testing.assert_allclose(moved, flight(restitution, run.t, height), rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(
        run[f"{name}.bounces"], np.searchsorted([t for t, *_ in expected], run.t, side="right")
    )


@pytest.mark.parametrize("isolate", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fmi", [2, 3])
def test_impacts_stay_in_c(file, returns, fmi, isolate):
    made = Diagram("d", ball(file[fmi], start={"height": 1.0, "restitution": 0.8}, isolate=isolate)())
    for run in both(made, 3.0, step=0.01):
        check(run, "ball", 0.8)
        assert len(run.events) == 6
    assert not returns


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_impact_is_one_event_of_the_run(file, fmi, compiled):
    made = Diagram("d", ball(file[fmi], start={"height": 1.0, "restitution": 0.8})())
    run = made.simulate(3.0, step=0.01, compile=compiled, **TIGHT)
    expected = [t for t, *_ in impacts(0.8, 3.0)]
    assert len(run.events) == len(expected)
    np.testing.assert_allclose([e.t for e in run.events], expected, atol=1e-8)


def test_two_balls_one_after_the_other(file, returns):
    """One waits for its impact where the other has one: each log has its own states."""
    first = ball(file[3], "first", start={"height": 1.0, "restitution": 0.8})()
    second = ball(file[2], "second", start={"height": 2.0, "restitution": 0.7})()
    for run in both(Diagram("d", first, second), 1.5, step=0.01):
        check(run, "first", 0.8)
        check(run, "second", 0.7, 2.0)
    assert not returns


def test_a_ball_that_comes_to_rest(file, returns):
    """Impacts follow each other ever faster, until one would leave it slower than 0.01 m/s: there it rests."""
    made = Diagram("d", ball(file[3], start={"height": 1.0, "restitution": 0.3})())
    for run in both(made, 2.0, step=0.01):
        check(run, "ball", 0.3)
        assert run["ball.resting"][-1] == 1.0
        assert not run["ball.height"][-20:].any()
    assert not returns

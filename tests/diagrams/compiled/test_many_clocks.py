"""Many clocks in C's loop: sets of them that act together, however many there are and however late they come."""

import os
import signal
from threading import Timer

import numpy as np
import pytest

from loopwright.blocks import Constant, Integrator, PythonFunction, Ramp, SimulationError, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.flat import ClockSets, TickPattern, clock_sets

pytestmark = pytest.mark.one_tier
QUIET = {"progress": False}
PERIODS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 15, 16, 18, 20, 21, 24, 25, 28, 30, 35)
"""Twenty-two, in ms."""


def counter(period, signal, offset=0):
    """A sampled subsystem that adds its input up: period and offset in ms."""

    @subsystem(sample_time=period / 1000, offset=offset / 1000, name=f"every{period}")
    def count(u):
        memory = UnitDelay(initial_value=0.0, name="n")
        return memory(memory.y + u)

    return count(signal)


def expected(period, ticks):
    """Values of a counter at each ms: ones that were added before its last tick."""
    return np.arange(ticks + 1) // period * 1.0


@pytest.mark.parametrize("form", ["auto", True])
@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.slow
def test_each_of_22_subsystems_acts_at_its_ticks(monkeypatch, all_in_c, form, continuous):
    monkeypatch.setattr(clock_sets, "_MOST_SETS", 10_000)
    clock_sets._sets_of.cache_clear()
    one = Constant(value=1.0, name="one")
    others = [Integrator(name="time")(one)] if continuous else []
    periods = PERIODS[:8] if form is True else PERIODS  # each set of clocks is code of its own
    made = Diagram("clocks", *(counter(period, one) for period in periods), *others)
    run = made.simulate(0.4, compile=form, step=1e-3, **QUIET)
    for period in periods:
        assert np.array_equal(run[f"every{period}.n.y"], expected(period, 400))
    if continuous:
        assert run["time.y"] == pytest.approx(run.t, abs=1e-12)
    clock_sets._sets_of.cache_clear()


@pytest.mark.parametrize("continuous", [False, True])
def test_a_set_that_has_no_code_is_gone_through_by_python(monkeypatch, continuous):
    monkeypatch.setattr(clock_sets, "_MOST_SETS", 3)
    clock_sets._sets_of.cache_clear()
    one = Constant(value=1.0, name="one")
    others = [Integrator(name="time")(one)] if continuous else []
    made = Diagram("clocks", *(counter(period, one) for period in (2, 3, 5, 7)), *others)
    runs = [made.simulate(0.4, compile=form, step=1e-3, **QUIET) for form in ("auto", True)]
    clock_sets._sets_of.cache_clear()
    for run in runs:
        for period in (2, 3, 5, 7):
            assert np.array_equal(run[f"every{period}.n.y"], expected(period, 400))


@pytest.mark.parametrize("continuous", [False, True])
def test_a_set_that_comes_after_the_first_million_of_ticks_is_found(continuous):
    """Periods of 1021 and 1031 ms, the second from 10 ms on: both act after 1,051,630 ms for the first time."""
    one = Constant(value=1.0, name="one")
    others = [Integrator(name="time")(one)] if continuous else []
    made = Diagram("clocks", counter(1021, one), counter(1031, one, offset=10), *others)
    run = made.simulate(1055.0, compile="auto", **QUIET)
    assert run["every1021.n.y"][-1] == 1_055_000 // 1021
    assert run["every1031.n.y"][-1] == (1_055_000 - 10) // 1031


def test_sets_of_more_than_64_clocks_have_their_numbers():
    clocks = [TickPattern(every, every // 3) for every in range(2, 92)]
    ticks = np.arange(3000)
    every = np.arange(2, 92)
    acts = (ticks[:, None] >= every // 3) & ((ticks[:, None] - every // 3) % every == 0)
    acting = [frozenset(clocks[i] for i in np.flatnonzero(row)) for row in acts]
    sets = {acting[k]: k for k in range(0, 3000, 7)}
    found = ClockSets(clocks, sets).at(ticks)
    assert found.tolist() == [sets.get(one, -1) for one in acting]
    assert (found >= 0).sum() >= len(sets)
    listed = clock_sets._sets_of(tuple(clocks))
    assert len(set(listed)) == len(listed) == clock_sets._MOST_SETS


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.drawn(2)
def test_what_was_recorded_before_an_error_at_such_a_set_is_kept(monkeypatch, continuous, error):
    """The clocks of 2, 3, 5 and 7 ms act together at 210 ms, for which there is no code; samples end before."""
    monkeypatch.setattr(clock_sets, "_MOST_SETS", 3)
    clock_sets._sets_of.cache_clear()

    raised = []

    def fails(u):
        if u > 0.205 and (error is ValueError or not raised):  # an interrupt comes once
            raised.append(u)
            raise error("enough")
        return u

    time = Ramp(slope=1.0, name="ramp")

    @subsystem(sample_time=0.07, name="slow")
    def slow(u):
        called = PythonFunction(fails, arguments={"u": ()}, results={"y": ()}, name="python")
        return UnitDelay(initial_value=0.0, name="late")(called(u))

    one = Constant(value=1.0, name="one")
    others = [Integrator(name="time")(one)] if continuous else []
    made = Diagram("clocks", *(counter(period, one) for period in (2, 3, 5, 7)), slow(time), *others)
    expected_error = KeyboardInterrupt if error is KeyboardInterrupt else SimulationError
    with pytest.raises(expected_error, match="enough|interrupted at t = 0.209 s") as caught:
        made.simulate(0.4, step=1e-3, solver="rk4" if continuous else "auto", **QUIET)
    clock_sets._sets_of.cache_clear()
    run = caught.value.run
    assert run.t[-1] == pytest.approx(0.209, abs=1e-9)
    for period in (2, 3, 5, 7):
        assert np.array_equal(run[f"every{period}.n.y"], expected(period, 209))


@pytest.mark.skipif(os.name != "posix", reason="sends itself a signal")
@pytest.mark.parametrize("continuous", [False, True])
def test_an_interrupt_while_c_runs_is_no_end_of_a_rare_tick(monkeypatch, continuous):
    """Python would raise it as C calls for the rare tick, where ctypes drops it, and C would take the tick for done."""
    monkeypatch.setattr(clock_sets, "_MOST_SETS", 1)
    clock_sets._sets_of.cache_clear()
    one = Constant(value=1.0, name="one")
    others = [Integrator(name="time")(one)] if continuous else []
    made = Diagram("clocks", *(counter(period, one) for period in (1, 1021)), *others)  # together once in 1021 ticks
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = Timer(0.1, os.kill, (os.getpid(), signal.SIGINT))
    try:
        with made.simulation(step=1e-3) as simulation:
            simulation.advance(50.0)
            timer.start()
            with pytest.raises(KeyboardInterrupt):
                simulation.advance(1e4)
    finally:
        timer.cancel()
        signal.signal(signal.SIGINT, before)
        clock_sets._sets_of.cache_clear()

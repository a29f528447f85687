"""Runs in both forms, interpreted and compiled."""

import pytest

from loopwright.diagrams.simulation.sampled_ticks import SampledTicks
from loopwright.diagrams.simulation.ticks_in_c import TicksInC


def refuse_ticks_by_python(patch):
    """Let a run fail in which Python goes through a tick that C's loop could not; ``patch`` undoes it."""

    def refused(*_, **__):
        raise AssertionError("Python had to look at a tick")

    patch.setattr(SampledTicks, "_take_tick", refused)
    patch.setattr(TicksInC, "_take_rare_tick", refused)


def both(made, duration, **options):
    """Run a diagram interpreted and compiled, and return both runs; all ticks of the second one are done in C."""
    interpreted = made.simulate(duration, compile=False, progress=False, **options)
    with pytest.MonkeyPatch.context() as patch:
        refuse_ticks_by_python(patch)
        compiled = made.simulate(duration, compile=True, progress=False, **options)
    assert not any(message.startswith("Interpreted") for message in compiled.messages)
    return interpreted, compiled


def assert_same_bits(first, second):
    assert first.t.tobytes() == second.t.tobytes()
    assert first.data.tobytes() == second.data.tobytes()
    assert first.stopped == second.stopped

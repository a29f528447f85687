"""Runs in both forms, interpreted and compiled."""

from unittest import mock

from loopwright.diagrams.simulation.compiled_ticks import CompiledTicks


def both(made, duration, **options):
    """Run a diagram interpreted and compiled, and return both runs; all ticks of the second one are done in C."""
    interpreted = made.simulate(duration, compile=False, progress=False, **options)
    with mock.patch.object(CompiledTicks, "_take_tick", side_effect=AssertionError("Python had to look at a tick")):
        compiled = made.simulate(duration, compile=True, progress=False, **options)
    assert not any(message.startswith("Interpreted") for message in compiled.messages)
    return interpreted, compiled


def assert_same_bits(first, second):
    assert first.t.tobytes() == second.t.tobytes()
    assert first.data.tobytes() == second.data.tobytes()
    assert first.stopped == second.stopped

"""A diagram that nobody refers to any more goes, with all that was made of it to run it."""

import gc
import weakref

import pytest

from loopwright.blocks import Compare, Gain, Integrator, Sine, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.flat import FlatDiagram

pytestmark = pytest.mark.one_tier  # the comparison of forms keeps the diagram of its last run


@subsystem(sample_time=0.01, name="box")
def box(u):
    return UnitDelay(name="delay")(u)


def sampled(gain):
    return Diagram("sampled", box(Gain(gain=gain)(Sine(frequency=1.0))))


def continuous(gain):
    return Diagram("continuous", Integrator(name="x")(Gain(gain=gain)(Sine(frequency=1.0))))


def with_events(gain):
    return Diagram("events", Integrator(name="x")(Compare(">")(Gain(gain=gain)(Sine(frequency=1.0)), 0.5)))


def functions_of(made):
    """Return weak references to all that a diagram has been flattened into."""
    return [
        weakref.ref(flat)
        for flat in gc.get_objects()
        if isinstance(flat, FlatDiagram) and flat.table is made.wired.structure
    ]


@pytest.mark.drawn(1)
@pytest.mark.parametrize("compiled", [False, "auto", True])
@pytest.mark.parametrize("make", [sampled, continuous, with_events])
def test_a_diagram_that_has_run_is_not_kept(make, compiled):
    made = make(2.0)
    made.simulate(2.0, step=0.01, compile=compiled, progress=False)
    flats = functions_of(made)
    assert flats
    del made
    gc.collect()
    assert [flat() for flat in flats if flat() is not None] == []


def test_a_diagram_whose_runs_went_side_by_side_is_not_kept():
    made = sampled(2.0)
    made.sweep({"gain.gain": [1.0, 2.0, 3.0, 4.0]}, 0.5, signals="box.delay.y", lanes=4, workers=1, progress=False)
    flats = functions_of(made)
    assert flats
    del made
    gc.collect()
    assert [flat() for flat in flats if flat() is not None] == []

"""A diagram's loop as one C text with one block of memory: the numbers of a run, without Python and without a plant."""

import numpy as np
import pytest

from loopwright.blocks import PID, PT1, Gain, Step, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.exporting import loop_spec, open_part, open_subsystem
from support.exported_loops import Loop


@subsystem(sample_time=1e-2)
def controller(reference, level):
    """PI with a filtered derivative."""
    return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")


@pytest.fixture(scope="module")
def diagram():
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
    return Diagram("level", plant(controller(Step(times=0.05, values=1.0, name="wanted"), plant.y)))


@pytest.fixture(scope="module")
def spec(diagram):
    return loop_spec(open_part(diagram.wired, "controller", "pi"), name="pi", description="")


def replay(loop, run, steps, names, output):
    """Give the inputs of a run's samples to an exported loop; return its output after each."""
    assert loop.start()
    found = []
    for k in range(steps):
        for name, signal in names.items():
            loop[name] = run[signal][k]
        assert loop.advance(run.t[k + 1])
        found.append(loop[output])
    return np.array(found)


def test_an_exported_controller_has_the_bits_of_the_run(diagram, spec):
    run = diagram.simulate(1.0, progress=False)
    signals = {"reference": "wanted.y", "level": "plant.y"}
    assert {one.variable.name for one in spec.inputs} == {"reference", "level"}
    assert [one.variable.name for one in spec.outputs] == ["effort"]
    found = replay(Loop(spec), run, 100, signals, "effort")
    np.testing.assert_array_equal(found, run["effort"][:100])
    assert np.ptp(found) > 1.0


def test_the_memory_is_all_there_is_of_an_instance(diagram, spec):
    run = diagram.simulate(1.0, progress=False)
    signals = {"reference": "wanted.y", "level": "plant.y"}
    one, other = Loop(spec), Loop(spec)
    replay(one, run, 50, signals, "effort")
    other.memory[:] = one.memory[:]  # of another instance, elsewhere: all pointers lead to the first one
    other.bind()
    one.memory[:] = b"\xff" * len(one.memory)
    for k in range(50, 100):
        other["reference"], other["level"] = run["wanted.y"][k], run["plant.y"][k]
        assert other.advance(run.t[k + 1])
        assert other["effort"] == run["effort"][k]


def test_a_communication_step_may_span_ticks_and_lie_between_them(spec):
    """The inputs of a step are held over it; a tick acts at its start, and not at its end."""
    fine, coarse = Loop(spec), Loop(spec)
    for loop in (fine, coarse):
        assert loop.start()
        loop["reference"] = 1.0
    for k in range(1, 41):
        assert fine.advance(k * 2.5e-3)
    assert coarse.advance(0.1)
    assert fine["effort"] == coarse["effort"]
    # by hand: P + D + I with T_f = 0.02 s, T = 0.01 s, ten ticks, of which the last one has seen nine integrations
    assert coarse["effort"] == pytest.approx(2.0 + 3.0 * 9 * 0.01, rel=1e-14)


def test_a_value_that_is_not_finite_stops_it_before_the_tick(spec):
    loop = Loop(spec)
    assert loop.start()
    loop["level"] = np.nan
    assert not loop.advance(0.01)
    loop["level"] = 0.0
    assert loop.advance(0.01)
    assert np.isfinite(loop["effort"])


def test_delays_of_two_outputs_begin_with_their_own_values():
    """The blocks that delays have become are other ones in a part of a diagram."""

    @subsystem(sample_time=0.01, delay=1)
    def late(u):
        return Gain(gain=100.0)(u).named("large"), Gain(gain=1.0)(u).named("small")

    large, small = late(Step(times=0.05, values=1.0, initial_value=-0.7, name="wanted"))
    diagram = Diagram("two", large.named("a"), Gain(gain=1.0)(small).named("c"))
    loop = Loop(loop_spec(open_part(diagram.wired, "late", "late"), name="late"))
    loop["u"] = 0.5
    assert loop.start()
    assert (loop["large"], loop["small"]) == (50.0, 0.5)
    loop["u"] = 2.0
    assert loop.advance(0.01)
    assert (loop["large"], loop["small"]) == (50.0, 0.5)
    assert loop.advance(0.02)
    assert (loop["large"], loop["small"]) == (200.0, 2.0)


def test_an_output_with_the_name_of_an_input_is_called_after_its_block():
    half = subsystem(sample_time=0.01, name="half")(lambda y: Gain(gain=0.5)(y))
    spec = loop_spec(open_subsystem(half, Diagram, "half"), name="half")
    assert [one.variable.name for one in (*spec.inputs, *spec.outputs)] == ["y", "gain_y"]


@pytest.mark.slow
@pytest.mark.parametrize("sample_time", [1e-2, None])
def test_a_diagram_of_many_blocks_is_exported(sample_time):
    """It runs in groups of equal blocks, and leaves as one function that calls theirs."""

    @subsystem(sample_time=sample_time)
    def chain(u):
        y = u
        for i in range(500):
            y = PT1(time_constant=1e-2 + 1e-5 * i, name=f"lag{i}")(y).y
        return y.named("y")

    diagram = Diagram("chain", chain(Step(times=0.0, values=1.0, name="step")))
    spec = loop_spec(open_part(diagram.wired, "chain", "chain"), name="chain", description="", rtol=1e-9, atol=1e-9)
    options = {} if sample_time else {"step": 1e-2, "rtol": 1e-9, "atol": 1e-9}
    run = diagram.simulate(12.0, progress=False, **options)
    if sample_time:
        np.testing.assert_array_equal(replay(Loop(spec), run, 1200, {"u": "step.y"}, "y"), run["y"][:1200])
    else:
        found = replay(Loop(spec), run, 1200, {"u": "step.y"}, "y")
        np.testing.assert_allclose(found, run["y"][1:], rtol=0.0, atol=1e-6)
    assert run["y"][-1] > 0.9

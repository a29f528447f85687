"""The first ticks of runs side by side: those that each run has by itself, from numbers of its own."""

import numpy as np
import pytest

from loopwright.blocks import (
    Compare,
    Constant,
    FilteredDerivative,
    Function,
    Gain,
    PulseTrain,
    RateLimiter,
    Sine,
    Step,
    StopCondition,
    UnitDelay,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from loopwright.diagrams.sweeps.plan import make_plan
from loopwright.diagrams.sweeps.samples import Sample
from loopwright.diagrams.sweeps.workers import make_worker
from loopwright.fmus import Fmu
from loopwright.fmus.models import mass_spring_damper
from support.lanes import QUIET, T, loop, three_plants

LANES = 4
NEAR = 1e-13
"""The change between two passes at which the start of coupled FMUs counts as found; others differ by some roundings."""


def started(diagram, table, signal="y", *, together=True):
    """Return the first ticks of some runs, by what `LaneStart` calls them, found together or one by one."""
    with make_worker(make_plan(diagram.wired, 0.1, (signal,), None, (), {}, lanes=LANES)) as worker:
        numbers = [worker._variation.find(worker.plan.parameters_of(Sample(0, row, 0))) for row in table]
        lanes = worker._lanes(numbers[0], worker._bind(numbers[0]))
        assert not isinstance(lanes, str), lanes
        if not together:
            found = [lanes.start(own) for own in numbers]
            plants = [np.concatenate([np.zeros(0), *start.plants.values()]) for start in found]
            return [
                {name: getattr(start, name) for name in ("p", "x", "w", "z", "row")} | {"plants": values}
                for start, values in zip(found, plants, strict=True)
            ]
        vectors, places = lanes.start_together(numbers)
        assert places == list(range(len(table)))
        names = "p", "x", "w", "z", "row", "plants"
        return [{name: getattr(vectors, name)[:, lane].copy() for name in names} for lane in range(len(table))]


def boxed(function, name="box", **options):
    return subsystem(sample_time=T, name=name, **options)(function)


def starting():
    """Blocks that start from their inputs, one from another, behind a source that jumps at t = 0."""

    def inside(u, v):
        slow = RateLimiter(rising=2.0, name="slow")(u)
        return slow, FilteredDerivative(time_constant=0.05, name="rate")(slow + v)

    jump = Step(times=0.0, values=2.0, name="jump", initial_value=0.5)
    slow, rate = boxed(inside)(Gain(gain=3.0, name="k")(jump), Sine(frequency=2.0, name="sine") + 1.0)
    return Diagram("starting", slow.named("y"), rate.named("rate"))


def gated():
    """A counter that is enabled from the start on, and holds its first output."""

    def inside(u):
        kept = UnitDelay(initial_value=0.2, name="kept")
        kept(kept.y + u)
        return kept.y + u

    on = PulseTrain(period=0.04, name="on")
    return Diagram("gated", boxed(inside, enabled="held")(Gain(gain=1.5, name="k")(2.0), enable=on).named("y"))


def chained():
    """Two FMUs, one behind the acceleration of the other: their outputs at the start need several passes."""
    first, second = (Fmu(mass_spring_damper.build(), name=name) for name in ("first", "second"))
    push, pull = boxed(lambda a, b: (2.0 + 0.02 * a - 0.01 * b, Gain(gain=0.4, name="k")(a)))(
        first.acceleration, second.acceleration
    )
    return Diagram("chained", first(force=push), second(force=pull), second.acceleration.named("y"))


CASES = {
    "lag": (
        loop,
        [{"plant.start.gain": g, "plant.start.bend": g - 0.4, "box.kp.gain": 2.0 * g} for g in (0.5, 1.0, 2.0)],
    ),
    "slow": (lambda: loop(slow=3), [{"plant.start.lag": g, "slow.kept.initial_value": g} for g in (0.5, 1.0)]),
    "arm": (
        three_plants,
        [{"box.arm_gain.gain[1,1]": g, "mass_spring_damper.start.position": g} for g in (0.5, 1.0, 2.0, 3.0)],
    ),
    "starting": (starting, [{"k.gain": g} for g in (0.5, 1.0, 2.0)]),
    "starting otherwise": (starting, [{"box.rate.time_constant": g} for g in (0.02, 0.06)]),
    "gated": (gated, [{"k.gain": g} for g in (0.5, 1.0, 2.0)]),
    "chained": (chained, [{"box.k.gain": g, "first.start.mass": 1.0 + g} for g in (0.5, 1.0, 1.5, 0.2)]),
}


@pytest.mark.drawn(3)
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "arm" else n for n in CASES])
def test_runs_start_together_as_each_does_by_itself(name):
    make, table = CASES[name]
    diagram, signal = make(), {"lag": "x", "slow": "k", "arm": "tip"}.get(name, "y")
    together, alone = started(diagram, table, signal), started(diagram, table, signal, together=False)
    for one, other in zip(together, alone, strict=True):
        for kind, values in other.items():
            np.testing.assert_allclose(one[kind], values, rtol=NEAR, atol=NEAR, err_msg=kind)
    neighbour = started(diagram, table[1:], signal)  # whoever starts beside it changes no bit
    for one, other in zip(together[1:], neighbour, strict=True):
        for kind, values in one.items():
            assert values.tobytes() == other[kind].tobytes(), kind


def test_outputs_of_coupled_fmus_at_the_start_are_the_solution_of_their_equations():
    """At rest m a = u − k x, with forces that are linear in both accelerations."""
    table = [{"box.k.gain": g, "first.start.mass": m} for g, m in ((0.4, 1.0), (0.9, 2.0), (-0.3, 1.5))]
    for row, found in zip(table, started(chained(), table), strict=True):
        variables = Fmu(mass_spring_damper.build(), name="m").description.variables
        second_mass, k, x = (float(variables[name].start) for name in ("mass", "stiffness", "position"))
        matrix = np.array([[row["first.start.mass"] - 0.02, 0.01], [-row["box.k.gain"], second_mass]])
        wanted = np.linalg.solve(matrix, [2.0 - k * x, -k * x])
        assert found["row"] == pytest.approx(wanted[1:], abs=1e-12)


def test_runs_that_are_over_or_fail_at_the_start_go_by_themselves():
    def inside(u):
        y = Gain(gain=1.0, name="k")(u)
        StopCondition(name="stop")(Compare(">", name="above")(y, 2.5))
        return Function(lambda u: 1.0 / (u - 2.0), name="pole")(y)

    diagram = Diagram("ends", boxed(inside)(Constant(value=1.0, name="one")).named("y"))
    gains = (1.0, 2.0, 3.0, 1.5)
    options = {"signals": "y", "workers": 1, **QUIET}
    found, alone = (diagram.sweep({"k.gain": gains}, 0.1, lanes=n, **options) for n in (LANES, False))
    assert found.failed.tolist() == [False, True, False, False]
    assert [f.message for f in found.failures] == [f.message for f in alone.failures]
    assert np.array_equal(found.end, alone.end, equal_nan=True)
    assert [DIFFER in outcome.messages for outcome in found.outcomes] == [True, False, False, True]
    np.testing.assert_allclose(found["y"][[0, 3]], alone["y"][[0, 3]], rtol=NEAR)


def test_a_source_of_its_own_that_jumps_is_started_by_itself():
    diagram = starting()
    values = [{"jump.values": v, "jump.times": t} for v, t in ((2.0, 0.0), (3.0, 0.05), (1.0, 0.0))]
    options = {"signals": ["y", "rate"], "workers": 1, **QUIET}
    found, alone = (diagram.sweep(None, 0.1, samples=values, lanes=n, **options) for n in (LANES, False))
    for name in options["signals"]:
        np.testing.assert_allclose(found[name], alone[name], rtol=NEAR, atol=1e-12)


def test_the_gantry_starts_together_with_others():
    diagram = experiments.hand_guiding().diagram
    names = "plant.start.coulomb_scale", "controller.admittance_perp.stiffness"
    table = [{names[0]: f, names[1]: 200.0 * f} for f in (0.5, 0.8, 1.1)]
    together, alone = (started(diagram, table, "xi", together=both) for both in (True, False))
    for one, other in zip(together, alone, strict=True):
        for kind, values in other.items():
            np.testing.assert_allclose(one[kind], values, rtol=NEAR, atol=1e-12, err_msg=kind)

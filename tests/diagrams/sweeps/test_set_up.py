"""The set-up of a run in a sweep: few calls of Python, and none for each tick."""

import sys

import numpy as np
import pytest

from loopwright.blocks import Constant, DiscreteTransferFunction
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.sweeps import final, maximum
from loopwright.diagrams.sweeps.bound_run import BoundRun
from loopwright.diagrams.sweeps.plan import make_plan
from loopwright.diagrams.sweeps.samples import Sample
from loopwright.diagrams.sweeps.worker import Worker
from loopwright.diagrams.sweeps.workers import make_worker

KEPT = {"xi": final("xi"), "force": maximum("motor_force")}


def samples(count):
    fractions = np.linspace(0.5, 1.5, count)
    names = "plant.start.coulomb_scale", "controller.admittance_perp.stiffness"
    return [Sample(k, {names[0]: float(f), names[1]: float(200.0 * f)}, k) for k, f in enumerate(fractions)]


def count_calls(worker, *given):
    """Return how many functions of Python some runs call; functions of C are not counted."""
    seen = []
    sys.setprofile(lambda frame, event, argument: seen.append(1) if event == "call" else None)
    try:
        outcomes = [*worker.run_all(given)]
    finally:
        sys.setprofile(None)
    assert all(outcome.failure is None for outcome in outcomes)
    return len(seen)


@pytest.fixture(scope="module")
def diagram():
    return experiments.hand_guiding().diagram


def test_a_run_of_a_sweep_calls_few_functions_of_python_and_none_for_each_tick(diagram):
    found = {}
    for ticks in (2, 500):
        with Worker(make_plan(diagram.wired, 0.001 * ticks, (), KEPT, (), {})) as worker:
            *first, last = samples(6)
            for sample in first:  # the chunks of ticks grow
                worker.run(sample)
            found[ticks] = count_calls(worker, last)
    assert found[2] == found[500]
    assert found[2] < 450  # 960, and one a tick, where start values, columns and ticks are looked up in every run


def test_start_values_are_set_in_one_call_and_a_run_of_others_is_a_single_run(diagram):
    with Worker(make_plan(diagram.wired, 0.05, ("xi",), {"force": KEPT["force"]}, (), {})) as worker:
        for sample in samples(3):
            found = worker.run(sample)
            assert worker._bound[None].engine.plants["plant"]._starts.bound is not None  # by the short way
            single = diagram.replace(sample.parameters).simulate(0.05, progress=False)
            assert found.signals["xi"].tobytes() == single["xi"].tobytes()
            assert found.numbers["force"].tobytes() == single["motor_force"].max(axis=0).tobytes()


def test_two_threads_set_up_twice(diagram, monkeypatch):
    made = []
    enter = BoundRun.__enter__
    monkeypatch.setattr(BoundRun, "__enter__", lambda self: (made.append(self), enter(self))[1])
    parameters = {"plant.coulomb_scale": np.linspace(0.5, 1.5, 8).tolist()}
    found = diagram.sweep(parameters, 0.02, reduce=KEPT, workers=2, progress=False)
    assert not found.failures
    assert len(made) <= 2


def test_runs_side_by_side_are_started_together(diagram):
    with make_worker(make_plan(diagram.wired, 0.002, (), KEPT, (), {}, lanes=8)) as worker:
        assert worker.can_compile(samples(1)[0])
        given = samples(24)
        [*worker.run_all(given[:8])]
        found = count_calls(worker, *given[8:])
    assert found / 16 < 200  # 317 where each run is started by itself


def test_the_first_tick_of_a_compiled_run_is_evaluated_in_c(diagram):
    with diagram.simulation(compile=True) as simulation:
        assert simulation._engine.workspace._native
    with diagram.simulation(compile=False) as simulation:
        assert not simulation._engine.workspace._native


def test_a_block_is_built_once_for_all_of_its_parameters(monkeypatch):
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return DiscreteTransferFunction(numerator=(0.3, 0.2), denominator=(1.0, -0.4), name="filter")(u)

    diagram = Diagram("filtered", box(Constant(value=1.0, name="one")).named("y"))
    names = [f"box.filter.{name}" for name in ("numerator[1]", "numerator[2]", "denominator[2]")]
    built = []
    plain = DiscreteTransferFunction.replace

    def replace(block, **changes):
        built.append(changes)
        return plain(block, **changes)

    with Worker(make_plan(diagram.wired, 3.0, (), {"end": final("y")}, (), {})) as worker:
        monkeypatch.setattr(DiscreteTransferFunction, "replace", replace)
        found = worker.run(Sample(0, dict(zip(names, (0.1, 0.4, -0.5), strict=True)), 0))
    assert len(built) == 1
    assert abs(found.numbers["end"] - (0.1 + 0.4) / (1.0 - 0.5)) < 1e-6  # the gain at rest

"""Runs of a diagram after its first one have its numbers; their start values come from traced functions."""

import sys

import numpy as np
import pytest

from loopwright.blocks import Clock, Constant, DiscreteIntegrator, Function, Gain, Step, Sum, UnitDelay
from loopwright.diagrams import Diagram, NonFiniteError, experiments, subsystem
from loopwright.fmus import Fmu, mass_spring_damper


@pytest.mark.parametrize("enabled", [0.0, 1.0])
def test_an_enabled_subsystem_holds_the_output_of_the_start(enabled):
    @subsystem(sample_time=0.1, enabled="held", name="box")
    def box(u):
        return UnitDelay(name="delay")(Gain(gain=2.0, name="gain")(u))

    source = Step(times=0.0, values=3.0, initial_value=1.0, name="source")
    diagram = Diagram("d", box(source, enable=Constant(value=enabled, name="on")).named("y"))
    rest = 6.0 if enabled else 2.0  # the delay starts with twice the value before the jump
    for _ in range(3):
        run = diagram.simulate(0.3, progress=False)
        assert run["y"].tolist() == [2.0, rest, rest, rest]


def test_a_zero_keeps_its_sign():
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return UnitDelay(name="delay")(Gain(gain=-2.0, name="gain")(u))

    diagram = Diagram("d", box(Clock()).named("y"))
    signs = [np.signbit(diagram.simulate(0.1, progress=False)["y"][0]) for _ in range(3)]
    assert signs == [True] * 3  # -2 times 0 s


def test_a_value_that_is_added_and_taken_away_again_is_computed_block_by_block():
    """Before its first tick a subsystem holds what follows from its inputs: −1 times −u + u, and (u + 1e17) − 1e17."""

    @subsystem(sample_time=0.2, offset=0.1, name="box")
    def box(u):
        zero = Gain(gain=-1.0, name="zero")(Sum(signs="-+", name="nothing")(u, u))
        large = Constant(value=1e17, name="large")
        return zero, Sum(signs="+-", name="back")(Sum(name="forth")(u, large), large)

    zero, back = box(Constant(value=3.0, name="three"))
    diagram = Diagram("d", zero.named("zero"), back.named("back"))
    for _ in range(3):
        run = diagram.simulate(0.1, progress=False)
        assert np.signbit(run["zero"][0])
        assert run["back"][0] == (3.0 + 1e17) - 1e17 == 0.0


def test_an_input_that_is_not_finite_at_the_start_has_its_error_in_every_run():
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return UnitDelay(name="delay")(Function(lambda u: 1.0 / (u - 1.0), name="ratio")(u))

    diagram = Diagram("d", box(Constant(value=1.0, name="one")).named("y"))
    found = []
    for _ in range(3):
        with pytest.raises(NonFiniteError, match="box.delay.u begins with it") as error:
            diagram.simulate(0.1, progress=False)
        found.append((str(error.value), error.value.block, error.value.t))
    assert found == [found[0]] * 3
    assert found[0][1:] == ("box.ratio", 0.0)


def test_start_values_are_those_of_the_run_and_not_of_the_one_before():
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return DiscreteIntegrator(initial_value=0.0, name="sum")(UnitDelay(name="delay")(u))

    diagram = Diagram("d", box(Constant(value=1.0, name="one")).named("y"))
    for value in (1.0, 5.0, -2.0):
        run = diagram.replace({"one.value": value}).simulate(0.2, progress=False)
        np.testing.assert_allclose(run["y"], [0.0, 0.1 * value, 0.2 * value], rtol=1e-14)


def test_experiment_c_has_the_bits_of_its_first_run():
    diagram = experiments.hand_guiding().diagram
    runs = [diagram.simulate(0.02, progress=False) for _ in range(3)]
    for run in runs[1:]:
        assert {n: run[n].tobytes() for n in run.names} == {n: runs[0][n].tobytes() for n in run.names}


@pytest.mark.one_tier
def test_a_further_run_calls_few_functions_of_python():
    diagram, seen = experiments.hand_guiding().diagram, []
    for _ in range(3):
        diagram.simulate(0.002, progress=False)
    sys.setprofile(lambda frame, event, argument: seen.append(1) if event == "call" else None)
    try:
        diagram.simulate(0.002, progress=False)
    finally:
        sys.setprofile(None)
    assert len(seen) < 1800  # 2100, where descriptions, layouts and durations are looked up again and again


def test_a_run_has_the_start_the_duration_and_the_cache_of_its_own_call(tmp_path, monkeypatch):
    """An undamped mass on a spring, held at no force, is at x₀ cos(ω t): ω = 20 rad/s of 800 N/m and 2 kg."""
    given = {"damping": 0.0, "stiffness": 800.0, "mass": 2.0, "position": 0.0}
    plant = Fmu(mass_spring_damper.build(out=tmp_path / "mass.fmu"), start=given, isolate=False, name="plant")
    diagram = Diagram("swing", plant(force=Constant(value=0.0)).position.named("x"))
    for k, (start, duration) in enumerate([(0.1, 0.05), (-0.3, 0.2), (0.1, 0.05)]):
        monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / f"cache {k}"))
        run = diagram.replace({"plant.start.position": start}).simulate(duration, step=0.01, progress=False)
        np.testing.assert_allclose(run["x"], start * np.cos(20.0 * np.arange(run.t.size) * 0.01), atol=1e-6)
        assert run.t.size == round(duration / 0.01) + 1
        assert any((tmp_path / f"cache {k}" / "unpacked").iterdir())

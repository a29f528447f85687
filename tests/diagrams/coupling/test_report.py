"""The delays that `report_coupling` lists, against the phase of a signal in a run."""

import numpy as np
import pytest

from loopwright.blocks import Gain
from loopwright.diagrams import Coupling, Diagram, subsystem
from loopwright.diagrams.coupling import HeldFrom, LinkKind
from support.oscillators import coupled_by_inertia, mass, mass_and_filter, two_masses


def by_target(report):
    return {c.target: c for c in report.connections}


@pytest.mark.parametrize(
    ("scheme", "of_a", "of_b"),
    [
        ("jacobi", (HeldFrom.BEGINNING, 1, 0.005), (HeldFrom.BEGINNING, 1, 0.005)),
        ("gauss_seidel", (HeldFrom.BEGINNING, 1, 0.005), (HeldFrom.END, 0, -0.005)),
        ("iterated", (HeldFrom.MEAN, 0, 0.0), (HeldFrom.MEAN, 0, 0.0)),
    ],
)
def test_delays_between_two_fmus(cache, scheme, of_a, of_b):
    report = two_masses().report_coupling(scheme, step=0.01)
    found = by_target(report)
    for target, (held, steps, delay) in {"a.force": of_a, "b.force": of_b}.items():
        c = found[target]
        assert (c.kind, c.step, c.held, c.steps) == (LinkKind.FMU_TO_FMU, 0.01, held, steps)
        assert c.delay == pytest.approx(delay)
        assert set(c.follows) == {"a.position", "b.position"}
    assert report.order == (("a", "b") if scheme == "gauss_seidel" else ())
    assert not report.loops


def test_delays_between_an_fmu_and_blocks(cache):
    found = by_target(mass_and_filter().report_coupling("jacobi", step=0.01))
    assert (found["a.force"].kind, found["a.force"].delay) == (LinkKind.BLOCK_TO_FMU, 0.005)
    (read,) = [c for c in found.values() if c.source == "a.position"]
    assert (read.kind, read.steps, read.delay) == (LinkKind.FMU_TO_BLOCK, 0, 0.005)  # held for the filter

    plant = mass("plant")

    @subsystem(sample_time=2e-3)
    def controller(y):
        return Gain(gain=-1.0, name="gain")(y)

    loop = Diagram("loop", plant(force=controller(plant.position)))
    for coupling in ("jacobi", "gauss_seidel", "iterated"):  # what is sampled is held by its subsystem, not by a scheme
        found = by_target(loop.report_coupling(coupling))
        assert (found["plant.force"].held, found["plant.force"].steps, found["plant.force"].delay) == (
            "its change",
            1,
            0,
        )
        assert found["controller.gain.u"].delay == 0.0


def test_a_loop_of_direct_feedthrough_is_listed(cache):
    report = coupled_by_inertia(0.5).report_coupling(step=0.01)
    assert [set(ports) for ports in report.loops] == [{"a.acceleration", "b.acceleration"}]
    assert "not solved" in str(report)
    assert "solved by iteration" in str(coupled_by_inertia(0.5).report_coupling("iterated", step=0.01))
    assert by_target(coupled_by_inertia(0.5).report_coupling(step=0.01)).keys() >= {"a.force", "b.force"}


@pytest.mark.parametrize("scheme", ["jacobi", "gauss_seidel", "iterated"])
def test_the_mean_delay_is_the_one_that_a_run_shows(cache, scheme):
    """The delays round the loop are a phase in it, −ω · delay, which adds ω² · delay · stiffness of damping.

    For x″ = −k x + p (x(t − τ) − x) a small delay τ takes p τ from the damping; the decay of a mass that a gain pulls
    back measures it.
    """
    h, pull = 0.005, 60.0
    plant = mass("plant", 0.1)
    diagram = Diagram("d", plant(force=Gain(gain=-pull, name="spring")(plant.position)))
    report = by_target(diagram.report_coupling(Coupling(scheme=scheme), step=h))
    run = diagram.simulate(1.0, step=h, progress=False, coupling=scheme)
    energy = run["plant.velocity"] ** 2 / 2 + 160.0 * run["plant.position"] ** 2 / 2
    decay = -np.polyfit(run.t, np.log(energy), 1)[0]  # the damping is 1 N·s/m of 1 kg: the energy decays with 1/s
    assert decay == pytest.approx(1.0 - pull * report["plant.force"].delay, abs=0.03)

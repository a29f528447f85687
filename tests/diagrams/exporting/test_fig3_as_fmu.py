"""Fig. 3 as an FMU, experiments A to D, every bit: without the gantry, beside its FMU in FMPy, and all of it in one.

The master steps the controller, which acts at the start of its step, before the plant.
"""

import numpy as np
import pytest

from loopwright import build, experiments
from support.instances import open_instance

MAKERS = (
    experiments.path_following,
    experiments.compliance,
    experiments.hand_guiding,
    experiments.force_tracking,
)


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_the_trajectories_are_those_of_the_run_to_the_last_bit(make, tmp_path):
    experiment = make()
    diagram = experiment.diagram
    run = diagram.simulate(experiment.duration, progress=False)
    block = diagram["plant"]
    file = build(diagram.sampled(1e-3), tmp_path, outside=["plant"], name="all_but_the_gantry")
    rest = open_instance(file, tmp_path / "rest")
    plant = open_instance(block.description.file, tmp_path / "plant")
    kinds = {v.name: v.causality for v in rest.description.modelVariables if v.type != "Clock"}
    inputs, outputs = ([n for n, kind in kinds.items() if kind == one] for one in ("input", "output"))
    assert {*inputs} <= {"position", "velocity", "acceleration", "contact_force"}
    assert {*outputs} == {"motor_force", "external_force"}
    rest.initialize()
    plant.initialize(**block.start)
    for k in range(len(run.t) - 1):
        if k % 100 == 0:
            np.testing.assert_array_equal(plant["position"], run["position"][k])
        rest.step(run.t[k], 1e-3, **{name: plant[name] for name in inputs})
        if k % 100 == 0:
            np.testing.assert_array_equal(rest["motor_force"], run["motor_force"][k])
            np.testing.assert_array_equal(rest["controller.v_perp"], run["v_perp"][k])
        plant.step(run.t[k], 1e-3, **{name: rest[name] for name in outputs})
    np.testing.assert_array_equal(plant["position"], run["position"][-1])
    np.testing.assert_array_equal(plant["velocity"], run["velocity"][-1])
    rest.free()
    plant.free()


@pytest.mark.slow
def test_a_parameter_of_table_iii_is_tuned_with_what_is_computed_from_it(tmp_path):
    """A softer admittance in the FMU is that of a softer diagram, but for the rounding of its exponential."""
    diagram = experiments.hand_guiding().diagram
    softer = diagram.replace({"controller.admittance_perp.stiffness": 120.0})
    run = softer.simulate(2.0, progress=False)
    file = build(diagram, tmp_path, subsystem="controller")
    item = open_instance(file, tmp_path / "controller")
    wires = {
        name: str(wire) for (path, name), wire in diagram.wired.structure.arguments.items() if path == "controller"
    }
    item.initialize(**{"admittance_perp.stiffness": 120.0})
    for k in range(2000):
        item.step(run.t[k], 1e-3, **{name: run[wire][k] for name, wire in wires.items()})
        np.testing.assert_allclose(item["motor_force"], run["motor_force"][k], rtol=0, atol=1e-9)
    hard = diagram.simulate(2.0, progress=False)
    assert np.abs(hard["motor_force"][1999] - run["motor_force"][1999]).max() > 1e-3
    item.free()


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_the_whole_loop_is_one_fmu_with_the_trajectories_of_the_run(make, tmp_path):
    """Controller, hand, references and the gantry's own FMU, merged: at any communication points, here every 50 ms."""
    experiment = make()
    run = experiment.diagram.simulate(experiment.duration, progress=False)
    names = ("position", "velocity", "motor_force", "v_perp")
    file = build(experiment.diagram.sampled(1e-3), tmp_path, outputs=names, name="whole_loop")
    item = open_instance(file, tmp_path / "item").initialize()
    for k in range(0, len(run.t) - 1, 50):
        for name in names[:2]:
            np.testing.assert_array_equal(item[name], run[name][k])
        item.step(run.t[k], 0.05)
        for name in names[2:]:
            np.testing.assert_array_equal(item[name], run[name][k + 49])
    item.free()

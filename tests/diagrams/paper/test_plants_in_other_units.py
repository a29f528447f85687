"""Plants of one's own in millimetres under the experiments: what an experiment says in metres is converted for them."""

import numpy as np
import pytest

from loopwright.blocks import OptionError, UnitError, UnknownNameError, WiringError
from loopwright.diagrams import experiments
from loopwright.fmus import Fmu
from support import oracle
from support.agreement import assert_agrees
from support.scalar_gantry import scalar_gantry

ARRAYS = {
    "F_my": "motor_force[1]",
    "F_mz": "motor_force[2]",
    "F_ey": "external_force[1]",
    "F_ez": "external_force[2]",
    "s_Y": "position[1]",
    "s_Z": "position[2]",
    "v_Y": "velocity[1]",
    "v_Z": "velocity[2]",
    "a_Y": "acceleration[1]",
    "a_Z": "acceleration[2]",
}


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return scalar_gantry(tmp_path_factory.mktemp("millimetres"), length="mm", names=ARRAYS)


def in_metres(run):
    """Return the signals of a run, those that the plant records in mm in m."""
    names = ("eta", "xi", "theta", "q", "eta_p", "xi_p", "force", "v_par", "v_perp", "motor_force")
    return {n: run[n] for n in names} | {n: run[n] / 1000.0 for n in ("position", "velocity")}


@pytest.mark.parametrize("letter", "AD")
@pytest.mark.slow
def test_an_experiment_places_a_plant_in_millimetres(file, letter):
    plant = Fmu(file, convert_units=True)
    experiment = experiments.EXPERIMENTS[letter](plant=plant)
    start = experiment.path.to_plane(*oracle.START[letter])
    np.testing.assert_allclose(experiment.diagram.blocks["plant"].start["position"], 1000.0 * start, rtol=1e-14)
    run = experiment.diagram.simulate(2.0, progress=False)
    want = oracle.simulate(letter, oracle.Options(), duration=2.0)
    assert_agrees(in_metres(run), want)


def test_an_option_in_metres_per_second_is_converted_too(file):
    plant = Fmu(file, convert_units=True)
    experiment = experiments.force_tracking(plant=plant, friction_width=0.1)
    assert experiment.diagram.blocks["plant"].start["friction_width"] == pytest.approx(100.0, rel=1e-14)
    run = experiment.diagram.simulate(1.0, progress=False)
    want = oracle.simulate("D", oracle.Options(friction_width=0.1), duration=1.0)
    assert_agrees(in_metres(run), want, width=0.1)


def test_an_option_that_is_given_twice_is_compared_in_one_unit(file):
    plant = Fmu(file, convert_units=True, start={"friction_width": 30.0})
    assert experiments.path_following(plant=plant, friction_width=0.03).options["friction_width"] == 0.03
    with pytest.raises(OptionError, match=r"friction_width: found 20 mm/s, and 30 mm/s in the plant's start values"):
        experiments.path_following(plant=plant, friction_width=0.02)


def test_names_of_scalars_in_another_unit_are_offered_where_they_are_converted(tmp_path):
    scalars = scalar_gantry(tmp_path, length="mm")
    moved = {name: port for name, port in ARRAYS.items() if not name.startswith("F_")}
    plant = Fmu(scalars, convert_units=True)
    with pytest.raises(UnknownNameError) as e:
        experiments.path_following(plant=plant)
    assert f"Fmu(file, rename={moved!r})" in str(e.value)
    with pytest.raises(WiringError) as e:
        experiments.path_following().diagram.replace(plant=plant)
    assert f"rename={moved!r}); name the others that are missing, too." in str(e.value)
    with pytest.raises(WiringError) as e:
        experiments.path_following().diagram.replace(plant=Fmu(scalars))
    assert "rename=" not in str(e.value)


def test_a_plant_that_does_not_convert_is_refused_for_its_unit(file):
    with pytest.raises(UnitError, match=r"position.*mm.*convert_units=True"):
        experiments.path_following(plant=Fmu(file))


def test_start_values_of_the_users_are_in_the_units_of_the_fmu(file):
    plant = Fmu(file, convert_units=True, start={"position": (500.0, 600.0)})
    run = experiments.path_following(plant=plant).diagram.simulate(0.001, progress=False)
    np.testing.assert_array_equal(run["position"][0], (500.0, 600.0))


def test_a_start_value_in_another_unit_is_the_entry_of_start(file):
    plant = Fmu(file, convert_units=True, rename={"position": "place"})
    np.testing.assert_array_equal(plant.start_of("place", (0.5, 0.25), "m")["position"], (500.0, 250.0))
    np.testing.assert_array_equal(plant.start_of("velocity", (0.5, 0.25), "mm/s")["velocity"], (0.5, 0.25))
    assert plant.start_of("friction_width", 0.125, "m/s")["friction_width"] == 125.0
    with pytest.raises(UnitError, match="place: found a start value in N; expected mm: .* of different dimensions"):
        plant.start_of("place", (0.5, 0.25), "N")
    with pytest.raises(UnknownNameError, match="the FMU has no variable 'mass'"):
        plant.start_of("mass", 1.0, "kg")


def test_an_operating_point_in_another_unit_is_refused(file, tmp_path):
    metres = experiments.path_following(plant=scalar_gantry(tmp_path, names=ARRAYS)).diagram
    point = metres.operating_point(0.01)
    variant = metres.replace(plant=Fmu(file, convert_units=True))
    expected = r"operating point: found an operating point with plant\.position in m; expected mm, the unit of the FMU"
    with pytest.raises(OptionError, match=expected):
        variant.simulate(0.01, start=point, progress=False)
    there = variant.operating_point(0.0)  # one of its own
    run = variant.simulate(0.01, start=there, progress=False)
    np.testing.assert_allclose(run["position"][0], there.values["plant.position"], rtol=1e-14)

"""The gantry: one definition, as a block, as an FMU, and as the model that a controller inverts."""

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from loopwright.blocks import Constant, Sine
from loopwright.diagrams import Diagram, experiments
from loopwright.fmus import Fmu, gantry

TABLE_II = {
    "translational_mass": (7.61, 4.41),
    "equivalent_mass": (29.26, 16.79),
    "coulomb_friction": (65.42, 37.69),
    "viscous_friction": (175.93, 62.83),
}
M = np.array([36.87, 21.20])
FORCE = (150.0, 90.0)


@pytest.fixture(scope="module")
def file():
    return gantry.build()


def solution(t, *, w=0.01, coulomb=1.0, viscous=1.0, force=FORCE):
    """Newton's law for both axes, from rest at (0.8, 0.5), by SciPy."""

    def rhs(_, x):
        v = x[2:]
        friction = coulomb * np.array([65.42, 37.69]) * np.tanh(v / w) + viscous * np.array([175.93, 62.83]) * v
        return [*v, *((np.array(force) - friction - np.array([0.0, 9.81 * 4.41])) / M)]

    return solve_ivp(rhs, (0, t[-1]), [0.8, 0.5, 0.0, 0.0], "DOP853", t, rtol=1e-12, atol=1e-14).y.T


def test_the_fmu_passes_fmpys_validation(file):
    assert validate_fmu(str(file)) == []


def test_every_number_of_table_ii_is_a_parameter_with_unit_and_description(file):
    variables = {v.name: v for v in fmpy.read_model_description(str(file)).modelVariables}
    for name, value in TABLE_II.items():
        assert variables[name].causality == "parameter"
        assert variables[name].unit in ("kg", "N", "N.s/m")
        assert variables[name].description
        assert np.array(variables[name].start.split(), dtype=float) == pytest.approx(value, rel=1e-15)
    for name in ("coulomb_scale", "viscous_scale", "friction_width", "gravity", "internal_step"):
        assert variables[name].causality == "parameter"


def test_the_ports_are_those_of_the_experiments(file):
    plant = Fmu(file)
    assert {n: (p.shape, p.unit) for n, p in plant.inputs.items()} == {
        "motor_force": ((2,), "N"),
        "external_force": ((2,), "N"),
    }
    assert {n: (p.shape, p.unit) for n, p in plant.outputs.items()} == {
        "position": ((2,), "m"),
        "velocity": ((2,), "m/s"),
        "acceleration": ((2,), "m/s2"),
    }


def test_it_runs_in_fmpy_on_its_own_and_agrees_with_scipy(file):
    result = fmpy.simulate_fmu(
        str(file),
        stop_time=0.5,
        output_interval=0.01,
        start_values={"motor_force": list(FORCE)},
        output=["position", "velocity"],
    )
    t = result["time"]
    exact = solution(t)
    got = np.hstack([result["position"], result["velocity"]])
    # RK4 at 1e-4 s, friction's rate F_c/(M w) = 178 1/s: (0.0178)^4/120 of the 1 m/s2 that change within 1/178 s
    assert np.max(np.abs(got[:, :2] - exact[:, :2])) < 1e-10
    assert np.max(np.abs(got[:, 2:] - exact[:, 2:])) < 1e-8


@pytest.mark.parametrize(
    ("start", "changed"),
    [
        ({"friction_width": 0.1}, {"w": 0.1}),
        ({"coulomb_scale": 0.5}, {"coulomb": 0.5}),
        ({"viscous_scale": 2.0}, {"viscous": 2.0}),
        ({"coulomb_scale": 0.0, "viscous_scale": 0.0}, {"coulomb": 0.0, "viscous": 0.0}),
    ],
)
def test_its_parameters_act_although_they_were_other_numbers_when_it_was_built(file, start, changed):
    plant = Fmu(file, name="plant", start=start)
    closed = plant(motor_force=Constant(value=FORCE, unit="N"), external_force=(0, 0))
    run = Diagram("d", closed).simulate(0.5, step=1e-3, progress=False)
    assert np.max(np.abs(run["position"] - solution(run.t, **changed)[:, :2])) < 1e-10


def test_the_external_force_acts_like_the_motor_force(file):
    def position(motor, external):
        plant = Fmu(file, name="plant")
        return Diagram("d", plant(motor_force=motor, external_force=external)).simulate(0.3, step=1e-3, progress=False)[
            "position"
        ]

    assert np.array_equal(position(FORCE, (0, 0)), position((0, 0), FORCE))


def test_the_internal_step_is_of_order_4(file):
    def error(step):
        plant = Fmu(file, name="plant", start={"internal_step": step})
        run = Diagram("d", plant(motor_force=FORCE, external_force=(0, 0))).simulate(0.2, step=4e-3, progress=False)
        return np.max(np.abs(run["velocity"] - solution(run.t)[:, 2:]))

    steps = np.array([4e-3 / n for n in (8, 16, 32)])
    errors = [error(h) for h in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.2)


def test_the_block_the_fmu_and_the_nominal_model_are_one_definition(file):
    rng = np.random.default_rng(1)
    x_v, u, f = rng.normal(size=2), 100 * rng.normal(size=2), 10 * rng.normal(size=2)
    friction = np.array([65.42, 37.69]) * np.tanh(x_v / 0.01) + np.array([175.93, 62.83]) * x_v
    newton = (u - friction - np.array([0.0, 9.81 * 4.41]) + f) / M
    assert gantry.nominal.coordinate_acceleration(np.zeros(2), x_v, u, f) == pytest.approx(newton, rel=1e-14)
    plant = Fmu(file, name="plant", start={"velocity": x_v, "motor_force": u, "external_force": f})
    with plant.instantiate([], 1.0) as instance:
        outputs = np.zeros(6)
        instance.bind(np.zeros(0), outputs)
    assert outputs[4:] == pytest.approx(newton, rel=1e-12)


@pytest.mark.slow
def test_another_plant_file_under_the_unchanged_controller(tmp_path):
    heavier = gantry.build(gantry.Gantry(translational_mass=(9.0, 5.0)), tmp_path / "heavier.fmu")
    run = experiments.path_following(plant=heavier).simulate(progress=False)
    nominal = experiments.path_following().simulate(progress=False)
    assert np.max(np.abs(run["position"] - nominal["position"])) > 1e-5  # it is another plant
    assert np.max(np.abs(run["eta"][-1] - nominal["eta"][-1])) < 1e-6  # and ends where it should
    swapped = experiments.path_following().diagram.replace(
        plant=Fmu(heavier, start={"position": experiments.ELLIPSE.to_plane(0.1, 0.01)})
    )
    assert np.array_equal(swapped.simulate(11.0, progress=False)["position"], run["position"])


def test_several_plants_in_one_diagram_do_not_disturb_each_other(file):
    one, two = Fmu(file, name="one"), Fmu(file, name="two", start={"friction_width": 0.1})
    wave = Sine(amplitude=100.0, frequency=2.0, name="wave")
    free = Constant(value=(0.0, 0.0), unit="N", name="free")
    push = Constant(value=(1.0, 1.0), name="axes") * 100.0
    both = Diagram("d", one(motor_force=push, external_force=free), two(motor_force=push, external_force=free), wave)
    run = both.simulate(0.3, step=1e-3, progress=False)
    alone = Fmu(file, name="two", start={"friction_width": 0.1})
    single = Diagram("s", alone(motor_force=push, external_force=free)).simulate(0.3, step=1e-3, progress=False)
    assert np.array_equal(run["two.position"], single["two.position"])
    assert not np.array_equal(run["one.position"], run["two.position"])

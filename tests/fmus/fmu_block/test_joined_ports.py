"""Scalar ports with names of their own as elements of one array port, by `rename`."""

import re

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, Gain, ParameterError, UnknownNameError, WiringError
from loopwright.diagrams import Diagram, experiments
from loopwright.fmus import Fmu, gantry
from support import oracle
from support.scalar_gantry import RENAME as GANTRY
from support.scalar_gantry import scalar_gantry
from support.scalar_ports import RATE, RENAME, levels, scalar_ports

FLOW = (3.0, -1.0)


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return scalar_ports(tmp_path_factory.mktemp("scalars"))


def driven(file, **options):
    plant = Fmu(file, name="plant", rename=RENAME, **options)
    return Diagram("driven", plant(flow=Constant(value=FLOW, unit="m3/s", name="pumps")))


def test_renamed_elements_are_one_port(file):
    plant = Fmu(file, rename=RENAME)
    assert {name: port.shape for name, port in plant.inputs.items()} == {"flow": (2,)}
    assert {name: (port.shape, port.unit) for name, port in plant.outputs.items()} == {
        "level": ((2,), "m3"),
        "sum_of": ((), "m3"),
    }
    assert plant.input_variables["flow"].references == (1, 2)
    assert np.array_equal(plant.output_variables["level"].limits, ([-9.0, -np.inf], [np.inf, 9.0]))


@pytest.mark.parametrize("rest", [{}, {"compile": True}], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("isolate", [False, True], ids=["here", "isolated"])
def test_a_run_is_the_closed_form(file, isolate, rest):
    run = driven(file, isolate=isolate).simulate(1.0, step=0.1, progress=False, **rest)
    want = levels(run.t, FLOW)
    np.testing.assert_allclose(run["plant.level"], want, rtol=1e-13, atol=1e-13)  # its steps are exact
    np.testing.assert_allclose(run["plant.sum_of"], want.sum(axis=1), rtol=1e-13, atol=1e-13)
    assert run.unit("plant.level") == "m3"


@pytest.mark.parametrize("rest", [{}, {"compile": True}], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("isolate", [False, True], ids=["here", "isolated"])
@pytest.mark.drawn(2)
def test_a_run_in_model_exchange_is_the_closed_form(file, isolate, rest):
    diagram = driven(file, isolate=isolate, interface="model_exchange")
    run = diagram.simulate(1.0, step=0.1, rtol=1e-9, atol=1e-11, progress=False, **rest)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, FLOW), rtol=0, atol=1e-7)
    assert diagram.linearize().states == ("plant.level[1]", "plant.level[2]")


@pytest.mark.parametrize(
    "start",
    [
        {"level": (2.0, -3.0)},
        {"low": 2.0, "high": -3.0},
        {"level[1]": 2.0, "level[2]": -3.0},
        {"level": (7.0, -3.0), "low": 2.0},
        {"low": 2.0, "level[2]": -3.0},
    ],
)
def test_start_values_by_all_names(file, start):
    run = driven(file, start=start).simulate(0.5, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, FLOW, (2.0, -3.0)), rtol=1e-13, atol=1e-13)


def test_a_start_value_of_one_element_leaves_the_other(file):
    run = driven(file, start={"level[2]": -3.0}).simulate(0.5, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, FLOW, (0.5, -3.0)), rtol=1e-13, atol=1e-13)


def test_one_element_with_two_values_is_refused(file):
    with pytest.raises(ParameterError, match=r"start.level\[1\]: found 2.0 for 'level\[1\]', and 3.0 for 'low'; expec"):
        Fmu(file, rename=RENAME, start={"level[1]": 2.0, "low": 3.0})


def test_elements_in_another_order(file):
    swapped = {**RENAME, "low": "level[2]", "high": "level[1]"}
    plant = Fmu(file, name="plant", rename=swapped, start={"level": (-3.0, 2.0)})
    diagram = Diagram("driven", plant(flow=Constant(value=FLOW, name="pumps")))
    run = diagram.simulate(0.5, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, FLOW, (2.0, -3.0))[:, ::-1], rtol=1e-13, atol=1e-13)


def test_elements_are_read_by_their_names(file):
    plant = Fmu(file, name="plant", rename=RENAME)
    twice = Gain(name="twice", gain=2.0)(plant["low"])
    other = Gain(name="other", gain=2.0)(plant["level[2]"])
    run = Diagram("d", plant(flow=FLOW), twice, other).simulate(0.3, step=0.1, progress=False)
    assert np.array_equal(run["twice.y"], 2.0 * run["plant.level"][:, 0])
    assert np.array_equal(run["other.y"], 2.0 * run["plant.level"][:, 1])
    assert run.plot("plant.level", "level[2]") is not None


def test_a_linear_model_is_the_matrix_exponential(file):
    h = 0.1
    plant = Fmu(file, name="plant", rename=RENAME, isolate=False)
    push = Gain(name="push", gain=1.0)(Constant(value=FLOW, unit="m3/s", name="pumps"))
    model = Diagram("d", plant(flow=push)).linearize(step=h, inputs=["push.y"], outputs=["plant.level"])
    A, B = np.diag([-RATE, -RATE]), np.eye(2)
    step = expm(np.block([[A, B], [np.zeros((2, 4))]]) * h)
    poles = np.sort(np.abs(np.linalg.eigvals(model.A)))
    np.testing.assert_allclose(poles[-2:], np.exp(-RATE * h), rtol=1e-8)
    z = np.exp(0.3j)
    gain = model.C @ np.linalg.solve(z * np.eye(len(model.A)) - model.A, model.B) + model.D
    want = np.linalg.solve(z * np.eye(2) - step[:2, :2], step[:2, 2:])
    np.testing.assert_allclose(gain, want, rtol=0, atol=1e-7)
    alone = plant.linear_model(state={"level": (1.0, 2.0)}, inputs={"flow": FLOW})
    np.testing.assert_allclose(alone.A, A, atol=1e-9)
    np.testing.assert_allclose(alone.C, [[1, 0], [0, 1], [1, 1]], atol=1e-9)
    assert alone.states == ("level[1]", "level[2]")


@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", ["plant.start.level[2]", "plant.start.high", "plant.high"])
def test_a_sweep_of_an_element_by_its_path(file, name):
    found = driven(file).sweep({name: (-3.0, 1.0)}, 0.5, step=0.1, signals=["plant.level"], progress=False, workers=1)
    assert not found.failures
    for i, start in enumerate((-3.0, 1.0)):
        want = levels(found.t, FLOW, (0.5, start))
        np.testing.assert_allclose(found["plant.level"][i], want, rtol=1e-13, atol=1e-13)


def test_variants_by_the_port(file):
    variant = driven(file).replace({"plant.start.level": (2.0, -3.0)})
    run = variant.simulate(0.5, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, FLOW, (2.0, -3.0)), rtol=1e-13, atol=1e-13)


def test_a_run_goes_on_from_an_operating_point(file):
    diagram = driven(file)
    point = diagram.operating_point(0.5, step=0.1)
    run = diagram.simulate(0.5, step=0.1, start=point, progress=False)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, FLOW), rtol=1e-12, atol=1e-12)


def test_ports_take_elements_by_their_own_names(file):
    plant = Fmu(file, rename=RENAME, ports=["inflow", "pump", "low", "high"])
    assert [*plant.inputs, *plant.outputs] == ["flow", "level"]
    with pytest.raises(
        ParameterError, match="ports: found 'low' and not 'high', which rename makes elements of one po"
    ):
        Fmu(file, rename=RENAME, ports=["inflow", "pump", "low"])
    rates = {"der(low)": "rate[0]", "der(high)": "rate[1]"}  # local variables; counted from 0
    plant = Fmu(file, name="plant", rename={**RENAME, **rates}, ports=[*RENAME, *rates])
    assert plant.outputs["rate"].shape == (2,)
    run = Diagram("d", plant(flow=FLOW)).simulate(0.3, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.rate"], np.asarray(FLOW) - RATE * run["plant.level"], rtol=1e-13)
    with pytest.raises(ParameterError, match=r"'der\(low\)', a continuous local, as an element of the port 'rate'"):
        Fmu(file, rename=rates)


@pytest.mark.parametrize(
    ("rename", "text"),
    [
        ({"low": "x[1]", "high": "x[3]"}, r"no variable that is renamed to x\[2\] .* from x\[1\] to x\[3\]"),
        ({"low": "x[2]", "high": "x[3]"}, r"no variable that is renamed to x\[1\] "),
        ({"low": "x[1]", "high": "x[1]"}, r"found both 'low' and 'high' as x\[1\] for the port 'x'"),
        ({"low": "x[1]", "high": "x[1,2]"}, r"found x\[1\] and x\[1,2\] for the port 'x'; expected as many indices"),
        ({"low": "x[1]", "inflow": "x[2]"}, "'low' with the causality output and 'inflow' with the causality input"),
    ],
)
def test_what_is_no_array_is_said_by_name(file, rename, text):
    with pytest.raises(ParameterError, match=f"^fmu.rename: found {text}" if text[0] == "n" else text):
        Fmu(file, rename=rename)


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (
            ('causality="output" initial="exact"', '<Real unit="m3/s" start="0"/>'),
            "the unit m3 and 'high' with the unit m3/s",
        ),
        (('causality="output" initial="exact"', '<Real start="0"/>'), r"the unit m3 and 'high' with the unit \(none\)"),
        (
            ('causality="output" variability="discrete" initial="exact"', '<Integer start="0"/>'),
            "the type Float64 and 'high' with the type Int32",
        ),
        (
            ('causality="output" variability="discrete" initial="exact"', '<Real unit="m3" start="0"/>'),
            "the variability continuous and 'high' with the variability discrete",
        ),
    ],
)
def test_elements_that_are_not_alike_are_said_by_name(cache, tmp_path, row, text):
    with pytest.raises(ParameterError, match=f"fmu.rename: found 'low' with {text}"):
        Fmu(scalar_ports(tmp_path, high=row), rename={"low": "x[1]", "high": "x[2]"})


def test_a_name_of_a_variable_stays_its_own(cache, tmp_path):
    """The port's name is that of a variable, too: in ``start`` it is the variable."""
    plant = Fmu(
        scalar_ports(tmp_path), name="plant", rename={"low": "sum_of[1]", "high": "sum_of[2]", "sum_of": "both"}
    )
    assert [*plant.outputs] == ["sum_of", "both"]
    made = plant.replace(start={"low": 2.0, "high": -3.0, "inflow": 3.0, "pump": -1.0})
    run = Diagram("d", made()).simulate(0.3, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.sum_of"], levels(run.t, FLOW, (2.0, -3.0)), rtol=1e-13)
    with pytest.raises(ParameterError, match="found a variable that is computed and has no start value"):
        plant.replace(start={"sum_of": 1.0})


def test_some_elements_of_an_array_of_the_fmu(cache):
    """The array is taken apart, and what is left of it are ports of their own."""
    file = gantry.build(fmi=2)
    plant = Fmu(file, rename={"position[2]": "place[1]", "velocity[2]": "place_rate[1]"})
    assert [*plant.outputs] == ["position[1]", "place", "velocity[1]", "place_rate", "acceleration"]
    with pytest.raises(UnknownNameError, match=re.escape("Name them one by one: position[1], position[2].")):
        plant.replace(start={"position": (0.8, 0.5)})
    swapped = Fmu(file, name="plant", rename={"position[2]": "position[1]", "position[1]": "position[2]"})
    run = Diagram(
        "d", swapped.replace(start={"position": (0.3, 0.7)})(motor_force=(0.0, 0.0), external_force=(0.0, 0.0))
    )
    assert np.array_equal(run.simulate(0.01, step=0.01, progress=False)["plant.position"][0], (0.3, 0.7))


# --- the gantry ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gantries(cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("gantries")
    return {fmi: scalar_gantry(folder, fmi) for fmi in ("fmi1", "fmi2")}


@pytest.mark.parametrize("fmi", ["fmi1", "fmi2"])
@pytest.mark.drawn(1)
def test_experiment_a_with_a_gantry_of_scalar_ports(gantries, fmi):
    """The same method and steps as the gantry's own build: rounding remains, of tanh and of the order of additions."""
    run, own = (
        experiments.path_following(plant=plant).diagram.simulate(2.0, progress=False)
        for plant in (Fmu(gantries[fmi], rename=GANTRY), None)
    )
    for name in ("position", "velocity", "eta", "xi", "motor_force"):
        assert np.abs(run[name] - own[name]).max() <= 1e-11 * np.abs(own[name]).max(), name
    want = oracle.simulate("A", oracle.Options(), duration=2.0)
    assert np.abs(run["position"] - want["position"]).max() < 1e-7


def test_the_experiment_offers_the_names_that_are_unique(gantries):
    with pytest.raises(UnknownNameError) as e:
        experiments.path_following(plant=gantries["fmi2"])
    found = {name: port for name, port in GANTRY.items() if not name.startswith("F_")}  # four forces are no one's
    assert str(e.value).endswith(
        "Where only a name differs, or scalars are its elements, give it the expected one, in Python: "
        f"Fmu(file, rename={found!r}). On the command line: --rename 's_Y=position[1]', once for each."
    )


def test_replace_offers_the_names_that_are_unique(gantries, cache, tmp_path):
    diagram = experiments.path_following().diagram
    with pytest.raises(WiringError) as e:
        diagram.replace(plant=Fmu(gantries["fmi2"]))
    found = {name: port for name, port in GANTRY.items() if not name.startswith("F_")}
    assert f"rename={found!r}); name the others that are missing, too." in str(e.value)
    names = {"F_my": "motor_y", "F_mz": "motor_z", "F_ey": "external.1", "F_ez": "external.2"}
    other = scalar_gantry(tmp_path, names=names)
    with pytest.raises(UnknownNameError) as e:
        diagram.replace(plant=Fmu(other))
    rename = {
        "external.1": "external_force[1]",
        "external.2": "external_force[2]",
        "motor_y": "motor_force[1]",
        "motor_z": "motor_force[2]",
        **found,
    }
    assert str(e.value).endswith(f"Perhaps only names differ: Fmu({str(other)!r}, rename={rename!r}).")
    run = diagram.replace(plant=Fmu(other, rename=rename)).simulate(0.01, progress=False)
    assert np.isfinite(run["plant.position"]).all()


def test_names_that_may_belong_to_several_ports_are_not_offered(gantries):
    plant = Fmu(gantries["fmi2"])
    with pytest.raises(UnknownNameError) as e:
        experiments.path_following(plant=plant)
    assert "F_m" not in str(e.value).partition("rename=")[2]

"""Units of an FMU's ports: refused with the factor, or converted at the port."""

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    Gain,
    Input,
    Output,
    Saturation,
    Sine,
    Sum,
    UnitConversion,
    UnitError,
)
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, mass_spring_damper
from support.typed_fmus import typed_fmu

UNITS = {
    "K": 'K="1"',
    "degF": 'K="1" factor="0.5555555555555556" offset="255.37222222222223"',
    "N": 'kg="1" m="1" s="-2"',
    "lbf": 'kg="1" m="1" s="-2" factor="4.4482216152605"',
    "degC": 'K="1" offset="273.15"',
    "rad": 'rad="1"',
}
PORTS = [
    ("T", "K", ""),
    ("F", "degF", ""),
    ("rise", "degC", ' relativeQuantity="true"'),
    ("force", "lbf", ""),
    ("angle", "rad", ""),
]
"""Each input u_<name>, and the output y_<name> that is equal to it after a step."""


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    rows = "".join(
        f'<Float64 name="{side}_{name}" valueReference="{i + k}" causality="{causality}" unit="{unit}"{more}{start}/>'
        for i, (name, unit, more) in enumerate(PORTS)
        for side, causality, k, start in (("u", "input", 0, ' start="0"'), ("y", "output", 50, ""))
    )
    units = "".join(f'<Unit name="{name}"><BaseUnit {base}/></Unit>' for name, base in UNITS.items())
    outputs = "".join(f'<Output valueReference="{50 + i}"/>' for i in range(len(PORTS)))
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="3.0" modelName="typed" '
        f'instantiationToken="x"><CoSimulation modelIdentifier="typed"/><UnitDefinitions>{units}</UnitDefinitions>'
        f"<ModelVariables>{rows}</ModelVariables><ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
    )
    return typed_fmu(tmp_path_factory.mktemp("units"), 3, text)


def wired(plant, **inputs):
    """Wire inputs of any unit, the others to 1."""
    return plant(**{f"u_{n}": inputs.get(n, Constant(value=1.0)) for n, _, _ in PORTS})


@pytest.mark.parametrize(
    ("port", "unit", "text"),
    [
        ("force", "N", r"N and lbf differ by a factor of 0\.224808943\d*: put Gain"),
        ("T", "degC", r"degC and K differ by an offset of 273\.15"),
        ("F", "K", r"K and degF differ by a factor and an offset, degF = 1\.8 · K - 459\.67"),
        ("force", "m", r"m \(m\) and lbf \(kg\.m\.s-2\) are of different dimensions: check which ports are meant$"),
        ("angle", "deg", r"deg and rad differ by a factor of 0\.0174532\d*: .*, or give its FMU convert_units=True$"),
    ],
)
def test_another_unit_is_refused_with_the_way_between(file, port, unit, text):
    with pytest.raises(UnitError, match=text):
        Diagram("d", wired(Fmu(file, name="plant"), **{port: Constant(value=1.0, unit=unit)}))


@pytest.mark.parametrize(
    ("port", "unit", "value", "expected"),
    [
        ("T", "degC", 20.0, 293.15),
        ("F", "degC", 100.0, 212.0),
        ("F", "K", 273.15, 32.0),
        ("rise", "K", 5.0, 5.0),
        ("rise", "degC", 5.0, 5.0),  # 5 °C of difference are 5 K
        ("force", "kN", 1.0, 1000.0 / 4.4482216152605),
        ("angle", "deg", 180.0, np.pi),
        ("angle", "rad", 0.1, 0.1),
    ],
)
def test_another_unit_is_converted_at_an_input(file, port, unit, value, expected):
    plant = Fmu(file, name="plant", convert_units=True)
    run = Diagram("d", wired(plant, **{port: Constant(value=value, unit=unit)})).simulate(0.1, step=0.1, progress=False)
    assert run[f"plant.y_{port}"][-1] == pytest.approx(expected, rel=1e-12)
    assert run.unit(f"plant.y_{port}") == plant.outputs[f"y_{port}"].unit


def test_another_dimension_stays_refused(file):
    plant = Fmu(file, name="plant", convert_units=True)
    with pytest.raises(UnitError, match="of different dimensions"):
        Diagram("d", wired(plant, force=Constant(value=1.0, unit="m")))


def test_outputs_are_converted_for_their_consumers_and_recorded_in_their_own_unit(file):
    plant = Fmu(file, name="plant", convert_units=True)
    closed = wired(plant, T=Constant(value=300.0, unit="K"), F=Constant(value=10.0, unit="degC"))
    difference = Sum(signs="+-", name="difference")(Constant(value=30.0, unit="degC"), plant.y_T)
    twice = Sum(signs="++", name="mean")(plant.y_F, plant.y_T)  # both are of the FMU: in the first one's unit
    loop = PID(kp=1.0, name="pid")(Constant(value=30.0, unit="degC", name="wish"), plant.y_T)
    run = Diagram("d", closed, difference, twice, loop).simulate(0.1, step=0.1, progress=False)
    assert run["plant.y_T"][-1] == 300.0
    assert run["pid.u"][-1] == pytest.approx(30.0 - 26.85, rel=1e-12)
    assert run.unit("plant.y_T") == "K"
    assert run["difference.y"][-1] == pytest.approx(30.0 - 26.85, rel=1e-12)
    assert run.unit("difference.y") == "K"
    assert run["mean.y"][-1] == pytest.approx(50.0 + (300.0 * 1.8 - 459.67), rel=1e-12)


@pytest.mark.slow
def test_jacobians_have_the_factor(file):
    plant = Fmu(file, name="plant", convert_units=True, isolate=False)
    push = Gain(gain=1.0, name="push")(Sine(amplitude=1.0, frequency=1.0, unit="kN", name="hand"))
    hand = UnitConversion(from_unit="kN", to_unit="kN", name="shown")(push)
    diagram = Diagram("d", wired(plant, force=hand))
    model = diagram.linearize(step=0.1, inputs=["push.y"], outputs=["plant.y_force"])
    gain = model.C @ np.linalg.solve(np.eye(len(model.A)) - model.A, model.B) + model.D
    assert gain.item() == pytest.approx(1000.0 / 4.4482216152605, rel=1e-7)


def test_a_replacement_in_other_units_fits_if_it_converts(file):
    near = Fmu(file, name="plant", convert_units=True, isolate=False)
    diagram = Diagram("d", wired(near, angle=Constant(value=90.0, unit="deg")))
    assert diagram.replace(plant=Fmu(file, convert_units=True)).simulate(0.1, step=0.1, progress=False)[
        "plant.y_angle"
    ][-1] == pytest.approx(np.pi / 2)
    with pytest.raises(UnitError, match="deg and rad"):
        diagram.replace(plant=Fmu(file))


WARM, COLD = Constant(value=30.0, unit="degC", name="warm"), Constant(value=25.0, unit="degC", name="cold")


@pytest.mark.parametrize(
    ("port", "signal", "expected"),
    [
        ("T", WARM - COLD, 5.0),
        ("F", WARM - COLD, 9.0),
        ("rise", WARM - COLD, 5.0),
        ("T", COLD + (WARM - COLD), 303.15),
        ("T", COLD + 5.0, 303.15),
        ("T", UnitConversion(from_unit="degC", to_unit="K")(COLD - 5.0), 293.15),
        ("T", Saturation(upper=28.0)(WARM).excess, 2.0),
    ],
)
def test_differences_of_temperatures_get_no_offset(file, port, signal, expected):
    plant = Fmu(file, name="plant", convert_units=True)
    run = Diagram("d", wired(plant, **{port: signal})).simulate(0.1, step=0.1, progress=False)
    assert run[f"plant.y_{port}"][-1] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("signal", [WARM + COLD, COLD - 5.0, -COLD, np.maximum(WARM, WARM - COLD)])
def test_what_may_be_a_temperature_or_a_difference_is_refused_where_that_counts(file, signal):
    plant = Fmu(file, name="plant", convert_units=True)
    with pytest.raises(UnitError, match="may be either .* put UnitConversion.from_unit='degC', to_unit='K'. between"):
        Diagram("d", wired(plant, T=signal))
    Diagram("d", wired(plant, rise=signal))  # a difference counts without an offset, whatever the signal is


class Controller(Block):
    """Proportional controller with a reference of its own; units as its parameters say."""

    k: float
    reference: float
    length: str = "m"
    power: str = "N"

    @property
    def inputs(self):
        return {"position": Input(unit=self.length, name="position")}

    @property
    def outputs(self):
        return {"u": Output(unit=self.power, name="u")}

    def output(self, t, x, u):
        return self.k * (self.reference - u.position)


@pytest.fixture(scope="module")
def loops(cache):
    """One loop twice: a controller in mm and kN whose wires are converted, and one in m and N."""
    file = mass_spring_damper.build()
    found = []
    for controller, converts in (
        (Controller(k=2e-3, reference=100.0, length="mm", power="kN", name="controller"), True),
        (Controller(k=2e3, reference=0.1, name="controller"), False),
    ):
        plant = Fmu(file, name="plant", convert_units=converts)
        found.append(Diagram("d", plant(force=controller(position=plant.position))))
    return found


def test_runs_linear_models_and_trims_are_those_of_one_unit(loops):
    mixed, plain = loops
    runs = [d.simulate(0.2, step=0.01, progress=False)["plant.position"] for d in loops]
    assert runs[0] == pytest.approx(runs[1], rel=1e-9)
    poles = [np.sort_complex(np.linalg.eigvals(d.linearize(step=0.01).A)) for d in loops]
    assert poles[0] == pytest.approx(poles[1], rel=1e-6)
    points = [d.trim() for d in loops]
    assert points[0].values["plant.position"] == pytest.approx(points[1].values["plant.position"], rel=1e-6)
    assert mixed.blocks.keys() == plain.blocks.keys()  # the conversions are no blocks of the user's


def test_a_contact_is_that_of_one_unit(loops):
    omega = np.array([1.0, 10.0, 50.0])
    found = [
        d.sampled(0.01)
        .contact(port="plant.force", force=None, direction=(1.0,), at=d.sampled(0.01).trim())
        .admittance(omega)
        for d in loops
    ]
    assert found[0].rendered == pytest.approx(found[1].rendered, rel=1e-6)

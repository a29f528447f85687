"""Type definitions: one for each unit, by the quantity that it measures."""

import zipfile

import fmpy
import pytest
from fmpy.validation import validate_fmu
from lxml import etree

from loopwright.blocks import Block, Constant, Input, State, Sum
from loopwright.diagrams import Diagram
from loopwright.fmus import build, build_fmu, gantry
from support.exported import pendulums

pytestmark = pytest.mark.usefixtures("uncompiled")


class Force(Block):
    """A model whose variable has the name of a type, with a unit that has no common name."""

    Force = Input(unit="N")
    pull = Input(unit="kN")
    odd = Input(unit="kg2.m/s", default=0.0)
    x = State(unit="m", output=True)

    def derivative(self, t, x, u):
        return 0.001 * (u.Force + 1000.0 * u.pull) - x.x


def definitions(path, fmi):
    with zipfile.ZipFile(path) as archive:
        root = etree.fromstring(archive.read("modelDescription.xml"))
    if fmi == 3:
        return {t.get("name"): (t.get("quantity"), t.get("unit")) for t in root.iterfind("TypeDefinitions/Float64Type")}
    types = root.iterfind("TypeDefinitions/SimpleType")
    return {t.get("name"): (t.find("Real").get("quantity"), t.find("Real").get("unit")) for t in types}


@pytest.mark.parametrize("fmi", [3, 2])
def test_each_unit_has_a_type_with_the_quantity_that_it_measures(fmi):
    path = build(gantry.nominal, fmi=fmi)
    assert definitions(path, fmi) == {
        "Number": ("Number", "1"),
        "Force": ("Force", "N"),
        "TranslationalDamping": ("TranslationalDamping", "N.s/m"),
        "Mass": ("Mass", "kg"),
        "Length": ("Length", "m"),
        "Velocity": ("Velocity", "m/s"),
        "Acceleration": ("Acceleration", "m/s2"),
        "Time": ("Time", "s"),
    }
    variables = fmpy.read_model_description(str(path)).modelVariables
    declared = {v.name.partition("[")[0]: v.declaredType.name for v in variables if v.declaredType is not None}
    assert declared["velocity"] == "Velocity"
    assert declared["motor_force"] == "Force"
    assert all(v.declaredType is None or v.declaredType.unit == v.unit for v in variables)


@pytest.mark.parametrize("fmi", [3, 2])
def test_types_and_variables_have_names_of_their_own(fmi):
    path = build(Force(), fmi=fmi)
    found = definitions(path, fmi)
    assert found["Force_"] == ("Force", "N")
    assert found["Force__"] == ("Force", "kN")  # the same quantity in another unit is another type
    assert found["Quantity in kg2.m/s"] == (None, "kg2.m/s")
    assert validate_fmu(str(path)) == []


@pytest.mark.parametrize("fmi", [3, 2])
def test_a_difference_of_temperatures_is_a_relative_quantity(fmi):
    warm = Constant(value=25.0, unit="degC", name="warm")
    rise = Sum(signs="+-", name="rise")(warm, Constant(value=20.0, unit="degC", name="cold"))
    path = build(Diagram("room", rise.named("rise")), fmi=fmi, outputs=["rise", "warm.y"])
    with zipfile.ZipFile(path) as archive:
        root = etree.fromstring(archive.read("modelDescription.xml"))
    real = {v.get("name"): v if fmi == 3 else v.find("Real") for v in root.find("ModelVariables")}
    found = [(real[name].get("unit"), real[name].get("relativeQuantity")) for name in ("rise", "warm.y")]
    assert found == [("K", "true"), ("degC", None)]
    assert validate_fmu(str(path)) == []


@pytest.mark.parametrize("fmi", [3, 2])
def test_a_model_without_units_defines_what_the_exporter_adds_alone(fmi):
    path = build_fmu(pendulums(), fmi=fmi)
    assert definitions(path, fmi) == {"Number": ("Number", "1"), "Time": ("Time", "s")}
    assert validate_fmu(str(path)) == []

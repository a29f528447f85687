"""Names that share a variable: an input has one wire, and a value has one name."""

import pytest

from loopwright.blocks import Constant, ParameterError, UnknownNameError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from support.typed_fmus import description2, description3, typed_fmu


@pytest.fixture(scope="module", params=[3, 2], ids=["fmi3", "fmi2"])
def file(request, cache, tmp_path_factory):
    """An FMU whose input u and parameter gain have second names: elements in FMI 3.0, references in FMI 2.0."""
    if request.param == 3:
        text = description3()
        for name, other in (("u_Float64", "flange.u"), ("gain", "motor.gain")):
            begin = text.index(f'name="{name}"')
            end = text.index("/>", begin)
            text = f'{text[:end]}><Alias name="{other}"/></Float64>{text[end + 2 :]}'
    else:
        text, start = description2(), 'variability="{}"><Real start="{}"/></ScalarVariable></ModelVariables>'
        for other, k, kind, rest in (
            ("flange.u", 0, "input", start.format("continuous", 0)),
            ("motor.gain", 30, "parameter", start.format("tunable", 2.5)),
        ):
            added = f'<ScalarVariable name="{other}" valueReference="{k}" causality="{kind}" {rest}'
            text = text.replace("</ModelVariables>", added)
    return typed_fmu(tmp_path_factory.mktemp("aliases"), request.param, text)


def test_an_input_with_two_names_is_one_port(file):
    plant = Fmu(file, name="plant")
    assert "u_Float64" in plant.inputs or "u_Real" in plant.inputs
    assert "flange.u" not in plant.inputs
    name = next(n for n in ("u_Float64", "u_Real") if n in plant.inputs)
    plant = Fmu(file, name="plant", ports=[name, name.replace("u_", "y_")])
    run = Diagram("d", plant(Constant(value=3.0))).simulate(0.02, step=0.01, progress=False)
    assert run[f"plant.y_{name[2:]}"].tolist() == [3.0, 3.0, 3.0]


@pytest.mark.parametrize("use", ["wire", "ports", "rename"])
def test_the_second_name_of_an_input_leads_to_the_first(file, use):
    plant, text = Fmu(file, name="plant"), "'flange.u' is another name of its input 'u_(Float64|Real)', and the two are"
    uses = {
        "wire": lambda: plant(**{"flange.u": Constant(value=1.0)}),
        "ports": lambda: Fmu(file, ports=["flange.u"]).inputs,
        "rename": lambda: Fmu(file, rename={"flange.u": "u"}).inputs,
    }
    with pytest.raises((UnknownNameError, ParameterError), match=text):
        uses[use]()


def test_two_start_values_of_one_variable_are_refused(file):
    assert float(Fmu(file, start={"motor.gain": 3.0}).start["motor.gain"]) == 3.0
    Fmu(file, start={"motor.gain": 3.0, "gain": 3.0})
    with pytest.raises(ParameterError, match=r"found 3.0 for 'motor.gain', and 2.0 for 'gain'; expected one value"):
        Fmu(file, start={"motor.gain": 3.0, "gain": 2.0})

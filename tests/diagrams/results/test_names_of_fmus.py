"""Names of an FMU's signals: variables that are no ports, and outputs beside others with longer names."""

import numpy as np
import pytest

from loopwright.blocks import UnknownNameError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from support.small_fmus import small_fmu, values

# ẇ = u: w = t; inertia1.w is 2 t, inertia1.a is u, and inertia2.w is a local variable, 3 t
SOURCE = """
typedef struct { double t, u, w; } instance;
int fmi2DoStep(void *p, double t, double h, int f) { instance *c = p; c->w += h * c->u; return 0; }
"""
EXPRESSIONS = {1: "c->u", 2: "c->w", 3: "2 * c->w", 4: "c->u", 5: "3 * c->w"}
ROWS = {
    "u": 'causality="input"',
    "w": 'causality="output"',
    "inertia1.w": 'causality="output"',
    "inertia1.a": "",
    "inertia2.w": "",
}


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    rows = "".join(
        f'<ScalarVariable name="{name}" valueReference="{k}" {kind}><Real{" start=" * (name == "u")}'
        f"{chr(34) + '0' + chr(34) if name == 'u' else ''}/></ScalarVariable>"
        for k, (name, kind) in enumerate(ROWS.items(), 1)
    )
    text = (
        f'<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>{rows}'
        '</ModelVariables><ModelStructure><Outputs><Unknown index="2"/><Unknown index="3"/></Outputs></ModelStructure>'
    )
    source = SOURCE + values("fmi2", "Get", "Real", "double", EXPRESSIONS)
    source += values("fmi2", "Set", "Real", "double", {1: "c->u"})
    return small_fmu(tmp_path_factory.mktemp("names"), "fmi2", source, text)


def simulate(file, **options):
    plant = Fmu(file, name="plant", **options)
    return Diagram("d", plant(u=1.0)).simulate(0.3, step=0.1, progress=False)


def test_a_local_variable_is_named_with_the_way_to_record_it(file):
    run = simulate(file)
    expected = (
        r"^no signal 'plant\.inertia2\.w' was recorded: 'inertia2\.w' is a variable of the FMU 'plant', and no port of "
        r"its\. Make it one, besides those that are needed: Fmu\(…, ports=\[…, 'inertia2\.w'\]\)\.$"
    )
    for ask in (run.plot, run.__getitem__, run.unit):
        with pytest.raises(UnknownNameError, match=expected):
            ask("plant.inertia2.w")
    with pytest.raises(UnknownNameError, match=r"ports=\[…, 'inertia1\.a'\]"):
        run.plot("inertia1.a")
    run = simulate(file, ports=["u", "w", "inertia2.w"])
    np.testing.assert_allclose(run["plant.inertia2.w"], 3.0 * run.t, atol=1e-12)
    assert run.plot("plant.inertia2.w") is not None


def test_record_and_sweeps_name_it_as_well(file):
    diagram = Diagram("d", Fmu(file, name="plant", start={"u": 1.0})())
    asked, expected = ["plant.inertia2.w"], r"ports=\[…, 'inertia2\.w'\]"
    with pytest.raises(UnknownNameError, match=expected):
        diagram.simulate(0.3, step=0.1, progress=False, record=asked)
    with pytest.raises(UnknownNameError, match=expected):
        diagram.sweep({"plant.start.u": (1.0, 2.0)}, 0.3, step=0.1, progress=False, signals=asked)


def test_other_names_are_unknown_as_before(file):
    with pytest.raises(UnknownNameError, match="no signal 'plant.inertia3.w' was recorded. Did you mean"):
        simulate(file).plot("plant.inertia3.w")
    with pytest.raises(UnknownNameError, match="no signal 'u' was recorded"):  # an input is no signal of the block's
        simulate(file)["u"]


def test_an_output_wins_over_longer_names_of_its_block(file):
    run = simulate(file)
    np.testing.assert_allclose(run["w"], run.t, atol=1e-12)
    np.testing.assert_allclose(run["plant.w"], run.t, atol=1e-12)
    np.testing.assert_allclose(run["inertia1.w"], 2.0 * run.t, atol=1e-12)
    assert run.plot("w") is not None


def test_outputs_of_two_blocks_stay_ambiguous(file):
    first, second = (Fmu(file, name=name) for name in ("plant", "other"))
    run = Diagram("d", first(u=1.0), second(u=1.0)).simulate(0.3, step=0.1, progress=False)
    with pytest.raises(UnknownNameError, match="'w' stands for several signals: other.inertia1.w, other.w, plant.iner"):
        run["w"]

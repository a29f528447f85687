"""Large descriptions: 100,000 variables open in a few seconds, and 20,000 outputs run."""

import io
import zipfile

import fmpy
import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, read_description
from loopwright.fmus.platform import native_platform
from support.small_fmus import small_fmu

OUTPUTS = """
typedef struct { double t; } instance;
int fmi2GetReal(void *p, const unsigned vr[], size_t n, double v[]) {
    for (size_t i = 0; i < n; i++) v[i] = ((instance *)p)->t * vr[i];
    return 0;
}
int fmi2SetReal() { return 0; }
int fmi2DoStep(void *p, double t, double h, int final) { ((instance *)p)->t = t + h; return 0; }
"""


def description(count, outputs, fmi=2):
    """Return the content of a description as tools write them: parts with vectors of 50, parameters and locals in turn."""
    rows = []
    for k in range(count):
        causality = "output" if k < outputs else ("local", "parameter")[k // 50 % 2]
        kind = "fixed" if causality == "parameter" else "continuous"
        start = ' start="1.5"' if causality == "parameter" else ""
        name = f'name="model.part{k // 50}.v[{k % 50 + 1}]" valueReference="{k}" description="variable {k}"'
        body = f'{name} causality="{causality}" variability="{kind}"'
        if fmi == 2:
            rows.append(f'<ScalarVariable {body}><Real unit="m"{start}/></ScalarVariable>')
        else:
            rows.append(f'<Float64 {body} unit="m"{start}/>')
    unknowns = "".join(
        f'<Unknown index="{k + 1}"/>' if fmi == 2 else f'<Output valueReference="{k}"/>' for k in range(outputs)
    )
    structure = f"<Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns>" if fmi == 2 else unknowns
    return (
        '<CoSimulation modelIdentifier="small"/><UnitDefinitions><Unit name="m"><BaseUnit m="1"/></Unit></UnitDefinitions>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
    )


@pytest.mark.parametrize(
    ("fmi", "count"),
    [(2, 2_000), pytest.param(2, 100_000, marks=pytest.mark.slow), pytest.param(3, 100_000, marks=pytest.mark.slow)],
)
def test_a_large_description_has_the_variables_that_fmpy_finds(tmp_path, fmi, count):
    path = tmp_path / "large.fmu"
    head = 'fmiVersion="2.0" guid="x"' if fmi == 2 else 'fmiVersion="3.0" instantiationToken="x"'
    text = f'<fmiModelDescription modelName="large" {head}>{description(count, 100, fmi)}</fmiModelDescription>'
    folder = native_platform() if fmi == 3 else {"x86_64-linux": "linux64"}.get(native_platform(), native_platform())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", text)
        archive.writestr(f"binaries/{folder}/small.so", b"")
    only = io.BytesIO()
    with zipfile.ZipFile(only, "w") as archive:
        archive.writestr("modelDescription.xml", text)
    theirs = {variable.name for variable in fmpy.read_model_description(only, validate=False).modelVariables}
    assert theirs <= {*read_description(path).names}
    assert len(theirs) >= count


@pytest.mark.slow
@pytest.mark.parametrize("count", [500, 20_000])
def test_many_outputs_run(tmp_path, count):
    """Output k is k·t."""
    file = small_fmu(tmp_path, "fmi2", OUTPUTS, description(count, count))
    plant = Fmu(file, name="plant")
    run = Diagram("d", plant()).simulate(0.003, step=1e-3, progress=False)
    values = np.concatenate([run[f"plant.{port}"][-1] for port in plant.outputs])
    assert values.shape == (count,)
    assert np.abs(values - 0.003 * np.arange(count)).max() <= 1e-15 * count

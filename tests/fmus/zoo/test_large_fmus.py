"""FMUs with very many variables: opened and run within seconds."""

import time
import zipfile

import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from support.zoo import zoo_fmu


def large(folder, fmi, n_locals, n_outputs):
    """Write a zoo FMU with further variables, all of them 0."""
    local, output = (
        ('<Float64 name="{}" valueReference="{}"/>', '<Float64 name="{}" valueReference="{}" causality="output"/>')
        if fmi == 3
        else (
            '<ScalarVariable name="{}" valueReference="{}"><Real/></ScalarVariable>',
            '<ScalarVariable name="{}" valueReference="{}" causality="output"><Real/></ScalarVariable>',
        )
    )
    rows = [local.format(f"part.b{k}.c", 100 + k) for k in range(n_locals)]
    rows += [output.format(f"o{k}", 10**6 + k) for k in range(n_outputs)]
    entries = [
        f'<Output valueReference="{10**6 + k}"/>' if fmi == 3 else f'<Unknown index="{5 + n_locals + k}"/>'
        for k in range(n_outputs)
    ]
    first = '<Output valueReference="2"/>' if fmi == 3 else '<Outputs><Unknown index="2"/>'
    small, path = zoo_fmu(folder, fmi), folder / f"large{fmi}.fmu"
    with zipfile.ZipFile(small) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                text = data.decode().replace("</ModelVariables>", "".join(rows) + "</ModelVariables>")
                data = text.replace(first, first + "".join(entries), 1).encode()
            new.writestr(name, data)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(("n_locals", "n_outputs"), [(100_000, 0), (0, 20_000)])
def test_an_fmu_with_very_many_variables_opens_within_five_seconds(tmp_path, fmi, n_locals, n_outputs):
    path = large(tmp_path, fmi, n_locals, n_outputs)
    started = time.process_time()
    plant = Fmu(path, name="zoo", start={"u": 1.0})
    assert len(plant.outputs) == 1 + n_outputs
    assert time.process_time() - started < 5.0
    started = time.process_time()
    run = Diagram("d", plant()).simulate(0.1, step=0.01, progress=False)
    assert time.process_time() - started < 10.0
    np.testing.assert_allclose(run["zoo.y"], run.t, rtol=0, atol=1e-12)
    if n_outputs:
        assert not run["zoo.o19999"].any()

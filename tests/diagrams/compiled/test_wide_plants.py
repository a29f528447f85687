"""FMUs with thousands of outputs: the C code goes over tables, and is as long as for one output."""

import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.diagrams.compiled import write_code
from loopwright.diagrams.flat import kinds_of
from loopwright.fmus import Fmu
from support.small_fmus import small_fmu

CODE = """
typedef struct { double t; } instance;
int fmi2DoStep(void *p, double t, double h, int f) { ((instance *)p)->t = t + h; return 0; }
int fmi2GetReal(void *p, const unsigned *r, size_t n, double *v) {
    for (size_t i = 0; i < n; i++) v[i] = (double)r[i] + ((instance *)p)->t;
    return 0;
}
"""


def wide(folder, count):
    variables = (
        f'<ScalarVariable name="y{i}" valueReference="{i}" causality="output"><Real/></ScalarVariable>'
        for i in range(count)
    )
    unknowns = (f'<Unknown index="{i + 1}"/>' for i in range(count))
    folder.mkdir()
    return small_fmu(
        folder,
        "fmi2",
        CODE,
        f"""<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>{"".join(variables)}</ModelVariables>
<ModelStructure><Outputs>{"".join(unknowns)}</Outputs></ModelStructure>""",
    )


def test_the_code_is_as_long_for_five_thousand_outputs_as_for_one_thousand(cache, tmp_path):
    sizes = []
    for count in (1000, 5000):
        flat = Diagram("d", Fmu(wide(tmp_path / str(count), count), name="plant")()).flatten(0.1)
        sizes.append(sum(map(len, write_code(flat, kinds_of(flat, every=True)).texts)))
    assert abs(sizes[1] - sizes[0]) < 100
    assert sizes[1] < 50_000


@pytest.mark.parametrize("count", [3, 1500])
def test_each_output_stands_in_its_column(cache, tmp_path, count):
    """yᵢ = i + t; the sum of their sizes tells the finite from others, in both tiers."""
    diagram = Diagram("d", Fmu(wide(tmp_path / "fmu", count), name="plant")())
    for compiled in (False, True):
        run = diagram.simulate(0.5, step=0.125, compile=compiled, progress=False)
        for i in (0, 1, count // 2, count - 1):
            assert run[f"plant.y{i}"].tolist() == (i + np.arange(5) / 8).tolist()

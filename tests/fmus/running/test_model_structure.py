"""FMUs in model exchange whose model structure leaves out a dependency."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, FmuRuntimeError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from tests.support.misstated import misstated_fmu

RATE = {
    2: '<Unknown index="4" dependencies="1 2 5"/>',
    3: '<ContinuousStateDerivative valueReference="4" dependencies="1 2 5"/>',
}
OUTPUT = {2: '<Unknown index="6" dependencies="1 2 5"/>', 3: '<Output valueReference="6" dependencies="1 2 5"/>'}


def damped(file):
    """A damper around it: u = 10 − 5 v."""
    plant = Fmu(file, interface="model_exchange", name="plant")
    return Diagram("damped", plant(u=Constant(value=10.0, name="push") - 5.0 * plant.v))


@pytest.mark.parametrize(("fmi", "kept", "left_out"), [(2, "1 2", "u"), (3, "1 2", "u"), (3, "2 5", "x")])
def test_a_dependency_that_is_left_out_is_named(tmp_path, fmi, kept, left_out):
    for given, value in ((RATE, r"der\(v\)"), (OUTPUT, "a")):
        file = misstated_fmu(tmp_path, fmi, [(given[fmi], given[fmi].replace("1 2 5", kept))])
        message = f"says that '{value}' does not depend on '{left_out}'"
        for _ in range(2):  # each time
            with pytest.raises(FmuRuntimeError, match=message) as error:
                damped(file).simulate(0.1, step=0.01, progress=False)
            assert error.value.block == "plant"
        with pytest.raises(FmuRuntimeError, match=message):
            damped(file).linearize(0.0)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_right_structure_and_one_that_says_nothing_run_as_the_equations_do(tmp_path, fmi):
    M = np.array([[0.0, 1.0, 0.0], [-100.0, -6.0, 10.0], [0.0, 0.0, 0.0]])
    for changes in ((), [(RATE[fmi], RATE[fmi].replace(' dependencies="1 2 5"', ""))]):
        run = damped(misstated_fmu(tmp_path, fmi, changes)).simulate(0.5, step=0.01, progress=False, rtol=1e-10)
        exact = [(expm(M * t) @ [0.0, 0.0, 1.0])[0] for t in run.t]
        np.testing.assert_allclose(run["plant.x"], exact, atol=1e-8)

"""Inputs and outputs of FMUs at t = 0 that depend on each other: any loop with a solution, by closed forms and SciPy."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import PID, Constant, Function, SimulationError, TransportDelay
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from support.small_fmus import small_fmu, values

# Its output is its input at the start, and stays there.
SOURCE = (
    """
typedef struct { double u, y; } instance;
int fmi2DoStep(void *p, double t, double h, int no) { return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->y"})
    + values("fmi2", "Set", "Real", "double", {2: "c->y = c->u"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>
<ScalarVariable name="y" valueReference="1" causality="output" variability="continuous"><Real/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input" variability="continuous"><Real start="0"/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="1"/></Outputs>
<InitialUnknowns><Unknown index="1"/></InitialUnknowns></ModelStructure>"""


@pytest.fixture(scope="module")
def through(cache, tmp_path_factory):
    return small_fmu(tmp_path_factory.mktemp("start"), "fmi2", SOURCE, MODEL)


def start(file, f):
    plant = Fmu(file, name="plant")
    diagram = Diagram("d", plant(u=Function(f, name="f")(plant.y)))
    return float(diagram.simulate(0.1, step=0.1, progress=False, compile=False)["plant.y"][0])


K, G = -0.9328288493890713, -1.9890459993194076
LOOPS = {
    # each pass brings it nearer by a third, where a search from the passes before came to rest at 1e-7
    "contracts": (lambda u: 0.2 * (G * np.sin(K * (math.tan(0.09) + u)) + 1.0), (0.0, 1.0)),
    "slowly": (lambda u: 1.0 + 0.999 * u, (0.0, 2000.0)),
    "steep": (lambda u: 1.0 - 400.0 * np.tanh(u), (0.0, 1.0)),
    "away": (lambda u: np.sqrt(4.0 + u * u) * 1.5 - 4.0, (-4.0, 0.0)),
    # passes alternate, Newton's method does, too, and the residual has a least value in between
    "in a circle": (lambda u: 3.0 * u - u**3 - 2.0, (-3.0, 0.0)),
    # without a value below 0.2, where the search may look
    "domain": (lambda u: 2.0 * np.log(u + 1.0) - np.sqrt(1.0 + u) + 3.0, (0.0, 9.0)),
}


@pytest.mark.parametrize("case", LOOPS)
def test_a_loop_through_an_fmu_begins_with_its_solution(through, case):
    f, (low, high) = LOOPS[case]
    found = start(through, f)
    assert abs(float(f(np.float64(found))) - found) <= 1e-9 * max(1.0, abs(found))
    if low < found < high:
        assert found == pytest.approx(brentq(lambda u: float(f(u)) - u, low, high, xtol=1e-300, rtol=1e-15), rel=2e-12)


def test_two_fmus_in_a_loop_have_the_solution_of_their_equations(through):
    """v = u² and u = 1 + 10 (v − u²) + u − u³, from u = 0: u = 1."""
    one, two = Fmu(through, name="one"), Fmu(through, name="two")
    u = Function(lambda v, u: 1.0 + 10.0 * (v - u * u) + u - u**3, name="f")(two.y, one.y)
    diagram = Diagram("d", one(u=u), two(u=Function(lambda u: u * u, name="g")(one.y)))
    run = diagram.simulate(0.1, step=0.1, progress=False, compile=False)
    assert (run["one.y"][0], run["two.y"][0]) == pytest.approx((1.0, 1.0), rel=1e-12)


def test_a_delay_with_its_own_output_at_its_input_begins_at_rest():
    """y = 1 − 2 y at rest, which repetition leads away from."""
    delay = TransportDelay(delay=0.05, initial_value=None, name="delay")
    diagram = Diagram("d", delay(Function(lambda u: 1.0 - 2.0 * u, name="f")(delay.y)))
    run = diagram.simulate(0.01, step=0.01, progress=False)
    assert run["delay.y"][0] == pytest.approx(1.0 / 3.0, rel=1e-12)


def test_an_initial_state_behind_a_delay_begins_with_the_input_at_the_start():
    """PID with a given first output: I = 40 − kp (r − y), whatever stands between y and its source."""
    duct = TransportDelay(delay=25.0, initial_value=None, name="duct")
    control = PID(kp=1.44, ki=0.008, initial_output=40.0, name="control")
    diagram = Diagram("d", control(Constant(value=120.0), duct(Constant(value=115.0, name="oven"))))
    assert diagram.simulate(1.0, step=1.0, progress=False)["control.u"][0] == pytest.approx(40.0, abs=1e-12)


def test_an_initial_state_behind_an_fmu_begins_with_the_output_that_its_input_makes(through):
    plant = Fmu(through, name="plant")
    control = PID(kp=1.44, ki=0.008, initial_output=40.0, name="control")
    diagram = Diagram("d", control(Constant(value=120.0), plant(u=Constant(value=115.0, name="oven"))["y"]))
    assert diagram.simulate(1.0, step=1.0, progress=False)["control.u"][0] == pytest.approx(40.0, abs=1e-12)


@pytest.mark.parametrize(
    "f",
    [lambda u: u + np.exp(-u), pytest.param(lambda u: 1.0 + u * u + u, marks=pytest.mark.slow)],
    ids=["approaches", "runs away"],
)
def test_a_loop_without_a_solution_is_named(through, f):
    with pytest.raises(
        SimulationError, match=r"plant.u, t = 0 s: its value at the start depends on the FMU's own outputs"
    ):
        start(through, f)

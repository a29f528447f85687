"""FMUs in model exchange that compute lazily: closed forms, whatever order of questions they were written for."""

from itertools import permutations

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant
from loopwright.blocks.core import Wanted
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, FmuRuntimeError
from support.lazy_fmus import lazy_fmu

KINDS = ["equations", "comparing", "derivatives"]
# ẋ1 = −x1 + u, ẋ2 = x1, y = 0.2 x1 + 2 x2, with u = −y: ẋ = CLOSED x.
EQUATIONS = "dx[0] = -x[0] + u[0]; dx[1] = x[0]; y[0] = 0.2 * x[0] + 2 * x[1];"
OPEN = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.2, 2.0, 0.0]])
"""[[A, B], [C, D]] of the FMU."""
CLOSED = np.array([[-1.2, -2.0], [1.0, 0.0]])
START = {"x1": 1.0, "x2": -0.5}
STRUCTURE = {"dx1": "x1 u1", "dx2": "x1", "y1": "x1 x2"}


@pytest.fixture(params=[2, 3])
def fmi(request):
    return request.param


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def file(cache, tmp_path, fmi, kind):
    return lazy_fmu(tmp_path, fmi, kind, EQUATIONS, states=2, dependencies=STRUCTURE)


def loop(file, **options):
    plant = Fmu(file, interface="model_exchange", name="plant", start=START, **options)
    return Diagram("loop", plant(u1=-1.0 * plant.y1))


@pytest.mark.parametrize("isolate", [True, False], ids=["apart", "here"])
@pytest.mark.parametrize("in_c", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("solver", ["RK45", "Radau", "rk4"])
@pytest.mark.drawn(8)
def test_a_loop_around_it_is_that_of_the_matrix_exponential(file, isolate, in_c, solver):
    tolerances = {} if solver == "rk4" else {"rtol": 1e-9, "atol": 1e-11}
    step = 0.01 if solver == "rk4" else 0.1
    run = loop(file, isolate=isolate).simulate(
        2.0, step=step, solver=solver, compile=in_c, progress=False, **tolerances
    )
    assert run.tier == ("compiled" if in_c else "interpreted"), run.messages
    exact = np.array([expm(CLOSED * t) @ [*START.values()] for t in run.t])
    np.testing.assert_allclose(run["plant.y1"], exact @ [0.2, 2.0], rtol=0, atol=1e-7)


@pytest.mark.parametrize("isolate", [True, False], ids=["apart", "here"])
def test_it_is_in_c_too(cache, tmp_path, isolate):
    """Each evaluation of C is the one of an interpreted run, in this process and by a request to another one."""
    file = lazy_fmu(tmp_path, 3, "equations", EQUATIONS, states=2, dependencies=STRUCTURE)
    run = loop(file, isolate=isolate).simulate(1.0, step=0.1, rtol=1e-9, atol=1e-11, compile=True, progress=False)
    assert run.tier == "compiled", run.messages
    exact = [[0.2, 2.0] @ expm(CLOSED * t) @ [*START.values()] for t in run.t]
    np.testing.assert_allclose(run["plant.y1"], exact, rtol=0, atol=1e-7)


@pytest.mark.parametrize("isolate", [True, False], ids=["apart", "here"])
@pytest.mark.drawn(4)
def test_evaluations_at_one_point_hold_in_any_order(file, isolate):
    """Derivatives alone, then outputs alone: an FMU that compares what is set has nothing new to compute between them."""
    plant = Fmu(file, interface="model_exchange", name="plant", isolate=isolate)
    outputs, rates, both = Wanted(("y1",)), Wanted(rates=True), Wanted(("y1",), rates=True)
    with plant.exchange(["u1"]) as instance:
        instance.exchange(np.zeros(1))
        instance.begin_exchange()
        rng = np.random.default_rng(1)
        for order in permutations((outputs, rates, both)):
            t, x, u = float(rng.uniform()), rng.normal(size=2), rng.normal(size=1)
            exact = OPEN @ [*x, *u]
            for wanted in order:
                expected = np.concatenate([exact[2:] if wanted.outputs else [], exact[:2] if wanted.rates else []])
                np.testing.assert_allclose(instance.evaluation(wanted)(t, x, u), expected, rtol=0, atol=1e-14)


@pytest.mark.drawn(1)
def test_the_linear_model_of_the_loop_has_its_matrix(file):
    made = loop(file).linearize(0.0)
    np.testing.assert_allclose(made.A, CLOSED, rtol=0, atol=1e-8)


@pytest.mark.drawn
def test_the_linear_model_of_the_fmu_has_its_matrices(file):
    made = Fmu(file).linear_model(0.0, state=START, inputs={"u1": 0.3}, interface="model_exchange")
    np.testing.assert_allclose(np.block([[made.A, made.B], [made.C, made.D]]), OPEN, rtol=0, atol=1e-8)
    np.testing.assert_allclose(made.f, [-0.7, 1.0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(made.y0, [-0.8], rtol=0, atol=1e-14)


# --- directional derivatives: by the product rule at kept values ------------------------------------------------------

_DIRECTIONAL = """
int fmi3GetDirectionalDerivative(void *p, const unsigned f[], size_t n, const unsigned by[], size_t m,
    const double seed[], size_t ns, double d[], size_t nd) {
    instance *c = p; double x = 0.0, u = 0.0; /* y = (x + u)^2 */
    for (size_t k = 0; k < m; k++) *(by[k] == 1 ? &x : &u) += seed[k];
    for (size_t i = 0; i < n; i++) d[i] = f[i] == 11 ? u : 2 * (c->y[1]) * (x + u);
    return 0; }
int NAME(EnterEventMode)"""


@pytest.mark.parametrize("kind", KINDS)
def test_directional_derivatives_are_those_of_the_point(cache, tmp_path, kind):
    """They are computed from values that the FMU keeps, and agree with the differences that they are held against."""
    file = lazy_fmu(
        tmp_path,
        3,
        kind,
        "dx[0] = u[0]; y[1] = x[0] + u[0]; y[0] = y[1] * y[1];",
        source=[("int NAME(EnterEventMode)", _DIRECTIONAL)],
        description=[
            (
                '<ModelExchange modelIdentifier="small"/>',
                '<ModelExchange modelIdentifier="small" providesDirectionalDerivatives="true"/>',
            )
        ],
    )
    state, inputs = {"x1": 0.7}, {"u1": 0.4}
    made = Fmu(file).linear_model(0.0, state=state, inputs=inputs, interface="model_exchange")
    np.testing.assert_allclose(np.block([[made.A, made.B], [made.C, made.D]]), [[0, 1], [2.2, 2.2]], rtol=1e-14)
    assert made.how == "directional derivatives in model-exchange"
    plant = Fmu(file, interface="model_exchange", name="plant", start=state)
    whole = Diagram("open", plant(u1=Constant(value=0.4, name="push")())).linearize(
        0.0, inputs="push.y", outputs="plant.y1"
    )
    assert (whole.A[0, 0], whole.B[0, 0]) == (0.0, 1.0)
    np.testing.assert_allclose([whole.C[0, 0], whole.D[0, 0]], [2.2, 2.2], rtol=1e-14)
    assert not whole.findings, whole.findings


# --- indicators, and the check of the structure -----------------------------------------------------------------------

_INDICATOR = """
int fmi3GetEventIndicators(void *p, double z[], size_t n) {
    instance *c = p; INDICATOR z[0] = c->y[0] - 0.5; return n == 1 ? 0 : 3; }
int NAME(EnterEventMode)"""


@pytest.mark.parametrize("in_c", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.drawn(1)
def test_an_indicator_of_a_value_that_is_kept_crosses_in_time(cache, tmp_path, kind, in_c):
    """The getter of the indicators computes the derivatives at most, as those of the tools with such getters do."""
    more = "settle(c, false);" if kind != "derivatives" else ""
    file = lazy_fmu(
        tmp_path,
        3,
        kind,
        "dx[0] = 1.0; y[0] = x[0] * x[0];",
        inputs=0,
        source=[("int NAME(EnterEventMode)", _INDICATOR.replace("INDICATOR", more))],
        description=[
            ("</ModelVariables>", '<Float64 name="z" valueReference="39"/></ModelVariables>'),
            ("</ModelStructure>", '<EventIndicator valueReference="39"/></ModelStructure>'),
        ],
    )
    plant = Fmu(file, interface="model_exchange", name="plant")
    run = Diagram("alone", plant()).simulate(1.0, step=0.05, rtol=1e-9, compile=in_c, progress=False)
    assert run.tier == ("compiled" if in_c else "interpreted"), run.messages
    np.testing.assert_allclose(run["plant.y1"], run.t**2, rtol=0, atol=1e-9)
    assert [e.t for e in run.events] == pytest.approx([np.sqrt(0.5)], abs=1e-8)


@pytest.mark.drawn(1)
def test_a_structure_that_leaves_out_an_input_is_named_and_one_that_leaves_out_states_runs(cache, tmp_path, fmi, kind):
    wrong = {**STRUCTURE, "dx1": "x1"}
    file = lazy_fmu(tmp_path, fmi, kind, EQUATIONS, states=2, dependencies=wrong)
    with pytest.raises(FmuRuntimeError, match=r"says that 'der\(x1\)' does not depend on 'u1'"):
        loop(file).simulate(0.1, step=0.1, progress=False)
    file = lazy_fmu(tmp_path, fmi, kind, EQUATIONS, states=2, dependencies={"dx1": "u1", "dx2": "", "y1": ""})
    run = loop(file).simulate(1.0, step=0.1, rtol=1e-9, progress=False)
    exact = np.array([expm(CLOSED * t) @ [*START.values()] for t in run.t])
    np.testing.assert_allclose(run["plant.y1"], exact @ OPEN[2, :2], rtol=0, atol=1e-7)

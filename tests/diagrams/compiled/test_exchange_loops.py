"""Algebraic loops beside FMUs in model exchange, and through them, in C: Newton's method around functions in stages."""

import numpy as np
import pytest

from loopwright.blocks import Function, Gain, Relay, Sine, Sum
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu
from support.small_fmus import small_fmu, values
from support.work_in_c import simulate_counted

LAG = """
typedef struct { double t, x, u; int mode; } instance;
void *fmi2Instantiate() { instance *c = calloc(1, sizeof(instance)); c->x = 1; return c; }
int fmi2SetTime(void *p, double t) { ((instance *)p)->t = t; return 0; }
int fmi2EnterContinuousTimeMode(void *p) { return 0; }
int fmi2EnterEventMode(void *p) { return 0; }
typedef struct { int more, terminate, nominals, values, defined; double next; } info;
int fmi2NewDiscreteStates(void *p, info *i) { *i = (info){0, 0, 0, 0, 0, 0}; return 0; }
int fmi2CompletedIntegratorStep(void *p, int final, int *event, int *end) { *event = *end = 0; return 0; }
int fmi2SetContinuousStates(void *p, const double x[], size_t n) { ((instance *)p)->x = x[0]; return 0; }
int fmi2GetContinuousStates(void *p, double x[], size_t n) { x[0] = ((instance *)p)->x; return 0; }
int fmi2GetNominalsOfContinuousStates(void *p, double x[], size_t n) { x[0] = 1; return 0; }
int fmi2GetDerivatives(void *p, double dx[], size_t n) { instance *c = p; dx[0] = c->u - c->x; return 0; }
int fmi2GetEventIndicators(void *p, double z[], size_t n) { return 0; }
""" + values("fmi2", "Get", "Real", "double", {1: "c->x", 2: "c->u", 3: "c->u - c->x", 4: "c->x + c->u"})
LAG += values("fmi2", "Set", "Real", "double", {2: "c->u"})
MODEL = """<ModelExchange modelIdentifier="small"/><ModelVariables>
<ScalarVariable name="x" valueReference="1" causality="output" initial="exact"><Real start="1"/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="dx" valueReference="3"><Real derivative="1"/></ScalarVariable>
<ScalarVariable name="y" valueReference="4" causality="output"><Real/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1" dependencies="1"/><Unknown index="4" dependencies="1 2"/></Outputs>
<Derivatives><Unknown index="3" dependencies="1 2"/></Derivatives></ModelStructure>"""
TIGHT = {"rtol": 1e-9, "atol": 1e-12, "progress": False}


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    """x' = u - x from x = 1, and y = x + u."""
    return small_fmu(tmp_path_factory.mktemp("loops"), "fmi2", LAG, MODEL, name="lag")


def both(made, duration, **options):
    one, two = (made.simulate(duration, compile=c, **TIGHT, **options) for c in (False, True))
    assert (one.tier, two.tier) == ("interpreted", "compiled"), two.messages
    np.testing.assert_allclose(one.data, two.data, atol=1e-8)
    assert [(e.block, e.event) for e in one.events] == [(e.block, e.event) for e in two.events]
    return two


def plant(file, **options):
    return Fmu(file, name="plant", interface="model_exchange", **options)


@pytest.mark.parametrize("isolate", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("solver", ["auto", "Radau", "rk4"])
def test_a_loop_through_the_fmu(file, solver, isolate):
    """u = -y = -(x + u): u = -x / 2, so x' = -3/2 x."""
    lag = plant(file, isolate=isolate)
    made = Diagram("d", lag(u=Gain(gain=-1.0, name="back")(lag.y)), loops="solve")
    run = both(made, 1.0, step=0.05, solver=solver)
    exact = np.exp(-1.5 * run.t)
    bound = 1e-7 if solver == "rk4" else 1e-8  # (1.5 · 0.05)⁵ / 120 in each of 20 steps: 4e-7 of x less its decay
    np.testing.assert_allclose(run["plant.x"], exact, atol=4 * bound if solver == "rk4" else bound)
    np.testing.assert_allclose(run["back.y"], -0.5 * run["plant.x"], atol=1e-12)


def test_a_nonlinear_loop_beside_the_fmu(file):
    """v = -v³ + x, solved at each evaluation; x' = v - x = -v³, so that v' (1 + 3 v²) = -v³: 3 log v - 1/(2 v²) + t stays."""
    cubic = Function(lambda v, x: x - v**3, name="cubic", arguments={"v": (), "x": ()})
    lag = plant(file)
    through = cubic(cubic.y, lag.x)
    run = both(Diagram("d", lag(u=through), loops="solve"), 1.0, step=0.05)
    v = run["cubic.y"]
    np.testing.assert_allclose(v + v**3, run["plant.x"], atol=1e-10)
    stays = 3.0 * np.log(v) - 0.5 / v**2 + run.t
    np.testing.assert_allclose(stays, stays[0], rtol=0.0, atol=1e-7)
    assert run["plant.x"][0] == 1.0


def test_a_loop_at_the_ticks_of_a_controller(file):
    """At each tick u = 2 (1 - y), y = x + u: u = 2 (1 - x) / 3; held in between."""
    lag = plant(file)

    @subsystem(sample_time=0.1)
    def controller(y):
        return Gain(gain=2.0, name="k")(1.0 - y)

    run = both(Diagram("d", lag(u=controller(lag.y)), loops="solve"), 1.0)
    x, found = 1.0, []
    for _ in range(11):
        found.append(x)
        u = 2.0 * (1.0 - x) / 3.0
        x = u + (x - u) * np.exp(-0.1)
    np.testing.assert_allclose(run["plant.x"], found, atol=1e-8)


def test_events_beside_a_loop_through_the_fmu(file):
    """A relay's edges w = 0 and 1 jump into the loop: u = (w − x) / 2 at once, so x' = w / 2 − 3 x / 2."""
    lag = plant(file)
    relay = Relay(name="relay", on_point=0.5, off_point=-0.5)
    wave = relay(Sine(name="wave", frequency=1.0))
    made = Diagram("d", lag(u=Sum(signs="+-", name="sum")(wave, lag.y)), loops="solve")
    run = both(made, 1.6, step=0.05)
    edges = np.array([1.0, 7.0, 13.0, 19.0]) / 12.0  # sin 2π t = 1/2 on its way up, −1/2 on its way down
    edges = edges[edges < 1.6]
    np.testing.assert_allclose([e.t for e in run.events], edges, atol=1e-9)
    expected = [np.exp(-1.5 * t) for t in run.t]
    for i, begun in enumerate(edges):
        expected += (-1.0) ** i / 3.0 * -np.expm1(-1.5 * np.clip(run.t - begun, 0.0, None))
    np.testing.assert_allclose(run["plant.x"], expected, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(run["plant.y"], 0.5 * (run["plant.x"] + run["relay.y"]), atol=1e-10)


def test_a_loop_that_is_nearly_singular_is_left_to_python(file):
    """u = (1 - 1e-8) y: differences can't tell the slope of the mismatch, 1e-8, from 0; u = (1e8 - 1) x."""
    lag = plant(file)
    made = Diagram("d", lag(u=Gain(gain=1.0 - 1e-8, name="k")(lag.y)), loops="solve")
    one, two = (made.simulate(1e-9, step=1e-9, solver="rk4", compile=c, progress=False) for c in (False, True))
    np.testing.assert_array_equal(one.data, two.data)
    np.testing.assert_allclose(two["k.y"], (1e8 - 1.0) * two["plant.x"], rtol=1e-6)


def test_the_slope_of_a_stiff_method_solves_the_loop_again(file):
    """u = 1.001 (y - sin t), y = x + u: u = 1001 (sin t - x), so x' = 1001 (sin t) - 1002 x, which is stiff.

    With the loop's value held, the slope of the rate would be -1 and not -1002: Newton's method would not converge at
    steps of more than about 1 ms, and the run would take thousands of steps.
    """
    lag = plant(file)
    wave = Sine(frequency=1.0 / (2.0 * np.pi), name="wave")
    made = Diagram("d", lag(u=Gain(gain=1.001, name="back")(lag.y - wave)), loops="solve")
    run, work = simulate_counted(made, 2.0, step=0.1, solver="Radau", compile=False, rtol=1e-7, atol=1e-10)
    a, t = 1002.0, run.t
    forced = 1001.0 * (a * np.sin(t) - np.cos(t)) / (a * a + 1.0)
    exact = forced + (1.0 + 1001.0 / (a * a + 1.0)) * np.exp(-a * t)
    np.testing.assert_allclose(run["plant.x"], exact, rtol=0.0, atol=2e-6)  # 7e-7 of SciPy's Radau
    assert work.steps < 400

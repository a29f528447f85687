"""Manners of FMUs that were seen: changed modes of the process, threads that log, formats, names, ends."""

import ctypes
import os
import subprocess
import sys

import numpy as np
import pytest

from loopwright.blocks import Constant, Integrator
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu
from support.closed_form import closed_form_fmu
from support.small_fmus import small_fmu, values

# `fault` tells the place: 1 initialization, 2 step, 3 terminate; `kind` the thing: 1 rounding, 2 traps, 3 folder.
CHANGES = (
    """
#include <pthread.h>
#include <unistd.h>
extern int feenableexcept(int);
typedef struct { double t, stop; int fault, kind, threads; void (*log)(void *, const char *, int, const char *, const char *, ...); }
    instance;
typedef struct { void (*log)(void *, const char *, int, const char *, const char *, ...); void *rest[4]; } callbacks;
void *fmi2Instantiate(const char *n, int type, const char *g, const char *r, const callbacks *f, int v, int logging) {
    instance *c = calloc(1, sizeof(instance)); c->log = f->log; c->stop = -1; return c; }
int fmi2SetupExperiment(void *p, int d, double tol, double t, int defined, double stop) {
    if (defined) ((instance *)p)->stop = stop; return 0; }
static void change(instance *c, int place) {
    if (c->fault != place) return;
    if (c->kind == 1) fesetround(FE_UPWARD);
    if (c->kind == 2) feenableexcept(FE_DIVBYZERO);
    if (c->kind == 3 && chdir("/")) abort(); }
int fmi2EnterInitializationMode(void *p) { change(p, 1); return 0; }
int fmi2Terminate(void *p) { change(p, 3); return 0; }
static void *speak(void *p) { instance *c = p; c->log(c, "small", 1, "w", "%s%n of %d", "a thread", 7); return NULL; }
int fmi2DoStep(void *p, double t, double h, int f) {
    instance *c = p; c->t = t + h; change(c, 2);
    if (c->stop >= 0 && c->t > c->stop) return 4;
    if (c->threads) { pthread_t one; pthread_create(&one, NULL, speak, c); pthread_join(one, NULL); }
    return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->t"})
    + values("fmi2", "Get", "Integer", "int", {2: "c->fault", 3: "c->kind", 4: "c->threads"})
    + values("fmi2", "Set", "Integer", "int", {2: "c->fault", 3: "c->kind", 4: "c->threads"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>
<ScalarVariable name="time" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="fault" valueReference="2" causality="parameter" variability="fixed"><Integer start="0"/></ScalarVariable>
<ScalarVariable name="kind" valueReference="3" causality="parameter" variability="fixed"><Integer start="0"/></ScalarVariable>
<ScalarVariable name="threads" valueReference="4" causality="parameter" variability="fixed"><Integer start="0"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/></Outputs></ModelStructure>"""
KINDS = {1: "the rounding mode or the traps", 2: "the rounding mode or the traps", 3: "the working folder"}


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return small_fmu(tmp_path_factory.mktemp("manners"), "fmi2", CHANGES, MODEL)


def modes():
    library = ctypes.CDLL("libm.so.6")
    return library.fegetround(), library.fegetexcept(), os.getcwd()


@pytest.mark.skipif(sys.platform != "linux", reason="modes are kept on Linux alone")
@pytest.mark.parametrize(("isolate", "compiled"), [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize(("place", "kind"), [(1, 1), (2, 1), (3, 1), (1, 2), (2, 2), (1, 3), (2, 3), (3, 3)])
@pytest.mark.drawn(8)
def test_modes_of_this_process_stay_as_they_are(file, place, kind, isolate, compiled):
    before = modes()
    plant = Fmu(file, name="plant", start={"fault": place, "kind": kind}, isolate=isolate)
    run = Diagram("d", plant()).simulate(0.5, step=0.1, progress=False, compile=compiled)
    assert run.tier == ("compiled" if compiled else "interpreted")
    assert modes() == before
    assert run["plant.time"] == pytest.approx(run.t, abs=1e-12)
    said = [m for m in run.messages if m.endswith("of this process; it was set back")]
    assert len(said) == (0 if isolate else 1)
    assert isolate or f"plant: the FMU has changed {KINDS[kind]}" in said[0]
    with np.errstate(divide="ignore"):
        assert np.isinf(np.float64(1.0) / np.zeros(1))[0]  # a trap that stays would end this process


@pytest.mark.parametrize("isolate", [False, True])
def test_a_thread_of_the_fmu_may_log_with_any_format(file, isolate):
    plant = Fmu(file, name="plant", start={"threads": 1}, isolate=isolate)
    run = Diagram("d", plant()).simulate(0.2, step=0.1, progress=False)
    said = [m for m in run.messages if "a thread" in m]
    assert said == ["plant: warning: a thread%n of 7 (said 2 times)"]


def test_an_output_may_be_called_time(file, tmp_path):
    plant = Fmu(file, name="plant")
    run = Diagram("d", 2.0 * plant.time, Constant(value=1.0)()).simulate(0.3, step=0.1, progress=False)
    assert run["time"] == pytest.approx(run.t, abs=1e-15)
    assert run["gain_of_plant.y"] == pytest.approx(2.0 * run.t, abs=1e-15)
    run.to_csv(tmp_path / "run.csv")
    assert (tmp_path / "run.csv").read_text().splitlines()[0].count("time") == 1
    assert [*run.to_pandas()].count("plant.time") == 1


@pytest.mark.parametrize("duration", [0.7, 0.3, 10 * 0.1])
def test_no_step_passes_a_stop_time_that_was_told(file, duration):
    """The FMU fails fatally where a step ends a rounding error beyond the end that it was told."""
    run = Diagram("d", Fmu(file, name="plant")()).simulate(duration, step=0.1, progress=False)
    assert run.t[-1] == pytest.approx(duration)


@pytest.mark.parametrize(
    "experiment", ['stopTime="NaN"', 'stopTime="INF"', 'startTime="5" stopTime="1"', 'stepSize="0"', 'stepSize="soon"']
)
def test_an_impossible_default_experiment_does_not_change_a_run(tmp_path, experiment):
    model = MODEL.replace("<ModelVariables>", f"<DefaultExperiment {experiment}/><ModelVariables>", 1)
    plant = Fmu(small_fmu(tmp_path, "fmi2", CHANGES, model), name="plant", isolate=False)
    run = Diagram("d", plant()).simulate(0.3, step=0.1, progress=False)
    assert run["plant.time"] == pytest.approx([0.0, 0.1, 0.2, 0.3], abs=1e-15)


@pytest.mark.parametrize(("isolate", "compiled"), [(False, False), (True, False), (False, True)])
def test_warnings_without_words_are_told_once_for_each_kind_of_call(tmp_path, cache, isolate, compiled):
    """Readings warn from t = 0.4 s on, steps from 0.6 s on; their values count."""
    getter = values("fmi2", "Get", "Real", "double", {1: "c->t"})
    warns = CHANGES.replace(getter, getter.replace("return 0;", "return c->t > 0.35;"))
    step = "pthread_join(one, NULL); }\n    return 0; }"
    assert warns.count(step) == 1
    path = small_fmu(tmp_path, "fmi2", warns.replace(step, step.replace("return 0", "return c->t > 0.65")), MODEL)
    diagram = Diagram("d", Fmu(path, name="plant", isolate=isolate)())
    run = diagram.simulate(1.0, step=0.1, progress=False, compile=compiled)
    assert run.tier == ("compiled" if compiled else "interpreted")
    told = [m for m in run.messages if "Warning" in m]
    assert [m.rpartition(" at t = ")[0] for m in told] == [
        "plant: reading the outputs gave fmi2Warning",
        "plant: a step gave fmi2Warning",
    ], run.messages
    np.testing.assert_allclose(run["plant.time"], run.t, atol=1e-15)


STRICT = (
    """
typedef struct { double t, u, p; int ready; } instance;
int fmi2EnterInitializationMode(void *p) { ((instance *)p)->ready = 1; return 0; }
int fmi2DoStep(void *p, double t, double h, int f) { ((instance *)p)->t = t + h; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->p * c->u", 2: "c->u", 3: "c->p"})
    + values("fmi2", "Set", "Real", "double", {2: "if (!c->ready) return 3; c->u", 3: "if (c->ready) return 3; c->p"})
)
STRICT_MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="p" valueReference="3" causality="parameter" variability="fixed"><Real start="1"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/></Outputs></ModelStructure>"""


@pytest.mark.parametrize("isolate", [False, True])
def test_start_values_of_inputs_are_set_in_initialization_mode(tmp_path, isolate):
    """FMI 2.0 allows inputs there and later, parameters before; an FMU refuses them elsewhere."""
    file = small_fmu(tmp_path, "fmi2", STRICT, STRICT_MODEL)
    plant = Fmu(file, name="plant", start={"u": 3.0, "p": 2.0}, isolate=isolate)
    run = Diagram("d", plant()).simulate(0.2, step=0.1, progress=False)
    assert run["plant.y"].tolist() == [6.0] * 3


@pytest.mark.skipif(sys.platform != "linux", reason="modes are kept on Linux alone")
@pytest.mark.parametrize("continuous", [False, True])
def test_a_compiled_run_computes_in_its_own_modes_beside_an_fmu_that_rounds_upward(file, continuous):
    # 1 + 2^-60 is 1, and above 1 where sums are rounded upward
    @subsystem(sample_time=0.1, name="sum")
    def add(time):
        return Constant(value=1.0, name="one") + 2.0**-60 * (1.0 + 0.0 * time)

    plant = Fmu(file, name="plant", start={"fault": 2, "kind": 1}, isolate=False)
    calls = [plant(), add(plant.time).named("total")]
    calls += [Integrator(initial_value=0.0, name="x")(plant.time)] if continuous else []
    run = Diagram("d", *calls).simulate(0.5, progress=False, compile=True)
    assert run.tier == "compiled"
    assert np.all(run["total"] == 1.0)
    assert any("the FMU has changed the rounding mode or the traps" in text for text in run.messages)


# Every call enables traps; "all" includes that of a rounded result, which any sum in Python would set off.
TRAPPED = """
extern int feenableexcept(int);
static void trap(void) { feclearexcept(FE_ALL_EXCEPT); feenableexcept(TRAPS); }
"""
_RUN = """
import sys
import numpy as np
from loopwright.blocks import Constant
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
plant = Fmu(sys.argv[1], name="plant", interface=sys.argv[2], isolate=False, start={"x1": 1.0})
diagram = Diagram("d", plant(u1=Constant(value=1 / 3, name="push")()))
run = diagram.simulate(0.7, step=0.1, rtol=1e-9, atol=1e-11, compile=sys.argv[3] == "True", progress=False)
exact = 1 / 3 + (1 - 1 / 3) * np.exp(-run.t)
assert abs(run["plant.y1"] - exact).max() < (1e-7 if sys.argv[2] == "model_exchange" else 1e-6)
assert any("the rounding mode or the traps" in text for text in run.messages), run.messages
model = plant.linear_model(0.1, state={"x1": 0.3}, inputs={"u1": 0.7})
assert abs(model.A[0, 0] + 1) < 1e-8, model.A
print("done", 1 / 3 + 1 / 7)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="modes are kept on Linux alone")
@pytest.mark.parametrize(
    ("compiled", "traps"),
    [
        (False, "FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW"),
        (True, "FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW"),
        (False, "FE_ALL_EXCEPT"),
        (True, "FE_ALL_EXCEPT"),
    ],
    ids=["interpreted", "compiled", "all traps", "all traps, compiled"],
)
@pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_nothing_is_computed_with_the_traps_of_an_fmu(cache, tmp_path, fmi, traps, interface, compiled):
    """A process of its own, as a trap that is set off ends it: in FMI 2.0 a step's end is compared with no number."""
    ends = [
        ("return 0; }\n#if FMI == 3\nint fmi3DoStep", "trap(); return 0; }\n#if FMI == 3\nint fmi3DoStep"),
        ("c->step++; c->t = t + 20 * h; return 0; }", "c->step++; c->t = t + 20 * h; trap(); return 0; }"),
        ("for (size_t i = 0; i < n; i++) dx[i] = d[i];", "for (size_t i = 0; i < n; i++) dx[i] = d[i]; trap();"),
        ("int NAME(EnterEventMode)", TRAPPED.replace("TRAPS", traps) + "int NAME(EnterEventMode)"),
    ]
    file = closed_form_fmu(tmp_path, fmi, "dx[0] = u[0] - x[0]; y[0] = x[0];", changes=ends)
    arguments = [sys.executable, "-c", _RUN, str(file), interface, str(compiled)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout[:4]) == (0, "done"), done.stderr

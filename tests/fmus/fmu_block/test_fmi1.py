"""FMUs of FMI 1.0 for co-simulation, in this process and in one of their own."""

import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Input, Output, ParameterError, Sine, UnknownNameError
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, FmuRuntimeError, Isolation, StepOptions, doctor
from loopwright.types import FmuFault
from support.small_fmus import small_fmu, values

# x' = gain u with the inputs held, or along their slope; it logs by a format, and discards steps above `longest`.
SOURCE = (
    """
typedef struct { void (*log)(void *, const char *, int, const char *, const char *, ...); void *allocate, *release, *done; }
    callbacks;
typedef struct { double t, x, u, du, gain, longest; int count, pending; char on, ready; char label[40]; callbacks f; } instance;
void *fmi1InstantiateSlave(const char *name, const char *guid, const char *place, const char *mime, double timeout, char visible,
                           char interactive, callbacks f, char logging) {
    if (strcmp(guid, "x") || strncmp(place, "file://", 7)) return NULL;
    instance *c = calloc(1, sizeof(instance)); c->f = f; c->gain = 1; c->longest = 10; return c; }
int fmi1InitializeSlave(void *p, double t, char defined, double stop) {
    instance *c = p; c->ready = 1; c->t = t;
    c->f.log(c, "small", 1, "w", "%d%% of %s, %.1f", 50, "all", 2.5); return c->gain < 0 ? 3 : 0; }
int fmi1ResetSlave(void *p) {
    instance *c = p; c->x = c->u = c->du = c->t = 0; c->gain = 1; c->ready = 0; c->longest = 10; return 0; }
int fmi1SetString(void *p, const unsigned vr[], size_t n, const char *v[]) {
    strncpy(((instance *)p)->label, v[0], 39); return 0; }
int fmi1GetString(void *p, const unsigned vr[], size_t n, const char *v[]) { v[0] = ((instance *)p)->label; return 0; }
int fmi1SetRealInputDerivatives(void *p, const unsigned vr[], size_t n, const int order[], const double v[]) {
    ((instance *)p)->du = v[0]; return 0; }
int fmi1GetStatus(void *p, int kind, int *v) { instance *c = p; *v = c->pending-- > 0 ? 5 : 0; return 0; }
int fmi1GetRealStatus(void *p, int kind, double *v) { *v = ((instance *)p)->t; return kind == 2 ? 0 : 3; }
int fmi1DoStep(void *p, double t, double h, char fresh) {
    instance *c = p; if (!c->ready || !fresh || fabs(t - c->t) > 1e-12) return 3;
    if (h > c->longest) return 2;
    c->x += h * c->gain * (c->u + 0.5 * h * c->du); c->t = t + h; c->count++;
    if (c->on) { c->pending = 2; return 5; } return 0; }
"""
    + values("fmi1", "Get", "Real", "double", {1: "c->x", 2: "c->u", 3: "c->gain", 7: "c->longest"})
    + values("fmi1", "Set", "Real", "double", {2: "c->u", 3: "if (c->ready) return 3; c->gain", 7: "c->longest"})
    + values("fmi1", "Get", "Integer", "int", {4: "c->count"})
    + values("fmi1", "Get", "Boolean", "char", {5: "c->on", 8: "c->on"})
    + values("fmi1", "Set", "Boolean", "char", {5: "c->on"})
)
MODEL = """<ModelVariables>
<ScalarVariable name="x" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="gain" valueReference="3" variability="parameter"><Real start="1" max="9"/></ScalarVariable>
<ScalarVariable name="count" valueReference="4" causality="output" variability="discrete"><Integer/></ScalarVariable>
<ScalarVariable name="on" valueReference="5" causality="input" variability="discrete"><Boolean start="false"/></ScalarVariable>
<ScalarVariable name="shown" valueReference="8" causality="output" variability="discrete"><Boolean/></ScalarVariable>
<ScalarVariable name="label" valueReference="6" variability="parameter"><String start=""/></ScalarVariable>
<ScalarVariable name="longest" valueReference="7" variability="parameter"><Real start="10"/></ScalarVariable>
</ModelVariables><Implementation><CoSimulation_StandAlone><Capabilities canHandleVariableCommunicationStepSize="true"
 canInterpolateInputs="true" canHandleEvents="true"/></CoSimulation_StandAlone></Implementation>"""


class Window(Block):
    """1 while the count is 1 or 2, else 0."""

    u, y = Input(), Output()

    def output(self, t, x, u):
        return np.where(np.abs(u.u - 1.5) < 1.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return small_fmu(tmp_path_factory.mktemp("fmi1"), "fmi1", SOURCE, MODEL)


@pytest.mark.parametrize("isolate", [False, Isolation(step_time=0.2)])
def test_a_step_that_stays_pending_is_an_error(tmp_path, monkeypatch, isolate):
    monkeypatch.setattr("loopwright.fmus.calls.fmi_calls.FmiCalls.patience", 0.2)
    never = SOURCE.replace("*v = c->pending-- > 0 ? 5 : 0", "*v = 5")
    plant = Fmu(small_fmu(tmp_path, "fmi1", never, MODEL), name="plant", isolate=isolate)
    made = Diagram("d", plant(u=Constant(value=2.0), on=Constant(value=1.0)))
    with pytest.raises(
        FmuRuntimeError, match=r"^plant, t = 0 s: the step .* was still pending after 0\.2 s: it failed"
    ):
        made.simulate(0.5, step=0.1, progress=False)


@pytest.mark.parametrize("isolate", [False, True])
def test_it_runs_with_its_parameters_types_and_texts(file, isolate):
    plant = Fmu(file, name="plant", start={"gain": 3.0, "label": "a text"}, isolate=isolate)
    assert [*plant.inputs, *plant.outputs] == ["u", "on", "x", "count", "shown"]
    run = Diagram("d", plant(u=Constant(value=2.0), on=Constant(value=1.0))).simulate(0.5, step=0.1, progress=False)
    assert run["plant.x"] == pytest.approx(6.0 * run.t, abs=1e-14)  # each step was pending for a while
    assert run["plant.count"].tolist() == [0, 1, 2, 3, 4, 5]
    assert run["plant.shown"][-1] == 1.0
    assert [m for m in run.messages if m.endswith("warning: 50% of all, 2.5")]


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(1)
def test_its_booleans_and_new_steps_are_those_of_both_tiers(file, isolate):
    """``on`` is put out a step after it has changed; it refuses steps that are told to be a repetition."""
    plant, window = Fmu(file, name="plant", isolate=isolate), Window(name="window")

    @subsystem(sample_time=0.1)
    def controller(count):
        return window(count)

    made = Diagram("d", plant(u=Constant(value=2.0), on=controller(plant["count"])))
    one, two = (made.simulate(0.6, compile=c, progress=False) for c in (False, True))
    assert (one.tier, two.tier) == ("interpreted", "compiled")
    assert one.data.tobytes() == two.data.tobytes()
    assert two["plant.shown"].tolist() == [0, 0, 1, 1, 0, 0, 0]
    assert two["plant.x"] == pytest.approx(2.0 * two.t, abs=1e-14)


def test_c_calls_it_by_its_own_prototypes(cache, tmp_path):
    """References and numbers of elements alone, and newStep: the FMU refuses a step that is told to be a repetition."""
    real = MODEL.replace('name="count" valueReference="4" causality="output"', 'name="count" valueReference="4"')
    for name in ("on", "shown"):
        real = "\n".join(line for line in real.splitlines() if f'name="{name}"' not in line)
    file = small_fmu(tmp_path, "fmi1", SOURCE, real, name="real")
    made = Diagram("d", Fmu(file, name="plant", isolate=False)(u=Sine(amplitude=1.0, frequency=1.0)))
    one, two = (made.simulate(1.0, step=0.01, compile=c, progress=False) for c in (False, True))
    assert (one.tier, two.tier) == ("interpreted", "compiled")
    assert one.data.tobytes() == two.data.tobytes()
    held = 0.01 * np.sin(2.0 * np.pi * 0.01 * np.arange(100))
    assert two["plant.x"] == pytest.approx(np.concatenate([[0.0], np.cumsum(held)]), abs=1e-12)


def test_it_has_the_linear_model_of_a_step(file):
    step = Fmu(file, name="plant", start={"gain": 3.0}, isolate=False).step_difference(0.1, inputs={"u": 1.0})
    assert step.D[0, 0] == pytest.approx(0.3, rel=1e-9)


def test_slopes_of_inputs_and_retries_work_as_in_later_versions(file):
    options = StepOptions(input_derivatives=True)
    plant = Fmu(file, name="plant", start={"longest": 0.03}, stepping=options, isolate=False)
    wave = Sine(amplitude=1.0, frequency=1.0)
    run = Diagram("d", plant(u=wave, on=Constant(value=0.0))).simulate(0.25, step=0.05, progress=False)
    assert run["plant.count"][-1] == 10.0  # in halves
    held = Diagram("d", plant.replace(stepping=StepOptions())(u=wave, on=Constant(value=0.0)))
    true = 1.0 / (2.0 * np.pi)
    assert abs(run["plant.x"][-1] - true) < 0.6 * abs(
        held.simulate(0.25, step=0.05, progress=False)["plant.x"][-1] - true
    )


def test_its_failures_are_told(file):
    plant = Fmu(file, name="plant", start={"gain": -1.0}, isolate=False)
    diagram = Diagram("d", plant(u=Constant(value=2.0), on=Constant(value=0.0)))
    with pytest.raises(
        FmuRuntimeError, match=r"plant, t = 0 s: initialization failed \(fmi1InitializeSlave failed with"
    ):
        diagram.simulate(0.5, step=0.1, progress=False)
    with pytest.raises(ValueError, match="found 10"):
        Fmu(file, start={"gain": 10.0})


NEGATED = MODEL.replace('name="x" valueReference="1"', 'name="x" valueReference="1" alias="noAlias"').replace(
    "</ModelVariables>",
    """<ScalarVariable name="fall" valueReference="1" causality="output" alias="negatedAlias"><Real/></ScalarVariable>
<ScalarVariable name="pull" valueReference="2" causality="input" alias="negatedAlias"><Real start="0"/></ScalarVariable>
<ScalarVariable name="loss" valueReference="3" variability="parameter" alias="negatedAlias"><Real start="-1"/></ScalarVariable>
<ScalarVariable name="again" valueReference="1" causality="output" alias="alias"><Real/></ScalarVariable></ModelVariables>""",
)


def test_negated_aliases_are_left_out_and_told(cache, tmp_path):
    made = small_fmu(tmp_path, "fmi1", SOURCE, NEGATED)
    plant = Fmu(made, name="plant", start={"gain": 3.0}, isolate=False)
    assert [*plant.inputs, *plant.outputs] == ["u", "on", "x", "count", "shown", "again"]
    assert {"fall", "pull", "loss"} <= {*plant.left_out}
    run = Diagram("d", plant(u=Constant(value=2.0), on=Constant(value=0.0))).simulate(0.5, step=0.1, progress=False)
    for port in ("x", "again"):
        assert run[f"plant.{port}"] == pytest.approx(6.0 * run.t, abs=1e-14)
    (told,) = [m for m in run.messages if "negated alias" in m]
    assert "'fall' (of 'x'), 'pull' (of 'u'), 'loss' (of 'gain')" in told
    (finding,) = [a for a in doctor(made, run=False).findings if a.fault == FmuFault.NEGATED]
    assert finding.subject == "fall"


def test_asking_for_a_negated_alias_is_an_error(cache, tmp_path):
    made = small_fmu(tmp_path, "fmi1", SOURCE, NEGATED)
    plant, text = Fmu(made, name="plant"), "negated alias of FMI 1.0: it has the value of '{}' with the opposite sign"
    with pytest.raises(ParameterError, match=text.format("gain")):
        Fmu(made, start={"loss": -3.0})
    with pytest.raises(ParameterError, match=text.format("x")):
        Fmu(made, ports=["u", "fall"])
    with pytest.raises(UnknownNameError, match=text.format("x")):
        plant["fall"]
    with pytest.raises(UnknownNameError, match=text.format("u")):
        plant(pull=Constant(value=1.0), on=Constant(value=0.0))

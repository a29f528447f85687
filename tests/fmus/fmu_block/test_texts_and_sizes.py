"""Texts and binary data at the start and in the record, arrays whose sizes are chosen, and clocks."""

import pickle

import numpy as np
import pytest

from loopwright.blocks import Constant, OptionError, ParameterError, UnknownNameError
from loopwright.diagrams import Diagram, Run
from loopwright.fmus import Fmu, read_description
from loopwright.fmus.calls.text_values import list_limits
from support.small_fmus import small_fmu

SOURCE = """
typedef struct { double t; char label[64]; char names[2][32]; uint8_t blob[8]; size_t length; uint64_t n; double u[50];
                 int configuring, sized; char mode[80]; } instance;
int fmi3EnterConfigurationMode(void *p) { ((instance *)p)->configuring = 1; return 0; }
int fmi3ExitConfigurationMode(void *p) { ((instance *)p)->configuring = 0; return 0; }
int fmi3EnterInitializationMode(void *p) { instance *c = p; if (!c->n) c->n = 2; return 0; }
int fmi3SetUInt64(void *p, const unsigned vr[], size_t k, const uint64_t v[], size_t nv) {
    instance *c = p; if (!c->configuring) return 3; c->n = v[0]; return 0; }
int fmi3GetUInt64(void *p, const unsigned vr[], size_t k, uint64_t v[], size_t nv) { v[0] = ((instance *)p)->n; return 0; }
int fmi3SetFloat64(void *p, const unsigned vr[], size_t k, const double v[], size_t nv) {
    instance *c = p; if (nv != c->n) return 3; memcpy(c->u, v, nv * sizeof(double)); return 0; }
int fmi3GetFloat64(void *p, const unsigned vr[], size_t k, double v[], size_t nv) {
    instance *c = p; size_t at = 0;
    for (size_t i = 0; i < k; i++) {
        if (vr[i] == 7) { v[at] = 0; for (size_t j = 0; j < c->n; j++) v[at] += c->u[j]; at++; }
        else for (size_t j = 0; j < c->n; j++) v[at++] = (vr[i] == 6 ? 2 : 1) * c->u[j];
    }
    return at == nv ? 0 : 3; }
int fmi3SetString(void *p, const unsigned vr[], size_t k, const char *v[], size_t nv) {
    instance *c = p; size_t at = 0;
    for (size_t i = 0; i < k; i++) {
        if (vr[i] == 1) strncpy(c->label, v[at++], 63);
        else { strncpy(c->names[0], v[at++], 31); strncpy(c->names[1], v[at++], 31); }
    }
    return 0; }
int fmi3GetString(void *p, const unsigned vr[], size_t k, const char *v[], size_t nv) {
    instance *c = p; size_t at = 0;
    for (size_t i = 0; i < k; i++) {
        if (vr[i] == 1) v[at++] = c->label;
        else if (vr[i] == 2) { v[at++] = c->names[0]; v[at++] = c->names[1]; }
        else { snprintf(c->mode, 80, "%s \\xc3\\xbc %d", c->label, c->t > 0.25); v[at++] = c->mode; }
    }
    return 0; }
int fmi3SetBinary(void *p, const unsigned vr[], size_t k, const size_t s[], const uint8_t *v[], size_t nv) {
    instance *c = p; c->length = s[0] < 8 ? s[0] : 8; memcpy(c->blob, v[0], c->length); return 0; }
int fmi3GetBinary(void *p, const unsigned vr[], size_t k, size_t s[], const uint8_t *v[], size_t nv) {
    instance *c = p; for (size_t i = 0; i < k; i++) { s[i] = c->length; v[i] = c->blob; } return 0; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; c->t = t + h; *e = *stop = *early = false; *last = t + h; return 0; }
"""
DESCRIPTION = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>
<String name="label" valueReference="1" causality="parameter" variability="fixed"><Start value="a"/></String>
<String name="names" valueReference="2" causality="parameter" variability="fixed"><Dimension start="2"/>
  <Start value="p"/><Start value="q"/></String>
<Binary name="key" valueReference="3" causality="parameter" variability="fixed"><Start value="00"/></Binary>
<UInt64 name="n" valueReference="4" causality="structuralParameter" variability="fixed" start="2" max="50"/>
<Float64 name="u" valueReference="5" causality="input" start="0 0"><Dimension valueReference="4"/></Float64>
<Float64 name="y" valueReference="6" causality="output"><Dimension valueReference="4"/></Float64>
<Float64 name="total" valueReference="7" causality="output"/>
<String name="mode" valueReference="8" causality="output"/>
<Binary name="copy" valueReference="9" causality="output"/>
<Clock name="beat" valueReference="10" causality="input" intervalVariability="constant" intervalDecimal="0.1"/>
<Clock name="alarm" valueReference="11" causality="output" intervalVariability="triggered"/>
</ModelVariables><ModelStructure><Output valueReference="6"/><Output valueReference="7"/><Output valueReference="8"/>
<Output valueReference="9"/></ModelStructure>"""


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return small_fmu(tmp_path_factory.mktemp("texts"), "fmi3", SOURCE, DESCRIPTION)


def test_a_periodic_clock_in_model_exchange_is_told(file):
    told = list_limits("p", read_description(file), model_exchange=True)
    assert any(
        "the clocks beat (constant Clock) never tick: input clocks are driven in co-simulation" in m for m in told
    )


def run_of(plant, duration=0.5, **options):
    u = np.arange(1.0, 1.0 + plant.inputs["u"].shape[0])
    return Diagram("d", plant(u=Constant(value=u))).simulate(duration, step=0.1, progress=False, **options)


def test_texts_and_binaries_are_set_and_recorded_with_the_times_at_which_they_change(file):
    plant = Fmu(file, name="plant", start={"label": "Grüße", "key": b"\x00\x01\xff"})
    run = run_of(plant)
    mode = run.texts["plant.mode"]
    assert mode.values == ("Grüße ü 0", "Grüße ü 1")
    assert mode.t == pytest.approx((0.0, 0.3))
    assert (mode.at(0.29), mode.at(0.3), mode.at(9.0)) == ("Grüße ü 0", "Grüße ü 1", "Grüße ü 1")
    assert run.texts["plant.copy"].values == (b"\x00\x01\xff",)
    with pytest.raises(OptionError, match=r"found t = -1 s; the record begins at 0 s"):
        mode.at(-1.0)


def test_recorded_texts_are_stored_with_the_run(file, tmp_path):
    plant = Fmu(file, name="plant", start={"key": b"\x07"})
    run = run_of(plant)
    run.save(tmp_path / "saved")
    streamed = run_of(plant, to=tmp_path / "streamed")
    assert run.texts == Run.open(tmp_path / "saved").texts == streamed.texts == Run.open(tmp_path / "streamed").texts


def test_a_run_that_goes_on_has_the_texts_of_each_part(file):
    plant = Fmu(file, name="plant")
    with Diagram("d", plant(u=Constant(value=np.ones(2)))).simulation(step=0.1) as simulation:
        simulation.advance(0.2)
        first = simulation.run().texts["plant.mode"]
        simulation.advance(0.2)
        second = simulation.run().texts["plant.mode"]
    assert first.values == (" ü 0",)
    assert len(second.values) == 2
    assert second.t[1] == pytest.approx(0.3)


def test_arrays_of_texts_are_set_as_a_list(file):
    plant = Fmu(file, name="plant", start={"names": ["left", "right"]}, ports=["u", "total", "mode"])
    assert plant.start["names"] == ("left", "right")
    assert [*run_of(plant).texts] == ["plant.mode"]
    assert pickle.loads(pickle.dumps(plant)) == plant
    assert Fmu(file, rename={"mode": "state"}, ports=["u", "total", "mode"]).text_variables.keys() == {"state"}


@pytest.mark.parametrize(
    ("name", "value", "error", "text"),
    [
        (
            "names",
            ["one"],
            ParameterError,
            r"found \('one',\); expected a text for each of 2 elements, of shape \(2,\)",
        ),
        ("names", "ab", ParameterError, "found 'ab'; expected a text for each of 2 elements"),
        ("key", "text", ParameterError, "found 'text' for a variable of type Binary; expected bytes. Give a bytes"),
        ("label", b"x", ParameterError, "found b'x' for a variable of type String; expected a text. Give a str"),
        ("mode", "x", ParameterError, "found an output of type String, which the FMU computes"),
        ("beat", 1, ParameterError, "found 1 for a constant clock, which ticks in a run alone"),
        ("n", 51, ParameterError, "found 51; the FMU allows at most 50"),
        ("n", 2.5, ParameterError, "found 2.5; expected an integer, as it is of type UInt64"),
        ("lable", "x", UnknownNameError, "the FMU has no variable 'lable'.*label"),
    ],
)
def test_wrong_texts_and_sizes_are_refused(file, name, value, error, text):
    with pytest.raises(error, match=text):
        Fmu(file, name="plant", start={name: value})


@pytest.mark.parametrize("n", [1, 2, 5, 50])
def test_a_structural_parameter_changes_the_ports(file, n):
    plant = Fmu(file, name="plant", start={"n": n})
    assert plant.inputs["u"].shape == plant.outputs["y"].shape == (n,)
    run = run_of(plant)
    assert run["plant.y"][-1].tolist() == [2.0 * (k + 1) for k in range(n)]
    assert run["plant.total"][-1] == n * (n + 1) / 2
    resized = plant.replace(start={"n": 3})
    assert resized.inputs["u"].shape == (3,)
    assert pickle.loads(pickle.dumps(resized)) == resized


def test_start_values_have_the_chosen_size(file):
    plant = Fmu(file, name="plant", start={"n": 3, "u": (1.0, 2.0, 4.0)})
    assert Diagram("d", plant()).simulate(0.1, step=0.1, progress=False)["plant.total"][-1] == 7.0
    with pytest.raises(
        ParameterError, match=r"plant\.start\.u: found \(1\.0, 2\.0\); expected numbers of shape \(3,\)"
    ):
        Fmu(file, name="plant", start={"n": 3, "u": (1.0, 2.0)})


def test_linear_models_of_a_step_have_the_chosen_size(file):
    plant = Fmu(file, name="plant", start={"n": 3})
    D = plant.step_difference(0.1, inputs={"u": np.ones(3)}).D
    assert pytest.approx(np.vstack([2.0 * np.eye(3), np.ones((1, 3))]), abs=1e-9) == D


def test_clocks_are_described(file):
    plant = Fmu(file, name="plant")
    assert "without ports for label (String), names (String)" in repr(plant)
    other = plant.description.other
    assert (str(other["beat"]), str(other["alarm"])) == ("beat (constant Clock)", "alarm (triggered Clock)")
    assert (other["beat"].interval, other["beat"].is_periodic, other["alarm"].is_periodic) == (0.1, True, False)

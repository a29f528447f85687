"""Differences of steps and identification go back to their point: an FMU that does not restore its state is started anew.

The FMU is y' = u − y over a step with u held: y⁺ = e⁻ʰ y + (1 − e⁻ʰ) u, with an output 2 u that follows at once.
"""

import numpy as np
import pytest

from loopwright.diagrams.linearization.identification import identify_step
from loopwright.fmus import Fmu
from support.small_fmus import small_fmu, values

H = 0.25
SOURCE = (
    r"""
typedef struct { double t, u, y; int id; } instance;
static int made;
void *fmi2Instantiate() { instance *c = calloc(1, sizeof(instance)); c->id = ++made; return c; }
int fmi2Reset(void *p) { instance *c = p; c->u = c->y = 0; return 0; }
int fmi2DoStep(void *p, double t, double h, int no) {
    instance *c = p; c->y = c->u + (c->y - c->u) * exp(-h); c->t = t + h; return 0; }
int fmi2GetFMUstate(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance));
    return 0; }
int fmi2FreeFMUstate(void *p, void **s) { free(*s); *s = 0; return 0; }
int fmi2SetFMUstate(void *p, void *s) { instance *c = p, *o = s; if (o->id != c->id) return 3; RESTORE return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {0: "c->u", 1: "c->y", 2: "2.0 * c->u", 3: "c->u - c->y"})
    + values("fmi2", "Set", "Real", "double", {0: "c->u", 1: "c->y"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"
canGetAndSetFMUstate="true"/><ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input" variability="continuous"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output" variability="continuous" initial="exact"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="twice" valueReference="2" causality="output" variability="continuous"><Real/></ScalarVariable>
<ScalarVariable name="der(y)" valueReference="3"><Real derivative="2"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="2" dependencies=""/><Unknown index="3" dependencies="1"/>
</Outputs>STATES</ModelStructure>"""
LISTED = '<Derivatives><Unknown index="4"/></Derivatives>'
TENTATIVE = SOURCE.replace("double t, u, y; int id;", "double t, u, y, kept; int id, back;").replace(
    "instance *c = p; c->y = c->u +",
    "instance *c = p; if (c->back) c->y = c->kept; c->kept = c->y; c->back = !no; c->y = c->u +",
)
"""Takes a step back when the next one begins, unless it was said to be final."""
RESTORES = ["*c = *o;", "", "c->u = o->u;", "c->y = o->y;"]
NAMES = ["all", "nothing", "inputs alone", "states alone"]


@pytest.fixture(scope="module")
def make(cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("restored")

    def build(restore, listed, **options):
        model = MODEL.replace("STATES", LISTED * listed)
        return Fmu(small_fmu(folder, "fmi2", SOURCE.replace("RESTORE", restore), model), name="lag", **options)

    return build


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("restore", RESTORES, ids=NAMES)
@pytest.mark.drawn
def test_a_step_has_its_derivatives_whatever_the_fmu_restores(make, restore, isolate):
    lag = make(restore, True, isolate=isolate)
    found = lag.step_difference(H, state={"y": 0.3}, inputs={"u": 0.7})
    decay = np.exp(-H)
    np.testing.assert_allclose(found.A, [[decay]], rtol=1e-9)
    np.testing.assert_allclose(found.B, [[1.0 - decay]], rtol=1e-9)
    np.testing.assert_allclose(found.D, [[1.0 - decay], [2.0]], rtol=1e-9)
    assert found.derivation.restarted == (restore != RESTORES[0])
    assert ("from a new start, as the FMU does not restore its state" in found.how) == (restore != RESTORES[0])


@pytest.mark.parametrize("restore", RESTORES, ids=NAMES)
def test_identification_has_its_response_whatever_the_fmu_restores(make, restore):
    lag = make(restore, False, isolate=False)
    found = identify_step(lag, {"t": 0.0, "state": {}, "inputs": {"u": np.array(0.0)}}, H, samples=60)
    for k in range(5):
        y, twice = found.C @ np.linalg.matrix_power(found.A, k) @ found.B
        assert y[0] == pytest.approx((1.0 - np.exp(-H)) * np.exp(-k * H), rel=1e-8)
        assert twice[0] == pytest.approx(2.0 * (k == 0), abs=1e-8)
    assert found.derivation.restarted == (restore in RESTORES[1:3])  # it sets the inputs itself


def test_an_fmu_that_takes_back_steps_that_are_not_final_is_identified_from_new_starts(cache, tmp_path):
    """Its state was found as one of a single sample: the pulse was gone with the step behind it."""
    source = TENTATIVE.replace("RESTORE", RESTORES[0])
    assert source.count("kept") == 3
    lag = Fmu(small_fmu(tmp_path, "fmi2", source, MODEL.replace("STATES", "")), name="lag", isolate=False)
    found = identify_step(lag, {"t": 0.0, "state": {}, "inputs": {"u": np.array(0.0)}}, H, samples=60)
    assert found.derivation.restarted
    for k in range(5):
        y, _ = found.C @ np.linalg.matrix_power(found.A, k) @ found.B
        assert y[0] == pytest.approx((1.0 - np.exp(-H)) * np.exp(-k * H), rel=1e-8)

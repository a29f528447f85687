"""Trims of FMUs that list no states: some have a memory that they hide, and some have none."""

import math

import pytest

from loopwright.blocks import Constant, SimulationError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, FmuError
from support.small_fmus import small_fmu, values

SOURCE = (
    """
typedef struct { double t, u, y; } instance;
int fmi2DoStep(void *p, double t, double h, int no) { instance *c = p; c->y = STEP; c->t = t + h; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {0: "c->u", 1: "c->y"})
    + values("fmi2", "Set", "Real", "double", {0: "c->u"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input" variability="continuous"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output" variability="continuous"><Real/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>"""
LAG = "c->u + (c->y - c->u) * exp(-h)"  # y' = u − y


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    def build(step, u=1.0):
        file = small_fmu(tmp_path_factory.mktemp("hidden"), "fmi2", SOURCE.replace("STEP", step), MODEL)
        return Diagram("open", Fmu(file, name="plant")(u=Constant(value=u, name="input")))

    return build


@pytest.mark.parametrize("step", [LAG, "c->y + h * c->u"], ids=["lag", "integrator"])
def test_a_memory_that_is_not_listed_is_no_rest(cache, make, step):
    """The lag rests at y = u = 1, and the integrator nowhere; both begin at 0."""
    with pytest.raises(SimulationError, match=r"lists no states .* plant\.y over 10 steps: 0\.00\d+; .*expected at"):
        make(step).trim()


def test_with_a_tolerance_the_point_says_how_far_it_moves(cache, make):
    point = make(LAG).trim(tolerance=0.1)
    moved = (0.999000499833375 - 0.990049833749168) / (1 + 0.000999500166625)  # e^−h and e^−10h, h = 1 ms
    assert point.residual == pytest.approx(moved, rel=1e-9)
    assert (point.largest, point.unjudged) == ("plant.y over 10 steps", ("plant",))


@pytest.mark.parametrize(("step", "u", "y"), [("2.0 * c->u", 1.0, 2.0), (LAG, 0.0, 0.0)], ids=["static", "at rest"])
def test_an_fmu_that_stays_is_at_rest_and_says_that_its_states_are_not_judged(cache, make, step, u, y):
    point = make(step, u).trim()
    assert float(point.values["plant.y"]) == pytest.approx(y, abs=1e-12)
    assert point.residual == 0.0
    assert point.unjudged == ("plant",)
    assert make(step, u).operating_point(0.01, step=0.01).unjudged == ("plant",)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("step", ["c->y + h * (c->u - c->y)", "c->y"], ids=["lag", "constant"])
def test_targets_that_hidden_states_keep_away_name_them_and_a_run(cache, make, step):
    """y = 2 has a rest at u = 2 for the lag, which one step from y = 0 doesn't show: u would have to be 2000."""
    loop = make(step)
    with pytest.raises(SimulationError, match=r"The FMU lists no states .*\(plant\).*operating_point\(t\)") as e:
        loop.trim({"input.value": (0.0, 10.0)}, {"plant.y": 2.0})
    assert "widen bounds" not in str(e.value)


def test_a_target_that_a_static_fmu_misses_at_a_bound_is_answered_with_the_bounds(cache, make):
    with pytest.raises(SimulationError, match="input.value is at its bound. Free more") as e:
        make("2.0 * c->u").trim({"input.value": (0.0, 1.5)}, {"plant.y": 4.0})
    assert "lists no states" not in str(e.value)


def test_a_point_that_just_misses_rest_says_how_near_is_near_enough_and_a_later_one_does(cache, make):
    """y' = 10 (u − y) is e^(−10 t) from its rest at 1."""
    loop = make("c->u + (c->y - c->u) * exp(-10 * h)")
    said = r"plant.*found .* y = 0\.9999546, which is 4\.54e-05 from the rest at 0\.99999999\d; expected at most 1e-06\. .*later"
    with pytest.raises(FmuError, match=said):
        loop.linearize(1.0, step=0.01)
    assert loop.linearize(2.0, step=0.01).poles == pytest.approx([math.exp(-0.1)], rel=1e-6)

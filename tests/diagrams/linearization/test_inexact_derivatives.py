"""Directional derivatives of FMUs of others, which are held against differences of the FMU's own values."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PID, Constant
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization.exchanged import PointEvaluator
from loopwright.diagrams.requirements import Limit, Reason, Verdict, judge
from loopwright.fmus import Fmu, FmuError
from loopwright.fmus.fmu_block import DerivativeMethod
from loopwright.frequency import margins
from loopwright.types import InexactDerivatives, RefutedDerivatives
from support.misstated import A, B, misstated_fmu

WAYS = ("model_exchange", "co_simulation")
POINT = {"x": 0.3, "v": 0.2}
DT = 0.01


@pytest.fixture(scope="module", params=[2, 3])
def file(request, tmp_path_factory):
    return misstated_fmu(tmp_path_factory.mktemp(f"misstated{request.param}"), request.param)


@pytest.fixture(scope="module")
def file3(tmp_path_factory):
    return misstated_fmu(tmp_path_factory.mktemp("misstated"), 3)


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.drawn(1)
def test_the_uncertainty_is_the_error_of_the_derivatives(file, interface):
    whole = np.block([[A, B], [np.eye(2), np.zeros((2, 1))], [A[1:], B[1:]]])
    for e in (0.0, 5e-9, 1e-7, 1e-5):
        model = Fmu(file, start={"e": e}).linear_model(state=POINT, interface=interface, exact=True)
        found = np.block([[model.A, model.B], [model.C, model.D]])
        error = np.abs(found - whole).max()
        assert error == pytest.approx(100.0 * e, rel=1e-6, abs=1e-13)
        assert np.all(np.abs(found - whole) <= 1.5 * model.uncertainty + 1e-13)
        assert model.uncertainty.max() <= 1.5 * error
        assert model.derivation.is_exact == (e == 0.0)
        assert model.derivation.gap == pytest.approx(e, rel=0.5)


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.parametrize("e", [0.01, -1.0, -2.0])
@pytest.mark.drawn(4)
def test_derivatives_that_are_plainly_wrong_are_replaced_by_differences(file, interface, e):
    model = Fmu(file, start={"e": e}).linear_model(state=POINT, interface=interface)
    np.testing.assert_allclose(model.A, A, atol=1e-7)
    np.testing.assert_allclose(model.B, B, atol=1e-7)
    assert np.all(np.abs(model.A - A) <= model.uncertainty[:2, :2])
    assert model.derivation.refuted
    assert model.derivation.gap == pytest.approx(abs(e) / max(1.0, abs(1.0 + e)), rel=0.02)
    assert not model.derivation.is_exact


def sampled(file, interface, **start):
    """Return a loop around it: a PI law of the speed at DT. The integral of the speed is hidden in the loop."""
    plant = Fmu(file, interface=interface, name="plant", start=start)

    @subsystem(sample_time=DT)
    def controller(v):
        return PID(kp=4.0, ki=20.0)(0.0, v)

    return Diagram("loop", plant(u=controller(plant.v).named("u")))


def held():
    return expm(np.block([[A, B], [np.zeros((1, 3))]]) * DT)[:2]


@pytest.mark.slow
def test_a_model_along_a_motion_is_as_exact_as_the_derivatives_and_takes_no_more_of_them(file3, monkeypatch):
    calls, differentiate = [], PointEvaluator.differentiate
    monkeypatch.setattr(PointEvaluator, "differentiate", lambda *a: (calls.append(a[2]), differentiate(*a))[1])
    for e in (5e-9, 1e-6):
        diagram = sampled(file3, "model_exchange", e=e, rough=1.0)
        point = diagram.operating_point(0.0, states={f"plant.{name}": value for name, value in POINT.items()})
        calls.clear()
        linear = diagram.linearize(point, inputs="u", outputs="plant.v")
        assert len(calls) < 400  # with tolerances below the noise they were 20,000
        own = [linear.states.index(f"plant.{name}") for name in "xv"]
        exact = held()
        error = np.abs(linear.B[own] - exact[:, 2:]).max()
        assert 0.0 < error <= linear.uncertainty * DT
        assert 10.0 * e < linear.uncertainty < 200.0 * e
        (finding,) = linear.findings
        assert isinstance(finding, InexactDerivatives)
        assert (finding.block, finding.gap) == ("plant", linear.derivations["plant"].gap)
        assert 0.1 * e < finding.gap < 2.0 * e


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.slow
def test_margins_of_a_loop_with_a_hidden_integrator_are_those_of_exact_derivatives(file3, interface):
    exact = margins(sampled(file3, interface).linearize().loop("u"))
    assert exact.findings == ()
    rough = margins(sampled(file3, interface, e=5e-9, rough=1.0).linearize().loop("u"))
    assert [type(f) for f in rough.findings] == [InexactDerivatives]
    for name in ("phase_margin_deg", "ms", "gain_margin_high"):
        one, two = getattr(exact, name), getattr(rough, name)
        assert abs(one.value - two.value) <= two.tolerance
        assert one.tolerance < two.tolerance < 1e-4 * one.value


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.slow
def test_a_diagram_says_that_derivatives_are_wrong_and_does_not_use_them(file3, interface):
    wrong, right = (sampled(file3, interface, e=e).linearize() for e in (-2.0, 0.0))
    np.testing.assert_allclose(wrong.A, right.A, atol=1e-8)
    (finding,) = wrong.findings
    assert isinstance(finding, RefutedDerivatives)
    assert finding.gap == pytest.approx(2.0, rel=1e-3)
    assert wrong.uncertainty < 1e-5


def test_a_trim_and_a_stiff_run_do_not_depend_on_wrong_derivatives(file3):
    plant = Fmu(file3, interface="model_exchange", name="plant", start={"e": -2.0})
    diagram = Diagram("pushed", plant(u=Constant(value=3.0, name="force")))
    point = diagram.trim(free=["force.value"], targets={"plant.x": 0.5})
    assert point.parameters["force.value"] == pytest.approx(50.0, rel=1e-9)


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.slow
def test_local_variables_as_ports_have_slopes_though_the_fmu_may_not_be_asked_for_them(tmp_path, fmi, interface):
    file = misstated_fmu(tmp_path, fmi, hides_state=True)
    plant = Fmu(file, interface=interface, ports=["u", "v", "x", "w"], name="plant")
    model = plant.linear_model(state={"x": 0.3, "v": 0.2})
    np.testing.assert_array_equal(model.A, A)
    rows = dict(zip(model.outputs, np.hstack([model.C, model.D]), strict=True))
    np.testing.assert_array_equal(rows["x"], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(rows["w"], [3.0, 0.0, 0.0], atol=1e-8)
    assert 0.0 < model.uncertainty.max() < 1e-7

    @subsystem(sample_time=DT)
    def controller(y):
        return PID(kp=4.0, ki=20.0)(0.0, y)

    diagram = Diagram("loop", plant(u=controller(plant["x"]).named("u")))  # a state does not feed through
    linear = diagram.linearize(inputs="u", outputs=["plant.x", "plant.w"])  # it moves: it starts at x = 0.1
    assert not linear.is_equilibrium
    own = [linear.states.index(f"plant.{name}") for name in "xv"]
    exact = held()
    kp = np.array([[0.0, 0.0], [0.0, 0.0]]) - 4.0 * exact[:, 2:] @ [[1.0, 0.0]]
    np.testing.assert_allclose(linear.A[np.ix_(own, own)], exact[:, :2] + kp, atol=1e-8)
    assert linear.uncertainty < 1e-6
    if interface == "model_exchange":  # differences of what it may not be asked for, of nothing else
        assert linear.derivations["plant"].method is DerivativeMethod.DIRECTIONAL


@pytest.mark.parametrize("e", [0.0, 5e-9, -2.0])
def test_a_diagram_has_the_slopes_of_its_fmu_by_itself(file3, e):
    """The same method, and the same bits: both ask one place."""
    plant = Fmu(file3, interface="model_exchange", name="plant", start={"e": e, **POINT})
    model = plant.linear_model(inputs={"u": 3.0})
    linear = Diagram("pushed", plant(u=Constant(value=3.0, name="force"))).linearize(0.0, inputs="force.y")
    assert linear.states == ("plant.x", "plant.v")
    np.testing.assert_array_equal(linear.A, model.A)
    np.testing.assert_array_equal(linear.B, model.B)
    assert linear.uncertainty == np.max(model.uncertainty[:2])
    assert linear.derivations["plant"] == model.derivation
    np.testing.assert_allclose(model.A, A, rtol=0.0, atol=2e-6)


def test_a_run_begins_at_the_start_itself_though_no_state_can_be_set_there(tmp_path):
    plant = Fmu(misstated_fmu(tmp_path, 3, hides_state=True), interface="co_simulation", ports=["u", "x"], name="plant")
    diagram = Diagram("pushed", plant(u=Constant(value=3.0, name="force")))
    start, later = diagram.operating_point(0.0, step=0.01), diagram.operating_point(0.5, step=0.01)
    run = diagram.simulate(0.5, step=0.01, start=start, progress=False)
    exact = [0.03 + (expm(A * t) @ [0.07, 0.0])[0] for t in run.t]
    np.testing.assert_allclose(run["plant.x"], exact, atol=1e-8)
    with pytest.raises(FmuError, match="can't be set at the FMU's start"):
        diagram.simulate(0.5, step=0.01, start=later, progress=False)


def test_a_coarse_solver_of_an_fmu_is_part_of_the_model_of_its_steps(tmp_path):
    """A step of Euler's method is I + h A, no matrix exponential: 0.5 % of the plant's motion here."""
    loop = "for (int i = 0; i < 100; i++) {"
    euler = "double k = 100 * h; if (1) { double v = c->v; c->v += k * rate(c, c->x, v); c->x += k * v; } else " + loop
    for changes, step in ((((loop, euler),), np.hstack([np.eye(2) + DT * A, DT * B])), ((), held())):
        linear = sampled(misstated_fmu(tmp_path, 3, changes), "co_simulation").linearize(inputs="u")
        own = [linear.states.index(f"plant.{name}") for name in "xv"]
        np.testing.assert_allclose(linear.B[own], step[:, 2:], atol=1e-9)
        assert np.abs(linear.B[own] - step[:, 2:]).max() <= linear.uncertainty + 1e-12
        assert linear.derivations["plant"].held == (not changes)


ROUGH = (("return -100.0 * x - v + c->u; }", "return single(single(101325.0 - 100.0 * x) - 101325.0) - v + c->u; }"),)
"""Its force is rounded to steps of 0.008: differences are no evidence."""


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.slow
def test_numbers_that_rest_on_derivatives_of_unknown_error_have_an_unknown_tolerance(tmp_path, interface):
    single = "static double single(double v) { volatile float s = (float)v; return s; }\nstatic double rate("
    file = misstated_fmu(tmp_path, 3, (*ROUGH, ("static double rate(", single)))
    model = Fmu(file).linear_model(state={"x": 1e-5, "v": 0.2}, interface=interface)
    np.testing.assert_array_equal(model.A, A)
    assert np.isnan(model.derivation.gap)
    assert np.isnan(model.uncertainty[1, 0])
    assert not model.uncertainty[0].any()
    linear = sampled(file, interface).linearize()
    assert np.isnan(linear.uncertainty)
    (finding,) = linear.findings
    assert isinstance(finding, InexactDerivatives)
    assert finding.leaves_error_unknown
    loop = linear.loop("u")
    assert np.isnan(loop.inexactness)
    found, exact = margins(loop), margins(sampled(misstated_fmu(tmp_path, 3), interface).linearize().loop("u"))
    for name in ("phase_margin_deg", "ms", "gain_margin_high"):
        number = getattr(found, name)
        assert np.isnan(number.tolerance)
        assert number.value == pytest.approx(getattr(exact, name).value, rel=1e-6)
        assert number.as_dict()["findings"][0]["kind"] == "InexactDerivatives"
        verdict, reason, _ = judge(number, Limit(0.0, np.inf))
        assert (verdict, reason) == (Verdict.UNDECIDED, Reason.FINDINGS)

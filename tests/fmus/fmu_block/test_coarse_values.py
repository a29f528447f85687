"""Linear models of FMUs without directional derivatives, whose values may be coarse: against closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from loopwright.fmus.fmu_block.difference_quotients import find_slopes
from loopwright.types import CoarseValues
from support.closed_form import closed_form_fmu

WAYS = ("model_exchange", "co_simulation")
X, U = 0.7, 0.3
FIRST = "dx[0] = -x[0] + u[0]; "
CASES = {  # equations, states, inputs, [[A, B], [C, D]], and whether it can say to 0.1 % what it is
    "linear": ("dx[0] = -3*x[0] + 2*u[0]; y[0] = 4*x[0] + 5*u[0];", [X], [U], [[-3, 2], [4, 5]], True),
    "pendulum": (
        "dx[0] = x[1]; dx[1] = -9.81*sin(x[0]) - 0.3*x[1] + u[0]; y[0] = cos(x[0]);",
        [0.4, -0.2],
        [0.1],
        [[0, 1, 0], [-9.81 * np.cos(0.4), -0.3, 1], [-np.sin(0.4), 0, 0]],
        True,
    ),
    "single precision next to an offset": (
        "dx[0] = single(single(single(101325.0 + x[0]) - 101325.0) * -3.0) + u[0]; y[0] = x[0];",
        [X],
        [U],
        [[-3, 1], [1, 0]],
        False,
    ),
    "single precision in a part": (
        "dx[0] = single(101325.0 + x[0]) - 101325.0 - 0.001*x[0] + u[0]; y[0] = x[0];",
        [X],
        [U],
        [[0.999, 1], [1, 0]],
        False,
    ),
    "single precision of an input": (
        "dx[0] = -x[0] + single(2000.0 + u[0]) - 2000.0; y[0] = u[0];",
        [X],
        [U],
        [[-1, 1], [0, 1]],
        False,
    ),
    "converter": (FIRST + "y[0] = floor(x[0]*409.6) / 409.6;", [X], [U], [[-1, 1], [1, 0]], False),
    "converter, decimal": (FIRST + "y[0] = floor(x[0]*4095/3.3) * (3.3/4095);", [X], [U], [[-1, 1], [1, 0]], False),
    "fine converter": (FIRST + "y[0] = floor(x[0]*1e6) / 1e6;", [X], [U], [[-1, 1], [1, 0]], True),
    "dead zone": (
        FIRST + "y[0] = fabs(x[0]) < 0.05 ? 0.0 : x[0] - copysign(0.05, x[0]);",
        [0.0],
        [U],
        [[-1, 1], [0, 0]],
        True,
    ),
    "saturation": (
        "dx[0] = -x[0] + fmin(fmax(u[0], -1), 1); y[0] = fmin(x[0], 0.5);",
        [X],
        [2.0],
        [[-1, 0], [0, 0]],
        True,
    ),
    "end stop": (
        "dx[0] = x[1]; dx[1] = u[0] - (x[0] > 0.52 ? 1e6*(x[0] - 0.52) : 0.0); y[0] = x[0];",
        [0.5, 0.1],
        [U],
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        True,
    ),
    "at the end stop": (
        "dx[0] = x[1]; dx[1] = u[0] - (x[0] > 0.52 ? 1e6*(x[0] - 0.52) : 0.0); y[0] = x[0];",
        [0.521, 0.1],
        [U],
        [[0, 1, 0], [-1e6, 0, 1], [1, 0, 0]],
        True,
    ),
    "Coulomb friction": (
        "dx[0] = -tanh(x[0]/1e-3) + u[0]; y[0] = x[0];",
        [0.08],
        [U],
        [[0, 1], [1, 0]],
        True,
    ),
    "relay": (FIRST + "y[0] = x[0] > 0.65 ? 1.0 : -1.0;", [X], [U], [[-1, 1], [0, 0]], True),
    "next to a kink": (FIRST + "y[0] = fabs(x[0] - 0.70002);", [X], [U], [[-1, 1], [-1, 0]], True),
    "offset of an input": (
        "dx[0] = -x[0] + 1e-3*(u[0] - 101325.0); y[0] = u[0];",
        [X],
        [101325.3],
        [[-1, 1e-3], [0, 1]],
        True,
    ),
    "offset of an output": (FIRST + "y[0] = 1e9 + x[0];", [X], [U], [[-1, 1], [1, 0]], True),
    "offset of a state": (
        "dx[0] = -0.1*(x[0] - 101325.0) + u[0]; y[0] = x[0]*x[0];",
        [101325.0],
        [U],
        [[-0.1, 1], [202650, 0]],
        True,
    ),
    "cancellation": ("dx[0] = (x[0] + 1e8) - 1e8 - 2*x[0] + u[0]; y[0] = x[0];", [X], [U], [[-1, 1], [1, 0]], True),
    "whole numbers": (FIRST + "y[0] = floor(10*x[0]);", [0.75], [U], [[-1, 1], [0, 0]], False),
    "narrow bump": (
        "dx[0] = -x[0] + exp(-1e4*x[0]*x[0]) + u[0]; y[0] = x[0];",
        [0.0],
        [U],
        [[-1, 1], [1, 0]],
        True,
    ),
    "stiff": (
        "dx[0] = x[1]; dx[1] = -1e8*x[0] - 1e3*x[1] + 1e8*u[0]; y[0] = 1e-9*x[0];",
        [0.01, 3.0],
        [0.01],
        [[0, 1, 0], [-1e8, -1e3, 1e8], [1e-9, 0, 0]],
        True,
    ),
}
FLOATS = {
    "floats": ("dx[0] = -3*x[0] + 2*u[0]; y[0] = sinf(x[0]) + 5*u[0];", [X], [U], [[-3, 2], [np.cos(X), 5]], True),
    "floats, product": (
        "dx[0] = x[1]; dx[1] = -100*x[0]*x[0] - x[1] + u[0]; y[0] = x[0]*x[1];",
        [X, 0.2],
        [U],
        [[0, 1, 0], [-140, -1, 1], [0.2, 0.7, 0]],
        True,
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("coarse")


def made(folder, name, fmi):
    """Return the FMU of a case, its point, and [[A, B], [C, D]] for two states, of which a second one may rest."""
    cases, number = (FLOATS, "float") if name in FLOATS else (CASES, "double")
    _, x, u, J, is_fine = cases[name]
    depends = {"dx1": "x1 x2 u1", "dx2": "x1 x2 u1"}
    file = closed_form_fmu(folder, fmi, [case[0] for case in cases.values()], 2, 1, number=number, dependencies=depends)
    whole = np.zeros((3, 3))
    n = len(x)
    at = [*range(n), 2]
    whole[np.ix_(at, at)] = J
    state = {"x1": x[0], "x2": x[1] if n > 1 else 0.0}
    return Fmu(file, start={"which": list(cases).index(name)}), {"state": state, "inputs": {"u1": u[0]}}, whole, is_fine


def joined(model):
    return np.block([[model.A, model.B], [model.C, model.D]])


@pytest.mark.parametrize("name", [*CASES, *FLOATS])
@pytest.mark.drawn(6)
def test_every_entry_is_right_within_its_uncertainty(folder, name):
    plant, point, J, is_fine = made(folder, name, 2 + list(CASES | FLOATS).index(name) % 2)
    for interface in WAYS:
        model = plant.linear_model(interface=interface, **point)
        error = np.abs(joined(model) - J)
        assert np.all(error <= model.uncertainty + 1e-15 * np.abs(J)), (interface, error, model.uncertainty)
        assert (model.derivation.coarseness == 0.0) == is_fine
        if is_fine:
            assert np.all(model.uncertainty <= 0.1 * np.abs(J).max())


@pytest.mark.parametrize("name", ["linear", "single precision next to an offset", "floats"])
@pytest.mark.drawn(2)
def test_a_step_of_a_coarse_fmu_is_right_within_its_uncertainty(folder, name):
    plant, point, J, _ = made(folder, name, 3)
    model = plant.step_difference(0.01, **point)
    held = expm(np.vstack([J[:2], np.zeros((1, 3))]) * 0.01)
    error = np.abs(np.hstack([model.A, model.B]) - held[:2])
    assert np.all(error <= model.uncertainty[:2] + 1e-12), (error, model.uncertainty)


@pytest.mark.parametrize("interface", WAYS)
@pytest.mark.drawn(1)
def test_a_diagram_around_coarse_values_says_so_and_its_numbers_are_as_uncertain(folder, interface):
    plant, point, *_ = made(folder, "single precision next to an offset", 3)
    plant = plant.replace(interface=interface, name="plant", start={**plant.start, **point["state"]})
    linear = Diagram("d", plant(u1=Constant(value=0.3, name="push")())).linearize(inputs="push.y", outputs="plant.y1")
    (finding,) = linear.findings
    assert isinstance(finding, CoarseValues)
    assert finding.block == "plant"
    assert 1e-3 < finding.error < 1.0
    assert abs(linear.A[0, 0] + 3.0) <= linear.uncertainty < 1.0


def single(v):
    return np.float64(np.float32(v))


STAIRS = {
    "offset": (lambda x: single(single(single(101325.0 + x) - 101325.0) * -3.0), lambda x: -3.0),
    "near offset": (lambda x: single(single(single(100.0 + x) - 100.0) * -3.0), lambda x: -3.0),
    "part": (lambda x: single(101325.0 + x) - 101325.0 - 1e-3 * x, lambda x: 0.999),
    "converter": (lambda x: np.floor(5 * x / 1e-4) * 1e-4, lambda x: 5.0),
    "quantizer": (lambda x: np.round(x / 0.03333333) * 0.03333333, lambda x: 1.0),
    "floats": (lambda x: single(np.float32(x) ** 2 * np.float32(-4.0)), lambda x: -8.0 * x),
    "smooth": (lambda x: np.sin(3 * x) + x**2, lambda x: 3 * np.cos(3 * x) + 2 * x),
    "kink": (lambda x: max(3 * x, 0.1), lambda x: 3.0 * (3 * x > 0.1)),
}


@pytest.mark.parametrize("name", list(STAIRS))
@pytest.mark.drawn(4)
def test_slopes_are_right_within_their_errors_wherever_the_point_is_on_the_stairs(name):
    function, slope = STAIRS[name]
    rng = np.random.default_rng(3)
    for k in range(40):
        x = rng.uniform(-1.0, 1.0)
        limits = (0.0, np.inf) if k % 3 == 0 else (-np.inf, np.inf)
        found = find_slopes(
            lambda d, x=x: np.atleast_1d(function(x + d)), np.atleast_1d(function(x)), 1.0, 1e-5, limits
        )
        assert abs(found.slope[0] - slope(x)) <= found.error[0]
        assert found.error[0] <= {"smooth": 1e-7, "kink": 1e-7}.get(name, 5.0)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_derivatives_that_are_computed_in_their_own_function_alone_are_not_stale(tmp_path, fmi):
    rates = (
        "instance *c = p; number d[9] = {0}, y[9] = {0}; find(c, c->x, d, y);\n    for (size_t i = 0; i < n; i++) dx"
    )
    changes = (("r[i] < 20 ? d[k]", "r[i] < 20 ? c->kept[k]"), (rates, rates.replace(" dx", " c->kept[i] = dx")))
    equations = "dx[0] = -10*x[0] + u[0]; y[0] = 10*x[0];"
    file = closed_form_fmu(
        tmp_path, fmi, equations, changes=(("int step, which;", "number kept[9]; int step, which;"), *changes)
    )
    model = Fmu(file).linear_model(state={"x1": 1.0}, interface="model_exchange")
    assert model.f == pytest.approx([-10.0])
    np.testing.assert_allclose(joined(model), [[-10.0, 1.0], [10.0, 0.0]], atol=1e-8)

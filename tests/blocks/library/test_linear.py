"""State space and transfer functions: against polynomials, matrix exponentials, python-control and closed forms."""

import pickle

import control
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import butter

from loopwright.blocks import (
    DiscreteStateSpace,
    DiscreteTransferFunction,
    ParameterError,
    SampleTimeError,
    StateSpace,
    TransferFunction,
    hold,
)
from loopwright.blocks.tracing.traced import trace
from support.stepped import Alone, response

RNG = np.random.default_rng(11)
POINTS = [0.3j, 1.0 + 2.0j, -0.7 + 0.1j, 40.0j]
WAVE = 2.0 * np.sin(0.9 * np.arange(40) + 0.3)


def matrices(n, m, p):
    A = RNG.standard_normal((n, n)) - 2.0 * np.eye(n)
    A[0, -1] = 0.0
    B, C = RNG.standard_normal((n, *m)), RNG.standard_normal((*p, n))
    return A, B, C, RNG.standard_normal((*p, *m))


# --- state space ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [StateSpace, DiscreteStateSpace])
@pytest.mark.parametrize(("m", "p"), [((), ()), ((2,), ()), ((), (3,)), ((2,), (3,)), ((1,), (1,))], ids=str)
def test_the_equations_are_the_matrices(cls, m, p):
    A, B, C, D = matrices(3, m, p)
    block = cls(A=A, B=B, C=C, D=D)
    alone = Alone(block, T=None if cls is StateSpace else 0.1)
    x, u = RNG.standard_normal(3), RNG.standard_normal(m)
    outputs, new = alone.call(0.0, x, {"u": u})
    assert outputs["y"].shape == p
    np.testing.assert_allclose(outputs["y"], C @ x + (D @ u if m else D * u), rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(new, A @ x + (B @ u if m else B * u), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("D", [0.0, [[0.0, 0.0], [0.0, 0.0]]], ids=["number", "matrix"])
def test_without_feedthrough_there_is_none_and_single_zeros_count(D):
    A, B, C, _ = matrices(3, (2,), (2,))
    shapes = {"u": (2,)}
    assert "u" not in trace(StateSpace(A=A, B=B, C=C, D=D), shapes, sampled=False).depends["y"]
    assert "u" in trace(StateSpace(A=A, B=B, C=C, D=[[0, 0], [0, 2]]), shapes, sampled=False).depends["y"]


def test_blocks_of_one_structure_share_a_trace():
    first, second = (StateSpace(A=A, B=B, C=C, D=D) for A, B, C, D in (matrices(3, (), ()), matrices(3, (), ())))
    assert Alone(first).made is Alone(second).made
    first, second = (TransferFunction(numerator=b, denominator=[1, 2, b]) for b in (3.0, 4.0))
    assert Alone(first).made is Alone(second).made


def test_it_starts_from_its_initial_state():
    A, B, C, D = matrices(3, (), ())
    for start in (0.5, [1.0, 2.0, 3.0]):
        block = StateSpace(A=A, B=B, C=C, D=D, initial_state=start)
        assert Alone(block).start({}).tolist() == np.broadcast_to(start, 3).tolist()


@pytest.mark.parametrize("method", ["exact", "forward", "semi_implicit", "trapezoidal"])
def test_a_state_space_in_a_sampled_frame_goes_by_its_method(method):
    A, B, C, D = matrices(3, (), ())
    got = Alone(StateSpace(A=A, B=B, C=C, D=D, initial_state=1.0), T=0.2, method=method).ticks(u=WAVE)["y"]
    Ad, phi = hold(A, 0.2, method)
    x, want = np.ones(3), []
    for u in WAVE:
        want.append(C @ x + D * u)
        x = Ad @ x + phi @ (B * u)
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


def test_sampled_exactly_it_is_what_python_control_samples():
    A, B, C, D = matrices(4, (2,), (2,))
    T, u = 0.15, RNG.standard_normal((50, 2))
    sampled = control.sample_system(control.ss(A, B, C, D), T, method="zoh")
    want = control.forced_response(sampled, np.arange(50) * T, u.T).outputs.T
    for block in (StateSpace(A=A, B=B, C=C, D=D), DiscreteStateSpace.from_control(sampled)):
        got = Alone(block, T=T, u=(2,)).ticks(u=u)["y"]
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11)


def test_in_continuous_time_it_is_the_matrix_exponential():
    A, B, C, D = matrices(4, (), ())
    x0 = RNG.standard_normal(4)
    times = np.linspace(0.0, 2.0, 9)
    got = Alone(StateSpace(A=A, B=B, C=C, D=D, initial_state=x0)).run(lambda t: {"u": 1.5}, times)["y"]
    rest = np.linalg.solve(A, 1.5 * B)
    want = [C @ (expm(A * t) @ (x0 + rest) - rest) + 1.5 * D for t in times]
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("changes", "port", "text"),
    [
        ({"A": [[1.0, 2.0]]}, "A", r"found shape \(1, 2\); expected a square matrix"),
        ({"A": -2.0}, "A", r"found shape \(\); expected a square matrix"),
        ({"B": [1.0, 2.0, 3.0]}, "B", r"found shape \(3,\); expected 2 numbers, or a matrix of 2 rows"),
        ({"C": [[1.0], [2.0]]}, "C", r"found shape \(2, 1\); expected 2 numbers, or a matrix of 2 columns"),
        ({"D": [1.0]}, "D", r"found shape \(1,\); expected a number"),
        ({"B": np.eye(2), "D": 1.0}, "D", r"found shape \(\); expected shape \(2,\)"),
        ({"initial_state": [1.0, 2.0, 3.0]}, "initial_state", "expected a number or 2 numbers"),
        ({"input_names": ("a", "b")}, "input_names", r"found 2 names \(a, b\); expected 1"),
    ],
)
def test_matrices_that_do_not_fit_are_refused(changes, port, text):
    with pytest.raises(ParameterError, match=text) as caught:
        StateSpace(**{"A": -np.eye(2), "B": [0, 1], "C": [1, 0], **changes})
    assert caught.value.port == port


# --- transfer functions -----------------------------------------------------------------------------------------------

FUNCTIONS = [
    (5.0, 2.0),
    (2.0, [0.1, 1.0]),
    ([3.0, 0.0], [0.1, 1.0]),
    ([1.0, 2.0], [2.0, 0.5, 4.0]),
    ([1.0, 0.0, -2.0], [1.0, 0.5, 0.0]),
    (1.0, [1.0, 0.0, 0.0, 0.0]),
    ([1.0, 2.0, 3.0], [-1.0, 4.0, 0.0, 2.0, 1.0]),
    ([-2.0, 0.0, 1.0, 5.0, 3.0], [3.0, 1.0, 4.0, 1.0, 5.0]),
]


@pytest.mark.parametrize(("b", "a"), FUNCTIONS)
@pytest.mark.parametrize("cls", [TransferFunction, DiscreteTransferFunction])
def test_its_response_is_that_of_the_polynomials(cls, b, a):
    found = Alone(cls(numerator=b, denominator=a), T=None if cls is TransferFunction else 0.1).matrices(["u"], "y")
    b, a = np.atleast_1d(b), np.atleast_1d(a)
    assert len(found[0]) == len(a) - 1
    for s in POINTS:
        want = np.polyval(b, s) / np.polyval(a, s)
        assert response(found, s)[0, 0] == pytest.approx(want, rel=1e-12)


def test_only_a_function_of_equal_degrees_feeds_through():
    for cls, sampled in ((TransferFunction, False), (DiscreteTransferFunction, True)):
        for b, feeds in (([1.0, 2.0], False), ([1.0, 2.0, 3.0], True)):
            made = trace(cls(numerator=b, denominator=[1.0, 1.0, 1.0]), {"u": ()}, sampled=sampled)
            assert ("u" in made.depends["y"]) == feeds


@pytest.mark.parametrize("cutoff", [1e-3, 1.0, 2e3 * np.pi])
def test_coefficients_are_of_one_size_at_any_frequency(cutoff):
    # the coefficients of a Butterworth filter of order 10 at 1 kHz span 38 decades; its scaled ones less than 2
    b, a = butter(10, cutoff, analog=True)
    A, B, C, D = Alone(TransferFunction(numerator=b, denominator=a)).matrices(["u"], "y")
    assert np.log10(np.abs(A[A != 0]).max() / np.abs(A[A != 0]).min()) < 2
    for w in (0.1, 0.9, 1.0, 1.1, 5.0):
        want = 1.0 / np.sqrt(1.0 + w**20)  # what makes it Butterworth's
        assert abs(response((A, B, C, D), 1j * w * cutoff)[0, 0]) == pytest.approx(want, rel=1e-12)


def test_sampled_exactly_the_pulse_response_of_a_filter_at_one_kilohertz_is_that_of_its_residues():
    b, a = butter(6, 2e3 * np.pi, analog=True)
    T, u = 5e-5, np.r_[1.0, np.zeros(199)]
    got = Alone(TransferFunction(numerator=b, denominator=a), T=T).ticks(u=u)["y"]
    poles = np.roots(a)  # the pulse response from the residues
    residues = b[-1] / np.array([np.polyval(np.polyder(a), p) for p in poles])
    steps = np.arange(200) * T
    step = sum(r / p * (np.exp(p * steps) - 1.0) for r, p in zip(residues, poles, strict=True)).real
    np.testing.assert_allclose(got, np.diff(np.r_[0.0, step]), rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("zeta", [0.1, 0.6])
def test_a_step_in_continuous_time_is_the_closed_form(zeta):
    w = 7.0
    times = np.linspace(0.0, 3.0, 31)
    alone = Alone(TransferFunction(numerator=w**2, denominator=[1.0, 2 * zeta * w, w**2]))
    got = alone.run(lambda t: {"u": 1.0}, times)["y"]
    wd = w * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * w * times)
    want = 1.0 - decay * (np.cos(wd * times) + zeta * w / wd * np.sin(wd * times))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-10)


def test_a_discrete_function_is_a_difference_equation():
    b, a = [2.0, -1.0], [2.0, 0.5, 0.25]
    got = Alone(DiscreteTransferFunction(numerator=b, denominator=a), T=0.1).ticks(u=WAVE)["y"]
    y = np.zeros(len(WAVE) + 2)
    u = np.r_[0.0, 0.0, WAVE]
    for k in range(2, len(u)):
        y[k] = (2.0 * u[k - 1] - u[k - 2] - 0.5 * y[k - 1] - 0.25 * y[k - 2]) / 2.0
    np.testing.assert_allclose(got, y[2:], rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("b", "a", "text"),
    [
        ([1.0, 2.0], 3.0, "found degree 1 over degree 0; expected a proper transfer function"),
        (1.0, [0.0, 1.0], r"found \[0.0, 1.0\]; expected a first coefficient that is not zero"),
        ([[1.0]], [1.0, 1.0], r"found shape \(1, 1\); expected a number, or coefficients in one list"),
        ([], [1.0, 1.0], r"found shape \(0,\)"),
    ],
)
@pytest.mark.parametrize("cls", [TransferFunction, DiscreteTransferFunction])
def test_coefficients_that_are_no_proper_function_are_refused(cls, b, a, text):
    with pytest.raises(ParameterError, match=text):
        cls(numerator=b, denominator=a)


def test_a_transfer_function_is_a_value():
    block = TransferFunction(numerator=1.0, denominator=[1.0, 2.0, 0.0], name="G")
    other = block.replace(denominator=[1.0, 2.0, 4.0])
    for one in (block, other, pickle.loads(pickle.dumps(other))):
        b, a = np.atleast_1d(one.numerator), one.denominator
        want = np.polyval(b, 2j) / np.polyval(a, 2j)
        assert response(Alone(one).matrices(["u"], "y"), 2j)[0, 0] == pytest.approx(want, rel=1e-13)
    assert pickle.loads(pickle.dumps(other)) == other != block


# --- python-control ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0, 0.1, True, None], ids=str)
@pytest.mark.parametrize(("m", "p"), [(1, 1), (2, 1), (1, 2), (2, 3)])
def test_a_state_space_goes_to_python_control_and_back(dt, m, p):
    A, B, C, D = matrices(3, (m,), (p,))
    names = {"inputs": [f"i{k}" for k in range(m)], "outputs": [f"o{k}" for k in range(p)], "states": list("abc")}
    system = control.ss(A, B, C, D, dt, **names)
    block = (StateSpace if dt == 0 or dt is None else DiscreteStateSpace).from_control(system, name="G")
    assert block.inputs["u"].shape == (() if m == 1 else (m,))
    assert block.outputs["y"].shape == (() if p == 1 else (p,))
    back = block.to_control()
    for mine, theirs in ((back.A, A), (back.B, B), (back.C, C), (back.D, D)):
        np.testing.assert_array_equal(mine, theirs)
    assert (back.input_labels, back.output_labels, back.state_labels) == tuple(names.values())
    assert back.name == "G"
    assert back.dt == (0 if dt is None else dt)


@pytest.mark.parametrize("dt", [0, 0.1, True], ids=str)
def test_a_transfer_function_goes_to_python_control_and_back(dt):
    system = control.tf([1.0, 2.0], [3.0, 0.0, 4.0], dt, inputs="force", outputs="position")
    block = (TransferFunction if dt == 0 else DiscreteTransferFunction).from_control(system)
    back = block.to_control()
    assert back.num[0][0].tolist() == [1.0, 2.0]
    assert back.den[0][0].tolist() == [3.0, 0.0, 4.0]
    assert (back.input_labels, back.output_labels, back.dt) == (["force"], ["position"], dt)


def test_names_that_python_control_made_up_are_left_out():
    assert StateSpace.from_control(control.ss([[-1.0]], [[1.0]], [[1.0]], 0.0)).input_names is None
    assert TransferFunction.from_control(control.tf(1, [1, 1])).output_names is None


@pytest.mark.parametrize("dt", [0, 0.1], ids=str)
def test_a_name_that_can_name_a_block_is_taken_over(dt):
    space, transfer = control.ss(0.5, 1, 1, 0, dt), control.tf(1, [1, 0.5], dt)
    spaces, transfers = (StateSpace, TransferFunction) if dt == 0 else (DiscreteStateSpace, DiscreteTransferFunction)
    for cls, system in ((spaces, space), (transfers, transfer)):
        assert cls.from_control(system).name is None  # made up: sys[0]
        system.name = "motor"
        assert cls.from_control(system).name == "motor"
        assert cls.from_control(system).to_control().name == "motor"
        assert cls.from_control(system, name="drive").name == "drive"
        system.name = "motor 2"
        assert cls.from_control(system).name is None


def test_no_direct_term_goes_to_python_control_as_zeros():
    block = StateSpace(A=-np.eye(2), B=np.eye(2), C=np.eye(2))
    np.testing.assert_array_equal(block.to_control().D, np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("cls", "system", "text"),
    [
        (StateSpace, control.tf(1, [1, 1]), r"found a TransferFunction; .* Convert it: control.ss\(system\)"),
        (TransferFunction, control.ss(-1, 1, 1, 0), r"found a StateSpace; .* Convert it: control.tf\(system\)"),
        (TransferFunction, [1.0], "found a list; expected a control.TransferFunction. Give one"),
        (StateSpace, control.ss(0.5, 1, 1, 0, 0.1), r"discrete time \(dt=0.1\); .* Use DiscreteStateSpace"),
        (DiscreteStateSpace, control.ss(-1, 1, 1, 0), r"continuous time .* Use StateSpace, or sample it"),
        (DiscreteTransferFunction, control.tf(1, [1, 1]), "continuous time .* Use TransferFunction, or sample it"),
        (StateSpace, control.ss([], [], [], 2.0), r"found a system without states; .* Use Gain\(gain=system.D\)"),
        (TransferFunction, control.tf([[[1], [1]]], [[[1, 1], [1, 1]]]), "found 2 inputs and 1 outputs"),
    ],
)
def test_systems_of_another_kind_are_refused(cls, system, text):
    with pytest.raises(ParameterError, match=text):
        cls.from_control(system)


@pytest.mark.parametrize("T", [0.1, 1.0], ids=str)
@pytest.mark.parametrize(
    "block",
    [
        DiscreteStateSpace(A=[[0.5]], B=[1.0], C=[1.0], dt=0.2),
        DiscreteTransferFunction(numerator=1.0, denominator=[1.0, 0.5], dt=0.2),
    ],
    ids=lambda block: block.label,
)
def test_another_sample_time_than_that_of_the_frame_is_refused(block, T):
    if T == 1.0:  # the sample time with which a trace is made
        alone = Alone(block, T=T)
        assert alone.made.guards == ("sample_time",)
        guard = alone.made.function.call([0.0, np.zeros(1), 0.0, alone.p])[-1]
        assert float(guard) == pytest.approx(-4.0)
        assert block.guard_error("sample_time", -1.0, None, None).message.startswith(
            "found another sample time in the subsystem; expected 0.2"
        )
    else:
        with pytest.raises(SampleTimeError, match=r"dt: found a sample time of .* s in the subsystem; expected 0.2 s"):
            Alone(block, T=T)
    Alone(block, T=0.2)
    Alone(block.replace(dt=None), T=T)

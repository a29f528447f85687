"""Zeros, poles and gain: against their product, however close or far apart they are."""

import control
import numpy as np
import pytest
from scipy.signal import cheb1ap, ellipap, lfilter

from loopwright.blocks import DiscreteZeroPoleGain, ParameterError, SampleTimeError, ZeroPoleGain
from loopwright.blocks.library.zero_pole import sections
from support.stepped import Alone, response

SYSTEMS = [
    ([], [-1.0]),
    ([-3.0], [-1.0]),
    ([], [-1.0] * 5),
    ([5.0], [-1e-3, -1e5, -2.0]),
    ([0.0, 0.0], [0.0, 0.0, -1.0]),
    ([-1 + 1j, -1 - 1j, 2.0], [-1.0, -2.0, -3.0]),
    ([-1.0, -2 + 3j, -2 - 3j], [-1 + 5j, -1 - 5j, -3.0, -1000.0]),
    ([1j, -1j, -4.0, 2.0], [-1 + 1j, -1 - 1j, -1 + 2j, -1 - 2j, 0.0]),
]
POINTS = [0.3j, 0.7 + 1.3j, -5.0 + 0.2j, 30j]


def product(z, p, k, s):
    return k * np.prod([s - v for v in z]) / np.prod([s - v for v in p])


@pytest.mark.parametrize(("z", "p"), SYSTEMS)
@pytest.mark.parametrize("cls", [ZeroPoleGain, DiscreteZeroPoleGain])
def test_its_response_is_the_product_of_its_factors(cls, z, p):
    alone = Alone(cls(zeros=z, poles=p, gain=-3.0), T=None if cls is ZeroPoleGain else 0.1)
    found = alone.matrices(["u"], "y")
    assert (found[3] != 0).any() == (len(z) == len(p))
    for s in POINTS:
        assert response(found, s)[0, 0] == pytest.approx(product(z, p, -3.0, s), rel=1e-12)


def test_poles_that_are_close_together_stay_where_they_are():
    # the polynomial of eight poles at -1 has them known to 1e-2 only; sections to 1e-8, the root of rounding
    A = Alone(ZeroPoleGain(poles=[-1.0] * 8)).matrices(["u"], "y")[0]
    blocks = [A[i : i + 2, i : i + 2] for i in range(0, 8, 2)]
    for block in blocks:
        np.testing.assert_allclose(np.linalg.eigvals(block), -1.0, rtol=0, atol=1e-7)
    assert not np.triu(A, 2).any()


@pytest.mark.parametrize("design", [cheb1ap(9, 0.5), ellipap(8, 0.5, 60)], ids=["chebyshev", "elliptic"])
@pytest.mark.parametrize("w", [1e-3, 1e4])
def test_sharp_filters_keep_their_response_and_the_size_of_their_states(design, w):
    z, p, k = design
    z, p, k = z * w, p * w, k * w ** (len(p) - len(z))
    found = Alone(ZeroPoleGain(zeros=z, poles=p, gain=k)).matrices(["u"], "y")
    for x in (0.1, 0.999, 1.5):
        assert response(found, 1j * x * w)[0, 0] == pytest.approx(product(z, p, k, 1j * x * w), rel=1e-11)
    states = np.linalg.solve(found[0], found[1])  # at rest under a constant input
    assert 1e-4 < np.abs(states[np.abs(states) > 1e-9]).min() <= np.abs(states).max() < 1e4


def test_a_discrete_cascade_is_the_difference_equation():
    z, p, k = [0.5], [0.9, 0.3 + 0.4j, 0.3 - 0.4j], 2.0
    u = np.sin(0.4 * np.arange(50))
    got = Alone(DiscreteZeroPoleGain(zeros=z, poles=p, gain=k), T=0.1).ticks(u=u)["y"]
    want = lfilter([0.0, 0.0, *np.poly(z) * k], np.real(np.poly(p)), u)  # two samples late: two more poles than zeros
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


def test_the_gain_is_a_parameter_of_one_shared_trace():
    first, second = (ZeroPoleGain(poles=[-1.0, -2.0], gain=k) for k in (1.0, 2.0))
    assert Alone(first).made is Alone(second).made
    assert Alone(first).made is not Alone(first.replace(poles=[-1.0, -3.0])).made


def test_no_section_has_more_zeros_than_poles():
    rng = np.random.default_rng(1)
    for _ in range(200):
        n = rng.integers(1, 9)
        pairs, reals = rng.integers(0, n // 2 + 1), rng.standard_normal(9)
        c = rng.standard_normal(9) + 1j * rng.uniform(0.1, 3, 9)
        p = [v for x in c[:pairs] for v in (x, x.conj())] + list(reals[: n - 2 * pairs])
        m = rng.integers(0, n + 1)
        zero_pairs = rng.integers(0, m // 2 + 1)
        z = [v for x in 2 * c[:zero_pairs] for v in (x, x.conj())] + list(3 * reals[: m - 2 * zero_pairs])
        made = sections(z, p)
        assert all(len(zeros) <= len(poles) <= 2 for zeros, poles in made)
        assert sum(len(poles) == 1 for _, poles in made) <= 1
        for i, given in enumerate((z, p)):
            found = sorted((r for part in made for r in part[i]), key=lambda r: (r.real, r.imag))
            np.testing.assert_allclose(found, sorted(given, key=lambda r: (np.real(r), np.imag(r))), rtol=1e-12)


@pytest.mark.parametrize(
    ("z", "p", "text"),
    [
        ([], [-1 + 1j], r"poles: found .*\(-1\+1j\) without its conjugate; expected a list of finite numbers"),
        ([1j, -2j], [-1.0, -2.0], "zeros: found .* without its conjugate"),
        ([1.0, 2.0], [-1.0], "found 2 zeros and 1 poles; expected a pole, and no more zeros than poles"),
        ([], [], "found 0 zeros and 0 poles"),
        ([], [np.inf], "poles: found .* expected a list of finite numbers"),
        ([], -1.0, "poles: found -1.0; expected a list"),
        ([], ["a"], "poles: found .* expected a list"),
    ],
)
def test_what_is_no_real_proper_function_is_refused(z, p, text):
    with pytest.raises(ParameterError, match=text):
        ZeroPoleGain(zeros=z, poles=p)


def test_another_sample_time_is_refused():
    with pytest.raises(SampleTimeError, match=r"found a sample time of 0.1 s in the subsystem; expected 0.2 s"):
        Alone(DiscreteZeroPoleGain(poles=[0.5], dt=0.2), T=0.1)


# --- python-control ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("z", "p"), SYSTEMS[:2] + SYSTEMS[5:])
@pytest.mark.parametrize("dt", [0, 0.1, True], ids=str)
def test_zeros_poles_and_gain_go_to_python_control_and_back(dt, z, p):
    cls = ZeroPoleGain if dt == 0 else DiscreteZeroPoleGain
    system = control.zpk(z, p, -3.0, dt, inputs="force", outputs="position", name="arm")
    block = cls.from_control(system)
    back = block.to_control()
    for s in POINTS:
        want = product(z, p, -3.0, s)
        assert product(block.zeros, block.poles, block.gain, s) == pytest.approx(want, rel=1e-9)
        assert back(s) == pytest.approx(want, rel=1e-9)
    assert (block.name, block.input_names, back.name, back.dt) == ("arm", ("force",), "arm", dt)
    assert (back.input_labels, back.output_labels) == (["force"], ["position"])


def test_a_transfer_function_with_leading_zeros_and_another_first_coefficient():
    block = ZeroPoleGain.from_control(control.tf([0.0, 6.0, 12.0], [2.0, 8.0, 6.0]))
    assert (block.zeros, block.gain) == ((-2.0,), 3.0)
    assert sorted(p.real for p in block.poles) == pytest.approx([-3.0, -1.0], rel=1e-14)
    assert (block.name, block.input_names) == (None, None)


def test_systems_that_have_no_zeros_poles_and_gain_are_refused():
    with pytest.raises(ParameterError, match="found a StateSpace; expected a control.TransferFunction"):
        ZeroPoleGain.from_control(control.ss(-1, 1, 1, 0))
    with pytest.raises(ParameterError, match="found 2 inputs and 1 outputs"):
        ZeroPoleGain.from_control(control.tf([[[1], [1]]], [[[1, 1], [1, 1]]]))
    with pytest.raises(ParameterError, match="Use ZeroPoleGain, or sample it"):
        DiscreteZeroPoleGain.from_control(control.tf(1, [1, 1]))
    with pytest.raises(ParameterError, match="use Gain where there are none"):
        ZeroPoleGain.from_control(control.tf([2.0], [1.0]))

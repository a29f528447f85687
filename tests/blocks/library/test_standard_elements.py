"""PT1, PT2, lead-lag, notch and Butterworth: frequency responses, steps and exact discretization, by closed forms and SciPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

from loopwright.blocks import PT1, PT2, Butterworth, Constant, LeadLag, Notch, ParameterError, Step
from loopwright.diagrams import Diagram, subsystem

F = np.geomspace(0.01, 100.0, 50)
S = 2j * np.pi * F
T, D, K = 0.2, 0.3, 1.7


def state_space(block):
    """Return (A, B, C, D) of a block of one input, column by column, from its own equations."""
    names = list(block.states)
    sizes = [int(np.size(block.states[n].start_value(block, {"u": ()}))) for n in names]
    total = sum(sizes)

    def evaluate(x, u):
        parts = np.split(np.asarray(x, dtype=float), np.cumsum(sizes)[:-1])
        states = SimpleNamespace(
            **{n: p[0] if s == 1 and n != "x" else p for n, p, s in zip(names, parts, sizes, strict=True)}
        )
        rate = np.ravel(
            np.concatenate([np.ravel(r) for r in np.atleast_1d(block.derivative(0.0, states, SimpleNamespace(u=u)))])
        )
        y = block.output(0.0, states, SimpleNamespace(u=u)) if hasattr(block, "output") else states.y
        return rate, float(np.ravel(y)[0])

    columns = [evaluate(np.eye(total)[i], 0.0) for i in range(total)]
    B, feed = evaluate(np.zeros(total), 1.0)
    return np.stack([c[0] for c in columns], axis=1), B, np.array([c[1] for c in columns]), feed


def response(block):
    A, B, C, feed = state_space(block)
    return np.array([C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + feed for s in S])


w0, b = 2 * np.pi * 3.0, 2 * np.pi * 0.4
CASES = [
    (PT1(gain=K, time_constant=T), K / (T * S + 1)),
    (PT2(gain=K, time_constant=T, damping_ratio=D), K / (T**2 * S**2 + 2 * D * T * S + 1)),
    (PT2(time_constant=T, damping_ratio=0.0), 1 / (T**2 * S**2 + 1)),
    (LeadLag(gain=K, lead_time=0.5, lag_time=T), K * (0.5 * S + 1) / (T * S + 1)),
    (LeadLag(lead_time=0.0, lag_time=T), 1 / (T * S + 1)),
    (Notch(frequency=3.0, bandwidth=0.4), (S**2 + w0**2) / (S**2 + b * S + w0**2)),
    (Notch(frequency=3.0, bandwidth=0.4, depth=0.1), (S**2 + 0.1 * b * S + w0**2) / (S**2 + b * S + w0**2)),
]
BANDS = [
    (4, 2.0, "lowpass"),
    (3, 2.0, "highpass"),
    (2, (1.0, 5.0), "bandpass"),
    (1, (1.0, 5.0), "bandstop"),
    (9, 0.5, "lowpass"),
]
CASES += [
    (
        Butterworth(order=n, cutoff=f, band=band, gain=K),
        K
        * signal.freqs_zpk(*signal.butter(n, 2 * np.pi * np.array(f), band, analog=True, output="zpk"), worN=S.imag)[1],
    )
    for n, f, band in BANDS
]


@pytest.mark.parametrize(("block", "expected"), CASES, ids=lambda case: type(case).__name__)
def test_the_frequency_response_is_that_of_the_docstring(block, expected):
    np.testing.assert_allclose(response(block), expected, rtol=0, atol=2e-11 * np.max(np.abs(expected)))


def test_a_butterworth_low_pass_has_its_gain_by_definition():
    found = np.abs(response(Butterworth(order=5, cutoff=2.0)))
    np.testing.assert_allclose(found, 1 / np.sqrt(1 + (F / 2.0) ** 10), rtol=1e-9, atol=1e-12)


def test_a_full_notch_is_as_wide_as_its_bandwidth():
    """At the edges, f = √(f₀² + (w/2)²) ± w/2, |H| is 1/√2."""
    A, B, C, feed = state_space(Notch(frequency=3.0, bandwidth=0.4))
    for edge in (np.hypot(3.0, 0.2) - 0.2, np.hypot(3.0, 0.2) + 0.2):
        s = 2j * np.pi * edge
        assert abs(C @ np.linalg.solve(s * np.eye(2) - A, B) + feed) == pytest.approx(np.sqrt(0.5), rel=1e-12)


@pytest.mark.parametrize("block", [case[0] for case in CASES[:-1]], ids=lambda block: type(block).__name__)
def test_a_sampled_subsystem_discretizes_exactly(block):
    """With a step at its input: C x[k] + D, x[k] by the matrix exponential of the block's own (A, B, C, D)."""

    @subsystem(sample_time=0.05)
    def box(u):
        return block(u).named("y")

    run = Diagram("d", box(Constant(value=2.0))).simulate(1.0, progress=False)
    A, B, C, feed = state_space(block)
    n = len(A)
    big = np.zeros((n + 1, n + 1))
    big[:n, :n], big[:n, n] = A, B
    want = [2.0 * (C @ expm(big * t)[:n, n] + feed) for t in run.t]
    np.testing.assert_allclose(run["box.y"], want, rtol=1e-9, atol=1e-10)


def test_steps_in_continuous_time_are_the_closed_forms():
    u = Step(times=0.0, values=1.0)
    first, second = PT1(gain=K, time_constant=T)(u), PT2(gain=K, time_constant=T, damping_ratio=D)(u)
    lead = LeadLag(lead_time=0.5, lag_time=T)(u)
    run = Diagram("d", first.named("one"), second.named("two"), lead.named("three")).simulate(
        2.0, step=0.1, rtol=1e-11, atol=1e-12, progress=False
    )
    t, wd = run.t, np.sqrt(1 - D**2) / T
    np.testing.assert_allclose(run["one"], K * (1 - np.exp(-t / T)), atol=1e-9)
    swing = np.exp(-D * t / T) * (np.cos(wd * t) + D / np.sqrt(1 - D**2) * np.sin(wd * t))
    np.testing.assert_allclose(run["two"], K * (1 - swing), atol=1e-9)
    np.testing.assert_allclose(run["three"], 1 + 1.5 * np.exp(-t / T), atol=1e-9)


def test_vectors_and_start_values():
    y = PT1(time_constant=T, initial_value=(1.0, -1.0))(Constant(value=(0.0, 0.0)))
    run = Diagram("d", y.named("y")).simulate(0.4, step=0.1, rtol=1e-11, atol=1e-12, progress=False)
    np.testing.assert_allclose(run["y"], np.exp(-run.t / T)[:, None] * [1.0, -1.0], atol=1e-10)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"cutoff": (1.0, 2.0)}, r"butterworth\.cutoff: found .* for a lowpass; expected one frequency"),
        ({"cutoff": 1.0, "band": "bandpass"}, r"for a bandpass; expected the lower and the upper frequency"),
        ({"cutoff": (2.0, 1.0), "band": "bandstop"}, r"expected the lower and the upper frequency"),
        ({"cutoff": 1.0, "band": "low"}, r"band: found 'low'"),
        ({"cutoff": -1.0}, r"cutoff: found -1"),
    ],
)
def test_a_butterworth_that_is_none_is_refused(wrong, text):
    with pytest.raises(ParameterError, match=text):
        Butterworth(order=2, **wrong)

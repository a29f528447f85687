"""Responses of linear models to a step: at samples, between and after them, and the values that they come to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..frequency import advance_held
from ..linearization import Linearization
from .between_samples import WithinSamples

SLOWEST = 1e-6
"""Poles slower than that, relative to the fastest, are taken as integrators that nothing feeds back."""
CONSTANTS = 40.0
"""Time constants of the slowest other pole after which a linear model rests."""
FINER = 6
"""Halvings of a sample time within which the largest value between two samples is looked for."""
FINER_DELAYED = 3
"""Instants a sample at which a response with delays is looked at."""
LATER = 5.0
"""Parts of the longest delay for which a response is looked at after its last sample, at least."""
MOST_LATER = 10
"""Lengths of a response up to which it is looked at after its last sample."""
SAMPLES_LATER = 2000
"""Instants at which it is."""
FINEST = 40
"""Halvings of it right behind a sample, where a fast mode has decayed before the next one."""
DOUBLED = 200
"""Samples after the record for which a linear model is looked at before their distance is doubled."""


class Predicted(NamedTuple):
    """Outputs of a linear model in a response."""

    rows: np.ndarray  # at the samples, (N, K)
    later: np.ndarray  # smallest and largest ones after the last sample, with the input held at its last value, (2, K)
    between: np.ndarray  # largest size between the samples, less that at the samples, (K,); 0 of a sampled model


def predict(model: Linearization, d: np.ndarray, t: np.ndarray) -> Predicted:
    """Return the outputs of a linear model with one input d: sampled as it is, or held from the first sample on."""
    if model.delays is not None:
        return _predict_with_delays(model, d, t)
    C, D, n = model.C, model.D[:, 0], len(model.A)
    h = float(t[1] - t[0])
    one = _advance_by(model, h)
    z, states = np.zeros(n + 1), np.zeros((len(d), n + 1))
    for k, value in enumerate(d):
        z[n] = value
        states[k] = z
        z = one @ z
    rows = states[:, :n] @ C.T + np.outer(d, D)
    later = _find_extremes(model, one, z, h)
    between = np.zeros(len(C))
    if not model.dt:
        size = np.max(np.abs(rows), axis=0)
        moves = [_advance_by(model, h * 0.5**k) for k in range(FINER + 2, FINEST, 2)]  # powers of one lose digits
        part = whole = _advance_by(model, h * 0.5**FINER)
        for _ in range(2**FINER - 1):
            moves.append(part)
            part = whole @ part
        for move in moves:
            inside = states @ (C @ move[:n]).T + np.outer(d, D)
            between = np.maximum(between, np.max(np.abs(inside), axis=0) - size)
    return Predicted(rows, later, between)


def predict_within(within: WithinSamples, d: np.ndarray, count: int) -> Predicted:
    """Return what `predict` returns, with ``count`` instants in each sample, over each of which d is held."""
    rows, state = within.respond(d)
    end, model = np.append(state, d[-1]), within.model
    later = _find_extremes(model, _advance_by(model, model.dt), end, model.dt).reshape(2, -1, within.outputs)
    extremes = np.stack([later[0].min(axis=0), later[1].max(axis=0)])
    return Predicted(within.read(rows, count), extremes, within.between(rows, count))


def _predict_with_delays(model: Linearization, d: np.ndarray, t: np.ndarray) -> Predicted:
    """Return what `predict` returns of a continuous model with delays and a step at its first sample.

    Later outputs are looked at until the slowest pole has decayed, between the samples at three instants of each.
    """
    h, size, poles = float(t[1] - t[0]), float(d[0]), model.poles
    slowest = float(np.min(np.abs(poles.real), initial=np.inf)) if poles.size else np.inf
    after = max(LATER * float(np.max(model.delays.times)) if model.delays else 0.0, CONSTANTS / slowest, 4.0 * h)
    end = t[-1] + min(after, MOST_LATER * h * len(t))
    fine = h / FINER_DELAYED * np.arange(FINER_DELAYED * (len(t) - 1) + 1)
    times = np.concatenate([fine, np.linspace(fine[-1], end, SAMPLES_LATER)[1:]])
    found = size * model.system.step_response(times)
    rows, later = found[: len(fine) : FINER_DELAYED], found[len(fine) - 1 :]
    between = np.max(np.abs(found[: len(fine)]), axis=0) - np.max(np.abs(rows), axis=0)
    return Predicted(rows, np.stack([later.min(axis=0), later.max(axis=0)]), between)


def _advance_by(model: Linearization, h: float) -> np.ndarray:
    """Return the matrix that takes (x, d) of a linear model h seconds further with d held, or by its sample time."""
    A, B, n = model.A, model.B[:, :1], len(model.A)
    if model.dt:
        return np.block([[A, B], [np.zeros((1, n)), np.ones((1, 1))]])
    return advance_held(A, B, h)


def _find_extremes(model: Linearization, one: np.ndarray, z: np.ndarray, h: float) -> np.ndarray:
    """Return the smallest and the largest outputs of a linear model from (x, d) = z on, until it rests.

    After every `DOUBLED` samples, which are h seconds apart at first, their distance is doubled: what decays slowly is
    looked at as long as it lasts.
    """
    n, low, high = len(model.A), np.full(len(model.C), np.inf), np.full(len(model.C), -np.inf)
    slowest, elapsed = float(np.min(_find_rates(model), initial=np.inf)), 0.0
    with np.errstate(all="ignore"):
        while not elapsed * slowest > CONSTANTS:
            for _ in range(DOUBLED):
                y = model.C @ z[:n] + model.D[:, 0] * z[n]
                low, high = np.minimum(low, y), np.maximum(high, y)
                z = one @ z
            elapsed, h, one = elapsed + DOUBLED * h, 2.0 * h, one @ one
    return np.stack([low, high])


def _find_rates(model: Linearization) -> np.ndarray:
    """Return how fast the modes of a linear model decay or grow, in 1/s; those slower than `SLOWEST` are left out."""
    poles = np.linalg.eigvals(model.A)
    with np.errstate(divide="ignore"):
        rates = np.abs(np.log(np.abs(poles)) / model.dt if model.dt else poles.real)
    rates = np.minimum(rates, np.pi / model.dt) if model.dt else rates
    return np.asarray(rates[rates > SLOWEST * np.max(rates, initial=0.0)])


def find_final(model: Linearization) -> np.ndarray:
    """Return the values that a linear model's outputs come to after a unit step, NaN of those that don't rest.

    They are those after many time constants of its slowest pole; poles slower than `SLOWEST` of the fastest stay where
    they are.
    """
    if model.delays is not None:
        at_rest = model.characteristic.count_unstable() == 0
        final = np.atleast_1d(np.real(model.system(0.0, squeeze=False))).reshape(len(model.C), -1)[:, 0]
        return final if at_rest else np.full(len(model.C), np.nan)
    C, D, n, rates = model.C, model.D[:, 0], len(model.A), _find_rates(model)
    if not rates.size:
        return np.asarray(D, dtype=float)
    h = model.dt or 0.1 / float(np.max(np.abs(np.linalg.eigvals(model.A))))
    M = _advance_by(model, h)
    doublings = max(1, math.ceil(math.log2(CONSTANTS / float(np.min(rates)) / h)))
    for _ in range(doublings):
        M = M @ M
    with np.errstate(all="ignore"):
        size = np.sum(np.abs(C), axis=1) * np.max(np.abs(M[:n, n]), initial=0.0) + np.abs(D)
        once, twice = C @ M[:n, n] + D, C @ (M @ M)[:n, n] + D
        rests = np.abs(twice - once) <= 1e-9 * size + 1e-6 * np.maximum(np.abs(once), np.abs(twice))
    return np.where(rests & np.isfinite(once), once, np.nan)

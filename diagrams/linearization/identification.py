"""Identification of an FMU's step from its responses alone, for an FMU that gives neither derivatives nor its state.

Each input gets a pulse of one step, up and down, in separate runs from the same rest. Half the differences of the
outputs, relative to the pulse, are the Markov parameters G₁, G₂, … of the step. Pulses of two sizes cancel the errors
that grow with the square of the pulse, and estimate the others.

The model x⁺ = A x + B z, w = C x with C Aᵏ⁻¹ B = Gₖ is found by the eigensystem realization algorithm (Juang and
Pappa, J. Guidance 8 (1985) 620-627): by singular values of the block Hankel matrix H[i, j] = G(1 + rᵢ + cⱼ) and of the
same matrix shifted by a step. The offsets rᵢ, cⱼ are spaced by powers, so that a small matrix shows slow and fast
motion. The order is the number of singular values above the noise.

A feedthrough of the FMU acts on its outputs at the end of the step; it becomes a pole at z = 0.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import FmuError, Layout, identity
from ...fmus.fmu_block import Derivation, DerivativeMethod, RestoredPoint, open_to_step, setup_of, take_step

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu

SAMPLES = 1000
"""Steps of a response."""
SETTLING = 20_000
"""Largest number of steps until the outputs are constant."""
PULSE = 1e-2
"""Size of a pulse, relative to the larger of an input's nominal value and its value."""
STILL = 1e-10
"""Change over a step below which an output is constant, relative to 1 + its size."""
NEAR_REST, NEAR_0 = 1e-6, 1e-9
"""How near outputs are to those at rest: relative to their size, and to 1 + the largest output's size."""
WATCHED = 10
"""Steps over which the outputs of an FMU without listed states are watched in a trim."""
FEW, ALIKE = 4, 0.1
"""Steps of a response that is looked at twice; the share of its largest change by which both may differ."""
_NOISE = 1e-10
"""Smallest noise of the singular values, relative to the largest."""


@dataclass(frozen=True, eq=False)
class IdentifiedStep:
    """Model x⁺ = A x + B (z − z0), y = y0 + C x of an FMU's step.

    y are the outputs after the step; x is zero at the operating point.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    y0: np.ndarray
    states: tuple[str, ...]
    derivation: Derivation
    uncertainty: float


MOST = 128
"""Models that are kept at a time."""
_KNOWN: OrderedDict[Any, IdentifiedStep] = OrderedDict()
_LOCK = Lock()


def identify_step(
    block: Fmu, point: Mapping[str, Any], h: float, outputs: np.ndarray | None = None, samples: int = SAMPLES
) -> IdentifiedStep:
    """Identify a linear model of an FMU's communication step at rest.

    States of ``point`` that can't be set are left out. At ``outputs``, those of the operating point, the FMU must come
    to rest. Each point of an FMU is identified once, however many loops are looked at; errors are not kept.
    """
    _ = block.description  # an FMU whose file has changed is refused
    now = tuple(identity(point[name]) for name in ("t", "inputs", "state"))
    key = identity(block), now, h, None if outputs is None else np.asarray(outputs, dtype=float).tobytes(), samples
    with _LOCK:
        found = _KNOWN.get(key)
    if found is None:
        found = _identify(block, point, h, outputs, samples)
        for part in (found.A, found.B, found.C, found.y0):
            part.setflags(write=False)
        with _LOCK:
            _KNOWN[key] = found
            while len(_KNOWN) > MOST:
                _KNOWN.popitem(last=False)
    return found


def _identify(
    block: Fmu, point: Mapping[str, Any], h: float, outputs: np.ndarray | None, samples: int
) -> IdentifiedStep:
    runner = _Runner(block, point, h)
    try:
        y0 = runner.settle()
        if outputs is not None:
            _check_rest(y0, outputs, block)
        runner.check_restoring(y0)
        G, noise = _measure_markov(runner, samples)
    finally:
        runner.close()
    A, B, C, _ = realize(G, noise)
    model = predict_markov(A, B, C, len(G))
    error = float(np.max(np.abs(model - G), initial=0.0) + np.max(noise, initial=0.0))
    derivation = Derivation(DerivativeMethod.IDENTIFIED, order=len(A), restarted=runner.rest.lied)
    return IdentifiedStep(A, B, C, y0, tuple(f"mode[{i + 1}]" for i in range(len(A))), derivation, error)


def _check_rest(y0: np.ndarray, outputs: np.ndarray, block: Fmu) -> None:
    """Refuse an operating point whose outputs are others than those at which the FMU comes to rest, ``y0``."""
    wanted = np.ravel(np.asarray(outputs, dtype=float))
    nearest = NEAR_REST * np.abs(wanted) + NEAR_0 * (1.0 + np.max(np.abs(y0), initial=0.0))
    off = np.abs(y0 - wanted)
    if np.all(off <= nearest):
        return
    i = int(np.nanargmax(np.where(np.isnan(off), np.inf, off / nearest)))
    layout = Layout.of({port: spec.shape or () for port, spec in block.outputs.items()})
    raise FmuError(
        f"by its responses alone it can be linearized only where it comes to rest by itself from its start values: "
        f"found the operating point's {layout.labels[i]} = {wanted[i]:.9g}, which is {off[i]:.3g} from the rest at "
        f"{y0[i]:.9g}; expected at most {nearest[i]:.3g}. Where the run still settles, take a later point, at=t; or "
        "give the FMU start values of that point.",
        block=block.label,
    )


def output_drift(block: Fmu, point: Mapping[str, Any], h: float) -> dict[str, float]:
    """Return how far the outputs of an FMU move over `WATCHED` steps from its start with held inputs.

    For an FMU that lists no states: outputs that move show that it has a memory. Changes are those after the first
    step, relative to 1 + the output's size.
    """
    runner = _Runner(block, point, h)
    try:
        y = np.array([runner.step() for _ in range(WATCHED)])
    finally:
        runner.close()
    moved = np.max(np.abs(y - y[0]) / (1.0 + np.abs(y[0])), axis=0, initial=0.0)
    layout = Layout.of({port: spec.shape or () for port, spec in block.outputs.items()})
    return {port: float(np.max(moved[where], initial=0.0)) for port, where in layout.slices.items()}


class _Runner:
    """Runs of an FMU from the same rest."""

    def __init__(self, block: Fmu, point: Mapping[str, Any], h: float):
        self.block, self.about, self.h, self.t0 = block, block.description, h, float(point["t"])
        variables = block.input_variables
        self.inputs = {variables[port].name: np.array(v, dtype=float) for port, v in point["inputs"].items()}
        self.start = {n: v for n, v in point["state"].items() if self.about.find(n).initial == "exact"}
        self.outputs = [v.name for v in block.output_variables.values()]
        self.instance = open_to_step(setup_of(block))
        self._steps, self._fresh = 0, True
        names = [*dict.fromkeys([*self.inputs, *self.outputs, *self.about.states])]
        self.rest = RestoredPoint(self.instance, names, self._start_at_rest)
        self._begin()

    def close(self) -> None:
        """Free the instance."""
        self.rest.free()
        self.instance.close()

    def _begin(self) -> None:
        if not self._fresh:
            self.instance.reset()
        self._fresh = False
        self.instance.initialize(None, start_time=self.t0, values={**self.start, **self.inputs})
        self.instance.begin()
        self._k = 0

    def step(self) -> np.ndarray:
        """Step once, and return the outputs."""
        t = self.t0 + self._k * self.h
        refusal = (
            f"found a step of {self.h:g} s from t = {t:.9g} s that it ends early, or in which it asks to end the "
            "simulation (terminateSimulation); expected whole steps. Take a smaller step, or another point."
        )
        take_step(self.instance, t, self.h, refusal)
        self._k += 1
        return self.instance.values(self.outputs)

    def settle(self) -> np.ndarray:
        """Step until the outputs are constant for 10 steps, and return them; `return_to_rest` comes back to this."""
        last, still = self.instance.values(self.outputs), 0
        while still < 10:
            if self._k >= SETTLING:
                raise FmuError(
                    f"it can be identified from its responses only at rest; with the inputs of the operating point "
                    f"held, it still moves after {SETTLING * self.h:g} s. Choose an operating point at which it rests, "
                    "or plants=None if it gives derivatives or its state can be set.",
                    block=self.block.label,
                )
            y = self.step()
            still = still + 1 if np.all(np.abs(y - last) <= STILL * (1.0 + np.abs(y))) else 0
            last = y
        self._steps = self._k
        self.rest.save()
        return last

    def _start_at_rest(self) -> None:
        self._begin()
        while self._k < self._steps:
            self.step()

    def return_to_rest(self) -> None:
        """Go back to the rest that `settle` has found."""
        self.rest.go_back()
        self._k = self._steps

    def check_restoring(self, y0: np.ndarray) -> None:
        """Begin every response at the start if the FMU continues otherwise from a restored state than from its start.

        Steps behind a state that is restored later may not be final (noSetFMUStatePriorToCurrentPoint). There are FMUs
        that take such a step back when the next one begins.
        """
        for name, value in self.inputs.items():
            if not self.rest.is_restored:
                return
            if self.about.find(name).is_integer or not value.size:
                continue
            pulse = np.zeros(value.shape)
            pulse.flat[0] = PULSE * max(float(np.ravel(self.about.find(name).nominals)[0]), abs(float(value.flat[0])))
            restored = self.measure_response(name, pulse, FEW)
            self.rest.give_up()
            change = self.measure_response(name, pulse, FEW) - y0
            allowed = ALIKE * np.max(np.abs(change), axis=0) + STILL * (1.0 + np.abs(y0))
            if np.all(np.abs(restored - y0 - change) <= allowed):
                self.rest.resume()

    def measure_response(self, name: str, change: np.ndarray, samples: int) -> np.ndarray:
        """Return the outputs after each step, with one input changed during the first step."""
        self.return_to_rest()
        self.instance.set_values({name: self.inputs[name] + change})
        y = [self.step()]
        self.instance.set_values({name: self.inputs[name]})
        y += [self.step() for _ in range(samples - 1)]
        return np.array(y)


def _measure_markov(runner: _Runner, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the Markov parameters G, by step, output and input, and their estimated error by output and input."""
    found, errors, n = [], [], len(runner.instance.values(runner.outputs))
    for name, value in runner.inputs.items():
        variable = runner.about.find(name)
        if variable.is_integer:  # it has no derivatives
            found += [np.zeros((samples, n))] * variable.size
            errors += [np.zeros(n)] * variable.size
            continue
        nominals = variable.nominals
        for index in np.ndindex(*value.shape):
            d = PULSE * max(float(nominals[index]), abs(float(value[index])))
            pulse = np.zeros(value.shape)
            pulse[index] = d
            one, two = (
                (runner.measure_response(name, k * pulse, samples) - runner.measure_response(name, -k * pulse, samples))
                / (2 * k * d)
                for k in (1, 2)
            )
            found.append((4.0 * one - two) / 3.0)
            errors.append(np.max(np.abs(two - one), axis=0) / 3.0)
    if not found:
        return np.zeros((samples, n, 0)), np.zeros((n, 0))
    return np.stack(found, axis=2), np.stack(errors, axis=1)


def _space_offsets(most: int) -> np.ndarray:
    """Return the offsets 0, 1, 2, …, then with growing distances, up to ``most``."""
    wide = np.round(np.geomspace(1, most, 40)).astype(int)
    found: np.ndarray = np.unique(np.concatenate([np.arange(min(8, most + 1)), wide]))
    return found


def realize(G: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C with C Aᵏ⁻¹ B = Gₖ, of the lowest order that explains G, and all singular values.

    G are the Markov parameters from k = 1 on, of shape (N, outputs, inputs), ``noise`` their estimated errors by output
    and input.
    """
    samples, q, p = G.shape
    rows = np.max(np.abs(G), axis=(0, 2), initial=0.0)
    rows = np.where(rows > 0.0, rows, 1.0)
    scaled = G / rows[None, :, None]
    columns = np.max(np.abs(scaled), axis=(0, 1), initial=0.0)
    columns = np.where(columns > 0.0, columns, 1.0)
    scaled = scaled / columns
    offsets = _space_offsets((samples - 2) // 2)
    where = offsets[:, None] + offsets[None, :]
    m = len(offsets)

    def hankel(shift: int) -> np.ndarray:
        found: np.ndarray = scaled[where + shift].transpose(0, 2, 1, 3).reshape(m * q, m * p)
        return found

    H0, H1 = hankel(0), hankel(1)
    if not H0.size or not np.any(H0):
        return np.zeros((0, 0)), np.zeros((0, p)), np.zeros((q, 0)), np.zeros(0)
    U, sigma, Vt = np.linalg.svd(H0, full_matrices=False)
    relative = float(np.max(noise / rows[:, None] / columns, initial=0.0))
    # largest singular value of a matrix of noise
    floor = max(_NOISE * sigma[0], relative * (np.sqrt(m * q) + np.sqrt(m * p)))
    best: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    for n in range(1, int(np.sum(sigma > floor)) + 1):
        half = np.sqrt(sigma[:n])
        A = (U[:, :n].T @ H1 @ Vt[:n].T) / np.outer(half, half)
        C = (U[:q, :n] * half) * rows[:, None]
        B = (half[:, None] * Vt[:n, :p]) * columns
        error = float(np.max(np.abs(predict_markov(A, B, C, samples) - G) / (rows[:, None] * columns)))
        if best is None or error < 0.3 * best[0]:  # a further state must reduce the error clearly
            best = error, A, B, C
    if best is None:
        raise FmuError(
            "found only noise in its responses; expected that a pulse shows at an output. Take a tighter tolerance of "
            "its solver."
        )
    return best[1], best[2], best[3], sigma


def predict_markov(A: np.ndarray, B: np.ndarray, C: np.ndarray, samples: int) -> np.ndarray:
    """Return the Markov parameters C Aᵏ⁻¹ B of a model, from k = 1 on."""
    found, x = np.zeros((samples, len(C), B.shape[1])), B
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(samples):
            found[k] = C @ x
            x = A @ x
    return np.nan_to_num(found, nan=1e300, posinf=1e300, neginf=-1e300)

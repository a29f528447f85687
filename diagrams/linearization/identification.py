"""A linear model of an FMU's step from responses alone, where it gives neither derivatives nor its state.

Each input gets a pulse of one step, up and down, in runs of their own from the same rest; half the differences of the
outputs are the Markov parameters G₁, G₂, … of the step. Pulses of two sizes take away what is quadratic in them, and
show what is left. The model x⁺ = A x + B z, w = C x with C Aᵏ⁻¹ B = Gₖ is found by the eigensystem realization
algorithm (Juang and Pappa, J. Guidance 8 (1985) 620-627): the singular value decomposition of the block Hankel matrix
H[i, j] = G(1 + rᵢ + cⱼ), and of the one shifted by a step. The offsets rᵢ, cⱼ are spaced by powers, so that slow and
fast motion are in a small matrix; the order is the number of singular values above what noise explains.

A feedthrough of the FMU acts on its outputs at the end of the step; it becomes a pole at z = 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import FmuError
from ...fmus.calls import LoadedFmu
from ...fmus.running import Derivation, DerivativeMethod

SAMPLES = 1000
"""Steps of a response."""
SETTLING = 20_000
"""Most steps that are waited for until the outputs stand still."""
PULSE = 1e-2
"""Size of a pulse, relative to an input's nominal value, or its value where that is larger."""
STILL = 1e-10
"""Change of an output over a step that counts as standing still, relative to 1 + its size."""
_NOISE = 1e-10


@dataclass(frozen=True, eq=False)
class IdentifiedStep:
    """x⁺ = A x + B (z − z0), y = y0 + C x for the outputs y after a step; x is zero at the operating point.

    Attributes
    ----------
    states : tuple of str
        Made up: the FMU's own are not known.
    singular_values : ndarray
        Of the scaled Hankel matrix, all of them; the order is how many were taken.
    uncertainty : float
        Largest difference between a Markov parameter of the model and the measured one, plus the latter's own error.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    y0: np.ndarray
    states: tuple[str, ...]
    singular_values: np.ndarray
    derivation: Derivation
    uncertainty: float


def identified(
    block: Any, point: Mapping[str, Any], h: float, outputs: np.ndarray | None = None, samples: int = SAMPLES
) -> IdentifiedStep:
    """Identify a linear model of an FMU's communication step at rest.

    Parameters
    ----------
    block : Fmu
        The FMU.
    point : mapping
        Its operating point: ``t`` in s, ``inputs`` by their ports, ``state`` by name, which is set as far as it can be.
    h : float
        Length of a step in s.
    outputs : ndarray, optional
        Its outputs there; where it comes to rest elsewhere, that is an error.
    samples : int
        Steps of a response.

    Raises
    ------
    FmuError
        If with these inputs it comes to no rest, or not to that one.
    """
    runner = _Runner(block, point, h)
    try:
        y0 = runner.settle()
        if outputs is not None and not np.allclose(
            y0, outputs, rtol=1e-6, atol=1e-9 * (1.0 + np.max(np.abs(y0), initial=0.0))
        ):
            raise FmuError(
                f"by its responses alone it can be linearized only where it comes to "
                f"rest by itself from its start values: there its outputs are {y0.tolist()}, at the operating point "
                f"{np.ravel(outputs).tolist()}. Give it start values of that point, or an operating point at rest.",
                block=block.label,
            )
        G, noise = _markov(runner, samples)
    finally:
        runner.close()
    A, B, C, sigma = realization(G, noise)
    model = predicted(A, B, C, len(G))
    error = float(np.max(np.abs(model - G), initial=0.0) + np.max(noise, initial=0.0))
    states, derivation = (
        tuple(f"mode[{i}]" for i in range(len(A))),
        Derivation(DerivativeMethod.IDENTIFIED, order=len(A)),
    )
    return IdentifiedStep(A, B, C, y0, states, sigma, derivation, error)


class _Runner:
    """Runs of an FMU from one rest."""

    def __init__(self, block: Any, point: Mapping[str, Any], h: float):
        self.block, self.about, self.h, self.t0 = block, block.description, h, float(point["t"])
        back = {new: old for old, new in block.rename.items()}
        self.inputs = {back.get(port, port): np.array(v, dtype=float) for port, v in point["inputs"].items()}
        self.start = {n: v for n, v in point["state"].items() if self.about.variables[n].initial == "exact"}
        self.outputs = list(self.about.of("output"))
        self.instance = LoadedFmu(block)
        self._steps, self._fresh = 0, True
        self._saved: Any = None
        self._begin()

    def close(self) -> None:
        """Free it."""
        if self._saved is not None:
            self.instance._fmu.freeFMUState(self._saved)
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
        _, terminate, early, _ = self.instance.call(
            f"a step by {self.h:g} s", "doStep", self.t0 + self._k * self.h, self.h, not self.about.can_save
        )
        if terminate or early:
            raise FmuError(
                "it ends a step early, so that no linear model of it can be identified. Take a smaller step.",
                block=self.block.label,
            )
        self._k += 1
        return self.instance.values(self.outputs)

    def settle(self) -> np.ndarray:
        """Step until the outputs stand still for 10 steps, and return them; `rest` then comes back to this."""
        last, still = self.instance.values(self.outputs), 0
        while still < 10:
            if self._k >= SETTLING:
                raise FmuError(
                    f"it can be identified from its responses at rest only, and with "
                    f"the inputs of the operating point held it still moves after {SETTLING * self.h:g} s. Choose an "
                    "operating point at which it rests, or plants=None where it gives derivatives, or takes "
                    "its state.",
                    block=self.block.label,
                )
            y = self.step()
            still = still + 1 if np.all(np.abs(y - last) <= STILL * (1.0 + np.abs(y))) else 0
            last = y
        self._steps = self._k
        if self.about.can_save:
            self._saved = self.instance.call("saving its state", "getFMUState")
        return last

    def rest(self) -> None:
        """Go back to the rest."""
        if self._saved is not None:
            self.instance.call("restoring its state", "setFMUState", self._saved)
            self._k = self._steps
        else:
            self._begin()
            while self._k < self._steps:
                self.step()

    def response(self, name: str, change: np.ndarray, samples: int) -> np.ndarray:
        """Return the outputs after each step, with an input changed during the first one."""
        self.rest()
        self.instance.set_values({name: self.inputs[name] + change})
        y = [self.step()]
        self.instance.set_values({name: self.inputs[name]})
        y += [self.step() for _ in range(samples - 1)]
        return np.array(y)


def _markov(runner: _Runner, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return G, (step, output, input), and the estimated error of each output by each input."""
    found, errors = [], []
    for name, value in runner.inputs.items():
        nominal = abs(runner.about.variables[name].nominal or 1.0)
        for index in np.ndindex(*value.shape):
            d = PULSE * max(nominal, abs(float(value[index])))
            pulse = np.zeros(value.shape)
            pulse[index] = d
            one, two = (
                (runner.response(name, k * pulse, samples) - runner.response(name, -k * pulse, samples)) / (2 * k * d)
                for k in (1, 2)
            )
            found.append((4.0 * one - two) / 3.0)
            errors.append(np.max(np.abs(two - one), axis=0) / 3.0)
    n = len(runner.instance.values(runner.outputs))
    if not found:
        return np.zeros((samples, n, 0)), np.zeros((n, 0))
    return np.stack(found, axis=2), np.stack(errors, axis=1)


def _offsets(most: int) -> np.ndarray:
    """Return 0, 1, 2, … and then ever wider ones up to ``most``."""
    wide = np.round(np.geomspace(1, most, 40)).astype(int)
    found: np.ndarray = np.unique(np.concatenate([np.arange(min(8, most + 1)), wide]))
    return found


def realization(G: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C with C Aᵏ⁻¹ B = Gₖ, of the lowest order that explains G, and the singular values.

    Parameters
    ----------
    G : (N, outputs, inputs) ndarray
        Markov parameters from k = 1 on.
    noise : (outputs, inputs) ndarray
        Their estimated errors.
    """
    samples, q, p = G.shape
    rows = np.max(np.abs(G), axis=(0, 2), initial=0.0)
    rows = np.where(rows > 0.0, rows, 1.0)
    scaled = G / rows[None, :, None]
    columns = np.max(np.abs(scaled), axis=(0, 1), initial=0.0)
    columns = np.where(columns > 0.0, columns, 1.0)
    scaled = scaled / columns
    offsets = _offsets((samples - 2) // 2)
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
    # the largest singular value of a matrix of noise
    floor = max(_NOISE * sigma[0], relative * (np.sqrt(m * q) + np.sqrt(m * p)))
    best: Any = None
    for n in range(1, int(np.sum(sigma > floor)) + 1):
        half = np.sqrt(sigma[:n])
        A = (U[:, :n].T @ H1 @ Vt[:n].T) / np.outer(half, half)
        C = (U[:q, :n] * half) * rows[:, None]
        B = (half[:, None] * Vt[:n, :p]) * columns
        error = float(np.max(np.abs(predicted(A, B, C, samples) - G) / (rows[:, None] * columns)))
        if best is None or error < 0.3 * best[0]:  # a state has to earn its place
            best = error, A, B, C
    if best is None:
        raise FmuError("its responses are noise: no pulse shows at an output. Take a tighter tolerance of its solver.")
    return best[1], best[2], best[3], sigma


def predicted(A: np.ndarray, B: np.ndarray, C: np.ndarray, samples: int) -> np.ndarray:
    """Return the Markov parameters of a model, from k = 1 on."""
    found, x = np.zeros((samples, len(C), B.shape[1])), B
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(samples):
            found[k] = C @ x
            x = A @ x
    return np.nan_to_num(found, nan=1e300, posinf=1e300, neginf=-1e300)

"""Coupling schemes of FMUs measured, and estimates for adaptive steps compared: python benchmarks/coupling.py.

It makes the tables and the figure of docs/explanation/coupling.md again. The schemes run on two FMUs of the library;
the estimates are compared in NumPy, on two masses with exact solutions under held forces, so that nothing but the
coupling errs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from loopwright.blocks import Gain
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, mass_spring_damper

HERE = Path(__file__).parent
PULL = 60.0
STEPS = (1 / 50, 1 / 100, 1 / 200, 1 / 400)
SCHEMES = ("jacobi", "gauss_seidel", "iterated")
LIMIT = 60_000
"""Steps of FMUs after which a method is given up."""


# --- orders of the schemes, on FMUs ---------------------------------------------------------------------------------


def two_masses() -> Diagram:
    """Return two masses on springs, each an FMU, that a gain in continuous time pulls together."""
    file = mass_spring_damper.build()
    a, b = (Fmu(file, name=name, start=start) for name, start in (("a", {}), ("b", {"mass": 2.0, "position": 0.0})))
    pull = Gain(gain=PULL, name="spring")(b.position - a.position)
    return Diagram("two", a(force=pull), b(force=-1.0 * pull))


def exactly(times: np.ndarray) -> np.ndarray:
    """Return the positions of both masses in closed form."""
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1], A[3] = [-100.0 - PULL, -1.0, PULL, 0.0], [PULL / 2, 0.0, -(100.0 + PULL) / 2, -0.5]
    return np.array([(expm(A * t) @ [0.1, 0.0, 0.0, 0.0])[[0, 2]] for t in times])


def errors_of(scheme: str) -> list[float]:
    """Return the largest errors of the positions over 1 s, for each step."""
    found = []
    for h in STEPS:
        run = two_masses().simulate(1.0, step=h, coupling=scheme, progress=False)
        found.append(float(np.abs(np.column_stack([run["a.position"], run["b.position"]]) - exactly(run.t)).max()))
    return found


# --- estimates for adaptive steps, in NumPy -----------------------------------------------------------------------

A_ONE = np.array([[0.0, 1.0], [-100.0, -1.0]])
A_TWO = np.array([[0.0, 1.0], [-0.5, -0.2]])
B_ONE, B_TWO = np.array([0.0, 1.0]), np.array([0.0, 0.05])
LINK = np.array([[-400.0, -8.0, 400.0, 8.0]])  # spring and damper between them: force on the first one
START = np.array([0.1, 0.0, 0.0, 0.0])
END = 10.0
"""A light mass rings down in a second, then follows a heavy one that moves slowly."""


class Half:
    """The solution of one mass under a held force, by eigenvalues."""

    def __init__(self, A: np.ndarray, B: np.ndarray):
        self.values, self.vectors = np.linalg.eig(A)
        self.inverse = np.linalg.inv(self.vectors)
        self.rest = -np.linalg.solve(A, B)  # where a unit force holds it

    def step(self, x: np.ndarray, force: float, h: float) -> np.ndarray:
        """Return the states after a step."""
        rest = self.rest * force
        grown = np.exp(self.values * h) * (self.inverse @ (x - rest))
        return rest + (self.vectors @ grown).real


ONE, TWO = Half(A_ONE, B_ONE), Half(A_TWO, B_TWO)


@dataclass
class Pair:
    """Two masses with an exact solution under held forces; it counts the steps that they take."""

    calls: int = 0

    def step(self, x: np.ndarray, force: float, h: float) -> np.ndarray:
        """Return the states after a step with a held force."""
        self.calls += 2
        return np.concatenate([ONE.step(x[:2], force, h), TWO.step(x[2:], -force, h)])

    @staticmethod
    def force(x: np.ndarray) -> float:
        """Return the force between the masses."""
        return float(LINK[0] @ x)


def truth(times: np.ndarray) -> np.ndarray:
    """Return the states in closed form."""
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = A_ONE, A_TWO
    A += np.outer(np.concatenate([B_ONE, -B_TWO]), LINK[0])
    values, vectors = np.linalg.eig(A)
    return ((np.exp(np.outer(times, values)) * np.linalg.solve(vectors, START)) @ vectors.T).real


def held(pair: Pair, x: np.ndarray, h: float) -> np.ndarray:
    """Take a step with the force of its beginning: Jacobi."""
    return pair.step(x, pair.force(x), h)


def iterated(pair: Pair, x: np.ndarray, h: float) -> np.ndarray:
    """Repeat a step with the mean force until it agrees, by the secant method."""
    first = pair.force(x)
    guesses, found, made = [first], [], x
    for _ in range(20):
        made = pair.step(x, 0.5 * (first + guesses[-1]), h)
        found.append(pair.force(made))
        off = [f - g for f, g in zip(found, guesses, strict=True)]
        if abs(off[-1]) < 1e-9 * (1.0 + abs(found[-1])):
            break
        if len(off) > 1:
            slope = (found[-1] - found[-2]) / (off[-1] - off[-2])
            guesses.append(found[-1] - slope * off[-1])
        else:
            guesses.append(found[-1])
    return made


Path_ = Iterator[tuple[float, np.ndarray]]
Method = Callable[[Pair, float], Path_]


def fixed(step: Callable[[Pair, np.ndarray, float], np.ndarray]) -> Method:
    """Return steps of one length."""

    def run(pair: Pair, h: float) -> Path_:
        x, n = START, round(END / h)
        for k in range(n):
            x = step(pair, x, END / n)
            yield (k + 1) * END / n, x

    return run


def doubled(step: Callable[[Pair, np.ndarray, float], np.ndarray], order: int) -> Method:
    """Return steps whose error is estimated by step doubling; the halves stay."""

    def run(pair: Pair, error: float) -> Path_:
        t, x, h = 0.0, START, 0.1
        while t < END:
            h = min(h, END - t)
            coarse = step(pair, x, h)
            half = step(pair, x, 0.5 * h)
            fine = step(pair, half, 0.5 * h)
            off = np.abs(fine - coarse).max() / (2.0**order - 1.0) / error
            if off <= 1.0:
                yield t + 0.5 * h, half
                t, x = t + h, fine
                yield t, x
            h *= min(4.0, max(0.2, 0.9 * max(off, 1e-12) ** (-1.0 / (order + 1))))

    return run


def energy_controlled(pair: Pair, error: float) -> Path_:
    """Control the step by the energy that the coupling adds in it (ECCO): no step is repeated.

    Sadjina, Kyllingstad, Skjong, Pedersen (2017): the residual power of a bond is the force that was held, less the one
    at the end, times the velocity; its energy over the step goes into a controller with proportional and integral part.
    """
    t, x, h, last = 0.0, START, 1e-3, 1.0
    while t < END:
        h = min(h, END - t)
        force = pair.force(x)
        x = pair.step(x, force, h)
        t += h
        yield t, x
        power = abs((pair.force(x) - force) * (x[1] - x[3]))
        off = max(power * h / error, 1e-12)
        h *= min(4.0, max(0.2, 0.8 * off**-0.15 * (off / last) ** -0.2))
        last = off


def corrected(pair: Pair, h: float) -> Path_:
    """Add the error of the last step's held force to the next one (NEPCE): nearly energy-preserving, without rollback.

    Benedikt, Watzenig, Zehetner, Hofer (2013). With held inputs the force is extrapolated to the middle of the step.
    """
    x, n = START, round(END / h)
    before = pair.force(x)
    for k in range(n):
        force = pair.force(x)
        x = pair.step(x, 1.5 * force - 0.5 * before, END / n)
        before = force
        yield (k + 1) * END / n, x


def predicted(pair: Pair, error: float) -> Path_:
    """Control the step by the difference of the held force and the one at its end, times h²/2: no step is repeated.

    It is the local error of the position under a force that changes linearly (Busch, Schweizer 2011).
    """
    t, x, h = 0.0, START, 1e-3
    while t < END:
        h = min(h, END - t)
        force = pair.force(x)
        x = pair.step(x, force, h)
        t += h
        yield t, x
        off = max(abs(pair.force(x) - force) * h * 0.5 / error, 1e-12)
        h *= min(4.0, max(0.2, 0.9 * off ** (-1.0 / 2.0)))


METHODS: dict[str, tuple[Method, tuple[float, ...]]] = {
    "Jacobi, fixed steps": (fixed(held), tuple(0.01 / 2**k for k in range(9))),
    "NEPCE, fixed steps": (corrected, tuple(0.01 / 2**k for k in range(7))),
    "iterated, fixed steps": (fixed(iterated), tuple(0.04 / 2**k for k in range(7))),
    "Jacobi, ECCO": (energy_controlled, tuple(10.0**-k for k in np.arange(3.0, 9.1, 0.5))),
    "Jacobi, difference of the input": (predicted, tuple(10.0**-k for k in np.arange(2.0, 7.1, 0.5))),
    "Jacobi, step doubling": (doubled(held, 1), tuple(10.0**-k for k in np.arange(2.0, 7.6, 0.5))),
    "iterated, step doubling": (doubled(iterated, 2), tuple(10.0**-k for k in np.arange(2.0, 8.1, 0.5))),
}


def measure(method: Method, options: tuple[float, ...], *, most: int = LIMIT) -> list[tuple[float, int]]:
    """Return largest error of the positions and number of FMU steps for each option."""
    found = []
    for option in options:
        pair = Pair()
        times, states = [], []
        for t, x in method(pair, option):
            times.append(t)
            states.append(x)
            if pair.calls > most or not np.all(np.abs(x) < 1e3):
                break
        else:
            off = np.array(states) - truth(np.array(times))
            found.append((float(np.abs(off[:, [0, 2]]).max()), pair.calls))
    return found


def calls_for(found: list[tuple[float, int]], error: float) -> float:
    """Return the number of FMU steps at which the error has fallen to a value; NaN where it never has."""
    below = [calls for off, calls in found if off <= error]
    return float(min(below)) if below else float("nan")


def main() -> None:
    """Print the tables, and save the figure where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="file of the figure, such as docs/images/coupling.png")
    arguments = parser.parse_args()
    print("| scheme | " + " | ".join(f"h = 1/{round(1 / h)} s" for h in STEPS) + " | order |")
    schemes = {scheme: errors_of(scheme) for scheme in SCHEMES}
    for scheme, errors in schemes.items():
        order = np.log2(errors[-2] / errors[-1])
        print(f"| {scheme} | " + " | ".join(f"{e:.2e}" for e in errors) + f" | {order:.2f} |")
    found = {name: measure(*made) for name, made in METHODS.items()}
    print("| method | error 1e-3 | error 1e-4 | error 1e-5 |")
    for name, pairs in found.items():
        cells = [f"{n:.0f}" if (n := calls_for(pairs, e)) < LIMIT else f"> {LIMIT}" for e in (1e-3, 1e-4, 1e-5)]
        print(f"| {name} | " + " | ".join(cells) + " |")
    if arguments.figure:
        draw(schemes, found, arguments.figure)


def draw(schemes: dict[str, list[float]], found: dict[str, list[tuple[float, int]]], file: Path) -> None:
    """Save the figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for scheme, errors in schemes.items():
        left.loglog(STEPS, errors, "o-", label=scheme)
    left.set(xlabel="communication step in s", ylabel="largest error of a position in m", title="two FMUs, fixed steps")
    for name, pairs in found.items():
        right.loglog([calls for _, calls in pairs], [off for off, _ in pairs], ".-", label=name)
    right.set(xlabel="steps of FMUs, repeated ones too", title="fast and slow motion", ylim=(1e-7, 1e-1))
    for axes in (left, right):
        axes.grid(visible=True, which="both", alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(file, dpi=120)


if __name__ == "__main__":
    main()

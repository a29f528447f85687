"""Accuracy and time of the methods in C next to SciPy's of the same names: python benchmarks/work_precision.py.

Eleven standard problems, each with a closed form or a reference of tight tolerance that SciPy computes on plain NumPy.
For each tolerance: the largest error of a run over all samples, relative to the largest value of each state, and the
processor's time without the making of the run, the smallest of three: interpreted (programs of the virtual machine)
and compiled (generated code); one loop in C goes through both. Where a problem is plain equations, without ticks and
events, and SciPy has the method, `solve_ivp` solves it at the same tolerances, with rates in Python and for Radau
with their exact Jacobian.
With a name that ends with .png it draws error over time; benchmarks/images/work_precision.png is made so. It returns 1
where an error is more than FACTOR times SciPy's, and above rounding.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.integrate
from scipy.linalg import expm

from loopwright.blocks import Block, Event, Gain, Relay, State, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem

FACTOR = 1.1
"""Largest ratio of an error to SciPy's."""
ROUNDING = 1e-11
"""Relative error below which the ratio is one of rounding."""
TURNS = 3
G = 9.81

Rates = Callable[[float, np.ndarray], list[float]]


def block(start: list[float], rates: Rates, name: str) -> Block:
    """Return a block with these rates, from a start."""

    class Made(Block):
        x = State(start=start, output=True)

        def derivative(self, t, x, u):
            return np.stack([rate + 0.0 * t for rate in rates(t, x.x)])

    Made.__name__ = Made.__qualname__ = name
    return Made(name="system")


@dataclass(frozen=True)
class Case:
    """A problem: its diagram, the exact values of a signal at its samples, and how it is run."""

    name: str
    diagram: Diagram
    signal: str
    exact: Callable[[np.ndarray], np.ndarray]
    duration: float
    step: float | None
    solvers: tuple[str, ...]
    atol: float = 1e-3
    """Absolute tolerance, relative to ``rtol``."""
    plain: tuple[list[float], Rates] | None = None
    """Start and rates, for SciPy; None where ticks or events act."""


def by_scipy(start: list[float], rates: Rates, method: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return the states at some times by SciPy at a tight tolerance."""

    def exact(t: np.ndarray) -> np.ndarray:
        # Tolerances near rounding; those of the states of Robertson's and HIRES' are small
        found = scipy.integrate.solve_ivp(
            lambda t, x: np.array(rates(t, x)), (0.0, t[-1]), start, method, t, rtol=3e-13, atol=1e-15
        )
        return found.y.T

    return exact


def system(
    name: str, start: list[float], rates: Rates, duration: float, solvers: tuple[str, ...], method: str, **more: float
) -> Case:
    """Return a case whose reference is SciPy's."""
    diagram = Diagram(re.sub(r"\W+", "_", name), block(start, rates, "System"))
    exact = by_scipy(start, rates, method)
    return Case(name, diagram, "system.x", exact, duration, duration / 200, solvers, plain=(start, rates), **more)


def kepler(t: np.ndarray, e: float = 0.6) -> np.ndarray:
    """Return the positions and velocities of a body on an ellipse, by Kepler's equation."""
    E = t.copy()
    for _ in range(50):
        E -= (E - e * np.sin(E) - t) / (1.0 - e * np.cos(E))
    root, rate = np.sqrt(1.0 - e * e), 1.0 / (1.0 - e * np.cos(E))
    return np.array([np.cos(E) - e, root * np.sin(E), -np.sin(E) * rate, root * np.cos(E) * rate]).T


class Ball(Block):
    """A ball that loses no energy."""

    x = State(start=[1.0, 0.0], output=True)
    impact = Event("falling")

    def derivative(self, t, x, u):
        return np.stack([x.x[1], -G + 0.0 * t])

    def indicators(self, t, x, u):
        return x.x[0]

    def jump(self, t, x, u, fired):
        return np.stack([0.0 * x.x[0], -x.x[1]])


def bouncing(t: np.ndarray) -> np.ndarray:
    """Return height and speed of the ball."""
    half = np.sqrt(2.0 / G)
    s = np.mod(t + half, 2.0 * half) - half
    return np.array([1.0 - 0.5 * G * s**2, -G * s]).T


def thermostat() -> Diagram:
    """A lag that a relay heats."""
    room, relay = (
        TransferFunction(numerator=1.0, denominator=[2.0, 1.0], name="room"),
        Relay(on_point=1.0, off_point=0.9),
    )
    return Diagram("thermostat", room(Gain(gain=-1.5)(relay(room.y)) + 1.5))


def heated(t: np.ndarray) -> np.ndarray:
    """Return the temperature of the room."""
    first, cooling, heating = 2.0 * np.log(3.0), 2.0 * np.log(1.0 / 0.9), 2.0 * np.log(0.6 / 0.5)
    s = np.mod(t - first, cooling + heating)
    later = np.where(s < cooling, np.exp(-0.5 * s), 1.5 - 0.6 * np.exp(-0.5 * (s - cooling)))
    return np.where(t < first, 1.5 - 1.5 * np.exp(-0.5 * t), later)[:, None]


def pi_loop() -> Diagram:
    """A PI controller at 1 kHz around two lags."""

    @subsystem(sample_time=1e-3, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 2.0 * error + 5.0 * memory(memory.y + 1e-3 * error)

    first = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="first")
    second = TransferFunction(numerator=1.0, denominator=[0.02, 1.0], name="second")
    return Diagram("loop", second(first(controller(second.y))))


def controlled(t: np.ndarray) -> np.ndarray:
    """Return the output of that loop at its ticks."""
    A = np.array([[-20.0, 0.0], [50.0, -50.0]])
    step = expm(1e-3 * np.vstack([np.hstack([A, [[20.0], [0.0]]]), np.zeros((1, 3))]))
    x, integral, found = np.zeros(2), 0.0, []
    for _ in t:
        found.append(x[1])
        error = 1.0 - x[1]
        x, integral = step[:2, :2] @ x + step[:2, 2] * (2.0 * error + 5.0 * integral), integral + 1e-3 * error
    return np.array(found)[:, None]


def robertson(t: float, y: np.ndarray) -> list[float]:
    """Return the rates of Robertson's reaction."""
    first, second, third = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] * y[1]
    return [second - first, first - second - third, third]


def hires(t: float, y: np.ndarray) -> list[float]:
    """Return the rates of HIRES (Hairer, Wanner II, IV.10)."""
    p = 280.0 * y[5] * y[7]
    return [
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
        1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
        8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
        -p + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        p - 1.81 * y[6],
        -p + 1.81 * y[6],
    ]


def van_der_pol(mu: float) -> Rates:
    """Return the rates of van der Pol's equation."""
    return lambda t, x: [x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0]]


def lorenz(t: float, x: np.ndarray) -> list[float]:
    """Return the rates of Lorenz' equations."""
    return [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1], x[0] * x[1] - 8.0 / 3.0 * x[2]]


EXPLICIT, STIFF = ("RK45", "DOP853"), ("auto", "Radau")


def cases() -> list[Case]:
    """Return the problems."""
    around: Rates = lambda t, x: [x[2], x[3], *(-x[:2] / np.hypot(x[0], x[1]) ** 3)]  # noqa: E731
    body = [0.4, 0.0, 0.0, 2.0], around
    swing: tuple[list[float], Rates] = [1.0, 0.0], lambda t, x: [x[1], -25.0 * x[0]]
    return [
        Case(
            "oscillator",
            Diagram("oscillator", block(*swing, "Swing")),
            "system.x",
            lambda t: np.array([np.cos(5.0 * t), -5.0 * np.sin(5.0 * t)]).T,
            10.0,
            0.05,
            ("RK23", *EXPLICIT, "Radau"),
            plain=swing,
        ),
        system("van der Pol, 1", [2.0, 0.0], van_der_pol(1.0), 20.0, EXPLICIT, "DOP853"),
        system("van der Pol, 1000", [2.0, 0.0], van_der_pol(1000.0), 2000.0, STIFF, "Radau"),
        system("Robertson", [1.0, 0.0, 0.0], robertson, 1000.0, STIFF, "Radau", atol=1e-6),
        system(
            "Brusselator",
            [1.5, 3.0],
            lambda t, x: [1.0 + x[0] ** 2 * x[1] - 4.0 * x[0], 3.0 * x[0] - x[0] ** 2 * x[1]],
            20.0,
            EXPLICIT,
            "DOP853",
        ),
        Case(
            "two bodies", Diagram("bodies", block(*body, "Body")), "system.x", kepler, 20.0, 0.1, EXPLICIT, plain=body
        ),
        system("Lorenz", [1.0, 1.0, 1.0], lorenz, 5.0, EXPLICIT, "DOP853"),
        system("HIRES", [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057], hires, 321.8122, STIFF, "Radau", atol=1e-3),
        Case("bouncing ball", Diagram("ball", Ball(name="ball")), "ball.x", bouncing, 10.0, 0.05, ("RK45", "Radau")),
        Case("thermostat", thermostat(), "room.y", heated, 40.0, 0.1, ("RK45", "Radau")),
        Case("PI loop at 1 kHz", pi_loop(), "second.y", controlled, 0.5, None, ("rk4", "RK45", "Radau")),
    ]


@dataclass(frozen=True)
class Result:
    """Errors, and times in s, of a problem with one solver at one tolerance: interpreted, compiled, SciPy's or NaN."""

    case: str
    solver: str
    rtol: float
    errors: tuple[float, float, float]
    times: tuple[float, float, float]


def slope_of(rates: Rates) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return the Jacobian of polynomial rates, exact but for rounding, by steps in the imaginary direction."""

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        moved = (np.array(rates(t, x + 1e-30j * way)) for way in np.eye(len(x)))
        return np.array([column.imag / 1e-30 for column in moved]).T

    return slope


def measure(case: Case, solver: str, rtol: float, exact: np.ndarray | None) -> tuple[Result, np.ndarray]:
    """Return the result of a problem, and its exact values."""
    tolerances = {"rtol": rtol, "atol": rtol * case.atol}
    options = {"solver": solver, **tolerances, **({} if case.step is None else {"step": case.step})}
    found, times = [], []
    for form in (False, True):
        spent = []
        for _ in range(TURNS):
            with case.diagram.simulation(compile=form, **options) as simulation:
                started = time.thread_time()
                simulation.advance(case.duration)
                spent.append(time.thread_time() - started)
                run = simulation.run(final=False)
        times.append(min(spent))
        if exact is None:
            exact = case.exact(run.t)
        found.append(np.reshape(run[case.signal], exact.shape))
    assert exact is not None
    if case.plain is not None and hasattr(scipy.integrate, solver):
        start, rates = case.plain
        more = {**tolerances, "jac": slope_of(rates)} if solver == "Radau" else tolerances
        spent = []
        for _ in range(TURNS):
            started = time.thread_time()
            solved = scipy.integrate.solve_ivp(rates, (0.0, run.t[-1]), start, solver, run.t, **more)
            spent.append(time.thread_time() - started)
        times.append(min(spent))
        found.append(solved.y.T)
    else:
        times.append(np.nan)
        found.append(np.full(exact.shape, np.nan))
    errors = [float(np.max(np.abs(values - exact) / np.max(np.abs(exact), axis=0))) for values in found]
    return Result(case.name, solver, rtol, (errors[0], errors[1], errors[2]), (times[0], times[1], times[2])), exact


def plot(results: list[Result], path: str) -> None:
    """Draw error over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    names, solvers = (list(dict.fromkeys(found)) for found in zip(*((r.case, r.solver) for r in results), strict=True))
    forms = (("interpreted", "o--"), ("compiled", "o-"), ("SciPy", "x:"))
    figure, axes = plt.subplots(3, 4, figsize=(14, 9), layout="constrained", sharex=True)
    for ax, name in zip(axes.flat, names, strict=False):
        for i, solver in enumerate(solvers):
            own = [r for r in results if (r.case, r.solver) == (name, solver)]
            for form, (_, style) in enumerate(forms):
                at = [(r.times[form], max(r.errors[form], 1e-16)) for r in own]
                if own and not np.isnan(at).any():
                    ax.loglog(*zip(*at, strict=True), style, color=f"C{i}", markersize=4)
        ax.set(title=name)
        ax.tick_params(labelbottom=True)
    for ax in axes.flat[len(names) :]:
        ax.axis("off")
    drawn = [Line2D([], [], color=f"C{i}", label=solver) for i, solver in enumerate(solvers)]
    drawn += [
        Line2D([], [], color="k", marker=style[0], linestyle=style[1:], markersize=4, label=label)
        for label, style in forms
    ]
    axes.flat[-1].legend(handles=drawn, loc="center")
    figure.supxlabel("processor time, s")
    figure.supylabel("largest relative error")
    figure.savefig(path, dpi=100)


def main() -> int:
    """Print one row for each problem, solver and tolerance; 1 if an error is too large."""
    wanted = [name for name in sys.argv[1:] if not name.endswith(".png")]
    results, worst = [], 0.0
    head = f"{'problem':18} {'solver':7} {'rtol':>7} {'interpr.':>9} {'compiled':>9} {'SciPy':>9} {'ratio':>6}"
    print(f"{head} {'time, ms':>9} {'compiled':>9} {'SciPy':>9}")
    for case in cases():
        if wanted and case.name not in wanted:
            continue
        exact = None
        for solver in case.solvers:
            for rtol in (1e-4, 1e-6, 1e-8):
                result, exact = measure(case, solver, rtol, exact)
                results.append(result)
                largest, usual = max(result.errors[:2]), result.errors[2]
                ratio = usual if np.isnan(usual) else largest / usual if max(largest, usual) > ROUNDING else 1.0
                worst = max(worst, 0.0 if np.isnan(ratio) else ratio)
                errors = " ".join(f"{v:9.1e}" for v in result.errors)
                times = " ".join(f"{1e3 * v:9.2f}" for v in result.times)
                row = f"{case.name:18} {solver:7} {rtol:7.0e} {errors} {ratio:6.2f} {times}"
                print(row.replace("nan", "  -"), flush=True)
                if solver == "rk4":
                    break
    print(f"largest ratio of an error to SciPy's: {worst:.2f}; allowed {FACTOR}")
    if any(name.endswith(".png") for name in sys.argv[1:]):
        plot(results, next(name for name in sys.argv[1:] if name.endswith(".png")))
    return int(worst > FACTOR)


if __name__ == "__main__":
    raise SystemExit(main())

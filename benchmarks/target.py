"""Memory and instructions of C for a target on Cortex-M4 and M0: the table of docs/howto/c_for_a_target.md.

    python benchmarks/target.py

It needs the package's compiler and unicorn: pip install '.[build,test]'. Instructions are counted in an emulator.
"""

from __future__ import annotations

from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from loopwright import Diagram, LoopwrightError, experiments, subsystem, to_c
from loopwright.blocks import PID, DiscreteObserver, DiscreteStateSpace, Lookup1D, Saturation

TICKS = 100
COLUMNS = ("diagram", "numbers", "instance", "tables", "M4 code", "M4 tick", "M0 code", "M0 tick", "float error")


@subsystem(sample_time=1e-2)
def pid(reference, level):
    """Return the effort of a PI controller with limits."""
    return PID(kp=2.0, ki=3.0, lower=-5.0, upper=5.0, name="pi")(reference, level).named("effort")


@subsystem(sample_time=1e-3)
def current_loop(wanted, current):
    """Return the voltage."""
    return PID(kp=1.5, ki=200.0, lower=-24.0, upper=24.0, name="pi")(wanted, current)


@subsystem(sample_time=2e-3)
def speed_loop(wanted, speed):
    """Return the wanted current."""
    return PID(kp=0.4, ki=3.0, lower=-5.0, upper=5.0, name="pi")(wanted, speed)


@subsystem(sample_time=6e-3)
def position_loop(wanted, position):
    """Return the wanted speed."""
    return Saturation(lower=-20.0, upper=20.0, name="limit")(8.0 * (wanted - position))


@subsystem(sample_time=1e-3)
def cascade(wanted, position, speed, current):
    """Return the voltage of a cascade at three rates."""
    return current_loop(speed_loop(position_loop(wanted, position), speed), current).named("voltage")


@subsystem(sample_time=0.02)
def observer(wanted, y):
    """Return the force of a state feedback from an observer of a double integrator."""
    model = DiscreteStateSpace(A=[[1.0, 0.02], [0.0, 1.0]], B=[0.0002, 0.02], C=[1.0, 0.0], D=0.0, dt=0.02)
    estimate = DiscreteObserver(model, [0.4, 2.2], name="observer")
    u = (9.0 * (wanted - estimate.x_hat[0]) - 5.0 * estimate.x_hat[1]).named("u")
    estimate(u, y)
    return u


@subsystem(sample_time=0.01)
def table(angle):
    """Return a gain from a cubic table of 16 points."""
    points = np.linspace(-2.0, 2.0, 16)
    return Lookup1D(breakpoints=points, values=np.exp(-(points**2)), interpolation="cubic", name="gain")(angle).named(
        "u"
    )


def signals(names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return a test signal: a sine for each input, of another frequency."""
    k = np.arange(TICKS)
    return {name: np.sin(0.1 * (i + 1) * k) for i, name in enumerate(names)}


def path_following() -> tuple[Diagram, dict[str, np.ndarray]]:
    """Return the diagram of experiment C, and the inputs of its controller in a run, from the start on."""
    diagram = experiments.EXPERIMENTS["C"]().diagram
    run = diagram.simulate(0.001 * TICKS, progress=False)
    found = {}
    for (path, argument), wire in diagram.structure.arguments.items():
        if path == "controller":
            values = run[f"{wire.block}.{wire.port}"][:TICKS]
            found[argument] = values if wire.index is None else values[:, wire.index]
    return diagram, found


def row(label: str, model: Any, inputs: dict[str, np.ndarray], number: str, **options: Any) -> str:
    """Return a row of the table."""
    with TemporaryDirectory() as folder:
        code = to_c(model, folder, number=number, own_functions=True, **options)
        cells = [label, number, str(code.bytes_of["struct"]), str(code.bytes_of["tables"])]
        try:
            measured = code.measure(inputs, ticks=TICKS)
        except LoopwrightError as error:
            return "| " + " | ".join([*cells, "", "", "", "", str(error).partition(". ")[0]]) + " |"
        for one in measured.processors:
            bound = f" (bound {one.bound})" if one.bound is not None else ""
            cells += [str(one.code), f"{one.largest}{bound}"]
        worst = max(measured.float_error.values(), default=0.0)
        return "| " + " | ".join([*cells, f"{worst:.1e}" if number == "float" else ""]) + " |"


def main() -> None:
    """Print the table."""
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---" * len(COLUMNS) + "|")
    cases: list[tuple[str, Any, dict[str, np.ndarray], dict[str, Any]]] = [
        ("PI with limits", pid, signals(("reference", "level")), {}),
        ("cascade, three rates", cascade, signals(("wanted", "position", "speed", "current")), {}),
        ("observer and feedback", observer, signals(("wanted", "y")), {}),
        ("cubic table", table, signals(("angle",)), {}),
    ]
    diagram, inputs = path_following()
    cases.append(("Fig. 3's controller", diagram, inputs, {"subsystem": "controller", "name": "fig3"}))
    for label, model, test, options in cases:
        for number in ("float", "double"):
            print(row(label, model, test, number, **options), flush=True)


if __name__ == "__main__":
    main()

"""A sampled loop in the tools that a Python user can install: python benchmarks/peers.py.

A PI controller at 1 kHz around two lags, 10 s, each tool as its own documentation would write it, every tick recorded;
then the lags as an FMU (FMI 3.0, co-simulation). A row has the processor time of a tick in µs, without set-up and
without a compiler's work; its ratio to the first row, as the median of three turns, and the smallest and the largest
one; and the largest difference from the exact trajectory, which matrix exponentials give. A tool that isn't installed
has an empty row: pip install fmpy pathsim pathsim-fmi ecospy tbb bdsim drake jaxonomy.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import io
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

T, TICKS, KP, KI = 1e-3, 10_000, 4.0, 20.0
A = np.array([[-1 / 0.02, 0.0], [1 / 0.1, -1 / 0.1]])  # 1/((0.02 s + 1)(0.1 s + 1))
B, C, D = np.array([[1 / 0.02], [0.0]]), np.array([[0.0, 1.0]]), np.zeros((1, 1))
Timed = tuple[float, np.ndarray]  # processor time of a tick in s, and the output at the ticks


def solve_exactly() -> np.ndarray:
    """Return the output at the ticks."""
    both = expm(np.block([[A, B], [np.zeros((1, 3))]]) * T)
    x, integral, y = np.zeros(2), 0.0, np.zeros(TICKS + 1)
    for k in range(TICKS + 1):
        y[k] = x[1]
        u = KP * (1.0 - y[k]) + integral
        integral += KI * T * (1.0 - y[k])
        x = both[:2, :2] @ x + both[:2, 2] * u
    return y


def timed(action: Callable[[], object]) -> float:
    """Return the processor time of a call in s, the least of three."""
    best = float("inf")
    for _ in range(3):
        started = time.process_time()
        action()
        best = min(best, time.process_time() - started)
    return best


def _ours(plant, **options) -> Timed:
    from loopwright.blocks import Constant, Integrator
    from loopwright.diagrams import Diagram, subsystem

    @subsystem(sample_time=T)
    def controller(e):
        return KP * e + Integrator(name="integral")(KI * e)

    y = plant.y.named("y")
    diagram = Diagram("loop", plant(controller(Constant(value=1.0) - y)))
    with diagram.simulation(**options) as simulation:
        simulation.advance(T)
        started = time.process_time()
        simulation.advance(T * (TICKS - 1))
        took = time.process_time() - started
        y = np.ravel(simulation.run(final=False)["y"])
    return took / (TICKS - 1), y


def run_loopwright(*, compiled: bool) -> Timed:
    """Blocks, the solver of the diagram."""
    from loopwright.blocks import StateSpace

    return _ours(StateSpace(A=A, B=B, C=C, D=D, name="plant"), compile=compiled)


def run_python_control() -> Timed:
    """The plant sampled exactly, a discrete system."""
    import control

    def simulate() -> np.ndarray:
        plant = control.ss(A, B, C, D).sample(T)
        pi = control.ss([[1.0]], [[KI * T]], [[1.0]], [[KP]], T)
        loop = control.feedback(plant * pi, 1)
        return np.ravel(control.forced_response(loop, np.arange(TICKS + 1) * T, np.ones(TICKS + 1)).outputs)

    return timed(simulate) / TICKS, simulate()


def run_drake() -> Timed:
    """Drake's systems; a zero-order hold samples the command."""
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder
    from pydrake.systems.primitives import (
        Adder,
        ConstantVectorSource,
        Gain,
        LinearSystem,
        LogVectorOutput,
        ZeroOrderHold,
    )

    builder = DiagramBuilder()
    plant = builder.AddSystem(LinearSystem(A, B, C, D))
    pi = builder.AddSystem(LinearSystem([[1.0]], [[KI * T]], [[1.0]], [[KP]], T))
    hold, minus, add = (builder.AddSystem(s) for s in (ZeroOrderHold(T, 1), Gain(-1.0, 1), Adder(2, 1)))
    reference = builder.AddSystem(ConstantVectorSource([1.0]))
    builder.Connect(plant.get_output_port(), minus.get_input_port())
    builder.Connect(reference.get_output_port(), add.get_input_port(0))
    builder.Connect(minus.get_output_port(), add.get_input_port(1))
    builder.Connect(add.get_output_port(), pi.get_input_port())
    builder.Connect(pi.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_input_port())
    log = LogVectorOutput(plant.get_output_port(), builder, T)
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    started = time.process_time()
    simulator.AdvanceTo(TICKS * T)
    took = time.process_time() - started
    return took / TICKS, log.FindLog(simulator.get_context()).data()[0]


def _pathsim(plant, ticks: int) -> Timed:
    from pathsim import Connection, Simulation
    from pathsim.blocks import Adder, Constant, Scope, Wrapper
    from pathsim.solvers import RKDP54

    integral = [0.0]

    def pi(e: float) -> float:
        u = KP * e + integral[0]
        integral[0] += KI * T * e
        return u

    reference, add, controller, scope = Constant(1.0), Adder("+-"), Wrapper(pi, T=T), Scope(sampling_period=T)
    wires = [
        Connection(reference, add[0]),
        Connection(plant, add[1], scope),
        Connection(add, controller),
        Connection(controller, plant),
    ]
    blocks = [reference, add, controller, plant, scope]
    simulation = Simulation(
        blocks, wires, dt=T, Solver=RKDP54, tolerance_lte_rel=1e-8, tolerance_lte_abs=1e-8, log=False
    )
    started = time.process_time()
    simulation.run(ticks * T)
    took = time.process_time() - started
    t, (y,) = scope.read()
    return took / ticks, np.interp(np.arange(ticks + 1) * T, t, y)


def run_pathsim() -> Timed:
    """A Wrapper block, called at every tick, around a state space; a tenth of the time."""
    from pathsim.blocks import StateSpace

    return _pathsim(StateSpace(A, B, C, D), TICKS // 10)


def run_jaxonomy() -> Timed:
    """Jaxonomy's blocks, compiled by JAX; the second run is timed."""
    import jaxonomy
    from jaxonomy.library import Adder, Constant, LTISystem, PIDDiscrete, ZeroOrderHold

    builder = jaxonomy.DiagramBuilder()
    reference, add = builder.add(Constant(1.0)), builder.add(Adder(2, operators="+-"))
    pi, hold = builder.add(PIDDiscrete(dt=T, kp=KP, ki=KI, kd=0.0)), builder.add(ZeroOrderHold(dt=T))
    plant = builder.add(LTISystem(A, B, C, D))
    for source, block, port in ((reference, add, 0), (plant, add, 1), (add, pi, 0), (pi, hold, 0), (hold, plant, 0)):
        builder.connect(source.output_ports[0], block.input_ports[port])
    diagram = builder.build()
    context = diagram.create_context()
    options = jaxonomy.SimulatorOptions(max_major_steps=2 * TICKS + 100, rtol=1e-8, atol=1e-10)

    def simulate():
        recorded = {"y": plant.output_ports[0]}
        return jaxonomy.simulate(diagram, context, (0.0, TICKS * T), options=options, recorded_signals=recorded)

    simulate()
    took, found = timed(simulate), simulate()
    y = np.interp(np.arange(TICKS + 1) * T, np.asarray(found.time), np.ravel(found.outputs["y"]))
    return took / TICKS, y


def run_bdsim() -> Timed:
    """Bdsim's blocks, which act from the second tick on: its trajectory is shifted by a tick; a tenth of the time."""
    import bdsim

    ticks = TICKS // 10
    simulator = bdsim.BDSim(graphics=False, progress=False, banner=False, quiet=True)
    diagram = simulator.blockdiagram()
    clock = diagram.clock(T, "s")
    reference, error, gain = diagram.CONSTANT(1.0), diagram.SUM("+-"), diagram.GAIN(KP)
    integral, total, hold = diagram.INTEGRATOR_S(clock, gain=KI), diagram.SUM("++"), diagram.ZOH(clock)
    plant = diagram.LTI_SS(A=A, B=B, C=C)
    for source, *ends in (
        (reference, error[0]),
        (plant, error[1]),
        (error, gain, integral),
        (gain, total[0]),
        (integral, total[1]),
        (total, hold),
        (hold, plant),
    ):
        diagram.connect(source, *ends)
    diagram.compile()
    started = time.process_time()
    tolerances = {"rtol": 1e-8, "atol": 1e-10}
    out = simulator.run(diagram, T=ticks * T, dt=T, watch=[plant], solver="RK45", solver_args=tolerances)
    took = time.process_time() - started
    return took / ticks, np.interp(np.arange(ticks) * T, np.asarray(out.t) - T, np.ravel(out.y))


def _export() -> Path:
    from loopwright.blocks import StateSpace
    from loopwright.fmus import build

    return build(StateSpace(A=A, B=B, C=C, D=D), name="two_lags", internal_step=T / 4)


def run_loopwright_fmu(*, compiled: bool) -> Timed:
    """The FMU as a block."""
    from loopwright.fmus import Fmu

    return _ours(Fmu(_export(), name="plant"), compile=compiled)


def run_fmpy() -> Timed:
    """FMPy's calls, and the controller in Python."""
    from fmpy import extract, read_model_description
    from fmpy.fmi3 import FMU3Slave

    description = read_model_description(str(_export()))
    references = {v.name: v.valueReference for v in description.modelVariables}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        extract(str(_export()), folder)
        fmu = FMU3Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="plant",
        )
        fmu.instantiate()
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        u, y, integral, found = [references["u"]], [references["y"]], 0.0, np.zeros(TICKS + 1)
        started = time.process_time()
        for k in range(TICKS):
            (found[k],) = fmu.getFloat64(y)
            error = 1.0 - found[k]
            fmu.setFloat64(u, [KP * error + integral])
            integral += KI * T * error
            fmu.doStep(k * T, T)
        (found[TICKS],) = fmu.getFloat64(y)
        took = time.process_time() - started
        fmu.terminate()
        fmu.freeInstance()
    return took / TICKS, found


def run_ecospy() -> Timed:
    """Ecos' simulation of a structure; a listener is the controller, which acts before each step.

    Its library needs oneTBB: pip install tbb, which the loader finds by its name once it is loaded.
    """
    with contextlib.suppress(OSError):
        ctypes.CDLL(str(Path(sys.prefix) / "lib" / "libtbb.so.12"), mode=ctypes.RTLD_GLOBAL)
    from ecospy import EcosSimulation, EcosSimulationStructure, SimulationListener

    class Controller(SimulationListener):
        def __init__(self, simulation: EcosSimulation):
            self.simulation, self.integral, self.found = simulation, 0.0, list[float]()

        def pre(self, info: object) -> None:
            y = self.simulation.get_real("plant::y")
            self.found.append(y)
            self.simulation.set_real("plant::u", KP * (1.0 - y) + self.integral)
            self.integral += KI * T * (1.0 - y)

    with EcosSimulationStructure() as structure:
        structure.add_model("plant", _export())
        with EcosSimulation(structure=structure, step_size=T) as simulation:
            controller = Controller(simulation)
            simulation.add_listener("controller", controller)
            simulation.init()
            started = time.process_time()
            simulation.step(TICKS)
            took = time.process_time() - started
            controller.found.append(simulation.get_real("plant::y"))
    return took / TICKS, np.array(controller.found)


def run_pathsim_fmi() -> Timed:
    """Pathsim's block of an FMU, and the controller of its row above; a tenth of the time.

    The block puts out the end of a step at its beginning: its trajectory is shifted by a tick.
    """
    from pathsim_fmi import CoSimulationFMU

    took, y = _pathsim(CoSimulationFMU(str(_export()), dt=T), TICKS // 10)
    return took, np.concatenate([[0.0], y[:-1]])


ROWS: dict[str, dict[str, tuple[str, Callable[[], Timed]]]] = {
    "two lags as blocks": {
        "Loopwright, compiled": ("loopwright", lambda: run_loopwright(compiled=True)),
        "Loopwright, interpreted": ("loopwright", lambda: run_loopwright(compiled=False)),
        "jaxonomy": ("jaxonomy", run_jaxonomy),
        "python-control (plant sampled beforehand)": ("control", run_python_control),
        "Drake": ("pydrake", run_drake),
        "pathsim": ("pathsim", run_pathsim),
        "bdsim": ("bdsim", run_bdsim),
    },
    "two lags as an FMU": {
        "Loopwright, compiled": ("loopwright", lambda: run_loopwright_fmu(compiled=True)),
        "Loopwright, interpreted": ("loopwright", lambda: run_loopwright_fmu(compiled=False)),
        "FMPy, controller in Python": ("fmpy", run_fmpy),
        "ecospy, controller in Python ": ("ecospy", run_ecospy),
        "pathsim-fmi": ("pathsim_fmi", run_pathsim_fmi),
    },
}


TURNS = 3


@dataclass(frozen=True)
class Row:
    """A tool's times of a tick in s, turn by turn; without any, its end says why. Else it is the largest error."""

    times: list[float]
    end: str


def measure(exact: np.ndarray, tools: dict[str, tuple[str, Callable[[], Timed]]]) -> dict[str, Row]:
    """Return the rows of some tools, which take turns."""
    found = {name: Row([], "not installed") for name in tools}
    for _ in range(TURNS):
        for name, (package, run) in tools.items():
            if importlib.util.find_spec(package) is None:
                continue
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    took, y = run()
            except Exception as error:  # a peer of another version: its row says so
                if package == "loopwright":
                    raise
                found[name] = Row([], f"{type(error).__name__}: {str(error).splitlines()[0][:60]}")
                continue
            found[name] = Row([*found[name].times, took], f"{np.abs(y - exact[: len(y)]).max():.1e}")
    return found


def show(rows: dict[str, Row]) -> None:
    """Print rows; the first one is what the others are compared with."""
    first, *_ = rows.values()
    for name, row in rows.items():
        if len(row.times) < TURNS:
            print(f"  {name:42}       –   {row.end}")
            continue
        ratios = np.divide(row.times, first.times)
        spread = f"{ratios.min():7.1f} to {ratios.max():7.1f}"
        print(f"  {name:42} {np.median(row.times) * 1e6:7.2f}  {np.median(ratios):8.1f}  {spread}   {row.end}")


def silence() -> None:
    """Let tools keep their warnings to themselves."""
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)


def main() -> None:
    """Print one row for each tool."""
    silence()
    exact = solve_exactly()
    for title, tools in ROWS.items():
        print(f"{title:44} µs/tick  of the first  its spread          largest error")
        show(measure(exact, tools))


if __name__ == "__main__":
    sys.exit(main())

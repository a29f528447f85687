"""A run next to C that was written by hand: python benchmarks/handwritten.py [--instructions].

Experiment C, 12,000 ticks, from `handwritten/experiment_c.c`, which gcc compiles with -O3 and FMA (zig where there is
no gcc), and by `simulate`, interpreted, compiled and fused (benchmarks/README.md), everything recorded. All forms
take turns, 15 times; a figure is the ratio of the smallest times, which other work on the machine disturbs least, with
the median of the ratios within a turn. The trajectories are compared, too: the program ends with status 1 if they
differ by more than 1e-9 of a signal's largest value.

With --instructions, valgrind counts the instructions of a tick, of the C by hand and of our runs in C: the difference
between a long and a short run, so that neither the start nor Python counts. It takes a minute.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import quad
from scipy.linalg import expm

from loopwright.diagrams import experiments

SOURCE = Path(__file__).parent / "handwritten" / "experiment_c.c"
FLAGS = ("-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-std=gnu11")
TICKS, ROW, TERMS = 12_000, 57, 40
TURNS = 15
BOUND = 1e-9  # of a signal's largest value
OURS = {"interpreted": {"compile": False}, "compiled": {"compile": True}, "fused": {"compile": True, "fuse": True}}
IN_C = ("compiled", "fused")
CHILD = """
import gc, os, subprocess
from loopwright.diagrams import experiments
diagram = experiments.hand_guiding().diagram
with diagram.simulation(**{options}) as simulation:
    simulation.advance(0.1)
    gc.disable()
    switch = ["callgrind_control", "--instr=on", str(os.getpid())]
    subprocess.run(switch, check=True, stdout=subprocess.DEVNULL)
    simulation.advance({seconds})
    os._exit(0)
"""
COLUMNS = {  # where the recorded values are in a row of the hand-written C
    "position": (16, 17),
    "velocity": (20, 21),
    "motor_force": (6, 7),
    "controller.eta": (1, 2),
    "controller.xi": (11, 12),
    "controller.eta_p": (3, 4, 5),
    "controller.xi_p": (13, 14, 15),
    "hand.force": (18, 19),
}
EVERYTHING = "5 substeps, 2 projections, everything recorded"
FORMS = {  # substeps, projections, recording
    "4 substeps, 1 projection, nothing recorded": (4, 1, 0),
    "5 substeps, 1 projection, nothing recorded": (5, 1, 0),
    "5 substeps, 2 projections, nothing recorded": (5, 2, 0),
    EVERYTHING: (5, 2, 1),
}


class Task(ctypes.Structure):
    """The numbers of `task` in the C file."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("ticks", "substeps", "projections", "terms", "record")),
        ("mean_speed", ctypes.c_double),
        ("sines", ctypes.c_double * TERMS),
        ("par", ctypes.c_double * 4),
        ("par_forcing", ctypes.c_double * 2),
        ("perp", ctypes.c_double * 4),
        ("perp_forcing", ctypes.c_double * 2),
        *((name, ctypes.c_double * 2) for name in ("damping", "s", "v", "theta")),
    ]


def task(substeps: int, projections: int, record: int) -> Task:
    """Return experiment C's numbers: Table III, the ellipse (16), the start at 0.2 m."""
    a, b, T = 0.3, 0.15, 1e-3

    def speed(theta: float) -> float:
        return float(np.hypot(a * np.sin(theta), b * np.cos(theta)))

    n = 512
    speeds = np.array([speed(theta) for theta in np.pi / n * np.arange(n)])
    c = np.fft.rfft(speeds).real / n
    sines = c[1 : TERMS + 1] / np.arange(1, TERMS + 1)
    terms = int(np.argmax(np.abs(sines) < 1e-17)) or TERMS
    found = Task(ticks=TICKS, substeps=substeps, projections=projections, record=record, terms=terms)
    found.mean_speed, found.sines = c[0], (ctypes.c_double * TERMS)(*sines)
    damping = 2.0 * 0.6 * np.sqrt(0.5 * 10.0), 2.0 * 0.3 * np.sqrt(2.0 * 200.0)
    found.damping = (ctypes.c_double * 2)(*damping)
    for name, mass, stiffness, d in (("par", 0.5, 0.0, damping[0]), ("perp", 2.0, 200.0, damping[1])):
        A = np.array([[0.0, 1.0, 0.0], [-stiffness / mass, -d / mass, 1.0], [0.0, 0.0, 0.0]])
        hold = expm(A * T)
        setattr(found, name, (ctypes.c_double * 4)(*hold[:2, :2].ravel()))
        setattr(found, f"{name}_forcing", (ctypes.c_double * 2)(*hold[:2, 2]))
    theta = 0.0  # Newton on the arc length, which quadrature gives
    for _ in range(30):
        theta -= (quad(speed, 0.0, theta, epsabs=1e-14, epsrel=1e-13)[0] - 0.2) / speed(theta)
    found.s = (ctypes.c_double * 2)(0.5 + a * np.cos(theta), 0.5 + b * np.sin(theta))
    found.theta = (ctypes.c_double * 2)(theta, theta)
    return found


def compile_by_hand(folder: Path, *, shown: bool = True) -> tuple[ctypes.CDLL, Path]:
    """Return the library of the hand-written C, and a program of it for counting."""
    library, program = folder / "by_hand.so", folder / "by_hand"
    gcc = shutil.which("gcc")
    compiler = [gcc] if gcc else [sys.executable, "-m", "ziglang", "cc"]
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    processor = f"-march={'x86-64-v3' if gcc else 'x86_64_v3'}" if x86 else "-mcpu=native"
    if shown:
        print(f"C by hand is compiled by {'gcc' if gcc else 'zig cc'} {processor} {' '.join(FLAGS)}")
    for flags in (("-shared", "-fPIC", "-o", library), ("-DPROGRAM", "-o", program)):
        subprocess.run([*compiler, processor, *FLAGS, *flags, SOURCE, "-lm"], check=True)
    return ctypes.CDLL(str(library)), program


def run_by_hand(library: ctypes.CDLL, form: tuple[int, int, int], rows: np.ndarray) -> float:
    """Return the seconds of one run."""
    job = task(*form)
    started = time.perf_counter()
    library.run_by_hand(ctypes.byref(job), ctypes.c_void_p(rows.ctypes.data))
    return time.perf_counter() - started


def largest_difference(run, rows: np.ndarray) -> float:
    """Return the largest difference of a run from the hand-written trajectory, relative to each signal's size."""
    worst = 0.0
    for name, columns in COLUMNS.items():
        mine, theirs = run[name], rows[:, columns]
        worst = max(worst, float(np.abs(mine - theirs).max() / max(1e-3, np.abs(theirs).max())))
    return worst


def count_instructions(program: Path, form: tuple[int, int, int]) -> float | None:
    """Return the instructions of a tick of the hand-written C by valgrind; None where there is none."""
    if shutil.which("valgrind") is None:
        return None
    counts = []
    for ticks in (1_000, 3_000):
        job = task(*form)
        job.ticks = ticks
        with tempfile.TemporaryDirectory() as folder:
            numbers = Path(folder) / "task"
            numbers.write_bytes(bytes(job))
            counts.append(_collected([program, numbers]))
    return (counts[1] - counts[0]) / 2_000


def count_ours(form: str) -> float | None:
    """Return the instructions of a tick of one of our runs in C; None where they can't be counted.

    Counting begins behind the start, which takes a tenth of the time then. Valgrind doesn't know all instructions of a
    processor for which a fused run is compiled (AVX-512).
    """
    if shutil.which("valgrind") is None or shutil.which("callgrind_control") is None:
        return None
    counts = []
    for ticks in (1_000, 9_000):
        script = CHILD.format(options=OURS[form], seconds=ticks * 1e-3)
        try:
            counts.append(_collected([sys.executable, "-c", script], "--instr-atstart=no"))
        except subprocess.CalledProcessError as error:
            if error.returncode != -signal.SIGILL:
                raise
            return None
    return (counts[1] - counts[0]) / 8_000


def _collected(command: list[str | Path], *options: str) -> int:
    """Return the instructions of a program that valgrind has counted."""
    printed = subprocess.run(
        ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", *options, *command],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONHASHSEED": "0"},
    ).stderr
    found = re.search(r"Collected\s*:\s*(\d+)", printed)
    assert found is not None, printed
    return int(found.group(1))


@dataclass(frozen=True)
class Measured:
    """The times of all forms in s, turn by turn, and how far our trajectories are from that of the C by hand."""

    by_hand: dict[str, list[float]]
    ours: dict[str, list[float]]
    differences: dict[str, float]


def measure(library: ctypes.CDLL, turns: int = TURNS) -> Measured:
    """Let all forms take turns."""
    diagram = experiments.hand_guiding().diagram
    rows = np.zeros((TICKS + 1, ROW))
    run_by_hand(library, FORMS[EVERYTHING], rows)
    by_hand: dict[str, list[float]] = {name: [] for name in FORMS}
    ours: dict[str, list[float]] = {name: [] for name in OURS}
    found = {}
    for turn in range(turns + 1):
        seconds = {name: run_by_hand(library, form, rows) for name, form in FORMS.items()}
        for form in ours:
            with diagram.simulation(**OURS[form]) as simulation:
                simulation.advance(1e-3)  # the set-up, and the first chunk's memory
                started = time.perf_counter()
                simulation.advance((TICKS - 1) * 1e-3)
                took = time.perf_counter() - started
                found[form] = simulation.run(final=False)
            if turn:  # the first turn warms up
                ours[form].append(took)
        if turn:
            for name, value in seconds.items():
                by_hand[name].append(value)
    return Measured(by_hand, ours, {form: largest_difference(run, rows) for form, run in found.items()})


def main() -> int:
    """Print one row for each form; 1 if a trajectory differs."""
    with tempfile.TemporaryDirectory() as folder:
        library, program = compile_by_hand(Path(folder))
        found = measure(library)
        print("trajectory, largest relative difference from C by hand (5 substeps, 2 projections):")
        for form, difference in found.differences.items():
            print(f"  {form:12} {difference:.1e}")
        print(
            "\nratio = time by hand / time of the run, of the smallest times (median of the turns); 1 is as fast as C"
        )
        print(f"{'C by hand':48} {'µs/tick':>8}" + "".join(f"{name:>22}" for name in OURS))
        for name, values in found.by_hand.items():
            line = f"{name:48} {min(values) / TICKS * 1e6:8.3f}"
            for times in found.ours.values():
                ratios = [a / b for a, b in zip(values, times, strict=True)]
                line += f"  {min(values) / min(times):14.2f} ({statistics.median(ratios):4.2f}) "
            print(line)
        for form, times in found.ours.items():
            print(f"{form:48} {min(times) / TICKS * 1e6:8.3f}")
        if "--instructions" in sys.argv[1:]:
            print("\ninstructions a tick")
            for name, form in FORMS.items():
                print(f"{name:48} {tell(count_instructions(program, form)):>8}")
            for form in IN_C:
                print(f"{form:48} {tell(count_ours(form)):>8}")
    return 0 if max(found.differences.values()) < BOUND else 1


def tell(count: float | None) -> str:
    """Return a count of instructions as text."""
    return "not counted: valgrind is missing, or lacks instructions" if count is None else f"{count:.0f}"


if __name__ == "__main__":
    raise SystemExit(main())

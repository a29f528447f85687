"""What a diagram costs by its number of blocks: python benchmarks/scaling.py [picture.png].

Chains, nested boxes, a net of feedback, sampled and continuous, of 10 to 10,000 blocks. Building is what `Diagram(…)`
does, preparing is the rest until an interpreted run can start (flattening, functions, start), stepping is a tick, or
one step of RK4 with the four evaluations of the rates. Compiling is what `compile=True` adds to flattening, with a
cache that has the library. Steps in C are measured with one signal recorded, and with all. Next to them is the least
that recording can take: writing as many numbers, once each, to memory that the process has just been given.

A virtual machine may be given its memory by its host at the first touch since it was started, which took 22 ns a number
where later runs take 1. So the program first fills as much memory as all its records need, and says what that costs
the first and the second time.

Exponents are fitted over the sizes from 100 blocks on: 1 is linear. Times are the processor's, the smallest of three.
The plot goes to benchmarks/out/scaling.png, or to the picture that is named; benchmarks/images/scaling.png is one such.
"""

from __future__ import annotations

import mmap
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from loopwright.blocks import Gain, Sine, Sum, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import functions_between, write_code
from loopwright.diagrams.flat import kinds_of

SIZES = (10, 30, 100, 300, 1000, 3000, 10000)
PRIVATE = {} if sys.platform == "win32" else {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS}
LIMIT = 5.0  # s, to build a diagram of 1000 blocks


def _next(i: int, signal, sampled: bool):
    """Return the output of one more block of a chain: every other one has a state."""
    if i % 2:
        return Gain(gain=1.0 - 1e-3 * (i % 7), name=f"b{i}")(signal)
    if sampled:
        return UnitDelay(initial_value=0.0, name=f"b{i}")(signal)
    return TransferFunction(numerator=1.0, denominator=[0.05 + 1e-3 * (i % 5), 1.0], name=f"b{i}")(signal)


def _in_a_box(function, sampled: bool) -> Diagram:
    box = subsystem(sample_time=1e-3 if sampled else None, name="box")(function)
    return Diagram("scaling", box(Sine(frequency=1.0, name="source")))


def chain(n: int, sampled: bool) -> Diagram:
    """One block after the other."""

    def inside(signal):
        for i in range(1, n):
            signal = _next(i, signal, sampled)
        return signal

    return _in_a_box(inside, sampled)


def nested(n: int, sampled: bool) -> Diagram:
    """Ten blocks to a box, ten boxes to the next larger one, and so on."""

    def filled(first: int, last: int):
        def inside(signal):
            width = 10
            while last - first > width * 10:
                width *= 10
            if last - first <= 10:
                for i in range(first, last):
                    signal = _next(i, signal, sampled)
                return signal
            for start in range(first, last, width):
                signal = subsystem(name=f"box{start}")(filled(start, min(last, start + width)))(signal)
            return signal

        return inside

    return _in_a_box(filled(1, n), sampled)


def net(n: int, sampled: bool) -> Diagram:
    """Lags or delays in a ring, each driven by three others: sums, states, feedback."""

    def inside(signal):
        count = max(1, (n - 1) // 3)
        kept = [UnitDelay(initial_value=0.0, name=f"x{i}") for i in range(count)]
        if not sampled:
            kept = [TransferFunction(numerator=1.0, denominator=[0.1, 1.0], name=f"x{i}") for i in range(count)]
        for i, block in enumerate(kept):
            others = (kept[(i + 1) % count].y, kept[(7 * i + 3) % count].y, signal)
            total = Sum(signs="+-+", name=f"s{i}")(*others)
            block(Gain(gain=0.3, name=f"g{i}")(total))
        return kept[0].y

    return _in_a_box(inside, sampled)


def seconds(action, runs: int = 3) -> float:
    """Return the smallest duration of a call."""
    durations = []
    for _ in range(runs):
        started = time.process_time()
        action()
        durations.append(time.process_time() - started)
    return min(durations)


def measured(make, n: int, sampled: bool) -> tuple[float, float, float]:
    """Return the seconds for building, preparing, and a step."""
    options = {"step": 1e-3, "record": ["source"], "states": False}
    options |= {} if sampled else {"solver": "rk4"}
    build = seconds(lambda: make(n, sampled))

    def prepare() -> None:
        nonlocal diagram
        diagram = make(n, sampled)
        diagram.simulate(1e-3, progress=False, **options)

    diagram = None
    prepared = seconds(prepare) - build
    ticks = max(20, 20000 // n)
    with diagram.simulation(**options) as simulation:
        step = seconds(lambda: simulation.advance(ticks * 1e-3)) / ticks
    return build, prepared, step


def measured_in_c(make, n: int, sampled: bool) -> tuple[float, float, float, float]:
    """Return the seconds for compiling, and of a step in C with one signal recorded, with all, and to write all."""
    options = {"step": 1e-3, "compile": True} | ({} if sampled else {"solver": "rk4"})
    ticks = max(100, 300_000 // n)
    found = []
    for fewer in ({"record": ["source"], "states": False}, {}):
        with make(n, sampled).simulation(**options, **fewer) as simulation:
            simulation.advance(ticks * 1e-3)
            found.append(seconds(partial(simulation.advance, ticks * 1e-3), runs=5) / ticks)
            width = simulation.run(final=False).data.shape[1] + 1
    diagram = make(n, sampled)
    diagram.flatten(1e-3)
    return seconds(lambda: compile_again(diagram, sampled)), *found, fill(ticks * width) / ticks


def fill(numbers: int, runs: int = 5) -> float:
    """Return the seconds to write so many numbers to memory that the process has just been given."""

    def write() -> None:
        memory = mmap.mmap(-1, numbers * 8, **PRIVATE)
        if hasattr(mmap, "MADV_HUGEPAGE"):  # as NumPy's large arrays
            memory.madvise(mmap.MADV_HUGEPAGE)
        np.frombuffer(memory).fill(1.0)

    return seconds(write, runs)


def compile_again(diagram: Diagram, sampled: bool) -> None:
    """Compile a diagram's functions, as at the first time in a process."""
    flat = diagram.flatten(1e-3)
    kinds = kinds_of(flat, every=not sampled)
    write_code(flat, kinds, () if sampled else functions_between(flat, stiff=False)).load()


def exponent(sizes, times) -> float:
    """Return the slope in logarithmic scales, from 100 blocks on."""
    large = np.asarray(sizes) >= 100
    return float(np.polyfit(np.log(np.asarray(sizes)[large]), np.log(np.asarray(times)[large]), 1)[0])


def plot(results: dict, path: Path) -> None:
    """Draw all times over the number of blocks."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained", sharex=True)
    for column, (axis, title) in enumerate(zip(axes, ("build", "prepare a run", "one step"), strict=True)):
        for (name, sampled), rows in results.items():
            axis.loglog(
                SIZES,
                rows[:, column],
                "o-" if sampled else "s--",
                ms=4,
                label=f"{name}, {'sampled' if sampled else 'continuous'}",
            )
        smallest = min(rows[-1, column] for rows in results.values())
        axis.loglog(SIZES, smallest * np.asarray(SIZES) / SIZES[-1] / 2, "k:", lw=1, label="linear")
        axis.set(title=title, xlabel="blocks")
        axis.grid(visible=True, which="major", alpha=0.3)
    axes[0].set_ylabel("time / s")
    axes[0].axhline(LIMIT, color="k", lw=0.5)
    axes[0].annotate("5 s", (SIZES[0], LIMIT), va="bottom", fontsize=8)
    axes[2].legend(fontsize=7)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=150)


def main() -> int:
    """Print one row for each kind and size, and the exponents; 1 if building is too slow."""
    results, slow = {}, []
    measured(chain, 10, sampled=True)  # imports, warm caches
    first, again = (fill(2**27, runs=1) / 2**27 * 1e9 for _ in range(2))
    print(f"memory: {first:.2f} ns a number at the first touch, {again:.2f} where this machine has used it before")
    print(
        "diagram               blocks    build, ms   prepare, ms   step, µs   step, ns a block"
        "   compile, ms   step in C, ns a block   all recorded   writing alone"
    )
    for make in (chain, nested, net):
        for sampled in (True, False):
            name = f"{make.__name__}, {'sampled' if sampled else 'continuous'}"
            rows = []
            for n in SIZES:
                build, prepared, step = measured(make, n, sampled)
                compiling, in_c, recorded, floor = measured_in_c(make, n, sampled)
                rows.append((build, prepared, step))
                print(
                    f"{name:20}  {n:6}  {build * 1e3:11.1f}  {prepared * 1e3:12.1f}"
                    f"  {step * 1e6:9.1f}  {step / n * 1e9:17.1f}  {compiling * 1e3:12.1f}"
                    f"  {in_c / n * 1e9:22.1f}  {recorded / n * 1e9:13.1f}"
                    f"  {floor / n * 1e9:14.1f}",
                    flush=True,
                )
                if n == 1000 and build > LIMIT:
                    slow.append(name)
            results[make.__name__, sampled] = np.array(rows)
            fitted = [exponent(SIZES, column) for column in np.transpose(rows)]
            print(f"{name:20}  exponent  {fitted[0]:9.2f}  {fitted[1]:12.2f}  {fitted[2]:9.2f}")
    plot(results, Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "out" / "scaling.png")
    for name in slow:
        print(f"{name}: 1000 blocks took more than {LIMIT:g} s to build")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())

"""All that is compared with others, in one run and one table: python benchmarks/side_by_side.py [--quick].

The Fig. 3 loop next to C that was written by hand for it; sampled and continuous loops in C next to interpreted ones;
sweeps over threads and vector lanes; an anti-lock brake with 12,900 events; and the tools of others. A row has a time,
what it is compared with, and the ratio of that one's time to it: above 1, it is faster. The ratio is the median of the
turns that both took, and next to it are the smallest and the largest one. Below are the instructions of a tick of
the Fig. 3 loop, as valgrind counts them, where it is installed.

Each comparison is its own benchmark too, which says more: handwritten.py, compiled.py, sweep.py, events.py and
peers.py. With --quick there are fewer turns and samples, and instructions are not counted. The program ends with status
1 if a trajectory or a result differs by more than it may.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import compiled
import events
import handwritten
import peers
import sweep

from loopwright.diagrams import experiments

LOOP = "Fig. 3, experiment C"
BRAKE_TURNS = 3


@dataclass(frozen=True)
class Row:
    """A time, in s a unit of work, and how many times as long another one takes, turn by turn."""

    work: str
    form: str
    time: float
    of: str
    reference: str
    ratios: Sequence[float]

    def __str__(self) -> str:
        middle = statistics.median(self.ratios)
        shown = f"{middle:8.3g}  {min(self.ratios):8.3g} to {max(self.ratios):<8.3g}"
        return f"{self.work:27} {self.form:25} {self.time * 1e6:10.3f} {self.of:5}  {shown} {self.reference}"


def ratios(others: Sequence[float], own: Sequence[float]) -> list[float]:
    """Return how many times as long others take, turn by turn."""
    return [a / b for a, b in zip(others, own, strict=True)]


def beside_c(found: handwritten.Measured) -> Iterator[Row]:
    """Yield our forms of Fig. 3 next to C by hand."""
    for form, times in found.ours.items():
        for name in (next(iter(found.by_hand)), handwritten.EVERYTHING):
            tick = statistics.median(times) / handwritten.TICKS
            yield Row(LOOP, form, tick, "tick", f"C by hand, {name}", ratios(found.by_hand[name], times))


def beside_interpreted(wrong: list[str]) -> Iterator[Row]:
    """Yield compiled runs next to interpreted ones."""
    for letter in experiments.EXPERIMENTS:
        slow, fast, same = compiled.measure_experiment(letter)
        if not same:
            wrong.append(f"the bits of experiment {letter}")
        yield Row(
            f"Fig. 3, experiment {letter}",
            "compiled",
            statistics.median(fast),
            "tick",
            "interpreted",
            ratios(slow, fast),
        )
    for solver in compiled.SOLVERS:
        slow, fast, _ = compiled.measure_lags(solver)
        yield Row(
            "PI, 1 kHz, two lags",
            f"compiled, {solver}",
            statistics.median(fast),
            "tick",
            "interpreted",
            ratios(slow, fast),
        )


def sweeps(found: sweep.Measured, samples: int) -> Iterator[Row]:
    """Yield sweeps next to those in one thread, and a core next to C by hand."""
    for (form, threads), times in found.elapsed.items():
        each = [elapsed / samples for elapsed in times]
        named = f"{form}, {threads} thread{'s' if threads > 1 else ''}"
        work, run = f"sweep, runs of {sweep.SECONDS:g} s", statistics.median(each)
        if threads > 1:
            yield Row(work, named, run, "run", "one thread", ratios(found.elapsed[form, 1], times))
        core = [elapsed * threads for elapsed in each]
        yield Row(work, named, run, "run", "C by hand, a core", ratios(found.by_hand, core))


def brake(turns: int) -> Row:
    """Return an anti-lock brake, compiled, next to the interpreted run."""
    diagram, duration, step = events.antilock()

    def run(form: bool) -> float:
        started = time.thread_time()
        diagram.simulate(duration, step=step, progress=False, compile=form)
        return time.thread_time() - started

    run(True)
    slow = run(False)
    fast = [run(True) for _ in range(turns)]
    return Row(
        "anti-lock brake",
        "compiled",
        statistics.median(fast),
        "run",
        "interpreted, once",
        [slow / took for took in fast],
    )


def beside_tools() -> Iterator[Row | str]:
    """Yield Loopwright in comparison with other tools; of one that isn't installed, a text."""
    exact = peers.solve_exactly()
    for title, tools in peers.ROWS.items():
        rows = peers.measure(exact, tools)
        (own, ours), *others = rows.items()
        for name, row in others:
            if len(row.times) < peers.TURNS:
                yield f"{title:27} {'':49} {name.strip()}: {row.end}"
            else:
                form = own.partition(", ")[2]
                yield Row(title, form, statistics.median(ours.times), "tick", name, ratios(row.times, ours.times))


def all_rows(*, quick: bool, wrong: list[str]) -> Iterator[Row | str]:
    """Yield all rows, as they are measured; note in ``wrong`` whatever differs by more than it may."""
    with tempfile.TemporaryDirectory() as folder:
        library, program = handwritten.compile_by_hand(Path(folder))
        found = handwritten.measure(library, 5 if quick else handwritten.TURNS)
        if max(found.differences.values()) > handwritten.BOUND:
            wrong.append("a trajectory next to C by hand")
        yield from beside_c(found)
        yield from beside_interpreted(wrong)
        samples = 50 if quick else 1000
        swept = sweep.measure(samples, shown=False)
        if not sweep.is_right(swept.differences):
            wrong.append("a run of a sweep next to a single one")
        yield from sweeps(swept, samples)
        yield brake(BRAKE_TURNS)
        yield from beside_tools()
        if quick:
            return
        yield "\ninstructions of a tick"
        for name, form in handwritten.FORMS.items():
            yield f"C by hand, {name:50} {handwritten.tell(handwritten.count_instructions(program, form))}"
        for name in handwritten.IN_C:
            yield f"Loopwright, {name:49} {handwritten.tell(handwritten.count_ours(name))}"


def main() -> int:
    """Print the table."""
    peers.silence()
    wrong: list[str] = []
    print(f"{'work':27} {'form':25} {'µs a':>10} {'unit':5}  {'ratio':>8}  {'smallest to largest':20} next to")
    for row in all_rows(quick="--quick" in sys.argv[1:], wrong=wrong):
        print(row, flush=True)
    for name in wrong:
        print(f"wrong: {name}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

"""Every run of a test in both forms, by the virtual machine and by generated code, and they are compared."""

from collections import Counter
from dataclasses import replace

import numpy as np

from loopwright.blocks import LoopwrightError
from loopwright.diagrams import diagram as facade
from loopwright.diagrams.simulation import simulation
from loopwright.diagrams.simulation.hybrid_ticks import HybridTicks
from loopwright.diagrams.simulation.sampled_ticks import SampledTicks

FACTOR = 100.0
"""Times the tolerances that values of both forms may differ by."""
counts = Counter()
"""Runs so far, by what came of them."""


def install(patch):
    """Let `Diagram.simulate` run every diagram a second time in C, where its ticks can be; ``patch`` undoes it."""
    original = simulation.simulate
    used = []

    def watch(kind):
        run = kind.run

        def watched(self, *arguments, **options):
            used.append(self)
            return run(self, *arguments, **options)

        patch.setattr(kind, "run", watched)

    def simulate(diagram, duration, options, **keywords):
        first = original(diagram, duration, options, **keywords)
        if options.compile is True or options.to is not None:
            return first
        del used[:]
        try:
            second = original(diagram, duration, replace(options, compile=True), progress=False)
        except LoopwrightError as error:
            raise AssertionError(f"compiled, this run ends with {error}") from error
        if not used:
            counts["interpreted"] += 1
        elif isinstance(used[0], HybridTicks):
            compare_within_tolerances(first, second, options)
            counts["compiled with continuous states"] += 1
        else:
            compare(first, second, exact=not used[0].messages)
            counts["compiled"] += 1
        return first

    watch(SampledTicks)
    watch(HybridTicks)
    patch.setattr(facade, "simulate", simulate)


def compare_within_tolerances(first, second, options):
    """Compare two runs with continuous states: samples, events in their order, and values within the tolerances.

    Both forms take steps of one method by one rule. They differ by rounding, which may change a step: the errors of both
    are within the tolerances, so that values differ by a multiple of these, and an event is as much apart in time.
    """
    events, others = ([(e.block, e.event) for e in run.events] for run in (first, second))
    assert events == others
    span = max(1.0, first.t[-1]) if len(first.t) else 1.0
    near = FACTOR * options.rtol * span
    assert first.t.shape == second.t.shape
    assert np.all(np.abs(first.t - second.t) <= near * 1e-3), "samples are at other times"
    finite = np.isfinite(first.data)  # outputs of FMUs that nothing reads may be NaN or infinite
    assert np.array_equal(first.data[~finite], second.data[~finite], equal_nan=True), "values that aren't finite differ"
    sizes = np.max(np.abs(first.data), axis=0, initial=0.0, where=finite)
    atol = np.max(np.asarray(options.atol))
    bound = FACTOR * (options.rtol * sizes + atol) + 1e-12
    times = np.sort([e.t for run in (first, second) for e in run.events] + [np.inf])
    since = np.abs(first.t - times[np.searchsorted(times, first.t - 1e-9 * span)])
    smooth = since > 1e-9 * span  # at an event a signal jumps, and a sample of either form may be on either side
    differences = np.abs(np.subtract(first.data, second.data, out=np.zeros_like(first.data), where=finite))
    apart = np.max(differences[smooth], axis=0, initial=0.0)
    assert np.all(apart <= bound), f"apart by {np.max(apart / bound):.3g} times the bound"


def compare(first, second, *, exact):
    """Compare two runs: to the last bit, or, in the listed classes, to signs of zeros and rounding of a linear solve."""
    assert first.t.tobytes() == second.t.tobytes()
    assert first.stopped == second.stopped
    if exact:
        assert first.data.tobytes() == second.data.tobytes(), "compiled and interpreted bits differ"
    else:
        assert np.allclose(first.data, second.data, rtol=1e-12, atol=1e-12, equal_nan=True)

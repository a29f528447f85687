"""Every run of a test in both forms: what is interpreted is compiled as well, and the bits are compared."""

from collections import Counter
from dataclasses import replace

import numpy as np

from loopwright.blocks import LoopwrightError
from loopwright.diagrams.simulation import compiled_hybrid, simulated_diagram, simulation
from loopwright.diagrams.simulation.compiled_ticks import CompiledTicks

counts = Counter()
"""Runs so far, by what came of them."""


def install(patch):
    """Let `Diagram.simulate` run every diagram a second time in C, where its ticks can be; ``patch`` undoes it."""
    original = simulation.simulate
    used = []
    run = CompiledTicks.run

    def watched(self, *arguments, **options):
        used.append(self)
        return run(self, *arguments, **options)

    def simulate(diagram, duration, options, **keywords):
        first = original(diagram, duration, options, **keywords)
        if options.compile is True or options.to is not None:
            return first
        del used[:]
        try:
            second = original(diagram, duration, replace(options, compile=True), progress=False)
        except LoopwrightError as error:
            raise AssertionError(f"compiled, this run ends with {error}") from error
        if used:
            compare(first, second, exact=not used[0].messages)
        counts["compiled" if used else "interpreted"] += 1
        return first

    patch.setattr(CompiledTicks, "run", watched)
    patch.setattr(compiled_hybrid, "make_hybrid", lambda *_, **__: (None, ()))  # its values differ within tolerances
    patch.setattr(simulated_diagram, "simulate", simulate)


def compare(first, second, *, exact):
    """Compare two runs: to the last bit, or, in the listed classes, to signs of zeros and rounding of a linear solve."""
    assert first.t.tobytes() == second.t.tobytes()
    assert first.stopped == second.stopped
    if exact:
        assert first.data.tobytes() == second.data.tobytes(), "compiled and interpreted bits differ"
    else:
        assert np.allclose(first.data, second.data, rtol=1e-12, atol=1e-12)

"""Blocks driven by signals given in time: at ticks, and in continuous time with their events. For tests, without an engine.

In continuous time the instants are found by bisection, and after a jump the indicators are looked at again until
nothing fires, as `loopwright.blocks.Event` says it.
"""

import numpy as np

from loopwright.blocks.tracing.equations import initial_state, start_values
from loopwright.blocks.tracing.symbols import bundle
from loopwright.blocks.tracing.traced import trace


class Driven:
    """A block and its inputs, functions of time by name; inputs with a default may be left out."""

    def __init__(self, block, sampled, T=np.nan, **inputs):
        self.block, self.sampled = block, sampled
        given = {name: inputs.get(name, (lambda d: lambda t: d)(port.default)) for name, port in block.inputs.items()}
        self.inputs = given
        shapes = {name: np.shape(f(0.0)) for name, f in given.items()}
        self.traced = trace(block, shapes, sampled=sampled)
        self.p = self.traced.pack(block, T)
        starts = start_values(block, shapes)
        self.x = np.concatenate([*(np.ravel(v) for v in starts.values()), np.zeros(0)])
        if block.starts_from_inputs:
            u = bundle("u", {name: np.asarray(f(0.0), dtype=float) for name, f in given.items()})
            self.x = initial_state(block, self.traced.states, u)

    def arguments(self, t):
        return [t, self.x, *(np.ravel(np.asarray(f(t), dtype=float)) for f in self.inputs.values()), self.p]

    def outputs(self, t):
        made = self.traced.function.call(self.arguments(t))
        self.guards = np.ravel(np.array(made[-1]))
        self.next = np.ravel(np.array(made[-2]))
        shaped = zip(self.traced.outputs.items(), made, strict=False)
        return {name: np.reshape(np.array(value), shape) for (name, shape), value in shaped}


def at_ticks(block, T, n, **inputs):
    """The outputs by name at the ticks 0 to n − 1, each an array whose first index is the tick."""
    run = Driven(block, True, T, **inputs)
    rows = []
    for k in range(n):
        rows.append(run.outputs(k * T))
        run.x = run.next.copy()
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def in_time(block, end, grid=1e-2, **inputs):
    """A function of time that gives the outputs, and the list of (t, names that fired). States must be discrete."""
    run = Driven(block, False, **inputs)
    names, directions = list(block.events), [e.direction for e in block.events.values()]

    def domains(t):
        return np.ravel(np.array(run.traced.indicators.call(run.arguments(t))[0])) > 0.0

    def fires(before, after):
        changed = {"both": before != after, "rising": after & ~before, "falling": before & ~after}
        return np.array([changed[d][i] for i, d in enumerate(directions)])

    history, log, t = [(0.0, run.x.copy())], [], 0.0
    known = domains(0.0)
    for stop in np.arange(1, round(end / grid) + 1) * grid:
        while np.any(domains(stop) != known):
            low, high = t, stop
            while high - low > 4e-16 * max(1.0, high):
                middle = 0.5 * (low + high)
                if middle in (low, high):
                    break
                low, high = (middle, high) if np.all(domains(middle) == known) else (low, middle)
            t = high
            for _ in range(100):
                now = domains(t)
                fired = fires(known, now)
                known = now
                if not fired.any():
                    break
                log.append((t, tuple(n for n, f in zip(names, fired, strict=True) if f)))
                run.x = np.ravel(np.array(run.traced.jump.call([*run.arguments(t), fired.astype(float)])[0]))
            else:
                raise AssertionError(f"endless events {names} at t = {t}")
            history.append((t, run.x.copy()))
            if len(history) > 1000:
                raise AssertionError(f"too many events {names} until t = {t}")
        t = stop

    def outputs(t):
        run.x = [x for start, x in history if start <= t][-1]
        return run.outputs(t)

    return outputs, log

"""One block alone, driven by its traced functions: at ticks, between events, and as matrices. No diagram around it."""

import numpy as np
from scipy.integrate import solve_ivp

from loopwright.blocks.tracing.equations import initial_state, start_values
from loopwright.blocks.tracing.symbols import bundle
from loopwright.blocks.tracing.traced import trace


class Alone:
    """A block in a frame of its own."""

    def __init__(self, block, T=None, method="exact", **shapes):
        self.block, self.T = block, T
        shapes = {name: shapes.get(name, port.shape or ()) for name, port in block.inputs.items()}
        self.made = trace(block, shapes, sampled=T is not None, method=method)
        self.p = self.made.pack(block, np.nan if T is None else T)
        self.shapes = shapes

    def columns(self, u):
        return [np.ravel(np.broadcast_to(u.get(n, 0.0), s)).astype(float) for n, s in self.shapes.items()]

    def start(self, u):
        """The state at the start; ``u`` maps inputs to values."""
        if self.block.starts_from_inputs:
            values = {n: np.broadcast_to(u.get(n, 0.0), s) for n, s in self.shapes.items()}
            return initial_state(self.block, self.made.states, bundle("u", values))
        found = start_values(self.block, self.shapes)
        return np.concatenate([np.zeros(0), *(np.ravel(v) for v in found.values())])

    def call(self, t, x, u):
        """Outputs by name, and the next state or the rates."""
        results = self.made.function.call([t, x, *self.columns(u), self.p])
        outputs = [np.array(r).reshape(s) for r, s in zip(results, self.made.outputs.values(), strict=False)]
        return dict(zip(self.made.outputs, outputs, strict=True)), np.ravel(np.array(results[len(outputs)]))

    def ticks(self, **u):
        """Outputs at every tick; each input is a sequence of one value for each tick."""
        n, rows = len(next(iter(u.values()))), []
        x = self.start({k: v[0] for k, v in u.items()})
        for k in range(n):
            outputs, x = self.call(k * self.T, x, {name: v[k] for name, v in u.items()})
            rows.append(outputs)
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}

    def domain(self, t, x, u):
        return np.ravel(np.array(self.made.indicators.call([t, x, *self.columns(u), self.p])[0]))

    def run(self, u, times, *, edges=(), start=None):
        """Outputs at ``times`` in continuous time: SciPy between events, which are located and jump. ``u(t)`` is a dict.

        ``edges`` are times at which the inputs jump.
        """
        events = self.block.events
        x = self.start(u(times[0])) if start is None else start
        t, rows, self.occurred = times[0], [], []
        above = self.domain(t, x, u(t)) > 0 if events else np.zeros(0, bool)
        stops = sorted({*edges, times[-1]})
        for stop in stops:
            while True:  # one segment between events
                fire = [self._event(i, u, above[i], stop) for i in range(len(events))]
                step = solve_ivp(
                    lambda s, z, stop=stop: self.call(s, z, u(min(s, np.nextafter(stop, -1))))[1],
                    (t, stop),
                    x,
                    method="DOP853",
                    rtol=1e-12,
                    atol=1e-13,
                    max_step=0.1,
                    dense_output=True,
                    events=fire or None,
                )
                t_end = step.t[-1]
                rows += [(s, self.call(s, step.sol(s), u(s))[0]) for s in times if t <= s < t_end]
                t, x = t_end, step.y[:, -1]
                if step.status != 1:
                    break
                hit = [i for i, found in enumerate(step.t_events) if len(found)]
                assert len(self.occurred) < 500, "the events never end"
                x, above = self._settle(t, x, u(t), above, set(hit))
            if events:
                x, above = self._settle(t, x, u(t), above, set())
        rows.append((times[-1], self.call(times[-1], x, u(times[-1]))[0]))
        return {name: np.array([row[name] for _, row in rows]) for name in rows[0][1]}

    def _event(self, i, u, above, stop):
        def crossing(s, z):
            value = self.domain(s, z, u(min(s, np.nextafter(stop, -1))))[i]
            return value if value != 0 or above else -1e-300

        crossing.terminal, crossing.direction = True, -1 if above else 1
        return crossing

    def _settle(self, t, x, u, above, hit):
        """Jump until no domain changes any more."""
        names = list(self.block.events)
        for _ in range(20):
            now = self.domain(t, x, u) > 0
            for i in hit:
                now[i] = not above[i]
            rising, falling = now & ~above, ~now & above
            fired = [
                float({"rising": r, "falling": f, "both": r or f}[self.block.events[n].direction])
                for n, r, f in zip(names, rising, falling, strict=True)
            ]
            above = now
            if not any(fired):
                return x, above
            self.occurred += [(t, n) for n, f in zip(names, fired, strict=True) if f]
            x = np.ravel(np.array(self.made.jump.call([t, x, *self.columns(u), self.p, fired])[0]))
            hit = set()
        raise AssertionError("the events don't settle")

    def matrices(self, inputs, output):
        """A, B, C, D of a linear block about zero, from its values at unit vectors."""
        n = sum(int(np.prod(s, dtype=int)) for s in self.made.states.values())
        zero, none = np.zeros(n), dict.fromkeys(self.shapes, 0.0)
        offset = self.call(0.0, zero, none)
        assert not np.any(offset[1])

        def at(x, u):
            outputs, rate = self.call(0.0, x, u)
            return np.ravel(outputs[output]), rate

        by_state = [at(e, none) for e in np.eye(n)]
        by_input = []
        for name in inputs:
            units = np.eye(int(np.prod(self.shapes[name], dtype=int)))
            by_input += [at(zero, {**none, name: e.reshape(self.shapes[name])}) for e in units]
        p = len(np.ravel(offset[0][output]))
        C, A = np.array([v[0] for v in by_state]).reshape(n, p).T, np.array([v[1] for v in by_state]).reshape(n, n).T
        D, B = np.array([v[0] for v in by_input]).T, np.array([v[1] for v in by_input]).T
        return A, B, C, D


def response(matrices, s):
    """C (s I − A)⁻¹ B + D."""
    A, B, C, D = matrices
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D

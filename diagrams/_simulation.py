"""The scheduler: integer ticks, in one order.

At tick k, t = k · base exactly:

1. The outputs of the FMUs are those at the end of their last step: a co-simulation FMU has no feedthrough between
   communication points (FMI 3.0, Step Mode). At k = 0 they are those of initialization, with the inputs of k = 0.
2. All blocks are evaluated once, each port after what it depends on: `FlatDiagram`. A sampled subsystem acts in the
   ticks of its own rate; between them its outputs are held.
3. Everything is recorded.
4. The inputs of the FMUs are set and held, and every FMU steps to tick k + 1; the blocks' next states take effect.

Time never accumulates: tick k is at k·numerator / denominator, rounded once. The last tick is evaluated and recorded,
and nothing steps beyond it. If a value is not finite or a guard fails, the tick is evaluated again block by block to
name the first one that is concerned; the run until then is kept in the error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from ..blocks._comparison import GUARDS, NEXT
from ..blocks._equations import initial_state
from ..blocks._errors import LoopwrightError, NonFiniteError, SimulationError
from ..blocks._symbols import bundle
from ._duration import check_memory, ticks_in
from ._flat import FlatDiagram
from ._run import Run
from ._structure import join

if TYPE_CHECKING:
    from ._diagram import Diagram

_CHUNK = 1000  # ticks between two looks at the progress bar
_MAX_PASSES = 100  # over inputs and outputs of the FMUs at the start
_SETTLED = 1e-13  # relative change of an input between two passes, a few hundred ulps


def simulate(diagram: Diagram, duration: float, *, step: float | Fraction | None, progress: bool | None) -> Run:
    """Run a diagram; see `Diagram.simulate`."""
    flat = diagram.flatten(step)
    n = ticks_in(duration, flat.base, diagram.name)
    width = flat.log.total + flat.states.total + flat.held.total
    check_memory(n + 1, width, flat.base, diagram.name)
    times = [k * flat.base.numerator / flat.base.denominator for k in range(n + 1)]
    recorded = _Recorded(diagram, flat, np.array(times), np.empty((n + 1, width)))
    with ExitStack() as stack:
        plants = []
        for path in sorted(diagram.blocks):
            block: Any = diagram.blocks[path]
            if not hasattr(block, "instantiate"):
                continue
            try:
                wired = [port for port in block.inputs if (path, port) in diagram.wires]
                plants.append((path, stack.enter_context(block.instantiate(wired, times[-1]))))
            except SimulationError as error:
                error.run = recorded.until(0, 0.0)
                error.at(block=path, t=0.0)
                raise
            except LoopwrightError as error:
                error.at(block=path)
                raise
        show = stack.enter_context(_progress(diagram.name, times[-1], progress))
        return _Loop(flat, plants, recorded).run(times, show)


class _Recorded:
    """The samples while they are being made."""

    def __init__(self, diagram: Diagram, flat: FlatDiagram, t: np.ndarray, data: np.ndarray):
        self.diagram, self.flat, self.t, self.data = diagram, flat, t, data

    def until(self, n: int, elapsed: float, messages: tuple[str, ...] = ()) -> Run:
        """Return the run of the first ``n`` samples."""
        units = {join(*port): unit for port, unit in self.flat.checked.units.items()}
        whole = n == len(self.t)
        return Run(
            t=self.t if whole else self.t[:n].copy(),
            data=self.data if whole else self.data[:n].copy(),
            layout=self.flat.log,
            wires=dict(self.diagram.names),
            units=units,
            diagram=self.diagram,
            elapsed=elapsed,
            messages=messages,
        )


class _Loop:
    """The state of a run, and its loop."""

    def __init__(self, flat: FlatDiagram, plants: list[tuple[str, Any]], recorded: _Recorded):
        self.flat, self.plants, self.recorded, self.done = flat, plants, recorded, 0
        self.t = np.zeros(1)
        self.x = flat.x0.copy()
        self.x_next = np.zeros_like(self.x)
        self.w = np.zeros(flat.plant_outputs.total)
        self.z = np.zeros(flat.plant_inputs.total)
        self.log = np.zeros(recorded.data.shape[1])
        self.ok = np.zeros(1)
        self._calls: dict[frozenset[int], tuple[Any, Any]] = {}

    def _part(self, layout: Any, path: str, vector: np.ndarray) -> np.ndarray:
        mine = [s for name, s in layout.slices.items() if self.flat.ports[name][0] == path]
        return vector[mine[0].start : mine[-1].stop] if mine else vector[:0]

    def run(self, times: list[float], progress: Any) -> Run:
        started = time.perf_counter()
        k = 0
        try:
            self._evaluator(0)
            self.start()
            k = self._advance(progress, times)
        except _Stopped as stop:
            k = stop.tick
            error = stop.error
            error.run = self.recorded.until(k, time.perf_counter() - started)
            raise error.at(t=times[k]) from stop.__cause__
        except KeyboardInterrupt as interrupt:
            interrupt.run = self.recorded.until(self.done, time.perf_counter() - started)  # type: ignore[attr-defined]
            raise
        elapsed = time.perf_counter() - started
        messages = tuple(m for _, plant in self.plants for m in plant.messages)
        return self.recorded.until(k + 1, elapsed, messages)

    def _evaluator(self, k: int) -> Any:
        """Return the call that evaluates tick ``k``; all calls share the run's vectors."""
        acting = self.flat.acting(k)
        if acting not in self._calls:
            function = self.flat.evaluator(k)
            buffer, trigger = function.buffer()
            for i, vector in enumerate((self.t, self.x, self.w, self.flat.p)):
                buffer.set_arg(i, _view(vector))
            for i, vector in enumerate((self.x_next, self.z, self.log, self.ok)):
                buffer.set_res(i, _view(vector))
            self._calls[acting] = (trigger, buffer)  # the buffer lives as long as its call
        return self._calls[acting][0]

    def _advance(self, progress: Any, times: list[float]) -> int:
        """Run all ticks and return the last one."""
        t, ok, x, x_next = _view(self.t), _view(self.ok), _view(self.x), _view(self.x_next)
        log, data, plants = self.log, self.recorded.data, [plant for _, plant in self.plants]
        h, last = float(self.flat.base), len(times) - 1
        single = self._evaluator(0) if self.flat.rates == (1,) else None
        only = plants[0].step if len(plants) == 1 else None
        k = 0
        while True:
            end = min(last, k + _CHUNK)
            for k in range(k, end):  # noqa: B020 - continues where the last chunk ended
                t[0] = now = times[k]
                (single or self._evaluator(k))()
                if not ok[0]:
                    raise _Stopped(k, self.failure(now, k))
                data[k] = log
                try:
                    if only is not None:
                        only(now, h)
                    else:
                        for plant in plants:
                            plant.step(now, h)
                except SimulationError as error:
                    raise _Stopped(k + 1, self._who(error)) from error
                x[:] = x_next
                self.done = k + 1
            k = end
            progress(times[k])
            if k == last:
                break
        t[0] = times[k]
        self._evaluator(k)()
        if not ok[0]:
            raise _Stopped(k, self.failure(times[k], k))
        data[k] = log
        self.done = k + 1
        return k

    def _who(self, error: SimulationError) -> SimulationError:
        for path, plant in self.plants:
            if plant.failed:
                error.block = path
        return error

    # --- the start, and the replay of a failed tick: block by block, with numbers -----------------------------------

    def start(self) -> None:
        """Initialize: inputs and outputs of the FMUs that agree at t = 0, and the blocks' initial states.

        In Initialization Mode an FMU's outputs follow its inputs at once (FMI 3.0, 2.3.3). What they change is given on
        until it changes no more than by rounding.
        """
        try:
            for path, plant in self.plants:
                plant.bind(
                    self._part(self.flat.plant_inputs, path, self.z), self._part(self.flat.plant_outputs, path, self.w)
                )
            for _ in range(_MAX_PASSES):
                self._initial_states()
                self._evaluator(0)()
                if not self.ok[0]:
                    raise _Stopped(0, self.failure(0.0, 0))
                before = self.z.copy()
                for _, plant in self.plants:
                    plant.exchange()
                self._evaluator(0)()
                if np.allclose(before, self.z, rtol=_SETTLED, atol=0.0, equal_nan=True):
                    break
            else:
                raise self._unsettled(before)
            for _, plant in self.plants:
                plant.begin()
        except SimulationError as error:
            raise _Stopped(0, self._who(error)) from error.__cause__

    def _unsettled(self, before: np.ndarray) -> SimulationError:
        slices = self.flat.plant_inputs.slices
        name = next(n for n, s in slices.items() if not np.allclose(before[s], self.z[s], rtol=_SETTLED, atol=0.0))
        path, port = self.flat.ports[name]
        return SimulationError(
            f"its value at the start depends on the FMU's own outputs, and is not found: after {_MAX_PASSES} passes it "
            f"still changes, from {before[slices[name]].tolist()} to {self.z[slices[name]].tolist()}. Put a "
            "UnitDelay(initial_value=…) on one of the wires between.",
            block=path,
            port=port,
        )

    def _initial_states(self) -> None:
        """Compute the initial states of the blocks that ask for their inputs first."""
        table = self.flat.table
        if not any(table.blocks[path].starts_from_inputs for path in self.flat.checked.traced):
            return
        for _ in self._blocks(self.flat.start_order, 0.0, 0, initialize=True):
            pass

    def failure(self, t: float, k: int) -> SimulationError:
        """Return the error of the first block that made a value that is not finite or whose guard fails."""
        for name, where in self.flat.plant_outputs.slices.items():
            if not np.all(np.isfinite(self.w[where])):
                path, port = self.flat.ports[name]
                return _non_finite(path, port, self.w[where], "It comes out of the FMU.")
        for path, names, inputs, made in self._blocks(self.flat.order, t, k):
            block = self.flat.table.blocks[path]
            shapes = self.flat.checked.traced[path].outputs
            u = bundle("u", inputs)
            for name in sorted(names, key=lambda n: n != GUARDS):  # a guard says more than the NaN behind it
                values = made[name]
                if name == GUARDS:
                    for guard, value in zip(self.flat.checked.traced[path].guards, values, strict=True):
                        if not value > 0:
                            y = bundle("y", {n: made.get(n) for n in shapes})
                            x = self._states_of(path)
                            return block.guard_error(guard, float(value), u, y, x).at(block=path)  # type: ignore[return-value]
                elif not np.all(np.isfinite(values)):
                    what = "the next state" if name == NEXT else name
                    return _non_finite(path, what, values, _inputs_text(inputs))
        layout = self.flat.log
        sizes = {name: float(np.max(np.abs(self.log[where]), initial=0.0)) for name, where in layout.slices.items()}
        largest = max(sizes, key=lambda name: sizes[name])
        path, port = self.flat.ports[largest]
        return NonFiniteError(
            f"found {sizes[largest]:g}; the signals of this tick overflow when they are added up, and this "
            "is the largest. Look at what drives it in the last samples of error.run.",
            block=path,
            port=port,
        )

    def _states_of(self, path: str) -> Any:
        """Return the states of a block at the failed tick, as its equations see them."""
        flat, position, parts = self.x[self.flat.states.slices[path]], 0, {}
        for name, shape in self.flat.checked.traced[path].states.items():
            n = math.prod(shape)
            parts[name] = flat[position : position + n].reshape(shape)
            position += n
        return bundle("x", parts)

    def _blocks(
        self, order: list[Any], t: float, k: int, *, initialize: bool = False
    ) -> Iterator[tuple[str, tuple[str, ...], dict[str, np.ndarray], dict[str, np.ndarray]]]:
        """Evaluate block by block; yield path, names, inputs and results of each."""
        flat, table = self.flat, self.flat.table
        values: dict[tuple[str, str], np.ndarray] = {}
        for name, where in flat.plant_outputs.slices.items():
            values[flat.ports[name]] = self.w[where]
        for name, where in flat.held.slices.items():
            values[flat.ports[name]] = self.x[where]
        ready: set[str] = set()
        for path, names in order:
            if k % flat.divisors[table.frame_of[path]]:
                continue
            trace, block = flat.checked.traced[path], table.blocks[path]
            known = {p: flat.source(path, p, values) for p in trace.inputs if flat.is_made(path, p, values)}
            shaped = {p: np.reshape(known[p], trace.inputs[p]) if p in known else None for p in trace.inputs}
            if initialize and block.starts_from_inputs and path not in ready:
                ready.add(path)
                self.x[flat.states.slices[path]] = _initial(path, block, bundle("u", shaped), trace.states)
            columns = [known.get(p, np.zeros(int(np.prod(s)))) for p, s in trace.inputs.items()]
            result = flat.block_function(path, names).call(
                [t, self.x[flat.states.slices[path]], *columns, flat.p[flat.parameters.slices[path]]]
            )
            made = {n: np.ravel(np.array(r)) for n, r in zip(names, result, strict=True)}
            values.update({(path, n): v for n, v in made.items()})
            shaped_known: Any = dict(shaped)
            yield path, names, shaped_known, made


def _initial(path: str, block: Any, u: Any, states: Mapping[str, tuple[int, ...]]) -> np.ndarray:
    """Return a block's initial state from its inputs, flat; whatever fails says whose it is."""
    try:
        return initial_state(block, states, u)
    except SimulationError as error:
        raise error.at(block=path, t=0.0) from error.__cause__
    except Exception as error:
        expected = ", ".join(f"{name} of shape {shape}" for name, shape in states.items())
        what = str(error) if isinstance(error, LoopwrightError) else f"{type(error).__name__}: {error}"
        raise SimulationError(
            f"its initial(u) failed: {what} {_inputs_text(u._asdict())} Expected {expected}.", block=path, t=0.0
        ) from error


def _view(vector: np.ndarray) -> Any:
    """Return the memory of a vector, as CasADi's buffers take it."""
    return memoryview(vector)  # type: ignore[arg-type]


class _Stopped(Exception):  # noqa: N818 - not an error of its own
    """Carries an error out of the loop with the tick at which it happened."""

    def __init__(self, tick: int, error: SimulationError):
        self.tick, self.error = tick, error


def _inputs_text(inputs: dict[str, Any]) -> str:
    shown = ", ".join(f"{n} = {np.asarray(v).tolist()}" for n, v in inputs.items() if v is not None)
    return f"Its inputs then: {shown}." if shown else "It has no inputs."


def _non_finite(path: str, port: str, values: np.ndarray, hint: str) -> NonFiniteError:
    return NonFiniteError(
        f"found {values.tolist()}; expected finite numbers. This is the first block that made such a value. {hint}",
        block=path,
        port=port,
    )


@contextmanager
def _progress(name: str, end: float, show: bool | None) -> Iterator[Any]:
    """Yield a function that is told the simulated time, and draws it where that is wanted."""
    if show is None:
        import sys

        widgets = "ipykernel" in sys.modules and find_spec("ipywidgets") is not None
        show = sys.stderr.isatty() or widgets
    if not show:
        yield lambda t: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.2f} / {task.total:g} s"))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=end)
        yield lambda t: bar.update(task, completed=t)

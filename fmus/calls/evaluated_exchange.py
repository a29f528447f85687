"""Instance of an FMU in model exchange that is evaluated at any time, states and inputs."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cached_property
from itertools import pairwise

import numpy as np

from ...blocks.core import EvaluationVectors, FmuRuntimeError, Layout, Wanted, elements
from ..archive import ExchangeInfo, FmuVariable
from .bound_calls import DISCARD, ERROR, FATAL, Call
from .evaluation import DirectEvaluation, Evaluation, Vector
from .exchange_states import SavedExchange
from .fmi_calls import WARNING
from .fmu_block import FmuBlock
from .loaded_library import MakeCalls
from .transfer import OutOfRangeError, Transfer, UnfitError

_NOTHING = nullcontext()
_MOVED, _SAME, _MOST_PATTERNS, _MOST_NOTES = 1e-4, 1e-8, 50, 5
"""Relative distance by which a check of the model structure moves states and inputs; change that is none; patterns, and
notes on values that change by themselves."""
_CHECKED: dict[tuple[str, float, bytes, bytes], Sequence[str]] = {}
_MOST_CHECKED = 10_000
"""Points at which the model structure of an FMU has been checked in this process: its digest, t, x and u, with notes on
what was found there; and how many are kept."""


class EvaluatedExchange(SavedExchange):
    """Instance in model exchange that can be evaluated at any time, states and inputs.

    Attributes
    ----------
    about : ExchangeInfo
        Model exchange as the FMU's description states it.
    """

    def __init__(self, block: FmuBlock, wired: Sequence[str], *, make_calls: MakeCalls | None = None):
        super().__init__(block, model_exchange=True, make_calls=make_calls)
        assert block.exchange_info is not None
        self.about: ExchangeInfo = block.exchange_info
        self._ports = dict(block.input_variables)
        self._places = Layout.of({port: v.shape for port, v in self._ports.items()}).slices
        self._wired = {port: self._ports[port] for port in wired}
        self._smooth = {port: v for port, v in self._wired.items() if is_smooth(v)}
        n = self.about.state_count
        order = self.description.state_order
        self._order = np.array(order if len(order) == n else range(n), dtype=int)
        self._time = self.fmi.variable(ctypes.c_double)
        self._x, self._dx = (self._allocate(n) for _ in range(2))
        self._indicators = self._allocate(len(self.about.indicators))
        self._evaluations: dict[Wanted, Evaluation] = {}
        self._is_own = self.fmi.in_process and self.is_built_here
        self._guarded = self.fmi.in_process and not self._is_own
        self._is_placed = False
        """Whether a bound evaluation has just set time and states."""
        self._discarded = ""
        self._u = np.zeros(0)
        """Values of all inputs at the last instant that was reached."""

    def _allocate(self, n: int) -> np.ndarray:
        return self.fmi.allocate(n, ctypes.c_double)

    def evaluation(self, wanted: Wanted) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
        """Return the call ``(t, x, u) -> values`` that gets outputs, then derivatives, then indicators.

        The result is one array, written anew by each call: NaN where the FMU can't compute it there (discard).
        """
        found = self._evaluation(wanted)

        def evaluate(t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            return self._run(found, t, x, u)

        return evaluate

    def _evaluation(self, wanted: Wanted) -> Evaluation:
        if wanted not in self._evaluations:
            self._evaluations[wanted] = self._bind(wanted)
        return self._evaluations[wanted]

    def _bind(self, wanted: Wanted, then: tuple[tuple[Call, str], ...] = (), *, all_inputs: bool = False) -> Evaluation:
        outputs = {port: self.block.output_variables[port] for port in wanted.outputs}
        every = wanted.indicators or bool(then) or all_inputs
        used = {port: v for port, v in self._smooth.items() if every or self._is_needed(port, wanted)}
        index = [np.arange(self._places[p].start, self._places[p].stop) for p in used]
        inputs = self._allocate(sum(v.size for v in used.values()))
        got = self._allocate(sum(v.size for v in outputs.values()))
        return Evaluation(
            self.fmi,
            time=self._time,
            states=Vector("set_states", self._x),
            inputs=Transfer(self.fmi, "Set", used, inputs),
            index=np.concatenate([np.zeros(0, dtype=int), *index]),
            outputs=Transfer(self.fmi, "Get", outputs, got),
            derivatives=Vector("derivatives", self._dx),
            rates=wanted.rates,
            indicators=Vector("indicators", self._indicators) if wanted.indicators else None,
            then=then,
            asked_first=None if self.is_built_here or (then and wanted == Wanted()) else self._asked_first,
        )

    @cached_property
    def _asked_first(self) -> Transfer:
        """Transfer of one variable that is computed, if there is one: to read it lets the FMU compute all of them."""
        about = self.description
        states, rates = (list(map(about.find, names)) for names in (about.states, about.states.values()))
        given = {v.keys for v in states}
        computed = [
            v for v in about.variables.values() if v.causality == "output" and is_smooth(v) and v.keys not in given
        ]
        read = {v.name: v for v in sorted(computed or rates or states, key=lambda v: v.size)[:1]}
        return Transfer(self.fmi, "Get", read, self._allocate(sum(v.size for v in read.values())))

    def bound_evaluation(self, wanted: Wanted, vectors: EvaluationVectors, *, again: bool) -> Callable[[], None]:
        """Return the call that reads and writes these vectors as `evaluation` does its arguments and its result.

        An FMU that Loopwright has built reads and writes these vectors itself. With ``again`` another such call always
        comes right before it, at the same t and x, which need not be set anew.
        """
        plain = self.evaluation(wanted)
        t, x, u, into = vectors

        def copy() -> None:
            into[:] = plain(t[0], x, u)

        made = self._bind_direct(wanted, vectors, again=False)
        if made is None:
            return copy
        short = self._bind_direct(wanted, vectors, again=True) if again else None

        def call() -> None:
            if not self._running:
                copy()
                return
            direct = made if short is None or not self._is_placed else short
            status, place = direct.run()
            self._is_placed = status <= WARNING
            if status:
                self._x[:] = x
                self._judge(status, direct.warned if status <= WARNING else [direct.actions[place]], t[0], into)

        return call

    def _bind_direct(self, wanted: Wanted, vectors: EvaluationVectors, *, again: bool) -> DirectEvaluation | None:
        """Return an evaluation on vectors of the caller's; None where values have to be copied or converted."""
        outputs = [self.block.output_variables[port] for port in wanted.outputs]
        used = [port for port in self._places if port in self._smooth]
        inputs = [port for port in used if wanted.indicators or self._is_needed(port, wanted)]
        variables = [*outputs, *(self._ports[port] for port in inputs)]
        places = [self._places[port] for port in inputs]
        adjoining = all(a.stop == b.start for a, b in pairwise(places))
        sorted_states = np.array_equal(self._order, np.arange(self._order.size))
        if not (self._is_own and sorted_states and adjoining and all(v.type == "Float64" for v in variables)):
            return None
        return DirectEvaluation(
            self.fmi,
            time=self._time,
            vectors=vectors._replace(u=vectors.u[places[0].start : places[-1].stop] if places else vectors.u[:0]),
            inputs=[r for port in inputs for r in self._ports[port].references],
            outputs=[r for v in outputs for r in v.references],
            rates=wanted.rates,
            indicators=len(self.about.indicators) if wanted.indicators else 0,
            again=again,
        )

    def _is_needed(self, port: str, wanted: Wanted) -> bool:
        """Whether outputs or rates that are wanted may depend on an input."""
        unknown = [self.block.output_variables[name] for name in wanted.outputs]
        if wanted.rates:
            unknown += [self.description.find(name) for name in self.description.states.values()]
            if not self.description.states:
                return True
        return any(self.about.pattern(of, self._ports[port]).any() for of in unknown)

    def _run(self, made: Evaluation, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        self._x[:] = x[self._order]
        try:
            with self.host if self._guarded else _NOTHING:
                status, action = made.run(t, u, running=self._running)
        except UnfitError as error:
            raise self._unfit(error, t) from None
        if status:
            self._judge(status, [action] if action else made.warned, t, made.result)
        if status <= WARNING and made.rates is not None:
            made.result[made.rates_at][self._order] = self._dx
        return made.result

    def _judge(self, status: int, actions: Sequence[str], t: float, into: np.ndarray) -> None:
        """Note a warning; write NaN where the FMU can't compute a result; raise the error of a status that is worse."""
        if status <= WARNING:
            for action in actions:
                self.log.warn(action, self.fmi.status_name(status), t)
            return
        if status != DISCARD:
            raise self._error(actions[-1], status, t)
        self._discarded = f"{actions[-1]} at t = {t:.9g} s{self._quote_messages().rstrip('.')}"
        into[:] = math.nan

    @property
    def discarded(self) -> str:
        """The last evaluation that the FMU could not compute; empty if there is none."""
        return self._discarded

    def slopes(self, ports: Sequence[str], *, rates: bool, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of an `evaluation` by (x, u); None if the FMU computes no directional derivatives.

        Those of local variables may not be asked for (FMI 2.0, 2.1.9; FMI 3.0, 2.2.11). Those of states are known; some
        FMUs say that they are zero.
        """
        about = self.description
        if not self.about.has_derivatives or (self._x.size and not about.states):
            return None
        outputs = [self.block.output_variables[port] for port in ports]
        states = [about.find_state(v) for v in outputs]
        asked = [
            v.type == "Float64" and state is None and about.has_slopes(v)
            for v, state in zip(outputs, states, strict=True)
        ]
        if any(
            v.type == "Float64" and not a and name is None for v, a, name in zip(outputs, asked, states, strict=True)
        ):
            return None
        self.evaluation(Wanted(tuple(ports), rates))(t, x, u)
        unknown = [*outputs, *(about.find(name) for name in about.states.values() if rates)]
        asked += [True] * (len(unknown) - len(asked))
        smooth = [v for v, is_asked in zip(unknown, asked, strict=True) if is_asked]
        parts = (np.full(v.size, is_asked) for v, is_asked in zip(unknown, asked, strict=True))
        rows = np.concatenate([np.zeros(0, dtype=bool), *parts])
        J = np.zeros((rows.size, x.size + u.size))
        first, where = 0, about.layout(about.states).slices
        for v, name in zip(outputs, states, strict=True):
            if name is not None:
                J[first : first + v.size, where[name]] = np.eye(v.size)
            first += v.size
        column = 0
        known = [(about.find(name), True) for name in about.states]
        known += [(v, port in self._smooth and v.type == "Float64") for port, v in self._ports.items()]
        references = [r for v in smooth for r in v.references]
        count = sum(v.size for v in smooth)
        for variable, moves in known:
            for k in range(variable.size):
                if moves and count:
                    refs, seed = seeds(variable, k)
                    purpose = f"the directional derivative by {variable.name}"
                    J[rows, column] = self.call(purpose, self.fmi.directional_derivative, references, refs, seed, count)
                column += 1
        return J

    def _check_structure(self, t: float, x: np.ndarray, u: np.ndarray) -> None:
        """Refuse a model structure that leaves out what outputs or derivatives follow; once for each point of an FMU.

        FMUs that Loopwright has built are right. An input may act in some mode only, so every start is looked at. The
        order of evaluation and linear models rest on it. Everything that some values should not follow is moved.

        Values that differ between evaluations at one point, such as a processor time, follow nothing: that is noted.
        """
        about = self.description
        key = about.digest, t, x.tobytes(), u.tobytes()
        if key in _CHECKED:
            for text in _CHECKED[key]:
                self.add_note(text)
            return
        if self.is_built_here or self.block.dependencies == "all" or (x.size and not about.states):
            return
        ports = [p for p, v in self.block.output_variables.items() if v.type == "Float64" and is_smooth(v)]
        rows = [self.block.output_variables[p] for p in ports]
        rows += [about.find(name) for name in about.states.values()]
        columns: list[tuple[FmuVariable, str | None]] = [(about.find(name), None) for name in about.states]
        columns += [(self._ports[port], port) for port in self._smooth]
        if not rows or not columns:
            return
        declared = np.block([[self.about.pattern(of, v) for v, _ in columns] for of in rows])
        bound = self._bind(Wanted(tuple(ports), bool(about.states)), all_inputs=True)
        start = np.concatenate([x, *(u[self._places[port]] for _, port in columns if port is not None)])
        nominals, low, high = (
            np.concatenate([np.ravel(part) for part in parts])
            for parts in zip(*((v.nominals, *v.limits) for v, _ in columns), strict=True)
        )
        step = _MOVED * np.maximum(np.abs(start), nominals) * np.random.default_rng(0).uniform(0.5, 1.0, start.size)
        step = np.where(start + step <= high, step, np.where(start - step >= low, -step, 0.0))

        def values(moved: np.ndarray) -> np.ndarray:
            inputs, first = u.copy(), x.size
            for v, port in columns:
                if port is not None:
                    inputs[self._places[port]] = moved[first : first + v.size]
                    first += v.size
            return self._run(bound, t, moved[: x.size], inputs).copy()

        names = [label for v in rows for label in elements(v.name, v.shape)]
        base, again, whole = values(start), values(start), np.abs(values(start + step))
        least, drift = _SAME * (np.abs(base) + whole), np.abs(again - base)
        for pattern in np.unique(declared, axis=0)[:_MOST_PATTERNS]:
            mine, free = np.all(declared == pattern, axis=1), ~pattern & (step != 0.0)
            if not free.any():
                continue
            off = mine & (np.abs(values(np.where(free, start + step, start)) - base) > least)
            if off.any():  # a value that grows by itself, in steps of a clock, may have waited for just this moment
                drift = np.fmax(drift, np.abs(values(start) - base))
            off &= ~(drift > least)
            if not off.any():
                continue
            knowns = [label for v, _ in columns for label in elements(v.name, v.shape)]
            row = int(np.flatnonzero(off)[0])
            alone = (np.where(np.arange(start.size) == k, start + step, start) for k in np.flatnonzero(free))
            sizes = [abs(values(moved)[row] - base[row]) for moved in alone]
            values(start)
            k = int(np.flatnonzero(free)[int(np.argmax(sizes))])
            raise FmuRuntimeError(
                f"its model structure says that {names[row]!r} does not depend on {knowns[k]!r}; found a change of "
                f"{max(sizes):.3g} where that moves by {step[k]:.3g}. The order of evaluation would be wrong. Take "
                "interface='co_simulation' if it is offered, or dependencies='all', by which everything may depend on "
                "everything, and tell its makers.",
                block=self.block.label,
                t=t,
            )
        values(start)
        notes = [
            f"{names[row]!r} changes by itself: it differs by {drift[row]:.3g} between evaluations at one time, with "
            "the same states and inputs, as a processor time or a random number does. Runs with it are not repeatable "
            "where it is read, and its dependencies can't be checked"
            for row in np.flatnonzero(drift > least)[:_MOST_NOTES]
        ]
        for text in notes:
            self.add_note(text)
        if len(_CHECKED) >= _MOST_CHECKED:
            _CHECKED.clear()
        _CHECKED[key] = notes

    def _error(self, action: str, status: int, t: float) -> FmuRuntimeError:
        self.failed, self.fatal = status >= ERROR, status >= FATAL
        u = ", ".join(f"{port} = {self._u[self._places[port]].tolist()}" for port in self._wired)
        return FmuRuntimeError(
            f"{action} failed with {self.fmi.status_name(status)} at t = {t:.9g} s{self._quote_messages()} Its states "
            f"were {self._x.tolist()}, its inputs at the last step {u or 'none'}. Look at the last samples of "
            "error.run, or check its inputs and start values.",
            block=self.block.label,
            t=t,
        )

    def _unfit(self, error: UnfitError, t: float) -> FmuRuntimeError:
        advice = "Leave this output out, by ports=."
        if error.port in self._ports:
            advice = "Convert the signal before this input, with Quantizer, say."
        if isinstance(error, OutOfRangeError):
            advice = "Limit the signal before this input, with Saturation, say."
        return FmuRuntimeError(f"{error.reason}. {advice}", block=self.block.label, port=error.port, t=t)


def is_smooth(variable: FmuVariable) -> bool:
    """Whether an input may be set in Continuous-Time Mode: a real number that is not discrete."""
    return variable.type in ("Float64", "Float32") and variable.variability == "continuous"


def seeds(variable: FmuVariable, k: int) -> tuple[list[int], list[float]]:
    """Return value references and seeds that move one element of a variable."""
    if len(variable.references) == variable.size:
        return [variable.references[k]], [1.0]
    return list(variable.references), np.eye(variable.size)[k].tolist()

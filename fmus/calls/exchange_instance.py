"""Instance of an FMU in model exchange: evaluated at any time, states and inputs; events change its discrete states."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np

from ...blocks.core import FmuRuntimeError, Layout
from ..archive import ExchangeInfo, FmuVariable
from ..platform import is_built_here
from .bound_calls import DISCARD, ERROR, FATAL, WARNING, BoundCalls, Call
from .evaluation import Evaluation, Vector
from .exchange_states import SavedExchange
from .fmi_calls import EventUpdate
from .fmu_block import FmuBlock, check_next_time
from .loaded_library import MakeCalls
from .texts import Text, TextRecord
from .transfer import Transfer, UnfitError

_ROUNDS = 100  # of an event iteration
_NOTHING = nullcontext()
_SAME = 1e-12  # relative change of a continuous input that is no jump


class ExchangeInstance(SavedExchange):
    """Loaded FMU whose continuous states a solver integrates.

    After `begin` it is in Continuous-Time Mode. There `evaluation` sets time, states and continuous inputs and gets
    outputs, derivatives and indicators: this leaves its discrete states as they are. `handle_event` goes through Event
    Mode, where discrete inputs and tunable parameters are set.

    States stand in the order of the description's ``states``, inputs in that of the block's ports.

    Attributes
    ----------
    next_time : float
        Time of its next time event in s, infinite without one.
    nominals : ndarray
        Nominal values of the continuous states.
    """

    def __init__(self, block: FmuBlock, wired: Sequence[str], *, make_calls: MakeCalls | None = None):
        super().__init__(block, model_exchange=True, make_calls=make_calls)
        assert self.description.exchange is not None
        self.about: ExchangeInfo = self.description.exchange
        self._ports = dict(block.input_variables)
        self._places = Layout.of({port: v.shape for port, v in self._ports.items()}).slices
        self._wired = {port: self._ports[port] for port in wired}
        self._smooth = {port: v for port, v in self._wired.items() if is_smooth(v)}
        n = self.about.state_count
        order = self.description.state_order
        self._order = np.array(order if len(order) == n else range(n), dtype=int)
        self._time = self.fmi.variable(ctypes.c_double)
        self._x, self._dx, self._kept = (self._allocate(n) for _ in range(3))
        self._indicators = self._allocate(len(self.about.indicators))
        self.next_time, self.nominals, self._has_odd_nominals = math.inf, np.ones(n), False
        self._evaluations: dict[Any, Evaluation] = {}
        self.ends_run = False
        """Whether the FMU has asked to end the simulation (terminateSimulation)."""
        self._guarded = self.fmi.in_process and not is_built_here(self.description.digest)
        self._texts = TextRecord(self.fmi, block.text_variables)
        self._events = self.fmi.event_calls()
        self._event: Evaluation | None = None
        self._completion: Evaluation | None = None
        self._bound: dict[tuple[str, int], BoundCalls] = {}
        self._all_inputs: Transfer | None = None
        self._final = True
        self._discarded = ""
        self._u = np.zeros(0)
        """Values of all inputs at the last instant that was reached."""

    @property
    def t(self) -> float:
        """Time that was set last, in s."""
        return self._time.value if self._running else self._began

    def _allocate(self, n: int) -> np.ndarray:
        return self.fmi.allocate(n, ctypes.c_double)

    # ---- evaluations ----

    def evaluation(
        self, ports: Sequence[str], *, rates: bool = False, indicators: bool = False
    ) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
        """Return the call ``(t, x, u) -> values`` that gets outputs, then derivatives, then indicators.

        The result is one array, written anew by each call: NaN where the FMU can't compute it there (discard).

        Parameters
        ----------
        ports : sequence of str
            Output ports.
        rates, indicators : bool
            Whether the derivatives of the states, and the event indicators, are wanted.
        """
        key = (tuple(ports), rates, indicators)
        if key not in self._evaluations:
            self._evaluations[key] = self._bind(*key)
        found = self._evaluations[key]

        def evaluate(t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            return self._run(found, t, x, u)

        return evaluate

    def _bind(
        self, ports: tuple[str, ...], rates: bool, indicators: bool, then: tuple[tuple[Call, str], ...] = ()
    ) -> Evaluation:
        outputs = {port: self.block.output_variables[port] for port in ports}
        every = indicators or bool(then)
        used = {port: v for port, v in self._smooth.items() if every or self._is_used(port, outputs, rates)}
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
            rates=rates,
            indicators=Vector("indicators", self._indicators) if indicators else None,
            then=then,
        )

    def _is_used(self, port: str, outputs: dict[str, FmuVariable], rates: bool) -> bool:
        """Whether an input has to be set: what is wanted may depend on it."""
        unknown = [*outputs.values()]
        if rates:
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
            if status != DISCARD:
                raise self._error(action, status, t)
            self._discarded = f"{action} at t = {t:.9g} s{self._quote_messages().rstrip('.')}"
            made.result[:] = math.nan
        elif made.rates is not None:
            made.result[made.rates_at][self._order] = self._dx
        return made.result

    @property
    def discarded(self) -> str:
        """The last evaluation that the FMU could not compute; empty if there is none."""
        return self._discarded

    def slopes(self, ports: Sequence[str], *, rates: bool, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of an `evaluation` by (x, u); None if the FMU computes no directional derivatives."""
        about = self.description
        if not self.about.has_derivatives or (self._x.size and not about.states):
            return None
        self.evaluation(ports, rates=rates)(t, x, u)
        outputs = [self.block.output_variables[port] for port in ports]
        unknown = [*outputs, *(about.find(name) for name in about.states.values() if rates)]
        smooth = [v for v in unknown if v.type == "Float64"]
        rows = np.concatenate([np.zeros(0, dtype=bool), *(np.full(v.size, v.type == "Float64") for v in unknown)])
        J = np.zeros((rows.size, x.size + u.size))
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

    # ---- the start ----

    def exchange(self, u: np.ndarray) -> np.ndarray:
        """In Initialization Mode: set the inputs, and return the continuous states that follow."""
        self._u = u.copy()
        status = self._fill(u, self._began).set() if self._wired else 0
        if not 0 <= status <= WARNING:
            raise self._error("setting the inputs", status, self._began)
        return self._get("get_states")

    def begin_exchange(self) -> np.ndarray:
        """Leave Initialization Mode, settle the events at the start, and return the continuous states."""
        self.begin()
        self._time.value = self._began
        x = self._iterate(self._began)
        self.nominals = self._read_nominals()
        for text in self.call("reading its texts", self._texts.go_back, self._began):
            self.add_note(text)
        return x

    @property
    def texts(self) -> Mapping[str, list[tuple[float, Text]]]:
        """Texts and binary data by port: each value with the time in s from which on it held."""
        return self._texts.values

    def _note_texts(self, t: float) -> None:
        if self._texts.variables:
            self.call("reading its texts", self._texts.note, t)

    def _read_nominals(self) -> np.ndarray:
        """Return the states' nominal values; 1 stands in for a value that is 0 or no number."""
        found = np.abs(self._get("nominals"))
        usable = np.isfinite(found) & (found > 0.0)
        if not usable.all() and not self._has_odd_nominals:
            self._has_odd_nominals = True
            self.add_note(
                f"the nominal values of its states are {found.tolist()}; expected positive numbers. 1 stands in for "
                "the others in the solver's tolerances"
            )
        return np.where(usable, found, 1.0)

    def _get(self, quantity: str, *then: Call) -> np.ndarray:
        """Return a vector of the FMU's for its states, and make further calls behind it."""
        n = self._x.size
        made, calls = np.zeros(n), [*then]
        if n:
            address, length = ctypes.c_void_p(self._kept.ctypes.data), ctypes.c_size_t(n)
            arguments = self.fmi.instance_argument, address, length
            calls.insert(0, (self.fmi.exchange_function(quantity), arguments))
        if calls:
            bound = self._bound.get((quantity, len(calls)))
            if bound is None:
                bound = self._bound[quantity, len(calls)] = self.fmi.bind(calls)
            status = bound.run()
            if not 0 <= status <= WARNING:
                raise self._error(_READING[quantity], status, self.t)
        if n:
            made[self._order] = self._kept
        return made

    def _fill(self, u: np.ndarray, t: float) -> Transfer:
        """Return the transfer of all wired inputs, discrete ones too, with their values."""
        if self._all_inputs is None:
            vector = self._allocate(sum(v.size for v in self._wired.values()))
            self._all_inputs = Transfer(self.fmi, "Set", self._wired, vector)
        inputs = self._all_inputs
        if self._wired:
            inputs.vector[:] = np.concatenate([u[self._places[port]] for port in self._wired])
        try:
            for group in inputs.groups:
                group.check_and_fill(inputs.vector)
        except UnfitError as error:
            raise self._unfit(error, t) from None
        return inputs

    # ---- events ----

    def has_jumped(self, u: np.ndarray) -> bool:
        """Whether an input has jumped since the last instant that was reached."""
        for port, variable in self._wired.items():
            now, before = u[self._places[port]], self._u[self._places[port]]
            if port not in self._smooth:
                if not np.array_equal(now, before):
                    return True
            elif np.any(np.abs(now - before) > _SAME * np.maximum(np.abs(now), variable.nominals.ravel())):
                return True
        return False

    def handle_event(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Go through Event Mode at an instant, and return the continuous states after it."""
        inputs = self._fill(u, t)
        try:
            inputs.check_limits()
        except UnfitError as error:
            raise self._unfit(error, t) from None
        if self._event is None:
            calls = self._events
            sets = [((group.function, group.arguments), "setting the inputs") for group in inputs.groups]
            more = [(calls.enter, "entering Event Mode"), *sets, (calls.update, "the event iteration")]
            self._event = self._bind((), False, bool(self.about.indicators), tuple(more))
        self._u, self._discarded = u.copy(), ""
        self._run(self._event, t, x, u)
        self._check_computed(t)
        return self._iterate(t, self._events.updated())

    def _check_computed(self, t: float) -> None:
        """Refuse an instant that the solver has reached, and that the FMU can't compute."""
        if self._discarded:
            raise self._error(f"{self._discarded}, where the solver has arrived:", DISCARD, t)

    def _call_bound(self, call: Call, action: str, t: float) -> None:
        status = self.fmi.bind([call]).run()
        if not 0 <= status <= WARNING:
            raise self._error(action, status, t)

    def _iterate(self, t: float, made: EventUpdate | None = None) -> np.ndarray:
        """Update the discrete states until they settle, and return to Continuous-Time Mode."""
        calls, nominals = self._events, False
        for _ in range(_ROUNDS):
            if made is None:
                self._call_bound(calls.update, "the event iteration", t)
                made = calls.updated()
            nominals |= made.nominals_changed
            if made.terminate:
                self._note_end(t, "in Event Mode")
            if not made.again:
                break
            made = None
        else:
            raise FmuRuntimeError(
                f"its discrete states don't settle at t = {t:.9g} s: after {_ROUNDS} rounds of the event iteration it "
                f"still asks for another one{self._quote_messages()} Report it to its makers, or change the inputs "
                "there.",
                block=self.block.label,
                t=t,
            )
        assert made is not None
        self.next_time = check_next_time(self.block, made.next_time, t)
        x = self._get("get_states", calls.leave)
        if nominals:
            self.nominals = self._read_nominals()
        self._note_texts(t)
        return x

    def accept(self, t: float, x: np.ndarray, u: np.ndarray) -> bool:
        """Note an instant that the solver has reached; return whether the FMU wants an event there (step event)."""
        discrete = [port for port in self._wired if port not in self._smooth]
        kept = {port: self._u[self._places[port]].copy() for port in discrete}
        self._u, self._discarded = u.copy(), ""
        changed = False
        for port, values in kept.items():  # they are taken over by an event alone
            changed |= not np.array_equal(values, u[self._places[port]])
            self._u[self._places[port]] = values
        if self._texts.variables:
            self.evaluation(())(t, x, u)
            self._note_texts(t)
        if not self.about.completes_steps:
            return changed
        if self._completion is None:
            self._completion = self._bind((), False, False, ((self._events.complete, "completing a step"),))
        self._events.final.value = self._final
        self._run(self._completion, t, x, u)
        self._check_computed(t)
        wants, terminate = self._events.completed()
        if terminate:
            self._note_end(t, "after a step of the solver")
        return wants or changed

    def _note_end(self, t: float, place: str) -> None:
        """Note that the FMU asks to end the simulation; it is told once."""
        if not self.ends_run:
            self.ends_run = True
            self.add_note(f"it asks to end the simulation at t = {t:.9g} s, {place} (terminateSimulation)")

    # ---- failures ----

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
        advice = "Convert the signal before this input, with Quantizer, say, or leave this output out, by ports=."
        return FmuRuntimeError(f"{error.reason}. {advice}", block=self.block.label, port=error.port, t=t)


_READING = {"get_states": "reading the continuous states", "nominals": "reading the nominal values of the states"}


def is_smooth(variable: FmuVariable) -> bool:
    """Whether an input may be set in Continuous-Time Mode: a real number that is not discrete."""
    return variable.type in ("Float64", "Float32") and variable.variability == "continuous"


def seeds(variable: FmuVariable, k: int) -> tuple[list[int], list[float]]:
    """Return value references and seeds that move one element of a variable."""
    if len(variable.references) == variable.size:
        return [variable.references[k]], [1.0]
    return list(variable.references), np.eye(variable.size)[k].tolist()

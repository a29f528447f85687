"""Instance of an FMU in model exchange: evaluated at any time, states and inputs; events change its discrete states."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import cached_property, partial

import numpy as np

from ...blocks.core import EvaluationVectors, FmuError, FmuRuntimeError, Layout, Wanted
from ..archive import FmuVariable, ModelExchangeInfo
from ..host_state import HostState
from .bound_calls import DISCARD, ERROR, FATAL, WARNING, BoundCalls, Call
from .event_calls import EventUpdate, check_next_time
from .fmi_calls import MOST_ROUNDS
from .loaded_fmu import LoadedFmu
from .loading import FmuSetup
from .model_exchange_calls import Evaluation, Vector, call_actions
from .model_structure import check_structure, is_smooth
from .native_calls import ActionKind, NativeAction, NativeLook, copy_action, transfer_actions
from .saved_state import StateFormat
from .transfer import Transfer, UnfitError

_NOTHING = nullcontext()
_SAME = 1e-12  # relative change of a continuous input that is no jump
_UPDATING = "the event iteration"
_READING = {"get_states": "reading the continuous states", "nominals": "reading the nominal values of the states"}
_FORMAT = StateFormat(b"lw-fmu-x", "dd", "state of an FMU in model exchange", "those of a run with the same interface")
"""State in model exchange: its time and the time of the next time event, in s; all inputs go before the FMU's bytes."""


class ModelExchangeInstance(LoadedFmu):
    """Loaded FMU whose continuous states a solver integrates.

    After `begin` it is in Continuous-Time Mode. There `evaluation` sets time, states and continuous inputs and gets
    outputs, derivatives and indicators: this leaves its discrete states as they are. `handle_event` goes through Event
    Mode, where discrete inputs and tunable parameters are set.

    States are in the order of the description's ``states``, inputs in that of the block's ports. ``next_time`` is the
    time of its next time event in s, infinite without one.
    """

    def __init__(self, setup: FmuSetup, wired: Sequence[str]):
        super().__init__(setup, wired, model_exchange=True)
        assert setup.model_exchange_info is not None
        self.about: ModelExchangeInfo = setup.model_exchange_info
        self._ports = dict(setup.input_variables)
        self._places = Layout.of({port: v.shape for port, v in self._ports.items()}).slices
        self._smooth = {port: v for port, v in self.inputs.items() if is_smooth(v)}
        n = self.about.state_count
        order = self.description.state_order
        self._order = np.array(order if len(order) == n else range(n), dtype=int)
        self._time = self.fmi.variable(ctypes.c_double)
        self._x, self._dx, self._kept = (self._allocate(n) for _ in range(3))
        self._indicators = self._allocate(len(self.about.indicators))
        self._evaluations: dict[Wanted, Evaluation] = {}
        self._is_own = self.fmi.in_process and self.is_built_here
        self._guarded = self.fmi.in_process and not self._is_own
        self._discarded = ""
        self.u = np.zeros(0)
        """Values of all inputs at the last instant that was reached."""
        self.next_time, self.nominals, self._has_odd_nominals = math.inf, np.ones(n), False
        self._events = self.fmi.event_calls()
        self._bound: dict[tuple[str, int], BoundCalls] = {}
        self._wired_at = self._index(self.inputs)
        self._discrete_at = self._index(port for port in self.inputs if port not in self._smooth)
        self.is_final = True
        """Whether no earlier state will be restored."""
        self._limited = any(np.isfinite(side).any() for v in self.inputs.values() for side in v.limits)
        width = sum(v.size for v in self._ports.values())
        self._least, self._relative = np.full(width, math.inf), np.zeros(width)
        """Least change of each input that is a jump, by itself and relative to the input; infinite without a wire."""
        for port, variable in self.inputs.items():
            smooth = _SAME if port in self._smooth else 0.0
            self._least[self._places[port]] = smooth * variable.nominals.ravel()
            self._relative[self._places[port]] = smooth

    @property
    def t(self) -> float:
        """Time that was set last, in s."""
        return self._time.value if self.is_running else self._began

    def _index(self, ports: Iterable[str]) -> np.ndarray:
        """Return the places of some ports among all inputs."""
        return np.concatenate([np.zeros(0, int), *(np.r_[self._places[port]] for port in ports)])

    def _allocate(self, n: int) -> np.ndarray:
        return self.fmi.allocate(n, ctypes.c_double)

    # ---- evaluations ----

    def evaluation(self, wanted: Wanted) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
        """Return the call ``(t, x, u) -> values`` that gets outputs, then derivatives, then indicators.

        The result is one array, written again by each call: NaN where the FMU can't compute it there (discard).
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
        outputs = {port: self.setup.output_variables[port] for port in wanted.outputs}
        every = wanted.indicators or bool(then) or all_inputs
        used = {port: v for port, v in self._smooth.items() if every or self._is_needed(port, wanted)}
        inputs = self._allocate(sum(v.size for v in used.values()))
        got = self._allocate(sum(v.size for v in outputs.values()))
        return Evaluation(
            self.fmi,
            time=self._time,
            states=Vector("set_states", self._x),
            inputs=Transfer(self.fmi, "Set", used, inputs),
            index=self._index(used),
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

    def _is_needed(self, port: str, wanted: Wanted) -> bool:
        """Whether outputs or rates that are wanted may depend on an input."""
        unknown = [self.setup.output_variables[name] for name in wanted.outputs]
        if wanted.rates:
            unknown += [self.description.find(name) for name in self.description.states.values()]
            if not self.description.states:
                return True
        return any(self.about.pattern(of, self._ports[port]).any() for of in unknown)

    def _run(self, made: Evaluation, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        self._x[:] = x[self._order]
        try:
            with self.host if self._guarded else _NOTHING:
                status, action = made.run(t, u, running=self.is_running)
        except UnfitError as error:
            raise self.refuse(error, t) from None
        if status:
            self._judge_evaluation(status, [action] if action else made.warned, t, made.result)
        if status <= WARNING and made.rates is not None:
            made.result[made.rates_at][self._order] = self._dx
        return made.result

    def _judge_evaluation(self, status: int, actions: Sequence[str], t: float, into: np.ndarray) -> None:
        """Note a warning; write NaN where the FMU can't compute a result; raise the error of a status that is worse."""
        if status <= WARNING:
            for action in actions:
                self.log.warn(action, self.fmi.status_name(status), t)
            return
        if status != DISCARD:
            raise self.report(actions[-1], status, t)
        self._discarded = f"{actions[-1]} at t = {t:.9g} s{self.quote_messages().rstrip('.')}"
        into[:] = math.nan

    def compute(self, wanted: Wanted, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return a copy of the values of an `evaluation`; where the FMU can't compute them that is an error."""
        self._discarded = ""
        found = self.evaluation(wanted)(t, x, u).copy()
        if self._discarded:
            raise self.report(f"{self._discarded}, where its slopes are computed:", DISCARD, t)
        return found

    def rows(self, wanted: Wanted) -> list[FmuVariable]:
        """Return the variables of an `evaluation` without indicators: outputs, then the derivatives of the states."""
        outputs = [self.setup.output_variables[port] for port in wanted.outputs]
        return [*outputs, *(self.description.find(name) for name in self.description.states.values() if wanted.rates)]

    @property
    def discarded(self) -> str:
        """The last evaluation that the FMU could not compute; empty if there is none."""
        return self._discarded

    def slopes(self, ports: Sequence[str], *, rates: bool, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of an `evaluation` by (x, u); None if the FMU can't be asked for all of it."""
        found = self.own_slopes(Wanted(tuple(ports), rates), t, x, u)
        return found[0] if found is not None and found[1].all() else None

    def own_slopes(
        self, wanted: Wanted, t: float, x: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the directional derivatives of an `evaluation` by (x, u), and which rows the FMU may be asked for.

        None if it computes none. Columns of inputs that are not set in Continuous-Time Mode are zero.
        """
        about = self.description
        if not self.about.has_derivatives or (self._x.size and not about.states):
            return None
        self.evaluation(wanted)(t, x, u)
        knowns = [(about.find(name), True) for name in about.states]
        knowns += [(v, port in self._smooth) for port, v in self._ports.items()]
        return self.directional_slopes(self.rows(wanted), knowns)

    # ---- the start ----

    def exchange(self, u: np.ndarray) -> np.ndarray:
        """In Initialization Mode: set the inputs, and return the continuous states that follow."""
        self.u = u.copy()
        status = self._fill(u, self._began).set() if self.inputs else 0
        self.judge("setting the inputs", status, self._began)
        return self._get("get_states")

    def begin_exchange(self) -> np.ndarray:
        """Leave Initialization Mode, settle the events at the start, and return the continuous states."""
        self.begin()
        return self.settle()

    def begin(self) -> None:
        """Leave Initialization Mode."""
        if self._limited:
            self.check_limits(self._fill(self.u, self._began), self._began)
        super().begin()
        self._time.value = self._began

    def settle(self) -> np.ndarray:
        """Settle the events at the start, and return the continuous states."""
        x = self._iterate(self._began, self.fmi.initialized)
        self.nominals = self._read_nominals()
        self.begin_texts(self._began)

        def evaluation(wanted: Wanted) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
            return partial(self._run, self._bind(wanted, all_inputs=True))

        check_structure(self, self.about, self._places, evaluation, self._began, x, self.u)
        return x

    def _read_nominals(self) -> np.ndarray:
        """Return the states' nominal values; 1 replaces a value that is 0 or no number."""
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
        made = np.zeros(self._x.size)
        bound = self._bind_reading(quantity, *then)
        if bound.calls:
            self.judge(_READING[quantity], bound.run(), self.t)
        if made.size:
            made[self._order] = self._kept
        return made

    def _bind_reading(self, quantity: str, *then: Call) -> BoundCalls:
        n, calls = self._x.size, [*then]
        if n:
            address, length = ctypes.c_void_p(self._kept.ctypes.data), ctypes.c_size_t(n)
            arguments = self.fmi.instance_argument, address, length
            calls.insert(0, (self.fmi.exchange_function(quantity), arguments))
        bound = self._bound.get((quantity, len(calls)))
        if bound is None:
            bound = self._bound[quantity, len(calls)] = self.fmi.bind(calls) if calls else BoundCalls(())
        return bound

    @cached_property
    def _all_inputs(self) -> Transfer:
        vector = self._allocate(self._wired_at.size)
        return Transfer(self.fmi, "Set", self.inputs, vector)

    def _fill(self, u: np.ndarray, t: float) -> Transfer:
        """Return the transfer of all wired inputs, discrete ones too, with their values."""
        inputs = self._all_inputs
        inputs.vector[:] = u[self._wired_at]
        try:
            inputs.fill()
        except UnfitError as error:
            raise self.refuse(error, t) from None
        return inputs

    # ---- events ----

    def has_jumped(self, u: np.ndarray) -> bool:
        """Whether an input has jumped since the last instant that was reached."""
        change = np.abs(u - self.u)
        return bool((change > np.maximum(self._least, self._relative * np.abs(u))).any())

    def handle_event(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Go through Event Mode at an instant, and return the continuous states after it."""
        inputs = self._fill(u, t)
        self.check_limits(inputs, t)
        self.u, self._discarded = u.copy(), ""
        self._run(self._event, t, x, u)
        self._check_computed(t)
        return self._iterate(t, self._events.answers.updated())

    @cached_property
    def _event(self) -> Evaluation:
        """Calls that go into Event Mode, with all inputs, for a first round."""
        enter, update = self._events.enter, self._events.update
        more = [(call, "setting the inputs") for call in self._all_inputs.calls]
        more = [*([] if enter is None else [(enter, "entering Event Mode")]), *more, (update, _UPDATING)]
        return self._bind(Wanted(indicators=bool(self.about.indicators)), tuple(more))

    @cached_property
    def _completion(self) -> Evaluation:
        """Calls by which the FMU learns of a step that the solver has accepted."""
        return self._bind(Wanted(), ((self._events.complete, "completing a step"),))

    def _check_computed(self, t: float) -> None:
        """Refuse an instant that the solver has reached, and that the FMU can't compute."""
        if self._discarded:
            raise self.report(f"{self._discarded}, where the solver has arrived:", DISCARD, t)

    @cached_property
    def _update(self) -> BoundCalls:
        """One more round of the event iteration."""
        return self.fmi.bind([self._events.update])

    def _iterate(self, t: float, made: EventUpdate | None = None) -> np.ndarray:
        """Update the discrete states until they settle, and return to Continuous-Time Mode."""
        calls, nominals = self._events, False
        for _ in range(MOST_ROUNDS):
            if made is None:
                self.judge(_UPDATING, self._update.run(), t)
                made = calls.answers.updated()
            nominals |= made.nominals_changed
            if made.terminate:
                self.note_end(t, in_event=True)
            if not made.again:
                break
            made = None
        else:
            raise self._unsettled(t)
        assert made is not None
        self.next_time = check_next_time(self.setup.label, made.next_time, t)
        x = self._get("get_states", *([] if calls.leave is None else [calls.leave]))
        if nominals:
            self.nominals = self._read_nominals()
        self.note_texts(t)
        return x

    def _unsettled(self, t: float) -> FmuRuntimeError:
        return FmuRuntimeError(
            f"its discrete states don't settle at t = {t:.9g} s: after {MOST_ROUNDS} rounds of the event iteration it "
            f"still asks for another one{self.quote_messages()} Report it to its makers, or change the inputs there.",
            block=self.setup.label,
            t=t,
        )

    def accept(self, t: float, x: np.ndarray, u: np.ndarray) -> bool:
        """Note an instant that the solver has reached; return whether the FMU wants an event there (step event)."""
        if self._limited:
            self.check_limits(self._fill(u, t), t)
        discrete = self.u[self._discrete_at]  # they are taken over by an event alone
        changed = not np.array_equal(discrete, u[self._discrete_at])
        self.u, self._discarded = u.copy(), ""
        self.u[self._discrete_at] = discrete
        if self.record.variables:
            self.evaluation(Wanted())(t, x, u)
            self.note_texts(t)
        if not self.about.completes_steps:
            return changed
        completion = self._completion
        self._events.final.value = self.is_final
        self._run(completion, t, x, u)
        self._check_computed(t)
        wants, terminate = self._events.answers.completed()
        if terminate:
            self.note_end(t, in_event=False)
        return wants or changed

    def note_end(self, t: float, *, in_event: bool) -> None:
        """Note that the FMU asks to end the simulation; it is reported once."""
        place = "in Event Mode" if in_event else "after a step of the solver"
        if not self.ends_run:
            self.ends_run = True
            self.add_note(f"it asks to end the simulation at t = {t:.9g} s, {place} (terminateSimulation)")

    # ---- saved states ----

    @property
    def can_serialize(self) -> bool:
        """Whether its state can be turned into bytes."""
        return self.about.can_serialize

    def serialize(self) -> bytes:
        """Return its complete state."""
        self._check_can()
        self.is_final = False
        handle = self.call("saving its state", self.fmi.save_state)
        try:
            data = self.call("serializing its state", self.fmi.serialize_state, handle)
        finally:
            self.free_state(handle)
        data = self.u.astype("<f8").tobytes() + bytes(data)
        return _FORMAT.pack(self.description.digest, self.t, self.next_time, data=data)

    def restore_bytes(self, data: bytes) -> None:
        """Go to a state that `serialize` has returned."""
        self._check_can()
        n = 8 * sum(v.size for v in self._ports.values())
        (t, next_time), rest = _FORMAT.unpack(data, self.description.digest, self.setup.label, least=n)
        u, rest = np.frombuffer(rest[:n], "<f8").copy(), rest[n:]
        handle = self.call("reading a serialized state", self.fmi.deserialize_state, rest)
        try:
            self.call("restoring its state", self.fmi.set_state, handle)
        finally:
            self.free_state(handle)
        self.failed, self.is_running, self.is_final, self.ends_run = False, True, False, False
        self.u, self.next_time, self._time.value = u, next_time, t

    def _check_can(self) -> None:
        if self.can_serialize:
            return
        flag = self.description.state_flags[1 if self.about.can_save else 0]
        raise FmuError(
            f"its state can't be turned into bytes: {flag} is false for model exchange in the FMU's description. "
            "Export it with that capability, or run again from the start.",
            block=self.setup.label,
        )

    # ---- errors ----

    def report(self, action: str, status: int, t: float) -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        self.failed, self.fatal = status >= ERROR, status >= FATAL
        u = ", ".join(f"{port} = {self.u[self._places[port]].tolist()}" for port in self.inputs)
        return FmuRuntimeError(
            f"{action} failed with {self.fmi.status_name(status)} at t = {t:.9g} s{self.quote_messages()} Its states "
            f"were {self._x.tolist()}, its inputs at the last step {u or 'none'}. Look at the last samples of "
            "error.run, or check its inputs and start values.",
            block=self.setup.label,
            t=t,
        )

    # ---- for a loop in C ----

    def find_native_obstacle(self) -> str | None:
        """Return why a loop in C can't evaluate it; None if it can."""
        if not self.fmi.in_process and self._update.request is None:
            return "runs in its own process, for which C can't wait on this system"
        if self.record.variables:
            return "has outputs of texts, which are recorded at each step"
        return None

    def native_evaluation(self, wanted: Wanted, vectors: EvaluationVectors, *, again: bool) -> list[NativeAction]:
        """Return `evaluation` as actions of C on these vectors.

        With ``again`` another one always comes right before it, at the same t and x, which an FMU that Loopwright has
        built need not be given again.
        """
        return self._evaluation(wanted).native(vectors, self._order, again=again and self._is_own)

    def native_look(self, vectors: EvaluationVectors) -> NativeLook:
        """Return `accept` and `handle_event` as actions of C, at what is in t, x and u; states are written."""
        inputs, take = self._fill(self.u, self.t), ActionKind.TAKE
        u, without_result = vectors.u, vectors._replace(into=np.zeros(0))
        enter = [*transfer_actions(inputs, u, self._wired_at, take)]
        enter += self._event.native(without_result, self._order)
        complete = self._completion.native(without_result, self._order) if self.about.completes_steps else []
        calls = self._events
        states = self._bind_reading("get_states", *([] if calls.leave is None else [calls.leave]))
        leave = call_actions(states, [_READING["get_states"]] * len(states.calls))
        low, high, discrete = np.full(u.size, -math.inf), np.full(u.size, math.inf), np.zeros(u.size, dtype=bool)
        low[self._wired_at], high[self._wired_at] = inputs.limits
        discrete[self._discrete_at] = True
        return NativeLook(
            complete,
            enter,
            call_actions(self._update, [_UPDATING]),
            [*leave, *copy_action(ActionKind.GIVE, vectors.into, self._order, self._kept)],
            calls.answers,
            None if self.fmi.in_process and calls.leave is not None else calls.final,
            self._least,
            self._relative,
            discrete,
            low,
            high,
        )

    @property
    def native_host(self) -> HostState | None:
        """The state of this process, which a library that Loopwright has not built may change."""
        return self.host if self._guarded else None

    def take_back(self, u: np.ndarray, next_time: float, *, read_nominals: bool) -> None:
        """Continue from where a loop in C has come to."""
        self.u, self.next_time = u.copy(), next_time
        if read_nominals:
            self.nominals = self._read_nominals()

    def judge_native(self, action: str, status: int, t: float) -> None:
        """Raise the error of a call of C that has failed; without a status, of an event that has no end or no time."""
        if not status:
            check_next_time(self.setup.label, self._events.answers.updated().next_time, t)
            raise self._unsettled(t)
        if status != DISCARD:
            raise self.report(action, status, t)
        self._judge_evaluation(status, [action], t, np.zeros(0))
        self._check_computed(t)

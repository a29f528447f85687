"""Instance of an FMU in model exchange: evaluated at any time, states and inputs; events change its discrete states."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ...blocks.core import EvaluationVectors, FmuRuntimeError, SimulationError, Wanted
from ..host_state import HostState
from .bound_calls import DISCARD, WARNING, BoundCalls, Call, EventUpdate
from .evaluated_exchange import EvaluatedExchange
from .evaluation import Evaluation, call_actions
from .fmu_block import FmuBlock, check_next_time
from .loaded_library import MakeCalls
from .native_step import ActionKind, NativeAction, NativeLook, copy_action, transfer_actions
from .texts import Text, TextRecord
from .transfer import Transfer, UnfitError

ROUNDS = 100
"""Rounds of an event iteration."""
_SAME = 1e-12  # relative change of a continuous input that is no jump


class ExchangeInstance(EvaluatedExchange):
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
        super().__init__(block, wired, make_calls=make_calls)
        n = self.about.state_count
        self._kept = self._allocate(n)
        self.next_time, self.nominals, self._has_odd_nominals = math.inf, np.ones(n), False
        self.ends_run = False
        """Whether the FMU has asked to end the simulation (terminateSimulation)."""
        self._texts = TextRecord(self.fmi, block.text_variables)
        self._events = self.fmi.event_calls()
        self._event: Evaluation | None = None
        self._completion: Evaluation | None = None
        self._bound: dict[tuple[str, int], BoundCalls] = {}
        self._all_inputs: Transfer | None = None
        self._final = True
        self._limited = any(np.isfinite(side).any() for v in self._wired.values() for side in v.limits)
        self.is_trial = False
        """Whether a step may be taken back; an input out of its range is then kept in `refused`, and no error yet."""
        self.refused: SimulationError | None = None
        """Error of an input that was out of its range in a trial step."""
        width = sum(v.size for v in self._ports.values())
        self._least, self._relative = np.full(width, math.inf), np.zeros(width)
        """Least change of each input that is a jump, by itself and relative to the input; infinite without a wire."""
        for port, variable in self._wired.items():
            smooth = _SAME if port in self._smooth else 0.0
            self._least[self._places[port]] = smooth * variable.nominals.ravel()
            self._relative[self._places[port]] = smooth

    @property
    def t(self) -> float:
        """Time that was set last, in s."""
        return self._time.value if self._running else self._began

    # ---- the start ----

    def exchange(self, u: np.ndarray) -> np.ndarray:
        """In Initialization Mode: set the inputs, and return the continuous states that follow."""
        self._u = u.copy()
        status = self._fill(u, self._began).set() if self._wired else 0
        self._check("setting the inputs", status, self._began)
        return self._get("get_states")

    def begin_exchange(self) -> np.ndarray:
        """Leave Initialization Mode, settle the events at the start, and return the continuous states."""
        if self._limited:
            self._check_limits(self._fill(self._u, self._began), self._began)
        self.begin()
        self._time.value = self._began
        x = self._iterate(self._began, self._events.first())
        self.nominals = self._read_nominals()
        for text in self.call("reading its texts", self._texts.go_back, self._began):
            self.add_note(text)
        self._check_structure(self._began, x, self._u)
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
        made = np.zeros(self._x.size)
        bound = self._bind_reading(quantity, *then)
        if bound.calls:
            self._check(_READING[quantity], bound.run(), self.t)
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
        change = np.abs(u - self._u)
        return bool((change > np.maximum(self._least, self._relative * np.abs(u))).any())

    def handle_event(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Go through Event Mode at an instant, and return the continuous states after it."""
        inputs = self._fill(u, t)
        self._check_limits(inputs, t)
        event = self._event_evaluation(inputs)
        self._u, self._discarded = u.copy(), ""
        self._run(event, t, x, u)
        self._check_computed(t)
        return self._iterate(t, self._events.updated())

    def _event_evaluation(self, inputs: Transfer) -> Evaluation:
        """Return the calls that go into Event Mode, with all inputs, for a first round."""
        if self._event is None:
            calls = self._events
            sets = [((group.function, group.arguments), "setting the inputs") for group in inputs.groups]
            more = [*sets, (calls.update, _UPDATING)]
            if calls.enter is not None:
                more.insert(0, (calls.enter, "entering Event Mode"))
            self._event = self._bind(Wanted(indicators=bool(self.about.indicators)), tuple(more))
        return self._event

    def _step_evaluation(self) -> Evaluation:
        """Return the calls that tell an accepted step of the solver."""
        if self._completion is None:
            self._completion = self._bind(Wanted(), ((self._events.complete, "completing a step"),))
        return self._completion

    def _check_limits(self, inputs: Transfer, t: float) -> None:
        """Refuse inputs out of the range that the FMU states, in a trial step only if it is accepted."""
        try:
            inputs.check_limits()
        except UnfitError as error:
            refused = self._unfit(error, t)
            if not self.is_trial:
                raise refused from None
            self.refused = self.refused or refused

    def _check_computed(self, t: float) -> None:
        """Refuse an instant that the solver has reached, and that the FMU can't compute."""
        if self._discarded:
            raise self._error(f"{self._discarded}, where the solver has arrived:", DISCARD, t)

    def _bind_update(self) -> BoundCalls:
        key = ("update", 1)
        if key not in self._bound:
            self._bound[key] = self.fmi.bind([self._events.update])
        return self._bound[key]

    def _check(self, action: str, status: int, t: float) -> None:
        """Note a warning, once for each action; raise the error of a status that is worse."""
        if not 0 <= status <= WARNING:
            raise self._error(action, status, t)
        if status:
            self.log.warn(action, self.fmi.status_name(status), t)

    def _iterate(self, t: float, made: EventUpdate | None = None) -> np.ndarray:
        """Update the discrete states until they settle, and return to Continuous-Time Mode."""
        calls, nominals = self._events, False
        for _ in range(ROUNDS):
            if made is None:
                self._check(_UPDATING, self._bind_update().run(), t)
                made = calls.updated()
            nominals |= made.nominals_changed
            if made.terminate:
                self._note_end(t, "in Event Mode")
            if not made.again:
                break
            made = None
        else:
            raise self._unsettled(t)
        assert made is not None
        self.next_time = check_next_time(self.block, made.next_time, t)
        x = self._get("get_states", *([] if calls.leave is None else [calls.leave]))
        if nominals:
            self.nominals = self._read_nominals()
        self._note_texts(t)
        return x

    def _unsettled(self, t: float) -> FmuRuntimeError:
        return FmuRuntimeError(
            f"its discrete states don't settle at t = {t:.9g} s: after {ROUNDS} rounds of the event iteration it "
            f"still asks for another one{self._quote_messages()} Report it to its makers, or change the inputs there.",
            block=self.block.label,
            t=t,
        )

    def accept(self, t: float, x: np.ndarray, u: np.ndarray) -> bool:
        """Note an instant that the solver has reached; return whether the FMU wants an event there (step event)."""
        if self._limited:
            self._check_limits(self._fill(u, t), t)
        discrete = [port for port in self._wired if port not in self._smooth]
        kept = {port: self._u[self._places[port]].copy() for port in discrete}
        self._u, self._discarded = u.copy(), ""
        changed = False
        for port, values in kept.items():  # they are taken over by an event alone
            changed |= not np.array_equal(values, u[self._places[port]])
            self._u[self._places[port]] = values
        if self._texts.variables:
            self.evaluation(Wanted())(t, x, u)
            self._note_texts(t)
        if not self.about.completes_steps:
            return changed
        completion = self._step_evaluation()
        self._events.final.value = self._final
        self._run(completion, t, x, u)
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

    # ---- for a loop in C ----

    def find_native_obstacle(self) -> str | None:
        """Return why a loop in C can't evaluate it; None if it can."""
        if not self.fmi.in_process and self._bind_update().request is None:
            return "runs in a process of its own, for which C can't wait on this system"
        if self._texts.variables:
            return "has outputs of texts, which are recorded at each step"
        return None

    def native_evaluation(self, wanted: Wanted, vectors: EvaluationVectors, *, again: bool) -> list[NativeAction]:
        """Return `bound_evaluation` as actions of C."""
        return self._evaluation(wanted).native(vectors, self._order, again=again and self._is_own)

    def native_look(self, vectors: EvaluationVectors) -> NativeLook:
        """Return `accept` and `handle_event` as actions of C, at what stands in t, x and u; states are written."""
        inputs, take = self._fill(self._u, self.t), ActionKind.TAKE
        u, without_result = vectors.u, vectors._replace(into=np.zeros(0))
        index = np.concatenate([np.zeros(0, int), *(np.arange(s.start, s.stop) for s in map(self._place, self._wired))])
        enter = [*transfer_actions(inputs, u, index, take)]
        enter += self._event_evaluation(inputs).native(without_result, self._order)
        complete = self._step_evaluation().native(without_result, self._order) if self.about.completes_steps else []
        calls = self._events
        assert calls.answers is not None
        states = self._bind_reading("get_states", *([] if calls.leave is None else [calls.leave]))
        leave = call_actions(states, [_READING["get_states"]] * len(states.calls))
        low, high, discrete = np.full(u.size, -math.inf), np.full(u.size, math.inf), np.zeros(u.size, dtype=bool)
        low[index], high[index] = inputs.bounds
        for port in self._wired:
            discrete[self._places[port]] = port not in self._smooth
        return NativeLook(
            complete,
            enter,
            call_actions(self._bind_update(), [_UPDATING]),
            [*leave, *copy_action(ActionKind.GIVE, vectors.into, self._order, self._kept)],
            calls.answers,
            None if self.fmi.in_process and calls.leave is not None else calls.final,
            self._least,
            self._relative,
            discrete,
            low,
            high,
        )

    def _place(self, port: str) -> slice:
        return self._places[port]

    @property
    def native_host(self) -> HostState | None:
        """The state of this process, which a library that Loopwright has not built may change."""
        return self.host if self._guarded else None

    @property
    def is_final(self) -> bool:
        """Whether no earlier state will be restored."""
        return self._final

    @property
    def reached_inputs(self) -> np.ndarray:
        """Values of all inputs at the last instant that was reached."""
        return self._u

    def take_back(self, u: np.ndarray, next_time: float, *, read_nominals: bool) -> None:
        """Go on from where a loop in C has come to."""
        self._u, self.next_time = u.copy(), next_time
        if read_nominals:
            self.nominals = self._read_nominals()

    def take_end(self, t: float, *, in_event: bool) -> None:
        """Note that the FMU has asked to end the simulation, to a loop in C."""
        self._note_end(t, "in Event Mode" if in_event else "after a step of the solver")

    def take_warning(self, action: str, t: float) -> None:
        """Note a warning of the FMU, to a loop in C."""
        self.log.warn(action, self.fmi.status_name(WARNING), t)

    def judge_native(self, action: str, status: int, t: float) -> None:
        """Raise the error of a call of C that has failed; without a status, of an event that has no end or no time."""
        if not status:
            check_next_time(self.block, self._events.updated().next_time, t)
            raise self._unsettled(t)
        if status != DISCARD:
            raise self._error(action, status, t)
        self._judge(status, [action], t, np.zeros(0))
        self._check_computed(t)


_UPDATING = "the event iteration"
_READING = {"get_states": "reading the continuous states", "nominals": "reading the nominal values of the states"}

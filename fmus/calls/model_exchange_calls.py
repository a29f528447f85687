"""Evaluations of an FMU in model exchange: fixed sequences of calls on fixed vectors."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from ...blocks.core import EvaluationVectors
from .bound_calls import BoundCalls, Call
from .fmi_calls import WARNING, FmiCalls
from .native_calls import ActionKind, NativeAction, call_action, copy_action, transfer_actions
from .transfer import Transfer

T = TypeVar("T")
_Named = tuple[Callable[..., int], tuple[Any, ...], str]
"""A function, its arguments, and the name of the call."""


@dataclass(frozen=True, eq=False)
class Vector:
    """A vector of float64 that one function sets or gets."""

    function: str
    """Name for `FmiCalls.exchange_function`."""
    values: np.ndarray


class Evaluation:
    """Calls that set time, states and inputs, and get outputs, derivatives and indicators; ``then`` follow others.

    Each call is bound once, to vectors that stay where they are: another process can make one round trip of it.

    The order of questions is that of `order_questions`. ``asked_first`` are the variables that are read before the
    derivatives where no outputs are wanted; None for an FMU that computes all that it is asked for, in any order.
    """

    warned: Sequence[str] = ()

    def __init__(
        self,
        fmi: FmiCalls,
        *,
        time: ctypes.c_double,
        states: Vector,
        inputs: Transfer,
        index: np.ndarray,
        outputs: Transfer,
        derivatives: Vector,
        rates: bool,
        indicators: Vector | None,
        then: Sequence[tuple[Call, str]] = (),
        asked_first: Transfer | None = None,
    ):
        self._time, self._inputs, self._index, self._outputs = time, inputs, index, outputs
        self._states = states.values
        self.rates, self.indicators = derivatives if rates else None, indicators
        sizes = [outputs.vector.size, *(0 if v is None else v.values.size for v in (self.rates, indicators))]
        self.result = np.zeros(sum(sizes))
        self.rates_at = slice(sizes[0], sizes[0] + sizes[1])
        self._outputs_at, self._indicators_at = slice(0, sizes[0]), slice(sizes[0] + sizes[1], sum(sizes))
        at = [(fmi.exchange_function("set_time"), (fmi.instance_argument, time), "setting the time")]
        at += _vector_call(fmi, states, "setting the continuous states")
        given = [(group.function, group.arguments, "setting the inputs") for group in inputs.groups]
        got = [(group.function, group.arguments, "reading the outputs") for group in outputs.groups]
        starting = [*given, *got]  # derivatives and indicators can't be computed yet (FMI 2.0, 3.2.3)
        slopes = _vector_call(fmi, derivatives, "computing the derivatives of its states")
        if asked_first is None:
            asked = [*(slopes if rates else ()), *got]
        else:
            others = [(group.function, group.arguments, "reading a variable") for group in asked_first.groups]
            asked = order_questions(got or others, slopes, got)
        more = [*given, *asked, *_vector_call(fmi, indicators, "computing the event indicators")]
        more += [(*call, action) for call, action in then]
        self._running, self._starting = (_bind(fmi, calls) for calls in ([*at, *more], starting))

    def run(self, t: float, u: np.ndarray, *, running: bool) -> tuple[int, str]:
        """Evaluate it; return the status of a call that has failed, and its name; else 1 after a warning, else 0.

        ``running`` says whether time and states are set: in Initialization Mode the FMU has its own.
        """
        self._time.value = t
        if self._index.size:
            vector = self._inputs.vector
            vector[:] = u[self._index]
            for group in self._inputs.groups:
                group.check_and_fill(vector)
        calls, actions = self._running if running else self._starting
        status = calls.run()
        self.warned = [actions[place] for place in calls.warned_places()] if status == WARNING else ()
        if not 0 <= status <= WARNING:
            return status, actions[calls.failed]
        if self._outputs.groups:
            for group in self._outputs.groups:
                group.spread(self._outputs.vector)
            self.result[self._outputs_at] = self._outputs.vector
        if self.indicators is not None:
            self.result[self._indicators_at] = self.indicators.values
        return status, ""

    def native(self, vectors: EvaluationVectors, order: np.ndarray, *, again: bool = False) -> list[NativeAction]:
        """Return it as actions of C on vectors of the caller's; ``order`` is that of the FMU's states.

        With ``again`` time and states need not be set.
        """
        t, x, u, into = vectors
        (calls, names), take, give = self._running, ActionKind.TAKE, ActionKind.GIVE
        placed = (1 + bool(self._states.size)) if again else 0
        time = np.ctypeslib.as_array(ctypes.pointer(self._time), (1,))
        made = [] if again else copy_action(take, t, np.zeros(1, int), time) + copy_action(take, x, order, self._states)
        made += transfer_actions(self._inputs, u, self._index, take)
        made += call_actions(calls, names, placed)
        if not into.size:
            return made
        places = np.arange(into.size)
        made += transfer_actions(self._outputs, into, places[self._outputs_at], give)
        if self.rates is not None:
            made += copy_action(give, into, places[self.rates_at][order], self.rates.values)
        if self.indicators is not None:
            made += copy_action(give, into, places[self._indicators_at], self.indicators.values)
        return made


def order_questions(values: Sequence[T], derivatives: Sequence[T], values_again: Sequence[T]) -> list[T]:
    """Return the calls that read variables and derivatives of an FMU at one point, in an order that holds for all.

    The getter of the derivatives of some FMUs computes the differential equations alone, and then says that all is
    computed: variables that are read after it only are those of an earlier point, and so are event indicators.
    Variables of others are computed with the derivatives alone. So variables come first, then the derivatives, wanted
    or not, then the variables that are wanted once more.
    """
    return [*values, *derivatives, *(values_again if derivatives else ())]


def call_actions(calls: BoundCalls, names: Sequence[str], first: int = 0) -> list[NativeAction]:
    """Return bound calls from one on as actions of C: one each, or one request to another process for all of them."""
    if (request := calls.request) is not None:
        assert not first
        return [NativeAction(ActionKind.ASK, tuple(names), arguments=(request.sequence,), bound=calls)]
    return [call_action(call, name) for call, name in zip(calls.calls[first:], names[first:], strict=True)]


def _vector_call(fmi: FmiCalls, vector: Vector | None, action: str) -> list[_Named]:
    if vector is None or not vector.values.size:
        return []
    address, length = ctypes.c_void_p(vector.values.ctypes.data), ctypes.c_size_t(vector.values.size)
    return [(fmi.exchange_function(vector.function), (fmi.instance_argument, address, length), action)]


def _bind(fmi: FmiCalls, calls: list[_Named]) -> tuple[BoundCalls, list[str]]:
    return fmi.bind([(function, arguments) for function, arguments, _ in calls]), [action for _, _, action in calls]

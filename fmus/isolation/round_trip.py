"""A round trip to a child as one function: a step costs it, beside the FMU's own work."""

from __future__ import annotations

from collections.abc import Callable
from itertools import repeat

from ...blocks.core import FmuProcessError
from . import wire
from .process import ChildProcess


def bind_round_trip(
    process: ChildProcess, sequence: int, seconds: float, note_failure: Callable[[int], int]
) -> Callable[[], int]:
    """Return a function that lets a child run a bound sequence, waits for it, and returns the status.

    It does what `ChildProcess.post` and `ChildProcess.finish` do one after the other, with everything looked up before:
    a lookup costs a twentieth of the whole.

    Parameters
    ----------
    process : ChildProcess
        The child.
    sequence : int
        Number of the sequence.
    seconds : float
        Longest time of it in s.
    note_failure : callable
        Called with a status that is not 0, a warning too; returns it.
    """
    words, patience, number_at = process.words, process.patience, wire.REPLY
    read, take, give = words.__getitem__, wire.ORDER.acquire, wire.ORDER.release
    request, chosen, sleeps = wire.REQUEST, wire.SEQUENCE, wire.CHILD_SLEEPS
    messages, status_at, fewest, ordered = wire.MESSAGES, wire.STATUS, wire.FEWEST, wire.ORDERED

    def run() -> int:
        if not process.alive:
            process.post(sequence)  # it raises the error
        words[chosen] = sequence
        process.number = number = process.number + 1
        words[request] = number
        if take(False):  # the write above is seen before the read below is done
            give()
        if words[sleeps] or not ordered:
            process.wake(sequence)
        try:
            for _ in repeat(None, patience.looks):
                if read(number_at) == number:
                    patience.pause = fewest
                    break
            else:
                patience.slept()
                process.sleep(sequence, number, seconds)
        except FmuProcessError:
            raise
        except BaseException:  # an interrupt: the reply is still to come
            process.give_up()
            raise
        if words[messages]:
            process.fetch_messages()
        status = words[status_at]
        return note_failure(status) if status else 0

    return run

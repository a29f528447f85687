"""C functions of a library: their names and statuses, those that are missing, and calls that are bound once."""

from __future__ import annotations

import ctypes
import inspect
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, Protocol

Call = tuple[Callable[..., int], tuple[Any, ...]]
"""A C function, and its arguments."""
STATUS = ("OK", "warning", "discard", "error", "fatal", "pending")
WARNING, DISCARD, ERROR, FATAL, PENDING = range(1, 6)
"""Statuses of FMI's functions (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3)."""


class ChildFace(Protocol):
    """A process that runs calls of a library, as whoever asks for them without `BoundCalls` sees it.

    Attributes
    ----------
    name : str
        The FMU.
    number : int
        Number of the last request.
    arrived : bool
        Whether the reply to it has been seen, though nobody has finished it yet.
    alive, used : bool
        Whether the process is there, and whether no other instance may be made in it.
    """

    name: str
    number: int
    arrived: bool
    alive: bool
    used: bool

    def check_alive(self, call: str) -> None:
        """Raise the error of a process that has ended before a call."""

    def give_up(self) -> None:
        """End the process after an interrupt in a call."""

    def collect(self) -> int:
        """Take the log messages of a request whose reply is there, and return its status."""

    def run_in_c(self, library: str) -> None:
        """Let a library wait for requests and make bound calls there, where it can."""


class ChildRequest(NamedTuple):
    """Calls in another process: who runs them, by which words in shared memory, and which pipes.

    Attributes
    ----------
    process : ChildFace
        The process.
    sequence : int
        Number of the calls.
    words : int
        Address of the words.
    commands, replies : int
        Pipes to wake the process, and to be woken.
    ordered : bool
        False where each request and reply is announced in the pipes.
    looks : int
        Most looks at a reply before one sleeps.
    """

    process: ChildFace
    sequence: int
    words: int
    commands: int
    replies: int
    ordered: bool
    looks: int


class BoundCalls:
    """C functions with their arguments, bound once and called one after the other.

    Parameters
    ----------
    calls : sequence of (function, arguments)
        Functions of the library, with arguments that are C values; their memory is that of `FmiCalls.allocate` and
        `FmiCalls.variable`, or doesn't change.
    """

    failed = 0
    """Place of the call that has failed last."""
    warned = 0
    """Bits of the places of the calls that gave a warning in the last run, the last bit for all behind it."""

    def __init__(self, calls: Sequence[Call]):
        self.calls = tuple(calls)

    def run(self) -> int:
        """Call the functions up to the first that fails; return its status, else 1 after a warning, else 0."""
        worst = 0
        for place, (function, arguments) in enumerate(self.calls):
            status = function(*arguments)
            if status:
                if status != WARNING:
                    self.failed = place
                    return status
                self.warned = bit_of(place) | (self.warned if worst else 0)
                worst = WARNING
        return worst

    def runner(self) -> Callable[[], int]:
        """Return `run` as a function, for a caller to whom each lookup counts."""
        return self.run

    @property
    def request(self) -> ChildRequest | None:
        """The calls as a request to another process; None where they run in this one, or C can't ask for them."""
        return None

    def warned_places(self) -> list[int]:
        """Return the places of the calls that gave a warning, where `run` has returned 1."""
        return [place for place in range(len(self.calls)) if self.warned & bit_of(place)]

    def start(self) -> None:
        """Begin to run, if that can go on by itself; `finish` ends it."""

    def finish(self) -> int:
        """Return the status of what `start` has begun."""
        return self.run()


def bit_of(place: int) -> int:
    """Return the bit of a place; the last one of a word is for all places behind it."""
    return 1 << min(place, 62)


class EventUpdate(NamedTuple):
    """Answer of a round of the event iteration."""

    again: bool
    """Whether another round is needed."""
    terminate: bool
    nominals_changed: bool
    states_changed: bool
    next_time: float
    """Time of the next time event in s, infinite without one."""


class AnswersAt(NamedTuple):
    """Addresses of the answers of ``update`` and ``complete``: flags of some bytes each, and a time in s.

    Another round is wanted where ``again`` is ``again_where``.
    """

    width: int
    again: int
    terminate: int
    nominals: int
    defined: int
    next_time: int
    wants: int
    ends: int
    again_where: bool = True


@dataclass(frozen=True)
class EventCalls:
    """Functions of events in model exchange with their arguments, to be bound, and what they have said."""

    enter: Call | None  # None without modes, as in FMI 1.0
    update: Call
    leave: Call | None
    complete: Call
    """It tells a step of the solver that was accepted."""
    final: Any
    """Argument of ``complete``: whether no earlier state will be restored, a C value that can be changed."""
    updated: Callable[[], EventUpdate]
    """Answer of the last ``update``."""
    completed: Callable[[], tuple[bool, bool]]
    """Answer of the last ``complete``: whether Event Mode is wanted, and the end of the run."""
    first: Callable[[], EventUpdate | None] = lambda: None  # answer of the initialization, in FMI 1.0
    answers: AnswersAt | None = None  # where these answers stand; None where only the functions above can read them


@cache
def allow_missing(kind: Any, prefix: str, required: tuple[str, ...]) -> Any:
    """Return a class of FMPy's that loads a library without some functions too; their calls return an error.

    Tools leave out functions of capabilities that their FMUs don't have, though the standard asks for all of them.

    Parameters
    ----------
    kind : type
        Class of FMPy's.
    prefix : str
        Prefix of the functions' names.
    required : tuple of str
        Ends of the names of functions without which an FMU can't run.
    """
    needed = {f"{prefix}{name}" for name in required}

    def load(fmu: Any) -> None:
        fmu.missing_functions = set()
        for name, *_ in list_prototypes(kind, prefix):
            shown = exported_name(name, prefix, fmu.modelIdentifier)
            if name not in needed and not hasattr(fmu.dll, shown):
                fmu.missing_functions.add(name)
                setattr(fmu.dll, shown, ctypes.CFUNCTYPE(ctypes.c_int)(lambda: ERROR))
        bind_functions(fmu, kind, prefix)

    return type(kind.__name__, (kind,), {"_loadFunctions": load})


class Prototype(NamedTuple):
    """A function of the standard: its name in FMPy, and names and C types of its arguments and its result."""

    name: str
    arguments: tuple[str, ...]
    types: tuple[Any, ...]
    result: Any


@cache
def list_prototypes(kind: Any, prefix: str) -> tuple[Prototype, ...]:
    """Return the functions that a class of FMPy's calls, by the annotations of its methods.

    They are read once for a class. FMPy's own ``_loadFunctions`` reads them for each instance, which takes longer than
    to load the library.
    """
    found = []
    for name in sorted(name for name in dir(kind) if name.startswith(prefix)):
        signature = inspect.signature(getattr(kind, name))
        arguments = list(signature.parameters.values())[1:]
        notes = [a.annotation for a in arguments]
        c_types = tuple(typing.get_args(n)[0] if isinstance(n, types.UnionType) else n for n in notes)
        result = {bytes: ctypes.c_char_p, int: ctypes.c_int}.get(signature.return_annotation)
        result = signature.return_annotation if result is None else result
        found.append(Prototype(name, tuple(a.name for a in arguments), c_types, result))
    return tuple(found)


def bind_functions(fmu: Any, kind: Any, prefix: str) -> None:
    """Give the functions of a loaded library their types, and the object of FMPy's class these functions."""
    for name, arguments, c_types, result in list_prototypes(kind, prefix):
        function = getattr(fmu.dll, exported_name(name, prefix, fmu.modelIdentifier))
        function.argnames, function.argtypes, function.restype = list(arguments), list(c_types), result
        fmu._functions[name] = function


def exported_name(name: str, prefix: str, identifier: str) -> str:
    """Return the name of a function in a library; those of FMI 1.0 begin with the model identifier.

    Examples
    --------
    >>> exported_name("fmi1DoStep", "fmi1", "ball")
    'ball_fmiDoStep'
    """
    return f"{identifier}_{name.replace('fmi1', 'fmi', 1)}" if prefix == "fmi1" else name

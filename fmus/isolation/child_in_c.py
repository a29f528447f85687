"""Bound calls in C, in the child: a small library, which the parent has compiled, waits for requests and makes them.

It imports the standard library only.
"""

from __future__ import annotations

import ctypes
from typing import Any

from . import shared_memory

TYPES: dict[str, Any] = {
    t._type_: t
    for t in (
        *(ctypes.c_bool, ctypes.c_byte, ctypes.c_ubyte, ctypes.c_short, ctypes.c_ushort, ctypes.c_int, ctypes.c_uint),
        *(ctypes.c_long, ctypes.c_ulong, ctypes.c_longlong, ctypes.c_ulonglong, ctypes.c_float, ctypes.c_double),
        *(ctypes.c_char, ctypes.c_char_p, ctypes.c_void_p),
    )
}
"""C types by the letters of ctypes."""
_FORMS = {
    form: place
    for place, form in enumerate(
        (
            *("ppnp", "ppnpn", "pddi", "pddc", "pddcpppp", "pd", "ppn", "p"),
            *("pp", "ppppppp", "pipp", "pcpp", "ppnpp", "pnp", "pcp"),
        )
    )
}
"""Forms of functions: pointers, numbers of elements, times, flags as int and as char; see `child.c`."""
_LETTERS = {"P": "p", "L": "n", "Q": "n", "d": "d", "i": "i", "?": "c", "b": "c", "c": "c"}


_WATCH = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)


def make_watch() -> Any:
    """Return a function for bound calls that notes in a word whether texts are others than when it was called last.

    Its arguments are where the texts are, their number, and where the word is, which it never sets back.
    """
    kept: list[Any] = []

    def watch(texts: int, n: int, changed: int) -> int:
        found = (ctypes.c_char_p * n).from_address(texts)[:]
        if found != kept:
            kept[:] = found
            ctypes.c_int64.from_address(changed).value = 1
        return 0

    return _WATCH(watch)


class _Call(ctypes.Structure):
    _fields_ = [
        ("form", ctypes.c_int64),
        ("function", ctypes.c_void_p),
        ("p", ctypes.c_void_p * 7),
        ("n", ctypes.c_uint64 * 2),
        *((name, ctypes.c_void_p) for name in ("now", "width", "flag")),
    ]


class _Sequence(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), ("calls", ctypes.c_void_p)]


class _Server(ctypes.Structure):
    _fields_ = [
        ("words", ctypes.c_void_p),
        ("count", ctypes.c_int64),
        ("sequences", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in ("commands", "replies", "ordered", "watches")),
        *((name, ctypes.c_int64) for name in ("most", "looks", "left", "pause", "row")),
    ]


Arguments = list[tuple[str, Any]]
"""Arguments of a call: a letter of ctypes each, and the C value, whose memory stays where it is."""


class Server:
    """Waits for requests in C, and makes bound calls; see `loopwright_serve` of ``child.c``.

    ``words`` is the address of the shared words. Without ``ordered`` each request and reply is announced in the pipes.
    After so many ``looks`` at a request one sleeps.
    """

    def __init__(self, library: str, words: int, commands: int, replies: int, ordered: bool, looks: int):
        self._serve = ctypes.CDLL(library)["loopwright_serve"]
        self._serve.restype = ctypes.c_bool
        self._server = _Server(
            words=words,
            commands=commands,
            replies=replies,
            ordered=ordered,
            most=looks,
            left=shared_memory.FEWEST,
            pause=shared_memory.FEWEST,
        )
        self._kept: list[Any] = []
        self._sequences = (_Sequence * 0)()

    def wait(self, last: int) -> bool:
        """Answer requests after a number until one comes that Python is to answer; False when the parent is gone."""
        found: bool = self._serve(ctypes.byref(self._server), ctypes.c_uint64(last))
        return found

    def take(self, sequences: list[list[tuple[Any, Arguments]]]) -> None:
        """Take all sequences that are bound; Python is to run those with a call of another form."""
        self._kept.clear()
        self._sequences = (_Sequence * len(sequences))(*(self._sequence(calls) for calls in sequences))
        self._server.count, self._server.sequences = len(sequences), ctypes.addressof(self._sequences)

    def _sequence(self, calls: list[tuple[Any, Arguments]]) -> _Sequence:
        found = [_call(function, arguments) for function, arguments in calls]
        made = [call for call in found if call is not None]
        if not made or len(made) < len(found):
            return _Sequence()
        array = (_Call * len(made))(*made)
        self._kept.append((array, calls))
        return _Sequence(len(made), ctypes.addressof(array))


def _call(function: Any, arguments: Arguments) -> _Call | None:
    form = _FORMS.get("".join(_LETTERS.get(letter, "x") for letter, _ in arguments))
    if form is None:
        return None
    of = {kind: [value for letter, value in arguments if _LETTERS[letter] == kind] for kind in "pndic"}
    made = _Call(form=form, function=ctypes.cast(function, ctypes.c_void_p).value)
    for i, value in enumerate(of["p"]):
        made.p[i] = value.value if isinstance(value, ctypes.c_void_p) else ctypes.addressof(value)
    for i, value in enumerate(of["n"]):
        made.n[i] = value.value
    for name, value in zip(("now", "width"), of["d"], strict=False):
        setattr(made, name, ctypes.addressof(value))
    if flags := of["i"] or of["c"]:
        made.flag = ctypes.addressof(flags[0])
    return made

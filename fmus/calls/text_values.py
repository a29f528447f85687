"""Texts and binary data of an FMU in a run: their values, with the times at which they changed."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping

from ..archive import FmuDescription, OtherVariable
from .bound_calls import Call
from .fmi_calls import FmiCalls

Text = str | bytes | tuple[str, ...] | tuple[bytes, ...]
"""Value of a text or of binary data: a tuple of the elements of an array, in C order."""


def read_text(fmi: FmiCalls, variable: OtherVariable) -> Text:
    """Return the value of a text or of binary data."""
    get: Callable[..., list[str] | list[bytes]] = fmi.get_texts if variable.type == "String" else fmi.get_binaries
    found: tuple[str, ...] | tuple[bytes, ...] = tuple(get([variable.reference], variable.size))  # type: ignore[assignment]
    return found if variable.shape else found[0]


def is_readable(fmi: FmiCalls, variable: OtherVariable) -> bool:
    """Whether the library exports the function that reads a text or binary data; some tools leave it out."""
    return not fmi.lacks(f"Get{variable.type}")


def write_text(fmi: FmiCalls, variable: OtherVariable, value: Text) -> None:
    """Set a text or binary data."""
    elements = list(value) if isinstance(value, tuple) else [value]
    put: Callable[..., None] = fmi.set_texts if variable.type == "String" else fmi.set_binaries
    put([variable.reference], elements)


def waits_for_initialization(about: FmuDescription, name: str) -> bool:
    """Whether a start value is set in Initialization Mode, as FMI 2.0 asks for inputs (3.2.3 and 4.2.4)."""
    return about.fmi.startswith("2") and (about.texts.get(name) or about.find(name)).causality == "input"


def list_limits(label: str, about: FmuDescription, *, model_exchange: bool = False) -> list[str]:
    """Return messages on ports that are neither read nor set, and on a file or description that breaks rules."""
    ins, outs = (about.other_ports(causality) for causality in ("input", "output"))
    outs, clocks = [v for v in outs if not v.is_text and not v.negated_of], [v for v in ins if v.type_is_clock]
    ins = [v for v in ins if not v.type_is_clock and not v.negated_of]
    parts = [f"the outputs {', '.join(map(str, outs))} are not recorded"] if outs else []
    parts += [f"the inputs {', '.join(map(str, ins))} keep their start values"] if ins else []
    found = [f"{label}: no wire carries texts, binaries and clocks: {'; '.join(parts)}"] if parts else []
    driven = {name for v in about.of("input").values() for name in v.clocks}
    still = [
        v
        for v in clocks
        if model_exchange
        or not about.has_event_mode
        or (v.interval_variability == "triggered" and v.name not in driven)
    ]
    if still:
        why = (
            "input clocks are driven in co-simulation alone, and this is model exchange. Take an FMU with co-simulation"
            if model_exchange
            else "a triggered clock ticks where an input that it clocks changes, and it clocks none. Export it with "
            "such an input, or with a periodic clock"
            if about.has_event_mode
            else "the FMU has no Event Mode (hasEventMode)"
        )
        found.append(f"{label}: the clocks {', '.join(map(str, still))} never tick: {why}")
    if about.complaints:
        more = f", and {len(about.complaints) - 1} more" if len(about.complaints) > 1 else ""
        found.append(
            f"{label}: its description breaks the standard: {about.complaints[0].rstrip('.')}{more}. "
            f"'loopwright validate {about.file}' has them all"
        )
    found += [f"{label}: {finding.found.rstrip('.')}" for finding in about.findings]
    return found + [f"{label}: {text}" for text in about.unit_complaints]


class TextWatch:
    """Calls behind a step in another process that note whether texts have changed, so that they need not be read.

    They are of texts alone, no binary data; `changed` is not 0 where they may have changed.
    """

    def __init__(self, fmi: FmiCalls, variables: Iterable[OtherVariable]):
        self.changed = fmi.variable(ctypes.c_int64)
        self.changed.value = 1
        chosen = [*variables]
        references = (ctypes.c_uint * len(chosen))(*(v.reference for v in chosen))
        n = sum(v.size for v in chosen)
        found = fmi.variable(ctypes.c_void_p * n)
        at, word = ctypes.addressof(found), ctypes.c_void_p(ctypes.addressof(self.changed))
        get = fmi.function("GetString"), fmi.value_arguments(references, len(chosen), at, n)
        assert fmi.text_watch is not None
        self.calls: list[Call] = [get, (fmi.text_watch, (ctypes.c_void_p(at), ctypes.c_size_t(n), word))]
        self._kept = references, found

    def take(self) -> bool:
        """Return whether the texts may have changed since the last time."""
        changed, self.changed.value = bool(self.changed.value), 0
        return changed


def watch_texts(fmi: FmiCalls, variables: Iterable[OtherVariable]) -> TextWatch | None:
    """Return the watch of an instance's texts; None in this process, without texts, and where some are binary data."""
    chosen = [v for v in variables if is_readable(fmi, v)]
    if fmi.text_watch is None or not chosen or any(v.type != "String" for v in chosen):
        return None
    return TextWatch(fmi, chosen)


class TextRecord:
    """Values of texts and binary data by port, each with the time in s from which on it holds."""

    def __init__(self, fmi: FmiCalls, variables: Mapping[str, OtherVariable]):
        self.fmi = fmi
        self.variables = dict(variables)
        self.values: dict[str, list[tuple[float, Text]]] = {port: [] for port in self.variables}

    def note(self, t: float) -> None:
        """Read all values at a time in s, and keep those that have changed."""
        for port, variable in self.variables.items():
            value, kept = read_text(self.fmi, variable), self.values[port]
            if not kept or kept[-1][1] != value:
                kept.append((t, value))

    def go_back(self, t: float) -> list[str]:
        """Forget the values from a time in s on, and read those there; return texts on variables that can't be read."""
        lost = []
        for port, variable in [*self.variables.items()]:
            kept = self.values[port]
            while kept and kept[-1][0] >= t:
                kept.pop()
            if not is_readable(self.fmi, variable):
                del self.variables[port], self.values[port]
                lost.append(f"{variable} is not recorded: the library has no {self.fmi.prefix}Get{variable.type}")
        self.note(t)
        return lost

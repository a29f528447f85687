"""Start values of an instance: set in the mode that takes each, and refused where the FMU doesn't keep them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import FmuRuntimeError
from ..archive import FmuDescription, FmuVariable
from .fmi_calls import FmiCalls
from .loading import FmuSetup
from .text_values import is_readable, read_text, waits_for_initialization
from .transfer import Transfer, is_kept

_SET = ("parameter", "input", "structuralParameter")


class InstanceStart:
    """Start values of an instance, by functions that set and read its variables.

    Attributes
    ----------
    given : dict
        Start values of the last initialization, by the FMU's names.
    bound : BoundStart or None
        Calls by which they were set, if they were bound.
    """

    def __init__(
        self,
        fmi: FmiCalls,
        setup: FmuSetup,
        set_values: Callable[[Mapping[str, Any]], None],
        read: Callable[[Iterable[FmuVariable]], np.ndarray],
    ):
        self._fmi, self._setup, self._about = fmi, setup, setup.description
        self._set, self._read = set_values, read
        self.given: dict[str, Any] = {}
        self.bound: BoundStart | None = None
        self._known: dict[tuple[str, ...], BoundStart | None] = {}

    def enter(self, given: dict[str, Any], start_time: float, stop_time: float | None) -> dict[str, Any]:
        """Set start values and enter Initialization Mode at a time in s; return those that the FMU has not kept.

        ``stop_time`` is the end of the run in s; None for that of the stepping options, if any.
        """
        self.given, self.bound = given, None
        about, options = self._about, self._setup.stepping
        stop_time = options.stop_time if stop_time is None else stop_time
        if sizes := {n: v for n, v in given.items() if n in about.structural}:  # the sizes of arrays depend on them
            self._fmi.enter_configuration_mode()
            self._set(sizes)
            self._fmi.exit_configuration_mode()
        self._fmi.set_up(start_time, stop_time, options.tolerance)
        in_mode = {n: v for n, v in given.items() if waits_for_initialization(about, n)}
        self._set({n: v for n, v in given.items() if n not in (*about.structural, *in_mode)})
        self._fmi.enter_initialization_mode(start_time, stop_time, options.tolerance)
        self._set(in_mode)
        lost = self._find_lost(given)
        if lost:  # some tools' FMUs drop parameters that are set before this mode
            self._set(lost)
            lost = self._find_lost(lost)
        return lost

    def enter_bound(self, given: dict[str, Any]) -> bool:
        """Do as `enter` at t = 0, by a few calls that are bound once; return whether the FMU has taken the values.

        It hasn't where they can't be set so, either.
        """
        self.given, self.bound = given, None
        if (names := tuple(given)) not in self._known:
            fits = BoundStart.fits(self._about, names)
            self._known[names] = BoundStart(self._fmi, self._about, names) if fits else None
        bound = self._known[names]
        if bound is not None and bound.enter(given, self._setup.stepping.tolerance):
            self.bound = bound
        return self.bound is not None

    def check_kept(self, t: float) -> None:
        """Refuse start values that the FMU has not kept after its initialization at a time in s."""
        if self.bound is not None and self.bound.are_kept():
            return
        others = {*self._about.texts, *(v.name for v in self._setup.input_variables.values())}  # set again
        names = [n for n in self.given if n not in others and self._about.find(n).causality != "input"]
        self.refuse(self._find_lost({n: self.given[n] for n in names}), t, " after its initialization")

    def refuse(self, lost: Mapping[str, Any], t: float, moment: str = "") -> None:
        """Refuse start values that the FMU has not kept, if there are any."""
        for name, value in lost.items():
            text = self._about.texts.get(name)
            kept = self._read([self._about.find(name)]).tolist() if text is None else read_text(self._fmi, text)
            put = value if text is not None else np.ravel(value).tolist()
            advice = "Leave it out, or set the parameters that it depends on."
            if name in (v.name for v in self._setup.input_variables.values()):
                advice = "Wire it, with Constant, say: a wire sets it before each step."
            raise FmuRuntimeError(
                f"its start value was set to {put!r}, but is {kept!r}{moment}: the FMU does not keep it. {advice}",
                block=self._setup.label,
                port=f"start.{name}",
                t=t,
            )

    def _find_lost(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return those of the given parameters and inputs that the FMU has not kept."""
        about, lost, at, texts = self._about, {}, 0, self._about.texts
        for name in (n for n in given if n in texts and is_readable(self._fmi, texts[n])):
            if read_text(self._fmi, texts[name]) != given[name]:
                lost[name] = given[name]
        numbers = {n: v for n in given if n not in texts and (v := about.find(n)).causality in _SET}
        numbers = dict(sorted(numbers.items(), key=lambda item: item[1].type))  # those of a type are read in one call
        found = self._read(numbers.values())
        values = {name: np.ravel(given[name]).astype(float) for name in numbers}
        if not values or np.array_equal(found, np.concatenate([*values.values()])):
            return lost  # as nearly always
        for name, v in numbers.items():
            at += v.size
            if not is_kept(found[at - v.size : at], values[name], single=v.type == "Float32"):
                lost[name] = given[name]
        return lost


class BoundStart:
    """Start values of type Float64, for which `fits` holds, set in one call, and read back in another."""

    def __init__(self, fmi: FmiCalls, description: FmuDescription, names: tuple[str, ...]):
        variables = {name: description.find(name) for name in names}
        size = sum(v.size for v in variables.values())
        self._fmi, self._given, self._found = fmi, np.zeros(size), np.zeros(size)
        inputs = [np.full(v.size, v.causality == "input") for v in variables.values()]
        self._inputs = np.concatenate([np.zeros(0, dtype=bool), *inputs])
        self._set, self._get = (
            Transfer(fmi, verb, variables, vector) for verb, vector in (("Set", self._given), ("Get", self._found))
        )

    @staticmethod
    def fits(description: FmuDescription, names: tuple[str, ...]) -> bool:
        """Whether start values can be set so: numbers of that type alone, which can be set before initialization."""
        if any(name in description.texts or description.find(name).type != "Float64" for name in names):
            return False
        late = any(waits_for_initialization(description, name) for name in names)
        return not late and not description.structural.keys() & set(names)

    def enter(self, values: Mapping[str, Any], tolerance: float | None) -> bool:
        """Set the values, enter Initialization Mode at t = 0; return whether the FMU has taken them to the last bit."""
        np.concatenate([np.zeros(0), *(np.ravel(value) for value in values.values())], out=self._given)
        self._fmi.set_up(0.0, None, tolerance)
        if not self._call(self._set):
            return False
        self._fmi.enter_initialization_mode(0.0, None, tolerance)
        return self.are_kept(inputs=True)

    def are_kept(self, *, inputs: bool = False) -> bool:
        """Whether the FMU has the values still, to the last bit; those of inputs count where that is asked for."""
        if not self._call(self._get):
            return False
        same = self._found == self._given
        return bool(same.all() if inputs else (same | self._inputs).all())

    @staticmethod
    def _call(transfer: Transfer) -> bool:
        if transfer.plain_call is None:
            return True
        function, arguments = transfer.plain_call
        return not function(*arguments)

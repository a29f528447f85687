"""Parameters that are moved by hand in a run: by functions of the time, sliders, or numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError, OptionError, SimulationError, UnknownNameError, shorten
from ..flat import Target
from ..wiring import Structure, change_parameter, find_control, join


@dataclass(frozen=True)
class _Control:
    """A parameter that is moved by hand: the name it was given by, its block, its place in that, and its source."""

    name: str
    path: str
    keys: list[str]
    source: Any

    def read(self, t: float) -> object:
        if hasattr(self.source, "value"):
            return self.source.value
        if not callable(self.source):
            return self.source
        try:
            return self.source(t)
        except Exception as error:
            raise SimulationError(
                f"the function given for {self.name!r} failed: {type(error).__name__}: {error}. Expected a number for "
                "this time.",
                block=self.path,
                port=self.keys[-1],
                t=t,
            ) from error


class Controls:
    """Parameters that are moved by hand in a run."""

    def __init__(self, table: Structure, inputs: Mapping[str, Any], diagram: str):
        # Each input is a function of the time in s, an object with a ``value`` (a slider), or a number.
        self._blocks: dict[str, Block] = {}
        self._last: dict[str, object] = {}
        self._controls: list[_Control] = []
        for name, source in inputs.items():
            if isinstance(source, str | bytes) or source is None:
                raise OptionError(
                    f"found {shorten(source)} for {name!r}; expected a function of the time, a slider or a number.",
                    block=diagram,
                    port="inputs",
                )
            path, keys = find_control(table, name, diagram)
            if not table.is_traced(path):
                whole = join(path, ".".join(keys))
                raise UnknownNameError(
                    f"{name!r} is of {path}, {type(table.blocks[path]).__name__}, which takes no parameters in a run; "
                    "expected a parameter of a block that the run evaluates. Set it before the run: "
                    f"diagram.replace({{{whole!r}: …}}).",
                    block=diagram,
                    port="inputs",
                )
            self._blocks[path] = table.blocks[path]
            self._controls.append(_Control(name, path, keys, source))

    @property
    def targets(self) -> list[Target]:
        """The parameters: path of a block, and the names that lead to one in it."""
        return [(control.path, control.keys) for control in self._controls]

    def read(self, t: float) -> tuple[list[tuple[float, str, object]], dict[str, Block]]:
        """Read the values at a time in s: return what has changed (time, parameter, value), and the blocks with it."""
        changes: list[tuple[float, str, object]] = []
        moved: dict[str, Block] = {}
        for control in self._controls:
            value = control.read(t)
            if control.name in self._last and np.array_equal(self._last[control.name], value):  # type: ignore[arg-type]
                continue
            self._last[control.name] = value
            try:
                block = change_parameter(self._blocks[control.path], control.keys, value)
            except LoopwrightError as error:
                raise _explain_value(error.at(block=control.path), control, t) from None
            self._blocks[control.path] = moved[control.path] = block
            changes.append((t, f"{control.path}.{'.'.join(control.keys)}", value))
        return changes, moved


def _explain_value(error: LoopwrightError, control: _Control, t: float) -> LoopwrightError:
    """Return the error of a value that a function or a slider has given: it says when."""
    if not (callable(control.source) or hasattr(control.source, "value")):
        return error
    return SimulationError(
        f"what is given for {control.name!r} can't be taken: {error.message}",
        block=error.block,
        port=error.port,
        t=t,
    )

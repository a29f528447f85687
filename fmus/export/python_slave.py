"""Program inside an FMU that needs Python: `python_fmu.py` copies it there; it is never imported from here.

It is next to ``loopwright.json`` (variables and steps), ``loopwright.pickle`` (the block) and, if the block comes from
its own file, that file. PythonFMU makes one object of the class for each instance of the FMU.
"""

# PythonFMU finds the class by importing this file, so it imports only modules that the FMU needs.
import atexit
import contextlib
import ctypes
import importlib.util
import inspect
import json
import math
import os
import pickle
import sys
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real

_KEPT: list[Any] = []
"""Extra references to objects that PythonFMU 0.7 frees twice after an exception: it releases an instance when a call
fails, and once more with the FMU. Without these references the process crashes sooner or later."""


def _end_cleanly(resources: Path, name: str) -> None:
    """Make the FMU's library release the interpreter while Python still runs.

    PythonFMU 0.7 releases it again when the process ends, by a pointer that is freed by then: the process sometimes
    aborts, after all its work. After this call the pointer is null.
    """
    library = resources.parent / "binaries" / "linux64" / f"{name}.so"
    if not sys.platform.startswith("linux") or str(library) in _ENDING:
        return
    with contextlib.suppress(
        OSError, AttributeError
    ):  # not loaded from there (while it is built), or fixed in PythonFMU
        _ENDING[str(library)] = end = ctypes.CDLL(str(library), mode=os.RTLD_NOLOAD).finalizePythonInterpreter
        end.argtypes, end.restype = [], None
        atexit.register(end)


_ENDING: dict[str, Any] = {}


class _Unpickler(pickle.Unpickler):
    """Unpickler that finds objects of the block's own file in the copy next to this file."""

    def __init__(self, stream: Any, module: Any):
        super().__init__(stream)
        self._module = module

    def persistent_load(self, pid: Any) -> Any:
        found = self._module
        for part in pid.split("."):
            found = getattr(found, part)
        return found


def _load(folder: Path, about: dict[str, Any]) -> Any:
    """Return the block."""
    module = None
    if about["file"] is not None:
        name = f"{about['module']}_model"
        module = sys.modules.get(name)
        if module is None:
            spec = importlib.util.spec_from_file_location(name, folder / about["file"])
            if spec is None or spec.loader is None:
                raise ImportError(f"{about['file']} can't be imported")
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            try:
                spec.loader.exec_module(module)
            except BaseException:
                del sys.modules[name]
                raise
    with (folder / "loopwright.pickle").open("rb") as stream:
        return _Unpickler(stream, module).load()


class LoopwrightSlave(Fmi2Slave):  # type: ignore[misc]
    """Slave of PythonFMU that evaluates a block's equations with NumPy."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        folder = Path(kwargs["resources"])
        about = json.loads((folder / "loopwright.json").read_text(encoding="utf-8"))
        self.modelName, self.description, self.guid = about["name"], about["description"], about["guid"]
        _end_cleanly(folder, self.modelName)
        self.default_experiment = DefaultExperiment(0.0, about["stop_time"], about["step_size"])
        self._about, self._given = about, _load(folder, about)
        self._block, self._changed, self._stale, self._t = self._given, False, True, 0.0
        self._values = {
            name: np.array(v["start"], dtype=float).reshape(v["shape"]) for name, v in about["values"].items()
        }
        for v in about["variables"]:
            self.register_variable(
                Real(
                    v["name"],
                    causality=Fmi2Causality[v["causality"]],
                    variability=Fmi2Variability[v["variability"]],
                    initial=None if v["initial"] is None else Fmi2Initial[v["initial"]],
                    description=v["description"] or None,
                    getter=partial(self._get, v["of"], v["index"]),
                    setter=partial(self._set, v["of"], v["index"]),
                ),
                nested=False,
            )

    def _get(self, name: str, index: int) -> float:
        if self._stale and self._about["values"][name]["kind"] == "output":
            try:
                self._evaluate()
            except Exception as error:
                raise self._error_to_raise(error) from error
        return float(self._values[name].flat[index])

    def _set(self, name: str, index: int, value: float) -> None:
        self._values[name].flat[index] = value
        self._stale = True
        self._changed |= self._about["values"][name]["kind"] == "parameter"

    def setup_experiment(self, start_time: float, stop_time: Any, tolerance: Any) -> None:
        """Take the start time."""
        self._t = start_time

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance the states; if that fails, they stay unchanged."""
        before = self._get_fmu_state()
        try:
            self._advance(current_time, step_size)
        except Exception as error:
            self._set_fmu_state(before)
            raise self._error_to_raise(error) from error
        return True

    def _error_to_raise(self, error: Exception) -> Exception:
        """Return the error to raise, with the line in its text, since PythonFMU shows the text only."""
        _KEPT.extend([self, self.log_queue, type(self)] * 4)
        line, step = "", error.__traceback__
        while step is not None:
            if step.tb_frame.f_code.co_filename != __file__:
                line = f" in line {step.tb_lineno} of {Path(step.tb_frame.f_code.co_filename).name}"
            step = step.tb_next
        return RuntimeError(f"{type(error).__name__}{line}: {error}")

    def _advance(self, current_time: float, step_size: float) -> None:
        self._t, kind = current_time, self._about["kind"]
        if kind == "continuous":
            n = max(1, math.ceil(step_size / self._about["internal_step"] * (1.0 - 1e-9)))
            self._integrate(current_time, step_size / n, n)
        elif kind == "sampled":
            T = self._about["step_size"]
            n = round(step_size / T)
            if n < 1 or abs(step_size - n * T) > 1e-9 * step_size:
                raise ValueError(f"found a step of {step_size} s; expected a multiple of its sample time, {T} s")
            for i in range(n):
                self._store(self._call_flat("update", current_time + i * T, self._states()))
        self._t, self._stale = current_time + step_size, True
        self._evaluate()

    def _integrate(self, t: float, h: float, n: int) -> None:
        """Take n steps of the Runge-Kutta method of order 4, with inputs held."""
        x = self._states()
        for i in range(n):
            a = t + i * h
            k1 = self._call_flat("derivative", a, x)
            k2 = self._call_flat("derivative", a + h / 2, x + h / 2 * k1)
            k3 = self._call_flat("derivative", a + h / 2, x + h / 2 * k2)
            k4 = self._call_flat("derivative", a + h, x + h * k3)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        self._store(x)

    # --- the block's equations --------------------------------------------------------------------------------------

    def _names(self, kind: str) -> list[str]:
        return [name for name, v in self._about["values"].items() if v["kind"] == kind]

    def _states(self) -> Any:
        return np.concatenate([*(self._values[name].ravel() for name in self._names("state")), np.zeros(0)])

    def _store(self, x: Any) -> None:
        for name, value in self._split(x).items():
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{name} is {np.asarray(value).tolist()}; expected finite numbers")
            self._values[name] = np.array(value, dtype=float)

    def _split(self, x: Any) -> dict[str, Any]:
        found, at = {}, 0
        for name in self._names("state"):
            shape = self._values[name].shape
            n = math.prod(shape)
            found[name], at = x[at : at + n].reshape(shape), at + n
        return found

    def _call(self, equation: str, t: float, x: Any, count: int) -> Any:
        if self._changed:
            changes = {name: self._values[name] for name in self._names("parameter")}
            self._block, self._changed = _replace(self._given, changes), False
        states = {n: float(v) if np.ndim(v) == 0 else v for n, v in self._split(x).items()}
        inputs = {n: float(v) if np.ndim(v := self._values[n]) == 0 else v.copy() for n in self._names("input")}
        function = getattr(self._block, equation)
        sampled = self._about["kind"] == "sampled" and "T" in inspect.signature(function).parameters
        keywords = {"T": self._about["step_size"]} if sampled else {}
        made = function(t, _bundle("x", states), _bundle("u", inputs), **keywords)
        parts = (made,) if count == 1 else tuple(made)
        if len(parts) != count:
            raise ValueError(f"its {equation} returned {len(parts)} values; expected {count}")
        return parts

    def _call_flat(self, equation: str, t: float, x: Any) -> Any:
        names = self._names("state")
        parts = [np.asarray(part, dtype=float) for part in self._call(equation, t, x, len(names))]
        for name, part in zip(names, parts, strict=True):
            if part.shape != self._values[name].shape:
                expected = self._values[name].shape
                raise ValueError(f"its {equation} gives shape {part.shape} for {name}; expected {expected}")
        return np.concatenate([*(part.ravel() for part in parts), np.zeros(0)])

    def _evaluate(self) -> None:
        names = self._names("output")
        if names:
            made = self._call("output", self._t, self._states(), len(names))
            for name, value in zip(names, made, strict=True):
                self._values[name] = np.array(value, dtype=float).reshape(self._values[name].shape)
        self._stale = False

    # --- the state of an instance -----------------------------------------------------------------------------------

    def _get_fmu_state(self) -> dict[str, Any]:
        return {"t": self._t, "values": {name: value.tolist() for name, value in self._values.items()}}

    def _set_fmu_state(self, state: dict[str, Any]) -> None:
        self._t = state["t"]
        self._values = {name: np.array(value, dtype=float) for name, value in state["values"].items()}
        self._changed, self._stale = True, True


def _bundle(kind: str, values: dict[str, Any]) -> Any:
    return namedtuple(kind, values)(**values)


def _replace(block: Any, changes: dict[str, Any]) -> Any:
    """Return the block with other parameters, made by its constructor, which checks their bounds."""
    own = {name: value for name, value in changes.items() if "." not in name}
    for head in {name.partition(".")[0] for name in changes if "." in name}:
        inner = {name.partition(".")[2]: v for name, v in changes.items() if name.startswith(f"{head}.")}
        own[head] = _replace(getattr(block, head), inner)
    return block.replace(**own)

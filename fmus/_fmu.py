"""An FMU as a block."""

from __future__ import annotations

import ctypes
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..blocks._block import Block
from ..blocks._errors import FmuError, FmuFileError, FmuRuntimeError, ParameterError, UnknownNameError, near
from ..blocks._frozen import FrozenMapping
from ..blocks._ports import Input, Output
from ..blocks._signals import Signal, UnknownAttributeError
from ..blocks._values import parameter
from ._compiler import cache_folder
from ._description_reading import FmuDescription, FmuVariable, read_description

_STATUS = ("OK", "warning", "discard", "error", "fatal")


class Fmu(Block):
    """A co-simulation FMU (FMI 3.0, Float64 variables) as a block; its ports are the FMU's inputs and outputs.

    Outputs are attributes (``plant.position``); ports whose names are no identifiers are reached by index
    (``plant["axis.phi"]``) or get another name by ``rename``. Between communication points its inputs are held and its
    outputs are those at the end of the last step. Inputs must be wired, or be given a value in ``start``.

    The file is checked when the block is made, and loaded only while a run lasts. The SHA-256 digest of what it held
    then belongs to the block: two blocks are equal only if the files' contents were, and a file that has changed since
    is an error.
    """

    opaque = True
    file: str | os.PathLike[str] = parameter(kw_only=False, description="path of the .fmu")
    start: Mapping[str, Any] = parameter(
        default={}, description="start values of parameters, states and inputs, by the FMU's names"
    )
    rename: Mapping[str, str] = parameter(default={}, description="FMU's name → name of the port")

    def check(self) -> None:
        """Check the file, and names, shapes and values of ``start`` and ``rename``."""
        who = self.label
        if not isinstance(self.file, str | os.PathLike):
            raise ParameterError(f"found {self.file!r}; expected the path of an .fmu file.", block=who, port="file")
        try:
            description = read_description(self.file)
        except FmuError as error:
            error.at(block=who)
            raise
        ports = {**description.of("input"), **description.of("output")}
        for old in self.rename:
            if old not in ports:
                raise UnknownNameError(
                    f"it has no port {old!r} to rename. {near(old, ports)}", block=who, port="rename"
                )
        start = {k: self._start_value(description, k, v) for k, v in self.start.items()}
        object.__setattr__(self, "start", FrozenMapping(start))
        object.__setattr__(self, "_content", description.digest)
        new = [self.rename.get(name, name) for name in ports]
        if len(set(new)) < len(new):
            raise ParameterError("two ports get the same name; rename them apart.", block=who, port="rename")

    def _start_value(self, description: FmuDescription, name: str, value: Any) -> Any:
        who, port = self.label, f"start.{name}"
        if name in description.other:
            raise ParameterError(
                f"it is {description.other[name]}; only Float64 can be set so far.", block=who, port=port
            )
        variable = description.variables.get(name)
        if variable is None:
            raise UnknownNameError(
                f"the FMU has no variable {name!r}. {near(name, description.variables)}", block=who, port="start"
            )
        if variable.causality in ("output", "local") and variable.start is None:
            raise ParameterError(
                "it is computed and has no start value; set the states and parameters that it follows from.",
                block=who,
                port=port,
            )
        try:
            array = np.array(np.broadcast_to(np.asarray(value, dtype=float), variable.shape))
        except (TypeError, ValueError):
            raise ParameterError(
                f"found {value!r}; expected numbers of shape {variable.shape}.", block=who, port=port
            ) from None
        if not np.all(np.isfinite(array)):
            raise ParameterError(f"found {value!r}; expected finite numbers{_in(variable)}.", block=who, port=port)
        for bound, wrong in ((variable.minimum, np.less), (variable.maximum, np.greater)):
            if bound is not None and np.any(wrong(array, bound)):
                raise ParameterError(f"found {value!r}; the FMU allows {_range(variable)}.", block=who, port=port)
        return array

    @property
    def description(self) -> FmuDescription:
        """What the FMU's description says.

        Raises
        ------
        FmuFileError
            If the file is gone, or is no longer the one that the block was made with.
        """
        try:
            found = read_description(self.file)
        except FmuError as error:
            error.at(block=self.label)
            raise
        if found.digest != self._content:
            raise FmuFileError(
                f"the file {str(self.file)!r} has changed since this block was made: found SHA-256 "
                f"{found.digest[:12]}…, expected {str(self._content)[:12]}…. Make the block again from the new file, "
                "with Fmu(…) or .replace(), and build the diagram with it.",
                block=self.label,
                port="file",
            )
        return found

    @property
    def label(self) -> str:
        """Name for messages: the given one, else ``fmu``."""
        return self.name or self._hint or "fmu"

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The FMU's inputs."""
        return {
            self.rename.get(n, n): Input(
                v.shape, v.unit, v.description, default=self.start.get(n), name=self.rename.get(n, n)
            )
            for n, v in self.description.of("input").items()
        }

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """The FMU's outputs."""
        return {
            self.rename.get(n, n): Output(v.shape, v.unit, v.description, name=self.rename.get(n, n))
            for n, v in self.description.of("output").items()
        }

    def __getattr__(self, name: str) -> Signal:
        if name.startswith("_") or "file" not in self.__dict__:
            raise AttributeError(name)
        outputs = self.outputs
        if name in outputs:
            return Signal(self, name)
        raise UnknownAttributeError(f"it has no output {name!r}. {near(name, outputs)}", block=self.label)

    def __getitem__(self, name: Any) -> Signal:
        if isinstance(name, str):
            if name in self.outputs:
                return Signal(self, name)
            raise UnknownNameError(f"it has no output {name!r}. {near(name, self.outputs)}", block=self.label)
        return super().__getitem__(name)

    @contextmanager
    def instantiate(self, wired: Sequence[str], stop_time: float) -> Iterator[FmuInstance]:
        """Load the FMU for a run; it is terminated and freed whatever happens.

        Parameters
        ----------
        wired : sequence of str
            The input ports that the run will set at each communication point.
        stop_time : float
            End of the run in s.
        """
        instance = FmuInstance(self, wired)  # it reads the description, and so checks the file
        try:
            instance.initialize(stop_time)
            yield instance
        finally:
            instance.close()


class FmuInstance:
    """A loaded FMU: one step at a time, through vectors that are shared with the scheduler."""

    def __init__(self, block: Fmu, wired: Sequence[str]):
        from fmpy.fmi3 import FMU3Slave

        self.block, self.failed = block, False
        self.messages: list[str] = []
        description = block.description
        back = {new: old for old, new in block.rename.items()}
        self._inputs = [description.variables[back.get(name, name)] for name in wired]
        self._outputs = list(description.of("output").values())
        self._open = self._stepping = False
        folder = Path.cwd()
        try:
            self._fmu = FMU3Slave(
                guid=description.token,
                modelIdentifier=description.identifier,
                unzipDirectory=str(unpacked(description)),
                instanceName=block.label,
            )
            self._fmu.instantiate(logMessage=self._log, loggingOn=True)
        except Exception as error:
            raise FmuFileError(
                f"the FMU {str(description.file)!r} can't be loaded: {error}{self._quoted()} Check it with "
                f"'fmpy validate {description.file}'.",
                block=block.label,
            ) from error
        finally:
            os.chdir(folder)  # FMPy stays in the binary's folder when loading it fails
        self._open = True

    def _log(self, environment: Any, status: int, category: bytes | None, message: bytes | None) -> None:
        text = (message or b"").decode(errors="replace")
        if status and len(self.messages) < 1000:
            self.messages.append(f"{self.block.label}: {_STATUS[status]}: {text}")

    def _quoted(self) -> str:
        return f". The FMU says: {' / '.join(self.messages[-5:])}." if self.messages else "."

    def initialize(self, stop_time: float) -> None:
        """Set start values and enter Initialization Mode at t = 0."""
        variables = self.block.description.variables
        try:
            for name, value in self.block.start.items():
                self._fmu.setFloat64([variables[name].reference], [float(v) for v in np.ravel(value)])
            self._fmu.enterInitializationMode(startTime=0.0, stopTime=stop_time)
        except Exception as error:
            raise self._initialization_error(error) from error

    def _initialization_error(self, error: Exception) -> FmuRuntimeError:
        self.failed = True
        return FmuRuntimeError(
            f"initialization failed ({error}){self._quoted()} Check its start values.", block=self.block.label, t=0.0
        )

    def begin(self) -> None:
        """Leave Initialization Mode and read the outputs with which the run begins."""
        try:
            self._fmu.exitInitializationMode()
        except Exception as error:
            raise self._initialization_error(error) from error
        self._stepping = True
        self._read(0.0)

    def bind(self, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Take the vectors that hold the inputs to set and the outputs to get, and get the outputs once."""
        lib, component = self._fmu.dll, ctypes.c_void_p(self._fmu.component)
        set_values, get_values, do_step = lib["fmi3SetFloat64"], lib["fmi3GetFloat64"], lib["fmi3DoStep"]
        for function in (set_values, get_values, do_step):
            function.restype = ctypes.c_int  # arguments are made once, so their types need no checks at each call
        flags = (ctypes.c_bool * 3)()
        reached = ctypes.c_double()
        ins = (ctypes.c_uint * max(1, len(self._inputs)))(*[v.reference for v in self._inputs])
        outs = (ctypes.c_uint * max(1, len(self._outputs)))(*[v.reference for v in self._outputs])
        self._kept = (ins, outs, flags, reached, inputs, outputs)  # alive as long as their addresses are used
        address, size, now, width = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_double(), ctypes.c_double()
        set_arguments = (component, ins, size(len(self._inputs)), address(inputs.ctypes.data), size(inputs.size))
        get_arguments = (component, outs, size(len(self._outputs)), address(outputs.ctypes.data), size(outputs.size))
        at = ctypes.addressof(flags)
        step_arguments = (
            *(component, now, width, ctypes.c_bool(True)),
            *(address(at), address(at + 1), address(at + 2), ctypes.byref(reached)),
        )
        has_inputs, has_outputs = bool(self._inputs), bool(self._outputs)

        def step(t: float, h: float) -> None:
            if has_inputs and set_values(*set_arguments) > 1:
                raise self._error("setting the inputs", t)
            now.value, width.value = t, h
            if do_step(*step_arguments) > 1:
                raise self._error(f"the step from t = {t:.9g} s by {h:g} s", t)
            if flags[1]:
                raise self._error("the FMU asks to end the simulation: the step", t)
            if has_outputs and get_values(*get_arguments) > 1:
                raise self._error("reading the outputs", t)

        def read(t: float) -> None:
            if has_outputs and get_values(*get_arguments) > 1:
                raise self._error("reading the outputs", t)

        def exchange() -> None:
            if has_inputs and set_values(*set_arguments) > 1:
                raise self._error("setting the inputs", 0.0)
            read(0.0)

        self.step, self.exchange, self._read = step, exchange, read
        read(0.0)

    def _error(self, what: str, t: float) -> FmuRuntimeError:
        self.failed = True
        inputs = ", ".join(f"{v.name}" for v in self._inputs)
        values = self._kept[4].tolist()
        return FmuRuntimeError(
            f"{what} failed{self._quoted()} The inputs ({inputs}) were {values}. Look at the last samples of "
            f"error.run, or take "
            "a smaller step.",
            block=self.block.label,
            t=t,
        )

    def close(self) -> None:
        """Terminate and free the instance."""
        if not self._open:
            return
        self._open = False
        with suppress(Exception):
            if self._stepping and not self.failed:
                self._fmu.terminate()
        with suppress(Exception):
            self._fmu.freeInstance()


def unpacked(description: FmuDescription) -> Path:
    """Return the folder that holds the FMU's files, unpacked once for each content."""
    import fmpy

    folder = cache_folder() / "unpacked" / description.digest[:32]
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        fmpy.extract(description.file, fresh)
        try:
            fresh.rename(folder)
        except OSError:  # another process was faster
            if not folder.is_dir():
                raise
    finally:
        if fresh.is_dir():
            shutil.rmtree(fresh, ignore_errors=True)
    return folder


def _in(variable: FmuVariable) -> str:
    return f" in {variable.unit}" if variable.unit else ""


def _range(variable: FmuVariable) -> str:
    low, high = variable.minimum, variable.maximum
    if low is not None and high is not None:
        return f"{low:g} to {high:g}{_in(variable)}"
    return f"at least {low:g}{_in(variable)}" if low is not None else f"at most {high:g}{_in(variable)}"

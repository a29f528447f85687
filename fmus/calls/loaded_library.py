"""Library of an FMU, loaded in this process, with one instance."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import FmuError, FmuFileError, FmuRuntimeError, UnknownNameError, near
from ..archive import FmuDescription
from ..platform import cache_folder, check_cache
from .fmu_block import FmuBlock

_STATUS = ("OK", "warning", "discard", "error", "fatal")
_FATAL = 4


class LoadedFmu:
    """Instance of an FMU: log, initialization, variables, end."""

    def __init__(self, block: FmuBlock, *, model_exchange: bool = False):
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        self.block, self.description = block, block.description
        self.model_exchange, self.failed, self.fatal = model_exchange, False, False
        self.messages: list[str] = self._list_limits()
        self._limits = len(self.messages)
        self._open = self._running = False
        self._began = 0.0
        description, folder = self.description, Path.cwd()
        try:
            files = unpack(description)
        except FmuError as error:
            error.at(block=block.label)
            raise
        identifier = description.model_exchange if model_exchange else description.identifier
        try:
            self._fmu: Any = (FMU3Model if model_exchange else FMU3Slave)(
                guid=description.token,
                modelIdentifier=identifier,
                unzipDirectory=str(files),
                instanceName=block.label,
            )
            self._check_version()
            self._fmu.instantiate(logMessage=self._log, loggingOn=True)
        except FmuFileError:
            raise
        except Exception as error:
            raise FmuFileError(
                f"the FMU {str(description.file)!r} can't be loaded: {error}{self._quote_messages()} Check it with "
                f"'fmpy validate {description.file}'.",
                block=block.label,
            ) from error
        finally:
            os.chdir(folder)  # FMPy stays in the binary's folder if loading fails
        self._open = True

    def _check_version(self) -> None:
        """Refuse a library of another version of FMI than the description says (FMI 3.0, 2.3.1)."""
        version = str(self._fmu.getVersion())
        if not version.startswith("3.0"):
            raise FmuFileError(
                f"the library of {str(self.description.file)!r} says that it is of FMI {version!r} (fmi3GetVersion); "
                "expected '3.0', as its description says. Export it again.",
                block=self.block.label,
            )

    def _list_limits(self) -> list[str]:
        """Return a message on the ports that are neither read nor set; none if all are Float64."""
        ins, outs = (self.description.other_ports(causality) for causality in ("input", "output"))
        parts = [f"the outputs {', '.join(map(str, outs))} are not recorded"] if outs else []
        parts += [f"the inputs {', '.join(map(str, ins))} keep their start values"] if ins else []
        return [f"{self.block.label}: only Float64 is read and set yet: {'; '.join(parts)}"] if parts else []

    def _log(self, environment: Any, status: int, category: bytes | None, message: bytes | None) -> None:
        text = (message or b"").decode(errors="replace")
        if status and len(self.messages) < 1000:
            self.messages.append(f"{self.block.label}: {_STATUS[status]}: {text}")

    def _quote_messages(self) -> str:
        said = self.messages[self._limits :][-5:]
        return f". The FMU says: {' / '.join(m.rstrip('.') for m in said)}." if said else "."

    @property
    def t(self) -> float:
        """Time of the instance in s."""
        return self._began

    # ---- initialization ----

    def initialize(
        self, stop_time: float | None, *, start_time: float = 0.0, values: Mapping[str, np.ndarray] | None = None
    ) -> None:
        """Set start values and enter Initialization Mode.

        Parameters
        ----------
        stop_time : float, optional
            End of the run in s; None if it is open. Some FMUs refuse to step beyond it, even after the state of a
            longer run has been restored.
        start_time : float
            Start of the run in s.
        values : mapping of str to array, optional
            Further start values, by the FMU's names; they override the block's.
        """
        self._began = start_time
        try:
            self.set_values({**self.block.start, **(values or {})})
            self._fmu.enterInitializationMode(startTime=start_time, stopTime=stop_time)
        except Exception as error:
            raise self._initialization_error(error) from error

    def _initialization_error(self, error: Exception) -> FmuRuntimeError:
        self._note(error)
        return FmuRuntimeError(
            f"initialization failed ({error}){self._quote_messages()} Check its start values.",
            block=self.block.label,
            t=self._began,
        )

    def reset(self) -> None:
        """Return to the state before the initialization (FMI 3.0, 2.3.1)."""
        self.call("resetting it", "reset")
        self.failed = self._running = False

    def begin(self) -> None:
        """Leave Initialization Mode."""
        try:
            self._fmu.exitInitializationMode()
        except Exception as error:
            raise self._initialization_error(error) from error
        self._running = True

    # ---- calls by names, which are not made at each step ----

    def call(self, purpose: str, name: str, *arguments: Any) -> Any:
        """Call a function of FMPy's interface; an error begins with the purpose of the call.

        Raises
        ------
        FmuRuntimeError
            If the FMU's function returns an error.
        """
        try:
            return getattr(self._fmu, name)(*arguments)
        except Exception as error:
            self._note(error)
            raise FmuRuntimeError(
                f"{purpose} failed ({error}){self._quote_messages()} Check that the FMU does as its description "
                f"claims: loopwright validate {self.description.file}.",
                block=self.block.label,
                t=self.t,
            ) from error

    def _note(self, error: Exception) -> None:
        self.failed = True
        self.fatal = self.fatal or getattr(error, "status", None) == _FATAL

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Set variables, by the FMU's names."""
        for name, value in values.items():
            reference = self.description.variables[name].reference
            self._fmu.setFloat64([reference], [float(v) for v in np.ravel(value)])

    def free_state(self, handle: Any) -> None:
        """Free a state that getFMUState gave; after a fatal error nothing is called any more (FMI 3.0, 2.3)."""
        if not self.fatal:
            with suppress(Exception):
                self._fmu.freeFMUState(handle)

    def values(self, names: Iterable[str]) -> np.ndarray:
        """Return the elements of variables, one after the other."""
        variables = [self.description.variables[name] for name in names]
        n = sum(v.size for v in variables)
        if not n:
            return np.zeros(0)
        found = self.call(f"reading {', '.join(names)}", "getFloat64", [v.reference for v in variables], n)
        return np.array(found, dtype=float)

    def directional_derivative(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float]
    ) -> np.ndarray:
        """Return the change of outputs and state derivatives for a change of knowns (FMI 3.0, 2.2.11).

        The derivative is taken at the present time, states and inputs, with discrete states frozen.

        Parameters
        ----------
        unknowns : sequence of str
            Outputs and derivatives of states, by the FMU's names.
        knowns : sequence of str
            Inputs and continuous states, by the FMU's names.
        seed : array_like
            Change of each element of the knowns.

        Returns
        -------
        numpy.ndarray
            Change of each element of the unknowns.

        Raises
        ------
        FmuError
            If the FMU has no directional derivatives.
        FmuRuntimeError
            If the FMU's function fails.
        UnknownNameError
            For an unknown variable.
        """
        about = self.description
        if not (about.model_exchange_has_derivatives if self.model_exchange else about.has_derivatives):
            raise FmuError(
                "it has no directional derivatives: providesDirectionalDerivatives is false in its description. Use "
                "linear_model(), which falls back on differences.",
                block=self.block.label,
            )
        for name in (*unknowns, *knowns):
            if name not in about.variables:
                raise UnknownNameError(
                    f"it has no variable {name!r}. {near(name, about.variables)}", block=self.block.label
                )
        of, by = ([about.variables[name] for name in names] for names in (unknowns, knowns))
        n = sum(v.size for v in of)
        if not n:
            return np.zeros(0)
        changes = [float(c) for c in np.ravel(seed)]
        arguments = ([v.reference for v in of], [v.reference for v in by], changes, n)
        return np.array(self.call("a directional derivative", "getDirectionalDerivative", *arguments), dtype=float)

    # ---- the end ----

    def close(self) -> None:
        """Terminate and free the instance."""
        if not self._open:
            return
        self._open = False
        if self.fatal:  # no function may be called any more, not even to free it (FMI 3.0, 2.2.3)
            return
        with suppress(Exception):
            if self._running and not self.failed:
                self._fmu.terminate()
        with suppress(Exception):
            self._fmu.freeInstance()


def unpack(description: FmuDescription) -> Path:
    """Unpack an FMU, once for each content, and return the folder of its files.

    Raises
    ------
    FmuError
        If the cache can't be written, or is full.
    FmuFileError
        If the archive can't be unpacked.
    """
    import fmpy

    folder = cache_folder() / "unpacked" / description.digest[:32]
    if folder.is_dir():
        return folder
    check_cache()
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        fmpy.extract(description.file, fresh)
        try:
            fresh.rename(folder)
        except OSError:  # another process was faster
            if not folder.is_dir():
                raise
    except OSError as error:
        raise FmuError(
            f"the FMU {str(description.file)!r} can't be unpacked into {str(fresh)!r}: {error}. Make room there, or "
            "set LOOPWRIGHT_CACHE to another folder."
        ) from error
    except Exception as error:
        raise FmuFileError(f"the FMU {str(description.file)!r} can't be unpacked: {error}. Export it again.") from error
    finally:
        if fresh.is_dir():
            shutil.rmtree(fresh, ignore_errors=True)
    return folder


def status_of(code: int) -> str:
    """Return the name of a status in FMI 3.0 (2.2.3), such as ``fmi3Discard``."""
    return f"fmi3{_STATUS[code].capitalize()}" if 0 <= code < len(_STATUS) else f"status {code}"

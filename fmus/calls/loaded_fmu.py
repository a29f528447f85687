"""Instance of an FMU, whose library is loaded in this process or in another one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from itertools import groupby
from typing import Any, TypeVar
from weakref import WeakSet

import numpy as np

from ...blocks.core import (
    FmuError,
    FmuFileError,
    FmuProcessError,
    FmuRuntimeError,
    SimulationError,
    UnknownNameError,
    describe_disk_error,
    near,
)
from ..archive import FmuFault, FmuVariable, inexact, unpack
from ..host_state import FOLDER, HostState
from ..isolation import Isolation
from ..platform import is_built_here
from .fmi_calls import FATAL, WARNING
from .instance_start import InstanceStart
from .loading import FmuSetup, load_calls
from .message_log import MessageLog, clean_text, describe_end
from .step_options import choose_modes
from .text_values import (
    Text,
    TextRecord,
    list_limits,
    write_text,
)
from .transfer import BoundReading, OutOfRangeError, Transfer, UnfitError

R = TypeVar("R")
_OPEN: WeakSet[LoadedFmu] = WeakSet()
"""Open instances of FMUs of which a process can have one only."""


class LoadedFmu:
    """Instance of an FMU: its log, initialization, variables, statuses of its calls, and end.

    Attributes
    ----------
    inputs : dict of str to FmuVariable
        Variables of the input ports that are wired.
    record : TextRecord
        Texts and binary data that are recorded.
    is_open, is_running : bool
        Whether it is there, and whether its initialization is over.
    failed, fatal : bool
        Whether one of its functions has failed, and whether nothing may be called any more.
    ends_run : bool
        Whether the FMU has asked to end the simulation (terminateSimulation).
    on_end : callable or None
        Called when it does so at the end of a step; without it the request is an error.
    is_trial : bool
        Whether a step may be taken back; an input out of its range is then kept in `refused`, and no error yet.
    refused : SimulationError or None
        Error of an input that was out of its range in a trial step.
    """

    failed = fatal = ends_run = is_trial = False
    on_end: Callable[[], None] | None = None
    refused: SimulationError | None = None

    def __init__(self, setup: FmuSetup, wired: Sequence[str] = (), *, model_exchange: bool = False):
        self.setup, self.description, self.model_exchange = setup, setup.description, model_exchange
        self.log = MessageLog(setup.label, list_limits(setup.label, self.description, model_exchange=model_exchange))
        self.is_open = self.is_running = False
        self._began, self.is_built_here = 0.0, is_built_here(self.description.digest)
        self.host = HostState(self.add_note)
        self._load(setup.process_limits)
        self.is_open = True
        if self.description.only_once and self.fmi.in_process:
            _OPEN.add(self)
        self.inputs = {port: setup.input_variables[port] for port in wired}
        self.record = TextRecord(self.fmi, setup.text_variables)
        self._starts = InstanceStart(self.fmi, setup, self.set_values, self.read_variables)

    def _load(self, limits: Isolation | None) -> None:
        """Load its library, in a process with limits or in this one, and make the instance."""
        setup, description, exchange = self.setup, self.description, self.description.exchange
        if limits is None:
            self._refuse_second()
        library = exchange.binary if self.model_exchange and exchange is not None else description.binary
        try:
            files = unpack(description)
        except FmuError as error:
            error.at(block=setup.label)
            raise
        # FMPy stays in the binary's folder if loading fails, too; another process has its own folder
        with FOLDER if limits is None else nullcontext(), self.host:
            try:
                self.fmi = load_calls(
                    setup,
                    limits,
                    name=setup.label,
                    token=description.token,
                    folder=files,
                    library=files / library,
                    model_exchange=self.model_exchange,
                )
                self._fmu, self.fmi.lose, self._reading = self.fmi.fmu, self.lose, BoundReading(self.fmi)
                if self.fmi.in_process and not self.is_built_here:
                    self.fmi.settle_by(self.host.settle)
                self._check_version()
                if not self.model_exchange:
                    choose_modes(self.fmi, description, setup.stepping)
                self.fmi.instantiate(self.log.take)
            except FmuProcessError as error:
                raise self.lose(error) from None
            except FmuError as error:
                self._end_calls()
                error.at(block=setup.label)
                raise
            except Exception as error:
                self._end_calls()
                step = f"Look for its fault with 'loopwright doctor {description.file}'."
                if isinstance(error, OSError) and error.errno is not None:  # not the loader's, which is a text alone
                    found = f"{describe_disk_error(error, files, step)}{self.quote_messages()}"
                else:
                    found = f"{error}{self.quote_messages()} {step}"
                text = f"the FMU {str(description.file)!r} can't be loaded: {found}"
                raise FmuFileError(text, fault=FmuFault.LOADING, block=setup.label) from error

    def _end_calls(self) -> None:
        """Give up the calls after an error in the course of loading."""
        if (calls := getattr(self, "fmi", None)) is not None:
            calls.end()

    def lose(self, error: FmuProcessError) -> FmuProcessError:
        """Note that the process of the FMU has ended, and return the error with place, time and messages."""
        if not self.fatal:
            self.failed = self.fatal = True
            self._end_calls()
            error.add(describe_end(error, self.quote_messages()))
        return error.at(block=self.setup.label, t=self.t)

    def _refuse_second(self) -> None:
        """Refuse a second instance in this process where the FMU can have one only."""
        for other in _OPEN:
            if self.description.only_once and other.description.digest == self.description.digest:
                raise FmuError(
                    f"its FMU {str(self.description.file)!r} can have one instance in a process "
                    f"(canBeInstantiatedOnlyOncePerProcess), and {other.setup.label} is one. End that run first, or "
                    "run them in separate processes.",
                    block=self.setup.label,
                )

    def _check_version(self) -> None:
        """Refuse a library of another version of FMI than the description says (FMI 2.0, 2.1.4; FMI 3.0, 2.3.1)."""
        version, expected = self.fmi.version(), self.description.fmi[:3]
        if not version.startswith(expected) or "-" in version:  # the functions of a beta version take other arguments
            raise FmuFileError(
                f"the library of {str(self.description.file)!r} says that it is of FMI {version!r} "
                f"({self.fmi.prefix}GetVersion); expected {expected!r}, as its description says. Export it again.",
                block=self.setup.label,
            )

    @property
    def messages(self) -> list[str]:
        """Notes on the FMU, and its own messages."""
        return self.log.texts

    def add_note(self, text: str) -> None:
        """Add a message of this library, which is not the FMU's own."""
        self.log.note(text)

    def quote_messages(self) -> str:
        """Return the end of a sentence, with the FMU's last messages if there are any."""
        return self.log.quote()

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
            End of the run in s; None for that of the stepping options, if any. Some FMUs refuse to step beyond it,
            even after the state of a longer run has been restored.
        start_time : float
            Start of the run in s.
        values : mapping of str to array, optional
            Further start values, by the FMU's names; they override the block's.
        """
        with self.host:
            self._began = start_time
            try:
                lost = self._starts.enter({**self.setup.start, **(values or {})}, start_time, stop_time)
            except Exception as error:
                raise self._initialization_error(error) from error
            self._starts.refuse(lost, start_time)

    def _initialization_error(self, error: Exception) -> FmuRuntimeError:
        if isinstance(error, FmuProcessError):
            return self.lose(error)
        self._note(error)
        return FmuRuntimeError(
            f"initialization failed ({error}){self.quote_messages()} Check its start values.",
            block=self.setup.label,
            t=self._began,
        )

    def reset(self) -> None:
        """Return to the state before the initialization (FMI 2.0, 2.1.6; FMI 3.0, 2.3.1).

        An FMU that Loopwright has not built gets a fresh instance: the resets of many leave something behind.
        """
        if self.is_built_here:
            self.call("resetting it", self.fmi.reset)
        else:
            self.call("making it again", self.fmi.renew, self.log.take, self.is_running and not self.failed)
        self.failed = self.is_running = self.ends_run = False
        self.refused = None

    def begin(self) -> None:
        """Leave Initialization Mode."""
        try:
            self.fmi.exit_initialization_mode()
        except Exception as error:
            raise self._initialization_error(error) from error
        self.is_running = True
        self._starts.check_kept(self._began)

    # ---- calls that are not made at each step ----

    def call(self, purpose: str, function: Callable[..., R], *arguments: Any) -> R:
        """Call a method of `fmi`; an error begins with the purpose of the call.

        Raises
        ------
        FmuRuntimeError
            If the FMU's function returns an error.
        """
        try:
            with self.host if self.fmi.in_process and not self.is_built_here else nullcontext():
                return function(*arguments)
        except FmuProcessError as error:
            raise self.lose(error) from None
        except Exception as error:
            self._note(error)
            raise FmuRuntimeError(
                f"{purpose} failed ({error}){self.quote_messages()} Check that the FMU does as its description "
                f"claims: loopwright validate {self.description.file}.",
                block=self.setup.label,
                t=self.t,
            ) from error

    def _note(self, error: Exception) -> None:
        self.failed = True
        self.fatal = self.fatal or getattr(error, "status", None) == FATAL

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Set variables, by the FMU's names."""
        for name, value in values.items():
            if name in self.description.texts:
                write_text(self.fmi, self.description.texts[name], value)
                continue
            variable = self.description.find(name)
            as_type = int if variable.is_integer else float
            self.fmi.set(variable.type, variable.references, [as_type(v) for v in np.ravel(value)])

    def free_state(self, handle: Any) -> None:
        """Free a saved state; after a fatal error nothing is called any more (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3)."""
        if not self.fatal:
            with suppress(Exception):
                self.fmi.free_state(handle)

    def values(self, names: Iterable[str]) -> np.ndarray:
        """Return the elements of variables, one after the other."""
        return self.read_variables([self.description.find(name) for name in names])

    def read_variables(self, variables: Iterable[FmuVariable]) -> np.ndarray:
        """Return the elements of variables, one after the other.

        Raises
        ------
        FmuRuntimeError
            If the FMU's function fails, or a value is an integer that a float64 can't hold.
        """
        found: list[np.ndarray] = []
        groups = [list(group) for _, group in groupby((v for v in variables if v.size), key=lambda v: v.type)]
        together = self._reading.read(groups)
        for k, alike in enumerate(groups):
            purpose = f"reading {', '.join(v.name for v in alike)}"
            size, references = sum(v.size for v in alike), [r for v in alike for r in v.references]
            given = together[k] if together else self.call(purpose, self.fmi.get, alike[0].type, references, size)
            values = np.array(given)
            if alike[0].is_integer and values.itemsize == 8 and inexact(values):
                raise FmuRuntimeError(
                    f"{purpose}: found {values[[inexact(v) for v in values]][0]}; expected at most 2**53 in size, up "
                    "to which a signal holds every integer. Leave this variable out.",
                    block=self.setup.label,
                    t=self.t,
                )
            found.append(values.astype(float))
        return np.concatenate(found) if found else np.zeros(0)

    def directional_derivative(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float]
    ) -> np.ndarray:
        """Return the change of outputs and state derivatives for a change of knowns (FMI 2.0, 2.1.9; 3.0, 2.2.11).

        The derivative is taken at the present time, states and inputs, with discrete states frozen.

        Parameters
        ----------
        unknowns, knowns : sequence of str
            Outputs and derivatives of states; inputs and continuous states; by the FMU's names.
        seed : array_like
            Change of each element of the knowns.

        Returns
        -------
        numpy.ndarray
            Change of each element of the unknowns.

        Raises
        ------
        FmuError, FmuRuntimeError, UnknownNameError
            If the FMU has no directional derivatives, if its function fails, and for an unknown variable.
        """
        about = self.description
        if not (about.model_exchange_has_derivatives if self.model_exchange else about.has_derivatives):
            raise FmuError(
                f"it has no directional derivatives: {about.derivatives_flag} is false in its description. Use "
                "linear_model(), which falls back on differences.",
                block=self.setup.label,
            )
        for name in (*unknowns, *knowns):
            if name not in about.names:
                text = f"it has no variable {name!r}. {near(name, about.names)}"
                raise UnknownNameError(text, block=self.setup.label)
        of, by = ([about.find(name) for name in names] for names in (unknowns, knowns))
        n = sum(v.size for v in of)
        if not n:
            return np.zeros(0)
        changes = [float(c) for c in np.ravel(seed)]
        arguments = ([r for v in of for r in v.references], [r for v in by for r in v.references], changes, n)
        found = self.call("a directional derivative", self.fmi.directional_derivative, *arguments)
        return np.array(found, dtype=float)

    def directional_slopes(
        self, unknowns: Sequence[FmuVariable], knowns: Sequence[tuple[FmuVariable, bool]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the directional derivatives of all elements of unknowns by those of knowns, at the present values.

        It returns also which rows are known: those of local variables may not be asked for (FMI 2.0, 2.1.9; FMI 3.0,
        2.2.11). Rows of integers are zero. Those of states are known; some FMUs say that they are zero. Knowns that
        don't move, by the second part of each pair, have zero columns.
        """
        about = self.description
        states = [about.find_state(v) for v in unknowns]
        pairs = [*zip(unknowns, states, strict=True)]
        asked = [not v.is_integer and state is None and about.has_slopes(v) for v, state in pairs]
        known = [k or v.is_integer or state is not None for k, (v, state) in zip(asked, pairs, strict=True)]
        sizes = [v.size for v in unknowns]
        rows = np.repeat(np.array(asked, dtype=bool), sizes)
        references = [r for v, is_asked in zip(unknowns, asked, strict=True) if is_asked for r in v.references]
        J, column = np.zeros((rows.size, sum(v.size for v, _ in knowns))), 0
        for variable, moves in knowns:
            for k in range(variable.size):
                if moves and rows.any():
                    of, by = references, _seeds(variable, k)
                    purpose = f"the directional derivative by {variable.name}"
                    J[rows, column] = self.call(purpose, self.fmi.directional_derivative, of, *by, int(rows.sum()))
                for first, state in zip(np.cumsum([0, *sizes]), states, strict=False):
                    if state == variable.name and moves:
                        J[first + k, column] = 1.0
                column += 1
        return J, np.repeat(np.array(known, dtype=bool), sizes)

    # ---- statuses of its calls, and values that don't fit ----

    def judge(self, action: str, status: int, t: float) -> None:
        """Note a warning, once for each action; raise the error of a status that is worse."""
        if status > WARNING:
            raise self.report(action, status, t)
        if status:
            self.log.warn(action, self.fmi.status_name(status), t)

    def report(self, action: str, status: int, t: float) -> FmuRuntimeError:
        """Return the error of an action that has failed with a status."""
        raise NotImplementedError

    def check_limits(self, inputs: Transfer, t: float) -> None:
        """Refuse inputs out of the range that the FMU states, in a trial step only if it is accepted."""
        try:
            inputs.check_limits()
        except UnfitError as error:
            refused = self.refuse(error, t)
            if not self.is_trial:
                raise refused from None
            self.refused = self.refused or refused

    def refuse(self, error: UnfitError, t: float) -> FmuRuntimeError:
        """Return the error of an input or output that doesn't fit."""
        if isinstance(error, OutOfRangeError):
            advice = "Limit the signal before this input, with Saturation, say."
        elif error.port in self.inputs:
            advice = "Convert the signal before this input, with Quantizer, say."
        else:
            advice = "Leave this output out, by ports=."
        return FmuRuntimeError(f"{error.reason}. {advice}", block=self.setup.label, port=error.port, t=t)

    # ---- texts, and the point at which it is ----

    @property
    def texts(self) -> Mapping[str, list[tuple[float, Text]]]:
        """Texts and binary data by port: each value with the time in s from which on it held."""
        return self.record.values

    def begin_texts(self, t: float) -> None:
        """Let the record of texts continue from a time in s."""
        for text in self.call("reading its texts", self.record.go_back, t):
            self.add_note(text)

    def note_texts(self, t: float) -> None:
        """Record the texts that have changed, at a time in s."""
        if self.record.variables:
            self.call("reading its texts", self.record.note, t)

    def operating_point(self) -> dict[str, Any]:
        """Return the present ``t``, ``state`` and ``inputs``, for `Fmu.linear_model` and `Fmu.step_difference`."""
        about = self.description

        def read(variable: FmuVariable) -> np.ndarray:
            return self.read_variables([variable]).reshape(variable.shape)

        state = {name: read(about.find(name)) for name in (*about.states, *about.discrete_states)}
        inputs = {port: read(variable) for port, variable in self.setup.input_variables.items()}
        return {"t": self.t, "state": state, "inputs": inputs}

    # ---- the end ----

    def close(self) -> None:
        """Terminate and free the instance; what fails then is noted, as the run is complete."""
        if not self.is_open:
            return
        self.is_open = False
        _OPEN.discard(self)
        with self.host:
            try:
                if self.fatal:  # nothing may be called any more, not even to free it (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3)
                    return
                if self.is_running and not self.failed:
                    self._end_by(self.fmi.terminate)
                if not self.fatal:
                    self._end_by(self.fmi.free_instance)
            finally:
                if lines := self.fmi.read_printed():
                    self.add_note(f"it printed, in its own process: {clean_text(' / '.join(lines))}")
                self.fmi.end()

    def _end_by(self, function: Callable[[], None]) -> None:
        try:
            function()
        except Exception as error:
            self._note(error)
            self.add_note(f"the run is complete, but the FMU did not end well: {error}")


def _seeds(variable: FmuVariable, k: int) -> tuple[list[int], list[float]]:
    """Return value references and seeds that move one element of a variable."""
    if len(variable.references) == variable.size:
        return [variable.references[k]], [1.0]
    return list(variable.references), np.eye(variable.size)[k].tolist()

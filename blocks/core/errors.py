"""Errors that Loopwright raises, as one tree.

::

    LoopwrightError
    ├── DefinitionError (ValueError)      a block, path, model or option is given wrongly
    │   ├── ParameterError                a parameter's name, value or shape
    │   ├── OptionError                   an option of an experiment, a run or a command
    │   └── TraceError                    an equation that can't be traced, or traces wrongly
    ├── WiringError (ValueError)          a diagram that can't be built
    │   ├── UnwiredInputError
    │   ├── DoubleDriveError              an input driven twice, a block called twice
    │   ├── DuplicateNameError
    │   ├── UnknownNameError (KeyError)   a path, port, signal or parameter that doesn't exist
    │   ├── ShapeError
    │   ├── UnitError
    │   ├── SampleTimeError
    │   └── AlgebraicLoopError
    ├── SimulationError (RuntimeError)    a run that stopped; ``.run`` holds what was recorded
    │   ├── NonFiniteError
    │   ├── GuardError
    │   │   └── PathDomainError           a position outside the domain of a path's coordinates
    │   └── FmuRuntimeError               an FMU's function returned an error
    │       └── FmuProcessError           the process of an isolated FMU ended, or had to be ended
    ├── FmuError (RuntimeError)           an FMU that can't be read, built or loaded
    │   ├── FmuFileError
    │   │   └── SspFileError              a file that is no SSP, or one that can't become a diagram
    │   └── CompilerError
    ├── DiskError (OSError)               a file or folder that can't be used: permission, space, limits
    └── ConfirmationError (RuntimeError)  two independent computations of one number disagree

Each error names the block (its path), the port and the time, then says what was found, what was expected, and one next
step.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from enum import Enum
from typing import Any, Self

EXPECTED = "; expected "
"""What is between the two parts of every message: what was found, and what was expected."""


class LoopwrightError(Exception):
    """The root of all errors raised on purpose.

    Parameters
    ----------
    message : str
        Found, expected, and one next step.
    block : str, optional
        Dotted path of the block concerned; the message begins with it.
    port : str, optional
        Port concerned.
    t : float, optional
        Simulation time in s.
    """

    def __init__(self, message: str, *, block: str | None = None, port: str | None = None, t: float | None = None):
        self.message, self.block, self.port, self.t = message, block, port, t
        super().__init__(message)

    @property
    def what_was_found(self) -> str:
        """What was found, the part of the message ahead of what was expected."""
        return self.message.partition(EXPECTED)[0]

    @property
    def next_step(self) -> str:
        """The next step, which is behind what was expected; empty where the message has none."""
        return self.message.partition(EXPECTED)[2].partition(". ")[2]

    def __str__(self) -> str:
        who = ".".join(part for part in (self.block, self.port) if part)
        when = "" if self.t is None else f"t = {self.t:.9g} s"
        head = ", ".join(part for part in (who, when) if part)
        return f"{head}: {self.message}" if head else self.message

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), self.__dict__.copy())

    def _render_traceback_(self) -> list[str]:
        """Return the traceback as IPython prints it, which calls this."""
        from .shown_errors import render

        return render(self)

    def at(self, *, block: str | None = None, port: str | None = None, t: float | None = None) -> Self:
        """Fill in block, port and time where they are not known yet, and return self."""
        self.block, self.port = self.block or block, self.port or port
        self.t = t if self.t is None else self.t
        return self

    def blame(self, block: str) -> Self:
        """Set the block concerned, such as the full path where only a name was known, and return self."""
        self.block = block
        return self

    def add(self, text: str) -> Self:
        """Add text to the message, and return self."""
        self.message += text
        return self


def _rebuild(cls: type[LoopwrightError], state: dict[str, Any]) -> LoopwrightError:
    error = cls.__new__(cls)
    Exception.__init__(error, state.get("message", ""))
    error.__dict__.update(state)
    return error


class DefinitionError(LoopwrightError, ValueError):
    """A block, path, model or option is given wrongly."""


class ParameterError(DefinitionError):
    """A parameter's name, value or shape is wrong."""


class OptionError(DefinitionError):
    """An option of an experiment, a run or a command is wrong."""


class BetweenTicksError(OptionError):
    """A loop of a sampled diagram is cut at a wire that acts between ticks: it has no L at ticks."""


class TraceError(DefinitionError):
    """An equation can't be traced, or its traced result differs from NumPy's.

    Attributes
    ----------
    is_mistake : bool
        Whether the equation would fail in plain Python too, such as by a name that doesn't exist.
    """

    is_mistake: bool = False


class WiringError(LoopwrightError, ValueError):
    """A diagram can't be built as it is wired."""


class UnwiredInputError(WiringError):
    """A required input has no source."""


class DoubleDriveError(WiringError):
    """An input is driven twice, or one block is called twice."""


class DuplicateNameError(WiringError):
    """Two blocks or wires of one subsystem have the same name."""


class UnknownNameError(WiringError, KeyError):
    """A path, port, signal or parameter of that name does not exist, or a short name is that of several.

    Attributes
    ----------
    candidates : tuple of str
        The full names that a short name may mean; empty if there are none.
    """

    candidates: tuple[str, ...] = ()


class ShapeError(WiringError):
    """The shapes at the two ends of a wire differ."""


class UnitError(WiringError):
    """The units at the two ends of a wire differ, or a unit can't be read."""


class SampleTimeError(WiringError):
    """A sample time is missing, not positive, or finer than the clock's base."""


class AlgebraicLoopError(WiringError):
    """Ports depend on each other without a state in between."""


class PeriodicLoopError(WiringError):
    """A loop is cut at a wire that is renewed several times in the model's period: it has no L at one rate."""


class SimulationError(LoopwrightError, RuntimeError):
    """A run stopped.

    Attributes
    ----------
    run : Run, optional
        Every sample recorded until then; None before the first.
    state : str, optional
        Name of the continuous state at which a solver failed, such as ``"plant.position[1]"``.
    """

    run: Any = None
    state: str | None = None

    def keep(self, run: Any) -> Self:
        """Keep the run as it was recorded until it stopped, and return self."""
        self.run = run
        return self


class NonFiniteError(SimulationError):
    """A block made a NaN or an infinity."""


class GuardError(SimulationError):
    """A block's guard (an expression that must stay positive) failed."""


class PathDomainError(GuardError):
    """A position is outside the domain in which a path's coordinates are valid.

    Attributes
    ----------
    position : tuple of float
        The position, m.
    theta : float
        Path parameter of its foot point.
    xi : float
        Signed distance to the path, m (positive to the left).
    reach : float
        Distance to the limit of the domain at this foot point, on that side, m.
    """

    position: tuple[float, ...] = ()
    theta: float = float("nan")
    xi: float = float("nan")
    reach: float = float("nan")


class FmuRuntimeError(SimulationError):
    """A function of an FMU returned an error; its own log lines are in the message.

    Attributes
    ----------
    ends_at : float or None
        Time in s at which the FMU has asked to end the simulation; None for a failure.
    """

    ends_at: float | None = None


class FmuEnd(Enum):
    """Reason for which the process of an isolated FMU has ended."""

    CRASH = "crash"
    """A signal, such as that of a segmentation fault."""
    KILLED = "killed"
    """SIGKILL, which the system sends where its memory is short, or another program: no fault of a library."""
    EXIT = "exit"
    """The FMU has ended its process itself."""
    TIMEOUT = "timeout"
    """A call took longer than it may."""
    MEMORY = "memory"
    """The process took more memory than it may."""
    OUTPUT = "output"
    """The FMU wrote more output than it may."""
    LOST = "lost"
    """The process does not answer, as the FMU has closed its pipes, say, or was ended before."""


class FmuProcessError(FmuRuntimeError):
    """The process of an isolated FMU has ended in a call, or was ended; this process and other FMUs continue.

    Attributes
    ----------
    cause : FmuEnd
        Reason.
    call : str
        Function of the FMU, such as ``"fmi3DoStep"``, or a step of its loading.
    printed : str
        Last lines of its standard output.
    """

    def __init__(self, message: str, *, cause: FmuEnd, call: str, printed: str = "", **where: Any):
        super().__init__(message, **where)
        self.cause, self.call, self.printed = cause, call, printed


class FmuError(LoopwrightError, RuntimeError):
    """An FMU can't be read, built or loaded."""


class FmuFileError(FmuError):
    """A file is no FMU, or an FMU that can't be used here.

    Attributes
    ----------
    fault : str, optional
        Kind of the fault, a `loopwright.types.FmuFault`; None where no kind is known.
    subject : str, optional
        File of the archive, variable, library or attribute concerned.
    """

    def __init__(
        self,
        message: str,
        *,
        fault: str | None = None,
        subject: str | None = None,
        block: str | None = None,
        port: str | None = None,
        t: float | None = None,
    ):
        super().__init__(message, block=block, port=port, t=t)
        self.fault, self.subject = fault, subject


class SspFileError(FmuFileError):
    """A file is no SSP, or one with something that can't become a diagram here; its attributes are those above."""


class CompilerError(FmuError):
    """No C compiler was found, or it failed; the message quotes it."""


class DiskError(LoopwrightError, OSError):
    """A file or folder can't be used: no permission, no space, a limit, no such folder; the message says which.

    Its ``__cause__`` is the system's own error.
    """


class ConfirmationError(LoopwrightError, RuntimeError):
    """A number and its independent confirmation (eigenvalues, encirclements, another algorithm) disagree."""


def close_names(name: str, known: Iterable[str]) -> list[str]:
    """Return the known names that are close to ``name``, at most three; those that differ in case alone come first."""
    plain: dict[str, list[str]] = {}
    for one in sorted({str(k) for k in known}):
        plain.setdefault(one.casefold(), []).append(one)
    asked = str(name).casefold()
    alike = [one for one in plain if len(asked) > 2 or one[:1] == asked[:1]]  # one letter of two, elsewhere, is chance
    close = difflib.get_close_matches(asked, alike, n=3, cutoff=0.5)
    if not close and len(asked) > 2:  # the beginning of a long name, or of a part of a path
        close = [one for one in plain if any(part.startswith(asked) for part in one.split("."))][:3]
    return [one for folded in close for one in plain[folded]][:3]


def near(name: str, known: Iterable[str]) -> str:
    """Name the known names that are close to ``name``, for the end of an error message."""
    known = sorted({str(k) for k in known})
    close = close_names(name, known)
    if close:
        return f"Did you mean {' or '.join(repr(c) for c in close)}?"
    return f"Known: {', '.join(known)}." if known else "There are none."

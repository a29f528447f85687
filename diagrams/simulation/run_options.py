"""Options of a run: their defaults and their meaning, its ticks, and the step between them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any, Self, TypedDict

from ...blocks.core import OptionError, UnknownArgumentError, accepts, check_argument, explain_calls, kinds
from ...blocks.names_of_other_tools import RUN_OPTIONS
from ..coupling import Coupling
from ..flat import FlatDiagram, WiredDiagram, takes_any_step
from ..results import OperatingPoint, RunState
from ..wiring import stepped_blocks

START_EXCHANGES = ("agree", "once", "none")
"""Exchanges of values with FMUs while they initialize; the first one is the default."""


class KeptKeywords(TypedDict, total=False):
    """The options of a run that is kept in memory, as keywords, for type checkers; see `RunOptions`."""

    step: float | Fraction | None
    solver: str
    rtol: float
    atol: float
    max_step: float | None
    record: Iterable[str] | None
    every: int
    states: bool
    start: RunState | OperatingPoint | None
    coupling: str | Coupling
    start_exchange: str
    compile: bool | str
    fuse: bool


class RunKeywords(KeptKeywords, total=False):
    """The options of a run as keywords, for type checkers; `RunOptions` says what they mean."""

    to: str | os.PathLike[str] | None
    overwrite: bool


_YES_OR_NO = kinds.one_of_class(bool, "True or False").worded(step="Give one.")


@explain_calls
@accepts(
    None,
    states=kinds.flag,
    overwrite=kinds.flag,
    start_exchange=kinds.choice(*START_EXCHANGES).worded(", ".join(map(repr, START_EXCHANGES)), "Give one."),
    compile=kinds.either(_YES_OR_NO, kinds.choice("auto")).worded('True, False or "auto"', "Give one."),
    fuse=_YES_OR_NO,
)
@dataclass(frozen=True, eq=False)
class RunOptions:
    """Options of a run, as `Diagram.simulate`, `Diagram.simulation` and `Experiment.simulate` take them.

    Attributes
    ----------
    step : float or Fraction, optional
        Seconds between two ticks (samples, steps of a solver of fixed step, communication points of FMUs). Without
        one it is the greatest common divisor of all sample times, of which those are visited at which a subsystem
        acts; for a diagram without any, a thousandth of the duration.
    solver : str
        Solver of the continuous states: of fixed step such as "rk4", of variable step such as "RK45", "Radau" or
        "CVODE_BDF"; an unknown name raises an error that lists all. The default, "auto", changes from an explicit to
        an implicit method where the diagram turns out to be stiff.
    rtol, atol : float
        Relative and absolute tolerance of a step of a solver of variable step; the absolute one is multiplied with
        the nominal value of a state that declares one.
    max_step : float, optional
        Longest step of a solver of variable step in s.
    record : list of str, optional
        Signals, blocks and subsystems to record; everything without it.
    every : int
        Record one of so many samples; the first and the last always.
    states : bool
        Record the states, too.
    to : path, optional
        Folder to which the samples are streamed, with bounded memory; `Run.open` opens it later.
    overwrite : bool
        Replace a run that is stored there.
    start : RunState or OperatingPoint, optional
        State to continue from: ``run.final_state``, that of `Simulation.save`, or an operating point, such as
        `trim` finds one, with the parameters that belong to it. Where ticks end the solver's steps, the run has the
        bits of one in one go; else the solver would have stepped over that instant, and values differ within the
        tolerances.
    coupling : str or Coupling
        Exchange of values between FMUs in a communication step: "jacobi", all step at once with the inputs of its
        beginning; "gauss_seidel", one after the other; "iterated", until they agree; or a `Coupling` with its options,
        such as adaptive communication steps. See docs/explanation/coupling.md.
    start_exchange : {"agree", "once", "none"}
        Exchange of values with FMUs while they initialize: until inputs and outputs agree, one pass, or none, where
        inputs keep their start values until the first step. Tools differ in this.
    compile : {"auto", True, False}
        Generate C code of the diagram. Runs go in C whatever this says; a virtual machine evaluates the diagram's
        functions unless there is generated code of them, to the same bits. "auto": a run begins with the machine; a
        compiler works alongside it if the run is long enough, and its code takes over. False: no code is generated, and
        no compiler is started. True: code is generated before the first tick. That needs a compiler (the extra
        ``build``), and a diagram of which there can be code. Where one of these fails, the run is interpreted, and
        ``run.messages`` says why. ``run.tier`` says what was done.
    fuse : bool
        Compile the ticks, the loop over them and the equations of FMUs that Loopwright has built on this machine
        together, for its processor, with products and sums fused (FMA): faster, and values differ by rounding, as
        ``run.messages`` says: by less than 1e-10 of a signal's size, but where a motion magnifies small differences (a
        limit cycle, sticking), which magnifies these, too. ``compile="auto"`` is then True. With ``compile=False`` the
        FMUs alone are compiled again, see `loopwright.fmus.tune`.
    """

    step: float | Fraction | None = None
    solver: str = "auto"
    rtol: float = 1e-6
    atol: float = 1e-9
    max_step: float | None = None
    record: Iterable[str] | None = None
    every: int = 1
    states: bool = True
    to: str | os.PathLike[str] | None = None
    overwrite: bool = False
    start: RunState | OperatingPoint | None = None
    coupling: str | Coupling = "jacobi"
    start_exchange: str = START_EXCHANGES[0]
    compile: bool | str = "auto"
    fuse: bool = False

    @classmethod
    def of(cls, options: Mapping[str, Any], *, block: str) -> Self:
        """Return the options with given names.

        Parameters
        ----------
        options : mapping
            Values by name.
        block : str
            Path or name for the error.

        Raises
        ------
        OptionError
            A name that is no option of a run; None for ``start``, which a run without a ``final_state`` has.
        """
        check_argument(options, kinds.mapping, "options", block)
        if not options.keys() <= cls.__dataclass_fields__.keys():
            known = [f.name for f in fields(cls)]
            name = next(name for name in options if name not in known)
            raise UnknownArgumentError(name, known, block=block, elsewhere=RUN_OPTIONS)
        if "start" in options and options["start"] is None:
            raise OptionError(
                "found None; expected a state or an operating point. A run has no final_state if it was interrupted or "
                "has failed (run.messages tells when), has ended between two ticks, or an FMU can't turn its state "
                "into bytes (canSerializeFMUState). Leave out start to begin at t = 0; to continue after an interrupt, "
                "run in parts and keep the final_state of each, or Simulation.save().",
                block=block,
                port="start",
            )
        try:
            return cls(**options)
        except OptionError as error:
            raise error.at(block=block) from None

    @property
    def compiled(self) -> bool | str:
        """When ticks are compiled: True, False or "auto"; with ``fuse``, whose bits differ, "auto" is True."""
        return True if self.fuse and self.compile == "auto" else self.compile

    def apply_fuse(self, diagram: WiredDiagram) -> tuple[WiredDiagram, tuple[str, ...]]:
        """Return the diagram that is run, and messages: with ``fuse`` its FMUs are compiled for this processor.

        Raises
        ------
        CompilerError
            If there is no compiler, or it fails.
        """
        if not self.fuse:
            return diagram, ()
        from ..compiled import fuse  # only such a run needs a compiler

        return fuse(diagram)

    def with_step(self, step: float | Fraction | None) -> Self:
        """Return the options with another step."""
        return self if step is self.step else replace(self, step=step)

    @property
    def recipe(self) -> dict[str, Any]:
        """The options that a later run to an instant of this one is made with, those that are given."""
        names = ("step", "solver", "rtol", "atol", "max_step", "start")
        found = {name: value for name in names if (value := getattr(self, name)) is not None}
        chosen = {"coupling": (self.coupling, "jacobi"), "start_exchange": (self.start_exchange, START_EXCHANGES[0])}
        return found | {
            name: value
            for name, (value, default) in chosen.items()
            if not (isinstance(value, str) and value == default)
        }


def ticks_in(duration: Any, base: Fraction, name: str) -> tuple[int, Fraction]:
    """Return the number of ticks in a duration, and the seconds that are left; rounding of a few ulps is forgiven."""
    try:
        span = float(duration)
    except (TypeError, ValueError):
        span = math.nan
    if not 0 < span < math.inf or isinstance(duration, str | bool):
        raise OptionError(
            f"found a duration of {duration!r}; expected seconds, positive. Give them, such as 2.0.",
            block=name,
            port="duration",
        )
    return _divide(span, base)


@lru_cache(maxsize=64)
def _divide(span: float, base: Fraction) -> tuple[int, Fraction]:
    exact = Fraction(span)
    n = round(exact / base)
    if n and abs(exact - n * base) <= exact * Fraction(1, 10**12):
        return n, Fraction(0)
    n = exact // base
    return n, exact - n * base


def refuse_rest(flat: FlatDiagram, n: int, duration: Any, name: str) -> None:
    """Refuse an end between two ticks where an FMU takes steps of one length only."""
    for path, plant in stepped_blocks(flat.table).items():
        if not takes_any_step(plant):
            raise OptionError(
                f"found a duration of {duration!r} s, no multiple of the {float(flat.base):g} s between ticks, and "
                f"{path} takes steps of one length only; take {float(max(n, 1) * flat.base)!r} s.",
                block=name,
                port="duration",
            )


def default_step(diagram: WiredDiagram, step: Any, duration: float | None, solver: str, start: Any = None) -> Any:
    """Return the seconds between two samples of a run that has neither a ``step`` nor a clock."""
    # That of the run that is continued; else a thousandth of the duration, in whole nanoseconds where it has them,
    # where the diagram has no FMU and the solver chooses its own steps.
    if step is not None or diagram.has_clock:
        return step
    if start is not None and hasattr(start, "base"):
        return start.base
    if duration is None:
        return step
    from ..solvers import FIXED, solver_name

    if diagram.has_fmu or solver_name(solver) in FIXED:
        return step
    try:
        span = Fraction(repr(float(duration)))
    except (TypeError, ValueError):
        span = Fraction(0)
    if not span > 0:
        ticks_in(duration, Fraction(1), diagram.name)  # refused
    ticks = span / Fraction(1, 10**9)
    if ticks.denominator != 1:
        return span / 1000
    return next((span / n for n in (1000, 500, 200, 100, 10, 1) if (ticks / n).denominator == 1), span)

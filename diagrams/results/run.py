"""The record of a run: signals, states, events, and the final state."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    Layout,
    OptionError,
    Sheet,
    ShownAsTable,
    accepts,
    brief,
    check_argument,
    count_of,
    enumerate_some,
    explain_calls,
    kinds,
    missing_member,
    shorten,
    with_unit,
)
from ..wiring import Wire, index_of, split_entry
from .recorded_signals import RecordedSignals
from .recorded_texts import TextSignal
from .signal_names import resolve
from .stored import Occurrence, PathLike, Stopped, header, prepare, read, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from xarray import Dataset

    from .plots import Data, DrawnSignal, MeasuredSignals
    from .saved_state import RunState
    from .step_info import StepInfo


_TIMES = kinds.row.where(lambda value: len(value) == 2 and value[0] < value[1]).worded(
    "two times in s, the first one below the other", "Give them: xlim=(0, 5)."
)
_FEW = 6
"""Named wires up to which a run's table has outputs of plants, too, and rows that it then has at most."""
_MESSAGES, _SHOWN_MESSAGES = 3, 10
"""Messages that the short text and the table of a run show; the others are counted."""
WAYS = {
    **dict.fromkeys(("scope", "show", "display"), 'run.plot("wire")'),
    **dict.fromkeys(("time", "times", "ts"), "run.t"),
    **dict.fromkeys(("get", "read", "value", "values", "signal"), 'run["wire"]'),
    **dict.fromkeys(("to_dataframe", "to_df", "dataframe", "df"), "run.to_pandas()"),
    **dict.fromkeys(
        ("stepinfo", "overshoot", "rise_time", "settling_time", "peak"), 'run.step_info("wire"), which has them'
    ),
    **dict.fromkeys(("signals", "keys", "channels", "logs"), "run.names, which has all signals"),
}
"""What to write for names that users of other tools look for in a run."""
_CLASS_WAYS = dict.fromkeys(
    ("load", "read", "restore", "from_file", "from_folder"),
    'Run.open("folder"), which reads what run.save("folder") and simulate(…, to="folder") write',
) | dict.fromkeys(
    ("from_csv", "read_csv", "from_pandas"),
    "pandas.read_csv to look at a CSV file, or the block Recorded.from_csv to wire it",
)
"""The same for the class."""


class _RunClass(type):
    """Class of `Run`: a name that it hasn't is an error with what to write."""

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(cls, name):
            raise missing_member(cls, name, "the class Run", _CLASS_WAYS)


@explain_calls
@dataclass(frozen=True)
class Snapshot:
    """All signals and states at one recorded instant."""

    t: float
    tick: int
    """The sample's number in the run, from 0: the tick, where every tick was recorded."""
    values: dict[str, Any]
    state: np.ndarray
    """The state vector x of the flattened diagram."""
    names: dict[str, Wire]
    """The named wires: two of one short name differ in their source."""
    run: Run | None = field(default=None, repr=False, compare=False)
    """The run that it comes from."""

    def __repr__(self) -> str:
        of = f" of {self.run.diagram_name!r}" if self.run is not None and self.run.diagram_name else ""
        facts = count_of(len(self.values), "signal"), count_of(self.state.size, "state")
        return brief(f"instant t = {self.t:.9g} s{of}", *facts, then="instant['name'], diagram.linearize(instant)")

    def __getitem__(self, name: str) -> Any:
        more = () if self.run is None else (self.run.signals.blocks, self.run.signals.stored_outputs)
        full = resolve(name, self.names, self.values, *more)
        full, entry = split_entry(full, self.values)
        value = self.values[full]
        return value[index_of(entry, value.shape, full)] if entry else value


@explain_calls
@dataclass(frozen=True, eq=False)
class Run(ShownAsTable, metaclass=_RunClass):
    """A run: the outputs of the blocks, and the states, at the instants that were recorded.

    ``run.t`` holds the times in s. ``run["xi"]`` is an array with one row per sample, by a wire's name, by a port's
    dotted path (``"controller.pid_par.v"``), or by any unique end of such a path. Steps need not be equal. At an event
    there may be two samples of one time, before and after it.

    Attributes
    ----------
    t : (N,) ndarray
        Times in s, ascending, up to and including the end.
    messages : tuple of str
        Messages of the FMUs, other solutions of algebraic loops, and whether the run was cut off.
    texts : mapping of str to TextSignal
        Texts and binary data that FMUs put out, by the port's dotted path.
    events : sequence of Occurrence
        The events that fired, in their order.
    stopped : Stopped or None
        The end by a stop condition, before the duration was over.
    residual : (N,) ndarray or None
        Largest residual of the solved algebraic loops, by sample; None where there were none.
    has_states : bool
        Whether the states were recorded, which `at` needs.
    elapsed : float
        Elapsed time of the loop in s.
    tier : str
        Form of the diagram's functions: "interpreted", "compiled" for generated code, or "both", where that has taken
        over within the run. The loop over time is in C whichever it is.

    Examples
    --------
    >>> from loopwright import Diagram
    >>> from loopwright.blocks import Gain, Step
    >>> step = Step(times=0.2, values=3.0)
    >>> run = Diagram("step", Gain(gain=2.0)(step).named("y")).simulate(0.4, step=0.2, progress=False)
    >>> run.t
    array([0. , 0.2, 0.4])
    >>> run["y"]
    array([0., 6., 6.])
    """

    t: np.ndarray
    data: np.ndarray = field(repr=False)
    signals: RecordedSignals = field(repr=False)
    """The names, columns and units of what was recorded."""
    diagram: Any = field(repr=False)
    elapsed: float = float("nan")
    tier: str = "interpreted"
    messages: tuple[str, ...] = ()
    texts: Mapping[str, TextSignal] = field(default_factory=dict, repr=False)
    events: Sequence[Occurrence] = field(default=(), repr=False)
    stopped: Stopped | None = None
    residual: np.ndarray | None = field(default=None, repr=False)
    diagram_name: str = ""
    final_state: RunState | None = field(default=None, repr=False)
    """The complete state at the end, for ``simulate(…, start=)``; None where an FMU can't save its state."""
    recipe: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """Options of the run (step, solver, tolerances, start), with which an instant of it can be found again."""

    def __post_init__(self) -> None:
        if not self.diagram_name:
            object.__setattr__(self, "diagram_name", getattr(self.diagram, "name", ""))

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            is_signal = "signals" in vars(self) and not name.startswith("_") and name in self
            raise missing_member(self, name, "a run", WAYS | ({name: f'run["{name}"]'} if is_signal else {}))

    def __repr__(self) -> str:
        t = self.t
        span = f" from {t[0]:.9g} to {t[-1]:.9g} s" if len(t) else ""
        names = self.names
        wires = [name for name in self.wires if name in names]
        first = (wires or names or ["name"])[0]
        facts = (
            count_of(len(t), "sample") + span,
            count_of(len(names), "signal") + (f" (named: {enumerate_some(wires)})" if wires else ""),
            "interpreted, then compiled" if self.tier == "both" else self.tier,
            f"stopped at {self.stopped.t:.9g} s by {self.stopped.block}" if self.stopped is not None else "",
            count_of(len(self.events), "event") if self.events else "",
            count_of(len(self.messages), "message") if self.messages else "",
        )
        head = brief(f"run of {self.diagram_name!r}", *facts, then=f"run[{first!r}], run.plot({first!r}), run.at(t)")
        more = len(self.messages) - _MESSAGES
        return "\n".join([head, *self.messages[:_MESSAGES], *([f"and {more} more: run.messages"] if more > 0 else [])])

    def _sheet(self) -> Sheet:
        from .run_table import ShownSignal, signal_grid

        t, names, messages = self.t, self.names, self.messages
        named = [name for name in self.wires if name in names]
        plants = self._plant_outputs() if named and len(named) < _FEW else []
        shown = [*named, *plants[: _FEW - len(named)]] or [name for name in names if name not in self.wires]
        signals = [ShownSignal(name, self.signals.place(name)[0], self.signals.units_of(name)) for name in shown]
        grid, why = signal_grid(t, self.data, signals, self.__getitem__)
        others = len(names) - len(shown)
        more = f"and {count_of(others, 'more signal')}: run.names, run['block.port']." if others else ""
        further = len(messages) - _SHOWN_MESSAGES
        last = f"and {further} more: run.messages" if further > 0 else ""
        return Sheet(
            f"run of {self.diagram_name!r}",
            (
                ("time", f"{t[0]:.9g} s to {t[-1]:.9g} s, {count_of(len(t), 'sample')}" if len(t) else "no sample"),
                ("stopped", "" if self.stopped is None else f"at {self.stopped.t:.9g} s by {self.stopped.block}"),
                ("events", count_of(len(self.events), "event") if self.events else ""),
            ),
            (grid,),
            tuple(note for note in (why, more, *messages[:_SHOWN_MESSAGES], last) if note),
        )

    def _plant_outputs(self) -> list[str]:
        """Return the outputs of FMUs and of blocks with states in continuous time that no named wire covers."""
        if self.diagram is None:
            return []
        from .signal_marks import is_of_a_plant

        unnamed = (name for name in self.signals.to_export((), self.diagram_name) if name not in self.wires)
        return [name for name in unnamed if is_of_a_plant(self.diagram, name.rpartition(".")[0])]

    @classmethod
    def open(cls, path: PathLike) -> Run:
        """Open a run on disk, as `save` and ``simulate(…, to=path)`` write it; its diagram is not needed.

        The samples stay on disk; ``run[name]`` reads those of one signal. A run that was killed, or that still runs,
        opens with the samples written until then; its messages say so.

        Parameters
        ----------
        path : path
            The run's folder.

        Raises
        ------
        OptionError
            If there is no run at that path.
        """
        stored = read(path)
        end, n = stored.end, len(stored.t)
        if end is None:
            until = f", until t = {stored.t[-1]:g} s" if n else ""
            end = {"messages": [f"This run did not end: it was killed, or still runs. It holds {n} samples{until}."]}
        stopped = end.get("stopped")
        return cls(
            t=stored.t,
            data=stored.data,
            signals=stored.signals,
            diagram=None,
            elapsed=end.get("elapsed", float("nan")),
            tier=str(end.get("tier", "interpreted")),
            messages=tuple(end.get("messages", ())),
            texts={name: TextSignal.from_json(rows) for name, rows in end.get("texts", {}).items()},
            events=stored.events,
            stopped=None if stopped is None else Stopped(**stopped),
            residual=stored.residual,
            diagram_name=stored.head["diagram"],
        )

    def save(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Write the run to a folder, from which `Run.open` reads it, exact to the last bit.

        Parameters
        ----------
        path : path
            Folder to make; its files are those of ``simulate(…, to=path)``.
        overwrite : bool
            Whether a run in that folder may be replaced.

        Raises
        ------
        OptionError
            If something is in the way.
        DiskError
            If the folder can't be written.
        """
        folder = Path(path)
        prepare(folder, overwrite)
        head = header(self.diagram_name, self.signals, residual=self.residual is not None)
        parts = [self.t[:, None], self.data, *([] if self.residual is None else [self.residual[:, None]])]
        end = {"elapsed": self.elapsed, "tier": self.tier, "messages": self.messages, "stopped": self.stopped}
        texts = {name: text.to_json() for name, text in self.texts.items()}
        write(folder, head, parts, self.events, **end, texts=texts)

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds per elapsed second."""
        return float(self.t[-1] - self.t[0]) / self.elapsed if self.elapsed > 0 and len(self.t) else float("nan")

    @property
    def names(self) -> list[str]:
        """Names of all recorded signals: the wires' names, then the ports' paths."""
        return [*self.signals.names]

    @property
    def wires(self) -> Mapping[str, Wire]:
        """The named wires."""
        return self.signals.wires

    @property
    def layout(self) -> Layout:
        """Entries of the ports in a sample's vector."""
        return self.signals.layout

    @property
    def has_states(self) -> bool:
        """Whether the states were recorded."""
        return self.signals.has_states

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a signal, shape (N, *shape of the port); ``run["q[1]"]`` is its first entry, ``run["q"][:, 0]``.

        Raises
        ------
        UnknownNameError
            If no signal or several have that name, or if it was not recorded.
        """
        return self.part(name, slice(None))

    def part(self, name: str, samples: slice) -> np.ndarray:
        """Return some samples of a signal, as ``run[name][samples]`` does, without reading the others.

        Parameters
        ----------
        name : str
            The signal, by a name that ``run[name]`` takes.
        samples : slice
            Numbers of the samples.

        Raises
        ------
        UnknownNameError
            If no signal or several have that name, or if it was not recorded.
        """
        shape, at = self.signals.place(name)
        values = self.data[samples, at] if isinstance(at, slice) else self.data[samples][:, at]
        return np.ascontiguousarray(values.reshape(len(values), *shape))

    def _ipython_key_completions_(self) -> list[str]:
        return self.names

    def __contains__(self, name: str) -> bool:
        return name in self.signals

    def unit(self, name: str) -> str | tuple[str, ...] | None:
        """Return the unit of a signal, None where it is not declared."""
        return self.signals.unit(name)

    def at(self, t: float) -> Snapshot:
        """Return all recorded signals and the states at the last sample not after ``t`` (in s).

        Raises
        ------
        OptionError
            If t is not within the run, or the states were not recorded.
        """
        if not (len(self.t) and kinds.is_real(t) and self.t[0] <= t <= self.t[-1] * (1 + 1e-12) + 1e-12):
            if not kinds.is_real(t):
                raise OptionError(f"found t = {t!r}; expected one time in s. Give one, such as run.at(0.5).")
            span = f"{self.t[0]:g} s to {self.t[-1]:g} s" if len(self.t) else "nothing"
            raise OptionError(f"found t = {t!r}; the run holds {span}. Choose a time within.")
        k = int(np.searchsorted(self.t, t * (1 + 1e-12) + 1e-12, side="right")) - 1
        if not self.has_states:
            raise OptionError(
                f"the states at t = {t!r} s were not recorded in this run, and an operating point needs them. Run "
                f"again with the states recorded; for a signal alone, take run[name][{k}]."
            )
        row = np.array(self.data[k])
        signals = self.signals
        found = ((name, signals.find_columns(name)) for name in (*signals.layout.slices, *signals.wires))
        values = {name: row[where] for name, where in found if where is not None}
        return Snapshot(float(self.t[k]), k, values, row[signals.first_state :].copy(), dict(signals.wires), self)

    def plot(
        self,
        *names: str | Iterable[str],
        against: Run | Data | Mapping[str, Run | Data] | None = None,
        label: str = "this run",
        xlim: tuple[float, float] | None = None,
        axes: Sequence[Axes] | np.ndarray | None = None,
    ) -> Figure:
        """Draw signals over time, one axis below the other, and return the figure.

        A set-point (the output of a source) next to other signals is dashed. Dotted lines are limits near the
        signals: of a `Saturation`, a `PID`, an integrator or a `Requirement`. Short ticks at the lower end are events.
        What is held between samples is drawn in steps. A run from disk has no diagram, and so none of these marks but
        events.

        Parameters
        ----------
        *names : str or list of str
            Signals or entries of them, ``"q[1]"``, each in a separate axis; those of a list share one, and so do
            a vector's entries: ``run.plot("speed", ["reference", "angle"])``. Without any, all named wires.
        against : Run, measured data or mapping of str to them, optional
            What is drawn over this run, by the names that the legend has: ``{"kp = 10": other}``. Measured data are a
            pair of arrays where one signal is drawn, ``{"measured": (t, y)}``, or columns by the names of signals, in
            a mapping of arrays or a data frame, with the times in s in ``"t"`` (or in the index of a frame). Signals
            of other runs are drawn in the units of this one; where a unit can't be converted, the legend has it.
        label : str
            Name of this run in the legend.
        xlim : (float, float), optional
            Times in s that are shown; the values within them fill the axes.
        axes : sequence of matplotlib axes, optional
            Axes to draw into, one per axis of the figure that would be made.

        Returns
        -------
        matplotlib.figure.Figure
            One of pyplot's, but in threads other than the main one; see docs/howto/plots.md.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        OptionError
            For something else than names, runs and measured data, and times that are no range.
        """
        from .plots import plot_signals, split_measured

        groups = self._groups_to_draw(names)
        others, data = split_measured(against)
        runs = self._runs_to_draw(others, label, data)
        names_drawn = [name for group in groups for name in group]
        for one in data:
            one.check_names(names_drawn)
        if xlim is not None:
            check_argument(xlim, _TIMES, "xlim", "Run.plot")
        units = {name: self.drawn(name).units for name in names_drawn}
        panels = [
            [run.drawn(name, of).in_units(units[name]) for of, run in runs.items() for name in group]
            for group in groups
        ]
        for panel in panels:
            own = panel[: len(panel) // len(runs)]
            panel += [found for one in data for like in own if (found := one.drawn(like)) is not None]
        return plot_signals(panels, self.events if len(runs) + len(data) == 1 else (), axes, xlim)

    @accepts(since=kinds.number, until=kinds.number, final=kinds.number)
    def step_info(
        self, name: str, *, since: float | None = None, until: float | None = None, final: float | None = None
    ) -> StepInfo:
        """Return rise time, settling time, overshoot and peak of a signal's response to a step.

        The numbers are those of ``control.step_info``, measured as in a report: the settling time is that of a band of
        2 % of the change, the rise time goes from 10 % to 90 %.

        Parameters
        ----------
        name : str
            The signal, or an entry of it, ``"q[1]"``.
        since : float, optional
            Time of the step in s. Without it that of the diagram's only `Step`, or the start of the run if there is
            none.
        until : float, optional
            End of the response in s, such as the time of a load's step; the end of the run without it.
        final : float, optional
            Value that the signal should come to; without it the value at the end. A signal that rests elsewhere has
            not settled.

        Returns
        -------
        StepInfo
            The numbers; ``print`` shows them as a table, and ``as_dict()`` has python-control's names.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        OptionError
            For a signal of several numbers, several steps without ``since``, and a response without samples.

        Examples
        --------
        >>> from loopwright import Diagram
        >>> from loopwright.blocks import PT1, Step
        >>> lag = PT1(time_constant=0.5)(Step(times=1.0, values=2.0)).named("y")
        >>> info = Diagram("lag", lag).simulate(11.0, progress=False).step_info("y")
        >>> round(info.rise_time, 3), round(info.settling_time, 3), info.overshoot
        (1.099, 1.956, 0.0)
        """
        from .signal_marks import is_held
        from .step_info import find_step, measure_info

        values = self[name]
        if values.ndim != 1:
            raise OptionError(
                f"found a signal of {int(np.prod(values.shape[1:]))} numbers; expected one. Name an entry of it: "
                f'run.step_info("{name}[1]").',
                block=self.diagram_name,
                port=str(name),
            )
        last = len(self.t) if until is None else int(np.searchsorted(self.t, until, side="right"))
        t = self.t[:last]
        start, end = (float(t[0]), float(t[-1])) if last else (0.0, 0.0)
        since = find_step(self.diagram, end, start, self.diagram_name) if since is None else float(since)
        held = is_held(self.diagram, self.signals.port_of(name))
        return measure_info(name, self.signals.units_of(name)[0], t, values[:last], since, held=held, final=final)

    def plot_path(
        self,
        x: str,
        y: str | None = None,
        *,
        against: Run | Mapping[str, Run] | None = None,
        label: str = "this run",
        axes: Axes | None = None,
    ) -> Figure:
        """Draw one signal over another one, and return the figure.

        Both axes have the same scale where both signals have the same unit, as positions in a plane.

        Parameters
        ----------
        x, y : str
            Two signals, ``"angle", "speed"``, or one with two entries, ``"position"``: its second over its first.
        against, label, axes
            As of `plot`.

        Raises
        ------
        UnknownNameError, OptionError
            For a name that was not recorded; for signals that are not two numbers together.
        """
        from .plots import plot_curve

        runs = self._runs_to_draw(against, label)
        pairs = {of: run._pair(x, y) for of, run in runs.items()}
        first, second = next(iter(pairs.values()))
        drawn = {of: (one.in_units(first.units), two.in_units(second.units)) for of, (one, two) in pairs.items()}
        labels = tuple(
            with_unit(own.name, own.units[0] if all(pair[i].units == own.units for pair in drawn.values()) else "")
            for i, own in enumerate((first, second))
        )
        curves = {of or label: (one.values, two.values) for of, (one, two) in drawn.items()}
        return plot_curve(curves, (labels[0], labels[1]), axes, is_equal=first.units == second.units)

    def _pair(self, x: str, y: str | None) -> tuple[DrawnSignal, DrawnSignal]:
        """Return two signals with a number each."""
        first = self.drawn(x)
        if y is None and first.values.shape[1:] == (2,):
            return self.drawn(f"{x}[1]"), self.drawn(f"{x}[2]")
        second = first if y is None else self.drawn(y)
        shapes = [one.values.shape[1:] for one in (first, second)]
        if y is None or shapes != [(), ()]:
            counts = [int(np.prod(shape)) for shape in (shapes[:1] if y is None else shapes)]
            raise OptionError(
                f"found signals of {' and '.join(map(str, counts))} numbers; expected one signal with two entries, or "
                "two with one each. Name two, as in "
                f'run.plot_path("{x if y is None or shapes[0] == () else x + "[1]"}", "speed").',
                block=self.diagram_name,
                port=x if y is None else f"{x}, {y}",
            )
        return first, second

    def drawn(self, name: str, run: str = "") -> DrawnSignal:
        """Return a signal as plots draw it."""
        from .plots import DrawnSignal
        from .signal_marks import is_held, is_set_point, limits_of

        port, own = self.signals.port_of(name), self.diagram
        return DrawnSignal(
            name,
            self.t,
            self[name],
            self.signals.units_of(name),
            run,
            is_set_point=is_set_point(own, port),
            is_held=is_held(own, port),
            limits=limits_of(own, port),
        )

    def _runs_to_draw(
        self, against: Run | Mapping[str, Run] | None, label: str, data: Sequence[MeasuredSignals] = ()
    ) -> dict[str, Run]:
        """Return this run and others by their labels; "" alone where there are no others, and no measured data."""
        check_argument(label, kinds.text, "label", "Run.plot")
        if against is None and not data:
            return {"": self}
        given = {"other run": against} if isinstance(against, Run) else against
        others = dict(given) if isinstance(given, Mapping) else {}
        none = not others and (against is not None or not data)
        if none or not all(isinstance(name, str) and isinstance(run, Run) for name, run in others.items()):
            raise OptionError(
                f'found {shorten(against)}; expected runs by their names, such as against={{"kp = 10": other}}, or in '
                'plot measured data, {"measured": (t, y)}.',
                block="Run.plot",
                port="against",
            )
        if label in {*others, *(one.label for one in data)}:
            raise OptionError(
                f"found {label!r} twice; expected a name for each run. Give this one another: label=….",
                block="Run.plot",
                port="against",
            )
        return {label: self, **others}

    def _groups_to_draw(self, names: Iterable[object]) -> list[list[str]]:
        """Return the names of the signals of each axis; without any names, those of all named wires."""
        groups = [list(name) if isinstance(name, list | tuple | set | np.ndarray) else [name] for name in names]
        for name in (one for group in groups for one in group):
            if not isinstance(name, str):
                raise OptionError(
                    f'found {name!r} to draw; expected the name of a signal, as in run.plot("eta"). Name the wire '
                    'with .named("…"), or give the path of the port.'
                )
        if found := [list(dict.fromkeys(map(str, group))) for group in groups if group]:
            return found
        wires = [name for name in self.names if name in self.wires]
        if not wires:
            some = ", ".join(map(repr, self.names[:6]))
            raise OptionError(f"found no signal to draw, and no wire has a name; expected names, such as {some}.")
        return [[name] for name in wires]

    # --- for other tools: all recorded signals if none is given -------------------------------------------------------

    def to_csv(self, path: PathLike | IO[str], *names: str) -> None:
        """Write ``t`` (s) and signals as comma-separated values, 17 significant digits.

        A column is named after its signal; those of a vector are ``name[1]``, ``name[2]``, …. The column of a wire
        that is called ``t`` itself is ``s_t``.

        Parameters
        ----------
        path : path or file
            File to write.
        *names : str
            Signals; all that were recorded if none is given, under the name of their wire or the path of their port.

        Raises
        ------
        UnknownNameError, OptionError
            For a name that was not recorded; for a folder that isn't there.
        """
        from .run_exports import to_csv

        to_csv(path, self.t, dict(self._columns(names)))

    def to_pandas(self, *names: str) -> DataFrame:
        """Return signals as a pandas DataFrame with the times (s) as index ``t``; all that were recorded without names.

        Columns are named as in `to_csv`.
        Units are in its ``attrs["units"]``, by column. At an event an index repeats: before and after.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        OptionError
            If pandas is not installed.
        """
        from .run_exports import to_pandas

        return to_pandas(self.t, dict(self._columns(names)), self._units_of_columns(names))

    def to_xarray(self, *names: str) -> Dataset:
        """Return signals as an xarray Dataset over ``t`` (s); all that were recorded without names.

        A vector ``f`` has the dimensions ``t`` and ``f_dim``, a matrix ``t``, ``f_dim1`` and ``f_dim2``; entries are
        counted from 1, as in `to_csv`. ``attrs["units"]`` of a variable is its unit, those of a vector separated by
        commas where they differ.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        OptionError
            If xarray is not installed.
        """
        from .run_exports import to_xarray

        signals = {name: self[name] for name in self._names_to_export(names)}
        return to_xarray(self.t, signals, {name: self.signals.units_of(name) for name in signals}, self.diagram_name)

    def to_parquet(self, path: PathLike, *names: str) -> None:
        """Write ``t`` (s) and signals, all without names, as a Parquet file; columns are named as in `to_csv`.

        A field's metadata holds its unit. Rows are written in groups, so a run on disk need not fit into memory.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        OptionError
            If pyarrow is not installed, or the folder isn't there.
        """
        from .run_exports import to_parquet

        def read(samples: slice) -> Iterator[np.ndarray]:
            return (values for _, values in self._columns(names, samples))

        to_parquet(path, self.t, read, self._units_of_columns(names), self.diagram_name)

    def to_mat(self, path: PathLike, *names: str) -> None:
        """Write ``t`` (s) and signals as a MATLAB file (version 5), a column vector or an N-by-n matrix each.

        Without names, these are all signals that were recorded.
        A variable is named after its signal, as MATLAB allows. Every character other than an ASCII letter, a digit or
        ``_`` becomes ``_``. A name that doesn't begin with a letter gets ``s_`` in front, as do MATLAB's keywords,
        ``t`` and ``info``. Of a name longer than 63 characters the end is kept. A name that is taken already gets
        ``_2``, ``_3``, …. The struct ``info`` lists ``variables``, the ``names`` they stand for, and their ``units``.
        Of a matrix each row holds its entries row by row.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        OptionError
            If the folder isn't there, or a signal takes 2 GiB or more, which the format can't hold.
        """
        from .run_exports import to_mat

        signals = {name: self[name] for name in self._names_to_export(names)}
        units = {name: self.signals.units_of(name) if self.unit(name) else None for name in signals}
        to_mat(path, self.t, signals, units, self.diagram_name)

    def _names_to_export(self, names: Iterable[str]) -> list[str]:
        return self.signals.to_export(names, self.diagram_name)

    def _columns(self, names: Iterable[str], samples: slice = slice(None)) -> Iterator[tuple[str, np.ndarray]]:
        """Yield the name and the values of each column; entries of a vector are counted from 1."""
        from .run_exports import column_labels, flatten_samples

        for name in self._names_to_export(names):
            values = self.part(name, samples)
            for label, column in zip(column_labels(name, values.shape[1:]), flatten_samples(values).T, strict=True):
                yield label, np.ascontiguousarray(column)

    def _units_of_columns(self, names: Iterable[str]) -> dict[str, str]:
        """Return the unit of each column, "" where it is not declared."""
        from .run_exports import column_labels

        units: dict[str, str] = {}
        for name in self._names_to_export(names):
            units |= zip(column_labels(name, self.signals.place(name)[0]), self.signals.units_of(name), strict=True)
        return units

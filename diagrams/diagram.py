"""The diagram: blocks and wires as one value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace as replace_fields
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from ..blocks.core.block import Block
from ..blocks.core.errors import OptionError, WiringError
from ..blocks.core.signals import check_name
from ..blocks.tracing.discretization import check_method
from .analysis import Analysis
from .flat.flat_diagram import FlatDiagram
from .flat.flatten import flatten
from .results.run import Run
from .wiring.check import Checked, check
from .wiring.delay_blocks import lowered
from .wiring.evaluation_order import evaluation_order
from .wiring.structure import Collector, Frame, Structure, Wire, stepped_blocks
from .wiring.subsystem import exact_time
from .wiring.variants import replaced, unique

if TYPE_CHECKING:
    from .linearization.operating_point import OperatingPoint
    from .results.saved_state import RunState
    from .simulation.simulation import Simulation

LOOPS = ("error", "solve")


class Diagram(Analysis):
    """A diagram: what its last calls need, found by walking the wires backwards.

    Building it checks everything: unwired inputs, double drives, shapes, units, names, algebraic loops.

    Parameters
    ----------
    name : str
        Name of the diagram.
    *roots : Call
        The calls that close it, such as ``plant(motor_force=u)``; what they are wired to belongs to the diagram.
    loops : {"error", "solve"}
        What is done about algebraic loops: they are an error, or Newton's method solves them at every instant, from the
        last solution, with exact derivatives. ``run.residual`` is what is left; above 1e-9 of 1 + the size of the
        signals the run stops.

    Raises
    ------
    WiringError
        One of its kinds, with the path of the block and its port.
    TraceError
        A block whose equations can't be traced.

    Examples
    --------
    >>> from loopwright.blocks import Sine, Gain
    >>> wave = Gain(gain=2, name="twice")(Sine(frequency=1)).named("wave")
    >>> run = Diagram("demo", wave).simulate(0.5, step=0.125, progress=False)
    >>> [round(float(v), 6) for v in run["wave"]]
    [0.0, 1.414214, 2.0, 1.414214, 0.0]
    """

    def __init__(self, name: str, *roots: Any, loops: str = "error"):
        if not isinstance(name, str):
            raise WiringError(
                f'found {name!r} where the name is expected; write Diagram("name", …), the calls after the name.'
            )
        if not roots:
            raise WiringError("a diagram needs at least one call, such as plant(motor_force=u).", block=name)
        if loops not in LOOPS:
            raise OptionError(
                f"found loops={loops!r}; expected {' or '.join(map(repr, LOOPS))}.", block=name, port="loops"
            )
        self._set(check_name(name), Collector(roots).structure(), loops)

    name: str
    loops: str
    _table: Structure
    _lowered: Structure
    _checked: Checked
    _flat: dict[Fraction | None, FlatDiagram]

    def _set(self, name: str, table: Structure, loops: str) -> None:
        runs = lowered(table)
        checked = check(runs)
        for start in (False, True):
            evaluation_order(runs, checked.traced, start=start, solve=loops == "solve")
        self.__dict__.update(name=name, loops=loops, _table=table, _lowered=runs, _checked=checked, _flat={})

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a diagram is a value: {name!r} can't be set. Use replace(…), or build another one.")

    @classmethod
    def _of(cls, name: str, table: Structure, loops: str = "error") -> Diagram:
        diagram = cls.__new__(cls)
        diagram._set(name, table, loops)
        return diagram

    def __reduce__(self) -> Any:
        return Diagram._of, (self.name, self._table, self.loops)

    def __repr__(self) -> str:
        boxes = [path for path in self._table.frames if path]
        return f"<diagram {self.name}: {len(self.blocks)} blocks{', in ' + ', '.join(boxes) if boxes else ''}>"

    @property
    def blocks(self) -> Mapping[str, Block]:
        """Every block by its dotted path."""
        return dict(self._table.blocks)

    @property
    def frames(self) -> Mapping[str, Frame]:
        """Every subsystem by its dotted path; the diagram itself is ""."""
        return dict(self._table.frames)

    @property
    def wires(self) -> Mapping[tuple[str, str], Wire]:
        """The source of every wired input, by (block path, input)."""
        return dict(self._table.wires)

    @property
    def names(self) -> Mapping[str, Wire]:
        """Every named wire."""
        return dict(self._table.names)

    def __getitem__(self, path: str) -> Block:
        """Return the block at a path, or at the unique end of one."""
        return self._table.blocks[unique(path, self._table.blocks, "block", self.name)]

    def replace(self, changes: Mapping[str, Any] | None = None, /, **more: Any) -> Diagram:
        """Return a variant: other blocks, parameters or sample times.

        Parameters
        ----------
        changes : mapping, optional
            By dotted path, or its unique end: a block (``"plant"``), a parameter
            (``"controller.admittance_par.stiffness"``), a subsystem's ``sample_time``, ``method``, ``offset`` or
            ``delay`` (``"controller.sample_time"``; None: that of what surrounds it), a plant's start value
            (``"plant.start.position"``).
        **more
            The same, for paths that are identifiers: ``replace(plant=Fmu("other.fmu"))``.

        Raises
        ------
        UnknownNameError, ParameterError, WiringError
            A name that isn't there, a value out of bounds, a block that doesn't fit the wires.
        """
        table = replaced(self._table, {**(changes or {}), **more}, self.name)
        return Diagram._of(self.name, table, self.loops)

    def continuous(self) -> Diagram:
        """Return the diagram with every sampled subsystem taken as ideal: continuous, without sampling, hold or delay.

        A projection then solves its equation at each evaluation, from the foot point of the last accepted step. With an
        FMU, a run still exchanges signals with it at multiples of ``step`` only, and holds its inputs between; the
        linear model, of its equations, has no such hold.

        Raises
        ------
        SampleTimeError
            A block that has a meaning at samples only, such as a `UnitDelay`.
        """
        table = Structure(**{k: dict(v) for k, v in vars(self._table).items()})
        for path, frame in table.frames.items():
            table.frames[path] = replace_fields(frame, sample_time=None, offset=Fraction(0), delay=0)
        return Diagram._of(self.name, table, self.loops)

    def sampled(self, sample_time: float | Fraction, method: str = "exact") -> Diagram:
        """Return the diagram with everything that is continuous sampled.

        Each block is discretized by itself, and what it reads from others is held over a sample: a plant drawn with
        `Integrator` blocks becomes forward Euler between them, of first order, whatever the method. To have a method
        act on a plant as a whole, write it as one block: a `StateSpace`, a `TransferFunction`, a `Block` of one's own.

        Parameters
        ----------
        sample_time : float or Fraction
            Sample time in s. Subsystems that have one of their own keep it.
        method : {"exact", "forward", "semi_implicit", "trapezoidal"}
            How the blocks are discretized that were continuous; see `loopwright.blocks.hold`. As inputs are held,
            ``trapezoidal`` is not Tustin's method, python-control's ``c2d(…, "bilinear")``, which averages them too.

        Raises
        ------
        SampleTimeError
            A sample time that is not positive, or an unknown method.
        """
        check_method(method)
        table = Structure(**{k: dict(v) for k, v in vars(self._table).items()})
        for path, frame in sorted(table.frames.items()):
            if self._table.clock(path) is None:
                table.frames[path] = replace_fields(frame, method=method)
        top = replace_fields(table.frames[""], sample_time=exact_time(sample_time, block=self.name))
        table.frames[""] = top
        return Diagram._of(self.name, table, self.loops)

    @property
    def is_continuous(self) -> bool:
        """Whether something happens between ticks: continuous states, events, or a transport delay."""
        table = self._lowered
        traces = self._checked.traced
        return (
            any(t.advance == "derivative" or t.indicators is not None for t in traces.values())
            or any(table.blocks[p].transport for p in table.blocks if p not in traces)
            or any(table.is_event(box) for box in table.controls)
        )

    @property
    def has_clock(self) -> bool:
        """Whether a subsystem, or the diagram itself, has a sample time."""
        return any(frame.sample_time is not None for frame in self._lowered.frames.values())

    @property
    def has_fmu(self) -> bool:
        """Whether an FMU is in it."""
        return bool(stepped_blocks(self._table))

    def flatten(self, step: float | Fraction | None = None) -> FlatDiagram:
        """Return the diagram as one CasADi function of a tick.

        Parameters
        ----------
        step : float or Fraction, optional
            Seconds between two ticks, where no subsystem has a sample time (or to look between samples).
        """
        return self._flattened(None if step is None else exact_time(step, block=self.name))

    def _flattened(self, key: Fraction | None) -> FlatDiagram:
        if key not in self._flat:
            solve = self.loops == "solve"
            self._flat[key] = flatten(self._lowered, self._checked, key, name=self.name, solve=solve)
        return self._flat[key]

    def simulate(
        self,
        duration: float,
        *,
        step: float | Fraction | None = None,
        solver: str = "auto",
        rtol: float = 1e-6,
        atol: float = 1e-9,
        max_step: float | None = None,
        record: Iterable[str] | None = None,
        every: int = 1,
        states: bool = True,
        to: Any = None,
        overwrite: bool = False,
        start: RunState | OperatingPoint | None = None,
        progress: bool | None = None,
    ) -> Run:
        """Run the diagram and return what it recorded: from t = 0, or from a saved state.

        What happens in which order is said in `loopwright.diagrams.Simulation`'s module, in one page.

        Parameters
        ----------
        duration : float
            Simulated time in s, a multiple of the step between ticks.
        step : float or Fraction, optional
            Seconds between two ticks (samples, steps of a solver of fixed step, communication points of FMUs). Without
            one it is the greatest common divisor of all sample times, of which those are visited at which a box acts;
            for a diagram without any, a thousandth of the duration.
        solver : str
            What integrates continuous states: "auto", of fixed step "euler", "heun", "rk4", of variable step "RK23",
            "RK45", "DOP853", "Radau", "BDF", "LSODA", "CVODE_BDF", "CVODE_Adams". The default changes from an explicit
            to an implicit method where the diagram turns out to be stiff.
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
            State to go on from: ``run.final_state``, that of `Simulation.save`, or an operating point, such as
            `trim` finds one, with the parameters that belong to it.
        progress : bool, optional
            Show a progress bar; by default on a terminal, and in a notebook where ipywidgets is installed.

        Returns
        -------
        Run
            Every output at every sample.

        Raises
        ------
        SimulationError
            `PathDomainError`, `GuardError`, `NonFiniteError` or `FmuRuntimeError`, a solver that can't go on, events
            that pile up, an algebraic loop without a solution; ``error.run`` holds what was recorded until then.
        OptionError
            A duration that is not positive, or no multiple of the step; an unknown solver, a tolerance out of range.
        """
        from .simulation.simulate import simulate

        return simulate(
            self,
            duration,
            step=step,
            solver=solver,
            rtol=rtol,
            atol=atol,
            max_step=max_step,
            record=record,
            every=every,
            states=states,
            to=to,
            overwrite=overwrite,
            start=start,
            progress=progress,
        )

    def simulation(self, **options: Any) -> Simulation:
        """Return a run in the making, to go on step by step, to save and to restore; see `Simulation`.

        Parameters
        ----------
        **options
            ``step``, ``solver``, ``rtol``, ``atol``, ``max_step``, ``record``, ``every``, ``states``, ``to``,
            ``overwrite`` and ``start`` of `simulate`.
        """
        from .simulation.simulation import Simulation

        return Simulation(self, **options)

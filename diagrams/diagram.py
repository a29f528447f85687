"""The diagram: blocks and wires as one value, with all that is done with it.

What describes and runs a diagram is imported with it; a method that linearizes, measures, draws or reports imports its
sub-package when it is first called, so that a run does not pay for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, Unpack

from ..blocks.core import (
    Block,
    Sheet,
    ShownAsTable,
    WiringError,
    accepts,
    check_name,
    explain_calls,
    kinds,
    missing_member,
    offer_elsewhere,
    without_collection,
)
from ..blocks.names_of_other_tools import DURATION
from .coupling import Coupling, CouplingReport, report_coupling, to_coupling
from .flat import FlatDiagram, WiredDiagram
from .results import OperatingPoint, Run
from .simulation import KeptKeywords, ProgressOption, RunKeywords, RunOptions, Simulation, simulate
from .wiring import Collector, Structure, SubsystemSettings, SubsystemTable, Wire, sheet_of_structure

if TYPE_CHECKING:
    from ..fmus import ArchiveLimits
    from ..fmus.export import Number, TargetCode
    from .contact import Contact
    from .drawing import Drawing, Facts
    from .linearization import Linearization
    from .measure import FrequencyResponse
    from .report import Report
    from .requirements import Requirements
    from .studies import Sensitivities, WorstCase
    from .sweeps import Sweep
    from .web_page import WebPage

LOOPS = ("error", "solve")
PLUMBING = {"contact_port", "drawn_facts", "has_clock", "has_fmu", "is_continuous", "of_wired", "structure", "wired"}
"""Public members of a diagram that only functions below it use: completion leaves them out."""
_LOOP = 'diagram.linearize().loop("wire")'
WAYS = {
    **dict.fromkeys(("run", "sim", "start", "execute"), "diagram.simulate(2.0)"),
    **dict.fromkeys(("scope", "plot", "show"), 'run = diagram.simulate(2.0), then run.plot("wire")'),
    **dict.fromkeys(("margin", "margins"), f"margins({_LOOP}), after from loopwright import margins"),
    **{name: f"{_LOOP}.{name}()" for name in ("bode", "nyquist", "root_locus", "pzmap", "nichols")},
    "step": f"{_LOOP}.step(), which closes the loop, or a Step as the reference and diagram.simulate(2.0)",
    **dict.fromkeys(("step_info", "stepinfo"), 'diagram.simulate(2.0).step_info("wire")'),
    **dict.fromkeys(("loop", "poles", "linmod"), f"diagram.linearize(), and {_LOOP} for the loop at a wire"),
    **dict.fromkeys(("add", "connect", "add_block", "add_connection"), "a call, which wires: plant(force=u)"),
    "sensitivity": 'diagram.sensitivities(…), by parameters, or S: diagram.linearize().sensitivity("wire")',
    **dict.fromkeys(("compile", "build"), "diagram.simulate(2.0, compile=True)"),
    **dict.fromkeys(("set", "set_parameter", "set_param"), 'diagram.replace({"plant.mass": 2.0}), a new diagram'),
}
"""What to write for names that users of other tools look for in a diagram."""


@explain_calls
class Diagram(ShownAsTable):
    """A diagram: what its last calls need, found by walking the wires backwards.

    Building it checks everything: unwired inputs, double drives, shapes, units, names, algebraic loops.

    Parameters
    ----------
    name : str
        Name of the diagram.
    *roots : Call
        The calls that close it, such as ``plant(motor_force=u)``; what they are wired to belongs to the diagram.
    loops : {"error", "solve"}
        Treatment of algebraic loops: they are an error, or Newton's method solves them at every instant, from the
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

    contact_port: ClassVar[str | None] = None
    """Port at which an environment pushes unless a contact names another; known where the kind of diagram is."""
    wired: WiredDiagram
    """Its blocks and wires, checked and ordered, with its functions: what the sub-packages take as a diagram."""

    @accepts("{name}", loops=kinds.choice(*LOOPS).worded(found=kinds.by_name))
    @without_collection
    def __init__(self, name: str, *roots: object, loops: str = "error"):
        if not isinstance(name, str):
            raise WiringError(
                f'found {name!r} where the name is expected; write Diagram("name", …), the calls after the name.'
            )
        if not roots:
            raise WiringError("a diagram needs at least one call, such as plant(motor_force=u).", block=name)
        structure = Collector(roots).structure()
        if not structure.blocks:
            raise WiringError(
                "found no block in what it is made of; expected one at least. Call blocks in the subsystem's function, "
                "and return their signals.",
                block=name,
            )
        self._hold(WiredDiagram(check_name(name), structure, loops, type(self)))

    @classmethod
    def from_ssp(
        cls,
        file: str | os.PathLike[str],
        variant: str | None = None,
        *,
        inputs: Mapping[str, Any] | None = None,
        limits: ArchiveLimits | None = None,
        loops: str = "error",
    ) -> Self:
        """Return the diagram of an SSP (System Structure and Parameterization 1.0 or 2.0); see docs/howto/ssp.md.

        Its components are FMUs, its systems subsystems, of the same names; inputs of the root system are constants,
        which `replace` takes other sources for, and its outputs are named wires. Conversions of units and linear
        transformations become blocks, and parameter sets the FMUs' start values.

        Parameters
        ----------
        file : path
            The ``.ssp``, or a ``.ssd`` with its files next to it. An archive is unpacked into the cache.
        variant : str, optional
            File name of the description in it, or its name; ``SystemStructure.ssd`` without it.
        inputs : mapping, optional
            Values of inputs of the root system, by name and in their units; by default those of the parameter sets,
            else the start values of what they drive.
        limits : ArchiveLimits, optional
            Limits of the file, and of each FMU in it.
        loops : {"error", "solve"}
            Treatment of algebraic loops.

        Raises
        ------
        SspFileError
            If the file is no SSP, is unsafe, breaks the standard, or has something that can't become a diagram: the
            message names the element.
        FmuFileError
            If an FMU in it can't be used here.
        WiringError
            One of its kinds, for connections that don't fit.
        """
        from .ssp import read_structure

        name, structure = read_structure(file, variant, inputs, limits)
        return cls._of(name, structure, loops)

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        explain_calls(cls)

    def _hold(self, wired: WiredDiagram) -> None:
        self.__dict__["wired"] = wired
        wired.show_as(self)

    @classmethod
    def of_wired(cls, wired: WiredDiagram) -> Self:
        """Return the diagram that shows a wired one to users."""
        diagram = cls.__new__(cls)
        diagram._hold(wired)
        return diagram

    @classmethod
    def _of(cls, name: str, structure: Structure, loops: str = "error") -> Self:
        return cls.of_wired(WiredDiagram(name, structure, loops, cls))

    def __reduce__(self) -> tuple[object, ...]:
        return type(self)._of, (self.name, self.structure, self.loops)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a diagram is a value: {name!r} can't be set. Use replace(…), or build another one.")

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            raise missing_member(self, name, "a diagram", WAYS)

    def __dir__(self) -> list[str]:
        return sorted(name for name in {*super().__dir__()} - PLUMBING if not name.startswith("_"))

    def __repr__(self) -> str:
        paths = [path for path in self.structure.subsystems if path]
        return f"<diagram {self.name}: {len(self.blocks)} blocks{', in ' + ', '.join(paths) if paths else ''}>"

    def _sheet(self) -> Sheet:
        return sheet_of_structure(self.name, self.structure)

    @property
    def name(self) -> str:
        """Its name."""
        return self.wired.name

    @property
    def loops(self) -> str:
        """Treatment of algebraic loops: "error" or "solve"."""
        return self.wired.loops

    @property
    def structure(self) -> Structure:
        """Blocks, wires and subsystems as they were wired."""
        return self.wired.structure

    @property
    def blocks(self) -> Mapping[str, Block]:
        """Every block by its dotted path."""
        return dict(self.structure.blocks)

    @property
    def subsystems(self) -> Mapping[str, SubsystemSettings]:
        """Every subsystem by its dotted path; the diagram itself is ""."""
        return SubsystemTable(self.structure.subsystems)

    @property
    def wires(self) -> Mapping[tuple[str, str], Wire]:
        """The source of every wired input, by (block path, input)."""
        return dict(self.structure.wires)

    @property
    def names(self) -> Mapping[str, Wire]:
        """Every named wire."""
        return dict(self.structure.names)

    @property
    def is_continuous(self) -> bool:
        """Whether the solver has work between ticks: continuous states, events, or a transport delay."""
        return self.wired.is_continuous

    @property
    def has_clock(self) -> bool:
        """Whether a subsystem, or the diagram itself, has a sample time."""
        return self.wired.has_clock

    @property
    def has_fmu(self) -> bool:
        """Whether a block in it is stepped from outside, such as an FMU."""
        return self.wired.has_fmu

    def __getitem__(self, path: str) -> Block:
        """Return the block at a path, or at the unique end of one."""
        return self.wired[path]

    # --- variants ----------------------------------------------------------------------------------------------------

    def replace(self, changes: Mapping[str, object] | None = None, /, **more: object) -> Self:
        """Return a variant: other blocks, parameters or sample times.

        Parameters
        ----------
        changes : mapping, optional
            By dotted path, or its unique end: a block (``"plant"``), a parameter
            (``"controller.admittance_par.stiffness"``), an entry of an array, counted from 1
            (``"motor.denominator[1]"``), a subsystem's ``sample_time``, ``method``, ``offset`` or
            ``delay`` (``"controller.sample_time"``; None: that of its surroundings), a plant's start value
            (``"plant.start.position"``, or ``"plant.position"`` where the block has no parameter of that name).
        **more
            Changes whose paths are identifiers, as keywords: ``replace(plant=Fmu("other.fmu"))``.

        Raises
        ------
        UnknownNameError, ParameterError, WiringError
            A name that isn't there, a value out of bounds, a block that doesn't fit the wires.
        OptionError
            Two names of one parameter, or of one block.

        Notes
        -----
        Blocks are replaced first, then whole parameters, then parts of them, in whatever order they are given:
        ``{"plant.mass": 3, "plant": Fmu("other.fmu")}`` gives the other FMU a mass of 3.
        """
        return self.of_wired(self.wired.replace(changes, **more))

    def continuous(self) -> Self:
        """Return the diagram with every sampled subsystem as its ideal: continuous, without sampling, hold or delay.

        A projection then solves its equation at each evaluation, from the foot point of the last accepted step. A run
        with an FMU still exchanges signals with it at multiples of ``step`` only, and holds its inputs between. The
        linear model comes from the FMU's equations and has no such hold.

        Raises
        ------
        SampleTimeError
            A block that is defined at samples only, such as a `UnitDelay` or an `Encoder`: `replace` it first.
        """
        return self.of_wired(self.wired.continuous())

    def sampled(self, sample_time: float | Fraction, method: str = "exact") -> Self:
        """Return the diagram with all its continuous blocks sampled.

        Each block is discretized by itself, with its inputs held over a sample. So a plant drawn with `Integrator`
        blocks becomes forward Euler between them, of first order, whatever the method. For a method to act on a plant
        as a whole, write the plant as one block: a `StateSpace`, a `TransferFunction`, or a `Block` of your own.

        Parameters
        ----------
        sample_time : float or Fraction
            Sample time in s. Subsystems with their own sample time keep it.
        method : {"exact", "forward", "semi_implicit", "trapezoidal"}
            Discretization of the blocks that were continuous; see `loopwright.hold`. As inputs are held,
            ``trapezoidal`` is not Tustin's method, python-control's ``c2d(…, "bilinear")``, which averages them too.

        Raises
        ------
        SampleTimeError
            A sample time that is not positive, or an unknown method.
        """
        return self.of_wired(self.wired.sampled(sample_time, method))

    # --- runs --------------------------------------------------------------------------------------------------------

    def flatten(self, step: float | Fraction | None = None) -> FlatDiagram:
        """Return the diagram as one CasADi function of a tick.

        Parameters
        ----------
        step : float or Fraction, optional
            Seconds between two ticks, where no subsystem has a sample time (or to look between samples).
        """
        return self.wired.flatten(step)

    @offer_elsewhere(**DURATION)
    def simulate(self, duration: float, *, progress: ProgressOption = None, **options: Unpack[RunKeywords]) -> Run:
        """Run the diagram and return what it recorded: from t = 0, or from a saved state.

        The page docs/explanation/time.md says what happens in which order.

        Parameters
        ----------
        duration : float
            Simulated time in s. One that is no multiple of the step between ticks ends with a sample between two of
            them; such a run has no ``final_state``.
        progress : bool or callable, optional
            Show a progress bar, or a function that is called with the time in s; by default the bar is shown on a
            terminal, and in a notebook.
        **options
            Options of the run by name: ``step``, ``solver``, ``rtol``, ``atol``, ``max_step``, ``record``, ``every``,
            ``states``, ``to``, ``overwrite``, ``start``, ``coupling``, ``start_exchange``, ``compile`` (whether C goes
            from tick to tick) and ``fuse`` (faster; values differ by rounding). `RunOptions` says what each means,
            and its default.

        Returns
        -------
        Run
            Every output at every sample.

        Raises
        ------
        SimulationError
            `PathDomainError`, `GuardError`, `NonFiniteError` or `FmuRuntimeError`, a solver that can't continue, events
            that pile up, an algebraic loop without a solution; ``error.run`` holds what was recorded until then.
        OptionError
            A duration that is not positive, or no multiple of the step; an unknown option or solver, a tolerance out of
            range.
        """
        return simulate(self.wired, duration, RunOptions.of(options, block=self.name), progress=progress)

    def simulation(self, **options: Unpack[RunKeywords]) -> Simulation:
        """Return a run in the making, to continue step by step, to save and to restore; see `Simulation`.

        Parameters
        ----------
        **options
            As for `simulate`; see `RunOptions`.

        Raises
        ------
        OptionError
            An unknown option or solver, a tolerance out of range.
        """
        return Simulation(self.wired, RunOptions.of(options, block=self.name))

    def report_coupling(
        self, coupling: str | Coupling = "jacobi", *, step: float | Fraction | None = None
    ) -> CouplingReport:
        """List the delay of every connection from and to an FMU; see docs/explanation/coupling.md.

        Parameters
        ----------
        coupling : str or Coupling
            As of `simulate`.
        step : float or Fraction, optional
            As of `simulate`; required where no subsystem has a sample time.

        Returns
        -------
        CouplingReport
            ``print`` shows it as a table.

        Raises
        ------
        OptionError, SampleTimeError
            An unknown coupling; no step where one is needed.
        """
        return report_coupling(self.wired.flatten(step), to_coupling(coupling, block=self.name))

    def sweep(
        self,
        parameters: Mapping[str, Any] | None,
        duration: float,
        *,
        samples: Any = "grid",
        count: int | None = None,
        seed: int = 0,
        seeds: str | Iterable[str] = (),
        signals: str | Iterable[str] = (),
        reduce: Mapping[str, Callable[[Run], Any]] | None = None,
        to: str | os.PathLike[str] | None = None,
        overwrite: bool = False,
        workers: int | None = None,
        client: Any = None,
        progress: ProgressOption = None,
        lanes: bool | int = False,
        **options: Unpack[KeptKeywords],
    ) -> Sweep:
        """Run the diagram with many values of its parameters, on every core; see docs/howto/sweeps.md.

        Without ``lanes`` each run is, to the last bit, that of ``diagram.replace(parameters).simulate(duration)`` with
        the same options and ``compile=True``, whoever makes it, and however many workers there are. A run that fails
        is kept as data, and harms no other.

        Parameters
        ----------
        parameters : mapping or None
            By dotted path, as `replace` takes them: values for a grid, ranges ``(low, high)`` or `Box` for a Latin
            hypercube; None with a table.
        duration : float
            Simulated time of each run in s.
        samples : {"grid", "latin"}, Samples, list of mapping, mapping of str to list, or DataFrame
            Every combination of the values; ``count`` samples spread over the ranges; or a table of samples.
        count : int, optional
            Number of samples of a Latin hypercube.
        seed : int
            Seed of the sweep; each sample has its own, which depends on this one and its place alone.
        seeds : list of str
            Parameters that take the sample's seed, such as ``"noise.seed"``. Where a seed is fixed in a
            block's equations, these runs are interpreted by default.
        signals : list of str
            Signals whose samples are kept.
        reduce : mapping of str to callable, optional
            Numbers of each run, by name: `final`, `maximum`, `minimum`, `mean`, `settling_time`, or a function that
            takes a run and returns numbers.
        to : path, optional
            Folder for the results. A sweep that was cut off, or one with some samples more, runs what is missing.
        overwrite : bool
            Replace a sweep of another diagram, or with other options, that is stored there.
        workers : int, optional
            Number of threads, or processes; as many as cores without it.
        client : distributed.Client, optional
            A Dask cluster that runs the samples.
        progress : bool or callable, optional
            Show a progress bar, or a function that is called with the number of samples that are done; see `simulate`.
        lanes : bool or {2, 4, 8, 16}, optional
            Make so many runs side by side in vector lanes of the processor, 8 for True: some times as fast.
            Their values then differ from those of single runs by rounding, and the sweep's messages say so. A motion
            that magnifies small differences (a limit cycle, sticking) magnifies these, too; see docs/howto/sweeps.md.
            Every FMU must have been built by Loopwright on this machine, with steps of fixed length and without events;
            runs that can't go so are made one after the other, which a message says.
        **options
            Options of each run, as for `simulate`; ``compile=True`` is the default, but with ``seeds``.

        Returns
        -------
        Sweep
            ``sweep["name"]`` by name, ``sweep.dataset`` for xarray, ``sweep.failures``.

        Raises
        ------
        UnknownNameError
            A parameter or signal that isn't there.
        OptionError
            Samples, options or reductions that don't fit; a folder that holds something else.
        """
        from .sweeps import sweep

        return sweep(
            self.wired,
            parameters,
            duration,
            samples=samples,
            count=count,
            seed=seed,
            seeds=seeds,
            signals=signals,
            reduce=reduce,
            to=to,
            overwrite=overwrite,
            workers=workers,
            client=client,
            progress=progress,
            lanes=lanes,
            options=options,
        )

    # --- linear models, margins and contact --------------------------------------------------------------------------

    def operating_point(
        self, t: float = 0.0, *, states: Mapping[str, Any] | None = None, **options: Any
    ) -> OperatingPoint:
        """Run to a time, and return everything that a linear model at that instant depends on.

        Parameters
        ----------
        t : float
            Time in s, a tick.
        states : mapping, optional
            Values of states of blocks and FMUs that are given, by path: ``{"plant.position": 0.2}``. Signals, and the
            FMUs' outputs, are then what follows from them.
        **options
            Of the run there: ``step``, ``solver``, ``rtol``, ``atol``, ``max_step``, ``start``, and
            ``start_exchange`` of `simulate`.

        Raises
        ------
        UnknownNameError
            A state that isn't there.
        """
        from .linearization import point_from_states, run_to

        if not (states is None or (isinstance(states, dict) and not states)):
            return point_from_states(self.wired, t, states, options)
        return run_to(self.wired, t, options)

    def trim(
        self,
        free: Mapping[str, Any] | Iterable[str] | None = None,
        targets: Mapping[str, Any] | None = None,
        *,
        rates: Mapping[str, Any] | None = None,
        fixed: Iterable[str] = (),
        at: Any = None,
        tolerance: float = 1e-9,
        **options: Any,
    ) -> OperatingPoint:
        """Find an operating point: the states and parameters at which signals have given values, and all is at rest.

        Every state of a block or an FMU is unknown, unless it is fixed, and is asked to stay: rates are zero, sampled
        states repeat. The equations are solved by least squares within bounds, with the exact derivatives of the
        diagram and the linear models of its FMUs. A state that nothing determines stays near where the search begins:
        ``free`` of the result says so.

        Parameters
        ----------
        free : mapping of str to (low, high), or list of str, optional
            Parameters that may change, by the paths of `replace`, with their bounds in their units, or None:
            ``{"force.value": (-10, 10)}``. An FMU's are ``"plant.start.mass"``. A state that is named here gets bounds.
        targets : mapping, optional
            Values that signals are to have, by the names of wires or ports: ``{"position": 0.2}``.
        rates : mapping, optional
            Rates of states in their unit per second that are not zero, by path; None where any rate will do.
        fixed : list of str, optional
            States that keep the value with which the search begins.
        at : OperatingPoint, Snapshot or float, optional
            Where the search begins, as in `linearize`; also the time at which sources are taken, and what discrete
            states and enabled subsystems are. Without it, the start.
        tolerance : float
            Largest residual of an equation, relative to 1 + the size of what it belongs to.
        **options
            Of the run to where the search begins: see `operating_point`; ``step`` is needed where only an FMU steps.

        Returns
        -------
        OperatingPoint
            With ``parameters``, the values found, and ``residuals``, what is left of each equation by name. `linearize`
            takes it with its parameters, ``simulate(…, start=point)`` runs from it.

        Raises
        ------
        SimulationError
            If no such point is found, or an FMU with hidden states moves there; the message has the largest residuals.
        UnknownNameError, OptionError, ParameterError, FmuError
            A name that isn't there, bounds or values that don't fit, a parameter that can't change; an FMU without a
            linear model.

        Examples
        --------
        >>> from loopwright.blocks import Constant, Integrator
        >>> level, inflow = Integrator(name="level"), Constant(value=1.0, name="inflow")
        >>> tank = Diagram("tank", level(inflow - 0.5 * level.y))
        >>> point = tank.trim(free={"inflow.value": (0, 10)}, targets={"level.y": 3.0})
        >>> round(point.parameters["inflow.value"], 12)
        1.5
        """
        from .linearization import trim

        return trim(self.wired, free, targets, rates=rates, fixed=fixed, at=at, tolerance=tolerance, **options)

    def linearize(
        self,
        at: Any = None,
        *,
        inputs: str | Iterable[str] = (),
        outputs: str | Iterable[str] = (),
        openings: str | Iterable[str] = (),
        plants: str | None = None,
        stairs: str | None = None,
        delays: str = "exact",
        order: int = 5,
        **options: Any,
    ) -> Linearization:
        """Return the linear model of this very diagram at an operating point.

        It is continuous where everything is continuous. With sampled subsystems it is discrete, over one base period
        or, with several rates, their least common one; hold, delay and the time between ticks are exact. Its
        ``findings`` say what it does not follow, such as stairs and kinks; loops and their numbers have them, too.

        Parameters
        ----------
        at : OperatingPoint, Snapshot or float, optional
            Where: ``run.at(t)``, a time in s, `operating_point`, `trim`; the start without it.
        inputs : str or list of str
            Wires or ports at which a signal is injected: added to what the consumers get; over a period it is held. At
            an input, such as ``"plant.force"``, it reaches that input alone.
        outputs : str or list of str
            Wires or ports that are measured: what the block puts out, or arrives at an input, ahead of an injection.
        openings : str or list of str
            Wires that are cut behind the port, for all its consumers, which get its value at the operating point; at an
            input, for that one alone.
        plants : {"equations", "step", "identified"}, optional
            Linear model of an FMU's step: its equations' Jacobian and a matrix exponential, the default at equilibria;
            differences of the step, elsewhere; or its pulse responses from rest, where it allows neither.
        stairs : {"gain", "zero"}, optional
            "zero" takes stairs by their slope of zero, "gain" all by their mean slope, also rounding of your own.
            Without it those of `Quantizer` and `Encoder` have their mean slope. A relay has none.
        delays : {"exact", "pade"}
            "pade" takes `TransportDelay` in a continuous diagram as Padé's approximation, for what needs a rational
            model; a finding says up to which frequency it is right. Sampled diagrams are exact with either.
        order : int
            Order of that approximation.
        **options
            Options of the run to a time, as of `operating_point`. With ``step`` a diagram that is continuous but for an
            FMU is linearized over its communication step.

        Returns
        -------
        Linearization
            With `Linearization.system`, a `control.StateSpace` with names, and the loops: ``.loop("v_perp")``. Of a
            continuous diagram with transport delays these are systems with delays, which evaluate exactly and have no
            matrices; see docs/howto/dead_time.md.

        Raises
        ------
        UnknownNameError, WiringError, FmuError
            A signal that isn't there; an opening at which nothing is wired; an FMU that can't be linearized: the error
            says what it lacks.
        OptionError
            A transport delay that acts back on itself between the ticks of a sampled diagram.
        """
        from .linearization import linearize

        options = {"plants": plants, "stairs": stairs, "delays": delays, "order": order, **options}
        return linearize(self.wired, at, inputs=inputs, outputs=outputs, openings=openings, **options)

    def linearize_batch(
        self, points: Iterable[Any] = (None,), variants: Iterable[Mapping[str, Any]] = ({},), **options: Any
    ) -> list[Linearization]:
        """Return the linear models at several operating points and with several parameters.

        Parameters
        ----------
        points : iterable
            As `linearize` takes them. Each variant runs to a time or an instant again; an `OperatingPoint` is taken.
        variants : iterable of mapping
            What `replace` changes: ``[{"controller.pid_par.poles": (-30, -30, -30)}, …]``.
        **options
            As for `linearize`.

        Returns
        -------
        list of Linearization
            All points of the first variant, then those of the second one, and so on; ``found.diagram`` is the variant.

        Raises
        ------
        LoopwrightError
            As `linearize` and `replace`; the message says with which variant, and at which point.
        """
        from .linearization import linearize_batch

        return linearize_batch(self.wired, points, variants, **options)

    def frequency_response(
        self,
        wire: str,
        frequencies: Any,
        *,
        amplitude: float,
        kind: str = "sine",
        at: Any = 0.0,
        outputs: str | Iterable[str] = (),
        to: str | Iterable[str] = (),
        windows: int = 40,
        agreement: float = 1e-6,
        confirm: bool = True,
        **options: Any,
    ) -> FrequencyResponse:
        """Measure a frequency response on the running diagram: a test signal d is added at a wire.

        With v the output of the wire's port and u = v + d the signal that all its consumers get, S = u/d, T = −v/d and
        L = −v/u, as of `Linearization`. They are sampled where the linear model is; see docs/howto/measured_loops.md.

        The signal is ramped in; then windows of whole periods follow until two agree. Let the references stand still.

        Parameters
        ----------
        wire : str
            A wire or port, or an entry of it, ``"motor_force[1]"``. Of one with several entries, each is excited in its
            own run, and the responses are matrices.
        frequencies : array_like
            In rad/s. They are moved by less than half a sample in a window, so that whole periods fit into it.
        amplitude : float
            Largest value of the test signal, in the wire's unit: small enough that nothing saturates.
        kind : {"sine", "multisine", "chirp"}
            One sine after the other; all at once, with Schroeder's phases; a linear sweep over their range, repeated.
        at : OperatingPoint, Snapshot or float
            Where: `trim`, ``run.at(t)``, or a time in s that is run to first.
        outputs : str or list of str
            Further signals to be measured: `FrequencyResponse.response`, from the test signal to them.
        to : str or list of str
            Inputs of blocks, ``"plant.u"``: these consumers of the wire alone get the test signal, as of
            `Linearization.loop`. So is measured the loop at the plant's input where the wire also feeds a model of the
            controller's own.
        windows : int
            Most windows that are waited for.
        agreement : float
            Relative difference of two windows at which a frequency is done. One at which noise keeps the windows from
            agreeing is done, too, with the uncertainty of their mean.
        confirm : bool
            Whether to measure a second time, with half the amplitude and smaller tolerances, for the uncertainty.
        **options
            Of the run, as in `operating_point`. A continuous diagram is run with rtol = 1e-9, atol = 1e-12, and sampled
            16 times in a period of the highest frequency, if nothing else is said; more often where ``at`` is a time
            that needs it, to have a sample there.

        Returns
        -------
        FrequencyResponse
            ``S``, ``T``, ``L`` and ``response`` as `control.FrequencyResponseData`, with the estimate's own
            ``uncertainty`` and ``distortion``; ``compare(linearization)`` is the largest relative deviation from a
            linear model.

        Raises
        ------
        UnknownNameError, WiringError, OptionError
            A signal that isn't there; a port that nothing is wired to; frequencies that are not positive or too high
            for the samples, no amplitude, an unknown kind.
        """
        from .measure import frequency_response

        return frequency_response(
            self.wired,
            wire,
            frequencies,
            amplitude=amplitude,
            kind=kind,
            at=at,
            outputs=outputs,
            to=to,
            windows=windows,
            agreement=agreement,
            confirm=confirm,
            **options,
        )

    def contact(
        self,
        port: str | None = None,
        *,
        position: str | None = None,
        velocity: str | None = None,
        force: str | None = "force",
        direction: Any = "perp",
        at: Any = None,
        **options: Any,
    ) -> Contact:
        """Return the contact of an environment with the plant: admittance, passivity and limits of coupled stability.

        The plant is the block or FMU with the port; all the rest of the diagram is its controller.

        Parameters
        ----------
        port : str, optional
            Port at which the environment pushes; a diagram of Fig. 3 needs no name for it.
        position, velocity : str, optional
            Position and velocity there, in its axes; the outputs ``position`` and ``velocity`` of the port's block
            without them.
        force : str or None
            Wire of the measured force on the robot; None if the controller does not measure it.
        direction : {"perp", "par"} or vector
            Direction of the environment: across or along the diagram's path, or a vector.
        at : OperatingPoint, Snapshot or float, optional
            Point at rest, as in `linearize`; the start without it. ``options`` are those of the run, and ``stairs``.

        Raises
        ------
        UnknownNameError, ShapeError, OptionError, ParameterError
            Ports that don't fit; a point not at rest; a plant without a model of its equations; a force behind states.
        """
        from .contact import PortNames, make_contact

        return make_contact(self.wired, PortNames(port, position, velocity, force), direction, at, options)

    def sensitivities(
        self,
        loop: str | Iterable[str],
        parameters: str | Iterable[str] | None = None,
        *,
        to: str | Iterable[str] | None = None,
        at: Any = None,
        delay: int = 0,
        skew: float = 0.0,
        **options: Any,
    ) -> Sensitivities:
        """Return the derivatives of a loop's margins by parameters of the diagram; see docs/howto/worst_case.md.

        They are exact derivatives of the linear model, hold and delay included: of its matrices by CasADi, of the
        margins by implicit differentiation at their crossings and peaks. By an FMU's parameter they are differences,
        with their error.

        Parameters
        ----------
        loop : str or list of str
            Wire that the loop is cut at, as of `Linearization.loop`. Of several wires, or one with several entries,
            there is the disk margin alone.
        parameters : list of str, optional
            Paths, ``"controller.pid.kp"`` or ``"plant.mass"`` of an FMU. Without it, all numbers in the traced
            equations that are not 0, and the parameters that the blocks of FMUs set.
        to : str or list of str, optional
            Inputs ahead of which the wire is cut, as of `Linearization.loop`; an empty list cuts it for all consumers.
            Without it, a wire that also feeds a model of the controller's own is cut ahead of the plant.
        at : OperatingPoint, Snapshot, float or callable, optional
            Point, as in `linearize`. An equilibrium follows the parameter; a point that is not at rest keeps its
            states. A function from a diagram to a point, ``lambda d: d.trim(…)``, is asked again for changed
            parameters.
        delay, skew
            As of `margins`. ``options`` are those of `linearize`.

        Returns
        -------
        Sensitivities
            ``found["pid.kp", "phase_margin_deg"].per_percent``; ``found.of("ms")``; ``print``; ``found.plot("ms")``.

        Raises
        ------
        UnknownNameError, ParameterError
            A wire or parameter that isn't there; a parameter that is structure of the equations.
        """
        from .studies import find_sensitivities

        return find_sensitivities(self.wired, loop, parameters, to=to, at=at, delay=delay, skew=skew, **options)

    def worst_case(
        self,
        parameters: Mapping[str, Any] | None,
        loop: str | Iterable[str] | None = None,
        *,
        to: str | Iterable[str] | None = None,
        quantity: str | Callable[[Any], Any] | None = None,
        requirements: Requirements | None = None,
        contact: Mapping[str, Any] | None = None,
        samples: Any = "latin",
        count: int | None = None,
        seed: int = 0,
        starts: int = 3,
        steps: int = 15,
        at: Any = None,
        points: Sequence[Any] | None = None,
        delay: int = 0,
        progress: ProgressOption = None,
        **options: Any,
    ) -> WorstCase:
        """Find the worst case of a loop's margin, or of requirements, over ranges of parameters.

        Samples of the ranges come first, then all corners (of up to 5 numbers), then searches downhill from the worst
        of them, along the exact derivatives of the margins. A case that can't be analysed counts as the worst and
        says why; then come unstable loops, by their growth.

        Parameters
        ----------
        parameters : mapping of str to (low, high) or Box
            Ranges by path; values of each for a grid; None where ``samples`` is a table.
        loop : str or list of str
            Wire that the loop is cut at; with requirements several wires, each its own loop. Without them several
            wires are one loop, cut at all at once, with a disk margin. Requirements need none where they name loops.
        to : str or list of str, optional
            Inputs of blocks, ``"plant.u"``, ahead of which the one wire is cut; an empty list for all its consumers.
            Without it a wire that also feeds a model of the controller's own is cut at the plant's input, as in a
            report. Requirements have it for each of their loops.
        quantity : str or callable, optional
            The number, ``"disk_margin"`` without it: one of those that `Requirements` can limit. Or a function from a
            diagram to a number, the smaller, the worse, without a loop; its search takes differences.
        requirements : Requirements, optional
            In place of a number: the smallest distance to a limit, relative to the limit, is made worst.
        contact : mapping, optional
            In place of a loop: the contact whose limit of coupled stability is made worst, with arguments of `contact`
            and of `Contact.stability_limit`: ``{"vary": "stiffness", "damping": 10.0}``. Its search takes differences.
        samples, count, seed
            As of `sweep`: ``count`` samples of a Latin hypercube (100), ``"grid"``, or a table.
        starts, steps : int
            Number of searches, 0 for samples alone, without corners, and the most steps of each.
        at : OperatingPoint, Snapshot, float or callable, optional
            Point of each case, as of `sensitivities`; ``points`` is a list of them, at each of which every case is
            tried.
        delay : int
            Whole samples of delay in series with sampled loops.
        progress : bool or callable, optional
            Show a line for every case once the search has taken 2 s, or a function that is called with it; by default
            it is shown on a terminal. ``options`` are those of `linearize`.

        Returns
        -------
        WorstCase
            ``found.diagram.simulate(…)`` runs the worst case, ``found.confirm()`` measures it; ``found.parameters``,
            ``found.table()``, ``found.plot()``.

        Raises
        ------
        OptionError, UnknownNameError
            Ranges, numbers or loops that aren't there; a diagram that can't be analysed as it is.
        """
        from .simulation import work_notes
        from .studies import find_worst_case

        # Studies know no progress bar: they call a function with a line for each case.
        with work_notes(self.name, progress) as notify:
            return find_worst_case(
                self.wired,
                parameters,
                loop,
                to=to,
                quantity=quantity,
                requirements=requirements,
                contact=contact,
                samples=samples,
                count=count,
                seed=seed,
                starts=starts,
                steps=steps,
                at=at,
                points=points,
                delay=delay,
                progress=notify,
                **options,
            )

    # --- other tools' formats ----------------------------------------------------------------------------------------

    def to_ssp(
        self,
        path: str | os.PathLike[str],
        *,
        stop: float | None = None,
        step: float | None = None,
        flat: bool = False,
    ) -> Path:
        """Write the diagram as an SSP (System Structure and Parameterization), and return the file.

        FMUs are components, subsystems with FMUs in them systems; gains, sums with constants and conversions of units
        between them become the connections' transformations. Subsystems without FMUs, such as controllers, are built
        as FMUs, and other blocks as one more, ``blocks``. Constants are inputs of the root system, named wires its
        outputs, start values parameter sets. It is SSP 1.0; 2.0 where an FMU has arrays or integers of more than 32
        bits. See docs/howto/ssp.md, also for the order in which other tools step a controller and its plant.

        Parameters
        ----------
        path : path
            File to write, ``.ssp``.
        stop : float, optional
            Proposed end of a simulation in s.
        step : float, optional
            Proposed communication step in s, in an annotation of the Open Simulation Platform.
        flat : bool
            Write components and connections between them only, all in the root system, for readers that know no more
            (libcosim, ecos): no systems within it, no inputs and outputs; constants are start values.

        Raises
        ------
        SspFileError
            A block that has no place in an SSP: the message names it.
        DefinitionError
            A block that can't be exported.
        OptionError
            A path that does not end in ``.ssp``, or a folder that isn't there; a time that is not positive.
        """
        from .ssp import write_ssp

        return write_ssp(self.wired, path, stop=stop, step=step, flat=flat)

    # --- report and drawing ------------------------------------------------------------------------------------------

    def report(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        pdf: bool = False,
        json: bool = False,
        paper: str = "A4",
        **options: Any,
    ) -> Report:
        """Analyse the diagram for design, and write the report; see docs/howto/reports.md.

        Parameters
        ----------
        path : path, optional
            File to write, ``.html``; without it nothing is written. A notebook shows the report.
        pdf, json : bool
            Write ``.pdf`` (which needs ``pip install 'loopwright[pdf]'``) and ``.json`` next to it, too.
        paper : {"A4", "letter"}
            Paper of the PDF. ``options`` are those of `analyse`, such as ``requirements``, ``at`` and ``loops``; with
            ``summary=True`` the page is two sheets, with ``appendix=False`` it ends with its chapters.

        Returns
        -------
        Report
            Its sections, and ``.numbers()`` by dotted path.

        Raises
        ------
        OptionError, ConfirmationError
            A path that does not end in ``.html``, a PDF without its library; a number that its confirmation refutes.
        """
        from .report import analyse, check_files, with_drawing, write_report
        from .simulation import work_notes

        check_files(path, pdf=pdf, json=json, paper=paper)
        with work_notes(self.name, options.pop("progress", None)) as notify:
            analysed = analyse(self, _written=path is not None, progress=notify, **options)
            made = with_drawing(analysed, self.wired)
            notify("writing the files")
            write_report(made, path, pdf=pdf, json=json, paper=paper)
        return made

    def to_c(
        self,
        folder: str | os.PathLike[str],
        *,
        name: str | None = None,
        subsystem: str | None = None,
        outside: Iterable[str] = (),
        outputs: Iterable[str] | None = None,
        number: Number = "double",
        own_functions: bool = False,
    ) -> TargetCode:
        """Write the diagram, a subsystem of it, or all but some blocks, as C for a target; see `loopwright.to_c`.

        Parameters
        ----------
        folder, name, subsystem, outside, outputs, number, own_functions
            As of `loopwright.to_c`.

        Returns
        -------
        TargetCode
            The files; its ``measure`` compiles them for Cortex-M and counts instructions.

        Raises
        ------
        DefinitionError
            For what can't be on a target, by its path; then nothing is written.
        OptionError, UnknownNameError, SimulationError, DiskError
            As `loopwright.to_c`.
        """
        from .exporting import to_c

        return to_c(
            self,
            folder,
            name=name,
            subsystem=subsystem,
            outside=outside,
            outputs=outputs,
            number=number,
            own_functions=own_functions,
        )

    def draw(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        subsystem: str = "",
        closed: bool | Iterable[str] | None = None,
        width: float = 1000.0,
        run: Run | None = None,
    ) -> Drawing:
        """Draw the diagram itself: blocks, subsystems with their rates, wires with their names, FMUs marked.

        Signals run from left to right; feedback runs back below. What is much wider than ``width`` is broken into
        rows, which are read like lines of text. Inside a block is its value, its transfer function, its
        characteristic or its waveform; a block of your own says it by the property ``drawn_inside``.

        Parameters
        ----------
        path : path, optional
            File to write: ``.svg`` or ``.html``; ``.png`` and ``.pdf`` with the extra ``pdf``.
        subsystem : str
            Path of the subsystem whose inside is drawn; the whole diagram without it.
        closed : bool or list of str, optional
            Subsystems that are drawn closed: all of them, or those of the list. Without it all are open, in a diagram
            of more than 40 blocks closed.
        width : float
            Width in pixels that the drawing should have; by default that of a notebook.
        run : Run, optional
            A run, whose signals are shown where a wire is clicked.

        Returns
        -------
        Drawing
            A notebook shows it: subsystems open and close at a click, a block says its parameters and its equation,
            a wire its name, unit and signal. ``.svg`` is the drawing, ``.html`` the part of a page.

        Raises
        ------
        OptionError
            No such subsystem, a file of another ending, a folder that isn't there, or an extra that isn't installed.
        """
        from .drawing import draw

        facts = self.drawn_facts(run)
        drawing = draw(self.structure, self.name, facts, subsystem=subsystem, closed=closed, width=width)
        if path is not None:
            drawing.save(path)
        return drawing

    def to_html(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        inputs: Mapping[str, tuple[float, float] | None] | Iterable[str] | None = None,
        sliders: Mapping[str, tuple[float, float] | None] | Iterable[str] | None = None,
        plots: Sequence[str | Sequence[str]] | None = None,
        step: float | None = None,
        solver: str = "auto",
        speed: float = 1.0,
        span: float = 10.0,
        title: str | None = None,
    ) -> WebPage:
        """Return the diagram as a page on which it runs in a browser: one file, no server, no network.

        The diagram and the FMUs in it that Loopwright has built are compiled to WebAssembly. They run at the pace of
        the clock, with plots that scroll, sliders, pause, single steps, reset, and the record as CSV. See
        docs/howto/web_page.md.

        Parameters
        ----------
        path : path, optional
            File to write, ``.html``.
        inputs, sliders : mapping of str to (float, float), or list of str, optional
            What is moved by hand, by names as `replace` takes them, with the range of each, or None for one around its
            value: first sources (the name of a `Constant`, or of the wire that comes out of it, is its value), then
            parameters, those of FMUs that are tunable, too. Without ``inputs`` these are the constants of the diagram.
        plots : list of str or of lists of str, optional
            Signals, each in a plot; those of a list in one. Without it the named wires, by their units.
        step : float, optional
            Seconds between two samples, where no subsystem has a sample time.
        solver : str
            Method of continuous states: "RK45", which "auto" is, or "Radau" for stiff ones, or another one that C has.
        speed : float
            Simulated seconds in a second of the clock, at first.
        span : float
            Seconds that plots show, at first.
        title : str, optional
            Title of the page; the diagram's name without one.

        Returns
        -------
        WebPage
            A notebook shows it; ``save`` writes it.

        Raises
        ------
        DefinitionError
            For an FMU of others, or a function that Python evaluates, by its path, before anything is compiled.
        UnknownNameError, OptionError
            A name that nothing has; a parameter that can't be moved while it runs; a range that doesn't fit.
        CompilerError
            If there is no compiler that builds WebAssembly (the extra ``build``), or it fails.
        """
        from .web_page import make_page

        return make_page(
            self.wired,
            self.drawn_facts(),
            path,
            inputs=inputs,
            sliders=sliders,
            plots=plots,
            step=step,
            solver=solver,
            speed=speed,
            span=span,
            title=title,
        )

    def drawn_facts(self, run: Run | None = None) -> Facts:
        """Return what a drawing says of signals: shapes, units, and the signals of a run."""
        from .drawing import Facts, RecordedSignal

        checked = self.wired.checked
        found: dict[tuple[str, str], RecordedSignal] = {}
        if run is not None:
            names = {port: ".".join(port) for port in checked.shapes}
            found = {port: RecordedSignal(run.t, run[name]) for port, name in names.items() if name in run}
        return Facts(checked.shapes, checked.units, found)

    def _repr_svg_(self) -> str:
        return self.draw().svg

    def _repr_html_(self) -> str:
        return self.draw().html

"""The diagram: blocks and wires as one value, with all that is done with it.

What describes and runs a diagram is imported with it; a method that linearizes, measures, draws or reports imports its
sub-package when it is first called, so that a run does not pay for it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from .results import OperatingPoint
from .varied_diagram import VariedDiagram

if TYPE_CHECKING:
    from .contact import Contact
    from .drawing import Drawing
    from .linearization import Linearization
    from .measure import FrequencyResponse
    from .report import Report


class Diagram(VariedDiagram):
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
            return point_from_states(self, t, states, options)
        return run_to(self, t, options)

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

        return trim(self, free, targets, rates=rates, fixed=fixed, at=at, tolerance=tolerance, **options)

    def linearize(
        self,
        point: Any = None,
        *,
        inputs: str | Iterable[str] = (),
        outputs: str | Iterable[str] = (),
        openings: str | Iterable[str] = (),
        plants: str | None = None,
        stairs: str | None = None,
        **options: Any,
    ) -> Linearization:
        """Return the linear model of this very diagram at an operating point.

        It is continuous where everything is continuous. With sampled subsystems it is discrete, over one base period
        or, with several rates, their least common one; hold, delay and the time between ticks are exact. Its
        ``findings`` say what it does not follow, such as stairs and kinks; loops and their numbers carry them.

        Parameters
        ----------
        point : OperatingPoint, Snapshot or float, optional
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
        stairs : {"gain"}, optional
            "gain" takes stairs, as of quantizers and encoders, as their mean slope, not as zero. A relay has none.
        **options
            Options of the run to a time, as of `operating_point`. With ``step`` a diagram that is continuous but for an
            FMU is linearized over its communication step.

        Returns
        -------
        Linearization
            With `Linearization.system`, a `control.StateSpace` with names, and the loops: ``.loop("v_perp")``.

        Raises
        ------
        UnknownNameError, WiringError, FmuError
            A signal that isn't there; an opening at which nothing is wired, or a transport delay in continuous time; an
            FMU that can't be linearized: the error says what it lacks.
        """
        from .linearization import linearize

        options = {"plants": plants, "stairs": stairs, **options}
        return linearize(self, point, inputs=inputs, outputs=outputs, openings=openings, **options)

    def linearize_batch(
        self, points: Iterable[Any] = (None,), variants: Iterable[Mapping[str, Any]] = ({},), **options: Any
    ) -> list[Linearization]:
        """Return the linear models at several operating points and with several parameters.

        Parameters
        ----------
        points : iterable
            As `linearize` takes them. Each variant runs to a time or an instant anew; an `OperatingPoint` is taken.
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

        return linearize_batch(self, points, variants, **options)

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

        return make_contact(self, PortNames(port, position, velocity, force), direction, at, options)

    def report(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        pdf: bool = False,
        json: bool = False,
        paper: str = "A4",
        **options: Any,
    ) -> Report:
        """Analyse the diagram for design, and write the report; see docs/reports.md.

        Parameters
        ----------
        path : path, optional
            File to write, ``.html``; without it nothing is written. A notebook shows the report.
        pdf, json : bool
            Write ``.pdf`` (which needs ``pip install 'loopwright[pdf]'``) and ``.json`` beside it, too.
        paper : {"A4", "letter"}
            Paper of the PDF. ``options`` are those of `analyse`, such as ``requirements``, ``at`` and ``loops``.

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

        check_files(path, pdf=pdf, json=json, paper=paper)
        made = with_drawing(analyse(self, _written=path is not None, **options), self)
        write_report(made, path, pdf=pdf, json=json, paper=paper)
        return made

    def draw(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        subsystem: str = "",
        closed: bool | Iterable[str] | None = None,
    ) -> Drawing:
        """Draw the diagram itself: blocks, subsystems with their rates, wires with their names, FMUs marked.

        Signals run from left to right; feedback runs back below. Nothing but Python is needed.

        Parameters
        ----------
        path : path, optional
            File to write, ``.svg``.
        subsystem : str
            Path of the subsystem whose inside is drawn; the whole diagram without it.
        closed : bool or list of str, optional
            Subsystems that are drawn closed: all of them, or those of the list. Without it all are open, in a diagram
            of more than 40 blocks closed.

        Returns
        -------
        Drawing
            A notebook shows it; ``.svg`` is its text.

        Raises
        ------
        OptionError
            No such subsystem, a file that is no ``.svg``, or a folder that isn't there.
        """
        from .drawing import Drawing, draw

        drawing = Drawing(draw(self, subsystem=subsystem, closed=closed))
        if path is not None:
            drawing.save(path)
        return drawing

    def _repr_svg_(self) -> str:
        return str(self.draw().svg)

    def frequency_response(
        self,
        wire: str,
        frequencies: Any,
        *,
        amplitude: float,
        kind: str = "sine",
        at: Any = 0.0,
        outputs: str | Iterable[str] = (),
        windows: int = 40,
        agreement: float = 1e-6,
        confirm: bool = True,
        **options: Any,
    ) -> FrequencyResponse:
        """Measure a frequency response on the running diagram: a test signal d is added at a wire.

        With v the output of the wire's port and u = v + d the signal that all its consumers get, S = u/d, T = −v/d and
        L = −v/u, as of `Linearization`. They are sampled where the linear model is; see docs/frequency.md.

        The signal is ramped in; then windows of whole periods follow until two agree. Let the references stand still.

        Parameters
        ----------
        wire : str
            A wire or port, or an entry of it, ``"motor_force[1]"``. Of one with several entries, each is excited in a
            run of its own, and the responses are matrices.
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
        windows : int
            Most windows that are waited for.
        agreement : float
            Relative difference of two windows at which a frequency is done. One at which noise keeps the windows from
            agreeing is done, too, with the uncertainty of their mean.
        confirm : bool
            Whether to measure a second time, with half the amplitude and smaller tolerances, for the uncertainty.
        **options
            Of the run, as in `operating_point`. A continuous diagram is run with rtol = 1e-9, atol = 1e-12, and sampled
            16 times in a period of the highest frequency, if nothing else is said.

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
            self, wire, frequencies, amplitude=amplitude, kind=kind, at=at, outputs=outputs, windows=windows,
            agreement=agreement, confirm=confirm, **options,
        )  # fmt: skip

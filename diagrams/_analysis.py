"""What a diagram is analysed with: operating points and linear models, as methods of `Diagram`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ._linearize import Linearization
    from ._operating_point import OperatingPoint


class Analysis:
    """The methods of `Diagram` that analyse it."""

    def operating_point(self: Any, t: float = 0.0, **options: Any) -> OperatingPoint:
        """Run to a time, and return everything that a linear model at that instant depends on.

        Parameters
        ----------
        t : float
            Time in s, a tick.
        **options
            How to run: ``step``, ``solver``, ``rtol``, ``atol``, ``max_step`` and ``start`` of `simulate`.
        """
        from ._operating_point import at_time

        return at_time(self, t, options)

    def linearize(
        self: Any,
        point: Any = None,
        *,
        inputs: str | Iterable[str] = (),
        outputs: str | Iterable[str] = (),
        openings: str | Iterable[str] = (),
        plants: str | None = None,
        **options: Any,
    ) -> Linearization:
        """Return the linear model of this very diagram at an operating point.

        It is continuous where everything is continuous. With sampled subsystems it is discrete, over one base period
        or, with several rates, their least common one; hold, delay and the time between ticks are exact. What it does
        not follow, such as a quantizer or an event within the period, is said in its ``notes``.

        Parameters
        ----------
        point : OperatingPoint, Snapshot or float, optional
            Where: ``run.at(t)``, a time in s, `operating_point`, `trim`; the start without it.
        inputs : str or list of str
            Wires or ports at which a signal is injected: added to what the consumers get; over a period it is held.
        outputs : str or list of str
            Wires or ports that are measured: what the block puts out, ahead of an injection there.
        openings : str or list of str
            Wires that are cut behind the port, for all its consumers, which get its value at the operating point: that
            stays what it is.
        plants : {"equations", "step"}, optional
            How an FMU's step is linearized: by its equations' Jacobian and a matrix exponential, right at an
            equilibrium, or by differences of the step itself. Without it the first at an equilibrium, else the second.
        **options
            How to run to the operating point, where it is a time: see `operating_point`. With ``step`` a diagram that
            is continuous but for an FMU is linearized over its communication step.

        Returns
        -------
        Linearization
            With `Linearization.system`, a `control.StateSpace` with names, and the loops: ``.loop("v_perp")``.

        Raises
        ------
        UnknownNameError
            A signal that isn't there.
        WiringError
            An opening at which nothing is wired, or a transport delay in continuous time.
        FmuError
            An FMU that can't be linearized; the error says what it lacks.
        """
        from ._linearize import linearize

        return linearize(self, point, inputs=inputs, outputs=outputs, openings=openings, plants=plants, **options)

    def linearize_batch(
        self: Any,
        points: Iterable[Any] = (None,),
        variants: Iterable[Mapping[str, Any]] = ({},),
        **options: Any,
    ) -> list[Linearization]:
        """Return the linear models at several operating points and with several parameters.

        Parameters
        ----------
        points : iterable
            Operating points, as `linearize` takes them. A time, or an instant of a run, is run to with each variant
            anew; an `OperatingPoint` is taken as it is, with the variant's parameters.
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
        from ._linearize import batch

        return batch(self, points, variants, **options)

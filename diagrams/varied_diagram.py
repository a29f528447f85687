"""A diagram whose parameters are varied: sweeps of runs, sensitivities and worst cases.

Each method imports what it needs when it is called, so that a run does not pay for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Unpack

from .results import Run
from .simulation import KeptKeywords, SimulatedDiagram

if TYPE_CHECKING:
    from .requirements import Requirements
    from .studies import Sensitivities, WorstCase
    from .sweeps import Sweep


class VariedDiagram(SimulatedDiagram):
    """A diagram with the studies that vary its parameters; `Diagram` is one with all the rest."""

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
        progress: bool | None = None,
        lanes: bool | int = False,
        **options: Unpack[KeptKeywords],
    ) -> Sweep:
        """Run the diagram with many values of its parameters, on every core; see docs/sweeps.md.

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
            Seed of the sweep; each sample has one of its own, which depends on this one and its place alone.
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
        progress : bool, optional
            Show a progress bar; see `simulate`.
        lanes : bool or {2, 4, 8, 16}, optional
            Make so many runs side by side in the lanes of the processor's vectors, 8 for True: some times as fast.
            Their values then differ from those of single runs by rounding, and the sweep's messages say so. A motion
            that magnifies small differences (a limit cycle, sticking) magnifies these, too; see docs/sweeps.md.
            Every FMU must have been built by Loopwright on this machine, with steps of fixed length and without events;
            runs that can't go so are made one after the other, which is told.
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
            self, parameters, duration, samples=samples, count=count, seed=seed, seeds=seeds, signals=signals,
            reduce=reduce, to=to, overwrite=overwrite, workers=workers, client=client, progress=progress,
            lanes=lanes, options=options,
        )  # fmt: skip

    def sensitivity(
        self,
        loop: str | Iterable[str],
        parameters: str | Iterable[str] | None = None,
        *,
        at: Any = None,
        delay: int = 0,
        skew: float = 0.0,
        **options: Any,
    ) -> Sensitivities:
        """Return the derivatives of a loop's margins by parameters of the diagram; see docs/worst_case.md.

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
        at : OperatingPoint, Snapshot, float or callable, optional
            Point, as in `linearize`. An equilibrium follows the parameter; a point that is not at rest keeps its
            states. A function from a diagram to a point, ``lambda d: d.trim(…)``, is asked anew for changed parameters.
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

        return find_sensitivities(self, loop, parameters, at=at, delay=delay, skew=skew, **options)

    def worst_case(
        self,
        parameters: Mapping[str, Any] | None,
        loop: str | Iterable[str] | None = None,
        *,
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
        progress: Callable[[str], None] | None = None,
        **options: Any,
    ) -> WorstCase:
        """Find the worst case of a loop's margin, or of requirements, over ranges of parameters.

        Samples of the ranges come first, then all corners (of up to 5 numbers), then searches downhill from the worst
        of them, along the exact derivatives of the margins. A case that can't be analysed counts as the worst and
        tells its reason; then come unstable loops, by their growth.

        Parameters
        ----------
        parameters : mapping of str to (low, high) or Box
            Ranges by path; values of each for a grid; None where ``samples`` is a table.
        loop : str or list of str
            Wire that the loop is cut at; with requirements several wires, each a loop of its own. Without them several
            wires are one loop, cut at all at once, with a disk margin. Requirements need none where they name loops.
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
            Point of each case, as of `sensitivity`; ``points`` is a list of them, each of which every case is tried at.
        delay : int
            Whole samples of delay in series with sampled loops.
        progress : callable, optional
            Told a line for every case. ``options`` are those of `linearize`.

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
        from .studies import find_worst_case

        return find_worst_case(
            self, parameters, loop, quantity=quantity, requirements=requirements, contact=contact, samples=samples,
            count=count, seed=seed, starts=starts, steps=steps, at=at, points=points, delay=delay, progress=progress,
            **options,
        )  # fmt: skip

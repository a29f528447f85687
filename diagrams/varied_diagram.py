"""A diagram whose parameters are varied: sweeps of runs.

Each method imports what it needs when it is called, so that a run does not pay for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Unpack

from .results import Run
from .simulation import KeptKeywords, SimulatedDiagram

if TYPE_CHECKING:
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
        **options: Unpack[KeptKeywords],
    ) -> Sweep:
        """Run the diagram with many values of its parameters, on every core; see docs/sweeps.md.

        Each run is, to the last bit, that of ``diagram.replace(parameters).simulate(duration)``, whoever makes it, and
        however many workers there are. A run that fails is kept as data, and harms no other.

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
            Parameters that take the sample's seed, such as ``"noise.seed"``.
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
        **options
            Options of each run, as for `simulate`; ``compile=True`` is the default.

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
            options=options,
        )  # fmt: skip

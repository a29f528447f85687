"""A diagram that can be run, at once or step by step."""

from __future__ import annotations

from fractions import Fraction
from typing import Unpack

from ..coupling import Coupling, CouplingReport, report_coupling, to_coupling
from ..flat import WiredDiagram
from ..results import Run
from .run_options import RunKeywords, RunOptions
from .simulation import Simulation, simulate


class SimulatedDiagram(WiredDiagram):
    """A wired diagram with its runs; `Diagram` is one with all the rest."""

    def simulate(self, duration: float, *, progress: bool | None = None, **options: Unpack[RunKeywords]) -> Run:
        """Run the diagram and return what it recorded: from t = 0, or from a saved state.

        The page docs/architecture.md says what happens in which order.

        Parameters
        ----------
        duration : float
            Simulated time in s. One that is no multiple of the step between ticks ends with a sample between two of
            them; such a run has no ``final_state``.
        progress : bool, optional
            Show a progress bar; by default on a terminal, and in a notebook where ipywidgets is installed.
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
            `PathDomainError`, `GuardError`, `NonFiniteError` or `FmuRuntimeError`, a solver that can't go on, events
            that pile up, an algebraic loop without a solution; ``error.run`` holds what was recorded until then.
        OptionError
            A duration that is not positive, or no multiple of the step; an unknown option or solver, a tolerance out of
            range.
        """
        return simulate(self, duration, RunOptions.of(options, block=self.name), progress=progress)

    def report_coupling(
        self, coupling: str | Coupling = "jacobi", *, step: float | Fraction | None = None
    ) -> CouplingReport:
        """List the delay of every connection from and to an FMU; see docs/coupling.md.

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
        return report_coupling(self.flatten(step), to_coupling(coupling, block=self.name))

    def simulation(self, **options: Unpack[RunKeywords]) -> Simulation:
        """Return a run in the making, to go on step by step, to save and to restore; see `Simulation`.

        Parameters
        ----------
        **options
            As for `simulate`; see `RunOptions`.

        Raises
        ------
        OptionError
            An unknown option or solver, a tolerance out of range.
        """
        return Simulation(self, RunOptions.of(options, block=self.name))

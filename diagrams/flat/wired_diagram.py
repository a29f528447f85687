"""A wired diagram that gives its functions."""

from __future__ import annotations

from fractions import Fraction

from ..wiring import CheckedDiagram, Structure, exact_time
from .flat_diagram import FlatDiagram
from .flatten import flatten


class WiredDiagram(CheckedDiagram):
    """A wired diagram with its functions, each made once: the diagram that runs, and that linear models are made of."""

    _flat: dict[Fraction | None, FlatDiagram]

    def _set(self, name: str, table: Structure, loops: str) -> None:
        super()._set(name, table, loops)
        self.__dict__["_flat"] = {}

    def flatten(self, step: float | Fraction | None = None) -> FlatDiagram:
        """Return the diagram as one CasADi function of a tick.

        Parameters
        ----------
        step : float or Fraction, optional
            Seconds between two ticks, where no subsystem has a sample time (or to look between samples).
        """
        return self.flattened(None if step is None else exact_time(step, block=self.name))

    def flattened(self, key: Fraction | None) -> FlatDiagram:
        """Return the same for a step that is exact already; None takes that of the clocks."""
        if key not in self._flat:
            solve = self.loops == "solve"
            self._flat[key] = flatten(self.scheduled, self.checked, key, name=self.name, solve=solve)
        return self._flat[key]

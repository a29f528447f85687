"""Methods by which the derivatives of a linear model are computed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum


class DerivativeMethod(Enum):
    """Method for the derivatives of an FMU or a block."""

    DIRECTIONAL = "directional derivatives"
    """Computed by the FMU: exact, if differences of its own values say so, too."""
    DIFFERENCES = "differences"
    """Differences of the FMU's equations at the point."""
    STEP_DIFFERENCES = "differences of steps"
    """Differences of a communication step, with the FMU's own solver."""
    IDENTIFIED = "identified from pulse responses"
    """Fit of a model to responses from rest, without the FMU's states."""
    BLOCK_DIFFERENCES = "differences of the block"
    """Differences of the function of an opaque block."""
    TRACED = "the traced Jacobian"
    """Algorithmic differentiation of a block's trace: exact."""


@dataclass(frozen=True)
class Derivation:
    """Method by which derivatives were computed, with details; ``str(…)`` is its text.

    Attributes
    ----------
    method : DerivativeMethod
        The method.
    interface : str
        FMI's interface in use, ``"model_exchange"`` or ``"co_simulation"``; empty if the method has only one.
    held : bool
        Whether a step was computed from the equations, by a matrix exponential with held inputs.
    order : int, optional
        Number of states of an identified model.
    restarted : bool
        Whether the FMU was started again for each difference, as it does not restore the states that it saves.
    gap : float
        Largest distance of the FMU's directional derivatives from differences of its own values, relative to their
        size; 0 where they agree, NaN where they could not be compared.
    refuted : bool
        Whether that gap is so large that differences replace the derivatives that are wrong.
    coarseness : float
        Largest error of a derivative by differences, relative to the largest change of its row, where the FMU's values
        move in steps, are coarsely rounded, or have a kink; 0 where they tell their slopes well.

    Examples
    --------
    >>> str(Derivation(DerivativeMethod.DIRECTIONAL, "model_exchange"))
    'directional derivatives in model-exchange'
    """

    method: DerivativeMethod
    interface: str = ""
    held: bool = False
    order: int | None = None
    restarted: bool = False
    gap: float = 0.0
    refuted: bool = False
    coarseness: float = 0.0

    @property
    def is_exact(self) -> bool:
        """Whether the derivatives have no error but rounding, as far as is known."""
        return self.method in (DerivativeMethod.DIRECTIONAL, DerivativeMethod.TRACED) and self.gap == 0.0

    def __str__(self) -> str:
        text = self.method.value
        if self.interface:
            text += f" in {self.interface.replace('_', '-')}"
        if self.order is not None:
            text += f", order {self.order}"
        if self.held:
            text += ", held over a step by a matrix exponential"
        if self.refuted:
            text += f", as its directional derivatives are off by {self.gap:.2g} of their size"
        elif math.isnan(self.gap):
            text += ", which could not be compared with differences"
        elif self.gap:
            text += f", off by {self.gap:.2g} of their size"
        if self.coarseness:
            text += f", right to {self.coarseness:.2g} of the largest change alone, as the values are coarse"
        if self.restarted:
            text += ", each from a new start, as the FMU does not restore its state though it says so"
        return text

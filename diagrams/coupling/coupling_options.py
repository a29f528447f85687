"""Coupling of FMUs as one option of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from ...blocks.core import OptionError, accepts, explain_calls, kinds, near


class Scheme(StrEnum):
    """Scheme by which FMUs, and blocks in continuous time, exchange values in a communication step."""

    JACOBI = "jacobi"
    """All step at once, with the inputs of the step's beginning."""
    GAUSS_SEIDEL = "gauss_seidel"
    """One after the other; each takes the new outputs of those before it."""
    ITERATED = "iterated"
    """The step is repeated until outputs and inputs agree at its end; inputs are the mean of beginning and end."""


_POSITIVE = kinds.above_zero.where(math.isfinite)


@explain_calls
@accepts(
    tolerance=_POSITIVE,
    shortest=_POSITIVE,
    error=_POSITIVE,
    passes=kinds.integer(2).worded("a whole number from 2 on", "Give one."),
    order=kinds.one_of_class((list, tuple), "a list of paths of FMUs")
    .where(lambda order: all(isinstance(path, str) for path in order))
    .worded(step="Give one."),
)
@dataclass(frozen=True, kw_only=True)
class Coupling:
    """Exchange of values between FMUs in a run: ``simulate(…, coupling=Coupling(scheme="iterated"))``.

    The page docs/explanation/coupling.md says what each scheme costs, and which order it has.

    Attributes
    ----------
    scheme : {"jacobi", "gauss_seidel", "iterated"}
        Scheme of a communication step. "iterated" needs FMUs that can save their states.
    order : sequence of str
        For "gauss_seidel": paths of all FMUs in the order in which they step. Without it the order follows from
        feedthrough: an FMU that passes an input straight on steps after the FMU that makes it.
    tolerance : float
        For "iterated": largest change of an output between two passes, relative to its nominal value plus its size.
    passes : int
        For "iterated": most passes over a step.
    error : float, optional
        Largest estimated error of a communication step, relative to an output's nominal value plus its size. With it,
        communication steps are as short as this needs, and as long as the ticks allow. All FMUs must be able to save
        their states and to take steps of any length.
    shortest : float
        With ``error``: shortest communication step in s.
    """

    scheme: str = "jacobi"
    order: Sequence[str] = ()
    tolerance: float = 1e-9
    passes: int = 50
    error: float | None = None
    shortest: float = 1e-9

    def __post_init__(self) -> None:
        known = [scheme.value for scheme in Scheme]
        if not isinstance(self.scheme, str) or self.scheme not in known:
            raise OptionError(f"found scheme={self.scheme!r}. {near(str(self.scheme), known)}", port="coupling")
        if self.order and self.scheme != Scheme.GAUSS_SEIDEL:
            raise OptionError(
                f"found an order with scheme={self.scheme!r}, which has none; expected scheme='gauss_seidel'.",
                port="coupling",
            )
        object.__setattr__(self, "order", tuple(self.order))

    def __str__(self) -> str:
        return self.scheme if self.error is None else f"{self.scheme} with error={self.error:g}"

    @property
    def is_plain(self) -> bool:
        """Whether all FMUs step at once, from tick to tick: the default."""
        return self.scheme == Scheme.JACOBI and self.error is None

    @property
    def convergence_order(self) -> int:
        """Order of the scheme: by halving the step, the error shrinks by 2 to this power."""
        return 2 if self.scheme == Scheme.ITERATED else 1


def refuse_model_exchange(coupling: Coupling, blocks: Mapping[str, Any]) -> None:
    """Refuse a scheme that goes back over a step where a model-exchange FMU can't.

    ``blocks``: the FMUs that are evaluated by the solver, by path.
    """
    if coupling.scheme != Scheme.ITERATED and coupling.error is None:
        return
    for path, block in blocks.items():
        # Those of an FMU; a user's block, which may have a description of another kind, serializes or says why not.
        interface = getattr(getattr(block, "description", None), "exchange", None)
        if interface is not None and not interface.can_serialize:
            raise OptionError(
                f"found coupling {str(coupling)!r}, which goes back to the beginning of a step; expected a "
                "model-exchange FMU that can turn its state into bytes (canSerializeFMUState of its description is "
                "false). Take coupling='gauss_seidel' or 'jacobi', or the FMU's co-simulation.",
                block=path,
                port="coupling",
            )


def to_coupling(value: Any, *, block: str) -> Coupling:
    """Return the coupling of a run from its option: a `Coupling`, or the name of a scheme."""
    if isinstance(value, Coupling):
        return value
    if isinstance(value, str):
        try:
            return Coupling(scheme=value)
        except OptionError as error:
            raise error.at(block=block) from None
    raise OptionError(
        f"found {value!r}; expected 'jacobi', 'gauss_seidel', 'iterated' or a Coupling(…).",
        block=block,
        port="coupling",
    )

"""Parameters of values: their declaration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from .arguments import Kind
from .explained_calls import explain_calls
from .units import parse_unit

if TYPE_CHECKING:
    Array: TypeAlias = Any
else:

    class Array:
        """A number or a NumPy array of floats; inside an equation that is being traced, its symbolic stand-in.

        Used in annotations only: ``mass: Array = parameter(…)``. Type checkers take it for ``Any``.
        """


MISSING: Any = object()
"""Default of a parameter that is required."""


@dataclass(frozen=True)
class ParameterSpec:
    """Declaration of one parameter, made by `parameter`."""

    default: Any = MISSING
    unit: str | None = None
    description: str = ""
    above: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    shape: tuple[int, ...] | None = None
    structural: bool = False
    kw_only: bool = True
    tunable: bool = True
    kind: Kind | None = None
    annotation: str = "Any"

    @property
    def required(self) -> bool:
        """Whether the constructor needs a value for it."""
        return self.default is MISSING


@explain_calls
def parameter(
    *,
    default: Any = MISSING,
    unit: str | None = None,
    description: str = "",
    above: float | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    shape: tuple[int, ...] | None = None,
    structural: bool = False,
    kw_only: bool = True,
    tunable: bool = True,
    kind: Kind | None = None,
) -> Any:
    """Declare a parameter of a value: ``mass: float = parameter(unit="kg", above=0.0)``.

    Parameters
    ----------
    default : object, optional
        The default; without one the parameter is required.
    unit : str, optional
        Unit, as FMI spells it (``"N.s/m"``).
    description : str, optional
        One line for people.
    above, minimum, maximum : float, optional
        Bounds of every entry: strictly above, at least, at most.
    shape : tuple of int, optional
        Shape that a numeric value is broadcast to.
    structural : bool, optional
        True when the equations branch on the value in Python; it is then a constant of the trace and not a symbol.
        Values other than floats are always structural.
    kw_only : bool, optional
        False for the one object that defines the value and may come first, by position.
    tunable : bool, optional
        False when an FMU made from it must not change the value during a run (FMI's variability "fixed").
    kind : Kind, optional
        Further condition on the value, in its stored form, with its words: ``kinds.choice("linear", "previous")``.

    Raises
    ------
    UnitError
        For a unit that can't be read.
    """
    if unit is not None:
        parse_unit(unit)
    return ParameterSpec(default, unit, description, above, minimum, maximum, shape, structural, kw_only, tunable, kind)

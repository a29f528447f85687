"""Numbers of a worst case that are no loop's margins: a contact's limit of stability, and functions of a user's own.

They have no derivative from the linear model: a search takes differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError, near
from ..contact import Contact, ContactLimit, PortNames, make_contact
from ..flat import WiredDiagram
from ..frequency import Number
from .confirmed_cases import GROWTH_AGREEMENT, ConfirmationKind, RunConfirmation

OF_CONTACT = (*PortNames._fields, "direction")
"""Arguments of `Diagram.contact`."""
OF_LIMIT = ("vary", "low", "high", "per_decade", "stiffness", "damping", "mass", "tool_mass")
"""Arguments of `Contact.stability_limit`."""


class ContactMeasure:
    """Limit of coupled stability of a contact.

    ``given`` are arguments of `Diagram.contact` and of `Contact.stability_limit` together, ``options`` those of the
    run, and ``stairs``.
    """

    def __init__(self, given: Mapping[str, Any], diagram: WiredDiagram, options: Mapping[str, Any]):
        if not isinstance(given, Mapping):
            raise OptionError(
                f"found {given!r}; expected arguments of a contact and its limit, such as {{'vary': 'stiffness', "
                "'damping': 10.0}. Give a mapping.",
                block=diagram.name,
                port="contact",
            )
        for key in given:
            if key not in OF_CONTACT and key not in OF_LIMIT:
                hint = near(str(key), [*OF_CONTACT, *OF_LIMIT])
                raise OptionError(f"a contact's limit has no {key!r}. {hint}", block=diagram.name, port="contact")
        self._names, self._direction = PortNames.of(given), given.get("direction", "perp")
        self._limit = {key: given[key] for key in OF_LIMIT if key in given}
        self._options = dict(options)
        self.place = str(diagram.contact_port if self._names.port is None else self._names.port)
        self.name = f"{self._limit.get('vary', 'stiffness')}_limit"

    def _find(self, diagram: WiredDiagram, at: Any) -> tuple[Contact, ContactLimit]:
        contact = make_contact(diagram, self._names, self._direction, at, self._options)
        return contact, contact.stability_limit(**self._limit)

    def __call__(self, diagram: WiredDiagram, at: Any) -> Number:
        """Return the limit; 0 where the coupled loop is unstable at the start of the scan."""
        limit = self._find(diagram, at)[1]
        return Number(limit.value, limit.unit, limit.tolerance, limit.confirmed_by, findings=limit.findings)

    def confirm(self, diagram: WiredDiagram, at: Any) -> RunConfirmation:
        """Return the confirmation by runs at 0.97 and 1.03 of the limit, with the environment at the plant."""
        contact, limit = self._find(diagram, at)
        made = contact.confirm(limit)
        agrees = made.below.measured < 0.0 < made.above.measured and all(
            abs(trial.measured - trial.predicted) <= max(made.within, GROWTH_AGREEMENT * abs(trial.predicted))
            for trial in made.trials
        )
        above = made.above
        return RunConfirmation(
            ConfirmationKind.CONTACT, self.place, limit.frequency, above.predicted, above.measured, agrees
        )


class FunctionMeasure:
    """A function of a user's own, from a diagram to a number."""

    def __init__(self, function: Callable[[Any], Any], diagram: str):
        self._function, self.place = function, diagram
        name = getattr(function, "__name__", "")
        self.name = name if name.isidentifier() else "value"

    def __call__(self, diagram: WiredDiagram, at: Any) -> Number:
        """Return the function's value."""
        try:
            found = self._function(diagram.facade)
        except LoopwrightError:
            raise
        except Exception as error:
            raise OptionError(
                f"{self.name}() fails: {type(error).__name__}: {error}. Mend the function.", block=self.place
            ) from error
        if isinstance(found, Number):
            return found
        value = np.asarray(found)
        if value.ndim or value.dtype.kind not in "iuf" or math.isnan(float(value)):
            raise OptionError(
                f"{self.name}() gives {found!r}; expected one number, the smaller, the worse. Give a float.",
                block=self.place,
            )
        return Number(float(value), "1", math.nan, "")

    def confirm(self, diagram: WiredDiagram, at: Any) -> RunConfirmation:
        """Refuse: nothing is known about a run that shows the number."""
        raise OptionError(
            f"found {self.name!r}, a function of your own; expected a margin or a contact's limit, which a run can "
            "show. Simulate found.diagram.",
            block=self.place,
        )


Measure = ContactMeasure | FunctionMeasure
"""A number of a diagram at an operating point: the smaller, the worse."""

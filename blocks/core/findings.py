"""Findings: facts that limit a number, which go with it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from .explained_calls import explain_calls


@explain_calls
@dataclass(frozen=True)
class Finding:
    """A fact that limits a result; subclasses are its kinds, with the facts as fields and the text as ``str(…)``.

    Attributes
    ----------
    limits_numbers : bool
        Whether numbers that are made from the result may be wrong because of it. Only such findings are passed on
        to numbers.
    """

    limits_numbers: ClassVar[bool] = True

    @property
    def puts_in_doubt(self) -> bool:
        """Whether a number that is made from the result, and lies within its limits, doesn't meet a requirement."""
        return True

    @property
    def remedy(self) -> str:
        """What to do where the result says nothing because of it, with the argument; "" where nothing is known."""
        return ""

    @property
    def leaves_error_unknown(self) -> bool:
        """Whether the error of numbers that are made from the result is not known: their tolerance is NaN."""
        return False

    def as_dict(self) -> dict[str, Any]:
        """Return the kind, the fields and the text by name, as in a report's JSON."""
        return {"kind": type(self).__name__, **asdict(self), "text": str(self)}

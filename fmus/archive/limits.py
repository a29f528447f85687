"""Limits of the size of an FMU's archive and description."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from ...blocks.core import OptionError, explain_calls


@explain_calls
@dataclass(frozen=True)
class ArchiveLimits:
    """Limits up to which an FMU is read and unpacked; beyond them it is refused before anything is written.

    Parameters
    ----------
    size : float
        Bytes of all files, unpacked.
    entries : int
        Number of files and folders.
    ratio : float
        Unpacked size over packed size, of archives that unpack to more than 100 MB. Text and zeros are packed up to
        1000 times smaller, libraries about three times.
    description : int
        Bytes of ``modelDescription.xml`` and of ``sources/buildDescription.xml``, each.
    elements : int
        Number of elements of one variable, by its dimensions' start values.

    Raises
    ------
    OptionError
        If a limit is not positive.

    Examples
    --------
    >>> ArchiveLimits(size=20 * 10**9).entries
    100000
    """

    size: float = 8e9
    entries: int = 100_000
    ratio: float = 100.0
    description: int = 10**9
    elements: int = 10**7

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not (number and value > 0 and not math.isnan(value)):
                raise OptionError(f"found {value!r}; expected a positive number.", port=f"limits.{field.name}")

"""Limits of the size of an FMU's archive and description."""

from __future__ import annotations

from dataclasses import dataclass

from ...blocks.core import accepts, explain_calls, kinds


@explain_calls
@accepts(
    "limits",
    size=kinds.above_zero,
    entries=kinds.above_zero,
    ratio=kinds.above_zero,
    description=kinds.above_zero,
    elements=kinds.above_zero,
)
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

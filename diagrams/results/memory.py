"""Room for the samples of a run, in memory or on disk."""

from __future__ import annotations

import os
import shutil
from fractions import Fraction
from pathlib import Path

from ...blocks.core import OptionError, explain_disk_errors


def machine_memory() -> int:
    """Return the bytes of memory of this machine."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not on Windows
        return 16 * 2**30


def check_memory(
    samples: int, width: int, base: Fraction, name: str, *, every: int = 1, to: str | os.PathLike[str] | None = None
) -> None:
    """Refuse a run whose samples can't fit, before it takes the machine down.

    There is one sample more than ticks of ``base`` seconds; ``width`` numbers of one sample in ``every`` are recorded,
    in memory, or on disk at ``to``.
    """
    needed = -(-samples // every) * 8 * (width + 1)
    if to is None:
        there, most, place = machine_memory(), 0.8 * machine_memory(), "this machine has"
        remedy = "record less with record=[…] or every=…, or stream to disk with to=path"
    else:
        there = most = free_on_disk(Path(to))
        place, remedy = "the disk has free", "record less with record=[…] or every=…, or choose another disk"
    if needed > most:
        kept = f"{width} numbers each" if every == 1 else f"{width} numbers of each {every}th"
        raise OptionError(
            f"found {samples - 1} ticks of {float(base):g} s; {kept} need {needed / 2**30:.0f} GiB, "
            f"and {place} {there / 2**30:.0f}. Is the duration in s? Take a shorter one or a larger step, {remedy}.",
            block=name,
            port="duration",
        )


def free_on_disk(path: Path) -> int:
    """Return the bytes that are free where a path is to be created."""
    with explain_disk_errors(f"the run can't be kept in {str(path)!r}", path, "Choose another path.", OptionError):
        path = path.absolute()
        return shutil.disk_usage(next(p for p in (path, *path.parents) if p.exists())).free

"""The way to every instance of an FMU: in its own process, or in this one."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ..archive import FmuDescription
from ..calls import FmiCalls, FmuBlock, LoadedFmu
from ..platform import is_built_here
from .pool import take
from .process_limits import Isolation, default_memory
from .remote_calls import make_remote_calls

L = TypeVar("L", bound=LoadedFmu)
_EACH = 256  # bytes of shared memory for an element of a variable; only those that are used take memory


def open_fmu(kind: type[L], block: FmuBlock, *arguments: Any, **options: Any) -> L:
    """Load an FMU, and make an instance of a class: `LoadedFmu`, or one of it. All that loads an FMU comes here.

    An FMU that Loopwright has not built is loaded in its own process, unless its block says otherwise.
    """
    limits = find_limits(block)
    if limits is None:
        return kind(block, *arguments, **options)
    return kind(block, *arguments, make_calls=partial(_make, block.description, limits), **options)


def find_limits(block: FmuBlock) -> Isolation | None:
    """Return the limits of the process in which an FMU is loaded; None for this process."""
    given = block.isolate
    if given is None:
        given = not is_built_here(block.description.digest)
    if isinstance(given, Isolation):
        return given
    return Isolation() if given else None


def _make(description: FmuDescription, limits: Isolation, *, folder: Path, **arguments: Any) -> FmiCalls:
    memory = default_memory() if limits.memory is None else limits.memory
    key = (description.digest, int(memory), int(limits.output), not description.only_once)
    n = sum(v.size + len(v.references) for v in description.variables.values())
    size = ((16 << 20) + n * _EACH + 4095) // 4096 * 4096
    process = take(key, description.file.name, folder, size)
    return make_remote_calls(description.fmi[0], process, limits, folder=folder, **arguments)

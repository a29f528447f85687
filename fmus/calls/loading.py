"""Where the library of an FMU is loaded: in its own process, or in this one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..isolation import Isolation, default_memory, give_back, take
from .fmi1 import Fmi1Calls
from .fmi2 import Fmi2Calls
from .fmi3 import Fmi3Calls
from .fmi_calls import FmiCalls
from .fmu_setup import FmuSetup
from .remote_calls import RemoteCalls

_CALLS: dict[str, type[FmiCalls]] = {"1": Fmi1Calls, "2": Fmi2Calls, "3": Fmi3Calls}
"""Functions by the major version of FMI."""
_REMOTE = {version: type(f"Remote{kind.__name__}", (RemoteCalls, kind), {}) for version, kind in _CALLS.items()}
_EACH = 256  # bytes of shared memory for an element of a variable; only those that are used take memory


def load_calls(setup: FmuSetup, limits: Isolation | None, *, folder: Path, library: Path, **arguments: Any) -> FmiCalls:
    """Load the library of an FMU that is unpacked into a folder: in a process with limits, or without any in this one.

    Further arguments are those of `FmiCalls`.
    """
    about = setup.description
    version = about.fmi[0]
    if limits is None:
        return _CALLS[version](folder=folder, library=library, **arguments)
    memory = default_memory() if limits.memory is None else limits.memory
    key = (about.digest, int(memory), int(limits.output), not about.only_once)
    n = sum(v.size + len(v.references) for v in about.variables.values())
    size = ((16 << 20) + n * _EACH + 4095) // 4096 * 4096
    process = take(key, about.file.name, folder, size)
    copied = process.folder / "fmu"
    try:
        calls: FmiCalls = _REMOTE[version](
            process=process, limits=limits, folder=copied, library=copied / library.relative_to(folder), **arguments
        )
    except BaseException:
        give_back(process, False)
        raise
    return calls

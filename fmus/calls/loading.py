"""How an FMU is loaded: its setup, and where its library is loaded, in its own process or in this one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..archive import FmuDescription, FmuVariable, ModelExchangeInfo, OtherVariable
from ..isolation import Isolation, default_memory, give_back, take
from ..platform import is_built_here
from .fmi1 import Fmi1Calls
from .fmi2 import Fmi2Calls
from .fmi3 import Fmi3Calls
from .fmi_calls import FmiCalls
from .remote_calls import RemoteCalls
from .step_options import StepOptions


@dataclass(frozen=True, eq=False)
class FmuSetup:
    """All that the instances of a block's FMU know of the block. Start values are by the FMU's names, ports by theirs.

    A block makes it when its FMU is loaded, and checks the file once for that.
    """

    label: str
    """Name for messages."""
    description: FmuDescription
    start: Mapping[str, Any]
    input_variables: Mapping[str, FmuVariable]
    output_variables: Mapping[str, FmuVariable]
    text_variables: Mapping[str, OtherVariable]
    """Texts and binary data that are recorded in a run."""
    stepping: StepOptions
    isolate: bool | Isolation | None
    """Whether it is loaded in its own process, or the limits of that process; None to decide by its origin."""
    model_exchange_info: ModelExchangeInfo | None
    """Its model exchange, with the dependencies that hold for it; None without one."""
    dependencies: str
    """Dependencies of its outputs and derivatives in model exchange: "declared" or "all"."""

    @property
    def process_limits(self) -> Isolation | None:
        """Limits of the process in which it is loaded; None for this process.

        An FMU that Loopwright has not built is loaded in its own process, unless its block says otherwise.
        """
        given = self.isolate
        if given is None:
            given = not is_built_here(self.description.digest)
        if isinstance(given, Isolation):
            return given
        return Isolation() if given else None


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

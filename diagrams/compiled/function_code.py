"""Functions of a diagram as code for the loop in C: for the virtual machine at once, or generated and compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

from .bound_functions import CodeOfFunctions, GeneratedCode, Machine
from .compiled_libraries import is_kept, load_compiled
from .runtime import load_runtime, runtime_is_kept

Code = TypeVar("Code")


@dataclass(frozen=True, eq=False)
class Sources(Generic[Code]):
    """A diagram's functions, and their C code, which is written when it is asked for."""

    writers: Sequence[Callable[[], str]]  # each writes the source of a library
    # from these libraries, or from the virtual machine in the place of each
    make: Callable[[Sequence[CodeOfFunctions]], Code]
    operations: int = 0
    exact: bool = False  # whether generated code has the bits of interpreted functions; see `TickCode`
    keep: Callable[[Code], None] = lambda code: None  # keeps the generated code for the next run

    @cached_property
    def texts(self) -> list[str]:
        """The sources of the libraries."""
        return [write() for write in self.writers]

    def is_compiled(self) -> bool:
        """Whether the cache has all libraries, so that none has to be compiled."""
        return runtime_is_kept() and all(is_kept(text) for text in self.texts)

    def load(self, flags: tuple[str, ...] = (), known: str = "") -> Code:
        """Return the generated code; libraries that the cache lacks are compiled. See `load_compiled`."""
        load_runtime()  # if it can't be compiled, the run is interpreted
        code = self.make([GeneratedCode(load_compiled(text, flags, known)) for text in self.texts])
        self.keep(code)
        return code

    def on_machine(self) -> Code:
        """Return the code for the virtual machine: nothing is compiled."""
        return self.make([Machine(load_runtime())] * len(self.writers))

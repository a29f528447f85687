"""Plants of a loop in C: FMUs that it calls, those in other processes, and those that Python steps."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial

from ...blocks.interrupts import INTERRUPTS
from ...fmus.calls import FmuInstance, NativeStep, RemoteStep
from ...fmus.host_state import HostState
from .bound_functions import MemoryForC
from .model_exchange_in_c import NativeModelExchange
from .plants_called_back import PythonStep, RemotePlants


class _Transfer(ctypes.Structure):
    _fields_ = [
        ("function", ctypes.c_void_p),
        ("references", ctypes.c_void_p),
        ("count", ctypes.c_size_t),
        ("values", ctypes.c_void_p),
        ("size", ctypes.c_size_t),
    ]


class _Plant(ctypes.Structure):
    _fields_ = [
        ("version", ctypes.c_int32),
        ("instance", ctypes.c_void_p),
        ("step", ctypes.c_void_p),
        ("inputs", _Transfer),
        ("outputs", _Transfer),
        *(
            (name, ctypes.c_void_p)
            for name in ("now", "width", "final", "flags", "reached", "changed", "far", "by_python", "quiet")
        ),
    ]


class LoopPlants:
    """The plants of a loop, by their places; FMUs in model exchange, ``exchange``, are guarded with them.

    Attributes
    ----------
    address : int or None
        Address of the plants as C knows them; valid as long as this lives.
    remote : RemotePlants
        Those of other processes, and those that Python steps.
    """

    def __init__(self, plants: Sequence[FmuInstance | PythonStep], exchange: NativeModelExchange | None):
        self.remote, self._memory = RemotePlants(), MemoryForC(plants)
        self._remotes = [self.remote, *([] if exchange is None else [exchange.remote])]
        self._watched: list[tuple[HostState, ctypes.c_bool]] = [] if exchange is None else [*exchange.watched]
        self._far = list[int | None]()  # of each plant: its structure, if it is in another process
        self.address = self._memory.array([self._plant(place, plant) for place, plant in enumerate(plants)])

    @property
    def kept(self) -> list[object]:
        """All that lives as long as the plants: whatever the pointers of their structures lead to."""
        return self._memory.kept

    def _plant(self, place: int, plant: FmuInstance | PythonStep) -> ctypes.Structure:
        self._far.append(None)
        if not isinstance(plant, FmuInstance):
            return _Plant(by_python=self.remote.add_python(place, plant, None))
        step, take = plant.native or plant.remote, partial(_take_step, plant)
        if step is None:
            return _Plant(by_python=self.remote.add_python(place, take, None))
        self._memory.kept.append(step)
        if isinstance(step, RemoteStep):
            far = self._far[-1] = self.remote.add(step)
            return _Plant(
                now=step.now,
                width=step.width,
                flags=step.flags,
                reached=step.reached,
                far=far,
                quiet=None if step.quiet is None else self.remote.add_quiet(step.quiet),
                by_python=self.remote.add_python(place, take, far) if step.is_careful else None,
            )
        return self._native(step)

    def _native(self, step: NativeStep) -> ctypes.Structure:
        inputs, outputs = (
            _Transfer()
            if call is None
            else _Transfer(call.function, call.references, call.count, call.values, call.size)
            for call in (step.inputs, step.outputs)
        )
        changed = None
        if step.host is not None:
            self._watched.append((step.host, ctypes.c_bool()))
            changed = ctypes.addressof(self._watched[-1][1])
        return _Plant(
            step.version,
            step.instance,
            step.step,
            inputs,
            outputs,
            step.now,
            step.width,
            step.final,
            step.flags,
            step.reached,
            changed,
        )

    def begun(self) -> list[bool]:
        """Return for each plant whether C has begun a step in another process whose end Python has to see to."""
        return [far is not None and self.remote.has_begun(far) for far in self._far]

    def check_steps(self) -> None:
        """Raise the error of a step that Python has taken for the loop."""
        if self.remote.by_python is not None:
            self.remote.by_python.check()

    def guard(self) -> AbstractContextManager[None]:
        """Leave this process's state as it was, whatever FMUs of others do to it meanwhile, and note their changes.

        C sets rounding mode and traps back after each step; the working folder is set back at the end. An interrupt
        waits until C has returned, as any loop may call Python: for a rare tick, for an algebraic loop, or as a log is
        full.
        """
        if self._watched or any(remote.address for remote in self._remotes):
            return self._guard()
        return INTERRUPTS.kept()

    @contextmanager
    def _guard(self) -> Iterator[None]:
        with ExitStack() as stack:
            for host, _ in self._watched:
                stack.enter_context(host)
            for remote in self._remotes:
                stack.enter_context(remote.guard())
            stack.enter_context(INTERRUPTS.kept())
            yield
        for host, changed in self._watched:
            if changed:
                host.note_modes()


def _take_step(plant: FmuInstance, t: float, h: float) -> bool:
    plant.step(t, h)
    return plant.ends_run

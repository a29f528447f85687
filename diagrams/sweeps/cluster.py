"""Samples of a sweep on a Dask cluster: FMUs travel as bytes, and every worker compiles for itself."""

from __future__ import annotations

import copy
import hashlib
import pickle
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...blocks.core import OptionError, one_thread, replace_file
from ...fmus import Fmu
from ...fmus.platform import cache_folder, explain_cache_errors, is_built_here, record_build
from ..flat import WiredDiagram
from .outcome import SampleOutcome
from .plan import Plan
from .processes import to_bytes
from .samples import Sample
from .worker import Worker
from .workers import make_worker

_CHUNKS = 8
"""Chunks of samples for each thread of the cluster."""
_LARGEST_CHUNK = 64
"""Samples of a chunk at most."""

Made = tuple[Callable[..., WiredDiagram], tuple[Any, ...]]


@dataclass(frozen=True, eq=False)
class Parcel:
    """A sweep without the files of its FMUs, as it travels."""

    plan: Plan  # its diagram is built again where it arrives
    made: Made  # function and arguments that make the diagram
    files: Mapping[str, str]  # SHA-256 digest of each FMU's file, by the block's path
    built: frozenset[str]  # digests of the FMUs that Loopwright has built

    @classmethod
    def of(cls, plan: Plan) -> tuple[Parcel, dict[str, bytes]]:
        """Return a sweep as a parcel, and the contents of its FMUs by digest."""
        plants = {path: block for path, block in plan.diagram.structure.blocks.items() if isinstance(block, Fmu)}
        files = {path: plant.description.digest for path, plant in plants.items()}  # the file is what it was
        contents = {files[path]: Path(plant.file).expanduser().read_bytes() for path, plant in plants.items()}
        made: Any = plan.diagram.__reduce__()
        empty: Any = None
        built = frozenset(digest for digest in contents if is_built_here(digest))
        return cls(replace(plan, diagram=empty), made, files, built), contents

    def unpack(self, contents: Mapping[str, bytes]) -> Plan:
        """Return the sweep with its diagram, whose FMUs are files of this machine's cache."""
        places = {digest: _keep(digest, content, built=digest in self.built) for digest, content in contents.items()}
        make, (name, structure, *more) = self.made
        structure = structure.copy()
        for path, digest in self.files.items():
            block = copy.copy(structure.blocks[path])
            object.__setattr__(block, "file", str(places[digest]))
            structure.blocks[path] = block
        return replace(self.plan, diagram=make(name, structure, *more))


def _keep(digest: str, content: bytes, *, built: bool) -> Path:
    """Return the file of an FMU in the cache; it is written where it isn't there."""
    folder = cache_folder() / "travelled"
    path = folder / f"{digest}.fmu"
    with explain_cache_errors("an FMU of the sweep can't be kept in this worker's cache"):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            with replace_file(path) as fresh:
                fresh.write_bytes(content)
    if built:
        record_build(digest)
    return path


# --- on the workers ------------------------------------------------------------------------------------------------


class _WorkerPool:
    """The workers of one sweep in this process: each thread that runs a chunk takes one, and puts it back."""

    def __init__(self, plan: Plan):
        self.plan, self.idle, self.lock = plan, list[Worker](), threading.Lock()
        self.alone: Any = threading.Lock() if plan.is_alone else nullcontext()

    @contextmanager
    def take(self) -> Iterator[Worker]:
        """Yield a worker that nobody else has."""
        with self.alone:
            with self.lock:
                worker = self.idle.pop() if self.idle else make_worker(self.plan)
            yield worker
            with self.lock:
                self.idle.append(worker)

    def close(self) -> None:
        """Free the FMUs of all workers."""
        with self.lock:
            for worker in self.idle:
                worker.__exit__(None, None, None)
            self.idle.clear()


_pools: dict[str, _WorkerPool] = {}
_pools_change = threading.Lock()


def deliver(content: bytes) -> bytes:
    """Return a content: a task whose result lies on workers, and is made again where one that had it ends."""
    return content


def run_chunk(key: str, parcel: bytes, digests: Sequence[str], samples: Sequence[Sample], *contents: bytes) -> Any:
    """Run samples on a worker of a cluster, and return their outcomes."""
    with _pools_change:
        if key not in _pools:
            found: Parcel = pickle.loads(parcel)
            _pools[key] = _WorkerPool(found.unpack(dict(zip(digests, contents, strict=True))))
        pool = _pools[key]
    with one_thread(), pool.take() as worker:
        return [*worker.run_all(samples)]


def release(key: str) -> None:
    """Free what a sweep holds in this process."""
    with _pools_change:
        pool = _pools.pop(key, None)
    if pool is not None:
        pool.close()


# --- here ------------------------------------------------------------------------------------------------------------


def run_on_cluster(plan: Plan, samples: Sequence[Sample], client: Any) -> Generator[SampleOutcome, None, None]:
    """Yield the outcomes of samples, in the order in which they are ready.

    A worker that ends gives its samples to others. A sample with which workers end again and again is a failure.
    """
    if not all(hasattr(client, name) for name in ("submit", "nthreads", "cancel")):
        raise OptionError(
            f"found client={client!r}; expected a distributed.Client, such as Client(n_workers=2).",
            block=plan.diagram.name,
            port="client",
        )
    import distributed

    library: Any = distributed
    threads = sum(client.nthreads().values())
    if not threads:
        raise OptionError(
            "the cluster has no worker; expected one at least. Start one: dask worker ADDRESS.",
            block=plan.diagram.name,
            port="client",
        )
    made, contents = Parcel.of(plan)
    parcel = to_bytes(made, plan.diagram.name)
    key = hashlib.sha256(parcel).hexdigest()[:24]
    packed = client.submit(deliver, parcel, key=f"loopwright-sweep-{key}")
    files = [client.submit(deliver, data, key=f"loopwright-fmu-{digest}") for digest, data in contents.items()]
    size = max(1, min(_LARGEST_CHUNK, len(samples) // (_CHUNKS * threads)))
    size = -(-size // plan.lanes) * plan.lanes  # no vector is broken up

    def submit(some: Sequence[Sample]) -> Any:
        return client.submit(run_chunk, key, packed, [*contents], list(some), *files, pure=False)

    chunks = {submit(samples[k : k + size]): samples[k : k + size] for k in range(0, len(samples), size)}
    waiting = library.as_completed([*chunks])
    try:
        for future in waiting:
            some = chunks.pop(future)
            error = future.exception() if future.status == "error" else None
            if future.status == "finished":
                yield from future.result()
            elif error is not None and not isinstance(error, library.KilledWorker):
                raise OptionError(
                    f"the cluster's workers can't run the sweep: {type(error).__name__}: {error}. They need Loopwright "
                    "of this version, and the modules of the diagram's blocks.",
                    block=plan.diagram.name,
                    port="client",
                ) from error
            elif len(some) > 1:  # which of them was it?
                for sample in some:
                    chunks[alone := submit([sample])] = [sample]
                    waiting.add(alone)
            else:
                end = "the workers of the cluster that ran this sample ended, several times"
                yield SampleOutcome.of_lost(some[0], end)
    finally:
        client.cancel([*chunks, packed, *files])
        with suppress(Exception):  # a cluster that is gone has nothing left to free
            client.run(release, key)

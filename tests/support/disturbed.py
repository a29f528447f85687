"""Linear algebra as another machine might compute it: arguments and results of NumPy's and SciPy's functions, disturbed.

Kernels for other processors, other versions of LAPACK and other numbers of threads round differently. Each computes the
exact result of an argument that differs a little from the given one (backward stability); the order of eigenvalues and
the signs of eigenvectors and singular vectors are nobody's promise. `Disturbance` does all this on purpose, so that a
decision that hangs on the last bits shows on any machine.

The disturbance is 1e-15 of the norm for functions that work by orthogonal transformations, and else of the largest
entry of each row and column after balancing, without filling zeros that sums of products leave 0. A disturbance by the
norm alone made a hundred numbers wrong that every machine computes rightly, such as the small gains beside a large one.

Equal arguments are disturbed equally, as a machine repeats itself; a stack of matrices is disturbed otherwise than the
same matrices one by one, as its entries have come out of other sums.

Its loops are C (``disturbed.c``): by NumPy, with a dozen calls for a small matrix, they took a tenth of the quick set.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

SIZE = 1e-15
"""Size of a disturbance, relative to the norm of what it disturbs."""

NUMBERS = (
    "tests/blocks/tracing/",
    "tests/diagrams/contact/",
    "tests/diagrams/frequency/",
    "tests/diagrams/linearization/",
    "tests/diagrams/measure/",
    "tests/diagrams/report/",
    "tests/diagrams/requirements/",
    "tests/diagrams/studies/",
)
"""Tests whose numbers come out of linear algebra."""
IN_QUICK = tuple(folder for folder in NUMBERS if folder != "tests/diagrams/report/")
"""Those that the quick set disturbs: the numbers of reports are those of the other folders, and the long set disturbs all."""
NUMPY = [
    "cholesky",
    "cond",
    "det",
    "eig",
    "eigh",
    "eigvals",
    "eigvalsh",
    "inv",
    "lstsq",
    "matrix_rank",
    "norm",
    "pinv",
    "qr",
    "slogdet",
    "solve",
    "svd",
    "svdvals",
]
SCIPY = [
    "cho_factor",
    "cholesky",
    "det",
    "eig",
    "eigh",
    "eigvals",
    "eigvalsh",
    "expm",
    "expm_frechet",
    "inv",
    "logm",
    "lstsq",
    "lu",
    "lu_factor",
    "norm",
    "null_space",
    "ordqz",
    "orth",
    "pinv",
    "qr",
    "qz",
    "schur",
    "solve",
    "solve_continuous_are",
    "solve_continuous_lyapunov",
    "solve_discrete_are",
    "solve_discrete_lyapunov",
    "solve_sylvester",
    "sqrtm",
    "svd",
    "svdvals",
]
ORTHOGONAL = {
    "cond",
    "eigh",
    "eigvalsh",
    "lstsq",
    "matrix_rank",
    "norm",
    "null_space",
    "orth",
    "pinv",
    "svd",
    "svdvals",
}
"""Functions whose orthogonal transformations mix all entries, so that the error of each is a part of the norm."""
HOLDERS = ("loopwright", "control", "scipy.signal", "numpy.lib", "numpy.polynomial", "support")
"""Modules that may hold such a function by its own name."""


MOST_READ = 1000
"""Entries of an argument of which its disturbance depends: equal arguments have equal ones."""


KINDS = (np.ndarray, list, tuple)
"""Types of arguments that may hold a matrix."""

POOL = 1 << 18
"""Random numbers of a seed. A call takes those from a place on that hangs on its arguments: a generator would cost more."""


class _Draw:
    """The random numbers of one call: those of the pool from a place on, around in a circle; none is 0, and all are below 1e-15."""

    def __init__(self, pool: np.ndarray, address: int, place: int):
        self._pool, self.address, self.place = pool, address, place % POOL

    def take(self, count: int) -> np.ndarray:
        """Return the next numbers."""
        first, self.place = self.place, (self.place + count) % POOL
        if first + count <= POOL:
            return self._pool[first : first + count]
        return self._pool.take(np.arange(first, first + count), mode="wrap")


@functools.cache
def _make_pool(seed: int) -> tuple[np.ndarray, int]:
    """Return the numbers of a seed, and their address."""
    pool = (np.random.default_rng(seed).integers(-128, 128, size=POOL) + 0.5) * (SIZE / 128)
    pool.flags.writeable = False
    return pool, pool.ctypes.data


def _flip(draw: _Draw, count: int) -> np.ndarray:
    return np.asarray(np.sign(draw.take(count)))


def _shuffle(draw: _Draw, values: np.ndarray) -> np.ndarray:
    """Return an order of eigenvalues; a conjugate pair stays together, as LAPACK promises."""
    groups, i, numbers = [], 0, values.tolist()
    while i < len(numbers):
        pair = i + 1 < len(numbers) and numbers[i].imag != 0.0 and numbers[i + 1] == numbers[i].conjugate()
        groups.append([i, i + 1] if pair else [i])
        i += len(groups[-1])
    order = np.argsort(draw.take(len(groups)))
    return np.array([i for place in order for i in groups[place]], dtype=int)


class Disturbance:
    """Disturbs linear algebra while it is on; ``seed`` None leaves everything as it is."""

    def __init__(self, folder: Path) -> None:
        """Compile the C part into a folder."""
        from loopwright.fmus.export import compile_shared  # only where it disturbs

        library = folder / "disturbed"
        compile_shared({"disturbed.c": Path(__file__).with_suffix(".c").read_text(encoding="utf-8")}, library)
        self._disturb = ctypes.CDLL(str(library)).disturb
        address, number = ctypes.c_void_p, ctypes.c_long
        self._disturb.restype = number
        self._disturb.argtypes = [address, number, number, number, number, number, address, number, number]
        self.seed: int | None = None
        self.calls = 0
        self.numpy: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {}

    @contextmanager
    def on(self, seed: int) -> Iterator[None]:
        """Disturb with a seed."""
        before, self.seed = self.seed, seed
        try:
            yield
        finally:
            self.seed = before

    def argument(self, name: str, value: Any, draw: _Draw) -> Any:
        """Return an argument with a disturbance, matrix by matrix; what is no array of finite floats stays."""
        array = np.asarray(value) if isinstance(value, KINDS) else None
        if array is None or array.dtype.char not in "dD" or array.ndim == 0 or not array.size:
            return value
        changed = np.array(array, order="C")
        rows, columns = (0, *array.shape)[-2:]
        used = self._disturb(
            changed.__array_interface__["data"][0],
            array.size // (columns * max(rows, 1)),
            rows,
            columns,
            1 if array.dtype.char == "d" else 2,
            name in ORTHOGONAL,
            draw.address,
            POOL,
            draw.place,
        )
        if used < 0:
            return value
        draw.place = (draw.place + used) % POOL
        return changed.view(type(value)) if isinstance(value, np.ndarray) else changed

    def result(self, name: str, found: Any, draw: _Draw) -> Any:
        """Return a result with eigenvalues in another order, and vectors with other signs."""
        if name in ("eig", "eigvals"):
            if isinstance(found, np.ndarray):
                if found.ndim != 1:
                    return np.stack([self.result(name, part, draw) for part in found]) if len(found) else found
                return found[_shuffle(draw, found)]
            values, *vectors = found
            if values.ndim == 1:
                order = _shuffle(draw, values)
                values, vectors = values[order], [v[:, order] * _flip(draw, v.shape[1]) for v in vectors]
            return _like(found, values, *vectors)
        if name == "eigh" and isinstance(found, tuple) and np.ndim(found[0]) == 1:
            return _like(found, found[0], found[1] * _flip(draw, found[1].shape[1]))
        if name == "svd" and isinstance(found, tuple) and np.ndim(found[1]) == 1:
            U, s, Vh = found
            signs = _flip(draw, len(s))
            U, Vh = U.copy(), Vh.copy()
            U[:, : len(s)] *= signs
            Vh[: len(s)] *= signs[:, None]
            return _like(found, U, s, Vh)
        return found

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that is disturbed while this is on."""

        @functools.wraps(function)
        def disturbed(*arguments: Any, **options: Any) -> Any:
            if any(map(_is_symbolic, arguments)):  # CasADi looks functions up in NumPy by themselves
                with self._originals():
                    return function(*arguments, **options)
            if self.seed is None:
                return function(*arguments, **options)
            self.calls += 1
            digest = zlib.crc32(f"{self.seed} {name}".encode())
            for value in (*arguments, *options.values()) if options else arguments:
                if isinstance(value, KINDS):
                    array = np.asarray(value)
                    some = array if array.size < MOST_READ else array.reshape(-1)[:: 1 + array.size // MOST_READ]
                    digest = zlib.crc32(some.tobytes(), zlib.crc32(str(array.shape).encode(), digest))
            draw = _Draw(*_make_pool(self.seed), digest)
            changed = [self.argument(name, value, draw) for value in arguments]
            return self.result(name, function(*changed, **options), draw)

        return disturbed

    @contextmanager
    def _originals(self) -> Iterator[None]:
        for name, (original, _) in self.numpy.items():
            setattr(np.linalg, name, original)
        try:
            yield
        finally:
            for name, (_, wrapped) in self.numpy.items():
                setattr(np.linalg, name, wrapped)

    def install(self, patch: Any) -> None:
        """Put the disturbed functions in place of those of NumPy and SciPy, wherever a module of `HOLDERS` has them."""
        for name in ("control", "loopwright.blocks.tracing.traced_functions", "loopwright.diagrams.report"):
            importlib.import_module(name)  # loads what they take by name

        for module, names in ((np.linalg, NUMPY), (scipy.linalg, SCIPY)):
            for name in names:
                if (function := getattr(module, name, None)) is None:  # of newer versions
                    continue
                wrapped = self.wrap(name, function)
                patch.setattr(module, name, wrapped)
                if module is np.linalg:
                    self.numpy[name] = function, wrapped
                for holder in [m for n, m in list(sys.modules.items()) if n.startswith(HOLDERS) and m is not None]:
                    for key, value in list(vars(holder).items()):
                        if value is function:
                            patch.setattr(holder, key, wrapped)


def _like(found: Any, *parts: Any) -> Any:
    return type(found)(*parts) if hasattr(found, "_fields") else tuple(parts)


def _is_symbolic(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return any(map(_is_symbolic, value))
    return not isinstance(value, (np.ndarray, np.generic)) and hasattr(type(value), "__array_function__")

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
"""

from __future__ import annotations

import functools
import importlib
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


AT_ONCE = 1 << 15
"""Entries of a stack that are disturbed together: all that is computed of them stays in the processor's cache."""

MOST_READ = 1000
"""Entries of an argument of which its disturbance depends: equal arguments have equal ones."""


KINDS = (np.ndarray, list, tuple)
"""Types of arguments that may hold a matrix."""

POOL = 1 << 18
"""Random numbers of a seed. A call takes those from a place on that hangs on its arguments: a generator would cost more."""


class _Draw:
    """The random numbers of one call: those of the pool from a place on, around in a circle; none is 0, and all are below 1e-15."""

    def __init__(self, pool: np.ndarray, place: int):
        self._pool, self._place = pool, place % POOL

    def take(self, count: int) -> np.ndarray:
        """Return the next numbers."""
        first, self._place = self._place, (self._place + count) % POOL
        if first + count <= POOL:
            return self._pool[first : first + count]
        return self._pool.take(np.arange(first, first + count), mode="wrap")


@functools.cache
def _make_pool(seed: int) -> np.ndarray:
    pool = (np.random.default_rng(seed).integers(-128, 128, size=POOL) + 0.5) * (SIZE / 128)
    pool.flags.writeable = False
    return pool


def _norm_sizes(sizes: np.ndarray) -> np.ndarray:
    """Return the norm of each matrix, or vector; the last axis is that of the stack."""
    axes = tuple(range(sizes.ndim - 1))
    return np.asarray(np.sqrt(np.add.reduce(sizes**2, axis=axes, keepdims=True) * (sizes.shape[-1] / sizes.size)))


def _scaled_sizes(sizes: np.ndarray) -> np.ndarray:
    """Return the largest size in the row or in the column of each entry, whichever is less; square ones are balanced.

    LAPACK balances a matrix before it looks for eigenvalues, and elimination works with columns and rows: a disturbance
    by the norm alone would shake small entries beside large ones as no machine does. An entry of a square matrix stays
    0 where all its powers have 0, as sums of products leave it so. The last axis is that of the stack.
    """
    if sizes.ndim == 2:  # vectors
        return sizes
    if sizes.shape[0] != sizes.shape[1]:
        return np.asarray(np.where(sizes > 0.0, _least_sizes(sizes), 0.0))
    largest = sizes[:, :, 0] if sizes.shape[2] == 1 else np.maximum.reduce(sizes, axis=2)
    found = _least_sizes(sizes)
    scale = _BALANCE(largest, scale=1, permute=0)[3]  # one balance for a stack: each takes too long
    if np.count_nonzero(scale != scale[0]):
        factors = (scale / scale[:, None])[:, :, None]
        with np.errstate(all="ignore"):  # factors may be as large as numbers get
            balanced = _least_sizes(sizes * factors)
            balanced /= factors
        np.fmin(found, balanced, out=found)
    if np.count_nonzero(largest) < largest.size:
        connected = (largest > 0.0).astype(float)
        for _ in range(int(sizes.shape[0]).bit_length()):
            connected = ((connected + connected @ connected) > 0.0).astype(float)
        found *= connected[:, :, None]
    return found


def _least_sizes(sizes: np.ndarray) -> np.ndarray:
    largest = np.maximum.reduce
    return np.asarray(np.minimum(largest(sizes, axis=1, keepdims=True), largest(sizes, axis=0, keepdims=True)))


_BALANCE = scipy.linalg.lapack.dgebal
NORMWISE, SCALED = _norm_sizes, _scaled_sizes


def _is_symmetric(stack: np.ndarray) -> bool:
    """Whether all matrices of a stack equal their conjugate transposes; the corners of the first one answer for most."""
    if stack.ndim != 3 or stack.shape[1] != stack.shape[2]:
        return False
    if stack.item(0, 0, -1) != stack.item(0, -1, 0).conjugate():
        return False
    return all(np.array_equal(some, np.conj(np.swapaxes(some, 1, 2))) for some in (stack[:1], stack))


def _disturb(values: np.ndarray, sizes: Callable[[np.ndarray], np.ndarray], draw: _Draw, turn: float) -> None:
    """Add a disturbance to real values, with the axis of the stack at last.

    That of a symmetric matrix is symmetric, with ``turn`` 1, or antisymmetric with -1 (its imaginary part); 0 for others.
    """
    if not np.count_nonzero(values):  # such as the imaginary parts of a real right side
        return
    change = draw.take(values.size).reshape(values.shape)
    if turn:
        change = 0.5 * (change + turn * np.swapaxes(change, 0, 1))
    values += change * sizes(np.abs(values))


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

    def __init__(self) -> None:
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
        """Return an argument with a disturbance, matrix by matrix; what is no array of floats stays."""
        array = np.asarray(value) if isinstance(value, KINDS) else None
        if array is None or array.dtype.kind not in "fc" or array.ndim == 0 or not array.size:
            return value
        if not np.logical_and.reduce(np.isfinite(array), axis=None):
            return value
        sizes = NORMWISE if name in ORTHOGONAL else SCALED
        stack = array.reshape(-1, *array.shape[-2:]) if array.ndim > 1 else array[None]
        symmetric = _is_symmetric(stack)
        to_last, to_first = ((1, 2, 0), (2, 0, 1)) if array.ndim > 1 else ((1, 0), (1, 0))
        parts = []
        count = max(1, AT_ONCE // stack[0].size)
        for first in range(0, len(stack), count):
            values = stack[first : first + count].transpose(to_last).copy()  # long rows are quick to go through
            if array.dtype.kind == "c":
                # Parts apart: a product adds up parts, and an imaginary one may be 1e-30 of the real.
                _disturb(values.real, sizes, draw, 1.0 if symmetric else 0.0)
                _disturb(values.imag, sizes, draw, -1.0 if symmetric else 0.0)
            else:
                _disturb(values, sizes, draw, 1.0 if symmetric else 0.0)
            parts.append(values.transpose(to_first))
        changed = (parts[0] if len(parts) == 1 else np.concatenate(parts)).reshape(array.shape)
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
            for value in (*arguments, *options.values()):
                if isinstance(value, KINDS):
                    array = np.asarray(value)
                    some = array.reshape(-1)[:: 1 + array.size // MOST_READ]
                    digest = zlib.crc32(some.tobytes(), zlib.crc32(str(array.shape).encode(), digest))
            draw = _Draw(_make_pool(self.seed), digest)
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

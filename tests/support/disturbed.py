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


def _norm_sizes(sizes: np.ndarray) -> np.ndarray:
    """Return the norm of each matrix, or vector; the last axis is that of the stack."""
    axes = tuple(range(sizes.ndim - 1))
    return np.asarray(np.sqrt(np.mean(sizes**2, axis=axes, keepdims=True)))


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
    largest = sizes.max(axis=2)
    connected = (largest > 0.0).astype(float)
    for _ in range(int(sizes.shape[0]).bit_length()):
        connected = ((connected + connected @ connected) > 0.0).astype(float)
    found = _least_sizes(sizes)
    scale = _BALANCE(largest, scale=1, permute=0)[3]  # one balance for a stack: each takes too long
    if (scale != scale[0]).any():
        factors = (scale / scale[:, None])[:, :, None]
        with np.errstate(all="ignore"):  # factors may be as large as numbers get
            balanced = _least_sizes(sizes * factors)
            balanced /= factors
        np.fmin(found, balanced, out=found)
    if not connected.all():
        found *= connected[:, :, None]
    return found


def _least_sizes(sizes: np.ndarray) -> np.ndarray:
    return np.asarray(np.minimum(sizes.max(axis=1, keepdims=True), sizes.max(axis=0, keepdims=True)))


_BALANCE = scipy.linalg.lapack.dgebal
NORMWISE, SCALED = _norm_sizes, _scaled_sizes


def _is_finite(array: np.ndarray) -> bool:
    with np.errstate(all="ignore"):
        return bool(np.isfinite(array.sum())) or bool(np.isfinite(array).all())


def _is_symmetric(stack: np.ndarray) -> bool:
    """Whether all matrices of a stack equal their conjugate transposes; the first one answers for most."""
    if stack.ndim != 3 or stack.shape[1] != stack.shape[2]:
        return False
    return all(np.array_equal(some, np.conj(np.swapaxes(some, 1, 2))) for some in (stack[:1], stack))


def _disturb(
    values: np.ndarray, sizes: Callable[[np.ndarray], np.ndarray], random: np.random.Generator, turn: float
) -> None:
    """Add a disturbance to real values, with the axis of the stack at last.

    That of a symmetric matrix is symmetric, with ``turn`` 1, or antisymmetric with -1 (its imaginary part); 0 for others.
    """
    if not values.any():  # such as the imaginary parts of a real right side
        return
    size = sizes(np.abs(values))
    change = np.frombuffer(random.bytes(values.size), dtype=np.int8).reshape(values.shape) + 0.5  # never 0
    change *= SIZE / 128
    if turn:
        change = 0.5 * (change + turn * np.swapaxes(change, 0, 1))
    change *= size
    values += change


def _flip(random: np.random.Generator, count: int) -> np.ndarray:
    return random.choice([-1.0, 1.0], size=count)


def _shuffle(random: np.random.Generator, values: np.ndarray) -> np.ndarray:
    """Return an order of eigenvalues; a conjugate pair stays together, as LAPACK promises."""
    groups, i = [], 0
    while i < len(values):
        pair = i + 1 < len(values) and values[i].imag != 0.0 and values[i + 1] == np.conj(values[i])
        groups.append([i, i + 1] if pair else [i])
        i += len(groups[-1])
    random.shuffle(groups)
    return np.array([i for group in groups for i in group], dtype=int)


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

    def argument(self, name: str, value: Any, random: np.random.Generator) -> Any:
        """Return an argument with a disturbance, matrix by matrix; what is no array of floats stays."""
        array = np.asarray(value) if isinstance(value, np.ndarray | list | tuple) else None
        if array is None or array.dtype.kind not in "fc" or array.ndim == 0 or not array.size or not _is_finite(array):
            return value
        sizes = NORMWISE if name in ORTHOGONAL else SCALED
        stack = array.reshape(-1, *array.shape[-2:]) if array.ndim > 1 else array[None]
        changed, symmetric = np.empty_like(stack, order="C"), _is_symmetric(stack)
        count = max(1, AT_ONCE // stack[0].size)
        for first in range(0, len(stack), count):
            some = slice(first, first + count)
            values = np.moveaxis(stack[some], 0, -1).copy()  # long rows are quick to go through
            if array.dtype.kind == "c":
                # Parts apart: a product adds up parts, and an imaginary one may be 1e-30 of the real.
                _disturb(values.real, sizes, random, 1.0 if symmetric else 0.0)
                _disturb(values.imag, sizes, random, -1.0 if symmetric else 0.0)
            else:
                _disturb(values, sizes, random, 1.0 if symmetric else 0.0)
            changed[some] = np.moveaxis(values, -1, 0)
        changed = changed.reshape(array.shape)
        return changed.view(type(value)) if isinstance(value, np.ndarray) else changed

    def result(self, name: str, found: Any, random: np.random.Generator) -> Any:
        """Return a result with eigenvalues in another order, and vectors with other signs."""
        if name in ("eig", "eigvals"):
            if isinstance(found, np.ndarray):
                if found.ndim != 1:
                    return np.stack([self.result(name, part, random) for part in found]) if len(found) else found
                return found[_shuffle(random, found)]
            values, *vectors = found
            if values.ndim == 1:
                order = _shuffle(random, values)
                values, vectors = values[order], [v[:, order] * _flip(random, v.shape[1]) for v in vectors]
            return _like(found, values, *vectors)
        if name == "eigh" and isinstance(found, tuple) and np.ndim(found[0]) == 1:
            return _like(found, found[0], found[1] * _flip(random, found[1].shape[1]))
        if name == "svd" and isinstance(found, tuple) and np.ndim(found[1]) == 1:
            U, s, Vh = found
            signs = _flip(random, len(s))
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
            digest = zlib.adler32(f"{self.seed} {name}".encode())
            for value in (*arguments, *options.values()):
                if isinstance(value, np.ndarray | list | tuple):
                    array = np.asarray(value)
                    some = array.reshape(-1)[:: 1 + array.size // MOST_READ]
                    digest = zlib.adler32(some.tobytes(), zlib.adler32(str(array.shape).encode(), digest))
            random = np.random.default_rng([self.seed, digest])
            changed = [self.argument(name, value, random) for value in arguments]
            return self.result(name, function(*changed, **options), random)

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
    if isinstance(value, list | tuple):
        return any(map(_is_symbolic, value))
    return hasattr(type(value), "__array_function__") and not isinstance(value, np.ndarray | np.generic)

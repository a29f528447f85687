"""Linear systems of zeros, poles and gain, as a cascade of real sections of at most second order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from ..core import Array, Block, Input, Kind, Output, ParameterError, State, lay_out, parameter
from .linear import Names, section
from .python_control import (
    MADE_FOR,
    FixedSampleTime,
    block_name,
    check_names,
    check_single,
    check_system,
    labels,
    names_of,
    sample_time_of,
)

Numbers = tuple[complex, ...]


class UnpairedRootError(ValueError):
    """A complex root without its conjugate."""


def real_factors(roots: Sequence[complex]) -> list[list[complex]]:
    """Return roots in groups that make real polynomials: conjugate pairs, and single real roots."""
    rest = sorted((complex(r) for r in roots), key=lambda r: (r.real, abs(r.imag), r.imag))
    groups: list[list[complex]] = []
    while rest:
        root = rest.pop()
        close = 1e-9 * abs(root)
        if abs(root.imag) <= 1e-14 * abs(root):
            groups.append([complex(root.real)])
            continue
        partner = min(rest, key=lambda r: abs(r - root.conjugate()), default=None)
        if partner is None or abs(partner - root.conjugate()) > close:
            raise UnpairedRootError(f"{root} without its conjugate")
        rest.remove(partner)
        mean = 0.5 * (root + partner.conjugate())
        groups.append([mean, mean.conjugate()])
    return groups


def sections(zeros: Sequence[complex], poles: Sequence[complex]) -> list[tuple[list[complex], list[complex]]]:
    """Return zeros and poles of sections, each with at most as many zeros as poles."""
    # Real poles are joined in the order of their size, so that at most one section is of first order. Each pair of
    # complex zeros, then each real zero, goes to the section with room that has the nearest pole.
    groups = real_factors(poles)
    reals = sorted((g[0] for g in groups if len(g) == 1), key=abs)
    joined = [g for g in groups if len(g) == 2]
    joined += [reals[i : i + 2] for i in range(0, len(reals), 2)]
    made: list[tuple[list[complex], list[complex]]] = [([], sorted(p, key=abs)) for p in joined]
    for group in sorted(real_factors(zeros), key=len, reverse=True):
        room = [m for m in made if len(m[0]) + len(group) <= len(m[1])]
        nearest = min(room, key=lambda m: min(abs(p - group[0]) for p in m[1]))
        nearest[0].extend(group)
    return made


def _polynomial(roots: Sequence[complex]) -> np.ndarray:
    return np.atleast_1d(np.real(np.poly(np.array(roots, dtype=complex))))


def _find_fault(roots: Any) -> str | None:
    """Return the fault of roots in words, None if they are those of a real polynomial."""
    try:
        if not np.all(np.isfinite([complex(r) for r in roots])):
            return ""
        real_factors(roots)
    except UnpairedRootError as error:
        return f": {error}"
    except (TypeError, ValueError):
        return ""
    return None


_ROOTS = Kind(
    "a list of finite numbers, complex ones in conjugate pairs, such as [-1+2j, -1-2j]",
    lambda value: _find_fault(value) is None,
    "Give those.",
    lambda name, value: f"found {value!r}{_find_fault(value)}",
)


class Cascade(Block):
    """Base of the transfer functions of zeros and poles: a cascade of real sections of at most second order."""

    u = Input(description="input")
    y = Output(description="output")
    x = State(
        start=lambda block: np.zeros(len(block.roots()[1])), description="states of the sections, one after another"
    )

    def roots(self) -> tuple[Numbers, Numbers, Array]:
        """Return zeros, poles and gain."""
        raise NotImplementedError

    def factors(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return numerator and denominator of each section, monic and of equal length."""
        made = []
        for zeros, poles in sections(*self.roots()[:2]):
            b, a = _polynomial(zeros), _polynomial(poles)
            made.append((np.concatenate([np.zeros(len(a) - len(b)), b]), a))
        return made

    def cascade(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the output, and the rates or next states of all sections."""
        signal, parts, gain, factors = u.u, [], 1.0, self.factors()
        for (b, a), place in zip(factors, lay_out(len(a) - 1 for _, a in factors), strict=True):
            signal, part, factor = self.advance_section(b, a, x.x[place], signal)
            parts.append(part)
            gain *= factor
        return self.roots()[2] * gain * signal, np.concatenate(parts)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the output."""
        return self.cascade(x, u)[0]

    def advance_section(self, b: np.ndarray, a: np.ndarray, x: Array, u: Array) -> tuple[Array, Array, float]:
        """Return output and rate or next state of one section, and the factor by which its output is too small."""
        raise NotImplementedError


class ContinuousCascade(Cascade):
    """Base of such transfer functions in continuous time."""

    def advance_section(self, b: np.ndarray, a: np.ndarray, x: Array, u: Array) -> tuple[Array, Array, float]:
        """Return output and ẋ of a section in controllable canonical form in s / ω."""
        n = len(a) - 1
        w = abs(a[2]) ** 0.5 if n == 2 and a[2] else abs(a[1]) or 1.0
        powers = w ** -np.arange(n + 1.0)
        a, b = a * powers, b * powers
        factor = float(np.abs(b).max())
        b = b / factor
        rate = w * np.concatenate([x[1:], np.stack([u - a[1:][::-1] @ x])])
        return b[0] * u + (b[1:] - b[0] * a[1:])[::-1] @ x, rate, factor

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẋ."""
        return self.cascade(x, u)[1]


class _ZeroPoleGain(Cascade):
    """Common part of zero-pole-gain blocks in continuous and in discrete time."""

    zeros: Numbers = parameter(
        default=(), structural=True, description="zeros; complex ones in conjugate pairs", kind=_ROOTS
    )
    poles: Numbers = parameter(
        structural=True, description="poles, at least one; complex ones in conjugate pairs", kind=_ROOTS
    )
    gain: float = parameter(default=1.0, description="factor k")
    input_names: Names = parameter(default=None, description="name of the input, for python-control")
    output_names: Names = parameter(default=None, description="name of the output, for python-control")

    def check(self) -> None:
        """Refuse zeros and poles that don't make a real, proper transfer function."""
        if not len(self.poles) or len(self.zeros) > len(self.poles):
            raise ParameterError(
                f"found {len(self.zeros)} zeros and {len(self.poles)} poles; expected a pole, and no more zeros than "
                "poles. Add poles, or use Gain where there are none.",
                port="poles",
            )
        check_names(self, input_names=1, output_names=1)

    def roots(self) -> tuple[Numbers, Numbers, Array]:
        """Return zeros, poles and gain."""
        return self.zeros, self.poles, self.gain

    @classmethod
    def from_control(cls, system: Any, *, name: str | None = None) -> Self:
        """Return the block of a `control.TransferFunction` of one input and one output.

        python-control keeps polynomials: zeros and poles are their roots, so multiple ones come apart. The block has
        the names of the system's signals. Without ``name`` its name is the system's, if that is an identifier.

        Raises
        ------
        ParameterError
            For anything but a transfer function in the block's time, continuous or discrete, of one input and one
            output, with poles.
        """
        more = check_system(cls, system, "TransferFunction")
        check_single(cls, system)
        b, a = (np.trim_zeros(np.asarray(c[0][0], dtype=float), "f") for c in (system.num, system.den))
        return cls(
            zeros=tuple(complex(z) for z in np.roots(b)),
            poles=tuple(complex(p) for p in np.roots(a)),
            gain=b[0] / a[0] if len(b) else 0.0,
            name=block_name(system, name),
            **names_of(system),
            **more,
        )

    def to_control(self) -> Any:
        """Return the `control.TransferFunction`, its polynomials multiplied out, with the names of its signals."""
        import control

        return control.zpk(list(self.zeros), list(self.poles), self.gain, sample_time_of(self), **labels(self))


class ZeroPoleGain(_ZeroPoleGain, ContinuousCascade):
    """Zeros, poles and gain: Y(s) = k (s − z₁) … (s − z_m) / ((s − p₁) … (s − p_n)) U(s), m ≤ n; it starts at rest.

    The realization is a cascade of real sections of second order, each in its own scaled frequency. Zeros are in the
    section of the nearest poles; numerators are scaled to coefficients of at most 1, and the gain takes the factors. So
    the poles are exact to rounding, however close or far apart. Zeros and poles are fixed in the trace; the gain is a
    parameter.

    Raises
    ------
    ParameterError
        For complex zeros or poles without their conjugates, and for more zeros than poles.

    Examples
    --------
    >>> ZeroPoleGain(poles=[-1 + 5j, -1 - 5j], gain=26.0)
    ZeroPoleGain(poles=((-1+5j), (-1-5j)), gain=26)
    """


class DiscreteZeroPoleGain(FixedSampleTime, _ZeroPoleGain):
    """Zeros, poles and gain: Y(z) = k (z − z₁) … (z − z_m) / ((z − p₁) … (z − p_n)) U(z), m ≤ n; it starts at rest.

    The realization is a cascade of real sections of second order in the transposed direct form II, with zeros in the
    section of the nearest poles. Zeros and poles are fixed in the trace; the gain is a parameter.

    Raises
    ------
    ParameterError
        For complex zeros or poles without their conjugates, and for more zeros than poles.
    SampleTimeError
        In a continuous subsystem, or with a sample time other than ``dt``, when the diagram is built.
    """

    dt: float | None = MADE_FOR

    def advance_section(self, b: np.ndarray, a: np.ndarray, x: Array, u: Array) -> tuple[Array, Array, float]:
        """Return output and next state of a section."""
        return (*section(b, a, x, u), 1.0)

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the next state."""
        return self.cascade(x, u)[1]

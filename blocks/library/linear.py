"""Linear systems: state space and transfer functions, in continuous and in discrete time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from ..core import Array, Block, Input, Kind, Output, ParameterError, State, parameter
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

Names = tuple[str, ...] | None
_COEFFICIENTS = Kind(
    "a number, or coefficients in one list, highest power first",
    lambda value: np.ndim(value) < 2 and np.size(value) > 0,
    found=lambda name, value: f"found shape {np.shape(value)}",
)


def _ndim(value: Array) -> int:
    return len(getattr(value, "shape", ()))  # np.ndim does not work on a traced value


def _apply(matrix: Array, u: Array) -> Array:
    """Return the product of a matrix and the input; a scalar input takes a single column."""
    return matrix @ u if _ndim(u) else matrix * u


class _StateSpace(Block):
    """Common part of state-space blocks in continuous and in discrete time."""

    A: Array = parameter(description="system matrix, n × n")
    B: Array = parameter(description="input matrix, n × m; n numbers make u a scalar")
    C: Array = parameter(description="output matrix, p × n; n numbers make y a scalar")
    D: Array = parameter(default=0.0, description="feedthrough, p × m without the dimensions that are scalars; 0: none")
    initial_state: Array = parameter(default=0.0, description="x at the start, n numbers or one for all")
    input_names: Names = parameter(default=None, description="names of the inputs, for python-control")
    output_names: Names = parameter(default=None, description="names of the outputs, for python-control")
    state_names: Names = parameter(default=None, description="names of the states, for python-control")
    u = Input(shape=None, description="input: m numbers, or a scalar where B is n numbers")
    y = Output(shape=None, description="output: p numbers, or a scalar where C is n numbers")
    x = State(start=lambda block: np.broadcast_to(block.initial_state, (len(block.A),)), description="state")

    def check(self) -> None:
        """Refuse matrices that don't fit each other."""
        n = np.shape(self.A)[0] if np.ndim(self.A) else 0
        shapes: dict[str, tuple[bool, str]] = {
            "A": (n > 0 and np.shape(self.A) == (n, n), "a square matrix, such as [[-2.0]] for one state"),
            "B": (np.ndim(self.B) in (1, 2) and np.shape(self.B)[0] == n, f"{n} numbers, or a matrix of {n} rows"),
            "C": (np.ndim(self.C) in (1, 2) and np.shape(self.C)[-1] == n, f"{n} numbers, or a matrix of {n} columns"),
        }
        if all(fits for fits, _ in shapes.values()):
            wanted = np.shape(self.C)[:-1] + np.shape(self.B)[1:]
            none = np.ndim(self.D) == 0 and self.D == 0
            shapes["D"] = (np.shape(self.D) == wanted or none, f"shape {wanted}" if wanted else "a number")
            shapes["initial_state"] = (np.shape(self.initial_state) in ((), (n,)), f"a number or {n} numbers")
        for name, (fits, expected) in shapes.items():
            if not fits:
                is_state = name == "initial_state"
                step = "Give one for each state." if is_state else "Write the matrices as nested lists of rows."
                found = np.shape(getattr(self, name))
                raise ParameterError(f"found shape {found}; expected {expected}. {step}", port=name)
        m, p = (int(np.prod(s, dtype=int)) for s in (np.shape(self.B)[1:], np.shape(self.C)[:-1]))
        check_names(self, input_names=m, output_names=p, state_names=n)

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """Input ``u``, of the shape that B takes."""
        return {"u": Input(np.shape(self.B)[1:], None, type(self).u.description, name="u")}

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """Output ``y``, of the shape that C gives."""
        return {"y": Output(np.shape(self.C)[:-1], None, type(self).y.description, name="y")}

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return C x + D u."""
        y = self.C @ x.x
        if not _ndim(self.D) and (_ndim(y) or _ndim(u.u)):
            return y
        return y + _apply(self.D, u.u)

    def advance(self, x: Any, u: Any) -> Array:
        """Return A x + B u."""
        return self.A @ x.x + _apply(self.B, u.u)

    @classmethod
    def from_control(cls, system: Any, *, initial_state: Any = 0.0, name: str | None = None) -> Self:
        """Return the block of a `control.StateSpace`; one input or output becomes a scalar.

        The block has the names of the system's signals. Without ``name`` its name is the system's, if that is an
        identifier.

        Raises
        ------
        ParameterError
            For anything but a state space in the block's time, continuous or discrete, and for one without states.
        """
        more = check_system(cls, system, "StateSpace")
        if system.nstates == 0:
            text = "found a system without states; expected one state or more. Use Gain(gain=system.D)."
            raise ParameterError(text, block=cls.__name__, port="system")
        B, C, D = (np.asarray(m, dtype=float) for m in (system.B, system.C, system.D))
        B, D = (B[:, 0], D[:, 0]) if system.ninputs == 1 else (B, D)
        C, D = (C[0], D[0]) if system.noutputs == 1 else (C, D)
        more |= {"initial_state": initial_state, **names_of(system)}
        return cls(A=system.A, B=B, C=C, D=D, name=block_name(system, name), **more)

    def to_control(self) -> Any:
        """Return the `control.StateSpace`, with the names of its signals."""
        import control

        n = len(self.A)
        B, C = np.reshape(self.B, (n, -1)), np.reshape(self.C, (-1, n))
        D = np.broadcast_to(0.0, (len(C), B.shape[1])) if np.ndim(self.D) == 0 and self.D == 0 else self.D
        return control.ss(self.A, B, C, np.reshape(D, (len(C), B.shape[1])), sample_time_of(self), **labels(self))


class StateSpace(_StateSpace):
    """Linear system in state space: ẋ = A x + B u, y = C x + D u.

    A sampled subsystem discretizes it by its method; ``exact`` is the zero-order hold.

    Raises
    ------
    ParameterError
        For matrices that don't fit each other, and a number of names that is not that of the signals.

    Examples
    --------
    >>> StateSpace(A=[[0, 1], [-4, -0.4]], B=[0, 1], C=[1, 0], name="oscillator")
    StateSpace(A=[[0.0, 1.0], [-4.0, -0.4]], B=[0.0, 1.0], C=[1.0, 0.0], name='oscillator')
    """

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẋ."""
        return self.advance(x, u)


class DiscreteStateSpace(FixedSampleTime, _StateSpace):
    """Linear system in discrete time: x[k + 1] = A x[k] + B u[k], y[k] = C x[k] + D u[k].

    Raises
    ------
    ParameterError
        For matrices that don't fit each other, and a number of names that is not that of the signals.
    SampleTimeError
        In a continuous subsystem, or with a sample time other than ``dt``, when the diagram is built.
    """

    dt: float | None = MADE_FOR

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the next state."""
        return self.advance(x, u)


class _TransferFunction(Block):
    """Common part of transfer functions in continuous and in discrete time."""

    numerator: Array = parameter(
        tunable=False, description="coefficients of the numerator, highest power first", kind=_COEFFICIENTS
    )
    denominator: Array = parameter(
        tunable=False, description="coefficients of the denominator, highest power first", kind=_COEFFICIENTS
    )
    input_names: Names = parameter(default=None, description="name of the input, for python-control")
    output_names: Names = parameter(default=None, description="name of the output, for python-control")
    u = Input(description="input")
    y = Output(description="output")
    x = State(
        start=lambda block: np.zeros(block.order),
        description="state, as many numbers as the order; of order 0 there is none",
        only_if="order",
    )

    @property
    def order(self) -> int:
        """Degree of the denominator."""
        return int(np.atleast_1d(self.denominator).shape[0]) - 1

    def check(self) -> None:
        """Refuse coefficients that don't make a proper transfer function."""
        a, b = np.atleast_1d(self.denominator), np.atleast_1d(self.numerator)
        if a[0] == 0:
            raise ParameterError(
                f"found {a.tolist()}; expected a first coefficient that is not zero. Leave leading zeros out.",
                port="denominator",
            )
        if len(b) > len(a):
            raise ParameterError(
                f"found degree {len(b) - 1} over degree {len(a) - 1}; expected a proper transfer function. Add poles "
                "(FilteredDerivative differentiates with one), or leave leading zeros out.",
                port="numerator",
            )
        check_names(self, input_names=1, output_names=1)

    def coefficients(self) -> tuple[Array, Array]:
        """Return numerator and denominator of equal length."""
        a, b = np.atleast_1d(self.denominator), np.atleast_1d(self.numerator)
        return np.concatenate([np.zeros(a.shape[0] - b.shape[0]), b]), a

    @classmethod
    def from_control(cls, system: Any, *, name: str | None = None) -> Self:
        """Return the block of a `control.TransferFunction` of one input and one output.

        The block has the names of the system's signals. Without ``name`` its name is the system's, if that is an
        identifier.

        Raises
        ------
        ParameterError
            For anything but a transfer function in the block's time, continuous or discrete, of one input and one
            output.
        """
        more = check_system(cls, system, "TransferFunction")
        check_single(cls, system)
        a, b = (np.asarray(c[0][0], dtype=float) for c in (system.den, system.num))
        return cls(numerator=b, denominator=a, name=block_name(system, name), **names_of(system), **more)

    def to_control(self) -> Any:
        """Return the `control.TransferFunction`, with the names of its signals."""
        import control

        b, a = np.atleast_1d(self.numerator), np.atleast_1d(self.denominator)
        return control.tf(b, a, sample_time_of(self), **labels(self))


class TransferFunction(_TransferFunction):
    """Transfer function: Y(s) = (b₀ sᵐ + … + b_m) / (a₀ sⁿ + … + a_n) U(s), m ≤ n; it starts at rest.

    The realization is the controllable canonical form in the scaled frequency s / ω, ω = |a_l / a₀|^(1 / l) with the
    last coefficient a_l that is not zero. ω is the geometric mean of the magnitudes of the poles that are not zero, so
    poles of one size give coefficients and states of one size. The coefficients don't define poles well that are many
    decades apart, or many and close together: use `ZeroPoleGain` for these.

    Raises
    ------
    ParameterError
        For coefficients that don't make a proper transfer function.

    Examples
    --------
    >>> TransferFunction(numerator=2.0, denominator=[0.1, 1.0])
    TransferFunction(numerator=2, denominator=[0.1, 1.0])
    """

    def check(self) -> None:
        """Refuse an improper transfer function, and find the coefficient that sets the scale."""
        super().check()
        object.__setattr__(self, "_last", int(np.flatnonzero(np.atleast_1d(self.denominator))[-1]))

    def scale_coefficients(self) -> tuple[Array, Array, Array]:
        """Return ω, and the coefficients of numerator and denominator in s / ω, divided by a₀."""
        b, a = self.coefficients()
        last: int = self.__dict__["_last"]  # follows from which coefficients are zero, so equal traces share it
        w = np.abs(a[last] / a[0]) ** (1.0 / last) if last else 1.0 + 0.0 * a[0]
        factors = [1.0 / a[0]]
        for _ in range(self.order):
            factors.append(factors[-1] / w)
        scale = np.stack(factors)
        return w, b * scale, a * scale

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the output."""
        _, b, a = self.scale_coefficients()
        return b[0] * u.u + ((b[1:] - b[0] * a[1:])[::-1] @ x.x if self.order else 0.0)

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẋ of the chain of integrators; the last is driven by the input less the feedback."""
        w, _, a = self.scale_coefficients()
        return w * np.concatenate([x.x[1:], np.stack([u.u - a[1:][::-1] @ x.x])])


class DiscreteTransferFunction(FixedSampleTime, _TransferFunction):
    """Transfer function: Y(z) = (b₀ zᵐ + … + b_m) / (a₀ zⁿ + … + a_n) U(z), m ≤ n; it starts at rest.

    The realization is the transposed direct form II. `IIR` takes filters in powers of 1/z, and in sections.

    Raises
    ------
    ParameterError
        For coefficients that don't make a proper transfer function.
    SampleTimeError
        In a continuous subsystem, or with a sample time other than ``dt``, when the diagram is built.
    """

    dt: float | None = MADE_FOR

    def output(self, t: Array, x: Any, u: Any, T: Array) -> Array:
        """Return the output."""
        b, a = self.coefficients()
        return section(b, a, x.x, u.u)[0] if self.order else b[0] / a[0] * u.u

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the next state."""
        b, a = self.coefficients()
        return section(b, a, x.x, u.u)[1]


def section(b: Array, a: Array, x: Array, u: Array) -> tuple[Array, Array]:
    """Return output and next state of b / a (in powers of 1/z, equal lengths) in the transposed direct form II.

    y = (b₀ u + x₁) / a₀ and x_i⁺ = x_{i+1} + b_i u − a_i y, x_{n+1} = 0.
    """
    y = (b[0] * u + x[0]) / a[0]
    return y, np.concatenate([x[1:], np.zeros(1)]) + b[1:] * u - a[1:] * y

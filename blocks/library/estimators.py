"""State feedback and observers: the gains of python-control's ``lqr``, ``place``, ``lqe`` and ``dlqe`` as blocks.

Åström and Murray, Feedback Systems, 2nd edition, chapters 7 and 8; of sampled observers: Franklin, Powell and Workman,
Digital Control of Dynamic Systems, 3rd edition, 8.2 (prediction and current estimators) and 9.4 (Kalman filter).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import numpy as np

from ..core import (
    Array,
    Block,
    Input,
    Kind,
    Output,
    ParameterError,
    ShapeError,
    State,
    accepts,
    kinds,
    parameter,
    shape_of,
)
from .linear import DiscreteStateSpace, StateSpace
from .python_control import FixedSampleTime

_GAIN = Kind("a number, a list of numbers or a matrix", lambda value: np.ndim(value) <= 2 and np.size(value) > 0)


_MODEL = Kind(
    "a state space: control.StateSpace, StateSpace or DiscreteStateSpace",
    lambda value: (
        isinstance(value, StateSpace | DiscreteStateSpace) or all(hasattr(value, n) for n in ("A", "nstates"))
    ),
    "Convert a transfer function by control.ss(system).",
)


def as_control(model: Any) -> Any:
    """Return a model as python-control has it."""
    return model.to_control() if isinstance(model, StateSpace | DiscreteStateSpace) else model


def _design(cls: type[Block], name: str, compute: Callable[[], Any]) -> np.ndarray:
    """Return the gain that a function of python-control finds."""
    try:
        gain = np.asarray(compute(), dtype=float)
        if np.all(np.isfinite(gain)):
            return gain
        reason = "the gain is not finite"
    except (ValueError, TypeError, ArithmeticError, np.linalg.LinAlgError) as error:
        reason = str(error).rstrip(".")
    raise ParameterError(
        f"{name} finds no gain: {reason}. Check the sizes of the arguments, and that the model can be controlled, or "
        "observed, where it is unstable.",
        block=cls.__name__,
        port="gain",
    ) from None


class StateFeedback(Block):
    """State feedback: y = u_ff − K (x − x_d), with the gain K of m × n numbers.

    ``StateFeedback(control.lqr(system, Q, R)[0])(state)`` is u = −K x; ``StateFeedback.from_lqr(system, Q, R)`` finds
    the gain itself. Of one row, K makes y a scalar.

    Raises
    ------
    ShapeError
        For a state of another number of entries than K has columns, when the diagram is built.
    """

    same_units = ("state", "target")
    gain: Array = parameter(
        kw_only=False, description="gain K, m × n; n numbers, or one row, make y a scalar", kind=_GAIN
    )
    state = Input(shape=None, description="state x, n numbers; a scalar where n is 1")
    target = Input(shape=None, default=0.0, description="state x_d to be reached, 0 if not wired")
    feedforward = Input(shape=None, default=0.0, description="input u_ff that is added, such as that of the target")
    y = Output(shape=None, description="input of the plant")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return "−K x"

    @classmethod
    @accepts("{cls.__name__}", ParameterError, system=_MODEL, Q=kinds.matrix, R=kinds.matrix)
    def from_lqr(cls, system: Any, Q: Any, R: Any, *, name: str | None = None) -> Self:
        """Return the linear-quadratic regulator, by `control.lqr`, or `control.dlqr` of a discrete system.

        It minimizes ∫ xᵀ Q x + uᵀ R u dt, or the sum at the ticks.

        Parameters
        ----------
        system : control.StateSpace, StateSpace or DiscreteStateSpace
            The plant.
        Q, R : array_like
            Weights of the state, n × n, and of the input, m × m or a number.
        name : str, optional
            Name of the block.

        Raises
        ------
        ParameterError
            For arguments of another kind, and where python-control finds no gain; the message has its reason.
        """
        import control

        plant = as_control(system)
        solve = control.dlqr if plant.isdtime(strict=True) else control.lqr
        return cls(_design(cls, solve.__name__, lambda: solve(plant, np.atleast_2d(Q), np.atleast_2d(R))[0]), name=name)

    @classmethod
    @accepts("{cls.__name__}", ParameterError, system=_MODEL, poles=kinds.roots)
    def from_poles(cls, system: Any, poles: Any, *, name: str | None = None) -> Self:
        """Return the gain that places the poles of A − B K, by `control.place`.

        Parameters
        ----------
        system : control.StateSpace, StateSpace or DiscreteStateSpace
            The plant.
        poles : sequence of n numbers
            Poles of the closed loop, of z for a discrete system. At most as many are equal as there are inputs.
        name : str, optional
            Name of the block.

        Raises
        ------
        ParameterError
            For arguments of another kind, and where python-control finds no gain; the message has its reason.
        """
        import control

        plant = as_control(system)
        return cls(_design(cls, "place", lambda: control.place(plant.A, plant.B, poles)), name=name)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the input of the plant."""
        K, off = self.gain, u.state - u.target
        rows = shape_of(K)
        K = K[0] if len(rows) == 2 and rows[0] == 1 else K
        if shape_of(K) == (1,) and not shape_of(off):
            return u.feedforward - K[0] * off
        if shape_of(off) != shape_of(K)[-1:]:
            raise ShapeError(
                f"found shape {shape_of(off)}; expected {shape_of(K)[-1] if rows else 'a scalar'}, as the gain has "
                "columns. Wire the whole state, or give another gain.",
                port="state",
            )
        return u.feedforward - (K @ off if rows else K * off)


class _Observer(Block):
    """Common part of observers in continuous and in discrete time."""

    _linear: ClassVar[type[StateSpace | DiscreteStateSpace]]
    model: object = parameter(kw_only=False, description="the plant: a state space block, or python-control's")
    gain: Array = parameter(
        kw_only=False, description="gain L, n × p: a row for each state, a column for each output", kind=_GAIN
    )
    u = Input(shape=None, description="input of the plant, as the model's", models_plant=True)
    y = Input(shape=None, description="measured output of the plant, as the model's")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return "x̂"

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        cls, given = type(self), [*args]
        found = given[0] if given else kwargs.get("model")
        if (given or "model" in kwargs) and not isinstance(found, cls._linear):
            made = cls._linear.from_control(found)
            given, kwargs = ([made, *given[1:]], kwargs) if given else (given, {**kwargs, "model": made})
        super().__init__(*given, **kwargs)

    def check(self) -> None:
        """Refuse a gain that does not fit the model."""
        model: Any = self.model
        fits = (len(model.A), *np.shape(model.C)[:-1])
        if np.shape(self.gain) not in (fits, (*fits, 1)[:2]):
            raise ParameterError(
                f"found shape {np.shape(self.gain)}; expected {fits}: a row for each state, a column for each output. "
                "Transpose it, or give another one.",
                port="gain",
            )

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """Inputs of the shapes that the model has."""
        model: Any = self.model
        of = {"u": model.inputs["u"], "y": model.outputs["y"]}
        own = {name: getattr(type(self), name) for name in of}
        return {
            name: Input(port.shape, None, own[name].description, models_plant=own[name].models_plant, name=name)
            for name, port in of.items()
        }

    def _error(self, estimate: Array, u: Any) -> Array:
        """Return the measured less the expected output."""
        model: Any = self.model
        return u.y - model.output(None, SimpleNamespace(x=estimate), u)

    def _correct(self, estimate: Array, u: Any) -> Array:
        """Return the gain times the error."""
        error, gain = self._error(estimate, u), self.gain
        if shape_of(error):
            return gain @ error
        return (gain[:, 0] if len(shape_of(gain)) == 2 else gain) * error

    def _advance(self, estimate: Array, u: Any) -> Array:
        model: Any = self.model
        return model.advance(SimpleNamespace(x=estimate), u)


def _start(block: Any) -> Any:
    return np.broadcast_to(block.initial_state, (len(block.model.A),))


def _noise(plant: Any, G: Any) -> np.ndarray:
    """Return the matrix by which process noise enters, of as many rows as states."""
    return np.eye(plant.nstates) if G is None else np.reshape(np.asarray(G, dtype=float), (plant.nstates, -1))


class Observer(_Observer):
    """Luenberger observer: d/dt x̂ = A x̂ + B u + L (y − C x̂ − D u), also a stationary Kalman-Bucy filter.

    ``Observer(system, L)(u, y)`` takes the plant's input and its measured output, and puts out the estimated state.
    ``from_lqe`` and ``from_poles`` find the gain. In a sampled subsystem it is discretized by the subsystem's method,
    with u and y held; `DiscreteObserver` is designed for the sampled plant.

    Raises
    ------
    ParameterError
        For a model that is no state space in continuous time, and a gain that does not fit it.
    """

    _linear = StateSpace
    initial_state: Array = parameter(default=0.0, description="x̂ at the start, n numbers or one for all")
    x_hat = State(start=_start, output=True, description="estimated state x̂")
    innovation = Output(shape=None, secondary=True, description="measured less expected output, y − C x̂ − D u")

    @classmethod
    @accepts("{cls.__name__}", ParameterError, system=_MODEL, QN=kinds.matrix, RN=kinds.matrix, G=kinds.matrix)
    def from_lqe(cls, system: Any, QN: Any, RN: Any, *, G: Any = None, **parameters: Any) -> Self:
        """Return the stationary Kalman-Bucy filter, with the gain of `control.lqe`.

        The plant is ẋ = A x + B u + G w, y = C x + D u + v.

        Parameters
        ----------
        system : control.StateSpace or StateSpace
            The plant.
        QN, RN : array_like
            Spectral densities of the process noise w and of the measurement noise v, matrices or a number each.
        G : array_like, optional
            Matrix by which w enters, n × q; without it, there is one w for each state.
        **parameters
            Further ones of the block, such as ``initial_state`` and ``name``.

        Raises
        ------
        ParameterError
            For arguments of another kind, and where python-control finds no gain; the message has its reason.
        """
        import control

        plant = as_control(system)
        noise = np.atleast_2d(QN), np.atleast_2d(RN)
        gain = _design(cls, "lqe", lambda: control.lqe(plant.A, _noise(plant, G), plant.C, *noise)[0])
        return cls(system, gain, **parameters)

    @classmethod
    @accepts("{cls.__name__}", ParameterError, system=_MODEL, poles=kinds.roots)
    def from_poles(cls, system: Any, poles: Any, **parameters: Any) -> Self:
        """Return the observer whose error has these poles, those of A − L C, by `control.place`.

        Parameters
        ----------
        system : control.StateSpace or StateSpace
            The plant.
        poles : sequence of n numbers
            Poles of s. At most as many are equal as there are outputs.
        **parameters
            Further ones of the block, such as ``initial_state`` and ``name``.

        Raises
        ------
        ParameterError
            For arguments of another kind, and where python-control finds no gain; the message has its reason.
        """
        import control

        plant = as_control(system)
        gain = _design(cls, "place", lambda: control.place(plant.A.T, plant.C.T, poles)).T
        return cls(system, gain, **parameters)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the innovation."""
        return self._error(x.x_hat, u)

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the rate of the estimate."""
        return self._advance(x.x_hat, u) + self._correct(x.x_hat, u)


class DiscreteObserver(FixedSampleTime, _Observer):
    """Observer of a sampled plant, predictor or current form, also a stationary Kalman filter.

    ``form="predictor"`` puts out x̂[k] from measurements up to k − 1: x̂[k + 1] = A x̂[k] + B u[k] + L (y[k] − C x̂[k] −
    D u[k]). ``form="current"``, the filter form, puts out x̂[k] = x̄[k] + L (y[k] − C x̄[k] − D u[k]) with the measurement
    of this tick; x̄[k + 1] = A x̂[k] + B u[k] is kept. ``from_lqe`` and ``from_poles`` find the gain of either form.

    Raises
    ------
    ParameterError
        For a model that is no state space in discrete time, a gain that does not fit it, and another form.
    SampleTimeError
        In a continuous subsystem, or with a sample time other than that of the model, when the diagram is built.
    """

    _linear = DiscreteStateSpace
    form: str = parameter(
        default="predictor", description="'predictor' or 'current'", kind=kinds.choice("predictor", "current")
    )
    initial_state: Array = parameter(default=0.0, description="x̂ (current form: x̄) at the start, n numbers or one")
    x_hat = Output(shape=None, description="estimated state x̂")
    innovation = Output(shape=None, secondary=True, description="measured less expected output")
    predicted = State(start=_start, description="state that is expected at the next tick")

    @property
    def dt(self) -> float | None:
        """Sample time of the model in s; None: any."""
        model: Any = self.model
        dt: float | None = model.dt
        return dt

    @classmethod
    @accepts("{cls.__name__}", ParameterError, system=_MODEL, QN=kinds.matrix, RN=kinds.matrix, G=kinds.matrix)
    def from_lqe(
        cls,
        system: Any,
        QN: Any,
        RN: Any,
        *,
        G: Any = None,
        form: str = "predictor",
        **parameters: Any,
    ) -> Self:
        """Return the stationary Kalman filter, with the covariance of `control.dlqe`.

        The plant is x[k + 1] = A x[k] + B u[k] + G w[k], y[k] = C x[k] + D u[k] + v[k]. With the covariance P of the
        predicted state, the gain of the current form is P Cᵀ (C P Cᵀ + RN)⁻¹; that of the predictor is A times it.

        Parameters
        ----------
        system : control.StateSpace or DiscreteStateSpace
            The plant, in discrete time.
        QN, RN : array_like
            Covariances of the process noise w and of the measurement noise v, matrices or a number each.
        G : array_like, optional
            Matrix by which w enters, n × q; without it, there is one w for each state.
        form : {"predictor", "current"}
            Form of the observer.
        **parameters
            Further ones of the block, such as ``initial_state`` and ``name``.

        Raises
        ------
        ParameterError
            For arguments of another kind, and where python-control finds no gain; the message has its reason.
        """
        import control

        plant, R = as_control(system), np.atleast_2d(np.asarray(RN, dtype=float))
        P = _design(cls, "dlqe", lambda: control.dlqe(plant.A, _noise(plant, G), plant.C, np.atleast_2d(QN), R)[1])
        gain = np.linalg.solve(plant.C @ P @ plant.C.T + R, plant.C @ P).T
        return cls(system, gain if form == "current" else plant.A @ gain, form=form, **parameters)

    @classmethod
    @accepts("{cls.__name__}", ParameterError, system=_MODEL, poles=kinds.roots)
    def from_poles(cls, system: Any, poles: Any, *, form: str = "predictor", **parameters: Any) -> Self:
        """Return the observer whose error has these poles, by `control.place`.

        They are those of A − L C, in the current form of A − L C A.

        Parameters
        ----------
        system : control.StateSpace or DiscreteStateSpace
            The plant, in discrete time.
        poles : sequence of n numbers
            Poles of z. At most as many are equal as there are outputs.
        form : {"predictor", "current"}
            Form of the observer.
        **parameters
            Further ones of the block, such as ``initial_state`` and ``name``.

        Raises
        ------
        ParameterError
            For arguments of another kind, and where python-control finds no gain; the message has its reason.
        """
        import control

        plant = as_control(system)
        C = plant.C @ plant.A if form == "current" else plant.C
        gain = _design(cls, "place", lambda: control.place(plant.A.T, C.T, poles)).T
        return cls(system, gain, form=form, **parameters)

    def output(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return the estimate and the innovation."""
        return self._estimate(x, u), self._error(x.predicted, u)

    def _estimate(self, x: Any, u: Any) -> Array:
        return x.predicted + self._correct(x.predicted, u) if self.form == "current" else x.predicted

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the state that is expected at the next tick."""
        following = self._advance(self._estimate(x, u), u)
        return following if self.form == "current" else following + self._correct(x.predicted, u)


__all__ = ["DiscreteObserver", "Observer", "StateFeedback"]

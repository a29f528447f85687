"""The PID controller."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from ..core import (
    Array,
    Block,
    Event,
    Input,
    Output,
    ParameterError,
    State,
    clip,
    kinds,
    parameter,
)
from ..tracing import find_hold, is_nonzero
from .integrators import check_limits

_WAYS = ("back_calculation", "clamping", "none")
_ONE_WAY = f"one of {', '.join(map(repr, _WAYS))}"


class PID(Block):
    """PID controller with two degrees of freedom, filtered derivative, output limits and anti-windup.

    The form is parallel (`from_ideal_form` takes the ideal one), after Åström and Hägglund, *Advanced PID Control*
    (2006): u = v limited to [lower, upper], v = P + I + D, with

    - P = kp (b r − y), İ = ki (r − y) + a, D = kd ẋ_f, T_f ẋ_f = c r − y − x_f;
    - back-calculation, a = (u − v) / T_t. With ``tracking``, a = (actual − v) / T_t: the input ``actual`` is the true
      control signal, of the actuator or of another controller that is in charge;
    - or clamping: İ = 0 while v is beyond a limit and ki (r − y) drives it further.

    With ki = 0, a P or PD controller, there is no state ``integral``: it would stay 0. It is kept where something else
    moves it or sets it: back-calculation with a ``tracking_time``, or ``initial_output``.

    Of an error alone, as textbooks write it, the controller is ``pid(e, 0.0)``, with ``c=1.0`` if it has a D part.

    The integral gain is under the integral, so a change of it makes no bump. In a sampled subsystem P, D and the limits
    are those of the tick, and I[k + 1] = I[k] + T ki (r − y) + (1 − α)(u − v). The subsystem's method gives the filter
    and α, the factor by which a lag of time constant T_t decays in T; ``exact`` is right for inputs that are held. In a
    continuous subsystem clamping is by events. The integral resumes once v is inside by ``clearance``, a share of the
    range, so that it doesn't chatter.

    It starts with x_f = c r − y, so that D = 0, and with I = 0 or, if ``initial_output`` is given, with the I that
    makes u equal to it. These are r and y just before t = 0: a `Step` at t = 0 kicks. With ``tracking`` the start reads
    no input, since ``actual`` depends on u: x_f = 0 and I = ``initial_output``.

    Raises
    ------
    ParameterError
        For a gain without the time that it needs, limits in the wrong order, and anti-windup that can't work.

    Examples
    --------
    >>> PID.from_ideal_form(gain=2.0, integral_time=0.5, derivative_time=0.1, lower=-1, upper=1)
    PID(kp=2, ki=4, kd=0.2, filter_time=0.01, lower=-1, upper=1)
    """

    same_units = ("r", "y")
    kp: float = parameter(description="proportional gain")
    ki: float = parameter(default=0.0, description="integral gain, in 1/s times the unit of kp")
    kd: float = parameter(default=0.0, description="derivative gain, in s times the unit of kp")
    b: float = parameter(default=1.0, description="weight of the set-point in P")
    c: float = parameter(default=0.0, description="weight of the set-point in D")
    filter_time: float | None = parameter(
        default=None, unit="s", above=0.0, description="time constant of the derivative's filter, T_f; None: no D"
    )
    lower: float | None = parameter(default=None, description="lower limit of u; None: there is none")
    upper: float | None = parameter(default=None, description="upper limit of u; None: there is none")
    anti_windup: str = parameter(
        default="back_calculation", description=_ONE_WAY, kind=kinds.choice(*_WAYS).worded(_ONE_WAY)
    )
    tracking_time: float | None = parameter(
        default=None, unit="s", above=0.0, description="time constant of back-calculation, T_t; None: kp / ki"
    )
    tracking: bool = parameter(default=False, description="True adds the input actual")
    clearance: float = parameter(default=1e-3, above=0.0, description="share of the range that ends clamping")
    initial_output: float | None = parameter(default=None, description="u at the start; None: the integral is zero")
    r = Input(description="set-point")
    y = Input(description="measured value")
    actual = Input(
        description="true control signal, in the unit of u; with tracking only", tracks="u", only_if="tracking"
    )
    u = Output(description="control signal")
    excess = Output(secondary=True, description="the part that the limits cut off, v − u")
    integral = State(
        start=lambda block: block.initial_output or 0.0,
        description="I; where ki or another way moves it",
        only_if="has_integral",
    )
    filtered = State(description="x_f; with filter_time", only_if=lambda block: block.filter_time is not None)
    clamped = State(discrete=True, description="1 while the integral is held; with clamping", only_if="clamps")
    clamp = Event("rising", "v is beyond a limit and the integral drives it further; with clamping", only_if="clamps")
    release = Event("rising", "v is inside again by the clearance; with clamping", only_if="clamps")
    filter_decay: ClassVar[Array]  # computed by constants
    filter_gain: ClassVar[Array]
    tracking_share: ClassVar[Array]

    def advise_unwired(self, ports: Collection[str]) -> str:
        """Return how a controller of an error alone is written."""
        if "y" not in ports:
            return ""
        weight = ", in a PID with c=1.0, so that D acts on it" if self.kd and self.c != 1.0 else ""
        return f" Of an error e alone, without a set-point and a measured value, it is {self.label}(e, 0.0){weight}."

    @classmethod
    def from_ideal_form(
        cls,
        *,
        gain: float,
        integral_time: float | None = None,
        derivative_time: float = 0.0,
        ratio: float = 10.0,
        **more: Any,
    ) -> Self:
        """Return the controller in ideal form, K (b r − y + ∫(r − y)/T_i + T_d d/dt (c r − y)).

        Parameters
        ----------
        gain : float
            K.
        integral_time, derivative_time : float
            T_i (None: no integral) and T_d in s.
        ratio : float
            N = T_d / T_f, 2 to 20; T_f filters the derivative.
        **more
            The other parameters of `PID`, and its name.
        """
        if derivative_time:
            more = {"kd": gain * derivative_time, "filter_time": derivative_time / ratio, **more}
        return cls(kp=gain, ki=0.0 if integral_time is None else gain / integral_time, **more)

    def to_control(self) -> Any:
        """Return the linear part as a `control.StateSpace` from r and y to u, with the block's name.

        It is in continuous time, starts at rest, and has neither limits nor anti-windup nor tracking (``actual`` counts
        as u). Without ki it has no integral, without kd no filter.
        """
        import control

        lag = np.inf if self.filter_time is None else self.filter_time
        A, B = np.diag([0.0, -1.0 / lag]), np.array([[self.ki, -self.ki], [self.c / lag, -1.0 / lag]])
        C, D = np.array([[1.0, -self.kd / lag]]), np.array([[self.kp * self.b, -self.kp]])
        D = D + self.kd / lag * np.array([[self.c, -1.0]])
        kept = [i for i, gain in enumerate((self.ki, self.kd)) if gain]
        states = [("integral", "filtered")[i] for i in kept]
        names: dict[str, Any] = {"inputs": ["r", "y"], "outputs": ["u"], "states": states, "name": self.name}
        return control.ss(A[np.ix_(kept, kept)], B[kept], C[:, kept], D, 0, **names)

    def check(self) -> None:
        """Refuse parameters that can't work together."""
        if self.kd and self.filter_time is None:
            text = "found none; expected a filter for the derivative. Give filter_time, such as kd / (10 kp) in s."
            raise ParameterError(text, port="filter_time")
        check_limits(self, None if self.tracking else "initial_output")
        if self.anti_windup == "clamping" and self.has_limits and (self.lower is None or self.upper is None):
            text = "found clamping without both limits; give lower and upper, or use 'back_calculation'."
            raise ParameterError(text, port="anti_windup")
        if self.tracking and self.anti_windup != "back_calculation":
            text = f"found {self.anti_windup!r}; expected 'back_calculation' with tracking. Leave it out."
            raise ParameterError(text, port="anti_windup")
        if self.tracks and self.tracking_time is None and self.ki and not self.kp / self.ki > 0:
            text = f"kp / ki is {self.kp / self.ki:g} s; expected a positive time. Give tracking_time."
            raise ParameterError(text, port="tracking_time")

    @property
    def has_limits(self) -> bool:
        """Whether the output is limited."""
        return self.lower is not None or self.upper is not None

    @property
    def has_integral(self) -> bool:
        """Whether anything moves the integral, or sets it to another value than 0."""
        moved = is_nonzero(self.ki) or (self.tracks and self.tracking_time is not None)
        return moved or self.initial_output is not None

    @property
    def clamps(self) -> bool:
        """Whether the integral is clamped."""
        return self.anti_windup == "clamping" and self.has_limits and self.has_integral

    @property
    def tracks(self) -> bool:
        """Whether there is back-calculation."""
        return self.anti_windup == "back_calculation" and (self.has_limits or self.tracking)

    @property
    def absent_states(self) -> Mapping[str, str]:
        """The states that its parameters leave out, with the reason."""
        reasons = {
            "integral": "with ki = 0, without initial_output and without back-calculation by a tracking_time its "
            "integral is 0 at all times, so it is no state; give ki a value",
            "filtered": "without filter_time it has no derivative, so no filter's state; give filter_time",
            "clamped": "nothing clamps an integral, so no state says so; give anti_windup='clamping' and ki",
        }
        return {name: reason for name, reason in reasons.items() if name not in self.states}

    @property
    def idle_parameters(self) -> frozenset[str]:
        """Those of anti-windup where nothing limits an integral, and weights of parts whose gain is 0."""
        bounded = self.has_integral and (self.has_limits or self.tracking)
        used = {
            "anti_windup": bounded,
            "tracking_time": bounded and self.tracks,
            "clearance": self.clamps,
            "b": self.kp != 0.0,
            "c": self.kd != 0.0,
        }
        return frozenset(name for name, is_used in used.items() if not is_used)

    @property
    def starts_from_inputs(self) -> bool:
        """Whether `initial` computes the states."""
        return not self.tracking and (bool(self.states.keys() - {"integral"}) or self.initial_output is not None)

    def initial(self, u: Any) -> tuple[Array, ...] | Array:
        """Return the states at the start."""
        proportional = self.kp * (self.b * u.r - u.y)
        integral = 0.0 if self.initial_output is None else self.initial_output - proportional
        start = {"integral": integral, "filtered": self.c * u.r - u.y}
        outward = self.outward_excess(proportional + integral, u) > 0.0 if self.clamps else False
        start["clamped"] = np.where(outward, 1.0, 0.0)
        states: tuple[Array, ...] | Array = _together(start, self.states)
        return states

    def tracking_rate(self) -> Array:
        """Return 1 / T_t."""
        return self.ki / self.kp if self.tracking_time is None else 1.0 / self.tracking_time

    def constants(self, T: float, method: str) -> dict[str, Array]:
        """Return the numbers of the filter and of back-calculation for one sample."""
        made = {}
        if self.filter_time is not None:
            decay, gain = find_hold([[-1.0 / self.filter_time]], T, method)
            made = {"filter_decay": decay[0, 0], "filter_gain": gain[0, 0]}
        if self.tracks:
            moves = is_nonzero(self.ki) or self.tracking_time is not None
            rate = self.tracking_rate() if moves else 0.0
            made["tracking_share"] = 1.0 - find_hold([[-rate]], T, method)[0][0, 0]
        return made

    def unlimited_output(self, x: Any, u: Any) -> Array:
        """Return v."""
        v = self.kp * (self.b * u.r - u.y)
        if "integral" in x._fields:  # where the equations are symbols, ki is one, too
            v = v + x.integral
        if "filtered" not in x._fields:
            return v
        return v + self.kd * (self.c * u.r - u.y - x.filtered) / self.filter_time

    def outward_excess(self, v: Array, u: Any) -> Array:
        """Return the distance of v beyond the limit towards which the integral drives."""
        rate = self.ki * (u.r - u.y)
        return np.where(rate > 0.0, v - self.upper, np.where(rate < 0.0, self.lower - v, -self.span()))

    def span(self) -> Array:
        """Return the range of the output."""
        low: Any = self.lower
        return self.upper - low

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return u and the part cut off."""
        v = self.unlimited_output(x, u)
        cut = clip(v, self.lower, self.upper)
        return cut, v - cut

    def correction(self, x: Any, u: Any) -> Array:
        """Return the true control signal less v, which back-calculation integrates."""
        v = self.unlimited_output(x, u)
        return (u.actual if self.tracking else clip(v, self.lower, self.upper)) - v

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, ...] | Array:
        """Return the rates of the integral and the filter."""
        rates: dict[str, Array] = {}
        if "integral" in x._fields:
            rates["integral"] = self.ki * (u.r - u.y)
            if self.tracks:
                rates["integral"] = rates["integral"] + self.tracking_rate() * self.correction(x, u)
        if "clamped" in x._fields:
            rates["integral"] = np.where(x.clamped > 0.5, 0.0, rates["integral"])
        if "filtered" in x._fields:
            rates["filtered"] = (self.c * u.r - u.y - x.filtered) / self.filter_time
        return _together(rates, rates)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the distances of v beyond a limit, and inside by more than the clearance."""
        beyond, held = self.outward_excess(self.unlimited_output(x, u), u), x.clamped > 0.5
        span = self.span()
        return np.where(held, -span, beyond), np.where(held, -beyond - self.clearance * span, -span)

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, ...]:
        """Hold the integral, or release it."""
        clamped = np.where(fired.clamp > 0.5, 1.0, np.where(fired.release > 0.5, 0.0, x.clamped))
        return (*x[:-1], clamped)

    def update(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, ...] | Array:
        """Return the states at the next tick."""
        new: dict[str, Array] = {}
        if "integral" in x._fields:
            step = T * self.ki * (u.r - u.y)
            if self.tracks:
                step = step + self.tracking_share * self.correction(x, u)
            if "clamped" in x._fields:
                new["clamped"] = np.where(self.outward_excess(self.unlimited_output(x, u), u) > 0.0, 1.0, 0.0)
                step = np.where(new["clamped"] > 0.5, 0.0, step)
            new["integral"] = x.integral + step
        if "filtered" in x._fields:
            goal = (self.c * u.r - u.y) / self.filter_time
            new["filtered"] = self.filter_decay * x.filtered + self.filter_gain * goal
        return _together(new, x._fields)


def _together(values: Mapping[str, Any], names: Iterable[str]) -> Any:
    """Return the values of some states as an equation returns them: one alone, several as a tuple."""
    made = tuple(values[name] for name in names)
    return made[0] if len(made) == 1 else made

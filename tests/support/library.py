"""Every public block of the library with sensible parameters, and what it is to be driven with: for the contract's test."""

import numpy as np

from loopwright.blocks import (
    FIR,
    IIR,
    PID,
    PT1,
    PT2,
    AdmittanceFilter,
    And,
    Backlash,
    BandLimitedNoise,
    Butterworth,
    Chirp,
    Circle,
    Clock,
    Compare,
    Constant,
    Counter,
    CubicSpline,
    DeadZone,
    Delay,
    Demux,
    DiscreteIntegrator,
    DiscreteObserver,
    DiscreteStateSpace,
    DiscreteTransferFunction,
    DiscreteZeroPoleGain,
    EdgeDetector,
    Ellipse,
    Encoder,
    ErrorDynamics,
    FeedbackLinearization,
    FilteredDerivative,
    ForceProjection,
    ForceSensor,
    Function,
    Gain,
    HandForce,
    HandProfile,
    Hold,
    Integrator,
    Latch,
    LeadLag,
    LimitedIntegrator,
    Line,
    Lookup1D,
    Lookup2D,
    Maximum,
    Minimum,
    MovingAverage,
    Not,
    Notch,
    Observer,
    Or,
    PadeDelay,
    PathProjection,
    PathSpring,
    PathTracking,
    PiecewiseLinear,
    Power,
    Product,
    Pulse,
    PulseTrain,
    PythonFunction,
    Quantizer,
    Ramp,
    RateLimiter,
    Recorded,
    Reference,
    Relay,
    Requirement,
    ResettableIntegrator,
    Saturation,
    Sawtooth,
    Sine,
    SmoothStep,
    SpringDamper,
    Stack,
    StateFeedback,
    StateMachine,
    StateSpace,
    Step,
    StopCondition,
    Sum,
    Switch,
    TransferFunction,
    TransportDelay,
    TransverseTransform,
    Triangle,
    UnitConversion,
    UnitDelay,
    VariableDelay,
    Wall,
    ZeroPoleGain,
)
from loopwright.fmus import bouncing_ball, dc_motor, gantry, mass_spring_damper

BOTH, SAMPLED, CONTINUOUS = ("sampled", "continuous"), ("sampled",), ("continuous",)
VECTOR = {"shapes": {"u": (3,)}}
PLANE = {"position": (np.array([0.4, -0.1]), np.array([0.6, 0.1]))}  # a patch around a point of the circle
ALONG = {"theta": (-0.2, 0.2), **PLANE}
MATRICES = {"A": [[0.0, 1.0], [-4.0, -0.5]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "D": [[0.5]]}
STILL = {"A": [[0.9, 0.1], [-0.1, 0.8]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]]}


def hypotenuse(a, b):
    return np.sqrt(a * a + b * b + 1.0)


def by_hand(u):
    """No trace of it: it looks at numbers one by one."""
    return float(np.prod([float(v) ** 2 for v in np.ravel(u)]))


def moved(wave=1.0):
    """A sine and its rate, as a backlash takes them in continuous time."""
    frequency = 1.5
    rate = 2.0 * np.pi * frequency * wave
    return {
        "u": Sine(amplitude=wave, frequency=frequency),
        "rate": Sine(amplitude=rate, frequency=frequency, phase=0.5 * np.pi, name="rate"),
    }


CASES = [
    # sources
    (Constant(value=(1.0, 2.0), unit="m"), {}, BOTH),
    (Reference(0.3, unit="m"), {}, BOTH),
    (Step(times=(0.2, 0.5), values=(1.0, -1.0)), {}, BOTH),
    (Pulse(start_time=0.1, end_time=0.8, amplitude=2.0), {}, BOTH),
    (SmoothStep(levels=(0.0, 1.0, 0.5), start_times=(0.1, 0.5), durations=(0.3, 0.2), unit="m"), {}, BOTH),
    (Sine(frequency=3.0, phase=0.3, bias=0.1), {}, BOTH),
    (Ramp(slope=2.0, start_time=0.3), {}, BOTH),
    (Chirp(start_frequency=1.0, end_frequency=8.0, duration=0.6, start_time=0.1), {}, BOTH),
    (Chirp(start_frequency=1.0, end_frequency=8.0, duration=0.6, sweep="logarithmic"), {}, BOTH),
    (PulseTrain(period=0.13, duty=0.3, delay=0.05), {}, BOTH),
    (Sawtooth(period=0.13, delay=0.05), {}, BOTH),
    (Triangle(period=0.13, rise=0.3, delay=0.05), {}, BOTH),
    (PiecewiseLinear(times=(0.1, 0.4, 0.7), values=(0.0, 1.0, -1.0)), {}, BOTH),
    (Recorded(times=(0.0, 0.4, 0.7), values=((0.0, 1.0), (1.0, 2.0), (0.5, 0.0)), unit="m"), {}, BOTH),
    (Recorded(times=(0.1, 0.4, 0.7), values=(0.0, 1.0, -1.0), interpolation="previous"), {}, BOTH),
    (BandLimitedNoise(sample_time=0.07, variance=2.0, seed=3), {}, BOTH),
    (Clock(), {}, BOTH),
    (
        HandProfile(
            start_time=0.1, hold_time=0.2, rise_time=0.2, release_time=0.1, peak_force=5.0, direction=(1.0, 1.0)
        ),
        {},
        BOTH,
    ),
    # algebra
    (Sum(signs="+-"), {}, BOTH),
    (Sum(signs="+-+"), {"shapes": {"u1": (2,), "u2": (2,), "u3": (2,)}}, BOTH),
    (Gain(gain=2.0), VECTOR, BOTH),
    (Gain(gain=((1.0, 0.0, 2.0), (0.5, 1.0, 0.0))), VECTOR, BOTH),
    (Product(), {}, BOTH),
    (Power(exponent=3), VECTOR, BOTH),
    (Stack(), {}, BOTH),
    (Stack(rows=True), {"shapes": {"u1": (2,), "u2": (2,)}}, BOTH),
    (Demux((2, 1)), VECTOR, BOTH),
    (Maximum(count=3), {}, BOTH),
    (Minimum(), {"shapes": {"u1": (2,), "u2": (2,)}}, BOTH),
    (Saturation(lower=-1.0, upper=0.5), {}, BOTH),
    (DeadZone(limit=0.7), VECTOR, BOTH),
    (Function(hypotenuse), {}, BOTH),
    (Function(np.sin), VECTOR, BOTH),
    (Function(lambda a, b: a * b, name="product"), {}, BOTH),
    (PythonFunction(by_hand, arguments={"u": (2,)}), {}, BOTH),
    (Lookup1D(breakpoints=(-1.0, 0.5, 2.0), values=(1.0, 0.0, 3.0)), {}, BOTH),
    (
        Lookup1D(
            breakpoints=(-1.0, 0.5, 2.0, 2.5), values=(1.0, 0.0, 3.0, 1.0), interpolation="cubic", beyond="extrapolate"
        ),
        {},
        BOTH,
    ),
    (Lookup2D(rows=(0.0, 1.0), columns=(0.0, 1.0, 2.0), values=((0.0, 1.0, 2.0), (3.0, 1.0, 0.0))), {}, BOTH),
    (UnitConversion(from_unit="degC", to_unit="K"), {}, BOTH),
    (UnitConversion(from_unit="mm", to_unit="m"), VECTOR, BOTH),
    # what jumps or remembers
    (Quantizer(quantum=0.3), {}, BOTH),
    (Quantizer(quantum=0.3), VECTOR, SAMPLED),
    (Relay(on_point=0.5, off_point=-0.5), {}, BOTH),
    (Relay(on_point=0.5, off_point=-0.5), VECTOR, SAMPLED),
    (Backlash(width=0.6), {}, SAMPLED),
    (Backlash(width=0.6, with_rate=True), {"inputs": moved()}, BOTH),
    (RateLimiter(rising=2.0, falling=3.0), {}, SAMPLED),
    (RateLimiter(rising=2.0, time_constant=0.05), VECTOR, BOTH),
    # logic and control flow
    (Compare(">"), {}, BOTH),
    (Compare("<="), VECTOR | {"shapes": {"u1": (2,), "u2": (2,)}}, SAMPLED),
    (And(count=3), {}, BOTH),
    (Or(), {}, BOTH),
    (Not(), {}, BOTH),
    (Switch(), {}, BOTH),
    (EdgeDetector(edge="both"), {}, SAMPLED),
    (Latch(), {}, BOTH),
    (Counter(), {}, BOTH),
    (
        StateMachine(
            modes=("approach", "contact", "retract"),
            transitions={("approach", "contact"): "touch", ("contact", "retract"): "done"},
        ),
        {},
        BOTH,
    ),
    (StopCondition(), {"inputs": {"u": Step(times=0.8, values=1.0)}}, BOTH),
    (Requirement("it stays small", upper=1.0, lower=-1.5, on_violation="record"), {}, BOTH),
    (Requirement("it stays small", upper=4.0), {}, BOTH),
    (Requirement("it holds"), {"inputs": {"u": (0.6, 1.0)}}, BOTH),
    # linear, continuous
    (Integrator(), {}, BOTH),
    (Integrator(initial_value=(1.0, 2.0, 3.0)), VECTOR, BOTH),
    (LimitedIntegrator(lower=-0.1, upper=0.2), {}, BOTH),
    (ResettableIntegrator(), {}, BOTH),
    (ResettableIntegrator(reset_to_input=True, lower=-0.1, upper=0.2), {}, BOTH),
    (FilteredDerivative(time_constant=0.05), {}, BOTH),
    (TransferFunction(numerator=(1.0, 2.0), denominator=(0.1, 0.5, 1.0)), {}, BOTH),
    (ZeroPoleGain(zeros=(-1.0,), poles=(-2.0 + 1.0j, -2.0 - 1.0j), gain=3.0), {}, BOTH),
    (StateSpace(**MATRICES), {}, BOTH),
    (PT1(gain=2.0, time_constant=0.1), VECTOR, BOTH),
    (PT2(gain=2.0, time_constant=0.1, damping_ratio=0.5), VECTOR, BOTH),
    (LeadLag(gain=2.0, lead_time=0.3, lag_time=0.1), VECTOR, BOTH),
    (Notch(frequency=2.0, bandwidth=0.5, depth=0.1), {}, BOTH),
    (Butterworth(order=3, cutoff=2.0), {}, BOTH),
    (Butterworth(order=1, cutoff=(1.0, 3.0), band="bandstop"), {}, BOTH),
    (StateFeedback(gain=[[1.0, 2.0]]), {"shapes": {"state": (2,), "target": (2,)}}, BOTH),
    (Observer(StateSpace(**MATRICES), gain=[[3.0], [1.0]]), {}, BOTH),
    (PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02), {}, BOTH),
    (PID(kp=2.0, ki=9.0, lower=-1.0, upper=1.5), {}, BOTH),
    (PID(kp=2.0, ki=9.0, lower=-1.0, upper=1.5, anti_windup="clamping"), {}, BOTH),
    (PID(kp=2.0, ki=9.0, lower=-1.0, upper=1.5, tracking=True), {}, BOTH),
    (PadeDelay(delay=0.2, order=4), {}, BOTH),
    (TransportDelay(delay=0.2), {}, BOTH),
    # sampled
    (UnitDelay(), VECTOR, SAMPLED),
    (Delay(steps=3), VECTOR, SAMPLED),
    (VariableDelay(samples=3), {"inputs": {"delay": (0.0, 0.03)}}, SAMPLED),
    (Hold(), VECTOR, SAMPLED),
    (DiscreteIntegrator(method="trapezoidal", lower=-0.5, upper=0.5), {}, SAMPLED),
    (DiscreteTransferFunction(numerator=(1.0, 0.5), denominator=(1.0, -0.5, 0.2)), {}, SAMPLED),
    (DiscreteZeroPoleGain(zeros=(0.3,), poles=(0.5, 0.2), gain=2.0), {}, SAMPLED),
    (DiscreteStateSpace(**STILL), {}, SAMPLED),
    (DiscreteObserver(DiscreteStateSpace(**STILL), gain=[[0.5], [0.2]]), {}, SAMPLED),
    (DiscreteObserver(DiscreteStateSpace(**STILL), gain=[[0.5], [0.2]], form="current"), {}, SAMPLED),
    (FIR(coefficients=(0.5, 0.3, 0.2)), VECTOR, SAMPLED),
    (IIR(b=(0.2, 0.1), a=(1.0, -0.7)), {}, SAMPLED),
    (MovingAverage(samples=4), {}, SAMPLED),
    (Encoder(quantum=1e-3), {"shapes": {"position": (2,), "velocity": (2,)}}, SAMPLED),
    (ForceSensor(tool_mass=0.5), {}, BOTH),
    # paths
    (PathTracking(Circle(radius=0.5)), {"inputs": PLANE}, BOTH),
    (PathProjection(Circle(radius=0.5)), {"inputs": PLANE}, BOTH),
    (PathProjection(Ellipse(semi_axes=(0.5, 0.3))), {"inputs": PLANE}, BOTH),
    (PathProjection(Line(start=(0.0, 0.0), end=(1.0, 0.1))), {"inputs": PLANE}, BOTH),
    (PathProjection(CubicSpline(points=((0.0, 0.0), (0.5, 0.1), (1.0, 0.0)))), {"inputs": PLANE}, BOTH),
    (TransverseTransform(Circle(radius=0.5)), {"inputs": ALONG}, BOTH),
    (ForceProjection(Ellipse(semi_axes=(0.5, 0.3))), {}, BOTH),
    (FeedbackLinearization(Circle(radius=0.5), gantry.nominal), {"inputs": ALONG}, BOTH),
    (ErrorDynamics.from_poles([-20.0] * 3), {}, BOTH),
    (AdmittanceFilter(mass=0.5, damping_ratio=0.6, stiffness=10.0), {}, BOTH),
    (AdmittanceFilter(mass=0.5, damping_ratio=0.6, stiffness=10.0, acceleration_limit=2.0), {}, BOTH),
    (AdmittanceFilter(mass=0.5, damping_ratio=0.6, stiffness=10.0, velocity_limit=0.5), {}, BOTH),
    (
        AdmittanceFilter(mass=0.5, damping_ratio=0.6, stiffness=10.0, velocity_limit=0.5, acceleration_limit=2.0),
        {},
        BOTH,
    ),
    # what the robot meets
    (HandForce(Circle(radius=0.5)), {"inputs": PLANE}, BOTH),
    (PathSpring(Circle(radius=0.5), stiffness=100.0, cubic_stiffness=50.0), {"inputs": PLANE}, BOTH),
    (SpringDamper(stiffness=10.0, damping=1.0, rest=0.1), {}, BOTH),
    (Wall(stiffness=100.0, point=0.2, normal=-1.0), {}, BOTH),
    (
        Wall(stiffness=100.0, damping=5.0, point=(0.2, 0.0), normal=(-1.0, 0.5)),
        {"shapes": {"position": (2,), "velocity": (2,)}},
        BOTH,
    ),
    # plants as equations
    (gantry.nominal, {}, BOTH),
    (dc_motor.nominal, {}, BOTH),
    (mass_spring_damper.nominal, {}, BOTH),
    (bouncing_ball.nominal, {}, CONTINUOUS),
]


def is_base(cls):
    """Whether a class is there to be derived from."""
    return cls.__name__ in ("Block", "PlanarModel")


__all__ = ["CASES", "is_base"]

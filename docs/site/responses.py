"""Small pictures for the pages of blocks: each in a diagram, and its response there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np

from loopwright import blocks as b
from loopwright.blocks import Block

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from loopwright.types import Call, Signal

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
_GREY = "#808080"
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "loopwright",
    "font.size": 8,
    "text.color": _GREY,
    "axes.edgecolor": _GREY,
    "axes.labelcolor": _GREY,
    "xtick.color": _GREY,
    "ytick.color": _GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_PLACE = (0.12, 0.2, 0.64, 0.74)
"""Place of the axes in a figure, the same in all; the legend is at its right."""

_SHOWN = """.. image:: /reference/responses/{name}_symbol.svg
   :alt: {name} in a diagram

.. image:: /reference/responses/{name}.svg
   :alt: Response of {name} in this diagram: inputs dashed, outputs solid

"""
_MATRICES: dict[str, Any] = {"A": ((0.0, 1.0), (-20.0, -2.0)), "B": ((0.0,), (20.0,)), "C": ((1.0, 0.0),)}
_ELLIPSE = b.Ellipse(semi_axes=(0.3, 0.15))


@dataclass(frozen=True)
class Example:
    """A block, the sources at its inputs, and what is shown of it."""

    block: Block
    inputs: Mapping[str, Block | Call | Signal] = field(default_factory=dict)
    duration: float = 1.0  # s
    sample_time: float | None = None  # s; None leaves the block in continuous time
    outputs: tuple[str, ...] = ()  # to show; all where it is empty
    hidden: tuple[str, ...] = ()  # inputs that are wired and not shown


def _sine(amplitude: float = 1.0, frequency: float = 1.0, bias: float = 0.0, **options: Any) -> Block:
    return b.Sine(amplitude=amplitude, frequency=frequency, bias=bias, **options)


def _step(time: float = 0.1, value: float = 1.0, name: str = "step") -> Block:
    return b.Step(times=time, values=value, name=name)


def _pulses(period: float = 0.4, delay: float = 0.1, name: str = "pulses") -> Block:
    return b.PulseTrain(period=period, delay=delay, name=name)


def _around() -> Call:
    """Return a position that goes around next to the ellipse."""
    turn = b.Function(
        lambda t: np.stack([0.32 * np.cos(2 * np.pi * t), 0.17 * np.sin(2 * np.pi * t)]),
        name="around",
        arguments=("t",),
    )
    return turn(b.Clock(unit=None)())


def _speed() -> Call:
    """Return the velocity of that position."""
    rate = b.Function(
        lambda t: 2 * np.pi * np.stack([-0.32 * np.sin(2 * np.pi * t), 0.17 * np.cos(2 * np.pi * t)]),
        name="speed",
        arguments=("t",),
    )
    return rate(b.Clock(unit=None, name="time")())


def _foot(position: Call) -> Signal:
    """Return the foot point of a position on the ellipse."""
    return b.PathProjection(_ELLIPSE, name="projection")(position).theta


def examples() -> dict[str, Example]:
    """Return an example of each block of the library, by the name of its class."""
    from loopwright.fmus import gantry

    around = _around()
    foot = _foot(around)
    wave, pulses, step = _sine(), _pulses(), _step()
    zero = b.Constant(value=(0.0, 0.0), name="zero")
    kick = {"u": step}
    found: list[Example] = [
        # sources
        Example(b.Constant(value=1.0)),
        Example(b.Reference(1.0)),
        Example(b.Clock()),
        Example(b.Step(times=(0.2, 0.6), values=(1.0, -1.0))),
        Example(b.Ramp(slope=2.0, start_time=0.3)),
        Example(b.Pulse(start_time=0.1, end_time=0.8, amplitude=1.0)),
        Example(b.PulseTrain(period=0.3, duty=0.3, delay=0.1)),
        Example(b.Sawtooth(period=0.3, delay=0.1)),
        Example(b.Triangle(period=0.3, rise=0.3, delay=0.1)),
        Example(b.SmoothStep(levels=(0.0, 1.0, 0.4), start_times=(0.5, 2.5), durations=(1.5, 1.0)), duration=4.0),
        Example(b.Sine(frequency=2.0, bias=0.5)),
        Example(b.Chirp(start_frequency=1.0, end_frequency=12.0, duration=0.9)),
        Example(b.PiecewiseLinear(times=(0.1, 0.4, 0.7), values=(0.0, 1.0, -1.0))),
        Example(b.Recorded(times=(0.0, 0.2, 0.5, 0.8), values=(0.0, 1.0, 0.3, 0.6), interpolation="previous")),
        Example(b.BandLimitedNoise(sample_time=0.02, seed=3)),
        Example(b.HandProfile(start_time=0.1, hold_time=0.2, peak_force=5.0)),
        # algebra and functions
        Example(b.Sum(signs="+-"), {"u1": wave, "u2": step}),
        Example(b.Gain(gain=2.0), {"u": wave}),
        Example(b.Product(), {"u1": wave, "u2": _sine(frequency=8.0, name="fast")}),
        Example(b.Power(exponent=2), {"u": wave}),
        Example(b.Demux((1, 1)), {"u": b.Stack()(wave(), step())}),
        Example(b.Stack(), {"u1": wave, "u2": step}),
        Example(b.Minimum(), {"u1": wave, "u2": _sine(phase=2.0, name="other")}),
        Example(b.Maximum(), {"u1": wave, "u2": _sine(phase=2.0, name="other")}),
        Example(b.Saturation(lower=-0.8, upper=0.5), {"u": wave}),
        Example(b.DeadZone(limit=0.5), {"u": wave}),
        Example(b.UnitConversion(from_unit="degC", to_unit="K"), {"u": _sine(20.0, unit="degC")}),
        Example(b.Lookup1D(breakpoints=(-1.0, 0.0, 0.5, 1.0), values=(0.5, 0.0, 1.0, 0.8)), {"u": wave}),
        Example(
            b.Lookup2D(rows=(-1.0, 1.0), columns=(-1.0, 0.0, 1.0), values=((0.0, 1.0, 2.0), (3.0, 1.0, 0.0))),
            {"u1": wave, "u2": _sine(phase=2.0, name="other")},
        ),
        Example(b.Function(lambda u: np.tanh(3 * u), name="function"), {"u": wave}),
        Example(b.PythonFunction(abs, arguments=("u",), name="python_function"), {"u": wave}, sample_time=0.02),
        # nonlinear blocks with memory
        Example(b.Quantizer(quantum=0.25), {"u": wave}),
        Example(b.Relay(on_point=0.5, off_point=-0.5), {"u": wave}),
        Example(b.Backlash(width=0.6), {"u": wave}, sample_time=0.01),
        Example(b.RateLimiter(rising=4.0, falling=3.0), {"u": pulses}, sample_time=0.01),
        # logic and control flow
        Example(b.Compare(">"), {"u1": wave, "u2": b.Constant(value=0.5)}),
        Example(b.And(), {"u1": pulses, "u2": _pulses(0.3, 0.0, "others")}),
        Example(b.Or(), {"u1": pulses, "u2": _pulses(0.3, 0.0, "others")}),
        Example(b.Not(), {"u": pulses}),
        Example(b.Switch(), {"condition": pulses, "then": wave, "otherwise": b.Constant(value=-0.5)}),
        Example(b.EdgeDetector(), {"u": pulses}, sample_time=0.02),
        Example(b.Latch(), {"set": _step(0.2), "reset": _step(0.6, name="reset")}),
        Example(b.Counter(), {"u": _pulses(0.2, 0.05)}),
        Example(
            b.StateMachine(
                modes=("approach", "contact", "retract"),
                transitions={("approach", "contact"): "touch", ("contact", "retract"): "done"},
            ),
            {"touch": _step(0.3), "done": _step(0.7, name="done")},
            outputs=("mode",),
        ),
        Example(b.StopCondition(), {"u": _step(0.6)}),
        Example(b.Requirement("it stays small", upper=0.8, on_violation="record"), {"u": wave}, outputs=("violated",)),
        # continuous
        Example(b.Integrator(), {"u": wave}),
        Example(b.LimitedIntegrator(lower=-0.1, upper=0.1), {"u": wave}, outputs=("y",)),
        Example(b.ResettableIntegrator(), {"u": b.Constant(value=1.0), "reset": pulses}, outputs=("y",)),
        Example(b.FilteredDerivative(time_constant=0.03), {"u": wave}),
        Example(b.TransferFunction(numerator=(20.0,), denominator=(1.0, 4.0, 20.0)), kick, 2.0),
        Example(b.ZeroPoleGain(zeros=(5.0,), poles=(-4.0 + 4.0j, -4.0 - 4.0j), gain=-6.4), kick, 2.0),
        Example(b.StateSpace(**_MATRICES, name="state_space"), {"u": b.Stack(count=1)(step())}, 4.0),
        Example(b.PT1(gain=1.5, time_constant=0.2), kick),
        Example(b.PT2(time_constant=0.1, damping_ratio=0.3), kick, 2.0),
        Example(b.LeadLag(lead_time=0.3, lag_time=0.1), kick),
        Example(b.Notch(frequency=4.0, bandwidth=2.0), {"u": _sine(frequency=4.0)}, 2.0),
        Example(b.Butterworth(order=4, cutoff=3.0), {"u": pulses}, 2.0),
        Example(b.StateFeedback((1.0, 2.0)), {"state": b.Stack()(wave(), step())}, outputs=("y",)),
        Example(
            b.Observer(b.StateSpace(A=((0.0, 1.0), (-20.0, -2.0)), B=(0.0, 20.0), C=(1.0, 0.0)), gain=(18.0, 46.0)),
            {"u": b.Constant(value=0.0, name="u"), "y": wave},
            outputs=("x_hat",),
            hidden=("u",),
        ),
        Example(
            b.PID(kp=1.0, ki=4.0, kd=0.05, filter_time=0.02, lower=-2.0, upper=2.0),
            {"r": step, "y": b.Constant(value=0.0, name="y")},
            outputs=("u",),
            hidden=("y",),
        ),
        Example(b.PadeDelay(delay=0.3, order=4), kick),
        Example(b.TransportDelay(delay=0.3), {"u": wave}),
        # sampled
        Example(b.UnitDelay(), {"u": wave}, sample_time=0.1),
        Example(b.Delay(steps=3), {"u": wave}, sample_time=0.05),
        Example(
            b.VariableDelay(samples=10),
            {"u": wave, "delay": b.Ramp(slope=0.4, name="ramp")},
            sample_time=0.05,
            hidden=("delay",),
        ),
        Example(b.Hold(), {"u": wave}, sample_time=0.1),
        Example(b.DiscreteIntegrator(), {"u": wave}, sample_time=0.05, outputs=("y",)),
        Example(b.DiscreteTransferFunction(numerator=(0.3,), denominator=(1.0, -0.7)), kick, sample_time=0.05),
        Example(b.DiscreteZeroPoleGain(zeros=(), poles=(0.7,), gain=0.3), kick, sample_time=0.05),
        Example(
            b.DiscreteStateSpace(A=((0.7,),), B=((0.3,),), C=((1.0,),)),
            {"u": b.Stack(count=1)(step())},
            sample_time=0.05,
        ),
        Example(
            b.DiscreteObserver(
                b.DiscreteStateSpace(A=((1.0, 0.05), (0.0, 1.0)), B=(0.0, 0.05), C=(1.0, 0.0)), (0.8, 3.0)
            ),
            {"u": b.Constant(value=0.0, name="u"), "y": wave},
            sample_time=0.05,
            outputs=("x_hat",),
            hidden=("u",),
        ),
        Example(b.FIR(coefficients=(0.4, 0.3, 0.2, 0.1)), {"u": pulses}, sample_time=0.02),
        Example(b.IIR(b=(0.2, 0.1), a=(1.0, -0.7)), {"u": pulses}, sample_time=0.02),
        Example(b.MovingAverage(samples=5), {"u": pulses}, sample_time=0.02),
        # path following and compliance
        Example(b.PathProjection(_ELLIPSE), {"position": around}),
        Example(
            b.TransverseTransform(_ELLIPSE),
            {"theta": foot, "position": around, "velocity": _speed()},
            outputs=("eta", "xi"),
            hidden=("theta", "position", "velocity"),
        ),
        Example(
            b.ForceProjection(_ELLIPSE),
            {"theta": foot, "force": b.Constant(value=(1.0, 0.0), name="force")},
            hidden=("theta",),
        ),
        Example(
            b.FeedbackLinearization(_ELLIPSE, gantry.nominal),
            {
                "theta": foot,
                "position": around,
                "velocity": _speed(),
                "force": zero,
                "v_par": b.Constant(value=0.0, name="v_par"),
                "v_perp": b.Constant(value=0.0, name="v_perp"),
            },
            hidden=("theta", "position", "velocity", "force", "v_par", "v_perp"),
        ),
        Example(
            b.ErrorDynamics.from_poles([-5.0] * 3),
            {"coordinate": b.Constant(value=(0.1, 0.0), name="coordinate"), "reference": b.Reference(0.0)},
            2.0,
            hidden=("reference",),
        ),
        Example(
            b.AdmittanceFilter(mass=0.5, damping_ratio=0.3, stiffness=50.0),
            {"force": _step(0.2, 5.0), "reference": b.Reference(0.0)},
            3.0,
            hidden=("reference",),
        ),
        # sensors and environments
        Example(
            b.Encoder(quantum=0.2),
            {"position": _sine(), "velocity": _sine(2 * np.pi, phase=np.pi / 2, name="rate")},
            sample_time=0.05,
            outputs=("measured_position",),
            hidden=("velocity",),
        ),
        Example(
            b.ForceSensor(tool_mass=0.5),
            {"force": b.Constant(value=(1.0, 0.0), name="force"), "acceleration": b.Stack()(wave(), step())},
        ),
        Example(
            b.HandForce(_ELLIPSE),
            {"position": around, "f_perp": b.Constant(value=2.0, name="f_perp")},
            hidden=("position",),
        ),
        Example(
            b.PathSpring(_ELLIPSE, stiffness=100.0),
            {"position": b.Stack()(_sine(0.03, bias=0.29)(), b.Constant(value=0.0)())},
        ),
        Example(
            b.SpringDamper(stiffness=10.0, damping=0.1),
            {"position": wave, "velocity": _sine(6.28, phase=1.571, name="rate")},
            hidden=("velocity",),
        ),
        Example(b.Wall(stiffness=100.0, point=0.5, normal=-1.0), {"position": wave}, outputs=("force",)),
    ]
    return {type(example.block).__name__: example for example in found}


def _wired(example: Example) -> Any:
    """Return the diagram of an example."""
    from loopwright.diagrams import Diagram, subsystem

    wires = {port: source() if isinstance(source, Block) else source for port, source in example.inputs.items()}
    if example.sample_time is None:
        return Diagram("example", example.block(**wires))
    block = example.block
    calls = {
        0: block,
        1: lambda a: block(**dict(zip(wires, [a], strict=True))),
        2: lambda a, c: block(**dict(zip(wires, [a, c], strict=True))),
    }
    return Diagram("example", subsystem(sample_time=example.sample_time)(calls[len(wires)])(*wires.values()))


def _draw(axes: Axes, example: Example, diagram: Any) -> None:
    """Run the diagram of an example and draw its signals."""
    step = example.duration / 500
    run = diagram.simulate(example.duration, step=step, progress=False)
    path = next(path for path, block in diagram.blocks.items() if block == example.block)
    shown = [port for port in example.inputs if port not in example.hidden]
    for port in shown:
        wire = diagram.wires[path, port]
        values = np.reshape(run[str(wire)], (len(run.t), -1))
        axes.plot(run.t, values, color=_GREY, lw=1.0, ls="--", label=port)
    for color, port in zip(_COLORS * 3, example.outputs or tuple(example.block.outputs), strict=False):
        values = np.reshape(run[f"{path}.{port}"], (len(run.t), -1))
        for i, column in enumerate(values.T):
            label = port if values.shape[1] == 1 else f"{port}[{i + 1}]"
            shade = color if values.shape[1] == 1 else _COLORS[(_COLORS.index(color) + i) % len(_COLORS)]
            axes.plot(run.t, column, color=shade, lw=1.5, label=label)
    handles, labels = axes.get_legend_handles_labels()
    known = dict(zip(labels, handles, strict=True))
    axes.legend(known.values(), known.keys(), frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_xlabel("t in s")
    axes.margins(x=0.0)


def draw_all(folder: Path) -> dict[str, str]:
    """Write the pictures of all blocks into a folder, and return the lines that show them, by the blocks' names."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, example in examples().items():
        diagram = _wired(example)
        with matplotlib.rc_context(_STYLE):
            figure = Figure(figsize=(5.2, 2.0))
            _draw(figure.add_axes(_PLACE), example, diagram)
            figure.savefig(folder / f"{name}.svg", transparent=True, metadata={"Date": None})
        diagram.draw().save(folder / f"{name}_symbol.svg")
        found[name] = _SHOWN.format(name=name)
    return found

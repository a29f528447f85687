"""Names that users of other tools look for (Simulink, python-control, FMPy, pathsim, bdsim), and what to write here."""

_LINEAR = 'diagram.linearize() returns the linear model, and its .loop("wire") the loop at a wire'
_METHODS = {
    "simulate": "diagram.simulate(2.0) returns the run",
    "sim": "diagram.simulate(2.0) returns the run",
    "linearize": _LINEAR,
    "linmod": _LINEAR,
    "dlinmod": _LINEAR,
    "trim": "diagram.trim(…) finds the point",
    "report": 'diagram.report("loop.html") writes it',
    "draw": "diagram.draw() draws it",
    "plot": 'run = diagram.simulate(2.0), then run.plot("wire")',
    "sweep": "diagram.sweep(…) runs it with many values",
    "worst_case": "diagram.worst_case(…) searches for it",
}
_BLOCKS = {
    "Abs": "abs(a) of a signal makes the block",
    "Add": "a + b adds two signals, and the block is Sum",
    "Adder": "a + b adds two signals, and the block is Sum",
    "Amplifier": "the block is Gain, or 2.0 * signal",
    "BusCreator": 'a mapping of signals is a bus: return {"speed": speed, "angle": angle} from a subsystem',
    "BusSelector": 'a bus is read by its names: bus["speed"]',
    "Derivative": "the block is FilteredDerivative",
    "Differentiator": "the block is FilteredDerivative",
    "Divide": "a / b divides two signals",
    "Fcn": "the block is Function, and PythonFunction for Python that can't be traced",
    "Comparator": "a < b of two signals makes the block Compare",
    "DeadTime": "the block is TransportDelay",
    "FirstOrder": "the block is PT1",
    "FirstOrderHold": "the function is loopwright.diagrams.first_order_hold",
    "FirstOrderLag": "the block is PT1",
    "FOH": "the function is loopwright.diagrams.first_order_hold",
    "FromWorkspace": "the block is Recorded",
    "FromFile": "the block is Recorded",
    "Hysteresis": "the block is Relay, which switches at two points, and play is Backlash",
    "Kalman": "the blocks are Observer.from_lqe(…) and DiscreteObserver.from_lqe(…)",
    "KalmanFilter": "the blocks are Observer.from_lqe(…) and DiscreteObserver.from_lqe(…)",
    "Lag": "the block is PT1",
    "Limiter": "the block is Saturation",
    "LowPass": "the blocks are PT1 and PT2",
    "LowPassFilter": "the blocks are PT1 and PT2",
    "Lookup": "the blocks are Lookup1D and Lookup2D",
    "LookupTable": "the blocks are Lookup1D and Lookup2D",
    "LUT": "the block is Lookup2D",
    "LUT1D": "the block is Lookup1D",
    "LQR": "the block is StateFeedback.from_lqr(…)",
    "Luenberger": "the blocks are Observer and DiscreteObserver",
    "LuenbergerObserver": "the blocks are Observer and DiscreteObserver",
    "MathFunction": "NumPy's functions of signals make the block: np.exp(a), np.hypot(a, b)",
    "MATLABFunction": "the block is Function, and PythonFunction for Python that can't be traced",
    "Multiplier": "a * b multiplies two signals, and the block is Product",
    "Memory": "the block is Delay",
    "MinMax": "np.minimum(a, b) and np.maximum(a, b) make the blocks Minimum and Maximum",
    "MultiPortSwitch": "the block is Switch",
    "Noise": "the block is BandLimitedNoise",
    "PI": "the block is PID, with kp=… and ki=…",
    "PIController": "the block is PID, with kp=… and ki=…",
    "PD": "the block is PID, with kp=…, kd=… and filter_time=…",
    "PIDController": "the block is PID",
    "PulseGenerator": "the block is PulseTrain",
    "RandomNumber": "the block is BandLimitedNoise",
    "RelationalOperator": "a < b of two signals makes the block Compare",
    "RepeatingSequence": "the blocks are Sawtooth and Triangle, and Recorded for others",
    "RateTransition": "none is needed: each @subsystem(sample_time=…) samples its inputs, and holds its outputs",
    "SFunction": "a block with its own equations is a class of loopwright.Block",
    "SignalGenerator": "the blocks are Sine, Sawtooth, Triangle, PulseTrain and others",
    "SinusoidalSource": "the block is Sine",
    "SineWave": "the block is Sine",
    "SecondOrder": "the block is PT2",
    "SecondOrderLag": "the block is PT2",
    "Sqrt": "np.sqrt(a) of a signal makes the block",
    "Source": "the blocks are Constant, Step, Sine and others, and Function of a Clock for any other",
    "SquareWave": "the block is PulseTrain",
    "StepSource": "the block is Step",
    "Subtract": "a - b subtracts two signals, and the block is Sum",
    "TransferFcn": "the block is TransferFunction",
    "Trigonometry": "NumPy's functions of signals make the block: np.sin(a)",
    "VariableTransportDelay": "the block is VariableDelay",
    "WhiteNoise": "the block is BandLimitedNoise",
    "ZeroOrderHold": "@subsystem(sample_time=…) samples its inputs, and holds its outputs",
    "ZOH": "@subsystem(sample_time=…) samples its inputs, and holds its outputs",
}
_PARTS = {
    "BDSim": 'a diagram is Diagram("name", plant(force=u)), run by diagram.simulate(2.0)',
    "Connection": "a call wires: plant(force=controller(plant.position))",
    "Display": 'a run has all values: run["wire"][-1]',
    "FMU": 'the block is Fmu("plant.fmu")',
    "CoSimulationFMU": 'the block is Fmu("plant.fmu")',
    "ModelExchangeFMU": 'the block is Fmu("plant.fmu", interface="model_exchange")',
    "From": "none is needed: a signal is a Python variable, used wherever it is wanted",
    "Goto": "none is needed: a signal is a Python variable, used wherever it is wanted",
    "Inport": "an argument of a function with @subsystem is its input",
    "Model": 'a diagram is Diagram("name", plant(force=u))',
    "Outport": "what a function with @subsystem returns are its outputs",
    "Scope": 'give the wire a name, signal.named("speed"), and plot it after the run: run.plot("speed")',
    "SCOPE": 'give the wire a name, signal.named("speed"), and plot it after the run: run.plot("speed")',
    "Simulation": 'make Diagram("name", plant(force=u)), and run it by diagram.simulate(2.0)',
    "Subsystem": "a function with @subsystem is one",
    "SubSystem": "a function with @subsystem is one",
    "Terminator": "none is needed: outputs may be left unwired",
    "Ground": "the block is Constant(value=0.0), and an input that takes a default may be left unwired",
    "ToWorkspace": 'every output is recorded: run["wire"]',
    "ToFile": 'every output is recorded: run.to_csv("run.csv")',
    "Workspace": 'every output is recorded: run["wire"]',
    "connect": "a call wires: plant(force=controller(plant.position))",
    "dump": 'an FMU is described by read_description("plant.fmu"), or the command loopwright inspect plant.fmu',
    "interconnect": "a call wires: plant(force=controller(plant.position))",
    "simulate_fmu": 'make Diagram("name", Fmu("plant.fmu")()), and run it by diagram.simulate(2.0)',
    "simulate_ssp": 'make Diagram.from_ssp("system.ssp"), and run it by diagram.simulate(2.0, step=0.01)',
    "plot_result": 'a run is plotted by run.plot("wire")',
    "validate_fmu": 'an FMU is examined by doctor("plant.fmu"), or the command loopwright validate plant.fmu',
}
_CONTROL = {
    "tf": "the block is TransferFunction(numerator=…, denominator=…)",
    "ss": "the block is StateSpace(A=…, B=…, C=…, D=…)",
    "zpk": "the block is ZeroPoleGain",
    "c2d": "@subsystem(sample_time=…) discretizes what is inside",
    "feedback": "a call wires: plant(force=controller(plant.position))",
    "series": "a call wires: second(first(u))",
    "parallel": "signals add up: first(u) + second(u)",
    "pade": "the block is PadeDelay",
}
_OF_LOOPS = (
    *("bode", "bode_plot", "nyquist", "nyquist_plot", "nichols", "nichols_plot", "root_locus", "rlocus"),
    *("step_response", "impulse_response", "forced_response", "damp", "minreal"),
)
_GAINS = {
    "lqr": "StateFeedback.from_lqr(system, Q, R)",
    "dlqr": "StateFeedback.from_lqr(system, Q, R)",
    "lqe": "Observer.from_lqe(system, QN, RN)",
    "dlqe": "DiscreteObserver.from_lqe(system, QN, RN)",
}
_OF_MATRICES = ("care", "dare", "ctrb", "obsv", "gram", "frd", "rss", "acker")
_LOOP = 'diagram.linearize().loop("wire")'

WAYS = {
    **{name: f"It is a method of a diagram: {text}." for name, text in _METHODS.items()},
    **{name: f"Here {text}; blocks are in loopwright.blocks." for name, text in _BLOCKS.items()},
    **{name: f"{text[0].upper()}{text[1:]}." for name, text in _PARTS.items()},
    **{name: f"It is python-control's: control.{name}(…). Here {text}." for name, text in _CONTROL.items()},
    **{name: f"It is python-control's, which takes a loop: control.{name}({_LOOP})." for name in _OF_LOOPS},
    **{name: f"It is python-control's, control.{name}; here the block is {text}." for name, text in _GAINS.items()},
    **{name: f"It is python-control's: from control import {name}." for name in _OF_MATRICES},
    "margin": f"Here it is margins({_LOOP}): from loopwright import margins.",
    "stability_margins": f"Here it is margins({_LOOP}): from loopwright import margins.",
    **dict.fromkeys(("step_info", "stepinfo"), 'It is a method of a run: diagram.simulate(2.0).step_info("wire").'),
}
"""What an error says for such a name, where no package here has it or the name means something else."""

_IDEAL = "PID.from_ideal_form(gain=…, integral_time=…, derivative_time=…), or kp=K, ki=K/Ti, kd=K*Td"
_LIMITS = {
    **dict.fromkeys(("min", "umin", "u_min", "minimum", "lower_limit", "lo", "low"), "lower=…"),
    **dict.fromkeys(("max", "umax", "u_max", "maximum", "upper_limit", "hi", "high"), "upper=…"),
    **dict.fromkeys(("limits", "bounds", "output_limits"), "lower=…, upper=…"),
}
_MATRICES = dict.fromkeys(("A", "B", "C", "D", "L"), "the plant by position: Observer(control.ss(A, B, C, D), gain=L)")
_LAG = {
    **dict.fromkeys(("K", "k", "Kp"), "gain=…"),
    **dict.fromkeys(("T", "T1", "tau", "time"), "time_constant=…"),
    **dict.fromkeys(("x0", "y0"), "initial_value=…"),
}

KEYWORDS: dict[str, dict[str, str]] = {
    "PID": {
        **_LIMITS,
        **dict.fromkeys(("K", "Kc", "gain", "Ti", "ti", "Td", "td", "Tv", "Tn"), _IDEAL),
        **dict.fromkeys(("P", "p", "Kp", "KP"), "kp=…"),
        **dict.fromkeys(("I", "i", "Ki", "KI"), "ki=…"),
        **dict.fromkeys(("D", "d", "Kd", "KD"), "kd=…"),
        **dict.fromkeys(("N", "n"), "filter_time=1/N, or PID.from_ideal_form(…, ratio=N)"),
        **dict.fromkeys(("Tf", "tf", "tau"), "filter_time=…"),
        **dict.fromkeys(("setpoint", "reference", "target"), "it as a wire: pid(r=…, y=…)"),
    },
    "Saturation": _LIMITS,
    "DeadZone": {**_LIMITS, "start": "lower=…", "end": "upper=…", "width": "limit=…, which is half of it"},
    "Observer": _MATRICES,
    "DiscreteObserver": _MATRICES,
    "StateFeedback": dict.fromkeys(("K", "k", "F", "gains"), "gain=…"),
    "TransferFunction": dict.fromkeys(("b", "B"), "numerator=…") | dict.fromkeys(("a", "A"), "denominator=…"),
    "StateSpace": dict.fromkeys(("x0", "initial_value"), "initial_state=…"),
    "Gain": dict.fromkeys(("k", "K", "value", "factor"), "gain=…"),
    "Constant": dict.fromkeys(("c", "k", "y"), "value=…"),
    "Step": {
        **dict.fromkeys(("time", "t", "t0", "step_time", "start_time", "at"), "times=…"),
        **dict.fromkeys(("value", "amplitude", "height", "final_value", "size", "after", "y"), "values=…"),
        **dict.fromkeys(("initial", "before", "offset"), "initial_value=…"),
    },
    "Sine": {
        **dict.fromkeys(("f", "freq"), "frequency=…, in Hz"),
        **dict.fromkeys(("omega", "w"), "frequency=omega/(2*np.pi), which is in Hz"),
        **dict.fromkeys(("a", "A", "amp"), "amplitude=…"),
        "offset": "bias=…",
    },
    "PT1": _LAG,
    "PT2": _LAG | dict.fromkeys(("d", "D", "zeta", "damping"), "damping_ratio=…"),
    "Integrator": dict.fromkeys(("x0", "y0", "initial_state"), "initial_value=…")
    | dict.fromkeys(("gain", "k", "K"), "Integrator()(k * u)"),
    "TransportDelay": dict.fromkeys(("Td", "td", "T", "tau", "time", "theta"), "delay=…, in s"),
    "Delay": dict.fromkeys(("delay", "n", "samples", "length"), "steps=…"),
    "Quantizer": dict.fromkeys(("interval", "step", "q", "resolution"), "quantum=…"),
    "Encoder": {
        **dict.fromkeys(("interval", "step", "q", "resolution"), "quantum=…"),
        **dict.fromkeys(("counts", "lines", "cpr", "ppr"), "quantum=2*np.pi/counts"),
    },
    "RateLimiter": dict.fromkeys(("rate", "slew", "limit", "slew_rate", "max_rate"), "rising=…, falling=…"),
    "Lookup1D": dict.fromkeys(("x", "xs", "points", "bp"), "breakpoints=…") | dict.fromkeys(("y", "ys"), "values=…"),
    "BandLimitedNoise": {
        **dict.fromkeys(("power", "density", "psd"), "BandLimitedNoise.from_density(density=…, sample_time=…)"),
        **dict.fromkeys(("std", "sigma"), "variance=std**2"),
    },
}
"""By a block's class: what to write for keywords that other tools and textbooks have for its parameters."""
BY_POSITION = {
    "Saturation": ("lower", "upper"),
    "DeadZone": ("lower", "upper"),
}
"""By a block's class: the parameters that people mean by position, where it is not the order of declaration."""
OF_ANY_BLOCK = dict.fromkeys(
    ("sample_time", "Ts", "dt", "ts"), "a sample time of the subsystem that the block is in: @subsystem(sample_time=…)"
)
"""The same for keywords that are no block's."""
UNITS = {
    **dict.fromkeys(("meter", "metre", "meters"), "m"),
    **dict.fromkeys(("second", "seconds", "sec"), "s"),
    **dict.fromkeys(("minute", "minutes"), "min"),
    **dict.fromkeys(("hour", "hours"), "h"),
    **dict.fromkeys(("kilogram", "kilograms"), "kg"),
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("ampere", "amperes", "amp", "amps"), "A"),
    **dict.fromkeys(("ohm", "ohms"), "Ohm"),
    **dict.fromkeys(("watt", "watts"), "W"),
    **dict.fromkeys(("joule", "joules"), "J"),
    **dict.fromkeys(("pascal", "pascals"), "Pa"),
    **dict.fromkeys(("kelvin",), "K"),
    **dict.fromkeys(("celsius",), "degC"),
    **dict.fromkeys(("hertz",), "Hz"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("degree", "degrees"), "deg"),
    **dict.fromkeys(("percent",), "%"),
    **dict.fromkeys(("litre", "liter"), "L"),
    **dict.fromkeys(("henry",), "H"),
    **dict.fromkeys(("farad",), "F"),
    **dict.fromkeys(("tesla",), "T"),
    **dict.fromkeys(("kmh", "kph"), "km/h"),
}
"""Symbols of units that are written out, in lower case."""

STEP = ("dt", "h", "Ts", "sample_time", "step_size", "stepsize", "fixed_step", "time_step", "communication_step")
"""Other words for the step of a run."""
_END = (
    *("t_end", "t_final", "t_stop", "t_max", "tf", "T", "Tf", "t", "time", "tmax"),
    *("stop_time", "final_time", "until", "tspan", "t_span", "end", "stop"),
)
DURATION = dict.fromkeys(_END, "the duration in s, the first argument: simulate(2.0)")
"""What to write for other words for the length of a run."""
RUN_OPTIONS = {
    **DURATION,
    **dict.fromkeys(STEP, "step=… (seconds)"),
    **dict.fromkeys(("method", "integrator", "Solver"), 'solver="RK45" or another one'),
    **dict.fromkeys(("reltol", "rel_tol", "tol", "tolerance", "tolerance_lte_rel"), "rtol=…"),
    **dict.fromkeys(("abstol", "abs_tol", "tolerance_lte_abs"), "atol=…"),
    **dict.fromkeys(("dt_max", "maxstep", "hmax"), "max_step=…"),
    **dict.fromkeys(("output_interval", "decimation"), "every=…, which keeps each such sample"),
    **dict.fromkeys(("input", "inputs"), "a block that is wired to the input, such as Step or Recorded"),
    **dict.fromkeys(("x0", "initial_state"), "start=…, a state or an operating point"),
    "start_values": "Fmu(…, start={…}) or diagram.replace(…)",
    "output": "record=[…], the signals to keep",
    "outputs": "record=[…], the signals to keep",
}
"""What an error offers for words that other tools have for options of a run."""
POINT = dict.fromkeys(("point", "operating_point", "t", "time", "x0", "op"), "at=…, a time in s, run.at(t) or a point")
"""What to write for other words for the operating point of an analysis."""

"""Export of a block as an FMU."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, cast

import casadi as ca
import numpy as np

from ...blocks.core import (
    Block,
    DefinitionError,
    Layout,
    LoopwrightError,
    OptionError,
    ParameterSpec,
    Port,
    Shape,
    accepts,
    kinds,
)
from ...blocks.tracing import GUARDS, NEXT, Traced, constants_of, trace, traced_parameters
from ..exported_models import make_exported
from .fmu_package import build_fmu, check_version
from .html_page import block_text
from .internal_step import choose_internal_step, compare_internal_step
from .model_spec import EventSpec, Integrator, ModelSpec, Variable

_TINY = float(np.finfo(float).tiny)  # the least positive number that is not denormal


@accepts(name=kinds.text)
def model_spec(
    block: Block,
    *,
    name: str | None = None,
    internal_step: float = 1e-3,
    stop_time: float = 1.0,
    step_size: float = 1e-3,
    integrator: Integrator = "rk4",
    tolerance: float = 1e-8,
) -> ModelSpec:
    """Return the model of a continuous block: its variables, and its equations as CasADi functions.

    States that are outputs become output variables; the other outputs are computed. All parameters are symbols, so
    that each can be set in the FMU.

    Raises
    ------
    DefinitionError
        If the block has no ``derivative``, or a port without a declared shape.
    TraceError
        If its equations can't be traced.
    """
    name = name or type(block).__name__.lower()
    try:
        return _model_spec(
            block,
            name,
            internal_step=internal_step,
            stop_time=stop_time,
            step_size=step_size,
            integrator=integrator,
            tolerance=tolerance,
        )
    except LoopwrightError as error:
        error.at(block=name)
        raise


def _model_spec(block: Block, name: str, **experiment: Any) -> ModelSpec:
    _check_exportable(block, name)
    shapes = {port: spec.shape or () for port, spec in block.inputs.items()}
    equations = _BlockEquations(block, trace(block, shapes, sampled=False, zeros=False))
    traced = equations.traced
    computed = [n for n in block.outputs if n not in block.states]
    return ModelSpec(
        name=name,
        description=(type(block).__doc__ or name).strip().splitlines()[0],
        inputs=tuple(
            _variable(port, "input", shape=shapes[n], start=0.0 if port.default is None else port.default)
            for n, port in block.inputs.items()
        ),
        outputs=tuple(_variable(block.outputs[n], "output", shape=traced.outputs[n]) for n in computed),
        parameters=tuple(parameter_variable(block, n, v) for n, v in traced_parameters(block)),
        states=tuple(_state(block, n, traced.states[n], shapes) for n in equations.order),
        derivative=equations.derivative(),
        output=equations.output(computed),
        events=tuple(
            EventSpec(n, cast(Any, port.direction), port.description, port.nominal or 1.0)
            for n, port in block.events.items()
        ),
        indicators=equations.indicators(),
        jump=equations.jump(),
        **experiment,
    )


class _BlockEquations:
    """A block's traced equations as functions of (t, x, u, p), with the discrete states behind the continuous ones."""

    def __init__(self, block: Block, traced: Traced):
        self.block, self.traced = block, traced
        states = block.states
        self.order = sorted(states, key=lambda n: states[n].discrete)
        layout, inputs = Layout.of(traced.states), Layout.of(traced.inputs)
        self._rows = layout.entries(self.order)
        self._n_continuous = len(layout.entries(n for n in self.order if not states[n].discrete))
        f = traced.function
        self.t, self.x, self.u = ca.MX.sym("t"), ca.MX.sym("x", len(self._rows)), ca.MX.sym("u", inputs.total)
        self.p = ca.MX.sym("p", sum(np.size(v) for _, v in traced_parameters(block)))
        columns = ca.vertsplit(self.u, inputs.cuts) if traced.inputs else []
        x = self.x[[self._rows.index(i) for i in range(len(self._rows))]] if self._rows else self.x
        # a continuous model has no sample time
        constants = [np.ravel(value) for value in constants_of(block, np.nan, traced.method).values()]
        self._arguments = [self.t, x, *columns, ca.vertcat(self.p, 0.0, *constants)]
        names = (*traced.outputs, NEXT, GUARDS)
        self._made = dict(zip(names, f.call(self._arguments), strict=True))

    def _function(self, name: str, result: Any, *more: Any) -> Any:
        return ca.Function(name, [self.t, self.x, self.u, self.p, *more], [result])

    def derivative(self) -> Any:
        """Return the rates of the continuous states."""
        return self._function("derivative", self._made[NEXT][self._rows[: self._n_continuous]])

    def output(self, computed: list[str]) -> Any:
        """Return the computed outputs as one column."""
        return self._function("output", ca.vertcat(*(self._made[n] for n in computed)))

    def indicators(self) -> Any:
        """Return the event indicators; None without events."""
        f = self.traced.indicators
        return None if f is None else self._function("indicators", f.call(self._arguments)[0])

    def jump(self) -> Any:
        """Return the states after an event; None without events."""
        if self.traced.jump is None:
            return None
        fired = ca.MX.sym("fired", len(self.block.events))
        after = self.traced.jump.call([*self._arguments, fired])[0]
        return self._function("jump", after[self._rows], fired)


def _state(block: Block, name: str, shape: Shape, shapes: dict[str, Shape]) -> Variable:
    port = block.states[name]
    return _variable(
        port,
        "output" if port.output else "local",
        variability="discrete" if port.discrete else "continuous",
        shape=shape,
        state=True,
        start=port.start_value(block, shapes),
    )


@accepts(
    name=kinds.text,
    communication=kinds.choice("any", "ticks"),
    solver=kinds.text.or_none(),
    clocks=kinds.flag,
    start=kinds.mapping.or_none(),
    own_functions=kinds.flag,
    arrays=kinds.flag,
)
def build(
    block: Any,
    out: Path | str | None = None,
    *,
    name: str | None = None,
    internal_step: float | None = None,
    stop_time: float = 1.0,
    step_size: float | None = None,
    integrator: Integrator | None = None,
    tolerance: float | None = None,
    fmi: int = 3,
    arrays: bool = True,
    platform: str | Iterable[str] | None = None,
    documentation: str | None = None,
    notify: Callable[[str], None] | None = None,
    subsystem: str | None = None,
    outside: Iterable[str] = (),
    outputs: Iterable[str] | None = None,
    communication: Literal["any", "ticks"] = "any",
    solver: str | None = None,
    clocks: bool = False,
    start: Mapping[str, Any] | None = None,
    own_functions: bool = False,
) -> Path:
    """Export a continuous block, a subsystem or a diagram as an FMU and return the file.

    The equations become C, compiled without Python inside; the build is cached by content.

    A block is a plant, with co-simulation and model exchange. A diagram, or a subsystem such as a controller, is for
    co-simulation; sampled subsystems act at their own ticks inside. A tick acts at the start of a communication step,
    with the inputs that were set for it: step the controller before the plant.

    Parameters
    ----------
    block : Block, Diagram or Subsystem
        A block with a ``derivative``; its parameters become the FMU's start values. Or a diagram, or a function that
        `subsystem` has made a subsystem; then parameters are the FMU's by their paths, named wires are its variables.
    out : path, optional
        File, or folder for it; without it, the file in the cache is returned. A file gets the ending ``.fmu`` if it
        lacks it.
    name : str, optional
        Name of the model; without it, the class name in lower case, or the name of the diagram or subsystem.
    internal_step : float, optional
        Of a block: start value, in s, of the FMU's parameter ``internal_step``: the longest step of its Runge-Kutta
        integrator of order 4. The adaptive integrators choose their steps. Without it and ``integrator``, it is at
        most 1e-3 and a tenth of the time constant of the fastest mode at the start values, which leaves an error of
        8e-7 of that mode in each of its time constants. A model that needs steps below 1e-5 gets the integrator
        "rodas". A step that is given and longer than half that time constant is a warning, and the FMU says so, too,
        when it is initialized with such parameters.
    integrator : {"rk4", "dopri5", "rodas"}, optional
        Of a block: start value of the FMU's parameter ``integrator``, for co-simulation: explicit with a fixed step,
        explicit with an adaptive one, or implicit for stiff models.
    tolerance : float, optional
        Relative error of a step of an adaptive integrator. Of a block it is the start value of the FMU's parameter
        ``tolerance``, 1e-8 without it; of a diagram it is that of the solver, 1e-6 without it.
    stop_time, step_size : float
        Default experiment, s; the step is 1e-3, or the time between two ticks of a diagram.
    fmi : {3, 2}
        FMI 3.0 or FMI 2.0.
    arrays : bool
        Whether vectors and matrices are arrays. Else, and always in FMI 2.0, each element is a variable: ``s[1]``.
    platform : str or iterable of str, optional
        FMI 3.0 platform tuples, such as ``"x86_64-linux"``, or ``"all"``; without it, this machine's.
    documentation : str, optional
        Plain text for the FMU's page of documentation; without it, the block's docstring and the source of its
        equations.
    notify : callable, optional
        Called with a line of text when a compilation starts.
    subsystem : str, optional
        Of a diagram: path of the subsystem to export, in place of the whole. What it reads from around it is the
        FMU's inputs.
    outside : iterable of str, optional
        Of a diagram: paths of blocks that are not exported, such as the plant or a source. What they put out is the
        FMU's inputs, and what they read its outputs.
    outputs : iterable of str, optional
        Of a diagram or subsystem: the signals that are outputs. Without it, those of the subsystem, what the blocks
        outside read, or the named wires of a diagram.
    communication : {"any", "ticks"}
        Of a diagram or subsystem: whether communication steps may have any length, with ticks inside them, or must go
        from tick to tick.
    solver : str, optional
        Of a diagram with continuous states: its solver, as `Diagram.simulate` takes it, but for those of other
        libraries. Without it, "RK45", or "DOP853" for a tolerance below 1e-8, and "Radau" where the fastest mode at the
        start decays more than 50 times within a step of ``step_size``.
    start : mapping of str, optional
        Of a diagram or subsystem: start values of its inputs, by their names. Without them, those that the diagram
        around it has at the start; those of a subsystem by itself are defaults of its arguments, or 0.
    own_functions : bool
        Of a diagram or subsystem: take sine, cosine, tangent hyperbolic, exponential, exp(x) - 1, logarithm and power
        from Loopwright, with the same bits on every platform, and not from the platform's library, with the bits of
        `Diagram.simulate` here. An exported block always has Loopwright's.
    clocks : bool, default False
        Of a diagram or subsystem in FMI 3.0: whether its sample times are periodic input clocks of the FMU, by which an
        importer with Event Mode makes the ticks. One without Event Mode makes its steps as it does without clocks, but
        some can't read an FMU that has any.

    Raises
    ------
    DefinitionError, TraceError
        For what can't be exported, by its path.
    OptionError
        For an option of the other kind of model.
    CompilerError
        If there is no compiler, or it fails.

    Examples
    --------
    ``build(fig3, subsystem="controller")`` and ``build(fig3, outside=["plant"])`` are two ways to export a controller.
    """
    check_version(fmi)
    made = None
    if not isinstance(block, Block | type):
        _refuse_options(block, internal_step=internal_step, integrator=integrator)
        made = make_exported(
            block,
            name=name,
            subsystem=subsystem,
            outside=outside,
            outputs=outputs,
            steps_on_ticks=communication == "ticks",
            offers_clocks=clocks,
            stop_time=stop_time,
            step_size=step_size,
            solver=solver,
            rtol=tolerance,
            start=start,
            own_functions=own_functions,
        )
    if made is not None:
        return build_fmu(
            made, out, fmi=fmi, arrays=arrays, platform=platform, documentation=documentation or "", notify=notify
        )
    # A single block has no parts, ticks or solver of its own to choose.
    of_parts = subsystem or tuple(outside) or outputs is not None or start
    if of_parts or communication != "any" or solver or own_functions or clocks:
        raise OptionError(
            "subsystem=, outside=, outputs=, start=, communication=, solver=, own_functions= and clocks= are options "
            "of diagrams and subsystems. Leave them out.",
            block=name or type(block).__name__.lower(),
        )
    spec = model_spec(
        block,
        name=name,
        internal_step=1e-3 if internal_step is None else internal_step,
        stop_time=stop_time,
        step_size=1e-3 if step_size is None else step_size,
        integrator=integrator or "rk4",
        tolerance=1e-8 if tolerance is None else tolerance,
    )
    # Steps that the user chose are kept, and only compared with finer ones.
    is_chosen = internal_step is None and integrator is None
    spec = choose_internal_step(spec) if is_chosen else compare_internal_step(spec)
    text = block_text(block) if documentation is None else documentation
    return build_fmu(spec, out, fmi=fmi, arrays=arrays, platform=platform, documentation=text, notify=notify)


def _refuse_options(model: object, **options: object) -> None:
    """Refuse options of a block's own integrator for a diagram."""
    given = [name for name, value in options.items() if value is not None]
    if given and not isinstance(model, Block) and (hasattr(model, "wired") or hasattr(model, "control_input")):
        raise OptionError(
            f"found {given[0]}=, which sets the integrator of an exported block; a diagram has none. Leave it out.",
            block=getattr(model, "name", None),
            port=given[0],
        )


def _check_exportable(block: object, name: str) -> None:
    """Refuse a block with parts that an FMU would leave out silently."""
    if isinstance(block, type) or not isinstance(block, Block):
        called = f"the class {block.__name__}" if isinstance(block, type) else repr(block)
        made = f"{block.__name__}(…)" if isinstance(block, type) else "Gantry()"
        raise DefinitionError(f"found {called}; expected a block, such as {made}.")
    if not (hasattr(block, "derivative") or block.events):
        raise DefinitionError(
            "found no derivative(t, x, u); expected a continuous model. Write one, or export another block.", block=name
        )
    for equation, reason in (
        ("guards", "an FMU has no guards"),
        ("initial", "an FMU's states have fixed start values, not computed ones"),
    ):
        if hasattr(block, equation):
            raise DefinitionError(f"it has {equation}(…), but {reason}. Export a block without.", block=name)
    for port, spec in block.inputs.items():
        if spec.shape is None:
            raise DefinitionError("found no declared shape; declare it with Input(shape=…).", block=name, port=port)
    for port, declared in {**block.inputs, **block.outputs, **block.states}.items():
        if isinstance(declared.unit, tuple):
            raise DefinitionError(
                f"found several units, {', '.join(declared.unit)}; a variable of an FMU has one. Split the port.",
                block=name,
                port=port,
            )


def _variable(port: Port, causality: Any, **more: Any) -> Variable:
    unit = port.unit if isinstance(port.unit, str) else None
    limits: dict[str, Any] = {"nominal": port.nominal, "minimum": port.minimum, "maximum": port.maximum}
    return Variable(name=port.name, causality=causality, unit=unit, description=port.description, **limits, **more)


def parameter_spec(block: Block, name: str) -> ParameterSpec:
    """Return the declaration of a parameter of a block, or of one inside it by a name with dots."""
    owner: Any = block
    *outer, last = name.split(".")
    for part in outer:
        owner = owner.__dict__[part]
    found: ParameterSpec = type(owner).parameter_specs[last]
    return found


def parameter_variable(block: Block, name: str, value: Any, full: str | None = None) -> Variable:
    """Return a parameter of a block as a variable, under another name if one is given."""
    spec = parameter_spec(block, name)
    above = spec.above if spec.above is None else float(np.nextafter(spec.above, np.inf)) if spec.above else _TINY
    return Variable(
        name=full or name,
        causality="parameter",
        variability="tunable" if spec.tunable else "fixed",
        shape=np.shape(value),
        unit=spec.unit,
        description=spec.description,
        start=value,
        minimum=spec.minimum if above is None else above,
        maximum=spec.maximum,
    )

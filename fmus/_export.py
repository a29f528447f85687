"""From a block's equations to an FMU."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ..blocks._block import Block
from ..blocks._comparison import NEXT
from ..blocks._errors import DefinitionError
from ..blocks._ports import Port
from ..blocks._tracing import trace, traced_parameters
from ..blocks._values import ParameterSpec
from ._build import build_fmu
from ._spec import ModelSpec, Variable

_TINY = float(np.finfo(float).tiny)  # the least positive number that is not denormal


def model_spec(
    block: Block,
    *,
    name: str | None = None,
    internal_step: float = 1e-3,
    stop_time: float = 1.0,
    step_size: float = 1e-3,
) -> ModelSpec:
    """Return what an FMU of a continuous block consists of: its variables, and its equations as CasADi functions.

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
    _check_exportable(block, name)
    shapes = {port: spec.shape or () for port, spec in block.inputs.items()}
    traced = trace(block, shapes, sampled=False, zeros=False)
    entries = list(traced_parameters(block))
    f = traced.function
    t, x, u = (
        ca.MX.sym("t"),
        ca.MX.sym("x", f.numel_in(1)),
        ca.MX.sym("u", sum(f.numel_in(2 + i) for i in range(len(shapes)))),
    )
    p = ca.MX.sym("p", sum(np.size(v) for _, v in entries))
    offsets = np.cumsum([0, *(f.numel_in(2 + i) for i in range(len(shapes)))])
    parts = [u[int(a) : int(b)] for a, b in itertools.pairwise(offsets)]
    made = f.call([t, x, *parts, ca.vertcat(p, 0.0)])  # the sample time does not enter a continuous model
    results = dict(zip((*traced.outputs, NEXT), made[: len(traced.outputs) + 1], strict=True))
    computed = [n for n in block.outputs if n not in block.states]
    y = ca.vertcat(*(results[n] for n in computed))
    return ModelSpec(
        name=name,
        description=(type(block).__doc__ or name).strip().splitlines()[0],
        inputs=tuple(
            _variable(port, "input", shape=shapes[n], start=0.0 if port.default is None else port.default)
            for n, port in block.inputs.items()
        ),
        outputs=tuple(_variable(block.outputs[n], "output", shape=traced.outputs[n]) for n in computed),
        parameters=tuple(_parameter(block, n, v) for n, v in entries),
        states=tuple(
            _variable(
                port,
                "output" if port.output else "local",
                shape=traced.states[n],
                state=True,
                start=port.start_value(block, shapes),
            )
            for n, port in block.states.items()
        ),
        derivative=ca.Function("derivative", [t, x, u, p], [results[NEXT]]),
        output=ca.Function("output", [t, x, u, p], [y]),
        internal_step=internal_step,
        stop_time=stop_time,
        step_size=step_size,
    )


def build(
    block: Block,
    out: Path | str | None = None,
    *,
    name: str | None = None,
    internal_step: float = 1e-3,
    stop_time: float = 1.0,
    step_size: float = 1e-3,
    platform: str | Iterable[str] | None = None,
    notify: Callable[[str], None] | None = None,
) -> Path:
    """Export a continuous block as an FMI 3.0 co-simulation FMU and return the file.

    The equations become C, compiled without Python inside; the build is cached by content.

    Parameters
    ----------
    block : Block
        A block with a ``derivative``; its parameter values become the FMU's start values.
    out : path, optional
        Where to put the file (or the folder for it); without it, the file in the cache is returned.
    name : str, optional
        The model's name; the class name in lower case without one.
    internal_step : float
        Start value, in s, of the FMU's parameter ``internal_step``: the longest step of its Runge-Kutta integrator
        (order 4).
    stop_time, step_size : float
        Default experiment, s.
    platform : str or iterable of str, optional
        FMI platform tuples, such as ``"x86_64-linux"``; this machine's without one.
    notify : callable, optional
        Called with a line of text when a compilation starts.

    Raises
    ------
    DefinitionError, TraceError
        A block that can't be exported.
    CompilerError
        No compiler, or one that failed.
    """
    spec = model_spec(block, name=name, internal_step=internal_step, stop_time=stop_time, step_size=step_size)
    return build_fmu(spec, out, platform=platform, notify=notify)


def _check_exportable(block: Block, name: str) -> None:
    """Refuse what an FMU would leave out without a word."""
    if isinstance(block, type) or not isinstance(block, Block):
        raise DefinitionError(f"found {block!r}; expected a block, such as Gantry().", block=name)
    if not hasattr(block, "derivative"):
        raise DefinitionError(
            "it has no derivative(t, x, u), so it is no continuous model; an FMU is made from one.", block=name
        )
    for what, why in (
        ("guards", "an FMU has no guards"),
        ("initial", "an FMU's states have start values, and none that are computed from its inputs"),
        ("jump", "events are not exported yet"),
    ):
        if hasattr(block, what):
            raise DefinitionError(f"it has {what}(…), but {why}. Export a block without.", block=name)
    for port, spec in block.inputs.items():
        if spec.shape is None:
            raise DefinitionError("its shape is not declared; declare it with Input(shape=…).", block=name, port=port)
    for port, declared in {**block.inputs, **block.outputs, **block.states}.items():
        if isinstance(declared.unit, tuple):
            raise DefinitionError(
                f"its entries have units of their own, {', '.join(declared.unit)}; a variable of an FMU has one. Split "
                "the port.",
                block=name,
                port=port,
            )


def _variable(port: Port, causality: Any, **more: Any) -> Variable:
    unit = port.unit if isinstance(port.unit, str) else None
    limits: dict[str, Any] = {"minimum": port.minimum, "maximum": port.maximum}
    return Variable(name=port.name, causality=causality, unit=unit, description=port.description, **limits, **more)


def _parameter(block: Block, name: str, value: Any) -> Variable:
    owner: Any = block
    *outer, last = name.split(".")
    for part in outer:
        owner = owner.__dict__[part]
    spec: ParameterSpec = type(owner).parameter_specs[last]
    above = spec.above if spec.above is None else float(np.nextafter(spec.above, np.inf)) if spec.above else _TINY
    return Variable(
        name=name,
        causality="parameter",
        variability="tunable" if spec.tunable else "fixed",
        shape=np.shape(value),
        unit=spec.unit,
        description=spec.description,
        start=value,
        minimum=spec.minimum if above is None else above,
        maximum=spec.maximum,
    )

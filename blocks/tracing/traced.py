"""Tracing: a block's equations run once on CasADi's symbols, through their NumPy interface.

The result is one CasADi function for each block,

    F(t, x, u₁ … uₘ, p) → (y₁ … yₖ, next, guards),

with flat columns (vectors and matrices in C order). ``next`` is the state at the next tick in a sampled subsystem, and
the time derivative in a continuous one. ``p`` holds the parameters, the sample time, and the numbers computed from
them. Parameters are symbols, except exact zeros, which are structure. Blocks of equal structure share a trace: blocks
of the library in the whole process, blocks of users' classes within one build of a diagram.

In a continuous subsystem events add two functions, indicators(t, x, u₁ … uₘ, p) → z and jump(t, x, u₁ … uₘ, p, fired) →
x⁺.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ..core import SOLVED, Block, Layout, LoopwrightError, SampleTimeError, Shape, TraceError, Value
from .discretization import find_hold, trapezoidal_step
from .equations import (
    check_definition,
    guards_of,
    is_only_sampled,
    match_ports,
    start_values,
    takes_update,
    trace_error,
)
from .numpy_check import GUARDS, NEXT, compare
from .opaque_equations import Foreign
from .structure import structure, traced_parameters
from .symbols import bundle, expand, flat_column, size, with_values, with_zeros, wrap


@dataclass(frozen=True, eq=False)
class Traced:
    """Traced equations of a block, for given shapes of its inputs, in a sampled or a continuous subsystem."""

    function: Any
    """CasADi function of (t, x, one column per input, p)."""
    inputs: dict[str, Shape]
    outputs: dict[str, Shape]
    states: dict[str, Shape]
    guards: tuple[str, ...]
    depends: dict[str, frozenset[str]]
    """The inputs (and "t", "x") that each output, `NEXT` and `GUARDS` depend on."""
    advance: str
    """Kind of the states' advance: "none", "update", "derivative", "integrator", "affine" or a method's name."""
    system_matrix: Any
    """CasADi function p → A where ``advance`` is "affine", else None."""
    method: str
    indicators: Any = None
    """CasADi function of (t, x, one column per input, p), one entry for each event; None without events."""
    jump: Any = None
    """CasADi function of the same and a column of ones and zeros (fired), to all states; None without events."""
    failures: list[BaseException] = field(default_factory=list)
    """The last exception of an opaque block's equations, whose results are then NaN; see `raise_failure`."""
    foreign: Foreign | None = None
    """The equations of an opaque block, kept alive with the functions that call them."""

    def pack(self, block: Block, T: float) -> np.ndarray:
        """Return ``p`` for ``block`` (of this structure) at the sample time T."""
        given = [value for _, value in traced_parameters(block)]
        numbers: list[float] = []
        for value in (*given, T, *constants_of(block, T, self.method).values()):
            numbers += [value] if isinstance(value, float) else np.asarray(value).ravel().tolist()
        p = np.array(numbers, dtype=float)
        if self.system_matrix is None:
            return p
        n = sum(size(s) for s in self.states.values())
        A = np.array(self.system_matrix(p)).reshape(n, n)
        return np.concatenate([p, *(m.ravel() for m in find_hold(A, T, self.method))])


def constants_of(block: Block, T: float, method: str) -> dict[str, Any]:
    """Return the block's precomputed numbers, in order of their names."""
    compute: Callable[..., dict[str, Any]] | None = getattr(block, "constants", None)
    if compute is None or not (np.isfinite(T) or block.computed_from):
        return {}
    made = compute(T, method)
    if not isinstance(made, Mapping):
        raise TraceError(
            f"its constants returned a {type(made).__name__}; expected a dictionary of numbers by name. Return one.",
            block=block.label,
        )
    return dict(sorted(made.items()))


def trace(
    block: Block,
    shapes: Mapping[str, Shape],
    *,
    sampled: bool,
    method: str = "exact",
    zeros: bool = True,
    cache: dict[Any, Traced] | None = None,
) -> Traced:
    """Trace ``block`` for inputs of the given shapes; ``zeros=False`` keeps exact zeros symbols, for export."""
    # Traces of users' blocks are shared within one build of a diagram, which brings the cache; those of the library's
    # blocks in the whole process.
    shared = None if block.opaque else _CACHE if _is_ours(block) else cache
    key = (structure(block), tuple(shapes.items()), sampled, method, zeros)
    found = None if shared is None else shared.get(key)
    if found is None:
        try:
            found = _Tracer(block, dict(shapes), sampled, method, zeros).run()
        except LoopwrightError as error:
            error.at(block=block.label)
            raise
        if shared is _CACHE and len(shared) > 2048:
            shared.clear()
        if shared is not None:
            shared[key] = found
    return found


_CACHE: dict[Any, Traced] = {}
_OURS = __name__.partition(".")[0]


def _is_ours(value: Any) -> bool:
    """Whether a value is data, or an object of this package whose parameters are data or of this package too."""
    # Functions, and the equations of other classes, may change between two builds: they may read a constant of their
    # module, a class attribute or a helper.
    if isinstance(value, Value):
        own = type(value).__module__.partition(".")[0] == _OURS
        return own and all(_is_ours(v) for v in value.parameters.values())
    if isinstance(value, Mapping):
        return all(_is_ours(v) for v in value.values())
    if isinstance(value, list | tuple | set | frozenset):
        return all(_is_ours(v) for v in value)
    return value is None or isinstance(value, bool | int | float | complex | str | bytes | np.ndarray)


class _Tracer:
    """Tracing of one block."""

    def __init__(self, block: Block, shapes: dict[str, Shape], sampled: bool, method: str, zeros: bool):
        self.block, self.shapes, self.sampled, self.method, self.zeros = block, shapes, sampled, method, zeros
        check_definition(block)
        self.starts = start_values(block, shapes)
        self.states = {name: v.shape for name, v in self.starts.items()}
        self.entries = list(traced_parameters(block))
        self.constants = constants_of(block, 1.0 if sampled else np.nan, method)
        self.guard_names: tuple[str, ...] = ()
        self.solved = ca.MX(0, 1)
        sizes = [sum(np.size(v) for _, v in self.entries), sum(np.size(v) for v in self.constants.values())]
        self.t = ca.MX.sym("t")
        self.x = ca.MX.sym("x", sum(map(size, self.states.values())))
        self.u = [ca.MX.sym(f"u{i}", size(s)) for i, s in enumerate(shapes.values())]
        self.p = ca.MX.sym("p", sizes[0] + 1 + sizes[1])
        self.T = self.p[sizes[0]]
        held = [*self.entries, ("T", 1.0 if sampled else np.nan), *self.constants.items()]
        self.foreign = Foreign(block, shapes, self.starts, held) if block.opaque else None

    def run(self) -> Traced:
        advance, matrix, new, hold_numbers = self._advance()
        outputs, output_shapes = self._outputs()
        results = [*outputs.values(), new, ca.vertcat(self._guards(), self.solved)]
        self.guard_names += (SOLVED,) * self.solved.numel()
        names = [*outputs, NEXT, GUARDS]
        p = ca.MX.sym("p", self.p.numel() + hold_numbers.numel())
        parts = ca.vertsplit(p, [0, self.p.numel(), p.numel()])
        results = ca.substitute(results, [self.p, hold_numbers], parts)
        function = expand(ca.Function("block", [self.t, self.x, *self.u, p], results))
        arguments = ("t", "x", *self.shapes)
        depends = {
            name: frozenset(a for j, a in enumerate(arguments) if function.jac_sparsity(i, j).nnz())
            for i, name in enumerate(names)
        }
        self.check(function, names)
        indicators, jump = self._events()
        return Traced(
            function=function,
            inputs=self.shapes,
            outputs=output_shapes,
            states=self.states,
            guards=self.guard_names,
            depends=depends,
            advance=advance,
            system_matrix=matrix,
            method=self.method,
            indicators=indicators,
            jump=jump,
            failures=[] if self.foreign is None else self.foreign.failures,
            foreign=self.foreign,
        )

    # --- the equations, called with symbols -------------------------------------------------------------------------

    def _shadow(self) -> Block:
        """Return the block with symbols for its numbers; exact zeros are structure."""
        numbers = [*self.entries, ("", 0.0), *self.constants.items()]  # between them the place of the sample time
        slices = Layout.of({str(i): np.shape(value) for i, (_, value) in enumerate(numbers)}).slices
        values: dict[str, Any] = {}
        for (name, value), where in zip(numbers, slices.values(), strict=True):
            part, zero = self.p[where], np.ravel(value) == 0
            if self.zeros and zero.any() and name not in self.constants:
                part = with_zeros(part, zero)
            values[name] = wrap(part, np.shape(value))
        del values[""]
        shadow: Block = with_values(self.block, values)
        return shadow

    def _call(self, equation: str, x: Any = None, *more: Any) -> Any:
        """Call an equation with symbols; ``x`` replaces those of the states, ``more`` follows the inputs."""
        sample_time = self._wants_sample_time(equation)
        if self.foreign is not None:
            fired = [ca.vertcat(*map(flat_column, bundled)) for bundled in more]
            arguments = [self.t, self.x if x is None else x, *self.u, self.p, *fired]
            return self.foreign.call(equation, arguments, sample_time=sample_time)
        states = bundle("x", self._columns(self.states, self.x if x is None else x))
        inputs = bundle("u", {n: wrap(c, s) for (n, s), c in zip(self.shapes.items(), self.u, strict=True)})
        keywords = {"T": wrap(self.T, ())} if sample_time else {}
        try:
            return getattr(self._shadow(), equation)(wrap(self.t, ()), states, inputs, *more, **keywords)
        except LoopwrightError:
            raise
        except Exception as error:
            raise trace_error(error, self.block, equation) from error

    def _wants_sample_time(self, equation: str) -> bool:
        declared = inspect.signature(getattr(type(self.block), equation)).parameters.get("T")
        if declared is None:
            return False
        if not self.sampled and declared.default is inspect.Parameter.empty:
            raise SampleTimeError(
                f"its {equation} needs a sample time, and the block is in a continuous subsystem; put it into a "
                "@subsystem(sample_time=…).",
                block=self.block.label,
            )
        return self.sampled

    @staticmethod
    def _columns(shapes: Mapping[str, Shape], flat: Any) -> dict[str, Any]:
        return {name: wrap(flat[where], shapes[name]) for name, where in Layout.of(shapes).slices.items()}

    def _outputs(self) -> tuple[dict[str, Any], dict[str, Shape]]:
        """Return columns and shapes of all outputs, by name."""
        own = {n: port.shape for n, port in self.block.outputs.items() if n not in self.states}
        made: dict[str, Any] = {}
        shapes: dict[str, Shape] = {}
        if own:
            if not hasattr(self.block, "output"):
                raise TraceError(f"it declares the outputs {', '.join(own)} but has no output(t, x, u); write it.")
            made, shapes = match_ports(self._call("output"), own, "output")
        for name, value in self._columns(self.states, self.x).items():
            if name in self.block.outputs:
                made[name], shapes[name] = flat_column(value), self.states[name]
        return {n: made[n] for n in self.block.outputs}, {n: shapes[n] for n in self.block.outputs}

    def _guards(self) -> Any:
        if not hasattr(self.block, "guards"):
            return ca.MX(0, 1)
        made = guards_of(self._call("guards"))
        self.guard_names = tuple(made)
        return ca.vertcat(*made.values()) if made else ca.MX(0, 1)

    def _events(self) -> tuple[Any, Any]:
        """Return the functions of the event indicators and of the jump."""
        events = self.block.events
        lone = [n for n, port in self.block.states.items() if port.discrete]
        if not events:
            if lone and not (self.sampled and hasattr(self.block, "update")):
                raise TraceError(
                    f"its states {', '.join(lone)} are discrete but no event changes them; declare an Event, or leave "
                    "discrete=True out."
                )
            return None, None
        for equation in ("indicators", "jump"):
            if not hasattr(self.block, equation):
                raise TraceError(f"it declares the events {', '.join(events)} but has no {equation}; write it.")
        if self.sampled:  # its update acts at the ticks in place of its jumps
            return None, None
        fired = ca.MX.sym("fired", len(events))
        z = ca.vertcat(*match_ports(self._call("indicators"), dict.fromkeys(events, ()), "indicators")[0].values())
        after = self._call("jump", None, bundle("fired", self._columns(dict.fromkeys(events, ()), fired)))
        x_next = ca.vertcat(*match_ports(after, self.states, "jump")[0].values()) if self.states else ca.MX(0, 1)
        arguments = [self.t, self.x, *self.u, self.p]
        indicators = expand(ca.Function("indicators", arguments, [z]))
        jump = expand(ca.Function("jump", [*arguments, fired], [x_next]))
        self.check(indicators, ["indicators"])
        self.check(jump, ["jump"])
        return indicators, jump

    def _advance(self) -> tuple[str, Any, Any, Any]:
        """Return the kind of advance, A(p) where needed, the new states (or rates), and symbols for Ad and Φ."""
        none, x = ca.MX(0, 1), self.x
        if not self.states:
            return "none", None, none, ca.MX.sym("none", 0)
        update, derivative = hasattr(self.block, "update"), hasattr(self.block, "derivative")
        if self.sampled and self.block.events and not update:
            raise SampleTimeError(
                f"it has events ({', '.join(self.block.events)}), and it is in a sampled subsystem; put it outside of "
                "it, or give it an update(t, x, u), which acts at the ticks instead of the events."
            )

        def states_from(equation: str, x: Any = None) -> Any:
            return ca.vertcat(*match_ports(self._call(equation, x), self.states, equation)[0].values())

        unused = ca.MX.sym("none", 0)
        if takes_update(self.block, self.sampled):
            if not self.sampled and is_only_sampled(self.block):
                text = "a sampled block is in a continuous subsystem; put it into a @subsystem(sample_time=…)."
                raise SampleTimeError(text)
            return "update", None, states_from("update"), unused
        discrete = {name for name, port in self.block.states.items() if port.discrete}
        if not derivative and len(discrete) < len(self.states):
            raise TraceError(
                f"it has states ({', '.join(self.states)}) but neither derivative(t, x, u) nor update(t, x, u); "
                "write one."
            )
        dx = self._rates(discrete)
        if not self.sampled:
            return "derivative", None, dx, unused
        n, arguments = x.numel(), [self.t, x, *self.u, self.p]
        jacobian = expand(ca.Function("A", arguments, [ca.jacobian(dx, x)]))
        if not any(jacobian.jac_sparsity(0, i).nnz() for i in range(2 + len(self.u))):
            if self.method == "trapezoidal":  # terms that depend on time are the mean of both ends
                dx = (dx + ca.substitute(dx, self.t, self.t + self.T)) / 2
            if jacobian.nnz_out(0) == 0:
                return "integrator", None, x + self.T * dx, unused
            at_zero = jacobian(*(ca.DM.zeros(a.shape) for a in arguments[:-1]), self.p)
            matrix = ca.Function("A", [self.p], [ca.densify(at_zero)])
            numbers = ca.MX.sym("hold", 2 * n * n)
            Ad, Phi = (ca.reshape(numbers[i * n * n : (i + 1) * n * n], n, n).T for i in (0, 1))
            return "affine", matrix, Ad @ x + Phi @ ca.substitute(dx, x, ca.MX(ca.DM.zeros(n))), numbers
        if self.method == "trapezoidal":
            rates = expand(ca.Function("rates", arguments, [dx]))
            nominals = [np.full(size(self.states[n]), port.nominal or 1.0) for n, port in self.block.states.items()]
            new, self.solved = trapezoidal_step(rates, arguments, self.T, np.concatenate(nominals))
            return "trapezoidal", None, new, unused
        if self.method == "semi_implicit":
            new = [x[i] for i in range(n)]
            for i in reversed(range(n)):
                new[i] = x[i] + self.T * states_from("derivative", ca.vertcat(*new))[i]
            return "semi_implicit", None, ca.vertcat(*new), unused
        return "forward", None, x + self.T * dx, unused

    def _rates(self, discrete: set[str]) -> Any:
        """Return the time derivatives of all states, zero for the discrete ones."""
        continuous = {n: s for n, s in self.states.items() if n not in discrete}
        made = match_ports(self._call("derivative"), continuous, "derivative")[0] if continuous else {}
        dx = ca.vertcat(*(made[n] if n in made else ca.MX.zeros(size(s)) for n, s in self.states.items()))
        self.check(expand(ca.Function("derivative", [self.t, self.x, *self.u, self.p], [dx])), ["derivative"])
        return dx

    def check(self, function: Any, names: list[str]) -> None:
        """Compare the results of a traced function with NumPy's."""
        if self.foreign is None:
            compare(self.block, function, names, self.shapes, self.starts, self.entries, self.constants, self.sampled)

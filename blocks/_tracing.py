"""Tracing: a block's equations, run once on CasADi's symbols through their NumPy interface.

What is traced becomes one CasADi function per block,

    F(t, x, u₁ … uₘ, p) → (y₁ … yₖ, next, guards),

with flat columns (vectors and matrices in C order). ``next`` is the state at the next tick in a sampled frame, the time
derivative in a continuous one. ``p`` holds the parameters, then the sample time, then what was computed from them.
Parameters are symbols, except exact zeros, which are structure. Traces are shared among blocks of equal structure.
"""

from __future__ import annotations

import inspect
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from ._block import Block
from ._discretization import hold
from ._errors import LoopwrightError, SampleTimeError, ShapeError, TraceError
from ._ports import Shape
from ._values import Value, identity

NEXT, GUARDS = "next", "guards"


@dataclass(frozen=True, eq=False)
class Traced:
    """The traced equations of a block for given input shapes in a given kind of frame."""

    function: Any
    """CasADi function of (t, x, one column per input, p)."""
    inputs: dict[str, Shape]
    outputs: dict[str, Shape]
    states: dict[str, Shape]
    guards: tuple[str, ...]
    depends: dict[str, frozenset[str]]
    """For each output, `NEXT` and `GUARDS`: the inputs (and "t", "x") that it depends on."""
    advance: str
    """How the states advance: "none", "update", "derivative", "integrator", "affine" or a method's name."""
    system_matrix: Any
    """CasADi function p → A where ``advance`` is "affine", else None."""
    method: str

    def pack(self, block: Block, T: float) -> np.ndarray:
        """Return the numbers of ``p`` for ``block`` (of this structure) at the sample time T."""
        numbers = [np.ravel(v) for _, v in traced_parameters(block)]
        p = np.concatenate([*numbers, [T], *(np.ravel(v) for v in constants_of(block, T, self.method).values())])
        if self.system_matrix is None:
            return p
        n = sum(size(s) for s in self.states.values())
        A = np.array(self.system_matrix(p)).reshape(n, n)
        return np.concatenate([p, *(m.ravel() for m in hold(A, T, self.method))])


def size(shape: Shape) -> int:
    """Return the number of entries of a shape."""
    return int(np.prod(shape, dtype=int))


def traced_parameters(block: Value, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of every parameter that is a symbol in the trace; a nested block's included."""
    for name, spec in type(block).parameter_specs.items():
        value = block.__dict__[name]
        if isinstance(value, Block):
            yield from traced_parameters(value, f"{prefix}{name}.")
        elif isinstance(value, float | np.ndarray) and not spec.structural:
            yield prefix + name, value


def structure(block: Value) -> Any:
    """Return what the trace depends on besides the shapes: class, fixed values, which numbers are exactly zero."""
    items: list[Any] = [type(block)]
    for name, spec in type(block).parameter_specs.items():
        value = block.__dict__[name]
        if isinstance(value, Block):
            items.append((name, structure(value)))
        elif isinstance(value, float | np.ndarray) and not spec.structural:
            items.append((name, np.shape(value), (np.asarray(value) == 0).tobytes()))
        else:
            items.append((name, identity(value)))
    return tuple(items)


def constants_of(block: Block, T: float, method: str) -> dict[str, Any]:
    """Return the block's precomputed numbers, in order of their names."""
    compute: Callable[..., dict[str, Any]] | None = getattr(block, "constants", None)
    if compute is None or not np.isfinite(T):
        return {}
    return dict(sorted(compute(T, method).items()))


@lru_cache(maxsize=4096)
def _tuple_type(kind: str, names: tuple[str, ...]) -> Any:
    return namedtuple(kind, names)


def bundle(kind: str, values: Mapping[str, Any]) -> Any:
    """Return a named tuple of states, inputs or outputs, as equations get it."""
    return _tuple_type(kind, tuple(values))(*values.values())


def trace(
    block: Block, shapes: Mapping[str, Shape], *, sampled: bool, method: str = "exact", zeros: bool = True
) -> Traced:
    """Trace ``block`` for inputs of the given shapes.

    Parameters
    ----------
    block : Block
        Any block with equations.
    shapes : mapping
        Shape of every input.
    sampled : bool
        Whether it stands in a sampled frame.
    method : str
        Discretization of a continuous block in a sampled frame.
    zeros : bool
        Whether parameters that are exactly zero are structure; False keeps every number a symbol (for export).

    Raises
    ------
    TraceError
        An operation that can't be traced, or whose traced result differs from NumPy's.
    ShapeError
        An equation that returns another shape than declared.
    """
    key = (structure(block), tuple(shapes.items()), sampled, method, zeros)
    found = _CACHE.get(key)
    if found is None:
        try:
            found = _Tracer(block, dict(shapes), sampled, method, zeros).run()
        except LoopwrightError as error:
            error.at(block=block.label)
            raise
        if len(_CACHE) > 2048:
            _CACHE.clear()
        _CACHE[key] = found
    return found


_CACHE: dict[Any, Traced] = {}


class _Tracer:
    """One trace in the making."""

    def __init__(self, block: Block, shapes: dict[str, Shape], sampled: bool, method: str, zeros: bool):
        self.block, self.shapes, self.sampled, self.method, self.zeros = block, shapes, sampled, method, zeros
        self.starts = {name: port.start_value(block, shapes) for name, port in block.states.items()}
        self.states = {name: v.shape for name, v in self.starts.items()}
        self.own = [name for name in block.outputs if name not in block.states]
        self.guard_names: tuple[str, ...] = ()
        self.constants = constants_of(block, 1.0 if sampled else np.nan, method)
        self.output_shapes: dict[str, Shape] = {}

    def run(self) -> Traced:
        t = ca.MX.sym("t")
        x = ca.MX.sym("x", sum(map(size, self.states.values())))
        u = [ca.MX.sym(f"u{i}", size(s)) for i, s in enumerate(self.shapes.values())]
        entries = list(traced_parameters(self.block))
        total = sum(np.size(v) for _, v in entries) + 1 + sum(np.size(v) for v in self.constants.values())
        p = ca.MX.sym("p", total)
        advance, matrix, extra, dx = self._advance(t, x, u, p, entries)
        outputs = self._outputs(t, x, u, p, entries)
        guards = self._guards(t, x, u, p, entries)
        if advance == "affine":
            n = x.numel()
            tail = ca.MX.sym("hold", 2 * n * n)
            Ad, Phi = (ca.reshape(tail[i * n * n : (i + 1) * n * n], n, n).T for i in (0, 1))
            free = ca.substitute(dx, x, ca.MX(ca.DM.zeros(n)))
            new, p_full = Ad @ x + Phi @ free, ca.vertcat(p, tail)
        else:
            new, p_full = dx, p
        del extra
        names = [*self.block.outputs, NEXT, GUARDS]
        results = [*outputs, new, guards]
        inner = ca.MX.sym("p", p_full.numel())
        if advance == "affine":
            results = ca.substitute(results, [p, tail], [inner[:total], inner[total:]])
        else:
            results = ca.substitute(results, [p], [inner])
        function = _expanded(ca.Function("block", [t, x, *u, inner], results))
        depends = {
            name: frozenset(
                arg
                for j, arg in enumerate(("t", "x", *self.shapes))
                if function.sparsity_out(i).numel() and function.jac_sparsity(i, j).nnz()
            )
            for i, name in enumerate(names)
        }
        self._compare(function)
        return Traced(
            function,
            self.shapes,
            self.output_shapes,
            self.states,
            self.guard_names,
            depends,
            advance,
            matrix,
            self.method,
        )

    # --- the equations, called with symbols -------------------------------------------------------------------------

    def _shadow(self, p: Any, entries: list[tuple[str, Any]], T: Any) -> Block:
        values: dict[str, Any] = {}
        position = 0
        for name, value in entries:
            part = p[position : position + np.size(value)]
            position += np.size(value)
            zero = np.ravel(value) == 0
            if self.zeros and zero.any():  # exact zeros are structure
                part = ca.vertcat(*(ca.MX(0.0) if z else part[i] for i, z in enumerate(zero)))
            values[name] = _wrap(part, np.shape(value))
        position += 1
        for name, value in self.constants.items():
            values[name] = _wrap(p[position : position + np.size(value)], np.shape(value))
            position += np.size(value)
        shadow: Block = _with(self.block, values)
        return shadow

    def _call(self, what: str, t: Any, x: Any, u: Any, p: Any, entries: list[tuple[str, Any]]) -> Any:
        T = p[sum(np.size(v) for _, v in entries)]
        method = getattr(self._shadow(p, entries, T), what)
        args = (_wrap(t, ()), self._bundle("x", self.states, x), self._bundle("u", self.shapes, u))
        keywords = {"T": _wrap(T, ())} if self._wants_sample_time(what) else {}
        try:
            return method(*args, **keywords)
        except LoopwrightError:
            raise
        except Exception as error:
            raise TraceError(_where(error, self.block, what)) from error

    def _wants_sample_time(self, what: str) -> bool:
        declared = inspect.signature(getattr(type(self.block), what)).parameters.get("T")
        if declared is None:
            return False
        if not self.sampled:
            if declared.default is inspect.Parameter.empty:
                raise SampleTimeError(
                    f"its {what} needs a sample time, and it stands in a continuous frame; put it into a "
                    "@subsystem(sample_time=…).",
                    block=self.block.label,
                )
            return False
        return True

    def _bundle(self, kind: str, shapes: Mapping[str, Shape], flat: Any) -> Any:
        values, position = {}, 0
        for i, (name, shape) in enumerate(shapes.items()):
            if isinstance(flat, list):
                values[name] = _wrap(flat[i], shape)
            else:
                values[name] = _wrap(flat[position : position + size(shape)], shape)
                position += size(shape)
        return bundle(kind, values)

    def _outputs(self, t: Any, x: Any, u: Any, p: Any, entries: list[tuple[str, Any]]) -> list[Any]:
        made: dict[str, Any] = {}
        if self.own:
            if not hasattr(self.block, "output"):
                raise TraceError(f"it declares the outputs {self.own} but has no output(t, x, u); write it.")
            result = self._call("output", t, x, u, p, entries)
            declared = {name: self.block.outputs[name].shape for name in self.own}
            made, shapes = _split(result, declared, "output")
            self.output_shapes.update(shapes)
        x_parts = self._bundle("x", self.states, x)
        for name in self.block.outputs:
            if name in self.states:
                made[name] = _flat(getattr(x_parts, name))
                self.output_shapes[name] = self.states[name]
        self.output_shapes = {name: self.output_shapes[name] for name in self.block.outputs}
        return [made[name] for name in self.block.outputs]

    def _guards(self, t: Any, x: Any, u: Any, p: Any, entries: list[tuple[str, Any]]) -> Any:
        if not hasattr(self.block, "guards"):
            return ca.MX(0, 1)
        made = self._call("guards", t, x, u, p, entries)
        self.guard_names = tuple(made)
        return ca.vertcat(*(_flat(v) for v in made.values()))

    def _advance(self, t: Any, x: Any, u: Any, p: Any, entries: list[tuple[str, Any]]) -> tuple[str, Any, int, Any]:
        if not self.states:
            return "none", None, 0, ca.MX(0, 1)
        update, derivative = hasattr(self.block, "update"), hasattr(self.block, "derivative")

        def states_from(what: str, x: Any) -> Any:
            made, _ = _split(self._call(what, t, x, u, p, entries), self.states, what)
            return ca.vertcat(*made.values())

        if update and (self.sampled or not derivative):
            if not self.sampled and not self.block.memory:
                raise SampleTimeError(
                    "a sampled block stands in a continuous frame; put it into a @subsystem(sample_time=…)."
                )
            return "update", None, 0, states_from("update", x)
        if not derivative:
            raise TraceError(
                f"it has states ({', '.join(self.states)}) but neither derivative(t, x, u) nor update(t, x, u)."
            )
        dx = states_from("derivative", x)
        if not self.sampled:
            return "derivative", None, 0, dx
        T = p[sum(np.size(v) for _, v in entries)]
        f = _expanded(ca.Function("f", [t, x, *u, p], [dx]))
        if f.jac_sparsity(0, 1).nnz() == 0 and self.method != "semi_implicit":
            return "integrator", None, 0, x + T * dx
        jacobian = _expanded(ca.Function("A", [t, x, *u, p], [ca.jacobian(dx, x)]))
        constant = not any(jacobian.jac_sparsity(0, i).nnz() for i in range(2 + len(u)))
        if constant:
            zero = [ca.DM.zeros(a.shape) for a in (t, x, *u)]
            return "affine", ca.Function("A", [p], [ca.densify(jacobian(*zero, p)).T]), 0, dx
        if self.method == "semi_implicit":
            new = x
            for i in reversed(range(x.numel())):
                step = states_from("derivative", new)[i]
                new = ca.vertcat(new[:i], x[i] + T * step, new[i + 1 :])
            return "semi_implicit", None, 0, new
        return "forward", None, 0, x + T * dx

    # --- NumPy's own result beside it -------------------------------------------------------------------------------

    def _compare(self, function: Any) -> None:
        """Evaluate the equations with NumPy at random points: finds what traces silently wrong (tracing has traps)."""
        rng = np.random.default_rng(20140)
        T = 1.0 if self.sampled else float("nan")
        numbers = [np.ravel(v) for _, v in traced_parameters(self.block)]
        p = np.concatenate([*numbers, [T], *(np.ravel(v) for v in self.constants.values())])
        p = np.concatenate([p, np.zeros(function.numel_in(function.n_in() - 1) - p.size)])
        for _ in range(2):
            t = float(rng.uniform(0.0, 2.0))
            x = {k: v + 0.1 * rng.standard_normal(v.shape) for k, v in self.starts.items()}
            u = {k: rng.standard_normal(s) for k, s in self.shapes.items()}
            flat_x = np.concatenate([np.ravel(v) for v in x.values()]) if x else np.zeros(0)
            traced = function(t, flat_x, *(np.ravel(v) for v in u.values()), p)
            traced = [np.ravel(np.array(r)) for r in (traced if isinstance(traced, tuple) else (traced,))]
            numeric = evaluate(self.block, t, x, u, T, self.constants)
            for name, value in numeric.items():
                if name == NEXT and not (hasattr(self.block, "update") and self.sampled):
                    continue
                index = [*self.block.outputs, NEXT, GUARDS].index(name)
                got, want = traced[index], np.ravel(np.asarray(value, dtype=float))
                if got.size != want.size:
                    raise TraceError(
                        f"its traced equation gives {got.size} numbers for {name!r} where NumPy gives {want.size}. An "
                        "operation in it traces to another shape; build arrays with np.stack and plain indexing."
                    )
                with np.errstate(all="ignore"):
                    wrong = (
                        ~(np.abs(got - want) <= 1e-9 * (1.0 + np.abs(want)))
                        & ~(np.isnan(got) & np.isnan(want))
                        & (got != want)
                    )
                if wrong.any():
                    raise TraceError(
                        f"its traced equation gives {got[wrong][:3]} for {name!r} where NumPy gives {want[wrong][:3]} "
                        f"(t = {t:.3g}, x = {x}, u = {u}). An operation in it traces wrongly; avoid math.…, float(…), "
                        "masks and assignments into arrays, and build vectors with np.stack.",
                    )


def evaluate(
    block: Block, t: float, x: Mapping[str, Any], u: Mapping[str, Any], T: float, constants: Mapping[str, Any]
) -> dict[str, Any]:
    """Evaluate a block's equations with NumPy: outputs by name, the updated states flat, the guards flat."""
    shadow = _with(block, dict(constants))
    bx, bu = (bundle(k, {n: float(v) if np.ndim(v) == 0 else v for n, v in d.items()}) for k, d in (("x", x), ("u", u)))

    def call(what: str) -> Any:
        wants = "T" in inspect.signature(getattr(type(block), what)).parameters and np.isfinite(T)
        with np.errstate(all="ignore"):
            return getattr(shadow, what)(t, bx, bu, **({"T": T} if wants else {}))

    result: dict[str, Any] = {name: x[name] for name in block.outputs if name in block.states}
    own = [name for name in block.outputs if name not in block.states]
    if own:
        made = call("output")
        result.update(zip(own, (made,) if len(own) == 1 else made, strict=True))
    if block.states and hasattr(block, "update") and (np.isfinite(T) or block.memory):
        made = call("update")
        result[NEXT] = np.concatenate([np.ravel(m) for m in ((made,) if len(block.states) == 1 else made)])
    if hasattr(block, "guards"):
        result[GUARDS] = np.array([float(v) for v in call("guards").values()])
    return result


def _expanded(function: Any) -> Any:
    """Return the function in scalar (SX) operations, each done once, or as it is where it looks up tables."""
    try:
        scalar = function.expand()
    except RuntimeError:
        return function
    arguments = scalar.sx_in()
    return ca.Function(function.name(), arguments, ca.cse(scalar.call(arguments)))


def _with(block: Any, values: Mapping[str, Any]) -> Any:
    """Return a copy of ``block`` whose attributes are replaced, without going through its constructor."""
    copy = object.__new__(type(block))
    copy.__dict__.update(block.__dict__)
    nested: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        head, _, rest = name.partition(".")
        if rest:
            nested.setdefault(head, {})[rest] = value
        else:
            copy.__dict__[name] = value
    for head, inner in nested.items():
        copy.__dict__[head] = _with(block.__dict__[head], inner)
    return copy


def _wrap(flat: Any, shape: Shape) -> Any:
    """Give a flat CasADi column NumPy's interface, in C order."""
    if shape == ():
        return ArrayInterface(flat, ndim=0)
    if len(shape) == 1:
        return ArrayInterface(flat.T, ndim=1)
    if len(shape) == 2:
        return ArrayInterface(ca.reshape(flat, shape[1], shape[0]).T, ndim=2)
    raise ShapeError(f"found a signal of shape {shape}; expected at most two dimensions.")


def _flat(value: Any) -> Any:
    """Return a traced value (or plain numbers) as a CasADi column in C order."""
    if isinstance(value, ArrayInterface):
        inner = value.to_casadi()
        return ca.vec(inner.T) if value.ndim == 2 else ca.vec(inner)
    return ca.MX(ca.DM(np.ravel(np.asarray(value, dtype=float))))


def _split(result: Any, declared: Mapping[str, Shape | None], what: str) -> tuple[dict[str, Any], dict[str, Shape]]:
    """Match what an equation returned with the ports declared."""
    names = list(declared)
    parts = (result,) if len(names) == 1 else result
    if isinstance(parts, ArrayInterface | np.ndarray) or len(parts) != len(names):
        raise TraceError(
            f"its {what} returned {len(parts)} values; expected a tuple of {len(names)}: {', '.join(names)}."
        )
    made, shapes = {}, {}
    for name, part in zip(names, parts, strict=True):
        shape = tuple(part.shape) if isinstance(part, ArrayInterface) else np.shape(part)
        expected = declared[name]
        if expected is not None and shape != expected:
            raise ShapeError(f"its {what} gives shape {shape}; expected {expected} as declared.", port=name)
        flat = _flat(part)
        if flat.numel() != size(shape):
            raise ShapeError(
                f"its {what} gives {flat.numel()} entries for shape {shape}; index it explicitly.", port=name
            )
        made[name], shapes[name] = ca.densify(flat), shape
    return made, shapes


def _where(error: Exception, block: Block, what: str) -> str:
    """Say which line of the user's equations an operation failed on."""
    file = inspect.getsourcefile(type(block)) if type(block).__module__ != "__main__" else None
    line, step = "", error.__traceback__
    while step is not None:
        if file is None or step.tb_frame.f_code.co_filename == file or step.tb_frame.f_code.co_name == what:
            line = f" in line {step.tb_lineno} of {step.tb_frame.f_code.co_filename}"
        step = step.tb_next
    return (
        f"its {what} can't be traced{line}: {type(error).__name__}: {error}. Use NumPy functions of (t, x, "
        f"u): np.where for "
        "branches, np.stack for vectors, np.sqrt and not math.sqrt."
    )

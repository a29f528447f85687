"""Errors that name a block: one that made a value that is not finite, and one whose values at the start are not found.

For the first the instant is evaluated again, block by block, with numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...blocks.core import NonFiniteError, SimulationError, enumerate_some
from ...blocks.tracing import GUARDS, NEXT, bundle, raise_failure
from ..flat import Evaluators, FlatDiagram, Instant, TickPattern, Vectors, evaluate, evaluate_apart
from ..wiring import join

START_SETTLED = 1e-13
"""Relative change of a value at the start between two passes that is rounding: a few hundred ulps."""


def failure(
    flat: FlatDiagram,
    here: Vectors,
    log: np.ndarray,
    acting: frozenset[TickPattern],
    evaluators: Evaluators | None = None,
) -> SimulationError:
    """Return the error of the first block that made a value that is not finite, or whose guard fails."""
    forget_trials(flat)
    for name, where in flat.plant_outputs.slices.items():
        if name not in flat.unread and not np.all(np.isfinite(here.w[where])):
            path, port = flat.ports[name]
            return _non_finite(path, port, here.w[where], _out_of_an_fmu(flat, path, port))
    found: list[SimulationError] = []

    def visit(instant: Instant, path: str, inputs: dict[str, Any], made: dict[str, Any]) -> None:
        if not found and instant.gate_of(path) is not False:
            known = {
                n: np.ravel(np.array(v))
                for n, v in made.items()
                if n not in instant.provisional and join(path, n) not in flat.unread
            }
            error = _wrong(flat, here, path, inputs, known)
            if error is not None:
                found.append(error)

    apart = evaluate_apart(evaluators)
    evaluate(flat, flat.blocks, acting, float(here.t[0]), here.x, here.w, here.p, visit=visit, apart=apart)
    return opaque_failure(flat) or (found[0] if found else _overflow(flat, log))


def forget_trials(flat: FlatDiagram) -> None:
    """Forget what opaque blocks have raised in trials that the solver got over; an interrupt is raised."""
    for trace in flat.checked.traced.values():
        if trace.failures:
            last = trace.failures.pop()
            if not isinstance(last, Exception):
                raise last


def opaque_failure(flat: FlatDiagram) -> SimulationError | None:
    """Return what an opaque block has raised since its failures were looked at; an interrupt is raised."""
    for path, trace in flat.checked.traced.items():
        try:
            raise_failure(trace.failures, path)
        except SimulationError as error:
            return error
    return None


def _wrong(
    flat: FlatDiagram, here: Vectors, path: str, inputs: dict[str, Any], made: dict[str, Any]
) -> SimulationError | None:
    trace, block = flat.checked.traced[path], flat.table.blocks[path]
    shaped = shaped_inputs(trace, inputs)
    for name in sorted(made, key=lambda n: n != GUARDS):  # a guard says more than the NaN behind it
        if name == GUARDS:
            for guard, value in zip(trace.guards, made[name], strict=True):
                if not value > 0:
                    u = bundle("u", shaped)
                    y = bundle("y", {n: made.get(n) for n in trace.outputs})
                    error = block.guard_error(guard, float(value), u, y, states_of(flat, path, here.x))
                    error.at(block=path)
                    return error
        elif not np.all(np.isfinite(made[name])):
            what = {NEXT: "the rate of its states" if trace.advance == "derivative" else "the next state"}.get(
                name, name
            )
            outside = block.in_model_exchange and name in block.outputs
            step = "Samples until then are in error.run."
            if not here.t[0] > 0.0:  # there are none
                step = "Look at its parameters and at what is wired to it."
            hint = _out_of_an_fmu(flat, path, name) if outside else step
            return _non_finite(path, what, made[name], f"{inputs_text(shaped)} {hint}")
    return None


def shaped_inputs(trace: Any, inputs: dict[str, Any]) -> dict[str, Any]:
    """Return the columns at a block's inputs as arrays of their shapes; None for what is not made yet."""
    return {
        q: None if inputs[q] is None else np.reshape(np.array(inputs[q], dtype=float), shape)
        for q, shape in trace.inputs.items()
    }


def states_of(flat: FlatDiagram, path: str, x: np.ndarray) -> Any:
    """Return the states of a block as its equations see them."""
    return bundle("x", state_values(flat, path, x))


def state_values(flat: FlatDiagram, path: str, x: np.ndarray) -> dict[str, np.ndarray]:
    """Return the states of a block by name."""
    return {name: part.copy() for name, part in flat.states.of_block[path].split(x).items()}


def _overflow(flat: FlatDiagram, log: np.ndarray) -> NonFiniteError:
    sizes = {name: float(np.max(np.abs(log[where]), initial=0.0)) for name, where in flat.log.slices.items()}
    largest = max(sizes, key=lambda name: sizes[name])
    path, port = flat.ports[largest]
    return NonFiniteError(
        f"found {sizes[largest]:g}; the signals of this tick overflow when they are added up, and this "
        "is the largest. Look at what drives it in the last samples of error.run.",
        block=path,
        port=port,
    )


def inputs_text(inputs: dict[str, Any]) -> str:
    """Write the values of a block's inputs."""
    shown = ", ".join(f"{n} = {np.asarray(v).tolist()}" for n, v in inputs.items() if v is not None)
    return f"Its inputs then: {shown}." if shown else "It has no inputs."


def _out_of_an_fmu(flat: FlatDiagram, path: str, port: str) -> str:
    """Return where an FMU's output that is not finite goes, and what to do about it."""
    ends = [join(*end) for end, wire in flat.table.wires.items() if (wire.block, wire.port) == (path, port)]
    ends += [name for name, wire in flat.table.controls.items() if (wire.block, wire.port) == (path, port)]
    readers = f" It is read by {enumerate_some(sorted(ends))}." if ends else ""
    return (
        f"It comes out of the FMU.{readers} Look up its inputs and start values, or wire another of its variables, "
        "which ports= makes a port; an output that nothing reads may be NaN."
    )


def _non_finite(path: str, port: str, values: np.ndarray, hint: str) -> NonFiniteError:
    return NonFiniteError(
        f"found {values.tolist()}; expected finite numbers. This is the first block that made such a value. {hint}",
        block=path,
        port=port,
    )


def unsolved_start(flat: FlatDiagram, last: np.ndarray, x: np.ndarray, passes: int) -> SimulationError:
    """Return the error of initial states that depend on themselves; ``last`` are those of the pass before."""
    path = next(
        (
            p
            for p, s in flat.states.slices.items()
            if not np.allclose(last[s], x[s], rtol=START_SETTLED, atol=START_SETTLED)
        ),
        "",
    )
    loops = "\n".join(flat.start_order.loops)
    return SimulationError(
        f"its initial state depends on itself, and is not found: after {passes} passes it still changes.\n"
        f"{loops}\nGive it an initial_value, or one to another block of this loop.",
        block=path or flat.start_order.torn[0][0],
    )


def unsettled(flat: FlatDiagram, before: np.ndarray, z: np.ndarray, passes: int) -> SimulationError:
    """Return the error of inputs of FMUs or delays that depend on their outputs; ``before`` are those a pass before."""
    slices = flat.plant_inputs.slices
    changed = (n for n, s in slices.items() if not np.allclose(before[s], z[s], rtol=START_SETTLED, atol=0.0))
    name = next(changed, next(iter(slices)))
    path, port = flat.ports[name]
    delay = flat.table.blocks[path].transport
    own, step = (
        ("its own output", "Give it an initial_value.")
        if delay
        else ("the FMU's own outputs", "Put a UnitDelay(initial_value=…) on one of the wires between.")
    )
    return SimulationError(
        f"its value at the start depends on {own}, and is not found: after {passes} passes it "
        f"still changes, from {before[slices[name]].tolist()} to {z[slices[name]].tolist()}. {step}",
        block=path,
        port=port,
    )

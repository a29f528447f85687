"""Names of a run's signals: the full name that a short one means.

``name[i]`` is an entry of a vector, ``name[i,j]`` one of a matrix. In names entries are counted from 1, as in FMI; of a
matrix a single number counts row by row, as the columns of exported tables do.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ...blocks.core import UnknownNameError, near, primary_outputs
from ..wiring import Wire, explain_absent_state, split_entry

_COMPUTED = ("local", "output", "calculatedParameter")
BlockOutputs = Mapping[str, Sequence[str]]
"""Names of outputs, secondary ones aside, by the path of their block."""


def resolve(
    name: str,
    wires: Mapping[str, Wire],
    ports: Collection[str],
    blocks: Mapping[str, Any] | None = None,
    outputs: BlockOutputs | None = None,
) -> str:
    """Return the full name that ``name`` means: a wire's or port's path, or a unique end of one; wires go first.

    An output ``w`` goes before ports of the same block with longer names, such as ``inertia.w``. An entry, ``name[1]``,
    stays behind it. Last of all, a block with one output, secondary ones aside, is that output by its own name: by
    ``blocks``, with which an error names their variables that are no ports, or by ``outputs`` of `outputs_of`.
    """
    if not isinstance(name, str):
        raise UnknownNameError(
            f"found {name!r}; expected the name of a signal, a text such as {next(iter((*wires, *ports)), 'y')!r}. "
            "run.names has all of them, for loops, too."
        )
    if name in wires or name in ports:
        return name
    # The names that the user gave go before the ports, of which there are many.
    for group in (wires, ports):
        found = sorted(n for n in group if n.endswith("." + name))
        if found and (len(found) == 1 or (group is wires and len({wires[n] for n in found}) == 1)):
            return found[0]
        if found and group is ports and (exact := _output_itself(name, found)):
            return exact
        if found:
            error = UnknownNameError(
                f"{name!r} stands for several signals: {', '.join(found)}. Write more of the path."
            )
            error.candidates = tuple(found)
            raise error
    if output := _only_output(name, ports, outputs_of(blocks or {}) if outputs is None else outputs):
        return output
    whole, entry = split_entry(name, {*wires, *ports})
    if entry:
        return resolve(whole, wires, ports, blocks, outputs) + name[len(whole) :]
    # Nothing fits. The errors below say what the name most likely means.
    if hidden := _hidden_variable(name, blocks or {}):
        path, variable = hidden
        raise UnknownNameError(
            f"no signal {name!r} was recorded: {variable!r} is a variable of the FMU {path!r}, and no port of its. "
            f"Make it one, besides those that are needed: Fmu(…, ports=[…, {variable!r}])."
        )
    if reason := explain_absent_state(blocks or {}, name):
        raise UnknownNameError(f"no signal {name!r} was recorded: {reason}")
    if reason := explain_input(blocks or {}, name):
        raise UnknownNameError(f"no signal {name!r} was recorded: {reason}")
    short = {n.rpartition(".")[2] for n in (*wires, *ports)}
    raise UnknownNameError(f"no signal {name!r} was recorded. {near(name, short | set(wires) | set(ports))}")


def explain_input(blocks: Mapping[str, Any], name: str, wires: Mapping[tuple[str, str], Wire] | None = None) -> str:
    """Return why an input's name is no signal, and what is one: by ``wires``, by block and input, the source itself."""
    for path, block in blocks.items() if "." in name else ():
        for port in block.inputs:
            if f".{path}.{port}".endswith(f".{name}"):
                step = "Name the wire that feeds it."
                if wires is not None:
                    source = wires.get((path, port))
                    step = (
                        f"Give {str(source)!r}, which feeds it." if source else "Wire a Constant to it, and give that."
                    )
                return f"{port!r} is an input of {path!r}, and signals are outputs. {step}"
    return ""


def _output_itself(name: str, found: Collection[str]) -> str:
    """Return the port ``path.name`` if all other names are ports with longer names of the same block, else ""."""
    shortest = min(found, key=len)
    head = shortest[: -len(name)]
    return shortest if all(other.startswith(head) for other in found) else ""


def outputs_of(blocks: Mapping[str, Any]) -> BlockOutputs:
    """Return the outputs of blocks, secondary ones aside, by the blocks' paths."""
    return {path: primary_outputs(block.outputs) for path, block in blocks.items()}


def find_blocks(name: str, paths: Collection[str]) -> list[str]:
    """Return the paths of the blocks that a name means: the path itself, or all of which it is an end."""
    return [name] if name in paths else [path for path in paths if path.endswith("." + name)]


def _only_output(name: str, ports: Collection[str], outputs: BlockOutputs) -> str:
    """Return the path of the only output of the blocks that a name means, "" where there is none."""
    paths = find_blocks(name, outputs)
    found = [full for path in paths for full in (f"{path}.{output}" for output in outputs[path]) if full in ports]
    if len(found) < 2:
        return found[0] if found else ""
    kind = f"is a block with {len(found)} outputs" if len(paths) == 1 else f"stands for {len(paths)} blocks"
    error = UnknownNameError(f"{name!r} {kind}; expected a signal. Name one of {', '.join(found)}.")
    error.candidates = tuple(found)
    raise error


def _hidden_variable(name: str, blocks: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the block and the variable of an FMU that could be a port and be recorded, if one has that name."""
    found = []
    for path, block in blocks.items():
        about: Any = getattr(block, "description", None)
        for variable in getattr(about, "names", ()):
            full = f"{path}.{variable}"
            if (full == name or full.endswith(f".{name}")) and about.find(variable).causality in _COMPUTED:
                found.append((path, variable))
    exact = [pair for pair in found if ".".join(pair) == name]
    one = exact or found
    return one[0] if len(one) == 1 else None

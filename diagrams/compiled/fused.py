"""A diagram that is compiled for the processor of this machine: its FMUs, or their equations in its ticks' code."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...blocks.core import CompilerError, FmuError
from ...fmus.export import describe_processor, inline_model, own_functions, processor_flags, tune
from ...fmus.platform import is_built_here
from ...fmus.runtime import read_sources
from ..flat import FlatDiagram, TickPattern, WiredDiagram
from .bound_functions import GeneratedCode
from .compiled_libraries import load_compiled
from .diagram_code import FUSING, DiagramCode, compile_code
from .expanded_functions import ExpandedFunctions, LoopEquations
from .generated_text import reorder, write_functions

_LIMIT = "0x1p20"  # LW_FAST_LIMIT
_KINDS_WRITTEN_TWICE = 16  # kinds of ticks that are written twice
_SYSTEM = "#define _POSIX_C_SOURCE 200809L"  # as `newton.c` asks for it, before anything is included
_CASADI = re.compile(r"\b(_?(?:casadi|CASADI)_)")


@dataclass(frozen=True)
class FusedPlant:
    """A plant that a fused loop steps, and the value references of its ports that the loop sets and gets."""

    file: Path | None  # its FMU; None where its own functions are called
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


def fuse(diagram: WiredDiagram) -> tuple[WiredDiagram, tuple[str, ...]]:
    """Return a diagram whose FMUs, those of ours, are compiled for this processor, and messages about what was done."""
    changes, kept = dict[str, object](), list[str]()
    for path, block in diagram.blocks.items():
        description = getattr(block, "description", None)
        if description is None or not hasattr(block, "file"):
            continue
        if not is_built_here(description.digest):
            kept.append(path)
            continue
        try:
            changes[f"{path}.file"] = tune(description.file)
        except (CompilerError, FmuError) as error:
            raise error.at(block=path) from error.__cause__
    messages = [
        f"Fused: {path.removesuffix('.file')} is compiled for this processor; values differ "
        "by rounding, which some motions magnify."
        for path in changes
    ]
    messages += [f"Not fused: {path} was not built by Loopwright on this machine." for path in kept]
    return (diagram.replace(changes) if changes else diagram), tuple(messages)


def compile_fused(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], plants: Mapping[str, FusedPlant]
) -> DiagramCode:
    """Compile the ticks at which sets of clocks act, the plants' equations, and the loop over both as one unit."""
    flat, key = flat.origin, tuple(plants.values())
    known: dict[tuple[FusedPlant, ...], DiagramCode] = flat.made["fused ticks"]
    if key not in known or tuple(known[key].ticks) != tuple(acting):
        known[key] = _compile(flat, acting, plants)
    return known[key]


def _compile(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], plants: Mapping[str, FusedPlant]
) -> DiagramCode:
    models, steps, inside = _write_models(plants)
    ticks = None if flat.by_block else ExpandedFunctions(flat, acting)
    if ticks is not None and not ticks.exact:  # tables and matrices stay as they are
        ticks = None
    loop = read_sources("newton.c", "remote.c", "loop_over_ticks.c")
    text = "\n".join([_SYSTEM, "" if ticks is None else _write_ticks(ticks.functions), models, steps, loop])
    library = load_compiled(text, (*processor_flags(), *FUSING), describe_processor())
    run_ticks = library["loopwright_run"]
    run_ticks.restype = None
    notes = tuple(f"Fused: the equations of {path} are in the loop, compiled with the ticks." for path in inside)
    if ticks is None:
        return replace(compile_code(flat, acting), run_ticks=run_ticks, notes=notes)
    notes += (
        "Fused: the ticks are compiled for this processor; values differ by rounding, which some motions magnify.",
    )
    found, between = ticks.find(GeneratedCode(library))
    equations = LoopEquations(flat, acting)
    loops = equations.find(GeneratedCode(load_compiled(equations.text()))) if equations.functions else {}
    return DiagramCode(found, between, loops, True, library, run_ticks=run_ticks, notes=notes)


def _write_models(plants: Mapping[str, FusedPlant]) -> tuple[str, str, list[str]]:
    """Return the equations of the plants, once for each file; how the loop steps them; and which they are."""
    prefixes: dict[Path, str | None] = {}
    texts, cases, inside = list[str](), list[str](), list[str]()
    for i, (path, plant) in enumerate(plants.items()):
        if (file := plant.file) is None:
            continue
        if file not in prefixes:
            text = inline_model(file, f"m{i}")
            prefixes[file] = None if text is None else f"m{i}"
            texts.append(text or "")
        if (prefix := prefixes[file]) is not None:
            for name, references in (("inputs", plant.inputs), ("outputs", plant.outputs)):
                texts.append(f"static const uint32_t {name}{i}[] = {{{', '.join(map(str, references)) or 0}}};\n")
            ports = f"p, inputs{i}, {len(plant.inputs)}, outputs{i}, {len(plant.outputs)}"
            cases.append(f"(j) == {i} ? {prefix}lw_inline_step(STEP_ARGUMENTS({ports}), now, width) : ")
            inside.append(path)
    steps = f"#define STEP_FUSED(j, p, now, width) ({''.join(cases)}false)\n" if cases else ""
    return "\n".join(texts), steps, inside


def _write_ticks(functions: Sequence[Any]) -> str:
    """Return the C code of ticks: each as it is, and in another order, with our own elementary functions."""
    texts, others, cases = list[str](), list[str](), list[str]()
    for i, function in enumerate(functions):
        text = write_functions(function.name(), [function])
        texts.append(_CASADI.sub(rf"t{i}\1", text))
        if i < _KINDS_WRITTEN_TWICE and (other := reorder(text, f"fast{i}", _LIMIT)) is not None:
            others.append(_CASADI.sub(rf"t{i}\1", other))
            one = f"(l)->ticks[{i}]"
            cases.append(f"(kind) == {i} ? fast{i}({one}.arguments, {one}.results) && call(&{one}) : ")
    before, after = own_functions("\n".join(others), "t")
    chosen = f"#define CALL_TICK(l, kind) ({''.join(cases)}call((l)->ticks + (kind)))\n" if cases else ""
    return "\n".join([*texts, before, *others, after, chosen])

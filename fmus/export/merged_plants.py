"""An FMU of our own that is merged into an exported diagram: its C text, with the instance in the diagram's memory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from .c_text import c_number, fill_template
from .loop_memory import Field
from .own_sources import expand_sources, name_apart

SAID = 512
"""Bytes of the message of a plant."""
Sized = Sequence[tuple[int, int]]
"""Value references of variables, each with its number of elements."""


@dataclass(frozen=True, kw_only=True)
class PlacedPlant:
    """Where a merged FMU is in the loop of its diagram.

    ``clocks``: ticks that are its communication points: every so many ticks, from an offset on.
    ``first_input``, ``first_output``, ``first_parameter``: entries of z, w and p at which its inputs, outputs and
    parameters begin.
    """

    path: str
    clocks: tuple[tuple[int, int], ...]
    first_input: int
    first_output: int
    first_parameter: int


@dataclass(frozen=True, kw_only=True)
class MergedPlant:
    """An FMU of our own that is merged into an exported diagram.

    ``inputs``, ``outputs``: what is set before a step, and got after it.
    ``tunable``: which of these may be set between two steps.
    ``start``: value references, each with its start value; before the parameters.
    ``implicit``: whether it starts with the implicit integrator, which needs a matrix.
    """

    sources: dict[str, str]
    inputs: Sized
    outputs: Sized
    parameters: Sized
    tunable: Sequence[bool]
    start: Sequence[tuple[int, Sequence[float]]]
    implicit: bool
    placed: PlacedPlant

    def write(self, prefix: str) -> str:
        """Return it as C text, with a prefix in front of every name, so that several are in one unit.

        The text defines the type ``<prefix>lw_instance``, and functions of it: ``<prefix>lw_plant_enter``,
        ``…exchange``, ``…start``, ``…step`` and ``…tune``.
        """
        values = [value for _, each in self.start for value in each]
        facts: dict[str, object] = {
            "sources": expand_sources("model.c", self.sources),
            "implicit": int(self.implicit),
            "said": SAID,
            "inputs": _listed(reference for reference, _ in self.inputs),
            "outputs": _listed(reference for reference, _ in self.outputs),
            "parameters": _listed(reference for reference, _ in self.parameters),
            "tunable": _listed(map(int, self.tunable)),
            "started": _listed(reference for reference, _ in self.start),
            "values": ", ".join(map(c_number, values)) or "0",
            "n_inputs": len(self.inputs),
            "n_outputs": len(self.outputs),
            "n_parameters": len(self.parameters),
            "n_started": len(self.start),
            "n_values": len(values),
            "n_u": count(self.inputs),
            "n_y": count(self.outputs),
            "n_p": count(self.parameters),
            "first": self.placed.first_parameter,
        }
        return name_apart(fill_template("merged_plant.c", **facts), prefix)


def write_plants(plants: Sequence[MergedPlant]) -> str:
    """Return the C text of the FMUs that are merged into a diagram, which comes before all of the diagram's."""
    return "\n".join(plant.write(f"m{j}") for j, plant in enumerate(plants))


def plant_fields(plants: Sequence[MergedPlant], inputs: int) -> tuple[list[Field], list[tuple[str, str]]]:
    """Return the members of a memory that merged FMUs need, and its pointers; ``inputs`` is the size of z."""
    if not plants:
        return [], []
    fields = [Field("exchange", "int64_t"), Field("culprit", "int64_t"), Field("reached", "int64_t", len(plants))]
    fields += [Field("begun", "double"), Field("held", "double", max(1, inputs)), Field("said", "char", SAID)]
    pointers = []
    for j, plant in enumerate(plants):
        fields.append(Field(f"plant{j}", f"m{j}lw_instance"))
        pointers.append((f"plant{j}.name", f'(char *)"{plant.placed.path}"'))
        pointers.append((f"plant{j}.environment", "m->said"))
        pointers.append((f"plant{j}.write", f"m{j}lw_plant_say"))
    return fields, pointers


def describe_plants(plants: Sequence[MergedPlant]) -> str:
    """Return the C text of the table of merged FMUs, which comes behind the memory."""
    if not plants:
        return "#define LW_N_MERGED 0"
    lines, rows = [], []
    for j, plant in enumerate(plants):
        own, at = f"m{j}lw_plant_", plant.placed
        due = ", ".join(f"{{{every}, {offset}}}" for every, offset in at.clocks)
        lines.append(f"static const int64_t lw_due{j}[][2] = {{{due}}};")
        places = f"{count(plant.inputs)}, {count(plant.outputs)}, {at.first_input}, {at.first_output}"
        functions = ", ".join(f"{own}{name}" for name in ("enter", "exchange", "start", "step", "tune"))
        label = f'"{at.path}", offsetof(lw_memory, plant{j})'
        rows.append(f"    {{{label}, {functions}, {places}, {len(at.clocks)}, lw_due{j}}},")
    return "\n".join(
        [
            f"#define LW_N_MERGED {len(plants)}",
            f"#define LW_MOST_MERGED {max(1, *(count(plant.outputs) for plant in plants))}",
            *lines,
            _TABLE,
            *rows,
            "};",
        ]
    )


_TABLE = """typedef struct {
    const char *path;
    size_t place; /* of its instance in the memory */
    bool (*enter)(void *plant, double start, const double *p), (*exchange)(void *plant, const double *u, double *y);
    bool (*start)(void *plant), (*step)(void *plant, const double *u, double t, double h, double *y);
    void (*tune)(void *plant, const double *p);
    int inputs, outputs, from, to; /* numbers of elements, and where they begin in z and w */
    int clocks;
    const int64_t (*due)[2]; /* its communication points: every so many ticks, from an offset on */
} lw_merged_plant;
static const lw_merged_plant lw_merged[LW_N_MERGED] = {"""


def count(variables: Sized) -> int:
    """Return the number of elements of variables."""
    return sum(size for _, size in variables)


def _listed(references: Iterable[int]) -> str:
    return ", ".join(map(str, references)) or "0"

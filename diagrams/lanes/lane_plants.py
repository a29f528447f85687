"""An FMU of our own in a vector of runs: its equations over vectors, and the steps of its integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from string import Template
from typing import Any

import numpy as np

from ...blocks.core import FmuError
from ...fmus import Fmu
from ...fmus.archive import FmuVariable
from ...fmus.calls import FmuInstance
from ...fmus.export import WrittenEquations, read_equations
from .vector_code import NoLanesError, write_methods, write_vectors

_ARGUMENTS = ("t", "x", "u", "p")
_SETTINGS = ("internal_step", "integrator", "tolerance")
_KINDS = ("fixed", "tunable", "input", "state", "discrete")
_RK4 = 1.0
_TEXT = Template("""
typedef struct { vec p[AT_LEAST_1($n_p)], u[AT_LEAST_1($n_u)], x[AT_LEAST_1($n_x)];
                 vec rates[AT_LEAST_1($kept_rates)], outputs[AT_LEAST_1($kept_outputs)]; } $name;

static void ${name}_begin($name *self, const vec *from) {
    memcpy(self->p, from, sizeof(vec) * $n_p);
    memcpy(self->u, from + $n_p, sizeof(vec) * $n_u);
    memcpy(self->x, from + $n_p + $n_u, sizeof(vec) * $n_x);
    ${name}_rates_prepare(self->p, self->rates);
    ${name}_outputs_prepare(self->p, self->outputs);
}

INLINE int ${name}_rate(const $name *self, double at, const vec *x, vec *f) {
    const vec t[1] = {splat(at)};
    ${name}_rates(t, x, self->u, self->p, self->rates, f);
    return 0;
}

$methods
/* A step of the integrator of the FMU, as in fmus/export/fmu_sources/integrators.c. */
INLINE void ${name}_rk4(const $name *self, double now, double h, vec *x) {
    vec k1[AT_LEAST_1($n_k)], k2[AT_LEAST_1($n_k)], k3[AT_LEAST_1($n_k)], k4[AT_LEAST_1($n_k)], stage[AT_LEAST_1($n_x)];
    memcpy(stage, x, sizeof stage);
    ${name}_rate(self, now, x, k1);
    ${name}_lw_rk4(self, $n_k, now, h, now + h, x, k1, k2, k3, k4, stage, x);
}

static inline void ${name}_step($name *self, double now, double h, int64_t n, const vec *z, vec *w) {
    vec t[1], y[AT_LEAST_1($n_y)], x[AT_LEAST_1($n_x)];
    $inputs
    memcpy(x, self->x, sizeof x);
    for (int64_t i = 0; i < n; i++) ${name}_rk4(self, now + h * ((double)i / (double)n), h / (double)n, x);
    memcpy(self->x, x, sizeof x);
    t[0] = splat(now + h);
    ${name}_outputs(t, self->x, self->u, self->p, self->outputs, y);
    $outputs
}

/* Outputs at the start, with the inputs in z; without z with those at hand. */
static void ${name}_look($name *self, const vec *z, vec *w) {
    vec t[1], y[AT_LEAST_1($n_y)];
    if (z) { $inputs }
    t[0] = splat(0.0);
    ${name}_outputs(t, self->x, self->u, self->p, self->outputs, y);
    $outputs
}

static void ${name}_resume($name *self, mask which, int from) {
    for (int i = 0; i < $n_x; i++) self->x[i] = choose(which, splat(self->x[i][from]), self->x[i]);
}

static void ${name}_end(const $name *self, vec *into) {
    memcpy(into + $n_p, self->u, sizeof(vec) * $n_u);
    memcpy(into + $n_p + $n_u, self->x, sizeof(vec) * $n_x);
}
""")


@dataclass(frozen=True, eq=False)
class LanePlant:
    """An FMU's equations, and where its ports are."""

    path: str
    derivative: Any  # (t, x, u, p) -> dx
    output: Any  # (t, x, u, p) -> y
    inputs: Sequence[tuple[int, int]]  # entries of u, and those of z that they take
    outputs: Sequence[tuple[int, str, int]]  # entries of w, and what they are: an entry of x, u or y
    references: Sequence[int]  # of parameters, inputs, states, then of the integrator's step and kind
    entries: Mapping[int, slice]  # where their values are among a run's numbers, without the integrator's

    @cached_property
    def width(self) -> int:
        """Vectors that a run keeps of it: parameters, inputs, states."""
        return int(sum(self.derivative.numel_in(i) for i in (3, 2, 1)))

    def write(self, name: str) -> str:
        """Write its C code."""
        rates = write_vectors(f"{name}_rates", self.derivative, _ARGUMENTS, {3})
        outputs = write_vectors(f"{name}_outputs", self.output, _ARGUMENTS, {3})
        of: Mapping[str, str] = {"x": "self->x", "u": "self->u", "y": "y"}
        return f"{rates.text}\n{outputs.text}" + _TEXT.substitute(
            name=name,
            n_p=self.derivative.numel_in(3),
            n_u=self.derivative.numel_in(2),
            n_x=self.derivative.numel_in(1),
            n_k=self.derivative.numel_out(0),
            n_y=self.output.numel_out(0),
            kept_rates=rates.kept,
            kept_outputs=outputs.kept,
            methods=write_methods(name, f"const {name}"),
            inputs=" ".join(f"self->u[{i}] = z[{j}];" for i, j in self.inputs),
            outputs=" ".join(f"w[{i}] = {of[kind]}[{j}];" for i, kind, j in self.outputs),
        )

    def read(self, plant: FmuInstance) -> tuple[np.ndarray, float]:
        """Return the numbers of an FMU at the start of a run, and the longest step of its integrator in s."""
        size = self.width + 2
        given = plant.call("reading its numbers", plant.fmi.get, "Float64", self.references, size)
        *found, step, integrator = np.array(given, dtype=float)
        if self.derivative.numel_out(0) and integrator != _RK4:
            raise NoLanesError(
                f"{self.path} chooses the steps of its integrator, and lanes need steps of one length: set its start "
                f"value integrator, which is {integrator:g}, to 1 (rk4)"
            )
        return np.array(found), float(step)


def read_plant(path: str, block: Fmu, inputs: Mapping[str, slice], outputs: Mapping[str, slice]) -> LanePlant:
    """Return the equations of an FMU, with its ports at some places of z and w."""
    try:
        found = read_equations(block.description.file)
    except FmuError as error:
        raise NoLanesError(f"{path}: {error}".rstrip(".")) from error
    ins, outs = list[tuple[int, int]](), list[tuple[int, str, int]]()
    for port, where in inputs.items():
        for k, place in zip(_places(found, block.input_variables[port]), _indices(where), strict=True):
            ins.append((k - found.first["u"], place))
    ends = {"y": found.output.numel_out(0), "x": found.output.numel_in(1), "u": found.output.numel_in(2)}
    for port, where in outputs.items():
        for k, place in zip(_places(found, block.output_variables[port]), _indices(where), strict=True):
            kind = next((name for name, size in ends.items() if 0 <= k - found.first[name] < size), None)
            if kind is None:
                raise NoLanesError(f"{path}: its output {port!r} is none of its states, inputs and computed outputs")
            outs.append((place, kind, k - found.first[kind]))
    of_kind = {kind: [i for i, v in enumerate(found.variables) if v.kind == kind] for kind in _KINDS}
    settings = {v.name: i for i, v in enumerate(found.variables) if v.name in _SETTINGS}
    numbers = sorted({*of_kind["fixed"], *of_kind["tunable"]} - {*settings.values()})
    references = [*numbers, *of_kind["input"], *of_kind["state"], *of_kind["discrete"]]
    entries, at = dict[int, slice](), 0
    for reference in references:
        entries[reference] = slice(at, at := at + found.variables[reference].size)
    references += [settings[name] for name in _SETTINGS[:2]]
    return LanePlant(path, found.derivative, found.output, ins, outs, references, entries)


def _places(found: WrittenEquations, variable: FmuVariable) -> list[int]:
    """Return where the elements of a variable are among the values of an instance."""
    own = [found.variables[reference] for reference in variable.references]
    return [v.first + k for v in own for k in range(v.size)]


def _indices(where: slice) -> range:
    return range(where.start, where.stop)

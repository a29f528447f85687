"""An FMU of our own as C text that is merged into an exported diagram: one instance, which nobody allocates."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

from .loop_memory import c_number
from .own_sources import expand_sources, name_apart, read_own_sources

_INSTANCE = """
/* The instance, in place of the functions of FMI: it starts and is stepped as an importer starts and steps it. */
static lw_instance lw_plant;
static const uint32_t lw_plant_inputs[] = {%(inputs)s}, lw_plant_outputs[] = {%(outputs)s};

/* Begin again: start values are set, and it is initializing. */
static bool lw_plant_enter(double start) {
    static const uint32_t references[] = {%(started)s};
    static const double values[] = {%(values)s};
    lw_reset(&lw_plant);
    return lw_set(&lw_plant, "", references, %(n_started)d, values, %(n_values)d)
           && lw_initialize(&lw_plant, "", start, false, 0.0);
}

/* Set the inputs u, and get the outputs y. */
static bool lw_plant_exchange(const double *u, double *y) {
    return lw_set(&lw_plant, "", lw_plant_inputs, %(n_inputs)d, u, %(n_u)d)
           && lw_get(&lw_plant, "", lw_plant_outputs, %(n_outputs)d, y, %(n_y)d);
}

/* End initialization. */
static bool lw_plant_start(void) { return lw_start(&lw_plant, "", LW_STEPPING); }

/* Step from t by h with the inputs u to the outputs y. */
static bool lw_plant_step(const double *u, double t, double h, double *y) {
    return lw_set(&lw_plant, "", lw_plant_inputs, %(n_inputs)d, u, %(n_u)d) && lw_step(&lw_plant, t, h)
           && lw_get(&lw_plant, "", lw_plant_outputs, %(n_outputs)d, y, %(n_y)d);
}

/* Set an element of a tunable parameter: before the start, or between two steps. */
static inline bool lw_plant_tune(uint32_t reference, size_t element, double value) {
    const lw_variable *variable = lw_variables + reference;
    double values[LW_AT_LEAST_1(LW_N_P)];
    memcpy(values, lw_plant.s.values + variable->first, variable->size * sizeof(double));
    values[element] = value;
    return lw_set(&lw_plant, "", &reference, 1, values, variable->size);
}
"""

Sized = Sequence[tuple[int, int]]
"""Value references of variables, each with its number of elements."""


def merge_model(
    path: str | os.PathLike[str],
    prefix: str,
    *,
    inputs: Sized,
    outputs: Sized,
    start: Iterable[tuple[int, Sequence[float]]],
) -> str | None:
    """Return an FMU of ours as C text with one instance, for a unit with other code.

    The text defines ``<prefix>lw_plant_enter``, ``…exchange``, ``…start``, ``…step`` and ``…tune``.

    Parameters
    ----------
    path : path
        The FMU.
    prefix : str
        Begin of every name of it, so that several are in one unit.
    inputs, outputs : sequence of (int, int)
        What is set before a step, and got after it.
    start : iterable of (int, sequence of float)
        Value references, each with its start value.

    Returns
    -------
    str or None
        None for an FMU that this version of Loopwright has not built.
    """
    sources = read_own_sources(path)
    if sources is None:
        return None
    started = list(start)
    values = [value for _, each in started for value in each]

    numbers: dict[str, object] = {
        "inputs": _listed(reference for reference, _ in inputs),
        "outputs": _listed(reference for reference, _ in outputs),
        "started": _listed(reference for reference, _ in started),
        "values": ", ".join(map(c_number, values)) or "0",
        "n_inputs": len(inputs),
        "n_outputs": len(outputs),
        "n_started": len(started),
        "n_values": len(values),
        "n_u": sum(size for _, size in inputs),
        "n_y": sum(size for _, size in outputs),
    }
    return name_apart(expand_sources("model.c", sources) + _INSTANCE % numbers, prefix)


def _listed(references: Iterable[int]) -> str:
    return ", ".join(map(str, references)) or "0"

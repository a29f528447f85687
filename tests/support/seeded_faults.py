"""Faults for the loop in C, each a change of its text, and a process that runs random diagrams with one of them.

``python -m support.seeded_faults NAME FILE`` reads records of the reference loop from the file, runs these diagrams with the
fault, and prints in how many of them it shows.
"""

import pickle
import sys
from pathlib import Path

_STEP_PLANTS = """\
    if (!s->stays || i) {
        const int64_t reason = step_plants(l, i, s->times[i], s->widths[i], g->out);
        if (reason != DONE) return h->inside = 0, reason;
    }
"""
_TAKE_STATES = "memcpy(l->x, l->x_next, (size_t)l->states * sizeof(double));\n"
_SETTLE = "    if (h->w.m || h->o) {\n        enter(h, g, t);"
_RECORD = "    g->out->rows = record(l, t, g->rows, g->out->rows);\n"
_HOLD = "    h->inside = 0;\n    hold_inputs(l, i);\n"
_LATE = """\
    static double late[64];
    h->inside = 0;
    for (int64_t j = 0; j < l->inputs; j++) l->held[j] = late[j], late[j] = l->z[j];
"""
_STRIDE = "    return (stride){l->own->begins[k], l->own->widths[k]};"
_ROOT = "lw_leave(&(search){w, p, m}, i, low, high, a, value_a, b, value_b, w->finest, lost);"
_EVALUATE = "        if ((out->reason = evaluate(l, kinds[i])) != DONE) break;\n"

FAULTS = {
    "the tick is evaluated before the plants have stepped": [
        (_STEP_PLANTS, ""),
        (_SETTLE, _STEP_PLANTS + _SETTLE),
    ],
    "plants get the inputs of the tick before": [(_HOLD, _LATE)],
    "plants with longer steps take the inputs of every tick": [
        ("if (l->own->holds[i * l->plants + j])", "if (l->own->holds[i * l->plants + j] || i >= 0)"),
    ],
    "longer steps of plants are as short as the ticks": [
        (_STRIDE, "    return (stride){l->own->begins[k], l->own->widths[k] > 0.0 ? whole.width : 0.0};"),
    ],
    "plants with longer steps step at every tick, too": [("    if (!l->own) return whole;", "    return whole;")],
    "an event is at the end of the bracket": [("const double t = " + _ROOT, "const double t = b;")],
    "events wait for the tick": [
        ("        const int result = settle(h, t, true);", "        const int result = QUIET;"),
    ],
    "events that a tick makes wait": [(_SETTLE, _SETTLE.replace("h->w.m || h->o", "h->o"))],
    "events within a few roundings behind a tick wait": [
        ("    if (!near || !(t > 0.0)) return QUIET;", "    if (near || !near) return QUIET;"),
    ],
    "an event that another one makes is left out": [
        (
            "        bool again = take_domains(w, w->domain, w->now, w->fires);",
            "        bool again = take_domains(w, w->domain, w->now, w->fires) && w->m < 0;",
        )
    ],
    "hysteresis is ignored": [
        ("nextafter(-w->hysteresis[i], INFINITY) - slack", "nextafter(0.0, INFINITY) - slack"),
        ("domain < 0.0 ? w->hysteresis[i] + slack", "domain < 0.0 ? slack"),
    ],
    "the dense output lacks its highest power": [
        ("k = rows - 1; k >= 0; k--) change", "k = rows - 2; k >= 0; k--) change"),
        ("k = m->order - 1; k >= 0; k--) change", "k = m->order - 2; k >= 0; k--) change"),
    ],
    "a sample is taken before the events that a tick makes": [
        (_SETTLE, _RECORD + _SETTLE),
        (_HOLD + _RECORD, _HOLD),
    ],
    "one sample more is left out": [("    l->skip = l->every - 1;", "    l->skip = l->every - (l->every < 2);")],
    "a source has its value from the left at its edge": [
        ("if (g->e < s->edges && s->edge[g->e] == t) p->at = t, p->late = s->late[g->e];", ""),
        ("    p->at = NAN;\n", "    p->at = t, p->late = left_of(t);\n"),
    ],
    "Newton's method stops early": [
        ("> s->rounding)) break;", "> 1e-5)) break;"),
        ("<= s->tolerance && is_determined(s)", "<= 1e-4 && is_determined(s)"),
    ],
    "step control accepts errors a thousand times too large": [
        ("        if (error < 1.0) {", "        if (error < 1e3) {")
    ],
    "sampled states are a tick old": [("        " + _TAKE_STATES + "        hold_inputs", "        hold_inputs")],
    "sampled states change before the tick": [
        (_EVALUATE, _EVALUATE + "        " + _TAKE_STATES + "        evaluate(l, kinds[i]);\n"),
    ],
}
"""By what is wrong: parts of the text, each of which is there once, and what stands in their places."""


def seed_fault(text, name):
    """Return the text with a fault.

    Raises
    ------
    ValueError
        For a part that is not there once.
    """
    for before, after in FAULTS[name]:
        if text.count(before) != 1:
            raise ValueError(f"{name}: found {text.count(before)} times, expected once: {before!r}")
        text = text.replace(before, after)
    return text


def main(name, file):
    """Run the diagrams of a file with a fault, and print in how many it shows, and how many there are."""
    from loopwright.diagrams.compiled import compiled_libraries
    from loopwright.fmus.runtime import runtime_source

    from .random_hybrid import differences, make, run

    text = runtime_source()
    changed = seed_fault(text, name) if name else text
    compiled_libraries.runtime_source = lambda: changed  # nothing has been loaded yet
    compiled_libraries.installed_runtime = lambda: Path("none")
    shown = 0
    records = pickle.loads(Path(file).read_bytes())
    for (family, seed), expected in records.items():
        case = make(family, seed)
        try:
            told = differences(case, expected, run(case))
        except Exception as error:
            told = [f"{type(error).__name__}: {error}"]
        if told:
            shown += 1
            print(case.diagram.name, told[0][:200])
    print(shown, len(records))


if __name__ == "__main__":
    main(*sys.argv[1:])

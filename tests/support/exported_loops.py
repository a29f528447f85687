"""Exported loops: the C text of a diagram, compiled and called by ctypes."""

import ctypes

import numpy as np

from loopwright.diagrams.compiled import load_compiled
from loopwright.fmus.export import write_unit

_SEEN = """
#define SEEN __attribute__((visibility("default")))
SEEN size_t size(void) { return sizeof(lw_memory); }
SEEN void fill(lw_memory *m) { lw_fill(m); lw_bind(m); }
SEEN void bind(lw_memory *m) { lw_bind(m); }
SEEN void renew(lw_memory *m) { lw_renew(m); }
SEEN int start(lw_memory *m, double t) { return lw_begin(m, t); }
SEEN int advance(lw_memory *m, double t) { return lw_go(m, t); }
SEEN double *p(lw_memory *m) { return m->p; }
SEEN double *w(lw_memory *m) { return m->w; }
SEEN double *x(lw_memory *m) { return m->x; }
SEEN double *logged(lw_memory *m) { return m->log; }
"""


class Loop:
    """One instance of an exported diagram."""

    def __init__(self, spec, **options):
        self.spec, self.library = spec, load_compiled(write_unit(spec, **options) + _SEEN)
        self.library.size.restype = ctypes.c_size_t
        self.memory = ctypes.create_string_buffer(self.library.size())
        self._call("fill")

    def _call(self, name, *more):
        function = self.library[name]
        function.restype = ctypes.c_void_p if name in ("p", "w", "x", "logged") else ctypes.c_int
        return function(ctypes.c_void_p(ctypes.addressof(self.memory)), *map(ctypes.c_double, more))

    def bind(self):
        """Set the pointers again, after the memory was copied."""
        self._call("bind")

    def vector(self, name):
        """Return a vector of the memory, to read and to write."""
        size = 1 + max(
            (
                place
                for group in ("inputs", "outputs", "signals", "parameters", "states")
                for one in getattr(self.spec, group)
                if one.vector == name
                for place in one.places
            ),
            default=0,
        )
        address = self._call({"log": "logged"}.get(name, name))
        return np.ctypeslib.as_array((ctypes.c_double * size).from_address(address))

    def _placed(self, name):
        spec = self.spec
        every = (*spec.inputs, *spec.outputs, *spec.signals, *spec.parameters, *spec.states)
        return next(one for one in every if one.variable.name == name)

    def __getitem__(self, name):
        one = self._placed(name)
        found = self.vector(one.vector)[list(one.places)]
        return found.copy() if one.variable.shape else float(found[0])

    def __setitem__(self, name, value):
        one = self._placed(name)
        self.vector(one.vector)[list(one.places)] = np.ravel(value)
        if one.vector == "p":
            self._call("renew")

    def start(self, t=0.0):
        """Evaluate everything at the start."""
        return bool(self._call("start", t))

    def advance(self, to):
        """Continue to a time in s."""
        return bool(self._call("advance", to))

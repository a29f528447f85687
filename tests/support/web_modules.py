"""Modules of pages, run by wasmtime as a page runs them."""

import base64
import json
import math
import re

import numpy as np
import wasmtime

CHUNK = 1024


def parts_of(html):
    """Return the module of a page, and its data."""
    module = re.search(r'<script type="text/plain" id="lw-module">([^<]*)</script>', html)[1]
    data = re.search(r'<script type="application/json" id="lw-data">([^<]*)</script>', html)[1]
    return base64.b64decode(module), json.loads(data)


class Module:
    """A page's module: parameters are set, ticks are gone through, samples are read."""

    def __init__(self, html):
        code, self.data = parts_of(html)
        self._store = wasmtime.Store()
        module = wasmtime.Module(self._store.engine, code)
        self.imports = [one.name for one in module.imports]
        given = [self._function(one) for one in module.imports]
        self._calls = wasmtime.Instance(self._store, module, given).exports(self._store)
        self.names = [column["name"] for column in self.data["columns"]]
        self._call("fill")

    def _function(self, one):
        assert one.module == "math"
        return wasmtime.Func(self._store, one.type, getattr(math, one.name))

    def _call(self, name, *arguments):
        return self._calls[name](self._store, *arguments)

    def _numbers(self, address, count):
        content = self._calls["memory"].read(self._store, address, address + 8 * count)
        return np.frombuffer(bytes(content))

    def set(self, place, value):
        """Set a parameter of a block or of an FMU by its place, as a slider does."""
        address = self._call("parameters") + 8 * place
        self._calls["memory"].write(self._store, np.float64(value).tobytes(), address)
        self._call("renew")

    def slider(self, name):
        """Return a slider of the page."""
        return next(one for group in self.data["groups"] for one in group["sliders"] if one["name"] == name)

    def begin(self):
        """Begin at t = 0."""
        self._call("renew")
        self._call("begin")
        return not self._call("failed")

    def run(self, ticks):
        """Go through ticks; return the samples, a row for each: time and columns."""
        rows, width = [], len(self.names) + 1
        while ticks:
            count = self._call("run", min(CHUNK, ticks), math.inf)
            rows.append(self._numbers(self._call("samples"), count * width).reshape(count, width).copy())
            if self._call("failed"):
                break
            ticks -= count
        return np.concatenate(rows)

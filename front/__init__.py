"""Loopwright: block-diagram simulation and co-simulation for control engineers.

Here is what most programs begin with. The rest is in

- `loopwright.blocks`: the library of blocks,
- `loopwright.fmus`: plants, their export as FMUs, FMUs of any tool,
- `loopwright.diagrams`: diagrams, requirements, reports, the paper's Fig. 3 and its experiments,
- `loopwright.frequency`: functions of loops: margins, disk margins, Nyquist counts, pole placement,
- `loopwright.sweeps`: samples of parameters, and what is kept of each run,
- `loopwright.types`: classes of results, for annotations and ``isinstance``.

Importing loads none of these, and changes no global state: a name is loaded when it is first used.
"""

from .blocks.public_names import load_on_use as _load_on_use

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in __init__.pyi

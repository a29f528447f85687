"""Linear models over communication steps and the coupling of FMUs."""

from __future__ import annotations

from ...blocks.core import OptionError
from ..coupling import Links, tells_slopes
from ..flat import FlatDiagram
from ..results import OperatingPoint


def check_coupling(flat: FlatDiagram, at: OperatingPoint) -> None:
    """Refuse a model over communication steps whose FMUs a run couples in another way than the model.

    The model holds the FMUs' inputs from the beginning of a step, as the default coupling does. Where every input
    comes from sampled subsystems, it is held by every scheme.

    Raises
    ------
    OptionError
        If an input changes within a step, and the coupling is not the default; if the run tells an FMU slopes.
    """
    for path, inputs in Links(flat).inputs.items():
        if inputs.stop > inputs.start and tells_slopes(flat.table.blocks[path]):
            raise OptionError(
                "found input_derivatives among its options: its inputs are ramps over a communication step; expected "
                "held inputs, which a linear model over communication steps has. Linearize the diagram with "
                f"replace({{{path!r}: …}}), the FMU without this option.",
                block=path,
                port="stepping",
            )
    if not at.coupling:
        return
    links = Links(flat)
    found = [path for path in links.paths if links.moving[links.inputs[path]].any()]
    if found:
        raise OptionError(
            f"found an operating point of a run with coupling {at.coupling!r}, in which inputs of {', '.join(found)} "
            "are not held from the beginning of a communication step; expected coupling 'jacobi', which a linear model "
            "over communication steps follows. Linearize at a point of a run with that coupling, or, without sampled "
            "subsystems, in continuous time: linearize(t) without step=, which all couplings approach with shorter "
            "steps.",
            block=found[0],
            port="coupling",
        )

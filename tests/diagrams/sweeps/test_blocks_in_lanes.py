"""Every block of the library that is sampled and has operations on scalars goes side by side as it goes by itself."""

from inspect import Parameter, Signature

import numpy as np
import pytest

from loopwright.blocks import (
    Constant,
    CubicSpline,
    Lookup1D,
    Lookup2D,
    PiecewiseLinear,
    PythonFunction,
    Recorded,
    Sine,
    UnitConversion,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from support.library import CASES

T, DURATION = 0.01, 1.2
GROUPS, LANES = 6, 4
BOUND = 1e-11
TABLES = (CubicSpline, Lookup1D, Lookup2D, PiecewiseLinear, PythonFunction, Recorded)
SAMPLED = [
    (block, options)
    for block, options, kinds in CASES
    if "sampled" in kinds
    and block.outputs
    and not isinstance(block, (*TABLES, UnitConversion))
    and not any(isinstance(value, TABLES) for value in block.parameters.values())
]


def driven(place, block, options, scale):
    """Return the outputs of a sampled block whose inputs swing, each at a frequency of its own."""
    given, shapes, sources = options.get("inputs", {}), options.get("shapes", {}), {}
    for i, port in enumerate(block.inputs):
        source = given.get(port)
        if not hasattr(source, "outputs"):
            low, high = source if source is not None else (-1.5, 1.5)
            shape = np.shape(low) or shapes.get(port, block.inputs[port].shape or ())
            middle, half = np.broadcast_to((low + high) / 2, shape), np.broadcast_to((high - low) / 2, shape)
            wave = Sine(frequency=1.3 + 0.37 * i + 0.05 * place, name=f"s{place}_{i}") * scale
            source = wave * Constant(value=half, name=f"h{place}_{i}") + Constant(value=middle, name=f"m{place}_{i}")
        sources[port] = source
    own = block.replace(name=f"b{place}")

    def inside(**values):
        own(**values)
        found = tuple(getattr(own, port) for port in own.outputs)
        return found if len(found) > 1 else found[0]

    inside.__signature__ = Signature([Parameter(port, Parameter.POSITIONAL_OR_KEYWORD) for port in sources])
    made = subsystem(sample_time=T, name=f"box{place}")(inside)(**sources)
    made = tuple(made) if len(own.outputs) > 1 else (made,)
    return {f"y{place}_{k}": signal.named(f"y{place}_{k}") for k, signal in enumerate(made)}


def diagram_of(cases):
    scale = Constant(value=1.0, name="scale")
    signals = {"scaled": (2.0 * scale).named("scaled")}
    for place, (block, options) in cases:
        signals |= driven(place, block, options, scale)
    return Diagram("library", *signals.values()), [*signals]


@pytest.mark.slow
@pytest.mark.parametrize("group", range(GROUPS))
def test_every_sampled_block_goes_side_by_side_as_by_itself(group):
    diagram, names = diagram_of([*enumerate(SAMPLED)][group::GROUPS])
    scales = {"scale.value": (0.61, 0.83, 0.97, 1.0, 1.13)}
    found = diagram.sweep(scales, DURATION, signals=names, lanes=LANES, workers=1, progress=False)
    alone = diagram.sweep(scales, DURATION, signals=names, workers=1, progress=False)
    assert DIFFER in found.messages, found.messages
    assert [f.message for f in found.failures] == [f.message for f in alone.failures]
    assert np.array_equal(found.end, alone.end)
    for name in names:
        largest = np.nanmax(np.abs(alone[name]), initial=1e-3)
        np.testing.assert_allclose(found[name], alone[name], rtol=0, atol=BOUND * largest, err_msg=name)

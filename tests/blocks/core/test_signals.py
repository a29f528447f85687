"""Signals and calls as values: what they unpack into, how they are indexed, what completes in a notebook."""

import inspect
import re

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    Gain,
    Input,
    Output,
    Saturation,
    SmoothStep,
    State,
    Sum,
    TransferFunction,
    UnitError,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import Diagram


class Pair(Block):
    """Two outputs and an input that may stay unwired."""

    u = Input(default=1.0)
    first = Output()
    second = Output()
    rest = Output(secondary=True)

    def output(self, t, x, u):
        return u.u, 2.0 * u.u, 3.0 * u.u


class ForceIn(Block):
    """An input in N."""

    u = Input(unit="N")
    y = Output()

    def output(self, t, x, u):
        return u.u


class Silent(Block):
    """No output."""


STEP = SmoothStep(levels=(0, 1), start_times=0, durations=1, name="step")


# --- unpacking -------------------------------------------------------------------------------------------------------


def test_a_block_without_unwired_inputs_unpacks_into_its_primary_outputs():
    pair = Pair()
    first, second = pair
    assert [(s.source, s.port) for s in pair] == [(pair, "first"), (pair, "second")]
    run = Diagram("d", Gain(gain=1.0)(first).named("a"), Gain(gain=1.0)(second).named("b")).simulate(
        1.0, step=0.5, progress=False
    )
    assert (run["a"][0], run["b"][0]) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("block", "text"),
    [
        (STEP, r"step\.y: this is one signal and can't be unpacked; index it"),
        (Gain(gain=2, name="twice"), r"twice: it is used as a signal before it is wired; call it first"),
        (Saturation(limit=1.0), r"saturation: it is used as a signal before it is wired"),
        (Silent(), r"silent: found 0 outputs \(none\); expected one, as a signal. Declare one"),
    ],
    ids=["one output", "unwired", "unwired, two outputs", "no output"],
)
def test_a_block_that_is_no_tuple_of_signals_says_so(block, text):
    with pytest.raises(WiringError, match=text):
        list(block)
    with pytest.raises(WiringError, match=text):
        _, _ = block


def test_a_part_of_a_signal_is_one_signal():
    with pytest.raises(WiringError, match=r"step\.y: this is one signal"):
        _, _ = STEP[:2]


# --- indexing --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [True, False, np.True_, 1.0, np.float64(1), (0,), None, slice(0.0, 1), slice(True)])
def test_an_index_that_is_no_integer_is_refused(index):
    with pytest.raises(WiringError, match=r"y: found the index .*; expected an integer or a slice of integers"):
        STEP.y[index]


@pytest.mark.parametrize("index", [1, np.int64(1), np.uint8(1), np.array(1)])
def test_numpys_integers_index_as_pythons_do(index):
    assert type(STEP.y[index].index) is int
    assert STEP.y[index].index == 1


def test_a_part_taken_by_numpys_integer_has_its_value():
    vector = Constant(value=(5.0, 6.0, 7.0))
    run = Diagram(
        "d", *(Gain(gain=1.0, name=f"g{i}")(vector[i]) for i in np.arange(3)), Gain(gain=1.0)(vector[np.int64(1) :])
    ).simulate(1.0, step=0.5, progress=False)
    assert [run[f"g{i}.y"][0] for i in range(3)] == [5.0, 6.0, 7.0]
    assert run["gain.y"][0].tolist() == [6.0, 7.0]
    assert vector.y[np.int64(1) :].index == slice(1, None)


# --- what completes --------------------------------------------------------------------------------------------------


def test_outputs_complete_on_blocks_and_calls():
    assert {"y", "excess", "named"} <= set(dir(Saturation(limit=1.0)(STEP[0])))
    assert {"y", "replace", "value"} <= set(dir(Constant(value=1.0)))
    assert "y" in Saturation(limit=1.0)(STEP[0])._ipython_key_completions_()
    assert dir(STEP.y)  # a signal has none, and does not fail


def test_the_signature_of_a_blocks_call_is_its_inputs():
    assert list(inspect.signature(Sum(signs="+-+")).parameters) == ["u1", "u2", "u3"]
    assert inspect.signature(Pair()).parameters["u"].default == 1.0


def test_ports_that_follow_from_parameters_are_inherited():
    class Named(Constant):
        """A constant with another name."""

    assert Named(value=(1.0, 2.0), unit="m").outputs["y"].shape == (2,)
    assert Named(value=1.0, unit="m").outputs["y"].unit == "m"


# --- like ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("port", [Output(like="v"), State(like="v")])
def test_like_names_an_input_of_the_block(port):
    from loopwright.blocks import DefinitionError

    with pytest.raises(DefinitionError, match=r"Wrong\.y: found like='v'; expected an input of this block\. Known: u"):
        type("Wrong", (Block,), {"u": Input(), "y": port})


def test_an_output_like_an_input_has_its_unit_and_the_shape_of_the_equations():
    limited = Saturation(limit=(1.0, 2.0), name="limited")(Constant(value=3.0, unit="N"))
    run = Diagram("d", limited).simulate(1.0, step=0.5, progress=False)
    assert run.unit("limited.y") == "N"
    assert run["limited.y"][0].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "decide",
    [
        lambda s: bool(s),
        lambda s: s and 1,
        lambda s: s == 0,
        lambda s: s != 0.0,
        lambda s: 0.0 < s < 1.0,
        lambda s: min(s, 2.0),
        lambda s: np.max([s, s]),
    ],
)
@pytest.mark.parametrize("signal", [Constant(value=1.0).y, Gain(gain=2.0)(1.0)], ids=["signal", "call"])
def test_nothing_is_decided_on_a_signal_while_wiring(decide, signal):
    with pytest.raises(
        WiringError, match=r"while the diagram is wired: its values come with the run. Write (np\.where|abs)"
    ):
        decide(signal)


def test_signals_are_still_told_apart_and_hashed():
    a, b = Constant(value=1.0).y, Constant(value=1.0).y
    assert a != b
    assert {a, b} == {b, a}
    assert len({a, b, a}) == 2


def test_minus_keeps_the_unit():
    force = Constant(value=2.0, unit="m").named("u")
    with pytest.raises(UnitError, match="is in m; expected in N"):
        Diagram("d", ForceIn()(-force))
    run = Diagram("d", Gain(gain=3.0)(-force).named("y")).simulate(0.1, step=0.1, progress=False)
    assert run["y"].tolist() == [-6.0, -6.0]


def test_a_matrix_is_applied_from_the_left():
    K = np.array([[1.0, 2.0], [0.0, -1.0], [5.0, 0.0]])
    run = Diagram("d", (K @ Constant(value=(3.0, 4.0)).named("u")).named("y")).simulate(0.1, step=0.1, progress=False)
    assert run["y"][0].tolist() == [11.0, -4.0, 15.0]


def test_a_misspelt_port_offers_near_names():
    with pytest.raises(UnknownNameError, match=r"gain: it has no output or parameter 'gian'.*Did you mean 'gain'"):
        _ = Gain(gain=1.0).gian
    assert not hasattr(Gain(gain=1.0), "velocty")
    with pytest.raises(UnknownNameError, match=r"motor: it has no output or parameter 'out'.*Its outputs: y\.$"):
        _ = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor").out


def test_a_source_names_its_wire():
    run = Diagram("d", Constant(value=2.0).named("two")).simulate(0.1, step=0.1, progress=False)
    assert run["two"].tolist() == [2.0, 2.0]


# --- what can be done with numbers only -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("act", "instead"),
    [
        (lambda y: y % 2.0, r"Function(lambda u: np.mod(u, …))(u) in a sampled subsystem"),
        (lambda y: y // 2.0, r"Function(lambda u: np.floor(u / …))(u) in a sampled subsystem"),
        (np.floor, r"np.floor can't be applied to a signal: its values come with the run. It jumps, where a solver"),
        (np.sign, r"Write (u > 0.0) - (u < 0.0), whose"),
        (np.round, r"Use Quantizer(quantum=1.0)(u)"),
        (round, r"Use Quantizer(quantum=1.0)(u)"),
        (lambda y: np.interp(y, [0, 1], [0, 1]), r"Use Lookup1D(breakpoints=…, values=…)(u)"),
        (np.shape, r"Its shape follows when the diagram is built"),
        (lambda y: np.sin(y, out=np.zeros(1)), r"np.sin can't be applied to a signal"),
        (np.add.reduce, r"np.add.reduce can't be applied to a signal"),
        (
            np.fft.fft,
            r"np.fft can't be applied to a signal: its values come with the run. Write it as the function of a",
        ),
        (np.where, r"Write np.where(condition, then, otherwise)"),
        (float, r"Use NumPy's functions, which make blocks: np.sin(u) for math.sin"),
    ],
)
def test_what_can_be_done_with_numbers_only_says_what_to_write_instead(act, instead):
    block = Gain(gain=2.0, name="k")
    call = block(1.0)
    for signal in (call, call.y, block.y, Constant(value=1.0, name="k")):
        with pytest.raises(WiringError, match=re.escape(instead)) as error:
            act(signal)
        assert error.value.block == "k"


def test_arrays_and_numpys_numbers_work_with_signals_from_either_side():
    a, w = Constant(value=(6.0, 8.0), name="a"), np.array([1.0, 2.0])
    made = {
        "sum": w + a,
        "difference": w - a,
        "other": a.y - w,
        "product": w * a,
        "scaled": np.float64(2.0) * a,
        "added": np.add(a, w),
        "half": a / np.float64(2.0),
        "matrix": np.diag(w) @ a,
    }
    run = Diagram("d", *(signal.named(name) for name, signal in made.items())).simulate(1.0, step=1.0, progress=False)
    x = np.array([6.0, 8.0])
    want = {
        "sum": w + x,
        "difference": w - x,
        "other": x - w,
        "product": w * x,
        "scaled": 2 * x,
        "added": x + w,
        "half": x / 2,
        "matrix": w * x,
    }
    assert {name: run[name][-1].tolist() for name in made} == {name: value.tolist() for name, value in want.items()}
    for act in (lambda: w == a.y, lambda: a.y != w):
        with pytest.raises(WiringError, match="has no value to compare while the diagram is wired"):
            act()
    assert (w == a) is False  # a block is a value, and no array

"""Calls as other tools and textbooks have them: the error says what to write here, with the user's own numbers."""

import re

import control
import numpy as np
import pytest

from loopwright import blocks
from loopwright.blocks import (
    PID,
    PT1,
    Constant,
    Gain,
    LoopwrightError,
    Observer,
    Saturation,
    Sine,
    StateFeedback,
    StateSpace,
    Step,
    TransferFunction,
    ZeroPoleGain,
)
from loopwright.blocks.core.units import parse_unit
from loopwright.blocks.names_of_other_tools import BY_POSITION, KEYWORDS, UNITS
from loopwright.diagrams import Diagram

TF, SS = control.tf([1.0], [1.0, 1.0]), control.ss(-1.0, 1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("call", "written"),
    [
        (lambda: Gain(3), "Write Gain(gain=3)."),
        (lambda: TransferFunction([2], [0.05, 1], name="p"), "numerator=[2], denominator=[0.05, 1], name='p')."),
        (lambda: StateSpace([[-1]], [1], [1], 0.0), "Write StateSpace(A=[[-1]], B=[1], C=[1], D=0)."),
        (lambda: Step(0.1, 2.0), "Write Step(times=0.1, values=2)."),
        (lambda: Step(0.1), "Write Step(times=0.1, values=…)."),
        (lambda: Sine(2.0), "Write Sine(frequency=2)."),
        (lambda: PT1(2.0, 0.5), "Write PT1(gain=2, time_constant=0.5)."),
        (lambda: PT1(0.5), "Write PT1(time_constant=0.5)."),
        (lambda: ZeroPoleGain([], [-1], 2), "Write ZeroPoleGain(zeros=[], poles=[-1], gain=2)."),
        (lambda: Saturation(-1, 2), "Write Saturation(lower=-1, upper=2)."),
        (
            lambda: TransferFunction(np.zeros(50), [1, 1]),
            "Write TransferFunction(numerator=<50 numbers>, denominator=[1, 1]).",
        ),
    ],
)
def test_a_call_by_position_is_repeated_by_keyword(call, written):
    with pytest.raises(LoopwrightError) as caught:
        call()
    assert str(caught.value).endswith(written)
    if not {"…", "<"} & set(written):  # what the error offers can be typed
        eval(re.search(r"Write (.*)\.$", str(caught.value))[1], vars(blocks))


@pytest.mark.parametrize(
    ("call", "written"),
    [
        (lambda: Observer(A=-1, B=1, C=1, L=2), "Observer(control.ss(A, B, C, D), gain=L)"),
        (lambda: StateFeedback(K=[1.0]), "Write gain=…"),
        (lambda: PID(K=2.0, Ti=1.0), "PID.from_ideal_form(gain=…, integral_time=…"),
        (lambda: PID(kp=1.0, sample_time=0.1), "of the subsystem that the block is in: @subsystem(sample_time=…)"),
        (lambda: Saturation(min=-1.0), "Write lower=…"),
        (lambda: Gain(gian=1.0), "Did you mean 'gain'?"),
        (lambda: Constant(value=1.0, unit="Newton"), "Did you mean 'N'?"),
    ],
)
def test_a_word_of_another_tool_leads_to_the_one_here(call, written):
    with pytest.raises(LoopwrightError) as caught:
        call()
    assert written in str(caught.value)


def test_the_tables_lead_to_parameters_that_exist():
    for table in (KEYWORDS, BY_POSITION):
        for name, ways in table.items():
            specs = getattr(blocks, name).parameter_specs
            assert not set(KEYWORDS.get(name, ())) & set(specs), name
            for text in ways.values() if isinstance(ways, dict) else [f"{way}=…" for way in ways]:
                if re.match(r"\w+=", text):
                    assert set(re.findall(r"(?:^|, )(\w+)=", text.split(", or ")[0])) <= set(specs), (name, text)
    assert all(parse_unit(symbol) for symbol in UNITS.values())


@pytest.mark.parametrize(
    ("call", "block"),
    [
        (lambda u: TF(u), "TransferFunction"),
        (lambda u: TF * u, "TransferFunction"),
        (lambda u: u * SS, "StateSpace"),
        (lambda u: u - TF, "TransferFunction"),
        (lambda u: Diagram("d", TF), "TransferFunction"),
        (lambda u: Diagram("d", SS), "StateSpace"),
        (lambda u: Gain(gain=2.0)(control.tf([1.0], [1.0, 0.5], 0.1)), "DiscreteTransferFunction"),
        (lambda u: TransferFunction(TF), "TransferFunction"),
        (lambda u: Diagram("d", Gain(gain=2.0, name="g")(u)).replace(g=TF), "TransferFunction"),
    ],
)
def test_a_system_of_python_control_leads_to_the_block_that_is_made_of_it(call, block):
    with pytest.raises(LoopwrightError) as caught:
        call(Step(times=0.1, values=1.0).y)
    assert f" {block}.from_control(system)" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rows_of_different_lengths_are_said():
    with pytest.raises(LoopwrightError, match=r"A: found \[\[0, 1\], \[-1\]\]; expected rows of one length"):
        StateSpace(A=[[0, 1], [-1]], B=[[0], [1]], C=[[1, 0]], D=0.0)

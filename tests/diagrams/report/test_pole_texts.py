"""Poles as texts: pairs, real ones, and single sampled ones with z < 0."""

import control
import numpy as np
import pytest

from loopwright.blocks import DiscreteStateSpace, Gain
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.report import list_poles

T = 0.1


def test_pairs_are_joined_and_single_poles_stand_alone():
    assert list_poles([]) == "none"
    assert list_poles([-2.0, -1 + 1j, -1 - 1j, -5.0]) == "-1 ± 1j, -2, -5"
    assert list_poles([-1 + 1j, -1 + 1j, -1 - 1j, -1 - 1j]) == "-1 ± 1j, -1 ± 1j"
    assert list_poles([-1 + 2j]) == "-1 + 2j"  # no system of real numbers has it, and it is not called a pair


@pytest.mark.parametrize("z", [-0.5, -0.999, -1.3])
def test_a_single_pole_with_negative_z_is_no_pair(z):
    text = list_poles([np.log(complex(z)) / T], T)
    assert text == f"{np.log(-z) / T:.6g} + jπ/T (z = {z:g})"


def test_two_poles_with_negative_z_are_two_and_a_pair_beside_the_axis_is_a_pair():
    assert list_poles(np.log([-0.5 + 0j, -0.25 + 0j]) / T, T).count("jπ/T") == 2
    pair = np.log([-0.5 + 0.1j, -0.5 - 0.1j]) / T
    assert list_poles(pair, T) == f"{pair[0].real:.6g} ± {pair[0].imag:.6g}j"


def test_the_report_writes_the_pole_of_a_loop_that_alternates():
    """x⁺ = 0.5 x + u with u = −0.9 x: the only pole is z = −0.4, which python-control has as well."""

    @subsystem(sample_time=T)
    def box():
        plant = DiscreteStateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], name="plant")
        return plant(Gain(gain=-0.9, name="k")(plant.y).named("u"))

    report = Diagram("d", box()).report(only=("inner",))
    (loop,) = report.sections[0].sections
    rows = next(t for t in loop.tables if t.title == "Closed-loop poles of the loop at box.u").rows
    (z,) = control.feedback(control.tf([0.9], [1.0, -0.5], T), 1).poles()
    assert rows[0][1] == f"{np.log(-z.real) / T:.6g} + jπ/T (z = -0.4)"

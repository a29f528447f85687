"""Worst cases that the search finds, beside the best of 1000 random points and a run; loops that have none."""

import json

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Constant,
    Gain,
    Integrator,
    OptionError,
    Saturation,
    TransferFunction,
)
from loopwright.diagrams import Diagram, Requirements, subsystem
from support.tuned_loops import make_pi_loop, make_slide, slide_slope

COUNT = 1000


def margins_on(omega, L):
    """Return the smallest phase margin in degrees of each row of L on a grid of frequencies, by its crossings."""
    size, found = np.log(np.abs(L)), np.full(len(L), np.inf)
    angle = np.abs(np.degrees(np.angle(-L)))
    rows, places = np.nonzero(np.diff(np.sign(size), axis=1))
    share = size[rows, places] / (size[rows, places] - size[rows, places + 1])
    values = angle[rows, places] + share * (angle[rows, places + 1] - angle[rows, places])
    np.minimum.at(found, rows, values)
    return found


def draw(ranges, seed=7):
    rng = np.random.default_rng(seed)
    return [rng.uniform(low, high, COUNT) for low, high in ranges.values()]


def agree(found, random):
    """Check that a search has found no better than the best of random points, and that a run confirms it."""
    assert found.worst.value <= np.min(random) * (1 + 1e-6)
    confirmed = found.confirm()
    assert confirmed.agrees, confirmed


def make_two_rates():
    speed, place = Integrator(name="speed"), Integrator(name="place")

    @subsystem(sample_time=0.02)
    def fast(y, wish):
        return Gain(gain=8.0, name="k")(wish - y)

    @subsystem(sample_time=0.1)
    def slow(y):
        return Gain(gain=2.0, name="k")(Constant(value=0.0, name="r") - y).named("u")

    return Diagram("two", place(speed.y), speed(fast(speed.y, slow(place.y))))


@pytest.mark.slow
def test_a_loop_with_two_rates():
    """Five fast ticks in a slow one: the matrices are multiplied out."""
    ranges = {"fast.k.gain": (4.0, 30.0), "slow.k.gain": (1.0, 4.0)}
    found = make_two_rates().worst_case(ranges, "slow.u", quantity="phase_margin_deg", count=15, seed=1)
    held = expm(np.array([[0, 1.0, 0], [0, 0, 1.0], [0, 0, 0]]) * 0.02)
    omega, random = np.linspace(0.2, 25.0, 1500), []
    for kf, ks in zip(*draw(ranges), strict=True):
        A = held[:2, :2] - kf * held[:2, 2:] @ np.array([[0.0, 1.0]])
        B = sum(np.linalg.matrix_power(A, i) for i in range(5)) @ held[:2, 2:] * kf
        poles, modes = np.linalg.eig(np.linalg.matrix_power(A, 5))
        weights = modes[0] * np.linalg.solve(modes, B)[:, 0]
        L = ks * np.sum(weights / (np.exp(0.1j * omega)[:, None] - poles), axis=1)
        random.append(margins_on(omega, L[None])[0])
    agree(found, random)


@pytest.mark.slow
def test_a_loop_at_an_operating_point_with_friction():
    """At 0.3 m/s the friction's slope is b + (c/w) sech²(0.3/w); the controller's integral carries the friction."""
    ranges = {"slide.coulomb": (0.5, 6.0), "slide.width": (0.1, 0.6), "slide.mass": (1.0, 4.0)}
    at = {"at": lambda d: d.trim(targets={"slide.speed": 0.3})}
    found = make_slide().worst_case(ranges, "u", quantity="phase_margin_deg", count=20, seed=2, **at)
    coulomb, width, mass = (v[:, None] for v in draw(ranges))
    s = 1j * np.geomspace(0.5, 100.0, 4000)
    agree(found, margins_on(s.imag, (6.0 + 40.0 / s) / (mass * s + slide_slope(coulomb, width))))
    assert not found.failures


def make_enabled():
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0, 0.0], name="plant")

    @subsystem(enabled="held")
    def extra(y):
        return Gain(gain=0.5, name="kd")(Integrator(name="w")(y))

    @subsystem(sample_time=0.05)
    def control(y):
        return Gain(gain=2.0, name="kp")(y).named("s")

    error = Constant(value=0.0, name="r") - plant.y
    command = control(error) + extra(error, enable=Constant(value=1.0, name="on"))
    return Diagram("enabled", plant(command.named("u")))


@pytest.mark.slow
def test_a_sampled_loop_beside_an_enabled_subsystem():
    ranges = {"control.kp.gain": (1.0, 4.0), "extra.kd.gain": (0.1, 0.6)}
    found = make_enabled().worst_case(ranges, "control.s", quantity="phase_margin_deg", count=15, seed=1)
    T, omega, random = 0.05, np.linspace(0.3, 20.0, 3000), []
    for kp, kd in zip(*draw(ranges), strict=True):
        rates = np.zeros((4, 4))
        rates[:3] = [[0, 1, 0, 0], [0, -1, kd, 1], [-1, 0, 0, 0]]
        held = expm(rates * T)
        poles, modes = np.linalg.eig(held[:3, :3])
        weights = modes[0] * np.linalg.solve(modes, held[:3, 3])
        L = kp * np.sum(weights / (np.exp(1j * omega * T)[:, None] - poles), axis=1)
        random.append(margins_on(omega, L[None])[0])
    agree(found, random)


def test_a_wire_without_a_loop_at_ticks_has_no_worst_case():
    """The sum of a sampled and a continuous signal changes between ticks."""
    with pytest.raises(OptionError, match="'u' changes between ticks.*closed at ticks"):
        make_enabled().worst_case({"control.kp.gain": (1.0, 4.0)}, "u", quantity="ms", count=2, starts=0)


def test_a_wire_that_is_renewed_several_times_has_no_worst_case():
    with pytest.raises(OptionError, match="renewed 5 times in the model's period"):
        make_two_rates().worst_case({"fast.k.gain": (4.0, 30.0)}, "fast.k.y", quantity="ms", count=2, starts=0)


def test_the_worst_case_says_what_its_linear_model_leaves_out():
    lag = Integrator(name="lag")
    command = Saturation(lower=0.0, upper=5.0, name="limit")(Gain(gain=3.0, name="k")(0.0 - lag.y)).named("u")
    diagram = Diagram("kink", lag(command))
    found = diagram.worst_case({"k.gain": (1.0, 4.0)}, "u", quantity="ms", count=2, starts=0)
    assert found.worst.numbers["u",]["ms"].findings
    assert "†" in str(found)


def test_a_vector_has_a_disk_margin_alone_and_says_so():
    gain, state = Gain(gain=np.eye(2), name="k"), Integrator(name="x", initial_value=np.zeros(2))
    diagram = Diagram("vector", state(gain(Constant(value=np.zeros(2), name="r") - state.y).named("u")))
    with pytest.raises(OptionError, match=r"found no ms; .* Take one of: disk_margin"):
        diagram.worst_case({"k.gain[1,1]": (0.5, 2.0)}, "u", quantity="ms", count=2, starts=0)


def test_tables_are_plain_numbers():
    diagram = make_pi_loop()
    rows = json.loads(json.dumps(diagram.sensitivities("u", ["p.gain", "ki.gain"]).table()))
    assert {row["parameter"] for row in rows} == {"p.gain", "ki.gain"}
    cases = diagram.worst_case({"p.gain": (0.5, 2.0)}, "u", requirements=Requirements(ms=1.6), count=2, starts=0)
    rows = json.loads(json.dumps(cases.table()))
    assert [row["case"] for row in rows] == [case.index for case in sorted(cases.cases, key=lambda c: c.goodness)]
    assert all(isinstance(row.get("p.gain", 1.0), float) for row in rows)

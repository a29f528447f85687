"""Continuous states in vector lanes: methods of fixed step, all runs in step."""

import numpy as np
import pytest

from loopwright.blocks import (
    BandLimitedNoise,
    Constant,
    Gain,
    Integrator,
    PulseTrain,
    Recorded,
    Relay,
    Saturation,
    Sine,
    Step,
    TransferFunction,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from loopwright.fmus import Fmu
from support.lanes import QUIET, T, lag

LANES, NEAR = 4, 1e-12
GROWTH = {
    "euler": lambda z: 1 + z,
    "heun": lambda z: 1 + z + z**2 / 2,
    "rk3": lambda z: 1 + z + z**2 / 2 + z**3 / 6,
    "rk4": lambda z: 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24,
}


def swept(diagram, table, signals, duration=0.5, *, lanes=LANES, **options):
    options = {"solver": "rk4", "step": T, "workers": 1, **options, **QUIET}
    return diagram.sweep(None, duration, samples=table, signals=signals, lanes=lanes, **options)


def apart(found):
    return [text for text in found.messages if text.startswith("Not side by side")]


@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", [*GROWTH][::-1])
def test_a_lag_behind_a_jump_at_a_tick_is_what_the_method_gives_in_closed_form(solver):
    """τ ẏ = K u − y with u = 0 before 0.1 s and a after it: y(n + 1) = G y(n) + (1 − G) K a, G the method's growth."""
    jump = Step(times=0.1, values=1.0, name="jump")
    diagram = Diagram(
        "lag",
        Gain(gain=1.0, name="k")(TransferFunction(numerator=(1.0,), denominator=(0.05, 1.0), name="lag")(jump)).named(
            "y"
        ),
    )
    table = [
        {"jump.values": a, "k.gain": k, "lag.denominator": (tau, 1.0), "jump.times": at}
        for a, k, tau, at in ((1.0, 2.0, 0.05, 0.1), (-3.0, 1.0, 0.08, 0.0), (0.5, 0.7, 0.2, 0.13))
    ]
    found = swept(diagram, table, ["y"], solver=solver)
    assert DIFFER in found.messages
    assert not apart(found)
    for row, values in zip(table, found["y"], strict=True):
        growth = GROWTH[solver](-T / row["lag.denominator"][0])
        wanted, y = [], 0.0
        for n in range(51):
            wanted.append(row["k.gain"] * y)
            if n >= round(row["jump.times"] / T):
                y = growth * y + (1.0 - growth) * row["jump.values"]
        np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-14)


HEIGHTS = [0.3, -1.2, 0.8, 2.0, -0.4, 0.9, -2.1]
NOISE = BandLimitedNoise(sample_time=T, seed=3, name="source")
JUMPING = {
    "a step at the end": (Step(times=12 * T, values=1.0, name="source"), lambda n: float(n >= 12)),
    "pulses": (PulseTrain(period=4 * T, name="source"), lambda n: float(n % 4 < 2)),
    "a record": (
        Recorded(times=[2 * T * k for k in range(7)], values=HEIGHTS, interpolation="previous", name="source"),
        lambda n: HEIGHTS[n // 2],
    ),
    "noise": (NOISE, lambda n: float(NOISE.output(n * T, None, None))),
}


@pytest.mark.drawn(4)
@pytest.mark.parametrize("solver", GROWTH)
@pytest.mark.parametrize("kind", JUMPING)
def test_a_source_that_jumps_at_ticks_reaches_a_lag_behind_them_up_to_the_last_one(kind, solver):
    """Between ticks the source is constant: y(n + 1) = G y(n) + (1 − G) K u(nT). The last tick has a jump, too."""
    source, value = JUMPING[kind]
    delayed = TransferFunction(numerator=(1.0,), denominator=(0.05, 1.0), name="lag")(source)
    diagram = Diagram("lag", Gain(gain=1.0, name="k")(delayed).named("y"))
    table = [{"k.gain": k} for k in (1.0, -0.7, 2.0)]
    found = swept(diagram, table, ["y"], 12 * T, solver=solver)
    assert not apart(found)
    growth, y = GROWTH[solver](-T / 0.05), [0.0]
    for n in range(12):
        y.append(growth * y[-1] + (1.0 - growth) * value(n))
    for row, values in zip(table, found["y"], strict=True):
        np.testing.assert_allclose(values, row["k.gain"] * np.array(y), rtol=0, atol=1e-14)


def machine(plants):
    """A controller at two rates around an oscillator in continuous time and some FMUs, one behind the other."""
    fmus = [Fmu(lag(), name=f"plant{i}", start={"lag": 0.05 + 0.07 * i, "gain": 0.8}) for i in range(plants)]
    swing = TransferFunction(numerator=(4.0,), denominator=(1.0, 0.8, 4.0), name="swing")
    push = Sine(frequency=0.7, name="sine") + PulseTrain(period=0.12, name="pulse")

    ports = {f"m{i}": fmu.x for i, fmu in enumerate(fmus)}

    def inside(position, reference, **measured):
        force = Gain(gain=2.0, name="kp")(reference - position)
        for signal in measured.values():
            force = force - 0.3 * signal
        return Saturation(lower=-1.5, upper=1.5, name="most")(force)

    box = subsystem(sample_time=2 * T, name="box")(inside)
    force = box(position=swing(push).y, reference=Constant(value=0.5, name="reference"), **ports)
    calls, before = [], force
    for fmu in fmus:
        calls.append(fmu(u=before + 0.2 * swing.y))
        before = fmu.mixed
    signals = {f"x{i}": fmu.x.named(f"x{i}") for i, fmu in enumerate(fmus)}
    return Diagram("machine", *calls, swing.y.named("y"), force.named("u"), *signals.values()), ["y", "u", *signals]


@pytest.mark.parametrize(
    "plants", [pytest.param(0, marks=pytest.mark.slow), 2, pytest.param(4, marks=pytest.mark.slow)]
)
def test_continuous_states_beside_fmus_and_controllers_are_near_single_runs(plants):
    diagram, names = machine(plants)
    table = [{"kp.gain": g, "swing.denominator": (1.0, 0.5 + g, 4.0)} for g in (0.4, 0.9, 1.4, 2.0, 2.3)]
    found, alone = (swept(diagram, table, names, lanes=lanes) for lanes in (LANES, False))
    assert DIFFER in found.messages
    assert not apart(found)
    for name in names:
        assert np.ptp(alone[name][:, -1]) > 1e-4
        assert np.abs(found[name] - alone[name]).max() <= NEAR * np.abs(alone[name]).max(), name


def test_a_run_that_jumps_between_ticks_goes_by_itself():
    jump = Step(times=0.1, values=1.0, name="jump")
    diagram = Diagram("sum", Integrator(name="sum")(Gain(gain=1.0, name="k")(jump)).named("y"))
    table = [{"jump.times": at, "k.gain": 2.0} for at in (0.1, 0.105, 0.2)]
    found = swept(diagram, table, ["y"])
    assert apart(found) == ["Not side by side in vector lanes: jump is not smooth at t = 0.105 s, between ticks."]
    assert [DIFFER in outcome.messages for outcome in found.outcomes] == [True, False, True]
    for row, values in zip(table, found["y"], strict=True):  # the area under the step
        t = np.arange(51) * T
        np.testing.assert_allclose(values, 2.0 * np.maximum(t - row["jump.times"], 0.0), rtol=0, atol=1e-14)


def test_why_continuous_states_go_by_themselves_is_told():
    gain = Gain(gain=1.0, name="k")(Sine(frequency=1.0, name="sine"))
    table = [{"k.gain": 1.0}, {"k.gain": 2.0}]
    smooth = Diagram("smooth", Integrator(name="sum")(gain).named("y"))
    (text,) = apart(swept(smooth, table, ["y"], solver="RK45"))
    assert "those of sum, and each run would choose its steps" in text
    limited = Diagram(
        "limited", Integrator(name="sum")(Relay(on_point=0.5, off_point=-0.5, name="clip")(gain)).named("y")
    )
    (text,) = apart(swept(limited, table, ["y"]))
    assert "clip is a block that has events in continuous time" in text


def test_a_state_that_runs_away_fails_as_a_single_run_does_and_harms_no_other():
    grown = TransferFunction(numerator=(1.0,), denominator=(1.0, -1.0), name="grown")
    diagram = Diagram("away", grown(Constant(value=1.0, name="one")).named("y"))
    table = [{"grown.denominator": (1.0, p)} for p in (-0.5, -1e5, 2.0)]
    found, alone = (swept(diagram, table, ["y"], 2.0, lanes=lanes) for lanes in (LANES, False))
    assert found.failed.tolist() == [False, True, False]
    assert [(f.kind, f.message, f.t) for f in found.failures] == [(f.kind, f.message, f.t) for f in alone.failures]
    for i in (0, 2):
        np.testing.assert_allclose(found["y"][i], alone["y"][i], rtol=1e-12)

"""Key numbers against closed forms, and what they say of a run that stopped early."""

import math
from dataclasses import replace

import numpy as np
import pytest

from loopwright.diagrams import experiments
from loopwright.diagrams.paper.experiment_numbers import DEFINITIONS, Theory, key_numbers, theory_numbers

TANGENTIAL, TRANSVERSAL = (0.5, 10.0, 0.6), (2.0, 200.0, 0.3)  # m, k, ζ of Table III


@pytest.fixture(scope="module")
def runs():
    made = {}
    for letter, make in experiments.EXPERIMENTS.items():
        experiment = make()
        made[letter] = experiment, experiment.simulate(progress=False)
    return made


@pytest.fixture(scope="module")
def numbers(runs):
    return {letter: key_numbers(*pair) for letter, pair in runs.items()}


def cut(run, ticks):
    return replace(run, t=run.t[:ticks], data=run.data[:ticks])


def settling_of(response, t):
    return t[np.flatnonzero(np.abs(response - 1.0) > 0.02)[-1] + 1]


def step_response(t, m, k, zeta):
    """Of m ë + d ė + k e = k with d = 2 ζ √(m k)."""
    w = math.sqrt(k / m)
    wd = w * math.sqrt(1 - zeta**2)
    return 1 - np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))


def test_every_experiment_has_every_number(numbers):
    assert all(list(n) == list(DEFINITIONS) for n in numbers.values())
    assert all(v is None or type(v) is float for n in numbers.values() for v in n.values())


def test_theory_is_known_where_it_holds(runs, numbers):
    found = {letter: theory_numbers(*pair) for letter, pair in runs.items()}
    beyond = {side: math.exp(-math.pi * z / math.sqrt(1 - z**2)) for side, z in (("par", 0.6), ("perp", 0.3))}
    assert found["A"]["overshoot_par"].value == found["A"]["overshoot_perp"].value == pytest.approx(0.248935, abs=1e-6)
    assert {name: form.value for name, form in found["B"].items()} == pytest.approx(
        {f"overshoot_{side}": value for side, value in beyond.items()} | {"offset_par": -0.2, "offset_perp": -0.025}
    )
    assert found["C"] == {}  # the hand is no closed form
    assert {name: (form.value, form.size) for name, form in found["D"].items()} == {"force_error_final": (0.0, 5.0)}
    for letter, forms in found.items():
        assert all(form.holds(numbers[letter][name]) for name, form in forms.items())


def test_theory_does_not_hold_beyond_one_percent():
    assert Theory(0.25, 0.25).holds(0.2524)
    assert not Theory(0.25, 0.25).holds(0.2526)
    assert not Theory(0.25, 0.25).holds(math.nan)


@pytest.mark.parametrize(("side", "pole"), [("par", 20.0), ("perp", 40.0)])
def test_initial_error_of_a_against_the_closed_form(numbers, side, pole):
    # (1 + p t − p² t²) e^{−pt} is the continuous limit; at 1 ms the sampled loop is off by first order, some p T / 10
    t = np.arange(0.0, 1.0, 1e-6)
    response = 1 - (1 + pole * t - (pole * t) ** 2) * np.exp(-pole * t)
    assert response.max() - 1 == pytest.approx(0.248935, abs=1e-6)
    assert numbers["A"][f"overshoot_{side}"] == pytest.approx(0.248935, abs=0.1 * pole * 1e-3)
    assert numbers["A"][f"settling_{side}"] == pytest.approx(settling_of(response, t), rel=0.03)


def test_error_of_a_tends_to_the_closed_form_at_first_order(numbers):
    fine = experiments.path_following(sample_time=5e-4)
    halved = key_numbers(fine, fine.simulate(progress=False))
    for side in ("par", "perp"):
        coarse, finer = (n[f"overshoot_{side}"] - 0.248935 for n in (numbers["A"], halved))
        assert 1.7 < coarse / finer < 2.3


@pytest.mark.parametrize(("side", "impedance"), [("par", TANGENTIAL), ("perp", TRANSVERSAL)])
def test_step_responses_of_b(numbers, side, impedance):
    zeta = impedance[2]
    overshoot = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert numbers["B"][f"overshoot_{side}"] == pytest.approx(overshoot, rel=1e-3)
    t = np.arange(0.0, 3.0, 1e-5)
    settling = settling_of(step_response(t, *impedance), t)
    assert numbers["B"][f"settling_{side}"] == pytest.approx(settling, abs=2e-3)


def test_the_first_step_is_what_counts(runs, numbers):
    experiment, run = runs["B"]
    data = run.data.copy()
    data[7000:, run.layout.slices["controller.transverse_transform.eta"]] = 0.0  # all but the first window
    found = key_numbers(experiment, replace(run, data=data))
    assert found["settling_par"] == numbers["B"]["settling_par"]
    assert found["overshoot_par"] == numbers["B"]["overshoot_par"]
    assert found["offset_par"] == pytest.approx(-0.3)


def test_offsets_of_b(numbers):
    assert numbers["B"]["offset_par"] == pytest.approx(-2.0 / 10.0, rel=1e-3)
    assert numbers["B"]["offset_perp"] == pytest.approx(-5.0 / 200.0, rel=1e-3)
    assert 0.0 < numbers["B"]["xi_step_motion"] < 10e-6


def test_force_step_of_d(numbers):
    # free of delay 2 ξ̈ + 12 ξ̇ + 1000 ξ = 5 N; the inner loop takes a little damping
    ideal = math.exp(-math.pi * 0.134 / math.sqrt(1 - 0.134**2))
    assert numbers["D"]["overshoot_perp"] == pytest.approx(ideal, rel=0.05)
    assert numbers["D"]["force_error_final"] < 5e-3
    assert 1e-3 < numbers["D"]["force_error_moving"] < 50e-3


def test_nothing_to_settle_is_none(numbers):
    steps = ("settling_par", "settling_perp", "overshoot_par", "overshoot_perp")
    assert all(numbers["C"][name] is None for name in steps)
    assert numbers["D"]["settling_par"] is None
    assert numbers["A"]["offset_par"] is None
    assert numbers["B"]["force_error_final"] is None


def test_errors_and_peaks_are_those_of_the_samples(runs, numbers):
    for letter, (_, run) in runs.items():
        found = numbers[letter]
        error = run["xi"][:, 0] - run["xi_p"][:, 0]
        assert found["rms_perp"] == pytest.approx(math.sqrt(sum(e * e for e in error) / len(error)), rel=1e-12)
        assert found["max_error_par"] == max(abs(run["eta"][:, 0] - run["eta_p"][:, 0]))
        assert found["peak_speed"] == pytest.approx(max(math.hypot(*v) for v in run["velocity"]), rel=1e-15)
        assert found["peak_motor_force_z"] == max(abs(f) for f in run["motor_force"][:, 1])
        assert found["end_time"] == run.t[-1]
    assert numbers["A"]["max_error_par"] == pytest.approx(0.02, abs=1e-12)
    assert numbers["C"]["rms_par"] < 10e-6
    assert numbers["C"]["rms_perp"] < 10e-6


def test_a_smooth_reference_leaves_the_force_step(runs):
    experiment = experiments.compliance(smooth_reference=True)
    found = key_numbers(experiment, experiment.simulate(progress=False))
    assert found["overshoot_par"] == pytest.approx(0.09478, rel=1e-3)  # of the step of F∥^d at 7 s
    assert found["offset_par"] == pytest.approx(-0.2, rel=1e-3)


def test_what_does_not_settle_never_settles():
    experiment = experiments.path_following(motor_force_limit=5.0)
    found = key_numbers(experiment, experiment.simulate(progress=False))
    assert found["settling_par"] == math.inf
    assert found["overshoot_par"] == 0.0


@pytest.mark.parametrize("letter", "ABCD")
def test_a_run_that_stopped_early_tells_nothing_of_its_steps(runs, letter):
    experiment, run = runs[letter]
    assert set(key_numbers(experiment, cut(run, 0)).values()) == {None}
    for ticks in (1, 2, 800):
        found = key_numbers(experiment, cut(run, ticks))
        assert found["settling_perp"] is found["overshoot_perp"] is found["force_error_final"] is None
        assert found["end_time"] == run.t[ticks - 1]
        assert found["rms_par"] is not None
    assert key_numbers(*runs["B"])["settling_par"] == key_numbers(runs["B"][0], cut(runs["B"][1], 4100))["settling_par"]

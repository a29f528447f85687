"""Experiments A to D against the independent solution of `oracle`, and against closed forms."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from loopwright.blocks import OptionError
from loopwright.diagrams import experiments
from support import oracle
from support.agreement import POSITION, assert_agrees

VARIANTS = {"A": ("A", {}), "B": ("B", {}), "C": ("C", {}), "D": ("D", {}), "D'": ("D", {"cubic": True})}
EVERY = pytest.mark.parametrize(("letter", "options"), VARIANTS.values(), ids=VARIANTS)

SHAPES = {"eta": (2,), "xi": (2,), "position": (2,), "velocity": (2,), "force": (2,), "motor_force": (2,)}
SHAPES |= {"v_par": (), "v_perp": (), "theta": (), "q": (), "eta_p": (3,), "xi_p": (3,)}


# --- all signals, at every tick ---------------------------------------------------------------------------------------


@pytest.mark.drawn(2)
@EVERY
def test_every_tick_agrees_with_the_independent_solution(runs, solutions, letter, options):
    experiment, run = runs(letter, **options)
    want = solutions(letter, **options)
    ticks = round(experiment.duration / 1e-3)
    assert len(want["t"]) == ticks + 1
    np.testing.assert_array_equal(run.t, [k / 1000 for k in range(ticks + 1)])
    assert_agrees(run, want)


@EVERY
def test_signals_have_the_shapes_of_the_contract(runs, letter, options):
    experiment, run = runs(letter, **options)
    for name, shape in SHAPES.items():
        values = run[name]
        assert type(values) is np.ndarray
        assert values.dtype == np.float64
        assert values.shape == (len(run.t), *shape), name
        assert np.all(np.isfinite(values))
    assert run.t[-1] == experiment.duration == oracle.DURATION[letter]
    assert run.t.dtype == np.float64


@pytest.mark.parametrize("sample_time", [2e-3, 5e-4])
def test_times_are_ticks_of_the_sample_time(runs, sample_time):
    _, run = runs("A", sample_time=sample_time)
    per_second = round(1 / sample_time)
    np.testing.assert_array_equal(run.t, [k / per_second for k in range(11 * per_second + 1)])


def test_two_runs_are_bit_identical():
    first, second = (experiments.path_following().simulate(progress=False) for _ in range(2))
    assert first.data.tobytes() == second.data.tobytes()
    assert first.t.tobytes() == second.t.tobytes()


# --- what a rig adds --------------------------------------------------------------------------------------------------

# Option by option, with the experiment in which it shows most; six of these are in the quick set.
OPTIONS = {
    "less Coulomb friction": ({"coulomb_scale": 0.8}, "C"),
    "more Coulomb friction": ({"coulomb_scale": 1.2}, "D"),
    "less viscous friction": ({"viscous_scale": 0.8}, "A"),
    "more viscous friction": ({"viscous_scale": 1.2}, "D"),
    "tool": ({"tool_mass": 0.3}, "B"),
    "delay": ({"delay": 1}, "A"),
    "force limit": ({"motor_force_limit": 300.0}, "A"),
    "two force limits": ({"motor_force_limit": (250.0, 150.0)}, "B"),
    "delay and force limit": ({"delay": 1, "motor_force_limit": (250.0, 150.0)}, "A"),
    "velocity limit": ({"velocity_limit": 0.3}, "D"),
    "acceleration limit": ({"acceleration_limit": 1.5}, "C"),
    "all reference limits": ({"velocity_limit": (0.3, 0.1), "acceleration_limit": (2.0, 1.0)}, "B"),
    "semi-implicit": ({"admittance_method": "semi_implicit"}, "C"),
    "2 ms": ({"sample_time": 2e-3}, "D"),
    "0.5 ms": ({"sample_time": 5e-4}, "D"),
    "wide friction": ({"friction_width": 0.1}, "D"),
}
LIMITS = {"velocity_limit", "acceleration_limit"}
ENCODER = {"encoder": 1e-6}
NARROW = {"friction_width": 0.001}


QUICK = {"more Coulomb friction", "tool", "delay and force limit", "all reference limits", "semi-implicit", "2 ms"}
CASES = [
    pytest.param(letter, options, id=f"{letter}, {name}")
    for (name, (options, _)), letter in product(OPTIONS.items(), "ABCD")
    if not (letter == "A" and LIMITS & options.keys())
]


@pytest.mark.drawn(2)
@pytest.mark.parametrize("name", sorted(QUICK))
def test_an_option_acts_as_in_the_first_seconds_of_the_independent_solution(runs, name):
    options, letter = OPTIONS[name]
    _, run = runs(letter, **options)
    want = oracle.simulate(letter, oracle.Options(**options), duration=4.0)
    rows = slice(len(want["t"]))
    assert_agrees(run, want, rows=rows)
    if "sample_time" not in options:
        assert np.abs(run["position"] - runs(letter)[1]["position"])[rows].max() > 10 * POSITION


@pytest.mark.slow
@pytest.mark.parametrize(("letter", "options"), CASES)
def test_an_option_acts_as_in_the_independent_solution(runs, solutions, letter, options):
    _, run = runs(letter, **options)
    want = solutions(letter, **options)
    assert_agrees(run, want, width=options.get("friction_width", 0.01))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name, (options, _) in OPTIONS.items()
        if "sample_time" not in options
    ],
)
def test_an_option_changes_the_run_by_far_more_than_the_comparison_lets_pass(runs, name):
    options, letter = OPTIONS[name]
    _, plain = runs(letter)
    _, run = runs(letter, **options)
    assert np.abs(run["position"] - plain["position"]).max() > 10 * POSITION


@pytest.mark.slow
@pytest.mark.parametrize("letter", ["A", *(pytest.param(letter, marks=pytest.mark.slow) for letter in "BCD")])
def test_an_encoder_acts_as_in_the_independent_solution(runs, solutions, letter):
    # A quantum that rounds differently, from position errors of rounding size, changes the measured velocity by
    # quantum/T = 1 mm/s for a tick: from then on two solutions of the same loop differ by the order of the quantum.
    # Until then they agree as without an encoder.
    _, run = runs(letter, **ENCODER)
    want = solutions(letter, **ENCODER)
    flipped = np.any(np.abs(run["measured_position"] - want["position_measured"]) > 0.5e-6, axis=1)
    first = int(np.argmax(flipped)) if flipped.any() else len(flipped)
    assert first > 50
    assert_agrees(run, want, rows=slice(first))
    assert np.abs(run["position"] - want["position"]).max() < 5e-6  # five quanta
    assert np.abs(run["velocity"] - want["velocity"]).max() < 1e-3  # one quantum in one tick
    quanta = run["measured_position"] / 1e-6
    assert np.abs(quanta - np.round(quanta)).max() < 1e-9  # rounding of numbers below 1e6


@pytest.mark.slow
@pytest.mark.parametrize("letter", "ABCD")
def test_narrow_friction_acts_as_in_the_independent_solution(runs, solutions, letter):
    # F_c/(M w) = 1774 1/s at w = 1 mm/s: the FMU's default step of 1/5000 s would reach 2.8e-7 m and 3.5e-5 m/s in A, so
    # the experiment takes a tenth of it
    _, run = runs(letter, **NARROW)
    assert_agrees(run, solutions(letter, **NARROW), width=0.001)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("letter", ["A", "B", "C", "D"])
@pytest.mark.parametrize(
    "options", [*(o for o, _ in OPTIONS.values()), ENCODER, NARROW], ids=[*OPTIONS, "encoder", "narrow"]
)
def test_no_option_makes_a_run_unbounded(runs, letter, options):
    if letter == "A" and LIMITS & options.keys():
        with pytest.raises(OptionError, match="experiment A has no admittance"):
            runs(letter, **options)
        return
    _, run = runs(letter, **options)
    assert len(run.t) == round(oracle.DURATION[letter] / options.get("sample_time", 1e-3)) + 1
    late = run.t >= 0.5  # A's initial error of 10 and 20 mm is over: (1 + 10 - 100) exp(-10) = -4e-3 of it
    end = run.t >= run.t[-1] - 0.25
    errors = {n: np.abs(run[n][:, 0] - run[f"{n}_p"][:, 0]) for n in ("eta", "xi")}
    # Mismatched Coulomb friction reverses by 2 * 0.2 F_c/M = 0.71 m/s2; the error of a triple pole p to such a step peaks
    # at 2 exp(-2)/p^2 of it, 0.48 mm at p = 20 and on the path, 0.65 mm at the least q of the runs. A force limit makes the
    # robot late: B's forces of 2 to 4 N on 0.5 kg ask for 4 to 8 m/s2, 147 to 295 N of inertia and 65 N + 176 N s/m of
    # friction along y, for an eighth of its period of 1.4 s; 2 m/s2 short for that time are 3 cm, and 250 N are 5 m/s2 short.
    peak = 0.1 if "motor_force_limit" in options else 1e-3
    for error in errors.values():
        assert error[late].max() < peak
        assert error[end].max() < 1e-5
    assert np.abs(run["xi"][:, 0]).max() < 0.05  # the reach is 0.075 m
    assert np.abs(run["velocity"]).max() < 1.2


# --- the continuous limit of A ----------------------------------------------------------------------------------------

SAMPLE_TIMES = (1e-3, 5e-4, 2.5e-4, 1.25e-4)
CHANNELS = {"eta": (20.0, 0.12, -0.02), "xi": (40.0, 0.0, 0.01)}  # pole, reference, initial error


@pytest.fixture(scope="module")
def initial_errors():
    """The error over the initial one in A's first 0.6 s, by sample time and channel, and the times."""
    made = {}
    for T in SAMPLE_TIMES:
        run = experiments.path_following(sample_time=T).diagram.simulate(0.6, progress=False)
        for name, (_, reference, e0) in CHANNELS.items():
            made[T, name] = run.t, (run[name][:, 0] - reference) / e0
    return made


@pytest.mark.parametrize("name", CHANNELS)
def test_the_error_response_tends_to_the_continuous_one_at_first_order(initial_errors, name):
    p = CHANNELS[name][0]
    deviations = []
    for T in SAMPLE_TIMES:
        t, e = initial_errors[T, name]
        deviations.append(np.abs(e - (1 + p * t - p**2 * t**2) * np.exp(-p * t)).max())
    order = np.polyfit(np.log(SAMPLE_TIMES), np.log(deviations), 1)[0]
    assert order == pytest.approx(1.0, abs=0.2)
    assert np.all(np.abs(np.log2(np.divide(deviations[:-1], deviations[1:])) - 1.0) < 0.2)
    assert deviations[0] < p * 1e-3  # and is of the size p T


@pytest.mark.parametrize("name", CHANNELS)
def test_the_least_error_tends_to_minus_five_over_e_cubed(initial_errors, name):
    # e'/e0 = 0 at p t = 3: minimum -5 exp(-3) = -0.248935; Richardson's extrapolation of the first order to T = 0 leaves
    # terms of second order, (p T)^2 <= 2.5e-5 at 0.125 ms
    (coarse, fine) = (initial_errors[T, name][1].min() for T in SAMPLE_TIMES[-2:])
    assert 2 * fine - coarse == pytest.approx(-5 * np.exp(-3), abs=2.5e-5)
    assert -5 * np.exp(-3) == pytest.approx(-0.248935, abs=5e-7)


# --- what theory says about each experiment ---------------------------------------------------------------------------


def tick(t):
    return round(1000 * t)


def test_the_seam_does_not_show_in_the_command(runs):
    _, run = runs("A")
    over_length = np.flatnonzero(np.diff(run["eta"][:, 0] >= oracle.LENGTH))
    over_turn = np.flatnonzero(np.diff(run["theta"] >= 2 * np.pi))
    np.testing.assert_array_equal(over_length, over_turn)
    assert len(over_length) == 1
    assert tick(5.5) < over_length[0] < tick(7.5)
    k = over_length[0]
    change = np.abs(np.diff(run["v_par"]))
    around = np.r_[change[k - 100 : k], change[k + 1 : k + 101]]
    assert change[k] <= around.max()
    assert np.abs(np.diff(run["eta"][:, 0])).max() < 1e-3  # at 0.93 m/s a tick is less than 1 mm
    assert run["eta"][-1, 0] == pytest.approx(1.60, abs=1e-5)


def test_a_constant_force_offsets_the_free_robot_by_force_over_stiffness(runs):
    # the force steps at 4 and 7 s are seen before the next one; what is left of the response by then is
    # exp(-zeta omega t): exp(-3 * 7) after 7 s across, exp(-2.683 * 4) = 2.2e-5 after 4 s along the path
    _, run = runs("B")
    xi, eta = run["xi"][:, 0], run["eta"][:, 0]
    assert xi[tick(11)] == pytest.approx(-5.0 / 200.0, rel=1e-3)
    assert eta[tick(11)] - 0.3 == pytest.approx(-2.0 / 10.0, rel=1e-3)
    assert xi[-1] == pytest.approx(5.0 / 200.0, rel=1e-3)
    assert eta[-1] - 0.3 == pytest.approx(2.0 / 10.0, rel=1e-3)


def test_the_free_robot_overshoots_as_the_impedances_do(runs):
    _, run = runs("B")
    along, across = oracle.overshoot(0.6), oracle.overshoot(0.3)
    assert along == pytest.approx(0.09478, abs=5e-6)
    assert across == pytest.approx(0.37233, abs=5e-6)
    for eta in (run["eta"][:, 0], run["eta_p"][:, 0]):
        first, second, third = eta[tick(1) : tick(4)], eta[tick(7) : tick(11)], eta[tick(11) :]
        assert first.max() / 0.3 - 1 == pytest.approx(along, rel=1e-3)
        assert (0.3 - second.min()) / 0.2 - 1 == pytest.approx(along, rel=1e-3)
        assert (third.max() - 0.1) / 0.4 - 1 == pytest.approx(along, rel=1e-3)
    for xi in (run["xi"][:, 0], run["xi_p"][:, 0]):
        first, second = xi[tick(4) : tick(7)], xi[tick(11) :]
        assert -first.min() / 0.025 - 1 == pytest.approx(across, rel=1e-3)
        assert (second.max() + 0.025) / 0.05 - 1 == pytest.approx(across, rel=1e-3)


def test_the_free_robot_moves_as_the_impedances_do(runs):
    # the path reference is sampled from the exact response: 3 N (k times the set-point) from 1 s on, -5 N across from 4 s on
    _, run = runs("B")
    t = run.t[: tick(7)]
    along = oracle.impedance_response(0.5, 2 * 0.6 * np.sqrt(5.0), 10.0, 3.0, np.maximum(t - 1.0, 0.0))
    across = oracle.impedance_response(2.0, 12.0, 200.0, -5.0, np.maximum(t - 4.0, 0.0))
    np.testing.assert_allclose(run["eta_p"][: tick(7), 0], along, atol=1e-12)
    np.testing.assert_allclose(run["xi_p"][: tick(7), 0], across, atol=1e-12)


def test_the_tangential_force_step_does_not_push_the_robot_off_the_path(runs):
    _, run = runs("B")
    xi = run["xi"][:, 0]
    # 7 s: the tangential force alone. The rest of the response across since 4 s is 25 mm exp(-9) = 3 um of it.
    assert np.ptp(xi[tick(7) : tick(11)]) < 10e-6
    # 1 s: the tangential set-point acts like a step of k 0.3 m = 3 N in place of 2: 10.46 um, in the independent solution too
    assert np.ptp(xi[tick(1) : tick(4)]) < 1.5 * 10e-6


def test_the_hand_moves_the_robot_freely_along_the_path(runs):
    # m v' + d v = F: a pulse of area 1.5 N * 0.8 s moves by area/d, what is left is exp(-d t/m) of it: 0.5 % after 1 s;
    # the third one is of 1.5 N * 1.0 s
    _, run = runs("C")
    eta, d = run["eta"][:, 0], 2 * 0.6 * np.sqrt(0.5 * 10.0)
    assert eta[tick(2.5)] - 0.2 == pytest.approx(1.2 / d, rel=5e-3)
    assert eta[tick(5)] - 0.2 == pytest.approx(0.0, abs=1e-4)
    assert eta[-1] - 0.2 == pytest.approx(1.5 / d, rel=1e-4)


def test_the_robot_returns_to_the_path_when_the_hand_lets_go(runs):
    # after the last pulse 12 - 9.7 = 2.3 s: amplitude 6 N/200 N/m sqrt(1/(1 - 0.3^2)) exp(-3 * 2.3) = 32 um at most
    _, run = runs("C")
    xi = run["xi"][:, 0]
    assert np.abs(xi).max() > 0.03
    assert abs(xi[-1]) < 32e-6


def test_the_hand_guided_robot_tracks_its_path_reference(runs):
    _, run = runs("C")
    for name in ("eta", "xi"):
        error = run[name][:, 0] - run[f"{name}_p"][:, 0]
        assert np.sqrt(np.mean(error**2)) < 10e-6


@pytest.mark.parametrize("options", [{}, {"cubic": True}], ids=["linear spring", "cubic spring"])
def test_the_force_on_the_path_reaches_the_desired_one_and_keeps_it_while_moving(runs, options):
    _, run = runs("D", **options)
    normal = np.array([oracle.frame(theta).normal for theta in run["theta"]])
    f_perp = np.sum(normal * run["force"], axis=1)
    settled, moving = tick(3), slice(tick(3), tick(6) + 1)
    assert f_perp[settled] == pytest.approx(-5.0, rel=1e-3)
    assert np.abs(f_perp[moving] + 5.0).max() < 50e-3
    assert f_perp[-1] == pytest.approx(-5.0, rel=1e-3)
    assert run["xi"][-1, 0] == pytest.approx(5e-3, rel=1e-3)  # either spring has 5 N at 5 mm
    assert run["eta"][-1, 0] == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("letter", ["B", "C", "D"])
def test_limits_bound_the_path_reference_at_every_tick(runs, letter):
    v_max, a_max = np.array([0.3, 0.1]), np.array([2.0, 1.0])
    _, run = runs(letter, velocity_limit=tuple(v_max), acceleration_limit=tuple(a_max))
    T = 1e-3
    reached = []
    for j, name in enumerate(("eta_p", "xi_p")):
        r, v, a = run[name].T
        assert np.abs(v).max() <= v_max[j] + 1e-12
        assert np.abs(a).max() <= a_max[j] + 1e-12
        reached.append(np.abs(v).max() > 0.999 * v_max[j] or np.abs(a).max() > 0.999 * a_max[j])
        # in a tick whose acceleration is cut, and in one that keeps the largest velocity, v + a T and p + v T + a T^2/2,
        # although D's reference moves on otherwise
        fastest = np.abs(np.abs(v) - v_max[j]) < 1e-12
        cut = np.flatnonzero((np.abs(np.abs(a) - a_max[j]) < 1e-12)[:-1] | (fastest[:-1] & fastest[1:]))
        assert len(cut) > 20 or not reached[j]
        np.testing.assert_allclose(v[cut + 1], np.clip(v[cut] + a[cut] * T, -v_max[j], v_max[j]), atol=1e-14)
        np.testing.assert_allclose(r[cut + 1], r[cut] + v[cut] * T + a[cut] * T**2 / 2, atol=1e-14)
    assert any(reached)

"""Other plants under the unchanged controller: what each costs in tracking.

The gantry's elastic, sticking and touching variants run in every experiment; the arm, which takes torques, follows the
ellipse by the same transform and a feedback linearization built from its own model.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import (
    PathDomainError,
)
from loopwright.diagrams import experiments
from loopwright.fmus import Fmu, gantry, gantry_contact, gantry_elastic, gantry_stiction, scara
from support import oracle
from support.followed import PATH, follow
from support.plants import WEIGHT, D, K, elastic, sticking


def errors(run, start=1.0):
    """Tracking errors along and across the path in um, from a second on: experiment A starts off its references."""
    late = run.t >= start
    return np.stack([(run[y] - run[r][:, :2])[late, 0] for y, r in (("eta", "eta_p"), ("xi", "xi_p"))]) * 1e6


def rms(run):
    return np.sqrt(np.mean(errors(run) ** 2, axis=1))


# RMS in um along and across the path, as measured. The gantry's own is what sampling at 1 kHz costs.
GANTRY = {"A": (3.21, 1.46), "B": (3.39, 1.12), "C": (3.22, 1.99), "D": (1.44, 1.24)}
COST = {
    (gantry_elastic, "A"): (4.44, 2.63),
    (gantry_elastic, "B"): (6.80, 2.37),
    (gantry_elastic, "C"): (6.43, 4.26),
    (gantry_elastic, "D"): (2.50, 2.63),
    (gantry_stiction, "A"): (354, 102),
    (gantry_stiction, "B"): (483, 83.9),
    (gantry_stiction, "C"): (324, 83.2),
    (gantry_stiction, "D"): (525, 107),
    (gantry_contact, "A"): (3.25, 1.77),
    (gantry_contact, "B"): (3.33, 1.36),
    (gantry_contact, "C"): (3.19, 2.11),
    (gantry_contact, "D"): (1.48, 1.39),
}


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize(("plant", "letter"), COST, ids=lambda v: getattr(v, "__name__", v).rpartition(".")[2])
def test_what_another_plant_costs_in_tracking(runs, plant, letter):
    nominal = rms(runs(letter)[1])
    run = experiments.EXPERIMENTS[letter](plant=plant.build()).simulate(progress=False)
    assert nominal == pytest.approx(GANTRY[letter], rel=0.05)
    assert rms(run) == pytest.approx(COST[plant, letter], rel=0.05)
    if plant is gantry_elastic:  # across the path, where the loop is faster, it is twice the gantry's
        assert 1.5 < rms(run)[1] / nominal[1] < 2.5
        assert np.abs(errors(run)).max() < 60.0
    elif plant is gantry_stiction:  # stick and slip: a hundred times
        assert np.all(rms(run) > 40.0 * nominal)
        assert 500.0 < np.abs(errors(run)).max() < 2000.0
    else:  # the wall's force is measured, and cancelled but for what it changes within a sample
        assert np.all(rms(run) < 1.4 * nominal)
        assert np.abs(errors(run)).max() < 30.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("letter", "longest", "push"),
    [
        ("A", (0.32, 0.34), (200.0, 201.0)),
        ("B", (4.5, 6.0), (5.0, 20.0)),
        ("C", (2.0, 3.5), (20.0, 60.0)),
        ("D", (0.2, 0.5), (5.0, 10.0)),
    ],
)
def test_every_experiment_touches_the_wall(letter, longest, push):
    # without compliance (A) the robot goes its way, 10 mm into 20 kN/m; with it, it yields, and the wall stops it
    run = experiments.EXPERIMENTS[letter](plant=gantry_contact.build()).simulate(progress=False)
    force = np.linalg.norm(run["plant.contact_force"], axis=1)
    assert longest[0] < 1e-3 * run["plant.contact"].sum() < longest[1]
    assert push[0] < force.max() < push[1]
    if letter in "AB":  # in free space nothing else is felt
        assert np.array_equal(run["force"], run["plant.contact_force"])
    if letter == "A":
        assert run["plant.penetration"].max() == pytest.approx(0.01, rel=2e-3)


class Elastic:
    """The oracle's plant with an elastic screw: slide and motor."""

    def __init__(self, options):
        self.x = self.force = None

    def rhs(self, t, x):
        return elastic(x, *self.force)

    def extended(self, state):
        motor = np.array([state[0], state[1] + WEIGHT[1] / K[1], 0.0, 0.0])
        return np.concatenate([state, motor])

    def advance(self, state, motor, external, T):
        self.x = self.extended(state) if self.x is None else self.x
        self.force = np.array(motor), np.array(external)
        self.x = solve_ivp(self.rhs, (0.0, T), self.x, "DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
        return self.x[:4]

    def acceleration(self, state):
        return tuple(self.rhs(0.0, self.x)[2:4])


class Sticking(Elastic):
    """The oracle's plant with LuGre friction."""

    def rhs(self, t, x):
        return sticking(x, *self.force)

    def extended(self, state):
        return np.concatenate([state, [0.0, 0.0]])


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    ("plant", "exact", "bound"), [(gantry_elastic, Elastic, 1e-9), (gantry_stiction, Sticking, 1e-8)]
)
def test_the_loop_around_another_plant_is_that_of_the_independent_solution(monkeypatch, plant, exact, bound):
    monkeypatch.setattr(oracle, "Plant", exact)
    want = oracle.simulate("A", duration=2.0)
    run = experiments.path_following(plant=plant.build()).diagram.simulate(2.0, progress=False)
    for name in ("eta", "xi"):
        assert np.abs(run[name][:, 0] - want[name][:, 0]).max() < bound, name
    assert np.abs(run["motor_force"] - want["motor_force"]).max() < 3e-3  # N, of 1100


def test_half_of_the_damping_and_the_paper_s_gains_are_unstable():
    # 3 p/(2 zeta omega) = 1.6 at the resonance: the loop across the path swings up
    soft = Fmu(gantry_elastic.build(), start={"screw_damping": D / 2})
    with pytest.raises(PathDomainError) as error:
        experiments.path_following(plant=soft).simulate(progress=False)
    late = error.value.run
    xi = late["xi"][-200:, 0] - np.mean(late["xi"][-200:, 0])
    spectrum = np.abs(np.fft.rfft(xi * np.hanning(200)))
    assert np.argmax(spectrum[1:]) + 1 == pytest.approx(20, abs=4)  # of 5 Hz each: near 100 Hz


@pytest.mark.slow
def test_an_arm_follows_the_ellipse_as_well_as_the_gantry():
    start = PATH.to_plane(0.10, 0.01)
    axes = Fmu(gantry.build(), name="plant", start={"position": start})
    straight = follow(axes, gantry.nominal, "motor_force", axes.position, axes.velocity)
    arm = Fmu(scara.build(), name="plant", start={"joint_angle": scara.nominal.joint_angles(start)})
    bent = follow(arm, scara.nominal, "motor_torque", arm.joint_angle, arm.joint_velocity)
    assert rms(straight) == pytest.approx(GANTRY["A"], rel=0.05)
    assert rms(bent) == pytest.approx([3.33, 0.96], rel=0.05)
    assert np.abs(errors(bent)).max() < 40.0
    # the triple poles show in the first second, whatever the plant: e0 (1 + p t - p^2 t^2) e^(-p t)
    t = bent.t[:400]
    for name, reference, p, bound in (("eta", "eta_p", 20.0, 0.02), ("xi", "xi_p", 40.0, 0.04)):
        e = (bent[name][:, 0] - bent[reference][:, 0])[:400]
        theory = e[0] * (1 + p * t - (p * t) ** 2) * np.exp(-p * t)
        assert np.abs(e - theory).max() < bound * abs(e[0]), name
    elbow = np.degrees(bent["plant.joint_angle"][:, 1])
    assert elbow.min() > 50.0
    assert elbow.max() < 135.0
    assert np.ptp(elbow) > 70.0

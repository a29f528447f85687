"""Reduced loops and their limits: only of a diagram whose plant is shown to be the reduced model."""

import re
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import Block, Gain, Input, Output, ParameterError, State, UnitDelay
from loopwright.diagrams import AdmittanceLoop, analyse, experiments, stability_limit
from loopwright.diagrams.paper import shown_plant as _shown_plant
from loopwright.diagrams.paper.fig3_case import Fig3Case
from loopwright.diagrams.report.pages.html import to_html
from loopwright.fmus import Fmu, build, gantry, gantry_contact, gantry_elastic, gantry_stiction, scara
from support.plants import hidden, undirected

START = (0.8, 0.5)  # of the path: there the tangent is the axis z, the normal the axis y
IN_CONTACT = {"contact": 1.0, "wall_point": (0.0, 0.5), "wall_normal": (0.0, -1.0)}
HEAVY = {"translational_mass": (10.0, 4.41)}


class Robot(Block):
    """A gantry with the ports of Fig. 3."""

    motor_force = Input(shape=(2,), unit="N")
    external_force = Input(shape=(2,), unit="N")
    acceleration = Output(shape=(2,), unit="m/s2")


class Amplified(Robot):
    """The gantry behind amplifiers that lag by 2 ms: two states more."""

    position = State(unit="m", start=START, output=True)
    velocity = State(unit="m/s", start=(0.0, 0.0), output=True)
    amplified = State(unit="N", start=(0.0, 43.2621))

    def derivative(self, t, x, u):
        return x.velocity, self.output(t, x, u), (u.motor_force - x.amplified) / 2e-3

    def output(self, t, x, u):
        return gantry.nominal.coordinate_acceleration(x.position, x.velocity, x.amplified, u.external_force)


class Sprung(Robot):
    """The gantry on soft springs."""

    position = State(unit="m", start=START, output=True)
    velocity = State(unit="m/s", start=(0.0, 0.0), output=True)

    def derivative(self, t, x, u):
        return x.velocity, self.output(t, x, u)

    def output(self, t, x, u):
        force = u.external_force - 5.0 * x.position
        return gantry.nominal.coordinate_acceleration(x.position, x.velocity, u.motor_force, force)


class Placed(Robot):
    """The gantry in other coordinates: of carriages that go twice as far, in the other order."""

    carriage = State(unit="m", start=(1.0, 1.6))
    rate = State(unit="m/s", start=(0.0, 0.0))
    position = Output(shape=(2,), unit="m")
    velocity = Output(shape=(2,), unit="m/s")

    def derivative(self, t, x, u):
        return x.rate, 2.0 * self.output(t, x, u)[0][::-1]

    def output(self, t, x, u):
        position, velocity = 0.5 * x.carriage[::-1], 0.5 * x.rate[::-1]
        a = gantry.nominal.coordinate_acceleration(position, velocity, u.motor_force, u.external_force)
        return a, position, velocity


@cache
def diagram(plant=None, **start):
    made = None if plant is None else Fmu(plant.build(), start=dict(start))
    return experiments.compliance(plant=made).diagram


def own(plant, **start):
    return experiments.compliance(plant=Fmu(build(plant, internal_step=2e-4), start=start)).diagram


@cache
def report(plant, *only):
    return analyse(diagram(plant), only=only or None)


def refusal(made, **options):
    with pytest.raises(ParameterError) as caught:
        AdmittanceLoop.of(made, **options)
    return str(caught.value)


def section(found, key):
    return next(s for s in found.sections if s.key == key)


# --- the true limits: matrices of our own ----------------------------------------------------------------------------

T = 1e-3
SIDES = {"par": (1, 0.5, 0.6, 10.0, 20.0), "perp": (0, 2.0, 0.3, 200.0, 40.0)}  # axis, m, ζ, k, p


def robot(kind, axis, k):
    """(A, B) of one axis at rest on a spring k, from the motor force; position and velocity come first."""
    g = gantry.nominal
    slide, motor, mass = g.translational_mass[axis], g.equivalent_mass[axis], g.mass[axis]
    viscous = g.viscous_friction[axis]
    c = viscous + g.coulomb_friction[axis] / g.friction_width
    if kind == "rigid":
        return np.array([[0, 1], [-k / mass, -c / mass]]), np.array([0, 1 / mass])
    if kind == "elastic":
        e = gantry_elastic.nominal
        stiff, damp = e.screw_stiffness[axis], e.screw_damping[axis]
        s = np.array([-k, -c / 2, stiff, damp]) / slide
        m = np.array([0, -c / 2, -stiff, -damp - c / 2]) / motor
        return np.array([[0, 1, 0, 0], s, [0, 0, 0, 1], m - s]), np.array([0, 0, 0, 1 / motor])
    b = gantry_stiction.nominal
    stiff, damp = b.bristle_stiffness[axis], b.bristle_damping[axis]
    return np.array([[0, 1, 0], np.array([-k, -damp - viscous, -stiff]) / mass, [0, 1, 0]]), np.array([0, 1 / mass, 0])


def growth(kind, side, k):
    """ln|z| of the slowest pole of the sampled loop: the held robot, and the controller's own difference equations."""
    axis, m, ratio, stiffness, p = SIDES[side]
    A, B = robot(kind, axis, k)
    n = len(B)
    Ad = expm(T * np.block([[A, B[:, None]], [np.zeros((1, n + 1))]]))
    Y = np.zeros((3, n))
    Y[0, 0], Y[1, 1], Y[2, 0] = 1, 1, -k  # position, velocity, measured force
    d = 2 * ratio * np.sqrt(m * stiffness)
    z = expm(T * np.array([[0, 1, 0], [-stiffness / m, -d / m, 1 / m], [0, 0, 0]]))
    K = np.block([[np.array([[1, -T, 0]])], [np.zeros((2, 1)), z[:2, :2]]])  # of ∫(w − e), e, ė
    L = np.array([[T, 0, 0], [0, 0, z[0, 2]], [0, 0, z[1, 2]]])
    g = gantry.nominal
    M, c = g.mass[axis], g.viscous_friction[axis] + g.coulomb_friction[axis] / g.friction_width
    on_k = M * np.array([-(p**3), 3 * p**2 - stiffness / m, 3 * p - d / m])
    on_y = np.array([-M * 3 * p**2, -M * 3 * p + c, M / m - 1])
    b = Ad[:n, n]
    closed = np.block([[Ad[:n, :n] + np.outer(b, on_y @ Y), np.outer(b, on_k)], [L @ Y, K]])
    return np.log(np.abs(np.linalg.eigvals(closed)).max())


def true_limit(kind, side):
    """The first stiffness of the environment at which the loop grows."""

    def beyond(k):
        return growth(kind, side, k) - 1e-9  # a pole of pure drift is rounded

    grid = np.geomspace(1.0, 1e6, 241)
    first = next(i for i, k in enumerate(grid) if beyond(k) > 0)
    return brentq(beyond, grid[first - 1], grid[first], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("side", SIDES)
def test_the_rigid_gantrys_limits_are_not_those_of_the_other_plants(side):
    rigid = true_limit("rigid", side)
    assert stability_limit(AdmittanceLoop.of(diagram(), side)).value == pytest.approx(rigid, rel=1e-6)
    elastic, sticking = (true_limit(kind, side) for kind in ("elastic", "stiction"))
    assert rigid / elastic == pytest.approx({"par": 3.156, "perp": 1.782}[side], abs=2e-3)  # on the unsafe side
    for plant, limit in ((gantry_elastic, elastic), (gantry_stiction, sticking)):
        found = diagram(plant).contact(direction=side).stability_limit()
        assert found.value == pytest.approx(limit, rel=1e-6)  # to the threshold of `true_limit`
        assert found.confirmed_by.startswith("closed-loop eigenvalues of python-control's interconnection")
    if side == "par":
        assert sticking / rigid == pytest.approx(48.08, abs=0.01)  # on the safe side, and of no use


@pytest.mark.drawn(1)
@pytest.mark.parametrize("kind", ["rigid", "elastic", "stiction"])
def test_the_matrices_of_these_tests_are_those_of_the_plants(kind):
    plant = {"rigid": gantry, "elastic": gantry_elastic, "stiction": gantry_stiction}[kind]
    m = diagram(None if kind == "rigid" else plant)["plant"].linear_model()
    for axis in range(2):
        A, B = robot(kind, axis, 0.0)
        np.testing.assert_allclose(m.A[axis::2, axis::2], A, rtol=1e-12)
        np.testing.assert_allclose(m.B[axis::2, axis], B, rtol=1e-12)


# --- plants that are, and that are not -------------------------------------------------------------------------------

ELASTIC = (
    "plant: found 8 states (position, velocity, deflection, deflection_rate); expected 4, position and velocity of two "
    "axes, as in the reduced model. Linearize the diagram itself in place of the reduced loop."
)


@pytest.mark.parametrize("side", ["par", "perp"])
@pytest.mark.drawn(1)
def test_an_elastic_plant_has_no_reduced_loop(side):
    assert refusal(diagram(gantry_elastic), side=side) == ELASTIC
    assert refusal(diagram(gantry_elastic), side=side, plant=gantry.nominal) == ELASTIC
    assert refusal(diagram(gantry_elastic), side=side, plant=gantry_elastic.nominal) == ELASTIC


@pytest.mark.slow
def test_bristles_and_amplifiers_are_hidden_states():
    assert "plant: found 6 states (position, velocity, bristle); expected 4" in refusal(diagram(gantry_stiction))
    assert "plant: found 6 states (position, velocity, amplified); expected 4" in refusal(own(Amplified()))


@pytest.mark.slow
def test_a_wall_is_seen_in_contact_and_not_away_from_it():
    away = AdmittanceLoop.of(diagram(gantry_contact))
    assert away == AdmittanceLoop.of(diagram())
    touching = experiments.compliance(plant=Fmu(gantry_contact.build(), start=IN_CONTACT)).diagram
    assert "plant.position: found the stiffness 20000 N/m along and 0 N/m across the path; expected none" in refusal(
        touching
    )
    found = refusal(diagram(gantry_contact), eta=0.3)  # contact there is not known
    assert found.startswith(
        "plant.position: found the position [0.8, 0.5] m, with discrete states that hold only there;"
    )
    assert found.endswith("Start the diagram there, or give its point of the path: eta=…, xi=….")


def test_contact_is_taken_from_the_point_that_is_given():
    start = {"position": START, "velocity": (0.0, 1e-3), "wall_point": (0.0, 0.5 + 1e-7)}
    moving = experiments.compliance(plant=Fmu(gantry_contact.build(), start=start)).diagram
    assert AdmittanceLoop.of(moving).eta == 0.0  # not yet
    point = moving.operating_point(2e-3)
    assert point.plants["plant"]["state"]["contact"] == 1.0
    eta, xi = (float(point.values[f"controller.transverse_transform.{n}"][0]) for n in ("eta", "xi"))
    assert "found the stiffness [[20000, " in refusal(moving, point=point, eta=eta, xi=xi)


def test_another_mass_than_the_models_is_refused_until_it_is_given():
    made = experiments.compliance(plant=Fmu(gantry.build(), start=HEAVY)).diagram
    assert refusal(made) == (
        "plant.motor_force: found the mass 21.2 kg along and 39.26 kg across the path; expected 21.2 kg along and "
        "36.87 kg across the path, as in the reduced model. Give the plant as it is, with plant=…, or its parameters "
        "to the FMU."
    )
    loop = AdmittanceLoop.of(made, plant=gantry.nominal.replace(**HEAVY))
    assert loop.motions[0].mass[0, 0] == pytest.approx(39.26, rel=1e-12)
    assert loop.model == gantry.nominal
    assert "found the mass 21.2 kg along and 36.87" in refusal(diagram(), plant=gantry.nominal.replace(**HEAVY))


def test_friction_is_compared_at_the_velocity_of_the_loop():
    made = experiments.compliance(coulomb_scale=0.5).diagram
    assert "plant.velocity: found the friction slope 1947.33 N s/m along" in refusal(made)
    half = gantry.nominal.replace(coulomb_scale=0.5)
    assert AdmittanceLoop.of(made, plant=half).plant == half
    assert "found the friction slope" in refusal(made, model=gantry.nominal)  # the plant is then the model


@pytest.mark.slow
def test_a_soft_spring_in_the_plant_is_a_stiffness():
    assert "plant.position: found the stiffness 5 N/m along and 5 N/m across the path" in refusal(own(Sprung()))


@pytest.mark.slow
def test_other_coordinates_are_the_plants_own_matter():
    made = own(Placed(), carriage=(1.0, 1.6))
    assert AdmittanceLoop.of(made, "par", eta=0.2, xi=0.01) == AdmittanceLoop.of(diagram(), "par", eta=0.2, xi=0.01)


@pytest.mark.slow
def test_differences_show_a_plant_within_their_stated_error(tmp_path, monkeypatch):
    made = experiments.compliance(plant=undirected(gantry.build(), tmp_path)).diagram
    assert made["plant"].linear_model().how.startswith("differences")
    assert AdmittanceLoop.of(made) == AdmittanceLoop.of(diagram())
    heavier = {"translational_mass": (7.61 * (1.0 + 1e-6), 4.41)}
    assert "found the mass" in refusal(made.replace({f"plant.start.{n}": v for n, v in heavier.items()}))
    monkeypatch.setattr(_shown_plant, "CERTAIN", 1e-14)
    assert re.search(
        r"found a linear model \(differences .*\) that is uncertain by .*; expected at most", refusal(made)
    )


def test_a_plant_without_a_linear_model_has_no_reduced_loop(tmp_path):
    made = experiments.compliance(plant=hidden(gantry.build(), tmp_path)).diagram
    found = refusal(made)
    assert found.startswith("plant: found no linear model (its model structure lists no derivatives")
    assert found.endswith("Build the AdmittanceLoop by hand if the plant is known to be rigid.")


def test_a_block_as_plant_is_differentiated():
    block = gantry.nominal.replace(name="plant", start_position=START)
    assert AdmittanceLoop.of(diagram().replace({"plant": block})) == AdmittanceLoop.of(diagram())
    heavy = diagram().replace({"plant": block.replace(**HEAVY)})
    assert "found the mass 21.2 kg along and 39.26 kg" in refusal(heavy)
    elastic = gantry_elastic.nominal.replace(name="plant", start_position=START)
    assert refusal(diagram().replace({"plant": elastic})) == ELASTIC


@pytest.mark.slow
def test_an_arm_is_no_gantry():
    arm = Fmu(scara.build(), rename={"motor_torque": "motor_force"}, name="plant")
    with pytest.raises(ParameterError, match=r"^plant"):
        _shown_plant.check_plant(Robots({"plant": arm}), "plant", gantry.nominal, rate=60.0, position=(0.7, 0.5))


class Robots:
    """As much of a diagram as a plant is looked up in."""

    def __init__(self, blocks):
        self.blocks = blocks


# --- the rest of the loop --------------------------------------------------------------------------------------------


def test_an_encoder_is_not_in_the_reduced_loop():
    assert refusal(experiments.compliance(encoder=1e-6).diagram) == (
        "controller.path_projection.position: found sensors.encoder.measured_position; expected plant.position: the "
        "reduced loop has nothing between them. Take it out, or linearize the diagram itself."
    )


def test_every_delay_counts():
    late = experiments.compliance(delay=1).diagram
    assert AdmittanceLoop.of(diagram().replace({"controller.delay": 2})).delay == 2
    assert AdmittanceLoop.of(late.replace({"controller.delay": 1})).delay == 2
    none = late.replace({"controller.computation": Gain(gain=1.0, name="computation")})
    assert AdmittanceLoop.of(none).delay == 0
    twice = late.replace({"controller.computation": Gain(gain=2.0, name="computation")})
    assert "controller.computation: found Gain; expected a UnitDelay" in refusal(twice)
    assert isinstance(late["controller.computation"], UnitDelay)
    with_encoder = experiments.compliance(encoder=1e-6).diagram
    assert "sensors: found the sample time" in refusal(with_encoder.replace({"sensors.delay": 1}))


# --- the report ------------------------------------------------------------------------------------------------------

PARTS = ("poles", "admittance", "time_domain")


@pytest.mark.slow
@pytest.mark.parametrize("plant", [gantry_elastic, gantry_stiction])
def test_a_report_of_another_plant_has_the_limits_of_its_contact_and_says_why(plant):
    found = report(plant, *PARTS)
    numbers = found.numbers()
    assert not [path for path in numbers if path.startswith("time_domain")]
    assert [s.key for s in found.sections] == ["poles", "admittance"]
    words = section(found, "admittance")
    assert words.text[0].startswith("The admittance Y(jω)")
    assert words.text[-1] == refusal(diagram(plant))
    assert "tried in the nonlinear run" in to_html(found)
    kind = plant.__name__.rpartition("_")[2]
    for side in SIDES:
        limit = numbers[f"admittance.{side}.ke_limit.sampled_d0.be_0"]
        assert limit.value == pytest.approx(true_limit(kind, side), rel=1e-6)
        late = diagram(plant).replace({"controller.delay": 1}).contact(direction=side).stability_limit(damping=10.0)
        assert numbers[f"admittance.{side}.ke_limit.sampled_d1.be_10"].value == pytest.approx(late.value, rel=1e-9)
        assert late.value < numbers[f"admittance.{side}.ke_limit.sampled_d0.be_10"].value


@pytest.mark.slow
@pytest.mark.parametrize("made", [{"encoder": 1e-6}, {"plant": None}])
def test_a_report_without_a_contact_to_tell_says_why(made):
    if "plant" in made:
        made = {"plant": Fmu(gantry_contact.build(), start=IN_CONTACT)}
    found = analyse(experiments.compliance(**made).diagram, only=("admittance",), stairs="zero")
    words = section(found, "admittance")
    assert words.text[0].startswith(
        "This report has no admittances and no limits of coupled stability, neither computed nor tried"
    )
    assert not words.tables
    assert not words.sections


@pytest.mark.slow
def test_a_report_of_the_time_runs_alone_says_why_there_are_none():
    found = analyse(diagram(gantry_elastic), only=("time_domain",))
    assert [(s.key, s.text[1]) for s in found.sections] == [("time_domain", ELASTIC)]
    assert not found.numbers()


@pytest.mark.slow
def test_poles_and_gains_of_the_chain_of_integrators_are_not_told_of_another_loop():
    paths = report(gantry_elastic, *PARTS).numbers()
    assert not [p for p in paths if re.match(r"poles\.(par|perp)\.sampled_d\d\.", p)]
    assert not [p for p, n in paths.items() if np.isnan(n.value)]


@pytest.mark.slow
def test_friction_is_taken_out_of_a_plant_only_where_that_is_shown():
    assert Fig3Case(experiments.compliance(plant=gantry_elastic.build()).diagram.wired).plant_model is None
    case = Fig3Case(diagram(gantry_elastic).wired)
    assert list(case.variants) == ["sampled_d0", "continuous", "sampled_d1"]  # as it is comes first
    assert case.smooth is None
    assert any(note.startswith("The plant is not shown to be the gantry, so its friction") for note in case.notes)
    assert Fig3Case(diagram().wired).plant_model == gantry.nominal


@pytest.mark.slow
def test_a_report_of_a_heavier_gantry_is_of_that_gantry():
    made = experiments.compliance(plant=Fmu(gantry.build(), start=HEAVY)).diagram
    found = analyse(made, only=("admittance",)).numbers()
    heavy = gantry.nominal.replace(**HEAVY)
    want = stability_limit(AdmittanceLoop.of(made, plant=heavy), damping=10.0)
    assert found["admittance.perp.ke_limit_friction.sampled_d0.be_10"].value == pytest.approx(want.value, rel=1e-9)


@pytest.mark.slow
def test_a_wall_is_not_in_the_time_runs():
    found = analyse(diagram(gantry_contact), only=("time_domain",))
    assert not found.numbers()
    assert section(found, "time_domain").text[-1].startswith("Not done: the plant has discrete states")

"""Random diagrams of all kinds against the reference loop, which shares nothing with Loopwright; it against closed forms."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from support.random_hybrid import FAMILIES, differences, make_if_possible, reference, run
from support.reference_loop import DelicateError, Part, ReferenceLoop

pytestmark = pytest.mark.one_tier
TENTH = Fraction(1, 10)


# --- the reference loop ------------------------------------------------------------------------------------------------


def test_a_bouncing_ball_hits_the_floor_when_the_closed_form_says():
    ball = Part(
        "ball",
        lambda t, x, z, u: x[0],
        x=(1.0, 0.0),
        rate=lambda t, x, z, u: (x[1], -9.81),
        events=(("bounce", -1, 0.0),),
        indicators=lambda t, x, z, u: x[0],
        jump=lambda t, x, z, u, fired: ((0.0, -0.8 * x[1]), ()),
    )
    found = ReferenceLoop([ball], [k * TENTH for k in range(21)]).run()
    first = np.sqrt(2.0 / 9.81)
    hits = first * np.array([1.0, 1 + 2 * 0.8, 1 + 2 * 0.8 + 2 * 0.8**2])
    assert [t for t, _, _ in found.events] == pytest.approx(hits, abs=1e-12)
    assert found.values["ball.y"][3] == pytest.approx(1.0 - 9.81 / 2 * 0.3**2, abs=1e-12)


def test_a_held_controller_and_a_plant_are_matrix_exponentials():
    """ẋ = −2 x + u, u = 3 (1 − x) held over 0.1 s from 0.05 s on; before, as at the start."""
    plant = Part(
        "plant",
        lambda t, x, z, u: x[0],
        inputs=("control.y",),
        x=(0.5,),
        rate=lambda t, x, z, u: (u[0] - 2.0 * x[0],),
        direct=False,
    )
    control = Part("control", lambda t, x, z, u: 3.0 * (1.0 - u[0]), inputs=("plant.y",), clock=(TENTH, TENTH / 2))
    found = ReferenceLoop([plant, control], [k * TENTH / 2 for k in range(21)]).run()
    state, expected = np.array([0.5, 1.5]), []
    for k in range(21):
        if k % 2:
            state[1] = 3.0 * (1.0 - state[0])
        expected.append(state.copy())
        state = expm(np.array([[-2.0, 1.0], [0.0, 0.0]]) * 0.05) @ state
    assert found.values["plant.y"] == pytest.approx([x for x, _ in expected], abs=1e-13)
    assert found.values["control.y"] == pytest.approx([u for _, u in expected], abs=1e-13)


def test_a_plant_is_stepped_with_the_input_of_its_last_tick():
    clock = Part("clock", lambda t, x, z, u: t)
    plant = Part(
        "plant",
        lambda t, x, z, u: x[0],
        inputs=("clock.y",),
        x=(0.0,),
        rate=lambda t, x, z, u: (u[0],),
        plant=((TENTH, Fraction(0)),),
    )
    found = ReferenceLoop([plant, clock], [k * TENTH for k in range(6)]).run()
    assert found.values["plant.y"] == pytest.approx([0.0, 0.0, 0.01, 0.03, 0.06, 0.1], abs=1e-14)


def test_events_of_one_instant_see_what_was_before_all_of_them_and_those_that_follow_what_is_after():
    def swaps(name, start, other):
        return Part(
            name,
            lambda t, x, z, u: z[0],
            inputs=(other, "step.y"),
            z=(start,),
            direct=False,
            events=(("take", 1, 0.0),),
            indicators=lambda t, x, z, u: u[1] - 0.5,
            jump=lambda t, x, z, u, fired: (x, (u[0],)),
        )

    step = Part("step", lambda t, x, k, u: float(k), breaks=(Fraction(1, 4),))
    found = ReferenceLoop([swaps("a", 1.0, "b.y"), swaps("b", 2.0, "a.y"), step], [k * TENTH for k in range(5)]).run()
    assert found.values["a.y"] == [1.0, 1.0, 1.0, 2.0, 2.0]
    assert found.values["b.y"] == [2.0, 2.0, 2.0, 1.0, 1.0]
    assert found.events == [(0.25, "a", "take"), (0.25, "b", "take")]


def test_a_tick_sees_an_event_that_is_there_and_what_it_changes_itself_is_recorded():
    alarm = Part(
        "alarm",
        lambda t, x, z, u: z[0],
        z=(0.0,),
        events=(("ring", 1, 0.0),),
        indicators=lambda t, x, z, u: t - 0.3,
        jump=lambda t, x, z, u, fired: (x, (1.0,)),
    )
    held = Part("held", lambda t, x, z, u: u[0], inputs=("alarm.y",), clock=(TENTH, Fraction(0)))
    counted = Part(
        "counted",
        lambda t, x, z, u: z[0],
        inputs=("held.y",),
        z=(0.0,),
        direct=False,
        events=(("edge", 1, 0.0),),
        indicators=lambda t, x, z, u: u[0] - 0.5,
        jump=lambda t, x, z, u, fired: (x, (z[0] + 1.0,)),
    )
    found = ReferenceLoop([alarm, held, counted], [k * TENTH for k in range(6)]).run()
    assert found.values["held.y"] == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    assert found.values["counted.y"] == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


def test_what_rounding_decides_is_refused():
    def touching(t, x, z, u):
        return (t - 0.25) ** 2

    part = Part("touches", lambda t, x, z, u: 0.0, events=(("cross", -1, 0.0),), indicators=touching)
    with pytest.raises(DelicateError, match="nearly crosses"):
        ReferenceLoop([part], [Fraction(0), Fraction(1)]).run()


# --- random diagrams ---------------------------------------------------------------------------------------------------


def check(family, first, count, compiled):
    """Hold `count` random diagrams, those with the next numbers that rounding does not decide, against the reference loop."""
    seeds = iter(range(first, first + 2 * count + 1))
    wrong, compared = [], 0
    while compared < count:
        seed = next(seeds, None)
        assert seed is not None, f"only {compared} of {2 * count + 1} diagrams are well conditioned"
        case = make_if_possible(family, seed)
        expected = None if case is None else reference(case)
        if expected is not None:
            compared += 1
            found = run(case, compiled=compiled)
            wrong += [f"{case.diagram.name}: {text}" for text in differences(case, expected, found)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.drawn(3)
@pytest.mark.parametrize("family", FAMILIES)
def test_random_diagrams_are_what_the_reference_loop_says(family):
    check(family, 1000, 2, "auto")


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.drawn(2)
def test_compiled_random_diagrams_are_what_the_reference_loop_says(family):
    check(family, 1005, 1, True)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(5))
@pytest.mark.parametrize("family", FAMILIES)
def test_many_random_diagrams_are_what_the_reference_loop_says(family, part):
    check(family, 15 * part, 9, "auto")


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_many_compiled_random_diagrams_are_what_the_reference_loop_says(family):
    check(family, 0, 16, True)

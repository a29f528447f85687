"""Blocks, paths and models that are given wrongly, or led where they don't hold: every error says what to do."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Circle,
    Constant,
    CubicSpline,
    DefinitionError,
    Ellipse,
    FeedbackLinearization,
    ForceProjection,
    Gain,
    GuardError,
    HandForce,
    Line,
    Output,
    ParameterError,
    PathDomainError,
    PathProjection,
    PathSpring,
    PlanarModel,
    Product,
    Saturation,
    ShapeError,
    Sum,
    TransverseTransform,
)
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import gantry

ELLIPSE = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))


def traced(block, **shapes):
    return trace(block, {n: shapes.get(n, port.shape) for n, port in block.inputs.items()}, sampled=False)


def value(block, *u):
    found = traced(block, **{n: np.shape(v) for n, v in zip(block.inputs, u, strict=True)})
    columns = [np.ravel(v) for v in u]
    made = found.function.call([0.0, np.zeros(found.function.numel_in(1)), *columns, found.pack(block, np.nan)])
    return np.reshape(np.array(made[0]), next(iter(found.outputs.values())))


# --- shapes at the algebraic blocks -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("block", "shapes", "text"),
    [
        (Sum(), ((2,), (3,)), r"sum\.u2: found shape \(3,\) next to u1 of shape \(2,\); expected one shape for both"),
        (Sum(signs="+-+"), ((), (2,), (3,)), r"sum\.u3: found shape \(3,\) next to u2 of shape \(2,\)"),
        (Sum(), ((2,), (2, 2)), r"sum\.u2: found shape \(2, 2\) next to u1 of shape \(2,\)"),
        (Sum(), ((1,), (3,)), r"sum\.u2: found shape \(3,\) next to u1 of shape \(1,\)"),
        (Product(), ((2,), (3,)), r"product\.u2: found shape \(3,\) next to u1 of shape \(2,\)"),
        (Gain(gain=(1, 2)), ((3,),), r"gain\.u: found shape \(3,\) next to gain of shape \(2,\)"),
        (
            Gain(gain=np.ones((2, 3))),
            ((2,),),
            r"gain\.u: found shape \(2,\); the gain is a matrix of 2 × 3 and takes 3",
        ),
        (Gain(gain=np.ones((2, 3))), ((),), r"gain\.u: found a scalar; the gain is a matrix of 2 × 3 and takes 3"),
        (Saturation(limit=(1, 2)), ((3,),), r"saturation\.u: found shape \(3,\) next to limit of shape \(2,\)"),
    ],
)
def test_shapes_that_do_not_fit(block, shapes, text):
    with pytest.raises(ShapeError, match=text):
        traced(block, **dict(zip(block.inputs, shapes, strict=True)))


def test_shapes_that_do_not_fit_are_told_with_the_blocks_path():
    with pytest.raises(ShapeError, match=r"^two\.u2: found shape \(3,\)"):
        Diagram("d", Sum(name="two")(Constant(value=(1.0, 2.0)), Constant(value=(1.0, 2.0, 3.0))))


def test_scalars_go_with_vectors():
    np.testing.assert_array_equal(value(Sum(signs="+-"), [1.0, 2.0], 3.0), [-2.0, -1.0])
    np.testing.assert_array_equal(value(Sum(signs="+-"), 3.0, [1.0, 2.0]), [2.0, 1.0])
    np.testing.assert_array_equal(value(Product(), 2.0, [1.0, 2.0]), [2.0, 4.0])
    np.testing.assert_array_equal(value(Gain(gain=(1.0, 2.0)), 3.0), [3.0, 6.0])
    np.testing.assert_array_equal(value(Gain(gain=((1.0, 2.0, 3.0), (0.0, 1.0, 0.0))), [1.0, 1.0, 2.0]), [9.0, 1.0])
    np.testing.assert_array_equal(value(Saturation(limit=1.0), [3.0, -0.5]), [1.0, -0.5])


def test_a_gain_of_three_dimensions():
    with pytest.raises(ParameterError, match=r"gain\.gain: found an array of shape \(1, 2, 3\); expected a number"):
        Gain(gain=np.ones((1, 2, 3)))


# --- paths and models that are none -----------------------------------------------------------------------------------


class Bare(PlanarModel):
    pass


class Half(PlanarModel):
    def f_v(self, x_c, x_v):
        return 0.0 * x_v


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (
            lambda: PathProjection("ellipse"),
            r"path_projection\.path: found 'ellipse'; expected a Path, such as Ellipse",
        ),
        (lambda: PathProjection(Ellipse), r"path_projection\.path: found .*Ellipse.*; expected a Path"),
        (lambda: HandForce(3.0), r"hand_force\.path: found 3; expected a Path"),
        (lambda: PathSpring("p"), r"path_spring\.path: found 'p'; expected a Path"),
        (lambda: ForceProjection(None), r"force_projection\.path: found None; expected a Path"),
        (lambda: TransverseTransform(gantry.nominal), r"transverse_transform\.path: found Gantry\(\); expected a Path"),
        (
            lambda: TransverseTransform(gantry.nominal, ELLIPSE),
            r"transverse_transform\.path: .*The path comes first, then the model",
        ),
        (lambda: TransverseTransform(ELLIPSE, "m"), r"transverse_transform\.model: found 'm'; expected a PlanarModel"),
        (
            lambda: FeedbackLinearization("p", gantry.nominal),
            r"feedback_linearization\.path: found 'p'; expected a Path",
        ),
        (lambda: FeedbackLinearization(gantry.nominal, ELLIPSE), r"path: .*The path comes first, then the model"),
        (lambda: FeedbackLinearization(ELLIPSE, None), r"model: found None; expected a PlanarModel"),
        (
            lambda: FeedbackLinearization(ELLIPSE, Bare()),
            r"model: Bare has no f_v\(x_c, x_v\); expected a PlanarModel that defines it, equation \(2\)",
        ),
        (lambda: FeedbackLinearization(ELLIPSE, Half()), r"model: Half has no G_v\(x_c\); .* Write it"),
    ],
)
def test_a_path_or_a_model_that_is_none(make, text):
    with pytest.raises(ParameterError, match=text):
        make()


def test_a_model_that_is_a_plant_without_its_equations():
    with pytest.raises(DefinitionError, match=r"Bare: found no f_v\(x_c, x_v\); expected a PlanarModel to define it"):
        Bare().f_v(np.zeros(2), np.zeros(2))
    with pytest.raises(DefinitionError, match=r"Half: found no G_v\(x_c\)"):
        Half().coordinate_acceleration(np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2))


class Stuck(Half):
    """Moves along one direction only."""

    def G_v(self, x_c):
        return np.array([[1.0, 0.0], [0.0, 0.0]])


class Locked(Half):
    """Loses an actuator on the left."""

    def G_v(self, x_c):
        return np.stack([np.stack([np.where(x_c[0] > 0.0, 1.0, 0.0), 0.0]), np.stack([0.0, 1.0])])


@pytest.mark.parametrize(("model", "start"), [(Stuck(), 1.0), (Locked(), -1.0)])
def test_a_singular_model_is_told_by_its_determinant(model, start):
    @subsystem(sample_time=1e-3)
    def box(position):
        theta = PathProjection(Circle(radius=2.0))(position)
        zero = Constant(value=(0.0, 0.0))
        return FeedbackLinearization(Circle(radius=2.0), model, name="law")(theta, position, zero, zero, 0.0, 0.0)

    with pytest.raises(
        GuardError, match=r"box\.law, t = 0 s: \|det\(dh G_v\)\| of (Stuck|Locked) is 0 at the position .*1e-09"
    ):
        Diagram("d", box(Constant(value=(start, 0.5)))).simulate(0.01, progress=False)


# --- the end of a path's coordinates ----------------------------------------------------------------------------------


class Moving(Block):
    """At one point until t = 5 ms, at another from then on."""

    before: np.ndarray
    after: np.ndarray
    y = Output(shape=(2,), unit="m")

    def output(self, t, x, u):
        return np.where(t < 5e-3 - 1e-9, self.before, self.after)


def stopped(path, before, after, block=PathProjection):
    @subsystem(sample_time=1e-3)
    def box(position):
        return block(path, name="follow")(position)

    moving = Moving(before=np.array(before), after=np.array(after))
    with pytest.raises(PathDomainError) as caught:
        Diagram("d", *np.atleast_1d(box(moving())).tolist()).simulate(0.01, progress=False)
    return caught.value


def test_a_reach_without_a_limit_is_called_so():
    error = stopped(Line(start=(0, 0), end=(1, 0)), (0.9, 0.01), (1.25, 0.02), HandForce)
    assert "local reach on that side unlimited" in str(error)
    assert error.reach == np.inf
    assert error.t == pytest.approx(5e-3)


@pytest.mark.parametrize(
    ("after", "text"), [(2.25, "it is 0.25 m beyond the end"), (-0.125, "it is 0.125 m before the start")]
)
def test_how_far_beyond_an_end(after, text):
    error = stopped(Line(start=(0, 0), end=(2, 0)), (0.9, 0.01), (after, 0.02), HandForce)
    assert f"{text} of the open path" in str(error)
    assert error.reach == np.inf


def test_a_foot_point_that_jumped_is_not_blamed_on_q():
    # to the other side of a circle: Newton's method finds the farthest point, where q is 1 - 2 = -1
    error = stopped(Circle(radius=0.2), (0.2, 0.001), (-0.2, -0.001), HandForce)
    assert "the foot point jumped" in str(error)
    assert "is below" not in str(error)
    assert "q = 1" not in str(error)


def test_how_far_a_foot_point_jumped():
    block = PathProjection(Circle(radius=0.2))
    u = type("u", (), {"position": np.array([0.0, 0.21])})()
    x = type("x", (), {"foot": np.array(2.0 * np.pi)})()
    text = str(block.guard_error("newton", -1.0, u, None, x))
    assert f"the foot point jumped by {0.2 * np.pi / 2:.3g} m along the path: the position moved too far" in text
    assert "the foot point jumped: the position" in str(block.guard_error("newton", -1.0, u, None))


@pytest.mark.parametrize("path", [ELLIPSE, Circle(radius=1.0), Line(start=(0, 0), end=(1, 0))])
@pytest.mark.parametrize(("eta", "xi", "name"), [(np.nan, 0.0, "eta"), (0.1, np.inf, "xi"), ([0.1, np.nan], 0, "eta")])
def test_coordinates_that_are_not_finite(path, eta, xi, name):
    with pytest.raises(PathDomainError, match=rf"found {name} = (nan|inf) m; expected finite path coordinates"):
        path.to_plane(eta, xi)


@pytest.mark.parametrize(("eta", "text"), [(1.25, "0.25 m beyond its end"), (-0.125, "0.125 m beyond its start")])
def test_arc_lengths_beyond_an_end(eta, text):
    with pytest.raises(PathDomainError, match=rf"found eta = {eta:g} m, {text}; expected 0 to 1 m") as caught:
        Line(start=(0, 0), end=(1, 0)).to_plane(eta, 0.0)
    assert caught.value.reach == np.inf


@pytest.mark.parametrize(
    "path",
    [
        ELLIPSE,
        Circle(radius=1.0),
        Line(start=(0, 0), end=(1, 0)),
        CubicSpline(points=[(0, 0), (1, 0), (2, 1)]),
    ],
)
@pytest.mark.parametrize("position", [(1, 2, 3), 1.0, (1,), np.zeros((3, 2)), "here", ((1, 2), (3,))])
def test_a_position_that_is_none(path, position):
    with pytest.raises(ParameterError, match=r"\.project: found a position of shape .*; expected \(2,\), in m, or"):
        path.project(position)


def test_positions_are_taken_one_by_one_and_together():
    path = CubicSpline(points=[(0, 0), (1, 0), (2, 1)])
    points = np.array([[0.2, 1.1], [0.1, 0.3]])
    assert path.project(points).shape == ELLIPSE.project(points).shape == (2,)
    assert path.project(points)[1] == path.project(points[:, 1])

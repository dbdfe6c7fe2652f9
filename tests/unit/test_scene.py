"""Scenes: round trip through files, order of bodies, kinds, distances and drawn patches of surfaces."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.messages import raises

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import solid_shape
from dynsim.draw.geometry.shapes import round_patch, surface_grids
from dynsim.errors import RecordError
from dynsim.library.surfaces import cylinder, plane, sphere
from dynsim.model.description import Quadric
from dynsim.record.scene import Body, CarriedMass, Joint, Point, Scene, SceneSurface, Shape, quaternion

CONTEXT = BuildContext(1.0)
HINGE = Joint("j", "revolute", (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "q", ("j",))


def surface(quadric: Quadric) -> SceneSurface:
    return SceneSurface.of_quadric("s", quadric.Q, quadric.b, quadric.c)


def test_round_trip_and_unknown_keys():
    scene = Scene(
        (Body("a", -1, HINGE), Body("b", 0, HINGE, (Shape("cylinder", (0.1, 1.0), colour=(1.0, 0.0, 0.0, 0.5)),))),
        (surface(plane.build(plane.Config(type="plane"), CONTEXT)),),
        (
            Point("hand", "hand", 1, (0.0, 0.0, 1.0)),
            Point("e", "contact", 0, (0.0, 0.0, 0.5), "s", 0.3, 0.02, (0.0, 0.0, 0.6)),
        ),
        payloads=(CarriedMass("tool", 1, (0.0, 0.0, 0.9), 0.5, 0.03),),
    )
    assert Scene.from_json(scene.to_json()) == scene
    later = json.loads(scene.to_json()) | {"lights": []}
    later["bodies"][0]["mass"] = 1.0
    assert Scene.from_json(json.dumps(later)) == scene
    assert (scene.hand, scene.contacts) == (scene.points[0], scene.points[1:])
    assert (scene.surface("s"), scene.surface("none")) == (scene.surfaces[0], None)


def test_planes_on_bodies_are_drawn_at_their_point():
    config = plane.Config(type="plane", point_m=[0.05, 0.0, 0.3], normal=[1.0, 0.0, 0.0])
    shape = solid_shape(plane.build(config, CONTEXT).shifted(np.array([0.0, 0.1, 0.0])), 0.5)
    assert shape.position == pytest.approx((0.05, 0.1, 0.3))
    assert shape.size[:2] == (0.5, 0.5)


def test_heights_of_single_points_are_those_of_many():
    """A posture with one sphere on a field asks at a single point."""
    zero = (0.0, 0.0, 0.0)
    heights = ((0.0, 0.1, 0.2), (0.1, 0.2, 0.3))
    hills = SceneSurface(
        "s", (zero, zero, zero), zero, 0.0, "height_field", position=zero, spacing=(1.0, 1.0), heights=heights
    )
    points = np.array([[0.5, 0.5, 1.0], [1.5, 0.2, 0.5]])
    np.testing.assert_allclose(hills.value(points), [0.9, 0.33], atol=1e-15)
    for point, value, normal in zip(points, hills.value(points), hills.normal(points), strict=True):
        assert hills.value(point) == value
        np.testing.assert_array_equal(hills.normal(point), normal)


def test_bodies_come_after_their_parents():
    with raises(RecordError, "a", "0"):
        Scene((Body("a", 0, HINGE),))
    with raises(RecordError, "p", "1"):
        Scene((Body("a", -1, HINGE),), points=(Point("p", "hand", 1, (0.0, 0.0, 0.0)),))
    with raises(RecordError, "planar", "1"):
        Joint("j", "planar", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "base", ("x",))


def test_planes_spheres_and_cylinders_are_recognised():
    shape = surface(plane.build(plane.Config(type="plane", point_m=[1.0, 2.0, 3.0], normal=[0.0, 0.6, 0.8]), CONTEXT))
    assert (shape.kind, shape.radius) == ("plane", None)
    np.testing.assert_allclose(shape.direction, [0.0, 0.6, 0.8], atol=1e-15)
    np.testing.assert_allclose(shape.position, 3.6 * np.array([0.0, 0.6, 0.8]), atol=1e-15)
    for inside, sign in ((False, 1.0), (True, -1.0)):
        shape = surface(
            sphere.build(sphere.Config(type="sphere", center_m=[1.0, -2.0, 0.5], radius_m=0.7, inside=inside), CONTEXT)
        )
        assert shape.kind == "sphere"
        np.testing.assert_allclose(shape.position, [1.0, -2.0, 0.5], atol=1e-13)
        assert shape.radius == pytest.approx(sign * 0.7, rel=1e-12)
        made = cylinder.Config(
            type="cylinder", point_m=[1.0, 0.0, 2.0], axis=[1.0, 1.0, 0.0], radius_m=0.3, inside=inside
        )
        shape = surface(cylinder.build(made, CONTEXT))
        assert (shape.kind, shape.radius) == ("cylinder", pytest.approx(sign * 0.3, rel=1e-12))
        axis = np.array(shape.direction)
        np.testing.assert_allclose(np.abs(axis), [0.5**0.5, 0.5**0.5, 0.0], atol=1e-12)
        off = np.array(shape.position) - [1.0, 0.0, 2.0]
        np.testing.assert_allclose(off - axis * (axis @ off), 0.0, atol=1e-12)
    cone = SceneSurface.of_quadric("s", np.diag([1.0, 1.0, -1.0]), np.zeros(3), 0.0)
    assert (cone.kind, cone.position) == ("quadric", None)
    # No direction is its normal, so it has no parameters that a file could not hold.
    nowhere = SceneSurface.of_quadric("s", np.zeros((3, 3)), np.zeros(3), 1.0)
    assert (nowhere.kind, nowhere.direction) == ("quadric", None)
    # No point is on it.
    assert SceneSurface.of_quadric("s", np.eye(3), np.zeros(3), 1.0).kind == "quadric"


def test_distances_are_those_of_the_model():
    rng = np.random.default_rng(3)
    for quadric in (
        plane.build(plane.Config(type="plane", normal=[0.0, 0.6, 0.8]), CONTEXT),
        sphere.build(sphere.Config(type="sphere", center_m=[0.0, 0.0, 1.0], radius_m=0.5), CONTEXT),
        cylinder.build(
            cylinder.Config(type="cylinder", point_m=[0.0, 0.0, 1.0], axis=[1.0, 0.0, 0.0], radius_m=2.0), CONTEXT
        ),
    ):
        for point in rng.standard_normal((20, 3)):
            assert surface(quadric).gap(point) == pytest.approx(quadric.gap(point), rel=1e-12, abs=1e-15)


def test_quaternions_of_rotations():
    rng = np.random.default_rng(1)
    half_turns = [np.diag(d) for d in ([1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0])]
    turns = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(50)]
    for R in [np.eye(3), *half_turns, *(R * np.sign(np.linalg.det(R)) for R in turns)]:
        w, *v = quaternion(R)
        x = np.array(v)
        cross = np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])
        np.testing.assert_allclose(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross, R, atol=1e-15)
        assert w >= 0.0


@pytest.mark.parametrize(
    "drawn",
    [
        SceneSurface.of_quadric("cone", np.diag([1.0, 1.0, -1.0]), np.zeros(3), 0.0),
        SceneSurface.of_quadric("ellipsoid", np.diag([1.0, 4.0, 2.0]), [0.1, 0.0, -0.3], -0.5),
        SceneSurface.of_quadric("slope", np.zeros((3, 3)), [0.0, 0.6, 0.8], -0.1),
    ],
)
def test_points_of_quadrics_are_on_them(drawn: SceneSurface):
    low, high = np.array([0.1, -0.4, 0.2]), np.array([0.9, 0.5, 0.8])
    (grid,) = surface_grids(drawn, low, high)
    points = grid[np.isfinite(grid).all(axis=-1)]
    assert len(points) > 3
    # Roots of a quadratic of numbers of the order of one.
    np.testing.assert_allclose(drawn.value(points), 0.0, atol=1e-12)
    # A flat one has no seams between cells.
    assert grid.shape[:2] == ((2, 2) if drawn.kind == "plane" else (41, 41))
    slopes = np.array([drawn.gradient(point) for point in points])
    np.testing.assert_allclose(drawn.normal(points), slopes / np.linalg.norm(slopes, axis=1)[:, None], atol=1e-12)


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
@pytest.mark.parametrize(("size", "whole"), [(0.2, True), (40.0, False)])
def test_a_round_patch_lies_on_its_surface_and_has_no_holes(kind, size, whole):
    """Around the point next to a box: the box stands aside of the surface, aslant."""
    low, high = np.array([0.8 * size, 0.1, -0.3]), np.array([0.8 * size + 1.0, 0.7, 0.4])
    if kind == "sphere":
        quadric = sphere.build(sphere.Config(type="sphere", center_m=(0.0, 0.0, 0.0), radius_m=size), CONTEXT)
    else:
        config = cylinder.Config(type="cylinder", point_m=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), radius_m=size)
        quadric = cylinder.build(config, CONTEXT)
    drawn = surface(quadric)
    assert drawn.kind == kind
    grid = round_patch(drawn, low, high)
    assert np.isfinite(grid).all()
    across = grid if kind == "sphere" else grid * [1.0, 0.0, 1.0]
    np.testing.assert_allclose(np.linalg.norm(across, axis=-1), size, rtol=1e-12)
    # Neighbours are near each other: a torn mesh would reach over what lies between.
    # Of a large sphere somewhat more than what the box covers of it, whose depth does not count.
    reach = np.pi * size if whole else 0.6 * (0.7 if kind == "sphere" else float(np.linalg.norm(high - low)))
    steps = [np.linalg.norm(np.diff(across, axis=axis), axis=-1).max() for axis in (0, 1)]
    assert max(steps) < 0.2 * reach
    # Next to the box is the middle of the patch; small ones are drawn all round.
    middle = 0.5 * (low + high) * ([1.0, 1.0, 1.0] if kind == "sphere" else [1.0, 0.0, 1.0])
    nearest = size * middle / np.linalg.norm(middle)
    away = np.linalg.norm(across - nearest, axis=-1)
    assert away.min() < 0.05 * size
    assert away.max() == pytest.approx(2.0 * size if whole else reach, rel=0.02)


@pytest.mark.parametrize("high", [(0.0, 0.0, 43.0), (0.0, 0.0, 40.0), (1.0, 0.0, 40.0)])
def test_a_round_patch_next_to_what_has_no_width(high):
    """A hanging pendulum over a sphere, and a point."""
    quadric = sphere.build(sphere.Config(type="sphere", center_m=(0.0, 0.0, 0.0), radius_m=39.0), CONTEXT)
    grid = round_patch(surface(quadric), np.array([0.0, 0.0, 40.0]), np.array(high))
    np.testing.assert_allclose(np.linalg.norm(grid, axis=-1), 39.0, rtol=1e-12)


def test_the_radius_of_a_body_is_that_of_its_thickest_round_shape():
    shapes = (Shape("box", (1.0, 1.0, 1.0)), Shape("cylinder", (0.02, 1.0)), Shape("capsule", (0.03, 1.0)))
    assert Body("b", -1, HINGE, shapes).radius == 0.03
    assert Body("b", -1, HINGE, shapes[:1]).radius == 0.0


def test_a_surface_without_points_has_none_to_draw():
    (grid,) = surface_grids(SceneSurface.of_quadric("s", np.eye(3), np.zeros(3), 1.0), np.full(3, -1.0), np.ones(3))
    assert np.isnan(grid).all()

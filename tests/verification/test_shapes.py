"""Spheres and capsules on planes, spheres, cylinders, boxes and height fields: gap and its derivatives, rolling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize, minimize_scalar
from support.random_robots import CompiledSystem, assemble, random_robot, random_rotation, random_unit

from dynsim.compile.model import Model
from dynsim.compile.shapes import compile_shapes, moves, share_of_axis, touching_points
from dynsim.compile.touching import gap_at
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.rows import set_modes
from dynsim.dynamics.state import OUT_FORCE
from dynsim.jit.kernel import integers
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot, vector
from dynsim.model.joints.ball import floating
from dynsim.model.surfaces import Box, HeightField, Surface

G = 9.81
KINDS = ("plane", "sphere", "bowl", "cylinder", "pipe", "box", "height_field")
BENT = ("sphere", "cylinder", "box")


def plane(normal: np.ndarray, point: np.ndarray) -> Quadric:
    return Quadric(np.zeros((3, 3)), normal, -float(normal @ point))


def round_surface(centre: np.ndarray, radius: float, axis: np.ndarray | None = None, sign: float = 1.0) -> Quadric:
    P = np.eye(3) if axis is None else np.eye(3) - np.outer(axis, axis)
    Q = sign / radius * P
    return Quadric(Q, -Q @ centre, 0.5 * float(centre @ Q @ centre) - 0.5 * sign * radius)


def hills(rng: np.random.Generator, point: np.ndarray) -> HeightField:
    """A field whose radius of curvature is some 0.3 m or more, 4 m wide, roughly through a place."""
    x, y = np.arange(-2.0, 2.01, 0.1), np.arange(-2.0, 2.01, 0.125)
    a, b = rng.uniform(0.0, 6.0, size=2)
    heights = 0.08 * np.sin(3.0 * x + a) * np.cos(4.0 * y[:, None] + b) + 0.3 * x - 0.2 * y[:, None] ** 2
    heights += rng.normal(scale=2e-4, size=heights.shape)
    return HeightField(point[:2] - 2.0, np.array([0.1, 0.125]), heights + point[2])


def surface_near(rng: np.random.Generator, kind: str, point: np.ndarray, axis: np.ndarray) -> Surface:
    """A surface of a kind at some 0.2 m from a place in the middle of an axis that runs across."""
    normal = np.cross(axis, random_unit(rng))
    normal /= np.linalg.norm(normal)
    side = np.cross(axis, normal) + 0.7 * axis
    side /= np.linalg.norm(side)
    if kind == "plane":
        return plane(normal, point - 0.2 * normal)
    if kind == "box":
        turn = random_rotation(rng)
        edge = turn.T @ np.array([0.25, 0.2, 0.1])
        return Box(point - 0.2 * normal - edge * np.sign(edge @ normal), turn, np.array([0.6, 0.5, 0.4]), 0.05)
    if kind == "height_field":
        return hills(rng, point - vector(0, 0, 0.1))
    across = side if kind in ("cylinder", "pipe") else None
    if kind in ("bowl", "pipe"):
        return round_surface(point + 0.8 * normal, 1.5, across, -1.0)
    return round_surface(point - 0.7 * normal, 0.5, across)


def brute_distance(surface: Surface, point: np.ndarray) -> float:
    """Signed distance of a point by other means than the kernels'."""
    if isinstance(surface, Quadric):
        return float(surface.gap(point))
    if isinstance(surface, Box):
        local = surface.axes @ (point - surface.centre)
        core = 0.5 * surface.edges - surface.edge_radius
        return float(np.linalg.norm(local - np.clip(local, -core, core))) - surface.edge_radius
    assert isinstance(surface, HeightField)
    ny, nx = surface.heights.shape
    x, y = (surface.origin[s] + surface.spacing[s] * np.arange((nx, ny)[s]) for s in (0, 1))
    along_y = make_interp_spline(y, surface.heights, k=3)

    def height(at: np.ndarray) -> float:
        return float(make_interp_spline(x, along_y(at[1]), k=3)(at[0]))

    minimum = minimize(
        lambda at: (at[0] - point[0]) ** 2 + (at[1] - point[1]) ** 2 + (height(at) - point[2]) ** 2,
        point[:2],
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-18, "maxiter": 2000},
    )
    return float(np.sqrt(minimum.fun) * np.sign(point[2] - height(point[:2])))


def brute_gap(contact: Contact, start: np.ndarray, end: np.ndarray) -> float:
    if not moves(contact):
        return brute_distance(contact.surface, start) - contact.radius
    minimum = minimize_scalar(
        lambda u: brute_distance(contact.surface, start + u * (end - start)),
        bounds=(0.0, 1.0),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return float(minimum.fun) - contact.radius


def random_case(kind: str, shape: str, seed: int) -> tuple[CompiledSystem, Contact, np.ndarray, np.ndarray, np.ndarray]:
    """A point, a sphere or a capsule of a random robot beside a surface, with q, v and an acceleration."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 6, motors=False)
    q, v, a = rng.normal(size=(3, 6))
    start, end = rng.normal(scale=0.3, size=(2, 3))
    end = start + 0.5 * (end - start) / np.linalg.norm(end - start)
    model = Model(robot)
    places = [model.point_position("body_5", point, q) for point in (start, end)]
    position = places[0] if shape != "capsule" else 0.5 * (places[0] + places[1])
    axis = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
    contact = Contact(
        "c",
        "body_5",
        start,
        surface_near(rng, kind, position, axis),
        friction=0.3,
        radius=0.0 if shape == "point" else 0.06,
        tip=end if shape == "capsule" else None,
    )
    return assemble(robot, [contact]), contact, q, v, a


CASES = [(kind, shape) for kind in KINDS for shape in ("point", "sphere")] + [(kind, "capsule") for kind in BENT]


@pytest.mark.parametrize(("kind", "shape"), CASES)
def test_gaps_are_distances_found_by_other_means(kind, shape):
    for seed in range(6):
        b, contact, q, v, _ = random_case(kind, shape, seed)
        b.derivative(b.state(q, v))
        model = Model(b.robot)
        start = model.point_position("body_5", contact.point, q)
        end = start if contact.tip is None else model.point_position("body_5", contact.tip, q)
        gap = b.ws.contacts[0, ka.GAP]
        # A simplex finds the distance to the square of its tolerance; so does a bracketed minimum (1e-8) but at a kink.
        assert gap == pytest.approx(brute_gap(contact, start, end), abs=2e-8 if shape == "capsule" else 1e-9)
        assert gap_at(model, contact, q) == pytest.approx(gap, abs=1e-12)


@pytest.mark.parametrize(("kind", "shape"), CASES)
def test_forces_act_where_a_shape_is_nearest_to_its_surface(kind, shape):
    """Records place them where the kernels let them act."""
    for seed in range(6):
        b, contact, q, v, _ = random_case(kind, shape, seed)
        b.derivative(b.state(q, v))
        ends = [
            Model(b.robot).point_position("body_5", end, q) for end in (contact.point, contact.tip) if end is not None
        ]
        at = touching_points(contact, *(np.array([end, end]) for end in ends))
        np.testing.assert_allclose(at, np.tile(b.ws.contacts[0, ka.POSITION : ka.POSITION + 3], (2, 1)), atol=1e-12)


def test_capsules_over_edges_of_a_box():
    """Axes flat over faces and across edges: the nearest point is where a flat stretch of the distance ends."""
    rng = np.random.default_rng(5)
    for trial in range(300):
        box = Box(np.zeros(3), np.eye(3), np.array([0.2, 1.0, 0.2]), rng.choice([0.002, 0.03]))
        start = np.array([rng.uniform(-0.6, -0.15), rng.uniform(-0.3, 0.3), 0.1 + rng.uniform(0.0, 0.3)])
        end = np.array([rng.uniform(0.0, 0.6), rng.uniform(-0.3, 0.3), 0.1 + rng.uniform(0.0, 0.3)])
        if trial % 3 == 0:
            end[2] = start[2]
        contact = Contact("c", "b", start, box, radius=0.02, tip=end)
        u = np.linspace(0.0, 1.0, 20001)
        points = start + u[:, None] * (end - start)
        core = 0.5 * box.edges - box.edge_radius
        nearest = np.linalg.norm(points - np.clip(points, -core, core), axis=1).min() - box.edge_radius - 0.02
        share = share_of_axis(contact, start, end)
        assert box.gap(start + share * (end - start)) - contact.radius == pytest.approx(
            nearest, abs=2e-9 + 1e-4 * (end - start) @ (end - start) / 20
        )


# The row of a point on a round quadric is that of its level set: the gap's own on the surface only.
SHAPED = [(kind, shape) for kind, shape in CASES if shape != "point" or kind in ("plane", "box", "height_field")]


@pytest.mark.parametrize(("kind", "shape"), SHAPED)
def test_rates_and_rows_are_derivatives_of_the_gap(kind, shape):
    """Along q + v t + a t²/2: ġ, and g̈ = J a − target, by central differences of the gap."""
    met = 0
    for seed in range(12):
        b, _, q, v, a = random_case(kind, shape, seed)
        eps = 1e-4
        gaps, rates, normals = [], [], []
        for t in (-2 * eps, -eps, 0.0, eps, 2 * eps):
            b.derivative(b.state(q + v * t + 0.5 * a * t * t, v + a * t))
            gaps.append(b.ws.contacts[0, ka.GAP])
            rates.append(b.ws.contacts[0, ka.GAP_RATE])
            normals.append(b.ws.contacts[0, ka.NORMAL : ka.NORMAL + 3].copy())
        if kind == "box":
            # Where a round edge begins, H jumps: those cases have no second derivative.
            spins = np.linalg.norm(np.diff(normals, 2, axis=0), axis=1) / eps**2
            if spins.max() > 1e3:
                continue
        met += 1
        b.derivative(b.state(q, v))
        row, target = b.ws.rows[0, ka.ROW : ka.ROW + 6].copy(), b.ws.rows[0, ka.TARGET]
        b.derivative(b.state(q, a))
        second = row @ b.ws.links[5, ka.V : ka.V + 6] - target
        scale = 1.0 + np.abs(v).max() ** 2 + np.abs(a).max()
        rate = (gaps[0] - 8 * gaps[1] + 8 * gaps[3] - gaps[4]) / (12 * eps)
        # Truncation eps⁴, rounding 1e-16/eps.
        assert abs(rate - rates[2]) <= 1e-9 * scale
        assert abs((rates[0] - 8 * rates[1] + 8 * rates[3] - rates[4]) / (12 * eps) - second) <= 1e-7 * scale**2
        assert abs((gaps[1] - 2 * gaps[2] + gaps[3]) / eps**2 - second) <= 1e-4 * scale**2
    assert met >= 6


@pytest.mark.parametrize(("kind", "shape"), [case for case in CASES if case[1] != "point"])
def test_tangential_rows_of_what_sticks_roll(kind, shape):
    """t · d/dt of the velocity of the body's point that is in contact: each time another one."""
    for seed in range(6):
        b, _, q, v, a = random_case(kind, shape, seed)
        y, eps = b.state(q, v), 1e-5
        b.derivative(y)
        set_modes(b.system.contacts, b.system.couplings, None, b.ws, integers([ka.STICKING]))
        b.derivative(y)
        state, rows = b.ws.contacts[0].copy(), b.ws.rows.copy()
        tangents = state[ka.FIRST_TANGENT : ka.SECOND_TANGENT + 3].reshape(2, 3)
        np.testing.assert_allclose(tangents @ tangents.T, np.eye(2), atol=1e-14)
        np.testing.assert_allclose(tangents @ state[ka.NORMAL : ka.NORMAL + 3], 0.0, atol=1e-14)
        assert (rows[1:3, ka.ROW_GAP] == 0.0).all()
        velocities = []
        for t in (-2 * eps, -eps, eps, 2 * eps):
            b.derivative(b.state(q + v * t + 0.5 * a * t * t, v + a * t))
            c, V = b.ws.contacts[0, ka.POSITION : ka.POSITION + 3], b.ws.links[5, ka.V : ka.V + 6]
            velocities.append(V[3:] + np.cross(V[:3], c))
        b.derivative(b.state(q, a))
        change = np.array([1, -8, 8, -1]) @ np.array(velocities) / (12 * eps)
        for r in (1, 2):
            row = rows[r, ka.ROW : ka.ROW + 6] @ b.ws.links[5, ka.V : ka.V + 6] - rows[r, ka.TARGET]
            assert abs(row - tangents[r - 1] @ change) <= 2e-6 * (1.0 + np.abs(v).max() ** 2 + np.abs(a).max()) ** 2


def test_a_capsule_that_meets_with_an_end_has_the_rows_of_a_sphere_there():
    for seed in range(6):
        b, capsule, q, v, _ = random_case("sphere", "capsule", seed)
        assert capsule.tip is not None
        for end, other in ((capsule.tip, capsule.point), (capsule.point, capsule.tip)):
            position, behind = (Model(b.robot).point_position("body_5", point, q) for point in (end, other))
            ahead = (position - behind) / np.linalg.norm(position - behind)
            beside = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
            # A ball ahead of the end and to the side, which nothing of the capsule is nearer to than this end.
            ball = round_surface(position + 0.5 * ahead + 0.3 * beside, 0.5)
            rows, states = [], []
            for contact in (
                replace(capsule, surface=ball),
                replace(capsule, surface=ball, point=end, tip=None),
            ):
                with_capsule = assemble(b.robot, [contact])
                with_capsule.derivative(with_capsule.state(q, v))
                rows.append(with_capsule.ws.rows.copy())
                states.append(with_capsule.ws.contacts.copy())
            np.testing.assert_allclose(rows[0], rows[1], rtol=0, atol=1e-11 * (1.0 + np.abs(rows[1]).max()))
            np.testing.assert_allclose(states[0], states[1], rtol=0, atol=1e-11 * (1.0 + np.abs(states[1]).max()))


@pytest.mark.parametrize(("kind", "radius"), [("sphere", 0.06), ("cylinder", 0.06), ("plane", 0.06)])
def test_a_sphere_is_a_point_on_the_surface_that_lies_a_radius_further_out(kind, radius):
    """Without friction: plane c − ρ, sphere and cylinder R + ρ."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        robot = random_robot(rng, 6, motors=False)
        q, v = rng.normal(size=(2, 6))
        point = rng.normal(scale=0.3, size=3)
        position = Model(robot).point_position("body_5", point, q)
        normal, axis = random_unit(rng), None
        if kind == "cylinder":
            axis = np.cross(normal, random_unit(rng))
            axis /= np.linalg.norm(axis)
        if kind == "plane":
            inner, outer = plane(normal, position - radius * normal), plane(normal, position)
        else:
            inner, outer = (round_surface(position - 0.7 * normal, r, axis) for r in (0.7 - radius, 0.7))
        J = normal @ Model(robot).point_jacobian("body_5", point, q)
        v = v - J * (J @ v) / (J @ J)
        sphere, lone = (
            assemble(robot, [Contact("c", "body_5", point, surface, radius=rho)])
            for surface, rho in ((inner, radius), (outer, 0.0))
        )
        a, b = (x.part(x.derivative(x.state(q, v)), "v") for x in (sphere, lone))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
        assert sphere.ws.contacts[0, ka.NORMAL_FORCE] == pytest.approx(lone.ws.contacts[0, ka.NORMAL_FORCE], rel=1e-9)


def free_body(inertia: Inertia) -> Robot:
    return Robot("free", floating(Link("body", "root", None, "", vector(0, 0, 1), inertia)), (), ("body", np.zeros(3)))


def pose(robot: Robot, position: np.ndarray) -> np.ndarray:
    q = robot.initial.copy()
    q[:3] = position
    return q


SLOPE = 0.3
DOWN = np.array([np.cos(SLOPE), 0.0, -np.sin(SLOPE)])
NORMAL = np.array([np.sin(SLOPE), 0.0, np.cos(SLOPE)])


@pytest.mark.slow  # a program of its own to compile
@pytest.mark.parametrize(("shape", "share"), [("sphere", 5.0 / 7.0), ("cylinder", 2.0 / 3.0)])
def test_a_ball_and_a_cylinder_roll_down_a_slope(shape, share):
    """a = g sin α / (1 + I/(m r²)): 5/7 of a solid ball, 2/3 of a solid cylinder on the two spheres of its ends."""
    r, mass, times = 0.1, 2.0, np.linspace(0.0, 1.0, 5)
    floor = plane(NORMAL, np.zeros(3))
    if shape == "sphere":
        robot = free_body(Inertia.solid_sphere(mass, r, np.zeros(3)))
        contacts = [Contact("ball", "body", np.zeros(3), floor, radius=r)]
    else:
        side = mass * (3.0 * r**2 + 0.6**2) / 12.0
        robot = free_body(Inertia(mass, np.zeros(3), np.diag([side, 0.5 * mass * r**2, side])))
        contacts = [
            Contact(name, "body", vector(0, y, 0), floor, radius=r) for name, y in (("left", 0.3), ("right", -0.3))
        ]
    b = assemble(robot, contacts)
    y = b.state(pose(robot, r * NORMAL), np.zeros(6))
    b.derivative(y)
    set_modes(b.system.contacts, b.system.couplings, None, b.ws, integers([ka.STICKING] * len(contacts)))
    run = b.simulate(y, times, rtol=1e-10)
    q = run.states("q")
    travelled = (q[:, :3] - q[0, :3]) @ DOWN
    np.testing.assert_allclose(travelled, 0.5 * share * G * np.sin(SLOPE) * times**2, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose((q[:, :3] - q[0, :3]) @ NORMAL, 0.0, atol=1e-9)
    np.testing.assert_allclose(run.outputs("contact")[:, :, OUT_FORCE].sum(axis=1), mass * G * np.cos(SLOPE), rtol=1e-8)


@pytest.mark.slow  # a program of its own to compile
def test_a_ball_rolls_over_a_sphere():
    """From near its top on a circle of R + r: its energy of motion is 7/10 m v² and comes from its height."""
    R, r, start = 0.5, 0.1, 0.2
    robot = free_body(Inertia.solid_sphere(1.0, r, np.zeros(3)))
    b = assemble(robot, [Contact("ball", "body", np.zeros(3), round_surface(np.zeros(3), R), radius=r)])
    y = b.state(pose(robot, (R + r) * np.array([np.sin(start), 0.0, np.cos(start)])), np.zeros(6))
    b.derivative(y)
    set_modes(b.system.contacts, b.system.couplings, None, b.ws, integers([ka.STICKING]))
    run = b.simulate(y, np.linspace(0.0, 0.8, 9), rtol=1e-10)
    position, v = run.states("q")[:, :3], run.states("v")
    theta = np.arctan2(position[:, 0], position[:, 2])
    assert theta[-1] > 1.2
    np.testing.assert_allclose(np.linalg.norm(position, axis=1), R + r, atol=1e-9)
    square = np.sum(v[:, :3] ** 2, axis=1)
    assert square[-1] > 1.0
    np.testing.assert_allclose(0.7 * square, G * (position[0, 2] - position[:, 2]), atol=1e-8)


def test_a_field_of_cubics_is_kept_exactly_and_goes_on_straight():
    x, y = np.linspace(-1.0, 2.0, 13), np.linspace(0.0, 1.0, 6)

    def cubic(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x**3 - x) * (1.0 + y**3) / 10.0 + y**2

    field = HeightField(np.array([-1.0, 0.0]), np.array([0.25, 0.2]), cubic(x, y[:, None]))
    rng = np.random.default_rng(1)
    inside = rng.uniform([-1.0, 0.0], [2.0, 1.0], size=(50, 2))
    on = np.column_stack([inside, cubic(inside[:, 0], inside[:, 1])])
    assert np.abs(field.gaps(on)).max() <= 1e-13
    steps = np.linspace(0.0, 1.0, 5)[:, None]
    slope = (3 * 2.0**2 - 1.0) * (1.0 + 0.5**3) / 10.0
    beyond = np.array([2.0, 0.5, cubic(2.0, 0.5)]) + steps * np.array([1.0, 0.0, slope])
    assert np.abs(field.gaps(beyond)).max() <= 1e-12


def test_a_field_meets_smooth_hills_to_the_fourth_power_of_its_spacing():
    rng = np.random.default_rng(4)
    places = rng.uniform(0.0, 2.0, size=(200, 2))

    def hill(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.1 * np.sin(3.0 * x) * np.cos(2.0 * y)

    errors = []
    for cells in (20, 40, 80):
        lines = np.linspace(0.0, 2.0, cells + 1)
        field = HeightField(np.zeros(2), np.full(2, 2.0 / cells), hill(lines, lines[:, None]))
        on = np.column_stack([places, hill(*places.T)])
        errors.append(np.abs(field.gaps(on)).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 3.6).all()
    assert errors[-1] < 1e-6


def test_points_on_quadrics_have_no_table():
    rng = np.random.default_rng(2)
    robot = random_robot(rng, 3)
    point = Contact("c", "body_2", np.zeros(3), plane(vector(0, 0, 1), np.zeros(3)))
    assert compile_shapes(robot, [point]) is None
    shapes = compile_shapes(robot, [point, replace(point, radius=0.1)])
    assert shapes is not None
    assert shapes.kind[:, 0].tolist() == [0, 1]

"""Joints with several rows in motion: closed forms, conservation, attitudes as angles, contacts and projection."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ellipj
from support.messages import raises
from support.random_robots import (
    assemble,
    random_contacts,
    random_positions,
    random_robot_of,
    random_rotation,
    without_losses,
)

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import CONSTRAINT, FRICTION, JOINT
from dynsim.dynamics.tree.joints import position_error, positions_along, rates_across
from dynsim.errors import ModelError
from dynsim.integrators.run import DRIFT_MAX, PROJECTIONS, REJECTED, STEPS
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.model.drives import Motor
from dynsim.model.joints.ball import ball, floating
from dynsim.model.joints.planar import planar, rolling
from dynsim.record.scene import quaternion as scene_quaternion

DOWN = np.array([0.0, 0.0, -9.81])
AXES = np.eye(3)


def body(name: str, parent: str | None = None, inertia: Inertia | None = None, **options: object) -> Link:
    inertia = inertia or Inertia(2.0, np.zeros(3), np.diag([0.03, 0.05, 0.07]))
    return Link(name, f"{name}_joint", parent, "", AXES[2], inertia, **options)  # type: ignore[arg-type]


def robot_of(links: tuple[Link, ...], gravity: np.ndarray | None = None) -> Robot:
    return Robot("test", links, (), (links[-1].name, np.zeros(3)), np.zeros(3) if gravity is None else gravity)


def quaternion(R: np.ndarray) -> np.ndarray:
    """w, x, y, z of a rotation, by the eigenvector of largest eigenvalue: accurate at every angle."""
    K = np.array(
        [
            [np.trace(R), R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0.0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0.0, 0.0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [0.0, 0.0, 0.0, R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    return np.linalg.eigh(K, UPLO="U")[1][:, -1]


def about(axis: int, angle: float) -> np.ndarray:
    """Rotation about x, y or z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.roll(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), (axis, axis), (0, 1))


def angle_between(R: np.ndarray, other: np.ndarray) -> float:
    """Angle of the rotation from one attitude to the other, accurate for small ones [rad]."""
    return 2.0 * float(np.arcsin(min(np.linalg.norm(R - other) / np.sqrt(8.0), 1.0)))


def momenta(model: Model, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear momentum and angular momentum about the world origin, from the sweep's spatial velocities."""
    model.kinetic_energy(q, v)
    linear, angular = np.zeros(3), np.zeros(3)
    for link, row in zip(model.robot.links, model._workspace.links, strict=True):
        R, p, w, o = row[ka.R : ka.R + 9].reshape(3, 3), row[ka.P : ka.P + 3], row[ka.V : ka.V + 3], row[ka.V + 3 :][:3]
        c = p + R @ link.inertia.com
        momentum = link.inertia.mass * (o + np.cross(w, c))
        linear += momentum
        angular += np.cross(c, momentum) + R @ link.inertia.tensor @ R.T @ w
    return linear, angular


# ---- one free body


def free_body(rng: np.random.Generator, moments: tuple[float, float, float]) -> tuple[Robot, np.ndarray]:
    """A body of these principal moments in general axes with its mass off the origin; and these axes."""
    axes = random_rotation(rng)
    tensor = axes @ np.diag(moments) @ axes.T
    inertia = Inertia(1.3, np.array([0.1, -0.2, 0.05]), 0.5 * (tensor + tensor.T))
    return robot_of(floating(body("body", inertia=inertia))), axes


def euler_top(moments: np.ndarray, w: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates (T, 3) about the principal axes and attitudes (T, 3, 3) in a frame whose z is the angular momentum.

    Moments I1 < I2 < I3, rates (w1, 0, w3) at t = 0 with |L|² > 2 E I2 (Landau and Lifshitz, Mechanics, § 37); the
    third angle, ψ̇ = |L| (I1 w1² + I2 w2²) / (I1² w1² + I2² w2²), by Gauss's rule.
    """
    I1, I2, I3 = moments
    twice, square = float(w @ (moments * w)), float((moments * w) @ (moments * w))
    assert w[1] == 0.0
    assert square > twice * I2
    rate = np.sqrt((I3 - I2) * (square - twice * I1) / (I1 * I2 * I3))
    m = (I2 - I1) * (twice * I3 - square) / ((I3 - I2) * (square - twice * I1))
    amplitude = np.sqrt(
        [
            (twice * I3 - square) / (I1 * (I3 - I1)),
            (twice * I3 - square) / (I2 * (I3 - I2)),
            (square - twice * I1) / (I3 * (I3 - I1)),
        ]
    )

    def rates(t: np.ndarray) -> np.ndarray:
        sn, cn, dn, _ = ellipj(rate * t, m)
        return amplitude * np.stack([cn, sn, dn], axis=-1)

    def turning(t: np.ndarray) -> np.ndarray:
        w = rates(t)
        L = moments * w
        return np.sqrt(square) * (L * w)[..., :2].sum(axis=-1) / (L * L)[..., :2].sum(axis=-1)

    nodes, weights = np.polynomial.legendre.leggauss(40)
    angle = [0.0]
    for a, b in itertools.pairwise(times):
        angle.append(angle[-1] + 0.5 * (b - a) * float(weights @ turning(0.5 * (a + b) + 0.5 * (b - a) * nodes)))
    solution = rates(times)
    L = moments * solution / np.sqrt(square)
    attitudes = [
        about(2, psi) @ about(0, np.arctan2(np.hypot(x, y), z)) @ about(2, np.arctan2(x, y))
        for psi, (x, y, z) in zip(angle, L, strict=True)
    ]
    return solution, np.array(attitudes)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("moments", [(0.15, 0.2, 0.3), (0.2, 0.2, 0.3)], ids=["three moments", "symmetric"])
def test_a_free_gyroscope_is_the_closed_form_for_100_seconds(method, moments):
    """Attitude, rates and the path of a point off the centre of mass, to 1e-9 at rtol = 1e-12."""
    rng = np.random.default_rng(4)
    robot, axes = free_body(rng, moments)
    model, times = Model(robot), np.linspace(0.0, 100.0, 101)
    w = np.array([0.5, 0.0, 1.1])
    rates, attitudes = euler_top(np.array(moments), w, times)
    # The closed form's frame in the world, and the body's axes: R_WB = world · attitude · axesᵀ.
    world = random_rotation(rng)
    R = world @ attitudes @ axes.T
    drift, com = np.array([0.2, -0.1, 0.3]), robot.links[-1].inertia.com
    start = np.array([1.0, 2.0, 3.0])
    w_world = R[0] @ axes @ w
    y = assemble(robot).state(np.r_[start, quaternion(R[0])], np.r_[drift - np.cross(w_world, R[0] @ com), axes @ w])
    run = assemble(robot).simulate(y, times, method, rtol=1e-12, atol=1e-13)
    q, v = run.states("q"), run.states("v")
    centre = start + R[0] @ com
    for k, t in enumerate(times):
        attitude, origin = model.body_pose("body", q[k])
        assert angle_between(attitude, R[k]) < 1e-9
        np.testing.assert_allclose(v[k, 3:], axes @ rates[k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(origin, centre + drift * t - R[k] @ com, rtol=0, atol=1e-9)
    # A square root and four products, each rounded.
    assert np.abs(np.linalg.norm(q[:, 3:], axis=1) - 1.0).max() < 1e-15
    # Not only in the samples: an unscaled quaternion would be off by the sum of all errors, some 1e-12.
    assert abs(np.linalg.norm(assemble(robot).part(run.y, "q")[3:]) - 1.0) < 1e-15


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_momentum_and_energy_of_a_free_robot(method):
    """A body with a ball joint, a planar and a revolute one on it, which nothing outside acts on."""
    rng = np.random.default_rng(8)
    robot = without_losses(random_robot_of(rng, ["floating", "ball", "revolute", "planar", "prismatic"]))
    robot = replace(robot, gravity=np.zeros(3))
    model = Model(robot)
    q, v = random_positions(rng, robot), 0.5 * rng.normal(size=model.n)
    b = assemble(robot)
    times = np.linspace(0.0, 2.0, 21)
    run = b.simulate(b.state(q, v), times, method, rtol=1e-11)
    linear, angular = momenta(model, q, v)
    energy = model.kinetic_energy(q, v)
    for q, v in zip(run.states("q"), run.states("v"), strict=True):
        momentum = momenta(model, q, v)
        np.testing.assert_allclose(momentum[0], linear, rtol=0, atol=1e-9 * np.linalg.norm(linear))
        np.testing.assert_allclose(momentum[1], angular, rtol=0, atol=1e-9 * np.linalg.norm(angular))
        assert model.kinetic_energy(q, v) == pytest.approx(energy, rel=1e-9)


@pytest.mark.parametrize("tilt", [0.0, 1e-17, 1e-15, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 1.0, 1.6])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_axes_of_a_plane_are_orthonormal_for_every_normal(side, tilt):
    normal = np.array([0.6 * np.sin(tilt), 0.8 * np.sin(tilt), side * np.cos(tilt)])
    axes = np.stack([link.axis for link in planar(replace(body("plate"), axis=normal))])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), normal, rtol=0, atol=1e-15)


def test_a_start_that_is_no_attitude_is_refused():
    robot = robot_of(floating(body("body")))
    for length in (0.0, 1.0 + 1e-6):
        with raises(ModelError, "body_joint", "1"):
            Model(replace(robot, q0=np.r_[np.zeros(3), length, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize("joint", ["body_joint.wx", "body_joint.wz", "body_joint.roll", "body_joint.turn"])
def test_a_rate_without_a_position_has_no_motor(joint):
    robot = robot_of(rolling(body("body")) if joint.endswith(("roll", "turn")) else floating(body("body")))
    motor = Motor(joint, 0.1, 1.0, 1e-3, 1e-5, 10.0)
    with raises(ModelError, joint):
        Model(replace(robot, motors=(motor,)))


def test_contacts_are_on_bodies_and_not_on_rows():
    robot = robot_of(floating(body("body")))
    assert robot.carriers == {link.name for link in robot.links} - {"body"}
    with raises(ModelError, "'body.position'", "body"):
        robot.attach("body.position", np.zeros(3))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 2.0, np.pi - 1e-9, np.pi])
def test_quaternions_of_all_rotations(angle):
    rng, robot = np.random.default_rng(2), robot_of(ball(body("body")))
    for turn in (np.eye(3), random_rotation(rng), random_rotation(rng)):
        for axis in range(3):
            R = turn @ about(axis, angle) @ turn.T
            q = np.array(scene_quaternion(R))
            np.testing.assert_allclose(Model(robot).body_pose("body", q)[0], R, rtol=0, atol=1e-15 * 4)
            assert q[0] >= 0.0


def test_positions_along_rates_and_rates_across_them():
    """N(q) u of joints behind each other, as of the state's derivative, and N⁺ N = 1; complex rates pass."""
    rng = np.random.default_rng(8)
    for kinds in (("floating", "revolute", "ball"), ("rolling", "ball"), ("wheeled", "prismatic")):
        robot = random_robot_of(rng, kinds)
        q, u = random_positions(rng, robot), rng.normal(size=len(robot.links)) + 1j * rng.normal(size=len(robot.links))
        b = assemble(robot)
        model = b.system.model
        y, out, back = np.r_[0.0, q], np.zeros(1 + robot.nq, dtype=complex), np.zeros(len(u), dtype=complex)
        positions_along(model, y, 1, u, out)
        for part, whole in ((u.real, out.real), (u.imag, out.imag)):
            np.testing.assert_allclose(whole[1:], b.part(b.derivative(b.state(q, part)), "q"), rtol=0, atol=1e-14)
        rates_across(model, y, 1, out, back)
        np.testing.assert_allclose(back, u, rtol=0, atol=1e-14)


# ---- error control


def turned_starts(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(12)
    return [np.eye(3), *(random_rotation(rng) for _ in range(count))]


@pytest.mark.parametrize("make", [ball, floating])
def test_steps_do_not_depend_on_the_attitude_of_the_start(make):
    """The same tumbling seen from turned frames: as many steps, the same errors, the same motion but for the turn."""
    robot = robot_of(make(body("body")))
    model, b, times = Model(robot), assemble(robot), np.linspace(0.0, 5.0, 11)
    w = np.array([0.8, 1.0, -0.4])
    counts, attitudes = [], []
    for R in turned_starts(6):
        q = np.r_[np.zeros(robot.nq - 4), quaternion(R)]
        run = b.simulate(b.state(q, np.r_[np.zeros(model.n - 3), w]), times, "dopri5", rtol=1e-8)
        counts.append((int(run.count[STEPS]), int(run.count[REJECTED])))
        attitudes.append([R.T @ model.body_pose("body", q)[0] for q in run.states("q")])
    assert len(set(counts)) == 1
    # The steps are the same to rounding, so even the errors are.
    for other in attitudes[1:]:
        np.testing.assert_allclose(other, attitudes[0], rtol=0, atol=1e-12)


def test_the_error_of_an_attitude_is_the_angle():
    """A quaternion off by a small rotation and by a factor: the norm is that of the angle's three components."""
    rng, robot = np.random.default_rng(3), robot_of(ball(body("body")))
    b = assemble(robot)
    rtol, atol = 1e-6, 1e-8
    for _ in range(20):
        q = quaternion(random_rotation(rng))
        angle = 1e-5 * rng.normal(size=3)
        turned = q + displacement(q, angle) + 1e-3 * q
        # ``q`` is off by what leads to ``turned``, whatever that adds to its length.
        total, count = position_error(b.system.model, q, q, turned - q, 0, rtol, atol)
        model = Model(robot)
        actual = angle_between(model.body_pose("body", q)[0], model.body_pose("body", turned)[0])
        assert count == 3
        # The 1e-3 in length makes the rotation that much smaller.
        assert np.sqrt(total) * (atol + rtol) == pytest.approx(actual * 1.001, rel=1e-8)


def displacement(q: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """½ q ∘ (0, angle)."""
    w, u = q[0], q[1:]
    return 0.5 * np.r_[-u @ angle, w * angle + np.cross(u, angle)]


def test_the_error_of_a_rolling_base_counts_both_distances():
    robot = robot_of(rolling(body("body")))
    b = assemble(robot)
    y, error = np.array([3.0, -0.5, 10.0]), np.array([1e-3, 2e-3, 5e-3])
    total, count = position_error(b.system.model, y, y, error, 0, 0.1, 1.0)
    assert count == 3
    assert total == pytest.approx(np.sum((error / (1.0 + 0.1 * np.abs(y))) ** 2), rel=1e-14)


# ---- rolling base


def tilted(links: tuple[Link, ...], R: np.ndarray) -> tuple[Link, ...]:
    return (replace(links[0], R_PJ=R), *links[1:])


def test_a_rolling_base_on_a_slope_is_the_closed_form():
    """On a plane inclined by a: V̇ = −g sin a cos ψ (x up the slope), ψ = ω t, so that the body does not slide down.

    Its path is the cycloid of the knife edge, which on average moves across the slope.
    """
    slope, w, times = 0.3, 0.7, np.linspace(0.0, 20.0, 41)
    robot = robot_of(tilted(rolling(body("body")), about(1, -slope)), DOWN)
    b = assemble(robot)
    run = b.simulate(b.state(np.zeros(3), np.array([0.0, w])), times, "dopri5", rtol=1e-11)
    g = 9.81 * np.sin(slope)
    speed = -g / w * np.sin(w * times)
    x = g / (4 * w**2) * (np.cos(2 * w * times) - 1.0)
    y = -g / w * (0.5 * times - np.sin(2 * w * times) / (4.0 * w))
    np.testing.assert_allclose(run.states("v"), np.column_stack([speed, np.full_like(times, w)]), rtol=0, atol=1e-8)
    np.testing.assert_allclose(run.states("q"), np.column_stack([x, y, w * times]), rtol=0, atol=1e-8)


def test_a_rolling_base_with_its_mass_ahead_swings_round():
    """The Chaplygin sleigh: with d the distance of the centre, V̇ = d ω², ω̇ = −m d V ω / (I + m d²)."""
    m, d, inertia = 2.0, 0.3, 0.05
    robot = robot_of(rolling(body("sleigh", inertia=Inertia(m, np.array([d, 0.0, 0.1]), inertia * np.eye(3)))))
    b = assemble(robot)
    for V, w in ((1.0, 0.5), (-0.4, 2.0)):
        rates = b.part(b.derivative(b.state(np.array([1.0, 2.0, 0.7]), np.array([V, w]))), "v")
        np.testing.assert_allclose(rates, [d * w**2, -m * d * V * w / (inertia + m * d**2)], rtol=1e-13)
    run = b.simulate(b.state(np.zeros(3), np.array([0.2, 1.0])), np.linspace(0, 10, 11), "dopri5", rtol=1e-10)
    v = run.states("v")
    energy = 0.5 * (m * v[:, 0] ** 2 + (inertia + m * d**2) * v[:, 1] ** 2)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


# ---- contacts

PLANE = Quadric(np.zeros((3, 3)), np.array([0.0, 0.0, 1.0]), 0.0)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_free_body_on_three_points_slides_on_a_plane(method):
    """A table pushed and spun on a floor with friction: it stays there to 1e-9 m, and the ledger closes."""
    robot = robot_of(floating(body("table", inertia=Inertia(3.0, np.array([0.05, 0.02, 0.4]), 0.1 * np.eye(3)))), DOWN)
    model = Model(robot)
    feet = [np.array([np.cos(a), np.sin(a), 0.0]) for a in (0.3, 2.4, 4.5)]
    contacts = [Contact(f"foot_{k}", "table", foot, PLANE, friction=0.2) for k, foot in enumerate(feet)]
    b = assemble(robot, contacts)
    times = np.linspace(0.0, 0.6, 61)
    start = b.state(np.r_[0.3, 0.1, 0.0, quaternion(about(2, 1.0))], np.array([1.5, 0.4, 0.0, 0.0, 0.0, 2.0]))
    run = b.simulate(start, times, method, rtol=1e-8)
    assert run.extremes[:, DRIFT_MAX].max() < 1e-9
    q, v = run.states("q"), run.states("v")
    for foot in feet:
        heights = [model.point_position("table", foot, state)[2] for state in q]
        assert np.abs(heights).max() < 1e-9
    assert np.linalg.norm(v[-1, :2]) < 0.7
    check_ledger(model, run, 1e-7)


def check_ledger(model: Model, run, tolerance: float) -> None:
    q, v, ledger = run.states("q"), run.states("v"), run.states("ledger")
    stored = np.array([model.kinetic_energy(a, c) + model.potential_energy(a) for a, c in zip(q, v, strict=True)])
    balance = stored - stored[0] + ledger[:, JOINT] + ledger[:, FRICTION] - ledger[:, CONSTRAINT]
    turnover = np.abs(stored - stored[0]).max() + np.abs(ledger).max()
    assert turnover > 0.1
    assert np.abs(balance).max() < tolerance * turnover


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("seed", range(6))
def test_random_robots_stay_on_their_surfaces(method, seed):
    """Ball, floating, planar and rolling joints with two contacts: drift, ledger, unit quaternions."""
    rng = np.random.default_rng(seed)
    kinds = ["floating", "ball", "revolute"] if seed % 2 else ["rolling", "ball", "planar"]
    robot = random_robot_of(rng, kinds)
    model = Model(robot)
    q, v = random_positions(rng, robot), np.zeros(model.n)
    contacts = [replace(c, friction=0.0) for c in random_contacts(rng, robot, q, 2)]
    b = assemble(robot, contacts)
    run = b.simulate(b.state(q, v), np.linspace(0.0, 0.5, 26), method, rtol=1e-7)
    assert run.extremes[:, DRIFT_MAX].max() < 1e-9
    assert np.abs(run.outputs("contact")).max() > 0.0
    check_ledger(model, run, 1e-5)
    for link, k in zip(robot.links, robot.position_index, strict=True):
        if link.kind == "ball_x":
            np.testing.assert_allclose(np.linalg.norm(run.states("q")[:, k : k + 4], axis=1), 1.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    "kinds", [["floating", "ball", "revolute"], ["rolling", "revolute", "ball"], ["planar", "ball"]]
)
def test_a_start_off_the_surface_is_put_on_it(kinds):
    """Projection moves quaternions by rotations and a rolling base along its heading, until the gap is closed."""
    rng = np.random.default_rng(5)
    robot = random_robot_of(rng, kinds, branches=False)
    model = Model(robot)
    q, v = random_positions(rng, robot), rng.normal(size=model.n)
    contact = replace(random_contacts(rng, robot, q, 1)[0], body=robot.links[-1].name, friction=0.0)
    position = model.point_position(contact.body, contact.point, q)
    surface = Quadric(np.zeros((3, 3)), np.array([0.0, 0.6, 0.8]), -float(position @ [0.0, 0.6, 0.8]) - 1e-3)
    b = assemble(robot, [replace(contact, surface=surface)])
    run = b.advance(b.new_run(b.state(q, v), np.array([0.0, 1e-3])), 0)
    settled = b.part(run.y, "q")
    assert run.count[PROJECTIONS] >= 1
    assert abs(surface.gap(model.point_position(contact.body, contact.point, settled))) < 1e-10
    # The nearest point in the kinetic metric, to first order: M dq = −Jᵀ λ, with dq from the poses of the bodies.
    J = (surface.b / np.linalg.norm(surface.b)) @ model.point_jacobian(contact.body, contact.point, q)
    M = model.mass_matrix(q)
    expected = np.linalg.solve(M, J) * (1e-3 / (J @ np.linalg.solve(M, J)))
    moved = np.array([(model.point_position(i, p, settled) - model.point_position(i, p, q)) for i, p in points(robot)])
    first = np.array([model.point_jacobian(i, p, q) @ expected for i, p in points(robot)])
    assert np.abs(moved - first).max() < 0.1 * np.abs(first).max()
    assert b.part(run.y, "v") @ J == pytest.approx(0.0, abs=1e-2)


def points(robot: Robot) -> list[tuple[int, np.ndarray]]:
    return [(i, axis) for i, link in enumerate(robot.links) if link.inertia.mass > 0.0 for axis in AXES]

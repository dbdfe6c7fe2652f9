"""Real contact of bodies that turn: discs, balls, arms and rods against equations of motion derived by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.random_robots import CompiledSystem, assemble
from support.unilateral_checks import events, ledger_residual

from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import OUT_MODE, OUT_VECTOR
from dynsim.integrators.contacts import events as ke
from dynsim.model.description import Contact, Inertia, Link, Load, Quadric, Robot, vector
from dynsim.model.joints.ball import floating

G = 9.81
FLOOR = Quadric(np.zeros((3, 3)), vector(0, 0, 1), 0.0)
X, Y, Z = np.eye(3)
TIGHT = {"rtol": 1e-11, "atol": 1e-13}


def touching(body: str, point: np.ndarray, surface: Quadric = FLOOR, **law: float) -> Contact:
    return Contact(f"{body} {point}", body, point, surface, pulling_friction="signed", **law)


def free_body(inertia: Inertia, contacts: list[Contact], loads: list[Load] | None = None) -> CompiledSystem:
    links = floating(Link("body", "free", None, "floating", Z, inertia))
    return assemble(Robot("body", links, (), ("body", np.zeros(3))), contacts, loads=loads, real=True)


def placed(b: CompiledSystem, position: np.ndarray, velocity: np.ndarray, turning: np.ndarray) -> np.ndarray:
    return b.state(np.concatenate([position, [1.0, 0.0, 0.0, 0.0]]), np.concatenate([velocity, turning]))


@pytest.mark.slow  # a program of its own, which takes half a minute to compile
def test_a_disc_on_three_feet_slides_pivots_and_stops():
    """Weight and overturning moment of friction give the feet's forces; one foot stops first, the others turn about it.

    The path and the spin while all slide, the stop of the first foot, and that of the others: a tripod does not end
    sliding and spinning at once, as a smooth disc does.
    """
    mass, inertia, height, mu = 2.0, 0.011, 0.03, 0.3
    angle = 0.3 + 2.0 * np.pi / 3.0 * np.arange(3)
    feet = 0.1 * np.array([np.cos(angle), np.sin(angle)]).T
    start = np.array([0.0, 0.0, 0.0, 1.0, 0.3, 8.0])

    def geometry(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        c, n = np.cos(s[2]), np.sin(s[2])
        arm = feet @ np.array([[c, n], [-n, c]])
        return arm, s[3:5] + s[5] * np.array([-arm[:, 1], arm[:, 0]]).T

    def solve(s: np.ndarray, pivot: bool) -> np.ndarray:
        """Acceleration (2), spin rate: unknowns n (3), ax, ay, spin rate, and friction of foot 0 if it is the pivot."""
        arm, slip = geometry(s)
        t = slip / np.linalg.norm(slip, axis=1)[:, None]
        K, r = np.zeros((8, 8)), np.zeros(8)
        K[0, :3], r[0] = 1.0, mass * G
        for i in range(3):
            f = np.array([0.0, 0.0]) if pivot and i == 0 else -mu * t[i]
            K[1:3, i] = arm[i, 1] + height * f[1], -height * f[0] - arm[i, 0]
            K[3:5, i], K[5, i] = f, arm[i, 0] * f[1] - arm[i, 1] * f[0]
        K[3, 3], K[4, 4], K[5, 5] = -mass, -mass, -inertia
        if pivot:
            K[1, 7], K[2, 6] = height, -height
            K[3, 6], K[4, 7], K[5, 6], K[5, 7] = 1.0, 1.0, -arm[0, 1], arm[0, 0]
            K[6, 3], K[6, 5], r[6] = 1.0, -arm[0, 1], s[5] ** 2 * arm[0, 0]
            K[7, 4], K[7, 5], r[7] = 1.0, arm[0, 0], s[5] ** 2 * arm[0, 1]
        else:
            K[6, 6], K[7, 7] = 1.0, 1.0
        return np.linalg.solve(K, r)[3:6]

    def sliding(_: float, s: np.ndarray) -> np.ndarray:
        return np.concatenate([s[3:], solve(s, False)])

    def pivoting(_: float, s: np.ndarray) -> np.ndarray:
        return np.concatenate([s[3:], solve(s, True)])

    def held(_: float, s: np.ndarray) -> float:
        return float(np.linalg.norm(geometry(s)[1][0])) - 1e-5

    def still(_: float, s: np.ndarray) -> float:
        return float(s[5]) - 1e-6

    held.terminal = still.terminal = True  # type: ignore[attr-defined]
    first = solve_ivp(sliding, (0.0, 0.35), start, "DOP853", rtol=1e-12, atol=1e-14, dense_output=True)
    last = solve_ivp(sliding, (0.35, 1.0), first["y"][:, -1], "Radau", rtol=1e-9, atol=1e-11, events=held)
    turn = solve_ivp(pivoting, (last.t[-1], 1.0), last["y"][:, -1], "DOP853", rtol=1e-10, atol=1e-12, events=still)

    contacts = [touching("body", np.append(foot, -height), friction=mu) for foot in feet]
    b = free_body(Inertia(mass, np.zeros(3), np.diag([0.006, 0.006, inertia])), contacts)
    y = placed(b, vector(0, 0, height), np.append(start[3:5], 0.0), vector(0, 0, start[5]))
    run = b.simulate(y, np.linspace(0.0, 0.6, 61), "dopri5", **TIGHT)
    early = run.sample_time <= 0.35
    q, v, expected = run.states("q"), run.states("v"), first.sol(run.sample_time[early])
    np.testing.assert_allclose(q[early, :2], expected[:2].T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(2.0 * np.arctan2(q[early, 6], q[early, 3]), expected[2], rtol=0, atol=1e-8)
    np.testing.assert_allclose(v[early][:, [0, 1, 5]], expected[3:].T, rtol=0, atol=1e-8)
    times = [(t, k) for t, k, kind in events(run) if kind == ke.SLIP_STOP]
    assert times[0][1] == 0
    # From 1e-5 m/s on, at some 0.5 m/s².
    assert times[0][0] == pytest.approx(last.t[-1], abs=1e-4)
    np.testing.assert_allclose([t for t, _ in times[1:]], turn.t[-1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(q[-1, :2], turn["y"][:2, -1], rtol=0, atol=1e-6)
    assert np.abs(v[-1]).max() < 1e-8
    assert (run.outputs("contact")[-1, :, OUT_MODE] == ka.STICKING).all()
    assert np.abs(ledger_residual(run)).max() < 1e-9


@pytest.mark.slow  # a program of its own, which takes half a minute to compile
@pytest.mark.parametrize("spin", [np.zeros(3), vector(7.0, -4.0, 3.0)])
def test_a_ball_slides_and_then_rolls(spin):
    """Slip u falls along itself by (7/2) μ g and is gone at 2 |u|/(7 μ g); v by 2 u/7; spin along n stays."""
    mass, radius, mu, v0 = 0.6, 0.05, 0.2, vector(1.0, 0.2, 0.0)
    contact = Contact("ball", "body", np.zeros(3), FLOOR, friction=mu, radius=radius, pulling_friction="signed")
    b = free_body(Inertia.solid_sphere(mass, radius, np.zeros(3)), [contact])
    run = b.simulate(placed(b, radius * Z, v0, spin), np.linspace(0.0, 1.0, 41), "dopri5", **TIGHT)
    slip = v0 + np.cross(spin, -radius * Z)
    stop = 2.0 * np.linalg.norm(slip) / (7.0 * mu * G)
    ((when, _, kind),) = events(run)
    assert kind == ke.SLIP_STOP
    assert when == pytest.approx(stop, abs=1e-10)
    t = np.minimum(run.sample_time, stop)[:, None]
    rolling_time = np.maximum(run.sample_time - stop, 0.0)[:, None]
    brake = -mu * G * slip / np.linalg.norm(slip)
    np.testing.assert_allclose(run.states("v")[:, :3], v0 + brake * t, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        run.states("q")[:, :3] - radius * Z,
        v0 * t + 0.5 * brake * t**2 + (v0 - 2.0 / 7.0 * slip) * rolling_time,
        atol=1e-8,
    )
    if not spin.any():
        np.testing.assert_allclose(run.states("v")[-1, :3], 5.0 / 7.0 * v0, rtol=1e-8, atol=1e-12)
    # Energy: what the slip had, half of m/(1 + 5/2) u².
    assert run.states("ledger")[-1, 5] == pytest.approx(mass / 7.0 * float(slip @ slip), rel=1e-8)
    assert np.abs(ledger_residual(run)).max() < 1e-9


@pytest.mark.slow  # a program of its own, which takes half a minute to compile
@pytest.mark.parametrize(("mu", "fall"), [(0.05, 2.0), (0.4, 2.0)])
def test_an_oblique_bounce_of_a_ball(mu, fall):
    """Newton's restitution along n; of slip u the impulse takes 2 u/7 of the speed, or μ (1 + e) v_n if less."""
    mass, radius, e, v0, spin = 0.6, 0.05, 0.7, vector(1.1, -0.4, -fall), vector(3.0, 5.0, 2.0)
    law = {"friction": mu, "restitution": e}
    contact = Contact("ball", "body", np.zeros(3), FLOOR, radius=radius, pulling_friction="signed", **law)
    b = free_body(Inertia.solid_sphere(mass, radius, np.zeros(3)), [contact])
    run = b.simulate(placed(b, radius * Z, v0, spin), np.array([0.0, 0.01]), "dopri5", **TIGHT)
    slip = v0 + np.cross(spin, -radius * Z)
    slip[2] = 0.0
    size = np.linalg.norm(slip)
    change = -slip / size * min(2.0 / 7.0 * size, mu * (1.0 + e) * fall)
    after = v0 + change + (1.0 + e) * fall * Z
    turned = spin + np.cross(-radius * Z, change) / (0.4 * radius**2)
    # The run's first sample is the state after the impact.
    np.testing.assert_allclose(run.states("v")[0], np.concatenate([after, turned]), rtol=1e-10)
    lost = 0.5 * mass * (v0 @ v0 - after @ after) + 0.2 * mass * radius**2 * (spin @ spin - turned @ turned)
    assert run.states("loss")[0, 0] == pytest.approx(lost, rel=1e-10)


def test_a_point_that_only_just_reaches_its_surface_is_seen():
    """Gravity upwards: the gap is a parabola with its least value in the middle of a long step."""
    robot = Robot("bead", (Link("z", "lift", None, "prismatic", Z, Inertia(1.0)),), (), ("z", np.zeros(3)), G * Z)
    for depth in (1e-7, -1e-7):
        b = assemble(robot, [touching("z", np.zeros(3))], real=True)
        speed = np.sqrt(2.0 * G * (1.0 + depth))
        run = b.simulate(b.state(np.ones(1), np.array([-speed])), np.array([0.0, 2.0]), "dopri5", rtol=1e-10)
        happened = events(run)
        if depth < 0.0:
            assert not happened
            continue
        first = (speed - np.sqrt(2.0 * G * depth)) / G
        # Landing 2e-10 m deep is later by that over the speed.
        assert happened[0][0] == pytest.approx(first, abs=3e-10 / np.sqrt(2.0 * G * depth))
        assert run.states("loss")[-1, 0] == pytest.approx(G * depth, rel=1e-2)


def bowl(radius: float) -> Quadric:
    """A cylinder along y about (0, 0, radius), free inside."""
    Q = -np.diag([1.0, 0.0, 1.0]) / radius
    return Quadric(Q, vector(0, 0, 1), 0.0)


@pytest.mark.parametrize(
    "law",
    [
        {"friction": 0.05},
        {"friction": 0.15, "static_friction": 0.25},
        {"friction": 0.1, "static_friction": 0.3, "stribeck": 0.4},
        {"friction": 0.1, "viscous_friction": 0.2},
        {"friction": 0.1, "static_friction": 0.2, "stribeck": 0.3, "viscous_friction": 0.1},
    ],
)
def test_a_bead_in_a_bowl_reverses_or_sticks(law):
    """Reversals of slip pass where tan φ > μ_s, and the first one below sticks: times, places, and the law of friction.

    R φ̈ = −g sin φ − μ(R |φ̇|) sgn(φ̇) (g cos φ + R φ̇²).
    """
    radius, mass, start = 0.4, 0.3, 1.1
    static, stribeck = law.get("static_friction", law["friction"]), law.get("stribeck", 0.0)
    links = (
        Link("x", "jx", None, "prismatic", X, Inertia(0.0)),
        Link("z", "jz", "x", "prismatic", Z, Inertia(mass)),
    )
    b = assemble(
        Robot("bead", links, (), ("z", np.zeros(3))), [touching("z", np.zeros(3), bowl(radius), **law)], real=True
    )

    def coefficient(speed: float) -> float:
        mu = law["friction"] + law.get("viscous_friction", 0.0) * speed
        return mu + (static - law["friction"]) * np.exp(-((speed / stribeck) ** 2)) if stribeck else mu

    t, phi, sign, reversals, path = 0.0, start, -1.0, [], []
    while np.tan(abs(phi)) > static:

        def rate(_: float, s: np.ndarray, sign: float = sign) -> list[float]:
            normal = G * np.cos(s[0]) + radius * s[1] ** 2
            # Beyond the reversal friction goes on as it was, so that the root is regular.
            mu = coefficient(abs(radius * s[1]))
            return [s[1], (-G * np.sin(s[0]) - sign * mu * normal) / radius]

        def turn(_: float, s: np.ndarray) -> float:
            return float(s[1])

        turn.terminal, turn.direction = True, -sign  # type: ignore[attr-defined]
        solution = solve_ivp(
            rate, (t, t + 10.0), [phi, 0.0], "DOP853", rtol=1e-13, atol=1e-15, events=turn, dense_output=True
        )
        path.append(solution.sol)
        t, phi, sign = solution.t[-1], solution["y"][0, -1], -sign
        reversals.append(t)
    y = b.state(radius * vector(np.sin(start), 1.0 - np.cos(start), 0.0)[:2], np.zeros(2))
    run = b.simulate(y, np.linspace(0.0, t + 0.5, 201), "dopri5", **TIGHT)
    *_, (when, _, kind) = events(run)
    assert kind == ke.SLIP_STOP
    assert when == pytest.approx(t, abs=2e-9)
    angle = np.arctan2(run.states("q")[:, 0], radius - run.states("q")[:, 1])
    index = np.minimum(np.searchsorted(reversals, run.sample_time), len(path) - 1)
    expected = [path[k](min(s, t))[0] for k, s in zip(index, run.sample_time, strict=True)]
    np.testing.assert_allclose(angle, expected, rtol=0, atol=1e-8)
    assert len(path) >= 1
    assert run.outputs("contact")[-1, 0, OUT_MODE] == ka.STICKING
    assert np.abs(ledger_residual(run)).max() < 1e-9


def pull(rate: float, along: np.ndarray) -> Load:
    """A force on the body's origin that grows with time."""
    coefficients = np.zeros((1, 6, 4))
    coefficients[0, :3, 1] = rate * along
    return Load("pull", "body", np.zeros(3), False, np.array([0.0, 10.0]), coefficients, True)


@pytest.mark.slow  # a program of its own, which takes half a minute to compile
@pytest.mark.parametrize("direction", [0.0, 0.4, 2.5])
def test_four_feet_hold_as_long_as_any_split_of_their_forces_does(direction):
    """A table pulled at its centre of mass: least norm would let it go early; all feet go at F = μ m g, together."""
    mass, mu, rate, height = 5.0, 0.4, 10.0, 0.1
    feet = [vector(x, y, -height) for x in (-0.3, 0.3) for y in (-0.2, 0.2)]
    along = vector(np.cos(direction), np.sin(direction), 0.0)
    contacts = [touching("body", foot, friction=mu) for foot in feet]
    b = free_body(Inertia(mass, np.zeros(3), np.diag([0.1, 0.1, 0.15])), contacts, [pull(rate, along)])
    onset = mu * mass * G / rate
    run = b.simulate(
        placed(b, height * Z, np.zeros(3), np.zeros(3)), np.linspace(0.0, 1.2 * onset, 61), "dopri5", **TIGHT
    )
    happened = events(run)
    # Rounding may let one foot go, and be caught by the others, before all do at that instant.
    np.testing.assert_allclose([t for t, _, _ in happened], onset, rtol=0, atol=1e-10)
    assert {k: kind for _, k, kind in happened} == dict.fromkeys(range(4), ke.SLIP_START)
    touch = run.outputs("contact")
    before = run.sample_time < onset
    force = touch[before][:, :, OUT_VECTOR : OUT_VECTOR + 3]
    np.testing.assert_allclose(
        force.sum(axis=1), mass * G * Z - rate * run.sample_time[before, None] * along, rtol=0, atol=1e-9
    )
    assert (np.hypot(force[:, :, 0], force[:, :, 1]) <= mu * force[:, :, 2] * (1.0 + 1e-9) + 1e-9).all()
    assert np.abs(run.states("q")[before, :3] - height * Z).max() < 1e-10
    t = np.maximum(run.sample_time - onset, 0.0)[:, None]
    np.testing.assert_allclose(run.states("q")[:, :3] - height * Z, rate / mass * t**3 / 6.0 * along, atol=1e-7)

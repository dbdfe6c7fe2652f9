"""Real contact in closed form: blocks on slopes, bouncing balls, discs, rods, joint stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.messages import lines_with, raises
from support.random_robots import CompiledSystem, assemble

from dynsim import load_scenario, simulate
from dynsim.compile.tables import SETTLE_SPEED
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import FRICTION, OUT_FORCE, OUT_GAP, OUT_MODE
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.integrators.contacts.events import consistent
from dynsim.model.description import Contact, Inertia, Link, Load, Quadric, Robot, vector
from dynsim.model.surfaces import Box

G = 9.81
ORIGIN = np.zeros(3)


def plane(normal: np.ndarray, point: np.ndarray = ORIGIN) -> Quadric:
    return Quadric(np.zeros((3, 3)), normal, -float(normal @ point))


def block(mass: float) -> Robot:
    """A body that translates freely and does not rotate."""
    links = []
    for k, name in enumerate("xyz"):
        inertia = Inertia(mass if name == "z" else 0.0)
        links.append(Link(name, f"joint_{name}", "wxyz"[k] if k else None, "prismatic", np.eye(3)[k], inertia))
    return Robot("block", tuple(links), (), ("z", np.zeros(3)))


def happened(run: ki.Run) -> list[tuple[float, int, int]]:
    """Time, contact and kind of the logged events of contacts."""
    events = []
    for t, code in zip(run.log_time, run.log_event[: run.count[ki.LOGGED]], strict=False):
        k, kind = divmod(int(code) - ki.CONTACT_LOG, ke.LOG_KINDS)
        events.append((float(t), k, kind))
    return events


def residual(b: CompiledSystem, run: ki.Run) -> float:
    """What the ledger of a passive system without losses of joints does not explain [J]."""
    stored = run.outputs("energy").sum(axis=1)
    taken = run.states("ledger")[:, FRICTION] + run.states("loss").sum(axis=1)
    return float(np.abs(stored - stored[0] + taken).max())


def sloped(alpha: float, mu: float, **law: float) -> CompiledSystem:
    normal = np.array([np.sin(alpha), 0.0, np.cos(alpha)])
    return assemble(
        block(3.0),
        [
            Contact(
                "foot",
                "z",
                vector(0.1, -0.2, 0.0),
                plane(normal, vector(0.1, -0.2, 0.0)),
                friction=mu,
                pulling_friction="signed",
                **law,
            )
        ],
        real=True,
    )


@pytest.mark.parametrize("method", ["dopri5", pytest.param("radau5", marks=pytest.mark.slow)])
@pytest.mark.parametrize("mu", [0.3, 0.5])
def test_a_block_on_a_slope_rests_or_slides(method, mu):
    alpha = np.arctan(0.4)
    b = sloped(alpha, mu)
    run = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.linspace(0.0, 2.0, 5), method)
    a = max(0.0, G * (np.sin(alpha) - mu * np.cos(alpha)))
    downhill = np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    distance = 0.5 * a * run.sample_time[:, None] ** 2 * downhill
    np.testing.assert_allclose(run.states("q"), distance, rtol=0, atol=1e-9)
    touch = run.outputs("contact")[:, 0]
    np.testing.assert_allclose(touch[:, OUT_FORCE], 3.0 * G * np.cos(alpha), rtol=1e-9)
    assert (touch[:, OUT_MODE] == (ka.SLIDING if mu < 0.4 else ka.STICKING)).all()
    assert np.abs(touch[:, OUT_GAP]).max() <= 1e-9
    assert residual(b, run) < 1e-8


@pytest.mark.parametrize("method", ["dopri5", pytest.param("radau5", marks=pytest.mark.slow)])
@pytest.mark.parametrize("height", [0.0, 0.3])
def test_a_block_without_friction_that_never_slips_stays(method, height):
    """It slides, by mode, in no direction, at rest from the start or after it has fallen straight down."""
    b = sloped(0.0, 0.0)
    run = b.simulate(b.state(vector(0.0, 0.0, height), np.zeros(3)), np.linspace(0.0, 1.0, 5), method)
    touch, q = run.outputs("contact")[:, 0], run.states("q")
    down = run.sample_time > np.sqrt(2.0 * height / G)
    np.testing.assert_allclose(q[down], 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(touch[down, OUT_FORCE], 3.0 * G, rtol=1e-9)
    assert (touch[down, OUT_MODE] == ka.SLIDING).all()
    assert residual(b, run) < 1e-8


def test_a_bouncing_ball():
    """Impact times of a ball with restitution e, and the time at which its bounces have come to an end."""
    e, height = 0.6, 0.5
    b = assemble(
        block(0.7),
        [Contact("foot", "z", np.zeros(3), plane(vector(0, 0, 1)), restitution=e, pulling_friction="signed")],
        real=True,
    )
    y = b.state(vector(0.0, 0.0, height), np.zeros(3))
    first = np.sqrt(2.0 * height / G)
    run = b.simulate(y, np.linspace(0.0, 3.0, 31), "dopri5")
    events = happened(run)
    times = np.array([t for t, _, _ in events])
    flights = 2.0 * first * e ** np.arange(1, 11)
    np.testing.assert_allclose(times[:10], first + np.concatenate([[0.0], np.cumsum(flights)[:9]]), rtol=0, atol=1e-8)
    # Slower bounces are let settle.
    end = first * (1.0 + e) / (1.0 - e)
    assert events[-1][2] == ke.LANDING
    assert times[-1] == pytest.approx(end, abs=2.0 * SETTLE_SPEED / G / (1.0 - e))
    assert all(kind == ke.BOUNCE for _, _, kind in events[:-1])
    assert np.abs(run.states("q")[-1]).max() <= 1e-9
    assert run.states("loss")[-1, 0] == pytest.approx(0.7 * G * height, rel=1e-9)
    assert residual(b, run) < 1e-8


@pytest.mark.parametrize("e", [0.2, 0.5])
def test_two_feet_that_bounce_at_one_instant(e):
    """A block on two feet, dropped: every impact at the same times as a ball's, one for each foot, to their end."""
    height, down = 0.3, plane(vector(0, 0, 1))
    feet = [
        Contact(f"foot {x}", "z", vector(x, 0, 0), down, restitution=e, pulling_friction="signed") for x in (-0.2, 0.2)
    ]
    b = assemble(block(0.5), feet, real=True)
    run = b.simulate(b.state(vector(0, 0, height), np.zeros(3)), np.array([0.0, 2.0]), "dopri5")
    first = np.sqrt(2.0 * height / G)
    times = np.array([t for t, _, kind in happened(run) if kind == ke.BOUNCE])
    assert len(times) % 2 == 0
    flights = 2.0 * first * e ** np.arange(1, len(times) // 2)
    expected = first + np.concatenate([[0.0], np.cumsum(flights)])
    np.testing.assert_allclose(times, np.repeat(expected, 2), rtol=0, atol=1e-8)
    assert [kind for _, _, kind in happened(run)][-2:] == [ke.LANDING] * 2
    assert run.states("loss")[-1, 0] == pytest.approx(0.5 * G * height, rel=1e-9)


@pytest.mark.parametrize("method", ["radau5", pytest.param("dopri5", marks=pytest.mark.long)])
@pytest.mark.parametrize("thickness", [0.2, 0.005])
def test_nothing_falls_through_a_body_within_one_step(method, thickness):
    """Falling freely steps are as long as the run; a plate's other side is as far from a point as its own."""
    plate = Box(vector(0, 0, -0.5 * thickness), np.eye(3), np.array([1.0, 1.0, thickness]), 1e-3)
    b = assemble(block(1.0), [Contact("foot", "z", np.zeros(3), plate, pulling_friction="signed")], real=True)
    run = b.simulate(b.state(vector(0.01, 0.0, 0.3), np.zeros(3)), np.array([0.0, 1.5]), method)
    ((time, _, kind), *_) = happened(run)
    assert kind == ke.LANDING
    assert time == pytest.approx(np.sqrt(0.6 / G), abs=1e-9)
    assert abs(run.states("q")[-1, 2]) <= 1e-9


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_without_kinetic_friction_slip_begins_along_its_acceleration(method: str) -> None:
    """Static friction gives way to none at all. It was a division by the friction force."""
    none, little = (
        simulate(load_scenario("brace_on_cylinder", None, {"integrator.method": method, "contacts.friction": friction}))
        for friction in (0.0, 1e-9)
    )
    assert np.isfinite(none["q"]).all()
    assert none.time[-1] == little.time[-1] == 4.0
    # A force of 1e-9 of 8 N, upon joints that motors hold by 300 V/rad; times of events add their own.
    assert none["q"] == pytest.approx(little["q"], abs=2e-7)
    assert none.summary["contacts"][0]["slip_starts"] == little.summary["contacts"][0]["slip_starts"] > 0


def test_a_block_thrown_up_a_slope_stops_and_stays_or_comes_back():
    """Way and time to the end of slip; below μ it sticks there, above it slides back."""
    alpha, speed = 0.4, 1.3
    uphill = np.array([-np.cos(alpha), 0.0, np.sin(alpha)])
    for mu in (0.3, 0.6):
        b = sloped(alpha, mu)
        run = b.simulate(b.state(np.zeros(3), speed * uphill), np.linspace(0.0, 1.0, 11), "dopri5")
        up, down = G * (np.sin(alpha) + mu * np.cos(alpha)), G * (np.sin(alpha) - mu * np.cos(alpha))
        stop, distance = speed / up, 0.5 * speed**2 / up
        t = run.sample_time
        back = 0.5 * max(down, 0.0) * np.maximum(t - stop, 0.0) ** 2
        along = np.where(t < stop, speed * t - 0.5 * up * t**2, distance - back)
        np.testing.assert_allclose(run.states("q"), along[:, None] * uphill, rtol=0, atol=1e-9)
        if mu > np.tan(alpha):
            ((when, _, kind),) = happened(run)
            assert kind == ke.SLIP_STOP
            assert when == pytest.approx(stop, abs=1e-10)
        assert residual(b, run) < 1e-9


def test_static_friction_above_kinetic():
    """A slope between the two holds a block at rest, and lets one that moves go on."""
    alpha = np.arctan(0.4)
    downhill = np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    b = sloped(alpha, 0.3, static_friction=0.45)
    rests = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.linspace(0.0, 1.0, 3), "dopri5")
    assert np.abs(rests.states("q")).max() <= 1e-12
    b = sloped(alpha, 0.3, static_friction=0.45)
    moves = b.simulate(b.state(np.zeros(3), 1e-3 * downhill), np.linspace(0.0, 1.0, 3), "dopri5")
    a = G * (np.sin(alpha) - 0.3 * np.cos(alpha))
    t = moves.sample_time[:, None]
    np.testing.assert_allclose(moves.states("q"), (1e-3 * t + 0.5 * a * t**2) * downhill, rtol=0, atol=1e-9)


def test_slip_starts_where_a_pull_reaches_static_friction():
    """A pull that grows with time, across a slope: onset at |m g∥ + F| = μ_s N, in the direction of that sum."""
    mass, alpha, mu, rate = 3.0, 0.2, 0.5, 4.0
    normal = np.array([np.sin(alpha), 0.0, np.cos(alpha)])
    pull = Load(
        "pull",
        "z",
        np.zeros(3),
        False,
        np.array([0.0, 10.0]),
        np.array([[[0.0, 0.0, 0, 0], [0.0, rate, 0, 0], [0.0, 0.0, 0, 0]] + [[0.0] * 4] * 3]),
        True,
    )
    contact = Contact("foot", "z", np.zeros(3), plane(normal), friction=mu, pulling_friction="signed")
    b = assemble(block(mass), [contact], loads=[pull], real=True)
    run = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.linspace(0.0, 5.0, 501), "dopri5")
    weight, friction_limit = mass * G * np.sin(alpha), mu * mass * G * np.cos(alpha)
    onset = np.sqrt(friction_limit**2 - weight**2) / rate
    (when, _, kind), *later = happened(run)
    assert kind == ke.SLIP_START
    assert not later
    assert when == pytest.approx(onset, abs=1e-10)
    downhill = np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    sum_ = weight * downhill + rate * onset * np.array([0.0, 1.0, 0.0])
    first = np.flatnonzero(run.sample_time > onset)[0] + 1
    moved = run.states("q")[first] / np.linalg.norm(run.states("q")[first])
    assert moved @ sum_ / np.linalg.norm(sum_) > 1.0 - 1e-3
    # Of some 30 J of work.
    assert residual_with_load(b, run) < 1e-6


def residual_with_load(b: CompiledSystem, run: ki.Run) -> float:
    stored = run.outputs("energy").sum(axis=1)
    taken = run.states("ledger")[:, FRICTION] + run.states("loss").sum(axis=1)
    return float(np.abs(stored - stored[0] + taken - run.states("load").sum(axis=1)).max())


@pytest.mark.parametrize(
    ("law", "coefficient"),
    [
        ({}, 0.2),
        ({"viscous_friction": 0.4}, 0.2 + 0.4 * 1.5),
        ({"static_friction": 0.5, "stribeck": 1.0}, 0.2 + 0.3 * np.exp(-(1.5**2))),
        ({"static_friction": 0.5}, 0.2),
    ],
)
def test_friction_of_an_impact_is_that_of_the_slip_before_it(law, coefficient):
    mass, speed, fall = 2.0, 1.5, 0.4
    contact = Contact("foot", "z", np.zeros(3), plane(vector(0, 0, 1)), friction=0.2, pulling_friction="signed", **law)
    b = assemble(block(mass), [contact], real=True)
    start, end = np.array([0.0, 0.0, 1e-7]), 2e-6
    run = b.simulate(b.state(start, np.array([speed, 0.0, -fall])), np.array([0.0, end]), "dopri5")
    lost = speed - run.states("v")[-1, 0]
    assert lost == pytest.approx(coefficient * fall, abs=coefficient * 2.0 * G * end)


def test_a_carriage_that_slides_askew_stops():
    """After v/(μ g), v²/(2 μ g) along its straight way."""
    mass, mu, speed = 2.0, 0.3, 1.0
    contact = Contact("foot", "z", np.zeros(3), plane(vector(0, 0, 1)), friction=mu, pulling_friction="signed")
    b = assemble(block(mass), [contact], real=True)
    v = speed * np.array([np.cos(0.3), np.sin(0.3), 0.0])
    run = b.simulate(b.state(np.zeros(3), v), np.linspace(0.0, 1.0, 11), "dopri5")
    ((when, _, kind),) = happened(run)
    assert kind == ke.SLIP_STOP
    assert when == pytest.approx(speed / (mu * G), abs=1e-10)
    np.testing.assert_allclose(run.states("q")[-1], v / speed * speed**2 / (2 * mu * G), rtol=0, atol=1e-9)


def pendulum(limit: float = np.inf, start: float = 1.0) -> Robot:
    """A rod of 0.8 kg and 0.5 m that hangs from a hinge about y; q = 0 points up."""
    rod = Inertia(0.8, vector(0, 0, 0.25), np.diag([0.8 * 0.25 / 12, 0.8 * 0.25 / 12, 0.0]))
    link = Link("rod", "hinge", None, "revolute", vector(0, 1, 0), rod, upper=limit)
    return Robot("pendulum", (link,), (), ("rod", vector(0, 0, 0.5)), q0=np.array([start]))


def test_a_joint_stop_takes_the_momentum_of_a_falling_rod():
    """It falls onto its stop at 90°: the kinetic energy is lost, and the stop carries the moment of the weight."""
    b = assemble(pendulum(limit=0.5 * np.pi), [], real=True)
    run = b.simulate(b.state(np.array([0.4]), np.zeros(1)), np.linspace(0.0, 2.0, 21), "dopri5", rtol=1e-10)
    fallen = 0.8 * G * 0.25 * np.cos(0.4)
    assert run.states("loss")[-1, 1] == pytest.approx(fallen, rel=1e-8)
    assert abs(run.states("loss")[-1, 0]) < 1e-15
    np.testing.assert_allclose(run.states("q")[-1], 0.5 * np.pi, rtol=0, atol=1e-9)
    assert run.outputs("stop")[-1, 0] == pytest.approx(0.8 * G * 0.25, rel=1e-9)
    (code,) = run.log_event[: run.count[ki.LOGGED]]
    assert code == ki.STOP_LOG + ke.STOP_HIT
    assert residual(b, run) < 1e-8


def test_a_joint_that_leaves_from_a_little_beyond_its_stop_has_not_hit_it():
    """Two others hit their stops meanwhile; the first one comes back: after 2 v/a with speed v and acceleration a."""
    rod = pendulum(limit=0.5 * np.pi).links[0]
    others = (replace(rod, name=f"rod_{k}", joint=f"hinge_{k}") for k in (1, 2))
    b = assemble(replace(pendulum(), links=(rod, *others), q0=np.full(3, 0.5 * np.pi)), [], real=True)
    beyond, speed, pull = 1.25 * ku.DEPTH, 2e-4, 0.8 * G * 0.25 / (0.8 * 0.25 / 3.0)
    y = b.state(0.5 * np.pi + np.array([beyond, -1e-9, -1.8e-9]), np.array([-speed, 1e-2, 1e-2]))
    run = b.simulate(y, np.linspace(0.0, 1e-3, 3), "dopri5")
    assert run.count[ki.STATUS] == ki.FINISHED
    codes = run.log_event[: run.count[ki.LOGGED]] - ki.STOP_LOG
    assert codes.tolist() == [ke.LOG_KINDS * k + ke.STOP_HIT for k in (1, 2, 0)]
    # From and to a little beyond the stop: DEPTH / v is 7 % of that time.
    assert run.log_time[2] == pytest.approx(2.0 * speed / pull, rel=0.1)
    np.testing.assert_allclose(run.states("q")[-1], 0.5 * np.pi, rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", ["dopri5", pytest.param("radau5", marks=pytest.mark.slow)])
def test_two_masses_that_kick_each_other_off_their_stops_come_to_rest(method):
    """Mass 1 rests on its stop; mass 2, pushed up from it, hits the stop between them, and both fly, with r v for v.

    Both land, mass 1 stops, and mass 2 leaves the other stop at r v, r = m₂/(m₁ + m₂). So each turn takes 2 r v (1/A +
    1/a) with the acceleration a of mass 2 alone and A of both: a geometric series.
    """
    m1, m2, mass, gap = 0.1, 1.5, 1.6, 1e-4
    push = 0.5 * (m2 + mass) * G
    a, A, r = push / m2 - G, G - push / mass, m2 / mass
    links = tuple(
        Link(name, f"slide_{name}", parent, "prismatic", np.array([0.0, 0.0, 1.0]), Inertia(m), **limits)
        for name, parent, m, limits in (("low", None, m1, {"lower": 0.0}), ("high", "low", m2, {"upper": 0.0}))
    )
    force = np.zeros((1, 6, 4))
    force[0, 2, 0] = push
    load = Load("push", "high", np.zeros(3), False, np.array([0.0, 1.0]), force, True)
    b = assemble(Robot("masses", links, (), ("high", np.zeros(3))), [], loads=[load], real=True)
    speed = np.sqrt(2.0 * a * gap)
    end = speed / a + 2.0 * speed * r / (1.0 - r) * (1.0 / A + 1.0 / a)
    run = b.simulate(b.state(np.array([0.0, -gap]), np.zeros(2)), np.array([0.0, end, end + 0.01]), method)
    assert run.count[ki.STATUS] == ki.FINISHED
    turns = np.log(SETTLE_SPEED / speed) / np.log(r)
    logged = int(run.count[ki.LOGGED])
    assert 4.0 * (turns - 3.0) < logged < 4.0 * (turns + 3.0)
    assert run.log_time[logged - 1] == pytest.approx(end, abs=4.0 * SETTLE_SPEED * r / (1.0 - r) * (1.0 / A + 1.0 / a))
    np.testing.assert_allclose(run.states("q")[-1], 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.abs(run.outputs("stop")[-1]), [mass * G - push, push - m2 * G], rtol=1e-6)
    # Each landing is lifted by what it is too deep, ku.DEPTH.
    assert residual_with_load(b, run) < 2.0 * logged * ku.DEPTH * mass * G


def test_a_closed_stop_that_pulls_disagrees_with_its_mode():
    """Each of two stops alone, and none that is open."""
    link = replace(pendulum().links[0], lower=-1.0, upper=1.0)
    b = assemble(replace(pendulum(), links=(link,)), [], real=True)
    table, stop = b.system.unilateral.stop_table, b.system.unilateral.stop
    assert len(table) == 2
    table[:, ku.STOP_CLOSED], stop[:, ku.STOP_FORCE] = 1, 2.0
    assert consistent(b.system, b.ws)
    for k in range(2):
        stop[k, ku.STOP_FORCE] = -2.0
        assert not consistent(b.system, b.ws)
        table[k, ku.STOP_CLOSED] = 0
        assert consistent(b.system, b.ws)
        table[k, ku.STOP_CLOSED], stop[k, ku.STOP_FORCE] = 1, 2.0


def rod(mu: float, phi: float, **law: float) -> tuple[CompiledSystem, float, float]:
    """A thin rod in the plane y = 0, on a point at its lower end; φ is the angle of the rod from the vertical."""
    mass, half = 1.0, 0.5
    links = (
        Link("cart", "x", None, "prismatic", vector(1, 0, 0), Inertia(0.0)),
        Link("lift", "z", "cart", "prismatic", vector(0, 0, 1), Inertia(0.0)),
        Link(
            "rod",
            "turn",
            "lift",
            "revolute",
            vector(0, 1, 0),
            Inertia(mass, np.zeros(3), np.diag([mass * half**2 / 3, mass * half**2 / 3, 0.0])),
        ),
    )
    robot = Robot("rod", links, (), ("rod", vector(0, 0, -half)), q0=np.array([0.0, half * np.cos(phi), phi]))
    contact = Contact(
        "foot", "rod", vector(0, 0, -half), plane(vector(0, 0, 1)), friction=mu, pulling_friction="signed", **law
    )
    return assemble(robot, [contact], real=True), mass, half


def test_a_leaning_rod_sticks_until_its_foot_slips():
    """A rod that tips about its foot: friction and normal force by its angle, slip where |f_t| = μ_s f_n.

    With ω² = (3 g/2 l) (cos φ0 − cos φ) (length 2 l... of the pivot at its end) the ratio of the forces is known in
    closed form; its root is the onset.
    """
    from scipy.optimize import brentq

    mu, start = 0.3, 0.2
    b, mass, half = rod(mu, start)
    run = b.simulate(b.state(b.robot.initial, np.zeros(3)), np.linspace(0.0, 1.5, 301), "dopri5", rtol=1e-9)

    def forces(phi: float) -> tuple[float, float]:
        square, acc = 1.5 * G / half * (np.cos(start) - np.cos(phi)), 0.75 * G / half * np.sin(phi)
        f_t = mass * half * (acc * np.cos(phi) - square * np.sin(phi))
        f_n = mass * (G - half * (acc * np.sin(phi) + square * np.cos(phi)))
        return f_t, f_n

    onset = brentq(lambda phi: abs(forces(phi)[0]) - mu * forces(phi)[1], start, 1.2)
    (when, _, kind), *_ = happened(run)
    assert kind == ke.SLIP_START
    before = run.sample_time < when
    f_t, f_n = np.array([forces(phi) for phi in run.states("q")[before, 2]]).T
    touch = run.outputs("contact")[before, 0]
    np.testing.assert_allclose(touch[:, OUT_FORCE], f_n, rtol=1e-7)
    np.testing.assert_allclose(touch[:, 1], f_t, rtol=1e-6, atol=1e-7)
    # The angle at the onset: between the samples around it.
    after = int(np.flatnonzero(~before)[0])
    assert run.states("q")[after - 1, 2] <= onset <= run.states("q")[after, 2]
    assert residual(b, run) < 1e-7


def stopped_arm(tmp_path, *lines: str):
    from dynsim import load_scenario

    path = tmp_path / "arm.yaml"
    path.write_text(
        "duration_s: 1.5\nplant:\n  type: serial_arm\n  chain:\n    - {axis: y, mass_kg: 0.8, length_m: 0.5, "
        + ", ".join(lines)
        + "}\ncontacts: {law: unilateral}\n"
    )
    return load_scenario(path)


def test_joint_stops_of_a_scenario(tmp_path):
    """A link falls onto its stop: force, loss, event and times are in record and summary."""
    from dynsim import simulate

    record = simulate(stopped_arm(tmp_path, "limit_deg: [-30, 90]", "initial_deg: 20"))
    (event,) = record.events
    assert (event.kind, event.name) == ("stop_hit", "joint_1")
    np.testing.assert_allclose(record["q"][-1], 0.5 * np.pi, rtol=0, atol=1e-9)
    assert record["stop_force"][-1, 0] == pytest.approx(-0.8 * G * 0.25, rel=1e-8)
    fallen = 0.8 * G * 0.25 * np.cos(np.deg2rad(20.0))
    assert record.summary["stop_loss_J"] == pytest.approx(fallen, rel=1e-5)
    (stop,) = record.summary["joint_stops"]
    assert stop["hits"] == 1
    assert stop["closed_fraction"] == pytest.approx(1.0 - event.time / 1.5, abs=1e-9)
    assert record.summary["energy_residual_relative"] < 1e-6


@pytest.mark.parametrize(
    ("lines", "names"),
    [
        (
            ("limit_deg: [0, 90]", "initial_deg: -20"),
            ["arm.yaml:2", "joint_1", "-20°", "-0.3491 rad", "0°"],
        ),
        (("limit_deg: [90, 0]",), ["arm.yaml:5", "plant.chain.0.limit_deg", "90", "0"]),
        (("limit_m: [0, 1]",), ["arm.yaml:5", "plant.chain.0.limit_m", "limit_deg"]),
    ],
)
def test_stops_that_cannot_be(tmp_path, lines, names):
    from dynsim import simulate
    from dynsim.errors import DynsimError

    with raises(DynsimError, *names):
        simulate(stopped_arm(tmp_path, *lines))


def test_what_only_bounces_has_touched():
    """No warning that a point never touches its surface where each of its landings is a bounce."""
    record = simulate(load_scenario("bouncing_link", overrides={"duration_s": 0.22}))
    assert [event.kind for event in record.events] == ["bounce"]
    assert not lines_with(record.summary["warnings"], phrase="never")

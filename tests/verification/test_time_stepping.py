"""Time stepping: closed forms of sliding, sticking, landing, bouncing and friction laws; order; runs in pieces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from support.messages import lines_with
from support.random_robots import CompiledSystem, assemble, random_robot
from support.stepping_systems import plane, snake, stepped

import dynsim
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import CONSTRAINT, FRICTION, IMPACT_LOSS, JOINT_STOP_LOSS, OUT_FORCE
from dynsim.integrators.run import FINISHED, LOGGED, STATUS, Run
from dynsim.integrators.stepping.tables import PENETRATION, SOLVES
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.model.drives import Motor

G = 9.81


def block(friction: float, slope: float = 0.0, mass: float = 2.0, **law: float) -> CompiledSystem:
    """A body that does not turn, with one point on a plane through the origin that falls towards +x.

    law: further arguments of the ``Contact``.
    """
    inertias = [Inertia(0.0), Inertia(0.0), Inertia(mass)]
    links = [
        Link(a, f"j{a}", "xy"[k - 1] if k else None, "prismatic", np.eye(3)[k], inertias[k])
        for k, a in enumerate("xyz")
    ]
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
    return assemble(
        Robot("block", tuple(links), (), ("z", np.zeros(3))),
        [Contact("foot", "z", np.zeros(3), plane(normal), friction=friction, **law)],
        real=True,
    )


@pytest.mark.parametrize("theta", [0.5, 1.0])
@pytest.mark.parametrize("slope", [0.2, 0.6])
def test_a_block_sticks_on_a_slope_or_slides_down_it(slope, theta):
    mu, b = 0.3, block(0.3, slope)
    run = stepped(b, b.state(np.zeros(3), np.zeros(3)), np.array([0.0, 2.0]), 1e-2, theta)
    acceleration = max(G * (np.sin(slope) - mu * np.cos(slope)), 0.0)
    # From rest: θ = 1/2 is exact, θ = 1 ahead by half a step.
    distance = 0.5 * acceleration * 2.0 * (2.0 + (1e-2 if theta == 1.0 else 0.0))
    np.testing.assert_allclose(np.linalg.norm(run.states("q")[-1]), distance, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.outputs("contact")[-1, 0, OUT_FORCE], 2.0 * G * np.cos(slope), rtol=1e-9)
    assert run.stepping.statistics[PENETRATION] < 1e-9


@pytest.mark.parametrize(("theta", "order"), [(0.5, 2), (1.0, 1)])
def test_order_of_a_motion_with_motors(theta, order):
    """A random arm with motors against an adaptive method at a tolerance out of reach of the other."""
    robot = random_robot(np.random.default_rng(3), 4)
    free, b, times = assemble(robot), assemble(robot, real=True), np.array([0.0, 0.2])
    start = np.full(4, 0.3), np.full(4, 0.5), np.zeros(b.system.layout.circuits)
    exact = free.simulate(free.state(*start), times, "dopri5", rtol=1e-11).states("q")[-1]
    errors = [
        np.abs(stepped(b, b.state(*start), times, h, theta).states("q")[-1] - exact).max() for h in (4e-4, 2e-4, 1e-4)
    ]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(rates - order) < 0.15).all(), (errors, rates)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_block_lands_and_bounces(restitution):
    """Height of the bounce e² of the fall; the ledger has lost (1 − e²) of the energy; errors shrink with the step."""
    height, errors = 0.5, []
    fall = np.sqrt(2.0 * height / G)
    apex = fall * (1.0 + restitution)
    for h in (2e-3, 1e-3, 5e-4):
        b = block(0.4, restitution=restitution)
        run = stepped(b, b.state([0.0, 0.0, height], np.zeros(3)), np.array([0.0, apex]), h, 0.5)
        errors.append(abs(run.states("q")[-1, 2] - restitution**2 * height))
        assert errors[-1] <= 2.0 * h * G * fall
        energy = 2.0 * G * b.part(run.y, "q")[2] + np.sum(b.part(run.y, "v") ** 2)
        lost = run.states("loss")[-1, IMPACT_LOSS]
        np.testing.assert_allclose(energy - 2.0 * G * height, -lost, atol=1e-9)
        np.testing.assert_allclose(run.states("ledger")[-1, CONSTRAINT], 0.0, atol=1e-9)
        assert run.stepping.statistics[PENETRATION] <= h * G * fall
    # A landing within a step is off by up to the whole step, one at its midpoint by nothing.
    assert restitution == 0.0 or errors[-1] < 0.5 * errors[0]


def test_a_rod_that_falls_on_its_stop_loses_there_what_it_has():
    """All of m g l (cos α − cos q)/2: a loss of the stop, no error of constraints; it is closed from then on."""
    mass, length, start = 0.8, 0.5, 1.2
    rod = Inertia(mass, 0.5 * length * np.eye(3)[2], mass * length**2 / 12.0 * np.diag([1.0, 1.0, 0.0]))
    link = Link("rod", "hinge", None, "revolute", np.eye(3)[1], rod, upper=0.5 * np.pi)
    b = assemble(Robot("rod", (link,), (), ("rod", length * np.eye(3)[2])), real=True)
    until = 1.5
    run = stepped(b, b.state([start], np.zeros(1)), np.linspace(0.0, until, 751), 2e-3, 0.5)
    angle, (stop,) = run.states("q")[:, 0], b.system.unilateral.stop
    # It passes its stop by less than a step at 5.5 rad/s, and is moved back.
    assert 1e-6 < angle.max() - 0.5 * np.pi < 0.011
    q = angle[-1]
    assert abs(q - 0.5 * np.pi) < 1e-9
    fallen = mass * G * 0.5 * length * (np.cos(start) - np.cos(q))
    assert run.states("loss")[-1, JOINT_STOP_LOSS] == pytest.approx(fallen, rel=1e-4)
    assert stop[ku.STOP_LOSS] == run.states("loss")[-1, JOINT_STOP_LOSS]
    assert abs(run.states("ledger")[-1, CONSTRAINT]) < 1e-12
    fall = quad(lambda q: 1.0 / np.sqrt(3.0 * G / length * (np.cos(start) - np.cos(q))), start, 0.5 * np.pi)[0]
    assert stop[ku.CLOSED_TIME] == pytest.approx(until - fall, abs=3e-3)


def test_what_slides_comes_to_rest_where_it_should():
    mu, speed = 0.2, np.array([1.2, -0.9, 0.0])
    b = block(mu)
    run = stepped(b, b.state(np.zeros(3), speed), np.array([0.0, 2.0]), 1e-3, 0.5)
    np.testing.assert_allclose(run.states("q")[-1], speed * 1.5 / (2.0 * mu * G), atol=1e-6)
    ledger = run.states("ledger")[-1]
    np.testing.assert_allclose(ledger[FRICTION], 0.5 * 2.0 * 1.5**2, rtol=1e-9)
    assert np.abs(run.states("v")[-1]).max() < 1e-9


def test_what_turns_as_it_slides_is_stopped_in_a_straight_line():
    """A point under the centre of a body has friction without moment: the body turns on for ever, its point stops.

    The law of the step in which it stops is on the slip of its end, which tangents that turn with the body would turn.
    """
    mu, rate, speed, inertia = 0.2, 10.0, 0.5, Inertia(2.0, np.zeros(3), np.diag([0.01, 0.01, 0.02]))
    places = ["x", "y", "z"]
    links = [
        Link(a, f"j{a}", places[k - 1] if k else None, "prismatic", np.eye(3)[k], Inertia(0.0))
        for k, a in enumerate(places)
    ]
    links.append(Link("top", "jtop", "z", "revolute", np.eye(3)[2], inertia))
    foot = Contact("foot", "top", np.zeros(3), plane(np.eye(3)[2]), friction=mu)
    b = assemble(Robot("top", tuple(links), (), ("top", np.zeros(3))), [foot], real=True)
    start = b.state(np.zeros(4), np.array([speed, 0.0, 0.0, rate]))
    run = b.simulate(start, np.linspace(0.0, 0.5, 51), "time_stepping", step=1e-2)
    q, v = run.states("q"), run.states("v")
    np.testing.assert_allclose(q[-1], [speed**2 / (2.0 * mu * G), 0.0, 0.0, 0.5 * rate], rtol=0, atol=1e-4)
    assert np.abs(q[:, 1]).max() < 1e-12
    assert np.abs(v[:, 1]).max() < 1e-11
    np.testing.assert_allclose(v[-1], [0.0, 0.0, 0.0, rate], rtol=0, atol=1e-11)


def test_friction_that_differs_along_and_across():
    """Two runs, each along one axis: friction along it alone; then both, in the direction of the ellipse's normal."""
    mu, ratio, law = 0.4, 0.25, {ka.GRIP: 0.25, ka.GRIP_AXIS: 1.0}
    for speed, friction in (([1.0, 0, 0], mu * ratio), ([0, 1.0, 0], mu)):
        b = block(mu)
        run = stepped(b, b.state(np.zeros(3), np.array(speed)), np.array([0.0, 0.1]), 1e-3, 0.5, law)
        np.testing.assert_allclose(np.linalg.norm(run.states("v")[-1]), 1.0 - friction * G * 0.1, rtol=1e-9)
    b = block(mu)
    run = stepped(b, b.state(np.zeros(3), np.array([1.0, 1.0, 0.0])), np.array([0.0, 1e-5]), 1e-5, 0.5, law)
    force = -2.0 * (run.states("v")[-1] - [1.0, 1.0, 0.0]) / 1e-5
    normal = 2.0 * G
    np.testing.assert_allclose((force[0] / ratio) ** 2 + force[1] ** 2, (mu * normal) ** 2, rtol=1e-6)
    np.testing.assert_allclose(force[0] / force[1], ratio**2, rtol=1e-3)


def slide(b: CompiledSystem, speed: float, until: float, h: float) -> Run:
    """The block slides along x at first."""
    return b.simulate(b.state(np.zeros(3), [speed, 0.0, 0.0]), np.array([0.0, until]), "time_stepping", step=h)


def test_static_friction_holds_more_than_it_gives_once_it_slides():
    """tan(slope) between both coefficients: at rest it stays; pushed, it slides at μ_k; stopped by μ_k, it stays."""
    slope, kinetic, static = np.arctan(0.4), 0.3, 0.5
    down = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    b = block(kinetic, slope, static_friction=static)
    still = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.array([2.0]), "time_stepping", step=1e-2)
    assert np.abs(still.states("q")).max() < 1e-12
    acceleration = G * np.cos(slope) * (0.4 - kinetic)
    pushed = b.simulate(b.state(np.zeros(3), 0.2 * down), np.array([1.0]), "time_stepping", step=1e-2)
    np.testing.assert_allclose(pushed.states("v")[-1] @ down, 0.2 + acceleration, rtol=1e-9)
    b = block(0.45, slope, static_friction=static)
    stopped = b.simulate(b.state(np.zeros(3), 0.2 * down), np.array([2.0]), "time_stepping", step=1e-3)
    assert np.abs(stopped.states("v")[-1]).max() < 1e-9
    np.testing.assert_allclose(stopped.states("q")[-1] @ down, 0.02 / (G * np.cos(slope) * 0.05), atol=2e-4)


def test_friction_that_depends_on_the_speed_is_followed_to_first_order():
    """v̇ = −g μ(v): viscous friction on paper, v + μ/c = (v_0 + μ/c) exp(−g c t); Stribeck's by quadrature."""
    mu, c, v_s, static, times = 0.1, 0.2, 0.4, 0.3, 0.25
    paper = (1.0 + mu / c) * np.exp(-G * c * times) - mu / c
    stribeck = solve_ivp(
        lambda t, v: -G * (mu + (static - mu) * np.exp(-((v / v_s) ** 2))), (0.0, times), [1.0], rtol=1e-11
    )["y"][0, -1]
    for b, exact in (
        (block(mu, viscous_friction=c), paper),
        (block(mu, static_friction=static, stribeck=v_s), stribeck),
    ):
        errors = np.array([slide(b, 1.0, times, h).states("v")[-1, 0] - exact for h in (4e-3, 2e-3, 1e-3)])
        np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 1.0, atol=0.05)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_what_friction_gives_within_an_impact_is_of_the_impact(tmp_path, restitution):
    """Only the sum of normal and friction is a loss, and all of it is one of the impact, as by events."""
    path = tmp_path / "slam.yaml"
    path.write_text(
        "duration_s: 0.5\n"
        "plant:\n  type: serial_arm\n"
        "  link: {mass_kg: 0.2, length_m: 0.25, damping_N_m_s_per_rad: 0.002}\n  chain: [{axis: y, initial_deg: 80}]\n"
        "surfaces: {floor: {type: plane}}\n"
        f"contacts:\n  {{law: unilateral, friction: 0.3, restitution: {restitution}, "
        "points: {tip: {body: link_1, point_m: [0, 0, 0.25]}}}\n"
    )
    by_events = dynsim.simulate(dynsim.load_scenario(path)).summary
    overrides = {"integrator.method": "time_stepping", "integrator.step_s": 0.0001}
    record = dynsim.simulate(dynsim.load_scenario(path, overrides=overrides))
    assert np.diff(record["heat_friction"]).min() >= 0.0
    for name in ("friction_heat_J", "impact_loss_J"):
        assert record.summary[name] == pytest.approx(by_events[name], rel=0.02, abs=1e-3), name
    assert not lines_with(record.summary["warnings"], phrase="friction gains")


def test_a_run_in_pieces_is_the_same_run():
    b, y = snake()
    whole = stepped(b, y, np.array([0.05]), 1e-3, 0.5)
    b = b.with_shapes()
    run = b.new_run(y, np.array([0.05]), "time_stepping", step=1e-3)
    while run.count[STATUS] != FINISHED:
        b.advance(run, 7)
    np.testing.assert_array_equal(run.y, whole.y)


@pytest.mark.parametrize("fill", [3.0, np.nan])
def test_scratch_memory_of_a_run_changes_no_bit(fill):
    """Stops, dry friction and contacts that come and go: rows of one kind stand where those of another have stood."""
    runs = []
    for scratch in (0.0, fill):
        b, y = rubbing_arm()
        run = b.new_run(y, np.linspace(0.0, 0.8, 81), "time_stepping", step=1e-3)
        while run.count[STATUS] != FINISHED:
            s, u = run.stepping, b.system.unilateral
            for array in (s.room, s.right, s.w, s.direction, u.room, u.split_room, u.vector, b.ws.small):
                array[...] = scratch
            b.advance(run, 7)
        runs.append(run)
    clean, dirty = runs
    assert clean.stepping.statistics[SOLVES] == 800
    # Joints rest and slide, stops and contacts close one after the other.
    kinds = {int(event) for event in clean.log_event[: clean.count[LOGGED]]}
    assert len(kinds) > 8
    np.testing.assert_array_equal(clean.y, dirty.y)
    np.testing.assert_array_equal(clean.sample, dirty.sample)
    np.testing.assert_array_equal(clean.output, dirty.output)
    np.testing.assert_array_equal(clean.stepping.statistics, dirty.stepping.statistics)


def rubbing_arm() -> tuple[CompiledSystem, np.ndarray]:
    """Three joints that rub, with stops, which fall on a plane."""
    rod = Inertia(0.4, np.array([0.0, 0.0, 0.15]), np.diag([3e-3, 3e-3, 0.0]))
    links = [
        Link(
            f"link_{k}", f"joint_{k}", f"link_{k - 1}" if k else None, "revolute", np.eye(3)[1 if k != 1 else 0], rod,
            p_PJ=np.array([0.0, 0.0, 0.3 if k else 0.0]), lower=-0.9, upper=0.9, friction=0.02,
        )
        for k in range(3)
    ]  # fmt: skip
    floor = Quadric(np.zeros((3, 3)), np.eye(3)[2], -0.2)
    tips = [Contact(f"tip_{k}", f"link_{k}", np.array([0.0, 0.02 * k, 0.3]), floor, friction=0.4) for k in range(3)]
    b = assemble(Robot("rubs", tuple(links), (), ("link_2", np.zeros(3))), tips, real=True, dry=True)
    return b.with_shapes(), b.state([0.5, 0.3, 0.2], np.zeros(3))


def test_current_in_a_blocked_motor_is_that_of_the_trapezoidal_rule():
    heavy = Link("wheel", "shaft", None, "revolute", np.eye(3)[2], Inertia(1.0, np.zeros(3), 1e15 * np.eye(3)))
    motor = Motor("shaft", 0.2, resistance=1.1, inductance=1.7e-3, rotor_inertia=0.0, gear_ratio=3.0)
    robot = Robot("motor", (heavy,), (motor,), ("wheel", np.zeros(3)))
    b = assemble(robot, held=np.array([0.4]), k_p=30.0, k_d=0.0, real=True)
    run = stepped(b, b.state([0.0], [0.0]), np.array([8e-3]), 1e-3, 0.5)
    x = 0.5e-3 * 1.1 / 1.7e-3
    np.testing.assert_allclose(
        run.states("current")[0, 0], 12.0 / 1.1 * (1.0 - ((1.0 - x) / (1.0 + x)) ** 8), rtol=1e-12
    )

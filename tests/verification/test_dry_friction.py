"""Dry friction of gears and bearings, by time stepping and with events: closed forms, the ledger, keys of scenarios."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.messages import lines_with, raises
from support.random_robots import CompiledSystem, assemble, random_robot
from support.stepping_cases import sphere
from support.stepping_systems import plane, stepped

from dynsim import load_scenario, simulate
from dynsim.compile.model import Model
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import ELECTRICAL, GEAR, JOINT, JOULE, OUT_MODE
from dynsim.dynamics.tables import SLIDING
from dynsim.errors import ModelError
from dynsim.integrators import run as ki
from dynsim.integrators.contacts.events import SLIP_START, SLIP_STOP
from dynsim.integrators.contacts.modes import let_joints_slide
from dynsim.integrators.stepping.tables import CAPPED
from dynsim.model.description import Contact, Inertia, Link, Load, Quadric, Robot, vector
from dynsim.model.drives import Motor, Servo

MASS, FRICTION = 2.0, 3.0


def sliding(load: np.ndarray, friction: float = FRICTION) -> CompiledSystem:
    """A mass on a horizontal guide with dry friction [N], pushed by load[0] + load[1] t [N]."""
    link = Link("slide", "guide", None, "prismatic", vector(1, 0, 0), Inertia(MASS), friction=friction)
    coefficients = np.zeros((1, 6, 4))
    coefficients[0, 0, :2] = load
    push = Load("push", "slide", np.zeros(3), False, np.array([0.0, 100.0]), coefficients, True)
    return assemble(Robot("slide", (link,), (), ("slide", np.zeros(3))), loads=[push], real=True, dry=True)


def test_a_bearing_holds_up_to_its_friction_and_no_further():
    times = np.array([0.0, 1.0])
    for share in (0.0, 0.5, 1.0 - 1e-9):
        b = sliding(np.array([share * FRICTION, 0.0]))
        run = stepped(b, b.state(np.zeros(1), np.zeros(1)), times, 1e-2, 0.5)
        assert abs(run.states("q")[-1, 0]) < 1e-12
        assert b.system.unilateral.dry[0, 2] == pytest.approx(-share * FRICTION, abs=1e-9)
    excess = 1e-6 * FRICTION
    b = sliding(np.array([FRICTION + excess, 0.0]))
    run = stepped(b, b.state(np.zeros(1), np.zeros(1)), times, 1e-2, 0.5)
    assert run.states("q")[-1, 0] == pytest.approx(0.5 * excess / MASS, rel=1e-6)


@pytest.mark.parametrize("theta", [0.5, 1.0])
def test_a_growing_push_breaks_it_loose_when_it_reaches_the_friction(theta):
    """At t_0 = F/r of a push r t; then x = r (t − t_0)³/6m, and the work of friction is F x."""
    rate, until = 4.0, 1.75
    moved, errors = rate * (until - FRICTION / rate) ** 3 / (6.0 * MASS), []
    for step in (1e-2, 5e-3):
        b = sliding(np.array([0.0, rate]))
        run = stepped(b, b.state(np.zeros(1), np.zeros(1)), np.array([0.0, until]), step, theta)
        q = run.states("q")[-1, 0]
        errors.append(abs(q - moved))
        lost = run.states("ledger")[-1, JOINT]
        assert lost == pytest.approx(FRICTION * q, rel=1e-12) if theta == 0.5 else lost > 0.0
    assert errors[1] < 0.6 * errors[0]
    assert errors[1] < (1e-5 if theta == 0.5 else 1e-2)


@pytest.mark.parametrize("mass", [2e7, 1e10])
def test_a_heavy_joint_moves_where_its_friction_is_exceeded(mass):
    """x = (F − R) t²/2m next to a weight on the floor; the acceleration is almost zero compared with its g."""
    links = (
        Link("slide", "guide", None, "prismatic", vector(1, 0, 0), Inertia(mass), friction=FRICTION),
        Link("foot", "rail", "slide", "prismatic", vector(0, 0, 1), Inertia(MASS)),
    )
    powers = np.zeros((1, 6, 4))
    powers[0, 0, 0] = FRICTION + 1.0
    push = Load("push", "foot", np.zeros(3), False, np.array([0.0, 10.0]), powers, True)
    foot = Contact("foot", "foot", np.zeros(3), plane(vector(0, 0, 1)), friction=0.0)
    b = assemble(Robot("cart", links, (), ("foot", np.zeros(3))), [foot], loads=[push], real=True, dry=True)
    run = b.simulate(b.state(np.zeros(2), np.zeros(2)), np.linspace(0.0, 2.0, 3), rtol=1e-10)
    # It slides from the start, which does not count as an event.
    assert run.count[ki.LOGGED] == 0
    assert run.outputs("dry")[-1] == pytest.approx(-FRICTION)
    assert run.states("q")[-1, 0] == pytest.approx(2.0 / (mass + MASS), rel=1e-6)


def oscillator(start: float, friction: float = 0.4) -> tuple[CompiledSystem, np.ndarray, float, float]:
    """A wheel on a servo that is a spring of 20 N m/rad and a little damping; its state, stiffness and damping."""
    k_m, resistance, stiffness = 0.1, 2.0, 20.0
    servo = Servo("shaft", k_m, resistance, stiffness * resistance / k_m, coulomb_friction=friction)
    link = Link("wheel", "shaft", None, "revolute", vector(0, 0, 1), Inertia(1.0, tensor=np.diag([0.3, 0.3, 0.3])))
    b = assemble(Robot("wheel", (link,), (servo,), ("wheel", np.zeros(3))), real=True, dry=True)
    return b, b.state(np.array([start]), np.zeros(1)), stiffness, k_m**2 / resistance


def rest_of(x: float, stiffness: float, damping: float) -> tuple[float, int]:
    """Where the oscillator that starts at x comes to rest, and after how many half swings."""
    band, inertia, swings = 0.4 / stiffness, 0.3, 0
    rate = damping / (2.0 * inertia)
    period = np.pi / np.sqrt(stiffness / inertia - rate**2)
    while abs(x) > band:
        centre = np.sign(x) * band
        x = centre - np.exp(-rate * period) * (x - centre)
        swings += 1
    return x, swings


def test_a_spring_is_held_where_its_force_is_below_the_friction():
    """The bound is exact: just below it nothing moves, just above it does."""
    band = 0.4 / 20.0
    for share, moves in ((1.0 - 1e-9, False), (1.0 + 1e-6, True)):
        b, y, _, _ = oscillator(share * band)
        run = stepped(b, y, np.array([0.0, 1.0]), 1e-3, 0.5)
        assert (abs(run.states("q")[-1, 0] - share * band) > 1e-9 * band) == moves


def test_a_spring_with_dry_friction_comes_to_rest_in_closed_form():
    """Each half swing is about the place ±τ/k where spring and friction balance; it ends and stays within that band."""
    b, y, stiffness, damping = oscillator(0.5)
    x, swings = rest_of(0.5, stiffness, damping)
    assert swings == 12
    errors = []
    for step in (2e-3, 1e-3):
        run = stepped(b, y, np.array([0.0, 6.0, 26.0]), step, 0.5)
        q = run.states("q")[:, 0]
        errors.append(abs(q[1] - x))
        assert abs(q[2] - q[1]) < 1e-10
        assert run.stepping.statistics[CAPPED] == 0
    assert errors[0] < 1e-4
    assert errors[1] < 0.5 * errors[0]


def rolling(share: float) -> tuple[CompiledSystem, np.ndarray, float, float, float]:
    """A wheel on a slope whose bearing takes a share of its pull; state, acceleration, drag and radius.

    (m + I/r²) a = m g sin α − τ/r, if that is positive.
    """
    radius, mass, inertia, slope = 0.05, 1.2, 2e-3, 0.2
    pull = mass * 9.81 * np.sin(slope)
    drag, wheel = share * pull * radius, Inertia(1.0, tensor=inertia * np.eye(3))
    links = (
        Link("x", "along", None, "prismatic", vector(1, 0, 0), Inertia(0.0)),
        Link("z", "up", "x", "prismatic", vector(0, 0, 1), Inertia(0.2)),
        Link("wheel", "axle", "z", "revolute", vector(0, 1, 0), wheel, friction=drag),
    )
    gravity = 9.81 * vector(np.sin(slope), 0, -np.cos(slope))
    contact = Contact("tyre", "wheel", np.zeros(3), plane(vector(0, 0, 1)), friction=0.8, radius=radius)
    b = assemble(Robot("wheel", links, (), ("wheel", np.zeros(3)), gravity=gravity), [contact], real=True, dry=True)
    acceleration = max(pull - drag / radius, 0.0) / (mass + inertia / radius**2)
    return b, b.state(np.array([0.0, radius, 0.0]), np.zeros(3)), acceleration, drag, radius


def test_a_wheel_rolls_down_a_slope_against_its_bearing():
    for share in (0.6, 1.1):
        b, y, acceleration, drag, radius = rolling(share)
        run = stepped(b, y, np.array([0.0, 1.0]), 2.5e-3, 0.5)
        x, _, angle = run.states("q")[-1]
        assert x == pytest.approx(0.5 * acceleration, rel=1e-9, abs=1e-11)
        assert x == pytest.approx(radius * angle, rel=1e-9, abs=1e-11)
        assert run.states("ledger")[-1, JOINT] == pytest.approx(drag * angle, rel=1e-9, abs=1e-11)


def arm(gear: float, **more: float) -> Robot:
    """Three links that hang sideways on servos, with gears that rub."""
    links, motors = [], []
    for k in range(3):
        inertia = Inertia.solid_cylinder(0.5, 0.02, 0.3)
        p = vector(0, 0, 0.3 if k else 0)
        links.append(
            Link(
                f"link_{k}", f"joint_{k}", f"link_{k - 1}" if k else None, "revolute", vector(0, 1, 0), inertia, p_PJ=p
            )
        )
        motors.append(
            Servo(f"joint_{k}", 2.5, 3.6, 58.6, armature=0.01, coulomb_friction=gear, voltage_limit=12.0, **more)
        )
    return Robot("arm", tuple(links), tuple(motors), ("link_2", vector(0, 0, 0.3)))


def test_a_held_arm_does_not_creep():
    """It sags, is held, and stays for 20 s; smoothed friction lets it creep by millimetres."""
    times, moved = np.array([0.0, 3.0, 23.0]), []
    for speed in (None, 1e-2):
        b = assemble(arm(0.8, coulomb_speed=speed), held=np.array([1.2, 0.3, 0.0]), real=True, dry=True)
        run = stepped(b, b.state(np.array([1.2, 0.3, 0.0]), np.zeros(3)), times, 2.5e-3, 0.5)
        hand = run.outputs("hand")
        moved.append(np.abs(hand[2] - hand[1]).max())
        assert run.stepping.statistics[CAPPED] == 0
    assert moved[0] < 1e-8
    assert moved[1] > 1e-4


def test_joint_torques_have_the_friction_of_their_gear_in_them():
    """At rest the shaft carries the weight alone, whatever motor and gear share of it."""
    b = assemble(arm(0.8), held=np.array([1.2, 0.3, 0.0]), real=True, dry=True)
    run = stepped(b, b.state(np.array([1.2, 0.3, 0.0]), np.zeros(3)), np.array([0.0, 3.0]), 2.5e-3, 0.5)
    q, torque = run.states("q")[-1], run.outputs("torque")[-1]
    np.testing.assert_allclose(torque, Model(b.robot).bias_forces(q, np.zeros(3)), rtol=0, atol=1e-8)
    assert abs(torque - 2.5 * run.outputs("current")[-1]).max() > 1e-3


def ledger_gap(run) -> np.ndarray:
    """Return the energy missing in the ledger without contacts, relative to the largest change of energy or 1 J."""
    ledger, stored = run.states("ledger"), run.outputs("energy").sum(axis=1)
    used = ledger[:, JOULE] + ledger[:, GEAR] + ledger[:, JOINT] + run.states("scheme")[:, 0]
    change = stored - stored[0]
    return np.abs(ledger[:, ELECTRICAL] - used - change) / max(1.0, np.abs(change).max())


@pytest.mark.parametrize("theta", [0.5, 0.8, 1.0])
def test_the_ledger_of_random_arms_that_rub(theta):
    rng = np.random.default_rng(3)
    robot = random_robot(rng, 6)
    robot = replace(
        robot,
        links=tuple(replace(link, friction=rng.uniform(0.0, 0.5)) for link in robot.links),
        motors=tuple(replace(motor, dry_friction=0.3) for motor in robot.motors),
    )
    assert any(isinstance(motor, Motor) for motor in robot.motors)
    b = assemble(robot, real=True, dry=True)
    run = stepped(b, b.state(rng.normal(size=6), rng.normal(size=6)), np.linspace(0.0, 0.5, 6), 2e-3, theta)
    assert ledger_gap(run).max() < 1e-9
    ledger = run.states("ledger")
    assert (np.diff(ledger[:, [GEAR, JOINT]], axis=0) > 0.0).all()


@pytest.mark.parametrize("theta", [0.5, 1.0])
def test_dry_friction_never_gives_energy_where_the_motion_turns_round(theta):
    """The force at the step end may be along its mean motion: that work is due to the scheme; the ledger closes."""
    b, y, _, _ = oscillator(0.5)
    run = stepped(b, y, np.arange(0.0, 6.0, 5e-3), 5e-3, theta)
    turns = (np.diff(np.sign(run.states("v")[:, 0])) != 0.0).sum()
    assert turns >= 10
    lost = run.states("ledger")[:, GEAR]
    assert np.diff(lost).min() > -1e-15
    assert ledger_gap(run).max() < 1e-9


METHODS = ("dopri5", "radau5")
STEPS = "time_stepping"


@pytest.mark.parametrize("method", METHODS)
def test_events_find_where_a_push_breaks_a_bearing_loose(method):
    """As above, and a push that falls again: the slide stops by itself, and stays."""
    rate = 4.0
    b = sliding(np.array([0.0, rate]))
    run = b.simulate(b.state(np.zeros(1), np.zeros(1)), np.array([0.0, 0.7, 1.75]), method, rtol=1e-10, atol=1e-12)
    q = run.states("q")[:, 0]
    assert abs(q[1]) < 1e-14
    assert q[2] == pytest.approx(rate * (1.75 - FRICTION / rate) ** 3 / (6.0 * MASS), rel=1e-8)
    assert run.states("ledger")[-1, JOINT] == pytest.approx(FRICTION * q[2], rel=1e-9)
    b = sliding(np.array([2.0 * FRICTION, -FRICTION]))
    run = b.simulate(b.state(np.zeros(1), np.zeros(1)), np.array([0.0, 3.0, 4.0]), method, rtol=1e-10, atol=1e-12)
    # m v' = F - F t until v = 0 at t = 2, and then within the friction until the push is -F at t = 3.
    assert run.states("q")[1, 0] == pytest.approx(2.0 / 3.0 * FRICTION / MASS, rel=1e-8)
    assert run.states("q")[2, 0] == pytest.approx((2.0 / 3.0 - 1.0 / 6.0) * FRICTION / MASS, rel=1e-8)


@pytest.mark.parametrize(("method", "late"), [("dopri5", 1e-8), ("radau5", 1e-8), ("time_stepping", 1e-3)])
def test_begin_and_end_of_slip_of_a_joint_are_in_the_log(method, late):
    """A push 2 F − F t slides the mass at once, which is not an event; it stops at 2 s and is pushed back from 3 s on.

    Time stepping logs these events at the ends of the steps in which they occur, here of 1 ms.
    """
    b = sliding(np.array([2.0 * FRICTION, -FRICTION]))
    y, times = b.state(np.zeros(1), np.zeros(1)), np.array([0.0, 4.0])
    stepping = method == "time_stepping"
    run = stepped(b, y, times, 1e-3, 0.5) if stepping else b.simulate(y, times, method, rtol=1e-10, atol=1e-12)
    logged = int(run.count[ki.LOGGED])
    assert run.log_event[:logged].tolist() == [ki.DRY_LOG + SLIP_STOP, ki.DRY_LOG + SLIP_START]
    np.testing.assert_allclose(run.log_time[:logged], [2.0, 3.0], rtol=0, atol=late * (1.0 + 1e-9))


@pytest.mark.parametrize("method", METHODS)
def test_events_bring_a_spring_to_rest_in_closed_form(method):
    b, y, stiffness, damping = oscillator(0.5)
    run = b.simulate(y, np.array([0.0, 6.0, 26.0]), method, rtol=1e-10, atol=1e-12)
    q = run.states("q")[:, 0]
    assert q[1] == pytest.approx(rest_of(0.5, stiffness, damping)[0], abs=1e-8)
    assert abs(q[2] - q[1]) < 1e-12


@pytest.mark.parametrize("method", ["radau5", pytest.param("dopri5", marks=pytest.mark.long)])
def test_events_roll_a_wheel_down_a_slope_against_its_bearing(method):
    for drag in (0.6, 1.1):
        b, y, acceleration, drag_torque, _ = rolling(drag)
        run = b.simulate(y, np.array([0.0, 1.0]), method, rtol=1e-9, atol=1e-11)
        x, _, angle = run.states("q")[-1]
        assert x == pytest.approx(0.5 * acceleration, rel=1e-7, abs=1e-11)
        assert run.states("ledger")[-1, JOINT] == pytest.approx(drag_torque * angle, rel=1e-7, abs=1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_a_joint_at_rest_follows_a_wheel_that_slowly_rolls_off_a_crest(method):
    """At the crest the normal row of the wheel and the row of the joint that lifts it are the same.

    ½ (m + I/r²) ds² − ½ (m + I/r²) v² = (m g − F) h along the path s of the axle, h = ρ (1 − cos s/ρ), whose slowness
    shows no contradicting accelerations. The joint may rest until the rows are off each other by a tenth of a
    nanometre, with any friction in its bound.
    """
    radius, crest, mass, inertia, friction, speed, off = 0.05, 20.0, 1.2, 2e-3, 3.0, 1e-3, 1e-10
    links = (
        Link("x", "along", None, "prismatic", vector(1, 0, 0), Inertia(0.0)),
        Link("z", "up", "x", "prismatic", vector(0, 0, 1), Inertia(0.2), friction=friction),
        Link("wheel", "axle", "z", "revolute", vector(0, 1, 0), Inertia(1.0, tensor=inertia * np.eye(3))),
    )
    surface = sphere(-crest * vector(0, 0, 1), crest, 1.0)
    contact = Contact("tyre", "wheel", np.zeros(3), surface, friction=0.8, radius=radius)
    robot = Robot("wheel", links, (), ("wheel", np.zeros(3)), gravity=-9.81 * vector(0, 0, 1))
    b = assemble(robot, [contact], real=True, dry=True)
    y = b.state(np.array([0.0, radius, 0.0]), np.array([speed, 0.0, speed / radius]))
    run = b.simulate(y, np.linspace(0.0, 3.0, 31), method, rtol=1e-9, atol=1e-13)
    path, bend = radius * run.states("q")[:, 2], crest + radius
    drop = 2.0 * bend * np.sin(0.5 * path / bend) ** 2
    assert drop[-1] > 1e-7
    np.testing.assert_allclose(run.states("q")[:, 1], radius - drop, rtol=0, atol=off)
    heavy = mass + inertia / radius**2
    energy = 0.5 * heavy * (radius * run.states("v")[:, 2]) ** 2
    exact = 0.5 * heavy * speed**2 + (mass * 9.81 - friction) * drop
    np.testing.assert_allclose(energy, exact, rtol=1e-8, atol=2.0 * friction * off)
    assert run.log_event[: int(run.count[ki.LOGGED])].tolist() == [ki.DRY_LOG + SLIP_START]


@pytest.mark.parametrize("method", METHODS)
def test_events_hold_an_arm_and_close_its_ledger(method):
    """It sags, joint after joint comes to rest, and nothing moves any more; the same place as by time stepping."""
    q0, places = np.array([1.2, 0.3, 0.0]), []
    b = assemble(arm(0.8), held=q0, real=True, dry=True)
    run = b.simulate(b.state(q0, np.zeros(3)), np.array([0.0, 1.0, 3.0, 23.0]), method, rtol=1e-8, atol=1e-10)
    hand = run.outputs("hand")
    assert np.abs(hand[3] - hand[2]).max() < 1e-10
    assert ledger_gap(run)[-1] < 1e-6
    for step in (1e-3, 2.5e-4):
        places.append(stepped(b, b.state(q0, np.zeros(3)), np.array([0.0, 3.0]), step, 0.5).outputs("hand")[-1])
    errors = [np.abs(position - hand[2]).max() for position in places]
    assert errors[1] < 0.5 * errors[0] < 1e-4


def leaning(rate: float) -> tuple[CompiledSystem, np.ndarray]:
    """An arm whose joints hold its weight, its tip on a floor and pushed along it by rate t: more rows than motions."""
    robot, q0, tip = arm(8.0), np.array([1.2, 0.5, 0.4]), vector(0, 0, 0.3)
    height = float(Model(robot).point_position("link_2", tip, q0)[2])
    floor = Quadric(np.zeros((3, 3)), vector(0, 0, 1), -height)
    coefficients = np.zeros((1, 6, 4))
    coefficients[0, 0, 1] = rate
    push = Load("push", "link_2", tip, False, np.array([0.0, 100.0]), coefficients, True)
    b = assemble(
        robot, [Contact("tip", "link_2", tip, floor, friction=0.5)], loads=[push], held=q0, real=True, dry=True
    )
    return b, b.state(q0, np.zeros(3))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("rate", "modes"), [(200.0, {2, 0}), (-200.0, {2, 1, 0}), (-60.0, {2})])
def test_joints_and_a_tip_that_hold_together_share_forces_that_are_open(method, rate, modes):
    """They hold while any split of their forces is within all bounds, and break loose as in time stepping."""
    times = np.linspace(0.0, 1.0, 11)
    b, y = leaning(rate)
    run = b.simulate(y, times, method, rtol=1e-8, atol=1e-10)
    b, y = leaning(rate)
    steps = stepped(b, y, times, 2.5e-4, 0.5)
    assert set(run.outputs("contact")[:, 0, OUT_MODE].astype(int)) == modes
    moved = np.abs(run.outputs("hand") - run.outputs("hand")[0]).max(axis=1)
    assert (moved > 1e-4).sum() == (0 if modes == {2} else 8 if rate > 0.0 else 5)
    assert moved[moved < 1e-4].max() < 1e-10
    np.testing.assert_allclose(steps.outputs("hand"), run.outputs("hand"), rtol=0, atol=1e-3 * moved.max() + 1e-12)
    np.testing.assert_array_equal(steps.outputs("contact")[:, 0, OUT_MODE], run.outputs("contact")[:, 0, OUT_MODE])


def test_each_joint_is_held_or_slides_by_its_own_force():
    """Among the held joints, which are the rows of the problem, the accelerated joint at its bound slides."""
    b = assemble(arm(0.8), real=True, dry=True)
    table, dry, vector = b.system.unilateral.dry_table, b.system.unilateral.dry, b.system.unilateral.vector
    for holds in ((1, 1, 1), (1, 0, 1), (0, 1, 1)):
        rows = [k for k in range(3) if holds[k] == 1]
        for at_bound in rows:
            table[:, ku.DRY_HOLDS] = holds
            # The same along every row, so that only bounds decide; and only this joint is at its bound.
            vector[ku.OFFSET], b.system.unilateral.room[ku.PROBLEM] = 1.0, 0.0
            for i, k in enumerate(rows):
                vector[ku.SOLUTION, i] = 0.8 if k == at_bound else -0.3
            let_joints_slide(b.system, len(rows), 1.0)
            expected = [int(k in rows and k != at_bound) for k in range(3)]
            assert table[:, ku.DRY_NEXT].tolist() == expected
            assert dry[at_bound, ku.DRY_SIDE] == -1.0


SCENARIO = """
name: rubbing
duration_s: 0.5
plant:
  type: serial_arm
  chain:
    - {axis: y, initial_deg: 60, friction_N_m: 0.2}
    - {axis: y, motor: {type: wang_minami, coulomb_friction_N_m: 0.3}}
    - {kind: prismatic, axis: z, friction_N: 20, mass_kg: 0.1}
controller: {type: joint_pd, k_p_V_per_rad: 50, k_d_V_s_per_rad: 1}
contacts: {law: unilateral}
integrator: {method: time_stepping, step_s: 0.001}
"""


def test_scenarios_say_what_rubs(tmp_path: Path):
    file = tmp_path / "rubbing.yaml"
    file.write_text(SCENARIO)
    record = simulate(load_scenario(file))
    assert np.abs(record["q"][:, 2]).max() < 1e-10  # below its friction
    assert record.summary["energy_residual_relative"] < 1e-9
    events = simulate(load_scenario(file, overrides={"integrator.method": "radau5"}))
    np.testing.assert_allclose(record["q"][-1], events["q"][-1], rtol=0, atol=1e-4)
    np.testing.assert_allclose(events["joint_friction"][:, 2], record["joint_friction"][:, 2], rtol=0, atol=0.05)
    assert events.summary["energy_residual_relative"] < 1e-6
    glued = {"contacts.law": "bilateral", "integrator.method": "radau5"}
    with raises(ModelError, "joint_1, joint_3, joint_2", "contacts.law: unilateral"):
        simulate(load_scenario(file, overrides=glued))


def test_slip_of_joints_is_among_the_events_of_a_run(tmp_path: Path):
    """The first joint swings back, holds for an instant, and comes to rest; the third never moves."""
    file = tmp_path / "rubbing.yaml"
    file.write_text(SCENARIO)
    times = []
    for method in ("time_stepping", "dopri5"):
        changes = {"integrator.method": method, "duration_s": 2.0, "plant.chain.0.friction_N_m": 0.6}
        slips = simulate(load_scenario(file, overrides=changes)).events
        assert {event.name for event in slips} == {"joint_1", "joint_2"}
        own = [event for event in slips if event.name == "joint_1"]
        assert [event.kind for event in own] == ["slip_stop", "slip_start", "slip_stop"]
        times.append([event.time for event in own])
    np.testing.assert_allclose(times[0], times[1], rtol=0, atol=2e-3)  # steps of 1 ms


TWO_ELBOWS = """
name: two_elbows_drag
duration_s: 1.6
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.12]}
  link: {mass_kg: 0.4, length_m: 0.3, friction_N_m: 0.05, motor: {type: dc, torque_constant_N_m_per_A: 0.0113,
    resistance_ohm: 3.6, inductance_H: 0.0005, rotor_inertia_kg_m2: 1.0e-6, gear_ratio: 225,
    gear_damping_N_m_s_per_rad: 1.0e-6}}
  chain:
    - {axis: z, length_m: 0.02}
    - {axis: y, initial_deg: 110}
    - {axis: y, initial_deg: -40}
    - {axis: y, initial_deg: 50}
    - {axis: y, length_m: 0.2, initial_deg: -60}
controller:
  type: joint_pd
  k_p_V_per_rad: 200
  k_d_V_s_per_rad: 5
  joints:
    joint_1: {times_s: [0.2, 1.2, 2.2, 3], angles_deg: [0, 3, -3, 0]}
    joint_2: {times_s: [0, 3], angles_deg: [114.5, 114.5]}
    joint_4: {times_s: [0.2, 1.2, 2.2, 3], angles_deg: [46.57, 44, 50, 46.57]}
initial: {equilibrium: true, on_surface: [near, far]}
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  friction: 0.3
  points:
    near: {body: link_2, point_m: [0, 0, 0.3]}
    far: {body: link_4, point_m: [0, 0, 0.3]}
"""


@pytest.mark.parametrize("friction", [0.3, 0.0])
def test_joints_rest_where_sliding_elbows_hold_them(tmp_path: Path, friction: float):
    """A yaw joint drags two elbows over a floor: their normal rows hold the pitch joints, which are at rest.

    Contact forces and dry friction of these joints are not determined, and with another split of them the friction of
    the elbows differs: both methods with events choose the same split, time stepping a different one.
    """
    path = tmp_path / "drag.yaml"
    path.write_text(TWO_ELBOWS.replace("  friction: 0.3", f"  friction: {friction}"), encoding="utf-8")
    runs = {method: simulate(load_scenario(path, None, {"integrator.method": method})) for method in (*METHODS, STEPS)}
    energy = {method: run.summary["electrical_energy_J"] for method, run in runs.items()}
    assert energy["radau5"] == pytest.approx(energy["dopri5"], rel=1e-5)
    assert energy[STEPS] == pytest.approx(energy["dopri5"], rel=0.02)
    for run in runs.values():
        assert run.time[-1] == pytest.approx(1.6)
        assert abs(run.summary["energy_residual_relative"]) < 1e-6
        resting = np.abs(run["v"]) < 1e-6
        assert resting[:, 1].sum() > 30
        assert (run["contact_mode"][resting[:, 1]] == SLIDING).any()
        assert np.abs(run["joint_friction"]).max() <= 0.05 * (1.0 + 1e-6)
        assert (run["contact_normal_force"] >= -1e-9).all()
        assert lines_with(run.summary["warnings"], "far", "joint_2", phrase="shared")


BESIDE_STOPS = """\
duration_s: 0.25
plant:
  type: serial_arm
  link: {radius_m: 0.0237}
  chain:
  - {axis: x, length_m: 0.0, mass_kg: 0.1446, kind: prismatic, initial_m: 0.0073, friction_N: 0.245}
  - {axis: y, length_m: 0.24, mass_kg: 0.39, initial_deg: 115.2, friction_N_m: 0.0245}
  - {axis: y, length_m: 0.156, mass_kg: 0.48, initial_deg: 0.355, friction_N_m: 0.0245, limit_deg: [-1.149, 2.61]}
  - {axis: y, length_m: 0.269, mass_kg: 0.341, initial_deg: -72.1, friction_N_m: 0.0245, limit_deg: [-73.56, -69.93]}
  - {axis: z, length_m: 0.154, mass_kg: 0.108, kind: prismatic, initial_m: 0.05, friction_N: 0.245}
surfaces: {floor: {type: plane, point_m: [0, 0, -0.1935]}}
contacts:
  law: unilateral
  friction: 0.4419
  points: {elbow: {body: link_4, radius_m: 0.02}}
integrator: {method: dopri5, rtol: 1.0e-5, atol: 1.0e-7}
"""


@pytest.mark.long  # compiles a separate program
def test_a_joint_that_rests_on_its_stop_takes_no_share_of_its_force(tmp_path: Path):
    """A falling arm lands on its elbow with a joint on its stop: friction within its bound, and no chatter."""
    path = tmp_path / "stops.yaml"
    path.write_text(BESIDE_STOPS, encoding="utf-8")
    record = simulate(load_scenario(path))
    assert record.time[-1] == pytest.approx(0.25)
    assert len(record.events) < 200
    assert record["stop_force"].max() > 0.1
    assert np.abs(record["joint_friction"]).max(axis=0) == pytest.approx([0.245, 0.0245, 0.0245, 0.0245, 0.245])
    assert abs(record.summary["energy_residual_relative"]) < 1e-6


LIFTED = """\
duration_s: 0.8
plant:
  type: serial_arm
  chain: [{axis: y, length_m: 0.5, mass_kg: 1, initial_deg: 90, friction_N_m: 1}]
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  friction: 0
  points: {tip: {body: link_1, point_m: [0, 0, 0.5]}}
loads:
  lift: {type: samples, body: link_1, point_m: [0, 0, 0.5], times_s: [0, 1], force_N: [[0, 0, 0], [0, 0, 10]]}
integrator: {method: dopri5, rtol: 1.0e-5, atol: 1.0e-6}
"""


@pytest.mark.parametrize("method", METHODS)
def test_friction_goes_on_holding_a_joint_whose_contact_leaves(tmp_path: Path, method: str):
    """A lever rests on a floor and on its friction, until 10 N/s times half a metre is its weight and that friction."""
    path = tmp_path / "lifted.yaml"
    path.write_text(LIFTED, encoding="utf-8")
    record = simulate(load_scenario(path, None, {"integrator.method": method}))
    assert [(event.kind, event.name) for event in record.events] == [("lift_off", "tip"), ("slip_start", "joint_1")]
    breaks = (9.81 * 0.25 + 1.0) / 5.0
    assert record.events[1].time == pytest.approx(breaks, abs=1e-6)  # the root of a force that is linear in time
    before = record.time < breaks
    assert np.abs(record["v"][before]).max() < 1e-12
    assert np.ptp(record["q"][before]) < 1e-12


LEANING = """\
duration_s: 0.41
plant:
  type: serial_arm
  chain:
  - {axis: z, length_m: 0, mass_kg: 0.2, friction_N_m: 0.05, limit_deg: [-30, 0]}
  - {axis: y, length_m: 0.5, mass_kg: 1, initial_deg: 90}
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  friction: 0.3
  points: {tip: {body: link_2, point_m: [0, 0, 0.5]}}
loads:
  push:
    type: samples
    interpolation: linear
    body: link_2
    point_m: [0, 0, 0.5]
    times_s: [0, 0.2, 0.4, 0.5]
    force_N: [[0, 0, 0], [0, 10, 0], [0, -2, 0], [0, -2, 0]]
integrator: {method: dopri5}
"""


@pytest.mark.parametrize("method", METHODS)
def test_a_tip_and_a_joint_on_its_stop_hold_what_only_the_stop_can(tmp_path: Path, method: str):
    """A yaw joint is pushed onto its stop while its tip rests on the floor, until the push turns back."""
    path = tmp_path / "leaning.yaml"
    path.write_text(LEANING, encoding="utf-8")
    record = simulate(load_scenario(path, None, {"integrator.method": method}))
    events = [(event.kind, event.name) for event in record.events]
    assert events[0] == ("stop_hit", "joint_1")
    assert sorted(events[1:]) == [("slip_start", "joint_1"), ("slip_start", "tip"), ("stop_left", "joint_1")]
    # Half of the weight presses the tip; friction of tip and joint hold this push either way.
    most = 0.3 * 0.5 * 9.81 + 0.05 / 0.5
    times = [event.time for event in record.events]
    # Both are roots of forces that are linear in time; friction at rest is reduced by 1e-5 for the choice of modes.
    assert times[0] == pytest.approx(most / 50.0, abs=1e-6)
    np.testing.assert_allclose(times[1:], 0.2 + (10.0 + most) / 60.0, rtol=0, atol=1e-6)
    before = record.time < times[1]
    assert np.ptp(record["q"][before], axis=0).max() < 1e-9
    assert record["stop_force"].max() <= 1e-9
    assert np.abs(record["joint_friction"]).max() <= 0.05 * (1.0 + 1e-9)
    assert np.linalg.norm(record["contact_force"][:, 0, :2], axis=1).max() <= 0.3 * 0.5 * 9.81 * (1.0 + 1e-6)


PRESSED = """\
duration_s: 1
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain: [{axis: y, length_m: 0.3, mass_kg: 0.3, motor: {type: torque}, friction_N_m: 0.3, limit_deg: [-20, 20]}]
contacts: {law: unilateral}
controller: {type: joint_pd, torques: {joint_1: {times_s: [0, 0.4, 0.9, 1], torques_N_m: [1, 1, END, END]}}}
integrator: {method: METHOD}
"""


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("end", "moves"), [("0", False), ("-0.2", False), ("-0.6", True)])
def test_a_joint_whose_load_fades_leaves_its_stop_once(tmp_path: Path, method: str, end: str, moves: bool):
    """When the load falls to a load that friction holds, the stop carries nothing and friction carries all of it."""
    path = tmp_path / "pressed.yaml"
    path.write_text(PRESSED.replace("END", end).replace("METHOD", method))
    run = simulate(load_scenario(path))
    kinds = [event.kind for event in run.events]
    assert kinds == ["stop_hit", "slip_stop", "stop_left"] + ["slip_start"] * moves
    assert [stop["hits"] for stop in run.summary["joint_stops"]] == [1]
    assert (run["q"][-1, 0] < np.radians(19.0)) == moves
    assert np.abs(run["joint_friction"]).max() <= 0.3 * (1.0 + 1e-9)

"""Undetermined contact forces or motion: Painlevé's paradox, signs, dependent frictional rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, raises
from support.random_robots import CompiledSystem, assemble, random_contacts, random_robot, random_unit

import dynsim
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.delassus import ROOM, UNIQUE, force_verdict
from dynsim.dynamics.derivative import new_workspace
from dynsim.engine import recording, simulation
from dynsim.engine.force_indeterminacy import acceleration_range, contact_matrices, motion_spread, paradox
from dynsim.errors import SimulationStopped
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.scenario import build

X, Y, Z = np.eye(3)
FLOOR = Quadric(np.zeros((3, 3)), Z, 0.0)
METHODS = ["dopri5", "radau5"]
HALF, MU = 0.5, 2.0
# A uniform rod of half length l that leans by θ, its tip sliding along +x: m A_11 = 1 + 3 s (s + μ c), with s = sin θ
# and c = cos θ, is zero where 5 − 3 cos 2θ + 3 μ sin 2θ = 0. For a pulling force, or sliding along −x, μ changes sign.
_TURN = np.hypot(3.0, 3.0 * MU)
CRITICAL = 0.5 * (np.arctan2(3.0 * MU, -3.0) - np.arccos(-5.0 / _TURN) + 2.0 * np.pi) - np.pi


def rod(friction_law: str, friction: float = MU) -> tuple[CompiledSystem, list[Contact]]:
    """A free rod in the plane y = 0 of 1 kg, half length 0.5 m, whose lower end is held to the floor."""
    slim = np.diag([1.0, 1.0, 1.0]) * HALF**2 / 3.0
    links = (
        Link("slide", "x", None, "prismatic", X, Inertia(0.0)),
        Link("lift", "z", "slide", "prismatic", Z, Inertia(0.0)),
        Link("rod", "lean", "lift", "revolute", Y, Inertia(1.0, np.zeros(3), slim)),
    )
    tip = Contact("tip", "rod", -HALF * Z, FLOOR, friction=friction, pulling_friction=friction_law)
    return assemble(Robot("rod", links, (), ("rod", np.zeros(3))), [tip]), [tip]


def rod_state(b: CompiledSystem, lean: float, turn: float, slide: float = 3.0) -> np.ndarray:
    """On the floor, with the centre's horizontal speed [m/s] and the rate of leaning [rad/s]."""
    rise = -HALF * np.sin(lean) * turn
    return b.state(np.array([0.0, HALF * np.cos(lean), lean]), np.array([slide, rise, turn]))


def started(b: CompiledSystem, y: np.ndarray, method: str, *, end: float = 0.3, rtol: float = 1e-6) -> ki.Run:
    """A run to its end or stop."""
    return b.advance(b.new_run(y, np.linspace(0.0, end, 4), method, rtol=rtol))


def test_the_critical_angle_is_where_the_diagonal_vanishes():
    b, _ = rod("signed")
    matrices = contact_matrices(b.system, b.ws, 0.0, rod_state(b, CRITICAL, 0.0))
    # The smoothing speed is 3e-4 of the slip: 5e-8 of the direction.
    assert matrices.matrix(np.ones(1))[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert -0.19 < CRITICAL < -0.18


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("rtol", "turn"), [(1e-3, -8.0), (1e-6, -6.0), (1e-8, -8.0)])
def test_a_signed_rod_is_stopped_where_its_diagonal_vanishes(method, rtol, turn):
    """The floor pulls, leans the rod towards the critical angle, and would carry it through with ±∞."""
    b, contacts = rod("signed")
    run = started(b, rod_state(b, 0.1, turn), method, rtol=rtol)
    paradox_seen = paradox(b.system, new_workspace(b.system), run, contacts)
    assert paradox_seen is not None, run.count
    t, y, words = paradox_seen
    check_message(words, "Painlevé", "tip", "contacts.friction")
    assert run.clock[ki.TIME] <= t
    # The steps collapse where the determinant is 2e-5, which is 5e-6 rad before it vanishes.
    assert b.part(y, "q")[2] == pytest.approx(CRITICAL, abs=1e-5)
    # What was recorded lies before it.
    assert (run.states("q")[:, 2] > CRITICAL).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_signed_rod_that_starts_beyond_is_stopped_before_its_first_step(method):
    b, contacts = rod("signed")
    run = started(b, rod_state(b, -0.6, 0.0), method)
    assert run.count[ki.STATUS] == ki.FORCES_REVERSED
    assert run.count[ki.STEPS] == 0
    t, _, words = paradox(b.system, new_workspace(b.system), run, contacts)
    assert t == 0.0
    # 5 − 3 cos 2θ + 3 μ sin 2θ = 0 solved for μ.
    least = (5.0 - 3.0 * np.cos(1.2)) / (3.0 * np.sin(1.2))
    check_message(words, "Painlevé", "tip", "contacts.friction", f"{least:.3g}")
    b, _ = rod("signed", friction=0.99 * least)
    assert started(b, rod_state(b, -0.6, 0.0), method, end=1e-3).count[ki.STATUS] == ki.FINISHED


@pytest.mark.parametrize("method", METHODS)
def test_a_dissipative_rod_is_stopped_where_a_second_solution_appears(method):
    """It trails and is pushed; beyond −critical a pulling force agrees with its friction as well."""
    b, contacts = rod("dissipative")
    run = started(b, rod_state(b, 0.0, 0.5), method)
    assert run.count[ki.STATUS] == ki.SEVERAL_FORCES
    t, y, words = paradox(b.system, new_workspace(b.system), run, contacts)
    check_message(words, "Painlevé", "tip", "contacts.friction")
    assert run.clock[ki.TIME] < t <= run.clock[ki.NOT_UNIQUE]
    # The smoothing speed turns the slip by 5e-8 of its direction, μ by as much; the state is linear over the step.
    assert b.part(y, "q")[2] == pytest.approx(-CRITICAL, abs=2e-6)
    solutions = contact_matrices(b.system, b.ws, 0.0, rod_state(b, 0.6, 0.0)).solutions()
    assert len(solutions) == 2
    assert solutions[0] * solutions[1] < 0.0


def test_signed_friction_goes_where_dissipative_friction_has_two_solutions():
    """The trailing rod is determined under the printed law: no false alarm."""
    b, _ = rod("signed")
    run = started(b, rod_state(b, 0.3, 0.5), "dopri5", end=0.1)
    assert run.count[ki.STATUS] == ki.FINISHED
    assert b.part(run.y, "q")[2] > -CRITICAL


def random_case(seed: int, friction: float, most: int = 3) -> tuple[CompiledSystem, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 9))
    robot = random_robot(rng, n)
    q = rng.normal(size=n)
    contacts = random_contacts(rng, robot, q, int(rng.integers(1, most + 1)))
    b = assemble(robot, [replace(contact, friction=friction * rng.random()) for contact in contacts])
    return b, b.state(q, rng.normal(size=n), rng.normal(size=len(robot.motors)))


def test_the_compiled_watch_agrees_with_its_definition():
    """Verdict of the kernel at the start against determinants and solutions by numpy, both laws mixed."""
    counts = {"unique": 0, "stopped": 0, "diagonal": 0}
    for seed in range(200):
        b, y = random_case(seed, friction=4.0)
        dy = b.derivative(y)
        if not np.isfinite(dy).all() or b.ws.counts[ka.DEPENDENT]:
            continue
        matrices = contact_matrices(b.system, b.ws, 0.0, y)
        values = [matrices.determinant(signs) for signs in matrices.choices()]
        if min(map(abs, values)) < 1e-6:
            continue
        run = b.advance(b.new_run(y, np.array([1.0]), "dopri5", step=1e-3), 0)
        if run.count[ki.STATUS] in (ki.NOT_PROJECTED, ki.NO_FORCES, ki.NOT_FINITE):
            continue
        matrices = contact_matrices(b.system, b.ws, 0.0, run.y)
        stopped = run.count[ki.STATUS] in (ki.FORCES_REVERSED, ki.SEVERAL_FORCES)
        assert stopped == (not matrices.unique()), seed
        marked = np.isfinite(run.extremes[:, ki.LOCAL_SINCE])
        np.testing.assert_array_equal(marked, matrices.reversed())
        counts["stopped" if stopped else "unique"] += 1
        counts["diagonal"] += marked.any() and not stopped
    assert min(counts.values()) >= 1, counts
    assert counts["stopped"] >= 20


def test_a_right_hand_side_does_not_depend_on_earlier_calls():
    """Unique forces: evaluated at A, at B, at A again, and in a fresh workspace, bit by bit."""
    compared, turned = 0, 0
    for seed in range(80):
        b, y = random_case(seed, friction=0.8)
        fresh, other = random_case(seed, friction=0.8)
        rng = np.random.default_rng(seed)
        for name in ("q", "v"):
            b.part(other, name)[:] += rng.normal(size=b.sizes[0])
        first = b.derivative(y).copy()
        signs = b.ws.rows[:, ka.SIGN].copy()
        b.derivative(other)
        turned += (signs != b.ws.rows[:, ka.SIGN]).any()
        again = b.derivative(y)
        if not np.isfinite(first).all() or not contact_matrices(b.system, b.ws, 0.0, y).unique():
            continue
        np.testing.assert_array_equal(first, again)
        fresh.ws.rows[:, ka.SIGN] = -1.0
        np.testing.assert_array_equal(first, fresh.derivative(y))
        compared += 1
    assert compared > 40
    assert turned > 5


def test_a_state_without_solution_leaves_nothing_behind():
    b, _ = rod("dissipative")
    y = rod_state(b, 0.1, 0.0)
    first = b.derivative(y)
    assert np.isfinite(first).all()
    assert np.isnan(b.derivative(rod_state(b, -0.6, 0.0))).any()
    np.testing.assert_array_equal(b.derivative(y), first)


def test_a_contact_without_load_has_no_sign():
    """Its force is rounding; whichever sign the search begins with, the other contact's force is the same, in bits."""
    slim = np.diag([0.1, 0.1, 0.1])
    links = (
        Link("slide", "x", None, "prismatic", X, Inertia(0.0)),
        Link("lift", "z", "slide", "prismatic", Z, Inertia(0.0)),
        Link("sledge", "lean", "lift", "revolute", Y, Inertia(1.3, np.array([0.37, 0.0, 0.21]), slim)),
    )
    unloaded = 0
    for height in np.linspace(0.1, 0.3, 30):
        # The force at foot 0, n − 0.3 t, passes through the centre of mass: nothing is left for foot 1.
        centre = np.array([0.37 - 0.3 * height, 0.0, height])
        sledge = replace(links[2], inertia=Inertia(1.3, centre, slim))
        robot = Robot("sledge", (*links[:2], sledge), (), ("sledge", np.zeros(3)))
        feet = [
            Contact(f"foot_{k}", "sledge", np.array([x, 0.0, 0.0]), FLOOR, friction=0.3, slip_smoothing=1e-12,
                    pulling_friction="dissipative") for k, x in enumerate((0.37, -0.4))
        ]  # fmt: skip
        b = assemble(robot, feet)
        y = b.state(np.zeros(3), np.array([1.0, 0.0, 0.0]))
        results = []
        for sign in (1.0, -1.0):
            b.ws.rows[:, ka.SIGN] = sign
            results.append(b.derivative(y).copy())
        force = b.ws.contacts[:, ka.NORMAL_FORCE]
        unloaded += abs(force[1]) < 1e-12 * abs(force[0])
        np.testing.assert_array_equal(*results)
    assert unloaded == 30


def table(friction: float, law: str = "dissipative", feet: int = 4) -> CompiledSystem:
    """A free body on four legs, 0.8 m × 0.6 m, 0.5 m high, its centre of mass off the middle."""
    names = ("x", "y", "z", "yaw", "pitch", "roll")
    axes, kinds = (X, Y, Z, Z, Y, X), ("prismatic",) * 3 + ("revolute",) * 3
    top = Inertia(5.0, np.array([0.05, -0.04, 0.5]), np.diag([0.15, 0.27, 0.4]))
    links = tuple(
        Link(name, name, None if k == 0 else names[k - 1], kinds[k], axes[k], top if k == 5 else Inertia(0.0))
        for k, name in enumerate(names)
    )
    corners = [(0.4, 0.3), (-0.4, 0.3), (-0.4, -0.3), (0.4, -0.3)][:feet]
    contacts = [
        Contact(f"foot_{k}", "roll", np.array([x, y, 0.0]), FLOOR, friction=friction, pulling_friction=law)
        for k, (x, y) in enumerate(corners)
    ]
    return assemble(Robot("table", links, (), ("roll", np.zeros(3))), contacts)


def sliding(b: CompiledSystem) -> np.ndarray:
    """Along x and turning."""
    return b.state(np.zeros(6), np.array([0.6, 0.1, 0.0, 2.0, 0.0, 0.0]))


@pytest.mark.parametrize("law", ["signed", "dissipative"])
def test_the_motion_of_a_table_on_four_legs_is_open(law):
    b = table(0.5, law)
    y = sliding(b)
    taken, low, high = acceleration_range(b.system, 0.0, y)
    np.testing.assert_array_equal(taken, b.part(b.derivative(y), "v"))
    assert b.ws.counts[ka.DEPENDENT] > 0
    # By hand: the splits are f0 + z (1, −1, 1, −1) to first order in friction; sampled along the null vector.
    matrices = contact_matrices(b.system, b.ws, 0.0, y)
    A = matrices.matrix(matrices.signs)
    null = np.linalg.svd(A)[2][-1]
    yaw, other = [], table(0.5, law)
    for z in np.linspace(-60.0, 60.0, 6001):
        force = matrices.force + z * null
        if (force >= 0.0).all():
            yaw.append(_yaw_acceleration(other, y, force))
    assert low[3] == pytest.approx(min(yaw), rel=5e-3)  # the sampling: 0.02 N of some 10 N
    assert high[3] == pytest.approx(max(yaw), rel=5e-3)
    assert low[3] < taken[3] < high[3]
    assert high[3] - low[3] > 0.5  # the size that makes it worth saying
    # Vertical motion is determined.
    np.testing.assert_allclose(low[[2, 4, 5]], high[[2, 4, 5]], rtol=0, atol=1e-9)
    spread = motion_spread(b.system, np.zeros(1), y[None], [(link.joint, link.units[2]) for link in b.robot.links])
    assert (spread.joint, spread.unit) == ("yaw", "rad/s²")
    assert (spread.low, spread.high, spread.taken) == (low[3], high[3], taken[3])


def _yaw_acceleration(b: CompiledSystem, y: np.ndarray, force: np.ndarray) -> float:
    """Newton and Euler about the vertical through the centre of mass of a body that lies level."""
    b.derivative(y)
    state, rows, centre = b.ws.contacts, b.ws.rows[: len(force)], np.array([0.05, -0.04])
    horizontal = force[:, None] * rows[:, ka.DIRECTION + 3 : ka.DIRECTION + 5]
    arm = state[:, ka.POSITION : ka.POSITION + 2] - centre
    return float((arm[:, 0] * horizontal[:, 1] - arm[:, 1] * horizontal[:, 0]).sum() / 0.4)


def test_no_spread_without_friction_or_with_three_legs():
    names = [(name, "") for name in "xyzuvw"]
    for b in (table(0.0), table(0.5, feet=3)):
        assert motion_spread(b.system, np.zeros(1), sliding(b)[None], names) is None


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("friction", "law"), [(0.0, "signed"), (0.4, "signed"), (0.4, "dissipative")])
def test_dependent_rows_are_no_paradox(method, friction, law):
    b = table(friction, law)
    run = started(b, sliding(b), method, end=0.02)
    assert run.count[ki.STATUS] == ki.FINISHED
    assert np.isinf(run.extremes[:, ki.LOCAL_SINCE]).all()


def test_a_point_that_no_joint_moves_along_its_normal_is_no_paradox():
    """Its row is rounding, of either sign: a body that yaws about a tilted axis on the plane across that axis."""
    for seed in range(20):
        axis = random_unit(np.random.default_rng(seed))
        link = Link("disc", "spin", None, "revolute", axis, Inertia(1.0, np.zeros(3), np.eye(3)))
        point = np.cross(axis, [0.3, 0.2, 0.1])
        foot = Contact("foot", "disc", point, Quadric(np.zeros((3, 3)), axis, 0.0), friction=0.9)
        for law in ("signed", "dissipative"):
            b = assemble(Robot("disc", (link,), (), ("disc", np.zeros(3))), [replace(foot, pulling_friction=law)])
            b.derivative(b.state(np.zeros(1), np.ones(1)))
            since, room = np.full(1, np.inf), np.zeros((ROOM, 1, 1))
            assert force_verdict(b.ws, room, since, 0.0) == UNIQUE
            assert np.isinf(since).all()


def test_a_contact_given_twice_is_stopped_like_one():
    b, (tip,) = rod("signed")
    twice = assemble(b.robot, [tip, replace(tip, name="tip again")])
    for lean, status in ((0.3, ki.RUNNING), (-0.6, ki.FORCES_REVERSED)):
        run = twice.advance(twice.new_run(rod_state(twice, lean, 0.0), np.array([1.0]), "dopri5", step=1e-3), 0)
        assert run.count[ki.STATUS] == status


ROD = """
duration_s: 0.5
plant:
  type: serial_arm
  gravity_m_s2: [1, 0, 9.81]      # the floor is a ceiling: it pulls, and signed friction drives the slip
  chain:
    - {kind: prismatic, axis: x, mass_kg: 0, length_m: 0}
    - {kind: prismatic, axis: z, mass_kg: 0, length_m: 0, initial_m: 0.41266780745}
    - {axis: y, mass_kg: 1, length_m: 0, com_m: [0, 0, 0], initial_deg: -34.37746770784939,
       inertia_kg_m2: [0.0833333, 0, 0, 0.0833333, 0, 0.0833333]}
surfaces: {floor: {type: plane}}
contacts:
  friction: 2
  pulling_friction: signed
  points: {tip: {body: link_3, point_m: [0, 0, -0.5]}}
"""


@pytest.mark.parametrize("method", METHODS)
def test_a_run_through_the_paradox_is_stopped_by_name_and_saved(tmp_path: Path, method):
    path = tmp_path / "rod.yaml"
    path.write_text(ROD)
    with raises(SimulationStopped, "Painlevé", "tip", "contacts.friction") as stop:
        dynsim.simulate(dynsim.load_scenario(str(path), overrides={"integrator.method": method}))
    error = stop.value
    assert error.exit_code == 3
    # dopri5 at rtol 1e-10 stops at 0.168686 s.
    assert error.time == pytest.approx(0.168686, abs=1e-5)
    assert not error.record.complete
    assert error.record.time[-1] == pytest.approx(0.165)
    assert np.isfinite(error.record["contact_normal_force"]).all()


YAWING = """
duration_s: 0.2
plant:
  type: serial_arm
  chain:
    - {axis: z, length_m: 0, motor: {type: wang_minami}}
    - {axis: y, count: 2, length_m: 0.4, damping_N_m_s_per_rad: 0.1}
  initial_deg: [0, 90, 0]
controller: {type: joint_pd, joints: {joint_1: {times_s: [0, 0.2], angles_deg: [0, 20]}}}
surfaces: {floor: {type: plane}}
contacts:
  friction: FRICTION
  points:
    near: {body: link_2, point_m: [0, 0, 0.2]}
    elbow: {body: link_3}
    tip: {body: link_3, point_m: [0, 0, 0.4]}
"""


@pytest.mark.parametrize("friction", [0.3, 0.0])
def test_a_summary_says_that_three_braces_on_two_joints_leave_the_yaw_open(tmp_path: Path, friction):
    path = tmp_path / "yawing.yaml"
    path.write_text(YAWING.replace("FRICTION", str(friction)))
    warnings = dynsim.simulate(dynsim.load_scenario(str(path))).summary["warnings"]
    assert lines_with(warnings, phrase="least norm")
    said = lines_with(warnings, phrase="motion open")
    assert len(said) == (friction > 0.0)
    assert all(mentions(text, "joint_1", "rad/s²") for text in said)


def test_a_reversed_diagonal_beside_a_positive_determinant_is_a_warning():
    """The forces are unique, and the summary says what they rest on."""
    scenario = dynsim.load_scenario("elbow_comparison", overrides={"duration_s": 0.02})
    prepared = simulation.prepare(scenario)
    driver.advance(prepared.system, prepared.workspace, prepared.run, 10**6)
    for since, expected in ((np.inf, []), (0.013, [("elbow_4", "0.013 s")])):
        prepared.run.extremes[0, ki.LOCAL_SINCE] = since  # as the watch does, see the random cases above
        warnings = recording.make_record(scenario, prepared, 1.0).summary["warnings"]
        said = lines_with(warnings, "Painlevé")
        assert [mentions(text, *names) for text in said for names in expected] == [True] * len(expected)
        assert len(said) == len(expected)


def test_dissipative_is_the_default_and_the_published_comparisons_name_their_own_law():
    for name in ("elbow_comparison", "elbow_comparison_vertical"):
        assert {contact.pulling_friction for contact in build.contacts(dynsim.load_scenario(name))} == {"signed"}
    assert {contact.pulling_friction for contact in build.contacts(dynsim.load_scenario("thirty_links"))} == {
        "dissipative"
    }
    assert Contact("c", "b", np.zeros(3), FLOOR).pulling_friction == "dissipative"


@pytest.mark.parametrize("variant", ["five_braces", "two_braces"])
def test_no_false_alarm_in_shipped_braces(simulated, variant):
    record = simulated("thirty_links", variant)
    assert record.complete
    assert not lines_with(record.summary["warnings"], "Painlevé")
    assert not lines_with(record.summary["warnings"], phrase="motion open")

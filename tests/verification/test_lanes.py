"""The right-hand side is fit for vectors of doubles: branches that look at the state are few, known, and listed here.

``derivative`` runs as Python on numbers of four lanes (``tests/lanes.py``), every line of it. What a lane gets must be
what a run of its own gets, to the bit, and every place that asks lanes for one truth must be in a list below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import lanes
import numpy as np
import pytest
from lanes import Divergent, Lanes, Notes, Place, select
from random_robots import Bench, bench, random_positions, random_robot, random_robot_of, random_unit, surface_through

from dynsim.kernels import arrays as ka
from dynsim.kernels import system
from dynsim.kernels.constraint.rows import set_modes
from dynsim.kernels.constraint.shapes import shaped_rows
from dynsim.kernels.constraint.splits import admissible_forces
from dynsim.kernels.constraint.unilateral import slide_direction
from dynsim.kernels.jit import integers, reals
from dynsim.model.description import Contact, Coupling, Inertia, Link, Load, Quadric, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource

N = 4

LIMIT = "limit of voltage, current or torque"
PIVOT, DEPENDENT = "choice of a pivot", "dependent rows"
CLOSED_FORM = "guard of a closed form; elimination else"
SEGMENT = "segment of a reference or load"

# Branches that are selects without another bit. FORMS below are the selects, and cases whose lanes disagree run them.
SELECT = {
    Place("constraint/m_star.py", "solve_m_star", "if factor != 0.0:"): "saves work alone: taking away zero is nothing",
    Place("constraint/surface.py", "surface_distance", "if inner <= 0.0:"): "curved surface: no root along the normal",
    Place("drive/limit.py", "clipped", "if x.real > limit:"): LIMIT,
    Place("drive/limit.py", "clipped", "if x.real < -limit:"): LIMIT,
    Place("drive/servo.py", "servo_circuit", "if i != wanted:"): "voltage of a servo at its limit of current",
}
# Branches whose lanes must agree. Where they do not, the lanes are evaluated one by one.
FALLBACK = {
    Place("constraint/delassus.py", "solve_small", "if p == 1 and small[0, 0, 0] != 0.0:"): CLOSED_FORM,
    Place(
        "constraint/delassus.py", "solve_small", "if abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)):"
    ): CLOSED_FORM,
    Place("constraint/delassus.py", "eliminate", "if abs(small[1, i, k]) > abs(small[1, best, k]):"): PIVOT,
    Place("constraint/delassus.py", "eliminate", "if abs(small[1, best, k]) <= RANK_TOLERANCE * largest:"): DEPENDENT,
    Place(
        "constraint/delassus.py",
        "eliminate",
        "least_norm(small, state, active, p, k if least > POOR_PIVOT * largest else 0, largest)",
    ): DEPENDENT,
    Place(
        "constraint/delassus.py",
        "eliminate_to_rank",
        "while last > k and abs(matrix[largest_in_column(matrix, last, k, p), last]) <= RANK_TOLERANCE * largest:",
    ): DEPENDENT,
    Place(
        "constraint/delassus.py", "eliminate_to_rank", "if abs(matrix[row, column]) <= RANK_TOLERANCE * largest:"
    ): DEPENDENT,
    Place("constraint/delassus.py", "eliminate_to_rank", "if abs(matrix[row, j]) > abs(matrix[row, other]):"): PIVOT,
    Place(
        "constraint/delassus.py", "largest_in_column", "if abs(matrix[i, column]) > abs(matrix[best, column]):"
    ): PIVOT,
    Place(
        "constraint/surface.py",
        "sign_changed",
        "if agreement < -NO_FORCE * largest or (agreement <= NO_FORCE * largest and rows[k, SIGN] < 0.0):",
    ): "search for the signs of dissipative friction",
}
# Branches on time, which is one number for all lanes. Lanes at times of their own must lie in one segment.
TIME = {
    Place("drive/law.py", "evaluate_reference", "segment = min(max(int(x / spacing), 0), c.shape[0] - 1)"): SEGMENT,
    Place("drive/law.py", "fed_forward", "k = min(max(int(x / grid[1]), 0), voltage.shape[0] - 1)"): SEGMENT,
    Place("tree/loads.py", "segment_start", "if t < loads.data[first] or t >= end:"): SEGMENT,
    Place("tree/loads.py", "segment_start", "if loads.data[first + middle * SEGMENT_SIZE] <= t:"): SEGMENT,
}
# Lines that no state comes to, as far as is known; they do not branch.
AGAIN = "M* begins with the signs that the articulated solve has found: only rounding could turn one"
COMPOUND = "for the compiler: systems whose joints are all single rows do not call it"
# The law of real contact has no lanes yet, nor have candidates that are more than points on quadrics.
WITHOUT_LANES = (admissible_forces, slide_direction, shaped_rows)
UNILATERAL = "the cases here are of the bilateral law"
NEVER = {
    Place(
        "constraint/surface.py",
        "contact_rows",
        "sx, sy, sz, mu = slide_direction(unilateral, contacts, k, tx, ty, tz)",
    ): UNILATERAL,
    Place("constraint/surface.py", "contact_rows", "rows[m, ROW_MU] = mu"): UNILATERAL,
    Place("tree/joints.py", "read_positions", "return"): COMPOUND,
    Place("tree/joints.py", "position_rates", "return"): COMPOUND,
    Place("tree/joints.py", "sweep_row", "return"): COMPOUND,
    Place("system.py", "m_star_acceleration", "passes += 1"): AGAIN,
    Place("system.py", "m_star_acceleration", "solve_m_star(dense, model, drives, ws)"): AGAIN,
}


def clipped_lanes(x, limit):
    return select(x.real > limit, limit, select(x.real < -limit, -limit, x))


def servo_circuit_lanes(motor, a, mode, command, v):
    if mode == ka.OFF:
        return motor[a, ka.K_M] * v, 0.0 * v
    u = clipped_lanes(command, motor[a, ka.U_MAX])
    wanted = (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]
    i = clipped_lanes(wanted, motor[a, ka.I_MAX])
    return select(i != wanted, motor[a, ka.RESISTANCE] * i + motor[a, ka.K_M] * v, u), i


def surface_distance_lanes(value, slope, curvature):
    inner = 1.0 - 2.0 * curvature * value / (slope * slope)
    return select(inner <= 0.0, value / slope, 2.0 * value / (slope * (1.0 + lanes.MATH.sqrt(inner))))


FORMS = {
    "clipped": clipped_lanes,
    "servo_circuit": servo_circuit_lanes,
    "surface_distance": surface_distance_lanes,
}


@dataclass
class Case:
    """States of a system about one, at a time."""

    bench: Bench
    y: np.ndarray
    spread: float  # of the lanes about y
    t: float = 0.0
    t_step: float = 0.0  # of time from lane to lane; 0: one time for all


def plane(rng: np.random.Generator, body: str, law: str = "signed", friction: float = 0.2) -> Contact:
    surface = Quadric(np.zeros((3, 3)), random_unit(rng), rng.normal())
    name = f"{body} {rng.integers(10**6)}"
    return Contact(name, body, rng.normal(scale=0.3, size=3), surface, friction=friction, pulling_friction=law)


def random_state(rng: np.random.Generator, b: Bench) -> np.ndarray:
    y = b.state(random_positions(rng, b.robot), rng.normal(size=len(b.robot.links)))
    current = b.part(y, "current")
    current[:] = rng.normal(size=current.shape)
    return y


def of(rng: np.random.Generator, b: Bench, spread: float, **keys: Any) -> Case:
    return Case(b, random_state(rng, b), spread, **keys)


def on_planes(
    n: int,
    count: int,
    law: str = "signed",
    *,
    seed: int = 0,
    spread: float = 1.0,
    friction: float = 0.2,
    twice: bool = False,
    m_star: bool = False,
) -> Case:
    """A tree with points of its last bodies on planes, the first of them ``twice``."""
    rng = np.random.default_rng(seed)
    contacts = [plane(rng, f"body_{n - 1 - k % n}", law, friction) for k in range(count)]
    if twice:
        contacts[1] = replace(contacts[0], name="again")
    return of(rng, bench(random_robot(rng, n), contacts, m_star=m_star), spread)


def free(seed: int = 0) -> Case:
    rng = np.random.default_rng(seed)
    return of(rng, bench(random_robot(rng, 8)), 1.0)


def every_joint() -> Case:
    rng = np.random.default_rng(1)
    return of(
        rng,
        bench(random_robot_of(rng, ["ball", "rolling", "planar", "floating", "wheeled", "prismatic", "revolute"])),
        1.0,
    )


def held(modes: list[int]) -> Case:
    """Points that stick, slide and are off their planes."""
    case = on_planes(7, len(modes), seed=2, spread=1e-3)
    stick(case, modes)
    return case


def stick(case: Case, modes: list[int]) -> None:
    """Give the contacts modes; those that stick do so where they are."""
    b = case.bench
    _, b.ws = run(case, [case.y], 0.0)
    lanes.plain(set_modes)(b.system.contacts, b.system.couplings, None, b.ws, integers(modes))


def curved() -> Case:
    """A sphere, a cylinder, and a level set that is nowhere zero."""
    rng = np.random.default_rng(3)
    surfaces = [
        surface_through(rng, "sphere", rng.normal(size=3)),
        surface_through(rng, "cylinder", rng.normal(size=3)),
    ]
    surfaces.append(Quadric(np.eye(3), np.zeros(3), 0.8))
    contacts = [
        replace(plane(rng, f"body_{3 + k}"), surface=surface, name=str(k)) for k, surface in enumerate(surfaces)
    ]
    return of(rng, bench(random_robot(rng, 6, branches=False), contacts), 1e-3)


def saddle() -> Case:
    """A surface that bends both ways, of which some lanes are too far for a distance along its normal."""
    rng = np.random.default_rng(9)
    contact = replace(plane(rng, "body_5"), surface=Quadric(np.diag([1.0, 0.5, -2.0]), np.zeros(3), -0.5))
    return of(rng, bench(random_robot(rng, 6, branches=False), [contact]), 1.0)


def coupled(m_star: bool = False) -> Case:
    """Joints that follow others up and down the tree, and a point that sticks to a body that moves."""
    rng = np.random.default_rng(4)
    robot = random_robot(rng, 8)
    couplings = (Coupling("joint_6", "joint_2", 0.7, 0.1), Coupling("joint_1", "joint_7", -1.3))
    b = bench(replace(robot, couplings=couplings), [plane(rng, "body_5")], m_star=m_star)
    case = of(rng, b, 1e-3)
    if not m_star:
        stick(case, [ka.STICKING])
    b.ws.active[2:, ka.BODY_B] = 3
    return case


def driven(t: float, t_step: float = 0.0) -> Case:
    """References by splines, held and rewritten; wrenches that are constant, end, and are held."""
    rng = np.random.default_rng(5)
    robot = replace(
        random_robot(rng, 5, motors=False),
        motors=tuple(Motor(f"joint_{k}", 0.2, 1.3, 2e-3, 1e-4, 7.0, 1e-3) for k in range(4)),
    )
    knots, coefficients = np.array([0.1, 0.4, 0.9, 1.6]), rng.normal(size=(3, 6, 4))
    loads = [
        Load("none", "body_4", rng.normal(size=3), False, np.zeros(1), np.zeros((0, 6, 4)), False),
        Load("ends", "body_3", rng.normal(size=3), True, knots, coefficients, False),
        Load("held", "body_2", rng.normal(size=3), False, knots, coefficients, True),
    ]
    b = bench(robot, loads=loads)
    reference = ka.ReferenceArrays(
        integers([0, ka.HELD_POSITION, 1, ka.REWRITTEN]),
        reals(rng.normal(size=4)),
        reals([0.0, 0.5]),
        reals(rng.normal(size=(4, 2, 6))),
        reals(rng.normal(size=(4, 4, 6))),
    )
    b.system = b.system._replace(reference=reference)
    b.system.drives.input[3, [ka.LINE_START, ka.LINE_RATE, ka.LINE_SINCE]] = rng.normal(size=3)
    return of(rng, b, 1.0, t=t, t_step=t_step)


def limited() -> Case:
    """Motors of which some lanes are at their limits."""
    rng = np.random.default_rng(6)
    robot = random_robot(rng, 6)
    motors = tuple(replace(motor, voltage_limit=15.0) for motor in robot.motors)
    return of(rng, bench(replace(robot, motors=motors)), 1.0)


def servos() -> Case:
    """Every kind of drive and mode of a servo."""
    rng = np.random.default_rng(7)
    robot = random_robot_of(rng, ["revolute"] * 6)
    common: dict[str, Any] = {"torque_constant": 1.9, "resistance": 2.3, "coulomb_friction": 0.3, "free_drag": 0.1}
    motors = (
        Servo("joint_0", k_p=6.0, k_d=0.2, voltage_limit=8.0, current_limit=2.0, **common),
        Servo("joint_1", k_p=0.0, k_v=5.0, velocity_mode=True, **common),
        Servo("joint_2", k_p=40.0, **common),
        Motor("joint_3", 0.2, 1.3, 2e-3, 1e-4, 7.0, 1e-3),
        TorqueSource("joint_4", 0.3),
        Servo("joint_5", k_p=40.0, voltage_limit=0.5, **common),
    )
    b = bench(replace(robot, motors=motors), held=rng.normal(size=6))
    b.system.drives.table[2, ka.SERVO_MODE] = ka.OFF
    b.system.drives.table[5, ka.SAMPLED] = 1
    b.system.drives.input[5, ka.COMMAND] = 0.7
    return of(rng, b, 1.0)


def unmoved() -> Case:
    """A point of a slide along x on a floor: a system of one row that is zero."""
    x, z = np.eye(3)[0], np.eye(3)[2]
    robot = Robot("slide", (Link("body", "joint", None, "prismatic", x, Inertia(1.0)),), (), ("body", np.zeros(3)))
    b = bench(robot, [Contact("foot", "body", np.zeros(3), Quadric(np.zeros((3, 3)), z, 0.0))])
    return of(np.random.default_rng(8), b, 1.0)


# Name → states. Spread widely; by little where lanes must agree; not at all where rounding decides on pivots.
CASES: dict[str, Callable[[], Case]] = {
    "free arm": free,
    "every joint": every_joint,
    "one brace": lambda: on_planes(5, 1),
    "two braces": lambda: on_planes(6, 2),
    "two braces, M*": lambda: on_planes(6, 2, m_star=True),
    "curved": curved,
    "saddle": saddle,
    "references and loads": lambda: driven(0.7),
    "references and loads at their end": lambda: driven(3.0),
    "voltage limits": limited,
    "servos": servos,
    "held, sliding, off": lambda: held([ka.STICKING, ka.OPEN, ka.SLIDING]),
    "sliding, held, held": lambda: held([ka.SLIDING, ka.STICKING, ka.STICKING]),
    "coupled": coupled,
    "coupled, M*": lambda: coupled(m_star=True),
    "dissipative": lambda: on_planes(6, 3, "dissipative", seed=1, spread=1e-4),
    "dissipative, M*": lambda: on_planes(6, 3, "dissipative", seed=1, spread=1e-4, m_star=True),
    "no choice of signs": lambda: on_planes(6, 3, "dissipative", seed=1, spread=1e-6, friction=3.0, m_star=True),
    "dependent": lambda: on_planes(3, 5, spread=0.0),
    "very dependent": lambda: on_planes(2, 6, spread=0.0, twice=True),
    "twice the same point": lambda: on_planes(5, 9, spread=0.0, twice=True),
    "unmoved": unmoved,
}
TIMED = {
    "times of their own": lambda: driven(0.7, 0.01),
    "times of their own, at the end": lambda: driven(3.0, 0.01),
}


def run(case: Case, states: list[np.ndarray], t: Any, **forms: Callable[..., Any]) -> tuple[np.ndarray, ka.Workspace]:
    """Derivative and workspace of states as lanes, or of one state as it is; kernels replaced by their ``forms``."""
    b, count = case.bench, len(states)
    parts, ws, dense = b.system, lanes.copies(b.ws), lanes.copies(b.system.dense)
    y, dy = states[0], np.zeros_like(states[0])
    if count > 1:
        parts, ws, dense = lanes.constants(parts), lanes.in_lanes(ws, count), lanes.in_lanes(dense, count)
        y, dy = lanes.stacked(states), lanes.stacked([dy] * count)
    with pytest.MonkeyPatch.context() as patches, np.errstate(all="ignore"):
        lanes.patch(patches, system.derivative, **forms)
        lanes.plain(system.derivative)(parts._replace(dense=dense), t, y, ws, dy)
    return dy, ws


def spread(case: Case, rng: np.random.Generator) -> list[np.ndarray]:
    """N states about that of the case."""
    scale = np.where(np.arange(len(case.y)) < case.bench.system.layout.tracked, case.spread, 0.0)
    return [case.y + scale * rng.normal(size=len(case.y)) for _ in range(N)]


@pytest.fixture(scope="module")
def notes() -> dict[str, Notes]:
    """What each case asks of lanes, which are equal here, and the lines that it runs."""
    found = {}
    for name, make in {**CASES, **TIMED}.items():
        case = make()
        with lanes.noted() as found[name]:
            run(case, [case.y] * N, Lanes([case.t] * N) if name in TIMED else case.t)
    return found


def union(sets: Iterable[set[Any]]) -> set[Any]:
    return set[Any]().union(*sets)


@pytest.mark.parametrize("name", [*CASES, *TIMED])
def test_a_lane_gets_what_a_run_of_its_own_gets(name):
    """Derivative and workspace, to the bit, with FORMS in place of what they are selects of."""
    case = (CASES | TIMED)[name]()
    states = spread(case, np.random.default_rng(99))
    times = [case.t + k * case.t_step for k in range(N)]
    dy, ws = run(case, states, Lanes(times) if name in TIMED else case.t, **FORMS)
    for k in range(N):
        dy_alone, alone = run(case, [states[k]], times[k])
        np.testing.assert_array_equal(lanes.lane(dy, k), dy_alone)
        for in_lanes, table in zip(ws, alone, strict=True):
            np.testing.assert_array_equal(lanes.lane(in_lanes, k), table)
    if case.spread > 0.0:
        assert not np.array_equal(lanes.lane(dy, 0), lanes.lane(dy, 1))


def test_every_line_of_the_right_hand_side_runs(notes):
    """So no branch is missing below because no case comes to it."""
    ran = union(note.lines for note in notes.values())
    reached = union(lanes.lines(function) for function in lanes.reached(system.derivative, WITHOUT_LANES))
    assert len(reached) > 500
    assert {line.place() for line in reached - ran} == {*NEVER}


def test_branches_on_the_state_are_known(notes):
    """A new branch: make it a select (min, max, or arithmetic), or list it with the reason why it may be there."""
    assert union(notes[name].asked for name in CASES) == {*SELECT, *FALLBACK}
    for name in ("free arm", "every joint", "references and loads", "voltage limits", "servos"):
        assert notes[name].asked <= {*SELECT}


def test_branches_on_time_are_known(notes):
    assert union(notes[name].asked for name in TIMED) - {*SELECT} == {*TIME}


@pytest.mark.parametrize(
    ("name", "places"),
    [("voltage limits", SELECT), ("servos", SELECT), ("saddle", SELECT), ("dissipative", FALLBACK), ("held", FALLBACK)],
)
def test_lanes_that_disagree_are_seen(name, places):
    """At a listed place, not by a wrong number."""
    case = held([ka.STICKING, ka.SLIDING]) if name == "held" else CASES[name]()
    case.spread = 1.0
    found = []
    for seed in range(20):
        try:
            run(case, spread(case, np.random.default_rng(seed)), case.t)
        except Divergent as divergent:
            found.append(divergent.place)
    assert found
    assert {*found} <= {*places}


def test_integers_are_apart_from_reals(notes):
    """Tables of integers hold nothing else, tables of reals no integers, and nothing takes a real for one."""
    assert union(note.kinds for note in notes.values()) == set()
    found = set()
    for make in CASES.values():
        case = make()
        _, ws = run(case, [case.y] * N, case.t)
        for name, table in ws._asdict().items():
            expected = getattr(case.bench.ws, name).dtype
            assert {type(x) is int for x in table.flat} <= {expected == np.int64}, name
            found.add((name, expected == np.int64))
    assert {name for name, integer in found if integer} == {"active", "counts"}


def test_lanes_are_no_index():
    """What a kernel may not do with a real fails, so the runs above have not done it."""
    x = Lanes([1.0] * N)
    with pytest.raises((TypeError, IndexError)):
        np.zeros(3)[x]
    with pytest.raises(TypeError):
        range(x)
    with pytest.raises((TypeError, IndexError)):
        np.zeros(3)[lanes.Constant(1.0)]
    with pytest.raises(TypeError):
        np.zeros(3)[0] = x

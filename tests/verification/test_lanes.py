"""List of the branches of the right-hand side that depend on state or time, with their treatment in SIMD code.

``derivative`` runs as Python on four states at once (``tests/support/lanes.py``), every line at least once. Each lane
must equal, bit for bit, a run with its state alone. A line that needs one truth value for all lanes must be listed.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from support import lanes
from support.lane_cases import CASES, TIMED, Case, held, run
from support.lanes import Divergent, Lanes, Notes, Place, select

from dynsim.dynamics import derivative as system
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.delassus import admissible_forces, solve_dependent
from dynsim.dynamics.contact.rows import shaped_rows
from dynsim.dynamics.contact.shares import solve_near_shares
from dynsim.dynamics.contact.unilateral import slide_direction

N = 4

LIMIT = "limit of voltage, current or torque"
PIVOT, DEPENDENT = "choice of a pivot", "dependent rows"
CLOSED_FORM = "guard of a closed form; elimination else"
SEGMENT = "segment of a reference or load"

# Branches that a select for each lane replaces, bit for bit. FORMS below are these selects; cases whose lanes differ
# run them.
SELECT = {
    Place("contact/m_star.py", "solve_m_star", "if factor != 0.0:"): "saves work alone: taking away zero is nothing",
    Place("contact/quadrics.py", "surface_distance", "if inner <= 0.0:"): "curved surface: no root along the normal",
    Place("drive/limit.py", "clipped", "if x.real > limit:"): LIMIT,
    Place("drive/limit.py", "clipped", "if x.real < -limit:"): LIMIT,
    Place("drive/servo.py", "servo_circuit", "if i != wanted:"): "voltage of a servo at its limit of current",
}
# Branches whose lanes must agree. If they do not, the lanes are evaluated one by one.
FALLBACK = {
    Place(
        "contact/delassus.py", "solve_small", "if p == 1 and abs(small[0, 0, 0]) > state[0, ka.ROW_FLOOR]:"
    ): CLOSED_FORM,
    Place(
        "contact/delassus.py", "solve_small", "if p == 1 and abs(small[0, 0, 0]) <= state[0, ka.ROW_FLOOR]:"
    ): CLOSED_FORM,
    Place(
        "contact/delassus.py", "solve_small", "if abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)) + floors:"
    ): CLOSED_FORM,
    Place("contact/delassus.py", "eliminate", "if abs(small[1, i, k]) > abs(small[1, best, k]):"): PIVOT,
    Place("contact/delassus.py", "eliminate", "if abs(small[1, best, k]) <= RANK_TOLERANCE * largest:"): DEPENDENT,
    Place(
        "contact/delassus.py",
        "eliminate_to_rank",
        "while last > k and abs(matrix[largest_in_column(matrix, last, k, p), last]) <= RANK_TOLERANCE * largest:",
    ): DEPENDENT,
    Place(
        "contact/delassus.py", "eliminate_to_rank", "if abs(matrix[row, column]) <= RANK_TOLERANCE * largest:"
    ): DEPENDENT,
    Place("contact/delassus.py", "eliminate_to_rank", "if abs(matrix[row, j]) > abs(matrix[row, other]):"): PIVOT,
    Place("contact/delassus.py", "largest_in_column", "if abs(matrix[i, column]) > abs(matrix[best, column]):"): PIVOT,
    Place(
        "contact/quadrics.py",
        "sign_changed",
        "if agreement < -NO_FORCE * largest or (agreement <= NO_FORCE * largest and rows[k, ka.SIGN] < 0.0):",
    ): "search for the signs of dissipative friction",
}
# Branches on time, which is one number for all lanes. Lanes at separate times must be in one segment.
TIME = {
    Place("drive/law.py", "evaluate_reference", "segment = min(max(int(x / spacing), 0), c.shape[0] - 1)"): SEGMENT,
    Place("drive/law.py", "fed_forward", "k = min(max(int(x / grid[1]), 0), voltage.shape[0] - 1)"): SEGMENT,
    Place("tree/loads.py", "segment_start", "if t < loads.data[first] or t >= end:"): SEGMENT,
    Place("tree/loads.py", "segment_start", "if loads.data[first + middle * SEGMENT_SIZE] <= t:"): SEGMENT,
}
# Lines that no known state reaches; they do not branch.
AGAIN = "M* begins with the signs that the articulated solve has found: only rounding could turn one"
# Unilateral contact has separate forms, which test_lanes_compiled runs; bodies larger than points have no lanes.
WITHOUT_LANES = (admissible_forces, slide_direction, shaped_rows, solve_near_shares, solve_dependent)
UNILATERAL = "the cases here are of the bilateral law"
NEVER = {
    Place("contact/quadrics.py", "contact_rows", "x, y, z, mu = slide_direction(unilateral, contacts, k, slip, n)"): (
        UNILATERAL
    ),
    Place("contact/quadrics.py", "contact_rows", "t = x, y, z"): UNILATERAL,
    Place("contact/quadrics.py", "contact_rows", "rows[m, ka.ROW_MU] = mu"): UNILATERAL,
    Place("contact/shares.py", "solve_rows", "if unilateral.number[ku.SHARED] == 1.0:"): UNILATERAL,
    Place("contact/shares.py", "solve_rows", "return solve_near_shares(unilateral, ws, p)"): UNILATERAL,
    Place("contact/shares.py", "solve_rows", "if unilateral.number[ku.REDUNDANT] == 1.0:"): UNILATERAL,
    Place("contact/shares.py", "solve_rows", "return solve_dependent(ws.small, ws.rows, ws.active, p)"): UNILATERAL,
    Place("contact/shares.py", "solve_rows", "return solve_small(ws.small, ws.rows, ws.active, p)"): UNILATERAL,
    Place("derivative.py", "m_star_acceleration", "passes += 1"): AGAIN,
    Place("derivative.py", "m_star_acceleration", "solve_m_star(dense, model, drives, unilateral, ws)"): AGAIN,
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


def spread(case: Case, rng: np.random.Generator) -> list[np.ndarray]:
    """N states around the state of the case."""
    scale = np.where(np.arange(len(case.y)) < case.compiled.system.layout.tracked, case.spread, 0.0)
    return [case.y + scale * rng.normal(size=len(case.y)) for _ in range(N)]


@pytest.fixture(scope="module")
def notes() -> dict[str, Notes]:
    """What each case asks of lanes, which are equal here, and the lines that it runs."""
    noted = {}
    for name, make in {**CASES, **TIMED}.items():
        case = make()
        with lanes.noted() as noted[name]:
            run(case, [case.y] * N, Lanes([case.t] * N) if name in TIMED else case.t)
    return noted


def union(sets: Iterable[set[Any]]) -> set[Any]:
    return set[Any]().union(*sets)


@pytest.mark.parametrize("name", [*CASES, *TIMED])
def test_a_lane_gets_what_a_run_of_its_own_gets(name):
    """Derivative and workspace are bit-identical, with FORMS in place of the kernels that they replace."""
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
    """So no branch is missing below because no case reaches it."""
    ran = union(note.lines for note in notes.values())
    reached = union(lanes.lines(function) for function in lanes.reached(system.derivative, WITHOUT_LANES))
    assert len(reached) > 500
    assert {line.location() for line in reached - ran} == {*NEVER}


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
    divergences = []
    for seed in range(20):
        try:
            run(case, spread(case, np.random.default_rng(seed)), case.t)
        except Divergent as divergent:
            divergences.append(divergent.place)
    assert divergences
    assert {*divergences} <= {*places}


def test_integers_are_apart_from_reals(notes):
    """Tables of integers hold nothing else, tables of reals no integers, and nothing takes a real for one."""
    assert union(note.kinds for note in notes.values()) == set()
    kinds = set()
    for make in CASES.values():
        case = make()
        _, ws = run(case, [case.y] * N, case.t)
        for name, table in ws._asdict().items():
            expected = getattr(case.compiled.ws, name).dtype
            assert {type(x) is int for x in table.flat} <= {expected == np.int64}, name
            kinds.add((name, expected == np.int64))
    assert {name for name, integer in kinds if integer} == {"active", "counts"}


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

"""Forces with which the head pushes: Tables IV and V of [T], V.C.

Nothing is tuned; docs/validation/snake.md lists the differences.
"""

import csv

import numpy as np
import pytest
from scipy.optimize import least_squares

from dynsim import load_scenario, simulate
from dynsim.draw.figures.snake import draw_comparison
from dynsim.scenario import build, shipped_scenarios, variant_names
from dynsim.snake.description import SnakeDescription
from dynsim.snake.kinematics import pose_of_point
from dynsim.snake.published import PLATE, PUSHES, TABLE_IV, TABLE_V, Push, push_table, pushed

SCENARIO = "snake_push"
POSTURES = TABLE_V | TABLE_IV
# Nothing within the limits of the joints has y_h = 0.2.
MISSING = ("viii", "x")
THERE = tuple(posture for posture in POSTURES if posture not in MISSING)
STRAIGHT = tuple(posture for posture in THERE if not POSTURES[posture].l_shape)
# Target of the last pitch joint of the head part, [T] IV.C.3 [rad].
LAST_PITCH = np.deg2rad(110.0)
# Number of starts of the search for a posture; 20 starts find all solutions that 300 starts find.
STARTS = 60


def push_posture(d: SnakeDescription, push: Push) -> np.ndarray | None:
    """Return the joint angles of a push-test posture, shape (n_phi,) [rad], or None without a solution.

    The paper specifies only z_h, y_h and the shape of the base part. The head is level and points along x, psi3 is at
    its target, and the two joints in the middle of the base part share the bend (assumed). The other five head joints
    determine five coordinates. Among several solutions within the limits, the solution with the smallest angles is
    used.
    """
    model, base = d.arrays(), np.zeros(d.base_joints)
    if push.l_shape:
        base[[2, 3]] = np.pi / 4.0
    wanted = np.array([push.beside, push.height, 0.0, 0.0, 0.0])

    def posture(angles: np.ndarray) -> np.ndarray:
        return np.concatenate([angles, [LAST_PITCH], base])

    def off(angles: np.ndarray) -> np.ndarray:
        w = np.zeros(6)
        pose_of_point(model, np.zeros(3), posture(angles), np.zeros((3, 3)), w)
        return w[1:] - wanted

    random, best = np.random.default_rng(0), None
    lower, upper = d.lower[:5], d.upper[:5]
    for _ in range(STARTS):
        solution = least_squares(
            off, random.uniform(lower, upper), bounds=(lower, upper), xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        if np.abs(solution.fun).max() < 1e-9 and (best is None or solution.x @ solution.x < best @ best - 1e-9):
            best = solution.x
    return None if best is None else posture(best)


def test_variants_are_the_postures_that_exist_in_three_directions():
    (path,) = (path for path in shipped_scenarios() if path.stem == SCENARIO)
    assert set(variant_names(path)) == {f"{posture}_{direction}" for posture in THERE for direction in PUSHES}


@pytest.mark.parametrize("posture", ["i", "ii", "iii", "vii"])
def test_joints_of_the_scenario_are_those_that_the_search_finds(posture):
    """The base part does not change them; those of the L-shape are compared with those of the straight one."""
    computed = push_posture(build.robot(load_scenario(SCENARIO, f"{posture}_x")).description, POSTURES[posture])
    for same in THERE:
        if POSTURES[same][:2] == POSTURES[posture][:2]:
            for direction in PUSHES:
                phi = build.robot(load_scenario(SCENARIO, f"{same}_{direction}")).description.initial_joints
                np.testing.assert_allclose(phi[:6], computed[:6], atol=1e-6)
                bend = np.pi / 4.0 if POSTURES[same].l_shape else 0.0
                np.testing.assert_allclose(phi[6:], [0.0, 0.0, bend, bend, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("posture", MISSING)
def test_no_posture_is_found_for_the_widest_offset(posture):
    assert push_posture(build.robot(load_scenario(SCENARIO, "ii_x")).description, POSTURES[posture]) is None


@pytest.mark.parametrize("posture", THERE)
def test_the_plate_is_where_the_scenario_says(posture):
    """0.2 m ahead of the head at t = 0, 1 mm beside it, 1 mm below it; and the target goes 120 mm into it."""
    for direction, gap in zip(PUSHES, (0.2, 1e-3, 1e-3), strict=True):
        scenario = load_scenario(SCENARIO, f"{posture}_{direction}", {"duration_s": 0.01})
        record = simulate(scenario)
        assert record["contact_gap"][0, record.labels["contact_gap"].index(PLATE)] == pytest.approx(gap, abs=5e-5)
        (path,) = scenario.config.controller.paths
        np.testing.assert_allclose(path.displacement[:3], (gap + 0.12) * np.array(PUSHES[direction]), atol=1e-9)
        assert np.linalg.norm(path.displacement) / path.duration_s == pytest.approx(0.03, rel=1e-4)


@pytest.fixture(scope="module")
def short():
    """Posture (ii) pushes down until the target is 29 mm within the plate."""
    return simulate(load_scenario(SCENARIO, "ii_z", {"duration_s": 2.0}))


def test_a_push_is_taken_where_the_target_came_to(short):
    """No deeper than it went: the table's depth is beyond it. The plate's spring gives direction by f/k."""
    result = pushed(short, "z")
    assert result.depth == pytest.approx(0.029, abs=2e-4)
    assert not result.stop_acted
    sunk = -short["contact_gap"][-1, short.labels["contact_gap"].index(PLATE)]
    assert result.force == pytest.approx(3e4 * sunk, rel=0.02)
    assert 1.0 < result.force < 12.1


def test_largest_force_and_stops_are_those_of_the_record(short):
    """A push along y takes the largest force; of the stops only what they carry while the head touches."""
    force = short["contact_normal_force"][:, short.labels["contact_normal_force"].index(PLATE)]
    assert pushed(short, "y").force == force.max()
    kept = short["stop_force"].copy()
    try:
        short["stop_force"][np.flatnonzero(force == 0.0)[0], 0] = -1.0
        assert not pushed(short, "z").stop_acted
        short["stop_force"][-1, 0] = -1.0
        assert pushed(short, "z").stop_acted
    finally:
        short["stop_force"][:] = kept


def test_tables_have_paper_and_simulation_side_by_side(short, tmp_path):
    """Posture (ii) is in both of them."""
    draw_comparison({"ii_z": short}, tmp_path)
    for name in ("table_iv", "table_v"):
        with (tmp_path / f"{name}.csv").open() as file:
            (row,) = csv.DictReader(file)
        assert list(row) == [
            "posture", "direction", "paper_mean", "paper_sd", "simulated", "depth_m", "start", "stop_acted",
        ]  # fmt: skip
        assert [row[k] for k in ("posture", "direction", "start", "stop_acted")] == ["ii", "-z", "soft", "no"]
        assert (float(row["paper_mean"]), float(row["paper_sd"])) == (12.1, 0.1)
        assert float(row["simulated"]) == pytest.approx(pushed(short, "z").force, abs=1e-3)
        assert float(row["depth_m"]) == pytest.approx(0.029, abs=2e-4)
    assert len(push_table(TABLE_IV, {})) == 1


@pytest.fixture
def force(simulated):
    return lambda posture, direction: pushed(simulated(SCENARIO, f"{posture}_{direction}"), direction).force


@pytest.mark.long
@pytest.mark.parametrize("posture", STRAIGHT)
def test_forward_push_of_a_straight_robot_is_that_of_the_paper(force, posture):
    """To 6 %; to 15.1 % with the head 0.1 m to the side, (vii)."""
    off = 0.06 if POSTURES[posture].beside == 0.0 else 0.155
    assert force(posture, "x") == pytest.approx(POSTURES[posture].mean[0], rel=off)


@pytest.mark.long
@pytest.mark.parametrize("postures", [("i", "ii", "iii"), pytest.param(("iv", "v", "vi"), marks=pytest.mark.slow)])
def test_a_lower_head_pushes_harder_forward_and_less_down(force, postures):
    """As published; an L-shape pushes less than a straight base part of the same height."""
    assert np.all(np.diff([force(posture, "x") for posture in postures]) > 0.0)
    assert np.all(np.diff([force(posture, "z") for posture in postures]) < 0.0)


@pytest.mark.slow
def test_an_l_shape_pushes_less_forward_and_as_much_down(force):
    """[T]: "even when changing the posture of the base part, f_z is almost the same"."""
    for straight, bent in (("i", "iv"), ("ii", "v"), ("iii", "vi")):
        assert force(bent, "x") < force(straight, "x")
        assert force(bent, "z") == pytest.approx(force(straight, "z"), rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize(
    "posture", [pytest.param(posture, marks=() if posture == "vii" else pytest.mark.slow) for posture in THERE]
)
def test_pushes_close_their_ledger_and_settle_their_servos(simulated, posture):
    """Wheels of (vii) that had slipped spun on at their voltage limit, on 103 J from the steps."""
    for direction in PUSHES:
        record = simulated(SCENARIO, f"{posture}_{direction}")
        assert abs(record.summary["energy_residual_relative"]) <= 1e-12
        assert record.summary["time_stepping"]["limits_unsettled"] <= 1
        assert abs(record.summary["scheme_loss_J"]) <= 1e-2
        assert not pushed(record, direction).stop_acted


@pytest.mark.long
def test_with_stops_at_the_limits_of_the_command_the_stop_pushes():
    """Posture (i) then pushes by half more: psi3 leans on its stop, 3 degrees beyond its target."""
    record = simulate(load_scenario(SCENARIO, "i_x", {"plant.dynamics.stops_deg.pitch": 113.0}))
    assert pushed(record, "x").stop_acted
    assert pushed(record, "x").force > 1.3 * TABLE_IV["i"].mean[0]

"""Statements of Tanaka et al. (IEEE T-RO 35(1), 2019), with sentence or table beside each assertion.

The robot here neither slips nor bends, so their measured deviations (Table III) must not appear: the control law alone
brings every coordinate to its target.
"""

import numpy as np
import pytest

from dynsim.compile.protocols import BuildContext
from dynsim.engine import simulate
from dynsim.library.controllers import task_space
from dynsim.library.controllers.task_space import TABLE_II
from dynsim.library.plants import snake
from dynsim.scenario import load_scenario
from dynsim.snake.description import conditioning
from dynsim.snake.kinematics import pose_of_point

SCENARIOS = {
    "snake_positioning": ["x", "y", "z", "alpha", "beta", "gamma"],
    "snake_joint_limits": ["cyclic", "predictive", "fixed", "eq20", "eq20_min"],
    "snake_circle": ["forward", "backward", "backward_switching", "vertical"],
    "snake_circle_backward": [None],
    "snake_door_arc": ["pull", "pull_switching", "pull_predictive", "push"],
    "snake_operator": [None],
}


def test_initial_posture_gives_the_head_pose():
    """V.A: "we set phi = [0, -0.8, 0, -1.1, 0, 1.9, 0, ..., 0]"; base straight, wheel pair 1 at the origin."""
    plant, w = snake.build(snake.Config(), BuildContext(1.0)), np.zeros(6)
    pose_of_point(plant.arrays(), np.zeros(3), plant.initial_joints, np.zeros((3, 3)), w)
    # two ψ-to-ψ distances of 181 mm at 1.9 and 0.8 rad, one level, on wheels of 50 mm
    x = 0.181 * (np.cos(1.9) + np.cos(0.8) + 1)
    z = 0.181 * (np.sin(1.9) + np.sin(0.8)) + 0.05
    np.testing.assert_allclose(w, [x, 0, z, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(w, [0.248589, 0, 0.351122, 0, 0, 0], atol=5e-7)


def test_dimensions():
    """eqs 5, 6, 10, 11 with n = 9, n_h = 6, n_b = 6, n_w = 7; III.A: redundancy n_h + n_lifted + ñ_lifted - 4."""
    plant = snake.build(snake.Config(), BuildContext(1.0))
    controller = task_space.build(task_space.Config(), BuildContext(1.0, plant))
    law, model = controller.law, plant.arrays()
    assert (model.base_joints + 4 + model.wheels, 6) == (17, 6)
    assert len(law.root_weight_inverse) == 19
    for row, number in enumerate(controller.modes.numbers):
        indices = conditioning(model, law, row, np.zeros(3), plant.initial_joints)
        lifted = len(TABLE_II[number])
        assert indices.rows == 13 + 1
        assert indices.redundancy == 6 + lifted + lifted - 4 - 1


def test_straight_length():
    """Table I: total length 1729 mm, which adds two wheel radii to the 1.629 m from head point to tail axle."""
    plant, w = snake.build(snake.Config(), BuildContext(1.0)), np.zeros(6)
    pose_of_point(plant.arrays(), np.zeros(3), np.zeros(12), np.zeros((3, 3)), w)
    tail = -6 * 0.181
    assert w[0] - tail == pytest.approx(1.729 - 2 * 0.05, abs=1e-12)


@pytest.mark.parametrize(
    ("variant", "target"),
    [
        ("x", [0.20, 0, 0, 0, 0, 0]),
        ("y", [0, 0.1, 0, 0, 0, 0]),
        ("z", [0, 0, -0.1, 0, 0, 0]),
        ("alpha", [0, 0, 0, np.pi / 2, 0, 0]),
        ("beta", [0, 0, 0, 0, -np.pi / 6, 0]),
        ("gamma", [0, 0, 0, 0, 0, np.pi / 4]),
    ],
)
def test_table_iii_without_slip_and_sag(simulated, variant, target):
    """Table III, rows "Target value". III.B: "w converges to w_d" where A has full column rank (eq 15)."""
    record = simulated("snake_positioning", variant)
    summary = record.summary
    np.testing.assert_allclose(summary["displacement"], target, atol=1e-6)
    assert summary["final_position_error_m"] < 1e-6
    assert summary["final_attitude_error_rad"] < 1e-6
    assert summary["joint_limit_violation_max_rad"] == 0.0
    assert summary["joints_taken_out"] == []
    assert summary["mode_switches"] == 0


@pytest.mark.parametrize("state", ["estimated", "feedforward"])
@pytest.mark.parametrize("moved", ["y", "alpha", "gamma"])
def test_table_iii_with_estimated_and_with_feedforward_state(state, moved):
    """IV.C.1 and IV.C.2: without slip and sag what is integrated stays true. "The actual joint angle of the robot is
    not used at all" in feedforward; estimated z, alpha, beta come from the joints, x, y from its velocity."""
    record = simulate(load_scenario("snake_positioning", moved, {"controller.state": state}))
    # nothing measures what the held rates leave in x, y, gamma: the errors of the run stay, second order in 5 ms
    assert record.summary["final_position_error_m"] < 1e-6
    assert record.summary["final_attitude_error_rad"] < 1e-6
    np.testing.assert_array_equal(record["w_estimate"][0], record["w"][0])
    belief, integrated, posture = record["w_estimate"], [0, 1, 5], slice(2, 5)
    np.testing.assert_allclose(belief[:, integrated], record["w_target"][:, integrated], atol=1e-12)
    # the joints of an ideal plant do what they are told, so integrating the rates gives the joints
    np.testing.assert_allclose(belief[:, posture], record["w"][:, posture], atol=1e-9)
    measured = simulate(load_scenario("snake_positioning", moved))
    assert np.any(record["phi"][-1] != measured["phi"][-1])  # it did not look where the measured state does


def _marks(name: str) -> tuple[pytest.MarkDecorator, ...]:
    return (pytest.mark.long,) if name == "snake_circle_backward" else ()


@pytest.mark.parametrize(
    ("name", "variant"), [pytest.param(n, v, marks=_marks(n)) for n, vs in SCENARIOS.items() for v in vs]
)
def test_limits_and_head_error_of_every_shipped_scenario(simulated, name, variant):
    """Table I: |psi| <= 113 deg, |theta| <= 65 deg; with the joint-limit policy at no cost in head error."""
    record = simulated(name, variant)
    limit = np.deg2rad([65, 113] * 3 + [65] * 6)
    assert np.all(np.abs(record["phi"]) <= limit + 1e-12)
    assert record.summary["joint_limit_violation_max_rad"] == 0.0
    assert record.summary["position_error_max_m"] < 1e-4
    assert record.summary["attitude_error_max_rad"] < 1e-4
    assert not record.summary["tipping"]


class TestJointLimitAvoidance:
    """V.B, Figs 8-10: fixing state for t < 2, switching state from t = 2, Delta T = 1, K_V as printed."""

    def test_start(self, simulated):
        """ "the base part has a zigzag form and the joint angles of the base part reach their limit" """
        record = simulated("snake_joint_limits", "cyclic")
        np.testing.assert_allclose(record["phi"][0, 6:], 1.1 * np.array([1, -1, 1, -1, 1, -1]))
        K_V = np.array([15, 0.015] * 3 + [9.6, 4.8, 2.4, 1.2, 0.6, 0.3])
        phi = record["phi"][0]
        assert record.summary["cost_initial"] == pytest.approx(phi @ (K_V * phi), abs=1e-12)

    def test_modes_are_switched_in_the_order_of_the_paper(self, simulated):
        """ "mode switching is repeated as sigma = 2, 3, ..., 6, 2, 3, ..." """
        record = simulated("snake_joint_limits", "cyclic")
        mode = record["mode"][np.searchsorted(record.time, np.arange(0.5, 22, 1.0))]
        assert mode.tolist() == [1, 1, *([2, 3, 4, 5, 6] * 4)]
        assert record.summary["mode_switches"] == 20

    @pytest.mark.parametrize("variant", ["cyclic", "predictive", "fixed"])
    def test_cost_never_rises(self, simulated, variant):
        """ "The cost function decreased V with time." Eq 18, third term: "it is semi-negative definite"."""
        cost = simulated("snake_joint_limits", variant)["cost"]
        assert np.diff(cost).max() <= 0.0
        assert cost[-1] < 0.9 * cost[0]

    @pytest.mark.parametrize(("variant", "bound"), [("eq20", 0.0), ("eq20_min", 1e-7)])
    def test_cost_20_never_rises_within_a_mode(self, simulated, variant, bound):
        """A new mode has another support polygon and so another V; between switches it falls. With 1/min d the robot
        once stands still at its limits, and what moves V then is only the head error of 1e-7 m that is taken away."""
        record = simulated("snake_joint_limits", variant)
        same = np.diff(record["mode"]) == 0
        assert np.diff(record["cost"])[same].max() <= bound
        assert np.diff(record["cost"])[same].sum() < -0.5 * record["cost"][0]

    def test_joint_angles_fall(self, simulated):
        """ "Although the angle of the base part was in the neighborhood of the joint angle limit, the angle decreased
        with time." """
        record = simulated("snake_joint_limits", "cyclic")
        assert np.all(np.abs(record["phi"][-1, 6:]) < 0.45)
        assert record.summary["cost_final"] < 0.15 * record.summary["cost_initial"]

    def test_the_head_stands_still(self, simulated):
        """Their 30 mm and 0.1 rad come from slip, sag and play; the law itself holds the head (fact: < 1e-4)."""
        summary = simulated("snake_joint_limits", "cyclic").summary
        assert summary["position_error_max_m"] < 1e-6
        assert summary["attitude_error_max_rad"] < 1e-6

    def test_eq_19_alone_does_not_keep_limits(self, simulated):
        """IV.C.4 hopes that "the robot reduces each joint angle by decreasing the value in (19)": V falls, yet a joint
        passes its limit. Clamping it costs head error, taking it out of the allocation costs none."""
        unlimited = simulated("snake_joint_limits", "unlimited")
        assert np.diff(unlimited["cost"]).max() <= 0.0
        assert unlimited["cost"][-1] < unlimited["cost"][0]
        assert unlimited.summary["joint_limit_violation_max_rad"] > 0.2
        assert simulated("snake_joint_limits", "saturate").summary["position_error_max_m"] > 1e-3

    def test_prediction_beats_the_prescribed_order(self, simulated):
        """V.E: "It is thus better that the robot uses not heuristic mode switching ... but switching optimized by
        predictive calculation"."""
        final = {v: simulated("snake_joint_limits", v).summary["cost_final"] for v in ("fixed", "cyclic", "predictive")}
        assert final["predictive"] < final["cyclic"] < final["fixed"]

    def test_cost_20_leaves_a_larger_support_polygon(self, simulated):
        """Fig 16: "the robot did not adopt a straight posture and the area of the support polygon was greater". True
        of 1/min d; the norm as printed is dominated by the far sides and changes nothing to speak of."""
        area = {v: simulated("snake_joint_limits", v).summary["support_area_final_m2"]
                for v in ("cyclic", "eq20", "eq20_min")}  # fmt: skip
        assert area["eq20_min"] > 1.1 * area["cyclic"]
        assert area["eq20"] == pytest.approx(area["cyclic"], rel=0.02)


class TestDoor:
    """V.D.3: "the joint reached the limit angle and the robot could not move backward. However, the robot changed
    posture ... employing mode switching, and the robot was able to resume moving backward." """

    def test_pulling_in_a_fixed_mode_gets_stuck(self, simulated):
        record = simulated("snake_door_arc", "pull")
        assert record.summary["waiting_s"] > 10.0
        assert record["w"][-1, 5] > np.deg2rad(-20)

    @pytest.mark.parametrize("variant", ["pull_switching", "pull_predictive"])
    def test_switching_modes_resumes(self, simulated, variant):
        record = simulated("snake_door_arc", variant)
        assert record.summary["mode_switches"] > 0
        assert record["w"][-1, 5] == pytest.approx(np.deg2rad(-25), abs=1e-6)

    def test_gripper_stays_on_the_arc_and_perpendicular_to_the_door(self, simulated):
        w = simulated("snake_door_arc", "pull_switching")["w"]
        hinge = w[0, :2] + [0.0, 0.4]
        np.testing.assert_allclose(np.hypot(*(w[:, :2] - hinge).T), 0.4, atol=1e-5)
        bearing = np.arctan2(*(w[:, :2] - hinge).T)  # from the -y axis, as the yaw of the door's normal
        np.testing.assert_allclose(np.sin(w[:, 5] - w[0, 5] + bearing - bearing[0]), 0.0, atol=1e-4)

    def test_backward_is_unstable_and_forward_is_not(self, simulated):
        """II.A in practice (jack-knife): the same circle, once head first, once tail first."""
        forward, backward = (simulated("snake_circle", v).summary for v in ("forward", "backward"))
        assert forward["waiting_s"] == 0.0
        assert backward["waiting_s"] > 20.0

    @pytest.mark.long
    def test_the_backward_circle_is_completed_with_modes_that_lift_pair_1(self, simulated):
        """Not by the modes of Table II, and not by the real robot: IV.C.5, "the robot cannot ... lift ... the wheel of
        the head of the base part because of a lack of torque"."""
        record = simulated("snake_circle_backward", None)
        assert record["w"][-1, 5] == pytest.approx(-2 * np.pi, abs=1e-3)
        # the path waited less than the 79 s that are left after its end, so it has come to its end
        assert 0.0 < record.summary["waiting_s"] < 79.0
        assert {7, 8, 9} & set(record["mode"])
        assert record.summary["modes_refused"] > 0
        assert not record.summary["tipping"]

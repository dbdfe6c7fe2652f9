"""Wrench sensors: closed forms, joint forces of Pinocchio, free bodies, recorded torques along the joint axes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import dynsim
from dynsim import Simulation, State, check, simulate
from dynsim.dynamics.contact import unilateral as ku
from dynsim.engine.link_sensors import _attitudes, _turning_axes, link_motion
from dynsim.errors import ModelError
from dynsim.integrators.stepping.contacts import turning_axis
from dynsim.model.description import Robot
from dynsim.record import Record
from dynsim.scenario import Scenario, ScenarioConfig, build

G = 9.81
# Rounding of sums of some terms, relative to forces of the weight.
ROUNDING = 1e-10


def scenario(chain: list[dict[str, Any]], sensors: dict[str, Any], **sections: Any) -> Scenario:
    """Return a serial arm with wrench sensors."""
    link = {"length_m": 0.3, "mass_kg": 0.4, "radius_m": 0.02}
    config = {
        "name": "sensed",
        "duration_s": 0.2,
        "plant": {"type": "serial_arm", "link": link, "chain": chain},
        "sensors": {"wrench": sensors},
        "metrics": {"settle_s": 0},
    }
    return Scenario("sensed", "", ScenarioConfig.model_validate(config | sections))


def every_link(count: int) -> dict[str, Any]:
    return {f"s{k}": {"body": f"link_{k}"} for k in range(1, count + 1)}


def seen(record: Record, sensor: str) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque of a sensor, (T, 3) each."""
    k = record.labels["wrench_force"].index(sensor)
    return record["wrench_force"][:, k], record["wrench_torque"][:, k]


def along_axes(record: Record, robot: Robot, count: int) -> np.ndarray:
    """Components along the axes of the first joints, (T, count), by sensors of ``every_link``."""
    columns = []
    for k, link in enumerate(robot.links[:count]):
        force, torque = seen(record, f"s{k + 1}")
        columns.append((force if link.kind == "prismatic" else torque) @ link.axis)
    return np.stack(columns, axis=1)


def recorded_torques(record: Record, robot: Robot, count: int) -> np.ndarray:
    """Shaft torque, viscous and dry friction, and force of the stop of each joint, (T, count)."""
    total = -record["v"][:, :count] * [link.damping for link in robot.links[:count]]
    for name in ("torque", "joint_friction", "stop_force"):
        for k, joint in enumerate(record.labels[name]) if name in record else ():
            total[:, robot.joint_names.index(joint)] += record[name][:, k]
    return total


# Closed forms.


def test_hanging_link_pulls_with_its_weight_and_free_joints_have_no_torque() -> None:
    still = {"axis": "y", "initial_deg": 180}
    record = simulate(scenario([still, {"axis": "y"}], every_link(2)))
    for sensor, mass in (("s1", 0.8), ("s2", 0.4)):
        force, torque = seen(record, sensor)
        # The z axes of the links point down.
        np.testing.assert_allclose(force, np.tile([0.0, 0.0, -mass * G], (len(record), 1)), atol=1e-9)
        np.testing.assert_allclose(torque, 0.0, atol=1e-9)


def test_spinning_link_has_the_centripetal_force() -> None:
    plant_without_weight = {"gravity_m_s2": [0, 0, 0]}
    spinning = scenario(
        [{"axis": "y"}], {"root": {"body": "link_1"}, "tip": {"body": "link_1", "point_m": [0, 0, 0.3]}}
    )
    config = spinning.config
    plant = config.plant.model_copy(update=plant_without_weight)
    spinning = Scenario("sensed", "", config.model_copy(update={"plant": plant}))
    simulation = Simulation(spinning, state=State(0.0, np.zeros(1), np.array([5.0]), np.zeros(0)))
    simulation.advance(0.2)
    record = simulation.record()
    for sensor in ("root", "tip"):
        force, torque = seen(record, sensor)
        np.testing.assert_allclose(force, np.tile([0.0, 0.0, -0.4 * 5.0**2 * 0.15], (len(record), 1)), atol=1e-6)
        np.testing.assert_allclose(torque, 0.0, atol=1e-6)


def test_motion_of_links_has_velocities_and_accelerations_minus_gravity() -> None:
    """The hinge accelerates a swinging link's tip by l (v̇ along, v² towards it); every point has −g in addition."""
    simulation = Simulation(scenario([{"axis": "y", "initial_deg": 90}], every_link(1)))
    simulation.advance(0.1)
    record = simulation.record()
    motion = link_motion(record, simulation._prepared, (), slice(None))
    q, v, vdot = (record[name][:, 0] for name in ("q", "v", "vdot"))
    across, still = np.stack([np.cos(q), 0 * q, -np.sin(q)], axis=1), np.stack([np.sin(q), 0 * q, np.cos(q)], axis=1)
    tip = motion.point(0, np.array([0.0, 0.0, 0.3]))
    np.testing.assert_allclose(tip, 0.3 * still, atol=1e-12)
    V, A = motion.velocity[:, 0], motion.acceleration[:, 0]
    flow = V[:, 3:] + np.cross(V[:, :3], tip)
    np.testing.assert_allclose(flow, 0.3 * v[:, None] * across, atol=1e-12)
    expected = 0.3 * (vdot[:, None] * across - (v * v)[:, None] * still) + [0.0, 0.0, G]
    np.testing.assert_allclose(A[:, 3:] + np.cross(A[:, :3], tip) + np.cross(V[:, :3], flow), expected, atol=1e-10)


def test_torque_is_about_the_point_and_components_are_in_the_axes_of_the_frame() -> None:
    sensors = {
        "plain": {"body": "tool_link"},
        "moved": {"body": "tool_link", "point_m": [0.1, -0.2, 0.3]},
        "framed": {"body": "tool_link", "frame": "flange", "point_m": [0.0, 0.1, 0.0]},
    }
    arm = dynsim.load_scenario("six_axis_arm")
    robot = build.robot(arm)
    frame = next(frame for frame in robot.frames if frame.body is not None)
    for sensor in sensors.values():
        sensor["body"] = frame.body
    sensors["framed"]["frame"] = frame.name
    record = simulate(dynsim.load_scenario("six_axis_arm", None, {"duration_s": 0.1, "sensors.wrench": sensors}))
    force, torque = seen(record, "plain")
    moved_force, moved_torque = seen(record, "moved")
    np.testing.assert_array_equal(moved_force, force)
    np.testing.assert_allclose(moved_torque, torque - np.cross([0.1, -0.2, 0.3], force), atol=1e-9)
    framed_force, framed_torque = seen(record, "framed")
    np.testing.assert_allclose(framed_force, force @ frame.R, atol=1e-9)
    point = frame.p + frame.R @ [0.0, 0.1, 0.0]
    np.testing.assert_allclose(framed_torque, (torque - np.cross(point, force)) @ frame.R, atol=1e-9)


# Consistency with the rest of the record.

MOTOR = {"motor": {"type": "wang_minami"}}
LEANING = [
    {"axis": "z", "length_m": 0.0, "mass_kg": 0.2, **MOTOR},
    {"axis": "y", "initial_deg": 60.0, "damping_N_m_s_per_rad": 0.05, **MOTOR},
    {"axis": "y", "initial_deg": 80.0, "damping_N_m_s_per_rad": 0.05, **MOTOR},
]
PD = {"type": "joint_pd", "k_p_V_per_rad": 60.0, "k_d_V_s_per_rad": 2.0}
PUSH = {"push": {"type": "constant", "body": "link_3", "point_m": [0, 0, 0.1], "force_N": [1.5, 0.5, -2.0]}}


def leaning(law: str, method: str, **sections: Any) -> Scenario:
    """Return an arm whose tip, a sphere, leans on a floor."""
    chain = [dict(link) for link in LEANING]
    if law == "unilateral":
        chain[1]["friction_N_m"] = 0.02
        chain[2]["limit_deg"] = [79.6, 170.0]
    contacts = {
        "law": law,
        "friction": 0.3,
        "points": {"tip": {"body": "link_3", "point_m": [0, 0, 0.3], "radius_m": 0.0, "surface": "floor"}},
    }
    surfaces = {"floor": {"type": "plane", "point_m": [0.0, 0.0, -0.0796]}}
    common = {"controller": PD, "contacts": contacts, "surfaces": surfaces, "integrator": {"method": method}}
    return scenario(chain, every_link(3), **(common | {"initial": {"on_surface": ["tip"]}} | sections))


@pytest.mark.parametrize(
    ("law", "method"), [("bilateral", "radau5"), ("unilateral", "radau5"), ("unilateral", "time_stepping")]
)
def test_braced_arm_at_rest_carries_its_weight_less_the_contact_force(law: str, method: str) -> None:
    """Σ m g − f at the base, and their moments."""
    arm = leaning(law, method, initial={"on_surface": ["tip"], "equilibrium": True}, duration_s=0.05)
    record, robot = simulate(arm), build.robot(arm)
    model = dynsim.Model(robot)
    q = record["q"][-1]
    bodies = model.robot.links
    centres = np.array([model.point_position(link.name, link.inertia.com, q) for link in bodies])
    weights = np.array([link.inertia.mass * robot.gravity for link in bodies])
    tip, contact = model.point_position("link_3", [0, 0, 0.3], q), record["contact_force"][-1, 0]
    assert contact[2] > 0.1
    turn, _ = model.body_pose("link_1", q)
    force, torque = seen(record, "s1")
    np.testing.assert_allclose(turn @ force[-1], -weights.sum(axis=0) - contact, atol=1e-6)
    # The joint of link_1 is at the origin.
    np.testing.assert_allclose(
        turn @ torque[-1], -np.cross(centres, weights).sum(axis=0) - np.cross(tip, contact), atol=1e-6
    )


@pytest.mark.parametrize(("law", "method"), [("bilateral", "radau5"), ("unilateral", "radau5")])
def test_component_along_each_joint_axis_is_the_recorded_torque(law: str, method: str) -> None:
    """Shaft torque, losses, dry friction and stops, on an arm that slides and is pushed."""
    arm = leaning(law, method, loads=PUSH)
    record, robot = simulate(arm), build.robot(arm)
    assert np.abs(record["vdot"]).max() > 0.1
    if law == "unilateral":
        assert np.abs(record["joint_friction"]).max() > 0.0
        assert np.abs(record["stop_force"]).max() > 0.0
    expected = recorded_torques(record, robot, 3)
    # The accelerations of the record balance their forces to about 1e-8 of the largest.
    np.testing.assert_allclose(along_axes(record, robot, 3), expected, atol=1e-7 * np.abs(expected).max())


def test_component_along_each_joint_axis_is_the_recorded_torque_up_to_the_step_of_time_stepping() -> None:
    """Means over the step at the posture of its end: an error of first order, away from impacts."""
    off = []
    for step in (1e-3, 5e-4):
        arm = leaning("unilateral", "time_stepping", loads=PUSH, integrator={"method": "time_stepping", "step_s": step})
        record, robot = simulate(arm), build.robot(arm)
        away = np.all([np.abs(record.time - event.time) > 3e-3 for event in record.events], axis=0)
        difference = np.abs(along_axes(record, robot, 3) - recorded_torques(record, robot, 3))
        off.append(float(difference[away & (record.time > 0.0)].max()))
        scale = np.abs(recorded_torques(record, robot, 3)).max()
    # The currents grow within milliseconds.
    assert off[0] < 0.1 * scale
    assert off[1] < 0.7 * off[0]


TIED = {
    "spring": {
        "type": "linear",
        "body": "link_3",
        "point_m": [0, 0, 0.3],
        "other": "world",
        "other_point_m": [0.2, 0.1, 0.3],
        "axis": [1, 1, 1],
        "stiffness_N_per_m": 200.0,
    },
    "twist": {"type": "torsion", "body": "link_3", "other": "link_1", "axis": [1, 2, 3], "stiffness_N_m_per_rad": 5.0},
    "reins": {"type": "torsion", "body": "link_2", "other": "world", "axis": [0, 0, 1], "stiffness_N_m_per_rad": 3.0},
}
LOADS = {
    **PUSH,
    "bag": {"type": "payload", "body": "link_2", "point_m": [0.05, 0, 0.1], "mass_kg": 0.3},
    "gust": {
        "type": "samples",
        "body": "link_3",
        "frame": "body",
        "times_s": [0.05, 0.1],
        "interpolation": "linear",
        "force_N": [[3, 0, 0], [5, 1, 0]],
        "torque_N_m": [[0, 0.1, 0], [0, 0.1, 0.2]],
    },
}


def test_ties_and_loads_leave_passive_joints_without_torque() -> None:
    """The torque left is of first order in the step; ties and loads exert some N and tenths of N m."""
    off = []
    for step in (1e-3, 5e-4):
        chain = [{"axis": "z"}, {"axis": "y", "initial_deg": 50}, {"axis": "x", "initial_deg": 40}]
        stepping = {"method": "time_stepping", "step_s": step, "theta": 0.5}
        arm = scenario(
            chain,
            every_link(3),
            contacts={"law": "unilateral"},
            integrator=stepping,
            ties=TIED,
            loads=LOADS,
            record={"rate_hz": 1000},
        )
        record, robot = simulate(arm), build.robot(arm)
        assert np.abs(record["tie_force"]).max(axis=0).min() > 0.05
        assert np.abs(record["wrench_torque"]).max() > 5.0
        off.append(float(np.abs(along_axes(record, robot, 3)[1:]).max()))
    assert off[0] < 0.05
    assert off[1] < 0.55 * off[0]


def test_turning_axes_are_the_axes_of_the_kernels() -> None:
    random = np.random.default_rng(3)
    axis = np.array([0.6, 0.0, 0.8])
    for size in (0.0, 1e-12, 1e-3, 0.0099, 0.0101, 1.0, 3.0):
        turn = random.normal(size=3)
        turn *= size / np.linalg.norm(turn)
        K = np.cross(np.eye(3), turn)  # K x = turn × x
        matrix = np.eye(3) + np.sinc(size / np.pi) * K + 0.5 * np.sinc(0.5 * size / np.pi) ** 2 * K @ K
        axes = _turning_axes(np.tile(axis, (1, 1)), matrix[None])
        np.testing.assert_allclose(axes[0], turning_axis(tuple(axis), tuple(turn)), atol=1e-9)


@pytest.mark.parametrize("method", ["radau5", "time_stepping"])
def test_sensor_of_a_free_body_reads_zero_in_flight_and_on_a_surface(method: str) -> None:
    """Its joint to the world transmits nothing: weight, contacts and loads are all that moves it."""
    dropped = scenario(
        [{"axis": "y", "initial_deg": 180}],
        {"free": {"body": "box"}},
        duration_s=0.3,
        contacts={"law": "unilateral", "friction": 0.3},
        surfaces={"floor": {"type": "plane"}},
        objects={"box": {"mass_kg": 0.5, "size_m": [0.1, 0.1, 0.1], "position_m": [1, 1, 0.1], "rpy_deg": [10, 20, 0]}},
        loads={"lean": {"type": "constant", "body": "box", "force_N": [0.8, 0, 0]}},
        integrator={"method": method},
        record={"rate_hz": 1000},
    )
    record = simulate(dropped)
    assert np.abs(record["contact_normal_force"]).max() > 1.0
    force, torque = seen(record, "free")
    pressing = np.linalg.norm(record["contact_force"], axis=2).sum(axis=1) + 0.5 * G
    # In time stepping contacts act along the normal at the middle of the step, here at its end; impacts turn the box.
    allowed = 0.02 * pressing if method == "time_stepping" else 1e-7 * pressing
    assert (np.linalg.norm(force, axis=1) < allowed).all()
    assert (np.linalg.norm(torque, axis=1) < allowed).all()


# Other plants, callers, and what a sensor must not change.


def test_base_of_a_mobile_arm_stands_on_its_wheels() -> None:
    sensors = {"ground": {"body": "base"}, "shoulder": {"body": "link_1"}}
    changes = {"duration_s": 0.4, "sensors.wrench": sensors}
    record = simulate(dynsim.load_scenario("mobile_reach", None, changes))
    force, torque = seen(record, "ground")
    np.testing.assert_allclose(force[:, 2], record["wheel_load"].sum(axis=1), rtol=1e-9)
    # Moments of the loads about the middle between the wheels; the ground is the plane z = 0 of the base.
    left, right, caster = record["wheel_load"].T
    np.testing.assert_allclose(torque[:, 0], 0.15 * (left - right), atol=1e-9 * force[:, 2].max())
    np.testing.assert_allclose(torque[:, 1], -0.15 * caster, atol=1e-9 * force[:, 2].max())


@pytest.mark.parametrize("method", ["dopri5", "time_stepping"])
def test_wrenches_that_a_caller_sets_act_outside(method: str) -> None:
    """A hinge without a drive has no torque, whatever pushes its link; snapshots restore the pushes too."""
    changes = {"contacts": {"law": "unilateral"}, "integrator": {"method": method}}
    simulation = Simulation(scenario([{"axis": "y", "initial_deg": 90}], every_link(1), **changes))
    simulation.advance(0.05)
    simulation.set_wrench("link_1", force=[1.0, 2.0, 3.0], torque=[0.1, 0.2, 0.3], point=[0, 0, 0.2], in_body=True)
    simulation.advance(0.1)
    snapshot = simulation.snapshot()
    simulation.set_wrench("link_1", force=[-5.0, 0.0, 0.0])
    simulation.advance(0.15)
    first = simulation.record()
    simulation.restore(snapshot)
    simulation.set_wrench("link_1")
    simulation.advance(0.2)
    for record in (first, simulation.record()):
        torque = seen(record, "s1")[1][1:]
        # Of 0.8 N m at the start.
        assert np.abs(torque[:, 1]).max() < (5e-3 if method == "time_stepping" else 1e-9)
        pushed = (record.time[1:] > 0.0501) & (record.time[1:] < 0.0999)
        assert np.abs(torque[pushed][:, 0] + 0.1 - 0.2 * 2.0).max() < (5e-3 if method == "time_stepping" else 1e-9)


def test_torsion_tie_that_begins_again_acts_about_the_axes_of_each_beginning() -> None:
    """The first hold uses the attitude at its first sample, the last hold the attitude in the table."""
    tie = {"type": "torsion", "body": "link_2", "other": "world", "axis": [0, 0, 1], "stiffness_N_m_per_rad": 0.5}
    arm = scenario(
        [{"axis": "y", "initial_deg": 60}, {"axis": "x", "initial_deg": 70}],
        every_link(2),
        contacts={"law": "unilateral"},
        integrator={"method": "time_stepping"},
        ties={"grip": tie},
        record={"rate_hz": 1000},
    )
    simulation = Simulation(arm)
    simulation.advance(0.07)
    simulation.set_tie("grip", holds=False)
    simulation.advance(0.13)
    simulation.set_tie("grip", holds=True)
    simulation.advance(0.2)
    record, prepared = simulation.record(), simulation._prepared
    attitudes = _attitudes(record, prepared, 0)
    model, q = simulation.model, record["q"]
    np.testing.assert_allclose(attitudes[10], model.body_pose("link_2", q[0])[0].T, atol=0.02)
    np.testing.assert_allclose(attitudes[-1], model.body_pose("link_2", q[130])[0].T, atol=1e-9)
    assert prepared.system.unilateral is not None
    assert prepared.system.unilateral.tie[0, ku.TIE_ATTITUDE] == attitudes[-1, 0, 0]
    assert np.abs(along_axes(record, simulation.robot, 2)[1:]).max() < 0.02


def test_sensors_change_no_other_signal() -> None:
    sensed = leaning("unilateral", "time_stepping")
    plain = Scenario("sensed", "", sensed.config.model_copy(update={"sensors": None}))
    a, b = simulate(plain), simulate(sensed)
    assert set(b) - set(a) == {"wrench_force", "wrench_torque"}
    for name in a:
        assert a[name].tobytes() == b[name].tobytes(), name
    assert b["wrench_force"].shape == (len(b), 3, 3)
    assert "sensors" not in plain.resolved
    assert Scenario("again", "", ScenarioConfig.model_validate(sensed.resolved)).config.sensors == sensed.config.sensors


def test_joint_forces_of_pinocchio() -> None:
    """Force and torque in the frame of each body, by rnea at the samples of a moving robot."""
    pin = pytest.importorskip("pinocchio")
    from support.pinocchio_oracle import Oracle

    arm = dynsim.load_scenario("six_axis_arm")
    names = [link.name for link in build.robot(arm).links]
    changes = {"duration_s": 1.0, "record.rate_hz": 20, "sensors.wrench": {name: {"body": name} for name in names}}
    moving = dynsim.load_scenario("six_axis_arm", None, changes)
    record, oracle = simulate(moving), Oracle(dynsim.Model(build.robot(moving)).robot)
    assert np.abs(record["v"]).max() > 0.1
    for row in range(len(record)):
        q, v, vdot = (oracle.to(record[name][row]) for name in ("q", "v", "vdot"))
        pin.rnea(oracle.model, oracle.data, q, v, vdot)
        for body, name in enumerate(names):
            expected = oracle.data.f[oracle.joint[body]]
            force, torque = seen(record, name)
            np.testing.assert_allclose(force[row], expected.linear, atol=1e-8)
            np.testing.assert_allclose(torque[row], expected.angular, atol=1e-8)


def test_columns_of_tables_name_sensor_and_component() -> None:
    pytest.importorskip("pandas")
    record = simulate(scenario([{"axis": "y", "initial_deg": 180}], {"hinge": {"body": "link_1"}}, duration_s=0.01))
    frame = record.to_dataframe()
    assert frame["wrench_force.hinge.z"].iloc[0] == pytest.approx(-0.4 * G)
    assert frame.attrs["units"]["wrench_torque.hinge.x"] == "N m"


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ({"body": "link_9"}, "body: no body 'link_9'; did you mean"),
        ({"body": "world"}, "body: 'world' has no joint; bodies: "),
        (
            {"body": "link_1", "frame": "tool"},
            "frame: 'tool' is not a frame fixed to link_1; remove it, because this body has no frames",
        ),
        (
            {"body": "link_1", "frame": "link_2"},
            "frame: 'link_2' is not a frame fixed to link_1; remove it, because this body has no frames",
        ),
        ({"body": "box", "frame": "tool"}, "frame: 'tool' is not a frame fixed to box; frames: box.grasp"),
        ({"body": "box.grasp"}, "body: 'box.grasp' is a frame fixed to box; use body: box, frame: box.grasp"),
    ],
)
def test_invalid_places_are_errors(sensor: dict[str, Any], message: str) -> None:
    box = {
        "mass_kg": 1,
        "shape": "sphere",
        "radius_m": 0.1,
        "position_m": [2, 0, 1],
        "grasp": {"position_m": [0, 0, 0]},
    }
    arm = scenario([{"axis": "y"}, {"axis": "y"}], {"s": sensor}, objects={"box": box})
    with pytest.raises(ModelError) as error:
        check(arm)
    assert f"sensors.wrench.s.{message}" in str(error.value)


def test_kinematic_snake_has_no_wrenches() -> None:
    changes = {"sensors.wrench": {"neck": {"body": "head"}}}
    with pytest.raises(ModelError, match=r"sensors\.wrench is not supported by the kinematic plant 'snake'"):
        check(dynsim.load_scenario("snake_positioning", "x", changes))

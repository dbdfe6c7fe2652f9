"""The tasks of [T] V.D on both levels: pick up a pipe joint, turn a valve, open a door; and why they fail."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from support.messages import check_message, mentions, raises

from dynsim import Simulation, load_scenario, simulate
from dynsim.engine.gripper import HARDENED, SOFT
from dynsim.errors import ModelError, SimulationStopped
from dynsim.record import Record
from dynsim.record.measures import GRIPPER_STATES
from dynsim.scenario import scenario_from_resolved
from dynsim.snake.description import NO_REQUEST
from dynsim.teleop.snake import Command, begin

G = 9.81


def column(record: Record, name: str) -> np.ndarray:
    """Coordinate of an object over time."""
    return record["q"][:, record.labels["q"].index(name)]


def events(record: Record) -> list[tuple[str, str]]:
    """Kinds and names of what the gripper did."""
    return [(event.kind.removeprefix("gripper "), event.name) for event in record.events if "gripper" in event.kind]


def stopped(name: str, variant: str, **changes: Any) -> SimulationStopped:
    """The end of a task that fails."""
    with pytest.raises(SimulationStopped) as caught:
        simulate(load_scenario(name, variant, {key.replace("__", "."): value for key, value in changes.items()}))
    return caught.value


@pytest.mark.parametrize(
    ("name", "variant", "coordinate", "end"),
    [
        ("snake_pick_up", "lifts", "pipe.z", 0.186),
        ("snake_valve", "turns", "valve", np.pi / 2),
        ("snake_door", "push", "door", np.pi / 3),
        ("snake_door", "pull_switching", "door", -0.42),
    ],
)
def test_on_the_kinematic_level_objects_follow_the_gripper(
    name: str, variant: str, coordinate: str, end: float
) -> None:
    record = simulate(load_scenario(name, variant, {"plant.level": "kinematic"}))
    moved = column(record, coordinate)
    assert moved[-1] == pytest.approx(end, abs=0.02)
    held = record["gripper_state"] == HARDENED
    # What is held stays where it was captured, which is in the plane of a hinge only.
    assert np.ptp(record["grasp_distance"][held]) < 1e-3
    before = record.time < 6.0
    assert np.ptp(moved[before]) == 0.0
    assert events(record)[0][0] == "captures"
    assert record.summary["gripper"]["captures"] == [coordinate.partition(".")[0]]


@pytest.mark.parametrize("name", ["snake_pick_up", "snake_valve", "snake_door"])
@pytest.mark.parametrize("level", ["kinematic", "dynamic"])
def test_a_gripper_that_closes_beside_its_object_ends_the_run(name: str, level: str) -> None:
    stop = stopped(name, "too_far", plant__level=level)
    assert stop.kind == "too_far"
    check_message(stop, name.removeprefix("snake_").replace("pick_up", "pipe"), "15 mm", "23°", "plant.gripper")
    assert stop.record is not None
    assert stop.record.time[-1] == pytest.approx(stop.time)
    assert not events(stop.record)


def test_the_pipe_is_picked_up() -> None:
    """Ledger, impulses against the weight, and the force of the gripper against that of the pipe."""
    scenario = load_scenario("snake_pick_up", "lifts")
    simulation = Simulation(scenario)
    simulation.advance(scenario.duration_s)
    record, model = simulation.record(), simulation.model
    assert column(record, "pipe.z")[-1] - 0.03 > 0.14
    assert events(record) == [("captures", "pipe")]
    gripped = record.summary["gripper"]
    assert gripped["captures"] == ["pipe"]
    assert gripped["loses"] == []
    assert gripped["moved"]["pipe"][2] == pytest.approx(column(record, "pipe.z")[-1] - 0.03)
    assert 1.7 < gripped["force_max_N"] < 2.2
    supplied = record["energy_electrical_supply"][-1]
    assert np.abs(record["energy_residual"]).max() < 1e-5 * supplied
    # Impulses of the ground, all upwards, and the change of momentum are those of the weight.
    q, v = record["q"][-1], record["v"][-1]
    up = mass = 0.0
    for k, link in enumerate(model.robot.links):
        jacobian = model.point_jacobian(k, link.inertia.com, q)
        up += link.inertia.mass * float(jacobian[2] @ v)
        mass += link.inertia.mass
    first = record["contact_impulse"][0].sum()
    impulse = record["contact_impulse"][-1].sum() - first
    # Steps keep momentum to second order: 1e-8 with 2.5 ms, 2e-9 with half of that.
    assert impulse == pytest.approx(mass * G * record.time[-1] + up, rel=2e-8)
    # While it hangs the six ties carry the pipe: its weight, and what its slow motion needs.
    force = record["tie_force"][record.time > 22.0][:, :3]
    assert np.linalg.norm(force, axis=1) == pytest.approx(0.2 * G, rel=0.1)


def test_a_load_that_is_too_heavy_ends_with_reason_and_time() -> None:
    stop = stopped("snake_pick_up", "too_heavy")
    assert stop.kind == "too_heavy"
    check_message(stop, "psi2")
    assert 15.0 < stop.time < 21.0


@pytest.mark.long
def test_the_valve_is_turned_by_its_friction_over_the_stiffness_less_than_the_head() -> None:
    record = simulate(load_scenario("snake_valve", "turns"))
    turned = record.time < 17.9
    head, valve = record["w"][turned, 3][-1], column(record, "valve")[turned][-1]
    assert head - valve == pytest.approx(0.3 / 5.0, abs=0.01)
    assert events(record) == [("captures", "valve"), ("releases", "valve")]
    assert record["gripper_state"][-1] == SOFT
    # It stays where it was let go.
    assert np.ptp(column(record, "valve")[record.time > 18.6]) < 1e-9
    assert np.abs(record["energy_residual"]).max() < 1e-5 * record["energy_electrical_supply"][-1]


@pytest.mark.long
@pytest.mark.parametrize(("variant", "angle"), [("push", 60.0), ("pull_switching", -24.0)])
def test_the_door_is_opened(variant: str, angle: float) -> None:
    record = simulate(load_scenario("snake_door", variant))
    assert np.degrees(column(record, "door")[-1]) == pytest.approx(angle, abs=2.0)
    assert np.abs(record["energy_residual"]).max() < 1e-5 * record["energy_electrical_supply"][-1]


@pytest.mark.long
@pytest.mark.parametrize("name", ["snake_valve", "snake_door"])
def test_what_does_not_give_way_ends_with_reason_and_time(name: str) -> None:
    stop = stopped(name, "too_stiff")
    assert stop.kind == "too_stiff"
    check_message(stop, name.removeprefix("snake_"), "plant.gripper")
    assert stop.record is not None
    assert ("slips", name.removeprefix("snake_")) in events(stop.record)


@pytest.mark.long
def test_an_object_that_slips_out_is_lost() -> None:
    """A gripper that holds 1 N lifts a pipe of 2 N."""
    stop = stopped("snake_pick_up", "lifts", plant__gripper__bound_N=1.0)
    assert stop.kind == "lost"
    check_message(stop, "pipe", re.compile(r"\b15(\.\d)? mm"))
    assert stop.record is not None
    assert events(stop.record)[-1] == ("loses", "pipe")


@pytest.mark.long
def test_a_robot_that_is_thrown_over_ends_as_overturned() -> None:
    push = {"type": "constant", "body": "pair1", "force_N": [0.0, 150.0, 40.0]}
    stop = stopped("snake_valve", "turns", loads={"push": push})
    assert stop.kind == "overturned"
    check_message(stop, "pair1")


def driven(session: Any, end: float) -> Record:
    """What a pilot does: as the script of ``snake_valve``, tick by tick."""
    while session.time < end:
        time, velocity = session.time, [0.0] * 6
        if 1.0 <= time < 5.0:
            velocity[0] = 0.05 / 4.0
        if 9.0 <= time < 13.0:
            velocity[3] = 0.1
        session.tick(Command(tuple(velocity), NO_REQUEST, time >= 7.0))
    record = session.record()
    assert isinstance(record, Record)
    return record


@pytest.mark.parametrize("level", ["kinematic", pytest.param("dynamic", marks=pytest.mark.long)])
def test_a_pilot_turns_the_valve_and_leaves_a_script_that_does_so_again(level: str) -> None:
    scenario = load_scenario("snake_valve", "turns", {"plant.level": level})
    session = begin(scenario, longest=30.0)
    record = driven(session, 13.0)
    assert mentions(session.frame().extra["grip"], GRIPPER_STATES[HARDENED], "valve")
    assert column(record, "valve")[-1] == pytest.approx(0.4, abs=0.08)
    again = simulate(scenario_from_resolved(record.provenance["scenario"]))
    np.testing.assert_array_equal(again["q"], record["q"])
    assert events(again) == events(record) == [("captures", "valve")]


@pytest.mark.long
def test_a_snapshot_continues_the_grip() -> None:
    simulation = Simulation(load_scenario("snake_valve", "turns"))
    simulation.advance(7.5)
    kept = simulation.snapshot()
    first = simulation.advance(10.0)
    turned = simulation.record()
    simulation.restore(kept)
    again = simulation.advance(10.0)
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(simulation.record()["gripper_state"], turned["gripper_state"])


TWICE = [
    {"at_s": 7.0, "gripper": "closed"},
    {"at_s": 12.0, "gripper": "open"},
    {"at_s": 15.0, "gripper": "closed"},
]


def test_a_kinematic_object_is_captured_again_where_it_was_left() -> None:
    """It does not go back; and where it was released does not depend on the samples."""
    ends = []
    for rate_hz in (100.0, 5.0):
        settings = {"plant.level": "kinematic", "controller.commands": TWICE, "record.rate_hz": rate_hz}
        record = simulate(load_scenario("snake_valve", "turns", settings))
        turned = column(record, "valve")
        assert np.diff(turned).min() > -1e-9
        ends.append(turned[np.isclose(record.time, 14.0)][0])
        assert events(record) == [("captures", "valve"), ("releases", "valve"), ("captures", "valve")]
    assert ends[0] == pytest.approx(ends[1], abs=1e-12)
    assert 0.3 < ends[0] < 1.2


def test_kinematic_objects_stop_at_their_limits() -> None:
    settings = {"plant.level": "kinematic", "objects.valve.hinge.limits_deg": [-10.0, 40.0]}
    record = simulate(load_scenario("snake_valve", "turns", settings))
    assert column(record, "valve").max() == pytest.approx(np.radians(40.0))


@pytest.mark.parametrize("level", ["kinematic", "dynamic"])
def test_an_object_within_capture_goes_before_a_nearer_one_that_points_elsewhere(level: str) -> None:
    """A ball 1 mm nearer, which can be held from the side only."""
    valve = load_scenario("snake_valve", "turns").resolved["objects"]["valve"]
    ball = {"mass_kg": 0.1, "shape": "sphere", "radius_m": 0.02, "position_m": [0.389, 0.0, 0.35], "hinge": {}}
    objects = {"valve": valve, "ball": ball | {"grasp": {"axis": [0.0, 1.0, 0.0]}}}
    settings = {"plant.level": level, "objects": objects, "duration_s": 8.0}
    assert events(simulate(load_scenario("snake_valve", "turns", settings))) == [("captures", "valve")]


@pytest.mark.long
def test_a_soft_grip_that_deflects_has_not_slipped() -> None:
    """100 N/m deflect by 17 mm, more than counts as lost, under a pipe of 2 N; the bound is 20 N."""
    settings = {"plant.gripper.stiffness_N_per_m": 100.0}
    record = simulate(load_scenario("snake_pick_up", "lifts", settings))
    assert events(record) == [("captures", "pipe")]


@pytest.mark.long
def test_a_grip_that_opens_slowly_releases_and_does_not_lose() -> None:
    commands = [{"at_s": 13.0, "gripper": "closed"}, {"at_s": 22.0, "gripper": "open"}]
    settings = {"plant.gripper.softening_s": 2.0, "controller.commands": commands, "plant.gripper.lost_m": 0.005}
    record = simulate(load_scenario("snake_pick_up", "lifts", settings))
    assert events(record)[-1] == ("releases", "pipe")


@pytest.mark.parametrize("level", ["kinematic", pytest.param("dynamic", marks=pytest.mark.long)])
def test_a_pilot_who_closes_the_gripper_in_the_air_ends_the_session(level: str) -> None:
    session = begin(load_scenario("snake_valve", "turns", {"plant.level": level}), longest=30.0)

    def closes() -> None:
        while session.time < 2.0:
            session.tick(Command((0.0,) * 6, NO_REQUEST, session.time > 1.0))

    with raises(SimulationStopped, "too_far", "valve", "plant.gripper") as caught:
        closes()
    assert caught.value.kind == "too_far"
    record = session.record()
    assert not events(record)


def test_a_stop_of_the_controller_has_the_record_of_the_simulation() -> None:
    commands = [{"at_s": 0.1, "gripper": "closed"}]
    simulation = Simulation(load_scenario("snake_valve", "turns", {"controller.commands": commands, "duration_s": 1.0}))
    with raises(SimulationStopped, "too_far", "valve", "plant.gripper") as caught:
        simulation.advance(1.0)
    for record in (caught.value.record, simulation.record()):
        assert record.time[-1] == pytest.approx(0.1)
        check_message(record.summary["warnings"][-1], "too_far", phrase="incomplete")


def test_a_hanging_load_is_balanced_by_impulses_of_the_ground_and_sinks_by_its_weight() -> None:
    """At rest: impulses against the weight of both, the gripper's force, and m g/k beside the unloaded gripper."""
    settings = {"controller.state": "feedforward", "controller.paths": [], "controller.commands": [], "objects": {}}
    scenario = load_scenario("snake_pick_up", "lifts", settings | {"duration_s": 0.05})
    tip = simulate(scenario)["w"][0, :3]
    ties: dict[str, Any] = {}
    for name, axis in zip("xyz", np.eye(3).tolist(), strict=True):
        ends = {"body": "head", "other": "load", "axis": axis}
        linear = {"type": "linear", "point_m": [0.1805, 0, 0], "stiffness_N_per_m": 5e3, "damping_N_s_per_m": 20.0}
        ties[f"f{name}"] = ends | linear | {"bound_N": 20.0}
        ties[f"m{name}"] = ends | {"type": "torsion", "stiffness_N_m_per_rad": 5.0, "damping_N_m_s_per_rad": 0.05}
    load = {"mass_kg": 0.3, "shape": "sphere", "radius_m": 0.02, "position_m": tip.tolist()}
    simulation = Simulation(
        load_scenario("snake_pick_up", "lifts", settings | {"duration_s": 8.0, "objects": {"load": load}, "ties": ties})
    )
    q = simulation.advance(8.0).q
    record, model = simulation.record(), simulation.model
    mass = sum(link.inertia.mass for link in model.robot.links)
    later = int(np.searchsorted(record.time, 6.0))
    impulse = record["contact_impulse"][-1].sum() - record["contact_impulse"][later].sum()
    assert impulse == pytest.approx(mass * G * (record.time[-1] - record.time[later]), rel=1e-9)
    force = np.array([simulation.tie_force[f"f{name}"] for name in "xyz"])
    assert np.linalg.norm(force) == pytest.approx(0.3 * G, rel=1e-9)
    R, p = model.body_pose(model.body_index("head"), q)
    _, at = model.body_pose(model.body_index("load"), q)
    assert np.linalg.norm(at - p - R @ [0.1805, 0.0, 0.0]) == pytest.approx(0.3 * G / 5e3, rel=0.02)


def test_a_snake_does_not_start_from_a_state() -> None:
    scenario = load_scenario("snake_valve", "turns", {"duration_s": 0.1})
    simulation = Simulation(scenario)
    with raises(ModelError, "State", "Simulation.snapshot"):
        Simulation(scenario, state=simulation.advance(0.05))

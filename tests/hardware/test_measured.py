"""A measured record describes itself: scene, poses and events; `plot` draws it from the file alone."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from support.messages import mentions

import dynsim
from dynsim import cli
from dynsim.draw import figures
from dynsim.draw.figures import measured as measured_figures
from dynsim.draw.figures import style
from dynsim.draw.page import viewable
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.replay.measured import describe
from dynsim.hardware.replay.output import ReplayState
from dynsim.hardware.servo_map import SHIPPED, load_servo_map
from dynsim.record import Record
from dynsim.record.scene import HERE, WORLD, Body, Joint, Point, Scene
from dynsim.scenario import build_model, load_scenario

from .conftest import Rig, swing

PNG = b"\x89PNG\r\n\x1a\n"
ARM_FIGURES = {"joints", "following_error", "servos", "hand_path", "tracking_error", "posture"}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer pixels: the tests look at what is drawn, not at how sharp it is."""
    monkeypatch.setattr(style, "DPI", 50)


def hinge(name: str, height: float, signal: str = "q") -> Joint:
    return Joint(name, "revolute", (0.0, 1.0, 0.0), (0.0, 0.0, height), HERE, signal, (name,))


def two_links() -> Scene:
    """The rig's joints as a planar arm of two links, half a metre each, with its wheel at the tip."""
    return Scene(
        (
            Body("upper", WORLD, hinge("shoulder", 0.0)),
            Body("lower", 0, hinge("elbow", 0.5)),
            Body("disc", 1, hinge("wheel", 0.5, "rho")),
        ),
        points=(Point("tip", "hand", 1, (0.0, 0.0, 0.5)),),
    )


@pytest.fixture
def scenic(rig: Rig) -> Rig:
    record = swing()
    record.scene = two_links()
    return Rig(rig.map, record)


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["dynsim", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert not leaving.value.code


def drawn(folder: Path) -> set[str]:
    for path in folder.glob("*.png"):
        assert path.read_bytes().startswith(PNG)
    return {path.stem for path in folder.glob("*.png")}


@pytest.mark.long
def test_a_measured_record_is_drawn_by_plot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From simulation to measured figures by the commands, and drawn from the measured file alone."""
    shown = load_scenario("elbow_comparison", "two_elbows", {"duration_s": 0.4})
    simulated = dynsim.simulate(shown)
    record = simulated.save(tmp_path / "record.h5")
    options = ("--map", "arm", "--port", "virtual", "--out", tmp_path / "out", "--quiet")
    call(monkeypatch, "hw", "replay", record, *options)
    record.unlink()  # nothing but the measured file is left
    measured = Record.load(tmp_path / "out" / "measured.h5")
    assert measured.scene == simulated.scene
    assert [event.name for event in measured.events] == ["MOVE_TO_START", "SETTLE", "REPLAY", "SETTLE"]
    model = build_model(shown)
    for row in (0, len(measured) // 2, len(measured) - 1):
        q = measured["q"][row]
        np.testing.assert_allclose(
            measured["hand_position"][row], model.point_position(*model.robot.hand, q), atol=5e-6
        )
        goal = model.point_position(*model.robot.hand, measured["q_goal"][row])
        np.testing.assert_allclose(measured["hand_position_goal"][row], goal, atol=5e-6)
        for k, link in enumerate(model.robot.links):
            np.testing.assert_allclose(measured["body_position"][row, k], model.body_pose(link.name, q)[1], atol=5e-6)
    call(monkeypatch, "plot", tmp_path / "out" / "measured.h5")
    assert drawn(tmp_path / "out" / "figures") == ARM_FIGURES
    call(monkeypatch, "plot", tmp_path / "out" / "measured.h5", "--format", "svg", "--out", tmp_path / "svg")
    assert {path.name for path in (tmp_path / "svg").glob("*.svg")} == {f"{name}.svg" for name in ARM_FIGURES}


def test_measured_beside_simulated(scenic: Rig, tmp_path: Path) -> None:
    measured = scenic.run().result.record
    simulated = dynsim.simulate(load_scenario("elbow_comparison", "no_elbow", {"duration_s": 0.1}))
    paths = figures.draw_comparison({"simulated": simulated, "measured": measured}, tmp_path)
    assert {"compare_hand_path", "compare_posture", "compare_tracking_error"} <= {path.stem for path in paths}


def test_poses_follow_from_the_measured_angles(scenic: Rig) -> None:
    record = scenic.run().result.record
    shoulder, elbow = record["q"].T
    total = shoulder + elbow
    tip = 0.5 * np.stack([np.sin(shoulder) + np.sin(total), 0.0 * total, np.cos(shoulder) + np.cos(total)], axis=1)
    np.testing.assert_allclose(record["hand_position"], tip, atol=1e-6)
    assert record.labels["body_position"] == ("upper", "lower", "disc")
    assert np.abs(record["hand_position"] - record["hand_position_goal"]).max() > 1e-4
    turned = 2.0 * np.arctan2(record["body_orientation"][:, 2, 2], record["body_orientation"][:, 2, 0])
    np.testing.assert_allclose(np.cos(turned), np.cos(total + record["rho"][:, 0]), atol=1e-5)


def test_a_fault_is_an_event_and_what_came_before_is_drawn(scenic: Rig, tmp_path: Path) -> None:
    run = scenic.run({"kind": "drop_off", "id": 2, "at": 1.2})
    record = run.result.record
    assert not record.complete
    fault = record.events[-1] if record.events[-1].kind == "fault" else record.events[-2]
    assert (fault.kind, fault.name) == ("fault", run.result.fault.cause.value)
    assert fault.description == run.result.fault.text
    assert record.time[0] < fault.time <= record.time[-1] + 1.0
    # Of the cycles without an answer nobody knows where the arm was.
    missed = record["missed"].any(axis=1)
    assert missed.any()
    assert np.isnan(record["hand_position"][missed]).all()
    assert np.isfinite(record["hand_position"][~missed]).all()
    figures.draw(Record.load(record.save(tmp_path / "measured.h5")), tmp_path / "figures")
    assert drawn(tmp_path / "figures") == ARM_FIGURES


def test_servos_of_many_joints_are_the_same_in_every_panel() -> None:
    time, names = np.linspace(0.0, 1.0, 11), tuple(f"j{k}" for k in range(20))
    record = Record(time)
    torque = np.outer(np.ones(11), np.arange(20.0))
    record.add("torque_estimate", torque, "N m", labels=names)
    record.add_axis("health", [0.0, 0.5])
    record.add("temperature", 50.0 - torque[:2], "degC", labels=names, axis="health")
    figure = measured_figures.servos(record)
    top, bottom = figure.axes
    expected = [f"j{k}" for k in range(8, 20)]
    assert [line.get_label() for line in top.get_lines()] == expected
    assert [line.get_label() for line in bottom.get_lines()] == expected
    assert [line.get_ydata()[0] for line in bottom.get_lines()] == [50.0 - k for k in range(8, 20)]
    assert bottom.get_lines()[0].get_xdata().tolist() == [0.0, 0.5]
    assert mentions(figure.get_suptitle(), "12", "20")


def test_without_a_scene_joints_and_servos_are_drawn(rig: Rig, tmp_path: Path) -> None:
    record = rig.run().result.record
    assert record.scene is None
    assert not {"body_position", "hand_position"} & set(record)
    figures.draw(record, tmp_path)
    assert drawn(tmp_path) == {"joints", "following_error", "servos"}


def test_where_the_base_was_is_not_invented(rig: Rig) -> None:
    """A robot that moves over the ground: its scene is copied, but the angles do not say where it was."""
    record = swing()
    base = Joint("base", "planar", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), HERE, "base_pose", ("x", "y", "yaw"))
    record.scene = Scene((Body("base", WORLD, base), Body("upper", 0, hinge("shoulder", 0.0))))
    measured = Rig(rig.map, record).run().result.record
    assert measured.scene == record.scene
    assert "body_position" not in measured


def test_a_base_that_was_recorded_carries_what_was_measured(rig: Rig) -> None:
    """Poses on the base of the record that was followed, at its time, and said to be so."""
    record = swing()
    base = Joint("base", "planar", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), HERE, "base_pose", ("x", "y", "yaw"))
    record.scene = Scene((Body("base", WORLD, base), Body("upper", 0, hinge("shoulder", 0.0))))
    pose = np.stack([record.time, 0.0 * record.time, 0.0 * record.time], axis=1)
    record.add("base_pose", pose, "m, m, rad", labels=("x", "y", "yaw"))
    measured = Rig(rig.map, record).run().result.record
    at = measured["record_time"]
    known = np.isfinite(at)
    assert known.sum() > 10
    # Before the motion begins it stands where that will, after its end where it ended.
    end = record.time[-1] - record.time[0]
    wanted = np.clip(at[known], 0.0, end) + record.time[0]
    np.testing.assert_allclose(measured["body_position"][known, 0, 0], wanted, atol=1e-6)
    np.testing.assert_array_equal(measured["body_position"][: np.flatnonzero(known)[0], 0, 0], 0.0)
    turned = 2.0 * np.arctan2(measured["body_orientation"][:, 1, 2], measured["body_orientation"][:, 1, 0])
    np.testing.assert_allclose(turned, measured["q"][:, 0], atol=1e-6)
    for name in ("base_pose", "body_position"):
        assert measured.signals[name].description


def test_a_measured_snake_can_be_viewed() -> None:
    """Servos that are exactly where they should be, pitched for lifted wheels: every body is where it was simulated."""
    simulated = dynsim.simulate(load_scenario("snake_positioning", "x", {"duration_s": 2.0}))
    servo_map = load_servo_map(SHIPPED / "snake.yaml")
    motion = check_motion(simulated, servo_map)
    goals = np.array([motion.path.at(time)[0] for time in simulated.time])
    measured = Record(simulated.time, provenance={"robot": "snake"})
    measured.add("record_time", simulated.time, "s")
    measured.add("state", np.full(len(simulated), int(ReplayState.REPLAY)), "1")
    for name in ("phi", "rho"):
        columns = [k for k, servo in enumerate(servo_map.servos) if servo.kind.follows.position == name]
        labels = tuple(servo_map.servos[k].label for k in columns)
        measured.add(name, goals[:, columns], "rad", labels=labels)
    describe(measured, simulated.scene, motion.unmeasured)
    wheels = [k for k, name in enumerate(simulated.labels["body_position"]) if name.startswith("wheel")]
    others = np.delete(np.arange(len(simulated.labels["body_position"])), wheels)
    for rows in (others, wheels):
        where = measured["body_position"][:, rows], simulated["body_position"][:, rows]
        np.testing.assert_allclose(*where, atol=1e-5)
    np.testing.assert_array_equal(measured["grounded"], simulated["grounded"])
    assert (simulated["grounded"] == 0).any()
    assert viewable(measured)
    np.testing.assert_allclose(measured["hand_position"], simulated["w"][:, :3], atol=1e-5)


def test_a_dry_run_has_a_record_without_goals(scenic: Rig, tmp_path: Path) -> None:
    record = scenic.run(live=False).result.record
    assert np.isnan(record["q_goal"]).all()
    figures.draw(record, tmp_path)
    assert {"servos", "hand_path", "posture"} <= drawn(tmp_path)
    assert "joints" not in drawn(tmp_path)


def test_the_scene_travels_with_the_checked_motion(scenic: Rig) -> None:
    assert check_motion(scenic.record, scenic.map).scene is scenic.record.scene

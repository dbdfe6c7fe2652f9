"""The suite can fail: a loader broken on purpose is found, named rightly, and the cases after it are run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynsim.model.description import Inertia, Link, Robot
from dynsim.model.urdf import read_urdf
from fuzz import campaign
from fuzz.case import SHIPPED
from fuzz.inputs.record import make_records
from fuzz.readings import missing, record_losses, urdf_losses
from fuzz.worker import CRASH, FILES, HANG, LOSS, MESSAGE, TRACEBACK

# Cases whose commands read the sound record of a servo map, export a broken one, read a scenario.
READS = [("servo_map", 0), ("servo_map", 1)]
EXPORTS = [("record", index) for index in range(8)]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("records")
    make_records(folder)
    return folder


@pytest.mark.parametrize(
    ("broken", "outcome", "what", "place"),
    [
        ("raises", TRACEBACK, "ValueError", "broken.py:<lambda>"),
        ("hangs", HANG, "hw takes more than", "broken.py:<lambda>"),
        ("hangs_deaf", HANG, "heeds no Ctrl-C", "dynsim/hardware/cli.py:_checked"),
        ("aborts", CRASH, "SIGABRT", "dynsim/hardware/cli.py:_checked"),
        ("exits", CRASH, "exit code 0", ""),
        ("babbles", MESSAGE, "control characters", "hw"),
    ],
)
def test_a_broken_loader_is_found(broken: str, outcome: str, what: str, place: str, records: Path) -> None:
    (result,) = campaign.run(READS[:1], records=records, broken=broken, limit=0.5)
    assert result.ended.outcome == outcome
    assert what in result.ended.what
    assert place in result.ended.place
    assert "--repeat servo_map 0" in campaign.failures([result])


def test_the_cases_after_a_crash_are_run_in_a_new_worker(records: Path) -> None:
    results = campaign.run([*READS, ("csv_path", 0)], records=records, broken="aborts")
    assert [result.ended.outcome for result in results[:2]] == [CRASH, CRASH]
    assert not results[2].failed


def test_memory_is_bounded(records: Path) -> None:
    """64 GB are refused by the system, not taken: dynsim says so in one line."""
    (result,) = campaign.run(READS[:1], records=records, broken="eats_memory")
    assert "not enough memory" in result.ended.detail


def test_lost_masses_are_found(records: Path) -> None:
    results = campaign.run([("scenario", index) for index in range(15)], records=records, broken="loses")
    assert any(result.ended.outcome == LOSS and "masses" in result.ended.detail for result in results)


@pytest.mark.parametrize(("broken", "what"), [("overwrites", "changed out.txt"), ("litters", "out.txt.tmp")])
def test_touched_files_are_found(broken: str, what: str, records: Path) -> None:
    results = campaign.run(EXPORTS, records=records, broken=broken)
    found = [result.ended for result in results if result.ended.outcome == FILES]
    assert found
    assert all(what in ended.what for ended in found)


@pytest.mark.parametrize(
    ("said", "taken"),
    [
        ({"a": 1}, {}),
        ({"a": 1.0}, {"a": 1.0000001}),
        ({"a": True}, {"a": 1.0}),
        ({"a": "1_9.2"}, {"a": 19.2}),
        ({"a": "１"}, {"a": 1.0}),
        ({"a": [1, 2]}, {"a": [1]}),
        ({"a": {"b": 1}}, {"a": "x"}),
        ({"a": 0.1}, {"a": None}),
    ],
)
def test_a_value_that_is_not_taken_over_is_a_loss(said: dict, taken: dict) -> None:
    assert missing(said, taken)
    assert not missing(said, said)
    assert not missing({"a": 1, "b": "2.50", "c": None}, {"a": 1.0, "b": 2.5, "d": 7})


def arm_with(change: tuple[str, str]) -> bytes:
    return (SHIPPED / "robots" / "six_axis_arm.urdf").read_text(encoding="utf-8").replace(*change, 1).encode()


def test_the_shipped_arm_is_read_alike_twice(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_bytes(arm_with(("", "")))
    robot = read_urdf(tmp_path / "arm.urdf")
    assert urdf_losses(arm_with(("", "")), robot) == []


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (('<mass value="8.5" />', ""), "0 <mass>"),
        (('<mass value="8.5" />', '<mass value="1_9.2" />'), "is not a number"),
        (('<mass value="8.5" />', '<mass value="8.6" />'), "body 'turret': mass"),
        (('ixx="0.035824"', 'ixx="0.045824"'), "body 'turret': mass"),
        (('damping="12"', 'damping="13"'), "damping"),
        (('<joint name="base_yaw"', '<joint name="base_roll"'), "joints"),
        (('<origin xyz="0 0 0.085" rpy="0 0 0" />', '<origin xyz="0 0 0.085" rpy="0 1 0" />'), "mass and moments"),
    ],
)
def test_what_a_urdf_file_says_and_the_robot_does_not_is_a_loss(
    change: tuple[str, str], what: str, tmp_path: Path
) -> None:
    (tmp_path / "arm.urdf").write_bytes(arm_with(("", "")))
    robot = read_urdf(tmp_path / "arm.urdf")
    assert what in "; ".join(urdf_losses(arm_with(change), robot))


def test_masses_behind_fixed_joints_are_composed_as_they_are_merged(tmp_path: Path) -> None:
    """Two bodies fixed to one another, turned and moved: one composite, whatever Pinocchio does to get there."""
    turned = '<origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 0.6"/>'
    tensor = '<inertia ixx="3" ixy="0.1" ixz="0.2" iyy="4" iyz="0.3" izz="5"/>'
    body = f'<inertial>{turned}<mass value="2"/>{tensor}</inertial>'
    text = (
        f'<robot name="r"><link name="w"/><link name="a">{body}</link><link name="b">{body}</link>'
        '<joint name="j" type="continuous"><parent link="w"/><child link="a"/><axis xyz="0 0 1"/></joint>'
        f'<joint name="f" type="fixed">{turned}<parent link="a"/><child link="b"/></joint></robot>'
    )
    (tmp_path / "two.urdf").write_text(text, encoding="utf-8")
    robot = read_urdf(tmp_path / "two.urdf")
    assert robot.links[0].inertia.mass == 4.0
    assert urdf_losses(text.encode(), robot) == []
    light = Robot(
        "r", (Link("a", "j", None, "revolute", np.array([0.0, 0.0, 1.0]), Inertia(2.0)),), (), ("a", np.zeros(3))
    )
    assert urdf_losses(text.encode(), light)


def test_a_record_with_another_number_is_a_loss(records: Path) -> None:
    from dynsim.record import Record

    sound, other = Record.load(records / "arm.h5"), Record.load(records / "arm.h5")
    assert record_losses(sound, other) == []
    other["q"][0, 0] += 1e-15
    assert record_losses(sound, other) == ["signal 'q' changed"]

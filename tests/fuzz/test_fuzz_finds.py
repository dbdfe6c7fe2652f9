"""Deliberately broken loaders that the fuzzer must detect and name, and losses that its readings must detect."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import mentions

from dynsim.model.description import Inertia, Link, Robot
from dynsim.model.urdf.reader import read_urdf
from dynsim.record import meshes
from fuzz import campaign
from fuzz.broken import WAYS
from fuzz.case import SHIPPED, draw, put
from fuzz.readings import missing, record_losses, urdf_losses
from fuzz.worker import CRASH, FILES, HANG, LARGE, LOSS, MESSAGE, REFUSED, TRACEBACK

pytestmark = pytest.mark.long

# Outcome, cause and place in dynsim of each failure of the loader of records, in the order of ``broken.WAYS``.
LOADING = "cli/hardware.py:_checked"
FOUND = {
    "raises": (TRACEBACK, "ValueError", LOADING),
    "hangs": (HANG, "hw takes more than 6 s", LOADING),
    "takes all memory": (REFUSED, "", ""),
    "takes 0.6 GB": (LARGE, "more than 600 MB", ""),
    "babbles": (MESSAGE, "control characters", "hw"),
    "overwrites": (FILES, "hw check changed map.yaml", "hw"),
    "litters": (FILES, "hw check changed map.yaml.tmp", "hw"),
    "hangs deaf": (HANG, "heeds no Ctrl-C", LOADING),
    "aborts": (CRASH, "SIGABRT", LOADING),
    "exits": (CRASH, "exit code 0", ""),
    "refuses": (REFUSED, "", ""),
}


@pytest.fixture(scope="module")
def results(records: Path) -> list[campaign.Result]:
    """Cases run with broken loaders."""
    cases = [("servo_map", index) for index in range(len(WAYS))] + [("scenario", index) for index in range(15)]
    return campaign.run(cases, records=records, broken=True, limit=6.0, seed=1)


@pytest.mark.parametrize(("number", "defect"), list(enumerate(WAYS)))
def test_a_broken_loader_is_found(number: int, defect: str, results: list[campaign.Result]) -> None:
    """Also detected after a defect that ended its worker: "refuses" is the last and ran in a new worker."""
    result = next(result for result in results if (result.kind, result.index) == ("servo_map", number))
    outcome, message, location = FOUND[defect]
    assert result.ended.outcome == outcome, result
    assert message in result.ended.what
    assert location in result.ended.place
    assert result.case
    if result.failed:
        assert f"--repeat servo_map {number}" in campaign.failures(results)
    if defect == "takes all memory":
        assert mentions(result.ended.detail, "memory")


def test_lost_masses_are_found(results: list[campaign.Result]) -> None:
    lost = [result for result in results if result.ended.outcome == LOSS and "masses" in result.ended.detail]
    assert {result.kind for result in lost} == {"scenario"}


def test_the_table_counts_every_case(results: list[campaign.Result]) -> None:
    total = campaign.table(results).splitlines()[-2].split()
    assert int(total[1]) == len(results) == sum(map(int, total[4:-3]))


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
    ("change", "loss"),
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
    change: tuple[str, str], loss: str, tmp_path: Path
) -> None:
    (tmp_path / "arm.urdf").write_bytes(arm_with(("", "")))
    robot = read_urdf(tmp_path / "arm.urdf")
    assert loss in "; ".join(urdf_losses(arm_with(change), robot))


def test_masses_behind_fixed_joints_are_composed_as_they_are_merged(tmp_path: Path) -> None:
    """Combine two bodies fixed to each other, rotated and translated, independently of Pinocchio's algorithm."""
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


@pytest.mark.parametrize("kind", ["obj", "stl", "dae"])
def test_a_lost_triangle_is_a_loss(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cases = (draw(kind, 3, index, tmp_path) for index in range(100))
    case = next(case for case in cases if case.losses.args == (kind, True) and f"mesh.{kind}" in case.files)
    put(tmp_path / f"mesh.{kind}", case.files[f"mesh.{kind}"])
    assert case.losses() == []
    read = meshes.read_mesh
    monkeypatch.setattr(meshes, "read_mesh", lambda path: read(path)._replace(triangles=read(path).triangles[1:]))
    assert "triangles became" in case.losses()[0]


def test_a_record_with_another_number_is_a_loss(records: Path) -> None:
    from dynsim.record import Record

    sound, other = Record.load(records / "arm.h5"), Record.load(records / "arm.h5")
    assert record_losses(sound, other) == []
    other["q"][0, 0] += 1e-15
    assert record_losses(sound, other) == ["signal 'q' changed"]

"""Visual shapes of URDF links: read leniently, placed like their bodies, never a reason to refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynsim.compile.scene import robot_scene
from dynsim.model.urdf.reader import read_urdf
from dynsim.record.quaternion import rotated
from dynsim.record.scene import Scene, Shape

URDF = """<?xml version="1.0"?>
<robot name="r">
<material name="sky"><color rgba="0.2 0.4 0.8 1"/></material>
<link name="base">{base}</link>
<link name="arm">{mass}{arm}</link>
<link name="tool">{mass}{tool}</link>
<joint name="hinge" type="continuous"><origin xyz="0 0 0.1"/><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
</joint>
<joint name="flange" type="fixed"><origin xyz="0 0 1" rpy="0 1.5707963267948966 0"/><parent link="arm"/>
<child link="tool"/></joint>
</robot>
"""
MASS = '<mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
ORIGIN = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
BOX = f'<visual>{ORIGIN}<geometry><box size="0.1 0.2 0.3"/></geometry>{{}}</visual>'


def scene(folder: Path, **links: str) -> Scene:
    text = URDF.format(mass=f"<inertial>{MASS}</inertial>", **{"base": "", "arm": "", "tool": ""} | links)
    (folder / "r.urdf").write_text(text)
    return robot_scene(read_urdf(folder / "r.urdf"), [], {})


def test_shapes_of_all_kinds(tmp_path: Path) -> None:
    solids = (
        '<cylinder radius="0.1" length="0.5"/>',
        '<sphere radius="0.2"/>',
        '<capsule radius="0.1" length="0.4"/>',
        '<mesh filename="package://r/arm.stl" scale="0.001 0.001 0.001"/>',
        '<mesh filename="arm.dae"/>',
    )
    arm = "".join(f"<visual><geometry>{solid}</geometry></visual>" for solid in solids)
    shapes = scene(tmp_path, arm=arm).bodies[0].shapes
    assert [(shape.kind, shape.size, shape.file) for shape in shapes] == [
        ("cylinder", (0.1, 0.5), ""),
        ("sphere", (0.2,), ""),
        ("capsule", (0.1, 0.4), ""),
        ("mesh", (0.001, 0.001, 0.001), "package://r/arm.stl"),
        ("mesh", (1.0, 1.0, 1.0), "arm.dae"),
    ]
    assert shapes[0] == Shape("cylinder", (0.1, 0.5))


def test_shapes_are_placed_on_the_body_that_carries_their_link(tmp_path: Path) -> None:
    drawn = scene(tmp_path, base=BOX.format(""), arm=BOX.format(""), tool=BOX.format(""))
    (stand,) = drawn.fixed
    own, fixed_on = drawn.bodies[0].shapes
    for shape, position, x in (
        (stand, [1.0, 2.0, 3.0], [0.0, 1.0, 0.0]),
        (own, [1.0, 2.0, 3.0], [0.0, 1.0, 0.0]),
        # The tool is turned about y by a right angle, a metre up: its (x, y, z) are (z, y, −x) of the arm.
        (fixed_on, [3.0, 2.0, 0.0], [0.0, 1.0, 0.0]),
    ):
        np.testing.assert_allclose(shape.position, position, atol=1e-12)
        np.testing.assert_allclose(rotated(np.array(shape.orientation), np.array([1.0, 0.0, 0.0])), x, atol=1e-12)
    z = rotated(np.array(fixed_on.orientation), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(z, [1.0, 0.0, 0.0], atol=1e-12)


def test_colours(tmp_path: Path) -> None:
    materials = (
        '<material name="sky"/>',
        '<material name="own"><color rgba="1 0 0 0.5"/></material>',
        '<material name="unknown"/>',
        '<material name="sky"><color rgba="7 0 0 1"/></material>',
    )
    shapes = scene(tmp_path, arm="".join(map(BOX.format, materials))).bodies[0].shapes
    sky = (0.2, 0.4, 0.8, 1.0)
    assert [shape.colour for shape in shapes] == [sky, (1.0, 0.0, 0.0, 0.5), None, sky]


@pytest.mark.parametrize(
    "visual",
    [
        "<visual/>",
        "<visual><geometry/></visual>",
        "<visual><geometry><cone radius='1'/></geometry></visual>",
        "<visual><geometry><box/></geometry></visual>",
        "<visual><geometry><box size='1 2'/></geometry></visual>",
        "<visual><geometry><box size='1 2 wide'/></geometry></visual>",
        "<visual><geometry><box size='1 2 nan'/></geometry></visual>",
        "<visual><geometry><box size='1 2 -3'/></geometry></visual>",
        "<visual><geometry><sphere radius='1e999'/></geometry></visual>",
        "<visual><geometry><cylinder radius='1'/></geometry></visual>",
        "<visual><geometry><mesh/></geometry></visual>",
        "<visual><origin xyz='0 0'/><geometry><sphere radius='1'/></geometry></visual>",
        "<visual><geometry><sphere radius='1'/><sphere radius='2'/></geometry></visual>",
    ],
)
def test_what_cannot_be_drawn_is_passed_over(tmp_path: Path, visual: str) -> None:
    assert len(scene(tmp_path, arm=visual + BOX.format("")).bodies[0].shapes) == 1


def test_shipped_arm_has_shapes_and_limits() -> None:
    robot = read_urdf(Path(__file__).parents[2] / "scenarios" / "robots" / "six_axis_arm.urdf")
    drawn = robot_scene(robot, [], {})
    assert [body.joint.name for body in drawn.bodies] == list(robot.joint_names)
    assert all(body.joint.signal == "q" for body in drawn.bodies)
    assert all(shape.kind in ("box", "cylinder", "sphere") for body in drawn.bodies for shape in body.shapes)
    assert sum(len(body.shapes) for body in drawn.bodies) + len(drawn.fixed) == 8
    assert Scene.from_json(drawn.to_json()) == drawn
    assert drawn.bodies[0].joint.upper == pytest.approx(robot.links[0].upper)

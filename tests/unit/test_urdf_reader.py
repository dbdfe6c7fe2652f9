"""Strict reading of URDF: nothing that a file states is dropped or guessed; refusals say where, what and the fix."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.messages import check_message, mentions, raises, warns
from support.urdf_in_pinocchio import assert_pinocchio_reads_the_same, plain_text

from dynsim.compile.model import Model
from dynsim.errors import DynsimError, ModelError
from dynsim.model.urdf import reader as urdf_reader
from dynsim.model.urdf.reader import read_urdf, read_xml

# Line 1 is the XML declaration; link "arm" is in line 3, its mass in line 6, joint "hinge" in line 10.
GOOD = """<?xml version="1.0"?>
<robot name="r"><link name="base"/>
<link name="arm">
<inertial>
<origin xyz="0 0 0.25" rpy="0 0 0"/>
<mass value="4.00"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
</inertial>
</link>
<joint name="hinge" type="revolute">
<origin xyz="0 0 0.1" rpy="0 0 0"/>
<parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="10" velocity="2"/>
<dynamics damping="0.5" friction="0"/>
</joint>
</robot>
"""
INERTIAL = GOOD[GOOD.index("<inertial>") : GOOD.index("</link>\n<joint")]
MASS, TENSOR = INERTIAL.splitlines()[2], INERTIAL.splitlines()[3]
LOOP = '<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/></joint>'


def refused(path: Path) -> str:
    """The message of the refusal, which is one line per problem and no traceback."""
    with pytest.raises(ModelError) as caught:
        read_urdf(path)
    message = str(caught.value)
    assert all(line.isprintable() for line in message.splitlines())
    return message


def test_the_good_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "good.urdf").write_text(GOOD)
    link = read_urdf(tmp_path / "good.urdf").links[0]
    assert (link.inertia.mass, link.damping, link.lower, link.effort_limit) == (4.0, 0.5, -1.0, 10.0)
    assert link.inertia.com.tolist() == [0.0, 0.0, 0.25]


@pytest.mark.parametrize(
    ("old", "new", "line", "names"),
    [
        # Masses and inertias that used to be lost.
        (MASS, "", 4, ["'arm'", "<mass>", "<inertial>"]),
        (TENSOR, "", 4, ["'arm'", "<inertia>", "<inertial>"]),
        ("4.00", "1_9.2", 6, ["'arm'", "<mass value='1_9.2'>", "0–9"]),
        ("4.00", "٤.٠", 6, ["'arm'", "٤.٠", "0–9"]),
        ("4.00", "４", 6, ["'arm'", "0–9"]),
        ("4.00", "1 2", 6, ["'arm'", "<mass value='1 2'>", "2", "1"]),
        ("4.00", "", 6, ["'arm'", "<mass value=''>", "0", "1"]),
        ("4.00", "4,00", 6, ["<mass value='4,00'>", "0–9"]),
        ("4.00", "0x4", 6, ["0x4"]),
        ("4.00", "4.00\u00a0", 6, ["'arm'", "0–9"]),
        ("4.00", "inf", 6, ["inf"]),
        ("4.00", "1e999", 6, ["<mass value='1e999'>"]),
        ("4.00", "1e300", 6, ["<mass value='1e300'>"]),
        ("4.00", "1e-999", 6, ["<mass value='1e-999'>"]),
        ("4.00", "9" * 5000, 6, ["'arm'", "..."]),
        ("4.00", "-4", 6, ["-4 kg"]),
        ('value="4.00"', 'valeu="4.00"', 6, ["valeu", "<mass>", "value"]),
        ('value="4.00"', 'weight="4.00"', 6, ["weight", "<mass>", "value"]),
        ('<mass value="4.00"/>', "<mass>4.00</mass>", 6, ["<mass>", "value"]),
        ("<mass", "<Mass", 6, ["<Mass>", "<mass>"]),
        ("<mass", "<weight", 4, ["<mass>", "<inertial>"]),
        ("inertial>", "inertail>", 4, ["<inertail>", "<inertial>"]),
        (INERTIAL, f"<visual>{INERTIAL}</visual>", 4, ["<inertial>", "<visual>"]),
        (MASS, "", 4, ["<mass>", "<inertial>"]),
        ("<inertial>", f"{MASS}<inertial>", 4, ["<mass>", "<link>"]),
        (MASS, f'{MASS}\n<mass value="5"/>', 7, ["<mass>"]),
        (INERTIAL, INERTIAL + INERTIAL.replace("4.00", "5"), 9, ["<inertial>"]),
        (' ixx="0.1"', "", 7, ["<inertia>", "ixx"]),
        ('izz="0.1"', 'izz="-0.1"', 3, ["'arm'", "[-0.1"]),
        ('izz="0.1"', 'izz="0.3"', 3, ["'arm'", "0.3]"]),
        # Joints.
        ('"0 0 0.1"', '"0 0.1"', 11, ["'hinge'", "<origin xyz='0 0.1'>", "2", "3"]),
        ('"0 0 0.1"', '"0 0 0.1 0"', 11, ["<origin xyz='0 0 0.1 0'>", "4", "3"]),
        ('<origin xyz="0 0 0.1"', '<origin xzy="0 0 0.1"', 11, ["xzy", "<origin>", "xyz, rpy"]),
        ("<origin xyz=\"0 0 0.1\"", "<orign xyz=\"0 0 0.1\"", 11, ["<orign>", "<origin>"]),
        ('"0 1 0"', '"0 1 y"', 13, ["hinge", "0 1 y"]),
        ('axis xyz="0 1 0"', "axis", 13, ["<axis>", "xyz"]),
        ('"0 1 0"', '"0 0 0"', 13, ["hinge", "'0 0 0'"]),
        (' velocity="2"', "", 14, ["<limit>", "velocity"]),
        ('velocity="2"', 'velocity="-2"', 14, ["hinge", "velocity"]),
        ('lower="-1"', 'lower="2"', 14, ["hinge", "2", "1"]),
        ('upper="1"', 'uper="1"', 14, ["uper", "<limit>", "upper"]),
        ('damping="0.5"', 'damping="-0.5"', 15, ["hinge", "-0.5"]),
        ('damping="0.5"', 'damping="O.5"', 15, ["O.5"]),
        ('type="revolute"', 'type="revolut"', 10, ["'revolut'", "'revolute'"]),
        (' type="revolute"', "", 10, ["hinge", "revolute, continuous, prismatic, fixed, floating, planar"]),
        ('<parent link="base"/>', "", 10, ["hinge", "<parent>"]),
        ('link="base"', 'link="bas"', 12, ["'bas'", "'base'"]),
        ('<child link="arm"/>', '<child/>', 12, ["hinge", "<child>"]),
        ('<joint name="hinge"', "<joint", 10, ["<joint>"]),
        # Names and trees.
        ('<link name="base"/>', '<link name="base"/><link name="arm"/>', 3, ["'arm'", "2"]),
        ("</robot>", LOOP.format("hinge", "arm", "base") + "</robot>", 17, ["'hinge'", "10"]),
        ("</robot>", LOOP.format("two", "base", "arm") + "</robot>", 17, ["'two'", "'arm'", "'hinge'", "10"]),
        ("</robot>", LOOP.format("two", "arm", "base") + "</robot>", 10, ["'hinge'"]),
        ("</robot>", '<link name="loose"/></robot>', 17, ["'base', 'loose'"]),
        ('name="arm"', 'name="a&#10;m"', 3, [r"'a\nm'"]),
        ('name="arm"', 'name="a\u202em"', 3, [r"'a\u202em'"]),
        ('name="arm"', f'name="{"m" * 201}"', 3, ["200"]),
        # Not plain URDF.
        ("4.00", "${m}", 6, ["xacro", "bad_expanded.urdf"]),
        ("4.00", "$(arg m)", 6, ["xacro"]),
        ('name="arm"', 'name="${prefix}arm"', 3, ["xacro"]),
        ("<inertial>", "<xacro:inertial>", 4, ["<xacro:inertial>", "bad_expanded.urdf"]),
        ("<robot", '<!DOCTYPE robot SYSTEM "robot.dtd"><robot', 2, ["DOCTYPE"]),
        ("<robot", '<!DOCTYPE r [<!ENTITY m "4">]><robot', 2, ["DOCTYPE"]),
        ("4.00", "&m;", 6, ["XML", "undefined entity"]),
        ("</inertial>", "", 9, ["XML", "mismatched tag"]),
        ('value="4.00"', 'value="4.00" value="3"', 6, ["XML", "duplicate attribute"]),
        ("<robot", "<sdf", 17, ["XML"]),
    ],
)  # fmt: skip
def test_refusals_say_where_and_what(old: str, new: str, line: int, names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "bad.urdf"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1 if "inertail" not in new else -1), encoding="utf-8")
    message = refused(path)
    check_message(message, f"bad.urdf:{line}", *names)


def test_a_xacro_file_is_reported_once(tmp_path: Path) -> None:
    """Other problems of the file, such as names that no link has, may vanish when it is expanded."""
    path = tmp_path / "bad.urdf"
    path.write_text(GOOD.replace('"arm"', '"${prefix}arm"').replace("4.00", "${m}"), encoding="utf-8")
    message = refused(path)
    check_message(message, "bad.urdf:3", "xacro", "bad_expanded.urdf")
    assert len(message.splitlines()) == 1


def test_what_the_specification_lets_a_file_leave_out_has_its_value(tmp_path: Path) -> None:
    text = GOOD.replace('<axis xyz="0 1 0"/>\n', "").replace('<dynamics damping="0.5" friction="0"/>\n', "")
    text = text.replace('lower="-1" ', "").replace('<origin xyz="0 0 0.1" rpy="0 0 0"/>\n', "")
    (tmp_path / "short.urdf").write_text(text)
    link = read_urdf(tmp_path / "short.urdf").links[0]
    assert (link.axis.tolist(), link.p_PJ.tolist(), link.lower, link.damping) == ([1, 0, 0], [0, 0, 0], 0.0, 0.0)


def test_white_space_beside_a_number_is_no_reason_to_lose_a_mass(tmp_path: Path) -> None:
    """Pinocchio's parser drops the whole inertia over it, and says so only on the terminal."""
    text = GOOD.replace('"4.00"', '" 4.00\n"').replace('ixx="0.1"', 'ixx=" 0.1"').replace('"0 0 0.25"', '"0\t0  0.25 "')
    (tmp_path / "spaced.urdf").write_text(text)
    inertia = read_urdf(tmp_path / "spaced.urdf").links[0].inertia
    assert (inertia.mass, inertia.com.tolist(), inertia.tensor[0, 0]) == (4.0, [0.0, 0.0, 0.25], 0.1)


def test_dynamics_with_extensions_alone_are_none(tmp_path: Path) -> None:
    """Pinocchio's parser refuses them, also where their attributes have the names of others."""
    text = GOOD.replace('<dynamics damping="0.5" friction="0"/>', '<dynamics name="x" joint="y" multiplier="2"/>')
    assert text != GOOD
    (tmp_path / "extended.urdf").write_text(text)
    assert read_urdf(tmp_path / "extended.urdf").links[0].damping == 0.0


def test_extensions_of_programs_are_passed_over(tmp_path: Path) -> None:
    extended = (
        '<robot xmlns:xacro="http://wiki.ros.org/xacro" name="r"><gazebo><link name="x"><inertial/></link></gazebo>'
        '<transmission name="t"><joint name="hinge"/></transmission>'
    )
    text = GOOD.replace('<robot name="r">', extended).replace("<dynamics", '<dynamics mu_coulomb="1" D="2"')
    text = text.replace("<limit", '<safety_controller k_velocity="1"/><limit gear_velocity="3"')
    (tmp_path / "extended.urdf").write_text(text)
    assert read_urdf(tmp_path / "extended.urdf").links[0].inertia.mass == 4.0


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "latin-1", "cp1252"])
def test_encodings(encoding: str, tmp_path: Path) -> None:
    declared = encoding.removesuffix("-sig").removesuffix("-be")
    text = GOOD.replace('version="1.0"', f'version="1.0" encoding="{declared}"').replace('"arm"', '"bräs"')
    data = text.encode(encoding)
    (tmp_path / "robot.urdf").write_bytes(b"\xfe\xff" + data if encoding == "utf-16-be" else data)
    robot = read_urdf(tmp_path / "robot.urdf")
    assert robot.links[0].name == "bräs"
    assert robot.links[0].inertia.mass == 4.0


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (b"", "bad.urdf <robot>"),
        (b" \n\n", "bad.urdf <robot>"),
        (b"<robot name='r'/>", "bad.urdf <link>"),
        (b"<mujoco/>", "bad.urdf:1 <mujoco> <robot>"),
        (b"\x00" * 100, "XML"),
        (bytes(range(256)), "XML"),
        (GOOD.encode("utf-32"), "XML"),
        (GOOD.replace("arm", "bräs").encode("latin-1"), "XML"),
        (b'<?xml version="1.0" encoding="klingon"?><robot/>', "bad.urdf klingon UTF-8"),
        (b'<?xml version="1.0" encoding="big5"?><robot/>', "bad.urdf UTF-8"),
        (b"<robot>" + b"<a>" * 1000, "bad.urdf:1 100"),
        (b"<robot>" + b"<a/>" * 300_000 + b"</robot>", "bad.urdf:1 100000"),
        (b"<robot " + b" ".join(b"a%d='1'" % i for i in range(101)) + b"/>", "bad.urdf:1 <robot> 100"),
        (b"<robot name='" + b"x" * 17_000_000 + b"'/>", "bad.urdf 16 MB"),
        (b"<robot>" + b"".join(b'<link name="l%d"/>' % i for i in range(3000)) + b"</robot>", "bad.urdf:1 2000"),
        (
            b'<!DOCTYPE l [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]><robot>&c;</robot>',
            "DOCTYPE",
        ),
    ],
    ids=range(16),
)
def test_files_that_are_no_robots(data: bytes, names: str, tmp_path: Path) -> None:
    (tmp_path / "bad.urdf").write_bytes(data)
    check_message(refused(tmp_path / "bad.urdf"), *names.split())


def test_what_is_no_file_is_refused_and_nothing_waits(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.urdf")
    (tmp_path / "zero.urdf").symlink_to("/dev/zero")
    for name, word in (
        ("pipe.urdf", "pipe"),
        ("zero.urdf", "device"),
        ("missing.urdf", "missing.urdf"),
        ("a" * 300, "too long"),
        (".", "folder"),
        ("a\0b", r"a\x00b'"),
    ):
        assert mentions(refused(tmp_path / name), word), name


def test_the_longest_chain_that_is_taken_is_read(tmp_path: Path) -> None:
    """Without recursion. In a process of its own, so that this test survives."""
    links = [f'<link name="l{i}">{INERTIAL}</link>' for i in range(urdf_reader.LINKS_MAX)]
    joints = [LOOP.format(f"j{i}", f"l{i}", f"l{i + 1}") for i in reversed(range(urdf_reader.LINKS_MAX - 1))]
    (tmp_path / "chain.urdf").write_text(f'<robot name="r">{"".join(links + joints)}</robot>')
    code = "import sys; from pathlib import Path; from dynsim.model.urdf.reader import read_urdf; "
    code += "print(len(read_urdf(Path(sys.argv[1])).links))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "chain.urdf")], capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == str(urdf_reader.LINKS_MAX - 1), done.stderr


def test_links_that_seem_to_have_lost_their_mass_are_named(tmp_path: Path) -> None:
    tip = '<link name="tip"><visual/></link>' + LOOP.format("wrist", "arm", "tip").replace("continuous", "fixed")
    (tmp_path / "light.urdf").write_text(GOOD.replace("</robot>", tip + "</robot>"))
    with warns(UserWarning, "light.urdf", "<inertial>", "tip"):
        read_urdf(tmp_path / "light.urdf")


def test_moving_links_without_mass_are_named(tmp_path: Path) -> None:
    """Allowed by the specification; without a motor nothing could move them, and with one only its rotor is left."""
    (tmp_path / "light.urdf").write_text(GOOD.replace(INERTIAL, ""))
    with warns(UserWarning, "light.urdf", "hinge"):
        robot = read_urdf(tmp_path / "light.urdf")
    with raises(ModelError, "hinge"):
        Model(robot)


def test_impossible_moments_within_a_possible_body_are_named(tmp_path: Path) -> None:
    odd = f'<link name="odd">{INERTIAL}</link>'.replace("4.00", "0.1").replace('izz="0.1"', 'izz="-0.001"')
    text = GOOD.replace("</robot>", odd + LOOP.format("glue", "arm", "odd").replace("continuous", "fixed") + "</robot>")
    (tmp_path / "odd.urdf").write_text(text)
    with warns(UserWarning, "odd.urdf", "odd"):
        read_urdf(tmp_path / "odd.urdf")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("4.00", "4.01", "mass is 4.0, Pinocchio reads 4.01"),
        ('izz="0.1"', 'izz="0.11"', "inertia is"),
        ("0 0 0.25", "0 0 0.26", "centre of mass is"),
        ("0 1 0", "0 0 1", "joint motion is"),
        ("0 0 0.1", "0 0 0.2", "position of the joint is"),
        ('upper="1"', 'upper="1.1"', "upper limit is 1.0, Pinocchio reads 1.1"),
        ('effort="10"', 'effort="11"', "effort limit is"),
        ('damping="0.5"', 'damping="0.6"', "damping is"),
        ('type="revolute"', 'type="prismatic"', "joint motion is"),
        ('name="hinge"', 'name="hunge"', "hinge, hunge"),
    ],
)
def test_two_readers_that_differ_are_found(old: str, new: str, words: str, tmp_path: Path) -> None:
    """Pinocchio is given a text that is not what the strict reader has read."""
    path = tmp_path / "robot.urdf"
    path.write_text(GOOD)
    assert_pinocchio_reads_the_same(path)
    plain = plain_text(read_xml(path), "r")
    with pytest.raises(AssertionError, match=re.escape(words)):
        assert_pinocchio_reads_the_same(path, plain.replace(old, new))


# An arm with a turned joint, turned inertias and a body behind a fixed joint, for mutations and an independent count.
TURNED = GOOD.replace('xyz="0 0 0.1" rpy="0 0 0"', 'xyz="0 0 0.1" rpy="0.3 -0.2 1.5"').replace(
    "</robot>",
    """<link name="tool"><inertial><origin xyz="0.01 0 0.05" rpy="0.1 0.7 -0.4"/><mass value="0.75"/>
<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="-0.002" izz="0.025"/></inertial></link>
<joint name="mount" type="fixed"><origin xyz="0 0.1 0.5" rpy="0 1.2 0"/><parent link="arm"/><child link="tool"/></joint>
<link name="slider"><inertial><mass value="1.5"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
<joint name="slide" type="prismatic"><origin xyz="0.2 0 0" rpy="0 0 0.5"/><parent link="tool"/><child link="slider"/>
<axis xyz="0 0.6 0.8"/><limit lower="-0.1" upper="0.2" effort="30" velocity="0.5"/></joint></robot>""",
)
MUTATIONS = 400


def mutated(rng: np.random.Generator) -> str:
    """The arm with one or two places changed: numbers, attributes, elements, names of either."""
    text = TURNED
    for _ in range(rng.integers(1, 3)):
        kind = rng.integers(8)
        if kind <= 3:
            spots = list(re.finditer(r'(?<=[" ])-?[0-9][0-9.e+-]*(?=[" ])', text))
        elif kind == 4:
            spots = list(re.finditer(r' \w+="[^"]*"', text))
        elif kind == 5:
            spots = list(re.finditer(r"<\w+ [^<>]*/>", text))
        elif kind == 6:
            spots = list(re.finditer(r"<(inertial|limit|joint|link|origin)\b.*?</\1>", text, re.DOTALL))
        else:
            spots = list(re.finditer(r"(?<=<)/?\w+", text))
        if not spots:
            continue
        spot = spots[rng.integers(len(spots))]
        old, digit = spot.group(), int(rng.integers(10))
        if kind <= 3:
            # The first four are numbers, the others only look like some.
            new = [
                f"{float(old) * rng.uniform(0.9, 1.1):.9g}", f"{old}0", f"+{old}e-0".replace("+-", "-"), f" {old}\n",
                "1e400", f"{old} {old}", f"1_{old}", chr(0x660 + digit), f"{old}\u2009", "nan", f"0x{digit}", "",
                old.replace(".", ","), f"-{old}",
            ][rng.integers(14) if rng.random() < 0.5 else rng.integers(4)]  # fmt: skip
        else:
            new = ["", old + old, old.upper(), old[: len(old) // 2], old.replace("i", "l", 1)][rng.integers(5)]
        text = text[: spot.start()] + new + text[spot.end() :]
    return text


def numbers(element: ElementTree.Element | None, key: str, default: str) -> np.ndarray:
    """Numbers of an attribute as Python takes them."""
    return np.array([float(x) for x in (default if element is None else element.get(key, default)).split()])


def pose(element: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position of an ``<origin>``, with SciPy's angles."""
    origin = element.find("origin")
    return Rotation.from_euler("xyz", numbers(origin, "rpy", "0 0 0")).as_matrix(), numbers(origin, "xyz", "0 0 0")


def stored(mass: float, com: np.ndarray, tensor: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """m, m c and the inertia about the world's origin of a body whose frame is at (R, p)."""
    c = p + R @ com
    about_origin = R @ tensor @ R.T + mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.concatenate([[mass], mass * c, about_origin.ravel()])


def counted(text: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """What moves, at q = 0, and axis and limits of each moving joint: by the standard library, without Pinocchio."""
    root = ElementTree.fromstring(text)
    below: dict[str | None, list[ElementTree.Element]] = {}
    for joint in {joint.get("name"): joint for joint in root.findall("joint")}.values():
        below.setdefault(joint.find("parent").get("link"), []).append(joint)  # type: ignore[union-attr]
    links = {link.get("name"): link for link in root.findall("link")}
    children = {joint.find("child").get("link") for joint in root.findall("joint")}  # type: ignore[union-attr]
    pending = [(next(name for name in links if name not in children), np.eye(3), np.zeros(3), False)]
    total, joints = np.zeros(13), {}
    while pending:
        name, R, p, moves = pending.pop()
        inertial = links[name].find("inertial")
        if moves and inertial is not None:
            turn, com = pose(inertial)
            xx, xy, xz, yy, yz, zz = (
                numbers(inertial.find("inertia"), key, "")[0] for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            )
            tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
            total += stored(numbers(inertial.find("mass"), "value", "")[0], com, tensor, R, p)
        for joint in below.get(name, ()):
            turn, position = pose(joint)
            if joint.get("type") != "fixed":
                axis = numbers(joint.find("axis"), "xyz", "1 0 0")
                limits = [numbers(joint.find("limit"), key, "0")[0] for key in ("lower", "upper", "effort", "velocity")]
                joints[str(joint.get("name"))] = np.array([*(axis / np.linalg.norm(axis)), *limits])
            child = joint.find("child").get("link")  # type: ignore[union-attr]
            pending.append((child, R @ turn, p + R @ position, moves or joint.get("type") != "fixed"))
    return total, joints


@pytest.mark.filterwarnings("ignore:.*mutated.urdf:UserWarning")
def test_mutations_are_refused_or_read_in_full(tmp_path: Path) -> None:
    """Never a traceback, never a loss: what is read has the masses, moments, axes, limits of two other counts."""
    rng, read, refusals = np.random.default_rng(8), 0, []
    path = tmp_path / "mutated.urdf"
    for k in range(MUTATIONS):
        text = mutated(rng)
        path.write_text(text, encoding="utf-8")
        try:
            model = Model.from_urdf(path)
        except DynsimError as error:
            refusals.append(str(error))
            continue
        read += 1
        assert_pinocchio_reads_the_same(path)
        total, joints = counted(text)
        inertia, at_rest = np.zeros(13), np.zeros(model.n)
        for link in model.robot.links:
            R, p = model.body_pose(link.name, at_rest)
            inertia += stored(link.inertia.mass, link.inertia.com, link.inertia.tensor, R, p)
            limits = [link.lower, link.upper, link.effort_limit, link.velocity_limit]
            # No limit: of position for 1e9, of the others for zero.
            limits = [0.0 if np.isinf(limit) else limit for limit in limits]
            np.testing.assert_allclose([*link.axis, *limits], joints.pop(link.joint), rtol=1e-12, atol=1e-12)
        assert not joints, k
        # Sums of three bodies within a metre.
        np.testing.assert_allclose(
            inertia, total, rtol=1e-12, atol=1e-12 * np.abs(total).max(), err_msg=f"{k}:\n{text}"
        )
    assert all(line.isprintable() for message in refusals for line in message.splitlines())
    # Both ways are met often.
    assert 0.2 * MUTATIONS < read < 0.8 * MUTATIONS


INSIDE = '<{0}><link name="payload">{1}</link></{0}></robot>'


@pytest.mark.parametrize("around", ["group", "model", "sensor", "x:part"])
def test_a_link_that_would_be_ignored_is_refused(tmp_path: Path, around: str) -> None:
    text = f'<robot name="r" xmlns:x="x"><link name="a">{INERTIAL}</link>' + INSIDE.format(around, INERTIAL)
    (tmp_path / "bad.urdf").write_text(text)
    check_message(refused(tmp_path / "bad.urdf"), "<link>", f"<{around}>", "<robot>")


def test_text_where_urdf_has_attributes_is_refused(tmp_path: Path) -> None:
    text = '<robot name="r"><link name="a"><inertial><mass value="8.5">80</mass>'
    text += f"{TENSOR}</inertial></link></robot>"
    (tmp_path / "bad.urdf").write_text(text)
    check_message(refused(tmp_path / "bad.urdf"), "<mass>", "'80'")

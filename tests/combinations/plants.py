"""Robots of scenes: an arm that descends to its elbow and rises behind it, on each kind of base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.random import Generator

from combinations.factors import Levels

# Revolute links: [m] and [kg].
LENGTH, MASS, RADIUS = (0.15, 0.3), (0.1, 0.5), (0.01, 0.03)


@dataclass(frozen=True)
class Joint:
    """A joint that can have a motor.

    Attributes
    ----------
    start : float
        Its position in the keys of the plant [° or m].
    body : str
        Body that it moves.
    before : bool
        It is before the elbow, so that the elbow moves with it.
    """

    name: str
    kind: str
    start: float
    body: str
    before: bool

    @property
    def turns(self) -> bool:
        return self.kind == "revolute"


@dataclass
class Plant:
    """A robot, and its properties that scenes need.

    Attributes
    ----------
    section : dict
        ``plant:`` of the scenario, without motors, friction and stops.
    joints : list of Joint
        Joints that can have a motor, in order.
    follower : str
        Joint that is coupled to another; empty if there is no coupling.
    elbow, hand, last : tuple
        (body, point in its axes [m]); ``last`` is the body before the hand's point.
    radius : float
        Radius of the links [m].
    files : dict
        Content of files, with the file names as keys.
    limited : list
        Joints that soon reach a stop.
    """

    section: dict[str, Any]
    joints: list[Joint]
    elbow: tuple[str, list[float]]
    hand: tuple[str, list[float]]
    radius: float
    files: dict[str, str] = field(default_factory=dict)
    limited: set[str] = field(default_factory=set)

    def entry(self, joint: Joint) -> dict[str, Any]:
        """Return the entry of ``chain`` for a joint of a serial arm."""
        chain = self.section.get("arm", self.section)["chain"]
        entry: dict[str, Any] = chain[int(joint.name.removeprefix("joint_")) - 1]
        return entry

    @property
    def serial(self) -> bool:
        return "chain" in self.section.get("arm", self.section)

    @property
    def arm(self) -> dict[str, Any]:
        """Return the section with the keys of the arm."""
        section: dict[str, Any] = self.section.get("arm", self.section)
        return section


def plant(random: Generator, levels: Levels) -> Plant:
    """Return the robot of an assignment."""
    name = levels["plant"]
    light = 0.3 if levels["motor"] == "velocity" else 1.0
    if name in ("revolute", "prismatic"):
        return _serial(random, name == "prismatic", light)
    if name == "mobile":
        return _mobile(random, levels, light)
    return _urdf(random, name, levels, light)


def _serial(random: Generator, slides: bool, light: float, yaw: bool | None = None) -> Plant:
    radius = float(random.uniform(*RADIUS))
    yaw = bool(random.random() < 0.6) if yaw is None else yaw
    down = [*(["yaw"] if yaw else []), *(["rail"] if slides else []), *["down"] * int(random.integers(1, 3))]
    up = [*(["up"] * int(random.integers(1, 3))), *(["slide"] if slides and random.random() < 0.6 else [])]
    chain: list[dict[str, Any]] = []
    joints: list[Joint] = []
    before = 0.0
    for k, kind in enumerate([*down, *up]):
        length = float(random.uniform(*LENGTH))
        mass = float(light * random.uniform(*MASS))
        entry: dict[str, Any] = {"axis": "y", "length_m": length, "mass_kg": mass}
        start, slider = 0.0, kind in ("rail", "slide")
        if kind == "yaw":
            start = float(random.uniform(-20, 20))
            entry |= {"axis": "z", "length_m": 0.0, "initial_deg": start}
        elif slider:
            axis, start = ("x", float(random.uniform(-0.05, 0.05))) if kind == "rail" else ("z", 0.05)
            entry |= {"kind": "prismatic", "axis": axis, "initial_m": start}
            if kind == "rail":
                entry["length_m"] = 0.0
        else:
            pitch = float(random.uniform(112, 125) if kind == "down" else random.uniform(30, 75))
            start, before = pitch - before, pitch
            entry["initial_deg"] = start
        chain.append(entry)
        shape = "prismatic" if slider else "revolute"
        joints.append(Joint(f"joint_{k + 1}", shape, start, f"link_{k + 1}", k < len(down)))
    elbow = (f"link_{len(down) + 1}", [0.0, 0.0, 0.0])
    last = (f"link_{len(chain)}", [0.0, 0.0, chain[-1]["length_m"]])
    return Plant({"type": "serial_arm", "link": {"radius_m": radius}, "chain": chain}, joints, elbow, last, radius)


def _mobile(random: Generator, levels: Levels, light: float) -> Plant:
    arm = _serial(random, False, light)
    wheel = {"mass_kg": 0.25, "radius_m": 0.05, "damping_N_m_s_per_rad": 0.05}
    base = {
        "heading_deg": float(random.uniform(-180, 180)),
        "mass_kg": 12.0,
        "wheel": wheel,
        # Below the origin of the base, where candidates would put it under the floor of the elbow.
        "mount": {"position_m": [-0.05, 0.0, 0.0]},
    }
    wheels = [Joint(f"base.{side}", "revolute", 0.0, f"base.{side}", True) for side in ("left", "right")]
    section = {"type": "pws_arm", "base": base, "arm": arm.section}
    return Plant(section, [*wheels, *arm.joints], arm.elbow, arm.hand, arm.radius)


def _urdf(random: Generator, name: str, levels: Levels, light: float) -> Plant:
    lengths = random.uniform(*LENGTH, size=2).tolist()
    masses = (light * random.uniform(*MASS, size=4)).tolist()
    pitch, back, yaw = float(random.uniform(112, 125)), float(random.uniform(-80, -50)), float(random.uniform(-20, 20))
    root = {"floating": "floating", "planar": "planar"}.get(name)
    losses = levels["rubbing"]
    # Some values are in the file instead of in the scenario.
    dynamics = f'<dynamics damping="{0.05 if losses == "viscous" else 0.0}" friction="0"/>'

    def link(body: str, mass: float, length: float) -> str:
        across, along = mass * (length**2 + 3e-3) / 12.0, mass * 3e-4
        return (
            f'  <link name="{body}"><inertial><origin xyz="0.01 0 {length / 2:.6g}"/><mass value="{mass:.6g}"/>'
            f'<inertia ixx="{across:.6g}" ixy="0" ixz="0" iyy="{across:.6g}" iyz="0" izz="{along:.6g}"/></inertial>'
            "</link>"
        )

    def joint(own: str, kind: str, parent: str, child: str, xyz: str, axis: str = "", inner: str = "") -> str:
        along = f'<axis xyz="{axis}"/>' if axis else ""
        return (
            f'  <joint name="{own}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}"/>{along}{inner}</joint>'
        )

    # Half of the files have faults, which the scenario corrects; then a floating base is a key.
    corrected = pitch > 118.0
    text = ['<robot name="combined">', link("trunk", 3.0, 0.1)]
    if not (corrected and root == "floating"):
        text.append('  <link name="ground"/>')
    if root is None:
        text.append(joint("stand", "fixed", "ground", "trunk", "0 0 0"))
    elif not corrected or root == "planar":
        text.append(joint("root", root, "ground", "trunk", "0 0 0", "0 0 1" if root == "planar" else ""))
    limit = '<limit lower="-3" upper="3" effort="0" velocity="0"/>'
    text += [
        link("turret", masses[0], 0.05), link("upper", masses[1], lengths[0]),
        link("fore", (3.0 if corrected else 1.0) * masses[2], lengths[1]),
        '  <link name="tool0"/>', link("finger", 0.1 * light, 0.05),
        joint("shoulder", "continuous", "trunk", "turret", "0 0 0.01", "0 0 1", dynamics),
        joint("lift", "revolute", "turret", "upper", "0 0 0", "0 1 0", limit + dynamics),
        joint("bend", "revolute", "upper", "fore", f"0 0 {lengths[0]:.6g}", "0 1 0", limit + dynamics),
        joint("flange", "fixed", "fore", "tool0", f"0 0 {lengths[1]:.6g}"),
        joint("grip", "prismatic", "fore", "finger", f"0 0.02 {lengths[1]:.6g}", "0 1 0",
              '<limit lower="-0.1" upper="0.1" effort="0" velocity="0"/>' + dynamics),
    ]  # fmt: skip
    joints = [
        Joint("shoulder", "revolute", yaw, "turret", True),
        Joint("lift", "revolute", pitch, "upper", True),
        Joint("bend", "revolute", back, "fore", False),
        Joint("grip", "prismatic", 0.01, "finger", False),
    ]
    if name == "mimic":
        text += [
            link("other_finger", 0.1 * light, 0.05),
            joint("other_grip", "prismatic", "fore", "other_finger", f"0 -0.02 {lengths[1]:.6g}", "0 1 0",
                  f'<limit lower="-1" upper="1" effort="0" velocity="0"/>{dynamics}'
                  '<mimic joint="grip" multiplier="-1" offset="0.005"/>'),
        ]  # fmt: skip
    text.append("</robot>")
    section: dict[str, Any] = {
        "type": "urdf_arm",
        "file": "robot.urdf",
        "initial_deg": {own.name: own.start for own in joints if own.turns},
        "initial_m": {own.name: own.start for own in joints if not own.turns},
        "hand": {"body": "tool0"},
    }
    if corrected:
        across, along = masses[2] * (lengths[1] ** 2 + 3e-3) / 12.0, masses[2] * 3e-4
        section["links"] = {"fore": {"mass_kg": masses[2], "inertia_kg_m2": [across, 0.0, 0.0, across, 0.0, along]}}
        section["base"] = "floating" if root == "floating" else "fixed"
    if root is not None:
        spot = random.uniform(-0.2, 0.2, size=3).tolist()
        turn = [0.0, 0.0, float(random.uniform(-180, 180))]
        if root == "planar":
            spot[2] = 0.0
        elif levels["contact"] in ("nothing", "free", "glued"):
            turn = random.uniform(-40, 40, size=3).tolist()
        section["initial_pose"] = {"root": {"position_m": spot, "rpy_deg": turn}}
    files = {"robot.urdf": "\n".join(text) + "\n"}
    return Plant(section, joints, ("fore", [0.0, 0.0, 0.0]), ("tool0", [0.0, 0.0, 0.0]), 0.0, files)


def set_limits(robot: Plant, joint: Joint, lower: float, upper: float) -> None:
    """Set stops of a joint [° or m]."""
    if robot.serial:
        robot.entry(joint)["limit_deg" if joint.turns else "limit_m"] = [lower, upper]
        return
    if "links" in robot.section:
        key = "limit_deg" if joint.turns else "limit_m"
        robot.section.setdefault("joints", {}).setdefault(joint.name, {})[key] = [lower, upper]
        return
    text = robot.files["robot.urdf"]
    start = text.index(f'<joint name="{joint.name}"')
    end = text.index("</joint>", start)
    scale = 0.017453292519943295 if joint.turns else 1.0
    own = f'<limit lower="{scale * lower:.9g}" upper="{scale * upper:.9g}" effort="0" velocity="0"/>'
    inner = text[start:end]
    if "<limit" in inner:
        head, _, tail = inner.partition("<limit")
        inner = head + own + tail.partition("/>")[2]
    else:
        inner += own
    robot.files["robot.urdf"] = text[:start] + inner.replace("continuous", "revolute") + text[end:]


def set_losses(robot: Plant, random: Generator, level: str) -> None:
    """Set damping and dry friction of bearings; dry friction of gears belongs to the motors."""
    damping = float(random.uniform(0.02, 0.3)) if level == "viscous" else 0.0
    dry = float(random.uniform(0.02, 0.3)) if level in ("bearing", "both") else 0.0
    slides = any(not joint.turns for joint in robot.joints)
    keys: dict[str, Any] = {}
    if damping:
        keys["damping_N_m_s_per_rad"] = damping
        keys |= {"damping_N_s_per_m": 10.0 * damping} if slides else {}
    if dry:
        keys["friction_N_m"] = dry
        keys |= {"friction_N": 10.0 * dry} if slides else {}
    if not robot.serial:
        robot.section |= keys
        return
    for joint in robot.joints:
        if joint.name.startswith("joint_"):
            kind = ("damping_N_m_s_per_rad", "friction_N_m") if joint.turns else ("damping_N_s_per_m", "friction_N")
            robot.entry(joint).update({key: value for key, value in keys.items() if key in kind})


def set_motors(robot: Plant, motors: Mapping[str, Mapping[str, Any]]) -> None:
    """Set the motors of joints, with the joint names as keys."""
    if not robot.serial:
        if "links" in robot.section:
            for name, motor in motors.items():
                robot.section.setdefault("joints", {}).setdefault(name, {})["motor"] = dict(motor)
        else:
            robot.section["motors"] = {name: dict(motor) for name, motor in motors.items()}
        return
    for joint in robot.joints:
        motor = motors.get(joint.name)
        if motor is not None and joint.name.startswith("joint_"):
            robot.entry(joint)["motor"] = dict(motor)
    if (wheel := motors.get("base.left")) is not None:
        robot.section["base"]["wheel"]["motor"] = dict(wheel)

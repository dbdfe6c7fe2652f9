"""The articulated mobile robot as a tree of bodies: plant ``snake`` with ``level: dynamic``.

    floating ─ pair1 ┬ head_psi3 ─ head_theta3 ─ … ─ head_theta1            head branch, axes with a minus sign
                     ├ pair2 (theta4) ─ plate2 (psi4) ─ pair3 (theta5) ─ …   tail branch
                     └ wheel1L, wheel1R on pair1, wheel2L, wheel2R on pair2, …

The root is the body behind the axle of wheel pair 1, at that axle. Towards the tail, a joint rotates by Rz(θ) or Ry(ψ).
A joint of the head branch rotates the bodies on its head side and therefore has the axis −e_z or −e_y. Joint angles are
defined as in :mod:`dynsim.snake.kinematics`. Pitch joints on the axles of the base part, ψ4 … ψ8, lift wheel pairs
(:mod:`dynsim.snake.lifting`).

All wheels are bodies with spherical contacts: a driven wheel has a servo in velocity mode, the other wheels rotate
freely. Their masses are included in the link masses of the kinematic level; they add only their spin inertia.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.scene import BODY_RADIUS, snake_tube, snake_wheel
from dynsim.errors import ModelError
from dynsim.model.description import Array, Foot, Inertia, Link, Robot, Tie
from dynsim.model.drives import Drive, Servo
from dynsim.model.gripper import Gripper
from dynsim.model.joints.ball import floating
from dynsim.snake.description import SnakeDescription
from dynsim.snake.lifting import BasePart, Lifts

GROUND = "ground"
ROOT = "pair1"
HEAD = "head"
_X, _Y, _Z = np.eye(3)
# Width and height of the solid boxes that represent links, which are as long as the link [m] (assumed).
BOX_WIDTH = 0.08


@dataclass(frozen=True)
class SnakeTree(Robot):
    """The tree of a snake with the data for its controller.

    Attributes
    ----------
    description : SnakeDescription
        Description of the snake.
    base_part : BasePart
        Base part of the snake, as it is folded about its axles.
    lifts : Lifts
        Height and timing of lifted wheel pairs.
    sag_compensation : bool
        If True, commands of the pitch joints of lifted pairs compensate the sag of their servos.
    raised : bool
        If True, a run starts after the head has been raised from below. If False, the head is released in its posture
        at the start, before anything has sagged.
    gripper : Gripper
        Gripper on its head.
    """

    description: SnakeDescription = field(kw_only=True)
    base_part: BasePart = field(kw_only=True)
    lifts: Lifts = field(kw_only=True)
    sag_compensation: bool = field(kw_only=True)
    raised: bool = field(kw_only=True)
    gripper: Gripper = field(kw_only=True)

    def holding(self, name: str) -> list[Tie]:
        """Return the ties by which the gripper can hold an object."""
        return self.gripper.ties(name)

    @property
    def lifting_joints(self) -> tuple[str, ...]:
        """Pitch joints on the axles of pairs 1, 2, …, except the last; the first is the last head joint."""
        return self.lifts.joints

    @property
    def wheel_joints(self) -> tuple[str, ...]:
        """Joints of the driven wheels, in the order of ρ."""
        sides = self.description.driven_side
        return tuple(wheel_joint(pair, int(side)) for pair, side in enumerate(sides) if side)


def wheel_joint(pair: int, side: int) -> str:
    """Return the joint name of a wheel; ``pair`` counts from 0, and ``side`` is 1 for left and −1 for right."""
    return f"wheel{pair + 1}{'L' if side > 0 else 'R'}"


def lifting_joints(d: SnakeDescription) -> tuple[str, ...]:
    """Return the names of the pitch joints on the axles of pairs 1, 2, …, except the last pair.

    The joint on the axle of pair 1 carries the head.
    """
    first = d.head_joints // 2
    return tuple(f"psi{first + k}" for k in range(d.pairs - 1))


def snake_tree(
    d: SnakeDescription,
    joint_servo: Callable[[str], Drive],
    wheel_servo: Callable[[str], Drive],
    *,
    yaw_stop: float,
    pitch_stop: float,
    wheel_inertia: float,
    bearing_drag: float,
    massless_wheels: bool,
    lifts: Lifts,
    sag_compensation: bool,
    raised: bool,
    gripper: Gripper,
) -> SnakeTree:
    """Return the tree of a snake in its initial posture, with all wheels on the ground z = 0.

    Parameters
    ----------
    d : SnakeDescription
        Description of the snake.
    joint_servo, wheel_servo : callable
        Functions that return the servo of a joint, given the name of the joint.
    yaw_stop, pitch_stop : float
        Mechanical stops of the joints, symmetric about zero [rad].
    wheel_inertia : float
        Inertia of each wheel about its axle, without its servo [kg m²].
    bearing_drag : float
        Viscous drag of each wheel [N m s/rad].
    massless_wheels : bool
        If True, wheels without a servo are not bodies: they have no friction in the rolling direction and no drag.
    lifts : Lifts
        Height and timing of lifted wheel pairs.
    sag_compensation, raised : bool
        See :class:`SnakeTree`.
    gripper : Gripper
        Gripper, with its tip in front of the head point.

    Raises
    ------
    ModelError
        If a servo does not follow positions (joints) or rates (wheels).
    """
    l, n_h = d.link_length, d.head_joints
    masses = d.link_mass  # head to tail
    floating_root = Link(
        ROOT, "base", None, "floating", _X, _link_inertia(masses[n_h], l, -1.0), shapes=(snake_tube(d, -l, 0.0),)
    )
    links = list(floating(floating_root))

    def link(name: str, joint: str, parent: str, axis: Array, x: float, mass: float, ahead: float) -> Link:
        stop = pitch_stop if axis[1] else yaw_stop
        start, end = (0.0, l) if ahead > 0.0 else (-l, 0.0)
        return Link(
            name,
            joint,
            parent,
            "revolute",
            axis,
            _link_inertia(mass, l, ahead),
            p_PJ=np.array([x, 0.0, 0.0]),
            lower=-stop,
            upper=stop,
            radius=BODY_RADIUS * d.wheel_radius,
            # The gripper extends the head forwards.
            tip=np.array([end + float(gripper.tip[0]) if name == HEAD else start + end, 0.0, 0.0]),
            shapes=(snake_tube(d, start, end),),
        )

    parent = ROOT
    for j in reversed(range(n_h)):
        joint = d.joint_names[j]
        name = HEAD if j == 0 else f"head_{joint}"
        links.append(link(name, joint, parent, -_Y if d.pitch[j] else -_Z, 0.0 if j == n_h - 1 else l, masses[j], 1.0))
        parent = name
    lifting = lifting_joints(d)
    parent, axles = ROOT, [(ROOT, 0.0)]
    for k in range(d.base_joints):
        pair = f"pair{k + 2}"
        joint = d.joint_names[n_h + k]
        links.append(link(pair, joint, parent, _Z, -l, masses[n_h + 2 * k + 1], -1.0))
        axles.append((pair, -l))
        if k + 1 < d.base_joints:
            parent = f"plate{k + 2}"
            links.append(link(parent, lifting[k + 1], pair, _Y, -l, masses[n_h + 2 * k + 2], -1.0))
    wheels, feet, driven = [], [], []
    for pair_index, (body, x) in enumerate(axles):
        for side in (1, -1):
            name = wheel_joint(pair_index, side)
            position = np.array([x, side * float(d.half_track[pair_index]), 0.0])
            if massless_wheels and side != d.driven_side[pair_index]:
                feet.append(Foot(name, body, position, d.wheel_radius, GROUND, grip_axis=_X))
                continue
            wheels.append(
                Link(
                    f"{name}.wheel",
                    name,
                    body,
                    "revolute",
                    _Y,
                    Inertia(0.0),
                    p_PJ=position,
                    damping=bearing_drag,
                    armature=wheel_inertia,
                    shapes=(snake_wheel(d),),
                )
            )
            feet.append(Foot(name, f"{name}.wheel", np.zeros(3), d.wheel_radius, GROUND))
            if side == d.driven_side[pair_index]:
                driven.append(name)
    links += wheels
    feet.append(Foot(HEAD, HEAD, np.array([l, 0.0, 0.0]), BODY_RADIUS * d.wheel_radius, GROUND))
    motors = [joint_servo(name) for name in (*d.joint_names, *lifting[1:])]
    motors += [wheel_servo(name) for name in driven]
    for motor, velocity_mode in zip(motors, [False] * (len(motors) - len(driven)) + [True] * len(driven), strict=True):
        if not isinstance(motor, Servo) or motor.velocity_mode != velocity_mode:
            key, follows = ("wheel_servo", "rates") if velocity_mode else ("joint_servo", "positions")
            raise ModelError(f"plant.dynamics.{key}: must be a servo that follows {follows}, such as the default")
    pairs, lengths = tuple(f"pair{k + 1}" for k in range(d.pairs)), np.full(d.base_joints, l)
    robot = SnakeTree(
        "snake",
        tuple(links),
        tuple(motors),
        (HEAD, np.array([l + d.point_offset, 0.0, 0.0])),
        feet=tuple(feet),
        description=d,
        base_part=BasePart(pairs, lengths, lengths, d.half_track, d.wheel_radius, "phi", d.joint_names[n_h:]),
        lifts=lifts,
        sag_compensation=sag_compensation,
        raised=raised,
        gripper=replace(gripper, body=HEAD, tip=np.array([l, 0.0, 0.0]) + gripper.tip),
    )
    return replace(robot, q0=configuration(robot, np.asarray(d.initial_joints), np.zeros(d.pairs)))


def configuration(robot: SnakeTree, phi: Array, height: Array) -> Array:
    """Return the coordinates (nq,) of the tree on its wheels, for joint angles and heights of wheel pairs.

    ``phi``, (n_phi,), contains the angles [rad] and ``height``, (pairs,), the heights [m]. Pair 1 is flat on the
    ground. The heights are computed for thin discs. If a bent base twists, some contact spheres of the wheels would be
    lower than these discs; the robot is then raised until the lowest sphere touches the ground.
    """
    d = robot.description
    hinge = robot.base_part.fold(phi[None, d.head_joints :], height[None]).hinge[0]
    angles = dict(zip(d.joint_names, phi.tolist(), strict=True))
    for joint, angle in zip(robot.lifting_joints, hinge.tolist(), strict=True):
        angles[joint] = angles.get(joint, 0.0) + angle
    return at_angles(robot, angles, float(hinge[0]))


def at_angles(robot: SnakeTree, angles: Mapping[str, float], tilt: float = 0.0) -> Array:
    """Return the coordinates (nq,) of the tree with its lowest wheel on the ground.

    ``tilt`` [rad] tilts the body behind pair 1; a positive tilt raises the tail. ``angles`` contains joint angles
    [rad]; the other joints keep their initial positions.
    """
    d = robot.description
    q = robot.initial.copy()
    for joint, k in zip(robot.joint_names, robot.position_index, strict=True):
        q[k] = angles.get(joint, q[k])
    x, y, yaw = d.initial_base_pose
    c, s = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    cp, sp = np.cos(0.5 * tilt), np.sin(0.5 * tilt)
    # Rz(yaw) Ry(hinge)
    q[:7] = x, y, d.wheel_radius, c * cp, -s * sp, c * sp, s * cp
    model = Model(robot)
    own = robot.feet[: 2 * d.pairs + 1]  # excludes the feet of objects
    q[2] -= min(model.point_position(foot.body, foot.point, q)[2] - foot.radius for foot in own)
    return q


def _link_inertia(mass: float, length: float, ahead: float) -> Inertia:
    """Return the inertia of a solid box in front of the joint (1) or behind it (−1)."""
    across = mass * (length**2 + BOX_WIDTH**2) / 12.0
    tensor = np.diag([mass * BOX_WIDTH**2 / 6.0, across, across])
    return Inertia(float(mass), np.array([0.5 * ahead * length, 0.0, 0.0]), tensor)

"""Scene of an arm or a snake for pictures: bodies, joints, shapes, surfaces and points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from dynsim.compile.clearance import axis_ends
from dynsim.model.description import Array, Contact, Link, Robot
from dynsim.model.drives import Motor
from dynsim.model.mobile_base import SUPPORTS, MobileBase
from dynsim.model.surfaces import Box, Capsule, HeightField, Quadric, Surface
from dynsim.record.quaternion import of_turn
from dynsim.record.scene import (
    HERE,
    WORLD,
    Body,
    FixedFrame,
    Joint,
    JointKind,
    Point,
    Quaternion,
    Scene,
    SceneSurface,
    Shape,
    quaternion,
    vector3,
)

if TYPE_CHECKING:
    from dynsim.snake.description import SnakeDescription

# Maximum number of grid lines of a drawn height field in each direction.
GRID_LINES = 61
# Width of a wheel relative to its radius; the description of a snake contains no width.
WHEEL_WIDTH = 0.48
BASE_WHEEL_WIDTH = 0.5
# Size at which infinite surfaces on bodies are drawn [m].
PATCH = 0.2
# Radius of the snake's body relative to the wheel radius.
BODY_RADIUS = 0.5
_ALONG_X: Quaternion = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
_ALONG_Y: Quaternion = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)


def robot_scene(robot: Robot, contacts: Sequence[Contact], surfaces: Mapping[str, Surface]) -> Scene | None:
    """Return the scene of a tree of bodies with joint positions ``q``; None if a joint cannot be drawn."""
    index = {link.name: k for k, link in enumerate(robot.links)}
    bodies, tips = [], axis_ends(robot)
    for link in robot.links:
        kind = link.row.drawn
        if kind is None:
            return None
        parent = WORLD if link.parent is None else index[link.parent]
        own = (surface for surface in surfaces.values() if surface.carrier == link.name)
        carried = tuple(solid_shape(surface, _patch(tips[link.name])) for surface in own)
        bodies.append(Body(link.name, parent, _joint(link, kind), shapes(link) + carried))
    hand_body, hand_point = robot.hand
    points = [Point("hand", "hand", index[hand_body], vector3(hand_point))]
    supports: tuple[Point, ...] = ()
    if robot.base is not None:
        bodies.extend(_wheels(robot.base, index[robot.base.body]))
        supports = _supports(robot.base, index[robot.base.body])
    for contact in contacts:
        body, point = robot.attach(contact.body, contact.point)
        friction = float(contact.friction_at_rest)
        tip = None if contact.tip is None else vector3(robot.attach(contact.body, contact.tip)[1])
        radius, surface = float(contact.radius), contact.surface_name
        carrier = WORLD if contact.surface.carrier is None else index[contact.surface.carrier]
        points.append(Point(contact.name, "contact", body, vector3(point), surface, friction, radius, tip, carrier))
    return Scene(
        tuple(bodies),
        tuple(drawn_surface(name, surface) for name, surface in surfaces.items() if surface.carrier is None),
        tuple(points),
        robot.fixed_shapes,
        supports,
        resistance=_shared(motor.resistance for motor in robot.motors if isinstance(motor, Motor)),
        voltage_limit=_shared(motor.voltage_limit for motor in robot.motors if isinstance(motor, Motor)),
        frames=tuple(
            FixedFrame(
                frame.name, WORLD if frame.body is None else index[frame.body], vector3(frame.p), quaternion(frame.R)
            )
            for frame in robot.frames
        ),
    )


def _shared(values: Iterable[float]) -> float | None:
    """Return the finite value that all values equal, or None."""
    different = set(values)
    value = different.pop() if len(different) == 1 else math.inf
    return float(value) if math.isfinite(value) else None


def _patch(tips: Sequence[Array]) -> float:
    """Return the size of infinite surfaces on a link with these axes [m]: 0.6 of the longest one, or PATCH."""
    return 0.6 * max((float(np.linalg.norm(tip)) for tip in tips), default=0.0) or PATCH


def solid_shape(surface: Surface, patch: float = PATCH) -> Shape:
    """Return the solid that represents a surface on a body; of infinite surfaces, a part of the size ``patch`` [m]."""
    if isinstance(surface, Box):
        return Shape("box", vector3(surface.edges), vector3(surface.centre), quaternion(surface.axes.T))
    if isinstance(surface, Capsule):
        length = float(np.linalg.norm(surface.axis))
        turn = turn_from_z(surface.axis / length) if length > 0.0 else HERE
        return Shape("capsule", (surface.radius, length), vector3(surface.start + 0.5 * surface.axis), turn)
    drawn = drawn_surface("", surface)
    position, radius = drawn.position or (0.0, 0.0, 0.0), abs(drawn.radius or 0.0)
    if drawn.kind == "sphere":
        return Shape("sphere", (radius,), position)
    turn = HERE if drawn.direction is None else turn_from_z(np.array(drawn.direction))
    if drawn.kind == "cylinder":
        return Shape("cylinder", (radius, patch), position, turn)
    if isinstance(surface, Quadric) and surface.middle is not None:
        position = vector3(surface.middle)
    return Shape("box", (patch, patch, 0.01 * patch), position, turn)


def drawn_surface(name: str, surface: Surface) -> SceneSurface:
    """Return a surface in the form stored in a scene."""
    empty = SceneSurface.of_quadric(name, np.zeros((3, 3)), np.zeros(3), 0.0)
    if isinstance(surface, Box):
        return replace(
            empty,
            kind="box",
            position=vector3(surface.centre),
            orientation=quaternion(surface.axes.T),
            edges=vector3(surface.edges),
            radius=float(surface.edge_radius),
        )
    if isinstance(surface, HeightField):
        heights, (dx, dy) = surface.heights, surface.spacing.tolist()
        heights, dx = _thinned(heights.T, dx)
        heights, dy = _thinned(heights.T, dy)
        return replace(
            empty,
            kind="height_field",
            position=vector3([*surface.origin, 0.0]),
            spacing=(dx, dy),
            heights=tuple(tuple(row) for row in heights.tolist()),
        )
    assert isinstance(surface, Quadric)
    return SceneSurface.of_quadric(name, surface.Q, surface.b, surface.c)


def _thinned(rows: Array, spacing: float) -> tuple[Array, float]:
    """Return equally spaced rows from the first to the last, at most GRID_LINES, and their spacing [m]."""
    count = len(rows)
    if count <= GRID_LINES:
        return rows, spacing
    at = np.linspace(0.0, count - 1.0, GRID_LINES)
    below = np.minimum(at.astype(int), count - 2)
    share = (at - below)[:, None]
    return (1.0 - share) * rows[below] + share * rows[below + 1], spacing * (count - 1) / (GRID_LINES - 1)


def _wheels(base: MobileBase, body: int) -> list[Body]:
    """Return the wheels as separate bodies that rotate on the base."""
    r, wheels = base.wheel_radius, []
    for name, side in zip(base.wheels, (0.5, -0.5), strict=True):
        position = (0.0, side * base.track, r)
        joint = Joint(f"{name}.axle", "revolute", (0.0, 1.0, 0.0), position, HERE, "q", (name,))
        wheels.append(
            Body(f"{name}.wheel", body, joint, (Shape("cylinder", (r, BASE_WHEEL_WIDTH * r), orientation=_ALONG_Y),))
        )
    return wheels


def _supports(base: MobileBase, body: int) -> tuple[Point, ...]:
    """Return the ground contact points of the wheels and the caster, with the names of their loads."""
    left, right = (vector3((0.0, side * base.track, 0.0)) for side in (0.5, -0.5))
    places = zip(SUPPORTS, (left, right, vector3(base.caster)), strict=True)
    return tuple(Point(name, "support", body, position) for name, position in places)


def _joint(link: Link, kind: JointKind) -> Joint:
    if link.kind == "left_wheel":  # the wheel angles do not determine the pose of the base
        position, columns = (0.0, 0.0, 0.0), ("x", "y", "heading")
        return Joint(
            link.joint, kind, (0.0, 0.0, 1.0), position, HERE, "base_pose", columns, part_of=link.joint_of_rows or ""
        )
    return Joint(
        name=link.joint,
        kind=kind,
        axis=vector3(link.axis),
        position=vector3(link.p_PJ),
        orientation=quaternion(link.R_PJ),
        signal="q",
        labels=link.coordinates,
        lower=_limit(link.lower),
        upper=_limit(link.upper),
        part_of=link.joint_of_rows or "",
    )


def _limit(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def shapes(link: Link, rod: Literal["cylinder", "capsule"] = "cylinder") -> tuple[Shape, ...]:
    """Return the shapes of a link's body or, if it has no shapes, the cylinder or capsule about its axis."""
    return link.shapes or _rod(link, rod)


def with_shapes(robot: Robot, rod: Literal["cylinder", "capsule"] = "cylinder") -> Robot:
    """Return the robot with the drawn shapes added to its links; ``rod`` is the shape of links without shapes."""
    return replace(robot, links=tuple(replace(link, shapes=shapes(link, rod)) for link in robot.links))


def _rod(link: Link, kind: Literal["cylinder", "capsule"]) -> tuple[Shape, ...]:
    """Return the cylinder or capsule about the body's axis; empty if its radius or end is unknown."""
    if link.tip is None or not link.radius > 0.0:
        return ()
    length = float(np.linalg.norm(link.tip))
    if not length > 0.0:
        return ()
    turn = turn_from_z(link.tip / length)
    return (Shape(kind, (link.radius, length), vector3(0.5 * link.tip), turn),)


def turn_from_z(direction: Array) -> Quaternion:
    """Return a rotation that maps the z axis to a unit vector."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    size = float(np.linalg.norm(axis))
    if size == 0.0:
        return HERE if direction[2] > 0.0 else (0.0, 1.0, 0.0, 0.0)
    w, x, y, z = of_turn(axis / size, math.atan2(size, float(direction[2]))).tolist()
    return w, x, y, z


def snake_scene(description: SnakeDescription) -> Scene:
    """Return the scene of an articulated mobile robot on the ground z = 0.

    The base part starts at wheel pair 1, whose pose is the signal ``base_pose``. Joint angles are in ``phi``; a joint
    of the head part rotates the bodies on its head side by −phi. Active wheels rotate by ``rho``. Lifted pairs are
    drawn on the ground, because the model has no height for them ([T] II.A).
    """
    d, l, n_h = description, description.link_length, description.head_joints
    base = Joint("base", "planar", (0.0, 0.0, 1.0), (0.0, 0.0, d.wheel_radius), HERE, "base_pose", ("x", "y", "yaw"))
    bodies = [Body("pair1", WORLD, base, _passive_wheels(d, 0, 0.0))]
    wheels = [_active_wheel(d, 0, 0, 0.0)]
    for j in reversed(range(n_h)):
        forward = 0.0 if j == n_h - 1 else l
        axis = (0.0, -1.0, 0.0) if d.pitch[j] else (0.0, 0.0, -1.0)
        joint = _snake_joint(d, j, axis, forward)
        bodies.append(Body(f"head_{d.joint_names[j]}", len(bodies) - 1, joint, (snake_tube(d, 0.0, l),)))
    head = len(bodies) - 1
    for pair in range(1, d.pairs):
        joint = _snake_joint(d, n_h + pair - 1, (0.0, 0.0, 1.0), -l if pair == 1 else -2.0 * l)
        parent = 0 if pair == 1 else len(bodies) - 1
        tube = snake_tube(d, -2.0 * l if pair < d.pairs - 1 else -l, 0.0)
        bodies.append(Body(f"pair{pair + 1}", parent, joint, (tube, *_passive_wheels(d, pair, -l))))
        wheels.append(_active_wheel(d, pair, len(bodies) - 1, -l))
    if d.pairs > 1:
        bodies[0] = Body("pair1", WORLD, base, (snake_tube(d, -l, 0.0), *bodies[0].shapes))
    ground = SceneSurface.of_quadric("ground", np.zeros((3, 3)), [0.0, 0.0, 1.0], 0.0)
    hand = Point("controlled point", "hand", head, (l + d.point_offset, 0.0, 0.0))
    return Scene((*bodies, *(wheel for wheel in wheels if wheel is not None)), (ground,), (hand,))


def _snake_joint(d: SnakeDescription, j: int, axis: tuple[float, float, float], x: float) -> Joint:
    name = d.joint_names[j]
    lower, upper = float(d.lower[j]), float(d.upper[j])
    return Joint(name, "revolute", axis, (x, 0.0, 0.0), HERE, "phi", (name,), lower, upper)


def snake_tube(d: SnakeDescription, start: float, end: float) -> Shape:
    """Return the tube that represents the snake's body along the x axis of a link, from start to end [m]."""
    return Shape("cylinder", (BODY_RADIUS * d.wheel_radius, end - start), (0.5 * (start + end), 0.0, 0.0), _ALONG_X)


def _passive_wheels(d: SnakeDescription, pair: int, x: float) -> tuple[Shape, ...]:
    """Return the passive wheels, whose angles are not recorded."""
    sides = [side for side in (1, -1) if side != d.driven_side[pair]]
    wheel = snake_wheel(d)
    return tuple(replace(wheel, position=(x, side * float(d.half_track[pair]), 0.0)) for side in sides)


def snake_wheel(d: SnakeDescription) -> Shape:
    """Return a wheel of a snake; its axle is the y axis of its body."""
    return Shape("cylinder", (d.wheel_radius, WHEEL_WIDTH * d.wheel_radius), orientation=_ALONG_Y)


def _active_wheel(d: SnakeDescription, pair: int, parent: int, x: float) -> Body | None:
    side = int(d.driven_side[pair])
    if not side:
        return None
    name = d.wheel_names[int(np.count_nonzero(d.driven_side[:pair]))]
    position = (x, side * float(d.half_track[pair]), 0.0)
    joint = Joint(name, "revolute", (0.0, 1.0, 0.0), position, HERE, "rho", (name,))
    return Body(f"wheel_{name}", parent, joint, (snake_wheel(d),))

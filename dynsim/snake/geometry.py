"""Geometry of a snake (joint axes and limits, head joints, wheels) from the scene of its record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import MissingEntry
from dynsim.record import Record
from dynsim.record.scene import Scene


@dataclass(frozen=True)
class SnakeGeometry:
    """Geometry of a snake.

    Attributes
    ----------
    head_joints : number of joints in the head part; they are the first columns of ``phi``, the joint angles
    pitch : (n_phi,) true where a joint turns about y (pitch), false about z (yaw)
    lower, upper : (n_phi,) limits of the joints [rad]
    wheel_radius : of the first pair [m]
    half_track : (number of wheel pairs,) distance from the middle of an axle to its wheels [m]
    """

    head_joints: int
    pitch: NDArray[np.bool_]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    wheel_radius: float
    half_track: NDArray[np.float64]


def snake_geometry(record: Record) -> SnakeGeometry:
    """Geometry of the snake of a record.

    Raises
    ------
    MissingEntry
        The record has no scene.
    """
    if record.scene is None:
        raise MissingEntry("the record has no scene, which says what the snake is like")
    names = record.labels["phi"]
    joints = {body.joint.name: body.joint for body in record.scene.bodies}
    lower, upper = np.array([[joints[name].lower, joints[name].upper] for name in names], dtype=np.float64).T
    wheels = [wheels_of(record.scene, pair) for pair in record.labels["grounded"]]
    return SnakeGeometry(
        head_joints=len(names) - len(wheels) + 1,
        pitch=np.array([abs(joints[name].axis[1]) > 0.5 for name in names]),
        lower=lower,
        upper=upper,
        wheel_radius=wheels[0][0].radius,
        half_track=np.array([max(wheel.beside for wheel in pair) for pair in wheels]),
    )


class WheelOfPair(NamedTuple):
    """Of a wheel pair: where along its body the axle is, how far beside the middle of the body it is, radius [m]."""

    along: float
    beside: float
    radius: float


def wheels_of(scene: Scene, pair: str) -> list[WheelOfPair]:
    """Wheels on a body: shapes of its own, and bodies that turn on it."""
    index = {body.name: k for k, body in enumerate(scene.bodies)}[pair]
    places = [(shape.position, shape) for shape in scene.bodies[index].shapes]
    places += [(body.joint.position, body.shapes[0]) for body in scene.bodies if body.parent == index and body.shapes]
    return [
        WheelOfPair(position[0], abs(position[1]), shape.size[0]) for position, shape in places if position[1] != 0.0
    ]

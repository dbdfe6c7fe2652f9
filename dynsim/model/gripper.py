"""Soft gripper that hardens around an object, like the omni-gripper of [T].

A soft gripper holds nothing. A hardened one holds an object by six ties, each with a spring, a damper and a bound.
Beyond a bound, the object slips and keeps its new position in the gripper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dynsim.model.description import Array, Robot, Tie

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
_GRASP = ".grasp"


class HoldingLaw(NamedTuple):
    """Spring, damper and bound of a hardened gripper [N/m, N s/m, N; for rotation N m/rad, N m s/rad, N m]."""

    stiffness: float
    damping: float
    bound: float


@dataclass(frozen=True)
class Gripper:
    """Position, capture range and stiffness of a gripper.

    Attributes
    ----------
    body : str
        Body that carries the gripper.
    tip : (3,) ndarray
        Tip in the frame of that body; the gripper points along its x axis [m].
    capture_distance, capture_angle : float
        Maximum distance [m] and angle [rad] to the grasp frame of an object at which the gripper captures the object.
    hardening, softening : float
        Durations of hardening and softening [s].
    along, about : HoldingLaw
        Laws along each axis and about each axis in the hardened state.
    lost_distance, lost_angle : float
        Slip beyond which an object counts as lost [m, rad].
    """

    body: str
    tip: Array
    capture_distance: float
    capture_angle: float
    hardening: float
    softening: float
    along: HoldingLaw
    about: HoldingLaw
    lost_distance: float
    lost_angle: float

    @property
    def laws(self) -> dict[str, HoldingLaw]:
        """Holding law in each of the :data:`DIRECTIONS`."""
        return {direction: self.about if len(direction) > 1 else self.along for direction in DIRECTIONS}

    def ties(self, object_name: str) -> list[Tie]:
        """Return the ties that hold an object at its grasp frame; they are inactive at the start."""
        return [
            Tie(
                tie_name(object_name, direction),
                self.body,
                grasp_frame(object_name),
                np.eye(3)["xyz".index(direction[-1])],
                *law,
                point=self.tip,
                turns=len(direction) > 1,
                rest=np.nan,
                holds=False,
            )
            for direction, law in self.laws.items()
        ]


def grasp_frame(name: str) -> str:
    """Return the name of the frame of an object at which a gripper holds it."""
    return name + _GRASP


def graspable(robot: Robot) -> tuple[str, ...]:
    """Return the names of the objects that have a grasp frame."""
    return tuple(frame.name.removesuffix(_GRASP) for frame in robot.frames if frame.name.endswith(_GRASP))


def tie_name(name: str, direction: str) -> str:
    """Return the name of the tie that holds an object in one of the :data:`DIRECTIONS`."""
    return f"gripper.{name}.{direction}"

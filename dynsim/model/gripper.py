"""A soft gripper that hardens around an object, as the omni-gripper of [T] does.

A soft gripper holds nothing. A hardened one holds an object by six ties, each with a spring, a damper and a bound.
Beyond a bound the object slips, and stays in its new position.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dynsim.model.description import Array, Tie

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Gripper:
    """Position, capture range and stiffness of a gripper.

    Attributes
    ----------
    body : that carries it; tip : (3,) of the gripper in the frame of that body, whose x axis it points along [m]
    capture_distance, capture_angle : from the grasp frame of an object, within which it captures that [m, rad]
    hardening, softening : times that these take [s]
    stiffness, damping, bound : along each axis, when it is hardened [N/m, N s/m, N]
    turning_stiffness, turning_damping, turning_bound : about each axis [N m/rad, N m s/rad, N m]
    lost_distance, lost_angle : by which an object that it holds has slipped when it counts as lost [m, rad]
    """

    body: str
    tip: Array = field(default_factory=lambda: np.zeros(3))
    capture_distance: float = 0.015
    capture_angle: float = 0.4
    hardening: float = 1.0
    softening: float = 0.5
    stiffness: float = 5e3
    damping: float = 20.0
    bound: float = 20.0
    turning_stiffness: float = 5.0
    turning_damping: float = 0.05
    turning_bound: float = 0.8
    lost_distance: float = 0.015
    lost_angle: float = 0.5

    def ties(self, object_name: str) -> list[Tie]:
        """Those by which it holds an object at its grasp frame; none of them holds at the start."""
        linear, turning = self.laws
        ties = []
        for k, name in enumerate(DIRECTIONS):
            stiffness, damping, bound = linear if k < 3 else turning
            ends = self.body, grasp_frame(object_name), np.eye(3)[k % 3]
            ties.append(
                Tie(
                    tie_name(object_name, name),
                    *ends,
                    stiffness,
                    damping,
                    bound,
                    point=self.tip,
                    turns=k >= 3,
                    rest=np.nan,
                    holds=False,
                )
            )
        return ties

    @property
    def laws(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Stiffness, damping and bound along axes and about them."""
        return (
            (self.stiffness, self.damping, self.bound),
            (self.turning_stiffness, self.turning_damping, self.turning_bound),
        )


def grasp_frame(name: str) -> str:
    """Name of the frame of an object at which a gripper holds it."""
    return f"{name}.grasp"


def tie_name(name: str, direction: str) -> str:
    """Name of the tie in one of the :data:`DIRECTIONS`."""
    return f"gripper.{name}.{direction}"

"""A base on two driven wheels and a caster, and where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dynsim.model.description import Link, Robot
    from dynsim.model.model import Model

Array = NDArray[np.float64]

# What the base stands on, in the order of the recorded loads.
SUPPORTS = ("left", "right", "caster")


@dataclass(frozen=True)
class MobileBase:
    """A base on two driven wheels and a caster ([WM] II.E); its frame: on the ground below the axle, x ahead.

    Attributes
    ----------
    body : name of the link that carries it
    wheels : joints of the left and of the right wheel; a positive rate rolls ahead
    wheel_radius : r [m]; track : T, between the wheels' contact points [m]
    caster : (3,) where the caster touches the ground, in the base's frame [m]
    spin_inertia : of one wheel about its axle [kg m²]
    wheel_friction : μ between wheels and ground, for the traction demand
    stop_on_overturn : whether a run ends when it tips; else it goes on as if held down
    """

    body: str
    wheels: tuple[str, str]
    wheel_radius: float
    track: float
    caster: Array
    spin_inertia: float
    wheel_friction: float = 0.8
    stop_on_overturn: bool = False


def base_row(robot: Robot) -> tuple[int, Link]:
    """Where the base's coordinates (left, right, x, y) begin in q, and its first row."""
    assert robot.base is not None
    i = robot.joint_names.index(robot.base.wheels[0])
    return robot.position_index[i], robot.links[i]


def base_pose(robot: Robot, q: Array) -> Array:
    """x, y [m] and heading [rad, not wrapped] of the base in the world at coordinates q, (T, nq) → (T, 3).

    heading = heading_0 + r (φ_r − φ_l)/T ([WM] II.E: ω_0 T = r (φ̇_r − φ̇_l)).
    """
    k, link = base_row(robot)
    left, right, x, y = q[:, k : k + 4].T
    place = link.p_PJ[:, None] + link.R_PJ @ np.stack([x, y, np.zeros_like(x)])
    start = np.arctan2(link.R_PJ[1, 0], link.R_PJ[0, 0])
    return np.stack([place[0], place[1], start + link.parameter * (right - left)], axis=1)


def static_margin(model: Model, q: Array, forces: Sequence[tuple[int, Array, Array]] = ()) -> float:
    """Tip margin of a base at rest, see :mod:`dynsim.kernels.tree.support`: 1 at the incentre, 0 tips, −1 lifted.

    Parameters
    ----------
    q : (nq,) coordinates
    forces : from outside beside the weight: index of the link, point in its frame [m], force in the world [N]
    """
    robot, base = model.robot, model.robot.base
    assert base is not None
    axes, origin = model.body_pose(base.body, q)
    force, moment = np.zeros(3), np.zeros(3)
    weights = [(i, link.inertia.com, link.inertia.mass * robot.gravity) for i, link in enumerate(robot.links)]
    for link, point, one in (*weights, *forces):
        force += one
        moment += np.cross(model.point_position(link, point, q) - origin, one)
    # What the ground gives back, in the axes of the base.
    carried, (turn_x, turn_y) = -float(axes[:, 2] @ force), (-axes.T @ moment)[:2]
    if carried <= 0.0:
        return -1.0
    x, y = base.caster[:2]
    caster = -turn_y / x
    difference = 2.0 * (turn_x - caster * y) / base.track
    loads = np.array([carried - caster + difference, carried - caster - difference, 2.0 * caster]) / 2.0
    half = 0.5 * base.track
    sides = np.array([np.hypot(x, y + half), np.hypot(x, y - half), base.track])
    return float((loads / carried * sides.sum() / sides).min())

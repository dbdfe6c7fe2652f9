"""Tip margin of a mobile base at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynsim.compile.model import Model
from dynsim.model.description import Array


def static_margin(model: Model, q: Array, forces: Sequence[tuple[int, Array, Array]] = ()) -> float:
    """Tip margin of a base at rest, see :mod:`dynsim.dynamics.tree.support`: 1 at the incentre, 0 tips, −1 lifted.

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
    for link, point, push in (*weights, *forces):
        force += push
        moment += np.cross(model.point_position(link, point, q) - origin, push)
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

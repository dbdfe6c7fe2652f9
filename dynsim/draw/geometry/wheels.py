"""Wheels of a record in groups, times on the ground, support polygon, and centre of pressure or mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.record import Record
from dynsim.record.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WheelGroups:
    """Wheels that are lifted together.

    Attributes
    ----------
    names : of the groups
    places : for each group (body, index of the shape on it)
    down : (T, groups), 1 on the ground; None where it was not recorded
    """

    names: tuple[str, ...] = ()
    places: tuple[tuple[tuple[int, int], ...], ...] = ()
    down: Array | None = None


def wheel_groups(record: Record, scene: Scene) -> WheelGroups:
    """Pairs of a snake, or the two wheels of a mobile base."""
    if "grounded" in record:
        names = record.labels["grounded"]
        index = {body.name: k for k, body in enumerate(scene.bodies)}
        places = [_of_pair(scene, index[name]) if name in index else () for name in names]
        return WheelGroups(names, tuple(places), np.asarray(record["grounded"], dtype=np.float64))
    wheels = scene.base[1:]
    if "wheel_load" in record and wheels:
        names = tuple(scene.bodies[k].joint.labels[0] for k in wheels)
        down = (record["wheel_load"][:, : len(wheels)] > 0.0).astype(np.float64)
        return WheelGroups(names, tuple(((k, 0),) for k in wheels), down)
    return WheelGroups()


def _of_pair(scene: Scene, pair: int) -> tuple[tuple[int, int], ...]:
    """Wheels on a body: its own beside its middle, and those that turn on it."""
    own = [(pair, k) for k, shape in enumerate(scene.bodies[pair].shapes) if shape.position[1] != 0.0]
    turning = [k for k, body in enumerate(scene.bodies) if body.parent == pair and body.joint.position[1] != 0.0]
    return (*own, *((k, 0) for k in turning))


def supports(scene: Scene, groups: WheelGroups) -> list[dict[str, Any]]:
    """Points whose hull the robot stands on: on which body, and with which group of wheels they are on the ground."""
    if scene.supports:
        return [{"body": point.body, "p": list(point.position), "group": -1} for point in scene.supports]
    points = []
    for group, places in enumerate(groups.places):
        for body, shape in places:
            points.append({"body": body, "p": list(scene.bodies[body].shapes[shape].position), "group": group})
    return points


def cop_of(record: Record) -> tuple[str, Array] | None:
    """What must lie within the support: centre of pressure of a mobile base, centre of mass of a snake, (T, 2)."""
    for signal, name in (("center_of_pressure", "centre of pressure"), ("centre_of_mass", "centre of mass")):
        if signal in record:
            return name, np.asarray(record[signal][:, :2], dtype=np.float64)
    return None

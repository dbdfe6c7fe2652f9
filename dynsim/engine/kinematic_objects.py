"""Objects of a kinematic snake: they have no forces, stay where they are, and follow the gripper while it holds them.

An object on a hinge turns with the gripper about its axis, an object on rails slides with it along them. A released
object stays in its position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.hand_posture import turn_error
from dynsim.compile.model import Model
from dynsim.compile.scene import robot_scene
from dynsim.engine.gripper import (
    HARDENED,
    HARDENING,
    SOFT,
    SOFTENING,
    add_gripper,
    gripper_event,
    in_words,
    nearest_object,
    refuse_capture,
)
from dynsim.engine.snake_record import attitude
from dynsim.model.description import Array, Link, Robot
from dynsim.model.gripper import Gripper, grasp_frame, graspable
from dynsim.record import Event, Record
from dynsim.record.scene import Scene, quaternion
from dynsim.scenario import Scenario
from dynsim.scenario.objects import SceneObject

# A grasp frame that is nearer to the axis of its hinge tells no angle: the turning of the gripper does [m].
ON_AXIS = 0.01


@dataclass
class HeldObject:
    """Object ``name`` in the gripper from one tick to another.

    ``start``, ``end`` : ticks; ``released`` : its coordinates from ``end`` on; ``tip``, ``q`` : pose of the gripper,
    rotation and position, and all coordinates at the start
    """

    name: str
    start: int
    end: float
    tip: tuple[Array, Array]
    q: Array
    released: Array | None = None


class CarriedObjects:
    """The objects of a run, and when the gripper held which.

    Parameters
    ----------
    gripper : its tip is ``ahead`` of the controlled point [m]
    period : control period [s]
    """

    def __init__(self, scenario: Scenario, gripper: Gripper, ahead: float, period: float) -> None:
        self.objects: dict[str, SceneObject] = scenario.config.objects
        self.gripper, self._ahead, self._period = gripper, ahead, period
        links = [link for name, body in self.objects.items() for link in body.links(name)]
        frames = [frame for name, body in self.objects.items() for frame in body.frames(name)]
        start = np.concatenate([body.start() for body in self.objects.values()])
        first = next(iter(self.objects))
        self.robot = Robot("objects", tuple(links), (), (first, np.zeros(3)), q0=start, frames=tuple(frames))
        self.model, self.q = Model(self.robot), start.copy()
        # Where the coordinates of each object are.
        sizes = [len(body.start()) for body in self.objects.values()]
        ends = np.cumsum(sizes).tolist()
        self._part = {name: slice(end - size, end) for name, size, end in zip(self.objects, sizes, ends, strict=True)}
        self.graspable = graspable(self.robot)
        self.grasps: list[HeldObject] = []
        self.events: list[Event] = []
        self._closed = False

    def tip(self, w: Array) -> tuple[Array, Array]:
        """Rotation and position of the gripper's tip at a pose (6,) of the controlled point."""
        R = attitude(w[None])[0]
        return R, w[:3] + self._ahead * R[:, 0]

    def command(self, tick: int, closed: bool, w: Array) -> None:
        """Close or open the gripper from a tick on, with the controlled point at w (6,).

        Raises
        ------
        SimulationStopped
            It closes, and nothing is within capture.
        """
        if closed == self._closed or not self.graspable:
            self._closed = closed
            return
        self._closed, time = closed, tick * self._period
        present = self.grasps[-1] if self.grasps and self.grasps[-1].end > tick else None
        if not closed:
            if present is not None:
                hardened = min((tick - present.start) * self._period / self.gripper.hardening, 1.0)
                present.end = tick + math.ceil(hardened * self.gripper.softening / self._period - 1e-9)
                self.events.append(gripper_event(present.end * self._period, "releases", present.name))
            return
        if present is not None:  # it was still softening
            present.end = np.inf
            self.events.pop()
            return
        tip = self.tip(w)
        name, distance, angle = nearest_object(self.model, self.graspable, self.q, tip, self.gripper)
        refuse_capture(self.gripper, time, name, distance, angle)
        self.grasps.append(HeldObject(name, tick, np.inf, tip, self.q.copy()))
        self.events.append(gripper_event(time, "captures", name, distance))

    def release(self, tick: int, w: Array) -> None:
        """Let go of an object whose time has come, with the controlled point at w (6,)."""
        for grasp in self.grasps:
            if grasp.released is None and grasp.end <= tick:
                part = self._part[grasp.name]
                grasp.released = self.q[part] = self._followed(grasp, *self.tip(w))

    def due(self, tick: int) -> float:
        """Return the number of periods until the next release."""
        return min((grasp.end - tick for grasp in self.grasps if grasp.released is None), default=math.inf)

    def _move_to(self, tick: int, w: Array) -> None:
        """Move the held object with the gripper, to its position at a tick, and those that were released."""
        for grasp in self.grasps:
            if tick >= grasp.end and grasp.released is not None:
                self.q[self._part[grasp.name]] = grasp.released
            elif grasp.start <= tick <= grasp.end:
                self.q[self._part[grasp.name]] = self._followed(grasp, *self.tip(w))

    def _followed(self, grasp: HeldObject, R: Array, p: Array) -> Array:
        """Coordinates of a held object with the gripper at R, p."""
        body, (R0, p0) = self.objects[grasp.name], grasp.tip
        index, at = self.robot.attach(grasp_frame(grasp.name), np.zeros(3))
        B, origin = self.model.body_pose(index, grasp.q)
        before = grasp.q[self._part[grasp.name]]
        if body.joint is None:
            turn = R @ R0.T
            return np.array([*(p + turn @ (origin - p0)), *quaternion(turn @ B), *before[7:]])
        link = self.robot.links[index]
        axis = B @ link.axis
        if body.slide is not None:
            return np.clip(before + axis @ (p - p0), link.lower, link.upper)
        # In the plane of the hinge: where the grasp frame was seen from the axis, and where it has gone with the tip.
        was = B @ at - axis * (axis @ B @ at)
        if np.linalg.norm(was) < ON_AXIS:
            return self._turned(grasp, before + axis @ turn_error(R0, R), link)
        now = was + (p - p0) - axis * (axis @ (p - p0))
        angle = float(np.arctan2(axis @ np.cross(was, now), was @ now))
        return self._turned(grasp, before + angle, link)

    def _turned(self, grasp: HeldObject, angle: Array, link: Link) -> Array:
        """An angle without its jumps by whole turns since the last position, within the limits of the hinge."""
        last = self.q[self._part[grasp.name]]
        turns = np.round((last - angle) / (2.0 * np.pi))
        return np.clip(angle + 2.0 * np.pi * turns, link.lower, link.upper)

    def state_in_words(self, tick: int) -> str:
        """Return the state of the gripper at a tick in words, for the page of a pilot."""
        present = next((grasp for grasp in reversed(self.grasps) if grasp.start <= tick <= grasp.end), None)
        return in_words(self._state(present, tick), None if present is None else present.name)

    def positions(self, tick: int, w: Array) -> dict[str, float]:
        """Return the coordinates of the objects by name, with the controlled point at w (6,) at this tick."""
        self._move_to(tick, w)
        return dict(zip(self.robot.position_names, self.q.tolist(), strict=True))

    def _state(self, grasp: HeldObject | None, tick: float) -> int:
        if grasp is None:
            return SOFT
        if (grasp.end - tick) * self._period <= self.gripper.softening:
            return SOFTENING if tick < grasp.end else SOFT
        return HARDENED if (tick - grasp.start) * self._period >= self.gripper.hardening else HARDENING

    def add_to(self, record: Record, w: Array, ticks: NDArray[np.int64]) -> None:
        """Coordinates of objects as the signal ``q``, and what the gripper did, at poses (T, 6) and ticks (T,)."""
        self.q, rows = self.robot.initial.copy(), []
        state, distance = np.zeros(len(ticks), dtype=np.int64), np.zeros(len(ticks))
        for row, tick in enumerate(ticks.tolist()):
            self._move_to(tick, w[row])
            rows.append(self.q.copy())
            if self.graspable:
                distance[row] = nearest_object(self.model, self.graspable, self.q, self.tip(w[row]))[1]
        for grasp in self.grasps:
            within = np.flatnonzero((ticks >= grasp.start) & (ticks <= grasp.end))
            state[within] = [self._state(grasp, tick) for tick in ticks[within].tolist()]
        labels = self.robot.position_names
        record.add("q", np.array(rows), "rad or m", labels=labels, description="coordinates of objects")
        if self.graspable:
            add_gripper(record, state, distance, self.events)

    def beside(self, scene: Scene) -> Scene:
        """The scene with the objects in it."""
        own = robot_scene(self.robot, (), {})
        assert own is not None
        shifted = len(scene.bodies)
        bodies = (replace(body, parent=body.parent + shifted) if body.parent >= 0 else body for body in own.bodies)
        return replace(scene, bodies=(*scene.bodies, *bodies))

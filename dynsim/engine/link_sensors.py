"""Sensors on links: after a run, their signals are computed from its samples by the Newton–Euler equations.

Each kind of sensor is an entry of :data:`LINK_SENSORS`, with the same key as in ``sensors``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dynsim.compile.shapes import touching_points
from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.tree import joints, sweep
from dynsim.integrators import run as ki
from dynsim.model.description import Array, Load, Robot
from dynsim.record import Record
from dynsim.scenario import Scenario, build
from dynsim.scenario.build import SensorMount

if TYPE_CHECKING:
    from dynsim.engine.prepare import Prepared

# Number of samples that are evaluated together; each body needs 0.3 kB per sample.
BLOCK = 4096
# If a sample is closer to a jump than this fraction of its time, it shows the loads after the jump, see
# integrators.run.sampled_now. In time stepping, a step that ends closer to a jump than this fraction of a step ends at
# the jump.
SAME_TIME, SAME_STEP = 1e-12, 1e-9
# Sine of the angle below which a rotation counts as a small rotation.
SMALL = 1e-9


@dataclass(frozen=True)
class LinkMotion:
    """Motion of all n links at T samples, and the wrenches across their joints.

    Attributes
    ----------
    rotation, origin : (T, n, 3, 3) and (T, n, 3) ndarray
        Frames of the links in the world [m].
    velocity, acceleration : (T, n, 6) ndarray
        Angular part, then linear part of the body point at the world's origin; gravity is subtracted from the
        acceleration.
    across : (T, n, 6) ndarray
        Torque about the world's origin [N m] and force [N] that the parent exerts on the link across its joint.
    """

    rotation: Array
    origin: Array
    velocity: Array
    acceleration: Array
    across: Array

    def point(self, body: int, point: Array) -> Array:
        """Return the world positions, (T, 3) [m], of a point that is fixed to a link, (3,)."""
        return np.asarray(self.origin[:, body] + self.rotation[:, body] @ point)


def seen(mount: SensorMount, motion: LinkMotion, vectors: Array) -> Array:
    """Return the components of world vectors (T, 3) in the axes of a sensor."""
    return np.asarray(np.einsum("tji,tj->ti", motion.rotation[:, mount.body] @ mount.axes, vectors))


@dataclass(frozen=True)
class LinkSensor:
    """Kind of sensor.

    Attributes
    ----------
    signals : tuple of (str, str, str)
        Name, unit and description of each signal; a signal has a value for each sensor.
    measure : callable
        Returns the values (T, *shape) of each signal for the motion of the links and the mount of a sensor.
    shape : tuple of int, optional
        Shape of a value: (3,) for vectors (default), () for numbers.
    """

    signals: tuple[tuple[str, str, str], ...]
    measure: Callable[[LinkMotion, SensorMount], tuple[Array, ...]]
    shape: tuple[int, ...] = (3,)


def wrench(motion: LinkMotion, mount: SensorMount) -> tuple[Array, Array]:
    """Return force [N] and torque about the sensor's point [N m] exerted by the parent on the link, in sensor axes."""
    torque, force = motion.across[:, mount.body, :3], motion.across[:, mount.body, 3:]
    about = torque - np.cross(motion.point(mount.body, mount.point), force)
    return seen(mount, motion, force), seen(mount, motion, about)


LINK_SENSORS = {
    "wrench": LinkSensor(
        (
            ("wrench_force", "N", "force that the parent exerts on the body across its joint, in sensor axes"),
            ("wrench_torque", "N m", "torque across the joint about the sensor's point, in sensor axes"),
        ),
        wrench,
    ),
}


class AppliedWrench(NamedTuple):
    """Wrench that a caller has set: point [m], force [N] and torque [N m], (9,), on a link from a time [s] on."""

    time: float
    body: int
    in_body: bool
    values: Array


def add_link_sensors(record: Record, scenario: Scenario, prepared: Prepared, pushes: Sequence[AppliedWrench]) -> None:
    """Add the signals of the scenario's sensors on links, from the motion and the forces of the record.

    Parameters
    ----------
    pushes : sequence of AppliedWrench
        Wrenches that the caller of a stepped simulation has set, in chronological order.
    """
    placed, count = build.sensor_mounts(scenario, prepared.model.robot), len(record)
    kinds = {kind: LINK_SENSORS[kind] for kind in placed}
    values = {k: np.empty((len(kinds[k].signals), count, len(named), *kinds[k].shape)) for k, named in placed.items()}
    for first in range(0, count if placed else 0, BLOCK):
        rows = slice(first, first + BLOCK)
        motion = link_motion(record, prepared, pushes, rows)
        for kind, named in placed.items():
            for k, mount in enumerate(named.values()):
                for row, data in zip(values[kind], kinds[kind].measure(motion, mount), strict=True):
                    if data.shape != row[rows, k].shape:
                        raise ValueError(f"sensor {kind!r} returns shape {data.shape}, not {row[rows, k].shape}")
                    row[rows, k] = data
    for kind, named in placed.items():
        for (name, unit, description), data in zip(kinds[kind].signals, values[kind], strict=True):
            record.add(name, data, unit, labels=tuple(named), description=description)


def link_motion(record: Record, prepared: Prepared, pushes: Sequence[AppliedWrench], rows: slice) -> LinkMotion:
    """Return the motion of the links, and the wrenches across their joints, at the samples in ``rows``.

    The wrench across a joint is the wrench required to move the bodies that it carries and to support their weight,
    minus the wrenches that contacts, loads and ties exert on them:

        F_i = Σ (İV − weight) − Σ W_outside, over the bodies from i to the tips

    Its component along the joint axis is the force that drive, losses, stop and coupling exert on the bodies, less the
    force that accelerates the rotor: a rotor turns only with its joint.
    """
    model, n = prepared.system.model, prepared.model.n
    q, v, vdot = (np.asarray(record[name][rows], dtype=np.float64) for name in ("q", "v", "vdot"))
    ws, links = ka.workspace(n, 0, 0), np.empty((len(q), n, ka.F + 6))
    for k in range(len(q)):
        if prepared.model.nq == n:
            ws.joints[:, ka.Q] = q[k]
        else:
            joints.read_positions(model, q[k], 0, ws)
        ws.joints[:, ka.QD], ws.joints[:, ka.QDD] = v[k], vdot[k]
        sweep.newton_euler(model, ws, 1.0, 1.0, 1.0)
        links[k] = ws.links[:, : ka.F + 6]
    motion = LinkMotion(
        links[:, :, ka.R : ka.R + 9].reshape(len(q), n, 3, 3),
        links[:, :, ka.P : ka.P + 3],
        links[:, :, ka.V : ka.V + 6],
        links[:, :, ka.A : ka.A + 6],
        links[:, :, ka.F : ka.F + 6],
    )
    # The last samples of a diverged run may overflow.
    with np.errstate(over="ignore", invalid="ignore"):
        outside = np.zeros((len(q), n, 6))
        for body, at, force, torque in (
            *_contact_forces(record, prepared, motion, rows),
            *_load_forces(record, prepared, motion, pushes, rows),
            *_tie_forces(record, prepared, motion, rows),
        ):
            outside[:, body, :3] += np.cross(at, force) + torque
            outside[:, body, 3:] += force
        for i in range(n - 1, -1, -1):
            if (parent := model.tree[i, ka.PARENT]) >= 0:
                outside[:, parent] += outside[:, i]
        motion.across[...] -= outside
        _add_wheel_spin(prepared.model.robot, motion, v, vdot)
    return motion


# Force that acts on a link: index of the link, point of application (T, 3), and force and torque there (T, 3), all in
# world axes.
ActingForce = tuple[int, Array, Array, Array | float]


def _contact_forces(record: Record, prepared: Prepared, motion: LinkMotion, rows: slice) -> list[ActingForce]:
    robot = prepared.model.robot
    acting: list[ActingForce] = []
    for k, contact in enumerate(prepared.contacts):
        ends = [robot.attach(contact.body, end) for end in (contact.point, contact.tip) if end is not None]
        at, *tip = (motion.point(body, end) for body, end in ends)
        if contact.radius > 0.0 or tip:
            at = touching_points(contact, at, *tip)
        force = record["contact_force"][rows, k]
        if contact.surface.carrier is not None:
            at = prepared.run.outputs("contact")[rows, k, kst.OUT_POSITION : kst.OUT_POSITION + 3]
            acting.append((robot.attach(contact.surface.carrier, np.zeros(3))[0], at, -force, 0.0))
        acting.append((ends[0][0], at, force, 0.0))
    return acting


def _load_forces(
    record: Record, prepared: Prepared, motion: LinkMotion, pushes: Sequence[AppliedWrench], rows: slice
) -> list[ActingForce]:
    robot, time = prepared.model.robot, _load_times(record, prepared, pushes)[rows]
    acting: list[ActingForce] = []

    def add(body: int, in_body: bool, point: Array, wrenches: Array) -> None:
        parts = wrenches[:, :3], wrenches[:, 3:]
        if in_body:
            parts = tuple(np.einsum("tij,tj->ti", motion.rotation[:, body], part) for part in parts)
        acting.append((body, motion.point(body, point), *parts))

    for load in prepared.loads:
        if len(load.coefficients):
            body, point = robot.attach(load.body, load.point)
            add(body, load.in_body, point, _components(load, time))
    # A wrench lasts until the next wrench is set on the same body.
    for body in dict.fromkeys(push.body for push in pushes):
        own = [push for push in pushes if push.body == body]
        index = np.searchsorted([push.time for push in own], time, side="right") - 1
        for k in np.unique(index[index >= 0]).tolist():
            add(body, own[k].in_body, own[k].values[:3], np.where((index == k)[:, None], own[k].values[3:], 0.0))
    return acting


def _components(load: Load, time: Array) -> Array:
    """Return force and torque (T, 6).

    A load without ``hold`` begins at its first time and has already ended at its last time.
    """
    lasts = load.hold | ((time >= load.knots[0]) & (time < load.knots[-1]))
    return np.where(lasts[:, None], load.components(time), 0.0)


def _load_times(record: Record, prepared: Prepared, pushes: Sequence[AppliedWrench]) -> Array:
    """Return the times at which the loads in the samples are evaluated, (T,) [s].

    In time stepping, a step uses the loads at t + θh. A step begins at the start of the run and whenever a load jumps.
    """
    run, time = prepared.run, record.time
    after = SAME_TIME * np.maximum(1.0, np.abs(time))
    if run.stepping is None or not len(time):
        return np.asarray(time + after)
    h = float(run.clock[ki.STEP])
    begins = np.unique([time[0], *run.breaks, *(push.time for push in pushes)])
    began = begins[np.maximum(np.searchsorted(begins, time - SAME_STEP * h) - 1, 0)]
    return np.asarray(np.maximum(time - (1.0 - run.stepping.theta) * h, began + after))


def _tie_forces(record: Record, prepared: Prepared, motion: LinkMotion, rows: slice) -> list[ActingForce]:
    """Return the forces of ties on both bodies; they act at the point of the second body."""
    unilateral = prepared.system.unilateral
    acting: list[ActingForce] = []
    if unilateral is None or "tie_force" not in record:
        return acting
    for k, tie in enumerate(prepared.model.robot.ties):
        (a, b), row = unilateral.tie_table[k, [ku.TIE_A, ku.TIE_B]].tolist(), unilateral.tie[k]
        axis, other = row[ku.TIE_AXIS : ku.TIE_AXIS + 3], row[ku.TIE_OTHER_POINT : ku.TIE_OTHER_POINT + 3]
        size = record["tie_force"][rows, k : k + 1]
        at = np.broadcast_to(other, (len(size), 3)) if b < 0 else motion.point(b, other)
        axes = np.broadcast_to(axis, (len(size), 3))
        if tie.turns:
            second = np.eye(3) if b < 0 else motion.rotation[:, b]
            attitude = _attitudes(record, prepared, k)[rows]
            turned = np.swapaxes(motion.rotation[:, a], 1, 2) @ second @ np.swapaxes(attitude, 1, 2)
            axes = _turning_axes(axis, turned)
        push = size * np.einsum("tij,tj->ti", motion.rotation[:, a], axes)
        force, torque = (0.0 * push, push) if tie.turns else (push, 0.0 * push)
        acting += [(body, at, sign * force, sign * torque) for body, sign in ((a, 1.0), (b, -1.0)) if body >= 0]
    return acting


def _attitudes(record: Record, prepared: Prepared, k: int) -> Array:
    """Return the rotation of a torsion tie's second body relative to the first in its undeflected state, (T, 3, 3).

    The table contains this rotation only for the time since the tie last began. For earlier times, the rotation at the
    first sample with a force is used.
    """
    unilateral, tie, count = prepared.system.unilateral, prepared.model.robot.ties[k], len(record)
    assert unilateral is not None
    last = unilateral.tie[k, ku.TIE_ATTITUDE : ku.TIE_ATTITUDE + 9].reshape(1, 3, 3)
    acts = record["tie_force"][:, k] != 0.0
    begins = np.flatnonzero(acts & ~np.append(False, acts[:-1]))
    if len(begins) < 2 or tie.pushes or not np.isnan(tie.rest):
        return np.broadcast_to(last, (count, 3, 3))
    a, b = unilateral.tie_table[k, [ku.TIE_A, ku.TIE_B]].tolist()
    q, model = np.asarray(record["q"], dtype=np.float64), prepared.model
    second = [np.eye(3) if b < 0 else model.body_pose(b, q[row])[0] for row in begins[:-1]]
    first = [model.body_pose(a, q[row])[0] for row in begins[:-1]]
    attitudes = np.concatenate([np.swapaxes(first, 1, 2) @ np.array(second), last])
    return np.asarray(attitudes[np.maximum(np.searchsorted(begins, np.arange(count), side="right") - 1, 0)])


def _turning_axes(axis: Array, turned: Array) -> Array:
    """Return the axes of :func:`dynsim.integrators.stepping.contacts.turning_axis` for rotations (T, 3, 3)."""
    twice = np.stack([turned[:, i, j] - turned[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    sine = 0.5 * np.linalg.norm(twice, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0))
    turn = 0.5 * twice * (np.where(sine > SMALL, angle, 1.0) / np.where(sine > SMALL, sine, 1.0))[:, None]
    half = np.where(angle > 1e-2, 0.5 * angle, 0.5)
    exact = (1.0 - half / np.tan(half)) / (4.0 * half * half)
    factor = np.where(angle > 1e-2, exact, 1.0 / 12.0 + angle * angle / 720.0)
    once = np.cross(turn, axis)
    return np.asarray(axis + 0.5 * once + factor[:, None] * np.cross(turn, once))


def _add_wheel_spin(robot: Robot, motion: LinkMotion, v: Array, vdot: Array) -> None:
    """Add the effect of a mobile base's spinning wheels to the wrench from the ground; see dynamics.tree.support."""
    base = robot.base
    if base is None:
        return
    body, _ = robot.attach(base.body, np.zeros(3))
    wheels = [robot.joint_names.index(wheel) for wheel in base.wheels]
    axle = motion.rotation[:, body, :, 1]
    spin, rate = (base.spin_inertia * x[:, wheels].sum(axis=1, keepdims=True) for x in (v, vdot))
    motion.across[:, body, :3] += rate * axle + spin * np.cross(motion.velocity[:, body, :3], axle)

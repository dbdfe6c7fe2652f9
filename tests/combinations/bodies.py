"""Motion and forces of a robot's bodies at all samples of a record at once, written only for the checks.

No code of the kernels is used: poses, velocities and accelerations follow from the description of the robot link by
link, forces from Newton's and Euler's equations of each body about the world origin. Arrays have samples first: (T, 3),
(T, 3, 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynsim.model.description import Robot

Array = NDArray[np.float64]

# A body, or two bodies that touch each other; motions are relative to the second body.
Ends = int | tuple[int, int]

# Rows whose axes are fixed in the body that the whole joint carries; they share the velocity of their mount.
_SEVERAL = ("ball_x", "ball_y", "ball_z", "roll", "turn", "left_wheel", "right_wheel")
_FIRST = ("ball_x", "roll", "left_wheel")


def cross_matrix(w: Array) -> Array:
    """Return the matrix of w ×, (..., 3) → (..., 3, 3)."""
    zero = np.zeros_like(w[..., 0])
    rows = (zero, -w[..., 2], w[..., 1]), (w[..., 2], zero, -w[..., 0]), (-w[..., 1], w[..., 0], zero)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def times(R: Array, x: Array) -> Array:
    """Return R x for every sample."""
    return np.einsum("...ij,...j->...i", R, x)


@dataclass
class Motion:
    """Motion of the bodies at the samples.

    Attributes
    ----------
    rotation, origin : list of ndarray
        Frame of each body in the world, n times (T, 3, 3) and (T, 3) [m].
    spin, flow : list of ndarray
        Angular velocity of each body, and velocity of its point at the world origin, n times (T, 3).
    turning, rushing : list of ndarray
        Angular acceleration and rate of ``flow``, n times (T, 3).
    axis, drift : list of ndarray
        Motion of each row per unit rate, angular and linear at the world origin, n times (T, 3).
    """

    rotation: list[Array] = field(default_factory=list)
    origin: list[Array] = field(default_factory=list)
    spin: list[Array] = field(default_factory=list)
    flow: list[Array] = field(default_factory=list)
    turning: list[Array] = field(default_factory=list)
    rushing: list[Array] = field(default_factory=list)
    axis: list[Array] = field(default_factory=list)
    drift: list[Array] = field(default_factory=list)

    def point(self, body: int, at: Array) -> Array:
        """Return the position of a point of a body's frame, (T, 3) [m]; ``at`` : (3,) or (T, 3)."""
        return self.origin[body] + times(self.rotation[body], np.broadcast_to(at, self.origin[body].shape))

    def velocity(self, body: Ends, position: Array) -> Array:
        """Return the velocity of the body's point at a world position, (T, 3)."""
        if isinstance(body, tuple):
            return self.velocity(body[0], position) - self.velocity(body[1], position)
        return self.flow[body] + np.cross(self.spin[body], position)


class Bodies:
    """Tree of bodies of a robot, with the masses of motors added to their links."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot.with_motors_mounted() if any(motor.mass for motor in robot.motors) else robot
        names = [link.name for link in self.robot.links]
        self.n = len(names)
        self.parent = [-1 if link.parent is None else names.index(link.parent) for link in self.robot.links]
        self.places = list(self.robot.position_index)
        self.gravity = np.asarray(self.robot.gravity, dtype=np.float64)
        self.armature = np.array([link.armature for link in self.robot.links])
        self.damping = np.array([link.damping for link in self.robot.links])
        joints = list(self.robot.joint_names)
        for motor in self.robot.motors:
            self.armature[joints.index(motor.joint)] += getattr(motor, "armature", 0.0)
            self.damping[joints.index(motor.joint)] += getattr(motor, "reflected_damping", 0.0)

    def ancestors(self, body: int) -> list[int]:
        """Return the rows that move a body, from the body to the root."""
        chain = []
        while body >= 0:
            chain.append(body)
            body = self.parent[body]
        return chain

    def motion(self, q: Array, v: Array, vdot: Array) -> Motion:
        """Return poses, velocities and accelerations for q (T, nq), v and vdot (T, n)."""
        samples, m = len(q), Motion()
        still = np.zeros((samples, 3))
        mounts: dict[int, int] = {}
        for i, link in enumerate(self.robot.links):
            p, kind = self.parent[i], link.kind
            several = kind in _SEVERAL
            first = not several or kind in _FIRST
            mounts[i] = p if first else mounts[p]
            R_P = m.rotation[p] if p >= 0 else np.broadcast_to(np.eye(3), (samples, 3, 3))
            o_P = m.origin[p] if p >= 0 else still
            R_J, o_J = R_P @ link.R_PJ, o_P + times(R_P, np.broadcast_to(link.p_PJ, (samples, 3)))
            R, o = self._moved(i, q, R_J, o_J) if first else (R_J, o_J)
            angular, linear = self._axis(i, R, R_J)
            drift = linear + np.cross(o, angular)
            spin_P, flow_P = (m.spin[p], m.flow[p]) if p >= 0 else (still, still)
            turn_P, rush_P = (m.turning[p], m.rushing[p]) if p >= 0 else (still, still)
            mount = mounts[i]
            spin_M, flow_M = (m.spin[mount], m.flow[mount]) if mount >= 0 else (still, still)
            rate, gain = v[:, i : i + 1], vdot[:, i : i + 1]
            m.rotation.append(R)
            m.origin.append(o)
            m.axis.append(angular)
            m.drift.append(drift)
            m.spin.append(spin_P + angular * rate)
            m.flow.append(flow_P + drift * rate)
            # The rate of a row's axis is the motion cross product of the velocity of its mount and the axis.
            bent = np.cross(spin_M, angular)
            swept = np.cross(spin_M, drift) + np.cross(flow_M, angular)
            m.turning.append(turn_P + angular * gain + bent * rate)
            m.rushing.append(rush_P + drift * gain + swept * rate)
        return m

    def _moved(self, i: int, q: Array, R_J: Array, o_J: Array) -> tuple[Array, Array]:
        """Return the world frame of a body whose joint's frame is at R_J, o_J."""
        link, k = self.robot.links[i], self.places[i]
        if link.kind == "prismatic":
            return R_J, o_J + times(R_J, link.axis * q[:, k : k + 1])
        if link.kind == "revolute":
            return R_J @ _turn(link.axis, q[:, k]), o_J
        if link.kind == "ball_x":
            return R_J @ _attitude(q[:, k : k + 4]), o_J
        if link.kind == "roll":
            x, y, heading = q[:, k], q[:, k + 1], q[:, k + 2]
        elif link.kind == "left_wheel":
            x, y, heading = q[:, k + 2], q[:, k + 3], link.parameter * (q[:, k + 1] - q[:, k])
        else:
            raise NotImplementedError(link.kind)
        return R_J @ _turn(np.array([0.0, 0.0, 1.0]), heading), o_J + times(R_J, np.stack([x, y, 0.0 * x], axis=1))

    def _axis(self, i: int, R: Array, R_J: Array) -> tuple[Array, Array]:
        """Return the angular velocity, and velocity of the body's origin, per unit rate of the row."""
        link, still = self.robot.links[i], np.zeros((len(R), 3))
        if link.kind == "revolute":
            return times(R_J, np.broadcast_to(link.axis, still.shape)), still
        if link.kind == "prismatic":
            return still, times(R_J, np.broadcast_to(link.axis, still.shape))
        if link.kind.startswith("ball_"):
            return R[:, :, "xyz".index(link.kind[-1])], still
        if link.kind == "roll":
            return still, R[:, :, 0]
        if link.kind == "turn":
            return R[:, :, 2], still
        # Radius over track is the parameter of the left wheel, half the radius of the right wheel.
        left = link if link.kind == "left_wheel" else self.robot.links[i - 1]
        right = self.robot.links[i + 1] if link.kind == "left_wheel" else link
        sign = -1.0 if link.kind == "left_wheel" else 1.0
        return sign * left.parameter * R[:, :, 2], right.parameter * R[:, :, 0]

    def wrenches(self, m: Motion, weight: bool = True) -> list[tuple[Array, Array]]:
        """Return moment about the world origin and force that each body needs, minus its weight."""
        needed = []
        for i, link in enumerate(self.robot.links):
            body, R = link.inertia, m.rotation[i]
            centre = m.point(i, body.com)
            tensor = R @ body.tensor @ R.transpose(0, 2, 1)
            spin, turning = m.spin[i], m.turning[i]
            speed = m.velocity(i, centre)
            gain = m.rushing[i] + np.cross(turning, centre) + np.cross(spin, speed)
            force = body.mass * (gain - (self.gravity if weight else 0.0))
            moment = times(tensor, turning) + np.cross(spin, times(tensor, spin)) + np.cross(centre, force)
            needed.append((moment, force))
        return needed

    def along_rows(self, m: Motion, wrenches: Sequence[tuple[Array, Array]]) -> Array:
        """Return generalised forces of a wrench on each body, (T, n)."""
        moments, forces = ([part.copy() for part in parts] for parts in zip(*wrenches, strict=True))
        rows = np.zeros((len(m.origin[0]), self.n))
        for i in range(self.n - 1, -1, -1):
            rows[:, i] = (m.axis[i] * moments[i]).sum(axis=1) + (m.drift[i] * forces[i]).sum(axis=1)
            if self.parent[i] >= 0:
                moments[self.parent[i]] += moments[i]
                forces[self.parent[i]] += forces[i]
        return rows

    def force_along_rows(self, m: Motion, body: Ends, position: Array, force: Array, moment: Array) -> Array:
        """Return generalised forces of a force at a world position and a moment, both on a body, (T, n)."""
        if isinstance(body, tuple):
            on = [self.force_along_rows(m, end, position, force, moment) for end in body]
            return on[0] - on[1]
        about, rows = moment + np.cross(position, force), np.zeros((len(force), self.n))
        for i in self.ancestors(body):
            rows[:, i] = (m.axis[i] * about).sum(axis=1) + (m.drift[i] * force).sum(axis=1)
        return rows

    def jacobian(self, m: Motion, body: Ends, position: Array) -> Array:
        """Return the velocity per unit rate of a body's point at a world position, (T, 3, n)."""
        if isinstance(body, tuple):
            return self.jacobian(m, body[0], position) - self.jacobian(m, body[1], position)
        J = np.zeros((len(position), 3, self.n))
        for i in self.ancestors(body):
            J[:, :, i] = m.drift[i] + np.cross(m.axis[i], position)
        return J

    def mass_matrix(self, q: Array) -> Array:
        """Return M + J_m at one configuration (nq,), from a unit acceleration of each row, (n, n)."""
        still = np.zeros((self.n, self.n))
        m = self.motion(np.repeat(q[None], self.n, axis=0), still, np.eye(self.n))
        return self.along_rows(m, self.wrenches(m, weight=False)) + np.diag(self.armature)

    def momentum(self, m: Motion, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Return angular momentum about the world origin and momentum of some bodies, (T, 3) each."""
        angular = linear = np.zeros((len(m.origin[0]), 3))
        for i in chosen:
            body, R = self.robot.links[i].inertia, m.rotation[i]
            centre = m.point(i, body.com)
            impulse = body.mass * m.velocity(i, centre)
            tensor = R @ body.tensor @ R.transpose(0, 2, 1)
            angular = angular + times(tensor, m.spin[i]) + np.cross(centre, impulse)
            linear = linear + impulse
        return angular, linear

    def energies(self, m: Motion, v: Array) -> tuple[Array, Array]:
        """Return kinetic energy with rotors, and potential energy up to a constant, (T,) each [J]."""
        kinetic, potential = 0.5 * (self.armature * v * v).sum(axis=1), np.zeros(len(v))
        for i, link in enumerate(self.robot.links):
            body, R = link.inertia, m.rotation[i]
            centre = m.point(i, body.com)
            speed, tensor = m.velocity(i, centre), R @ body.tensor @ R.transpose(0, 2, 1)
            kinetic = kinetic + 0.5 * body.mass * (speed * speed).sum(axis=1)
            kinetic = kinetic + 0.5 * (m.spin[i] * times(tensor, m.spin[i])).sum(axis=1)
            potential = potential - body.mass * centre @ self.gravity
        return kinetic, potential

    def free_directions(self) -> Array:
        """Return the rates that couplings of joints allow, as columns, (n, n − k)."""
        joints, rows = list(self.robot.joint_names), []
        for coupling in self.robot.couplings:
            row = np.zeros(self.n)
            row[joints.index(coupling.joint)] = 1.0
            row[joints.index(coupling.leader)] -= coupling.ratio
            rows.append(row)
        if not rows:
            return np.eye(self.n)
        _, _, basis = np.linalg.svd(np.array(rows))
        return basis[len(rows) :].T


def position_rates(bodies: Bodies, q: Array, v: Array) -> Array:
    """Return q̇ for coordinates (T, nq) and rates (T, n)."""
    rates = np.zeros_like(q)
    for i, link in enumerate(bodies.robot.links):
        k = bodies.places[i]
        if link.kind in ("revolute", "prismatic"):
            rates[:, k] = v[:, i]
        elif link.kind == "ball_x":
            w, u, spin = q[:, k : k + 1], q[:, k + 1 : k + 4], v[:, i : i + 3]
            rates[:, k : k + 1] = -0.5 * (u * spin).sum(axis=1, keepdims=True)
            rates[:, k + 1 : k + 4] = 0.5 * (w * spin + np.cross(u, spin))
        elif link.kind == "roll":
            heading = q[:, k + 2]
            rates[:, k], rates[:, k + 1] = v[:, i] * np.cos(heading), v[:, i] * np.sin(heading)
            rates[:, k + 2] = v[:, i + 1]
        elif link.kind == "left_wheel":
            right = bodies.robot.links[i + 1]
            heading = link.parameter * (q[:, k + 1] - q[:, k])
            ahead = right.parameter * (v[:, i] + v[:, i + 1])
            rates[:, k], rates[:, k + 1] = v[:, i], v[:, i + 1]
            rates[:, k + 2], rates[:, k + 3] = ahead * np.cos(heading), ahead * np.sin(heading)
    return rates


def _turn(axis: Array, angle: Array) -> Array:
    """Return rotations about a unit axis, (T,) → (T, 3, 3)."""
    K = cross_matrix(np.asarray(axis, dtype=np.float64))
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * K + (1.0 - cosine) * (K @ K)


def _attitude(quaternion: Array) -> Array:
    """Return rotations of quaternions w, x, y, z, of any length, (T, 4) → (T, 3, 3)."""
    unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    w, K = unit[:, 0, None, None], cross_matrix(unit[:, 1:])
    return np.eye(3) + 2.0 * w * K + 2.0 * K @ K

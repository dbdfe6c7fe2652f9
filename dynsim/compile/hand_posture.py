"""Inverse kinematics of one posture: hand position and orientation, points on surfaces, joint limits."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.touching import Kinematics, touch
from dynsim.errors import ModelError, UnreachableReference
from dynsim.model.description import Array, Contact, Robot

ITERATIONS = 200
# Maximum change of a coordinate in one iteration [rad or m]; it prevents jumps to another solution branch.
STEP_MAX = 0.3
# Maximum damping, which applies far from the target; the damping vanishes near the target.
DAMPING = 1e-2


def turn_error(R: Array, wanted: Array) -> Array:
    """Return the rotation vector that rotates R to ``wanted``, (3,) [rad]."""
    from scipy.spatial.transform import Rotation  # imported here because it takes a third of a second

    return np.asarray(Rotation.from_matrix(wanted @ R.T).as_rotvec())


def hand_turn(model: Kinematics, q: Array) -> Array:
    """Return the axes of the hand's body or frame in the world as columns, (3, 3)."""
    return model.body_pose(model.robot.attach(*model.robot.hand)[0], q)[0] @ model.robot.hand_axes


def hand_turns(model: Kinematics, q: Array, orientation: Array) -> Array:
    """Return the angles between the hand's orientation and a target orientation, postures (T, nq) → (T,) [rad]."""
    from scipy.spatial.transform import Rotation  # imported here because it takes a third of a second

    R = np.array([hand_turn(model, row) for row in q]).reshape(-1, 3, 3)
    return np.asarray(Rotation.from_matrix(orientation.T @ R).magnitude())


def hand_posture(
    model: Kinematics,
    target: Array,
    q: Array,
    orientation: Array | None,
    braces: Sequence[Contact],
    tolerance: float,
    moving: Sequence[str] | None = None,
) -> Array:
    """Find a posture by changing only the joints in ``moving`` (default: all joints).

    See :meth:`dynsim.Model.inverse_kinematics`.
    """
    robot = model.robot
    if any(contact.tip is not None for contact in braces):
        raise ModelError("inverse_kinematics: braces must be points or spheres, not link axes")
    ends = [robot.hand[0], *(body for contact in braces for body in (contact.body, contact.surface.carrier))]
    chain = _chain(robot, [body for body in ends if body is not None])
    movable = np.array([link.name in chain and (moving is None or link.joint in moving) for link in robot.links])
    coupled = {joint for coupling in robot.couplings for joint in (coupling.joint, coupling.leader)}
    for link in itertools.compress(robot.links, movable):
        if link.joint in coupled or link.coordinates != (link.joint,):
            raise ModelError(
                f"inverse_kinematics: {link.joint}: coupled joints and joints with several coordinates are not "
                "supported"
            )
    lower, upper = (np.array([getattr(link, side) for link in robot.links]) for side in ("lower", "upper"))
    revolute = np.array([link.units[0] == "rad" for link in robot.links])
    hand, axes = robot.attach(*robot.hand)[0], robot.hand_axes
    q, places = q.copy(), np.array(robot.position_index)
    q[places[movable]] = np.clip(q[places], lower, upper)[movable]
    error = np.zeros(0)
    for _ in range(ITERATIONS):
        position, J = model.point_position_and_jacobian(*robot.hand, q)
        errors, rows = [target - position], [J]
        if orientation is not None:
            R = model.body_pose(hand, q)[0]
            errors.append(turn_error(R @ axes, orientation))
            rows.append(angular_jacobian(model, hand, R, q) * revolute)
        for contact in braces:
            at = touch(model, contact, q)
            errors.append(np.array([-at.gap]))
            rows.append((at.normal @ at.jacobian(model, q))[None])
        error, J = np.concatenate(errors), np.vstack(rows)
        size = float(np.abs(error).max())
        if size <= tolerance:
            return q
        stepped = _stepped(q[places], J, error * min(1.0, 0.3 / size), size, lower, upper, movable)
        q[places[movable]] = stepped[movable]
    limited = [robot.links[k].joint for k in np.flatnonzero(movable) if q[places[k]] in (lower[k], upper[k])]
    stuck = f"; at their limits: {', '.join(limited)}" if limited else ""
    left = float(np.abs(error).max())
    raise UnreachableReference(
        f"no posture near the start satisfies all targets for hand and braces: residual {left:.3g} [m or rad]{stuck}; "
        "change the start or relax a target"
    )


def _chain(robot: Robot, bodies: Sequence[str]) -> set[str]:
    """Return the names of the links between the world and some bodies or frames."""
    parents, chain = {link.name: link.parent for link in robot.links}, set[str]()
    for body in bodies:
        name: str | None = robot.links[robot.attach(body, np.zeros(3))[0]].name
        while name is not None:
            chain.add(name)
            name = parents[name]
    return chain


def _stepped(
    q: Array, J: Array, error: Array, size: float, lower: Array, upper: Array, movable: NDArray[np.bool_]
) -> Array:
    """Return a damped Gauss–Newton step; joints at their limits stay there, and the other joints take over."""
    free = movable.copy()
    for _ in range(len(q)):
        A = J[:, free]
        damping = 1e-12 + DAMPING * min(size, 1.0) ** 2
        step = np.zeros(len(q))
        step[free] = A.T @ np.linalg.solve(A @ A.T + damping * np.eye(len(A)), error)
        step *= min(1.0, STEP_MAX / max(float(np.abs(step).max(initial=0.0)), 1e-300))
        beyond = free & (((q + step < lower) & (q <= lower)) | ((q + step > upper) & (q >= upper)))
        if not beyond.any() or not free.any():
            break
        free &= ~beyond
    return np.clip(q + step, lower, upper)


def angular_jacobian(model: Kinematics, body: str | int, R: Array, q: Array) -> Array:
    """Return the angular velocity of a body with rotation R per unit rate, (3, n), from velocities of its points."""
    at_origin = model.point_position_and_jacobian(body, np.zeros(3), q)[1]
    jacobian = np.zeros((3, model.n))
    for k in range(3):
        # ω × e_k, and ω = ½ Σ e_k × (ω × e_k).
        swept = model.point_position_and_jacobian(body, np.eye(3)[k], q)[1] - at_origin
        jacobian += 0.5 * np.cross(R[:, k], swept.T).T
    return jacobian

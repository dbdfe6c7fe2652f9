"""Postures with points of an arm on their surfaces (closure of the contact constraints), nearest to the initial one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.shapes import gap_at
from dynsim.errors import ModelError
from dynsim.model.description import Array, Contact, Robot

HAND = "hand"

# Distance from the surfaces that counts as none [m].
TOLERANCE = 1e-13
REACHED = 1e-12
ITERATIONS = 300
# A point that no joint moves along its normal must start this close to its surface [m].
START_TOLERANCE = 1e-6
# Rounding by which a joint may be beyond its limit [rad or m].
BEYOND = 1e-9
STEP_MAX = 0.3  # [rad or m] per iteration, against jumps to another branch of solutions


def gaps_and_rates(model: Model, contacts: Sequence[Contact], q: Array) -> tuple[Array, Array]:
    """Distances of points and spheres from their surfaces, (c,) [m], and their rates by joint, (c, n) [m/rad]."""
    gaps, rates = np.zeros(len(contacts)), np.zeros((len(contacts), model.n))
    for k, contact in enumerate(contacts):
        position, jacobian = model.point_position_and_jacobian(contact.body, contact.point, q)
        gaps[k], rates[k] = contact.surface.gap(position) - contact.radius, contact.surface.normal(position) @ jacobian
    return gaps, rates


def on_surfaces(model: Model, contacts: Mapping[str, Contact], names: Sequence[str], keep: Sequence[str]) -> Array:
    """The posture nearest to the initial one, |q − q_0| least, with the named points on their surfaces, (nq,).

    Joints that would go beyond their limits stay there, the one that goes furthest first, and the others go on.

    Gauss–Newton steps q ← q_0 + J⁺ (J (q − q_0) − e), then Newton's without the pull to q_0 for the last digits.

    Parameters
    ----------
    contacts : of the scenario, by name
    names : contacts that are to be on their surfaces
    keep : joints that do not move; ``hand``: the hand stays where it is

    Raises
    ------
    ModelError
        An unknown name, that of an axis, or surfaces that the points do not reach.
    """
    robot = model.robot
    for name in names:
        if name not in contacts:
            raise ModelError(f"initial.on_surface: no contact {name!r}; those are: {', '.join(contacts) or 'none'}")
        if contacts[name].tip is not None:
            raise ModelError(f"initial.on_surface: {name!r} is the axis of a link; name the points at its ends")
        if contacts[name].left_out and abs(gap := gap_at(model, contacts[name], robot.initial)) > START_TOLERANCE:
            raise ModelError(
                f"initial.on_surface: no joint moves {name!r} along the normal of "
                f"{contacts[name].surface_name!r}, which it is {gap:+.4g} m from; take it off the list"
            )
    fixed = [name for name in keep if name != HAND]
    for name in fixed:
        if name not in robot.joint_names:
            raise ModelError(f"initial.keep: no joint {name!r}; joints: {', '.join(robot.joint_names)}, and {HAND}")
    if robot.couplings:
        raise ModelError("initial: not for robots with coupled joints; give their positions")
    columns = [
        k for k, link in enumerate(robot.links) if len(link.row.neutral) == 1 and robot.joint_names[k] not in fixed
    ]
    points = [contacts[name] for name in names if not contacts[name].left_out]
    stopped = dict[int, float]()
    while True:
        q, worst = _nearest(model, points, columns, stopped, HAND in keep)
        if not worst <= REACHED:
            within = f" with {', '.join(robot.joint_names[k] for k in stopped)} at the limit" if stopped else ""
            raise ModelError(
                f"initial: the joints that may move do not bring {', '.join(names)} onto the surfaces{within}; "
                f"{worst:.3g} m are left: keep fewer joints, or start closer"
            )
        beyond = _furthest_beyond(robot, columns, q)
        if beyond is None:
            return q
        stopped[beyond[0]] = beyond[1]


def _nearest(
    model: Model, points: Sequence[Contact], columns: Sequence[int], stopped: Mapping[int, float], keep_hand: bool
) -> tuple[Array, float]:
    """Posture with the points on their surfaces, joints ``stopped`` at these values; and the largest distance left."""
    robot = model.robot
    moving = [k for k in columns if k not in stopped]
    places = [robot.position_index[k] for k in moving]
    start = robot.initial
    hand = model.point_position(*robot.hand, start)
    q = start.copy()
    for k, value in stopped.items():
        q[robot.position_index[k]] = value
    for turn in range(ITERATIONS):
        error, J = gaps_and_rates(model, points, q)
        if keep_hand:
            position, jacobian = model.point_position_and_jacobian(*robot.hand, q)
            error, J = np.concatenate([error, position - hand]), np.vstack([J, jacobian])
        pull = start[places] - q[places] if turn < ITERATIONS - 5 else 0.0 * q[places]
        step = pull - np.linalg.lstsq(J[:, moving], error + J[:, moving] @ pull, rcond=1e-10)[0]
        longest = float(np.abs(step).max(initial=0.0))
        if np.abs(error).max(initial=0.0) <= TOLERANCE and longest < 1e-10:
            break
        q[places] += step * min(1.0, STEP_MAX / max(longest, 1e-300))
    return q, float(np.abs(error).max(initial=0.0))


def _furthest_beyond(robot: Robot, columns: Sequence[int], q: Array) -> tuple[int, float] | None:
    """The joint furthest beyond its limit, and that limit; joints that start beyond are refused elsewhere."""
    worst, furthest = BEYOND, None
    for k in columns:
        link, at, start = robot.links[k], q[robot.position_index[k]], robot.initial[robot.position_index[k]]
        for side, limit in ((1.0, link.upper), (-1.0, link.lower)):
            if side * (start - limit) <= 0.0 and side * (at - limit) > worst:
                worst, furthest = side * (at - limit), (k, limit)
    return furthest

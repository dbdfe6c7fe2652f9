"""Joints that move no inertia, and contact points that no joint moves along the normal of their surface.

The force on an immobile point changes no motion, so no equation determines it. A point that is immobile in every
posture is left out of the contact problem; a point that is immobile in a single posture carries no force there. A joint
with a closed brake moves nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.touching import TouchPoint, touch
from dynsim.config.problems import listed
from dynsim.dynamics.contact.mobility import IMMOBILE
from dynsim.dynamics.linear import RANK_TOLERANCE
from dynsim.errors import ModelError
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.surfaces import Quadric

# Number of configurations at which points are compared and rows examined; a property that holds at all is structural.
CONFIGURATIONS = 6
# Points closer than this [m] at all configurations count as identical, and rows smaller than this at all as zero.
SAME = 1e-9
# Positions along the axis of a capsule at which its row is examined, as fractions of its length.
SHARES = (0.0, 0.3, 0.7, 1.0)
# The inertia of a joint counts as zero below this fraction of Σ m l² + tr I of the bodies that it moves, and below this
# fraction of their Σ m r² about the world origin, the rounding error of the sweep. Axes that robot files round to six
# digits miss each other by up to 1e-5 of their distance from a point mass.
NOTHING, CANCELLED = 1e-10, 1e-14
# Maximum rounding error of the sweep as a fraction of Σ m l² + tr I; beyond it the inertia of a joint is unknown.
KNOWN = 1e-3


def random_configurations(robot: Robot, braked: Collection[int] = (), at: Array | None = None) -> list[Array]:
    """Return random coordinates with unit quaternions; they are the same in every call.

    ``braked`` joints keep their coordinates ``at``. A ball joint with a brake on one or two of its three rates still
    reaches every attitude.
    """
    rng, first = np.random.default_rng(0), 0
    free = set[int]()
    for i, link in enumerate(robot.links):
        # A row without coordinates moves with the first row of its joint.
        first = i if link.row.neutral else first
        if i not in braked:
            free.add(first)
    configurations = []
    for _ in range(CONFIGURATIONS):
        q = np.zeros(robot.nq)
        for i, (link, k) in enumerate(zip(robot.links, robot.position_index, strict=True)):
            size = len(link.row.neutral)
            q[k : k + size] = rng.normal(size=size)
            if size == 4:
                q[k : k + 4] /= np.linalg.norm(q[k : k + 4])
            if at is not None and i not in free:
                q[k : k + size] = at[k : k + size]
        configurations.append(q)
    return configurations


def moves(
    model: Model,
    contact: Contact,
    configurations: Iterable[Array],
    *,
    anywhere: bool = False,
    braked: Collection[int] = (),
) -> bool:
    """Return whether any joint moves any part of a contact candidate along the surface normal.

    With ``anywhere``, motion along the surface also counts. Joints in ``braked`` are ignored.
    """
    free = [i for i in range(model.n) if i not in braked]
    for q in configurations:
        for share in SHARES[: None if contact.tip is not None else 1]:
            at = touch(model, contact, q, share)
            jacobian = at.jacobian(model, q)
            rates = (jacobian if anywhere else at.normal @ jacobian)[..., free]
            if np.abs(rates).max(initial=0.0) > SAME:
                return True
    return False


def immobile(
    model: Model, contacts: Sequence[Contact], braked: Collection[int] = (), at: Array | None = None
) -> list[bool]:
    """Return for each contact whether no joint moves it along the normal in any posture.

    A few random postures do not cover the faces of a box or the slopes of a height field. A point on such a surface is
    immobile only if no joint moves it in any direction. ``braked`` joints keep their coordinates ``at``.
    """
    configurations = random_configurations(model.robot, braked, at)
    still: list[bool] = []
    for contact in contacts:
        if contact.slot:  # the contacts of two solids move together
            still.append(still[-1])
            continue
        try:
            model.robot.attach(contact.body, contact.point)
        except ModelError:  # the check at the start reports an unknown or fixed body
            still.append(False)
            continue
        anywhere = not isinstance(contact.surface, Quadric)
        still.append(not moves(model, contact, configurations, anywhere=anywhere, braked=braked))
    return still


def immobile_at(model: Model, at: TouchPoint, q: Array) -> bool:
    """Return whether the motion of a contact along its normal is only a rounding error in a posture.

    The limit is the same as in :func:`dynsim.dynamics.contact.mobility.moves_along_normal`.
    """
    jacobian = at.jacobian(model, q)
    places = np.vstack([model.joint_positions(q), at.position])
    scale = np.linalg.norm(places, axis=1).max() + np.linalg.norm(jacobian, axis=0)
    return bool((np.abs(at.normal @ jacobian) <= IMMOBILE * scale).all())


def mobility_floors(
    model: Model, contacts: Sequence[Contact], braked: Collection[int] = (), at: Array | None = None
) -> Array:
    """Return for each contact the mobility along its normal below which a bilateral contact has no force, (c,) [1/kg].

    It is the fraction of a typical mobility below which a row counts as dependent. The typical mobility is the largest
    mobility over random postures. It is computed with only the diagonal of the mass matrix, which overestimates it by a
    factor of up to n. ``braked`` joints keep their coordinates ``at``; their armature in the model includes the brake.
    """
    floors = np.zeros(len(contacts))
    if not contacts:
        return floors
    for q in random_configurations(model.robot, braked, at)[:2]:
        inertia = np.diag(model.mass_matrix(q)) + model.armature
        for k, contact in enumerate(contacts):
            nearest = touch(model, contact, q, 0.0)
            typical = float(((nearest.normal @ nearest.jacobian(model, q)) ** 2 / inertia).sum())
            floors[k] = max(floors[k], RANK_TOLERANCE * typical)
    return floors


def without_inertia(model: Model, q: Array) -> list[tuple[int, list[int]]]:
    """Return the indices of joints that move no inertia at coordinates q (nq,), and of the bodies behind them.

    Of joints in a series only the last one is returned; of the bodies behind it, those with mass, or all of them.
    """
    links = model.robot.links
    felt = model.articulated_inertia(q)
    mass = np.array([link.inertia.mass for link in links])
    own = np.array([np.trace(link.inertia.tensor) for link in links])
    positions = model.joint_positions(q, *((k, link.inertia.com) for k, link in enumerate(links)))
    origins, centres = positions[: model.n], positions[model.n + 1 :]
    numbers = {link.name: k for k, link in enumerate(links)}
    parents = [-1 if link.parent is None else numbers[link.parent] for link in links]
    behind = np.eye(model.n, dtype=bool)
    for k in range(model.n - 1, -1, -1):
        if parents[k] >= 0:
            behind[parents[k]] |= behind[k]
    slides = np.array([link.kind == "prismatic" for link in links])
    lever = ((centres[None] - origins[:, None]) ** 2).sum(axis=2)
    about_joint = np.where(slides, behind @ mass, (behind * (mass * lever + own)).sum(axis=1)) + model.armature
    about_origin = behind @ (mass * (centres**2).sum(axis=1))
    rounding = np.where(slides, 0.0, CANCELLED * about_origin)
    # If bodies have diverged, rounding errors dominate and the inertia is unknown.
    known = rounding <= KNOWN * about_joint
    none = (felt <= np.maximum(NOTHING * about_joint, rounding)) & (known | (about_joint == 0.0))
    last = [k for k in np.flatnonzero(none).tolist() if np.count_nonzero(none & behind[k]) == 1]
    bodies = behind & np.array([link.name not in model.robot.carriers for link in links])
    massive = bodies & (mass > 0.0)
    return [(k, np.flatnonzero(massive[k] if massive[k].any() else bodies[k]).tolist()) for k in last]


def moving_nothing(model: Model, q: Array) -> str:
    """Return a message about joints that move no inertia at coordinates q (nq,), or an empty string."""
    if not np.isfinite(q).all():
        return ""
    none = without_inertia(model, q)
    if not none:
        return ""
    joints = listed([model.robot.links[k].joint for k, _ in none])
    bodies = listed([model.robot.links[k].name for _, behind in none for k in behind])
    return (
        f"joint {joints} moves no inertia in this posture: the mass behind it ({bodies}) is zero, or on its axis "
        "without moments of inertia; set mass_kg and inertia_kg_m2 of the link or a rotor inertia, change the posture, "
        "or lock the joint"
    )


def check_inertia(model: Model) -> None:
    """Raise ModelError if a joint moves no inertia at the start."""
    if sentence := moving_nothing(model, model.robot.initial):
        raise ModelError(f"plant: {sentence}", keys=("plant",))

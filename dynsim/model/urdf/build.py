"""URDF import: bodies, joints, limits, viscous losses, couplings, frames and shapes of a robot.

Files are read strictly (:mod:`dynsim.model.urdf.reader`); everything behind fixed and locked joints is merged into the
moving body that carries it. Motors, contacts and gravity are not taken from a URDF file but from the scenario.
"""

from __future__ import annotations

import heapq
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import Array, Coupling, Frame, Inertia, Link, Robot
from dynsim.model.joints.ball import floating
from dynsim.model.joints.planar import planar
from dynsim.model.urdf.reader import MOVING, SEVERAL, UrdfJoint, UrdfTree, read_tree, suggestion
from dynsim.record.scene import Shape, quaternion

HAND = "hand"
# Functions that make the rows of joints with several of them.
ROWS = {"floating": floating, "planar": planar}


@dataclass(frozen=True)
class _Place:
    """The moving body that carries a link (None: the world), the link's frame there, and its distance from the root."""

    body: str | None
    R: Array
    p: Array
    moving: int
    joints: int


def read_urdf(path: Path, lock: Mapping[str, float] | None = None) -> Robot:
    """Read the bodies and joints of a URDF file.

    Joints keep their names and the order of the file (a parent still comes first); each body is named after the link
    at its moving joint, and every other link is a frame of the body that carries it. Floating and planar joints become
    their rows (:mod:`dynsim.model.joints`). The hand is the link named
    ``hand``, else the tip of the chain with the most moving joints: the last link fixed to its last body, or that
    body's origin when nothing is fixed to it. The root link is the world. A mimic joint is a coupling to its leader; a
    locked leader locks it too.

    Parameters
    ----------
    path : file
    lock : positions [rad or m] of joints that are to be fixed, by name

    Raises
    ------
    ModelError
        No such file, not URDF, a number that is none, a mass without inertia and the like; a mimic joint whose leader
        there is not; no joint of a name in ``lock``, or one without a single position. The message names file, line,
        link or joint, value and what to do.

    Warns
    -----
    UserWarning
        A link with a shape has no mass; moments of inertia of a link are not those of a body; a joint is locked beyond
        its limits.
    """
    tree = read_tree(path)
    locked = _locked(tree, {**_locked_followers(tree, lock or {}), **(lock or {})})
    places = _places(locked)
    links = _links(locked, places)
    if not links:
        raise ModelError(f"{path}: no moving joint")
    _warn(locked, places, links)
    frames = [Frame(name, pose.body, pose.R, pose.p) for name, pose in places.items() if pose.body != name]
    rows = tuple(row for link in links for row in (ROWS[link.kind](link) if link.kind in ROWS else (link,)))
    for joint in locked.joints.values():
        for name in (joint.name, joint.mimics or joint.name):
            if joint.mimics is not None and locked.joints[name].kind in SEVERAL:
                raise tree.error(
                    joint.line, f"joint {joint.name!r} mimics {joint.mimics!r}, and {name!r} has several positions"
                )
    couplings = tuple(
        Coupling(joint.name, joint.mimics, joint.multiplier, joint.offset)
        for joint in locked.joints.values()
        if joint.mimics is not None and joint.kind in MOVING
    )
    hand = _hand(tree, places)
    return Robot(
        name=tree.name,
        links=rows,
        motors=(),
        hand=(str(hand.body), hand.p),
        hand_frame=hand.R,
        frames=tuple(frames),
        couplings=couplings,
        fixed_shapes=_shapes(locked, places).get(None, ()),
        fixed_inertia=_fixed(locked, places),
    )


def _fixed(tree: UrdfTree, places: Mapping[str, _Place]) -> Inertia:
    """Mass properties of all that is fixed to the root, in its frame."""
    parts = [
        inertia.placed(pose.R, pose.p)
        for name, pose in places.items()
        if pose.body is None and (inertia := tree.links[name].inertia) is not None
    ]
    return Inertia.merged(parts) if parts else Inertia(0.0)


def _locked_followers(tree: UrdfTree, lock: Mapping[str, float]) -> dict[str, float]:
    """Positions of the mimic joints whose leader is locked or fixed, directly or through others [rad or m]."""
    positions: dict[str, float] = {}
    for follower in tree.joints.values():
        chain, joint = [], follower
        while joint.mimics is not None and joint.name not in lock and joint.kind != "fixed":
            if joint.mimics not in tree.joints:
                raise tree.error(
                    joint.line,
                    f"joint {joint.name!r} mimics joint {joint.mimics!r}, which is not in the file"
                    f"{suggestion(joint.mimics, tree.joints)}",
                )
            if joint in chain:
                raise tree.error(joint.line, f"joint {joint.name!r} mimics itself, by way of {joint.mimics!r}")
            chain.append(joint)
            joint = tree.joints[joint.mimics]
        if chain and (joint.name in lock or joint.kind == "fixed"):
            q = lock.get(joint.name, 0.0)
            for link in reversed(chain):
                q = link.multiplier * q + link.offset
            positions[follower.name] = q
    return positions


def _locked(tree: UrdfTree, lock: Mapping[str, float]) -> UrdfTree:
    """The tree with joints fixed at positions: T_PC = T_PJ · Rot(a, q), or T_PJ · Trans(a q) for a prismatic one."""
    joints = dict(tree.joints)
    for name, value in lock.items():
        if name not in joints:
            raise ModelError(
                f"{tree.path}: lock: no joint {name!r}{suggestion(name, joints)}; joints: {', '.join(joints)}"
            )
        joint = joints[name]
        if joint.kind not in MOVING:
            fix = "; make it fixed in the file" if joint.kind in SEVERAL else ""
            raise tree.error(
                joint.line, f"lock: joint {name!r} is {joint.kind}, which has no position to lock it at{fix}"
            )
        if not math.isfinite(value):
            raise ModelError(f"{tree.path}: lock: {name} = {value} is not a finite number")
        if not joint.lower - 1e-9 <= value <= joint.upper + 1e-9:
            warnings.warn(
                f"{tree.path}: joint {name} is locked at {value:g}, its limits are {joint.lower:g} and {joint.upper:g}",
                stacklevel=3,
            )
        if joint.kind == "prismatic":
            joints[name] = replace(joint, kind="fixed", p=joint.p + joint.R @ joint.axis * value)
        else:
            joints[name] = replace(joint, kind="fixed", R=joint.R @ _turn(joint.axis, value))
    return replace(tree, joints=joints)


def _turn(axis: Array, angle: float) -> Array:
    """Rotation about a unit axis, R = 1 + sin q [a]× + (1 − cos q) [a]×² (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _places(tree: UrdfTree) -> dict[str, _Place]:
    """Where every link is; a parent comes before its children, of those that could come next the first of the file."""
    below: dict[str, list[tuple[int, UrdfJoint]]] = {name: [] for name in tree.links}
    for order, joint in enumerate(tree.joints.values()):
        below[joint.parent].append((order, joint))
    places = {tree.root: _Place(None, np.eye(3), np.zeros(3), 0, 0)}
    # Fixed joints first: what is behind them belongs to a body that is there, and may carry joints early in the file.
    pending: list[tuple[bool, int, str]] = []
    joints = tree.joints

    def open_up(link: str) -> None:
        for order, joint in below[link]:
            heapq.heappush(pending, (joint.kind != "fixed", order, joint.name))

    open_up(tree.root)
    while pending:
        moves, _, name = heapq.heappop(pending)
        joint, parent = joints[name], places[joints[name].parent]
        if moves:
            places[joint.child] = _Place(joint.child, np.eye(3), np.zeros(3), parent.moving + 1, parent.joints + 1)
        else:
            R, p = parent.R @ joint.R, parent.p + parent.R @ joint.p
            places[joint.child] = _Place(parent.body, R, p, parent.moving, parent.joints + 1)
        open_up(joint.child)
    return places


def _links(tree: UrdfTree, places: Mapping[str, _Place]) -> tuple[Link, ...]:
    """The moving bodies, with all that is fixed to them; a floating or planar joint is still one, of this kind."""
    parts: dict[str | None, list[Inertia]] = {}
    for name, pose in places.items():
        inertia = tree.links[name].inertia
        if inertia is not None and pose.body is not None:
            own = name == pose.body
            parts.setdefault(pose.body, []).append(inertia if own else inertia.placed(pose.R, pose.p))
    joint_to = {joint.child: joint for joint in tree.joints.values()}
    shapes = _shapes(tree, places)
    links = []
    for name, pose in places.items():
        if pose.body != name:
            continue
        joint = joint_to[name]
        parent = places[joint.parent]
        links.append(
            Link(
                name=name,
                joint=joint.name,
                parent=parent.body,
                kind=MOVING.get(joint.kind, joint.kind),
                axis=joint.axis,
                inertia=Inertia.merged(parts.get(name, [Inertia(0.0)])),
                R_PJ=parent.R @ joint.R,
                p_PJ=parent.p + parent.R @ joint.p,
                damping=joint.damping,
                friction=joint.friction,
                lower=joint.lower,
                upper=joint.upper,
                velocity_limit=joint.velocity_limit,
                effort_limit=joint.effort_limit,
                shapes=shapes.get(name, ()),
            )
        )
    return tuple(links)


def _shapes(tree: UrdfTree, places: Mapping[str, _Place]) -> dict[str | None, tuple[Shape, ...]]:
    """What each moving body, and the world (None), looks like, with all that is fixed to it."""
    drawn: dict[str | None, tuple[Shape, ...]] = {}
    for name, pose in places.items():
        turn = quaternion(pose.R)
        shapes = tuple(shape.placed(pose.p, turn) for shape in tree.links[name].shapes)
        drawn[pose.body] = (*drawn.get(pose.body, ()), *shapes)
    return drawn


def _hand(tree: UrdfTree, places: Mapping[str, _Place]) -> _Place:
    """The controlled point: the link ``hand`` if it moves, else the tip of the deepest chain, the first of equals."""
    tip = max(tree.links, key=lambda name: (places[name].moving, places[name].joints))
    if HAND in places and places[HAND].moving > 0:
        tip = HAND
    return places[tip]


def _warn(tree: UrdfTree, places: Mapping[str, _Place], links: tuple[Link, ...]) -> None:
    """Refuse bodies that cannot be; warn of masses that are missing."""
    for link in links:
        link.inertia.check(
            f"{tree.path}:{tree.links[link.name].line}: link {link.name!r}, with all that is fixed to it"
        )
    loaded: set[str | None] = set()
    for link in reversed(links):
        if link.name in loaded or link.inertia.mass > 0.0 or link.inertia.tensor.any():
            loaded |= {link.name, link.parent}
    empty = [link.joint for link in links if link.name not in loaded and (link.parent in loaded or not link.parent)]
    if empty:
        warnings.warn(f"{tree.path}: nothing beyond these joints has a mass ({', '.join(empty)})", stacklevel=3)
    moving = [tree.links[name] for name, pose in places.items() if pose.body is not None]
    bare = [link.name for link in moving if link.inertia is None and link.shaped]
    if bare:
        warnings.warn(
            f"{tree.path}: links with a shape but without <inertial> have no mass ({', '.join(bare)})", stacklevel=3
        )
    odd = []
    for part in moving:
        try:
            (part.inertia or Inertia(0.0)).check(part.name)
        except ModelError:
            odd.append(part.name)
    if odd:
        warnings.warn(
            f"{tree.path}: moments of inertia that no body can have, taken as they stand because the bodies that these "
            f"links are fixed to can have the sum ({', '.join(odd)})",
            stacklevel=3,
        )

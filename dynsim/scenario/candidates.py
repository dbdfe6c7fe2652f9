"""Contact candidates where a scenario names no points: all joints as points, or links as capsules."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from dynsim.compile.clearance import axis_ends
from dynsim.compile.mobility import SAME, moves, random_configurations
from dynsim.compile.model import Model
from dynsim.compile.shapes import bends_outward
from dynsim.model.description import Contact, Robot
from dynsim.model.surfaces import Array, Surface

log = logging.getLogger(__name__)

# The radius of a capsule between its ends is smaller by this [m]: where an end is nearest, or the axis lies along a
# face, only the ends touch, and the rows are independent.
THINNER = 1e-6


def candidates(kind: str, robot: Robot, surfaces: Mapping[str, Surface], declared: Iterable[Contact]) -> list[Contact]:
    """Candidates of a robot against all surfaces, without friction, beside those that are declared.

    ``joints``: the origins of all joints, and the hand, as points. ``links``: the axes of all links, with their radii.
    A capsule is nearest to a flat or hollow surface, and to a height field, with one of the spheres at its ends; those
    that neighbours share count once, on the link whose joint it is, with the larger radius. Spheres, cylinders and
    boxes are touched from outside by these, and by the nearest point of the axis; that is :data:`THINNER`.

    Left out are points that are declared or the same as others, spheres about points that are declared (a warning
    names them), and what cannot move along the normal (a log line names it): it would have a row of zeros. A link
    without mass and extent, such as a carriage, has no sphere.
    """
    model = Model(robot)
    configurations = random_configurations(robot)
    taken = [contact for contact in declared if contact.tip is None]
    names = {contact.name for contact in declared}
    contacts: list[Contact] = []
    still: list[str] = []
    replaced: list[str] = []
    for surface_name, surface in surfaces.items():
        kept: list[tuple[Contact, Array]] = []
        known = [
            (contact, _places(model, contact, configurations))
            for contact in taken
            if contact.surface_name == surface_name
        ]
        for contact in (_joints if kind == "joints" else _links)(robot, surface, surface_name):
            places = _places(model, contact, configurations)
            if contact.tip is None:
                twins = [entry for entry, other in known if _same(places, other)]
                if twins:
                    replaced.extend(entry.name for entry in twins if contact.radius > entry.radius)
                    continue
                twin = next((k for k, (own, other) in enumerate(kept) if own.tip is None and _same(places, other)), -1)
                if twin >= 0:
                    earlier, other = kept[twin]
                    kept[twin] = replace(earlier, radius=max(earlier.radius, contact.radius)), other
                    continue
            kept.append((contact, places))
        for contact, _ in kept:
            name = contact.name if len(surfaces) == 1 else f"{contact.name}_{surface_name}"
            if moves(model, contact, configurations):
                contacts.append(replace(contact, name=_unused(name, names)))
            else:
                still.append(name)
    if replaced:
        log.warning(
            "contacts.candidates: declared at a joint, a point of less radius touches there instead of the link: %s",
            ", ".join(dict.fromkeys(replaced)),
        )
    if still:
        log.info("contacts.candidates: left out, because nothing moves them along the normal: %s", ", ".join(still))
    return contacts


def _joints(robot: Robot, surface: Surface, name: str) -> list[Contact]:
    """Origins of all joints, and the hand."""
    carriers = robot.carriers
    joints = [
        Contact(link.joint_of_rows or link.joint, link.name, np.zeros(3), surface, name)
        for link in robot.links
        if link.name not in carriers
    ]
    return [*joints, Contact("hand", *robot.hand, surface, name)]


def _links(robot: Robot, surface: Surface, on: str) -> list[Contact]:
    """Axes of all links against a surface: spheres at their beginnings, then at their ends, and capsules between."""
    starts, ends, capsules = [], [], []
    tips, carriers = axis_ends(robot), robot.carriers
    for link in robot.links:
        axes = [tip for tip in tips[link.name] if np.linalg.norm(tip) > SAME]
        # What has neither extent nor mass, such as a carriage, is no body of its own.
        if link.name in carriers or not (axes or link.inertia.mass):
            continue
        joint = link.joint_of_rows or link.joint
        starts.append(Contact(joint, link.name, np.zeros(3), surface, on, radius=link.radius))
        for k, tip in enumerate(axes):
            name = link.name if len(axes) == 1 else f"{link.name}_{k + 1}"
            ends.append(Contact(f"{name}_end", link.name, tip, surface, on, radius=link.radius))
            thinner = max(link.radius - THINNER, 0.0)
            capsules.append(Contact(name, link.name, np.zeros(3), surface, on, radius=thinner, tip=tip))
    return [*starts, *ends, *capsules] if bends_outward(surface) else starts + ends


def _places(model: Model, contact: Contact, configurations: Iterable[Array]) -> Array:
    """Positions of the point of a contact [m]."""
    return np.array([model.point_position(contact.body, contact.point, q) for q in configurations])


def _same(a: Array, b: Array) -> bool:
    return bool(np.abs(a - b).max() <= SAME)


def _unused(name: str, names: set[str]) -> str:
    """The name, with a number if another candidate has it; it is taken from then on."""
    unused, count = name, 1
    while unused in names:
        count += 1
        unused = f"{name}_{count}"
    names.add(unused)
    return unused

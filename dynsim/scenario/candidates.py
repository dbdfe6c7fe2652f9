"""Contact candidates that a scenario does not list: all joints as points, or all links as capsules."""

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

# Amount by which a capsule's radius is smaller between its ends [m]. If an end is nearest, or the axis is parallel to a
# face, only the ends touch, so that the constraint rows are independent.
THINNER = 1e-6


def candidates(kind: str, robot: Robot, surfaces: Mapping[str, Surface], declared: Iterable[Contact]) -> list[Contact]:
    """Return the frictionless contact candidates of a robot on all surfaces, in addition to the declared contacts.

    The kind ``joints`` uses the origins of all joints and the hand as points; ``links`` forms capsules from the axes
    and radii of all links. On a flat or hollow surface, or a height field, a capsule touches with one of its end
    spheres. Neighbouring links share an end sphere; it is listed once, on the link that starts at the joint, with the
    larger radius. Spheres, cylinders and boxes can also touch the capsule between its ends; this part is thinner by
    :data:`THINNER`.

    The result omits points that are declared or coincide with another candidate, spheres around declared points (with a
    warning), and candidates that no joint moves along the normal (with a log line), because their constraint row would
    be zero. A link without mass and length, such as a carriage, has no sphere.
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
                contacts.append(replace(contact, name=unused(name, names)))
            else:
                still.append(name)
    if replaced:
        log.warning(
            "contacts.candidates: declared points at joints replace the larger spheres of the links: %s",
            ", ".join(dict.fromkeys(replaced)),
        )
    if still:
        log.info("contacts.candidates: omitted because no joint moves them along the normal: %s", ", ".join(still))
    return contacts


def _joints(robot: Robot, surface: Surface, name: str) -> list[Contact]:
    """Return the origins of all joints, and the hand, as points."""
    carriers = robot.carriers
    joints = [
        Contact(link.joint_of_rows or link.joint, link.name, np.zeros(3), surface, name)
        for link in robot.links
        if link.name not in carriers
    ]
    return [*joints, Contact("hand", *robot.hand, surface, name)]


def _links(robot: Robot, surface: Surface, on: str) -> list[Contact]:
    """Return the links as spheres at their starts, spheres at their ends, and capsules in between."""
    starts, ends, capsules = [], [], []
    tips, carriers = axis_ends(robot), robot.carriers
    for link in robot.links:
        axes = [tip for tip in tips[link.name] if np.linalg.norm(tip) > SAME]
        # A link without length and mass, such as a carriage, is not a physical body.
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
    """Return the positions of a contact's point in each configuration [m]."""
    return np.array([model.point_position(contact.body, contact.point, q) for q in configurations])


def _same(a: Array, b: Array) -> bool:
    return bool(np.abs(a - b).max() <= SAME)


def unused(name: str, names: set[str]) -> str:
    """Return the name, with a number appended if it is already in use, and add it to ``names``."""
    unused, count = name, 1
    while unused in names:
        count += 1
        unused = f"{name}_{count}"
    names.add(unused)
    return unused

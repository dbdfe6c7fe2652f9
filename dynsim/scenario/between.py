"""Contacts between bodies: the solids of links and objects, and the candidates of a pair of solids.

A solid is a surface that its body carries: a capsule, a sphere (a capsule without length) or a box with rounded edges.
Candidates of a pair are points and axes of each solid against the other.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dynsim.compile.solids import Solid, solids_of
from dynsim.config.problems import suggest
from dynsim.dynamics.contact.solids import SLOTS
from dynsim.errors import ModelError, first_few
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.surfaces import CORNERS, Box, Capsule
from dynsim.scenario.candidates import THINNER, unused
from dynsim.scenario.schema import BodyPair, SceneObject

log = logging.getLogger(__name__)
LINKS, OBJECTS, SELF = "links", "objects", "self"
# Maximum number of candidates between bodies for event-driven methods.
MOST_CANDIDATES = 20


def contacts_between(
    pairs: Sequence[BodyPair],
    robot: Robot,
    objects: Mapping[str, SceneObject],
    law: Callable[[BodyPair], dict[str, Any]],
    names: set[str],
    stepped: bool,
) -> list[Contact]:
    """Return the contacts between bodies.

    Parameters
    ----------
    pairs : sequence of BodyPair
        Entries of ``contacts.between``; for a pair in several entries the last one counts.
    robot : Robot
        Description of the robot.
    objects : mapping of str to SceneObject
        Objects of the scenario.
    law : callable
        Function that returns the contact-law parameters of an entry, as keyword arguments of :class:`Contact`.
    names : set of str
        Names of other contacts; extended by those of the result.
    stepped : bool
        True for time stepping: pairs without a sphere have the contacts of two solids, see
        :mod:`dynsim.dynamics.contact.solids`. False: points and axes of each solid against the other.

    Raises
    ------
    ModelError
        If a body does not exist or has no solid.
    """
    result = []
    for a, b, entry in solid_pairs(pairs, robot, objects):
        for contact in _slots(a, b) if stepped and not (_is_sphere(a) or _is_sphere(b)) else _candidates(a, b):
            name = unused(f"{contact.body}-{contact.surface.carrier}", names)
            result.append(replace(contact, name=name, surface_name=str(contact.surface.carrier), **law(entry)))
    if not stepped and len(result) > MOST_CANDIDATES:
        raise ModelError(
            f"contacts.between: {len(result)} candidates between bodies are more than the {MOST_CANDIDATES} for which "
            "this method locates events; use integrator: {method: time_stepping}, or fewer pairs",
            keys=("contacts", "between"),
        )
    return result


def solid_pairs(
    pairs: Sequence[BodyPair], robot: Robot, objects: Mapping[str, SceneObject]
) -> list[tuple[Solid, Solid, BodyPair]]:
    """Return the pairs of solids that can touch, each with its entry; see :func:`contacts_between`."""
    solids = solids_of(robot)
    chosen: dict[tuple[str, str], BodyPair] = {}
    for k, entry in enumerate(pairs):
        for first, second in _bodies(k, entry, robot, objects, solids):
            chosen.pop((second, first), None)
            chosen[first, second] = entry
    touching = set(itertools.chain.from_iterable(chosen))
    if left_out := [text for link in robot.links if link.name in touching and not link.radius for text in link.omitted]:
        log.warning(
            "contacts.between: %s: left out; use boxes, spheres, cylinders or plant.links.NAME.radius_m",
            first_few(left_out),
        )
    return [
        (a, b, entry)
        for (first, second), entry in chosen.items()
        for a, b in itertools.product(solids[first], solids[second])
    ]


def _bodies(
    k: int, entry: BodyPair, robot: Robot, objects: Mapping[str, SceneObject], solids: Mapping[str, list[Solid]]
) -> Iterator[tuple[str, str]]:
    """Yield the pairs of bodies of entry k, without neighbours on a joint and without ignored pairs."""
    of_objects = {link.name for name, body in objects.items() for link in body.links(name)}
    keys: tuple[str | int, ...] = ("contacts", "between", k)
    groups = {LINKS: [b for b in solids if b not in of_objects], OBJECTS: [b for b in solids if b in of_objects]}

    def members(name: str, key: str) -> list[str]:
        if name in groups:
            if not groups[name]:
                raise ModelError(f"contacts.between: no {name} with a solid; set radius_m", keys=(*keys, key))
            return groups[name]
        if name not in robot.bodies:
            known = [*robot.bodies, *groups]
            raise ModelError(
                f"contacts.between: unknown body {name!r}{suggest(name, known)}; bodies: {', '.join(known)}",
                keys=(*keys, key),
            )
        if name not in solids:
            (omitted,) = (link.omitted for link in robot.links if link.name == name)
            reason = f" ({first_few(omitted)})" if omitted else ""
            raise ModelError(
                f"contacts.between: body {name!r} has no solid{reason}; set its radius_m", keys=(*keys, key)
            )
        return [name]

    for name in itertools.chain.from_iterable(entry.ignore):
        if name not in robot.bodies:
            members(name, "ignore")
    if names := {LINKS, OBJECTS, SELF} & set(robot.bodies):
        raise ModelError(f"contacts.between: {min(names)!r} is a group and a body; rename the body", keys=keys)
    ignored = {frozenset(pair) for pair in entry.ignore} | _neighbours(robot)
    sides = [LINKS, LINKS] if entry.bodies == SELF else list(entry.bodies)
    seen = set[frozenset[str]]()
    for first, second in itertools.product(*(members(side, "bodies") for side in sides)):
        pair = frozenset((first, second))
        if len(pair) == 2 and pair not in ignored and pair not in seen:
            seen.add(pair)
            yield first, second
    if not seen:
        log.warning("contacts.between.%d has no effect: no pair remains without neighbours on joints and `ignore`", k)


def _neighbours(robot: Robot) -> set[frozenset[str]]:
    """Return the pairs of bodies that a joint connects; a wheel also ignores the neighbours of its axle."""
    parents = {link.name: link.parent for link in robot.links}
    pairs = set[frozenset[str]]()
    for name in robot.bodies:
        parent = parents[name]
        while parent is not None and parent in robot.carriers:
            parent = parents[parent]
        if parent is not None:
            pairs.add(frozenset((name, parent)))
    wheels = {foot.body for foot in robot.feet if foot.radius and not foot.point.any()}
    beside = {frozenset((wheel, body)) for wheel in wheels for pair in pairs if parents[wheel] in pair for body in pair}
    return pairs | beside


def _is_sphere(solid: Solid) -> bool:
    return isinstance(solid, Capsule) and not solid.axis.any()


def _slots(a: Solid, b: Solid) -> Iterator[Contact]:
    """Yield the contacts of two solids."""
    for k in range(SLOTS):
        yield replace(_contact(a, np.zeros(3), b, 0.0), solid=a, slot=k)


def _candidates(a: Solid, b: Solid) -> Iterable[Contact]:
    """Yield points, spheres and axes of each of two solids against the other."""
    if isinstance(a, Box) and isinstance(b, Box):
        yield from (*_corners(a, b), *_corners(b, a), *_edges(a, b))
    elif isinstance(a, Box):
        yield from _candidates(b, a)
    elif isinstance(b, Box):
        # The distance of a sphere from a box covers corners, too.
        yield from (*_along(a, b), *(_corners(b, a) if a.axis.any() else ()))
    elif not a.axis.any() or b.axis.any():
        yield from (*_along(a, b), *(_ends(b, a) if b.axis.any() and a.axis.any() else ()))
    else:
        yield from _along(b, a)


def _contact(body: Solid, point: Array, surface: Solid, radius: float, tip: Array | None = None) -> Contact:
    assert body.carrier is not None
    return Contact("", body.carrier, point, surface, radius=radius, tip=tip)


def _ends(a: Capsule, b: Solid) -> Iterator[Contact]:
    """Yield the end spheres of a capsule, one of a sphere, against a solid."""
    yield _contact(a, a.start, b, a.radius)
    if a.axis.any():
        yield _contact(a, a.start + a.axis, b, a.radius)


def _along(a: Capsule, b: Solid) -> Iterator[Contact]:
    """Yield the ends and the axis of a capsule against a solid; the axis is thinner, so that no point counts twice."""
    yield from _ends(a, b)
    if a.axis.any():
        yield _contact(a, a.start, b, max(a.radius - THINNER, 0.0), a.start + a.axis)


def _corners(a: Box, b: Solid) -> Iterator[Contact]:
    """Yield the rounded corners of a box against a solid; those of a thin plate once."""
    for corner in a.corners[((CORNERS < 0.0) | (a.core > 0.0)).all(axis=1)]:
        yield _contact(a, corner, b, a.edge_radius)


def _edges(a: Box, b: Box) -> Iterator[Contact]:
    """Yield the rounded edges of a box against another box."""
    for k in range(3):
        for start in a.corners[CORNERS[:, k] < 0.0]:
            tip = start + 2.0 * a.core[k] * a.axes[k]
            yield _contact(a, start, b, max(a.edge_radius - THINNER, 0.0), tip)

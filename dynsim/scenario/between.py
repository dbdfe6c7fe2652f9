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
from dynsim.model.description import WORLD, Array, Contact, Robot
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
        True for time stepping: pairs without a moving sphere have the contacts of two solids, see
        :mod:`dynsim.dynamics.contact.solids`. False: points and axes of each solid against the other.

    Raises
    ------
    ModelError
        If a body does not exist or has no solid.
    """
    result = []
    for a, b, entry in solid_pairs(pairs, robot, objects):
        slots = stepped and not (a.is_sphere or (b.is_sphere and b.carrier))
        for contact in _slots(a, b) if slots else _candidates(a, b):
            on = contact.surface.carrier or robot.root or WORLD
            name = unused(f"{contact.body}-{on}", names)
            result.append(replace(contact, name=name, surface_name=on, **law(entry)))
    if not stepped and len(result) > MOST_CANDIDATES:
        other = "spheres" if robot.base else "integrator: {method: time_stepping}"  # which has no mobile base
        raise ModelError(
            f"contacts.between: {len(result)} candidates between bodies are more than the {MOST_CANDIDATES} for which "
            f"this method locates events; use {other}, or fewer pairs",
            keys=("contacts", "between"),
        )
    return result


def solid_pairs(
    pairs: Sequence[BodyPair],
    robot: Robot,
    objects: Mapping[str, SceneObject],
    solids: Mapping[str, list[Solid]] | None = None,
) -> list[tuple[Solid, Solid, BodyPair]]:
    """Return the pairs of solids that can touch, each with its entry; see :func:`contacts_between`.

    The first solid of a pair is on a body that moves; the second one may be fixed to the world. ``solids`` defaults to
    the solids of the robot.
    """
    solids = solids_of(robot) if solids is None else solids
    chosen: dict[tuple[str, str], BodyPair] = {}
    for k, entry in enumerate(pairs):
        ignored = set(map(frozenset, entry.ignore))
        for first, second in _bodies(k, entry, robot, objects, solids):
            if frozenset((first, second)) not in ignored:
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


def idle_entries(scenario: Any, robot: Robot) -> list[str]:
    """Return a warning for each entry without pairs, and for pairs in ``ignore`` that its entry does not have."""
    warnings, entries, objects = [], scenario.config.contacts.between, scenario.config.objects
    solids = solids_of(robot) if entries else {}
    for k, entry in enumerate(entries):
        pairs = set(map(frozenset, _bodies(k, entry, robot, objects, solids)))
        ignored, where = set(map(frozenset, entry.ignore)), scenario.location(("contacts", "between", k))
        if pairs <= ignored:
            why = "no pair remains without neighbours on joints and `ignore`"
            warnings.append(f"contacts.between.{k} has no effect: {why} ({where})")
        elif idle := ["-".join(pair) for pair in entry.ignore if frozenset(pair) not in pairs]:
            warnings.append(
                f"contacts.between.{k}.ignore has no effect: the entry does not contain {first_few(idle)} ({where})"
            )
    return warnings


def _bodies(
    k: int, entry: BodyPair, robot: Robot, objects: Mapping[str, SceneObject], solids: Mapping[str, list[Solid]]
) -> Iterator[tuple[str, str]]:
    """Yield the pairs of bodies of entry k, including ignored pairs, without neighbours on a joint; the root last."""
    of_objects = {link.name for name, body in objects.items() for link in body.links(name)}
    keys: tuple[str | int, ...] = ("contacts", "between", k)
    apart = of_objects | ({robot.base.body} if robot.base else set())  # the arm is mounted within the mobile base
    groups = {LINKS: [b for b in solids if b not in apart], OBJECTS: [b for b in solids if b in of_objects]}
    root, fixed = robot.root or WORLD, {frame.name: frame.body or robot.root for frame in robot.frames}
    bodies = [*robot.bodies, *([root] if robot.root else ())]

    def members(name: str, key: str) -> list[str]:
        if name in groups:
            if not groups[name]:
                raise ModelError(f"contacts.between: no {name} with a solid; set radius_m", keys=(*keys, key))
            return groups[name]
        known = [*bodies, *groups]
        text = f"unknown body {name!r}{suggest(name, known)}; bodies: {', '.join(known)}"
        if name in solids:
            return [name]
        if name in bodies:
            omitted = [text for link in robot.links if link.name == name for text in link.omitted]
            fix = "add a <collision> box, sphere or cylinder" if name == robot.root else "set its radius_m"
            text = f"body {name!r} has no solid{f' ({first_few(omitted)})' if omitted else ''}; {fix}"
        elif name in fixed:
            text = f"{name!r} is fixed to {fixed[name]!r}; use {fixed[name]!r}, which has the solids of both"
        raise ModelError(f"contacts.between: {text}", keys=(*keys, key))

    for name in itertools.chain.from_iterable(entry.ignore):
        if name not in bodies:
            members(name, "ignore")
    if names := {LINKS, OBJECTS, SELF} & set(bodies):
        raise ModelError(f"contacts.between: {min(names)!r} is a group and a body; rename the body", keys=keys)
    neighbours = _neighbours(robot, of_objects)
    sides = [LINKS, LINKS] if entry.bodies == SELF else list(entry.bodies)
    seen = set[frozenset[str]]()
    for first, second in itertools.product(*(members(side, "bodies") for side in sides)):
        pair = frozenset((first, second))
        if len(pair) == 2 and pair not in neighbours and pair not in seen:
            seen.add(pair)
            yield (second, first) if first == root else (first, second)


def _neighbours(robot: Robot, of_objects: set[str]) -> set[frozenset[str]]:
    """Return the pairs of bodies that a joint connects; a wheel also ignores the neighbours of its axle."""
    parents = {link.name: link.parent for link in robot.links}
    pairs = set[frozenset[str]]()
    for name in robot.bodies:
        parent = parents[name]
        while parent is not None and parent in robot.carriers:
            parent = parents[parent]
        if parent is not None or name not in of_objects:  # joints of objects are not on the root link
            pairs.add(frozenset((name, parent or robot.root or WORLD)))
    wheels = {foot.body for foot in robot.feet if foot.radius and not foot.point.any()}
    beside = {frozenset((wheel, body)) for wheel in wheels for pair in pairs if parents[wheel] in pair for body in pair}
    return pairs | beside


def _slots(a: Solid, b: Solid) -> Iterator[Contact]:
    """Yield the contacts of two solids."""
    for k in range(SLOTS):
        yield replace(_contact(a, np.zeros(3), b, 0.0), solid=a, slot=k)


def _candidates(a: Solid, b: Solid) -> Iterable[Contact]:
    """Yield points, spheres and axes of each of two solids against the other."""
    if b.carrier is None:
        if isinstance(a, Box):
            raise ModelError(
                f"contacts.between: {a.carrier} is a box, and its partner is fixed to the world, for which this method "
                "has no contacts; use integrator: {method: time_stepping}",
                keys=("contacts", "between"),
            )
        yield from _along(a, b)
    elif isinstance(a, Box) and isinstance(b, Box):
        yield from (*_corners(a, b), *_corners(b, a), *_edges(a, b))
    elif isinstance(a, Box):
        yield from _candidates(b, a)
    elif isinstance(b, Box):
        # The distance of a sphere from a box covers corners, too.
        yield from (*_along(a, b), *(() if a.is_sphere else _corners(b, a)))
    elif a.is_sphere or not b.is_sphere:
        yield from (*_along(a, b), *(() if a.is_sphere or b.is_sphere else _ends(b, a)))
    else:
        yield from _along(b, a)


def _contact(body: Solid, point: Array, surface: Solid, radius: float, tip: Array | None = None) -> Contact:
    assert body.carrier is not None
    return Contact("", body.carrier, point, surface, radius=radius, tip=tip, is_between_bodies=True)


def _ends(a: Capsule, b: Solid) -> Iterator[Contact]:
    """Yield the end spheres of a capsule, one of a sphere, against a solid."""
    yield _contact(a, a.start, b, a.radius)
    if not a.is_sphere:
        yield _contact(a, a.start + a.axis, b, a.radius)


def _along(a: Capsule, b: Solid) -> Iterator[Contact]:
    """Yield the ends and the axis of a capsule against a solid; the axis is thinner, so that no point counts twice."""
    yield from _ends(a, b)
    if not a.is_sphere:
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

"""Lines and points of an arm from the scene and body poses of its record, and their extent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynsim.draw.figures import style
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.robot import placed
from dynsim.draw.geometry.shapes import Faces, corners_of
from dynsim.draw.geometry.surfaces import box_about
from dynsim.record import Record
from dynsim.record.measures import hand_target
from dynsim.record.poses import POSITION, point_positions, touching_positions
from dynsim.record.scene import WORLD, Joint, Point, Scene, SceneSurface

# Number of postures drawn faintly, at even intervals of the run, besides the last one.
FAINT = 6
# Text at the contacts: font size, and height of its two lines [point].
LABEL_SIZE, LABEL_HEIGHT = 7.0, 19.0
# From the middle of a contact's mark to its text [point].
NEAR_CONTACT = 7.0
# Extents up to this count as zero, as body poses are in single precision [m].
NOTHING = 1e-6


@dataclass(frozen=True)
class Skeleton:
    """A robot with the poses of its bodies over time."""

    record: Record
    scene: Scene

    def segments(self, row: int) -> Array:
        """From each body's parent to the body, and from the hand's body to the hand, (m, 2, 3) [m].

        Nothing leads from the world or a body to what moves freely beside it.
        """
        points, base = self.record[POSITION][row].astype(np.float64), self.scene.base
        lines = []
        for k, body in enumerate(self.scene.bodies):
            # A mobile base is drawn as what it is, see :meth:`solids`.
            if k in base or body.parent in base or _moves_beside(body.joint):
                continue
            # A sliding joint at the root moves its body away from where it is mounted.
            start = np.array(body.joint.position) if body.parent == WORLD else points[body.parent]
            lines.append((start, points[k]))
        hand = self.scene.hand
        if hand is not None and hand.body != WORLD:
            lines.append((points[hand.body], point_positions(self.record, hand, row)))
        return np.array(lines)

    def solids(self, row: int) -> list[tuple[Array, Faces]]:
        """Corners, (n, 3) [m], and faces of the shapes of a mobile base and its wheels at a sample."""
        return [solid for body in self.scene.base for solid in corners_of(self.record, self.scene, body, row)]

    def bases(self) -> list[list[Array]]:
        """Corners of a mobile base's solids for each of the postures."""
        return [[corners for corners, _ in self.solids(k)] for k in self.rows_shown()]

    def postures(self) -> list[Array]:
        """Segments at some samples, those of the last one last; a run that diverged may end in some without poses."""
        return [self.segments(k) for k in self.rows_shown()]

    def rows_shown(self) -> list[int]:
        """Samples at which the robot is drawn, the last one last; none where it never had a pose."""
        rows = np.flatnonzero(np.isfinite(self.record[POSITION]).all(axis=(1, 2)))
        if not len(rows):
            return []
        return list(dict.fromkeys(rows[np.linspace(0, len(rows) - 1, FAINT + 1).astype(int)].tolist()))

    def contacts(self) -> list[tuple[Point, SceneSurface, Array, float]]:
        """Contact, its surface, position and normal force at the end; NaN for a force that is not known.

        A point with a radius is where its sphere touches, if a force says that it does.

        Of those that could touch, under the unilateral law, the ones that did in some sample.
        """
        record = self.record
        if not np.isfinite(record[POSITION][-1]).all():
            return []
        forces: dict[str, float] = {}
        if "contact_normal_force" in record:
            forces = dict(zip(record.labels["contact_normal_force"], record["contact_normal_force"][-1], strict=True))
        untouched: set[str] = set()
        if "contact_mode" in record:
            open_always = (record["contact_mode"] == 0.0).all(axis=0)
            untouched = {
                name for name, always in zip(record.labels["contact_mode"], open_always, strict=True) if always
            }
        contacts = []
        for point in self.scene.contacts:
            surface = self.scene.surface(point.surface)
            if surface is None or point.name in untouched:
                continue
            position, force = touching_positions(record, point, len(record) - 1), float(forces.get(point.name, np.nan))
            if abs(force) > 0.0:
                position = position - surface.gap(position) * surface.normal(position)
            contacts.append((point, surface, position, force))
        return contacts


def _moves_beside(joint: Joint) -> bool:
    """Whether it is a row of a floating, planar or rolling joint that takes the body away from what it hangs on."""
    return bool(joint.part_of) and joint.kind in ("prismatic", "planar")


def skeleton(record: Record) -> tuple[Skeleton | None, str]:
    """The robot of a record, or why it cannot be drawn."""
    scene, lacking = placed(record)
    return (None, f"posture not drawn: {lacking}") if scene is None else (Skeleton(record, scene), "")


@dataclass(frozen=True)
class SidePlane:
    """A vertical plane through ``origin``, where ``where`` is, along the horizontal unit vector ``direction``."""

    origin: Array
    direction: Array
    where: str = "the base"

    def project(self, points: Array) -> Array:
        """(…, 3) world → (…, 2): along the plane and z [m]."""
        return np.stack([(points - self.origin) @ self.direction, points[..., 2]], axis=-1)

    def world(self, along: Array, z: Array) -> Array:
        """Points in the plane, (…, 3) [m]."""
        points = self.origin * np.array([1.0, 1.0, 0.0]) + along[..., None] * self.direction
        points[..., 2] = z
        return points

    @property
    def label(self) -> str:
        """Label of the plane's horizontal axis."""
        # Rounded first, and without the sign of a zero.
        azimuth = round(float(np.degrees(np.arctan2(self.direction[1], self.direction[0])))) + 0
        return f"distance from {self.where}, azimuth {azimuth}° [m]"


def side_plane(record: Record, drawn: Sequence[Array]) -> SidePlane:
    """The vertical plane that the arm spans: from the base in the horizontal direction of its greatest extent."""
    points = drawn[0].reshape(-1, 3) if drawn else record["hand_position"]
    origin = points[0]
    where = "the arm's first place" if record.scene is not None and record.scene.base else "the base"
    spread = (points - origin)[:, :2]
    spread = spread[np.isfinite(spread).all(axis=1)]
    if not len(spread) or np.abs(spread).max() < NOTHING:
        # It stands upright at first; where does it go from there?
        spread = np.concatenate([segments.reshape(-1, 3) for segments in drawn] or [points])[:, :2] - origin[:2]
    if np.abs(spread).max(initial=0.0) < NOTHING:
        return SidePlane(origin, np.array([1.0, 0.0, 0.0]), where)
    first = np.linalg.svd(spread, full_matrices=False)[2][0]
    if (spread @ first).sum() < 0.0:
        first = -first
    return SidePlane(origin, np.array([*first, 0.0]), where)


@dataclass(frozen=True)
class Label:
    """Text at a contact at ``place`` (x, z) [m] of the side plane, on a ``side`` of it, ``level`` labels away."""

    text: str
    place: Array
    side: tuple[int, int]
    level: int

    @property
    def half(self) -> Array:
        """Half of its width and height [point]."""
        return 0.5 * np.array([LABEL_SIZE * 0.65 * max(map(len, self.text.splitlines())), LABEL_HEIGHT])

    @property
    def offset(self) -> Array:
        """From the contact to its middle [point]."""
        half = float(self.half @ np.abs(self.side))
        return np.array(self.side) * (NEAR_CONTACT + (2 * self.level + 1) * half)

    def middle(self, scale: float) -> Array:
        """Where it is in the side plane at a scale [point/m]."""
        return scale * self.place + self.offset

    def overprints(self, other: Label, scale: float) -> bool:
        """Whether both would be written over each other."""
        apart = np.abs(self.middle(scale) - other.middle(scale))
        return bool((apart < self.half + other.half + [2.0, 0.0]).all())


def contact_labels(body: Skeleton | None, plane: SidePlane, scale: float) -> list[Label]:
    """Names and forces of the contacts, on the far side of the surface, where there is no arm.

    Labels that would overprint each other at ``scale`` [point/m] are moved away from the surface.
    """
    labels: list[Label] = []
    points = [(*contact, plane.project(contact[2])) for contact in ([] if body is None else body.contacts())]
    for contact, surface, position, force, at in sorted(points, key=lambda entry: float(entry[4][0])):
        along, up = plane.project(plane.origin + surface.gradient(position)) - plane.project(plane.origin)
        steep = abs(along) > abs(up)
        side = (-1 if along > 0.0 else 1, 0) if steep else (0, 1 if up < 0.0 else -1)
        text = contact.name if np.isnan(force) else f"{contact.name}\n{style.number(force, 3)} N"
        label = Label(text, at, side, 0)
        while any(label.overprints(other, scale) for other in labels):
            label = replace(label, level=label.level + 1)
        labels.append(label)
    return labels


def with_labels(extent: tuple[Array, Array], labels: Sequence[Label], scale: float) -> tuple[Array, Array]:
    """The extent with room for the labels."""
    low, high = extent
    for label in labels:
        middle, room = label.middle(scale) / scale, (label.half + 3.0) / scale
        low, high = np.minimum(low, middle - room), np.maximum(high, middle + room)
    return low, high


def bounds(records: Sequence[Record], drawn: Sequence[Array]) -> tuple[Array, Array]:
    """Corners of the box that a 3D view shows [m]."""
    low, high = box_about(_clouds(records, drawn))
    # A flat picture still needs some depth to stand in.
    extra = np.maximum(0.15 * float((high - low).max() or 1.0) - 0.5 * (high - low), 0.0)
    return low - extra, high + extra


def extent_of(plane: SidePlane, drawn: Sequence[Array], records: Sequence[Record]) -> tuple[Array, Array]:
    """Corners of what a side view shows [m]."""
    low, high = box_about([plane.project(points) for points in _clouds(records, drawn)])
    span = float((high - low).max() or 1.0)
    # An upright arm would leave no width for the axis.
    extra = np.maximum(np.array([0.3, 0.05]) * span - 0.5 * (high - low), 0.0) + 0.05 * span
    return low - extra, high + extra


def _clouds(records: Sequence[Record], drawn: Sequence[Array]) -> list[Array]:
    """Everything that must be in the picture, (…, 3) each."""
    targets = [target for record in records if (target := hand_target(record)) is not None]
    return [*(record["hand_position"] for record in records), *targets, *drawn]

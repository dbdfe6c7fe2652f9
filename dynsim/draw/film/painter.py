"""Frames of one robot: background drawn once, and solids with a depth buffer; drawing tools and camera.

Frames are painted at ``FINER`` times their size and then reduced, which smooths all edges: faces with
:func:`dynsim.draw.film.raster.fill`, everything else with Pillow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from dynsim.draw.figures.style import BLACK, BLUE, DEEP, GREEN, GREY, ORANGE, PULLING, SKY
from dynsim.draw.film.raster import fill
from dynsim.draw.geometry.meshes import Meshes, simplified
from dynsim.draw.geometry.projection import Projection
from dynsim.draw.geometry.robot import (
    DrawnContact,
    DrawnRobot,
    Penetration,
    contacts,
    gripping,
    largest_force,
    paths,
    penetrations,
)
from dynsim.draw.geometry.shapes import (
    body_shapes,
    cop_of,
    drawn_shapes,
    floor_level,
    gripper,
    outline,
    solid,
    supports,
    surface_solid,
    wheel_groups,
)
from dynsim.record.measures import GRIPPER_STATES
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.quaternion import rotated
from dynsim.record.scene import HERE, WORLD

# Drawing tools, in pixels.
Box = tuple[float, float, float, float]


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return the font that is shipped with matplotlib, so that films look the same everywhere."""
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), size)


def line(draw: ImageDraw.ImageDraw, points: Array, colour: tuple[int, ...], width: int) -> None:
    """Draw a path through points, (n, 2) [pixel]."""
    if len(points) > 1:
        draw.line(points.ravel().tolist(), fill=colour, width=width, joint="curve")


def dashes(draw: ImageDraw.ImageDraw, points: Array, length: float, colour: str, width: int) -> None:
    """Draw a dashed path; dashes and gaps have the same length [pixel]."""
    if len(points) < 2:
        return
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    for start in np.arange(0.0, distance[-1], 2.0 * length):
        ends = np.linspace(start, min(start + length, distance[-1]), 5)
        dash = np.stack([np.interp(ends, distance, points[:, k]) for k in (0, 1)], axis=1)
        draw.line(dash.ravel().tolist(), fill=colour, width=width)


def arrow(draw: ImageDraw.ImageDraw, tail: Array, head: Array, colour: str, width: int) -> None:
    """Draw an arrow with a filled head from tail to head [pixel]."""
    along = head - tail
    size = float(np.linalg.norm(along))
    if size < 1e-6:
        return
    along = along / size
    across = np.array([-along[1], along[0]])
    long = min(3.4 * width, size)
    neck = head - long * along
    draw.line([*tail.tolist(), *neck.tolist()], fill=colour, width=width)
    corners: Sequence[Array] = (head, neck + 0.45 * long * across, neck - 0.45 * long * across)
    draw.polygon([tuple(corner.tolist()) for corner in corners], fill=colour)


def ring(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: str, width: int) -> None:
    """Draw a circle with a dot at its centre [pixel]."""
    draw.circle((x, y), radius, outline=colour, width=width)
    draw.circle((x, y), 2, fill=colour)


def labels(
    draw: ImageDraw.ImageDraw,
    texts: Sequence[tuple[str, Array, str]],
    face: ImageFont.FreeTypeFont,
    size: tuple[int, int],
    paper: str,
) -> list[Box]:
    """Draw texts with outlines above their anchors, inside the image and without overlap.

    Parameters
    ----------
    draw : ImageDraw
        Target of the drawing.
    texts : sequence of tuple
        Text, centre of its lower edge, (2,) [pixel], and colour.
    face : FreeTypeFont
        Font.
    size : tuple of int
        Size of the image [pixel].
    paper : str
        Colour of the outlines.

    Returns
    -------
    list of tuple of float
        Positions of the labels: left, top, right, bottom [pixel].
    """
    edge = 0.2 * face.size
    boxes: list[Box] = []
    for text, anchor, colour in texts:
        width, height = draw.textlength(text, font=face) + 2.0 * edge, 1.1 * face.size
        x = min(max(float(anchor[0]) - 0.5 * width, 0.0), size[0] - width)
        y = min(max(float(anchor[1]) - height, 0.0), size[1] - height)
        for _ in texts:
            # Move the label above the labels that it would hide.
            hidden = [box for box in boxes if x < box[2] and box[0] < x + width and y < box[3] and box[1] < y + height]
            if not hidden:
                break
            y = min(box[1] for box in hidden) - height
        boxes.append((x, y, x + width, y + height))
        middle = x + 0.5 * width, y + 0.5 * height
        draw.text(middle, text, fill=colour, font=face, anchor="mm", stroke_width=round(edge), stroke_fill=paper)
    return boxes


# Camera: parallel projection, so that the scale does not depend on the distance.
@dataclass(frozen=True)
class Camera(Projection):
    """Parallel projection p = scale · (right, −up) · (r − origin) + middle.

    Attributes
    ----------
    origin : (3,) ndarray
        Point r shown in the middle [m].
    axes : (3, 3) ndarray
        Unit vectors in the world: right, up and towards the viewer.
    scale : float
        Scale [pixel/m].
    middle : (2,) ndarray
        Middle of the image [pixel]; y is down.
    """

    scale: float
    middle: Array

    @classmethod
    def fitted(cls, axes: Array, low: Array, high: Array, area: tuple[float, float, float, float]) -> Camera:
        """Create a camera that fits a box into an area (left, top, right, bottom) [pixel].

        ``low`` and ``high`` are the corners of the box along ``axes`` [m].
        """
        left, top, right, bottom = area
        size = np.maximum(high - low, 1e-9)
        scale = float(min((right - left) / size[0], (bottom - top) / size[1]))
        middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
        return cls(0.5 * (low + high) @ axes, axes, scale, middle)

    def project(self, points: Array) -> Array:
        """Project world points, (…, 3) [m], to x and y [pixel] and the coordinate towards the viewer [m], (…, 3)."""
        seen = super().project(points)
        seen[..., :2] = self.middle + seen[..., :2] * np.array([self.scale, -self.scale])
        return seen


Array = NDArray[np.float64]
FINER = 2
# Maximum number of triangles of all meshes; the image of a robot is about 500 pixels wide.
TRIANGLES = 20_000
PAPER, GROUND, LINES, FAINT, SURFACE = "#FFFFFF", "#F1F3F5", "#D3D8DE", "#ECEEF1", "#DCE3EB"
BODY, HUB, WHEEL, SUPPORT = "#AEB7C4", "#4A5260", "#3A4048", "#D5EAF8"
FRICTION = "#7A3E9D"
# Friction forces below this fraction of the largest normal force are drawn without an arrow.
MIN_FRICTION_SHARE = 1e-3
MODES = {0: GREY, 1: ORANGE, 2: GREEN}
# Direction to the light in view coordinates: right, up, towards the viewer.
LIGHT = np.array([-0.35, 0.75, 0.56]) / np.linalg.norm([-0.35, 0.75, 0.56])
# Distance by which planes that would hide the robot are moved away from the viewer [m].
BEHIND = 1e6
# Image height below which a smaller font is used [pixel].
SMALL_HEIGHT = 200
# Number of contact points whose forces are written (the largest by rms); all have arrows.
LABELLED = 5
# Forces below this fraction of the largest force are rounding errors.
ROUNDING = 1e-9
# Maximum number of points of a path.
PATH_POINTS = 600


def largest(values: Array, count: int) -> list[int]:
    """Return the indices of the ``count`` columns of values, (T, n), with the largest rms over time, in order."""
    effort = np.nan_to_num(values.astype(float) ** 2).sum(axis=0)
    return sorted(np.argsort(-effort, kind="stable")[:count].tolist())


@dataclass(frozen=True)
class _Solids:
    """Faces of all moving solids: corners in body frames, faces with four corners, colours.

    ``aside`` contains the displacements of the corners for an open and a closed gripper, (2, n, 3) [m].
    """

    corners: Array
    body: NDArray[np.int64]
    faces: NDArray[np.int64]
    colour: Array
    wheel: NDArray[np.int64]
    aside: Array


Faces = tuple[Array, NDArray[np.uint8]]


def painted(image: Image.Image, faces: Sequence[Faces]) -> Image.Image:
    """Return an image with faces in front of it, each group with its corners and colours; see :func:`fill`."""
    pixels = np.array(image)
    depth = np.full(pixels.shape[:2], -np.inf)
    for corners, colours in faces:
        fill(pixels, depth, corners, colours)
    return Image.fromarray(pixels)


class Painter:
    """Painter of a robot at times of its record.

    Parameters
    ----------
    robot : DrawnRobot
        Robot to paint.
    camera : Camera
        Camera for an image that is ``FINER`` times as large.
    size : tuple of int
        Width and height of the image [pixel].
    bounds : tuple of ndarray
        Box in which everything moves [m].
    tint : str, optional
        Colour of the hand path.
    title : str, optional
        Title in the image, if there are several robots; the hubs then have the colour ``tint``.
    """

    def __init__(
        self,
        robot: DrawnRobot,
        camera: Camera,
        size: tuple[int, int],
        bounds: tuple[Array, Array],
        *,
        tint: str = BLUE,
        title: str = "",
    ) -> None:
        self.robot, self.camera, self.size, self.tint, self.title = robot, camera, size, tint, title
        self._hub = tint if title else HUB
        record = robot.record
        self._time = record.time
        self._position = record[POSITION].astype(np.float64)
        self._turn = record[ORIENTATION].astype(np.float64)
        meshes = Meshes()
        meshes.of_robot(record.scene)
        shapes = body_shapes(robot.scene, robot.reach, meshes)
        fixed = drawn_shapes(robot.scene.fixed, meshes)
        self._meshes = simplified(meshes.unique, TRIANGLES)
        self._wheels = wheel_groups(record, robot.scene)
        # Find the body that carries the gripper.
        hand = robot.scene.hand
        self._grip = gripping(record)
        self._gripped = hand.body if hand is not None and self._grip is not None else WORLD
        self._solids = self._moving(shapes)
        self._contacts = contacts(robot)
        self._sunk = penetrations(record, robot.scene)
        self._full = largest_force(self._contacts)
        # A reaction has the same force as its action, which is labelled.
        own = [k for k, contact in enumerate(self._contacts) if contact.point.body != contact.point.carrier]
        forces = np.stack([np.zeros(len(record)), *(self._contacts[k].force for k in own)], axis=1)
        self._labelled = {own[k - 1] for k in largest(forces, LABELLED) if k}
        self._paths = dict(paths(record, robot.scene))
        self._supports = supports(robot.scene, self._wheels)
        self._pressure = cop_of(record)
        # Use smaller text in the smaller images of several robots.
        self._font = font((13 if size[1] >= SMALL_HEIGHT else 11) * FINER)
        self.labels: list[Box] = []
        self._floors = [level for surface in robot.scene.surfaces if (level := floor_level(surface)) is not None]
        self._ground = self._background(*bounds)
        self._static = self._fixed_faces(fixed, *bounds)

    def frame(self, time: float) -> Image.Image:
        """Return the image of the robot at a time [s], with linear interpolation between samples."""
        position, turn, row, share = self._pose(time)
        image, faces = self._ground.copy(), list(self._static)
        if known := bool(np.isfinite(position).all() and np.isfinite(turn).all()):
            hull = self._support(position, turn, row)
            if len(hull) > 2:
                corners = self.camera.project(np.column_stack([hull, np.zeros(len(hull))]))[:, :2]
                polygon = [tuple(corner) for corner in corners.tolist()]
                ImageDraw.Draw(image).polygon(polygon, fill=SUPPORT, outline=SKY)
            faces.append(self._body_faces(position, turn, row))
        image = painted(image, faces)
        if known:
            draw = ImageDraw.Draw(image)
            self._paint_pressure(draw, hull, row)
            self._paint_path(draw, time, row)
            for point in self._sunk:
                self._paint_sunk(draw, point, position, turn, row, share)
            forces = [self._paint_contact(draw, contact, position, turn, row, share) for contact in self._contacts]
            forces = [force for k, force in enumerate(forces) if k in self._labelled]
            self._paint_hand(draw, position, turn)
            # Paint texts last, so that they are on top.
            self._paint_grip_state(draw, row)
            self.labels = labels(draw, [force for force in forces if force], self._font, image.size, PAPER)
        return image.reduce(FINER)

    def _pose(self, time: float) -> tuple[Array, Array, int, float]:
        """Return the positions and orientations of all bodies at a time, the last sample and the fraction after it."""
        row, share = 0, 0.0
        if len(self._time) > 1:
            row = int(np.clip(np.searchsorted(self._time, time, side="right") - 1, 0, len(self._time) - 2))
            share = (time - self._time[row]) / max(self._time[row + 1] - self._time[row], 1e-12)
            share = float(np.clip(share, 0.0, 1.0))
        position, turn = (_between(values, row, share) for values in (self._position, self._turn))
        return position, turn / np.linalg.norm(turn, axis=1)[:, None], row, share

    def _moving(self, shapes: list[list[dict[str, Any]]]) -> _Solids:
        wheels = {shape_index: k for k, places in enumerate(self._wheels.places) for shape_index in places}
        parts = []
        for k, own in enumerate(shapes):
            for j, shape in enumerate(own):
                wheel = wheels.get((k, j), -1)
                role = "wheel" if wheel >= 0 else shape.get("role", "")
                plain = {"wheel": WHEEL, "pad": WHEEL, "hub": self._hub}.get(role, BODY)
                parts.append((k, shape, plain, wheel, np.zeros((2, 3))))
        parts += [(self._gripped, shape, self.tint, -1, moved) for shape, moved in self._fingers(shapes)]
        solids = [solid(shape, self._meshes) for _, shape, *_ in parts]
        points, cells = ([len(pair[k]) for pair in solids] for k in (0, 1))
        starts = np.cumsum([0, *points])
        colours = [
            self._colours(shape, count, plain) for (_, shape, plain, *_), count in zip(parts, cells, strict=True)
        ]
        bodies, paired = ([part[k] for part in parts] for k in (0, 3))
        return _Solids(
            np.concatenate([np.zeros((0, 3)), *(corners for corners, _ in solids)]),
            np.repeat(np.array(bodies, dtype=np.int64), points),
            np.concatenate([np.zeros((0, 4), int), *(f + n for (_, f), n in zip(solids, starts, strict=False))]),
            np.concatenate([np.zeros((0, 3)), *colours]),
            np.repeat(np.array(paired, dtype=np.int64), cells),
            np.repeat(np.reshape([part[4] for part in parts], (-1, 2, 3)), points, axis=0).swapaxes(0, 1),
        )

    def _fingers(self, shapes: list[list[dict[str, Any]]]) -> list[tuple[dict[str, Any], Array]]:
        """Return the fingers of a gripper halfway between open and closed, and their displacements, (2, 3) [m]."""
        hand = self.robot.scene.hand
        if hand is None or self._gripped == WORLD:
            return []
        both = gripper(shapes, self.robot.scene, self.robot.reach)
        position = np.array(hand.position) + np.array([both["ahead"], 0.0, 0.0])
        shape = {"kind": "box", "size": both["size"], "p": position.tolist(), "q": list(HERE)}
        return [(shape, side * np.outer(both["aside"], [0.0, 1.0, 0.0])) for side in (-1.0, 1.0)]

    def _colours(self, shape: dict[str, Any], faces: int, plain: str) -> Array:
        """Return the colours of a shape's faces, (n, 3): from the shape, its mesh file, or a default colour."""
        colours = np.tile(np.array(_rgb(plain), dtype=float), (faces, 1))
        if "colour" in shape:
            colours[:] = 255.0 * np.array(shape["colour"][:3])
        elif "mesh" in shape and (own := self._meshes[shape["mesh"]].colours) is not None:
            colours = np.where(np.isfinite(own), 255.0 * own, colours)
        return colours

    def _background(self, low: Array, high: Array) -> Image.Image:
        image = Image.new("RGB", (self.size[0] * FINER, self.size[1] * FINER), PAPER)
        draw = ImageDraw.Draw(image)
        for level in self._floors:
            self._paint_floor(draw, low, high, level)
        if not self._floors:
            # A grid helps to judge positions.
            self._paint_floor(draw, low, high, float(low[2]), real=False)
        if (target := self._paths.get("target")) is not None:
            dashes(draw, _finite_path(self.camera.project(target)[:, :2]), 6.0 * FINER, BLACK, FINER)
        if (path := self._paths.get("hand")) is not None:
            faint = tuple(int(0.65 * 255 + 0.35 * part) for part in _rgb(self.tint))
            line(draw, _finite_path(self.camera.project(path)[:, :2]), faint, FINER)
        if self.title:
            draw.text((10 * FINER, 8 * FINER), self.title, fill=self.tint, font=self._font)
        return image

    def _fixed_faces(self, fixed: list[dict[str, Any]], low: Array, high: Array) -> list[Faces]:
        """Return the visible faces of fixed shapes and surfaces.

        Planes that would hide the robot are moved behind it.
        """
        groups = []
        for shape in fixed:
            corners, faces = solid(shape, self._meshes)
            groups.append(self._faces(corners, faces, self._colours(shape, len(faces), HUB)))
        for surface in self.robot.scene.surfaces:
            if floor_level(surface) is not None:
                continue
            shown, colours = self._faces(*surface_solid(surface, low, high), np.array(_rgb(SURFACE), dtype=float))
            if surface.kind == "plane" and np.array(surface.direction) @ self.camera.axes[2] < -1e-9:
                shown[..., 2] -= BEHIND
            groups.append((shown, colours))
        return groups

    def _paint_floor(self, draw: ImageDraw.ImageDraw, low: Array, high: Array, z: float, *, real: bool = True) -> None:
        """Paint a horizontal plane with a grid (in side view: the area below), or only the grid if not ``real``."""
        width, height = (side * FINER for side in self.size)
        up = float(self.camera.axes[2][2])
        level = float(self.camera.project(np.array([*(0.5 * (low + high))[:2], z]))[1])
        if up < 1e-6 and not real:
            return
        if up < 1e-6:
            draw.rectangle([0, level, width, height], fill=GROUND)
            draw.line([0, level, width, level], fill=GREY, width=FINER)
            return
        # The visible part is the corners of the image, projected along the line of sight.
        seen = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        flat = (seen - self.camera.middle) * np.array([1.0, -1.0]) / self.camera.scale
        points = self.camera.origin + flat @ self.camera.axes[:2]
        points += ((z - points[:, 2]) / up)[:, None] * self.camera.axes[2]
        ticks = MaxNLocator(10, steps=[1, 2, 5, 10]).tick_values(0.0, float(np.linalg.norm(high - low)))
        step = ticks[1] - ticks[0]
        (x0, y0), (x1, y1) = np.floor(points[:, :2].min(axis=0) / step), np.ceil(points[:, :2].max(axis=0) / step)
        x, y = step * np.arange(x0, x1 + 1), step * np.arange(y0, y1 + 1)
        if real:
            draw.rectangle([0, 0, width, height], fill=GROUND)
        ends = [([a, y[0], z], [a, y[-1], z]) for a in x] + [([x[0], b, z], [x[-1], b, z]) for b in y]
        for row in self.camera.project(np.array(ends))[..., :2]:
            draw.line(row.ravel().tolist(), fill=LINES if real else FAINT, width=FINER)

    def _body_faces(self, position: Array, turn: Array, row: int) -> Faces:
        """Return the visible faces of all moving solids."""
        solids = self._solids
        own = solids.corners
        if self._gripped != WORLD:
            assert self._grip is not None
            own = own + solids.aside[int(self._grip[row] > 0)]
        corners = position[solids.body] + rotated(turn[solids.body].T, own.T).T
        colour = solids.colour
        if self._wheels.down is not None:
            lifted = (solids.wheel >= 0) & (self._wheels.down[row][solids.wheel] == 0.0)
            standing = (solids.wheel >= 0) & ~lifted
            colour = np.where(lifted[:, None], np.array(_rgb("#F4F6F8")), colour)
            colour = np.where(standing[:, None], np.array(_rgb(BLUE)), colour)
        return self._faces(corners, solids.faces, colour)

    def _faces(self, corners: Array, faces: NDArray[np.int64], colour: Array) -> Faces:
        """Return the faces that face the viewer, projected, and their colours, lit from the upper left."""
        shown = self.camera.project(corners)[faces]
        # Compute area and direction from the diagonals; this also works for a triangle that repeats a corner.
        a, b = shown[:, 2] - shown[:, 0], shown[:, 3] - shown[:, 1]
        scale = np.array([1.0, -1.0, self.camera.scale])
        normal = np.cross(a * scale, b * scale)
        size = np.linalg.norm(normal, axis=1)
        kept = (size > 1e-12) & (normal[:, 2] > 0.0)
        light = 0.58 + 0.42 * np.clip(normal[kept] / size[kept, None] @ LIGHT, 0.0, 1.0)
        shades = np.broadcast_to(colour, (len(faces), 3))[kept] * light[:, None]
        return shown[kept], np.minimum(shades, 255.0).astype(np.uint8)

    def _support(self, position: Array, turn: Array, row: int) -> Array:
        """Return the corners of the support polygon, (n, 2) [m], counterclockwise."""
        down = self._wheels.down
        on = [
            support
            for support in self._supports
            if support["group"] < 0 or down is None or down[row][support["group"]] > 0.0
        ]
        points = [_on(s["body"], np.array(s["p"]), position, turn)[:2] for s in on]
        return outline(np.array(points)) if points else np.zeros((0, 2))

    def _paint_pressure(self, draw: ImageDraw.ImageDraw, hull: Array, row: int) -> None:
        """Paint a ring at the centre of pressure or mass, in orange if it is outside the support polygon."""
        if self._pressure is None or not np.isfinite(self._pressure[1][row]).all():
            return
        at = self._pressure[1][row]
        inside = len(hull) > 2 and Outline(hull).contains_point(at)
        x, y, _ = self.camera.project(np.array([*at, 0.0]))
        ring(draw, x, y, 5.0 * FINER, BLACK if inside else PULLING, 2 * FINER)

    def _paint_path(self, draw: ImageDraw.ImageDraw, time: float, row: int) -> None:
        path = self._paths.get("hand")
        if path is None or row < 1:
            return
        line(draw, _finite_path(self.camera.project(path[: row + 1])[:, :2]), _rgb(self.tint), 2 * FINER)

    def _paint_contact(
        self, draw: ImageDraw.ImageDraw, contact: DrawnContact, position: Array, turn: Array, row: int, share: float
    ) -> tuple[str, Array, str] | None:
        """Paint arrows of the normal and total force: away from the surface if it pushes, towards it if it pulls.

        Returns the text that states the force, its position [pixel] and colour, or None without a force.
        """
        if contact.at is None:
            at = _on(contact.point.body, np.array(contact.point.position), position, turn)
        else:
            at = _between(contact.at, row, share)
        force = float(_between(contact.force, row, share))
        mode, text = None if contact.mode is None else int(contact.mode[row]), None
        x, y, _ = self.camera.project(at)
        colour = PULLING if force < 0.0 else BLUE
        dot = colour if mode is None else MODES.get(mode, GREY)
        if np.isfinite(force) and abs(force) > ROUNDING * self._full and mode != 0:
            normal = force * contact.normal[row]
            friction = None if contact.tangent is None else _between(contact.tangent, row, share)
            if friction is not None and np.linalg.norm(friction) > MIN_FRICTION_SHARE * self._full:
                self._paint_force(draw, at, normal + friction, force < 0.0, FRICTION, 2 * FINER)
            end = self._paint_force(draw, at, normal, force < 0.0, colour, 3 * FINER)
            text = f"{force:+.3g} N".replace("-", "−"), end - [0.0, 2.0 * FINER], colour
        draw.circle((x, y), 3.0 * FINER, fill=dot, outline=PAPER)
        return text

    def _paint_sunk(
        self, draw: ImageDraw.ImageDraw, point: Penetration, position: Array, turn: Array, row: int, share: float
    ) -> None:
        """Paint a ring around a joint that is below a surface, with its depth."""
        depth = float(_between(point.depth, row, share))
        if not depth > point.least:
            return
        x, y, _ = self.camera.project(_on(point.body, np.array(point.position), position, turn))
        ring(draw, x, y, 6.0 * FINER, DEEP, 2 * FINER)
        text = f"{1e3 * depth:.0f} mm" if depth >= 1e-3 else ""
        draw.text((x, y + 8 * FINER), text, fill=DEEP, font=font(11 * FINER), anchor="mt")

    def _paint_force(
        self, draw: ImageDraw.ImageDraw, at: Array, force: Array, pulls: bool, colour: str, width: int
    ) -> Array:
        """Paint the arrow of a force [N] at a contact, on the free side; return the far end of the arrow [pixel]."""
        size = float(np.linalg.norm(force))
        long = max(0.13 * self.robot.reach * min((size / self._full) ** 0.5, 1.6), 14.0 * FINER / self.camera.scale)
        here = self.camera.project(at)[:2]
        there = self.camera.project(at + (-long if pulls else long) / size * force)[:2]
        arrow(draw, *((there, here) if pulls else (here, there)), colour, width)
        return np.asarray(there)

    def _paint_grip_state(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        """Write the state of a gripper below the title, if the record contains it."""
        if "gripper_state" in self.robot.record:
            text = f"gripper: {GRIPPER_STATES[int(self.robot.record['gripper_state'][row])]}"
            draw.text((10 * FINER, (24 if self.title else 8) * FINER), text, fill=HUB, font=self._font)

    def _paint_hand(self, draw: ImageDraw.ImageDraw, position: Array, turn: Array) -> None:
        hand = self.robot.scene.hand
        if hand is None or self._gripped != WORLD:
            return
        x, y, _ = self.camera.project(_on(hand.body, np.array(hand.position), position, turn))
        draw.circle((x, y), 4.0 * FINER, fill=self.tint, outline=PAPER, width=FINER)


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = ImageColor.getrgb(colour)[:3]
    return red, green, blue


def _between(values: Array, row: int, share: float) -> Array:
    if share == 0.0:
        return np.asarray(values[row])
    return np.asarray(values[row] + share * (values[row + 1] - values[row]))


def _on(body: int, point: Array, position: Array, turn: Array) -> Array:
    """Return the world position of a point on a body, (3,) [m]."""
    return point if body == WORLD else np.asarray(position[body] + rotated(turn[body], point))


def _finite_path(points: Array) -> Array:
    """Return the finite points of a path, thinned to at most ``PATH_POINTS``."""
    points = points[np.isfinite(points).all(axis=1)]
    return points[np.linspace(0, len(points) - 1, min(len(points), PATH_POINTS)).astype(int)] if len(points) else points

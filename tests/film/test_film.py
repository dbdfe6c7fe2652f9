"""Films: number of frames, size, length, and positions of what they show."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor, ImageDraw
from support.meshed_robot import meshed_robot
from support.messages import mentions, raises

import dynsim
from dynsim import cli
from dynsim.cli import commands
from dynsim.cli.records import record_files
from dynsim.draw.figures.style import BLUE, DEEP, PULLING
from dynsim.draw.film import Film, write
from dynsim.draw.film.film import Strip
from dynsim.draw.film.painter import FINER, FRICTION, Painter, font, labels, largest, painted
from dynsim.draw.geometry.meshes import Meshes
from dynsim.draw.geometry.projection import view_axes
from dynsim.draw.geometry.robot import bounds
from dynsim.draw.geometry.shapes import body_shapes, from_z, solid
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.record.poses import ORIENTATION, POSITION, point_positions
from dynsim.record.quaternion import rotated
from dynsim.record.scene import SceneSurface
from dynsim.scenario import build_model, load_scenario
from dynsim.system import interruption

MARK = "#FF00FF"


def hand_mark(painter, time):
    """Position of the hand in the image [pixel], from the poses between samples."""
    position, turn, _, _ = painter._pose(time)
    hand = painter.robot.scene.hand
    return painter.camera.project(position[hand.body] + rotated(turn[hand.body], np.array(hand.position)))[:2] / FINER


def empty(painter: Painter) -> Image.Image:
    """The picture without anything that moves, not reduced."""
    return painted(painter._ground, painter._static)


def short(name: str | Path, variant: str | None = None, **options: object) -> Record:
    return dynsim.simulate(load_scenario(name, variant, {"duration_s": 1.0, "metrics.settle_s": 0.2, **options}))


@pytest.fixture(scope="module")
def braced() -> Record:
    return short("elbow_comparison", "two_elbows")


@pytest.fixture(scope="module")
def robots(braced: Record, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Record]:
    mesh = dynsim.simulate(load_scenario(meshed_robot(tmp_path_factory.mktemp("robot"))))
    return {"arm": braced, "mobile": short("mobile_path"), "snake": short("snake_circle"), "urdf": mesh}


def decoded(path: Path) -> tuple[int, tuple[int, int], float]:
    """Frames, size, and duration [s] of a film."""
    if path.suffix == ".gif":
        with Image.open(path) as film:
            times = []
            for k in range(film.n_frames):
                film.seek(k)
                times.append(film.info["duration"])
            return film.n_frames, film.size, sum(times) / 1e3
    av = pytest.importorskip("av")
    with av.open(str(path)) as film:
        (track,) = film.streams.video
        frames = list(film.decode(track))
        return len(frames), frames[0].to_image().size, float(track.duration * track.time_base)


def test_a_gif_has_its_frames_size_and_duration(braced: Record, tmp_path: Path) -> None:
    """30 a second is no whole number of hundredths: none is lost over the film."""
    path = write({"one": braced}, tmp_path / "film.gif", size=(320, 240), fps=30, hold=0.5)
    assert decoded(path) == (31, (320, 240), pytest.approx(31 / 30 + 0.5, abs=0.0101))


def test_a_gif_keeps_the_colours_of_small_marks(braced: Record, tmp_path: Path) -> None:
    path = write({"one": braced}, tmp_path / "film.gif", size=(480, 320), fps=5, view="side")
    with Image.open(path) as film:
        film.seek(4)
        shown = {tuple(colour) for colour in np.asarray(film.convert("RGB")).reshape(-1, 3).tolist()}
    assert {ImageColor.getrgb(BLUE), ImageColor.getrgb(PULLING), (255, 255, 255)} <= shown


def test_an_mp4_has_its_frames_size_and_duration(braced: Record, tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = write({"one": braced}, tmp_path / "film.mp4", size=(320, 240), fps=20, speed=0.5, hold=1.0)
    # 1 s at half the speed: 40 steps, the last frame, and that one for another second.
    assert decoded(path) == (61, (320, 240), pytest.approx(61 / 20, abs=1e-3))


def test_the_last_frame_is_the_last_sample(braced: Record) -> None:
    film = Film({"one": braced}, fps=7, size=(320, 240))
    assert film.times[-1] == braced.time[-1]
    assert len(film.times) == 8
    np.testing.assert_allclose(np.diff(film.times)[:-1], 1 / 7, atol=1e-12)


def pixels(image: Image.Image, colour: str) -> np.ndarray:
    """Places of the pixels of a colour, (n, 2) as x, y; those that edges mixed with others are left out."""
    near = np.abs(np.asarray(image).astype(int) - ImageColor.getrgb(colour)).max(axis=2) < 40
    return np.argwhere(near)[:, ::-1]


@pytest.mark.parametrize("view", ["side", "top", "iso"])
def test_the_hand_is_where_the_model_has_it(braced: Record, view: str) -> None:
    """The mark's middle, to 2 pixels, at random instants between samples; positions are those of the kernels."""
    film = Film({"one": braced}, view=view, plot="", size=(640, 480))
    known = film.painters["one"]
    painter = Painter(known.robot, known.camera, known.size, (np.zeros(3), np.ones(3)), tint=MARK)
    painter._paths.clear()
    model = build_model(load_scenario("elbow_comparison", "two_elbows"))
    camera, hand = painter.camera, braced.scene.hand
    # The projection in words: along the axes of the view, y down.
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    for instant in np.random.default_rng(4).uniform(0.0, 1.0, 8):
        q = np.array([np.interp(instant, braced.time, column) for column in braced["q"].T])
        where = model.point_position(braced.scene.bodies[hand.body].name, hand.position, q)
        right, up = camera.axes[:2] @ (where - camera.origin)
        expected = (camera.middle + camera.scale * np.array([right, -up])) / FINER
        marks = pixels(painter.frame(float(instant)), MARK)
        assert len(marks) > 15
        np.testing.assert_allclose(marks.mean(axis=0), expected, atol=2.0)
        assert hand_mark(painter, float(instant)) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("view", ["side", "top", "iso"])
@pytest.mark.parametrize(("curved", "size"), [((1, 0, 1), 0.1), ((1, 1, 1), 0.1), ((1, 0, 1), -0.3)])
def test_round_surfaces_are_whole(braced: Record, view: str, curved: tuple[int, ...], size: float) -> None:
    """Every point of a pipe, a sphere and a tunnel that the picture shows is painted."""
    known = Film({"one": braced}, view=view, plot="", size=(640, 480)).painters["one"]
    low, high = bounds([known.robot])
    radius = size * float((high - low).max())
    centre = 0.5 * (low + high) - [0.0, 0.0, max(radius, 0.0)]
    Q = np.sign(size) * np.diag(curved).astype(float)
    surface = SceneSurface.of_quadric("round", Q, -Q @ centre, 0.5 * (centre @ Q @ centre - np.sign(size) * radius**2))
    assert surface.radius == pytest.approx(radius)
    robot = replace(known.robot, scene=replace(known.robot.scene, surfaces=(surface,)))
    shown = np.asarray(empty(Painter(robot, known.camera, known.size, (low, high)))).astype(int)
    rng = np.random.default_rng(3)
    away = rng.normal(size=(4000, 3)) * np.array(curved)
    points = centre + 0.98 * abs(radius) * away / np.linalg.norm(away, axis=1)[:, None]
    if not curved[1]:
        points[:, 1] = rng.uniform(low[1], high[1], len(points))
    x, y = np.round(known.camera.project(points)[:, :2]).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < shown.shape[1]) & (y < shown.shape[0])
    assert inside.sum() > 500
    assert (np.abs(shown[y[inside], x[inside]] - 255).max(axis=1) > 20).all()


def test_a_pixel_shows_the_nearest_face() -> None:
    """Random quadrilaterals, some far outside the image, against the depths of all planes at each pixel."""
    rng = np.random.default_rng(7)
    corners = rng.uniform(-10.0, 50.0, (40, 4, 3))
    corners[::20] = corners[::20] * [1e4, 1e4, 1.0] - [0.0, 0.0, 50.0]
    # The fourth corner is in the plane of the others.
    corners[:, 3] = corners[:, 0] + rng.uniform(0.2, 1.0, (40, 1)) * (corners[:, 2] - corners[:, 1])
    colours = rng.integers(1, 255, (40, 3)).astype(np.uint8)
    shown = np.asarray(
        painted(Image.new("RGB", (40, 30)), [(corners[:25], colours[:25]), (corners[25:], colours[25:])])
    )
    best, expected = np.full((30, 40), -np.inf), np.zeros((30, 40, 3), dtype=np.uint8)
    y, x = np.mgrid[:30, :40]
    for face, colour in zip(corners, colours, strict=True):
        for a, b, c in (face[[0, 1, 2]], face[[0, 2, 3]]):
            inverse = np.linalg.inv(np.stack([b - a, c - a], axis=1)[:2])
            v, w = np.einsum("ij,jyx->iyx", inverse, np.stack([x - a[0], y - a[1]]))
            z = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])
            nearer = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (z > best)
            best[nearer], expected[nearer] = z[nearer], colour
    assert len(np.unique(expected.reshape(-1, 3), axis=0)) > 10
    np.testing.assert_array_equal(shown, expected)


def box(centre: np.ndarray, edges: tuple[float, float, float]) -> SceneSurface:
    zero = ((0.0, 0.0, 0.0),) * 3
    return SceneSurface(
        "table", zero, zero[0], 0.0, "box", tuple(centre), radius=0.0, orientation=(1.0, 0.0, 0.0, 0.0), edges=edges
    )


@pytest.mark.parametrize("view", ["side", "iso"])
def test_a_box_hides_the_robot_behind_it_only(braced: Record, view: str) -> None:
    """A box nearer to the viewer covers the last link, a box behind it does not; its visible faces are whole."""
    for side in (-1.0, 1.0):
        record = replace_surfaces(braced, ())
        known = Film({"one": record}, view=view, plot="", size=(640, 480)).painters["one"]
        near = known.camera.axes[2]
        link = braced[POSITION][0, -1].astype(float)
        surface = box(link + side * 0.4 * near, (0.2, 0.2, 0.2))
        film = Film({"one": replace_surfaces(braced, (surface,))}, view=view, plot="", size=(640, 480))
        painter = film.painters["one"]
        # The whole box is in the picture.
        half = 0.1 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = painter.camera.project(np.array(surface.position) + half)[:, :2] / FINER
        assert (corners > 0.0).all()
        assert (corners < painter.size).all()
        # Points on the faces that face the viewer are painted in three shades.
        shades = set()
        shown = empty(painter)
        for axis in range(3):
            towards = np.sign(near[axis])
            if abs(near[axis]) > 0.1:
                for a, b in np.random.default_rng(axis).uniform(-0.095, 0.095, (20, 2)):
                    point = np.insert([a, b], axis, 0.1 * towards) + surface.position
                    x, y, _ = painter.camera.project(point)
                    shades.add(shown.getpixel((round(x), round(y))))
        assert len(shades) == int((np.abs(near) > 0.1).sum())
        assert (255, 255, 255) not in shades
        position, turn, row, _ = painter._pose(0.0)
        image = painted(painter._ground, [*painter._static, painter._body_faces(position, turn, row)])
        x, y, _ = painter.camera.project(link)
        assert (image.getpixel((round(x), round(y))) in shades) == (side > 0.0)


def replace_surfaces(record: Record, surfaces: tuple[SceneSurface, ...]) -> Record:
    changed = Record(record.time, provenance=record.provenance)
    for name in (POSITION, ORIENTATION):
        changed.add(name, record[name], record.units[name], labels=record.labels[name])
    changed.scene = replace(record.scene, surfaces=surfaces, points=(record.scene.hand,))
    return changed


def test_a_hub_is_not_covered_by_a_rod_that_leans_to_the_viewer(braced: Record) -> None:
    """A hub about x of radius 1.45 r hides the beginning of a rod of radius r, seen along y, but not the rest of it."""
    painter = Film({"one": braced}, view="side", plot="", size=(640, 480)).painters["one"]
    r, right, near = 0.02, painter.camera.axes[0], painter.camera.axes[2]
    along = np.cos(np.pi / 6) * right + np.sin(np.pi / 6) * near
    hub = {"kind": "cylinder", "size": [1.45 * r, 3.6 * r], "p": [0.0] * 3, "q": from_z(right).tolist()}
    rod = {"kind": "capsule", "size": [r, 20.0 * r], "p": (10.0 * r * along).tolist(), "q": from_z(along).tolist()}
    groups = [painter._faces(*solid(s, []), np.array(c)) for s, c in ((hub, [255.0, 0, 0]), (rod, [0, 0, 255.0]))]
    image = painted(Image.new("RGB", (1280, 960)), groups)
    for depth, hidden in ((-1.0, True), (-0.5, True), (0.1, True), (1.0, False), (3.0, False)):
        x, y, _ = painter.camera.project(depth * r * right)
        red, _, blue = image.getpixel((round(x), round(y)))
        assert (red > blue) == hidden


def test_a_snake_has_fingers_that_close(robots: dict[str, Record]) -> None:
    """Two blocks up to the tip, nearer to each other when closed, and a stem if the link ends before the tip."""
    snake = robots["snake"]
    film = Film({"one": snake}, view="top", plot="", size=(640, 480))
    robot, camera = film.painters["one"].robot, film.painters["one"].camera
    apart = []
    for closed in (0.0, 1.0):
        record = Record(snake.time[:1], provenance=snake.provenance)
        for name in (POSITION, ORIENTATION, "grounded"):
            record.add(name, snake[name][:1], snake.units[name], labels=snake.labels[name])
        record.add("gripper", np.array([closed]), "1")
        record.scene = snake.scene
        painter = Painter(replace(robot, record=record), camera, (640, 480), (np.zeros(3), np.ones(3)), tint=MARK)
        painter._paths.clear()
        solids = painter._solids
        fingers = solids.body == robot.scene.hand.body
        fingers &= np.abs(solids.aside).max(axis=(0, 2)) > 0.0
        assert fingers.sum() == 16
        tips = (solids.corners + solids.aside[int(closed)])[fingers] - robot.scene.hand.position
        apart.append(2.0 * np.abs(tips[:, 1]).min())
        np.testing.assert_allclose(tips[:, 0].max(), snake.scene.tip, atol=1e-12)
        # They are lit: the tint is darkened.
        shown = np.asarray(painter.frame(0.0)).astype(int)
        tinted = np.argwhere((shown[..., 0] - shown[..., 1] > 60) & (shown[..., 2] - shown[..., 1] > 60))[:, ::-1]
        assert len(tinted) > 20
        ahead = hand_mark(painter, 0.0) + np.array([tips[:, 0].mean() * camera.scale / FINER, 0.0])
        np.testing.assert_allclose(tinted.mean(axis=0), ahead, atol=0.02 * camera.scale / FINER)
    assert apart[0] > 2.0 * apart[1] > 0.0
    for ahead, count in ((0.0905, 0), (0.1805, 1)):
        hand = replace(snake.scene.hand, position=(ahead, 0.0, 0.0))
        shapes = body_shapes(replace(snake.scene, points=(hand,), tip=0.0), 1.0, Meshes())
        stems = [shape["p"][0] for own in shapes for shape in own if shape.get("role") == "stem"]
        assert stems == count * [0.5 * ahead]


def test_the_state_of_a_gripper_is_told_and_closes_its_fingers(robots: dict[str, Record]) -> None:
    """By the state, where the record has one: what is told to open is closed until it is soft."""
    snake = robots["snake"]
    film = Film({"one": snake}, view="top", plot="", size=(640, 480))
    robot, camera = film.painters["one"].robot, film.painters["one"].camera
    seen = {}
    for state in range(4):
        record = Record(snake.time[:1], provenance=snake.provenance)
        for name in (POSITION, ORIENTATION, "grounded"):
            record.add(name, snake[name][:1], snake.units[name], labels=snake.labels[name])
        record.add("gripper", np.zeros(1), "1")
        record.add("gripper_state", np.array([state]), "1")
        record.scene = snake.scene
        painter = Painter(replace(robot, record=record), camera, (640, 480), (np.zeros(3), np.ones(3)), tint=MARK)
        seen[state] = np.asarray(painter.frame(0.0)).astype(int)
    # Words in the upper left corner, other ones for each state.
    words = [image[:24, :200] for image in seen.values()]
    assert all((words[a] != words[b]).any() for a in range(4) for b in range(a))
    # Below them only the fingers differ: of the soft one.
    others = [image[40:] for image in seen.values()]
    assert (others[0] != others[1]).any()
    assert (others[1] == others[2]).all()
    assert (others[2] == others[3]).all()


def test_labels_lie_on_paper_beside_each_other_and_within_the_picture() -> None:
    """Each sign is seen: no two overlap, though all are wanted at one place, on an image that has their colour."""
    image = Image.new("RGB", (300, 200), "#D55E00")
    places = np.array([[150.0, 100.0], [152.0, 98.0], [2.0, 4.0], [299.0, 200.0]])
    texts = [("−1.23 N", anchor, "#D55E00") for anchor in places]
    boxes = labels(ImageDraw.Draw(image), texts, font(26), image.size, "#FFFFFF")
    for k, (left, top, right, bottom) in enumerate(boxes):
        assert 0.0 <= left < right <= 300.0
        assert 0.0 <= top < bottom <= 200.0
        assert all(left >= b[2] or right <= b[0] or top >= b[3] or bottom <= b[1] for b in boxes[:k])
        part = np.asarray(image)[round(top) + 1 : round(bottom), round(left) + 1 : round(right)]
        minus = pixels(Image.fromarray(part[:, : round(0.25 * (right - left))]), "#D55E00")
        # A bar: wider than high, with white about it.
        middle = minus[(minus[:, 1] > 8) & (minus[:, 1] < part.shape[0] - 8)]
        assert np.ptp(middle[:, 0]) > 2 * np.ptp(middle[:, 1]) > 0


def test_films_of_several_fill_their_parts(braced: Record) -> None:
    """Seen from a corner the arm takes most of the width or of the height."""
    film = Film({str(k): braced for k in range(4)}, view="iso", size=(640, 360))
    painter = film.painters["0"]
    seen = painter.camera.project(braced[POSITION][-1].astype(float))[:, :2] / FINER
    assert (np.ptp(seen, axis=0) / painter.size).max() > 0.5


def test_the_plot_names_the_largest_columns(braced: Record) -> None:
    """Of several records the largest motor of each and the range of all, of one the largest four."""
    values = np.tile([1.0, -3.0, 0.5, 2.0, 4.0, 0.1], (10, 1))
    assert largest(values, 1) == [4]
    assert largest(values, 4) == [0, 1, 3, 4]
    power = braced["power"]
    (k,) = largest(power, 1)
    assert np.sqrt((power**2).mean(axis=0)).argmax() == k
    name = braced.labels["power"][k]
    assert texts_of({"one": braced, "two": braced}) == [f"one: {name}", f"two: {name}"]
    assert texts_of({"one": braced}) == [
        f"all {power.shape[1]}",
        *(braced.labels["power"][k] for k in largest(power, 4)),
    ]


def texts_of(records: dict[str, Record]) -> list[str]:
    """Names in the legend of the plot of power."""
    strip = Strip(records, (640, 160), "power")
    return list(strip.legend)


def test_views_are_right_handed_and_show_up_as_up() -> None:
    for view in ("side", "top", "iso"):
        axes = view_axes(view, 0.7)
        np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)
        if view != "top":
            assert axes[1][2] > 0.0
            assert axes[0][2] == pytest.approx(0.0, abs=1e-12)
        # The robot's longest way goes from left to right.
        assert axes[0] @ np.array([np.cos(0.7), np.sin(0.7), 0.0]) > 0.5


def test_arrows_have_the_colour_of_their_sign(braced: Record) -> None:
    """Above each contact the colour of its force, and not the other one; longer for a larger force."""
    film = Film({"one": braced}, view="side", plot="", size=(800, 500))
    known = film.painters["one"]
    painter = Painter(known.robot, known.camera, known.size, (np.zeros(3), np.ones(3)), tint=MARK)
    seen = set()
    for row in range(3, len(braced), 23):
        image = painter.frame(float(braced.time[row]))
        for k, point in enumerate(braced.scene.contacts):
            force = braced["contact_normal_force"][row, k]
            if abs(force) < 0.05:
                continue
            position = point_positions(braced, point, row)
            x, y = painter.camera.project(position)[:2] / FINER
            shown = {}
            for colour in (BLUE, PULLING):
                at = pixels(image, colour)
                shown[colour] = np.sum((np.abs(at[:, 0] - x) < 20) & (at[:, 1] < y) & (at[:, 1] > y - 60))
            right, wrong = (PULLING, BLUE) if force < 0.0 else (BLUE, PULLING)
            assert shown[right] > 30
            assert shown[wrong] == 0
            seen.add(right)
    assert seen == {BLUE, PULLING}


def test_joints_below_the_floor_are_ringed() -> None:
    record = short("elbow_comparison", "no_elbow")
    painter = Film({"one": record}, view="side", plot="", size=(800, 500)).painters["one"]
    assert len(pixels(painter.frame(0.0), DEEP)) == 0
    ringed = pixels(painter.frame(1.0), DEEP)
    depth = record[POSITION][-1, :, 2]
    x, y = painter.camera.project(record[POSITION][-1, depth.argmin()].astype(float))[:2] / FINER
    assert depth.min() < -0.05
    assert np.sum(np.hypot(ringed[:, 0] - x, ringed[:, 1] - y) < 9) > 20


def test_the_force_with_friction_has_its_own_direction() -> None:
    """Violet, along the whole force as it is seen; a block that the slope's friction holds: straight up."""
    record = short("block_on_slope", duration_s=0.5, **{"metrics.settle_s": 0.1})
    painter = Film({"one": record}, view="side", plot="", size=(800, 500)).painters["one"]
    row = len(record) - 1
    force = record["contact_force"][row, 0]
    (point,) = record.scene.contacts
    x, y = painter.camera.project(point_positions(record, point, row))[:2] / FINER
    arrow = pixels(painter.frame(float(record.time[row])), FRICTION)
    assert len(arrow) > 20
    right, up = painter.camera.axes[:2] @ force
    # Tilted by the angle of the slope against the normal arrow, which covers its beginning.
    along = np.array([right, -up]) / np.hypot(right, up)
    across = (arrow - [x, y]) @ [along[1], -along[0]]
    assert np.abs(across).mean() < 5.0
    assert np.all((arrow - [x, y]) @ along > 0.0)


@pytest.mark.parametrize("kind", ["arm", "mobile", "snake", "urdf", "payload"])
@pytest.mark.parametrize("view", ["side", "iso", "top"])
def test_every_corner_of_a_robot_is_in_the_picture(kind: str, view: str, robots: dict[str, Record]) -> None:
    """At all samples, also of the last body, whose solid extends beyond its origin and the hand."""
    record = robots[kind] if kind in robots else short("sampled_arm", duration_s=0.3, **{"metrics.settle_s": 0.1})
    painter = Film({"one": record}, view=view, size=(480, 320)).painters["one"]
    solids = painter._solids
    assert len(solids.corners) > 100
    seen = []
    for instant in np.linspace(0.0, record.time[-1], 30):
        position, turn, *_ = painter._pose(instant)
        corners = solids.corners + solids.aside[0]
        world = position[solids.body] + rotated(turn[solids.body].T, corners.T).T
        seen.append(painter.camera.project(world)[:, :2] / FINER)
    low, high = np.min(seen, axis=(0, 1)), np.max(seen, axis=(0, 1))
    assert (low > 0.0).all()
    assert (high < painter.size).all()
    assert ((high - low) / painter.size).max() > 0.6


@pytest.mark.parametrize("kind", ["arm", "mobile", "snake", "urdf"])
@pytest.mark.parametrize("view", ["side", "iso"])
def test_all_robots_are_painted_within_the_picture(kind: str, view: str, robots: dict[str, Record]) -> None:
    film = Film({kind: robots[kind]}, view=view, size=(480, 320))
    (painter,) = film.painters.values()
    still = np.asarray(empty(painter).reduce(FINER)).astype(int)
    for instant in (film.times[0], film.times[-1]):
        moving = np.abs(np.asarray(painter.frame(float(instant))).astype(int) - still).max(axis=2) > 20
        rows, columns = np.nonzero(moving)
        # It fills a good part of the picture and touches no edge.
        assert np.ptp(rows) + np.ptp(columns) > 100
        assert rows.min() > 0
        assert columns.min() > 0
        assert columns.max() < painter.size[0] - 1
        assert film.frame(float(instant)).size == (480, 320)
    assert np.any(np.asarray(film.frame(float(film.times[0]))) != np.asarray(film.frame(float(film.times[-1]))))


def test_a_mesh_is_painted_with_its_faces(robots: dict[str, Record]) -> None:
    painter = Film({"one": robots["urdf"]}, view="side").painters["one"]
    # Three wedges of four triangles, a rod in place of the file that is not there, and hubs.
    assert len(painter._meshes) == 3
    lengths = np.ptp(painter._solids.corners[painter._solids.body == 0], axis=0)
    np.testing.assert_allclose(lengths, [0.1, 0.1, 0.15], atol=1e-6)


def test_faces_turn_outwards() -> None:
    """A solid's volume by the divergence theorem is positive, and that of the shape."""
    shapes = {
        "box": ([0.1, 0.2, 0.3], 0.006),
        "cylinder": ([0.1, 0.4], np.pi * 0.004),
        "capsule": ([0.1, 0.4], np.pi * (0.004 + 4e-3 / 3)),
        "sphere": ([0.1], np.pi * 4e-3 / 3),
    }
    for kind, (size, volume) in shapes.items():
        corners, faces = solid({"kind": kind, "size": size, "p": [1.0, 2.0, 3.0], "q": [0.6, 0.0, 0.8, 0.0]}, [])
        parts = [np.linalg.det(corners[face[list(three)]]) for face in faces for three in ((0, 1, 2), (0, 2, 3))]
        # 28 sides and 8 rings enclose some 5 % less.
        assert sum(parts) / 6 == pytest.approx(volume, rel=1e-9 if kind == "box" else 0.06)


def test_the_cursor_is_at_the_time(braced: Record) -> None:
    film = Film({"one": braced}, size=(640, 480), plot="q")
    strip = film._strip
    assert strip is not None
    bare = np.asarray(strip._image).astype(int)
    columns = []
    for instant in (0.0, 0.25, 0.5, 1.0):
        changed = np.abs(np.asarray(strip.frame(instant)).astype(int) - bare).max(axis=2) > 0
        columns.append(np.nonzero(changed)[1].mean())
    steps = np.diff(columns)
    np.testing.assert_allclose(steps, [steps.sum() / 4, steps.sum() / 4, steps.sum() / 2], atol=1.5)
    assert steps.sum() > 400


def test_a_run_that_diverged_and_one_of_a_single_sample(braced: Record, tmp_path: Path) -> None:
    """Where there are no poses nothing moves into the picture; a single sample is one frame."""
    for rows, count in ((slice(None), 26), (slice(0, 1), 1)):
        record = Record(braced.time[rows], provenance=braced.provenance)
        for name in ("q", POSITION, ORIENTATION, "hand_position", "contact_normal_force", "contact_force"):
            data = braced[name][rows].astype(float)
            if count > 1:
                data[-30:] = np.nan
            record.add(name, data, braced.units[name], labels=braced.labels[name])
        record.scene = braced.scene
        film = Film({"one": record}, size=(320, 240))
        (painter,) = film.painters.values()
        assert len(film.times) == count
        first, last = (np.asarray(painter.frame(float(film.times[k]))) for k in (0, -1))
        still = np.asarray(empty(painter).reduce(FINER))
        assert np.any(first != still)
        assert np.array_equal(last, still) == (count > 1)
        write({"one": record}, tmp_path / "film.gif", size=(320, 240), fps=5)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"size": (321, 240)}, ("321x240", "160", "4096")),
        ({"size": (32, 20)}, ("32x20", "160", "4096")),
        ({"speed": 0.0}, ("0", "1000")),
        ({"speed": float("nan")}, ("nan", "1000")),
        ({"speed": 1e-5}, ("2.5e+06", "--speed", "--fps")),
        ({"speed": 1e-300}, ("--speed", "--fps")),
        ({"speed": 0.001, "size": (960, 540)}, ("GIF", "960x540", ".mp4", "--speed", "--fps", "--size")),
        ({"fps": 0}, ("1", "120", "0")),
        ({"plot": "no_such"}, ("'no_such'", "current")),
        ({"plot": "q", "size": (200, 200)}, ("240x220", "200x200")),
        ({"hold": -1.0}, ("60 s", "-1")),
        ({"view": "front"}, ("side, top, iso", "'front'")),
    ],
)
def test_numbers_beyond_bounds(
    braced: Record, tmp_path: Path, options: dict[str, object], names: tuple[str, ...]
) -> None:
    with raises(RecordError, *names):
        write({"one": braced}, tmp_path / "film.gif", **options)
    assert list(tmp_path.iterdir()) == []


def test_too_many_robots_for_the_size(braced: Record) -> None:
    many = {str(k): braced for k in range(30)}
    with raises(RecordError, "30", "320x240", "--size"):
        Film(many, size=(320, 240))
    assert len(Film(dict(list(many.items())[:5]), size=(640, 480)).painters) == 5


def test_other_kinds_of_files(braced: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with raises(RecordError, ".mp4", ".gif", ".avi"):
        write({"one": braced}, tmp_path / "film.avi")
    with raises(RecordError, "GIF", "50", "60", "--fps"):
        write({"one": braced}, tmp_path / "film.gif", fps=60)
    monkeypatch.setitem(sys.modules, "av", None)
    with raises(RecordError, "pip install 'dynsim[video]'"):
        write({"one": braced}, tmp_path / "film.mp4")
    bare = Record(braced.time)
    with raises(RecordError):
        write({"bare": bare}, tmp_path / "film.gif")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_interrupted_there_is_no_film_and_the_old_one_stays(braced: Record, tmp_path: Path, kind: str) -> None:
    if kind == "mp4":
        pytest.importorskip("av")
    path = tmp_path / f"film.{kind}"
    path.write_bytes(b"old")

    def stop(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write({"one": braced}, path, size=(160, 160), progress=stop)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr("sys.argv", ["dynsim", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert isinstance(end.value.code, int)
    return end.value.code


def test_records_of_a_folder_are_in_the_order_of_its_comparison(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "record.h5").touch()
    assert [path.parent.name for path in record_files([tmp_path])] == ["a", "b", "c"]
    (tmp_path / "comparison.json").write_text('{"variants": {"c": {}, "gone": {}, "a": {}}}')
    assert [path.parent.name for path in record_files([tmp_path])] == ["c", "a", "b"]
    (tmp_path / "comparison.json").write_text("[]")
    assert [path.parent.name for path in record_files([tmp_path])] == ["a", "b", "c"]


def test_command(
    braced: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        (tmp_path / "all" / name).mkdir(parents=True)
        braced.save(tmp_path / "all" / name / "record.h5")
    out = tmp_path / "film.gif"
    quick = ("--fps", 5, "--size", "320x240", "--hold", 0)
    # A record, the folder of a run, the folder of a comparison.
    for named in ("all/a/record.h5", "all/a", "all"):
        assert run(monkeypatch, "animate", tmp_path / named, "--out", out, "--view", "side", *quick) == 0
        assert decoded(out) == (6, (320, 240), pytest.approx(1.2))
        assert "film.gif" in capsys.readouterr().out
        out.unlink()
    for wrong, name in (
        (("--size", "big"), "'big'"),
        (("--out", "film"), ".mp4"),
        (("--plot", "nothing"), "'nothing'"),
    ):
        assert run(monkeypatch, "animate", tmp_path / "all/a", "--out", out, *quick, *wrong) != 0
        assert mentions(capsys.readouterr().err, name)
    (tmp_path / "empty").mkdir()
    assert run(monkeypatch, "animate", tmp_path / "empty", "--out", out) != 0
    assert mentions(" ".join(capsys.readouterr().err.split()), "empty", "record.h5")
    assert not out.exists()
    drawn: list[tuple[list[str], Path]] = []
    monkeypatch.setattr(commands, "draw", lambda figures, quiet: drawn.append((list(figures.records), figures.folder)))
    assert run(monkeypatch, "plot", tmp_path / "all", "--out", tmp_path / "figures") == 0
    assert [folder.name for _, folder in drawn] == ["figures", "two_elbows", "two_elbows_2"]
    assert run(monkeypatch, "plot", tmp_path / "all" / "a") == 0
    assert drawn[-1] == (["two_elbows"], tmp_path / "all" / "a" / "figures")
    # The same folders elsewhere.
    assert run(monkeypatch, "view", tmp_path / "all", "--no-open") == 0
    assert (tmp_path / "all" / "view.html").is_file()
    assert run(monkeypatch, "view", tmp_path / "all" / "b", "--no-open") == 0
    assert (tmp_path / "all" / "b" / "view.html").is_file()


def test_a_postponed_signal_ends_a_film(braced: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that arrives while a kernel is loaded; such a film was completed, with exit code 0."""
    original, calls = Film.frame, []

    def frame(self: Film, time: float) -> Image.Image:
        calls.append(time)
        if len(calls) == 3:
            interruption.keep()
            signal.raise_signal(signal.SIGINT)
            interruption.heed()
        return original(self, time)

    monkeypatch.setattr(Film, "frame", frame)
    monkeypatch.setattr(interruption.signal, "getsignal", lambda number: signal.SIG_DFL)  # ignored in the background
    with interruption.handled(), pytest.raises(KeyboardInterrupt):
        dynsim.film.write({"a": braced}, tmp_path / "film.gif", size=(320, 240), speed=0.1)
    assert len(calls) == 3
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_leaves_nothing(braced: Record, tmp_path: Path) -> None:
    braced.save(tmp_path / "record.h5")
    (tmp_path / "films").mkdir()
    command = [
        sys.executable,
        "-m",
        "dynsim",
        "animate",
        str(tmp_path / "record.h5"),
        "--speed",
        "0.01",
        "--size",
        "320x240",
    ]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "films" / "film.gif")],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        end = time.monotonic() + 120.0
        # The temporary file is there: it is at work.
        while not list((tmp_path / "films").iterdir()):
            assert process.poll() is None, process.stderr and process.stderr.read()
            assert time.monotonic() < end
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        assert process.wait(120.0) == 130
        assert list((tmp_path / "films").iterdir()) == []
    finally:
        process.kill()
        process.communicate()

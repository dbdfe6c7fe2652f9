"""Scenario for an assignment of levels: it is short, its robot could be built, and a seed varies it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from combinations import drives, plants
from combinations.factors import FACTORS, GLUED, SAMPLED, WITH_BALL, Levels, methods
from combinations.sentences import OFF_SURFACE, OVERLAP
from dynsim import Model, check
from dynsim.errors import DynsimError
from dynsim.scenario import Scenario, build_model, load_scenario
from dynsim.scenario.reading import scenario_from_resolved, to_yaml

Array = NDArray[np.float64]

# Wall-clock time after which a run counts as endless [s].
WALL_LIMIT_S = 60.0
# Radius of spheres about points [m], and extra radius of declared points on links that have a radius [m].
SPHERE, THICKER = 0.02, 0.002
# Distance from the elbow to the shin [m].
SHIN = 0.05
# Radius of the balls that single points touch [m].
BALL_M = 0.03
# Radius of the ball that falls on a body [m]; number of pairs of links that may touch each other.
RIDER_M, MOST_PAIRS = 0.02, 4
# Maximum number of scenes drawn until no body starts in a surface.
ATTEMPTS = 12
# Number of grid heights along each side, and their spacing [m].
GRID, SPACING = 24, 0.1
# Integrator options by the level of precision, for adaptive methods and for time stepping.
ADAPTIVE = {"default": {}, "tight": {"rtol": 1e-9, "atol": 1e-11}, "coarse": {"rtol": 1e-5, "atol": 1e-7}}
STEPPED = {"default": {}, "tight": {"step_s": 2.5e-4}, "coarse": {"step_s": 2e-3, "theta": 1.0}}
DEFAULT_STEP_S = 1e-3
THIRD_ORDER_SHARE = 25
# Steps for a snake, which divide its control period.
SNAKE_STEPPED = {"default": {}, "tight": {"step_s": 1.25e-3}, "coarse": {"step_s": 5e-3, "theta": 1.0}}


@dataclass(frozen=True)
class Scene:
    """A scene and the folder with its files.

    Attributes
    ----------
    levels : levels of all factors
    seed : seed with which the scene was drawn
    settings : content of a scenario file, without ``integrator``
    folder : folder of the scenario files and of the files that they name
    """

    levels: Levels
    seed: int
    settings: Mapping[str, Any]
    folder: Path

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that can run the scene; ``auto`` chooses one of the others.

        One scene in :data:`THIRD_ORDER_SHARE` is run by ``bogacki_shampine`` too, which supports what ``dopri5`` does.
        """
        supported = methods(self.levels)
        third_order = "dopri5" in supported and self.seed % THIRD_ORDER_SHARE == 0
        return ("bogacki_shampine", *supported) if third_order else supported

    def with_method(self, method: str, solver: str = "articulated") -> dict[str, Any]:
        """Return the whole scenario: the settings with a method."""
        stepped = method == "time_stepping"
        fixed = SNAKE_STEPPED if self.levels["plant"] == "snake" else STEPPED
        options = dict((fixed if stepped else ADAPTIVE)[self.levels["precision"]])
        if solver != "articulated":
            options["solver"] = solver
        settings = {**self.settings, "integrator": {"method": method, **options, "wall_limit_s": WALL_LIMIT_S}}
        if stepped and fixed is STEPPED:
            # Record at the end of each step, so that the checks see all steps. Steps divide the time between ticks.
            step, between = (
                options.get("step_s", DEFAULT_STEP_S),
                self.settings.get("controller", {}).get("sample_time_s"),
            )
            rate = 1.0 / step if between is None else math.ceil(between / step - 1e-9) / between
            settings["record"] = {**self.settings["record"], "rate_hz": rate}
        return settings

    def load(self, method: str, solver: str = "articulated") -> Scenario:
        """Write the scenario file and return the scenario read from it; errors of reading are passed on."""
        file = self.folder / f"{method}_{solver}.yaml"
        file.write_text(to_yaml(self.with_method(method, solver)), "utf-8")
        return load_scenario(file)

    def text(self, method: str = "auto") -> str:
        """Return the text of the scenario file, with the levels in its first line."""
        levels = ", ".join(f"{factor} {self.levels[factor]}" for factor in FACTORS)
        return f"# seed {self.seed}: {levels}\n{to_yaml(self.with_method(method))}"


def scene(
    levels: Levels, seed: int, folder: Path, change: Callable[[dict[str, Any]], None] = lambda settings: None
) -> Scene:
    """Return the scene of an assignment; files are written to the folder, which must exist.

    ``change`` : its sections, as they would be written
    """
    # This number is the same in every process, unlike Python's own hashes of strings.
    chosen = [levels[factor] for factor in FACTORS if factor != "between" or levels[factor] != "none"]
    number = zlib.crc32("/".join(chosen).encode())
    for attempt in range(ATTEMPTS):
        random = np.random.default_rng([seed, number, attempt])
        draft = _snake(random, levels) if levels["plant"] == "snake" else _arm(random, levels, folder)
        draft["name"] = "combined"
        change(draft)
        for section in [key for key, value in draft.items() if value is None or value == {}]:
            del draft[section]
        drawn = Scene(levels, seed, draft, folder)
        if not drawn.methods or not _in_a_surface(drawn):
            break
    _add_wrench_sensor(drawn, draft)
    return drawn


def _add_wrench_sensor(drawn: Scene, draft: dict[str, Any]) -> None:
    """Add a wrench sensor at the joint of a body, which depends on the seed; nothing is drawn for it."""
    if not drawn.methods:
        return
    try:
        bodies = build_model(drawn.load(drawn.methods[-1])).robot.bodies
    except DynsimError:
        return
    sensor = {"body": bodies[drawn.seed % len(bodies)], "point_m": [0.01, -0.02, 0.03]}
    draft["sensors"] = {**draft.get("sensors", {}), "wrench": {"probe": sensor}}


def _in_a_surface(drawn: Scene) -> bool:
    """Whether a part other than the declared points starts below a surface, which the levels do not require."""
    try:
        check(drawn.load(drawn.methods[-1]))
    except DynsimError as error:
        return OFF_SURFACE in str(error) or OVERLAP in str(error)
    return False


def _arm(random: Generator, levels: Levels, folder: Path) -> dict[str, Any]:
    duration = float(random.uniform(0.2, 0.4))
    robot = plants.plant(random, levels)
    driven = drives.motors(random, levels, robot)
    plants.set_motors(robot, driven)
    plants.set_losses(robot, random, levels["rubbing"])
    _set_stops(random, levels, robot)
    for name, text in robot.files.items():
        (folder / name).write_text(text, "utf-8")
    model = _model(robot, folder)
    touching = _Touching(random, levels, robot, model, folder)
    # Without bodies that touch each other, objects are drawn after the controller, as before this factor existed.
    objects = None
    if levels["between"] != "none":
        objects = touching.objects()
        touching.add_between(objects)
    settings: dict[str, Any] = {
        "duration_s": duration,
        "plant": robot.section,
        "controller": drives.controller(random, levels, robot, driven, model, duration),
        "surfaces": touching.surfaces,
        "contacts": touching.contacts,
        "initial": _initial(levels, touching, robot),
        "loads": _loads(random, levels, robot, duration),
        "objects": touching.objects() if objects is None else objects,
        "ties": _ties(random, levels, robot),
        "sensors": _sensors(random, levels),
        "record": {"rate_hz": 500.0},
        "metrics": {"settle_s": 0.0},
    }
    return settings


def _model(robot: plants.Plant, folder: Path) -> Model:
    """Return the model of the robot alone, which is used to locate its points."""
    plant = dict(robot.section)
    if "file" in plant:
        plant["file"] = str(folder / plant["file"])
    alone = {"duration_s": 1.0, "plant": plant, "contacts": {"law": "unilateral"}}
    return build_model(scenario_from_resolved(alone))


def _set_stops(random: Generator, levels: Levels, robot: plants.Plant) -> None:
    if levels["stops"] == "none":
        return
    able = [joint for joint in robot.joints if not joint.name.startswith("base.")]
    if levels["stops"] == "far":
        for joint in able:
            reach = 170.0 if joint.turns else 0.5
            plants.set_limits(robot, joint, joint.start - reach, joint.start + reach)
        return
    if levels["start"] == "on_references":
        # The remaining joints may start elsewhere.
        able = [joint for joint in able if joint.before]
    for k in random.permutation(len(able)).tolist()[: 1 + int(random.integers(2))]:
        joint = able[k]
        robot.limited.add(joint.name)
        reach = float(random.uniform(0.2, 2.0)) * (1.0 if joint.turns else 0.002)
        plants.set_limits(robot, joint, joint.start - reach, joint.start + 1.5 * reach)


class _Touching:
    """Surfaces under the points of the robot, its contacts, and objects on a separate shelf."""

    def __init__(self, random: Generator, levels: Levels, robot: plants.Plant, model: Model, folder: Path) -> None:
        self._random, self._levels, self._robot, self._model, self._folder = random, levels, robot, model, folder
        self._q = np.array(model.robot.initial)
        self.surfaces: dict[str, Any] = {}
        self.points: dict[str, Any] = {}
        self.elbow = model.point_position(*robot.elbow, self._q)
        contact, start = levels["contact"], levels["start"]
        radius = SPHERE if levels["shape"] == "sphere" else 0.0
        if contact == "links":
            # The point is thicker than the link; otherwise the link would touch first.
            radius = robot.radius + THICKER
        gap = {"above": float(random.uniform(1e-3, 6e-3)), "on_surface": float(random.uniform(-2e-3, 2e-3))}.get(
            start, 0.0
        )
        # Several points cannot all be moved onto their surfaces together.
        self.gap = 0.0 if contact == "glued" or start not in ("on_surface", "on_references") else 3e-3
        if contact == "glued" and levels["points"] != "elbow":
            gap = 0.0
        self._floor(radius, gap)
        self.points["elbow"] = self._point(robot.elbow, "floor", radius)
        self._more(radius)
        if levels["plant"] == "floating" and contact in ("points", "joints", "links"):
            self._feet()
        if contact in ("nothing", "free"):
            for point in self.points.values():
                point["enabled"] = False
        self._friction()

    @property
    def on_surface(self) -> list[str]:
        """Names of the points that start on their surfaces, without points that may start above them."""
        if self._levels["contact"] == "glued":
            return list(self.points)
        return ["elbow", *(name for name in self.points if name.startswith("foot"))]

    def _point(self, spot: tuple[str, list[float]], surface: str, radius: float) -> dict[str, Any]:
        body, point = spot
        settings: dict[str, Any] = {"body": body, "point_m": list(point), "surface": surface}
        if radius:
            settings["radius_m"] = radius
        return settings

    def _floor(self, radius: float, gap: float) -> None:
        """Add the surface below the elbow."""
        random, kind = self._random, self._levels["surface"]
        wide = self._levels["contact"] in ("joints", "links") or self._levels["objects"] not in ("none", "hinge")
        wide = wide or self._levels["between"] in WITH_BALL
        # Tilt the surface across the plane of the arm, so that the other joints stay equally far above it.
        heading = self._across()
        normal = _unit(np.array([0.0, 0.0, 1.0]) + float(random.uniform(-0.05, 0.05)) * heading)
        if kind in ("sphere", "cylinder") and not wide and random.random() < 0.8:
            normal = _unit(np.array([0.0, 0.0, 1.0]) + float(random.uniform(0.2, 0.8)) * heading)
        if kind == "steep" and self._levels["contact"] == "links":
            # On a steep plane, a link that passes by would penetrate it.
            kind = "inclined"
        if kind == "steep":
            normal = self._steep(heading)
        if kind == "inclined":
            normal = _unit(np.array([0.0, 0.0, 1.0]) + float(random.uniform(0.2, 0.8)) * heading)
        if kind in ("box", "height_field"):
            normal = np.array([0.0, 0.0, 1.0])
        spot = self.elbow - (radius + gap) * normal
        size = float(random.uniform(0.1, 0.3))
        if kind in ("bowl", "pipe"):
            size = 4.0 if wide else float(random.uniform(0.3, 0.6))
        self.normal = normal
        if kind == "steep" and wide:
            kind, size = "sphere", 0.05
        if kind in ("plane", "inclined", "steep"):
            surface: dict[str, Any] = {"type": "plane", "point_m": spot.tolist(), "normal": normal.tolist()}
        elif kind in ("sphere", "bowl"):
            sign = 1.0 if kind == "bowl" else -1.0
            surface = {"type": "sphere", "center_m": (spot + sign * size * normal).tolist(), "radius_m": size}
        elif kind in ("cylinder", "pipe"):
            sign = 1.0 if kind == "pipe" else -1.0
            axis = _unit(np.cross(normal, _unit(random.normal(size=3))))
            centre = (spot + sign * size * normal).tolist()
            surface = {"type": "cylinder", "point_m": centre, "axis": axis.tolist(), "radius_m": size}
        elif kind == "box":
            edges = random.uniform(0.15, 0.5, size=3).tolist()
            turn = [0.0, 0.0, float(random.uniform(-90, 90))]
            centre = (spot - [0.0, 0.0, 0.5 * edges[2]]).tolist()
            surface = {"type": "box", "center_m": centre, "edges_m": edges, "rpy_deg": turn}
        else:
            surface = self._terrain(spot)
        if kind in ("bowl", "pipe"):
            surface["inside"] = True
        self.surfaces["floor"] = surface

    def _across(self) -> Array:
        """Return a horizontal direction across the plane of the arm."""
        hand = self._model.point_position(*self._robot.hand, self._q) - self.elbow
        along = np.array([hand[0], hand[1], 0.0])
        if np.linalg.norm(along) < 1e-3:
            along = np.array([1.0, 0.0, 0.0])
        return _unit(np.cross(along, [0.0, 0.0, 1.0])) * float(self._random.choice((-1.0, 1.0)))

    def _steep(self, heading: Array) -> Array:
        """Return an upward normal of a plane that the elbow, turned about one joint, leaves at a flat angle."""
        body, point = self._robot.elbow
        jacobian = self._model.point_jacobian(body, np.array(point), self._q)
        moving = [column for column in jacobian.T if np.linalg.norm(column) > 0.05]
        toward = _unit(moving[-1]) if moving else np.array([0.0, 0.0, 1.0])
        side = _unit(np.cross(toward, heading) if abs(toward @ heading) < 0.9 else np.cross(toward, [0.0, 0.0, 1.0]))
        angle = np.radians(float(self._random.uniform(60.0, 80.0)))
        normal = np.cos(angle) * toward + np.sin(angle) * side
        return normal if normal[2] > 0.0 else -normal

    def _terrain(self, spot: Array) -> dict[str, Any]:
        """Return a hill with its top below the elbow; its spline reproduces it except for rounding."""
        x = SPACING * (np.arange(GRID) - 0.5 * (GRID - 1))
        bends = self._random.uniform(0.05, 0.3, size=2)
        np.save(self._folder / "terrain.npy", -np.add.outer(bends[0] * x**2, bends[1] * x**2))
        corner = -0.5 * SPACING * (GRID - 1)
        origin = (spot + np.array([corner, corner, 0.0])).tolist()
        return {"type": "height_field", "file": "terrain.npy", "spacing_m": [SPACING] * 2, "origin_m": origin}

    def _more(self, radius: float) -> None:
        """Add further points, each on a separate small ball that other links do not reach."""
        level, robot = self._levels["points"], self._robot
        body, point = robot.elbow
        if level == "two":
            end = self._model.point_position(*robot.hand, self._q)
            toward = _unit(end - self._model.point_position(robot.hand[0], self._behind(robot.hand), self._q))
            self._ball("hand", robot.hand, radius, end, -toward)
        elif level == "same_link":
            spot = (body, [0.0, 0.0, point[2] + SHIN])
            there = self._model.point_position(*spot, self._q)
            along = _unit(there - self.elbow)
            normal = _unit(self.normal - (self.normal @ along) * along)
            self._ball("shin", spot, radius + self._fan(body), there, normal)
        elif level == "unmoved":
            # Use the last joint with its centre on the axis of the first joint, which moves it only by rounding.
            bodies = [joint.body for joint in robot.joints if not joint.name.startswith("base.")]
            centres = [self._model.point_position(body, np.zeros(3), self._q) for body in bodies]
            last = max(k for k, centre in enumerate(centres) if np.linalg.norm(centre - centres[0]) < 1e-9)
            spot = (bodies[last], [0.0, 0.0, 0.0])
            there = self._model.point_position(*spot, self._q)
            toward = self._model.point_position(*robot.hand, self._q) - there
            toward[2] = 0.0
            # The ball is behind the arm, or where a folded arm leaves most room for it.
            toward = _unit(toward) if np.linalg.norm(toward) > 1e-3 else np.array([1.0, 0.0, 0.0])
            behind = _unit(toward + self._random.uniform(-0.3, 0.3, size=3))
            ends = [*centres[last:], self._model.point_position(*robot.hand, self._q)]
            sides = [behind, *(np.array([x, y, 0.0]) for x, y in ((0.0, 1.0), (0.0, -1.0), (-1.0, 0.0), (1.0, 0.0)))]
            room = [_distance(there - (radius + BALL_M) * side, ends) for side in sides]
            side = 0 if room[0] > BALL_M or self._levels["contact"] not in ("links", "joints") else int(np.argmax(room))
            self._ball("root", spot, radius, there, sides[side])

    def _fan(self, body: str) -> float:
        """Return how far the capsules from a body to its fingers are off its own axis at the shin [m]."""
        if self._levels["contact"] != "links":
            return 0.0
        ends = [link.p_PJ for link in self._model.robot.links if link.parent == body]
        return max((SHIN * math.hypot(end[0], end[1]) / float(np.linalg.norm(end)) for end in ends), default=0.0)

    def _behind(self, spot: tuple[str, list[float]]) -> list[float]:
        return [spot[1][0], spot[1][1], spot[1][2] - 0.05]

    def _ball(self, name: str, spot: tuple[str, list[float]], radius: float, there: Array, normal: Array) -> None:
        size = BALL_M
        centre = (there - (radius + size + self.gap) * normal).tolist()
        self.surfaces[f"{name}_ball"] = {"type": "sphere", "center_m": centre, "radius_m": size}
        self.points[name] = self._point(spot, f"{name}_ball", radius)

    def _feet(self) -> None:
        """Add four feet under the trunk of a floating robot."""
        base = self._model.point_position("trunk", np.zeros(3), self._q)
        slab = [*(base[:2]), base[2] - 0.1 - SPHERE]
        self.surfaces["slab"] = {
            "type": "box",
            "center_m": [float(slab[0]), float(slab[1]), float(slab[2] - 0.025)],
            "edges_m": [0.5, 0.5, 0.05],
        }
        for k, (x, y) in enumerate([(0.1, 0.1), (0.1, -0.1), (-0.1, 0.1), (-0.1, -0.1)]):
            self.points[f"foot_{k + 1}"] = self._point(("trunk", [x, y, -0.1]), "slab", SPHERE)

    def _friction(self) -> None:
        """Fill the ``contacts:`` section."""
        random, levels = self._random, self._levels
        law = "bilateral" if levels["contact"] in ("nothing", "glued") else "unilateral"
        level, own = levels["friction"], dict[str, Any]()
        own["friction"] = float({"none": 0.0, "high": random.uniform(1.2, 3.0)}.get(level, random.uniform(0.1, 0.5)))
        if level in ("static", "stribeck"):
            own["static_friction"] = own["friction"] * float(random.uniform(1.2, 2.0))
        if levels["give"] == "restitution":
            own["restitution"] = float(random.uniform(0.2, 0.8))
        elif levels["give"] == "compliant":
            own["stiffness_N_per_m"] = float(10.0 ** random.uniform(3.5, 5.0))
            own["damping_N_s_per_m"] = float(random.uniform(10.0, 200.0))
        self.contacts: dict[str, Any] = {"law": law}
        # In some scenes the values are set for the point instead of for all contacts.
        (self.points["elbow"] if random.random() < 0.3 and level != "stribeck" else self.contacts).update(own)
        if level == "stribeck":
            self.contacts["stribeck_m_s"] = float(random.choice((0.01, 0.1)))
        if level == "viscous":
            self.contacts["viscous_friction_s_per_m"] = float(random.uniform(0.1, 1.0))
        if level == "grip":
            self.points["elbow"]["grip"] = {
                "axis": random.normal(size=3).tolist(),
                "ratio": float(random.uniform(0.0, 0.8)),
            }
        if levels["contact"] in ("joints", "links"):
            self.contacts["candidates"] = levels["contact"]
        if law == "bilateral" and levels["contact"] == "glued":
            self.contacts["reference_tolerance_m"] = 1.0
            if random.random() < 0.3:
                self.contacts["pulling_friction"] = "signed"
        self.contacts["points"] = self.points

    def objects(self) -> dict[str, Any]:
        """Return a body next to the robot, at rest on a shelf or a little above it."""
        random, level = self._random, self._levels["objects"]
        if level == "none":
            return {}
        # The body is far from the arm, on the free side of its floor.
        there = self.elbow + 2.0 * self.normal + self._away()
        if level == "hinge":
            hinge: dict[str, Any] = {"axis": random.normal(size=3).tolist(), "damping_N_m_s_per_rad": 0.01}
            if "dopri5" not in methods(self._levels):
                hinge["friction_N_m"] = 0.02
            return {"thing": {"mass_kg": 0.5, "size_m": [0.1, 0.2, 0.1], "position_m": there.tolist(), "hinge": hinge}}
        edges = [1.0, 1.0, 0.1]
        centre = (there - [0.0, 0.0, 0.05]).tolist()
        self.surfaces["shelf"] = {"type": "box", "center_m": centre, "edges_m": edges}
        drop = float(random.choice((0.0, random.uniform(1e-3, 0.02))))
        if self._levels["start"] == "equilibrium":
            drop = 0.0
        thing: dict[str, Any] = {"mass_kg": float(random.uniform(0.2, 1.0))}
        if level == "box":
            size = random.uniform(0.04, 0.1, size=3).tolist()
            thing |= {"size_m": size, "rpy_deg": [0.0, 0.0, float(random.uniform(-90, 90))]}
            height = 0.5 * size[2]
        elif level == "sphere":
            thing |= {"shape": "sphere", "radius_m": 0.05}
            height = 0.05
        else:
            wheel = {"radius_m": 0.05, "mass_kg": 0.2}
            thing |= {
                "size_m": [0.3, 0.15, 0.04],
                "wheels": {
                    name: {**wheel, "position_m": spot}
                    for name, spot in {
                        "left": [0.05, 0.1, -0.02], "right": [0.05, -0.1, -0.02], "rear": [-0.12, 0.0, -0.02],
                    }.items()
                },
            }  # fmt: skip
            height = 0.07
            if self._levels["rubbing"] in ("bearing", "both"):
                thing["wheels"]["rear"]["friction_N_m"] = 0.002
        thing["position_m"] = (there + np.array([0.0, 0.0, height + drop])).tolist()
        return {"thing": thing}

    def add_between(self, objects: dict[str, Any]) -> None:
        """Add bodies that touch each other: pairs of links, or a ball above an object, a link or a carried plate."""
        random, level, robot = self._random, self._levels["between"], self._robot
        # A link that moves: the hand of a file is fixed to one.
        index, at_hand = self._model.robot.attach(robot.hand[0], np.array(robot.hand[1]))
        tip = at_hand.tolist()
        body = self._model.robot.links[index].name
        if level == "self":
            # Few pairs, which event-driven methods support.
            names = self._model.robot.bodies
            ignore = [[a, b] for k, a in enumerate(names) for b in names[k + 1 :] if names[k + 2 :][:1] != [b]]
            self.contacts["between"] = [{"bodies": "self", "ignore": ignore[MOST_PAIRS:]}]
            return
        if level == "objects":
            thing = objects["thing"]
            half = thing.get("radius_m", 0.5 * thing.get("size_m", [0.0, 0.0, 0.0])[2])
            up = np.array([0.0, 0.0, 1.0])
            top = np.array(thing["position_m"]) + half * up
        elif level == "links":
            middle = [0.0, 0.0, 0.5 * tip[2]]
            along = _unit(self._model.point_position(body, np.array(tip), self._q) - self._start_of(body))
            up = np.cross(np.cross(along, [0.0, 0.0, 1.0]), along)
            up = _unit(up) if np.linalg.norm(up) > 0.1 else np.array([1.0, 0.0, 0.0])
            top = self._model.point_position(body, np.array(middle), self._q) + robot.radius * up
        else:
            centre = [0.0, 0.0, tip[2] + 0.08]
            axes = [self._model.point_position(body, centre + axis, self._q) for axis in np.eye(3)]
            at = self._model.point_position(body, np.array(centre), self._q)
            k = int(np.argmax([abs(axis[2] - at[2]) for axis in axes]))
            up = (axes[k] - at) * math.copysign(1.0, axes[k][2] - at[2])
            edges = np.full(3, 0.08)
            edges[k] = 0.02
            self.surfaces["plate"] = {"type": "box", "center_m": centre, "edges_m": edges.tolist(), "on": body}
            top = at + 0.01 * up
        gap = float(random.choice((0.0, random.uniform(1e-3, 0.01)))) + 1e-9
        centre_of_ball = top + (RIDER_M + gap) * up
        mass = float(random.uniform(0.05, 0.2))
        objects["rider"] = {
            "shape": "sphere", "radius_m": RIDER_M, "mass_kg": mass, "position_m": centre_of_ball.tolist(),
        }  # fmt: skip
        if level != "carried":
            self.contacts["between"] = [{"bodies": ["rider", "thing" if level == "objects" else "links"]}]
            if random.random() < 0.3:
                own = self.contacts["between"][0]
                own["friction"] = float(random.uniform(0.0, 1.0))
                if "static_friction" in self.contacts:
                    own["static_friction"] = 1.3 * own["friction"]

    def _start_of(self, body: str) -> Array:
        return self._model.point_position(body, np.zeros(3), self._q)

    def _away(self) -> Array:
        side = np.cross(self.normal, [0.0, 0.0, 1.0])
        return _unit(side) if np.linalg.norm(side) > 0.1 else np.array([1.0, 0.0, 0.0])


def _distance(point: Array, ends: Sequence[Array]) -> float:
    """Return the distance of a point from the segments between the ends [m]."""
    least = math.inf
    for a, b in pairwise(ends):
        share = float((point - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-12)
        least = min(least, float(np.linalg.norm(point - a - np.clip(share, 0.0, 1.0) * (b - a))))
    return least


def _unit(vector: Array) -> Array:
    scaled: Array = vector / np.linalg.norm(vector)
    return scaled


def _initial(levels: Levels, touching: _Touching, robot: plants.Plant) -> dict[str, Any] | None:
    start = levels["start"]
    if start in ("given", "above"):
        return None
    initial: dict[str, Any] = {}
    if start == "on_surface" or (start == "on_references" and levels["plant"] != "mimic"):
        initial["on_surface"] = touching.on_surface
    if start == "on_references":
        initial["on_references"] = True
    if start == "equilibrium":
        initial["equilibrium"] = True
    return initial


def _loads(random: Generator, levels: Levels, robot: plants.Plant, duration: float) -> dict[str, Any]:
    level, (body, tip) = levels["loads"], robot.hand
    if level == "payload":
        mass, size = float(random.uniform(0.05, 0.3)), 0.03
        return {"tool": {"type": "payload", "body": body, "point_m": list(tip), "mass_kg": mass, "radius_m": size}}
    force = random.uniform(-3.0, 3.0, size=3).tolist()
    if level == "constant":
        torque = random.uniform(-0.1, 0.1, size=3).tolist()
        return {
            "wind": {"type": "constant", "body": body, "point_m": list(tip), "force_N": force, "torque_N_m": torque}
        }
    if level in ("push", "body_push"):
        times = (np.array([0.2, 0.4, 0.7]) * duration).tolist()
        push: dict[str, Any] = {"type": "samples", "body": body, "times_s": times}
        push["force_N"] = [[0.0] * 3, (3.0 * np.array(force)).tolist(), [0.0] * 3]
        if level == "body_push":
            push |= {"frame": "body", "interpolation": "linear", "point_m": [0.01, 0.0, 0.05]}
            push["torque_N_m"] = [[0.0] * 3, random.uniform(-0.3, 0.3, size=3).tolist(), [0.05, 0.0, 0.0]]
        return {"push": push}
    return {}


def _ties(random: Generator, levels: Levels, robot: plants.Plant) -> dict[str, Any]:
    level = levels["ties"]
    if level == "none":
        return {}
    own = [joint.body for joint in robot.joints if not joint.name.startswith("base.")]
    other = "thing" if levels["objects"] != "none" else own[0]
    tie: dict[str, Any] = {"body": own[-1], "other": other, "axis": random.normal(size=3).tolist()}
    if level == "torsion":
        tie |= {"type": "torsion", "stiffness_N_m_per_rad": 2.0, "damping_N_m_s_per_rad": 0.02}
    else:
        tie |= {"type": "linear", "stiffness_N_per_m": 200.0, "damping_N_s_per_m": 2.0, "point_m": [0.0, 0.0, 0.02]}
    if level == "bounded":
        tie["bound_N"] = float(random.uniform(0.2, 2.0))
    return {"spring": tie}


def _sensors(random: Generator, levels: Levels) -> dict[str, Any]:
    level = levels["controller"]
    if level not in SAMPLED[1:]:
        return {}
    encoders: dict[str, Any] = {"resolution_deg": 0.01}
    if level == "delayed":
        encoders |= {"delay_s": 0.001, "noise_deg": 0.002}
    return {"seed": int(random.integers(1000)), "encoders": encoders}


def _snake(random: Generator, levels: Levels) -> dict[str, Any]:
    """Return a snake on the ground that moves its head, with the features of the other factors."""
    duration = float(random.uniform(0.3, 0.6))
    settings: dict[str, Any] = {
        "duration_s": duration,
        "plant": {"type": "snake", "level": "dynamic", "mass_kg": float(random.uniform(8.0, 12.0))},
        "record": {"rate_hz": 200.0},
        "metrics": {"settle_s": 0.0},
    }
    controller: dict[str, Any] = {"type": "task_space"}
    level = levels["controller"]
    if level == "none":
        return settings
    if level == "operator":
        speed = [*random.uniform(-0.1, 0.1, size=3).tolist(), 0.0, 0.0, float(random.uniform(-0.2, 0.2))]
        controller["commands"] = [{"at_s": 0.05, "velocity": speed}]
    else:
        # Scenes with controllers that a snake does not support are refused.
        states = {"sampled": "feedforward", "encoders": "estimated", "delayed": "measured"}
        controller["state"] = states.get(level, "measured")
        step = [*random.uniform(-0.03, 0.03, size=3).tolist(), 0.0, 0.0, 0.0]
        controller["paths"] = [{"type": "ramp", "start_s": 0.0, "duration_s": duration, "displacement": step}]
    if random.random() < 0.5:
        # Some pairs are lifted; in some scenes the first pair is among them.
        controller |= {"modes": {1: [2, 5] if random.random() < 0.5 else [3, 6]}, "switching": {"order": [1]}}
    settings["controller"] = controller if level in ("operator", *SAMPLED) else {"type": "joint_pd"}
    own = {"none": 0.0, "high": 1.5}.get(levels["friction"], 0.6)
    settings["contacts"] = {"friction": own}
    if levels["give"] != "compliant":
        settings["contacts"]["stiffness_N_per_m"] = None
    if levels["give"] == "restitution":
        settings["contacts"]["restitution"] = 0.3
    if levels["contact"] in GLUED:
        settings["contacts"]["law"] = "bilateral"
    if levels["friction"] in ("static", "stribeck"):
        settings["contacts"]["static_friction"] = 1.3 * own
    if levels["objects"] in ("box", "sphere", "cart", "hinge"):
        shape = {"shape": "sphere", "radius_m": 0.05} if levels["objects"] == "sphere" else {"size_m": [0.1, 0.1, 0.1]}
        # The object is at rest on the ground, or above it.
        height = float(random.choice((0.05, 0.25))) if levels["objects"] != "hinge" else 0.4
        thing = {"mass_kg": 0.5, **shape, "position_m": [2.0, 0.5, height]}
        if levels["objects"] == "hinge":
            thing["hinge"] = {"axis": [0.0, 0.0, 1.0]}
        settings["objects"] = {"thing": thing}
        if levels["between"] == "objects":
            half = shape.get("radius_m", 0.05)
            ball = {"shape": "sphere", "radius_m": RIDER_M, "mass_kg": 0.1}
            settings["objects"]["rider"] = {**ball, "position_m": [2.0, 0.5, height + half + RIDER_M + 1e-3]}
            settings["contacts"]["between"] = [{"bodies": ["rider", "thing"]}]
        if levels["ties"] != "none":
            settings["ties"] = {
                "spring": {
                    "type": "linear", "body": "thing", "other": "head", "axis": [1.0, 0.0, 0.0],
                    "stiffness_N_per_m": 50.0, "damping_N_s_per_m": 1.0,
                }
            }  # fmt: skip
    if levels["surface"] == "box":
        edges = [0.5, 2.0, 0.02]
        settings["surfaces"] = {"plate": {"type": "box", "center_m": [1.2, 0.0, 0.01], "edges_m": edges}}
    return settings

"""The planning problem: options, arm, surfaces, clearances, hand path, and points that may be braced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeVar, cast

import numpy as np

from dynsim.compile.control import HandPath
from dynsim.compile.model import Model
from dynsim.compile.protocols import BuildContext
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.library import families
from dynsim.model.description import Array
from dynsim.model.surfaces import Quadric
from dynsim.planner.arm import MovingArm, Problem, axis_points, moving_arm, workspace
from dynsim.planner.compiled import Course, Points
from dynsim.scenario import Scenario, build

# Weight of the bend of the postures along the path [W/rad²]: for uniqueness; no part of the cost that is reported.
SMOOTHNESS = 1e-3
# Where along links clearance is asked for, beside their ends.
ALONG = (0.33, 0.67)
# Clearance of those points [m].
LINK_CLEARANCE = 2e-3
# Slip [m/s] over which the friction that is charged grows to its value: a brace that creeps feels all of it, whatever
# planned voltages, which must not ring, make of it. The search begins with smoother ones, for long steps and few local
# optima.
FINAL_SLIP_SCALE, FINE_SLIP_SCALE, COARSE_SLIP_SCALE = 1e-3, 3e-3, 1e-2
# Targets that differ by less are the same [m].
SAME = 1e-6

Kind = Literal["there_and_back", "closed", "open"]
T = TypeVar("T")


@dataclass(frozen=True)
class Candidate:
    """A point that may be braced, in the frame of the link that carries it, and a surface that it may lean on.

    Attributes
    ----------
    name : of the point
    body : link, or frame, as the scenario names it; point_m: in its frame [m]
    joint, on_joint : index of the arm's joint that carries it, and the point in the frame of that link [m]
    radius : of a sphere about the point, that touches [m]
    surface : name
    """

    name: str
    body: str
    point_m: tuple[float, float, float]
    joint: int
    on_joint: Array = field(compare=False, repr=False)
    radius: float
    surface: str

    @property
    def location(self) -> tuple[str, tuple[float, float, float]]:
        """The point, whatever it leans on: it can lean on one surface only."""
        return self.body, self.point_m

    @property
    def label(self) -> str:
        """Point and surface."""
        return f"{self.name} on {self.surface}"


class Clear(NamedTuple):
    """A point that stays clear: index of its joint, point [m] in the frame of that joint's link, radius [m], least
    distance [m], name, index of the surface."""

    joint: int
    point: Array
    radius: float
    margin: float
    label: str
    surface: int


Key = tuple[int, int, tuple[float, ...]]


def key(joint: int, surface: int, point: Array) -> Key:
    """The same for the same point and surface, by indices of its joint and of the surface."""
    return joint, surface, tuple(point.round(9).tolist())


@dataclass(frozen=True)
class Options:
    """What a designer may choose.

    Attributes
    ----------
    candidates : links, frames or declared contact points, ``first:last`` for all links from one to the other; empty:
        all links beyond the second, and declared points
    along : shares of the way along links that are candidates too, beside their joints
    radius_m : of candidates; None: that of their links, and of declared points what they say
    count : least and greatest number of braces
    surfaces : that may be leaned on; empty: all
    peak : cost of the greatest torque of revolute joints [W/(N m)]
    clearance_m : of joints that are not braced; links between them must not touch
    min_N : least normal force of a brace
    starts : postures that the search begins with
    """

    candidates: tuple[str, ...] = ()
    along: tuple[float, ...] = ()
    radius_m: float | None = None
    count: tuple[int, int] = (0, 3)
    surfaces: tuple[str, ...] = ()
    peak: float = 0.0
    clearance_m: float = 0.01
    min_N: float = 0.5
    starts: int = 8
    seed: int = 0
    exhaustive: bool = False


@dataclass(frozen=True)
class Task:
    """A scenario as a planning problem."""

    scenario: Scenario
    options: Options
    arm: MovingArm
    path: HandPath
    kind: Kind
    candidates: tuple[Candidate, ...]
    friction: float

    @property
    def bare(self) -> list[str]:
        """Names of candidates whose radius of zero nobody chose: it is that of their links."""
        if self.options.radius_m is not None:
            return []
        declared = self.scenario.config.contacts.points
        return list(dict.fromkeys(c.name for c in self.candidates if c.radius == 0.0 and c.name not in declared))

    @cached_property
    def _known(self) -> dict[Any, Any]:
        """Courses by their number of knots, points by their braces, and rooms by these numbers."""
        return {}

    def _once(self, key: Any, make: Callable[[], T]) -> T:
        """What is made when it is asked for first."""
        if key not in self._known:
            self._known[key] = make()
        return cast("T", self._known[key])

    @property
    def duration(self) -> float:
        """Of the path [s]."""
        return float(self.scenario.duration_s)

    def targets(self, times: Array) -> Array:
        """Of the hand [m], (T, 3)."""
        return np.asarray(self.path.position(np.asarray(times, dtype=np.float64)), dtype=np.float64)

    def wanted(self, times: Array) -> Array:
        """Of the hand, (T, 3) [m]; with an orientation also the z and the x axis that its link has then, (T, 9)."""
        targets, hand = self.targets(times), self.scenario.controller.hand
        if hand.orientation is None:
            return targets
        robot = self.arm.model.robot
        axes = (hand.orientation.matrix() @ robot.hand_axes.T)[:, [2, 0]].T
        return np.hstack([targets, np.tile(axes.ravel(), (len(targets), 1))])

    @property
    def span(self) -> float:
        """Time that the knots cover [s]: of a path there and back, half of it."""
        return 0.5 * self.duration if self.kind == "there_and_back" else self.duration

    def times(self, count: int) -> Array:
        """Of so many knots [s]."""
        if count == 1:
            return np.array([0.5 * self.span])
        if self.kind == "closed":
            return np.linspace(0.0, self.span, count, endpoint=False)
        return np.linspace(0.0, self.span, count)

    @cached_property
    def clear(self) -> dict[Key, Clear]:
        """Points that stay clear where they are not braced; of planes the ends of links are enough."""
        robot, arm = self.arm.model.robot, self.arm
        points: dict[Key, Clear] = {}
        rng = np.random.default_rng(0)
        postures = arm.coordinates(rng.normal(size=(4, arm.n)))

        def moves(link: int, point: Array) -> bool:
            places = np.array([arm.model.point_position(link, point, q) for q in postures])
            return bool(np.ptp(places, axis=0).max() > 1e-9)

        margin = self.options.clearance_m
        ends = [(k, np.zeros(3), self._thickness(k), margin, robot.links[i].joint) for k, i in enumerate(arm.links)]
        hand, hand_point = robot.attach(*robot.hand)
        ends.append((arm.links.index(hand), hand_point, robot.links[hand].radius, margin, "hand"))
        middles = [
            (k, point, radius, LINK_CLEARANCE, f"{robot.links[arm.links[k]].name} at {share:g}")
            for k, point, radius, share in axis_points(arm, ALONG)
        ]
        surfaces = build.surfaces(self.scenario)
        for index, name in enumerate(arm.surfaces):
            surface = surfaces[name]
            flat = isinstance(surface, Quadric) and surface.drawn.kind == "plane"
            for k, point, radius, least, label in ends if flat else [*ends, *middles]:
                if moves(arm.links[k], point):
                    points[key(k, index, point)] = Clear(k, point, radius, least, f"{label} on {name}", index)
        return points

    def _thickness(self, k: int) -> float:
        """Radius about the beginning of a link: the larger one of those that meet there [m]."""
        links, parent = self.arm.model.robot.links, int(self.arm.tables.parent[k])
        own = links[self.arm.links[k]].radius
        return own if parent < 0 else max(own, links[self.arm.links[parent]].radius)

    def points(self, braces: Sequence[Candidate]) -> Points:
        """Tables of braces, then of what stays clear."""
        on = [self.arm.surfaces.index(b.surface) for b in braces]
        braced = {
            key(b.joint, s, b.on_joint): Clear(b.joint, b.on_joint, b.radius, 0.0, b.name, s)
            for b, s in zip(braces, on, strict=True)
        }
        rows = [*braced.values(), *(point for at, point in self.clear.items() if at not in braced)]
        return Points(
            body=integers([row.joint for row in rows]),
            point=reals([row.point for row in rows]).reshape(-1, 3),
            radius=reals([row.radius for row in rows]),
            surface=integers([row.surface for row in rows]),
            margin=reals([row.margin for row in rows]),
            friction=reals(np.full(len(braces), self.friction)),
        )

    def course(self, count: int) -> Course:
        """Knots and instants of so many knots: halfway between neighbours, with the chord for a velocity.

        So both are right to second order in the distance of knots. Slopes of a spline through the knots an optimiser
        would make vanish there, and slide in between; chords with the posture of a knot let it save much of the
        friction that there is, by joints that turn against each other.
        """
        times, closed = self.times(count), self.kind == "closed"
        pairs = [(k, (k + 1) % count) for k in range(count if closed else count - 1)] if count > 1 else []
        spacing = self.span / max(len(pairs), 1)
        signs = (1.0, -1.0) if self.kind == "there_and_back" else (1.0,)
        instants = [(first, np.eye(count)[[first, second]], sign) for first, second in pairs for sign in signs]
        knot = [first for first, _, _ in instants] or [0]
        blend = [0.5 * ends.sum(axis=0) for _, ends, _ in instants] or [np.ones(1)]
        chord = [sign / spacing * (ends[1] - ends[0]) for _, ends, sign in instants] or [np.zeros(1)]
        if count < 3:
            bend = np.diff(np.eye(count), axis=0)
        elif closed:
            bend = np.roll(np.eye(count), 1, axis=1) - 2.0 * np.eye(count) + np.roll(np.eye(count), -1, axis=1)
        else:
            bend = np.diff(np.eye(count), 2, axis=0)
        return Course(
            target=reals(self.wanted(times)),
            knot=integers(knot),
            blend=reals(blend),
            chord=reals(chord),
            share=reals(np.full(len(knot), 1.0 / len(knot))),
            smooth=reals(SMOOTHNESS * bend.T @ bend),
            slip_scale=reals([COARSE_SLIP_SCALE]),
        )

    def problem(self, braces: Sequence[Candidate], count: int, slip_scale: float = COARSE_SLIP_SCALE) -> Problem:
        """Of one set of braces at so many knots; its targets are its own, its room that of all with as many braces."""
        course = self._once(count, lambda: self.course(count))
        points = self._once(tuple(braces), lambda: self.points(braces))
        room = self._once((len(braces), len(points.body), count), lambda: workspace(self.arm.n, points, course))
        course = course._replace(target=course.target.copy(), slip_scale=reals([slip_scale]))
        return Problem(self.arm.tables, points, course, room, self.options.min_N, self.options.peak)


def task(scenario: Scenario, options: Options) -> Task:
    """The planning problem of a scenario: its plant, surfaces, friction and the hand's path.

    Raises
    ------
    ModelError
        No arm with DC motors, no path of the hand, no surface, or candidates that there are not.
    """
    robot = build.robot(scenario)
    model = Model(robot)
    surfaces = build.surfaces(scenario)
    if not surfaces and options.count[1] > 0:
        raise ModelError("plan: the scenario has no surfaces to lean on; give it some, or ask for --count 0:0")
    hand = getattr(scenario.controller, "hand", None)
    if hand is None:
        raise ModelError("plan: the scenario has no controller.hand.path, along which the arm could be planned")
    path = families.build("path", hand.path, BuildContext(scenario.duration_s), HandPath)
    arm = moving_arm(model, surfaces)
    unknown = [name for name in options.surfaces if name not in surfaces]
    if unknown:
        raise ModelError(f"plan: no surface {unknown[0]!r}; surfaces: {', '.join(surfaces) or 'none'}")
    chosen = options.surfaces or tuple(surfaces)
    candidates = _candidates(scenario, arm, options, chosen)
    if not candidates and options.count[1] > 0:
        raise ModelError("plan: no candidates for braces; name links or contact points with --candidates")
    points = len({candidate.location for candidate in candidates})
    if options.count[0] > points:
        raise ModelError(f"plan: {options.count[0]} braces, but there are {points} points to brace; ask for fewer")
    kind = _kind(path, scenario.duration_s)
    return Task(scenario, options, arm, path, kind, tuple(candidates), scenario.config.contacts.friction)


def _kind(path: HandPath, duration: float) -> Kind:
    """Whether a path comes back the way it went, or to where it began."""
    times = np.linspace(0.0, duration, 33)
    there = np.asarray(path.position(times))
    if np.abs(there - there[::-1]).max() <= SAME and np.ptp(there, axis=0).max() > SAME:
        return "there_and_back"
    return "closed" if np.abs(there[0] - there[-1]).max() <= SAME else "open"


def _candidates(scenario: Scenario, arm: MovingArm, options: Options, surfaces: Sequence[str]) -> list[Candidate]:
    """Points that may be braced, each with each surface that it may lean on."""
    robot, declared = arm.model.robot, scenario.config.contacts.points
    links = [robot.links[i].name for i in arm.links]
    frames = [frame.name for frame in robot.frames if frame.body in links]
    wanted: list[str] = []
    for text in options.candidates:
        first, _, last = text.partition(":")
        if not last:
            wanted.append(text)
            continue
        for end in (first, last):
            if end not in links:
                raise ModelError(f"plan: no link {end!r} in {text!r}; links: {', '.join(links)}")
        if links.index(first) > links.index(last):
            raise ModelError(f"plan: {text!r} begins after its end; write {last}:{first}")
        wanted += links[links.index(first) : links.index(last) + 1]
    if not wanted:
        wanted = [*declared, *links[2:]]
    along = {(k, share): point for k, point, _, share in axis_points(arm, options.along)}
    candidates: list[Candidate] = []
    known: list[tuple[int, Array]] = []

    def add(name: str, body: str, point: Array, radius: float, on: Sequence[str]) -> None:
        joint, on_joint = arm.attached(body, point)
        if any(joint == k and np.allclose(on_joint, there) for k, there in known):
            return
        known.append((joint, on_joint))
        radius = radius if options.radius_m is None else options.radius_m
        at = tuple(float(x) for x in point)
        candidates.extend(Candidate(name, body, at, joint, on_joint, radius, surface) for surface in on)  # type: ignore[arg-type]

    for name in wanted:
        if name in declared:
            point = declared[name]
            on = [point.surface] if point.surface in surfaces else list(surfaces)
            add(name, point.body, np.array(point.point_m), point.radius_m, on)
            continue
        if name in frames:
            add(name, name, np.zeros(3), robot.links[robot.attach(name, np.zeros(3))[0]].radius, surfaces)
            continue
        if name not in links:
            known_names = ", ".join([*declared, *links, *frames])
            raise ModelError(f"plan: no candidate {name!r}; contact points, links and frames: {known_names}")
        k = links.index(name)
        radius = robot.links[arm.links[k]].radius
        parent = int(arm.tables.parent[k])
        thick = radius if parent < 0 else max(radius, robot.links[arm.links[parent]].radius)
        add(name, name, np.zeros(3), thick, surfaces)
        for share in options.along:
            if (k, share) in along:
                add(f"{name}_at_{share:g}", name, along[k, share], radius, surfaces)
    return candidates

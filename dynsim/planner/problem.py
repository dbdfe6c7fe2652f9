"""Planning problem: options, arm, surfaces, clearances, hand path, and candidate points for braces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeVar, cast

import numpy as np

from dynsim.compile.bracing import RAMP
from dynsim.compile.control import HandPath
from dynsim.compile.model import Model
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.inverse_kinematics import SLIP_SCALE
from dynsim.compile.solids import Solid, solids_of
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import WORLD, Array, Robot
from dynsim.model.surfaces import Capsule, Quadric
from dynsim.planner.arm import MovingArm, Problem, axis_points, moving_arm, with_pairs, workspace
from dynsim.planner.compiled.tables import Course, Points
from dynsim.scenario import Scenario, build
from dynsim.scenario.between import LINKS, OBJECTS, SELF, solid_pairs
from dynsim.scenario.schema import BodyPair

# Weight of the curvature of the postures along the path [W/rad²]. It makes the solution unique and is excluded from the
# reported cost.
SMOOTHNESS = 1e-3
# Weight of the squared difference of the accelerations of two neighbouring knots. With the square of their mean, it is
# the mean square acceleration of the cubic spline through the knots, up to the fourth order of ω h.
RIPPLE = 5.0 / 12.0
# Hand speed below which the hand counts as at rest [m/s], and the time over which it is measured [s].
REST_SPEED, INSTANT = 1e-2, 1e-4
# Points along links that must keep a clearance, in addition to the ends, as fractions of the link length.
ALONG = (0.33, 0.67)
# Clearance of these points [m].
LINK_CLEARANCE = 2e-3
# Slip v_s [m/s] at which friction approaches its full value. The final value is the value of planned voltages. The
# search starts with larger values, which allow long steps and have few local optima.
FINAL_SLIP_SCALE, FINE_SLIP_SCALE, COARSE_SLIP_SCALE = SLIP_SCALE, 3e-3, 1e-2
# Fraction of the time that the knots cover, within which braces may be close to their surfaces before and after they
# touch.
LIFTING = 0.13
# Distance below which two targets count as equal [m].
SAME = 1e-6
# Sections with parts on bodies, and the keys that name the bodies.
OF_OBJECTS = {"surfaces": ("on",), "loads": ("body",), "ties": ("body", "other")}

Kind = Literal["there_and_back", "closed", "open"]
T = TypeVar("T")


@dataclass(frozen=True)
class Candidate:
    """Candidate point for a brace, with a surface that it may use.

    Attributes
    ----------
    name : str
        Name of the point.
    body : str
        Link or frame in the scenario.
    point_m : tuple of float
        Point in the frame of ``body`` [m].
    joint : int
        Index of the arm's joint that carries the point.
    on_joint : (3,) ndarray
        Point in the frame of this joint's link [m].
    radius : float
        Radius of the sphere around the point that touches [m].
    surface : str
        Name of the surface.
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
        """Body and point of the candidate, without its surface; a point can use only one surface at a time."""
        return self.body, self.point_m

    @property
    def label(self) -> str:
        """Name of point and surface."""
        return f"{self.name} on {self.surface}"


BraceSet = tuple[Candidate, ...]


@dataclass(frozen=True)
class BraceSchedule:
    """Sets of braces along a path, one after the other.

    Attributes
    ----------
    sets : tuple of tuple of Candidate
        Set of braces of each phase.
    borders : tuple of float
        Ends of all phases but the last, as fractions of the time that the knots cover, increasing. At a border, the
        braces of both phases are on their surfaces.
    """

    sets: tuple[BraceSet, ...]
    borders: tuple[float, ...] = ()

    @classmethod
    def of(cls, braces: Sequence[Candidate] | BraceSchedule) -> BraceSchedule:
        """Return the schedule with a single phase for a set of braces; a schedule is returned itself."""
        return braces if isinstance(braces, BraceSchedule) else cls((tuple(braces),))

    @cached_property
    def braces(self) -> BraceSet:
        """Braces of all phases."""
        return tuple(dict.fromkeys(brace for braces in self.sets for brace in braces))

    def __len__(self) -> int:
        """Return the largest number of braces at a time."""
        return max(map(len, self.sets))

    @property
    def label(self) -> str:
        """Names of the braces of each phase, with their surfaces."""
        return " → ".join(", ".join(brace.label for brace in braces) or "none" for braces in self.sets)


def contact_names(braces: Sequence[Candidate]) -> list[str]:
    """Return names of braces as contact points; points that use several surfaces are named with their surface."""
    names = [brace.name for brace in braces]
    return [f"{b.name}_{b.surface}" if names.count(b.name) > 1 else b.name for b in braces]


class Phase(NamedTuple):
    """Part of a path with one set of braces, from ``start`` to ``end`` [s]."""

    start: float
    end: float
    braces: BraceSet


class Clear(NamedTuple):
    """Point that must stay clear of a surface.

    Attributes
    ----------
    joint : int
        Index of the joint that carries the point.
    point : (3,) ndarray
        Point in the frame of this joint's link [m].
    radius : float
        Radius of a sphere around the point [m].
    margin : float
        Minimum distance [m].
    label : str
        Name of point and surface.
    surface : int
        Index of the surface.
    solid : bool
        Whether the point belongs to a collision shape.
    """

    joint: int
    point: Array
    radius: float
    margin: float
    label: str
    surface: int
    solid: bool = False


Key = tuple[int, int, tuple[float, ...]]


def key(joint: int, surface: int, point: Array) -> Key:
    """Return a key that is the same for equal points and surfaces, given the indices of joint and surface."""
    return joint, surface, tuple(point.round(9).tolist())


@dataclass(frozen=True)
class Options:
    """Options of the planner.

    Attributes
    ----------
    candidates : tuple of str
        Links, ranges of links ``first:last``, frames or declared contact points; empty: all links except the first
        two, and all declared points.
    along : tuple of float
        Fractions of the link length, 0 to 1, at which there are additional candidates.
    radius_m : float or None
        Radius of the candidates [m]; None: the radius of the link or of the declared point.
    count : tuple of int
        Minimum and maximum number of braces.
    surfaces : tuple of str
        Surfaces that braces may use; empty: all.
    peak : float
        Cost of the maximum torque of revolute joints [W/(N m)].
    clearance_m : float
        Minimum distance of unbraced joints from surfaces and of links from objects [m]; links between joints must not
        touch.
    min_N : float
        Minimum normal force of a brace [N].
    starts, seed : int
        Number of rounds of a search, and seed of the random postures.
    budget_s : float
        Time after which no search starts or continues, except for the first [s].
    exhaustive : bool
        Whether to try every set of candidates.
    phases : tuple of int
        Minimum and maximum number of sets of braces along the path.
    """

    candidates: tuple[str, ...] = ()
    along: tuple[float, ...] = ()
    radius_m: float | None = None
    count: tuple[int, int] = (0, 3)
    surfaces: tuple[str, ...] = ()
    peak: float = 0.0
    clearance_m: float = 0.01
    min_N: float = 0.5
    starts: int = 4
    seed: int = 0
    budget_s: float = 30.0
    exhaustive: bool = False
    phases: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class Task:
    """Planning problem of a scenario.

    ``turn`` is the target rotation of the hand in the world, or None; ``link_m`` is the clearance of links [m].
    """

    scenario: Scenario
    options: Options
    arm: MovingArm
    path: HandPath
    turn: Array | None
    kind: Kind
    candidates: tuple[Candidate, ...]
    friction: float
    link_m: float = LINK_CLEARANCE

    @property
    def without_radius(self) -> list[str]:
        """Names of the candidates whose radius is zero because their link has no radius."""
        if self.options.radius_m is not None:
            return []
        declared = self.scenario.config.contacts.points
        return list(dict.fromkeys(c.name for c in self.candidates if c.radius == 0.0 and c.name not in declared))

    @cached_property
    def _known(self) -> dict[Any, Any]:
        """Cache: courses by number of knots, points by braces, and workspaces by problem size."""
        return {}

    def _cached(self, key: Any, make: Callable[[], T]) -> T:
        """Return the cached value of a key; compute it on first use."""
        if key not in self._known:
            self._known[key] = make()
        return cast("T", self._known[key])

    def clearer(self, clearance_m: float) -> Task:
        """Return the task with at least this clearance of links and unbraced joints [m]."""
        options = replace(self.options, clearance_m=max(self.options.clearance_m, clearance_m))
        return replace(self, options=options, link_m=max(self.link_m, clearance_m))

    @property
    def duration(self) -> float:
        """Duration of the path [s]."""
        return float(self.scenario.duration_s)

    def targets(self, times: Array) -> Array:
        """Return the positions of the hand on its path, shape (T, 3) [m]."""
        return np.asarray(self.path.position(np.asarray(times, dtype=np.float64)), dtype=np.float64)

    def hand_targets(self, times: Array) -> Array:
        """Return the targets of the hand, shape (T, 3) [m]; with an orientation also its z and x axis, (T, 9)."""
        targets, turn = self.targets(times), self.turn
        if turn is None:
            return targets
        axes = (turn @ self.arm.model.robot.hand_axes.T)[:, [2, 0]].T
        return np.hstack([targets, np.tile(axes.ravel(), (len(targets), 1))])

    @property
    def span(self) -> float:
        """Time that the knots cover [s], which is half of the duration for a path there and back."""
        return 0.5 * self.duration if self.kind == "there_and_back" else self.duration

    @cached_property
    def rests(self) -> bool:
        """Whether the hand is at rest at the start and at the end of the path."""
        ends = ((0.0, INSTANT), (self.duration - INSTANT, self.duration))
        return all(np.linalg.norm(np.diff(self.targets(np.array(end)), axis=0)) < REST_SPEED * INSTANT for end in ends)

    def times(self, count: int) -> Array:
        """Return the times of ``count`` knots [s]."""
        if count == 1:
            return np.array([0.5 * self.span])
        if self.kind == "closed":
            return np.linspace(0.0, self.span, count, endpoint=False)
        return np.linspace(0.0, self.span, count)

    @cached_property
    def _own(self) -> set[str]:
        """Names of the robot's links and of its root; other bodies are objects."""
        robot = self.arm.model.robot
        return {robot.root or WORLD, *(link.name for link in robot.links)}

    @cached_property
    def clear(self) -> dict[Key, Clear]:
        """Points that must stay clear of surfaces unless they are braced; for planes, the ends of links suffice."""
        robot, arm = self.arm.model.robot, self.arm
        points: dict[Key, Clear] = {}
        rng = np.random.default_rng(0)
        postures = arm.coordinates(rng.normal(size=(4, arm.n)))

        def moves(link: int, point: Array) -> bool:
            places = np.array([arm.model.point_position(link, point, q) for q in postures])
            return bool(np.ptp(places, axis=0).max() > 1e-9)

        margin = self.options.clearance_m
        ends = [(k, np.zeros(3), _thickness(arm, k), margin, robot.links[i].joint) for k, i in enumerate(arm.links)]
        hand, hand_point = robot.attach(*robot.hand)
        ends.append((arm.links.index(hand), hand_point, robot.links[hand].radius, margin, "hand"))
        middles = [
            (k, point, radius, self.link_m, f"{robot.links[arm.links[k]].name} at {share:g}")
            for k, point, radius, share in axis_points(arm, ALONG)
        ]
        shaped = [k for k, i in enumerate(arm.links) if robot.links[i].solids and not robot.links[i].radius]
        own = solids_of(robot) if shaped else {}
        solids = [(k, *at) for k in shaped for at in solid_points(own[robot.links[arm.links[k]].name])]
        surfaces = build.surfaces(self.scenario)
        for index, name in enumerate(arm.surfaces):
            surface = surfaces[name]
            flat = isinstance(surface, Quadric) and surface.drawn.kind == "plane"
            for k, point, radius, least, label in ends if flat else [*ends, *middles]:
                if moves(arm.links[k], point):
                    points[key(k, index, point)] = Clear(k, point, radius, least, f"{label} on {name}", index)
            for k, point, radius, edge in solids:
                if (edge or not flat) and moves(arm.links[k], point):
                    at = key(k, index, point)
                    label = f"{robot.links[arm.links[k]].name} on {name}"
                    made = Clear(k, point, radius, self.link_m, label, index, solid=True)
                    if (joint := points.get(at)) is not None:
                        made = joint._replace(radius=max(radius, joint.radius))
                    points[at] = made
        return points

    def free(self, braces: Sequence[Candidate]) -> dict[Key, Clear]:
        """Points that must stay clear: neither braced, nor parts of solids within the spheres of the braces."""
        tables, surfaces = self.arm.tables, self.arm.surfaces
        braced = {key(b.joint, surfaces.index(b.surface), b.on_joint) for b in braces}
        spheres = [(b.joint, b.on_joint, b) for b in braces]
        # The end of a link is the start of the next one.
        spheres += [(int(tables.parent[j]), tables.origin[j], b) for j, at, b in spheres if not at.any()]

        def within(point: Clear) -> bool:
            return any(
                joint == point.joint
                and surfaces.index(b.surface) == point.surface
                and float(np.linalg.norm(point.point - centre)) + point.radius <= b.radius + LINK_CLEARANCE
                for joint, centre, b in spheres
            )

        return {k: point for k, point in self.clear.items() if k not in braced and not (point.solid and within(point))}

    def points(self, braces: Sequence[Candidate]) -> Points:
        """Return the tables of the braces, followed by the points that must stay clear."""
        on = [self.arm.surfaces.index(b.surface) for b in braces]
        braced = {
            key(b.joint, s, b.on_joint): Clear(b.joint, b.on_joint, b.radius, 0.0, b.name, s)
            for b, s in zip(braces, on, strict=True)
        }
        rows = [*braced.values(), *self.free(braces).values()]
        for m, pair in enumerate(self.arm.pairs):
            least = self.link_m if self._own.issuperset(pair) else self.options.clearance_m
            rows.append(Clear(0, np.zeros(3), 0.0, least, "", -1 - m))
        return Points(
            body=integers([row.joint for row in rows]),
            point=reals([row.point for row in rows]).reshape(-1, 3),
            radius=reals([row.radius for row in rows]),
            surface=integers([row.surface for row in rows]),
            margin=reals([row.margin for row in rows]),
            friction=reals(np.full(len(braces), self.friction)),
        )

    def pair_gaps(self, q: Array) -> Array:
        """Return the distances of pairs of solids in postures (T, n), shape (T, m) [m]; inf if far apart."""
        problem, gaps = self.problem((), 1), np.zeros((len(q), len(self.arm.pairs)))
        for row, gap in zip(q, gaps, strict=True):
            problem.evaluate(reals(row)[None], np.zeros((len(problem.course.knot), 0)))
            gap[:] = problem.work.gap[0, len(self.clear) :]
        return gaps

    def nearest_pair(self, times: Array, q: Array) -> tuple[float, str, float]:
        """Return the smallest distance [m] of two solids, their bodies and the time [s]; inf without pairs."""
        if not self.arm.pairs:
            return np.inf, "", 0.0
        gaps = self.pair_gaps(q)
        t, m = np.unravel_index(gaps.argmin(), gaps.shape)
        return float(gaps[t, m]), " and ".join(self.arm.pairs[m]), float(times[t])

    def course(self, count: int) -> Course:
        """Return ``count`` knots, and instants halfway between neighbouring knots, whose velocities are chord slopes.

        Both are second-order accurate in the knot spacing. If velocities were the slopes of a spline, the optimiser
        would make the slip vanish at the knots and slide in between. If chords were used at the postures of the knots,
        it would avoid much of the real friction by turning joints against each other.
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
            curve = np.diff(np.eye(count), axis=0)
        elif closed:
            curve = np.roll(np.eye(count), 1, axis=1) - 2.0 * np.eye(count) + np.roll(np.eye(count), -1, axis=1)
        else:
            curve = np.diff(np.eye(count), 2, axis=0)
        at_knots = self._accelerations(count, spacing)
        first, second = (at_knots[[pair[side] for pair in pairs]] for side in range(2))
        jerk, bend = second - first, np.repeat(0.5 * (first + second), len(signs), axis=0)
        if not pairs:
            bend = np.zeros((1, count))
        return Course(
            target=reals(self.hand_targets(times)),
            knot=integers(knot),
            blend=reals(blend),
            chord=reals(chord),
            bend=reals(bend),
            share=reals(np.full(len(knot), 1.0 / len(knot))),
            smooth=reals(SMOOTHNESS * curve.T @ curve),
            ripple=reals(RIPPLE / max(len(pairs), 1) * jerk.T @ jerk),
            slip_scale=reals([COARSE_SLIP_SCALE]),
            guided=integers(np.zeros((count, 0))),
            apart=reals(np.zeros((count, 0))),
            acting=integers(np.zeros((len(knot), 0))),
        )

    def _accelerations(self, count: int, spacing: float) -> Array:
        """Return the matrix of the accelerations at knots from three knots each, shape (K, K) [1/s²].

        Paths that start and end at rest, or turn back, continue as their mirror images. On other open paths, the
        acceleration at an end is that of its neighbour.
        """
        if count < 2:
            return np.zeros((count, count))
        index = np.arange(-1, count + 1)
        if self.kind == "closed":
            index %= count
        elif self.kind == "there_and_back" or self.rests:
            index = np.abs(index)
            index[-1] = count - 2
        else:
            index = np.clip(index, 0, count - 1)
        rows = np.diff(np.eye(count)[index], 2, axis=0) / spacing**2
        if self.kind == "open" and not self.rests:
            rows[[0, -1]] = rows[[1, -2]] if count > 2 else 0.0
        return rows

    def phases(self, schedule: BraceSchedule) -> list[Phase]:
        """Return the phases over the whole duration; on a path there and back they recur in reverse order."""
        ends = [self.span * share for share in (0.0, *schedule.borders, 1.0)]
        phases = [Phase(*part) for part in zip(ends[:-1], ends[1:], schedule.sets, strict=True)]
        if self.kind != "there_and_back":
            return phases
        back = [Phase(self.duration - p.end, self.duration - p.start, p.braces) for p in reversed(phases[:-1])]
        return [*phases[:-1], phases[-1]._replace(end=self.duration - phases[-1].start), *back]

    def intervals(self, schedule: BraceSchedule, brace: Candidate) -> tuple[tuple[float, float], ...]:
        """Return the intervals in which a brace is on its surface [s]; at a border, those of both phases overlap."""
        joined: list[tuple[float, float]] = []
        for start, end, braces in self.phases(schedule):
            if brace in braces:
                first, last = max(start - RAMP, 0.0), min(end + RAMP, self.duration)
                if joined and joined[-1][1] >= first:
                    first = joined.pop()[0]
                joined.append((first, last))
        return tuple(joined)

    def shares(self, schedule: BraceSchedule) -> list[float]:
        """Return the fraction of the duration that the phases of each brace take."""
        phases = self.phases(schedule)
        return [sum(p.end - p.start for p in phases if b in p.braces) / self.duration for b in schedule.braces]

    def idle_times(self, schedule: BraceSchedule, times: Array) -> Array:
        """Return how far times of the first pass are from the phases of each brace, shape (T, c) [s]; 0 within."""
        phases = self.phases(schedule)
        if self.kind == "closed":
            phases = [
                p._replace(start=p.start + t, end=p.end + t) for p in phases for t in (-self.span, 0.0, self.span)
            ]
        idle = np.full((len(times), len(schedule.braces)), np.inf)
        for start, end, braces in phases:
            on = [schedule.braces.index(brace) for brace in braces]
            idle[:, on] = np.minimum(idle[:, on], np.maximum(np.maximum(start - times, times - end), 0.0)[:, None])
        return idle

    def problem(
        self, braces: Sequence[Candidate] | BraceSchedule, count: int, slip_scale: float = COARSE_SLIP_SCALE,
        target: Array | None = None,
    ) -> Problem:  # fmt: skip
        """Return the problem for one brace set, or a schedule of sets, and ``count`` knots.

        Each problem has its own targets, but shares its workspace with all sets of the same size. In a problem with
        one knot, all braces are on their surfaces, and the hand is at ``target`` or in the middle of the path.
        """
        schedule = BraceSchedule.of(braces)
        braces = schedule.braces
        course = self._cached(count, lambda: self.course(count))
        points = self._cached(tuple(braces), lambda: self.points(braces))
        work = self._cached((len(braces), len(points.body), count), lambda: workspace(self.arm.n, points, course))
        guided, acting = np.ones((count, len(braces))), np.ones((len(course.knot), len(braces)))
        apart = np.zeros((count, len(braces)))
        if count > 1 and schedule.borders:
            times = self.times(count)
            idle = self.idle_times(schedule, times)
            guided = np.where(idle <= SAME, 1.0, 0.0)
            apart[idle > LIFTING * self.span] = self.options.clearance_m
            # Instants are halfway between knots.
            acting = np.where(self.idle_times(schedule, times[course.knot] + 0.5 * times[1]) == 0.0, 1.0, 0.0)
        wanted = course.target.copy() if target is None else reals(target[None])
        course = course._replace(target=wanted, slip_scale=reals([slip_scale]), acting=integers(acting))
        course = course._replace(guided=integers(guided), apart=reals(apart))
        return Problem(self.arm.tables, points, course, work, self.options.min_N, self.options.peak, self.arm.inertia)


def task(scenario: Scenario, options: Options) -> Task:
    """Build the planning problem of a scenario from its plant, surfaces, friction and hand path.

    Raises
    ------
    ModelError
        If the scenario has no arm with DC motors, no hand path or no surface, or a candidate does not exist.
    """
    # Plans and their controllers do not know errors of masses; the verification adds its own.
    scenario = replace(scenario, config=scenario.config.model_copy(update={"mass_error": None}))
    described = build.robot(scenario)
    model = Model(described)
    if scenario.config.objects:
        alone = build.unposed(without_objects(scenario))
        model = Model(replace(alone, q0=described.initial[: alone.nq]))
    surfaces = {name: surface for name, surface in build.surfaces(scenario).items() if surface.carrier is None}
    if not surfaces and options.count[1] > 0:
        raise ModelError("plan: the scenario has no surfaces; add one, or use --count 0:0")
    hand = getattr(scenario.controller, "hand", None)
    if hand is None:
        raise ModelError("plan: the scenario has no controller.hand.path; add a path for the hand")
    context = BuildContext(scenario.duration_s, model)
    path = hand.path_in_world(context)
    arm = moving_arm(model, surfaces)
    unknown = [name for name in options.surfaces if name not in surfaces]
    if unknown:
        raise ModelError(f"plan: unknown surface {unknown[0]!r} (surfaces: {', '.join(surfaces) or 'none'})")
    chosen = options.surfaces or tuple(surfaces)
    candidates = _candidates(scenario, arm, options, chosen)
    if not candidates and options.count[1] > 0:
        raise ModelError("plan: there are no candidates for braces; list links or contact points in --candidates")
    points = len({candidate.location for candidate in candidates})
    if options.count[0] > points:
        raise ModelError(
            f"plan: {options.count[0]} braces are requested, but there are only {points} candidates; lower --count"
        )
    kind = _kind(path, scenario.duration_s)
    friction = scenario.config.contacts.friction
    made = Task(scenario, options, arm, path, hand.turn_in_world(context), kind, tuple(candidates), friction)
    return _with_pairs(made, described)


def without_objects(scenario: Scenario) -> Scenario:
    """Return the scenario of the arm alone, without the surfaces, loads and ties of objects."""
    config = scenario.config

    def own(part: Any, key: str) -> bool:
        body = getattr(part, key, None) or ""
        return body not in config.objects and body.rpartition(".")[0] not in config.objects  # box, box.wheel

    kept: dict[str, Any] = {
        section: {name: part for name, part in getattr(config, section).items() if all(own(part, key) for key in keys)}
        for section, keys in OF_OBJECTS.items()
    }
    kept |= {"objects": {}, "contacts": config.contacts.model_copy(update={"between": []})}
    return replace(scenario, config=config.model_copy(update=kept))


def _with_pairs(made: Task, described: Robot) -> Task:
    """Return the task with the pairs of ``contacts.between``.

    Without that key, links stay clear of each other, of the root link and of the objects, except for solids that
    overlap in the initial posture.
    """
    arm, config = made.arm, made.scenario.config
    entries, stated, solids = list(config.contacts.between), bool(config.contacts.between), solids_of(described)
    moving = {arm.model.robot.links[i].name for i in arm.links}
    if not stated:
        if moving & solids.keys():
            entries.append(BodyPair(bodies=SELF))
        if config.objects and moving & solids.keys():
            entries.append(BodyPair(bodies=[LINKS, OBJECTS]))
    pairs = [(a, b) for a, b, _ in solid_pairs(entries, described, config.objects, solids)]
    pairs.sort(key=lambda pair: pair[1].carrier is None)
    made = replace(made, arm=with_pairs(arm, described, pairs))
    if stated or not made.arm.pairs:
        return made
    start = made.pair_gaps(arm.model.robot.initial[None, list(arm.columns)])[0]
    touching = {pair for pair, gap in zip(made.arm.pairs, start, strict=True) if gap <= 0.0}
    pairs = [(a, b) for a, b in pairs if (a.carrier, b.carrier or described.root or WORLD) not in touching]
    return replace(made, arm=with_pairs(arm, described, pairs)) if touching else made


def solid_points(solids: Sequence[Solid]) -> list[tuple[Array, float, bool]]:
    """Return spheres of solids: centre [m], radius [m], and whether it is at a corner or end.

    The corners suffice for planes.
    """
    points: list[tuple[Array, float, bool]] = []
    for solid in solids:
        if isinstance(solid, Capsule):
            shares = (0.0,) if solid.is_sphere else (0.0, 1.0, *ALONG)
            points += [(solid.start + share * solid.axis, solid.radius, share in (0.0, 1.0)) for share in shares]
        else:
            points += [(corner, solid.edge_radius, True) for corner in solid.corners]
            points.append((solid.centre, 0.5 * float(solid.edges.min()), False))
    return points


def _kind(path: HandPath, duration: float) -> Kind:
    """Return the kind of a path: it goes there and back, returns to its start, or is open."""
    times = np.linspace(0.0, duration, 33)
    there = np.asarray(path.position(times))
    if np.abs(there - there[::-1]).max() <= SAME and np.ptp(there, axis=0).max() > SAME:
        return "there_and_back"
    return "closed" if np.abs(there[0] - there[-1]).max() <= SAME else "open"


def _thickness(arm: MovingArm, k: int) -> float:
    """Return the radius at the start of a link: the larger radius of the two adjacent links [m]."""
    links, parent = arm.model.robot.links, int(arm.tables.parent[k])
    own = links[arm.links[k]].radius
    return own if parent < 0 else max(own, links[arm.links[parent]].radius)


def _candidates(scenario: Scenario, arm: MovingArm, options: Options, surfaces: Sequence[str]) -> list[Candidate]:
    """Return the candidate points, each combined with each surface that it may use."""
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
                raise ModelError(f"plan: unknown link {end!r} in {text!r} (links: {', '.join(links)})")
        if links.index(first) > links.index(last):
            raise ModelError(f"plan: the range {text!r} is reversed; write {last}:{first}")
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
            raise ModelError(f"plan: unknown candidate {name!r} (contact points, links and frames: {known_names})")
        k = links.index(name)
        radius = robot.links[arm.links[k]].radius
        add(name, name, np.zeros(3), _thickness(arm, k), surfaces)
        for share in options.along:
            if (k, share) in along:
                add(f"{name}_at_{share:g}", name, along[k, share], radius, surfaces)
    return candidates

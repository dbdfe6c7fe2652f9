"""Tables of an arm for the planner's compiled statics, and the local solver for one set of braces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_type_hints

import numpy as np

from dynsim.compile.clearance import axis_ends
from dynsim.compile.model import Model
from dynsim.compile.shapes import solid_row
from dynsim.compile.solids import Solid
from dynsim.dynamics.contact.solids import pair_arrays
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import WORLD, Array, Robot
from dynsim.model.drives import Motor
from dynsim.model.surfaces import Surface, shape_arrays
from dynsim.planner.compiled import retract, statics
from dynsim.planner.compiled import solve as local
from dynsim.planner.compiled.tables import Arm, Course, Points, Work

# Distance that plans keep from joint limits [rad or m], and its maximum as a fraction of the joint range. It is a
# margin for low gains.
FROM_STOP, FROM_STOP_SHARE = 0.05, 0.05


@dataclass(frozen=True)
class MovingArm:
    """Joints of a robot on a fixed base that a plan moves, in the order of the links.

    Attributes
    ----------
    model : Model
        Model of the robot.
    tables : Arm
        Tables for the compiled functions.
    links : tuple of int
        Index of each joint's link in the robot.
    columns : tuple of int
        Column of each joint in q.
    surfaces : tuple of str
        Names of the surfaces, in the order of the tables.
    pairs : tuple of (str, str)
        Bodies whose solids must stay clear of each other, for each pair of solids in the tables.
    """

    model: Model
    tables: Arm
    links: tuple[int, ...]
    columns: tuple[int, ...]
    surfaces: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...] = ()

    @property
    def n(self) -> int:
        """Number of moving joints."""
        return len(self.links)

    @property
    def motors(self) -> list[Motor]:
        """Motors of the moving joints."""
        known = {motor.joint: motor for motor in self.model.robot.motors}
        return [motor for joint in self.joints if isinstance(motor := known[joint], Motor)]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the moving joints."""
        return tuple(self.model.robot.links[i].joint for i in self.links)

    def attached(self, body: str, point: Array) -> tuple[int, Array]:
        """Return the joint that carries a body or frame, and the point in the frame of that joint's link [m]."""
        link, on_link = self.model.robot.attach(body, point)
        if link not in self.links:
            raise ModelError(f"{body} is not moved by any joint and cannot be braced; remove it from the candidates")
        return self.links.index(link), on_link

    def inertia(self, q: Array) -> Array:
        """Return the inertia of the joints with their rotors, J_m + M(q), shape (n, n) [kg m²; kg m, kg]."""
        whole = self.model.mass_matrix(self.coordinates(q[None])[0]) + np.diag(self.model.armature)
        return whole[np.ix_(self.links, self.links)]

    def coordinates(self, q: Array) -> Array:
        """Return all coordinates of the robot, shape (T, nq), for joint positions of shape (T, n) [rad or m]."""
        whole = np.tile(self.model.robot.initial, (len(q), 1))
        whole[:, list(self.columns)] = q
        return whole


def moving_arm(model: Model, surfaces: Mapping[str, Surface]) -> MovingArm:
    """Build the tables of a robot.

    Raises
    ------
    ModelError
        If a joint has several coordinates or no DC motor, joints are coupled, or no joint moves the hand.
    """
    robot = model.robot
    if robot.couplings:
        raise ModelError("plan: robots with coupled joints are not supported, because these joints share a motor")
    wheels = () if robot.base is None else robot.base.wheels
    links = [i for i, link in enumerate(robot.links) if link.joint not in wheels]
    motors = {motor.joint: motor for motor in robot.motors}
    heat, greatest = [], []
    for i in links:
        link = robot.links[i]
        if link.kind not in ("revolute", "prismatic"):
            raise ModelError(
                f"plan: {link.joint} is of kind {link.kind}; only revolute and prismatic joints are supported"
            )
        motor = motors.get(link.joint)
        if not isinstance(motor, Motor):
            raise ModelError(f"plan: {link.joint} has no DC motor, whose heat can be minimised; set its motor in plant")
        heat.append(motor.resistance / motor.joint_constant**2)
        greatest.append(min(motor.stall_torque, link.effort_limit))
    index, start = {robot.links[i].name: k for k, i in enumerate(links)}, robot.initial
    parent, rotation, origin = [], [], []
    for i in links:
        link = robot.links[i]
        R, p = link.R_PJ, link.p_PJ
        if link.parent is not None and link.parent not in index:
            R_WP, p_WP = model.body_pose(link.parent, start)
            R, p = R_WP @ R, p_WP + R_WP @ p
        parent.append(index.get(link.parent, -1) if link.parent is not None else -1)
        rotation.append(R)
        origin.append(p)
    hand, hand_point = robot.attach(*robot.hand)
    if hand not in links:
        raise ModelError("plan: no joint moves the hand")
    chosen = [robot.links[i] for i in links]
    tables = Arm(
        parent=integers(parent),
        prismatic=integers([link.kind == "prismatic" for link in chosen]),
        rotation=reals(rotation).reshape(-1, 9),
        origin=reals(origin),
        axis=reals([link.axis for link in chosen]),
        mass=reals([link.inertia.mass for link in chosen]),
        com=reals([link.inertia.com for link in chosen]),
        losses=reals(model.damping[links]),
        heat=reals(heat),
        greatest=reals(greatest),
        lower=reals([link.lower for link in chosen]),
        upper=reals([link.upper for link in chosen]),
        gravity=reals([robot.gravity]),
        hand=integers([links.index(hand)]),
        hand_point=reals([hand_point]),
        shapes=shape_arrays([(surface, 0.0, np.zeros(3), False) for surface in surfaces.values()]),
    )
    room = np.minimum(FROM_STOP, FROM_STOP_SHARE * (tables.upper - tables.lower))
    bounded = np.isfinite(room)
    tables.lower[bounded] += room[bounded]
    tables.upper[bounded] -= room[bounded]
    for bound, sign in ((tables.lower, 1.0), (tables.upper, -1.0)):
        one_sided = np.isfinite(bound) & ~bounded
        bound[one_sided] += sign * FROM_STOP
    columns = tuple(robot.position_index[i] for i in links)
    return MovingArm(model, tables, tuple(links), columns, tuple(surfaces))


def with_pairs(arm: MovingArm, described: Robot, pairs: Sequence[tuple[Solid, Solid]]) -> MovingArm:
    """Return the arm whose tables include pairs of solids; bodies that no joint of the arm moves keep their poses.

    ``described`` is the robot with the objects. Pairs that cannot move against each other are omitted.
    """
    model, index, rows, names = Model(described), list[list[int]](), list[list[Array]](), list[tuple[str, str]]()
    joint = {arm.model.robot.links[i].name: k for k, i in enumerate(arm.links)}
    for pair in pairs:
        bodies = [solid.carrier or described.root or WORLD for solid in pair]
        solids = [solid_row(solid) for solid in pair]
        joints = [joint.get(body, -1) for body in bodies]
        if max(joints) < 0:
            continue
        for solid, row, k in zip(pair, solids, joints, strict=True):
            if k < 0 and solid.carrier is not None:
                R, p = model.body_pose(solid.carrier, described.initial)
                row[:9] = (R @ row[:9].reshape(3, 3)).ravel()
                row[9:12] = p + R @ row[9:12]
        index.append(joints)
        rows.append(solids)
        names.append((bodies[0], bodies[1]))
    tables = pair_arrays(np.array(index), np.array(rows)) if index else None
    return replace(arm, tables=arm.tables._replace(pairs=tables), pairs=tuple(names))


def axis_points(arm: MovingArm, shares: Sequence[float]) -> list[tuple[int, Array, float, float]]:
    """Return points along the axes of all links.

    Each entry is the index of the joint, the point [m], the radius [m] and the fraction of the link length. An axis
    runs from the link's joint to an end from :func:`dynsim.compile.clearance.axis_ends`.
    """
    robot = arm.model.robot
    ends = axis_ends(robot)
    return [
        (k, share * end, robot.links[i].radius, share)
        for k, i in enumerate(arm.links)
        for end in ends[robot.links[i].name]
        if np.linalg.norm(end) > 1e-9
        for share in shares
    ]


def axis_lines(arm: MovingArm, q: Array) -> Array:
    """Return both ends of the axes of all links, in the order of :func:`axis_points`, (m, 2, 3) [m], in a posture."""
    whole = arm.coordinates(q[None])[0]
    lines = []
    for k, end, _, _ in axis_points(arm, (1.0,)):
        R, p = arm.model.body_pose(arm.links[k], whole)
        lines.append((p, p + R @ end))
    return np.array(lines).reshape(-1, 2, 3)


# Local solver: it finds postures along the path and brace forces of least heat for one set of braces.


# Maximum number of constraints in one step. A few early steps (2 to 10 % where there are boxes) would need more, and
# ignore the others; the projection that follows meets them, or the step is rejected.
WORKING_SETS = 160


@dataclass
class Problem:
    """Planning problem for one set of braces and a number of knots.

    Attributes
    ----------
    arm, points, course : Arm, Points, Course
        Tables for the compiled functions.
    work : Work
        Workspace with the results, shared by problems of the same size.
    min_force : float
        Minimum normal force of a brace [N].
    peak : float
        Cost of the maximum torque of revolute joints [W/(N m)].
    inertia : callable or None
        Function that returns the inertia J_m + M of a posture, shape (n, n); None: without inertia.
    """

    arm: Arm
    points: Points
    course: Course
    work: Work
    min_force: float
    peak: float = 0.0
    inertia: Callable[[Array], Array] | None = None

    def evaluate(self, Q: Array, F: Array) -> None:
        """Compute torques, geometry and derivatives in the workspace."""
        statics.statics(self.arm, self.points, self.course, self.work, Q, F, self.min_force, False)

    def forces(self, Q: Array) -> Array:
        """Return the normal forces of least heat, shape (E, c) [N]; the workspace contains the resulting torques."""
        F = np.zeros((len(self.course.knot), len(self.points.friction)))
        statics.statics(self.arm, self.points, self.course, self.work, Q, F, self.min_force, True)
        return F

    def freeze_inertia(self, Q: Array) -> None:
        """Write the inertia of the postures between the knots to the workspace; solutions consider it as constant."""
        course, work = self.course, self.work
        if self.inertia is None or len(Q) == 1:
            return
        for e, knot in enumerate(course.knot):
            again = e > 0 and knot == course.knot[e - 1]
            work.inertia[e] = work.inertia[e - 1] if again else self.inertia(course.blend[e] @ Q)
        work.jolt[:] = np.einsum("e,eij,j,ejk->ik", course.share, work.inertia, self.arm.heat, work.inertia)

    def heat(self) -> float:
        """Return the mean heat of the torques in the workspace [W]."""
        return float(self.course.share @ (self.work.torque**2 @ self.arm.heat))

    def retract(self, Q: Array, steps: int = 12, tolerance: float = retract.ON) -> float:
        """Project postures in place, so that the hand is on its path and the braces touch; return the residual [m]."""
        return float(retract.project(self.arm, self.points, self.course, self.work, Q, steps, tolerance))


@dataclass(frozen=True)
class Local:
    """Local optimum: postures at knots, (K, n), forces at instants, (E, c) [N], heat and cost [W], number of steps."""

    Q: Array
    F: Array
    heat: float
    cost: float
    steps: int


def workspace(n: int, points: Points, course: Course) -> Work:
    """Allocate a :class:`Work` for n joints."""
    (K, h), E, c, P = course.target.shape, len(course.knot), len(points.friction), len(points.body)
    N, R = K * n + E * c, h + P + n
    W = max(min(WORKING_SETS, K * (P + 2 * n) + E * c), c)

    sizes = {"n": n, "2n": 2 * n, "c": c, "K": K, "K+1": K + 1, "E": E, "h": h, "P": P, "N": N, "R": R, "W": W}
    sizes |= {"Kn+c": K * n + c, "max(N,n)": max(N, n), "max(W,R)": max(W, R)}
    arrays: dict[str, Any] = {}
    for name, hint in get_type_hints(Work, include_extras=True).items():
        shape, *kind = hint.__metadata__
        lengths = [int(size) if size.isdigit() else sizes[size] for size in shape.split()]
        arrays[name] = np.zeros(lengths, dtype=np.int64 if kind else np.float64)
    return Work(**arrays)


def solve(
    problem: Problem, start: Array, turns: int = 40, tolerance: float = 1e-4, most: float = math.inf
) -> Local | None:
    """Minimise the cost from start postures, (K, n); return None if they cannot be projected onto path and surfaces.

    The iteration ends early if the cost is unlikely to fall below ``most`` [W].
    """
    Q, F = reals(start), np.zeros((len(problem.course.knot), len(problem.points.friction)))
    tables = problem.arm, problem.points, problem.course, problem.work
    problem.freeze_inertia(Q)
    cost, heat, steps = local.solve(*tables, Q, F, problem.min_force, problem.peak, turns, tolerance, most)
    return None if np.isnan(cost) else Local(Q, F, heat, cost, steps)

"""Tables of an arm for the planner's compiled statics: the joints that move, surfaces, points along link axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dynsim.compile.clearance import axis_ends
from dynsim.compile.model import Model
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Array
from dynsim.model.drives import Motor
from dynsim.model.surfaces import Surface, shape_arrays
from dynsim.planner import compiled
from dynsim.planner.compiled import Arm, Course, Points, Work

# Distance that plans keep from joint limits [rad or m], at most this share of the range: for errors under soft gains.
FROM_STOP, FROM_STOP_SHARE = 0.05, 0.05


@dataclass(frozen=True)
class MovingArm:
    """The joints of a robot that a plan moves, in their order, on a base that stands.

    Attributes
    ----------
    tables : for the compiled functions
    links : index of each joint's link in the robot
    columns : of each joint in q
    surfaces : names, in the order of the tables
    """

    model: Model
    tables: Arm
    links: tuple[int, ...]
    columns: tuple[int, ...]
    surfaces: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of joints that move."""
        return len(self.links)

    @property
    def joints(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self.model.robot.links[i].joint for i in self.links)

    def attached(self, body: str, point: Array) -> tuple[int, Array]:
        """Which joint carries a body or frame, and the point in the frame of that joint's link [m]."""
        link, on_link = self.model.robot.attach(body, point)
        if link not in self.links:
            raise ModelError(f"{body} stands still: only what the arm's joints move can be braced")
        return self.links.index(link), on_link

    def coordinates(self, q: Array) -> Array:
        """All coordinates of the robot for positions of the joints, (T, n) → (T, nq)."""
        whole = np.tile(self.model.robot.initial, (len(q), 1))
        whole[:, list(self.columns)] = q
        return whole


def moving_arm(model: Model, surfaces: Mapping[str, Surface]) -> MovingArm:
    """Tables of a robot.

    Raises
    ------
    ModelError
        A joint with several coordinates, coupled joints, a hand that no joint moves, or a joint without a DC motor.
    """
    robot = model.robot
    if robot.couplings:
        raise ModelError("plan: not for robots with coupled joints, which share a motor")
    wheels = () if robot.base is None else robot.base.wheels
    links = [i for i, link in enumerate(robot.links) if link.joint not in wheels]
    motors = {motor.joint: motor for motor in robot.motors}
    heat, greatest = [], []
    for i in links:
        link = robot.links[i]
        if link.kind not in ("revolute", "prismatic"):
            raise ModelError(
                f"plan: {link.joint} is a joint of kind {link.kind}; revolute and prismatic ones are planned"
            )
        motor = motors.get(link.joint)
        if not isinstance(motor, Motor):
            raise ModelError(
                f"plan: {link.joint} has no DC motor, whose heat is what is planned for; give it plant…motor"
            )
        heat.append(motor.resistance / motor.joint_constant**2)
        current = min(motor.greatest_current, motor.voltage_limit / motor.resistance)
        greatest.append(min(motor.joint_constant * current, link.effort_limit))
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


def axis_points(arm: MovingArm, shares: Sequence[float]) -> list[tuple[int, Array, float, float]]:
    """Points along the axes of all links: joint that carries them, point [m], radius [m], share of the way.

    From each link's joint to the ends that :func:`dynsim.compile.clearance.axis_ends` gives it.
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


# The local solver: for one set of braces, the postures along the path and brace forces of least heat.


# Most constraints that take part in one step.
WORKING_SETS = 160


@dataclass
class Problem:
    """One set of braces at some knots.

    Attributes
    ----------
    work : results, until another problem with the same room is evaluated
    peak : cost of the greatest torque of revolute joints [W/(N m)]
    """

    arm: Arm
    points: Points
    course: Course
    work: Work
    least: float
    peak: float = 0.0

    def evaluate(self, Q: Array, F: Array) -> None:
        """Torques, geometry and derivatives into the workspace."""
        compiled.settle(self.arm, self.points, self.course, self.work, Q, F, self.least, False)

    def forces(self, Q: Array) -> Array:
        """Normal forces of least heat, (E, c) [N]; the workspace holds what goes with them."""
        F = np.zeros((len(self.course.knot), len(self.points.friction)))
        compiled.settle(self.arm, self.points, self.course, self.work, Q, F, self.least, True)
        return F

    def heat(self) -> float:
        """Mean heat of what is in the workspace [W]."""
        return float(self.course.share @ (self.work.torque**2 @ self.arm.heat))

    def retract(self, Q: Array, steps: int = 12, tolerance: float = compiled.ON) -> float:
        """Put postures onto hand path and braces, in place; what is left [m]."""
        reach = 2.0 * compiled.REACH / 3.0
        return float(compiled.retract(self.arm, self.points, self.course, self.work, Q, steps, tolerance, reach))


@dataclass(frozen=True)
class Local:
    """Postures at the knots, (K, n), forces at the instants, (E, c) [N], heat and cost [W], and steps taken."""

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

    def zeros(*shape: int) -> Array:
        return np.zeros(shape)

    def ints(*shape: int) -> Array:
        return integers(np.zeros(shape))

    return Work(
        torque=zeros(E, n), by_q=zeros(E, n, n), by_v=zeros(E, n, n), by_f=zeros(E, n, c), gap=zeros(K + 1, P),
        gap_rate=zeros(K + 1, P, n), hand=zeros(K + 1, h), hand_rate=zeros(K + 1, h, n), R=zeros(n, 9), p=zeros(n, 3),
        a=zeros(n, 3), below=zeros(n, 4), moment=zeros(n, 3), touch=zeros(c, n, 3), turned=zeros(c, n, 3),
        normal=zeros(c, 3), shift=zeros(c, n, 3), slip=zeros(c, 7), force=zeros(c, 3), turn=zeros(n, 3),
        drift=zeros(n, 3), basis=zeros(K, n, n), free=ints(K), rows=zeros(R, n),
        normal_matrix=zeros(R, R), right=zeros(R), H=zeros(N, N), g=zeros(N), x=zeros(max(N, n)), step=zeros(N),
        B=zeros(n, K * n + c), column=ints(K * n + c), start=ints(K), pressed=ints(E), skyline=ints(N),
        working=ints(W, 3), bound=zeros(W),
        normals=zeros(N, W), dual=zeros(W, W), dual_right=zeros(W), multiplier=zeros(W), passive=ints(W),
        small=zeros(W, W), small_right=zeros(W), index=ints(W), small_skyline=ints(max(W, R)),
        between=zeros(n), rate=zeros(n), weight=zeros(E, n), pull=zeros(E, n), change=zeros(K, n), trial=zeros(K, n),
        trial_forces=zeros(E, c),
    )  # fmt: skip


def solve(problem: Problem, start: Array, turns: int = 40, tolerance: float = 1e-4) -> Local | None:
    """Postures and forces of least cost from a start, (K, n); None where that cannot be put onto path and surfaces."""
    Q, F = reals(start), np.zeros((len(problem.course.knot), len(problem.points.friction)))
    cost, heat, steps = compiled.solve(
        problem.arm, problem.points, problem.course, problem.work, Q, F, problem.least, problem.peak, turns, tolerance
    )
    return None if np.isnan(cost) else Local(Q, F, heat, cost, steps)

"""The local solver: for one set of braces, the postures along the path and brace forces of least heat.

    minimise   Σ_e share_e Σ_j w_ej τ_ej² + ε |S q|²   over postures q_k at knots and forces f_e ≥ min_N
    subject to hand(q_k) = p_k,  gap_c(q_k) = 0,  clearances, limits of joints

Gauss–Newton method on the manifold of the equations: a step in its tangent space (with a basis at each knot), kept
within the inequalities by a dual active-set method; then the least change back onto the manifold, and the forces of
least heat for each instant. So every iterate is feasible, and a step is accepted by its cost alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Array
from dynsim.planner import compiled
from dynsim.planner.compiled import Arm, Course, Points, Work

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

"""The local solver: postures of one set of braces along the path, and their forces, of least heat.

    minimise   Σ_e share_e Σ_j w_ej τ_ej² + ε |S q|²   over postures q_k at knots and forces f_e ≥ min_N
    subject to hand(q_k) = p_k,  gap_c(q_k) = 0,  clearances, limits of joints

Gauss and Newton's method on the manifold of the equations: a step in what they leave free (a basis of it at each
knot), kept within the inequalities by dual active sets; then back onto the manifold by least change, and the forces of
least heat of each instant anew. So every iterate is feasible, and the heat alone tells whether a step is good.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Array
from dynsim.planner import compiled
from dynsim.planner.compiled import Arm, Course, Points, Work

# Distance from hand path and surfaces that counts as none [m].
ON = 1e-9
# First damping of the steps beside the curvature of the heat, and its bounds, over the largest of that curvature.
DAMPING, DAMPING_MIN, DAMPING_MAX = 1e-3, 1e-7, 1e6
# Longest step of a coordinate in one turn [rad or m].
REACH = 0.6
# Torques beyond this part of their limits cost extra, so many times what they cost as heat.
NEAR_LIMIT, DEAR = 0.98, 100.0
# Exponent of the mean that stands for the peak of the torques.
PEAK_POWER = 12
WORKING_SETS = 160


@dataclass
class Problem:
    """One set of braces at some knots.

    Attributes
    ----------
    peak : cost of the greatest torque [W/(N m)]
    """

    arm: Arm
    points: Points
    course: Course
    least: float
    smooth: Array
    peak: float = 0.0
    work: Work = field(init=False)

    def __post_init__(self) -> None:
        K, E = self.course.smooth.shape[0], len(self.course.knot)
        n, c, P = len(self.arm.parent), len(self.points.friction), len(self.points.body)
        self.work = workspace(n, c, P, K, E, self.course.target.shape[1])

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Knots, instants, joints, braces."""
        return len(self.course.target), len(self.course.knot), len(self.arm.parent), len(self.points.friction)

    def evaluate(self, Q: Array, F: Array, derivatives: bool = True) -> None:
        """Torques, geometry and derivatives into the workspace."""
        compiled.evaluate(self.arm, self.points, self.course, self.work, Q, self.course.chord @ Q, F, derivatives)

    def forces(self, Q: Array) -> Array:
        """Normal forces of least heat, (E, c) [N]."""
        _, E, _, c = self.sizes
        F = np.zeros((E, c))
        if c:
            self.evaluate(Q, F, False)
            weight, _ = self._weights(within=False)
            compiled.least_heat(self.arm, self.work, weight, self.least, F)
        return F

    def heat(self) -> float:
        """Mean heat of what is in the workspace [W]."""
        return float(self.course.share @ (self.work.torque**2 @ self.arm.heat))

    def cost(self, Q: Array) -> float:
        """What is minimised, of what is in the workspace [W]."""
        _, extra = self._weights()
        return self.heat() + extra + float(np.sum((self.smooth @ Q) ** 2))

    def _weights(self, within: bool = True) -> tuple[Array, float]:
        """Weights of the squares of torques, (E, n), and what is paid beside the heat [W]."""
        torque, arm, share = self.work.torque, self.arm, self.course.share[:, None]
        weight, extra = np.tile(arm.heat, (len(torque), 1)), 0.0
        if not within:
            return weight, extra
        over = np.abs(torque) - NEAR_LIMIT * arm.greatest
        beyond = over > 0.0
        if beyond.any():
            extra += float(np.sum(np.where(beyond, share * DEAR * arm.heat * over**2, 0.0)))
            weight = np.where(beyond, (1.0 + DEAR) * arm.heat, weight)
        if self.peak > 0.0:
            largest = np.abs(torque).max()
            if largest > 0.0:
                ratio = np.abs(torque) / largest
                mean = float(np.mean(ratio**PEAK_POWER))
                extra += self.peak * largest * mean ** (1.0 / PEAK_POWER)
        return weight, extra

    def _model(self) -> tuple[Array, Array]:
        """Weights of the squares of torques and half the gradient by torques, (E, n), each over the share of time."""
        torque, arm, share = self.work.torque, self.arm, self.course.share[:, None]
        weight, _ = self._weights()
        pull = arm.heat * torque
        over = np.abs(torque) - NEAR_LIMIT * arm.greatest
        beyond = over > 0.0
        if beyond.any():
            pull = pull + np.where(beyond, DEAR * arm.heat * np.where(beyond, over, 0.0) * np.sign(torque), 0.0)
        largest = np.abs(torque).max()
        if self.peak > 0.0 and largest > 0.0:
            ratio = np.abs(torque) / largest
            mean = float(np.mean(ratio**PEAK_POWER))
            slope = self.peak * mean ** (1.0 / PEAK_POWER - 1.0) * ratio ** (PEAK_POWER - 1) / torque.size
            pull = pull + 0.5 * slope * np.sign(torque) / share
            weight = weight + 0.5 * (PEAK_POWER - 1) * slope / np.maximum(np.abs(torque), 1e-9) / share
        return reals(weight), reals(pull)

    def retract(self, Q: Array, steps: int = 12, tolerance: float = ON) -> float:
        """Put postures onto hand path and braces, in place; what is left [m]."""
        return float(
            compiled.retract(self.arm, self.points, self.course, self.work, Q, steps, tolerance, 2.0 * REACH / 3.0)
        )


@dataclass(frozen=True)
class Local:
    """Postures at the knots, (K, n), forces at the instants, (E, c) [N], heat and cost [W], and steps taken."""

    Q: Array
    F: Array
    heat: float
    cost: float
    steps: int


def workspace(n: int, c: int, P: int, K: int, E: int, h: int) -> Work:
    """Allocate a :class:`Work`."""
    N, R, W = K * n + E * c, h + P + n, max(WORKING_SETS, c)

    def zeros(*shape: int) -> Array:
        return np.zeros(shape)

    def ints(*shape: int) -> Array:
        return integers(np.zeros(shape))

    return Work(
        torque=zeros(E, n), by_q=zeros(E, n, n), by_v=zeros(E, n, n), by_f=zeros(E, n, c), gap=zeros(K, P),
        gap_rate=zeros(K, P, n), hand=zeros(K, h), hand_rate=zeros(K, h, n), R=zeros(n, 3, 3), p=zeros(n, 3),
        a=zeros(n, 3), below=zeros(n, 4), touch=zeros(c, n, 3), centre=zeros(c, n, 3), normal=zeros(c, 3),
        bend=zeros(c, 3, 3), shift=zeros(c, n, 3), slip=zeros(c, 8), force=zeros(c, 3), turn=zeros(n, 3),
        drift=zeros(n, 3), vector=zeros(12, 3), basis=zeros(K, n, n), free=ints(K), rows=zeros(R, n),
        normal_matrix=zeros(R, R), right=zeros(R), H=zeros(N, N), g=zeros(N), x=zeros(max(N, n)), step=zeros(N),
        B=zeros(n, K * n + c), column=ints(K * n + c), start=ints(K), pressed=ints(E), skyline=ints(N), working=ints(W, 3), bound=zeros(W),
        normals=zeros(W, N), dual=zeros(W, W), dual_right=zeros(W), multiplier=zeros(W), passive=ints(W),
        small=zeros(W, W), small_right=zeros(W), index=ints(W), small_skyline=ints(max(W, R)),
    )  # fmt: skip


def solve(problem: Problem, start: Array, turns: int = 40, tolerance: float = 1e-4) -> Local | None:
    """Postures and forces of least cost from a start, (K, n); None where that cannot be put onto path and surfaces."""
    K, E, n, c = problem.sizes
    Q = reals(start)
    if problem.retract(Q, 60) > 2.0 * ON:
        return None
    arm, points, course, work = problem.arm, problem.points, problem.course, problem.work
    F = problem.forces(Q)
    problem.evaluate(Q, F)
    cost, damping, taken, quiet = problem.cost(Q), DAMPING, 0, 0
    change, dF = np.zeros((K, n)), np.zeros((E, c))
    scale = max(cost, 0.1)
    while taken < turns:
        taken += 1
        weight, pull = problem._model()
        improved = False
        while damping < DAMPING_MAX:
            N = compiled.prepare(arm, points, course, work, Q, weight, pull, damping * scale + 1e-6)
            fall = compiled.step(arm, points, course, work, Q, F, problem.least, N, change, dF)
            longest = float(np.abs(change).max(initial=0.0))
            if not fall > 0.0 or fall < tolerance * 0.1 * max(cost, 1e-3):
                break
            share = min(1.0, REACH / max(longest, 1e-300))
            trial = Q + share * change
            if problem.retract(trial, 12) <= 2.0 * ON:
                forces = problem.forces(trial)
                problem.evaluate(trial, forces)
                there = problem.cost(trial)
                ratio = (cost - there) / (fall * share * (2.0 - share))
                if there < cost:
                    improved = True
                    break
            damping *= 8.0
            problem.evaluate(Q, F)
        if not improved:
            problem.evaluate(Q, F)
            break
        gain, Q, F, cost = cost - there, trial, forces, there
        if ratio > 0.7:
            damping = max(damping / 6.0, DAMPING_MIN)
        elif ratio < 0.25:
            damping *= 3.0
        quiet = quiet + 1 if gain < tolerance * max(cost, 1e-3) else 0
        if quiet >= 2:
            break
    return Local(Q, F, problem.heat(), cost, taken)

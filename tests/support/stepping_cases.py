"""Time-stepping cases with known final states: a bead in bowls and over a hump, a knife edge, touching arms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from dynsim.dynamics import tables as ka
from dynsim.integrators.run import Run
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.model.drives import Servo
from support.random_robots import CompiledSystem, assemble
from support.stepping_systems import plane, stepped

G = 9.81
X, Y, Z = np.eye(3)


class Case(NamedTuple):
    """A system with its start, duration and required final state."""

    compiled: CompiledSystem
    q: np.ndarray
    v: np.ndarray
    until: float
    end: np.ndarray
    law: dict[int, float] = {}
    read: Callable[[np.ndarray], np.ndarray] = np.asarray  # converts positions to the form of ``end``

    def run(self, step: float, theta: float = 0.5, until: float | None = None) -> Run:
        """Run it with this step, sampled at every step."""
        until = self.until if until is None else until
        times = np.arange(round(until / step) + 1) * step
        return stepped(self.compiled, self.compiled.state(self.q, self.v), times, step, theta, self.law)

    def error(self, step: float, theta: float = 0.5) -> float:
        """Return the largest error at the end [m or rad]."""
        return float(np.abs(self.read(self.run(step, theta).states("q")[-1]) - self.end).max())


def solved(law: Callable[..., object], until: float, start: np.ndarray, *more: object) -> np.ndarray:
    """Solve an ordinary differential equation far more accurately than steps resolve, and return the end."""
    return solve_ivp(law, (0.0, until), start, "DOP853", rtol=1e-12, atol=1e-13, args=more)["y"][:, -1]


def point(contact: Contact, mass: float, *, gravity: float = G) -> CompiledSystem:
    """Return a body that does not turn, free along x, y and z, with one contact at its origin."""
    links = [
        Link(a, f"j{a}", "xy"[k - 1] if k else None, "prismatic", np.eye(3)[k], Inertia(mass if k == 2 else 0.0))
        for k, a in enumerate("xyz")
    ]
    robot = Robot("point", tuple(links), (), ("z", np.zeros(3)), gravity=np.array([0.0, 0.0, -gravity]))
    return assemble(robot, [contact], real=True)


def sphere(centre: np.ndarray, radius: float, side: float) -> Quadric:
    """Return a sphere with its free side inside (−1) or outside (1)."""
    Q = side * np.eye(3) / radius
    return Quadric(Q, -Q @ centre, 0.5 * side * (float(centre @ centre) / radius - radius))


def bowl(friction: float, *, radius: float = 0.4, mass: float = 0.3, gravity: float = G) -> CompiledSystem:
    """Return a bead in a sphere whose lowest point is the origin."""
    surface = sphere(radius * Z, radius, -1.0)
    return point(Contact("bead", "z", np.zeros(3), surface, friction=friction), mass, gravity=gravity)


def bead(friction: float = 0.0) -> Case:
    """Move around a great circle without weight; with friction the speed falls as v₀/(1 + μ v₀ t/R)."""
    radius, speed, until = 0.4, 1.7, 1.0
    rate = friction / radius
    distance = speed * until if friction == 0.0 else np.log(1.0 + rate * speed * until) / rate
    end = radius * np.array([np.sin(distance / radius), 0.0, 1.0 - np.cos(distance / radius)])
    return Case(bowl(friction, gravity=0.0), np.zeros(3), speed * X, until, end)


def spherical_bowl(friction: float) -> Case:
    """Move across with weight, so that the slip direction turns."""
    radius = 0.4
    start = np.array([0.3, 0.0, radius - np.sqrt(radius**2 - 0.09)])

    def law(_: float, y: np.ndarray) -> np.ndarray:
        x, v = y[:3] - radius * Z, y[3:]
        n = -x / np.linalg.norm(x)
        pressed = v @ v / radius + G * n[2]
        return np.r_[v, -G * Z + pressed * (n - friction * v / np.linalg.norm(v))]

    end = solved(law, 0.5, np.r_[start, 1.7 * Y])[:3]
    return Case(bowl(friction), start, 1.7 * Y, 0.5, end)


def hump() -> Case:
    """Slide a bead over a sphere, which it leaves; then it falls."""
    radius, speed, until = 0.4, 0.8, 0.35

    def leaves(_: float, y: np.ndarray) -> float:
        return G * np.cos(y[0]) - radius * y[1] ** 2

    leaves.terminal = True  # type: ignore[attr-defined]
    slide = solve_ivp(
        lambda _, y: [y[1], G / radius * np.sin(y[0])], (0.0, 2.0), [0.0, speed / radius], "DOP853",
        rtol=1e-12, atol=1e-13, events=leaves,
    )  # fmt: skip
    (angle, rate), flight = slide["y"][:, -1], until - slide["t"][-1]
    left = radius * np.array([np.sin(angle), 0.0, np.cos(angle) - 1.0])
    speeds = radius * rate * np.array([np.cos(angle), 0.0, -np.sin(angle)])
    end = left + flight * speeds - 0.5 * G * flight**2 * Z
    surface = sphere(-radius * Z, radius, 1.0)
    return Case(point(Contact("bead", "z", np.zeros(3), surface), 0.3), np.zeros(3), speed * X, until, end)


def knife_edge() -> Case:
    """Return a sleigh on one blade, with its weight slightly ahead: friction acts only across the blade."""
    mass, inertia, ahead, until = 2.0, 0.05, 0.1, 3.0
    inertias = [Inertia(0.0)] * 3 + [Inertia(mass, ahead * X, inertia * np.eye(3))]
    links = [
        Link(a, f"j{a}", "xyz"[k - 1] if k else None, "revolute" if k == 3 else "prismatic", axis, inertias[k])
        for k, (a, axis) in enumerate(zip("xyzt", (X, Y, Z, Z), strict=True))
    ]
    robot = Robot("sleigh", tuple(links), (), ("t", np.zeros(3)))
    b = assemble(robot, [Contact("blade", "t", np.zeros(3), plane(Z), friction=1e3)], real=True)

    def law(_: float, y: np.ndarray) -> list[float]:
        along, rate, angle = y[:3]
        return [
            ahead * rate**2,
            -mass * ahead * along * rate / (inertia + mass * ahead**2),
            rate,
            along * np.cos(angle),
            along * np.sin(angle),
        ]

    end = solved(law, until, np.array([0.3, 4.0, 0.0, 0.0, 0.0]))
    # Friction across the blade is μ, along it zero: the grip axis is along the blade.
    grip = {ka.GRIP: 0.0, ka.GRIP_AXIS: 1.0, ka.GRIP_AXIS + 1: 0.0, ka.GRIP_AXIS + 2: 0.0}
    return Case(b, np.zeros(4), np.array([0.3, 0.0, 0.0, 4.0]), until, np.array([end[3], end[4], 0.0, end[2]]), grip)


def incline(until: float = 0.6) -> Case:
    """Slide a block down a slope, sideways at first, so that its direction turns. After 1.5 s it is at rest."""
    friction, slope, start = 0.5, 0.4, np.array([1.5, 1.0])
    held = friction * G * np.cos(slope)

    def law(_: float, y: np.ndarray) -> np.ndarray:
        v = y[2:]
        return np.r_[v, -G * np.sin(slope) * np.array([0.0, 1.0]) - held * v / np.linalg.norm(v)]

    def rests(_: float, y: np.ndarray) -> float:
        return float(np.hypot(y[2], y[3])) - 1e-6

    rests.terminal = True  # type: ignore[attr-defined]
    solution = solve_ivp(law, (0.0, until), np.r_[0.0, 0.0, start], "DOP853", rtol=1e-12, atol=1e-13, events=rests)
    # The plane is level here and gravity is inclined.
    b = point(Contact("foot", "z", np.zeros(3), plane(Z), friction=friction), 1.0)
    b.system.model.gravity[:] = G * np.array([0.0, -np.sin(slope), -np.cos(slope)])
    return Case(b, np.zeros(3), np.r_[start, 0.0], until, np.r_[solution["y"][:2, -1], 0.0])


LENGTH, MASS, FLOOR = np.array([0.3, 0.25, 0.2]), np.array([0.5, 0.4, 0.3]), -0.1
BEND = np.eye(3) - np.eye(3, k=-1)  # joint angles from absolute angles
STIFF, DRAG = 200.0, 2.0


class Chain:
    """Three rods in a vertical plane, by absolute angles: an independent arm, with its tip on a floor or free."""

    def __init__(self) -> None:
        self.inertia, self.weight = np.zeros((3, 3)), np.zeros(3)
        for k in range(3):
            arm = np.where(np.arange(3) < k, LENGTH, 0.0)
            arm[k] = 0.5 * LENGTH[k]
            self.inertia += MASS[k] * np.outer(arm, arm)
            self.inertia[k, k] += MASS[k] * LENGTH[k] ** 2 / 12.0
            self.weight += MASS[k] * arm

    def rows(self, q: np.ndarray) -> np.ndarray:
        """Return the rows of the tip, normal and along the floor, (2, 3)."""
        return np.array([LENGTH * np.cos(q), -LENGTH * np.sin(q)])

    def law(
        self, t: float, y: np.ndarray, motion: str, friction: float = 0.0, reference: Callable | None = None
    ) -> np.ndarray:
        """Return (v, v̇) with a tip that is free along the floor, slides on it, or sticks."""
        q, v = y[:3], y[3:]
        M = self.inertia * np.cos(q[:, None] - q[None])
        force = -(self.inertia * np.sin(q[:, None] - q[None])) @ (v * v) - G * self.weight * np.cos(q)
        if reference is not None:
            force = force - BEND.T @ (STIFF * BEND @ (q - reference(t)) + DRAG * BEND @ v)
        J, bias = self.rows(q), np.array([-LENGTH * np.sin(q) @ v**2, -LENGTH * np.cos(q) @ v**2])
        held, pushed = (J, J) if motion == "sticks" else (J[:1], J[:1] - friction * J[1:])
        answer = np.linalg.solve(M, np.column_stack([force, pushed.T]))
        f = np.linalg.solve(held @ answer[:, 1:], -bias[: len(held)] - held @ answer[:, 0])
        return np.r_[v, answer[:, 0] + answer[:, 1:] @ f]


def reach(last: float, x: float, z: float = FLOOR) -> np.ndarray:
    """Return absolute angles with the tip at (x, z) and the last rod at an angle; the elbow is up."""
    px, pz = x - LENGTH[2] * np.cos(last), z - LENGTH[2] * np.sin(last)
    bend = -np.arccos((px**2 + pz**2 - LENGTH[0] ** 2 - LENGTH[1] ** 2) / (2 * LENGTH[0] * LENGTH[1]))
    first = np.arctan2(pz, px) - np.arctan2(LENGTH[1] * np.sin(bend), LENGTH[0] + LENGTH[1] * np.cos(bend))
    return np.array([first, first + bend, last])


def arm(friction: float, reference: Callable | None = None, until: float = 0.0) -> CompiledSystem:
    """Return the same arm in dynsim, with joints held to a reference of absolute angles by springs and dampers."""
    links = []
    for k in range(3):
        rod = Inertia(MASS[k], 0.5 * LENGTH[k] * X, MASS[k] * LENGTH[k] ** 2 / 12.0 * np.eye(3))
        position = LENGTH[k - 1] * X if k else np.zeros(3)
        links.append(Link(f"rod_{k}", f"j{k}", f"rod_{k - 1}" if k else None, "revolute", -Y, rod, p_PJ=position))
    # τ = K_m/R (k_p e − K_m v) is 200 e − 2 v.
    servos = [Servo(f"j{k}", np.sqrt(DRAG), 1.0, STIFF / np.sqrt(DRAG)) for k in range(3 if reference else 0)]
    robot = Robot("arm", tuple(links), tuple(servos), ("rod_2", LENGTH[2] * X))
    surface = Quadric(np.zeros((3, 3)), Z, -FLOOR)
    b = assemble(robot, [Contact("tip", "rod_2", LENGTH[2] * X, surface, friction=friction)], real=True)
    if reference is None:
        return b
    knots = np.linspace(0.0, until, 1001)
    spline = make_interp_spline(knots, np.array([BEND @ reference(t) for t in knots]), k=5)
    # Taylor coefficients at the left end of each piece.
    powers = [spline.derivative(m)(knots[:-1]) / math.factorial(m) for m in range(6)]
    coefficients = np.stack(powers, axis=-1)
    follows = ka.ReferenceArrays(
        spline=integers(np.arange(3)), held=reals(np.zeros(3)), grid=reals([0.0, knots[1]]),
        coefficients=reals(coefficients),
    )  # fmt: skip
    b.system = b.system._replace(reference=follows)
    return b


def tip(motion: str) -> Case:
    """Move the arm with its tip on the floor: free along it, sliding, or sticking."""
    chain, start = Chain(), reach(-1.2, 0.42)
    J = chain.rows(start)
    if motion == "free":
        until, friction, reference = 0.2, 0.0, None
        speed = np.linalg.svd(J[:1])[2][1:].T @ np.array([3.0, 2.0])
    elif motion == "slides":
        until, friction = 0.3, 0.3
        speed = np.linalg.lstsq(J, np.array([0.0, 0.5]), rcond=None)[0]

        def reference(t: float) -> np.ndarray:
            return reach(-1.2, 0.42 + 0.3 * t - 0.1 * t * t) - 0.1

    else:
        until, friction = 0.5, 20.0

        def last(t: float) -> float:
            return -1.2 + 0.4 * np.sin(4.0 * t)

        def reference(t: float) -> np.ndarray:
            q = reach(last(t), 0.42)
            pressed = chain.rows(q).T @ np.array([-30.0, 0.0]) + G * chain.weight * np.cos(q)
            return q + np.linalg.solve(STIFF * BEND.T @ BEND, pressed)

        speed = (reach(last(1e-6), 0.42) - reach(last(-1e-6), 0.42)) / 2e-6
    end = solved(chain.law, until, np.r_[start, speed], motion, friction, reference)[:3]
    return Case(arm(friction, reference, until), BEND @ start, BEND @ speed, until, end, read=np.cumsum)

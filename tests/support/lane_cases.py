"""Test cases for SIMD lanes: systems that reach every state-dependent branch of the right-hand side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.rows import set_modes
from dynsim.dynamics.derivative import new_workspace
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Contact, Coupling, Inertia, Link, Load, Quadric, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource
from support.random_robots import (
    CompiledSystem,
    assemble,
    random_positions,
    random_robot,
    random_robot_of,
    random_unit,
    surface_through,
)


@dataclass
class Case:
    """A system, and a state y and a time t around which the states of the lanes are drawn."""

    compiled: CompiledSystem
    y: np.ndarray
    spread: float  # spread of the lanes about y
    t: float = 0.0
    t_step: float = 0.0  # time difference between lanes; 0: the same time for all


def random_plane(rng: np.random.Generator, body: str, law: str = "signed", friction: float = 0.2) -> Contact:
    surface = Quadric(np.zeros((3, 3)), random_unit(rng), rng.normal())
    name = f"{body} {rng.integers(10**6)}"
    return Contact(name, body, rng.normal(scale=0.3, size=3), surface, friction=friction, pulling_friction=law)


def random_state(rng: np.random.Generator, b: CompiledSystem) -> np.ndarray:
    y = b.state(random_positions(rng, b.robot), rng.normal(size=len(b.robot.links)))
    current = b.part(y, "current")
    current[:] = rng.normal(size=current.shape)
    return y


def random_case(rng: np.random.Generator, b: CompiledSystem, spread: float, **keys: Any) -> Case:
    return Case(b, random_state(rng, b), spread, **keys)


def on_planes(
    n: int,
    count: int,
    law: str = "signed",
    *,
    seed: int = 0,
    spread: float = 1.0,
    friction: float = 0.2,
    twice: bool = False,
    m_star: bool = False,
) -> Case:
    """Return a tree with points of its last bodies on planes, the first of them ``twice``."""
    rng = np.random.default_rng(seed)
    contacts = [random_plane(rng, f"body_{n - 1 - k % n}", law, friction) for k in range(count)]
    if twice:
        contacts[1] = replace(contacts[0], name="again")
    return random_case(rng, assemble(random_robot(rng, n), contacts, m_star=m_star), spread)


def free(seed: int = 0) -> Case:
    rng = np.random.default_rng(seed)
    return random_case(rng, assemble(random_robot(rng, 8)), 1.0)


def every_joint() -> Case:
    rng = np.random.default_rng(1)
    return random_case(
        rng,
        assemble(random_robot_of(rng, ["ball", "rolling", "planar", "floating", "wheeled", "prismatic", "revolute"])),
        1.0,
    )


def held(modes: list[int]) -> Case:
    """Return points that stick, slide and are off their planes."""
    case = on_planes(7, len(modes), seed=2, spread=1e-3)
    stick(case, modes)
    return case


def stick(case: Case, modes: list[int]) -> None:
    """Set the modes of the contacts; sticking points stick at their present positions."""
    b = case.compiled
    b.derivative(case.y, 0.0)
    set_modes(b.system.contacts, b.system.couplings, None, b.ws, integers(modes))


def curved() -> Case:
    """Return a sphere, a cylinder, and a level set that is nowhere zero."""
    rng = np.random.default_rng(3)
    surfaces = [
        surface_through(rng, "sphere", rng.normal(size=3)),
        surface_through(rng, "cylinder", rng.normal(size=3)),
    ]
    surfaces.append(Quadric(np.eye(3), np.zeros(3), 0.8))
    contacts = [
        replace(random_plane(rng, f"body_{3 + k}"), surface=surface, name=str(k)) for k, surface in enumerate(surfaces)
    ]
    return random_case(rng, assemble(random_robot(rng, 6, branches=False), contacts), 1e-3)


def saddle() -> Case:
    """Return a saddle surface, too far from some lanes for a distance along its normal."""
    rng = np.random.default_rng(9)
    contact = replace(random_plane(rng, "body_5"), surface=Quadric(np.diag([1.0, 0.5, -2.0]), np.zeros(3), -0.5))
    return random_case(rng, assemble(random_robot(rng, 6, branches=False), [contact]), 1.0)


def coupled(m_star: bool = False) -> Case:
    """Return joints that follow others up and down the tree, and a point that sticks to a moving body."""
    rng = np.random.default_rng(4)
    robot = random_robot(rng, 8)
    couplings = (Coupling("joint_6", "joint_2", 0.7, 0.1), Coupling("joint_1", "joint_7", -1.3))
    b = assemble(replace(robot, couplings=couplings), [random_plane(rng, "body_5")], m_star=m_star)
    case = random_case(rng, b, 1e-3)
    if not m_star:
        stick(case, [ka.STICKING])
    b.ws.active[2:, ka.BODY_B] = 3
    return case


def driven(t: float, t_step: float = 0.0) -> Case:
    """Return references by splines, held and rewritten; wrenches that are constant, end, and are held."""
    rng = np.random.default_rng(5)
    robot = replace(
        random_robot(rng, 5, motors=False),
        motors=tuple(Motor(f"joint_{k}", 0.2, 1.3, 2e-3, 1e-4, 7.0, 1e-3) for k in range(4)),
    )
    knots, coefficients = np.array([0.1, 0.4, 0.9, 1.6]), rng.normal(size=(3, 6, 4))
    loads = [
        Load("none", "body_4", rng.normal(size=3), False, np.zeros(1), np.zeros((0, 6, 4)), False),
        Load("ends", "body_3", rng.normal(size=3), True, knots, coefficients, False),
        Load("held", "body_2", rng.normal(size=3), False, knots, coefficients, True),
    ]
    b = assemble(robot, loads=loads)
    reference = ka.ReferenceArrays(
        integers([0, ka.HELD_POSITION, 1, ka.REWRITTEN]),
        reals(rng.normal(size=4)),
        reals([0.0, 0.5]),
        reals(rng.normal(size=(4, 2, 6))),
        reals(rng.normal(size=(4, 4, 6))),
    )
    b.system = b.system._replace(reference=reference)
    b.system.drives.input[3, [ka.LINE_START, ka.LINE_RATE, ka.LINE_SINCE]] = rng.normal(size=3)
    return random_case(rng, b, 1.0, t=t, t_step=t_step)


def limited() -> Case:
    """Return motors that are at their limits in some lanes."""
    rng = np.random.default_rng(6)
    robot = random_robot(rng, 6)
    motors = [replace(motor, voltage_limit=15.0) for motor in robot.motors]
    motors[0] = replace(motors[0], current_limit=3.0)
    return random_case(rng, assemble(replace(robot, motors=tuple(motors))), 1.0)


def servos() -> Case:
    """Return every kind of drive and mode of a servo."""
    rng = np.random.default_rng(7)
    robot = random_robot_of(rng, ["revolute"] * 6)
    common: dict[str, Any] = {"torque_constant": 1.9, "resistance": 2.3, "coulomb_friction": 0.3, "free_drag": 0.1}
    motors = (
        Servo("joint_0", k_p=6.0, k_d=0.2, voltage_limit=8.0, current_limit=2.0, **common),
        Servo("joint_1", k_p=0.0, k_v=5.0, velocity_mode=True, **common),
        Servo("joint_2", k_p=40.0, **common),
        Motor("joint_3", 0.2, 1.3, 2e-3, 1e-4, 7.0, 1e-3),
        TorqueSource("joint_4", 0.3),
        Servo("joint_5", k_p=40.0, voltage_limit=0.5, **common),
    )
    b = assemble(replace(robot, motors=motors), held=rng.normal(size=6))
    b.system.drives.table[2, ka.SERVO_MODE] = ka.OFF
    b.system.drives.table[5, ka.SAMPLED] = 1
    b.system.drives.input[5, ka.COMMAND] = 0.7
    return random_case(rng, b, 1.0)


def rubbing() -> Case:
    """Return sliding joints and gears with dry friction."""
    rng = np.random.default_rng(9)
    robot = random_robot_of(rng, ["revolute"] * 4)
    links = tuple(replace(link, friction=0.1 * k) for k, link in enumerate(robot.links))
    motor = Motor("joint_2", 0.2, 1.3, 2e-3, 1e-4, 7.0, 1e-3, dry_friction=0.4)
    b = assemble(replace(robot, links=links, motors=(motor,)), real=True, dry=True)
    unilateral = b.system.unilateral
    assert unilateral is not None
    unilateral.dry_table[:, ku.DRY_HOLDS] = 0
    unilateral.dry[:, ku.DRY_SIDE] = 1.0, -1.0, 1.0
    b.ws = new_workspace(b.system)
    return random_case(rng, b, 1.0)


def unmoved() -> Case:
    """Return a point of a slide along x on a floor: a system of one zero row."""
    x, z = np.eye(3)[0], np.eye(3)[2]
    robot = Robot("slide", (Link("body", "joint", None, "prismatic", x, Inertia(1.0)),), (), ("body", np.zeros(3)))
    b = assemble(robot, [Contact("foot", "body", np.zeros(3), Quadric(np.zeros((3, 3)), z, 0.0))])
    return random_case(np.random.default_rng(8), b, 1.0)


# Name → states. The spread is wide, small if lanes must agree, and zero if rounding decides on pivots.
CASES: dict[str, Callable[[], Case]] = {
    "free arm": free,
    "every joint": every_joint,
    "one brace": lambda: on_planes(5, 1),
    "two braces": lambda: on_planes(6, 2),
    "two braces, M*": lambda: on_planes(6, 2, m_star=True),
    "curved": curved,
    "saddle": saddle,
    "references and loads": lambda: driven(0.7),
    "references and loads at their end": lambda: driven(3.0),
    "voltage limits": limited,
    "servos": servos,
    "held, sliding, off": lambda: held([ka.STICKING, ka.OPEN, ka.SLIDING]),
    "sliding, held, held": lambda: held([ka.SLIDING, ka.STICKING, ka.STICKING]),
    "coupled": coupled,
    "coupled, M*": lambda: coupled(m_star=True),
    "dissipative": lambda: on_planes(6, 3, "dissipative", seed=1, spread=1e-4),
    "dissipative, M*": lambda: on_planes(6, 3, "dissipative", seed=1, spread=1e-4, m_star=True),
    "no choice of signs": lambda: on_planes(6, 3, "dissipative", seed=1, spread=1e-6, friction=3.0, m_star=True),
    "dependent": lambda: on_planes(3, 5, spread=0.0),
    "very dependent": lambda: on_planes(2, 6, spread=0.0, twice=True),
    "twice the same point": lambda: on_planes(5, 9, spread=0.0, twice=True),
    "unmoved": unmoved,
    "rubbing": rubbing,
}
TIMED = {
    "different times": lambda: driven(0.7, 0.01),
    "different times, at the end": lambda: driven(3.0, 0.01),
}


def copies(tables: Any) -> Any:
    """Return a named tuple, however nested, with copies of its tables."""
    if isinstance(tables, tuple):
        return type(tables)(*map(copies, tables))
    return np.copy(tables) if isinstance(tables, np.ndarray) else tables

"""Systems for tests of time stepping: runs with a special contact law, and a scene of the snake's size."""

from __future__ import annotations

import numpy as np

from dynsim.integrators.run import Run
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.model.drives import Servo
from dynsim.model.joints.ball import floating
from support.random_robots import CompiledSystem, assemble


def stepped(
    b: CompiledSystem, y: np.ndarray, times: np.ndarray, step: float, theta: float, law: dict | None = None
) -> Run:
    """Return a run with time stepping; law: columns of the contacts' law."""
    b = b.with_shapes()
    run = b.new_run(y, times, "time_stepping", step=step, theta=theta)
    for column, value in (law or {}).items():
        b.system.contacts.law[:, column] = value
    return b.finish(run)


def plane(normal: np.ndarray) -> Quadric:
    return Quadric(np.zeros((3, 3)), normal, 0.0)


def snake(joints: int = 12, wheels: int = 14) -> tuple[CompiledSystem, np.ndarray]:
    """Return a chain of alternating yaw and pitch joints on wheels on a plane, two at each end and one per joint."""
    length, inertia = 0.1, Inertia(0.3, np.zeros(3), np.diag([2e-4, 4e-4, 4e-4]))
    links = list(floating(Link("link_0", "root", None, "floating", np.eye(3)[0], inertia)))
    for k in range(joints):
        axis = np.eye(3)[2 if k % 2 == 0 else 1]
        links.append(
            Link(f"link_{k + 1}", f"joint_{k}", f"link_{k}", "revolute", axis, inertia, p_PJ=np.array([length, 0, 0]))
        )
    motors = [
        Servo(f"joint_{k}", 1.5, 3.0, 60.0, 1.0, armature=5e-3, coulomb_friction=0.05, coulomb_speed=0.05)
        for k in range(joints)
    ]
    contacts = [
        Contact(
            f"wheel_{k}",
            f"link_{min(k, joints)}",
            np.array([0.05 * (k > joints), 0.02 * (-1) ** k, -0.03]),
            plane(np.eye(3)[2]),
            friction=0.6,
        )
        for k in range(wheels)
    ]
    robot = Robot("snake", tuple(links), tuple(motors), (f"link_{joints}", np.zeros(3)))
    held = np.array([0.35 * np.sin(0.8 * k) if k % 2 == 0 else 0.0 for k in range(joints)])
    b = assemble(robot, contacts, held=held, real=True)
    q = np.zeros(robot.nq)
    q[2], q[3] = 0.03, 1.0
    return b, b.state(q, np.zeros(len(robot.links)))

"""Random robots of every joint kind, states and contacts, and ``CompiledSystem`` to evaluate and integrate them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.shapes import compile_shapes
from dynsim.compile.tables import (
    JointStop,
    compile_contacts,
    compile_couplings,
    compile_drives,
    compile_loads,
    compile_model,
    compile_unilateral,
    dry_frictions,
    joint_stops,
    with_shapes,
)
from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System, derivative, new_workspace
from dynsim.dynamics.state import ELASTIC_SIZE, LOSSES, block, output_layout, state_layout
from dynsim.engine.prepare import guards
from dynsim.integrators.driver import advance
from dynsim.integrators.methods import METHODS
from dynsim.integrators.radau5.tables import CLOSE
from dynsim.integrators.run import FINISHED, STATUS, TIME_STEPPING, Run, new_run
from dynsim.integrators.simd.forms import has_forms
from dynsim.integrators.stepping.articulated_contacts import articulated_arrays
from dynsim.integrators.stepping.tables import stepping_arrays
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Contact, Inertia, Link, Load, Quadric, Robot
from dynsim.model.drives import Motor
from dynsim.model.joints.ball import ball, floating
from dynsim.model.joints.planar import planar, rolling
from dynsim.model.joints.wheels import wheeled

SURFACES = ("plane", "sphere", "cylinder")
# Methods that integrate the right-hand side with bilateral contacts; time stepping has separate tests.
ADAPTIVE = tuple(name for name, method in METHODS.items() if method.adaptive)
SEVERAL_ROWS = {
    "ball": ball,
    "floating": floating,
    "planar": planar,
    "rolling": rolling,
    "wheeled": partial(wheeled, radius=0.07, track=0.4),
}


def random_unit(rng: np.random.Generator) -> np.ndarray:
    """Return a direction, uniform on the sphere, (3,)."""
    u = rng.normal(size=3)
    return u / np.linalg.norm(u)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a rotation matrix, (3, 3)."""
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Q * np.sign(np.linalg.det(Q))


def random_inertia(rng: np.random.Generator) -> Inertia:
    """Return a solid box of random edges, mass, position and attitude: a full tensor that a real body can have."""
    mass = rng.uniform(0.1, 2.0)
    square = rng.uniform(0.05, 0.4, size=3) ** 2
    R = random_rotation(rng)
    tensor = R @ np.diag(mass * (square.sum() - square) / 12.0) @ R.T
    return Inertia(mass, rng.normal(scale=0.2, size=3), 0.5 * (tensor + tensor.T))


def random_robot(rng: np.random.Generator, n: int, *, branches: bool = True, motors: bool = True) -> Robot:
    """Return n links: revolute about x, y, z or any axis, or prismatic; about every third link starts a branch."""
    links, axes = [], np.eye(3)
    for i in range(n):
        kind = rng.integers(5)
        parent = i - 1
        if branches and rng.random() < 0.35:
            parent = int(rng.integers(-1, i))
        links.append(
            Link(
                name=f"body_{i}",
                joint=f"joint_{i}",
                parent=None if parent < 0 else f"body_{parent}",
                kind="prismatic" if kind == 4 else "revolute",
                axis=axes[kind] if kind < 3 else random_unit(rng),
                inertia=random_inertia(rng),
                R_PJ=np.eye(3) if rng.random() < 0.5 else random_rotation(rng),
                p_PJ=rng.normal(scale=0.3, size=3),
                damping=rng.uniform(0.0, 0.5),
            )
        )
    driven = [i for i in range(n) if motors and rng.random() < 0.7]
    return Robot(
        name="random",
        links=tuple(links),
        motors=tuple(
            Motor(
                joint=f"joint_{i}",
                torque_constant=rng.uniform(0.05, 0.3),
                resistance=rng.uniform(0.5, 2.0),
                inductance=rng.uniform(1e-3, 5e-3),
                rotor_inertia=rng.uniform(1e-5, 3e-4),
                gear_ratio=rng.uniform(1.0, 10.0),
                gear_damping=rng.uniform(0.0, 0.02),
            )
            for i in driven
        ),
        hand=(f"body_{n - 1}", rng.normal(scale=0.2, size=3)),
        gravity=rng.normal(scale=6.0, size=3),
    )


def random_robot_of(rng: np.random.Generator, kinds: Sequence[str], *, branches: bool = True) -> Robot:
    """Return a body for each joint kind, in this order: single rows as in `random_robot`, and :data:`SEVERAL_ROWS`.

    All placements are rotated; the bodies have the names of :func:`random_robot`.
    """
    links: list[Link] = []
    for i, kind in enumerate(kinds):
        parent = int(rng.integers(-1, i)) if branches and i and rng.random() < 0.35 else i - 1
        link = Link(
            name=f"body_{i}",
            joint=f"joint_{i}",
            parent=None if parent < 0 else f"body_{parent}",
            kind=kind,
            axis=random_unit(rng),
            inertia=random_inertia(rng),
            R_PJ=random_rotation(rng),
            p_PJ=rng.normal(scale=0.3, size=3),
            damping=rng.uniform(0.0, 0.5),
        )
        links.extend(SEVERAL_ROWS[kind](link) if kind in SEVERAL_ROWS else (link,))
    return Robot(
        "random", tuple(links), (), (links[-1].name, rng.normal(scale=0.2, size=3)), rng.normal(scale=6, size=3)
    )


def without_losses(robot: Robot) -> Robot:
    """Return the robot with frictionless joints."""
    return replace(robot, links=tuple(replace(link, damping=0.0) for link in robot.links))


def random_positions(rng: np.random.Generator, robot: Robot) -> np.ndarray:
    """Return coordinates of all joints, (nq,): quaternions uniform on the rotations."""
    q = rng.normal(scale=2.0, size=robot.nq)
    for link, k in zip(robot.links, robot.position_index, strict=True):
        if link.kind == "ball_x":
            q[k : k + 4] /= np.linalg.norm(q[k : k + 4])
    return q


def surface_through(rng: np.random.Generator, kind: str, position: np.ndarray) -> Quadric:
    """Return a plane, sphere or cylinder of random attitude and size that passes through a point."""
    normal, radius = random_unit(rng), rng.uniform(0.3, 2.0)
    if kind == "plane":
        return Quadric(np.zeros((3, 3)), normal, -float(normal @ position))
    Q = np.eye(3)
    if kind == "cylinder":
        axis = np.cross(normal, random_unit(rng))
        axis /= np.linalg.norm(axis)
        Q -= np.outer(axis, axis)
    centre = position - radius * normal
    return Quadric(Q, -Q @ centre, 0.5 * float(centre @ Q @ centre - radius**2))


def random_contacts(rng: np.random.Generator, robot: Robot, q: np.ndarray, count: int) -> list[Contact]:
    """Return contacts at points of random bodies that are on their surfaces at q, with both friction laws."""
    model, contacts = Model(robot), []
    # Only the last row of a joint carries a body.
    bodies = [link.name for link in robot.links if link.inertia.mass > 0.0]
    for k in range(count):
        body, point = bodies[int(rng.integers(len(bodies)))], rng.normal(scale=0.3, size=3)
        kind = SURFACES[rng.integers(3)]
        contacts.append(
            Contact(
                name=f"contact_{k}",
                body=body,
                point=point,
                surface=surface_through(rng, kind, model.point_position(body, point, q)),
                surface_name=kind,
                friction=rng.uniform(0.0, 0.3),
                pulling_friction="dissipative" if rng.random() < 0.5 else "signed",
            )
        )
    return contacts


def held_reference(angles: np.ndarray) -> ka.ReferenceArrays:
    """Return references that hold the given angles, (na,)."""
    return ka.ReferenceArrays(
        spline=integers(np.full(len(angles), -1)),
        held=reals(angles),
        grid=reals([0.0, 1.0]),
        coefficients=reals(np.zeros((1, 1, 6))),
    )


@dataclass
class CompiledSystem:
    """System with its workspace: everything that a test needs to evaluate one right-hand side."""

    robot: Robot
    system: System
    ws: ka.Workspace
    contacts: tuple[Contact, ...] = ()  # unilateral law
    stops: tuple[JointStop, ...] = ()

    @property
    def sizes(self) -> tuple[int, int, int]:
        """n, na, c."""
        return len(self.robot.links), len(self.robot.motors), len(self.system.contacts.link)

    def state(self, q: np.ndarray, v: np.ndarray, current: np.ndarray | None = None) -> np.ndarray:
        """Return a state vector with zero integrals, (layout.size,)."""
        y = np.zeros(self.system.layout.size)
        self.part(y, "q")[:], self.part(y, "v")[:] = q, v
        if current is not None:
            self.part(y, "current")[:] = current
        return y

    def part(self, y: np.ndarray, name: str) -> np.ndarray:
        """Return the block ``name`` of a state vector or of its derivative (a view)."""
        return y[block(self.system.layout, name)]

    def derivative(self, y: np.ndarray, t: float = 0.0) -> np.ndarray:
        """Return dy/dt."""
        dy = np.zeros_like(y)
        derivative(self.system, t, reals(y), self.ws, dy)
        return dy

    def new_run(
        self,
        y: np.ndarray,
        times: np.ndarray,
        method: str = "dopri5",
        *,
        step: float = 0.0,
        fixed: bool = False,
        rtol: float = 1e-6,
        atol: float | None = None,
        theta: float = 0.5,
    ) -> Run:
        """Return a run from y to the last of ``times``, recorded there, that has not begun.

        ``step`` 0 leaves the first step to the method; ``fixed`` keeps the ``step`` of adaptive methods constant.
        Time stepping has additional arrays, with ``theta``, and uses the unilateral law.
        """
        n, na, c = self.sizes
        system, stepping = self.system, None
        couplings = len(self.robot.couplings) + len(self.stops)
        dry, ties = (0, 0) if system.unilateral is None else (len(system.unilateral.dry), len(self.robot.ties))
        couplings += dry + ties
        if METHODS[method].number == TIME_STEPPING:
            art = articulated_arrays(system)
            stepping = stepping_arrays(system.model, system.contacts, na, couplings, theta, articulated=art)
        run = new_run(
            METHODS[method].number,
            y,
            self.system.layout,
            output_layout(n, na, c, 0, len(self.stops), dry, ties),
            n=n,
            na=na,
            c=c,
            couplings=couplings,
            events=guards(self.robot, self.contacts, self.stops, dry_frictions(self.robot) if dry else ()),
            sample_time=times,
            hand=(n - 1, self.robot.hand[1]),
            end=float(times[-1]),
            step=step,
            stepping=stepping,
            lanes=has_forms(system),
            step_max=step if fixed else np.inf,
            rtol=rtol,
            # With a huge absolute tolerance every step is accepted and the next one is as long as allowed.
            atol=1e12 if fixed else rtol * 1e-2 if atol is None else atol,
        )
        if fixed and run.newton is not None:
            run.newton.clock[CLOSE] = 1e-27
        return run

    def advance(self, run: Run, limit: int = 10**7) -> Run:
        """Take up to ``limit`` steps; 0 only starts the run, on its contacts."""
        advance(self.system, self.ws, run, limit)
        return run

    def with_shapes(self) -> CompiledSystem:
        """Return the system with shapes, like scenarios with time stepping, which all run one program."""
        return replace(self, system=with_shapes(self.system))

    def simulate(self, y: np.ndarray, times: np.ndarray, method: str = "dopri5", **options: Any) -> Run:
        """Integrate to the last of ``times``, which must be reached; ``options`` as for :meth:`new_run`."""
        b = self.with_shapes() if METHODS[method].number == TIME_STEPPING else self
        return b.finish(b.new_run(y, times, method, **options))

    def finish(self, run: Run) -> Run:
        """Advance a run to its end, which must be reached."""
        self.advance(run)
        assert run.count[STATUS] == FINISHED
        return run


def assemble(
    robot: Robot,
    contacts: list[Contact] | None = None,
    *,
    m_star: bool = False,
    loads: list[Load] | None = None,
    held: np.ndarray | None = None,
    k_p: float = 30.0,
    k_d: float = 1.0,
    real: bool = False,
    slow: float = 1e-5,
    dry: bool = False,
) -> CompiledSystem:
    """Compile a robot and its contacts, with a voltage PD that holds ``held`` (zero by default).

    ``real``: unilateral law, with the robot's joint stops; slip below ``slow`` [m/s] keeps its direction.
    ``dry``: friction that holds joints at rest, not smoothed.
    """
    na = len(robot.motors)
    contact_arrays = compile_contacts(robot, contacts or [])
    n, c, circuits = len(robot.links), len(contacts or []), robot.circuits
    stops = joint_stops(robot) if real else []
    rubbing = dry_frictions(robot) if dry else []
    size = n + ka.row_limit(c, len(robot.couplings) + len(stops) + len(rubbing) + len(robot.ties)) + circuits
    gives = ELASTIC_SIZE if robot.ties or any(contact.stiffness for contact in contacts or ()) else 0
    system = System(
        layout=state_layout(robot.nq, n, circuits, c, len(loads or ()), LOSSES if real else 0, 1, gives),
        model=compile_model(robot),
        drives=compile_drives(robot, k_p=[k_p] * na, k_d=[k_d] * na, dry=dry),
        reference=held_reference(np.zeros(na) if held is None else held),
        contacts=contact_arrays,
        loads=compile_loads(robot, loads or ()),
        dense=np.zeros((size, size + 1)) if m_star else None,
        couplings=compile_couplings(robot),
        shapes=compile_shapes(robot, contacts or []),
        unilateral=compile_unilateral(robot, contacts or [], stops, slow, slow, rubbing) if real else None,
    )
    return CompiledSystem(robot, system, new_workspace(system), tuple(contacts or ()) if real else (), tuple(stops))


def braced(rng: np.random.Generator) -> tuple[CompiledSystem, np.ndarray]:
    """Return a tree with gentle motors and two points on surfaces: fast or chattering motion amplifies rounding."""
    robot = random_robot(rng, 7)
    q = random_positions(rng, robot)
    return assemble(robot, random_contacts(rng, robot, q, 2), k_p=0.3, k_d=0.01), q

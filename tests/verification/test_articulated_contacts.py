"""Compliant contacts by articulated inertias: the same motion as with the dense matrix of the contact problem."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from support.random_robots import (
    CompiledSystem,
    assemble,
    random_contacts,
    random_positions,
    random_robot_of,
    random_unit,
)
from support.stepping_systems import snake

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import block
from dynsim.engine.simulation import prepare
from dynsim.integrators import driver
from dynsim.integrators.run import Run
from dynsim.integrators.stepping import articulated_contacts as kac
from dynsim.integrators.stepping import tables as kt
from dynsim.model.description import Contact, Robot
from dynsim.scenario import load_scenario

# Both solvers end at a residual of at most GOOD [m/s]. The residual is the error of z = m p − w; an error of w changes
# rates by as much, and an error of p by its mobility, so that rates of one step differ by some GOOD.
RATES = 100.0 * kt.GOOD


def dense(run: Run) -> Run:
    """Return the run with the dense solver only, in the same program."""
    assert run.stepping is not None
    assert len(run.stepping.articulated.contact) > 0
    empty = kac.ArticulatedArrays(run.stepping.articulated.link, np.zeros((0, kac.CONTACT_SIZE)))
    return run._replace(stepping=run.stepping._replace(articulated=empty))


def rates(system, run: Run) -> np.ndarray:
    """The rates of all joints, as a view of the state."""
    state = run.y
    return state[block(system.layout, "v")]


def step_with_both(system, ws, run: Run, steps: int):
    """Take steps with articulated inertias, and each of them with the dense solver from the same state, too.

    Yields the largest difference of rates after each step [m/s or rad/s].
    """
    for _ in range(steps):
        other, space, reference = deepcopy((system, ws, run))
        reference = dense(reference)
        driver.advance(other, space, reference, 1)
        driver.advance(system, ws, run, 1)
        yield float(np.abs(rates(system, run) - rates(system, reference)).max())


def with_dry_friction(rng: np.random.Generator, robot: Robot) -> Robot:
    """Return the robot with dry friction of some of its joints with one row."""
    links = tuple(
        replace(link, friction=float(10 ** rng.uniform(-1.5, 1.5)))
        if link.kind in ("revolute", "prismatic") and not link.joint.startswith("root") and rng.random() < 0.7
        else link
        for link in robot.links
    )
    return replace(robot, links=links)


def random_tree(seed: int) -> tuple[CompiledSystem, np.ndarray]:
    """Return a tree or free bodies with dry friction and compliant contacts of all kinds, near their surfaces."""
    rng = np.random.default_rng(seed)
    first = [str(rng.choice(["floating", "ball", "planar", "rolling"]))] if rng.random() < 0.7 else []
    count = int(rng.integers(1, 7))
    kinds = first + [str(rng.choice(["revolute", "prismatic", "ball"], p=[0.7, 0.15, 0.15])) for _ in range(count)]
    robot = with_dry_friction(rng, random_robot_of(rng, kinds, branches=bool(rng.random() < 0.7)))
    q = random_positions(rng, robot)
    contacts = [soft(rng, contact) for contact in random_contacts(rng, robot, q, int(rng.integers(1, 6)))]
    b = assemble(robot, contacts, real=True, dry=True).with_shapes()
    return b, b.state(
        q, rng.normal(scale=float(rng.choice([0.0, 0.01, 0.3], p=[0.6, 0.2, 0.2])), size=len(robot.links))
    )


def random_snake(seed: int) -> tuple[CompiledSystem, np.ndarray]:
    """Return a chain with servos and dry friction that moves on compliant feet."""
    rng = np.random.default_rng(seed)
    joints = int(rng.integers(2, 13))
    b, y = snake(joints, int(rng.integers(3, joints + 3)))
    q = b.part(y, "q").copy()
    robot = with_dry_friction(rng, b.robot)
    contacts = [soft(rng, contact) for contact in b.contacts]
    b = assemble(
        robot, contacts, held=rng.normal(scale=float(rng.choice([0.02, 0.5])), size=joints), real=True, dry=True
    ).with_shapes()
    v = rng.normal(scale=float(rng.choice([0.0, 0.05, 0.3])), size=len(robot.links))
    return b, b.state(q, v)


def soft(rng: np.random.Generator, contact: Contact) -> Contact:
    """Return the contact with a random stiffness, damping, friction and grip."""
    grips = bool(rng.random() < 0.3)
    friction = float(rng.choice([0.0, rng.uniform(0.0, 0.5), rng.uniform(0.5, 1.5)], p=[0.1, 0.4, 0.5]))
    return replace(
        contact,
        friction=friction,
        static_friction=friction + float(rng.choice([0.0, rng.uniform(0.0, 0.2)])),
        stiffness=float(10 ** rng.uniform(3, 5)),
        damping=float(10 ** rng.uniform(0, 2.5)),
        grip_axis=random_unit(rng) if grips else None,
        grip=float(rng.uniform(0.2, 3.0)) if grips else 1.0,
    )


def statuses(system, run: Run, ws) -> Counter[str]:
    """Return how many contacts and joints have each status after a step."""
    art = run.stepping.articulated
    listed = ws.active[: len(ws.contacts), ka.MODE] == ka.STICKING
    seen = Counter(f"contact {status:g}" for status in art.contact[listed, kac.STATUS])
    for joint in system.unilateral.dry_table[:, ku.DRY_JOINT]:
        seen["joint locked" if art.link[joint, kac.LOCK] == 1.0 else "joint slides"] += 1
    return seen


@pytest.mark.parametrize(("scene", "count", "steps"), [(random_tree, 120, 12), (random_snake, 40, 25)])
def test_systems_move_as_with_the_dense_solver(scene, count: int, steps: int):
    """All statuses of contacts and joints occur, and hardly any search fails."""
    seen, off, cycled, solves = Counter[str](), 0.0, 0.0, 0.0
    for seed in range(count):
        b, y = scene(seed)
        run = b.new_run(y, np.array([0.0, 1.0]), "time_stepping", step=1e-3)
        for error in step_with_both(b.system, b.ws, run, steps):
            seen += statuses(b.system, run, b.ws)
            off = max(off, error)
        cycled += run.stepping.statistics[kt.CYCLED]
        solves += run.stepping.statistics[kt.SOLVES]
    assert off <= RATES
    assert min(seen.values()) > 50
    assert len(seen) == 5
    assert cycled < 5e-3 * solves


def test_dynamic_snake_moves_as_with_the_dense_solver():
    """Joints and wheels turn at random rates at the start; the servos stop them."""
    prepared = prepare(load_scenario("snake_positioning_dynamic", "x"))
    system, run = prepared.system, prepared.run
    v = rates(system, run)
    v[:] = np.random.default_rng(0).normal(scale=0.1, size=len(v))
    seen, off = Counter[str](), 0.0
    for error in step_with_both(system, prepared.workspace, run, 60):
        seen += statuses(system, run, prepared.workspace)
        off = max(off, error)
    assert off <= RATES
    assert len(seen) == 5
    assert run.stepping.statistics[kt.CYCLED] == 0

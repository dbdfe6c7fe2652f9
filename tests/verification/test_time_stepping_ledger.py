"""Discrete energy balance of time stepping: the ledger closes to rounding; order of the loss of the steps."""

from __future__ import annotations

import numpy as np
import pytest
from support.random_robots import (
    CompiledSystem,
    assemble,
    random_contacts,
    random_positions,
    random_robot,
    random_robot_of,
)
from support.stepping_systems import snake, stepped

from dynsim import load_scenario, simulate
from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import CONSTRAINT, ELECTRICAL, FRICTION, GEAR, JOINT, JOULE
from dynsim.integrators.run import STEPS, Run
from dynsim.integrators.stepping.tables import BAD, CAPPED, PENETRATION, WORST
from dynsim.model.description import Coupling, Load, Robot
from dynsim.model.drives import Servo, TorqueSource

SPENT = [JOULE, GEAR, JOINT, FRICTION]


def unexplained(run: Run) -> float:
    """Largest error of the balance at any sample, per the energy that changed hands."""
    ledger, stored = run.states("ledger"), run.outputs("energy").sum(axis=1)
    loads = run.states("load")
    supplied = ledger[:, ELECTRICAL] + ledger[:, CONSTRAINT] + loads.sum(axis=1)
    spent = ledger[:, SPENT].sum(axis=1) + run.states("loss").sum(axis=1) + run.states("scheme")[:, 0]
    change = stored - stored[0]
    terms = np.abs(ledger[:, [ELECTRICAL, CONSTRAINT, *SPENT]]).sum(axis=1) + np.abs(loads).sum(axis=1)
    turnover = 0.5 * (terms + np.abs(change)).max()
    assert turnover > 1e-3
    return float(np.abs(supplied - spent - change).max() / turnover)


def push(robot: Robot, rng: np.random.Generator) -> Load:
    """A force and a torque on the last body, in its axes, that change with time."""
    coefficients = np.zeros((1, 6, 4))
    coefficients[0, :, :2] = rng.normal(scale=2.0, size=(6, 2))
    return Load("push", robot.links[-1].name, rng.normal(size=3), True, np.array([0.0, 1.0]), coefficients, True)


def moving(b: CompiledSystem, q: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return b.state(q, rng.normal(size=len(b.robot.links)), rng.normal(size=b.system.layout.circuits))


# Samples within steps too, where the state is linear.
TIMES = np.linspace(0.0, 0.15, 38)


@pytest.mark.parametrize("theta", [0.5, 0.7, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_arms_whose_inertia_changes(seed, theta):
    """Motors, contacts with impacts at the start, joints that follow others, and loads, at a step that is too long."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 6)
    driven = {motor.joint for motor in robot.motors}
    free = [link.joint for link in robot.links if link.joint not in driven]
    if len(free) > 1:
        robot = Robot(**{**vars(robot), "couplings": (Coupling(free[0], free[1], 0.7, 0.0),)})
    q = rng.normal(size=6)
    if robot.couplings:
        names = robot.joint_names
        q[names.index(free[0])] = 0.7 * q[names.index(free[1])]
    b = assemble(robot, random_contacts(rng, robot, q, 3), loads=[push(robot, rng)], real=True)
    run = stepped(b, moving(b, q, seed), TIMES, 3e-3, theta)
    assert run.stepping.statistics[CAPPED] == 0
    assert unexplained(run) < 1e-9
    for coupling in robot.couplings:
        pair = [names.index(coupling.joint), names.index(coupling.leader)]
        apart, rate = (np.abs(run.states(name)[:, pair] @ [1.0, -0.7]) for name in "qv")
        # The start's rates disagree: they count with 1 − θ in the first step, and never again.
        assert apart.max() <= (1.0 - theta) * 3e-3 * rate[0] + 1e-12


@pytest.mark.parametrize("seed", range(2))
def test_servos_and_torque_sources(seed):
    """Drives that are not linear: limits of voltage, current and torque, Coulomb friction of gears."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 5, motors=False)
    limits = {"voltage_limit": 6.0, "current_limit": 2.5, "coulomb_friction": 0.05, "coulomb_speed": 0.05}
    motors = [
        TorqueSource(link.joint, torque_limit=0.8)
        if link.kind == "prismatic" or k % 3 == 2
        else Servo(link.joint, 1.5, 3.0, 60.0, 1.0, armature=5e-3, **limits)
        for k, link in enumerate(robot.links)
    ]
    assert len({type(motor) for motor in motors}) == 2
    robot = Robot(**{**vars(robot), "motors": tuple(motors)})
    b = assemble(robot, held=rng.normal(size=5), real=True)
    run = stepped(b, moving(b, rng.normal(size=5), seed), TIMES, 2e-3, 0.5)
    assert unexplained(run) < 1e-9


@pytest.mark.parametrize("kinds", [("floating", "revolute", "ball"), ("rolling", "prismatic"), ("wheeled", "planar")])
def test_bodies_that_are_free(kinds):
    """Joints of several rates: attitudes, rolling and wheeled bases, whose positions are no integrals of rates."""
    rng = np.random.default_rng(len(kinds[0]))
    robot = random_robot_of(rng, kinds)
    q = random_positions(rng, robot)
    b = assemble(robot, random_contacts(rng, robot, q, 2), loads=[push(robot, rng)], real=True)
    run = stepped(b, moving(b, q, 1), TIMES, 3e-3, 0.5)
    assert unexplained(run) < 1e-9


def test_a_scene_of_the_snakes_size_keeps_its_cones_and_its_ledger():
    b, y = snake()
    run = stepped(b, y, np.linspace(0.0, 0.5, 101), 1e-3, 0.5, {ka.GRIP: 0.05, ka.GRIP_AXIS: 1.0})
    statistics, ledger = run.stepping.statistics, run.states("ledger")[-1]
    assert run.count[STEPS] == 500
    assert statistics[CAPPED] == 0
    assert statistics[WORST] <= BAD
    assert statistics[PENETRATION] < 1e-3
    assert ledger[FRICTION] >= 0.0
    assert unexplained(run) < 1e-9
    # Steps of 1 ms take about a thousandth of what the motors give.
    assert abs(run.states("scheme")[-1, 0]) < 2e-3 * ledger[ELECTRICAL]


@pytest.mark.parametrize(("theta", "order"), [(0.5, 2), (1.0, 1)])
def test_what_steps_take_is_of_their_order(theta, order):
    robot = random_robot(np.random.default_rng(3), 4)
    b = assemble(robot, real=True)
    y = b.state(np.full(4, 0.3), np.full(4, 0.5), np.zeros(b.system.layout.circuits))
    taken = [stepped(b, y, np.array([0.0, 0.2]), h, theta).states("scheme")[-1, 0] for h in (4e-4, 2e-4, 1e-4)]
    rates = np.log2(np.abs(np.divide(taken[:-1], taken[1:])))
    assert (np.abs(rates - order) < 0.2).all(), (taken, rates)


BLOCK = """
duration_s: 0.3
plant:
  type: serial_arm
  chain:
    - {kind: prismatic, axis: z, length_m: 0, mass_kg: 0.1}
    - {kind: prismatic, axis: x, length_m: 0, mass_kg: 0.9}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.5, points: {foot: {body: link_2}}}
loads:
  push:
    type: samples
    body: link_2
    times_s: [0, 0.05, 0.051, 1]
    force_N: [[10, 0, 0], [10, 0, 0], [-4, 0, 0], [-4, 0, 0]]
    interpolation: linear
integrator: {method: time_stepping}
record: {rate_hz: 1000}
"""


def test_friction_gives_no_energy_where_slip_ends(tmp_path):
    """A block slows down and stops with a force on it that pulls it back, which friction then holds.

    In the last step friction holds against that force while the block still moves a little with it.
    """
    path, falls = tmp_path / "block.yaml", []
    path.write_text(BLOCK)
    for push in np.linspace(8.0, 12.0, 9):
        force = [[push, 0, 0], [push, 0, 0], [-4, 0, 0], [-4, 0, 0]]
        record = simulate(load_scenario(path, overrides={"loads.push.force_N": force}))
        assert abs(record["v"][-1, 1]) < 1e-9
        assert record.summary["energy_residual_relative"] < 1e-9
        falls.append(-np.diff(record["heat_friction"]).min())
    # What is left of rates is solved to 1e-8 m/s, against 5 N for steps of 1 ms.
    assert max(falls) < 1e-10

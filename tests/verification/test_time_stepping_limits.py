"""Limits of voltage, current and torque in time stepping: they hold for the end of a step, also in stiff loops."""

from __future__ import annotations

import numpy as np
import pytest
from support.random_robots import CompiledSystem, assemble
from support.stepping_systems import plane, stepped

from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.law import servo_block, servo_block_on, servo_circuit, servo_circuit_on, servo_segment
from dynsim.dynamics.state import ELECTRICAL, SLIP
from dynsim.integrators.stepping.tables import UNSETTLED
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Contact, Inertia, Link, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource, servo_row

X, Y, Z = np.eye(3)
RADIUS = 0.05


def cart(gain: float) -> CompiledSystem:
    """10 kg on one wheel, a velocity servo of 2.5 N m and 5.76 rad/s at 12 V that is told to roll at 0.1 m/s."""
    constant = 12.0 / 5.76
    servo = Servo("axle", constant, 12.0 * constant / 2.5, 0.0, k_v=gain, velocity_mode=True, voltage_limit=12.0,
                  armature=1e-3)  # fmt: skip
    links = (
        Link("slide", "x", None, "prismatic", X, Inertia(0.0)),
        Link("cart", "z", "slide", "prismatic", Z, Inertia(10.0, np.zeros(3), 0.1 * np.eye(3))),
        Link("wheel", "axle", "cart", "revolute", Y, Inertia(0.1, np.zeros(3), 2e-4 * np.eye(3))),
    )
    tyre = Contact("tyre", "wheel", np.zeros(3), plane(Z), friction=0.6, radius=RADIUS)
    b = assemble(Robot("cart", links, (servo,), ("cart", np.zeros(3))), [tyre], real=True)
    line = ka.ReferenceArrays(integers([ka.REWRITTEN]), reals([0.0]), reals([0.0, 1.0]), reals(np.zeros((1, 1, 6))))
    b.system = b.system._replace(reference=line)
    b.system.drives.input[0, ka.LINE_RATE] = 0.1 / RADIUS
    return b


@pytest.mark.parametrize("theta", [0.5, 1.0])
@pytest.mark.parametrize("gain", [5.0, 20.0, 100.0])
def test_a_stiff_velocity_loop_rolls(gain, theta):
    """It was at its limit and back in turn, and drove 0.71 m with 770 mm of slip."""
    b = cart(gain)
    run = stepped(b, b.state([0.0, RADIUS, 0.0], np.zeros(3)), np.array([0.0, 2.0]), 1e-3, theta)
    x, _, turned = run.states("q")[-1]
    # It starts from rest within its torque: 20 ms at the softest gain.
    assert 0.196 < x < 0.2
    np.testing.assert_allclose(x, RADIUS * turned, atol=1e-9)
    assert run.states("contact")[-1, SLIP] < 1e-9
    assert run.stepping.statistics[UNSETTLED] == 0


@pytest.mark.parametrize("limits", [{"voltage_limit": 12.0}, {"current_limit": 2.08}])
def test_a_light_wheel_at_the_wrong_limit_comes_to_rest(limits):
    """It is told to stand still, and spins at its limit from the step before. Under either it passes zero in a step.

    It spun on for ever, on power from the steps themselves.
    """
    constant = 12.0 / 5.76
    servo = Servo("axle", constant, 12.0 * constant / 2.5, 0.0, k_v=20.0, velocity_mode=True, armature=2e-4, **limits)
    wheel = Link("wheel", "axle", None, "revolute", Y, Inertia(0.1, np.zeros(3), 4e-5 * np.eye(3)))
    b = assemble(Robot("wheel", (wheel,), (servo,), ("wheel", np.zeros(3))), held=np.zeros(1), real=True)
    b = b.with_shapes()
    for segment in (-1, 1, -2, 2):
        run = b.new_run(b.state([0.0], [5.4]), np.array([0.0, 1.0]), "time_stepping", step=2.5e-3, theta=0.5)
        run.stepping.segment[0] = segment
        run = b.finish(run)
        assert abs(run.states("v")[-1, 0]) < 1e-9
        assert run.stepping.statistics[UNSETTLED] == 0


def stiff_arm(limit: float, current: float = np.inf) -> tuple[CompiledSystem, np.ndarray]:
    """Three joints with gains that ask for a thousand volts; at rest, and away from where they should be."""
    links = [
        Link(f"l{k}", f"j{k}", f"l{k - 1}" if k else None, "revolute", -Y, Inertia(1.0, 0.15 * X, 0.01 * np.eye(3)),
             p_PJ=0.3 * X if k else np.zeros(3))
        for k in range(3)
    ]  # fmt: skip
    motors = [
        Motor(
            f"j{k}",
            0.05,
            resistance=0.6,
            inductance=1e-3,
            rotor_inertia=1e-5,
            gear_ratio=60.0,
            voltage_limit=limit,
            current_limit=current,
        )
        for k in range(3)
    ]
    b = assemble(
        Robot("arm", tuple(links), tuple(motors), ("l2", 0.3 * X)),
        held=np.array([0.8, -0.6, 0.9]), k_p=2000.0, k_d=20.0, real=True,
    )  # fmt: skip
    return b, b.state(np.zeros(3), np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("limit", [24.0, 6.0])
def test_a_stiff_arm_at_its_voltage_limit_ends_where_radau5_does(limit):
    times = np.array([0.0, 0.3, 1.0])
    b, y = stiff_arm(limit)
    exact = b.simulate(y, times, "radau5", rtol=1e-9)
    errors, energies = [], []
    for step in (2e-3, 1e-3, 5e-4):
        run = stepped(b, y, times, step, 0.5)
        assert run.stepping.statistics[UNSETTLED] == 0
        errors.append(np.abs(run.states("q") - exact.states("q")).max(axis=1)[1:])
        energies.append(run.states("ledger")[-1, ELECTRICAL] / exact.states("ledger")[-1, ELECTRICAL] - 1.0)
    # On its way, where it comes off its limit, and at rest.
    assert errors[0][0] < 2e-5
    assert errors[2][0] < 0.2 * errors[0][0]
    assert errors[2][1] < 1e-10
    assert abs(energies[2]) < 1e-3


def test_a_driver_that_limits_the_current_does_so_at_the_end_of_a_step():
    """Six amperes hardly hold it: it comes on and off its limits for a second, each to within a step."""
    times = np.array([0.0, 0.3, 1.0])
    b, y = stiff_arm(24.0, 6.0)
    exact = b.simulate(y, times, "radau5", rtol=1e-9).states("q")
    runs = [stepped(b, y, times, h, 0.5) for h in (2e-3, 1e-3, 5e-4)]
    errors = [np.abs(run.states("q") - exact).max() for run in runs]
    assert errors[2] < 1e-3
    assert errors[2] < 0.2 * errors[0]
    assert all(run.stepping.statistics[UNSETTLED] == 0 for run in runs)


def test_servos_with_limits_of_current_and_open_torques_end_where_radau5_does():
    links = tuple(
        Link(f"l{k}", f"j{k}", f"l{k - 1}" if k else None, "revolute", -Y, Inertia(1.0, 0.15 * X, 0.01 * np.eye(3)),
             p_PJ=0.3 * X if k else np.zeros(3), damping=0.3)
        for k in range(3)
    )  # fmt: skip
    drives = (
        Servo("j0", 2.0, 1.0, 900.0, 10.0, armature=0.05, voltage_limit=40.0, current_limit=12.0),
        Servo("j1", 2.0, 1.0, 900.0, 10.0, armature=0.05, voltage_limit=8.0),
        TorqueSource("j2", torque_limit=0.4),
    )
    b = assemble(Robot("arm", links, drives, ("l2", 0.3 * X)), held=np.array([0.8, -0.6, 0.9]), real=True)
    y, times = b.state(np.zeros(3), np.zeros(3)), np.array([0.0, 0.3, 1.0])
    exact = b.simulate(y, times, "radau5", rtol=1e-9).states("q")
    errors = [np.abs(stepped(b, y, times, h, 0.5).states("q") - exact).max() for h in (2e-3, 1e-3, 5e-4)]
    assert errors[2] < 2e-5
    assert errors[2] < 0.3 * errors[0]


def test_segments_are_those_of_the_law():
    """On its own segment a servo does what its law does; beside it, the limit holds whatever the state says."""
    rng = np.random.default_rng(5)
    table = servo_row(Servo("j", 2.0, 1.5, 60.0, 1.0, k_v=20.0, coulomb_friction=0.1, voltage_limit=10.0,
                            current_limit=4.0))[None]  # fmt: skip
    seen = set()
    for _ in range(400):
        mode, asked, v = int(rng.integers(3)), rng.normal(scale=12.0), rng.normal(scale=3.0)
        segment = servo_segment(table, 0, mode, asked, v)
        seen.add((mode == ka.OFF, segment))
        np.testing.assert_allclose(
            servo_circuit_on(table, 0, mode, segment, asked, v), servo_circuit(table, 0, mode, asked, v), rtol=1e-14
        )
        assert servo_block_on(table, 0, mode, segment, False, v) == servo_block(table, 0, mode, False, asked, v)
    assert seen == {(True, 0), *((False, segment) for segment in (-2, -1, 0, 1, 2))}
    u, i = servo_circuit_on(table, 0, ka.POSITION_MODE, -2, 0.0, 1.0)
    assert (u, i) == (1.5 * -4.0 + 2.0, -4.0)

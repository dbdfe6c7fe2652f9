"""Dynamics of random trees: mass matrix, forces, Jacobians, energy and momentum; sines and cosines of the kernels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.random_robots import assemble, random_inertia, random_robot, random_unit

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.dynamics.tree.joints import sine_cosine
from dynsim.jit.kernel import kernel
from dynsim.model.description import Inertia, Link, Robot
from dynsim.model.drives import Motor

seeds = st.integers(0, 2**32 - 1)


def random_case(seed: int, largest: int = 10) -> tuple[Model, np.ndarray, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    model = Model(random_robot(rng, int(rng.integers(1, largest + 1))))
    return model, rng.normal(scale=2.0, size=model.n), rng.normal(size=model.n), rng


@given(seeds)
def test_mass_matrix_is_symmetric_positive_definite_and_gives_the_kinetic_energy(seed):
    model, q, v, _ = random_case(seed)
    M = model.mass_matrix(q)
    # Rounding of a few hundred operations.
    assert np.abs(M - M.T).max() <= 1e-13 * np.abs(M).max()
    assert np.linalg.eigvalsh(M).min() > 0.0
    assert model.kinetic_energy(q, v) == pytest.approx(0.5 * v @ M @ v, rel=1e-12)


@given(seeds)
def test_inverse_dynamics_is_linear_in_the_acceleration(seed):
    model, q, v, rng = random_case(seed)
    vdot = rng.normal(size=model.n)
    tau = model.inverse_dynamics(q, v, vdot)
    expected = model.mass_matrix(q) @ vdot + model.bias_forces(q, v)
    assert np.abs(tau - expected).max() <= 1e-12 * np.abs(expected).max()  # rounding


@given(seeds)
def test_forward_dynamics_inverts_inverse_dynamics(seed):
    model, q, v, rng = random_case(seed)
    vdot = rng.normal(size=model.n)
    acceleration = model.forward_dynamics(q, v, model.inverse_dynamics(q, v, vdot))
    # Rounding of vdot times the condition of M, and of the forces that cancel, as accelerations.
    M, forces = model.mass_matrix(q), max(1.0, np.abs(model.bias_forces(q, v)).max())
    bound = 1e-14 * (np.linalg.cond(M) * np.abs(vdot).max() + np.linalg.norm(np.linalg.inv(M), 2) * forces)
    assert np.abs(acceleration - vdot).max() <= bound


@given(seeds)
def test_gravity_forces_are_the_gradient_of_the_potential_energy(seed):
    model, q, _, _ = random_case(seed)
    eps = 1e-5
    gradient = [
        (model.potential_energy(q + eps * e) - model.potential_energy(q - eps * e)) / (2 * eps) for e in np.eye(model.n)
    ]
    scale = 1.0 + np.abs(gradient).max() + abs(model.potential_energy(q))
    # Central difference: truncation eps² = 1e-10, rounding 1e-16/eps = 1e-11, of the energies' size.
    assert np.abs(model.bias_forces(q, np.zeros(model.n)) - gradient).max() <= 1e-8 * scale


@given(seeds)
def test_velocity_forces_are_the_christoffel_symbols_of_the_mass_matrix(seed):
    """h_k = Σ_ij (∂M_kj/∂q_i − ½ ∂M_ij/∂q_k) v_i v_j, which makes Ṁ − 2C skew."""
    model, q, v, _ = random_case(seed, largest=6)
    eps = 1e-5
    dM = np.array(
        [(model.mass_matrix(q + eps * e) - model.mass_matrix(q - eps * e)) / (2 * eps) for e in np.eye(model.n)]
    )
    expected = np.einsum("ikj,i,j->k", dM, v, v) - 0.5 * np.einsum("kij,i,j->k", dM, v, v)
    h = model.bias_forces(q, v) - model.bias_forces(q, np.zeros(model.n))
    scale = 1.0 + np.abs(expected).max() + np.abs(model.bias_forces(q, v)).max()
    assert np.abs(h - expected).max() <= 1e-8 * scale  # central difference, as above


@given(seeds)
def test_power_of_the_joint_forces_is_the_change_of_energy(seed):
    model, q, v, rng = random_case(seed)
    a, eps = rng.normal(size=model.n), 1e-5

    def energy(t: float) -> float:
        qt, vt = q + t * v + 0.5 * t * t * a, v + t * a
        return model.kinetic_energy(qt, vt) + model.potential_energy(qt)

    power = v @ model.inverse_dynamics(q, v, a)
    # Central difference, as above; third derivatives of the energy are those of fast spinning joints.
    assert (energy(eps) - energy(-eps)) / (2 * eps) == pytest.approx(
        power, abs=1e-7 * (1.0 + abs(energy(0.0)) + abs(power))
    )


@given(seeds)
def test_point_jacobian_is_the_derivative_of_the_point_position(seed):
    model, q, _, rng = random_case(seed)
    body, point, eps = int(rng.integers(model.n)), rng.normal(size=3), 1e-6
    J = model.point_jacobian(body, point, q)
    columns = [
        (model.point_position(body, point, q + eps * e) - model.point_position(body, point, q - eps * e)) / (2 * eps)
        for e in np.eye(model.n)
    ]
    # Truncation 1e-12, rounding 1e-16/eps = 1e-10, of lengths of a few metres.
    assert np.abs(J - np.transpose(columns)).max() <= 1e-8


def free_body(rng: np.random.Generator) -> Robot:
    """A body free in space (three massless slides, three massless turns) with a motor-driven arm, no gravity."""
    empty, axes = Inertia(0.0), np.eye(3)
    kinds = ["prismatic"] * 3 + ["revolute"] * 3
    links = [
        Link(
            f"b{i}",
            f"j{i}",
            None if i == 0 else f"b{i - 1}",
            kinds[i],
            axes[i % 3],
            empty if i < 5 else random_inertia(rng),
        )
        for i in range(6)
    ]
    links.append(
        Link("arm", "shoulder", "b5", "revolute", random_unit(rng), random_inertia(rng), p_PJ=rng.normal(size=3))
    )
    motor = Motor("shoulder", 0.2, 1.1, 1.7e-3, 1.6e-4, 3.0)
    return Robot("free", tuple(links), (motor,), hand=("arm", np.zeros(3)), gravity=np.zeros(3))


def momentum(model: Model, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Linear [N s] and angular [N m s] momentum of all bodies about the world origin, (6,)."""
    total = np.zeros(6)
    for i, link in enumerate(model.robot.links):
        m, com = link.inertia.mass, link.inertia.com
        R, _ = model.body_pose(i, q)
        c = model.point_position(i, com, q)
        speed = model.point_jacobian(i, com, q) @ v
        # Velocity of three body-fixed points gives ω: ω × R e_k.
        spin = np.array([model.point_jacobian(i, com + e, q) @ v - speed for e in np.eye(3)])
        w = 0.5 * sum(np.cross(R[:, k], spin[k]) for k in range(3))
        total[:3] += m * speed
        total[3:] += m * np.cross(c, speed) + R @ link.inertia.tensor @ R.T @ w
    return total


@pytest.mark.parametrize("seed", range(3))
def test_momentum_of_a_free_body_is_kept_whatever_its_own_motor_does(seed):
    rng = np.random.default_rng(seed)
    b = assemble(free_body(rng), held=np.array([1.0]))
    model = Model(b.robot)
    q, v = rng.normal(scale=0.3, size=7), rng.normal(scale=0.5, size=7)
    run = b.simulate(b.state(q, v), np.linspace(0.0, 1.0, 11), rtol=1e-10)
    assert abs(run.states("q")[-1, 6] - q[6]) > 0.05  # the motor has moved the arm
    values = np.array([momentum(model, *pair) for pair in zip(run.states("q"), run.states("v"), strict=True)])
    # A hundred times the tolerance of the integration, per unit of momentum.
    assert np.abs(values - values[0]).max() <= 1e-8 * (1.0 + np.abs(values).max())


def sweep_trigonometry(joints, trig):
    sine_cosine(joints, trig)


def test_sine_and_cosine_of_the_sweep_are_those_of_libm():
    angles = np.concatenate(
        [np.linspace(-20.0, 20.0, 4001), np.geomspace(1e-8, 1e5, 300), -np.geomspace(1.0, 1e5, 100)]
    )
    joints, trig = np.zeros((len(angles), ka.JOINT_SIZE)), np.zeros((3, len(angles)))
    joints[:, ka.Q] = angles
    compiled = kernel(sweep_trigonometry)
    compiled(joints, trig)
    # Two units in the last place of 1.
    assert np.abs(trig[:2] - [np.sin(angles), np.cos(angles)]).max() <= 4.5e-16
    joints[:, ka.Q] = np.inf
    compiled(joints, trig)
    assert np.isnan(trig[:2]).all()

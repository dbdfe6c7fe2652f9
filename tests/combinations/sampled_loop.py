"""Growth of a sampled loop, by a separate discretisation for the checks: the matrix exponential over one period."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from combinations.observed import Observed
from dynsim.model.drives import Motor, Servo, TorqueSource

Array = NDArray[np.float64]


def loop_growth(seen: Observed, q: Array | None = None, *, most: bool = False) -> float | None:
    """Return the growth rate [1/s] of the slower of two loops (or of the faster one); None if no command is sampled.

    In one loop all contacts are released, in the other one all touching contacts are held: the effect of contacts is in
    between. Weight and velocity products are excluded, so that only the loop can cause growth. Evaluated at the start,
    or at coordinates q (nq,).
    """
    period = seen.sample_time
    if period is None or not seen.robot.motors or seen.reads_sensors:
        return None
    basis = seen.bodies.free_directions()
    q = seen.robot.initial if q is None else q
    first = seen.bodies.motion(q[None], np.zeros((1, seen.bodies.n)), np.zeros((1, seen.bodies.n)))
    rows = [np.zeros((0, seen.bodies.n))]
    for touch in seen.touches(first):
        if abs(touch.gap[0]) < 1e-6 or (touch.contact.stiffness > 0.0 and touch.gap[0] < 0.0):
            J = seen.bodies.jacobian(first, touch.body, touch.position)[0]
            rows.append(J if seen.real and touch.contact.friction > 0.0 else touch.normal[0][None] @ J)
    _, sizes, vectors = np.linalg.svd(np.vstack(rows) @ basis)
    rank = int((sizes > 1e-9).sum())
    # Contacts that prevent all motion stabilise every loop (8831).
    loops = (basis, basis @ vectors[rank:].T)
    radii = [_spectral_radius(seen, q, free) if free.shape[1] else 0.0 for free in loops]
    return float(np.log(max((max if most else min)(radii), 1e-300))) / period


def _spectral_radius(seen: Observed, q: Array, basis: Array) -> float:
    """Return the largest eigenvalue over one period of the motions in a basis, (n, k), at coordinates q (nq,)."""
    from scipy.linalg import expm

    period, controller = seen.sample_time, seen.config.get("controller") or {}
    n, motors = seen.bodies.n, seen.robot.motors
    M = basis.T @ seen.bodies.mass_matrix(q) @ basis
    k = basis.shape[1]
    circuits = [motor for motor in motors if isinstance(motor, Motor)]
    size = 2 * k + len(circuits)
    A, B, K = np.zeros((size, size)), np.zeros((size, len(motors))), np.zeros((len(motors), size))
    A[:k, k : 2 * k] = np.eye(k)
    inverse = np.linalg.inv(M)
    A[k : 2 * k, k : 2 * k] = -inverse @ basis.T @ np.diag(seen.bodies.damping) @ basis
    c = 2 * k
    for a, motor in enumerate(motors):
        row = np.eye(n)[seen.joints.index(motor.joint)] @ basis
        if isinstance(motor, TorqueSource):
            continue
        k_m, resistance = motor.joint_constant, motor.resistance
        k_p, k_d = _gains(controller, motor, sum(isinstance(other, Motor) for other in motors[:a]))
        K[a, :k], K[a, k : 2 * k] = -k_p * row, -k_d * row
        if isinstance(motor, Motor):
            A[k : 2 * k, c] = inverse @ row * k_m
            A[c, c], A[c, k : 2 * k] = -resistance / motor.inductance, -k_m * row / motor.inductance
            B[c, a] = 1.0 / motor.inductance
            c += 1
        else:
            A[k : 2 * k, k : 2 * k] -= np.outer(inverse @ row, row) * k_m**2 / resistance
            B[k : 2 * k, a] = inverse @ row * k_m / resistance
    joined = np.zeros((size + len(motors),) * 2)
    joined[:size, :size], joined[:size, size:] = A, B
    E = expm(joined * period)
    return float(np.abs(np.linalg.eigvals(E[:size, :size] + E[:size, size:] @ K)).max())


def _gains(controller: Mapping[str, Any], motor: Motor | Servo, number: int) -> tuple[float, float]:
    """Return the gains of a motor; ``number``: its index among the DC motors, for gains listed by motor."""
    if isinstance(motor, Servo):
        # The velocity loop compensates the back-EMF of the measured rate: u = k_v (v_d − v) + K_m v.
        return (0.0, motor.k_v - motor.joint_constant) if motor.velocity_mode else (motor.k_p, motor.k_d)
    gains = []
    for key, default in (("k_p_V_per_rad", 500.0), ("k_d_V_s_per_rad", 20.0)):
        value = controller.get(key, default)
        gains.append(float(value[number] if isinstance(value, Sequence) else value))
    return gains[0], gains[1]

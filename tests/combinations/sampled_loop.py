"""How fast a sampled loop grows, by a discretisation of the checks' own: the matrix exponential over one period."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from combinations.observed import Observed
from dynsim.model.drives import Motor, Servo, TorqueSource


def spectral_radius(seen: Observed) -> float | None:
    """Largest eigenvalue of the loop over one period at the start's posture; None where no command is sampled.

    Contacts let go, no weight and no velocity products: what grows without them is the loop.
    """
    period, controller = seen.sample_time, seen.config.get("controller") or {}
    if period is None or not seen.robot.motors:
        return None
    from scipy.linalg import expm

    n, motors = seen.bodies.n, seen.robot.motors
    basis = seen.bodies.free_directions()
    M = basis.T @ seen.bodies.mass_matrix(seen.robot.initial) @ basis
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
        k_p, k_d = _gains(controller, motor)
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


def _gains(controller: Mapping[str, Any], motor: Motor | Servo) -> tuple[float, float]:
    if isinstance(motor, Servo):
        return (0.0, motor.k_v) if motor.velocity_mode else (motor.k_p, motor.k_d)
    gains = []
    for key, default in (("k_p_V_per_rad", 500.0), ("k_d_V_s_per_rad", 20.0)):
        value = controller.get(key, default)
        gains.append(float(value.get(motor.joint, default) if isinstance(value, Mapping) else value))
    return gains[0], gains[1]

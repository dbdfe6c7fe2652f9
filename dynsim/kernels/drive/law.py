"""DC motors: joint references and the continuous voltage PD."""

from __future__ import annotations

from dynsim.kernels.arrays import (
    CURRENT,
    K_D,
    K_M,
    K_P,
    Q_REF,
    QD,
    RESISTANCE,
    U_MAX,
    V_REF,
    VOLTAGE,
    DriveArrays,
    Q,
    ReferenceArrays,
    Workspace,
)
from dynsim.kernels.jit import inlined_kernel


@inlined_kernel
def evaluate_reference(reference: ReferenceArrays, t, ws: Workspace):
    """Reference angles q_d and rates v_d of all motors at time t, into ``ws.motors`` [rad, rad/s]."""
    motors, c = ws.motors, reference.coefficients
    spacing = reference.grid[1]
    x = t - reference.grid[0]
    segment = min(max(int(x / spacing), 0), c.shape[0] - 1)
    x -= segment * spacing
    for a in range(motors.shape[0]):
        s = reference.spline[a]
        if s < 0:
            motors[a, Q_REF] = reference.held[a]
            motors[a, V_REF] = 0.0
        else:
            c0, c1, c2 = c[segment, s, 0], c[segment, s, 1], c[segment, s, 2]
            c3, c4, c5 = c[segment, s, 3], c[segment, s, 4], c[segment, s, 5]
            motors[a, Q_REF] = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
            motors[a, V_REF] = c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))


@inlined_kernel
def motor_voltage(drives: DriveArrays, reference: ReferenceArrays, t, ws: Workspace):
    """u = k_p (q_d − q) + k_d (v_d − v), within ±u_max, into ``ws.motors`` [V] ([WM] eq 56)."""
    evaluate_reference(reference, t, ws)
    motors, joints, motor = ws.motors, ws.joints, drives.motor
    for a in range(motors.shape[0]):
        i = drives.link[a]
        u = motor[a, K_P] * (motors[a, Q_REF] - joints[i, Q]) + motor[a, K_D] * (motors[a, V_REF] - joints[i, QD])
        limit = motor[a, U_MAX]
        motors[a, VOLTAGE] = min(max(u, -limit), limit)


@inlined_kernel
def emf_balance(drives: DriveArrays, ws: Workspace, a):
    """L di/dt = u − R i − K_m v of motor a [V] ([WM] eqs 24, 26)."""
    motors, motor = ws.motors, drives.motor
    return (
        motors[a, VOLTAGE] - motor[a, RESISTANCE] * motors[a, CURRENT] - motor[a, K_M] * ws.joints[drives.link[a], QD]
    )

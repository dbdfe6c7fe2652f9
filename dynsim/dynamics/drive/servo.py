"""A position servo: voltage loop, motor without inductance, limits of voltage and current, friction of the gear.

    u = k_p (q_d − q) + k_d (v_d − v)     position mode
    u = k_v (v_d − v) + K_m v             velocity mode
    i = (u − K_m v) / R                   u within ±U, then i within ±I
    τ = K_m i − τ_c v / √(v² + v_s²)

all at the output shaft; J_m and D_m are counted at the joint, as those of a DC motor. Where the current is at its limit
the terminal voltage is R i + K_m v. A servo that is off has an open circuit, and only the drag of the gear is left.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.limit import clipped


def servo_command(motor, a, mode, q_ref, v_ref, q, v):
    """The voltage that the loop asks for [V], before its limit."""
    if mode == ka.VELOCITY_MODE:
        return motor[a, ka.K_V] * (v_ref - v) + motor[a, ka.K_M] * v
    return motor[a, ka.K_P] * (q_ref - q) + motor[a, ka.K_D] * (v_ref - v)


def servo_segment(motor, a, mode, command, v):
    """Which limit holds at a command and a rate: 0 none, ±1 that of the voltage, ±2 that of the current."""
    if mode == ka.OFF:
        return 0
    u = clipped(command, motor[a, ka.U_MAX])
    wanted = (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]
    if wanted.real > motor[a, ka.I_MAX]:
        return 2
    if wanted.real < -motor[a, ka.I_MAX]:
        return -2
    if command.real > motor[a, ka.U_MAX]:
        return 1
    return -1 if command.real < -motor[a, ka.U_MAX] else 0


def servo_circuit_on(motor, a, mode, segment, command, v):
    """:func:`servo_circuit` with this limit holding, as :func:`servo_segment` tells it, whatever the state says."""
    if mode == ka.OFF:
        return motor[a, ka.K_M] * v, 0.0 * v
    if segment == 2 or segment == -2:
        i = motor[a, ka.I_MAX] if segment > 0 else -motor[a, ka.I_MAX]
        return motor[a, ka.RESISTANCE] * i + motor[a, ka.K_M] * v, i
    u = command if segment == 0 else motor[a, ka.U_MAX] if segment > 0 else -motor[a, ka.U_MAX]
    return u, (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]


def servo_circuit(motor, a, mode, command, v):
    """Terminal voltage u [V] and current i [A] of a command, both within their limits."""
    if mode == ka.OFF:
        return motor[a, ka.K_M] * v, 0.0 * v
    u = clipped(command, motor[a, ka.U_MAX])
    wanted = (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]
    i = clipped(wanted, motor[a, ka.I_MAX])
    if i != wanted:
        u = motor[a, ka.RESISTANCE] * i + motor[a, ka.K_M] * v
    return u, i


def servo_drag(motor, a, mode, v):
    """Friction of the gear against v [N m]: Coulomb's, smoothed below v_s; while off a viscous one comes with it."""
    drag = motor[a, ka.COULOMB] * v / (v * v + motor[a, ka.COULOMB_SPEED] ** 2) ** 0.5
    if mode == ka.OFF:
        drag += motor[a, ka.FREE_DRAG] * v
    return drag


def servo_torque(motor, a, mode, command, v):
    """K_m i − drag [N m] of a command."""
    _, i = servo_circuit(motor, a, mode, command, v)
    return motor[a, ka.K_M] * i - servo_drag(motor, a, mode, v)


def servo_block_on(motor, a, mode, segment, sampled, v):
    """∂τ/∂(q, v) with this limit holding; a command that is ``sampled`` does not follow the state."""
    smoothing = motor[a, ka.COULOMB_SPEED] ** 2
    by_q, by_v = 0.0, -motor[a, ka.COULOMB] * smoothing / (v * v + smoothing) ** 1.5
    if mode == ka.OFF:
        return by_q, by_v - motor[a, ka.FREE_DRAG]
    if -2 < segment < 2:
        slope = motor[a, ka.K_M] / motor[a, ka.RESISTANCE]
        by_v -= slope * motor[a, ka.K_M]
        if not sampled and segment == 0:
            if mode == ka.VELOCITY_MODE:
                by_v += slope * (motor[a, ka.K_M] - motor[a, ka.K_V])
            else:
                by_q -= slope * motor[a, ka.K_P]
                by_v -= slope * motor[a, ka.K_D]
    return by_q, by_v


def servo_block(motor, a, mode, sampled, command, v):
    """∂τ/∂(q, v) at a command; one that is ``sampled`` does not follow the state."""
    return servo_block_on(motor, a, mode, servo_segment(motor, a, mode, command, v), sampled, v)

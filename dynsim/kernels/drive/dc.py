"""A DC motor with its circuit, and the voltage PD on its terminals ([WM] eqs 16–26, 56)."""

from __future__ import annotations

from dynsim.kernels.arrays import INDUCTANCE, K_D, K_M, K_P, RESISTANCE


def dc_command(motor, a, q_ref, v_ref, q, v):
    """u = k_p (q_d − q) + k_d (v_d − v) [V], before its limit ([WM] eq 56)."""
    return motor[a, K_P] * (q_ref - q) + motor[a, K_D] * (v_ref - v)


def dc_torque(motor, a, i):
    """K_m i [N m] ([WM] eq 19); the losses of rotor and gear belong to the joint."""
    return motor[a, K_M] * i


def dc_balance(motor, a, u, v, i):
    """L di/dt = u − R i − K_m v [V] ([WM] eqs 24, 26)."""
    return u - motor[a, RESISTANCE] * i - motor[a, K_M] * v


def dc_block(motor, a, follows):
    """∂τ/∂(q, v, i) and ∂(di/dt)/∂(q, v, i); ``follows`` is 1 where the voltage follows the state, else 0."""
    inductance = motor[a, INDUCTANCE]
    return (
        0.0,
        0.0,
        motor[a, K_M],
        -follows * motor[a, K_P] / inductance,
        -(follows * motor[a, K_D] + motor[a, K_M]) / inductance,
        -motor[a, RESISTANCE] / inductance,
    )

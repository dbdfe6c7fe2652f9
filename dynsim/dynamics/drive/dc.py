"""A DC motor with its circuit, and the voltage PD on its terminals ([WM] eqs 16–26, 56).

A driver that limits the current to ±I lets the voltage be no further from the back-EMF than R I:

    |u − K_m v| ≤ R I,  so that  L d|i|/dt ≤ R (I − |i|)

A current that starts within ±I thus approaches ±I no faster than with the time constant L/R and never exceeds it.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.limit import clipped


def dc_command(motor, a, q_ref, v_ref, q, v):
    """u = k_p (q_d − q) + k_d (v_d − v) [V], before its limit ([WM] eq 56)."""
    return motor[a, ka.K_P] * (q_ref - q) + motor[a, ka.K_D] * (v_ref - v)


def within_current(u, v, k_m, drop):
    """The voltage u, clipped so that it drives no more current than the limit [V]; may exceed the voltage limit.

    drop : R I of the limit [V]
    """
    back = k_m * v
    return back + clipped(u - back, drop)


def dc_torque(motor, a, i):
    """K_m i [N m] ([WM] eq 19); the losses of rotor and gear belong to the joint."""
    return motor[a, ka.K_M] * i


def dc_balance(motor, a, u, v, i):
    """L di/dt = u − R i − K_m v [V] ([WM] eqs 24, 26)."""
    return u - motor[a, ka.RESISTANCE] * i - motor[a, ka.K_M] * v


def dc_block(motor, a, follows):
    """∂τ/∂(q, v, i) and ∂(di/dt)/∂(q, v, i); ``follows`` is 1 where the voltage follows the state, else 0."""
    inductance = motor[a, ka.INDUCTANCE]
    return (
        0.0,
        0.0,
        motor[a, ka.K_M],
        -follows * motor[a, ka.K_P] / inductance,
        -(follows * motor[a, ka.K_D] + motor[a, ka.K_M]) / inductance,
        -motor[a, ka.RESISTANCE] / inductance,
    )


def at_current_limit(motor, a, u, v):
    """Whether the voltage that is left by :func:`within_current` is that of the limit."""
    drop = motor[a, ka.RESISTANCE] * motor[a, ka.I_MAX]
    return abs(u - motor[a, ka.K_M] * v) >= drop * (1.0 - 1e-12)

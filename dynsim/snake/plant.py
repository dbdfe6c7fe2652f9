"""Kinematic plant of the snake: grounded wheels move the base; joints and wheels follow their commands."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel


@internal_kernel
def base_velocity(model, grounded, yaw, phi, u, ws):
    """Velocity of the base part that the grounded wheels allow, into ``ws.base_rate``.

    Joint and wheel rates are given, so the rows (no side slip of every grounded pair, rolling of every grounded active
    wheel) are more than the three unknowns. Their least-squares solution is the motion of least dissipation when all
    wheels slip against equal viscous friction; between control ticks, when held rates fit the rows only to first order,
    it shares the misfit evenly. A consistent u gives the exact motion.

    Returns
    -------
    slip : float
        Largest residual of a row [m/s].
    """
    normal, out, joints = ws.normal, ws.base_rate, model.head_joints + model.base_joints
    slip = 0.0
    for sweep in range(2):  # 0: sum the normal equations, 1: residuals of the solution
        if sweep == 0:
            for i in range(3):
                for j in range(4):
                    normal[i, j] = 0.0
        x, y, heading, spin = 0.0, 0.0, yaw, 0.0
        for pair in range(model.base_joints + 1):
            if pair > 0:
                c, s = math.cos(heading), math.sin(heading)
                x, y = x - model.link_length * c, y - model.link_length * s
                ws.px[pair - 1], ws.py[pair - 1] = x, y
                heading += phi[model.head_joints + pair - 1]
                spin += u[model.head_joints + pair - 1]
                x -= model.link_length * math.cos(heading)
                y -= model.link_length * math.sin(heading)
            if not grounded[pair]:
                continue
            vx, vy = 0.0, 0.0  # from the joint rates, pair 1 held
            for j in range(pair):
                rate = u[model.head_joints + j]
                vx -= rate * (y - ws.py[j])
                vy += rate * (x - ws.px[j])
            c, s = math.cos(heading), math.sin(heading)
            for kind in range(2):
                if kind == 0:  # -s vx + c vy = 0
                    ax, ay, turn, known = -s, c, 0.0, 0.0
                elif model.wheel[pair] >= 0:  # c vx + s vy - side b omega = r rho'
                    ax, ay, turn = c, s, -model.side[pair] * model.half_track[pair]
                    known = model.wheel_radius * u[joints + model.wheel[pair]]
                else:
                    continue
                aw = -ax * y + ay * x + turn
                rhs = known - ax * vx - ay * vy - turn * spin
                if sweep == 0:
                    row = (ax, ay, aw, rhs)
                    for i in range(3):
                        for j in range(4):
                            normal[i, j] += row[i] * row[j]
                else:
                    slip = max(slip, abs(ax * out[0] + ay * out[1] + aw * out[2] - rhs))
        if sweep == 0:
            for i in range(3):
                for k in range(i + 1, 3):
                    factor = normal[k, i] / normal[i, i]
                    for j in range(i, 4):
                        normal[k, j] -= factor * normal[i, j]
            for i in range(2, -1, -1):
                value = normal[i, 3]
                for j in range(i + 1, 3):
                    value -= normal[i, j] * out[j]
                out[i] = value / normal[i, i]
    return slip


@internal_kernel
def advance_plant(model, grounded, period, substeps, state, u, ws):
    """Hold u for one control period: joints and wheels exactly, base pose by classical Runge-Kutta 4.

    Returns the largest slip met [m/s].
    """
    h, slip = period / substeps, 0.0
    for _ in range(substeps):
        for i in range(3):
            ws.base_sum[i] = 0.0
        for stage in range(4):
            fraction = (0.0, 0.5, 0.5, 1.0)[stage]
            for j in range(state.phi.shape[0]):
                ws.phi_stage[j] = state.phi[j] + fraction * h * u[j]
            for i in range(3):
                ws.base_stage[i] = state.base[i] + (fraction * h * ws.base_rate[i] if stage > 0 else 0.0)
            now = base_velocity(model, grounded, ws.base_stage[2], ws.phi_stage, u, ws)
            slip = max(slip, now)
            weight = (1.0, 2.0, 2.0, 1.0)[stage]
            for i in range(3):
                ws.base_sum[i] += weight * ws.base_rate[i]
        for i in range(3):
            state.base[i] += h / 6.0 * ws.base_sum[i]
        for j in range(state.phi.shape[0]):
            state.phi[j] += h * u[j]
        for j in range(state.rho.shape[0]):
            state.rho[j] += h * u[state.phi.shape[0] + j]
    return slip

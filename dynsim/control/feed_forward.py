"""Planned voltages along joint references: gravity, the whole dynamics, and braces that press with given forces.

    K_m i = M v̇ + h + g + J_m v̇ + (D + D_m) v − J_cᵀ f_d,    u = R i + L di/dt + K_m v

f_d: normal forces as commanded, or those of least heat, and the friction of a point that slips along the references.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from dynsim.errors import ModelError
from dynsim.model.bracing import MIN_N, Brace
from dynsim.model.description import Contact
from dynsim.model.drives import Motor
from dynsim.model.model import Model
from dynsim.model.shapes import gap_at

Array = NDArray[np.float64]

# Slip of the references [m/s] over which planned friction grows to its value: a jump would make the voltages ring.
SLIP_SCALE = 5e-3
# Further off its surface than this, by the references, a brace carries nothing [m].
GAP_MAX = 2e-3


def planned_voltages(
    model: Model,
    times: Array,
    positions: Mapping[str, Array],
    braces: Mapping[str, tuple[Contact, float | None]],
    min_N: float = MIN_N,
    whole: bool = True,
) -> Array:
    """Voltages of all motors, (T, na) [V].

    Parameters
    ----------
    times : (T,) equally spaced [s]
    positions : of the moving joints, (T,) [rad or m]; the others hold their initial ones
    braces : contact and commanded normal force [N] by name; None: the one of least heat, at least ``min_N``
    whole : the whole dynamics and the circuits; else what holds the weight at rest, i = g / K_m

    Raises
    ------
    ModelError
        Joints without DC motors, a brace that is no point or that the references take off its surface, or no forces
        that carry the motion.
    """
    robot = model.robot
    driven = [motor.joint for motor in robot.motors]
    if sorted(driven) != sorted(robot.joint_names) or not all(isinstance(m, Motor) for m in robot.motors):
        raise ModelError("controller: planned voltages need a DC motor on every joint", keys=("controller",))
    q = np.tile(robot.initial, (len(times), 1))
    for name, values in positions.items():
        q[:, model.joint_names.index(name)] = values
    for name, (contact, _) in braces.items():
        _check_brace(model, name, contact, times, q)
    spline = make_interp_spline(times, q, k=5)
    v, vdot = spline(times, 1), spline(times, 2)
    rest = np.zeros(model.n)
    torques = np.zeros((len(times), model.n))
    for k in range(len(times)):
        if not whole:
            torques[k] = model.bias_forces(q[k], rest)
            continue
        at = {name: _brace(model, contact, force, min_N, q[k], v[k]) for name, (contact, force) in braces.items()}
        found = model.brace_statics(q[k], v[k], vdot[k], at)
        if not found.feasible:
            raise ModelError(
                f"controller.brace: at t = {times[k]:.3f} s no forces of {', '.join(braces)} carry the motion within "
                "the limits of the motors",
                keys=("controller", "brace"),
            )
        torques[k] = found.torques
    columns = [model.joint_names.index(joint) for joint in driven]
    motors = [motor for motor in robot.motors if isinstance(motor, Motor)]
    constant = np.array([motor.joint_constant for motor in motors])
    resistance, inductance = (np.array([getattr(m, key) for m in motors]) for key in ("resistance", "inductance"))
    current = torques[:, columns] / constant
    if not whole:
        return np.asarray(resistance * current)
    rate = make_interp_spline(times, current, k=5)(times, 1)
    return np.asarray(resistance * current + inductance * rate + constant * v[:, columns])


def _check_brace(model: Model, name: str, contact: Contact, times: Array, q: Array) -> None:
    """Refuse a brace that nothing can press against."""
    keys = ("controller", "brace")
    if contact.radius > 0.0 or contact.tip is not None:
        raise ModelError(
            f"controller.brace: {name} is no point but has a radius; name points of contacts.points that are to press",
            keys=keys,
        )
    gaps = np.array([gap_at(model, contact, row) for row in q])
    k = int(np.abs(gaps).argmax())
    if abs(gaps[k]) > GAP_MAX:
        raise ModelError(
            f"controller.brace: the references take {name} {gaps[k]:+.4g} m off surface {contact.surface_name!r} at "
            f"t = {times[k]:.3f} s (limit {GAP_MAX:g} m); let controller.hand.braces keep it there, or take "
            "initial.on_surface",
            keys=keys,
        )


def _brace(model: Model, contact: Contact, force: float | None, min_N: float, q: Array, v: Array) -> Brace:
    """The brace that a contact is at a point of the references."""
    position, jacobian = model.point_position_and_jacobian(contact.body, contact.point, q)
    normal = contact.surface.normal(position)
    slip = jacobian @ v
    slip -= (slip @ normal) * normal
    speed = float(np.linalg.norm(slip))
    sliding = speed > 1e-9
    return Brace(
        body=contact.body,
        point=contact.point,
        normal=normal,
        friction=contact.friction * speed / float(np.hypot(speed, SLIP_SCALE)) if sliding else 0.0,
        min_N=min_N,
        normal_force=force,
        sliding=slip if sliding else None,
    )

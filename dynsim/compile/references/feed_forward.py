"""Feed-forward voltages along joint references, from full dynamics with brace forces or from gravity alone.

    K_m i = M v̇ + h + g + J_m v̇ + (D + D_m) v − Jᵀ f,    u = R i + L di/dt + K_m v

f are the brace forces: normal forces, commanded or chosen for least motor heat, and friction if the references slip.
Gravity alone requires u = R g / K_m. :func:`pressing` builds the tables of the braces, also for the brace planner.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.bracing import MIN_N, BracePlanner, brace_rows
from dynsim.compile.model import Model
from dynsim.compile.splines import quintic_rates
from dynsim.dynamics.contact.braces import tables as kb
from dynsim.errors import ModelError
from dynsim.model.description import Contact
from dynsim.model.drives import Motor

Array = NDArray[np.float64]

# Smoothing speed v_s of planned friction [m/s], μ s/√(s² + v_s²): a jump would make the voltages oscillate.
SLIP_SCALE = 5e-3
# Slip speed s below which the plan contains no friction [m/s].
SLIP_MIN = 1e-9
# Largest distance of a brace from its surface, above or below, along the references [m]; more is a ModelError.
GAP_MAX = 2e-3


def planned_voltages(
    model: Model,
    times: Array,
    positions: Mapping[str, Array],
    braces: Mapping[str, tuple[Contact, float | None]],
    min_N: float = MIN_N,
    whole: bool = True,
) -> Array:
    """Return the voltages of all motors, (T, na) [V].

    Parameters
    ----------
    times : (T,) equally spaced instants [s]
    positions : positions of the moving joints, (T,) [rad or m]; the remaining joints hold their initial positions
    braces : contact and commanded normal force [N] for each brace; None for the force of least heat, at least ``min_N``
    whole : True for the whole dynamics and the circuits; False for the currents that hold the weight at rest,
        i = g / K_m

    Raises
    ------
    ModelError
        If a joint has no DC motor, a mobile base must move, a brace is not a point or the references pull it off its
        surface, or no brace forces carry the motion.
    """
    robot = model.robot
    driven = [motor.joint for motor in robot.motors]
    if sorted(driven) != sorted(robot.joint_names) or not all(isinstance(m, Motor) for m in robot.motors):
        raise ModelError("controller: planned voltages need a DC motor on every joint", keys=("controller",))
    q, places = np.tile(robot.initial, (len(times), 1)), list(robot.position_index)
    for name, values in positions.items():
        if robot.base is not None and name in robot.base.wheels and np.ptp(values) > 0.0:
            raise ModelError("controller: planned voltages need a mobile base that stands", keys=("controller",))
        q[:, places[model.joint_names.index(name)]] = values
    spacing = float(times[1] - times[0])
    v, vdot = quintic_rates(spacing, q[:, places])
    if whole:
        torques = _pressing_torques(model, times, q, v, vdot, braces, min_N)
    else:
        still = np.zeros(model.n)
        torques = np.array([model.bias_forces(row, still) for row in q])
    columns = [model.joint_names.index(joint) for joint in driven]
    motors = [motor for motor in robot.motors if isinstance(motor, Motor)]
    constant = np.array([motor.joint_constant for motor in motors])
    resistance, inductance = (np.array([getattr(m, key) for m in motors]) for key in ("resistance", "inductance"))
    current = torques[:, columns] / constant
    if not whole:
        return np.asarray(resistance * current)
    rate, _ = quintic_rates(spacing, current)
    return np.asarray(resistance * current + inductance * rate + constant * v[:, columns])


def pressing(
    model: Model,
    times: Array,
    q: Array,
    v: Array,
    braces: Mapping[str, tuple[Contact, float | None]],
    min_N: float = MIN_N,
    slip_scale: float = SLIP_SCALE,
) -> tuple[BracePlanner, Array]:
    """Return the planner of braces that press along references, and their kernel tables, (T, c, BRACE_SIZE).

    Friction acts against the slip of the references: μ f_n v/√(v² + v_s²), with v_s = ``slip_scale`` [m/s].
    """
    attached = []
    for name, (contact, _) in braces.items():
        if contact.tip is not None:
            raise ModelError(
                f"controller.brace: {name} is the axis of a link; name points of contacts.points that are to press",
                keys=("controller", "brace"),
            )
        attached.append(model.robot.attach(contact.body, contact.point))
    planner = BracePlanner(model.robot, model.arrays, [link for link, _ in attached])
    points = np.array([point for _, point in attached]).reshape(-1, 3)
    positions, velocities = planner.motion(points, q, v)
    tables = np.zeros((len(times), len(braces), kb.BRACE_SIZE))
    for k, (name, (contact, force)) in enumerate(braces.items()):
        _check_gaps(name, contact, times, contact.surface.gaps(positions[:, k]) - contact.radius)
        normals = contact.surface.normals(positions[:, k])
        touching, velocity = points[k], velocities[:, k]
        if contact.radius > 0.0:
            touching, velocity = _lowest_points(model, attached[k], -contact.radius * normals, q, v)
        slip = velocity - np.sum(velocity * normals, axis=1, keepdims=True) * normals
        speed = np.linalg.norm(slip, axis=1)
        slip[speed <= SLIP_MIN] = 0.0
        # The plan has no friction for a point at rest along the surface: the friction there depends on its history.
        friction = np.where(speed > SLIP_MIN, contact.friction * speed / np.hypot(speed, slip_scale), 0.0)
        tables[:, k] = brace_rows(touching, normals, friction, min_N, np.nan if force is None else force, slip)
    return planner, tables


def _pressing_torques(
    model: Model,
    times: Array,
    q: Array,
    v: Array,
    vdot: Array,
    braces: Mapping[str, tuple[Contact, float | None]],
    min_N: float,
) -> Array:
    """Return the torques of the motors along the references, (T, n), with braces that press."""
    planner, tables = pressing(model, times, q, v, braces, min_N)
    torques, _, solved = planner.least_heat(q, v, vdot, tables)
    if solved < len(times):
        raise ModelError(
            f"controller.brace: at t = {times[solved]:.3f} s no forces of {', '.join(braces)} carry the motion within "
            "the limits of the motors; ask for other forces, go slower, or raise a voltage_limit_V or peak_current_A",
            keys=("controller", "brace"),
        )
    return torques


def _lowest_points(
    model: Model, attached: tuple[int, Array], offsets: Array, q: Array, v: Array
) -> tuple[Array, Array]:
    """Return a body's points at given offsets from one of its points: in its frame [m], and their velocities [m/s].

    Parameters
    ----------
    attached : link, and the point in its frame [m]
    offsets : offsets in the world frame, (T, 3) [m]
    """
    link, point = attached
    planner = BracePlanner(model.robot, model.arrays, [link] * 4)
    positions, velocities = planner.motion(point + np.vstack([np.zeros(3), np.eye(3)]), q, v)
    axes = positions[:, 1:] - positions[:, :1]  # (T, 3, 3), a row for each axis of the body
    shifts = np.einsum("tij,tj->ti", axes, offsets)
    return point + shifts, velocities[:, 0] + np.einsum("ti,tij->tj", shifts, velocities[:, 1:] - velocities[:, :1])


def _check_gaps(name: str, contact: Contact, times: Array, gaps: Array) -> None:
    """Raise ModelError if the references pull a brace off its surface, where it cannot carry its planned force."""
    k = int(np.abs(gaps).argmax())
    if abs(gaps[k]) > GAP_MAX:
        raise ModelError(
            f"controller.brace: the references take {name} {gaps[k]:+.4g} m off surface {contact.surface_name!r} at "
            f"t = {times[k]:.3f} s (limit {GAP_MAX:g} m); let controller.hand.braces keep it there, or take "
            "initial.on_surface",
            keys=("controller", "brace"),
        )

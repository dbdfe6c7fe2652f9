"""Joint references by inverse kinematics of a hand path, on the joints that the scenario names."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.bracing import MIN_N, BracePlanner, brace_rows
from dynsim.compile.hand_posture import hand_posture
from dynsim.compile.model import Model
from dynsim.compile.reaching import path_arrays
from dynsim.compile.references.plane_curve import quintic_rates
from dynsim.compile.tables import format_quantity
from dynsim.dynamics import inverse_kinematics as kik
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.dynamics.tables import workspace
from dynsim.errors import ModelError, UnreachableReference
from dynsim.jit.kernel import reals
from dynsim.model.base_pose import base_row
from dynsim.model.description import Contact
from dynsim.model.drives import Motor
from dynsim.system.memo import recall

Array = NDArray[np.float64]

# Limits in files are rounded: 1.5707963 = 90° is not beyond 90° [rad or m].
LIMIT_SLACK = 1e-6
# Targets between two checks of the clock and for Ctrl-C: some milliseconds.
PIECE = 256
# Wall time before the first report of progress, and between two [s]; most paths take less than the first.
QUIET_S, REPORT_S = 1.0, 0.1


def follow(
    model: Model,
    times: Array,
    targets: Array,
    joints: Sequence[str],
    q: Array,
    tolerance: float,
    progress: Callable[[float], None] | None = None,
    base: Array | None = None,
    braces: Sequence[Contact] = (),
    orientation: Array | None = None,
) -> Array:
    """Positions of ``joints`` that put the hand on ``targets`` at ``times``; the others stay as in ``q``.

    Joints keep their limits on the way. The targets are in the world: what a mobile base moves by meanwhile, the joints
    make up for.

    Damped Gauss–Newton from the previous solution: dq = Jᵀ (J Jᵀ + λ 1)⁻¹ e, with λ falling with the error, so that
    near a solution it is Newton's method and far from one it does not jump. More than three joints move as little as
    possible.

    Parameters
    ----------
    times : (T,) [s]; targets : (T, 3) [m]
    joints : names of the joints that move
    q : (nq,) configuration to start from; it selects the branch
    tolerance : distance that counts as reached [m]
    progress : called now and then with the time on the path [s], when it takes longer than a second
    braces : points that stay on their surfaces on the way, as exactly as the hand is on its path
    base : (T, 4) coordinates of the mobile base at ``times``: its wheels [rad], x and y [m]; None: it stays
    orientation : (3, 3) rotation of the hand in the world, which it keeps all the way; None: any

    Returns
    -------
    array, shape (T, len(joints)) [rad or m]

    Raises
    ------
    UnreachableReference
        With the first time at which the hand cannot reach its target, and the distance that is left; or with the joint
        that would pass its limit, when, and by how much.
    """
    if orientation is not None:
        _check_start(model, joints, q)
        args = model, times, targets, joints, q, tolerance, orientation, braces
        return recall("turned hand", lambda: _turned(*args), model.geometry, *args[1:])
    path, wanted = path_arrays(model, joints, braces, limited=True), reals(targets)
    carried = np.zeros((len(times), 0)) if base is None else reals(base)
    first = 0 if base is None else base_row(model.robot)[0]
    geometry = model.geometry
    _check_start(model, joints, q)

    def solved() -> Array:
        ws, result = workspace(model.n, 0, 0), np.zeros((len(times), len(joints)))
        there, k, due = reals(q), 0, clock.perf_counter() + QUIET_S
        while k < len(times):
            if progress is not None and clock.perf_counter() >= due:
                progress(float(times[k]))
                due = clock.perf_counter() + REPORT_S
            end = min(k + PIECE, len(times))
            k, left = kik.follow_path(geometry, ws, path, wanted, carried, first, k, end, tolerance, there, result)
            if k < end:
                free = path_arrays(model, joints, braces)
                result[:] = 0.0
                reached, _ = kik.follow_path(
                    geometry, ws, free, wanted, carried, first, 0, len(times), tolerance, reals(q), result
                )
                if reached > k and (passed := _passed_limits(model, joints, times, result[:reached])):
                    raise UnreachableReference(
                        "controller.hand.path: "
                        f"the hand cannot follow its path with {', '.join(joints)} within their limits: {passed}; move "
                        "the path, let more joints follow it, or change the limit"
                    )
                target = wanted[k]
                raise UnreachableReference(
                    "controller.hand.path: "
                    f"the hand cannot follow its path with {', '.join(joints)}: at t = {times[k]:.3f} s it stays "
                    f"{left:.4g} m from ({target[0]:.4g}, {target[1]:.4g}, {target[2]:.4g}) m; "
                    "move the path, or let more joints follow it"
                )
        return result

    inputs = geometry, path, wanted, carried, first, tolerance, np.asarray(q)
    # Not from masses. The path has room for one step in it, which holds anything afterwards.
    return recall("inverse kinematics", solved, *inputs)


def _turned(
    model: Model,
    times: Array,
    targets: Array,
    joints: Sequence[str],
    q: Array,
    tolerance: float,
    orientation: Array,
    braces: Sequence[Contact],
) -> Array:
    """As :func:`follow`, for a hand that keeps its orientation."""
    columns = [model.robot.position_index[model.joint_names.index(name)] for name in joints]
    postures = np.zeros((len(times), len(joints)))
    for k, target in enumerate(targets):
        try:
            q = hand_posture(model, target, q, orientation, braces, tolerance, joints)
        except UnreachableReference as error:
            raise UnreachableReference(
                "controller.hand.path: "
                f"the hand cannot follow its path with {', '.join(joints)}, turned as controller.hand.orientation "
                f"says: at t = {times[k]:.3f} s {error}"
            ) from None
        postures[k] = q[columns]
    return postures


def _check_start(model: Model, joints: Sequence[str], q: Array) -> None:
    """Refuse joints that begin beyond their limits: the path would begin with a jump."""
    for name in joints:
        i = model.joint_names.index(name)
        link, at = model.robot.links[i], float(q[model.robot.position_index[i]])
        for which, limit, beyond in (("lower", link.lower, link.lower - at), ("upper", link.upper, at - link.upper)):
            if beyond > LIMIT_SLACK:
                raise UnreachableReference(
                    "controller.hand.path: "
                    f"{name} follows the hand's path, but starts at {format_quantity(at, link.units[0])}, beyond "
                    f"its {which} limit of {format_quantity(limit, link.units[0])}; change its initial "
                    "position or its limit"
                )


def _passed_limits(model: Model, joints: Sequence[str], times: Array, positions: Array) -> str:
    """What joints without limits would do: joint, limit, time and amount of the one that goes furthest beyond."""
    passed: list[tuple[float, str]] = []
    for name, column in zip(joints, positions.T, strict=True):
        link = model.robot.links[model.joint_names.index(name)]
        unit = link.units[0]
        sides = ("lower", link.lower, link.lower - column), ("upper", link.upper, column - link.upper)
        for which, limit, beyond in sides:
            over = np.flatnonzero(beyond > LIMIT_SLACK)
            if over.size:
                most, since = float(beyond[over].max()), times[over[0]]
                text = f"{name} would pass its {which} limit of {format_quantity(limit, unit)} from"
                passed.append((most, f"{text} t = {since:.3f} s on, by up to {format_quantity(most, unit, 3)}"))
    return "; ".join(text for _, text in sorted(passed, reverse=True))


# Feed-forward voltages along joint references, from full dynamics with brace forces or from gravity alone.


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

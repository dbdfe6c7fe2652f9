"""Joint references from the inverse kinematics of a hand path, and planned voltages along joint references."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.bracing import MIN_N, BracePlanner, PressingBrace, brace_rows
from dynsim.compile.hand_posture import hand_posture
from dynsim.compile.model import Model
from dynsim.compile.reaching import path_arrays
from dynsim.compile.references.splines import quintic_rates
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

# Excess over a limit that is tolerated, because limits in files are rounded: 90° does not exceed 1.5707963 [rad or m].
LIMIT_SLACK = 1e-6
# Number of targets between two checks of the clock and for Ctrl-C; these targets take a few milliseconds.
PIECE = 256
# Wall-clock time before the first progress report, and between reports [s]; most paths take less than the former.
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
    """Compute positions of ``joints`` that put the hand on ``targets`` at ``times``; other joints stay as in ``q``.

    The joint limits are enforced. The targets are in the world frame, so the joints compensate for the motion of a
    mobile base.

    The method takes damped Gauss–Newton steps from the previous solution: dq = Jᵀ (J Jᵀ + λ 1)⁻¹ e. λ decreases with
    the error, so that the method becomes Newton's method near a solution and does not jump far away from it. If there
    are more than three joints, they move as little as possible.

    Parameters
    ----------
    model : Model
        Model of the robot.
    times : (T,) ndarray
        Times [s].
    targets : (T, 3) ndarray
        Hand positions in the world frame [m].
    joints : sequence of str
        Joints that move.
    q : (nq,) ndarray
        Configuration to start from, which selects the solution branch.
    tolerance : float
        Distance from a target at which it counts as reached [m].
    progress : callable, optional
        Called regularly with the time on the path [s] if the computation takes longer than a second.
    base : (T, 4) ndarray, optional
        Coordinates of the mobile base at ``times``: wheels [rad], x and y [m]; default: it does not move.
    braces : sequence of Contact, optional
        Points that stay on their surfaces, with the same tolerance as the hand on its path.
    orientation : (3, 3) ndarray, optional
        Constant rotation of the hand in the world; default: any.

    Returns
    -------
    (T, len(joints)) ndarray
        Joint positions [rad or m].

    Raises
    ------
    UnreachableReference
        With the first time at which the hand cannot reach its target, and the remaining distance; or with the joint
        that would exceed its limit, the time and the amount.
    """
    if orientation is not None:
        args = model, times, targets, joints, q, tolerance, orientation, braces, base
        return recall("turned hand", lambda: _turned(*args), model.geometry, *args[1:])
    path, wanted = path_arrays(model, joints, braces, limited=True), reals(targets)
    carried = np.zeros((len(times), 0)) if base is None else reals(base)
    first = 0 if base is None else base_row(model.robot)[0]
    geometry = model.geometry

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
                        f"out of reach with {', '.join(joints)} within their limits: {passed}; move the path, add "
                        "joints to controller.hand.joints, or change the limit"
                    )
                target = wanted[k]
                raise UnreachableReference(
                    "controller.hand.path: "
                    f"out of reach with {', '.join(joints)}: at t = {times[k]:.3f} s the hand is "
                    f"{left:.4g} m from ({target[0]:.4g}, {target[1]:.4g}, {target[2]:.4g}) m; "
                    "move the path or add joints to controller.hand.joints"
                )
        return result

    inputs = geometry, path, wanted, carried, first, tolerance, np.asarray(q)
    # The cached result does not depend on masses. The path contains a workspace for one step with arbitrary contents.
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
    base: Array | None,
) -> Array:
    """Compute the same positions as :func:`follow`, for a hand with constant orientation."""
    columns = [model.robot.position_index[model.joint_names.index(name)] for name in joints]
    postures = np.zeros((len(times), len(joints)))
    for k, target in enumerate(targets):
        if base is not None:
            first = base_row(model.robot)[0]
            q = np.concatenate([q[:first], base[k], q[first + base.shape[1] :]])
        try:
            q = hand_posture(model, target, q, orientation, braces, tolerance, joints)
        except UnreachableReference as error:
            raise UnreachableReference(
                "controller.hand.path: "
                f"out of reach with {', '.join(joints)} and controller.hand.orientation: at t = {times[k]:.3f} s: "
                f"{error}"
            ) from None
        postures[k] = q[columns]
    return postures


def _passed_limits(model: Model, joints: Sequence[str], times: Array, positions: Array) -> str:
    """Describe how joints would exceed their limits without enforcement: joint, limit, time, excess; largest first."""
    passed: list[tuple[float, str]] = []
    for name, column in zip(joints, positions.T, strict=True):
        link = model.robot.links[model.joint_names.index(name)]
        unit = link.units[0]
        sides = ("lower", link.lower, link.lower - column), ("upper", link.upper, column - link.upper)
        for which, limit, beyond in sides:
            over = np.flatnonzero(beyond > LIMIT_SLACK)
            if over.size:
                most, since = float(beyond[over].max()), times[over[0]]
                text = f"{name} would exceed its {which} limit of {format_quantity(limit, unit)} from"
                passed.append((most, f"{text} t = {since:.3f} s on, by up to {format_quantity(most, unit, 3)}"))
    return "; ".join(text for _, text in sorted(passed, reverse=True))


# Feed-forward voltages along joint references, from the full dynamics with brace forces or from gravity alone.


# Smoothing speed v_s of planned friction [m/s], μ s/√(s² + v_s²); a jump in friction would make the voltages oscillate.
# With a larger value, braces that creep would have less friction in the plan than in the run.
SLIP_SCALE = 1e-3
# Slip speed s below which the plan contains no friction [m/s].
SLIP_MIN = 1e-9
# Maximum distance of a brace from its surface, above or below, along the references [m]; a larger distance is an error.
GAP_MAX = 2e-3


def planned_voltages(
    model: Model,
    times: Array,
    positions: Mapping[str, Array],
    braces: Mapping[str, PressingBrace],
    min_N: float = MIN_N,
    whole: bool = True,
) -> Array:
    """Return the voltages of all motors, (T, na) [V].

    Parameters
    ----------
    model : Model
        Model of the robot.
    times : (T,) ndarray
        Equally spaced times [s].
    positions : mapping of str to (T,) ndarray
        Positions of the moving joints [rad or m]; the other joints keep their initial positions.
    braces : mapping of str to PressingBrace
        Braces that press, by name.
    min_N : float, optional
        Minimum normal force of braces without a commanded force [N].
    whole : bool, optional
        True for the full dynamics and the circuits; False for the currents that hold the weight at rest, i = g / K_m.

    Raises
    ------
    ModelError
        If a joint has no DC motor, a mobile base must move, a brace is not a point, the references pull a brace off its
        surface, or no brace forces carry the motion.
    """
    robot = model.robot
    driven = [motor.joint for motor in robot.motors]
    if sorted(driven) != sorted(robot.joint_names) or not all(isinstance(m, Motor) for m in robot.motors):
        raise ModelError("controller: planned voltages require a DC motor on every joint", keys=("controller",))
    q, places = np.tile(robot.initial, (len(times), 1)), list(robot.position_index)
    for name, values in positions.items():
        if robot.base is not None and name in robot.base.wheels and np.ptp(values) > 0.0:
            raise ModelError("controller: planned voltages require a stationary mobile base", keys=("controller",))
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
    braces: Mapping[str, PressingBrace],
    min_N: float = MIN_N,
) -> tuple[BracePlanner, Array, Array | None]:
    """Return the planner for braces that press along references, their kernel tables and their shares.

    The tables have shape (T, c, BRACE_SIZE), the shares (T, c); None if all braces press during the whole run.
    Friction opposes the slip that the references prescribe: μ f_n v/√(v² + v_s²), with v_s = 1 mm/s.
    """
    attached = []
    for name, brace in braces.items():
        contact = brace.contact
        if contact.tip is not None:
            raise ModelError(
                f"controller.brace: {name} is the axis of a link; use points of contacts.points",
                keys=("controller", "brace"),
            )
        if contact.surface.carrier is not None:
            raise ModelError(
                f"controller.brace: {name} is on {contact.surface_name}, which {contact.surface.carrier} carries; use "
                "points on surfaces of the world",
                keys=("controller", "brace"),
            )
        attached.append(model.robot.attach(contact.body, contact.point))
    planner = BracePlanner(model.robot, model.arrays, [link for link, _ in attached])
    points = np.array([point for _, point in attached]).reshape(-1, 3)
    positions, velocities = planner.motion(points, q, v)
    tables = np.zeros((len(times), len(braces), kb.BRACE_SIZE))
    shares = np.array([brace.share(times) for brace in braces.values()]).reshape(-1, len(times)).T
    for k, (name, brace) in enumerate(braces.items()):
        contact = brace.contact
        gaps = contact.surface.gaps(positions[:, k]) - contact.radius
        _check_gaps(name, contact, times, np.where(shares[:, k] > 0.0, gaps, 0.0))
        normals = contact.surface.normals(positions[:, k])
        touching, velocity = points[k], velocities[:, k]
        if contact.radius > 0.0:
            touching, velocity = _lowest_points(model, attached[k], -contact.radius * normals, q, v)
        slip = velocity - np.sum(velocity * normals, axis=1, keepdims=True) * normals
        speed = np.linalg.norm(slip, axis=1)
        slip[speed <= SLIP_MIN] = 0.0
        # Plan no friction for a point that does not slide, because its friction depends on its history.
        friction = np.where(speed > SLIP_MIN, contact.friction * speed / np.hypot(speed, SLIP_SCALE), 0.0)
        commanded = np.nan if brace.force is None else brace.force
        tables[:, k] = brace_rows(touching, normals, friction, min_N, commanded, slip)
    return planner, tables, shares if any(brace.during is not None for brace in braces.values()) else None


def _pressing_torques(
    model: Model,
    times: Array,
    q: Array,
    v: Array,
    vdot: Array,
    braces: Mapping[str, PressingBrace],
    min_N: float,
) -> Array:
    """Return the motor torques along the references, (T, n), with braces that press."""
    planner, tables, shares = pressing(model, times, q, v, braces, min_N)
    torques, _, solved = planner.least_heat(q, v, vdot, tables, shares)
    if solved < len(times):
        key, subject = ("brace", f"forces of {', '.join(braces)}") if braces else ("feed_forward", "motor torques")
        fix = "change the forces, slow down" if braces else "slow down, use gravity"
        raise ModelError(
            f"controller.{key}: at t = {times[solved]:.3f} s no {subject} carry the motion within the motor limits; "
            f"{fix}, or raise a voltage_limit_V or peak_current_A",
            keys=("controller", key),
        )
    return torques


def _lowest_points(
    model: Model, attached: tuple[int, Array], offsets: Array, q: Array, v: Array
) -> tuple[Array, Array]:
    """Return points of a body at given offsets from one of its points, in its frame [m], with their velocities [m/s].

    Parameters
    ----------
    model : Model
        Model of the robot.
    attached : (int, (3,) ndarray)
        Link, and the point in its frame [m].
    offsets : (T, 3) ndarray
        Offsets in the world frame [m].
    q, v : (T, nq), (T, n) ndarray
        Positions and rates of the motion.
    """
    link, point = attached
    planner = BracePlanner(model.robot, model.arrays, [link] * 4)
    positions, velocities = planner.motion(point + np.vstack([np.zeros(3), np.eye(3)]), q, v)
    axes = positions[:, 1:] - positions[:, :1]  # (T, 3, 3), one row for each body axis
    shifts = np.einsum("tij,tj->ti", axes, offsets)
    return point + shifts, velocities[:, 0] + np.einsum("ti,tij->tj", shifts, velocities[:, 1:] - velocities[:, :1])


def _check_gaps(name: str, contact: Contact, times: Array, gaps: Array) -> None:
    """Raise ModelError if the references pull a brace off its surface, where it cannot carry its planned force."""
    k = int(np.abs(gaps).argmax())
    if abs(gaps[k]) > GAP_MAX:
        raise ModelError(
            f"controller.brace: the references move {name} {gaps[k]:+.4g} m off surface {contact.surface_name!r} at "
            f"t = {times[k]:.3f} s (limit {GAP_MAX:g} m); list it in controller.hand.braces, use "
            "initial.on_surface, or limit its times with during_s",
            keys=("controller", "brace"),
        )

"""Joint references by inverse kinematics of a hand path, on the joints that the scenario names."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.contact_law import format_quantity
from dynsim.compile.hand_posture import hand_posture
from dynsim.compile.model import Model
from dynsim.compile.reaching import path_arrays
from dynsim.dynamics import inverse_kinematics as kik
from dynsim.dynamics.tables import workspace
from dynsim.errors import UnreachableReference
from dynsim.jit.kernel import reals
from dynsim.model.base_pose import base_row
from dynsim.model.description import Contact
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

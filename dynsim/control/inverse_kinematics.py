"""Joint references for a hand path, on the joints that the scenario names."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import UnreachableReference
from dynsim.model.description import Contact
from dynsim.model.mobile_base import base_row
from dynsim.model.model import Model
from dynsim.model.posture import gaps_and_rates

Array = NDArray[np.float64]

ITERATIONS = 200
STEP_MAX = 0.3  # [rad or m] per iteration, so that the branch of the start is kept
# Wall time before the first report of progress, and between two [s]: most paths are done before anyone asks.
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
) -> Array:
    """Positions of ``joints`` that put the hand on ``targets`` at ``times``; the others stay as in ``q``.

    The targets are in the world: what a mobile base moves by meanwhile, the joints make up for.

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

    Returns
    -------
    array, shape (T, len(joints)) [rad or m]

    Raises
    ------
    UnreachableReference
        With the first time at which the hand cannot reach its target, and the distance that is left.
    """
    columns = [model.joint_names.index(name) for name in joints]
    places = [model.robot.position_index[column] for column in columns]
    body, point = model.body_index(model.robot.hand[0]), model.robot.hand[1]
    q, rows = q.copy(), 3 + len(braces)
    identity = np.eye(rows)
    carried = 0 if base is None else base_row(model.robot)[0]
    result = np.zeros((len(times), len(columns)))
    due = clock.perf_counter() + QUIET_S
    for k, (t, target) in enumerate(zip(times, targets, strict=True)):
        if progress is not None and clock.perf_counter() >= due:
            progress(float(t))
            due = clock.perf_counter() + REPORT_S
        if base is not None:
            q[carried : carried + 4] = base[k]
        if k >= 3 and len(columns) <= rows:
            # The parabola through the last three solutions leaves one iteration to do. Not for redundant joints: what
            # the hand does not determine would run away along it.
            q[places] = 3.0 * result[k - 1] - 3.0 * result[k - 2] + result[k - 3]
        best = np.inf
        for _ in range(ITERATIONS):
            position, jacobian = model.point_position_and_jacobian(body, point, q)
            error = target - position
            if braces:
                gaps, rates = gaps_and_rates(model, braces, q)
                error, jacobian = np.concatenate([error, -gaps]), np.vstack([jacobian, rates])
            distance = math.sqrt(error @ error)
            best = min(best, distance)
            # Two orders below the tolerance: the references shall be smooth, not just close.
            if distance < 1e-4 * tolerance:
                break
            J = jacobian[:, columns]
            step = J.T @ np.linalg.solve(J @ J.T + (1e-12 + 0.1 * distance**2) * identity, error)
            q[places] += step * min(1.0, STEP_MAX / max(float(np.abs(step).max()), 1e-300))
        if best > tolerance:
            raise UnreachableReference(
                f"the hand cannot follow its path with {', '.join(joints)}: at t = {t:.3f} s it stays "
                f"{best:.4g} m from ({target[0]:.4g}, {target[1]:.4g}, {target[2]:.4g}) m; "
                "move the path, or let more joints follow it"
            )
        result[k] = q[places]
    return result

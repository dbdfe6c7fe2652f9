"""Requirements that a plan must meet in addition to its verification: sag of the hand, ratings of motors, limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from dynsim.config.problems import dotted
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.description import Array
from dynsim.model.drives import continuous_torque
from dynsim.planner import planned_scenario
from dynsim.planner.dense import Dense
from dynsim.planner.problem import FINAL_SLIP_SCALE, Candidate, Task
from dynsim.planner.verify import Corner, Requirement, Tolerances
from dynsim.scenario.schema import Requirements

# Relative rounding error below which a brace still counts as touching, and singular values of braces count as zero.
ROUNDING = 1e-9


def displaced(task: Task, braces: tuple[Candidate, ...], dense: Dense, joints: Array, force: Array) -> Array:
    """Compute the displacement of the hand by an additional force at the waypoints of a plan.

    The references and planned voltages remain. Joint displacements δ and changes Δf of the brace forces solve

        (K + ∂τ/∂q) δ = Jᵀ F − ∂τ/∂f Δf,    G δ ≥ 0,  f + Δf ≥ 0,  (G δ)·(f + Δf) = 0

    with the Jacobian J of the hand, the rates G of the gaps, and the statics τ(q, v, f) of :mod:`dynsim.planner`, whose
    derivative by q includes the stiffness of weights and brace forces. Braces slide in the direction of the motion, or
    lift off if the force unloads them. Without friction, and with K alone, the displacement of a plan whose braces stay
    is C F with C = J K⁻¹ Jᵀ − J K⁻¹ Gᵀ (G K⁻¹ Gᵀ)⁻¹ G K⁻¹ Jᵀ.

    Parameters
    ----------
    task : Task
        Planning problem.
    braces : tuple of Candidate
        Braces of the plan.
    dense : Dense
        References of the plan.
    joints : (n,) ndarray
        Stiffness K of the joints [N m/rad or N/m].
    force : (3,) ndarray
        Force F on the hand, in the world [N].

    Returns
    -------
    (T, 3) ndarray
        Displacement of the hand at the waypoints [m].
    """
    # The posture halfway between two knots has the velocity of their chord.
    problem, half = task.problem(braces, 2, FINAL_SLIP_SCALE), 0.5 * task.span
    rates = np.gradient(dense.q, dense.times, axis=0)
    result, work, c = np.zeros((len(dense.q), 3)), problem.work, len(braces)
    columns = [np.interp(dense.times, dense.fine, column) for column in dense.forces.T]
    forces = np.reshape(columns, (c, len(result))).T
    for t, (moved, q, v, f) in enumerate(zip(result, dense.q, rates, forces, strict=True)):
        problem.evaluate(reals([q - half * v, q + half * v]), reals(np.tile(f, (len(problem.course.knot), 1))))
        on = dense.acting(t)
        J, G, by_f = work.hand_rate[-1, :3], work.gap_rate[-1, on], work.by_f[0][:, on]
        solved = np.linalg.solve(np.diag(joints) + work.by_q[0], np.column_stack([J.T @ force, by_f]))
        changes = _changes(f[on], G @ solved[:, 1:], G @ solved[:, 0])
        bent = [solved[:, 0] - solved[:, 1:] @ change for change in changes]
        # Friction may allow several solutions.
        moved[:] = max((J @ each for each in bent), key=np.linalg.norm)
    return result


def _changes(f: Array, A: Array, rise: Array) -> Iterator[Array]:
    """Yield the changes Δf of forces f with gaps rise − A Δf ≥ 0, f + Δf ≥ 0, and one of both zero for each brace.

    If there is no solution, which only large friction causes, all braces stay.
    """
    c, known = len(f), False
    for on in (list(chosen) for size in range(c, -1, -1) for chosen in combinations(range(c), size)):
        off = [i for i in range(c) if i not in on]
        change = -f
        left = rise[on] - A[np.ix_(on, off)] @ change[off]
        change[on] = np.linalg.lstsq(A[np.ix_(on, on)], left, rcond=ROUNDING)[0]
        gaps = rise - A @ change
        if (f + change >= -ROUNDING * np.abs(f).max(initial=1.0)).all() and (gaps[off] >= 0.0).all():
            known = True
            yield change
    if not known:
        yield reals(np.linalg.lstsq(A, rise, rcond=ROUNDING)[0])


def rated_share(task: Task, dense: Dense) -> tuple[float, str]:
    """Return the largest rms torque as a fraction of the continuous rating, and its joint; 0 without ratings."""
    rms = np.sqrt(np.trapezoid(dense.torques**2, dense.fine, axis=0) / task.duration)
    shares = rms / np.array([continuous_torque(motor) for motor in task.arm.motors])
    return float(shares.max()), task.arm.joints[int(shares.argmax())]


def check_ratings(task: Task) -> None:
    """Raise ModelError if a rating is required, but no motor has one."""
    required, keys = task.scenario.config.requirements, ("requirements", "rating_share")
    rated = any(np.isfinite(continuous_torque(motor)) for motor in task.arm.motors)
    if required is not None and required.rating_share is not None and not rated:
        raise ModelError(
            f"{dotted(keys)}: no motor has a continuous rating; add nominal_torque_N_m or nominal_current_A to motors",
            keys=keys,
        )


def with_requirements(tolerances: Tolerances, required: Requirements | None) -> Tolerances:
    """Return the tolerances with the limits and errors that a scenario requires, in place of the default values."""
    if required is None:
        return tolerances
    changes = {
        "hand_m": required.hand_error_m, "heat": required.heat_ratio, "payload": required.payload_error,
        "mass": required.mass_error,
    }  # fmt: skip
    for key, value in changes.items():
        if value is not None and getattr(tolerances, key) == getattr(Tolerances, key):
            tolerances = replace(tolerances, **{key: value})  # type: ignore[arg-type]
    return tolerances


def check(
    task: Task, limits: Tolerances, braces: tuple[Candidate, ...], dense: Dense, k_p: float, corners: Sequence[Corner]
) -> tuple[Requirement, ...]:
    """Compare a plan with all requirements of its scenario; requirements on runs need its corner cases.

    The verification rejects runs with too much heat or error of the hand; here, these requirements have no reason.

    Parameters
    ----------
    task : Task
        Planning problem.
    limits : Tolerances
        Limits of heat and hand error in the runs.
    braces : tuple of Candidate
        Braces of the plan.
    dense : Dense
        References of the plan.
    k_p : float
        Gain k_p of the plan [V/rad].
    corners : sequence of Corner
        Simulated runs of the plan, first the nominal run; may be empty.

    Returns
    -------
    tuple of Requirement
        One entry for each requirement that the scenario sets and that could be evaluated. The value of an error of
        masses is the largest heat with this error, as a multiple of the heat of the nominal run.
    """
    required, results = task.scenario.config.requirements, []
    if required is None:
        return ()

    def add(key: str, value: float, limit: float, text: str = "") -> None:
        result = Requirement(key, float(value), limit)
        results.append(result if result.met else replace(result, reason=text))

    if required.hand_sag_m is not None:
        joints, force = planned_scenario.stiffness(task, braces, dense, k_p), np.array(required.hand_force_N)
        joints /= 1.0 + joints / (required.gear_stiffness_N_m_per_rad or np.inf)
        sags = np.linalg.norm(displaced(task, braces, dense, joints, force), axis=1)
        k = int(sags.argmax())
        text = f"the hand sags by {1e3 * sags[k]:.3g} mm (limit {1e3 * required.hand_sag_m:.3g} mm)"
        add("hand_sag_m", sags[k], required.hand_sag_m, f"{text} at t = {dense.times[k]:.3g} s")
    if required.rating_share is not None:
        share, joint = max(
            [rated_share(task, dense), *((corner.rating_share, corner.rated_joint) for corner in corners)]
        )
        text = f"{joint}: rms torque is {share:.3g} times the continuous rating (limit {required.rating_share:.3g})"
        add("rating_share", share, required.rating_share, text)
    if not corners:
        return tuple(results)
    if required.hand_error_m is not None:
        assert limits.hand_m is not None
        add("hand_error_m", np.max([corner.hand_error_m for corner in corners]), limits.hand_m)
    for key, factor in (("heat_ratio", ""), ("payload_error", "payload_factor"), ("mass_error", "robot_factor")):
        heats = [corner.heat_W for corner in corners if not factor or getattr(corner, factor) != 1.0]
        if getattr(required, key) is not None and heats:
            add(key, np.max(heats) / corners[0].heat_W, limits.heat)
    return tuple(results)

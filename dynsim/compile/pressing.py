"""Postures in which compliant contacts are pressed into their surfaces as deeply as an equilibrium requires.

At rest, the force of a compliant contact is its stiffness times its depth, f_n = −k g. A displacement d of the bodies
changes the gaps by J d. The generalised forces of an equilibrium with normal forces f equal those of the springs if

    Jᵀ K J d = Jᵀ (f + K g),    the least-squares solution of K^½ J d = −K^(−½) (f + K g)

so that statically indeterminate supports share the load as their springs do. Rigid contacts stay closed; a rigid
contact that need not carry load may open if compliant contacts cannot be pressed in otherwise.

The search starts with the forces that minimize the motor heat in the initial posture. If the motors can hold different
forces, the next forces are those nearest to the forces that the springs already carry. The heat criterion may determine
the forces to only a few digits or not at all, and it may require more depth than is possible, for example if an arm is
wedged between a rigid and a compliant brace.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.posture import BEYOND, KEYS, holding_torques, touching_contacts
from dynsim.compile.touching import TouchPoint, gap_at
from dynsim.dynamics.tree.joints import normalise, positions_along, rates_across
from dynsim.errors import ModelError, first_few
from dynsim.model.description import Array, Contact, Load

# Displacement that counts as zero [rad or m]; with a stiffness of 1e5 N/m it changes a force by 1e-8 N.
DONE = 1e-13
# Displacement that may remain if the equilibrium forces are not known more accurately [rad or m]; it corresponds to
# 1e-4 N at 1e5 N/m.
NEARLY = 1e-9
ITERATIONS = 50
# A step is damped more if a gap differs from its linear prediction by more than this fraction of the largest change.
AGREES = 0.5
# Maximum number of repeated searches; a search is repeated only if it reduces the distance to the initial posture by
# this factor.
REPEATS, NEARER = 4, 0.9
# Damping of the least-squares problem of the springs, relative to its largest singular value; values are tried in this
# order, and a step with the last value is always accepted.
DAMPINGS = (0.0, *4.0 ** np.arange(-5, 7))
# Singular values of the rows below this fraction of the largest one count as zero.
RANK = 1e-10


def pressed_in(
    model: Model, contacts: Sequence[Contact], loads: Sequence[Load], able: Sequence[str], real: bool
) -> Model:
    """Return the model in the nearest posture in which compliant contacts carry their equilibrium forces.

    The nearest posture is the one closest to the initial posture. If no compliant contact touches, the model itself is
    returned. For the parameters, see :func:`dynsim.compile.posture.holding_torques`.

    Raises
    ------
    ModelError
        If no torques hold the posture, or if no nearby posture is found in which the contacts carry their forces.
    """
    touching = touching_contacts(model, contacts, model.robot.initial, real)
    names = [at.contact.name for at in touching]
    compliant = [at.contact.name for at in touching if at.contact.stiffness > 0.0]
    if not compliant:
        return model

    def holding(q: Array, springs: Mapping[str, float]) -> dict[str, float] | None:
        try:
            return holding_torques(model, q, contacts, loads, able, real, springs).normal_forces
        except ModelError:
            return None

    forces = holding_torques(model, model.robot.initial, contacts, loads, able, real).normal_forces
    if (balance := _search(model, contacts, real, names, forces, holding)) is None:
        # A rigid contact that need not carry load may prevent a compliant contact from being pressed in. Let it open.
        for name in [name for name in names if name not in compliant]:
            others = [other for other in names if other != name]
            if (without := holding(model.robot.initial, dict.fromkeys(others, np.nan))) is not None:
                names, forces = others, without
        balance = _search(model, contacts, real, names, forces, holding)
    if balance is None:
        raise ModelError(
            f"initial.equilibrium: no posture near this one presses {first_few(compliant)} in as deep as their forces "
            "require; raise contacts.stiffness_N_per_m, or remove initial.equilibrium",
            keys=KEYS,
        )
    # Steps towards forces that were later abandoned, or for contacts that have opened, leave displacements that the
    # equilibrium does not need. A search from the initial posture that starts with the final forces avoids them.
    q, forces = balance
    for _ in range(REPEATS):
        again = _search(model, contacts, real, list(forces), forces, holding)
        if again is None or _distance(model, again[0]) >= NEARER * _distance(model, q):
            break
        q, forces = again
    return Model(replace(model.robot, q0=q))


def _distance(model: Model, q: Array) -> float:
    """Return the norm of the displacement from the initial posture."""
    moved = np.zeros(model.n)
    rates_across(model.arrays, q, 0, q - model.robot.initial, moved)
    return float(np.linalg.norm(moved))


def _search(
    model: Model,
    contacts: Sequence[Contact],
    real: bool,
    names: Sequence[str],
    forces: Mapping[str, float],
    holding: Callable[[Array, Mapping[str, float]], dict[str, float] | None],
) -> tuple[Array, dict[str, float]] | None:
    """Return the posture (nq,) and the normal forces of contacts that carry load [N], or None.

    Parameters
    ----------
    model : Model
        Model of the robot.
    contacts : sequence of Contact
        All contacts.
    real : bool
        True for the unilateral law.
    names : sequence of str
        Contacts that carry load at first.
    forces : mapping of str to float
        Their normal forces [N].
    holding : callable
        Function that returns the forces of an equilibrium near given spring forces, or None; see
        :func:`dynsim.compile.posture.holding_torques`.
    """
    q, before = model.robot.initial, np.inf
    touching = touching_contacts(model, contacts, q, real, names)
    for _ in range(ITERATIONS):
        q, size = _step(model, q, touching, forces) if touching else (q, 0.0)
        # A contact that carries load may open within a step. An unloaded contact carries load only if the posture
        # cannot be held otherwise.
        near = touching_contacts(model, contacts, q, real)
        meeting = [at.contact.name for at in near if not at.contact.stiffness or at.gap < 0.0]
        closed = [at.contact for at in touching]
        carrying = [c.name for c in closed if not c.stiffness or forces[c.name] > NEARLY * c.stiffness]
        for named in ([*carrying, *meeting], [*names, *meeting]):
            touching = touching_contacts(model, contacts, q, real, named)
            if (next_forces := holding(q, spring_forces(touching))) is not None:
                break
        else:
            return None
        forces = next_forces
        # If friction shares the load with normal forces, the split between them is only as accurate as the search.
        if size <= DONE or before <= size <= NEARLY:
            soft = [at for at in touching if at.contact.stiffness > 0.0]
            lacking = [abs(forces[at.contact.name] / at.contact.stiffness + at.gap) for at in soft]
            # Rigid contacts or limits may prevent joints from pressing springs in further.
            if max(lacking, default=0.0) <= NEARLY:
                return q, forces
            if size <= DONE:
                return None
        before = size
    return None


def spring_forces(touching: Sequence[TouchPoint]) -> dict[str, float]:
    """Return the normal force of each contact [N]: computed from the depth if it is compliant, NaN if it is rigid."""
    return {
        at.contact.name: max(-at.contact.stiffness * at.gap, 0.0) if at.contact.stiffness > 0.0 else np.nan
        for at in touching
    }


def _step(model: Model, q: Array, touching: Sequence[TouchPoint], forces: Mapping[str, float]) -> tuple[Array, float]:
    """Return the posture to which these forces press the contacts in, to first order, and the largest displacement.

    The step is damped until the gaps change approximately as the Jacobian predicts. A spring that can only be pressed
    in by a large rotation, for example at a wedged arm, is then pressed in less.
    """
    closed = [at.contact for at in touching]
    rigid = np.array([contact.stiffness == 0.0 for contact in closed])
    roots = np.sqrt([contact.stiffness for contact in closed])
    rows = np.array([at.normal @ at.jacobian(model, q) for at in touching])
    gaps = np.array([at.gap for at in touching])
    wanted = -gaps - [
        forces[contact.name] / contact.stiffness if contact.stiffness > 0.0 else 0.0 for contact in closed
    ]
    for damping in DAMPINGS:
        step = _within_limits(model, q, rows, wanted, rigid, roots, damping)
        after, change = q.copy(), np.zeros(model.nq)
        positions_along(model.arrays, q, 0, step, change)
        after += change
        normalise(model.arrays, after, 0)
        expected, changed = rows @ step, [gap_at(model, contact, after) for contact in closed] - gaps
        if np.abs(changed - expected).max() <= AGREES * np.abs(expected).max() + NEARLY:
            break
    return after, float(np.abs(step).max())


def _within_limits(
    model: Model, q: Array, rows: Array, wanted: Array, rigid: NDArray[np.bool_], roots: Array, damping: float
) -> Array:
    """Return the displacement of minimum norm (n,) that changes gaps as wanted, (c,) [m], within the joint limits."""
    robot, wheels = model.robot, () if model.robot.base is None else model.robot.base.wheels
    free = np.array([link.joint not in wheels for link in robot.links])
    while True:
        step = np.zeros(model.n)
        step[free] = _displacement(rows[:, free], wanted, rigid, roots, damping)
        beyond = np.zeros(model.n, dtype=bool)
        for k, (link, index) in enumerate(zip(robot.links, robot.position_index, strict=True)):
            if len(link.row.neutral) == 1:
                end = q[index] + step[k]
                beyond[k] = (step[k] > 0.0 and end > link.upper + BEYOND) or (
                    step[k] < 0.0 and end < link.lower - BEYOND
                )
        if not (beyond & free).any():
            return step
        free &= ~beyond


def _displacement(rows: Array, wanted: Array, rigid: NDArray[np.bool_], roots: Array, damping: float) -> Array:
    """Return the smallest displacement of the free joints that solves the contacts.

    Rigid contacts are satisfied exactly, springs by damped least squares.
    """
    particular, null = np.zeros(rows.shape[1]), np.eye(rows.shape[1])
    if rigid.any():
        particular[:] = np.linalg.lstsq(rows[rigid], wanted[rigid], rcond=RANK)[0]
        _, sizes, basis = np.linalg.svd(rows[rigid])
        null = basis[int(np.count_nonzero(sizes > RANK * sizes.max(initial=0.0))) :].T
    springs = roots[~rigid, None] * rows[~rigid]
    left = roots[~rigid] * wanted[~rigid] - springs @ particular
    from_left, sizes, to_right = np.linalg.svd(springs @ null, full_matrices=False)
    # Rows of springs that closed rigid contacts keep fixed consist of rounding errors.
    least, largest = RANK * float(np.linalg.norm(springs)), sizes.max(initial=0.0)
    inverse = np.divide(sizes, sizes**2 + (damping * largest) ** 2, out=np.zeros_like(sizes), where=sizes > least)
    return np.asarray(particular + null @ (to_right.T @ (inverse * (from_left.T @ left))))

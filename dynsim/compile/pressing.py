"""Postures in which compliant contacts are as deep in their surfaces as the forces of an equilibrium need.

At rest a compliant contact carries its stiffness times its depth, f_n = −k g. Bodies displaced by d change the gaps by
J d; the generalised forces of an equilibrium with normal forces f are those of the springs where

    Jᵀ K J d = Jᵀ (f + K g),    the least squares of K^½ J d = −K^(−½) (f + K g)

so that supports which rigid bodies do not determine share their load as the springs do. Rigid contacts stay
closed; one that need not carry may open where compliant ones cannot be pressed in otherwise.

The first forces are those of least heat in the initial posture. Where motors can hold different forces, the next ones
are those nearest to what the springs already carry: least heat may determine forces to few digits, or not at all, and
may ask for more than can be pressed in: an arm wedged between a rigid and a compliant brace.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.equilibrium import KEYS, Touching, holding_torques, touching_contacts
from dynsim.compile.model import Model
from dynsim.compile.posture import BEYOND
from dynsim.compile.shapes import gap_at
from dynsim.dynamics.tree.joints import normalise, positions_along
from dynsim.errors import ModelError, first_few
from dynsim.model.description import Array, Contact, Load

# Displacement that counts as none [rad or m]: of a stiffness of 1e5 N/m it is a force of 1e-8 N.
DONE = 1e-13
# Displacement that may be left where the forces of the equilibrium are known no better: 1e-4 N of 1e5 N/m [rad or m].
NEARLY = 1e-9
ITERATIONS = 50
# A step is damped more where a gap differs by more than this part of the largest change from what the Jacobian says.
AGREES = 0.5
# Damping of the springs' least squares, in parts of its largest singular value. The last step is taken as it is.
DAMPINGS = (0.0, *4.0 ** np.arange(-5, 7))
# Singular values of rows below this part of the largest are zero.
RANK = 1e-10


def pressed_in(
    model: Model, contacts: Sequence[Contact], loads: Sequence[Load], able: Sequence[str], real: bool
) -> Model:
    """The model in the posture nearest to its initial one whose compliant contacts carry what an equilibrium needs.

    The model itself if no compliant contact touches. Parameters are those of
    :func:`dynsim.compile.equilibrium.holding_torques`.

    Raises
    ------
    ModelError
        Nothing holds the posture, or none is near in which the contacts carry their forces.
    """
    touching = touching_contacts(model, contacts, model.robot.initial, real)
    names = [contact.name for contact, *_ in touching]
    compliant = [contact.name for contact, *_ in touching if contact.stiffness > 0.0]
    if not compliant:
        return model

    def holding(q: Array, springs: Mapping[str, float]) -> dict[str, float] | None:
        try:
            return holding_torques(model, q, contacts, loads, able, real, springs).normal_forces
        except ModelError:
            return None

    forces = holding_torques(model, model.robot.initial, contacts, loads, able, real).normal_forces
    if (q := _search(model, contacts, real, names, forces, holding)) is None:
        # A rigid contact that need not carry may keep a compliant one from being pressed in: it may open.
        for name in [name for name in names if name not in compliant]:
            others = [other for other in names if other != name]
            if (without := holding(model.robot.initial, dict.fromkeys(others, np.nan))) is not None:
                names, forces = others, without
        q = _search(model, contacts, real, names, forces, holding)
    if q is None:
        raise ModelError(
            f"initial.equilibrium: no posture near this one presses {first_few(compliant)} in as deep as their forces "
            "need; raise contacts.stiffness_N_per_m, or remove initial.equilibrium",
            keys=KEYS,
        )
    return Model(replace(model.robot, q0=q))


def _search(
    model: Model,
    contacts: Sequence[Contact],
    real: bool,
    names: Sequence[str],
    forces: Mapping[str, float],
    holding: Callable[[Array, Mapping[str, float]], dict[str, float] | None],
) -> Array | None:
    """The posture (nq,), or None.

    Parameters
    ----------
    names : contacts that carry at first, with these forces [N]
    holding : forces of an equilibrium near those of springs, or None, see
        :func:`dynsim.compile.equilibrium.holding_torques`
    """
    q, before = model.robot.initial, np.inf
    touching = touching_contacts(model, contacts, q, real, names)
    for _ in range(ITERATIONS):
        q, size = _step(model, q, touching, forces)
        # What carries may open within a step. What carried nothing carries only if nothing else holds the posture.
        meeting = [c.name for c, *_, gap in touching_contacts(model, contacts, q, real) if not c.stiffness or gap < 0.0]
        carrying = [c.name for c, *_ in touching if not c.stiffness or forces[c.name] > NEARLY * c.stiffness]
        for named in ([*carrying, *meeting], [*names, *meeting]):
            touching = touching_contacts(model, contacts, q, real, named)
            if (next_forces := holding(q, spring_forces(touching))) is not None:
                break
        else:
            return None
        forces = next_forces
        # Where friction shares the load with normal forces, their split is as accurate as its search.
        if size <= DONE or before <= size <= NEARLY:
            lacking = [abs(forces[c.name] / c.stiffness + gap) for c, *_, gap in touching if c.stiffness > 0.0]
            # Rigid contacts or limits may keep joints from pressing springs in further.
            if max(lacking, default=0.0) <= NEARLY:
                return q
            if size <= DONE:
                return None
        before = size
    return None


def spring_forces(touching: Sequence[Touching]) -> dict[str, float]:
    """Normal forces of compliant contacts by their depths [N], and NaN for rigid ones, by name."""
    return {
        contact.name: max(-contact.stiffness * gap, 0.0) if contact.stiffness > 0.0 else np.nan
        for contact, *_, gap in touching
    }


def _step(model: Model, q: Array, touching: Sequence[Touching], forces: Mapping[str, float]) -> tuple[Array, float]:
    """The posture in which these forces press contacts in, by the Jacobian, and the largest displacement to it.

    It is damped until the gaps change about as the Jacobian says: a spring that only a large turn would press in, as
    that of a wedged arm, is not pressed in as deep.
    """
    rigid = np.array([contact.stiffness == 0.0 for contact, *_ in touching])
    roots = np.sqrt([contact.stiffness for contact, *_ in touching])
    rows = np.array([normal @ model.point_jacobian(link, point, q) for _, link, point, normal, _ in touching])
    gaps = np.array([gap for *_, gap in touching])
    wanted = -gaps - [
        forces[contact.name] / contact.stiffness if contact.stiffness > 0.0 else 0.0 for contact, *_ in touching
    ]
    for damping in DAMPINGS:
        step = _within_limits(model, q, rows, wanted, rigid, roots, damping)
        after, change = q.copy(), np.zeros(model.nq)
        positions_along(model.arrays, q, 0, step, change)
        after += change
        normalise(model.arrays, after, 0)
        expected, changed = rows @ step, [gap_at(model, contact, after) for contact, *_ in touching] - gaps
        if np.abs(changed - expected).max() <= AGREES * np.abs(expected).max() + NEARLY:
            break
    return after, float(np.abs(step).max())


def _within_limits(
    model: Model, q: Array, rows: Array, wanted: Array, rigid: NDArray[np.bool_], roots: Array, damping: float
) -> Array:
    """Displacement of least norm (n,) that changes gaps as wanted, (c,) [m]; joints do not pass their limits."""
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
    """Least displacement of the free joints: rigid contacts exactly, springs by damped least squares."""
    particular, null = np.zeros(rows.shape[1]), np.eye(rows.shape[1])
    if rigid.any():
        particular[:] = np.linalg.lstsq(rows[rigid], wanted[rigid], rcond=RANK)[0]
        _, sizes, basis = np.linalg.svd(rows[rigid])
        null = basis[int(np.count_nonzero(sizes > RANK * sizes.max(initial=0.0))) :].T
    springs = roots[~rigid, None] * rows[~rigid]
    left = roots[~rigid] * wanted[~rigid] - springs @ particular
    from_left, sizes, to_right = np.linalg.svd(springs @ null, full_matrices=False)
    largest = sizes.max(initial=0.0)
    inverse = np.divide(
        sizes, sizes**2 + (damping * largest) ** 2, out=np.zeros_like(sizes), where=sizes > RANK * largest
    )
    return np.asarray(particular + null @ (to_right.T @ (inverse * (from_left.T @ left))))

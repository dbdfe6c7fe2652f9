"""Postures in which compliant contacts are as deep in their surfaces as the forces of an equilibrium need.

At rest a compliant contact carries its stiffness times its depth, f_n = −k g. Bodies displaced by d change the gaps by
J d; the generalised forces of an equilibrium with normal forces f are those of the springs where

    Jᵀ K J d = Jᵀ (f + K g),    the least squares of K^½ J d = −K^(−½) (f + K g)

so that supports which rigid bodies do not determine share their load as the springs do. Rigid contacts stay closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.equilibrium import KEYS, holding_torques, touching_contacts
from dynsim.compile.model import Model
from dynsim.compile.posture import BEYOND
from dynsim.dynamics.tree.joints import normalise, positions_along
from dynsim.errors import ModelError, first_few
from dynsim.model.description import Array, Contact, Load

# Displacement that counts as none [rad or m]: of a stiffness of 1e5 N/m it is a force of 1e-8 N.
DONE = 1e-13
# Displacement that may be left where the forces of the equilibrium are known no better: 1e-4 N of 1e5 N/m [rad or m].
NEARLY = 1e-9
ITERATIONS = 50
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
    robot, q = model.robot, model.robot.initial.copy()
    names = [contact.name for contact, *_ in touching_contacts(model, contacts, q, real) if contact.stiffness > 0.0]
    if not names:
        return model
    before = np.inf
    for _ in range(ITERATIONS):
        forces = holding_torques(model, q, contacts, loads, able, real).normal_forces
        rows, depths, rigid, roots = [], [], [], []
        for contact, link, point, normal, gap in touching_contacts(model, contacts, q, real):
            compliant = contact.stiffness > 0.0
            rows.append(normal @ model.point_jacobian(link, point, q))
            depths.append(gap + (forces[contact.name] / contact.stiffness if compliant else 0.0))
            rigid.append(not compliant)
            roots.append(np.sqrt(contact.stiffness))
        step = _within_limits(model, q, np.array(rows), -np.array(depths), np.array(rigid, dtype=bool), np.array(roots))
        change = np.zeros(model.nq)
        positions_along(model.arrays, q, 0, step, change)
        q += change
        normalise(model.arrays, q, 0)
        size = float(np.abs(step).max(initial=0.0))
        # Where friction shares the load with normal forces, their split is as accurate as its search.
        if size <= DONE or before <= size <= NEARLY:
            return Model(replace(robot, q0=q))
        before = size
    raise ModelError(
        f"initial.equilibrium: no posture near this one presses {first_few(names)} in as deep as their forces need; "
        "raise contacts.stiffness_N_per_m, or remove initial.equilibrium",
        keys=KEYS,
    )


def _within_limits(model: Model, q: Array, rows: Array, wanted: Array, rigid: NDArray[np.bool_], roots: Array) -> Array:
    """Displacement of least norm (n,) that changes gaps as wanted, (c,) [m]; joints do not pass their limits."""
    robot, wheels = model.robot, () if model.robot.base is None else model.robot.base.wheels
    free = np.array([link.joint not in wheels for link in robot.links])
    while True:
        step = np.zeros(model.n)
        step[free] = _displacement(rows[:, free], wanted, rigid, roots)
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


def _displacement(rows: Array, wanted: Array, rigid: NDArray[np.bool_], roots: Array) -> Array:
    """Least displacement of the free joints: rigid contacts exactly, the others by the springs' least squares."""
    particular, null = np.zeros(rows.shape[1]), np.eye(rows.shape[1])
    if rigid.any():
        particular[:] = np.linalg.lstsq(rows[rigid], wanted[rigid], rcond=RANK)[0]
        _, sizes, basis = np.linalg.svd(rows[rigid])
        null = basis[int(np.count_nonzero(sizes > RANK * sizes.max(initial=0.0))) :].T
    springs = roots[~rigid, None] * rows[~rigid]
    left = roots[~rigid] * wanted[~rigid] - springs @ particular
    return np.asarray(particular + null @ np.linalg.lstsq(springs @ null, left, rcond=RANK)[0])

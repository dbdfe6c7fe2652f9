"""Which contacts of the unilateral law share forces that the motion does not determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.shapes import share_of_axis
from dynsim.dynamics import tables as ka
from dynsim.model.description import Contact

Array = NDArray[np.float64]

# Sets of modes that are looked at: each is a singular value decomposition of the rows of all that is closed.
MOST_SETS = 50
# Singular values of unit rows below this are none: their square is what the elimination of A takes for dependent.
DEPENDENT = 1e-6


def sharing(model: Model, contacts: Sequence[Contact], q: Array, modes: Array) -> list[str]:
    """Names of the contacts whose rows depend on those of other contacts, in the first sample of each set of modes.

    Rows that are zero, such as that across a planar arm, and those that depend on each other within one contact, as
    where an arm has two joints before it, leave no choice between contacts: each contact counts with an orthonormal
    basis of its own rows. Those that share are in the left null space of all bases together.

    Parameters
    ----------
    q : samples, (T, nq) [rad or m]
    modes : of the contacts in them, (T, c), dynsim.dynamics.tables: OPEN, SLIDING, STICKING
    """
    free = _free(model)
    found: set[int] = set()
    _, first = np.unique(modes, axis=0, return_index=True)
    several = [
        t for t in sorted(first) if np.count_nonzero(modes[t] != ka.OPEN) > 1 and (modes[t] == ka.STICKING).any()
    ]
    for t in several[:MOST_SETS]:
        bases, owner = [], []
        for k in np.flatnonzero(modes[t] != ka.OPEN).tolist():
            basis = _basis(_rows(model, contacts[k], q[t], bool(modes[t, k] == ka.STICKING)) @ free)
            bases.append(basis)
            owner += [k] * len(basis)
        left, sizes, _ = np.linalg.svd(np.vstack(bases))
        rank = int(np.count_nonzero(sizes > DEPENDENT))
        found.update(np.array(owner, dtype=int)[np.abs(left[:, rank:]).max(axis=1, initial=0.0) > DEPENDENT].tolist())
    return [contacts[k].name for k in sorted(found)]


def _free(model: Model) -> Array:
    """Rates that couplings of joints allow, (n, n − k)."""
    robot = model.robot
    rows = np.zeros((len(robot.couplings), model.n))
    for row, coupling in zip(rows, robot.couplings, strict=True):
        row[robot.joint_names.index(coupling.joint)] = 1.0
        row[robot.joint_names.index(coupling.leader)] -= coupling.ratio
    return np.linalg.svd(rows)[2][len(rows) :].T


def _rows(model: Model, contact: Contact, q: Array, sticks: bool) -> Array:
    """Jacobian of the place that touches, (3, n), or of its distance, (1, n), where it slides."""
    body, point = model.robot.attach(contact.body, contact.point)
    if contact.tip is not None:
        end = model.robot.attach(contact.body, contact.tip)[1]
        start, other = (model.point_position(body, at, q) for at in (point, end))
        point = point + share_of_axis(contact, start, other) * (end - point)
    normal = contact.surface.normal(model.point_position(body, point, q))
    rotation, _ = model.body_pose(body, q)
    jacobian = model.point_jacobian(body, point - contact.radius * (rotation.T @ normal), q)
    return jacobian if sticks else (normal @ jacobian)[None]


def _basis(rows: Array) -> Array:
    """Orthonormal basis of the space of some rows, (r, n)."""
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    # A row of zeros has rounding of its size.
    return basis[sizes > max(DEPENDENT * sizes.max(initial=0.0), 1e-9)]

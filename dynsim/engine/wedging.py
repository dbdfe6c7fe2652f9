"""Contacts that friction can wedge by itself: forces of one contact that push against no joint, inside its cone.

J (3, n) is the velocity of a contact's point per unit rate of the joints. A force d with Jᵀ d = 0 moves nothing: bodies
pass it to the ground. If d lies in the friction cone, d_n > 0 and |d_t| ≤ μ d_n, the contact can carry it at any size.
With enough of it, friction holds the point against every load, and stops it from every speed.

With Q, N orthonormal bases of the range of J and of the null space of Jᵀ, the d nearest to the normal n is N Nᵀ n, so
that the least coefficient is μ* = |Qᵀ n| / |Nᵀ n|, the tangent of its angle to n.

The motion is not unique where such a contact slides, since an impulse along d can stop it. Where it sticks it may have
to: then the force f without the part that blocks it, f_n n + s along the directions in which the point can slip, with
Qᵀ (f_n n + s) = Qᵀ f, lies in the cone as well. Otherwise it could slip or leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.engine.force_indeterminacy import DEPENDENT, contact_point, free_rates, row_basis
from dynsim.model.description import Contact
from dynsim.record import Record

Array = NDArray[np.float64]

# Samples in which a contact is examined, at equal distances among those in which it is closed.
POSTURES = 20
# A force that leaves its cone by less, relative or in N, lies on it except for rounding.
ON_CONE = 1e-6


@dataclass(frozen=True)
class Wedge:
    """A contact that can wedge itself, the least coefficient that does it, its own at rest, and the time [s]."""

    contact: Contact
    least: float
    friction: float
    time: float


def wedges(model: Model, contacts: Sequence[Contact], record: Record) -> list[Wedge]:
    """Contacts whose motion is not unique because they can wedge themselves, each where the least friction does it.

    Springs decide the normal forces of compliant contacts. Friction that depends on direction (``grip``) is left out:
    it has another cone, and does not oppose slip.
    """
    result, free, q = list[Wedge](), free_rates(model), record["q"]
    for k, contact in enumerate(contacts):
        friction = contact.friction_at_rest
        if contact.stiffness > 0.0 or contact.grip_axis is not None or friction == 0.0:
            continue
        mode, own = record["contact_mode"][:, k], list[Wedge]()
        closed = np.flatnonzero(mode != ka.OPEN)
        for t in closed[np.unique(np.linspace(0, len(closed) - 1, min(POSTURES, len(closed))).astype(int))].tolist():
            if not np.isfinite(q[t]).all():
                continue
            normal, jacobian = contact_point(model, contact, q[t])
            least, moving = least_coefficient(jacobian @ free, normal)
            if least > friction:
                continue
            if mode[t] == ka.SLIDING or not _holds(moving, normal, friction, record["contact_force"][t, k]):
                own.append(Wedge(contact, least, friction, float(record.time[t])))
        if own:
            # The first of those that are equal except for rounding.
            result.append(min(own, key=lambda wedge: float(f"{wedge.least:.4g}")))
    return result


def least_coefficient(jacobian: Array, normal: Array) -> tuple[float, Array]:
    """μ* of a contact with ``jacobian`` (3, f), infinite for none, and the directions Q of its motion, (3, r).

    A point that joints do not move along the normal carries nothing, and has none either.
    """
    moving = row_basis(jacobian.T).T
    along = normal @ moving
    own, other = float(np.linalg.norm(along)), float(np.linalg.norm(normal - moving @ along))
    # Blocked directions are known up to DEPENDENT: what is less is a direction across the normal.
    if own <= DEPENDENT or other <= DEPENDENT:
        return np.inf, moving
    return own / other, moving


def _holds(moving: Array, normal: Array, friction: float, force: Array) -> bool:
    """Whether the contact would stick without the force that blocks it too, ``force`` (3,) being all that it has."""
    along = normal @ moving
    # Of two directions one is along the surface; of one, which is not across the normal, none is.
    slips = np.array([[-along[1]], [along[0]]]) / np.linalg.norm(along) if len(along) == 2 else np.zeros((1, 0))
    needed = np.linalg.solve(np.column_stack([along, slips]), moving.T @ force)
    slack = ON_CONE * (1.0 + float(np.linalg.norm(force)))
    return bool(np.abs(needed[1:]).max(initial=0.0) <= friction * needed[0] + slack and needed[0] >= -slack)

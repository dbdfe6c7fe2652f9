"""The benchmark robot in Pinocchio, built from the compiled tables, and its forward dynamics; also used by tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka

Array = NDArray[np.float64]


def build_pinocchio(arrays: ka.ModelArrays) -> Any:
    """Return the tree of bodies as a ``pinocchio.Model``; joint i + 1 is link i, rotor inertias are its armature."""
    import pinocchio

    tree, body = arrays.tree, arrays.body
    model = pinocchio.Model()
    aligned = {
        ka.REVOLUTE_X: pinocchio.JointModelRX,
        ka.REVOLUTE_Y: pinocchio.JointModelRY,
        ka.REVOLUTE_Z: pinocchio.JointModelRZ,
    }
    for i in range(len(tree)):
        row, kind = body[i], tree[i, ka.KIND]
        axis = row[ka.AXIS : ka.AXIS + 3].copy()
        if kind in aligned:
            joint = aligned[kind]()
        elif kind == ka.REVOLUTE:
            joint = pinocchio.JointModelRevoluteUnaligned(axis)
        else:
            joint = pinocchio.JointModelPrismaticUnaligned(axis)
        placement = pinocchio.SE3(row[ka.R_PJ : ka.R_PJ + 9].reshape(3, 3), row[ka.P_PJ : ka.P_PJ + 3].copy())
        number = model.addJoint(int(tree[i, ka.PARENT]) + 1, joint, placement, f"joint_{i}")
        xx, xy, xz, yy, yz, zz = row[ka.INERTIA : ka.INERTIA + 6]
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia = pinocchio.Inertia(float(row[ka.MASS]), row[ka.COM : ka.COM + 3].copy(), tensor)
        model.appendBodyToJoint(number, inertia, pinocchio.SE3.Identity())
    model.armature = body[:, ka.ARMATURE].copy()
    model.gravity = pinocchio.Motion(arrays.gravity.copy(), np.zeros(3))
    return model


def native_aba(model: Any, q: Array, v: Array, batch: int) -> Callable[[], Any]:
    """Return a call that runs ``batch`` articulated-body solves one after the other inside Pinocchio (one thread)."""
    import pinocchio

    # With one column (or one row) the binding cannot tell the order of the matrix and reads out of bounds.
    if batch < 2 or model.nv < 2:
        raise ValueError("a batch needs two states and two joints")
    pool = pinocchio.ModelPool(model, 1)
    states, rates = (np.asfortranarray(np.tile(x[:, None], (1, batch))) for x in (q, v))
    torques, out = np.asfortranarray(np.zeros_like(states)), np.asfortranarray(np.zeros_like(states))
    return lambda: pinocchio.abaInParallel(1, pool, states, rates, torques, out)


def python_aba(model: Any, data: Any, q: Array, v: Array) -> Callable[[], Any]:
    """Return a call of one articulated-body solve, from Python."""
    import pinocchio

    tau = np.zeros(model.nv)
    return lambda: pinocchio.aba(model, data, q, v, tau)


def constrained(model: Any, data: Any, algorithm: str, links: list[int], q: Array, v: Array) -> Callable[[], Any]:
    """Return a call of one constrained solve, from Python, with the origins of ``links`` pinned by three rows each.

    ``algorithm`` is "constraintDynamics" (sparse Cholesky) or "lcaba" (O(n)). Pinocchio has neither one-row contacts
    nor friction in these. One proximal iteration: the fastest setting, which still meets the rows to 1e-8 m/s².
    """
    import pinocchio

    constraints, datas = pinocchio.StdVec_RigidConstraintModel(), pinocchio.StdVec_RigidConstraintData()
    for link in links:
        constraints.append(
            pinocchio.RigidConstraintModel(
                pinocchio.ContactType.CONTACT_3D, model, link + 1, pinocchio.SE3.Identity(), pinocchio.LOCAL
            )
        )
    for constraint in constraints:
        datas.append(constraint.createData())
    tau = np.zeros(model.nv)
    if algorithm == "lcaba":
        pinocchio.computeJointMinimalOrdering(model, data, constraints)
    else:
        pinocchio.initConstraintDynamics(model, data, constraints, datas)
    settings = pinocchio.ProximalSettings(1e-9, 1e-8, 1)
    solve = getattr(pinocchio, algorithm)
    return lambda: solve(model, data, q, v, tau, constraints, datas, settings)

"""Derivatives of inverse dynamics in closed form, after Singh, Russo and Wensing (2022).

All six-vectors refer to the world origin: motions (ω, v) and forces (n, f). × is the cross product of two motions, ×*
the cross product of a motion and a force, and (F ×̄*) V = V ×* F. S is the axis of a joint, V and A (minus gravity) are
the velocity and acceleration of its body, and V_p and A_p those of the body on which the joint is mounted. I and f are
the spatial inertia and wrench of a body; I_c, f_c and B_c are the sums of I, f and B over a subtree:

    S' = V_p × S,   S'' = A_p × S + V_p × S',   Ṡ = V × S
    2 B = (V ×*) I − I (V ×) + (I V) ×̄*

    ∂τ_i/∂q_j = S_i · (2 B_c S'_j + I_c S''_j)                    j an ancestor of i, or i
    ∂τ_j/∂q_i = S_j · (2 B_c S'_i + I_c S''_i + S_i ×* f_c)       j an ancestor of i
    ∂τ_i/∂v_j, ∂τ_j/∂v_i = S · (2 B_c S + I_c (S' + Ṡ))           likewise, with B_c, I_c and f_c of link i
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays
from dynsim.model.description import Array


@dataclass(frozen=True)
class InverseDynamicsDerivatives:
    """Derivatives of tau = M(q) v̇ + h(q, v) + g(q).

    Attributes
    ----------
    q : (n, n) ndarray
        ∂tau/∂q [N m/rad]. Column j is for a motion along rate j; for ball joints, a rotation about the body's axes.
    v : (n, n) ndarray
        ∂tau/∂v [N m s/rad].
    vdot : (n, n) ndarray
        ∂tau/∂v̇ = M [kg m²].
    """

    q: Array
    v: Array
    vdot: Array


def inverse_dynamics_derivatives(arrays: ModelArrays, links: Array) -> InverseDynamicsDerivatives:
    """Return the derivatives at the state in ``links`` after a sweep with rates, accelerations and gravity."""
    n = len(arrays.tree)
    parent = arrays.tree[:, ka.PARENT]
    base = arrays.tree[:, ka.BASE]
    S, V, A = (links[:, first : first + 6] for first in (ka.S, ka.V, ka.A))
    body = _joint_bodies(parent, base)
    root = np.concatenate([np.zeros(3), -arrays.gravity])
    V_p = np.where(base[:, None] >= 0, V[base], 0.0)
    A_p = np.where(base[:, None] >= 0, A[base], root)
    S1 = _cross_motion(V_p, S)
    S2 = _cross_motion(A_p, S) + _cross_motion(V_p, S1)
    rate = S1 + _cross_motion(V[body], S)
    inertia, twice_b, wrench = _composites(arrays, links, V, A)
    for i in range(n - 1, -1, -1):
        if parent[i] >= 0:
            inertia[parent[i]] += inertia[i]
            twice_b[parent[i]] += twice_b[i]
            wrench[parent[i]] += wrench[i]
    by_q, by_v, mass = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        chain = [i]
        while parent[chain[-1]] >= 0:
            chain.append(int(parent[chain[-1]]))
        own = body[chain] == body[i]
        left, momentum = S[i] @ twice_b[i], S[i] @ inertia[i]
        by_q[i, chain] = S1[chain] @ left + S2[chain] @ momentum
        by_v[i, chain] = S[chain] @ left + rate[chain] @ momentum
        mass[i, chain] = mass[chain, i] = S[chain] @ momentum
        moved = twice_b[i] @ S1[i] + inertia[i] @ S2[i]
        turned = moved + _cross_force(S[i], wrench[i])
        by_q[chain, i] = np.where(own, S[chain] @ moved, S[chain] @ turned)
        by_v[chain, i] = S[chain] @ (twice_b[i] @ S[i] + inertia[i] @ rate[i])
    return InverseDynamicsDerivatives(by_q, by_v, mass)


def _joint_bodies(parent: NDArray[np.int64], base: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each row, the link of the body that its joint carries: the link of the joint's last row."""
    body = np.arange(len(parent), dtype=np.int64)
    for i in range(len(parent) - 1, 0, -1):
        # Every later row of a joint is mounted on the same body as the row before it, which is its parent.
        if parent[i] >= 0 and base[i] == base[parent[i]] and base[i] != parent[i]:
            body[parent[i]] = body[i]
    return body


def _composites(arrays: ModelArrays, links: Array, V: Array, A: Array) -> tuple[Array, Array, Array]:
    """Return the inertia (n, 6, 6), 2 B (n, 6, 6) and wrench I A + V ×* I V (n, 6) of each body at the world origin."""
    tables = arrays.body
    n = len(tables)
    R, p = links[:, ka.R : ka.R + 9].reshape(n, 3, 3), links[:, ka.P : ka.P + 3]
    mass = tables[:, ka.MASS]
    com = p + np.einsum("nij,nj->ni", R, tables[:, ka.COM : ka.COM + 3])
    own = tables[:, ka.INERTIA : ka.INERTIA + 6][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(n, 3, 3)
    c = _skew(com)
    inertia = np.zeros((n, 6, 6))
    inertia[:, :3, :3] = R @ own @ R.transpose(0, 2, 1) - mass[:, None, None] * c @ c
    inertia[:, :3, 3:] = mass[:, None, None] * c
    inertia[:, 3:, :3] = -inertia[:, :3, 3:]
    inertia[:, 3:, 3:] = mass[:, None, None] * np.eye(3)
    momentum = np.einsum("nij,nj->ni", inertia, V)
    cross = _motion_matrix(V)
    twice_b = -cross.transpose(0, 2, 1) @ inertia - inertia @ cross + _force_matrix(momentum)
    wrench = np.einsum("nij,nj->ni", inertia, A) + _cross_force(V, momentum)
    return inertia, twice_b, wrench


def _skew(a: Array) -> Array:
    """Return the cross-product matrices [a]×, (…, 3, 3), of vectors (…, 3)."""
    zero = np.zeros(a.shape[:-1])
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*a.shape[:-1], 3, 3)


def _motion_matrix(V: Array) -> Array:
    """Return the matrices (V ×) that act on motions, (…, 6, 6); the matrices that act on forces are −(V ×)ᵀ."""
    out = np.zeros((*V.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = _skew(V[..., :3])
    out[..., 3:, :3] = _skew(V[..., 3:])
    return out


def _force_matrix(F: Array) -> Array:
    """Return the matrices (F ×̄*), (…, 6, 6), defined by (F ×̄*) V = V ×* F."""
    out = np.zeros((*F.shape, 6))
    out[..., :3, :3] = -_skew(F[..., :3])
    out[..., :3, 3:] = out[..., 3:, :3] = -_skew(F[..., 3:])
    return out


def _cross_motion(V: Array, S: Array) -> Array:
    """Return V × S of motions, (…, 6)."""
    w, v = V[..., :3], V[..., 3:]
    return np.concatenate([np.cross(w, S[..., :3]), np.cross(w, S[..., 3:]) + np.cross(v, S[..., :3])], axis=-1)


def _cross_force(V: Array, F: Array) -> Array:
    """Return V ×* F of a motion and a wrench, (…, 6)."""
    w, v = V[..., :3], V[..., 3:]
    return np.concatenate([np.cross(w, F[..., :3]) + np.cross(v, F[..., 3:]), np.cross(w, F[..., 3:])], axis=-1)

"""Operations on unit quaternions (w, x, y, z): arrays of shape (4,), or (4, T) for T times."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def of_turn(axis: ArrayLike, angle: ArrayLike) -> Array:
    """Return the rotation by an angle q, () or (T,) [rad], about a unit axis a, (3,): (cos q/2, a sin q/2)."""
    half = 0.5 * np.asarray(angle, dtype=np.float64)
    s = np.sin(half)
    x, y, z = np.asarray(axis, dtype=np.float64)
    return np.array([np.cos(half), x * s, y * s, z * s])


def of_matrix(R: ArrayLike) -> Array:
    """Return the quaternion with w ≥ 0 of a rotation matrix, (3, 3) → (4,)."""
    R = np.asarray(R, dtype=np.float64)
    # Compute 4 q_k q for the largest component q_k, because division by a small component would lose precision.
    trace = float(np.trace(R))
    squares = np.array([1.0 + trace, *(1.0 - trace + 2.0 * np.diag(R))])
    k = int(squares.argmax())
    cross = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    row = np.array([squares[0], *cross] if k == 0 else [cross[k - 1], *(R + R.T)[k - 1]])
    row[k] = squares[k]
    return np.asarray(np.copysign(1.0, row[0]) * row / np.linalg.norm(row))


def product(a: Array, b: Array) -> Array:
    """Return the rotation a b, which applies b first, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def rotated(q: Array, vector: Array) -> Array:
    """Rotate a vector, (3,) or (3, T), by q = (w, u): v + 2 w u × v + 2 u × (u × v)."""
    w, u = q[0], q[1:]
    twice = 2.0 * _cross(u, vector)
    along = w * twice + _cross(u, twice)
    return np.array([v + a for v, a in zip(vector, along, strict=True)])


def _cross(a: Array, b: Array) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def continuous(q: Array) -> Array:
    """Return the same rotations, (4, T), with signs that make successive quaternions close; the first has w ≥ 0."""
    flips = np.where((q[:, 1:] * q[:, :-1]).sum(axis=0) < 0.0, -1.0, 1.0)
    first = -1.0 if q.shape[1] and q[0, 0] < 0.0 else 1.0
    return q * np.concatenate([[first], first * np.cumprod(flips)])[: q.shape[1]]

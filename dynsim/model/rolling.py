"""A base on two driven wheels: from the way it is to go to angles of its wheels, and from these to where it is.

V = r (φ̇_left + φ̇_right)/2, ω = r (φ̇_right − φ̇_left)/T, ẋ = V cos ψ, ẏ = V sin ψ: it cannot move sideways.
"""

from __future__ import annotations

import numpy as np

from dynsim.model.mobile_base import Array, MobileBase

# Of the Gauss–Legendre rule within one piece of a spline: exact to rounding unless it turns by radians in a piece.
NODES = 8


def wheel_angles(base: MobileBase, motion: Array) -> Array:
    """Angles of the left and the right wheel [rad] after a distance ahead [m] and a turn [rad], (T, 2) → (T, 2)."""
    distance, half = motion[:, 0], 0.5 * base.track * motion[:, 1]
    return np.stack([distance - half, distance + half], axis=1) / base.wheel_radius


def rolled(base: MobileBase, start: Array, coefficients: Array, spacing: float, pieces: int = 1) -> Array:
    """Where a base comes whose wheels turn as splines say, without slip, in the axes of the frame of its joint [m].

    Parameters
    ----------
    start : (2,) x and y where the splines begin [m]
    coefficients : (segments, 2, 6) ascending powers of the angles of the left and the right wheel [rad]
    spacing : of the segments [s]
    pieces : equal parts of a segment, at whose ends x and y are given

    Returns
    -------
    array, shape (segments, pieces + 1, 2) [m]; the end of a segment is the begin of the next
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    h = spacing / pieces
    t = h * (np.arange(pieces)[:, None] + 0.5 * (1.0 + nodes))
    angles = np.einsum("swc,pgc->spgw", coefficients, t[..., None] ** np.arange(6))
    rates = np.einsum("swc,pgc->spgw", coefficients[..., 1:] * np.arange(1, 6), t[..., None] ** np.arange(5))
    speed = 0.5 * base.wheel_radius * (rates[..., 0] + rates[..., 1])
    heading = base.wheel_radius / base.track * (angles[..., 1] - angles[..., 0])
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1)
    steps = 0.5 * h * np.einsum("spgx,g->spx", velocity, weights).reshape(-1, 2)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) + start
    return places[pieces * np.arange(len(coefficients))[:, None] + np.arange(pieces + 1)]

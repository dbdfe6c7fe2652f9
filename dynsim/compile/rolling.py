"""Kinematics of a base on two driven wheels: wheel angles from its path, and its pose from wheel angles.

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
    h = spacing / pieces
    begins = np.broadcast_to(h * np.arange(pieces), (len(coefficients), pieces))
    steps = _steps(base, coefficients, begins, np.full(len(coefficients), h)).reshape(-1, 2)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) + start
    return places[pieces * np.arange(len(coefficients))[:, None] + np.arange(pieces + 1)]


def coordinates(base: MobileBase, start: Array, coefficients: Array, spacing: float, times: Array) -> Array:
    """Wheel angles [rad], x and y [m] at times [s] since the splines begin, (T,) → (T, 4); see :func:`rolled`.

    Before and after the splines everything stays where they begin and end.
    """
    count = len(coefficients)
    knots = rolled(base, start, coefficients, spacing)[:, 0]
    times = np.clip(times, 0.0, count * spacing)
    segment = np.minimum((times / spacing).astype(int), count - 1)
    # Rounding may take a time into the segment before its own.
    within = np.maximum(times - segment * spacing, 0.0)
    angles = np.einsum("swc,sc->sw", coefficients[segment], within[:, None] ** np.arange(6))
    steps = _steps(base, coefficients[segment], np.zeros((len(times), 1)), within)
    return np.hstack([angles, knots[segment] + steps[:, 0]])


def _steps(base: MobileBase, coefficients: Array, begins: Array, lengths: Array) -> Array:
    """Ways from ``begins``, (s, p) [s] since each of the segments does, in ``lengths``, (s,) [s], (s, p, 2) [m]."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    t = begins[..., None] + 0.5 * lengths[:, None, None] * (1.0 + nodes)
    angles = np.einsum("swc,spgc->spgw", coefficients, t[..., None] ** np.arange(6))
    rates = np.einsum("swc,spgc->spgw", coefficients[..., 1:] * np.arange(1, 6), t[..., None] ** np.arange(5))
    speed = 0.5 * base.wheel_radius * (rates[..., 0] + rates[..., 1])
    heading = base.wheel_radius / base.track * (angles[..., 1] - angles[..., 0])
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1)
    return np.einsum("spgx,g,s->spx", velocity, weights, 0.5 * lengths)

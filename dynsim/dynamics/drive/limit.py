"""A bound on both sides, for every kind of drive."""

from __future__ import annotations


def clipped(x, limit):
    """X within ±limit; NaN stays NaN."""
    if x.real > limit:
        return limit
    if x.real < -limit:
        return -limit
    return x

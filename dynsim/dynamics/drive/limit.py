"""Clamping of a value to ±limit, for every kind of drive."""

from __future__ import annotations


def clipped(x, limit):
    """Value x clamped to ±limit, by its real part; NaN stays NaN."""
    if x.real > limit:
        return limit
    if x.real < -limit:
        return -limit
    return x

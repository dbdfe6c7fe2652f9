"""Sines and cosines of joint angles by range reduction and polynomials, without calls or branches."""

from __future__ import annotations

import math

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.jit.kernel import internal_kernel

TWO_OVER_PI = 2.0 / math.pi
HALF_PI_HIGH, HALF_PI_MIDDLE = 1.57079632673412561417, 6.07710050630396597660e-11
HALF_PI_LOW = 2.02226624879595063154e-21
SIN3, SIN5, SIN7 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
SIN9, SIN11, SIN13 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
COS4, COS6, COS8 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
COS10, COS12, COS14 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@internal_kernel
def sine_cosine_of(q):
    """Sine and cosine of one q; within one unit in the last place of libm's.

    Free of calls, which would push all values of a sweep out of their registers, and of branches:
    r = q − k π/2 with π/2 in three parts, then the polynomials of FreeBSD's msun (k_sin.c, k_cos.c) on |r| ≤ π/4.
    Infinite q gives NaN.
    """
    k = np.rint(q * TWO_OVER_PI)
    r = ((q - k * HALF_PI_HIGH) - k * HALF_PI_MIDDLE) - k * HALF_PI_LOW
    z = r * r
    s = r + r * z * (SIN3 + z * (SIN5 + z * (SIN7 + z * (SIN9 + z * (SIN11 + z * SIN13)))))
    c = 1.0 - 0.5 * z + z * z * (COS4 + z * (COS6 + z * (COS8 + z * (COS10 + z * (COS12 + z * COS14)))))
    # k = 4 turns + 2 half + odd; sin and cos of r + k π/2 without a branch.
    odd = k - 2.0 * np.floor(0.5 * k)
    half = 0.5 * (k - odd)
    sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))
    return sign * (s + odd * (c - s)), sign * (c - odd * (c + s))


@internal_kernel
def sine_cosine(joints, trig):
    """Sine and cosine of every q, into trig: (3, ≥ n), in vectors of several q."""
    for i in range(joints.shape[0]):
        trig[2, i] = joints[i, ka.Q]
    for i in range(trig.shape[1]):
        trig[0, i], trig[1, i] = sine_cosine_of(trig[2, i])

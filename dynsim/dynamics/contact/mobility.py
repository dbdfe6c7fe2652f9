"""Mobility of contact candidates along their normals in the present posture."""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import ZERO_VECTOR, dot, dot_vector, six, vector, wrench_at
from dynsim.jit.kernel import noinline_kernel

# Rounding limit of a point's rate along its normal per joint rate, as a fraction of the terms that cancel in it. The
# rounding error is 1e-16 times a few dozen operations; at the limit, forces still have three correct digits.
IMMOBILE = 1e-12
# A larger rate is not a rounding error for any robot [m/rad or m/m].
CLEARLY = 1e-9
# A joint that would have to move further than this to bring a point onto its surface does not count [rad or m].
MAX_TRAVEL = 0.1


@noinline_kernel
def moves_along_normal(model: ModelArrays, contacts: ContactArrays, ws: Workspace, k, gap):
    """Return whether a joint moves candidate k along its normal far enough to close ``gap`` [m]; call after a sweep.

    The rate due to joint i is S_i · (p × n, n). Its terms are products of the distances of the joint and the point from
    the origin. The scale of the rounding error is the largest of these distances times the angular part of S, plus the
    linear part of S.
    """
    if contacts.link[k, ka.LEFT_OUT] == 1:
        return False
    links, state = ws.links, ws.contacts
    at, last = vector(state, k, ka.POSITION), contacts.link[k, ka.LINK]
    row = wrench_at(at, vector(state, k, ka.NORMAL), ZERO_VECTOR)
    square, least = dot_vector(at, at), abs(gap) / MAX_TRAVEL
    i, j = last, contacts.link[k, ka.CARRIER]
    while i != j:  # joints below both the body and the carrier of the surface move neither against the other
        i, j = max(i, j), min(i, j)
        if abs(dot(six(links, i, ka.S), row)) > max(CLEARLY, least):
            return True
        p = vector(links, i, ka.P)
        square = max(square, dot_vector(p, p))
        i = model.tree[i, ka.PARENT]
    i, j = last, contacts.link[k, ka.CARRIER]
    while i != j:
        i, j = max(i, j), min(i, j)
        S = six(links, i, ka.S)
        turn, shift = S[0] * S[0] + S[1] * S[1] + S[2] * S[2], S[3] * S[3] + S[4] * S[4] + S[5] * S[5]
        if abs(dot(S, row)) > max(IMMOBILE * (math.sqrt(turn * square) + math.sqrt(shift)), least):
            return True
        i = model.tree[i, ka.PARENT]
    return False

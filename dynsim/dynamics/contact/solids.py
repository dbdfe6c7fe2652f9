"""Contacts between two solids: spheres, capsules and rounded boxes, all as a box with half edges h and a radius r.

h = 0 is a sphere, one nonzero half edge a capsule, three a box whose edges are rounded. The core |x_i| ≤ h_i is
convex, and the distance of two solids is the distance of their cores minus both radii. It is attained at a corner of
one core or between two edges. A pair has at most :data:`SLOTS` contacts: places that touch at the same time, such as
the corners of two faces. A slot keeps its place from step to step, because time stepping remembers impulses by slot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.spatial import along, compose, dot_vector, rotate, rotate_back, rotation, transform, vector
from dynsim.jit.kernel import integers, internal_kernel, kernel, reals

SLOTS = 4
# Row of a found contact
GAP = 0  # [m]
PLACE = 1  # 3: midpoint between the two surfaces, in W [m]
NORMAL = 4  # 3: from the second solid to the first, in W
FEATURE = 7  # corner or edge of one of the solids, −1: empty slot
FOUND_SIZE = 8
# Gap of a place that does not exist [m].
FAR = 1e9
# Features: corners 0 to 7 and edges 8 to 19 of the first solid, corners 20 to 27 of the second, and the places where
# the edges of one solid begin and end to be above a face of the other, 28 to 39 and 40 to 51.
EDGES, OTHERS, BORDERS, FEATURES = 8, 20, 28, 52
# Smallest cosine between the normal and a face for which two solids touch in more places than corners.
FLAT = 0.98
# Difference of gaps below which the nearest place of an edge is where the edge begins or ends to be above a face [m].
SAME = 1e-12
# A feature of the last step keeps its slot unless another one is deeper by this distance [m] or further by this factor.
STAYS, STAYS_FACTOR = 1e-6, 1.02
# A place that is further behind the deepest one than this [m] only gets a slot that no other place needs.
TOUCHES, APART_FACTOR = 1e-5, 1e-3
# Places within this distance behind the deepest one can touch as well [m].
BAND = 2e-3
# Slope of the distance along an edge below which its ends are as near as its middle.
LEVEL = 1e-9
# Largest number of steps of the search along an edge.
ALONG_STEPS = 60
# Pairs whose bounding spheres are further apart than this [m] are not examined.
NEAR = 5e-3
# PairArrays.index
LINKS = 0  # 2: links of the first solid and of the second, which carries the surface; −1: the world
PAIR_SIZE = 2
# PairArrays.solid
POSE = 0  # 12: rotation by rows and centre in the frame of its link
CORE = 12  # 4: half edges and radius
BOUND = 16  # radius of the sphere about it
SOLID_SIZE = 17


class PairArrays(NamedTuple):
    """Pairs of solids that can touch, with their contacts."""

    index: np.ndarray  # (m, PAIR_SIZE) int
    solid: np.ndarray  # (m, 2, SOLID_SIZE)
    slots: np.ndarray  # (m, SLOTS, FOUND_SIZE): contacts at the present poses
    known: np.ndarray  # (m, SLOTS): features of the last accepted step
    poses: np.ndarray  # (2, 12) scratch
    places: np.ndarray  # (FEATURES, FOUND_SIZE) scratch
    chosen: np.ndarray  # (SLOTS,) int scratch


def pair_arrays(index: np.ndarray, solid: np.ndarray) -> PairArrays:
    """Allocate :class:`PairArrays` for pairs of links, (m, PAIR_SIZE), with their solids, (m, 2, SOLID_SIZE)."""
    m = len(index)
    return PairArrays(
        index=integers(index),
        solid=reals(solid),
        slots=reals(np.zeros((m, SLOTS, FOUND_SIZE))),
        known=reals(np.full((m, SLOTS), -1.0)),
        poses=reals(np.zeros((2, 12))),
        places=reals(np.zeros((FEATURES, FOUND_SIZE))),
        chosen=integers(np.zeros(SLOTS)),
    )


@internal_kernel
def find_pairs(pairs, ws: Workspace):
    """Find the contacts of all pairs of solids at the poses in ``ws``; without pairs (None) nothing is compiled."""
    if pairs is None:
        return
    solid, poses = pairs.solid, pairs.poses
    for m in range(pairs.index.shape[0]):
        for side in range(2):
            i, p = pairs.index[m, LINKS + side], vector(solid[m], side, POSE + 9)
            if i >= 0:
                p = transform(vector(ws.links, i, ka.P), rotation(ws.links, i, ka.R), p)
            poses[side, 9], poses[side, 10], poses[side, 11] = p
        dx, dy, dz = poses[0, 9] - poses[1, 9], poses[0, 10] - poses[1, 10], poses[0, 11] - poses[1, 11]
        apart = math.sqrt(dx * dx + dy * dy + dz * dz)
        gap = apart - solid[m, 0, BOUND] - solid[m, 1, BOUND]
        if gap > NEAR:
            for j in range(SLOTS):
                slot = pairs.slots[m, j]
                slot[GAP], slot[FEATURE] = gap, -1.0
                slot[NORMAL], slot[NORMAL + 1], slot[NORMAL + 2] = dx / apart, dy / apart, dz / apart
                for s in range(3):
                    slot[PLACE + s] = 0.5 * (poses[0, 9 + s] + poses[1, 9 + s])
            continue
        for side in range(2):
            i, R = pairs.index[m, LINKS + side], rotation_of(solid[m, side])
            if i >= 0:
                R = compose(rotation(ws.links, i, ka.R), R)
            for s in range(9):
                poses[side, s] = R[s]
        core, other = solid[m, 0, CORE:BOUND], solid[m, 1, CORE:BOUND]
        slots, known = pairs.slots[m], pairs.known[m]
        find_contacts(poses[0], core, poses[1], other, known, slots, pairs.places, pairs.chosen)


@internal_kernel
def remember_pairs(pairs):
    """Note the features of the slots, so that the slots of the next step are the same."""
    if pairs is None:
        return
    for m in range(pairs.known.shape[0]):
        for j in range(SLOTS):
            pairs.known[m, j] = pairs.slots[m, j, FEATURE]


@internal_kernel
def core_distance(hx, hy, hz, x, y, z):
    """Return the distance of a point from a core, negative within a box, and its gradient, in the axes of the core."""
    ox, oy, oz = abs(x) - hx, abs(y) - hy, abs(z) - hz
    inside = max(ox, max(oy, oz))
    if inside < 0.0:
        if ox == inside:
            return inside, math.copysign(1.0, x), 0.0, 0.0
        if oy == inside:
            return inside, 0.0, math.copysign(1.0, y), 0.0
        return inside, 0.0, 0.0, math.copysign(1.0, z)
    ox, oy, oz = max(ox, 0.0), max(oy, 0.0), max(oz, 0.0)
    r = math.sqrt(ox * ox + oy * oy + oz * oz)
    if r == 0.0:
        # On the core: the normal of a face through the point, if there is one.
        if hx > 0.0 and abs(x) == hx:
            return 0.0, math.copysign(1.0, x), 0.0, 0.0
        if hy > 0.0 and abs(y) == hy:
            return 0.0, 0.0, math.copysign(1.0, y), 0.0
        return 0.0, 0.0, 0.0, math.copysign(1.0, z)
    return r, math.copysign(ox, x) / r, math.copysign(oy, y) / r, math.copysign(oz, z) / r


@internal_kernel
def corner(h, k):
    """Return corner k of a core: bits 0, 1 and 2 of k are the signs along x, y and z."""
    return (
        h[0] if k & 1 else -h[0],
        h[1] if k & 2 else -h[1],
        h[2] if k & 4 else -h[2],
    )


@internal_kernel
def is_corner(h, k):
    """Return whether corner k of a core is not the same as an earlier one; along a zero half edge there is one."""
    return not ((k & 1 and h[0] == 0.0) or (k & 2 and h[1] == 0.0) or (k & 4 and h[2] == 0.0))


@internal_kernel
def lowest_between(h, start, step):
    """Return u in [0, 1] at which start + u step is nearest to a core; φ is convex along a line."""
    low, high, u = 0.0, 1.0, 0.5
    for _ in range(ALONG_STEPS):
        x, y, z = along(start, step, u)
        far, nx, ny, nz = core_distance(h[0], h[1], h[2], x, y, z)
        slope = nx * step[0] + ny * step[1] + nz * step[2]
        if slope < 0.0:
            low = u
        elif slope > 0.0:
            high = u
        else:
            return u
        # Outside the core φ = |o|, so that φ'' = (|step_o|² − slope²)/φ with the part of step where o is not zero.
        bend = 0.0
        if far > 0.0:
            for s in range(3):
                at, half, d = (x, h[0], step[0]) if s == 0 else (y, h[1], step[1]) if s == 1 else (z, h[2], step[2])
                if abs(at) > half:
                    bend += d * d
            bend = (bend - slope * slope) / far
        trial = u - slope / bend if bend > 0.0 else low
        if bend > 0.0 and trial == u:
            return u
        u = trial if low < trial < high else 0.5 * (low + high)
        if high - low <= 1e-15:
            return u
    return u


@kernel
def find_contacts(pose_a, core_a, pose_b, core_b, known, slots, places, chosen):
    """Find the contacts of two solids.

    Parameters
    ----------
    pose_a, pose_b : (12,) ndarray
        Rotation of the core, by rows, and its centre in W [m].
    core_a, core_b : (4,) ndarray
        Half edges of the core and radius [m].
    known : (SLOTS,) ndarray
        Features of the contacts of the last step, which keep their slots.
    slots : (SLOTS, FOUND_SIZE) ndarray
        Contacts, overwritten; an empty slot repeats the deepest contact at a gap of at least ``BAND``.
    places : (FEATURES, FOUND_SIZE) ndarray
        Scratch.
    chosen : (SLOTS,) ndarray of int
        Scratch.
    """
    RA, pA = rotation_of(pose_a), (pose_a[9], pose_a[10], pose_a[11])
    RB, pB = rotation_of(pose_b), (pose_b[9], pose_b[10], pose_b[11])
    hA, hB = (core_a[0], core_a[1], core_a[2]), (core_b[0], core_b[1], core_b[2])
    rA, rB = core_a[3], core_b[3]
    for f in range(FEATURES):
        places[f, GAP], places[f, FEATURE] = FAR, -1.0
    for k in range(8):
        if is_corner(hA, k):
            note_place(places, k, transform(pA, RA, corner(hA, k)), RB, pB, hB, rA, rB, 1.0)
        if is_corner(hB, k):
            note_place(places, OTHERS + k, transform(pB, RB, corner(hB, k)), RA, pA, hA, rB, rA, -1.0)
    for axis in range(3):
        bit = 1 << axis
        half = hA[0] if axis == 0 else hA[1] if axis == 1 else hA[2]
        for k in range(8):
            if half == 0.0 or k & bit or not is_corner(hA, k):
                continue
            start, end = transform(pA, RA, corner(hA, k)), transform(pA, RA, corner(hA, k | bit))
            direction = along(end, start, -1.0)
            n, m = (
                (places[k, NORMAL], places[k, NORMAL + 1], places[k, NORMAL + 2]),
                (places[k | bit, NORMAL], places[k | bit, NORMAL + 1], places[k | bit, NORMAL + 2]),
            )
            level = LEVEL * 2.0 * half
            # φ falls towards the middle from both ends.
            if dot_vector(n, direction) < -level and dot_vector(m, direction) > level:
                x, d = rotate_back(RB, along(start, pB, -1.0)), rotate_back(RB, direction)
                at = along(start, direction, lowest_between(hB, x, d))
                f = EDGES + 4 * axis + edge_number(k, axis)
                note_place(places, f, at, RB, pB, hB, rA, rB, 1.0)
    if min(hB[0], hB[1], hB[2]) > 0.0:
        note_borders(places, known, RA, pA, hA, RB, pB, hB, rA, rB, 1.0)
    elif min(hA[0], hA[1], hA[2]) > 0.0:
        note_borders(places, known, RB, pB, hB, RA, pA, hA, rB, rA, -1.0)
    fill_slots(known, slots, places, chosen)


@internal_kernel
def note_borders(places, known, R, p, h, Q, q, box, own, other, sign):
    """Write the places where edges of a solid (R, p, h) begin and end to be above the nearest face of a box.

    The pose of the box is Q, q, and ``box`` contains its half edges. The corners of the area in which two faces touch
    are corners of the faces, or such places.
    """
    deepest = deepest_place(places, known)
    n = rotate_back(Q, (places[deepest, NORMAL], places[deepest, NORMAL + 1], places[deepest, NORMAL + 2]))
    k = 0 if abs(n[0]) >= max(abs(n[1]), abs(n[2])) else 1 if abs(n[1]) >= abs(n[2]) else 2
    if abs(n[k]) < FLAT:
        return
    side = math.copysign(1.0, sign * n[k])
    depth = places[deepest, GAP]
    up = rotate(Q, (side if k == 0 else 0.0, side if k == 1 else 0.0, side if k == 2 else 0.0))
    for axis in range(3):
        bit = 1 << axis
        for c in range(8):
            if h[axis] == 0.0 or c & bit or not is_corner(h, c):
                continue
            start = transform(p, R, corner(h, c))
            span = along(transform(p, R, corner(h, c | bit)), start, -1.0)
            x, d, low, high = rotate_back(Q, along(start, q, -1.0)), rotate_back(Q, span), 0.0, 1.0
            for m in range(3):
                if m != k and d[m] != 0.0:
                    a, b = (-box[m] - x[m]) / d[m], (box[m] - x[m]) / d[m]
                    low, high = max(low, min(a, b)), min(high, max(a, b))
                elif m != k and abs(x[m]) > box[m]:
                    high = low
            f = 4 * axis + edge_number(c, axis)
            for end in range(2):
                u = low if end == 0 else high
                gap = side * (x[k] + u * d[k]) - box[k] - own - other
                if low < high and 0.0 < u < 1.0 and abs(gap - depth) <= BAND:
                    put_place(places, BORDERS + 12 * end + f, along(start, span, u), up, gap, own, sign)
                    if sign > 0.0 and gap <= places[EDGES + f, GAP] + SAME:
                        places[EDGES + f, GAP] = FAR


@internal_kernel
def rotation_of(pose):
    """Return the rotation of a pose."""
    return pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6], pose[7], pose[8]


@internal_kernel
def edge_number(k, axis):
    """Return which of the four edges along an axis begins at corner k."""
    if axis == 0:
        return k >> 1
    if axis == 1:
        return (k & 1) | ((k >> 1) & 2)
    return k & 3


@internal_kernel
def note_place(places, f, at, R, p, h, own, other, sign):
    """Write the place where the point ``at`` of one core is nearest to the other core (R, p, h)."""
    x, y, z = rotate_back(R, along(at, p, -1.0))
    far, nx, ny, nz = core_distance(h[0], h[1], h[2], x, y, z)
    put_place(places, f, at, rotate(R, (nx, ny, nz)), far - own - other, own, sign)


@internal_kernel
def put_place(places, f, at, n, gap, own, sign):
    """Write the place below the point ``at`` of a core with radius ``own``, at this gap along the normal n."""
    row = places[f]
    # From the axis to the own surface, and half of the gap further.
    c = along(at, n, -(own + 0.5 * gap))
    row[GAP], row[FEATURE] = gap, f
    row[PLACE], row[PLACE + 1], row[PLACE + 2] = c
    row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = sign * n[0], sign * n[1], sign * n[2]


@internal_kernel
def fill_slots(known, slots, places, chosen):
    """Choose at most SLOTS places: the deepest, the furthest from it, and the furthest on either side of their line."""
    chosen[:] = -1
    deepest = deepest_place(places, known)
    chosen[0] = deepest
    limit = places[deepest, GAP] + BAND
    first, best = vector_of(places, deepest), 1e-12
    for f in range(FEATURES):
        if places[f, GAP] <= limit:
            offset = along(vector_of(places, f), first, -1.0)
            square = dot_vector(offset, offset) * weight(places, known, f, deepest)
            if square > best:
                best, chosen[1] = square, f
    if chosen[1] >= 0:
        n = places[deepest, NORMAL], places[deepest, NORMAL + 1], places[deepest, NORMAL + 2]
        line = along(vector_of(places, chosen[1]), first, -1.0)
        across = (
            n[1] * line[2] - n[2] * line[1],
            n[2] * line[0] - n[0] * line[2],
            n[0] * line[1] - n[1] * line[0],
        )
        least, most = -1e-6 * best, 1e-6 * best
        for f in range(FEATURES):
            if places[f, GAP] <= limit:
                side = dot_vector(across, along(vector_of(places, f), first, -1.0))
                side *= weight(places, known, f, deepest)
                if side < least:
                    least, chosen[2] = side, f
                elif side > most:
                    most, chosen[3] = side, f
    # A feature that had a slot keeps it.
    for j in range(SLOTS):
        kept = False
        for s in range(SLOTS):
            if chosen[s] >= 0 and known[j] == chosen[s]:
                copy_place(slots, j, places, chosen[s])
                kept, chosen[s] = True, -1
        if not kept:
            copy_place(slots, j, places, deepest)
            slots[j, GAP], slots[j, FEATURE] = max(places[deepest, GAP], 0.0) + BAND, -1.0
    for s in range(SLOTS):
        for j in range(SLOTS):
            if chosen[s] >= 0 and slots[j, FEATURE] < 0.0:
                copy_place(slots, j, places, chosen[s])
                chosen[s] = -1


@internal_kernel
def deepest_place(places, known):
    """Return the feature of the deepest place; a known one keeps this role until another is deeper by ``STAYS``."""
    deepest, least = 0, FAR
    for f in range(FEATURES):
        gap = places[f, GAP] - (STAYS if is_known(known, f) else 0.0)
        if gap < least:
            deepest, least = f, gap
    return deepest


@internal_kernel
def weight(places, known, f, deepest):
    """Return the weight of feature f in the choice of slots."""
    touches = places[f, GAP] <= max(places[deepest, GAP], 0.0) + TOUCHES
    return (1.0 if touches else APART_FACTOR) * (STAYS_FACTOR if is_known(known, f) else 1.0)


@internal_kernel
def is_known(known, f):
    """Return whether feature f had a slot in the last step."""
    result = False
    for j in range(SLOTS):
        result = result or known[j] == f
    return result


@internal_kernel
def copy_place(slots, j, places, f):
    """Copy the place of feature f to slot j."""
    for s in range(FOUND_SIZE):
        slots[j, s] = places[f, s]


@internal_kernel
def vector_of(places, f):
    """Return the place of feature f."""
    return places[f, PLACE], places[f, PLACE + 1], places[f, PLACE + 2]


@kernel
def pair_distances(poses_a, cores_a, poses_b, cores_b, known, slots, places, chosen, gaps, normals):
    """Write the distances, (m,) [m], and normals, (m, 3), of m pairs of solids; see :func:`find_contacts`."""
    for k in range(poses_a.shape[0]):
        find_contacts(poses_a[k], cores_a[k], poses_b[k], cores_b[k], known, slots, places, chosen)
        gaps[k] = FAR
        for j in range(SLOTS):
            if slots[j, GAP] < gaps[k]:
                gaps[k] = slots[j, GAP]
                for i in range(3):
                    normals[k, i] = slots[j, NORMAL + i]

"""Contacts between two solids: spheres, capsules and rounded boxes, all as a box with half edges h and a radius r.

h = 0 is a sphere, one nonzero half edge a capsule, three a box whose edges are rounded. The core |x_i| ≤ h_i is
convex, and the distance of two solids is the distance of their cores minus both radii. It is attained at a corner of
one core or between two edges. A pair has at most :data:`SLOTS` contacts: places that touch at the same time, such as
the corners of two faces. A slot keeps its place from step to step, because time stepping remembers impulses by slot.
"""

from __future__ import annotations

import math

from dynsim.dynamics.tree.spatial import along, dot_vector, rotate, rotate_back, transform
from dynsim.jit.kernel import internal_kernel, kernel

SLOTS = 4
# Row of a found contact
GAP = 0  # [m]
PLACE = 1  # 3: midpoint between the two surfaces, in W [m]
NORMAL = 4  # 3: from the second solid to the first, in W
FEATURE = 7  # corner or edge of one of the solids, −1: empty slot
FOUND_SIZE = 8
# Gap of an empty slot [m].
FAR = 1e9
# Features: corners 0 to 7 and edges 8 to 19 of the first solid, corners 20 to 27 of the second.
EDGES, OTHERS, FEATURES = 8, 20, 28
# Places within this distance behind the deepest one can touch as well [m].
BAND = 2e-3
# Slope of the distance along an edge below which its ends are as near as its middle.
LEVEL = 1e-9
# Largest number of steps of the search along an edge.
ALONG_STEPS = 60


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
def lowest_between(h, start, way):
    """Return u in [0, 1] at which start + u way is nearest to a core; φ is convex along a line."""
    low, high, u = 0.0, 1.0, 0.5
    for _ in range(ALONG_STEPS):
        x, y, z = along(start, way, u)
        far, nx, ny, nz = core_distance(h[0], h[1], h[2], x, y, z)
        slope = nx * way[0] + ny * way[1] + nz * way[2]
        if slope < 0.0:
            low = u
        elif slope > 0.0:
            high = u
        else:
            return u
        # Outside the core φ = |o|, so that φ'' = (|way_o|² − slope²)/φ with the part of way along which o is not zero.
        bend = 0.0
        if far > 0.0:
            for s in range(3):
                at, half, d = (x, h[0], way[0]) if s == 0 else (y, h[1], way[1]) if s == 1 else (z, h[2], way[2])
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
def find_contacts(pose_a, core_a, pose_b, core_b, slots, places, chosen):
    """Find the contacts of two solids.

    Parameters
    ----------
    pose_a, pose_b : (12,) ndarray
        Rotation of the core, by rows, and its centre in W [m].
    core_a, core_b : (4,) ndarray
        Half edges of the core and radius [m].
    slots : (SLOTS, FOUND_SIZE) ndarray
        Contacts of the last step; they are replaced by those of the present poses.
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
            way = along(end, start, -1.0)
            n, m = (
                (places[k, NORMAL], places[k, NORMAL + 1], places[k, NORMAL + 2]),
                (places[k | bit, NORMAL], places[k | bit, NORMAL + 1], places[k | bit, NORMAL + 2]),
            )
            level = LEVEL * 2.0 * half
            # φ falls towards the middle from both ends.
            if dot_vector(n, way) < -level and dot_vector(m, way) > level:
                x, d = rotate_back(RB, along(start, pB, -1.0)), rotate_back(RB, way)
                at = along(start, way, lowest_between(hB, x, d))
                f = EDGES + 4 * axis + edge_number(k, axis)
                note_place(places, f, at, RB, pB, hB, rA, rB, 1.0)
    fill_slots(slots, places, chosen)


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
    n = rotate(R, (nx, ny, nz))
    gap = far - own - other
    row = places[f]
    # From the axis to the own surface, and half of the gap further.
    c = along(at, n, -(own + 0.5 * gap))
    row[GAP], row[FEATURE] = gap, f
    row[PLACE], row[PLACE + 1], row[PLACE + 2] = c
    row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = sign * n[0], sign * n[1], sign * n[2]


@internal_kernel
def fill_slots(slots, places, chosen):
    """Choose at most SLOTS places: the deepest, the furthest from it, and the furthest on either side of their line."""
    chosen[:] = -1
    deepest = 0
    for f in range(FEATURES):
        if places[f, GAP] < places[deepest, GAP]:
            deepest = f
    chosen[0] = deepest
    limit = places[deepest, GAP] + BAND
    first, best = vector_of(places, deepest), 1e-12
    for f in range(FEATURES):
        if places[f, GAP] <= limit:
            way = along(vector_of(places, f), first, -1.0)
            if dot_vector(way, way) > best:
                best, chosen[1] = dot_vector(way, way), f
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
                if side < least:
                    least, chosen[2] = side, f
                elif side > most:
                    most, chosen[3] = side, f
    # A feature that had a slot keeps it.
    for j in range(SLOTS):
        kept = False
        for s in range(SLOTS):
            if chosen[s] >= 0 and slots[j, FEATURE] == chosen[s]:
                copy_place(slots, j, places, chosen[s])
                kept, chosen[s] = True, -1
        if not kept:
            slots[j, GAP], slots[j, FEATURE] = FAR, -1.0
    for s in range(SLOTS):
        for j in range(SLOTS):
            if chosen[s] >= 0 and slots[j, FEATURE] < 0.0:
                copy_place(slots, j, places, chosen[s])
                chosen[s] = -1


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
def pair_distances(poses_a, cores_a, poses_b, cores_b, slots, places, chosen, gaps, normals):
    """Write the distances, (m,) [m], and normals, (m, 3), of m pairs of solids; see :func:`find_contacts`."""
    for k in range(poses_a.shape[0]):
        find_contacts(poses_a[k], cores_a[k], poses_b[k], cores_b[k], slots, places, chosen)
        gaps[k] = FAR
        for j in range(SLOTS):
            if slots[j, GAP] < gaps[k]:
                gaps[k] = slots[j, GAP]
                for i in range(3):
                    normals[k, i] = slots[j, NORMAL + i]

"""Distances and normals of spheres, capsules and boxes against coal, on random pairs."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynsim.dynamics.contact import solids

PAIRS = 10_000
KINDS = ("sphere", "capsule", "box")


def cores(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Half edges and radius of random solids, (PAIRS, 4)."""
    half, radius = rng.uniform(0.05, 0.3, (PAIRS, 3)), rng.uniform(0.001, 0.1, PAIRS)
    if kind == "sphere":
        half[:] = 0.0
    elif kind == "capsule":
        half[:, :2] = 0.0
    else:
        radius = rng.choice([0.0, 1e-3], PAIRS)
    return np.column_stack([half, radius])


def poses(rng: np.random.Generator, spread: float) -> np.ndarray:
    turns = Rotation.random(PAIRS, rng=rng).as_matrix().reshape(PAIRS, 9)
    return np.column_stack([turns, rng.uniform(-spread, spread, (PAIRS, 3))])


def peer(core: np.ndarray) -> tuple[coal.CollisionGeometry, float]:
    """A solid in coal, and the radius that it leaves out."""
    *half, radius = core
    if not any(half):
        return coal.Sphere(radius), 0.0
    if half[0] == 0.0:
        return coal.Capsule(radius, 2.0 * half[2]), 0.0
    return coal.Box(*(2.0 * np.array(half))), radius


@pytest.mark.parametrize(("first", "second"), list(itertools.product(KINDS, KINDS)))
def test_distances_and_normals_agree_with_coal(first: str, second: str) -> None:
    rng = np.random.default_rng([KINDS.index(first), KINDS.index(second)])
    a, b, at_a, at_b = cores(first, rng), cores(second, rng), poses(rng, 0.6), poses(rng, 0.3)
    gaps, normals = np.zeros(PAIRS), np.zeros((PAIRS, 3))
    slots, places = np.zeros((solids.SLOTS, solids.FOUND_SIZE)), np.zeros((solids.FEATURES, solids.FOUND_SIZE))
    known, chosen = np.full(solids.SLOTS, -1.0), np.zeros(solids.SLOTS, dtype=int)
    solids.pair_distances(at_a, a, at_b, b, known, slots, places, chosen, gaps, normals)
    request, apart = coal.DistanceRequest(), 0
    request.gjk_tolerance = 1e-12
    for k in range(PAIRS):
        (first, left), (other, right) = peer(a[k]), peer(b[k])
        result = coal.DistanceResult()
        poses_of_both = (coal.Transform3s(pose[:9].reshape(3, 3), pose[9:]) for pose in (at_a[k], at_b[k]))
        placed = [part for pair in zip((first, other), poses_of_both, strict=True) for part in pair]
        far = coal.distance(*placed, request, result)
        if far <= 1e-6:  # coal's depth is another measure
            continue
        apart += 1
        assert gaps[k] == pytest.approx(far - left - right, abs=1e-9)
        assert np.abs(normals[k] + result.normal).max() < 1e-6
    assert apart > 0.7 * PAIRS

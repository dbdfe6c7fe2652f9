"""Mass properties of the shapes of a link from their density."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dynsim.errors import ModelError, RecordError
from dynsim.model.description import Array, Inertia, vector
from dynsim.record.meshes import Mesh, mesh_path, read_mesh
from dynsim.record.scene import Shape
from dynsim.record.urdf_text import rotation

# Relative size of the sum of all area vectors at which a mesh counts as open; it is zero for a closed surface.
_OPEN = 1e-2


def solid_inertia(shapes: Sequence[Shape], density: float, folder: Path, key: str) -> Inertia:
    """Return the mass properties of solid shapes with a density [kg/m³]; overlaps count twice.

    Raises
    ------
    ModelError
        If there are no shapes, or a mesh is not found, cannot be read, or is not closed.
    """
    if not shapes:
        raise ModelError(f"{key}.density_kg_m3: the link has no shapes; set mass_kg, com_m and inertia_kg_m2")
    parts = []
    for shape in shapes:
        try:
            solid = _solid(shape, density, folder)
        except (RecordError, ValueError) as error:
            raise ModelError(f"{key}.density_kg_m3: {error}; set mass_kg, com_m and inertia_kg_m2 instead") from error
        parts.append(solid.placed(rotation(shape.orientation), np.array(shape.position)))
    return Inertia.merged(parts)


def _solid(shape: Shape, density: float, folder: Path) -> Inertia:
    """Return the mass properties of a shape in its own frame."""
    match shape.kind:
        case "box":
            squares = np.square(shape.size)
            mass = density * float(np.prod(shape.size))
            return Inertia(mass, vector(0.0, 0.0, 0.0), np.diag(mass / 12.0 * (squares.sum() - squares)))
        case "sphere":
            (r,) = shape.size
            return Inertia.solid_sphere(density * 4.0 / 3.0 * np.pi * r**3, r, vector(0.0, 0.0, 0.0))
        case "cylinder" | "capsule":
            r, length = shape.size
            turned = Inertia.solid_cylinder(density * np.pi * r**2 * length, r, length)
            parts = [turned.placed(np.eye(3), vector(0.0, 0.0, -0.5 * length))]
            if shape.kind == "capsule":
                # A half ball: its centre of mass is 3 r/8 above its flat side.
                mass = density * 2.0 / 3.0 * np.pi * r**3
                moments = mass * r**2 * np.array([83.0 / 320.0, 83.0 / 320.0, 0.4])
                parts += [
                    Inertia(mass, vector(0.0, 0.0, side * (0.5 * length + 0.375 * r)), np.diag(moments))
                    for side in (-1.0, 1.0)
                ]
            return Inertia.merged(parts)
    path = mesh_path(shape.file, [folder])
    if path is None:
        raise ValueError(f"mesh {shape.file} not found")
    try:
        return _mesh_solid(read_mesh(path), np.array(shape.size), density)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _mesh_solid(mesh: Mesh, scale: Array, density: float) -> Inertia:
    """Return the mass properties of the volume within a closed mesh, by the tetrahedra from its centre."""
    centre = (scale * mesh.corners[mesh.triangles]).mean(axis=(0, 1))
    corners = (scale * mesh.corners)[mesh.triangles] - centre
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    volume = float(volumes.sum())
    if np.linalg.norm(areas.sum(axis=0)) > _OPEN * np.linalg.norm(areas, axis=1).sum() or volume == 0.0:
        raise ValueError("the mesh is not closed and has no volume")
    sums = corners.sum(axis=1)
    com = np.einsum("t,ti->i", volumes, sums) / (4.0 * volume)
    # Second moments of a tetrahedron with one corner in the origin: V/20 (Σ c cᵀ + s sᵀ).
    second = np.einsum("t,tki,tkj->ij", volumes, corners, corners) + np.einsum("t,ti,tj->ij", volumes, sums, sums)
    second = second / (20.0 * volume) - np.outer(com, com)
    mass = density * abs(volume)
    return Inertia(mass, centre + com, mass * (np.trace(second) * np.eye(3) - second))

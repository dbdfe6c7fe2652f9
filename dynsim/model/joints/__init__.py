"""Kinds of joints, one module each: rows, coordinates, units, and the motion of the body in the joint's frame.

A module defines ``ROWS``, its rows by kind (:attr:`dynsim.model.description.Link.kind`), and for a joint with several
rows a function that makes its links. All modules of this package are loaded. In the kernels, the motion is a branch of
:func:`dynsim.dynamics.tree.sweep.forward_sweep` (one angle, one distance) or of
:func:`dynsim.dynamics.tree.joints.row_motion` (everything else).
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.record.scene import JointKind

Array = NDArray[np.float64]
ANGLE = ("rad", "rad/s", "rad/s²", "N m")
DISTANCE = ("m", "m/s", "m/s²", "N")


@dataclass(frozen=True)
class Row:
    """One row of a joint, which belongs to one rate.

    Attributes
    ----------
    code : int
        Number of the kind in the kernels (dynsim.dynamics.tables).
    units : tuple of str
        Units of position, velocity, acceleration and force.
    neutral : tuple of float
        Coordinates of the whole joint at which its two frames coincide; empty for later rows.
    names : tuple of str
        Names of the joint's coordinates, if there are several.
    offset : int
        Index of the row's coordinates within the coordinates of the joint.
    own_position : bool
        Whether the first of these coordinates is the integral of the row's rate, so that a motor can control it
        although the joint has several rows.
    drawn : str or None
        Kind of joint, in the scene of a record, that moves the row's body in the same way; None: not available, and
        records of robots with such a joint have no scene.
    motion : callable
        Function of a :class:`~dynsim.model.description.Link` and coordinates (k, T); returns rotation (3, 3, T) and
        origin (3, T) of the body in the joint's frame.
    """

    code: int
    units: tuple[str, str, str, str]
    neutral: tuple[float, ...] = (0.0,)
    names: tuple[str, ...] = ()
    offset: int = 0
    own_position: bool = field(default=False, kw_only=True)
    drawn: JointKind | None = field(default=None, kw_only=True)
    motion: Callable[[Any, Array], tuple[Array, Array]] | None = None


@cache
def rows() -> dict[str, Row]:
    """Return the rows of all joints by kind."""
    table: dict[str, Row] = {}
    for info in pkgutil.iter_modules(__path__):
        table.update(importlib.import_module(f"{__name__}.{info.name}").ROWS)
    return table


def turned(axis: Array, angle: Array) -> Array:
    """Return the rotations, (3, 3, T), about a unit axis by angles (T,)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R = unturned(len(angle))
    # Most entries of the matrices are zero for an axis of the frame.
    for part, matrix in ((np.sin(angle), K), (1.0 - np.cos(angle), K @ K)):
        for i, j in np.argwhere(matrix).tolist():
            R[i, j] += part * matrix[i, j]
    return R


def unturned(count: int) -> Array:
    """Return identity rotations, (3, 3, count)."""
    return np.repeat(np.eye(3)[:, :, None], count, axis=2)

"""Compression of time series for pages: quantised, differenced, and split into byte planes.

A column x becomes k = round((x − offset)/scale), 0 ≤ k < 2^b − 1 with b = 16 or 32; the last code stands for values
that are not finite. Differences of k modulo 2^b are stored, the lowest byte of all of them first. ``decode.js`` of the
page decodes them. Also here: meshes as blocks.
"""

from __future__ import annotations

import base64
import gzip
import json
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.draw.geometry.mesh_files import Mesh

# Largest code of a finite value by number of bits; 32 bits are used where half a step of 16 exceeds the allowed error.
_CODES = {16: 2**16 - 2, 32: 2**32 - 2}
_TYPES: dict[int, np.dtype[Any]] = {16: np.dtype("<u2"), 32: np.dtype("<u4")}


class Blocks:
    """Collects blocks; the description of a block goes into the head of the page."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, columns: ArrayLike, error: float = np.inf) -> dict[str, Any]:
        """Add columns, (T,) or (T, …), each to half a step of its range in 16 bits, or 32 where ``error`` is less."""
        data = np.asarray(columns, dtype=np.float64)
        data = data.reshape(len(data), -1) if len(data) else data.reshape(0, 1)
        known = np.isfinite(data)
        low = np.where(known, data, np.inf).min(axis=0, initial=np.inf)
        high = np.where(known, data, -np.inf).max(axis=0, initial=-np.inf)
        some = np.isfinite(low)
        low, span = np.where(some, low, 0.0), np.where(some, high - low, 0.0)
        bits = 16 if 0.5 * span.max(initial=0.0) / _CODES[16] <= error else 32
        scale = span / _CODES[bits]
        with np.errstate(all="ignore"):
            codes = np.rint((np.where(known, data, low) - low) / np.where(scale > 0.0, scale, 1.0))
        kind = _TYPES[bits]
        codes = np.where(known, codes, float(_CODES[bits] + 1)).astype(kind)
        steps = np.diff(codes.T, axis=1, prepend=np.zeros((codes.shape[1], 1), dtype=kind))
        planes = np.ascontiguousarray(steps).view(np.uint8).reshape(-1, bits // 8).T
        content = np.ascontiguousarray(planes).tobytes()
        self._parts.append(content)
        start, self._size = self._size, self._size + len(content)
        header = {"at": start, "rows": len(data), "columns": int(codes.shape[1]), "bits": bits}
        return header | {"offset": low.tolist(), "scale": scale.tolist()}

    def raw(self, data: NDArray[Any]) -> dict[str, Any]:
        """Add an array of whole numbers ≥ 0 as it is (a mesh), little endian: in 16 bits, or 32 if one needs them."""
        bits = 16 if data.max(initial=0) < 2**16 else 32
        content = data.astype(_TYPES[bits]).tobytes()
        self._parts.append(content)
        start, self._size = self._size, self._size + len(content)
        return {"at": start, "count": int(data.size), "bits": bits}

    def packed(self, head: dict[str, Any]) -> str:
        """Head and blocks: the length of the head in 4 bytes, its JSON, the blocks; compressed, in base64."""
        text = json.dumps(head, allow_nan=False, separators=(",", ":"), ensure_ascii=True).encode("ascii")
        content = len(text).to_bytes(4, "little") + text + b"".join(self._parts)
        # No time in it: the same record gives the same page.
        return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")


def packed_mesh(mesh: Mesh, blocks: Blocks) -> dict[str, Any]:
    """A mesh as the page reads it: corners in 16 bits within their box, triangles, and the colours of these."""
    corners, triangles, colours = mesh
    low, high = corners.min(axis=0), corners.max(axis=0)
    step = np.where(high > low, (high - low) / 65535.0, 1.0)
    paint: dict[str, Any] = {}
    if colours is not None:
        # −1 for none: numbers that are none are equal to nothing.
        palette, number = np.unique(np.round(np.nan_to_num(colours, nan=-1.0), 3), axis=0, return_inverse=True)
        paint["palette"] = [None if row[0] < 0.0 else row.tolist() for row in palette]
        paint["paint"] = blocks.raw(number.reshape(-1))
    return paint | {
        "vertices": blocks.raw(np.rint((corners - low) / step)),
        "triangles": blocks.raw(triangles),
        "low": low.tolist(),
        "step": step.tolist(),
    }

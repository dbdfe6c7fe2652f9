"""Positions and Jacobians of body-fixed points, from the poses left by a forward sweep."""

from __future__ import annotations

from dynsim.kernels import arrays as ka
from dynsim.kernels.arrays import ModelArrays, Workspace
from dynsim.kernels.jit import kernel


@kernel
def point_position(ws: Workspace, link, point, out):
    """p_WB + R_WB point: world position of a body-fixed point, after ``forward_sweep``. out: (3,) [m]."""
    if link < 0:
        out[0], out[1], out[2] = point[0], point[1], point[2]
        return
    links = ws.links
    x, y, z = point[0], point[1], point[2]
    out[0] = links[link, ka.P] + links[link, ka.R] * x + links[link, ka.R + 1] * y + links[link, ka.R + 2] * z
    out[1] = links[link, ka.P + 1] + links[link, ka.R + 3] * x + links[link, ka.R + 4] * y + links[link, ka.R + 5] * z
    out[2] = links[link, ka.P + 2] + links[link, ka.R + 6] * x + links[link, ka.R + 7] * y + links[link, ka.R + 8] * z


@kernel
def point_jacobian(model: ModelArrays, ws: Workspace, link, position, out):
    """Jacobian of the world velocity of the point at ``position`` on ``link``; out: (3, n) [m/rad or 1].

    Column j is S_lin + S_ang × position for every joint j between the world and the link, zero elsewhere.
    """
    out[:] = 0.0
    links = ws.links
    x, y, z = position[0], position[1], position[2]
    j = link
    while j >= 0:
        out[0, j] = links[j, ka.S + 3] + links[j, ka.S + 1] * z - links[j, ka.S + 2] * y
        out[1, j] = links[j, ka.S + 4] + links[j, ka.S + 2] * x - links[j, ka.S] * z
        out[2, j] = links[j, ka.S + 5] + links[j, ka.S] * y - links[j, ka.S + 1] * x
        j = model.tree[j, ka.PARENT]

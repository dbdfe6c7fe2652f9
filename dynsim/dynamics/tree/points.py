"""Positions and Jacobians of body-fixed points, from the poses left by a forward sweep."""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import point_velocity, rotation, six, transform, vector
from dynsim.jit.kernel import kernel


@kernel
def point_position(ws: Workspace, link, point, out):
    """p_WB + R_WB point: world position of a body-fixed point, after ``forward_sweep``. out: (3,) [m]."""
    if link < 0:
        out[0], out[1], out[2] = point[0], point[1], point[2]
        return
    out[0], out[1], out[2] = transform(vector(ws.links, link, ka.P), rotation(ws.links, link, ka.R), point)


@kernel
def point_jacobian(model: ModelArrays, ws: Workspace, link, position, out):
    """Jacobian of the world velocity of the point at ``position`` on ``link``; out: (3, n) [m/rad or 1].

    Column j is S_lin + S_ang × position for every joint j between the world and the link, zero elsewhere.
    """
    out[:] = 0.0
    j = link
    while j >= 0:
        out[0, j], out[1, j], out[2, j] = point_velocity(six(ws.links, j, ka.S), position)
        j = model.tree[j, ka.PARENT]

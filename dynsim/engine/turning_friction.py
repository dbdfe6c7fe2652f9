"""How fast friction turns slow slip into the direction in which forces balance: why explicit steps are short.

A contact slips at speed v along t, e is across t on the surface, and friction is −μ f t. Slip across t at speed w turns
t by w/v towards e; below the limit of slow slip s, by w/s (dynsim.dynamics.contact.unilateral.slide_direction). So for
all contacts that slide

    dw/dt = −A w,    A_ij = e_i J_i M⁻¹ (1 − F (R M⁻¹ F)⁻¹ R M⁻¹) J_jᵀ e_jᵀ (μ f)_j / max(v_j, s)

with all closed rows R v̇ = const. and the directions F of their forces: n − μ t of a point that slides. The shortest
time constant τ is one over the spectral radius of A, and an explicit method is stable up to about 3 τ; an implicit one
is at any step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.derivative import derivative
from dynsim.dynamics.state import block
from dynsim.engine.force_indeterminacy import contact_point
from dynsim.engine.prepare import Prepared
from dynsim.integrators import run as ki

Array = NDArray[np.float64]

# Steps of an explicit method at the limit of stability, in time constants: 3.3 by DOPRI5 [Hairer and Wanner], shorter
# after a rejected step, longer before one.
LEAST, MOST = 1.0, 5.0


def held_up(prepared: Prepared) -> str:
    """A clause about the contact whose friction turns so fast that explicit steps have to be this short, or ""."""
    run, unilateral = prepared.run, prepared.system.unilateral
    step = float(run.clock[ki.STEP])
    if run.method != ki.DOPRI5 or unilateral is None or not prepared.contacts or not np.isfinite(run.y).all():
        return ""
    turning = fastest(prepared)
    if turning is None or not LEAST < step / turning.within < MOST:
        return ""
    return (
        f"steps are as short as {step:.1e} s because {turning.contact} slips at {turning.speed:.3g} m/s and its "
        f"friction changes direction within {turning.within:.3g} s; integrator.method: radau5 follows that with longer "
        "steps"
    )


@dataclass(frozen=True)
class Turning:
    """The contact whose friction turns fastest by itself, its slip [m/s], and τ of all together [s]."""

    contact: str
    speed: float
    within: float


def fastest(prepared: Prepared) -> Turning | None:
    """The fastest turning of friction at the state of the run; None if none turns."""
    system, run, ws, model = prepared.system, prepared.run, prepared.workspace, prepared.model
    unilateral = system.unilateral
    assert unilateral is not None
    q = run.y[block(run.layout, "q")]
    derivative(system, float(run.clock[ki.TIME]), run.y, ws, np.zeros_like(run.y))
    identity = np.eye(model.n)
    still = [identity[table[ku.STOP_JOINT]][None] for table in unilateral.stop_table if table[ku.STOP_CLOSED] == 1]
    still += [identity[table[ku.DRY_JOINT]][None] for table in unilateral.dry_table if table[ku.DRY_HOLDS] == 1]
    rows, forces = [model.coupling_rows, *still], [model.coupling_rows, *still]
    sliding: list[tuple[int, Array, float, float]] = []
    for k, contact in enumerate(prepared.contacts):
        mode, state = int(ws.active[k, ka.MODE]), ws.contacts[k]
        if mode == ka.OPEN:
            continue
        normal, point = contact_point(model, contact, q)
        if mode == ka.STICKING:
            rows.append(point)
            forces.append(point)
            continue
        along, mu = state[ka.TANGENT : ka.TANGENT + 3], float(ws.rows[ws.active[k, ka.FIRST_ROW], ka.ROW_MU])
        rows.append((normal @ point)[None])
        forces.append(((normal - mu * along) @ point)[None])
        across = np.cross(normal, along) @ point
        speed = float(np.linalg.norm(state[ka.SLIP_VELOCITY : ka.SLIP_VELOCITY + 3]))
        sliding.append((k, across, mu * float(state[ka.NORMAL_FORCE]), speed))
    R, F = np.vstack(rows), np.vstack(forces)
    inverse = np.linalg.inv(model.mass_matrix(q) + np.diag(model.armature))
    left = inverse - inverse @ F.T @ np.linalg.pinv(R @ inverse @ F.T, rcond=1e-9) @ R @ inverse
    slow = float(unilateral.number[ku.SLOW])
    E = np.array([across for _, across, _, _ in sliding]).reshape(-1, model.n)
    A = E @ left @ E.T * np.array([friction / max(speed, slow) for _, _, friction, speed in sliding])
    if not np.isfinite(A).all() or not A.any():
        return None
    k, _, _, speed = sliding[int(A.diagonal().argmax())]
    return Turning(prepared.contacts[k].name, speed, 1.0 / float(np.abs(np.linalg.eigvals(A)).max()))

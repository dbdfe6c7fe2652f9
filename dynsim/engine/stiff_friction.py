"""How fast friction changes with slip: why explicit steps are short.

Friction f(v) of slip v on the surface damps slip by dv/dt = −A v, A_ij = E_i W E_jᵀ D_j, D = −∂f/∂v, with the rows
E of slip and the mobility W = M⁻¹ (1 − F (R M⁻¹ F)⁻¹ R M⁻¹) that closed rows R v̇ = const. leave; their forces have the
directions F, with friction. Real contacts that slip along t have friction −μ f t, which slip across t turns: E is the
row across t, and D = μ f/max(|v|, s), with the limit s of slow slip (dynsim.dynamics.contact.unilateral.
slide_direction). Glued contacts have friction −μ |f| v/w, w² = |v|² + v_s²: E are both rows along the surface, and
D = μ |f|/w (1 − v vᵀ/w²). The shortest time constant τ is one over the spectral radius of A. An explicit method is
stable up to about 3 τ, and an implicit one at any step.
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
    """A clause about the contact whose friction changes so fast that explicit steps have to be this short, or ""."""
    run = prepared.run
    step = float(run.clock[ki.STEP])
    if run.method != ki.DOPRI5 or not prepared.contacts or not np.isfinite(run.y).all():
        return ""
    changing = fastest(prepared)
    if changing is None or not LEAST < step / changing.within < MOST:
        return ""
    return (
        f"steps are as short as {step:.1e} s because {changing.contact} slips at {changing.speed:.3g} m/s and its "
        f"friction changes within {changing.within:.3g} s; integrator.method: radau5 follows that with longer steps"
    )


@dataclass(frozen=True)
class Changing:
    """The contact whose friction changes fastest by itself, its slip [m/s], and τ of all together [s]."""

    contact: str
    speed: float
    within: float


def fastest(prepared: Prepared) -> Changing | None:
    """The fastest change of friction at the state of the run; None if none changes."""
    system, run, ws, model = prepared.system, prepared.run, prepared.workspace, prepared.model
    unilateral = system.unilateral
    q = run.y[block(run.layout, "q")]
    derivative(system, float(run.clock[ki.TIME]), run.y, ws, np.zeros_like(run.y))
    rows, forces = [model.coupling_rows], [model.coupling_rows]
    if unilateral is not None:
        identity = np.eye(model.n)
        still = [identity[table[ku.STOP_JOINT]][None] for table in unilateral.stop_table if table[ku.STOP_CLOSED] == 1]
        still += [identity[table[ku.DRY_JOINT]][None] for table in unilateral.dry_table if table[ku.DRY_HOLDS] == 1]
        rows, forces = [*rows, *still], [*forces, *still]
    slides: list[tuple[int, Array, Array]] = []
    for k, contact in enumerate(prepared.contacts):
        mode = int(ws.active[k, ka.MODE])
        if unilateral is not None and mode == ka.OPEN:
            continue
        normal, point = contact_point(model, contact, q)
        if unilateral is not None and mode == ka.STICKING:
            rows.append(point)
            forces.append(point)
            continue
        along, tangents, damping = _friction(prepared, k, normal)
        rows.append((normal @ point)[None])
        forces.append(((normal - along) @ point)[None])
        slides.append((k, tangents @ point, damping))
    if not slides:
        return None
    R, F = np.vstack(rows), np.vstack(forces)
    inverse = np.linalg.inv(model.mass_matrix(q) + np.diag(model.armature))
    left = inverse - inverse @ F.T @ np.linalg.pinv(R @ inverse @ F.T, rcond=1e-9) @ R @ inverse
    E, DE = np.vstack([row for _, row, _ in slides]), np.vstack([damping @ row for _, row, damping in slides])
    A = E @ left @ DE.T
    if not np.isfinite(A).all() or not A.any():
        return None
    own = [float(np.trace(row @ left @ row.T @ damping)) for _, row, damping in slides]
    k = slides[int(np.argmax(own))][0]
    speed = float(np.linalg.norm(_slip(prepared, k)))
    return Changing(prepared.contacts[k].name, speed, 1.0 / float(np.abs(np.linalg.eigvals(A)).max()))


def _slip(prepared: Prepared, k: int) -> Array:
    return np.asarray(prepared.workspace.contacts[k, ka.SLIP_VELOCITY : ka.SLIP_VELOCITY + 3])


def _friction(prepared: Prepared, k: int, normal: Array) -> tuple[Array, Array, Array]:
    """Friction of contact k that slips: minus its force per normal force, (3,); the rows of E on the surface; and D."""
    ws, unilateral, contact = prepared.workspace, prepared.system.unilateral, prepared.contacts[k]
    slip = _slip(prepared, k)
    pressed = float(ws.contacts[k, ka.NORMAL_FORCE])
    if unilateral is not None:
        along = ws.contacts[k, ka.TANGENT : ka.TANGENT + 3]
        mu = float(ws.rows[ws.active[k, ka.FIRST_ROW], ka.ROW_MU])
        speed = max(float(np.linalg.norm(slip)), float(unilateral.number[ku.SLOW]))
        return mu * along, np.cross(normal, along)[None], np.array([[mu * pressed / speed]])
    smooth = float(np.hypot(np.linalg.norm(slip), contact.slip_smoothing))
    size = contact.friction * (pressed if contact.pulling_friction == "signed" else abs(pressed))
    tangents = np.linalg.svd(normal[None])[2][1:]
    across = tangents @ slip / smooth
    damping = size / smooth * (np.eye(2) - np.outer(across, across))
    return contact.friction * np.sign(size * pressed) * slip / smooth, tangents, damping

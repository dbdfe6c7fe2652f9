"""Choice of the integration method (``method: auto``) from the fastest rate of the system at its start.

DOPRI5 is stable only while h |λ| is below about 3.3 (step h, eigenvalue λ), however smooth the motion; steps of RADAU5
are limited by its accuracy alone. The rate is the spectral radius of that part of ∂(v, v̇, di/dt)/∂(q, v, i) which
drives and losses give, linearised at the start, under the constraints that hold there:

    v̇ = W (∂τ/∂(q, v, i) − diag(D))       W = M⁻¹ − M⁻¹ Aᵀ (A M⁻¹ Aᵀ)⁺ A M⁻¹,  A: contacts and couplings

Gravity and velocity forces are as slow as the motion itself. Where that part is zero, nothing damps the errors of the
steps, and the energy drifts: of one to six links that tumble for ten seconds by up to 18 rtol (DOPRI5) and 0.9 rtol
(RADAU5). A share of the tolerance, 0.03 at rtol 1e-6 and 0.1 at 3e-8 and below, brings DOPRI5 to 0.7 and 5 rtol, in 1.0
to 1.7 times its time at the tolerance itself. RADAU5 would need 3 to 4 times that at 1e-10, since its error estimate is
of third order. Friction of contacts turns fast if slip is slow: then the implicit method is taken. Nothing is timed:
the choice is the same on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dynsim.compile.control import JointControl
from dynsim.compile.model import Model
from dynsim.compile.posture import gaps_and_rates
from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.dc import dc_block
from dynsim.dynamics.drive.servo import servo_block
from dynsim.model.description import Array, Contact
from dynsim.scenario.schema import Integrator

AUTO = "auto"
PACE = 0.02
"""Smallest step that the accuracy of an arm's motion is assumed to need [s]."""
TOUCHING = 1e-6
"""A contact with a gap below this is closed at the start [m]."""
SMALL = 36
"""Joints up to which Jacobians of RADAU5 cost less than half of its steps."""
UNDAMPED, UNDAMPED_RTOL, LEAST_RTOL = (0.03, 0.1), 3e-9, 1e-12
"""Where nothing damps the errors of steps, the tolerance of steps is this one, but within these shares of rtol; shares
are taken down to the last number."""

DENSE = 300
"""Size of matrices up to which all eigenvalues are found at once; of larger ones only the largest."""


class Choice(NamedTuple):
    """A method, and why."""

    method: str
    reason: str
    sharper: float = 1.0
    """Tolerances of the steps as a share of the scenario's."""


def choose(
    options: Integrator, model: Model, contacts: Sequence[Contact], control: JointControl, drives: ka.DriveArrays
) -> Choice:
    """The method that ``integrator.method`` names, or for ``auto`` the one that suits the system."""
    if options.method != AUTO:
        return Choice(options.method, "named in the scenario")
    pace = min(PACE, control.sample_time or PACE, options.step_max_s or PACE)
    rate = fastest_rate(model, contacts, drives)
    reason = f"fastest rate {rate:.3g} 1/s, steps of {1e3 * pace:.3g} ms"
    if rate * pace > worth_it(model.n):
        return Choice("radau5", f"{reason}: an implicit method is not held by it")
    if rate == 0.0:
        sharper = min(max(UNDAMPED_RTOL / options.rtol, UNDAMPED[0]), UNDAMPED[1])
        sharper = sharper if options.rtol * sharper >= LEAST_RTOL else 1.0
        reason = f"no drive and no loss damps errors: {sharper:.2g} of the tolerances keeps the energy"
        if model.n <= SMALL and any(contact.friction_at_rest > 0.0 for contact in contacts):
            return Choice("radau5", f"{reason}; the implicit method follows friction of slow slip", sharper)
        return Choice("dopri5", reason, sharper)
    return Choice("dopri5", f"{reason}: an explicit method takes them")


def worth_it(n: int) -> float:
    """h |λ| above which a step of RADAU5 costs less than the steps of DOPRI5 that it replaces.

    Those take six right-hand sides for each 3.3/|λ|. It takes about twenty, and at every eleventh step a Jacobian of
    2 n columns and factors of n × n matrices: n³ multiplications in the time of 100 n right-hand sides of a link.
    """
    return (20.0 + (2.0 * n + 0.03 * n**2) / 11.0) * 3.3 / 6.0


class DriveSlopes(NamedTuple):
    """Derivatives of joint torques τ and current rates di/dt by q, v and i, at rest.

    Shapes: torques (n, n), (n, n) and (n, circuits); rates of currents (circuits, n), (circuits, n) and (circuits,
    circuits). Commands that are held do not follow the state.
    """

    torque_q: Array
    torque_v: Array
    torque_i: Array
    rate_q: Array
    rate_v: Array
    rate_i: Array


def drive_slopes(model: Model, drives: ka.DriveArrays) -> DriveSlopes:
    """Return the derivatives of what drives and the damping of joints do."""
    n, circuits = model.n, int(model.robot.circuits)
    torque_q, torque_v, torque_i = np.zeros((n, n)), -np.diag(model.damping), np.zeros((n, circuits))
    rate_q, rate_v, rate_i = np.zeros((circuits, n)), np.zeros((circuits, n)), np.zeros((circuits, circuits))
    for a in range(len(drives.table)):
        kind, j, sampled = drives.table[a, ka.DRIVE_KIND], drives.table[a, ka.DRIVEN], drives.table[a, ka.SAMPLED] != 0
        if kind == ka.DC_MOTOR:
            e, block = drives.table[a, ka.CIRCUIT], dc_block(drives.motor, a, 0.0 if sampled else 1.0)
            torque_q[j, j], torque_v[j, j], torque_i[j, e] = block[0], torque_v[j, j] + block[1], block[2]
            rate_q[e, j], rate_v[e, j], rate_i[e, e] = block[3:]
        elif kind == ka.POSITION_SERVO:
            by_q, by_v = servo_block(drives.motor, a, drives.table[a, ka.SERVO_MODE], sampled, 0.0, 0.0)
            torque_q[j, j], torque_v[j, j] = by_q, torque_v[j, j] + by_v
    return DriveSlopes(torque_q, torque_v, torque_i, rate_q, rate_v, rate_i)


def fastest_rate(model: Model, contacts: Sequence[Contact], drives: ka.DriveArrays) -> float:
    """Largest |λ| of drives and losses at the start, at rest [1/s]."""
    n, q = model.n, model.robot.initial
    torque_q, torque_v, torque_i, rate_q, rate_v, rate_i = drive_slopes(model, drives)
    if not (torque_q.any() or torque_v.any() or torque_i.any()):
        return 0.0
    mobility = np.linalg.inv(model.mass_matrix(q) + np.diag(model.armature))
    rows = _held(model, contacts, q)
    if len(rows):
        through = mobility @ rows.T
        mobility = mobility - through @ np.linalg.pinv(rows @ through) @ through.T
    still = np.zeros((n, len(rate_i)))
    return _spectral_radius(
        np.block(
            [
                [np.zeros((n, n)), np.eye(n), still],
                [mobility @ torque_q, mobility @ torque_v, mobility @ torque_i],
                [rate_q, rate_v, rate_i],
            ]
        )
    )


def _spectral_radius(A: Array) -> float:
    if len(A) <= DENSE:
        return float(np.abs(np.linalg.eigvals(A)).max())
    from scipy.sparse.linalg import eigs  # here, because short chains do without

    start = np.random.default_rng(0).normal(size=len(A))
    return float(np.abs(eigs(A, k=1, v0=start, tol=1e-2, return_eigenvectors=False)[0]))


def _held(model: Model, contacts: Sequence[Contact], q: Array) -> Array:
    """Rows of what does not move at the start, (p, n): contacts that touch, along their normals, and couplings."""
    gaps, rates = gaps_and_rates(model, contacts, q)
    return np.vstack([rates[np.abs(gaps) < TOUCHING], model.coupling_rows])

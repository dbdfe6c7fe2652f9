"""Checks whether a system can be integrated: joints that move no inertia, and stability of sampled control loops.

A loop is stable at a posture if its spectral radius over a period is at most 1. The open loop is linear in small
deviations δq, v and currents i, with constant commands u:

    M v̇ = K_m i − D v,    L di/dt = u − R i − K_m v,    u = −k_p δq̂ − k_d v̂ at each tick

for the motions that couplings and active contacts allow. It is integrated exactly over a period. Positions q̂ and rates
v̂ are the true values at the tick, or encoder measurements with their delay. Gravity and velocity products are
neglected, so a robot that slowly falls out of a posture does not count as an unstable loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.touching import gap_at
from dynsim.dynamics import tables as ka
from dynsim.engine.force_indeterminacy import touching_rows
from dynsim.engine.prepare import drive_slopes
from dynsim.model.description import Array, Contact
from dynsim.record import Record
from dynsim.scenario import Scenario, build
from dynsim.scenario.schema import Encoders

if TYPE_CHECKING:
    from dynsim.engine.prepare import Prepared

# Maximum number of joints for which the loop is examined: its matrices have three rows for each joint.
LARGE = 100
# Maximum number of rows of a loop with delayed encoder samples: the same as for LARGE joints.
LATE = 3 * LARGE
# Deviations count as growing above this rate [1/s] and above this growth per period. Free motions have a double
# eigenvalue 1 with rounding errors of 1e-8.
GROWTH, ROUNDING = 1.0, 1e-6
# Periods of encoders and of the controller must be multiples of each other to this relative accuracy.
WHOLE = 1e-9
# Number of shorter periods tried for a message, each half of the previous one.
HALVINGS = 8
# Instability is reported as the reason for a stop if the logarithm of the growth of deviations reaches this value, a
# factor of 20.
GROWN = 3.0
# Number of postures of a record in which a sampled loop is examined.
POSTURES = 10
# Postures that differ by less than this have nearly the same growth [rad or m].
NEAR_POSTURE = 0.02


@dataclass(frozen=True)
class Growth:
    """Growth of deviations in a sampled control loop.

    Attributes
    ----------
    radius : float
        Spectral radius per ``period``.
    period : float
        Period [s].
    motor : int
        Index of the motor whose command contributes most.
    """

    radius: float
    period: float
    motor: int

    @property
    def rate(self) -> float:
        """Growth rate [1/s], negative if deviations decay."""
        return math.log(max(self.radius, 1e-300)) / self.period

    @property
    def unstable(self) -> bool:
        """True if deviations grow faster than rounding errors explain."""
        return self.radius > 1.0 + ROUNDING and self.rate > GROWTH


@dataclass(frozen=True)
class HeldLoop:
    """Linear open loop dx/dt = A x + B u with states x = (δq, v, i) and commands u.

    δq and v are the coordinates of the motions that constraints leave free.

    Attributes
    ----------
    A : (s, s) ndarray
        State matrix.
    B : (s, na) ndarray
        Input matrix.
    position, rate : (na, s) ndarray
        Positions and rates of the motors' joints as functions of the state.
    gain : (na, 2) ndarray
        k_p and k_d of the sampled commands; 0 for commands that do not depend on the state.
    """

    A: Array
    B: Array
    position: Array
    rate: Array
    gain: Array

    def growth(self, period: float) -> Growth:
        """Return the growth with exact positions and rates at the ticks."""
        law = -self.gain[:, :1] * self.position - self.gain[:, 1:] * self.rate
        advance, input_ = self._over(period)
        return _growth(advance + input_ @ law, law, period)

    def growth_by_encoders(self, period: float, encoders: Encoders) -> Growth | None:
        """Return the growth with encoder positions and their differences.

        Returns None if neither period is a multiple of the other, or if a long delay makes the loop larger than
        :data:`LATE` rows.
        """
        between = period if encoders.rate_hz is None else 1.0 / encoders.rate_hz
        ratio = max(period, between) / min(period, between)
        if abs(ratio - round(ratio)) > WHOLE * ratio:
            return None
        step, steps = min(period, between), round(ratio)
        size, na = self.B.shape
        kept = math.ceil(encoders.delay_s / between + 1.0 - WHOLE) + 2
        # The vector contains the states, the commands, and the samples, starting with the last one.
        whole = size + na + kept * na
        if whole > LATE:
            return None
        samples = size + na
        advance, input_ = self._over(step)
        product = np.eye(whole)
        for k in range(steps):
            if between <= period or k == 0:
                taken = np.eye(whole)
                taken[samples + na :, samples:] = np.eye((kept - 1) * na, kept * na)
                taken[samples : samples + na] = 0.0
                taken[samples : samples + na, :size] = self.position
                product = taken @ product
            if period <= between or k == 0:
                since = k * step if between > period else 0.0  # time since the last sample
                late = max(0, math.ceil((encoders.delay_s - since) / between - WHOLE))
                commanded = np.eye(whole)
                commanded[size : size + na] = 0.0
                last, before = (samples + (late + j) * na for j in range(2))
                commanded[size : size + na, last : last + na] -= np.diag(self.gain[:, 0] + self.gain[:, 1] / between)
                commanded[size : size + na, before : before + na] += np.diag(self.gain[:, 1] / between)
                product = commanded @ product
            moved = np.eye(whole)
            moved[:size, :size], moved[:size, size : size + na] = advance, input_
            product = moved @ product
        commands = np.zeros((na, whole))
        commands[:, size : size + na] = np.eye(na)
        return _growth(product, commands, steps * step)

    def _over(self, period: float) -> tuple[Array, Array]:
        """Return the matrices of x(t + period) = advance x + input u."""
        from scipy.linalg import expm  # imported here because it loads slowly and most runs have no sampled loop

        size, na = self.B.shape
        both = expm(np.block([[self.A, self.B], [np.zeros((na, size + na))]]) * period)
        return both[:size, :size], both[:size, size:]


def _growth(step: Array, commands: Array, period: float) -> Growth:
    values, vectors = np.linalg.eig(step)
    worst = int(np.abs(values).argmax())
    return Growth(float(np.abs(values[worst])), period, int(np.abs(commands @ vectors[:, worst]).argmax()))


def held_loop(model: Model, drives: ka.DriveArrays, q: Array, rows: Array) -> HeldLoop:
    """Return the loop at coordinates q (nq,), whose rates v satisfy ``rows`` v = 0, (r, n).

    Smoothed gear friction is represented by its slope at rest.
    """
    from scipy.linalg import null_space  # for the same reason as in HeldLoop._over

    free = null_space(rows) if len(rows) else np.eye(model.n)
    torque_q, torque_v, torque_i, rate_q, rate_v, rate_i = drive_slopes(model, drives)
    f, na, circuits = free.shape[1], len(drives.table), len(rate_i)
    size = 2 * f + circuits
    inertia = free.T @ (model.mass_matrix(q) + np.diag(model.armature)) @ free
    A, B = np.zeros((size, size)), np.zeros((size, na))
    A[:f, f : 2 * f] = np.eye(f)
    forces = np.hstack([free.T @ torque_q @ free, free.T @ torque_v @ free, free.T @ torque_i])
    A[f : 2 * f] = np.linalg.solve(inertia, forces)
    A[2 * f :] = np.hstack([rate_q @ free, rate_v @ free, rate_i])
    position, rate = np.zeros((na, size)), np.zeros((na, size))
    pushed, gain = np.zeros((f, na)), np.zeros((na, 2))
    for a, (table, motor) in enumerate(zip(drives.table, drives.motor, strict=True)):
        joint, k_m = free[table[ka.DRIVEN]], motor[ka.K_M]
        position[a, :f], rate[a, f : 2 * f] = joint, joint
        if table[ka.DRIVE_KIND] == ka.DC_MOTOR:
            B[2 * f + table[ka.CIRCUIT], a] = 1.0 / motor[ka.INDUCTANCE]
            own = motor[ka.K_P], motor[ka.K_D]
        elif table[ka.DRIVE_KIND] == ka.POSITION_SERVO and table[ka.SERVO_MODE] != ka.OFF:
            pushed[:, a] = k_m / motor[ka.RESISTANCE] * joint
            velocity = table[ka.SERVO_MODE] == ka.VELOCITY_MODE
            own = (0.0, motor[ka.K_V] - k_m) if velocity else (motor[ka.K_P], motor[ka.K_D])
        else:
            continue
        # Continuous commands are part of A; commands set by the caller do not depend on the state.
        if table[ka.SAMPLED] == ka.AT_TICKS:
            gain[a] = own
    B[f : 2 * f] = np.linalg.solve(inertia, pushed)
    return HeldLoop(A, B, position, rate, gain)


def held_rows(model: Model, contacts: Sequence[Contact], real: bool, q: Array) -> Array:
    """Return the rows of couplings and active contacts at q and at rest.

    Under the bilateral law all contacts are active, otherwise only the closed ones.
    """
    rows = [model.coupling_rows]
    for contact in contacts:
        if contact.stiffness > 0.0 or (real and abs(gap_at(model, contact, q)) > build.START_TOLERANCE):
            continue
        rows.append(touching_rows(model, contact, q, real and contact.friction > 0.0))
    return np.vstack(rows)


def loop_growth(scenario: Scenario, prepared: Prepared, q: Array, period: float) -> Growth | None:
    """Return the growth of the sampled loop at coordinates q (nq,), or None if the loop is not examined."""
    model, drives = prepared.model, prepared.system.drives
    if model.n > LARGE or not len(drives.table) or not np.isfinite(q).all():
        return None
    rows = held_rows(model, prepared.contacts, prepared.system.unilateral is not None, q)
    try:
        loop = held_loop(model, drives, q, rows)
    except np.linalg.LinAlgError:  # a joint that moves no inertia has a separate message
        return None
    if not loop.A.shape[0] or not (np.isfinite(loop.A).all() and loop.gain.any()):
        return None
    encoders = None if scenario.config.sensors is None else scenario.config.sensors.encoders
    return loop.growth(period) if encoders is None else loop.growth_by_encoders(period, encoders)


def unstable_loop(scenario: Scenario, prepared: Prepared, q: Array | None = None) -> tuple[str, Growth] | None:
    """Return a warning about a sampled loop that is unstable at coordinates q (default: the start), and its growth.

    Returns None if the loop is stable, if there is no sampled controller, or for more than :data:`LARGE` joints.
    """
    period = prepared.control.sample_time
    if period is None:
        return None
    at = prepared.model.robot.initial if q is None else q
    growth = loop_growth(scenario, prepared, at, period)
    if growth is None or not growth.unstable:
        return None
    remedy = "use smaller gains"
    for halved in range(1, HALVINGS + 1):
        shorter = loop_growth(scenario, prepared, at, period / 2**halved)
        if shorter is not None and not shorter.unstable:
            remedy = f"use {period / 2**halved:.3g} s, which is stable, or smaller gains"
            break
    table, motor = prepared.system.drives.table[growth.motor], prepared.system.drives.motor[growth.motor]
    gains = f"k_p = {motor[ka.K_P]:.4g} V/rad, k_d = {motor[ka.K_D]:.4g} V s/rad"
    if table[ka.DRIVE_KIND] == ka.POSITION_SERVO and table[ka.SERVO_MODE] == ka.VELOCITY_MODE:
        gains = f"k_v = {motor[ka.K_V]:.4g} V s/rad"
    return (
        f"controller.sample_time_s = {period:g} s: the sampled loop is unstable in the "
        f"{'start posture' if q is None else 'posture reached'}: deviations grow by a factor of "
        f"{math.exp(growth.rate * period):.4g} per period "
        f"(most at {prepared.model.robot.motors[growth.motor].joint}, {gains}); {remedy}"
    ), growth


def unstable_later(scenario: Scenario, prepared: Prepared, record: Record) -> str:
    """Return the warning about a loop that is unstable in later postures long enough for deviations to grow by e³.

    Postures of the record are examined at equal intervals. The result is empty if the loop is never unstable, or only
    briefly.
    """
    period, time = prepared.control.sample_time, record.time
    if period is None or len(record) < 2:
        return ""
    grown, first, before, at, growth = 0.0, -1, 0, np.full(prepared.model.nq, np.inf), None
    for k in np.unique(np.linspace(0.0, len(record) - 1, POSTURES + 1).astype(int)).tolist()[1:]:
        if not np.abs(record["q"][k] - at).max() < NEAR_POSTURE:
            at = record["q"][k]
            growth = loop_growth(scenario, prepared, at, period)
        if growth is None or not growth.unstable:
            grown, first = 0.0, -1
        else:
            first = k if first < 0 else first
            grown += growth.rate * float(time[k] - time[before])
            if grown >= GROWN and (verdict := unstable_loop(scenario, prepared, record["q"][first])) is not None:
                return f"{verdict[0]}; since t = {time[first]:.3g} s deviations may have grown by a factor of 20"
        before = k
    return ""


def unstable_stop(scenario: Scenario, prepared: Prepared, q: Array, v: Array, elapsed: float) -> str:
    """Return the warning about a loop whose growth explains a stop after ``elapsed`` [s], or an empty string.

    This requires that deviations had time to grow by e³, and that the kinetic energy is positive or not finite.
    """
    for at in (None, q):
        verdict = unstable_loop(scenario, prepared, at)
        if verdict is None or verdict[1].rate * elapsed < GROWN:
            continue
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return verdict[0]
        if prepared.model.kinetic_energy(q, v) > 0.0:
            # Contacts may just have stopped the motion, so its energy is not conclusive.
            growth = verdict[1].rate * elapsed / math.log(10.0)
            return f"{verdict[0]}; until then, deviations could grow by a factor of 1e{growth:.0f}"
    return ""

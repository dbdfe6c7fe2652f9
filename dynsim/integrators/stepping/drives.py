"""The drives within a step of time stepping: implicit by linear blocks, with limits decided at x_θ.

A law with limits is linear on each of its segments: unlimited, ±U or ±I. Choosing the segment from the state at the
start of the step would be explicit, and a stiff loop would oscillate between its limits. So each drive starts from its
last segment, and the step is repeated if the resulting state x_θ is on another one.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System
from dynsim.dynamics.drive.law import drive, drive_on_segments, segment_of
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.run import Run
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import place_joints
from dynsim.jit.kernel import internal_kernel

# Most repetitions of a step for the segments of its drives; after ALL_AT_ONCE of them one drive changes at a time, as
# changes of several at once may undo each other.
MOST_TRIES, ALL_AT_ONCE = 16, 4


@internal_kernel
def eliminate_currents(system: System, ws: Workspace, run: Run):
    """What is left of drives and damping: torques into APPLIED, the implicit share into the ARMATURE of ``s.body``.

    The joints must be at (q + h θ v, v), and what is applied without drives in APPLIED. With Δ = v' − v, i' − i is
    a + c Δ, and the torque of x_θ is τ + ∂τ/∂i θ a + (∂τ/∂q h θ² + ∂τ/∂v θ + ∂τ/∂i θ c) Δ.
    """
    s, h, body, joints, motors = run.stepping, run.clock[ki.STEP], system.model.body, ws.joints, ws.motors
    theta, drives = s.theta, system.drives
    drive_on_segments(
        drives, system.reference, run.clock[ki.TIME] + theta * h, run.y, system.layout, s.segment, ws, s.linear
    )
    for i in range(joints.shape[0]):
        damping = body[i, ka.DAMPING] + body[i, ka.GEAR_DAMPING]
        s.body[i, ka.ARMATURE] = body[i, ka.ARMATURE] + h * theta * damping
    for a in range(motors.shape[0]):
        j, linear, free, per = drives.table[a, ka.DRIVEN], s.linear[a], 0.0, 0.0
        if drives.table[a, ka.CIRCUIT] >= 0:
            scale = h / (1.0 - h * theta * linear[ka.RATE_I])
            free = scale * motors[a, ka.DIDT]
            per = scale * (linear[ka.RATE_Q] * h * theta * theta + linear[ka.RATE_V] * theta)
        s.eliminated[a, kt.FREE], s.eliminated[a, kt.PER], s.eliminated[a, kt.DIDT_THEN] = free, per, motors[a, ka.DIDT]
        joints[j, ka.APPLIED] += linear[ka.TORQUE_I] * theta * free
        slope = (
            linear[ka.TORQUE_Q] * h * theta * theta + linear[ka.TORQUE_V] * theta + linear[ka.TORQUE_I] * theta * per
        )
        s.body[j, ka.ARMATURE] -= h * slope


@internal_kernel
def drive_at_theta(system: System, ws: Workspace, run: Run):
    """The drives at x_θ of the step into y_new, by their own laws: torques in APPLIED, which has nothing else."""
    s, h, y, y_new, layout = run.stepping, run.clock[ki.STEP], run.y, run.y_new, system.layout
    between, theta = run.stage[2], s.theta
    for j in range(y.shape[0]):
        between[j] = y[j] + theta * (y_new[j] - y[j])
    place_joints(system, ws, y)
    for i in range(ws.joints.shape[0]):
        v = between[layout.v + i]
        ws.joints[i, ka.Q] += h * theta * v
        ws.joints[i, ka.QD], ws.joints[i, ka.APPLIED] = v, 0.0
    drive(system.drives, system.reference, run.clock[ki.TIME] + theta * h, between, layout, ws)


@internal_kernel
def limits_agree(system: System, ws: Workspace, run: Run, tries):
    """True when the drives at x_θ, after :func:`drive_at_theta`, lie on their segments; else puts them there.

    From one limit to the opposite one a drive goes by the unlimited segment, which lies between: a light wheel passes
    it within a step under either limit, and each would ask for the other. Between the current limits of a motor with
    inductance lie those of its voltage instead.
    """
    s, agree = run.stepping, True
    t = run.clock[ki.TIME] + s.theta * run.clock[ki.STEP]
    for a in range(ws.motors.shape[0]):
        segment = segment_of(system.drives, system.reference, t, ws, a)
        direct = system.drives.table[a, ka.DRIVE_KIND] == ka.DC_MOTOR and abs(segment) == 2
        if segment == -s.segment[a] and not direct:
            segment = 0
        if segment != s.segment[a] and (agree or tries < ALL_AT_ONCE):
            s.segment[a], agree = segment, False
    return agree

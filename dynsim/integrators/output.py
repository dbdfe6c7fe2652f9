"""Recorded outputs of a sample that are not states: accelerations, drives, hand, energies, contacts, support."""

from __future__ import annotations

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.rows import force_vectors
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System
from dynsim.dynamics.ledger import kinetic_energy, magnetic_energy, potential_energy
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree import support as ks
from dynsim.dynamics.tree.points import point_position
from dynsim.dynamics.tree.support import ground_reaction
from dynsim.integrators.run import Run
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import internal_kernel


@internal_kernel
def write_output(system: System, ws: Workspace, run: Run, row):
    """All recorded outputs that are not states, after ``derivative``, into the columns of OutputLayout."""
    fill_output(system, ws, run, run.output[row])
    write_support(system, ws, run, row)


@internal_kernel
def fill_output(system: System, ws: Workspace, run: Run, out):
    """The same without the ground reactions of a mobile base, into out (columns.size,); also for lanes."""
    joints, state, columns = ws.joints, ws.contacts, run.columns
    force_vectors(ws)
    for i in range(joints.shape[0]):
        out[columns.vdot + i] = joints[i, ka.QDD]
    fill_drives(system, ws, run, out)
    point_position(ws, run.hand_link, run.hand_point, out[columns.hand : columns.hand + 3])
    fill_energies(system, ws, run, out)
    k = columns.contact
    for c in range(state.shape[0]):
        out[k + kst.OUT_FORCE] = state[c, ka.NORMAL_FORCE]
        out[k + kst.OUT_GAP] = state[c, ka.GAP]
        out[k + kst.OUT_MODE] = ws.active[c, ka.MODE]
        for s in range(3):
            out[k + kst.OUT_VECTOR + s] = state[c, ka.FORCE_VECTOR + s]
            out[k + kst.OUT_SLIP + s] = state[c, ka.SLIP_VELOCITY + s]
        k += kst.OUTPUTS_PER_CONTACT
    row_forces(system.unilateral, out[columns.stop :], out[columns.dry :], out[columns.tie :])


@internal_kernel
def fill_energies(system: System, ws: Workspace, run: Run, out):
    """Kinetic, potential and magnetic energy of the last sweep and its currents."""
    energy = run.columns.energy
    out[energy] = kinetic_energy(system.model, ws)
    out[energy + 1] = potential_energy(system.model, ws)
    out[energy + 2] = magnetic_energy(system.drives, ws)


@internal_kernel
def fill_drives(system: System, ws: Workspace, run: Run, out):
    """Currents, voltages and shaft torques of the motors, at the accelerations that are in ``out``."""
    joints, motors, motor, columns = ws.joints, ws.motors, system.drives.motor, run.columns
    for a in range(motors.shape[0]):
        i = system.drives.table[a, ka.DRIVEN]
        out[columns.current + a] = motors[a, ka.CURRENT]
        out[columns.voltage + a] = motors[a, ka.VOLTAGE]
        steady = steady_torque(motor, motors, a, joints[i, ka.QD])
        out[columns.torque + a] = with_rotor(run.stepping, steady, motor[a, ka.J_M] * out[columns.vdot + i], a)


@internal_kernel
def steady_torque(motor, motors, a, v):
    """Shaft torque of motor a at a constant rate v [N m or N]."""
    return motor[a, ka.K_M] * motors[a, ka.CURRENT] - motor[a, ka.D_M] * v - motors[a, ka.DRAG] - motors[a, ka.DRY_DRAG]


@internal_kernel
def with_rotor(stepping: SteppingArrays | None, steady, inertial, a):
    """Shaft torque of motor a at a constant rate, ``steady``, less what its rotor takes, ``inertial``.

    Recorded torques are without impulses. In the steps of an impact, whose accelerations have one in them, the torque
    stays as it was in the last step without; at the start of a run it is ``steady``.
    """
    if stepping is None:  # known to the compiler
        return steady - inertial
    if stepping.grid[kt.HELD_STEPS] == 0.0:
        return steady - inertial
    return stepping.torque[a] if stepping.torque[a] == stepping.torque[a] else steady


@internal_kernel
def row_forces(unilateral: UnilateralArrays | None, stop, dry, tie):
    """Forces of joint stops, (s,), of dry frictions, (d,), and of ties, (e,), or more."""
    if unilateral is None:  # known to the compiler
        return
    for k in range(unilateral.stop.shape[0]):
        stop[k] = unilateral.stop[k, ku.STOP_FORCE]
    for k in range(unilateral.dry.shape[0]):
        dry[k] = unilateral.dry[k, ku.DRY_FORCE]
    for k in range(unilateral.tie.shape[0]):
        tie[k] = unilateral.tie[k, ku.TIE_FORCE]


@internal_kernel
def write_support(system: System, ws: Workspace, run: Run, row):
    """What the ground carries of a mobile base, into the columns ``support``."""
    if run.support.index.shape[0] == 0:
        return
    ground_reaction(system.model, system.loads, run.sample_time[row], ws, run.support)
    for s in range(ks.OUTPUTS):
        run.output[row, run.columns.support + s] = run.support.state[s]

"""Equilibrium start (``initial.equilibrium``): motor currents that hold the posture, and shifted references.

At rest u = R i, so a controller whose reference is the posture itself has to supply R i. Planned voltages supply it,
except for external loads. The missing part is added as a shift of each motor's reference, constant over the run:

    DC motor, position servo: q_d + R i / k_p        torque source: τ_d + τ

The shift cancels the sag under gravity at the start. Compliant contacts that carry load are pressed in. This moves the
joints, and the references move with them. Errors, tracking and ledger refer to the original references.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dynsim.compile.control import JointControl
from dynsim.compile.model import Model
from dynsim.compile.posture import holding_torques, load_torques, touching_contacts
from dynsim.compile.pressing import pressed_in, spring_forces
from dynsim.compile.tables import format_quantity
from dynsim.dynamics.tables import ReferenceArrays
from dynsim.errors import first_few
from dynsim.model.description import Array, Contact, Load
from dynsim.model.drives import Motor, Servo, TorqueSource

# A reference starts at rest and without offset if offset and rate are below this [rad or m, rad/s or m/s].
AT_REST = 1e-4
# If pressing contacts in moves a joint by more than this [rad or m], a warning reports that the start posture differs
# from the requested posture.
MOVED = {"rad": math.radians(1.0), "m": 5e-3}
# A normal force below this fraction of the robot's weight counts as zero; spline references leave forces of this size.
NO_FORCE = 1e-4


@dataclass(frozen=True)
class Balance:
    """Currents, reference shifts and contact forces of a start at rest.

    Attributes
    ----------
    current : (na,) ndarray
        Motor currents [A; N m for a torque source].
    shift : (na,) ndarray
        Shifts of the references [rad or m; N m for a torque source].
    heat : float
        Motor heat Σ R i² [W].
    normal_forces : dict of str to float
        Normal force of each contact that touches [N]; empty if the controller plans these forces.
    warnings : tuple of str
        Warnings about jumps that remain at the start.
    on_edge : bool
        True if the posture requires the full static friction.
    """

    current: Array
    shift: Array
    heat: float
    normal_forces: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    on_edge: bool = False


def pressed(
    model: Model, contacts: Sequence[Contact], loads: Sequence[Load], control: JointControl, real: bool
) -> Model:
    """Return the model in its rest posture; for parameters and errors see :func:`balanced`.

    Only compliant contacts change the posture: they carry no load unless they are pressed in.
    """
    if len(control.reference.voltage):
        return model
    return pressed_in(model, contacts, loads, _torque_joints(model, control), real)


def balanced(
    model: Model,
    contacts: Sequence[Contact],
    loads: Sequence[Load],
    control: JointControl,
    real: bool,
    requested: Array,
) -> Balance:
    """Compute the start at rest of a robot under its controller.

    Parameters
    ----------
    model : Model
        Model in its posture at rest, see :func:`pressed`.
    contacts : sequence of Contact
        Contacts of the scenario.
    loads : sequence of Load
        Loads of the scenario, evaluated at t = 0.
    control : JointControl
        Controller with its references.
    real : bool
        True under the unilateral contact law.
    requested : (nq,) ndarray
        Posture before :func:`pressed`, in which references start.

    Returns
    -------
    Balance
        Currents, reference shifts, normal forces and warnings.

    Raises
    ------
    ModelError
        If no torques hold the posture.
    """
    robot, motors = model.robot, model.robot.motors
    index = [model.joint_names.index(motor.joint) for motor in motors]
    begin, rate = _begin(control.reference, len(motors))
    current, shift, on_edge = np.zeros(len(motors)), np.zeros(len(motors)), False
    jumps: list[str] = []
    planned = control.reference.voltage
    if not len(planned):
        touching = touching_contacts(model, contacts, robot.initial, real)
        springs = spring_forces([at for at in touching if at.contact.stiffness == 0.0 or at.gap < 0.0])
        balance = holding_torques(model, robot.initial, contacts, loads, _torque_joints(model, control), real, springs)
        torques, on_edge = balance.torques, balance.on_edge
        forces = {at.contact.name: balance.normal_forces.get(at.contact.name, 0.0) for at in touching}
    else:
        # The plan determines the contact forces; it does not include loads, which the motors carry.
        torques, forces = load_torques(model, robot.initial, loads), {}
        if compliant := _relied_on(model, contacts, planned[0, :, 0], index, real):
            jumps.append(f"the planned voltages rely on {first_few(compliant)}, which deform before they carry load")
    for a, (motor, i) in enumerate(zip(motors, index, strict=True)):
        if isinstance(motor, TorqueSource):
            current[a] = torques[i]
            if control.reference.spline[a] < 0:
                shift[a] = torques[i] - begin[a]
            elif abs(torques[i] - begin[a]) > AT_REST:
                force = robot.links[i].units[3]
                jumps.append(
                    f"the {'torque' if force == 'N m' else 'force'} of {motor.joint} starts at {begin[a]:.4g} "
                    f"{force}, but would be {torques[i]:.4g} at rest"
                )
            continue
        drop = motor.resistance * torques[i] / motor.joint_constant
        k_p = motor.k_p if isinstance(motor, Servo) else control.k_p[a]
        current[a] = torques[i] / motor.joint_constant
        if len(planned):
            current[a] += planned[0, a, 0] / motor.resistance
        if not k_p > 0.0:
            continue
        unit, index_q = robot.links[i].units, robot.position_index[i]
        at = requested[index_q]
        shift[a] = drop / k_p + (robot.initial[index_q] - at)
        if abs(begin[a] - at) > AT_REST:
            away = format_quantity(begin[a] - at, unit[0], 3)
            jumps.append(f"the reference of {motor.joint} starts {away} from the joint position")
        elif abs(rate[a]) > AT_REST:
            jumps.append(f"the reference of {motor.joint} starts with {rate[a]:.3g} {unit[1]}")
    resistance = np.array([getattr(motor, "resistance", 0.0) for motor in motors])
    said = _moved(model, requested)
    if jumps:
        fix = "use a path that starts at rest at the hand"
        said = (f"initial.equilibrium: {'; '.join(jumps)}: the motion still jumps at the start; {fix}", *said)
    return Balance(current, shift, float(resistance @ current**2), forces, said, on_edge)


def _moved(model: Model, requested: Array) -> tuple[str, ...]:
    """Return a warning that lists the joints that move far as contacts are pressed in, or an empty tuple."""
    robot = model.robot
    moved = []
    for link, k in zip(robot.links, robot.position_index, strict=True):
        unit = link.units[0]
        change = float(robot.initial[k] - requested[k])
        if len(link.row.neutral) == 1 and abs(change) > MOVED.get(unit, math.inf):
            moved.append(f"{link.joint} by {format_quantity(change, unit, 3)}")
    if not moved:
        return ()
    return (
        f"initial.equilibrium: moves {first_few(moved)} away from the requested posture so that compliant contacts "
        "carry load; they are soft or have short lever arms; raise contacts.stiffness_N_per_m or change the posture",
    )


def _relied_on(
    model: Model, contacts: Sequence[Contact], voltages: Array, index: Sequence[int], real: bool
) -> list[str]:
    """Return the compliant contacts that the planned voltages, (na,), assume to carry part of the weight.

    ``index`` is the joint of each motor.
    """
    robot = model.robot
    left = np.asarray(model.bias_forces(robot.initial, np.zeros(model.n)))
    for motor, i, u in zip(robot.motors, index, voltages, strict=True):
        if not isinstance(motor, TorqueSource):
            left[i] -= motor.joint_constant * u / motor.resistance
    touching = touching_contacts(model, contacts, robot.initial, real)
    rows = np.array([at.normal @ at.jacobian(model, robot.initial) for at in touching])
    if not len(rows):
        return []
    forces = np.linalg.lstsq(rows.T, left, rcond=None)[0]
    least = NO_FORCE * sum(link.inertia.mass for link in robot.links) * float(np.linalg.norm(robot.gravity))
    named = zip((at.contact for at in touching), forces, strict=True)
    return [contact.name for contact, force in named if contact.stiffness > 0.0 and abs(force) > least]


def _torque_joints(model: Model, control: JointControl) -> list[str]:
    """Return the joints whose motors can produce a torque at rest."""
    return [
        motor.joint
        for motor, k_p in zip(model.robot.motors, control.k_p, strict=True)
        if isinstance(motor, TorqueSource) or (isinstance(motor, Servo) and not motor.velocity_mode)
        or (isinstance(motor, Motor) and k_p > 0.0)
    ]  # fmt: skip


def shifted(reference: ReferenceArrays, shift: Array) -> ReferenceArrays:
    """Return the references, each shifted by a constant."""
    coefficients, moving = reference.coefficients.copy(), reference.spline >= 0
    coefficients[:, reference.spline[moving], 0] += shift[moving]
    return reference._replace(held=reference.held + shift, coefficients=coefficients, spline=reference.spline.copy())


def _begin(reference: ReferenceArrays, motors: int) -> tuple[Array, Array]:
    """Return values and rates of the references at their start, both (na,)."""
    begin, rate, moving = reference.held.copy(), np.zeros(motors), reference.spline >= 0
    begin[moving], rate[moving] = reference.coefficients[0, reference.spline[moving], :2].T
    return begin, rate

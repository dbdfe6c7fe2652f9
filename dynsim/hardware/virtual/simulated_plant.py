"""A simulated robot behind the virtual servos: its bodies, gravity, and the surfaces its elbows are braced on.

The servos' motor law replaces the motors of the scenario. Contact points are pushed by a stiff spring and damper with
regularised Coulomb friction, and only pushed: unlike the scenario's bilateral law a floor does not pull here. One step
is linearly implicit,

    (M + J + Δt (D + Jcᵀ c Jc) + Δt² Jcᵀ k Jc) Δv = Δt (τ − h − g − D v + Jcᵀ f)

with M, h, g of :class:`dynsim.Model`, J the servos' own inertia and D the joints' losses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.servo_plant import Drive, MotorLaw

Array = NDArray[np.float64]

CONTACT_STIFFNESS = 2e4
"""[N/m]: the 50 N of a braced elbow sink it by 2.5 mm."""
CONTACT_DAMPING = 200.0  # N·s/m
HELD = 1e9
"""Inertia that keeps a joint on its stand in place [kg·m²]."""


class SimulatedArm:
    """A :class:`~dynsim.hardware.virtual.servo_plant.ServoPlant`: a robot whose every joint has a position servo.

    A joint rests on the robot's stand until its servo is first switched on: otherwise an arm would fall while it is
    armed joint by joint.

    Parameters
    ----------
    model : dynsim.Model
    contacts : list of contacts of the scenario
    servo_map : ServoMap
    posture : array, shape (n,)
        Where the joints are at first [rad], in the order of the model.

    Raises
    ------
    ServoMapError
        The servos of the map are not the joints of the model.
    """

    def __init__(self, model: Any, contacts: list[Any], servo_map: ServoMap, posture: Array) -> None:
        labels = [servo.label for servo in servo_map.servos]
        joints = list(model.joint_names)
        if sorted(labels) != sorted(joints):
            raise ServoMapError(
                f"{servo_map.path} has servos for {', '.join(labels)}; the plant's joints are {', '.join(joints)}"
            )
        self._model, self._contacts = model, contacts
        self._order = np.array([joints.index(label) for label in labels])  # servo k moves joint order[k]
        servos = servo_map.servos
        self._scale = np.array([servo.sign * servo.gear for servo in servos])  # servo angle per joint angle
        self._zero = np.array([servo.zero_tick * RAD_PER_TICK for servo in servos])
        self._law = MotorLaw([servo.model for servo in servos])
        self.position = self._zero + self._scale * np.asarray(posture, dtype=np.float64)[self._order]
        self.velocity = np.zeros(len(servos))
        self.torque = np.zeros(len(servos))
        self._on_stand = np.ones(len(servos), dtype=bool)

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad], shape (n,), in the order of the model."""
        return self._to_joints((self.position - self._zero) / self._scale)

    def step(self, dt: float, drive: Drive) -> None:
        self._on_stand &= ~drive.enabled
        self.torque = self._law.torque(self.position, self.velocity, drive)
        q, v = self.joint_positions, self._to_joints(self.velocity / self._scale)
        tau = self._to_joints(self.torque * self._scale) - self._model.bias_forces(q, v) - self._model.damping * v
        inertia = self._to_joints(self._law.inertia * self._scale**2)
        losses = self._model.damping + self._to_joints(self._law.damping * self._scale**2 * drive.enabled)
        A = self._model.mass_matrix(q) + np.diag(inertia + dt * losses)
        for contact in self._contacts:
            self._push(contact, q, v, dt, tau, A)
        held = self._to_joints(self._on_stand.astype(np.float64)) > 0
        A[held, held] += HELD
        v = np.where(held, 0.0, v + np.linalg.solve(A, dt * np.where(held, 0.0, tau)))
        self.velocity = self._scale * v[self._order]
        self.position = self.position + dt * self.velocity

    def stop(self, index: int) -> None:
        self.velocity[index] = 0.0

    def _push(self, contact: Any, q: Array, v: Array, dt: float, tau: Array, A: Array) -> None:
        """Add a contact's force to ``tau``, its stiffness and damping to ``A``."""
        position, jacobian = self._model.point_position_and_jacobian(contact.body, contact.point, q)
        gap = float(contact.surface.gap(position))
        if gap >= 0:
            return
        normal = np.asarray(contact.surface.Q @ position + contact.surface.b)
        normal = normal / np.linalg.norm(normal)
        velocity = jacobian @ v
        row = normal @ jacobian
        force = max(0.0, -CONTACT_STIFFNESS * gap - CONTACT_DAMPING * float(normal @ velocity))
        slip = velocity - normal * float(normal @ velocity)
        # Regularised over what a step can do to the slip: tighter would only chatter.
        friction = -contact.friction * force * slip / np.hypot(np.linalg.norm(slip), 1e-2)
        tau += row * force + friction @ jacobian
        A += np.outer(row, row) * (dt * CONTACT_DAMPING + dt**2 * CONTACT_STIFFNESS)

    def _to_joints(self, of_servos: Array) -> Array:
        of_joints = np.empty_like(of_servos)
        of_joints[self._order] = of_servos
        return of_joints


def simulated_arm(
    scenario_name: str, variant: str | None, servo_map: ServoMap, posture: dict[str, float]
) -> SimulatedArm:
    """The robot of a scenario behind the servos of a map.

    Parameters
    ----------
    posture : dict
        Joint angles at first [rad], by label; the scenario's initial ones where it names none.

    Raises
    ------
    ScenarioError, ModelError
        No such scenario, or it has no rigid-body model (a kinematic plant).
    ServoMapError
        The servos of the map are not its joints.
    """
    from dynsim.scenario import build, build_model, load_scenario

    scenario = load_scenario(scenario_name, variant=variant)
    model = build_model(scenario)
    start = [posture.get(name, angle) for name, angle in zip(model.joint_names, model.robot.initial, strict=True)]
    return SimulatedArm(model, build.contacts(scenario), servo_map, np.array(start))

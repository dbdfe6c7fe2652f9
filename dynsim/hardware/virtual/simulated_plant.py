"""A simulated robot behind the virtual servos: its bodies, gravity, and the surfaces its elbows are braced on.

A :class:`dynsim.Simulation` moves it: the scenario's robot, with servos of the map's models for motors. Unlike the
scenario's bilateral law a floor does not pull here. Contact points are pushed by a stiff spring and damper with
regularised Coulomb friction, as wrenches on their bodies that are held for a tick Δt. With G = J M⁻¹ Jᵀ, the mobility
of a point [1/kg], damping c and friction b take no more speed away in a tick than there is,

    f_n = max(0, −k g − c/(1 + Δt c nᵀG n) ġ)        f_t = −b/(1 + Δt b |G|) v_t,   b = μ f_n/√(v_t² + v_s²)

Ticks are stable while k Δt/2 is less than what is left of c, which holds for points of more than 11 g. A load at rest
is carried by k alone.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.servo_plant import Drive, MotorLaw

if TYPE_CHECKING:
    from dynsim import Scenario, Simulation

Array = NDArray[np.float64]

TICK = 1e-3
"""For so long a contact's force is held [s]; the servos' physics step is a multiple of it."""
CONTACT_STIFFNESS = 2e4
"""[N/m]: the 50 N of a braced elbow sink it by 2.5 mm."""
CONTACT_DAMPING = 200.0  # N·s/m
SLOW, STEADY = 1e-4, 1e-2
"""Slower [rad/s] and with less acceleration [rad/s²] a limp robot rests."""


class SimulatedArm:
    """A :class:`~dynsim.hardware.virtual.servo_plant.ServoPlant`: a robot whose every joint has a position servo.

    A joint rests on the robot's stand until its servo is first switched on: otherwise an arm would fall while it is
    armed joint by joint.

    Parameters
    ----------
    scenario : dynsim.Scenario
        Whose robot it is, with payloads and contacts; forces that the scenario gives over time are left out.
    servo_map : ServoMap
    posture : array, shape (n,)
        Where the joints are at first [rad], in the order of the model.

    Raises
    ------
    ServoMapError
        The servos of the map are not the joints of the model.
    """

    def __init__(self, scenario: Scenario, servo_map: ServoMap, posture: Array) -> None:
        import dynsim
        from dynsim.scenario import build

        robot, servos = build.robot(scenario), servo_map.servos
        labels, joints = [servo.label for servo in servos], list(robot.joint_names)
        if sorted(labels) != sorted(joints):
            raise ServoMapError(
                f"{servo_map.path} has servos for {', '.join(labels)}; the plant's joints are {', '.join(joints)}"
            )
        self._labels = labels
        self._order = np.array([joints.index(label) for label in labels])  # servo k moves joint order[k]
        self._scale = np.array([servo.sign * servo.gear for servo in servos])  # servo angle per joint angle
        self._zero = np.array([servo.zero_tick * RAD_PER_TICK for servo in servos])
        self._law = MotorLaw([servo.model for servo in servos])
        # They weigh what the motors do whose places they take.
        masses = {motor.joint: (motor.mass, motor.mass_point) for motor in robot.motors}
        motors = [
            replace(servo, mass=mass, mass_point=point)
            for servo in self._law.servos(labels, np.abs(self._scale))
            for mass, point in [masses.get(servo.joint, (0.0, None))]
        ]
        start = dynsim.State(0.0, np.asarray(posture, dtype=np.float64), np.zeros(len(joints)), np.zeros(0))
        self._simulation = dynsim.Simulation(_bare(scenario), state=start, duration=math.inf, trace=0, motors=motors)
        self._contacts = [
            (contact, robot.links[index].name, index, point)
            for contact in build.contacts(scenario)
            for index, point in [robot.attach(contact.body, contact.point)]
        ]
        self._pushed: set[str] = set()  # bodies with a wrench
        self._on_stand = np.ones(len(servos), dtype=bool)
        self._jammed = np.zeros(len(servos), dtype=bool)
        self._told = [("off", 0.0, 0.0)] * len(servos)
        for label in labels:
            self._simulation.set_mode(label, "off")
            self._simulation.set_brake(label, True)
        self._simulation.every(TICK, self._push)
        # Nothing moves yet; kernels are compiled now, not while a bus waits for an answer.
        self._ticks = 1
        self._simulation.advance(TICK)
        self.rests = True
        self.torque = np.zeros(len(servos))
        self.position, self.velocity = self._shafts()

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad], shape (n,), in the order of the model."""
        return self._simulation.state.q

    def step(self, dt: float, drive: Drive) -> None:
        self._on_stand &= ~drive.enabled
        simulation, before = self._simulation, self.velocity
        simulation.set_supply(max(drive.voltage, 0.0))
        positions = (drive.set_position - self._zero) / self._scale
        rates = drive.set_velocity / self._scale
        for k, label in enumerate(self._labels):
            simulation.set_brake(label, bool(self._on_stand[k] or self._jammed[k]))
            told = ("off", 0.0, 0.0)
            if drive.enabled[k]:
                in_position_mode = drive.in_position_mode[k]
                told = ("position", positions[k], 0.0) if in_position_mode else ("velocity", 0.0, rates[k])
            if told != self._told[k]:
                simulation.set_mode(label, told[0])
                simulation.set_reference(label, *told[1:])
                self._told[k] = told
        self._jammed[:] = False
        self._ticks += round(dt / TICK)
        simulation.advance(self._ticks * TICK)
        self.position, self.velocity = self._shafts()
        self.torque = self._law.torque(self.position, self.velocity, drive)
        steady = np.abs(self.velocity - before).max() < STEADY * dt
        self.rests = bool(steady and np.abs(self.velocity).max() < SLOW and not drive.enabled.any())

    def stop(self, index: int) -> None:
        self._jammed[index] = True
        self._simulation.set_brake(self._labels[index], True)
        self.position, self.velocity = self._shafts()

    def _shafts(self) -> tuple[Array, Array]:
        """Angles [rad] and speeds [rad/s] of the servos."""
        state = self._simulation.state
        return self._zero + self._scale * state.q[self._order], self._scale * state.v[self._order]

    def _push(self, simulation: Simulation) -> None:
        """Write the contacts' forces at the present state, for a tick."""
        state, model = simulation.state, simulation.model
        # By body: where its first contact is, in its own frame and in the world, and the wrench there.
        pushes: dict[str, tuple[Array, Array, Array]] = {}
        compliance = None
        for contact, body, index, point in self._contacts:
            position, jacobian = model.point_position_and_jacobian(index, point, state.q)
            gap = float(contact.surface.gap(position))
            if gap >= 0.0:
                continue
            if compliance is None:
                compliance = np.linalg.inv(model.mass_matrix(state.q) + np.diag(model.armature))
            force = push(contact, position, gap, jacobian @ state.v, jacobian @ compliance @ jacobian.T)
            if body in pushes:
                _, centre, wrench = pushes[body]
                wrench += np.concatenate([force, np.cross(position - centre, force)])
            else:
                pushes[body] = point, position, np.concatenate([force, np.zeros(3)])
        for body, (point, _, wrench) in pushes.items():
            simulation.set_wrench(body, wrench[:3], wrench[3:], point=point)
        for body in self._pushed - pushes.keys():
            simulation.set_wrench(body)
        self._pushed = set(pushes)


def push(contact: Any, position: Array, gap: float, velocity: Array, mobility: Array) -> Array:
    """Force on a point below its surface, (3,) [N].

    Parameters
    ----------
    contact : of the scenario
    position, velocity : of the point, (3,) [m], [m/s]
    gap : below zero [m]
    mobility : J M⁻¹ Jᵀ of the point, (3, 3) [1/kg]
    """
    normal = np.asarray(contact.surface.normal(position))
    rate = float(normal @ velocity)
    along = float(normal @ mobility @ normal)
    damping = CONTACT_DAMPING / (1.0 + TICK * CONTACT_DAMPING * along)
    force = max(0.0, -CONTACT_STIFFNESS * gap - damping * rate)
    slip = velocity - normal * rate
    grip = contact.friction * force / math.hypot(float(np.linalg.norm(slip)), contact.slip_smoothing)
    across = float(np.trace(mobility)) - along
    return np.asarray(normal * force - slip * (grip / (1.0 + TICK * grip * across)))


def _bare(scenario: Scenario) -> Scenario:
    """The plant of a scenario and its payloads: no controller, no contacts that hold, no forces over time."""
    from dynsim.scenario.loads import Payload

    config = scenario.config
    payloads = {name: load for name, load in config.loads.items() if isinstance(load, Payload)}
    free = config.contacts.model_copy(update={"points": {}})
    integrator = type(config.integrator)()
    changes = {"controller": None, "contacts": free, "loads": payloads, "integrator": integrator}
    return replace(scenario, config=config.model_copy(update=changes))


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
    from dynsim.scenario import build, load_scenario

    scenario = load_scenario(scenario_name, variant=variant)
    robot = build.robot(scenario)
    start = [posture.get(name, angle) for name, angle in zip(robot.joint_names, robot.initial, strict=True)]
    return SimulatedArm(scenario, servo_map, np.array(start))

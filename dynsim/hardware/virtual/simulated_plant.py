"""Plants for virtual servos: the motor law, simple inertias, and a simulated robot with gravity, stops and contacts.

The simulated robot is a :class:`dynsim.Simulation` of a scenario's robot, with servo models from the map as motors. Its
contacts are unilateral, whatever the scenario specifies, because a real floor does not pull. The integrator is time
stepping for a snake robot, which stands on its wheels, and for a scenario that uses time stepping; otherwise the
integrator is event-driven.

Servos round their angles to ticks. Therefore a braced elbow may appear some tenths of a millimetre below its floor, or
a joint beyond its stop. The arm then starts in the nearest admissible posture.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dynsim.config.data_sheets import GEAR_FRICTION
from dynsim.hardware.bus.control_table import MX_106, RAD_PER_TICK, ServoModel
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import ServoMap

if TYPE_CHECKING:
    from dynsim.compile.model import Model
    from dynsim.model.description import Robot
    from dynsim.model.drives import Servo
    from dynsim.scenario import Scenario

# Mechanics of virtual servos: motor law, interface for plants, and separate inertias as the simplest plant.


STIFFNESS_PER_STALL_TORQUE = 41.0 / MX_106.stall_torque  # 1/rad
VELOCITY_TIME_CONSTANT = 0.02
"""Time constant of a servo's closed velocity loop without load [s] (unverified)."""
FREE_DAMPING = 0.1
"""Damping of an unpowered gear train as a fraction of the back-EMF damping (unverified)."""


@dataclass
class Drive:
    """Set points of the servo controllers, as arrays of shape (N,) in servo coordinates, and the supply voltage.

    Attributes
    ----------
    enabled, in_position_mode : bool arrays
    set_position : array
        Position set points [rad].
    set_velocity : array
        Velocity set points [rad/s].
    voltage : float
        Supply voltage at the servos [V].
    """

    enabled: NDArray[np.bool_]
    in_position_mode: NDArray[np.bool_]
    set_position: Array
    set_velocity: Array
    voltage: float


class MotorLaw:
    """Law for the torque of N servos as a function of their set points, with the constants of the servo models.

    Attributes
    ----------
    stiffness, damping, stall_torque : array, shape (N,)
        k [N·m/rad], d [N·m·s/rad], τ_stall at the rated voltage [N·m].
    inertia : array, shape (N,)
        Output inertia for which the position loop is critically damped, d²/(4k) [kg·m²].
    friction : array, shape (N,)
        Dry friction of the gear train [N·m], which is not part of :meth:`torque`.
    """

    def __init__(self, models: list[ServoModel]) -> None:
        self.stall_torque = np.array([model.stall_torque for model in models])
        self._voltage = np.array([model.rated_voltage for model in models])
        self.damping = self.stall_torque / np.array([model.no_load_speed for model in models])
        self.stiffness = STIFFNESS_PER_STALL_TORQUE * self.stall_torque
        self.inertia = self.damping**2 / (4 * self.stiffness)
        self.friction = GEAR_FRICTION * self.stall_torque
        # Imported here, because a replay on real servos imports this module but does not need the simulation.
        from dynsim.model.drives import ServoBank

        self._bank = ServoBank(self.servos([model.name for model in models], np.ones(len(models))))

    def torque(self, position: Array, velocity: Array, drive: Drive) -> Array:
        """Return the output torque [N·m], shape (N,), at an angle [rad] and speed [rad/s]."""
        self._bank.command(drive.enabled, drive.in_position_mode, drive.set_position, drive.set_velocity)
        self._bank.supply(drive.voltage)
        return self._bank.torque(position, velocity)

    def servos(self, joints: list[str], gears: Array) -> list[Servo]:
        """Return the servos as motors of joints; ``gears`` (N,) contains the servo turns per joint turn.

        K_m = V/ω_no_load and R = V K_m/τ_stall at the rated voltage, so that d = K_m²/R; the torque per volt is K_m/R.
        """
        from dynsim.model.drives import Servo

        torque_constants = self._voltage / (self.stall_torque / self.damping)
        resistances = self._voltage * torque_constants / self.stall_torque
        volts = resistances / torque_constants
        return [
            Servo(
                joint=joint,
                torque_constant=float(torque_constants[a] * gear),
                resistance=float(resistances[a]),
                k_p=float(self.stiffness[a] * volts[a] * gear),
                k_v=float(self.inertia[a] / VELOCITY_TIME_CONSTANT * volts[a] * gear),
                armature=float(self.inertia[a] * gear**2),
                free_drag=float(FREE_DAMPING * self.damping[a] * gear**2),
            )
            for a, (joint, gear) in enumerate(zip(joints, gears, strict=True))
        ]


class InertialLoad:
    """A separate inertia for each servo, with a critically damped second-order response; see :data:`ServoPlant`."""

    def __init__(self, models: list[ServoModel], position: Array) -> None:
        self.law = MotorLaw(models)
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.zeros(len(models))
        self.torque = np.zeros(len(models))
        self._jammed = np.zeros(len(models), dtype=bool)

    @property
    def rests(self) -> bool:
        return bool(np.abs(self.velocity).max(initial=0.0) < 1e-4)

    def step(self, dt: float, drive: Drive) -> None:
        """Advance by ``dt`` [s]."""
        self.torque = self.law.torque(self.position, self.velocity, drive)
        driven = self.velocity + dt * self.torque / self.law.inertia
        # Dry friction cannot reverse the motion, but stops it. The integral gain of a velocity loop compensates for it.
        friction = self.law.friction * (drive.in_position_mode | ~drive.enabled)
        slowed = np.maximum(np.abs(driven) - dt * friction / self.law.inertia, 0.0)
        self.velocity = np.where(self._jammed, 0.0, np.copysign(slowed, driven))
        self.position += dt * self.velocity
        self._jammed[:] = False

    def stop(self, index: int) -> None:
        """Stop one shaft at its present angle and lock it during the next step, like a jammed gear."""
        self.velocity[index] = 0.0
        self._jammed[index] = True


Array = NDArray[np.float64]

log = logging.getLogger(__name__)

START_CHANGE = 5.0 * RAD_PER_TICK
"""Maximum change of a joint angle to remove penetrations at the start, which ticks and backlash can cause [rad]."""
GAP_TOLERANCE = 1e-10  # [m]
SNAKE_STEP, ARM_STEP = 2e-3, 1e-3
"""Maximum time step, which is equal to the time step of the servo physics, and default time step for an arm [s]."""
SLOW, STEADY = 1e-4, 1e-2
"""Rate [rad/s] and acceleration [rad/s²] below which a robot without torque counts as at rest."""


class SimulatedArm:
    """A :data:`~dynsim.hardware.virtual.simulated_plant.ServoPlant`: a robot with a position servo at each joint.

    Each joint is locked, as if the robot were on a stand, until its servo is switched on for the first time; otherwise
    an arm would fall while its joints are armed one after another.

    Parameters
    ----------
    scenario : dynsim.Scenario
        Scenario with the robot, payloads and contacts; forces that are functions of time are ignored.
    servo_map : ServoMap
    posture : array, shape (n,)
        Initial joint angles [rad], in the order of :func:`served_joints`; see :func:`admissible_posture`.

    Raises
    ------
    ServoMapError
        If the servos of the map do not match the joints of the model.
    ModelError
        If a contact point starts so far below its surface that rounding to ticks cannot be the reason.
    """

    def __init__(self, scenario: Scenario, servo_map: ServoMap, posture: Array) -> None:
        from dynsim.engine.simulation import Simulation, State
        from dynsim.scenario import build

        robot, servos = build.robot(scenario), servo_map.servos
        served, labels = served_joints(robot), [servo.label for servo in servos]
        if sorted(own := dict.fromkeys(labels)) != sorted(served):
            raise ServoMapError(
                f"{servo_map.path} has servos for {', '.join(own)}, but the plant has joints {', '.join(served)}"
            )
        # Servo k moves the joint labels[k], whose angle is q[order[k]] and whose rate is v[rows[k]].
        self._labels = labels = [served[label] for label in labels]
        self._rows = np.array([robot.joint_names.index(joint) for joint in labels])
        self._order = np.array(robot.position_index)[self._rows]
        self._indices = np.array(robot.position_index)[[robot.joint_names.index(joint) for joint in served.values()]]
        self._scale = np.array([servo.sign * servo.gear for servo in servos])  # servo angle per joint angle
        self._zero = np.array([servo.zero_tick * RAD_PER_TICK for servo in servos])
        self._law = MotorLaw([servo.model for servo in servos])
        # The integral gain of a velocity loop compensates for friction, which a wheel therefore does not have.
        friction = self._law.friction * np.abs(self._scale) * [servo.in_position_mode for servo in servos]
        # Each servo has the mass of the motor that it replaces.
        masses = {motor.joint: (motor.mass, motor.mass_point) for motor in robot.motors}
        # Two servos on one axle are one motor with twice the torque per volt and twice the inertia; the first of them
        # determines whether it is on.
        motors = [
            replace(
                servo,
                mass=mass,
                mass_point=point,
                resistance=servo.resistance / count,
                armature=servo.armature * count,
                free_drag=servo.free_drag * count,
                coulomb_friction=float(friction[k]) * count,
            )
            for k, servo in enumerate(self._law.servos(labels, np.abs(self._scale)))
            if labels.index(servo.joint) == k
            for count, (mass, point) in [(labels.count(servo.joint), masses.get(servo.joint, (0.0, None)))]
        ]
        self._first = [labels.index(label) for label in labels]
        bare = _plant_only(scenario)
        q = _start_coordinates(bare, robot, dict(zip(served.values(), np.asarray(posture).tolist(), strict=True)))
        start = State(0.0, q, np.zeros(len(robot.links)), np.zeros(0))
        self.simulation = Simulation(bare, state=start, duration=math.inf, trace=0, motors=motors)
        self._on_stand = np.ones(len(servos), dtype=bool)
        self._jammed = np.zeros(len(servos), dtype=bool)
        self._commands = [("off", 0.0, 0.0)] * len(servos)
        for label in labels:
            self.simulation.set_mode(label, "off")
            self.simulation.set_brake(label, True)
        # Nothing moves yet: compile the kernels now, not while a bus waits for an answer.
        self.simulation.advance(1e-3)
        self.rests = True
        self.torque = np.zeros(len(servos))
        self.position, self.velocity = self._shafts()

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad], shape (n,), in the order of :func:`served_joints`."""
        return self.simulation.state.q[self._indices]

    def step(self, dt: float, drive: Drive) -> None:
        self._on_stand &= ~drive.enabled
        simulation, before = self.simulation, self.velocity
        simulation.set_supply(max(drive.voltage, 0.0))
        positions = (drive.set_position - self._zero) / self._scale
        rates = drive.set_velocity / self._scale
        for k, label in enumerate(self._labels):
            if self._first[k] != k:
                continue
            jammed = any(self._jammed[j] for j, first in enumerate(self._first) if first == k)
            simulation.set_brake(label, bool(self._on_stand[k] or jammed))
            command = ("off", 0.0, 0.0)
            if drive.enabled[k]:
                in_position_mode = drive.in_position_mode[k]
                command = ("position", positions[k], 0.0) if in_position_mode else ("velocity", 0.0, rates[k])
            if command != self._commands[k]:
                simulation.set_mode(label, command[0])
                simulation.set_reference(label, *command[1:])
                self._commands[k] = command
        self._jammed[:] = False
        simulation.advance(simulation.time + dt)
        self.position, self.velocity = self._shafts()
        self.torque = self._law.torque(self.position, self.velocity, drive)
        steady = np.abs(self.velocity - before).max() < STEADY * dt
        self.rests = bool(steady and np.abs(self.velocity).max() < SLOW and not drive.enabled.any())

    def stop(self, index: int) -> None:
        self._jammed[index] = True
        self.simulation.set_brake(self._labels[index], True)
        self.position, self.velocity = self._shafts()

    def _shafts(self) -> tuple[Array, Array]:
        """Return the angles [rad] and speeds [rad/s] of the servo shafts."""
        state = self.simulation.state
        return self._zero + self._scale * state.q[self._order], self._scale * state.v[self._rows]


ServoPlant = InertialLoad | SimulatedArm
"""Mechanics that servos drive.

Attributes
----------
position, velocity, torque : array, shape (N,)
    Servo angle [rad] (0 at tick 0), speed [rad/s], motor torque [N·m].
rests : bool
    True if nothing moves while all servos are off, so that no steps are needed.
"""


def served_joints(robot: Robot) -> dict[str, str]:
    """Return the joints with servos, by servo label: all joints of an arm, or the motorised joints of a snake robot."""
    # Imported here and below, because a replay on real servos imports this package but does not need the simulation.
    from dynsim.compile.snake_tree import SnakeTree

    if not isinstance(robot, SnakeTree):
        return {joint: joint for joint in robot.joint_names}
    wheels = dict(zip(robot.description.wheel_names, robot.wheel_joints, strict=True))
    driven = [motor.joint for motor in robot.motors]
    return {joint: joint for joint in driven if joint not in wheels.values()} | wheels


def _start_coordinates(bare: Scenario, robot: Robot, posture: dict[str, float]) -> Array:
    """Return coordinates (nq,) for joint angles [rad]: an admissible posture of an arm, or a snake on its wheels."""
    from dynsim.compile.snake_tree import SnakeTree, at_angles
    from dynsim.scenario import build

    if isinstance(robot, SnakeTree):
        return at_angles(robot, posture)
    return admissible_posture(bare, build.build_model(bare), np.array(list(posture.values()), dtype=np.float64))


def admissible_posture(scenario: Scenario, model: Model, posture: Array) -> Array:
    """Return a posture (n,) [rad] with all joints within their stops and no contact point below its surface.

    To first order it is the nearest such posture: Δq = −Jᵀ(J Jᵀ)⁺ gap, for all points that have been below their
    surfaces, is repeated until the gaps are rounding errors. Changes are logged. If a joint would have to change by
    more than START_CHANGE, the posture is returned unchanged, and the simulation rejects it with a message.
    """
    from dynsim.compile.touching import gap_at
    from dynsim.scenario import build

    contacts = build.contacts(scenario, model.robot)
    links = model.robot.links

    def gaps(q: Array) -> Array:
        return np.array([gap_at(model, contact, q) for contact in contacts])

    q = np.clip(posture, [link.lower for link in links], [link.upper for link in links])
    below = np.zeros(len(contacts), dtype=bool)
    for _ in range(20):
        depths = gaps(q)
        below |= depths < -GAP_TOLERANCE
        if np.abs(depths[below]).max(initial=0.0) <= GAP_TOLERANCE:
            break
        q = q - np.linalg.pinv(_slopes(gaps, q)[below]) @ depths[below]
    change = np.abs(q - posture).max(initial=0.0)
    if not 0.0 < change <= START_CHANGE:
        return posture
    log.info("a joint starts %.2g rad away from its servo position, so that contacts and stops are satisfied", change)
    return q


def _slopes(function: Callable[[Array], Array], q: Array, step: float = 1e-6) -> Array:
    """Return the Jacobian (c, n) of a function of the joint angles, computed by central differences."""
    shifts = step * np.eye(len(q))
    return np.array([(function(q + shift) - function(q - shift)) / (2.0 * step) for shift in shifts]).T


def _plant_only(scenario: Scenario) -> Scenario:
    """Return a scenario with only the plant, payloads and unilateral contacts: no controller, no forces over time."""
    from dynsim.scenario.combinations import BILATERAL_KEYS
    from dynsim.scenario.schema import Contacts, Payload

    config = scenario.config
    payloads = {name: load for name, load in config.loads.items() if isinstance(load, Payload)}
    keys = config.contacts.model_dump(exclude_unset=True, exclude=set(BILATERAL_KEYS))
    changes = {
        "controller": None,
        "sensors": None,
        "contacts": Contacts(**{**keys, "law": "unilateral"}),
        "loads": payloads,
        "initial": None,  # the ticks of the servos determine the posture
        "integrator": type(config.integrator)(method="dopri5"),  # every 2 ms, new set points end a step
    }
    if config.integrator.method == "time_stepping":
        step = min(config.integrator.step_s or ARM_STEP, SNAKE_STEP)
        changes["integrator"] = config.integrator.model_copy(update={"step_s": step, "wall_limit_s": None})
    if hasattr(config.plant, "dynamics"):
        released = config.plant.dynamics.model_copy(update={"start": "released"})
        changes["plant"] = config.plant.model_copy(update={"dynamics": released})
        changes["integrator"] = type(config.integrator)(method="time_stepping", step_s=SNAKE_STEP)
    return replace(scenario, config=config.model_copy(update=changes))


def simulated_arm(
    scenario_name: str, variant: str | None, servo_map: ServoMap, posture: dict[str, float]
) -> SimulatedArm:
    """Build the robot of a scenario as the plant that the servos of a map drive.

    Parameters
    ----------
    scenario_name : str
        Scenario file or name of a shipped scenario.
    variant : str or None
        Variant of the scenario; default: the first variant.
    servo_map : ServoMap
    posture : dict
        Initial joint angles [rad], by label; joints that are not listed start as in the scenario.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario does not exist, or its plant is kinematic and has no rigid-body model.
    ServoMapError
        If the servos of the map do not match the joints of the robot.
    """
    from dynsim.scenario import build, load_scenario

    scenario = load_scenario(scenario_name, variant=variant)
    robot = build.robot(scenario)
    initial = dict(zip(robot.joint_names, robot.initial[list(robot.position_index)].tolist(), strict=True))
    start = [posture.get(label, initial[joint]) for label, joint in served_joints(robot).items()]
    return SimulatedArm(scenario, servo_map, np.array(start))

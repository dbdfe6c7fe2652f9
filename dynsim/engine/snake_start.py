"""Lifting of a dynamic snake's wheel pairs, as joint angles, and its start: a preliminary run that raises the head.

The references at each tick are in :mod:`dynsim.engine.snake_pilot`. Because of gear friction a head that was raised
into its posture rests about 20 mm and 0.09 rad lower than one that was lowered into it. A real robot raises its head.
So a preliminary run before t = 0 lets the head settle below its posture, raises it, and lets it settle again.
Only the ground and payloads are part of it: objects, ties and other surfaces exist from t = 0 on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dynsim.compile.control import JointControl
from dynsim.compile.snake_tree import GROUND, SnakeTree, configuration, lifted_moments
from dynsim.errors import ModelError
from dynsim.model.description import Array
from dynsim.model.drives import Servo
from dynsim.scenario import Scenario, build
from dynsim.scenario.loads import Payload
from dynsim.scenario.schema import Integrator
from dynsim.snake.description import ModeTable
from dynsim.snake.lifting import height_of
from dynsim.system.memo import recall

# Angles by which the head starts below its posture, for its pitch joints in order from the base [rad] (assumed).
LOWERED = (0.10, 0.30, 0.15)
# Times to settle, to raise the head, and to settle again [s] (assumed).
SETTLE, RAISE, SETTLE_AGAIN = 0.5, 1.0, 1.0
# Ticks between two updates of the geometry of lifted pairs while their heights do not change.
STEADY_TICKS = 4


class WheelLifter:
    """Heights of the wheel pairs over time, and the resulting angles of the pitch joints on their axles.

    What is to be put down goes down before the next is lifted.
    """

    def __init__(self, robot: SnakeTree, grounded: Array) -> None:
        self._robot = robot
        self._grounded = grounded.copy()
        pairs = len(grounded)
        self._up, self._down = np.where(grounded == 0, -np.inf, np.inf), np.full(pairs, np.inf)
        servos = {motor.joint: motor for motor in robot.motors}
        chosen = [servo for joint in robot.lifting_joints if isinstance(servo := servos[joint], Servo)]
        # Torque per angle of the position loop [N m/rad].
        self._stiffness = np.array([servo.k_p * servo.torque_constant / servo.resistance for servo in chosen])

    def state(self) -> tuple[Array, Array, Array]:
        """What the future depends on."""
        return self._grounded.copy(), self._up.copy(), self._down.copy()

    def restore(self, state: tuple[Array, Array, Array]) -> None:
        """Go back to a state of this lifter."""
        self._grounded, self._up, self._down = (part.copy() for part in state)

    def change(self, time: float, grounded: Array) -> None:
        """From a time [s] on these pairs, (pairs,) 1 or 0, are to be on the ground."""
        blend = self._robot.lifts.blend_s
        put_down = (grounded == 1) & (self._grounded == 0)
        lifted = (grounded == 0) & (self._grounded == 1)
        self._down[put_down] = np.maximum(time, self._up[put_down] + blend) + blend
        begin = max([time, *self._down[put_down]])
        for pair in np.flatnonzero(lifted):
            landed = self._down[pair] if math.isfinite(self._down[pair]) else -math.inf
            self._up[pair], self._down[pair] = max(begin, landed), math.inf
        self._grounded = grounded.copy()

    def moving(self, time: float) -> bool:
        """Whether a height changes after a time [s]."""
        rising = np.isfinite(self._up) & (time < self._up + self._robot.lifts.blend_s)
        return bool((rising | (np.isfinite(self._down) & (time < self._down))).any())

    def heights(self, time: float) -> Array:
        """Of the pairs at a time [s], (pairs,) [m]."""
        return height_of(np.array(time), self._up, self._down, self._robot.lifts)

    def angles(self, time: float, yaw: Array) -> Array:
        """What is added to the pitch joints on the axles at a time [s] and yaw angles, both (pairs − 1,) [rad]."""
        return angles_of_heights(self._robot, self.heights(time), yaw, self._stiffness)


def angles_of_heights(robot: SnakeTree, height: Array, yaw: Array, stiffness: Array) -> Array:
    """Angles that bring pairs to heights (pairs,) [m], with what servos give way.

    ``stiffness`` : (pairs − 1,) of these servos [N m/rad]
    """
    if not height.any():
        return np.zeros(len(yaw))
    hinge = np.asarray(robot.base_part.fold(yaw[None], height[None]).hinge[0])
    if not robot.sag_compensation:
        return hinge
    # Moments of what is higher than s, averaged over s from zero to the clearance: they change without a jump.
    share, below = height / (1e-3 * robot.lifts.clearance_mm), 0.0
    for level in np.unique(share[share > 0.0]).tolist():
        hinge = hinge + (level - below) * lifted_moments(robot, share >= level) / stiffness
        below = level
    return hinge


def command_angles(robot: SnakeTree, phi: Array, added: Array) -> dict[str, float]:
    """What each joint servo is told: phi (n_phi,) and what lifting adds (pairs − 1,) [rad]."""
    angles = dict(zip(robot.description.joint_names, phi.tolist(), strict=True))
    for joint, angle in zip(robot.lifting_joints, added.tolist(), strict=True):
        angles[joint] = angles.get(joint, 0.0) + angle
    return angles


# Until when [s] servos follow lines, position and rate by joint.
Phase = tuple[float, Mapping[str, tuple[float, float]]]
# Coordinates that a scenario comes to from others, whose servos go through phases: dynsim.engine.prepare.follow_lines.
Follow = Callable[[Scenario, Array, Sequence[Phase]], Array]


def begun(scenario: Scenario, robot: SnakeTree, follow: Follow) -> tuple[SnakeTree, JointControl]:
    """The robot as a run begins, and what its servos hold until the controller, if there is one, tells them otherwise.

    ``follow`` : simulates the raising of the head

    Raises
    ------
    ModelError
        See :func:`dynsim.scenario.build.controller`; the control period is not a multiple of the step; or a mode lifts
        wheel pair 1.
    """
    d, config = robot.description, scenario.config
    controller = None if scenario.controller is None else build.controller(scenario, d)
    grounded = np.ones(d.pairs)
    if controller is not None:
        grounded = controller.law.grounded[controller.fixing_row].astype(np.float64)
        _check_step(config.integrator, controller.schedule.period)
        _check_modes(controller.modes)
    lifter = WheelLifter(robot, grounded)
    height, phi = lifter.heights(0.0), np.asarray(d.initial_joints)
    added = lifter.angles(0.0, phi[d.head_joints :])
    if robot.raised:
        alone = _alone(scenario)
        parts = alone.config
        known = parts.plant, parts.contacts, parts.integrator, parts.surfaces, parts.surface_error, parts.loads
        own = recall("raised", lambda: _raised(alone, height, added, follow), *known, grounded)
        # Objects start where the scenario places them.
        q = np.concatenate([own, robot.initial[len(own) :]])
    else:
        q = configuration(robot, phi, height)
    robot = replace(robot, q0=q)
    control = JointControl.absent(robot, command_angles(robot, phi, added))
    return robot, replace(control, task_space=controller)


def _check_step(integrator: Integrator, period: float) -> None:
    """ModelError unless the control period [s] is a multiple of the step of time stepping."""
    step = integrator.step_s
    if integrator.method == "time_stepping" and step and abs(period / step - round(period / step)) > 1e-9:
        raise ModelError(
            f"integrator.step_s = {step:g} s does not divide controller.period_s = {period:g} s; "
            f"{period / math.ceil(period / step):g} does",
            keys=("integrator", "step_s"),
        )


def _check_modes(modes: ModeTable) -> None:
    """ModelError where a mode lifts wheel pair 1: the head is on its body, and no joint raises it."""
    lifting = [str(number) for number, row in zip(modes.numbers, modes.grounded, strict=True) if row[0] == 0]
    if lifting:
        raise ModelError(
            f"controller.modes: {'mode' if len(lifting) == 1 else 'modes'} {', '.join(lifting)} cannot lift wheel "
            "pair 1 under plant.level: dynamic: it carries the head, and no joint raises it; remove pair 1, or use "
            "plant.level: kinematic",
            keys=("controller", "modes"),
        )


def _alone(scenario: Scenario) -> Scenario:
    """The scenario of the preliminary run: the robot and its payloads on the ground.

    Objects, ties and other surfaces are placed for the raised head. A plate just ahead of it would push against the
    lowered head and throw the robot back; a tied object would be dragged along.
    """
    config = scenario.config
    dynamics = scenario.plant.dynamics.model_copy(update={"start": "released"})
    points = {
        name: point
        for name, point in config.contacts.points.items()
        # Wheels of an object are named object.wheel.
        if point.surface == GROUND and point.body.partition(".")[0] not in config.objects
    }
    changes = {
        "plant": scenario.plant.model_copy(update={"dynamics": dynamics}),
        "controller": None,
        "initial": None,
        "loads": {name: load for name, load in config.loads.items() if isinstance(load, Payload)},
        "objects": {},
        "ties": {},
        "surfaces": {name: surface for name, surface in config.surfaces.items() if name == GROUND},
        "contacts": config.contacts.model_copy(update={"points": points}),
    }
    return replace(scenario, config=config.model_copy(update=changes))


def _raised(alone: Scenario, height: Array, added: Array, follow: Follow) -> Array:
    """Coordinates (nq,) of the robot alone after its head was raised into the initial posture."""
    robot = build.robot(alone)
    assert isinstance(robot, SnakeTree)
    d = robot.description
    lowered = np.zeros(len(d.joint_names))
    pitches = np.flatnonzero(d.pitch)[::-1][: len(LOWERED)]
    lowered[pitches] = LOWERED[: len(pitches)]
    below = np.clip(d.initial_joints - lowered, d.lower, d.upper)
    first, last = command_angles(robot, below, added), command_angles(robot, d.initial_joints, added)
    phases: list[Phase] = [
        (SETTLE, {joint: (angle, 0.0) for joint, angle in first.items()}),
        (SETTLE + RAISE, {joint: (angle, (last[joint] - angle) / RAISE) for joint, angle in first.items()}),
        (SETTLE + RAISE + SETTLE_AGAIN, {joint: (angle, 0.0) for joint, angle in last.items()}),
    ]
    return follow(alone, configuration(robot, below, height), phases)

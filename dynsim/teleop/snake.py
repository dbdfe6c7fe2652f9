"""Teleoperation sessions: a pilot commands a simulated arm or snake robot tick by tick ([T] IV.C for the snake).

A session executes the pilot's commands and records them in a script that reproduces the run.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.control import PLANNED
from dynsim.compile.references.teleop import BASE, HAND, VELOCITIES
from dynsim.engine import named
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.kinematic import make_record, prepare
from dynsim.engine.operator import Operator
from dynsim.engine.simulation import Simulation
from dynsim.engine.snake_control import SnakeControl
from dynsim.engine.snake_pilot import SnakePilot
from dynsim.engine.stepped import Touch
from dynsim.errors import ScenarioError
from dynsim.model.base_pose import base_pose
from dynsim.model.drives import TorqueSource
from dynsim.record import Record
from dynsim.record.poses import poses_at
from dynsim.record.scene import Scene
from dynsim.scenario import Scenario, build, require_scenario, scenario_from_resolved
from dynsim.snake import ticks as ss
from dynsim.snake.description import COORDINATES, FIXING, NO_REQUEST, SWITCHING, CommandBlock, Feedback

# Interface and data types for a teleoperated simulation.


Array = NDArray[np.float64]


@dataclass(frozen=True)
class PilotAxis:
    """One component of the commanded velocity.

    Attributes
    ----------
    name : str
        Name of the component, such as ``x`` or ``yaw``.
    group : str
        Part of the robot that moves: ``hand``, ``head``, ``gripper`` or ``base``.
    unit : str
        Unit of the velocity.
    limit : float
        Maximum velocity, in ``unit``.
    """

    name: str
    group: str
    unit: str
    limit: float


@dataclass(frozen=True)
class Command:
    """Command from the pilot for one tick of the simulation.

    Attributes
    ----------
    velocity : tuple of float
        Velocity of each axis [m/s, rad/s].
    request : int
        Requested mode: its number, or a constant from :mod:`dynsim.snake.description`, such as ``NO_REQUEST``.
    closed : bool
        True to close the gripper.
    """

    velocity: tuple[float, ...]
    request: int = NO_REQUEST
    closed: bool = False


@dataclass(frozen=True)
class LiveFrame:
    """State of the robot after a tick, to be shown to the pilot.

    Attributes
    ----------
    time : float
        Simulation time [s].
    poses : array, shape (bodies, 7)
        Positions [m] and quaternions (w, x, y, z) of the bodies.
    hand : array, shape (3,)
        Target position of the hand [m].
    hindrance : str
        Reason why the command is not fully executed; empty if it is fully executed.
    extra : dict
        Further entries for the page: wheels, gripper and ``mode`` of a snake robot.
    touching : mapping of str to Touch
        Contact states, by the name of the contact point.
    """

    time: float
    poses: Array
    hand: Array
    hindrance: str
    extra: dict[str, Any]
    touching: Mapping[str, Touch]


@dataclass(frozen=True)
class SpeedLimits:
    """Maximum velocities that a pilot can command.

    Attributes
    ----------
    hand : float
        Maximum speed of a hand or head [m/s].
    turn : float
        Maximum turning rate of a head or base [rad/s].
    base : float
        Maximum speed of a mobile base [m/s].
    """

    hand: float = 0.1
    turn: float = 0.5
    base: float = 0.3


def with_controller(scenario: Scenario, duration: float, controller: dict[str, Any]) -> Scenario:
    """Return a copy of the scenario with a different duration [s] and controller."""
    return scenario_from_resolved({**scenario.resolved, "duration_s": duration, "controller": controller})


def _record_until(simulation: Simulation, end: float, script: Scenario) -> Record:
    """Return the record of a run that ends at a tick [s], whose command is not known yet; the simulation continues."""
    before = simulation.snapshot()
    if not simulation.finished:
        simulation.end_samples(end)
        simulation.advance(end)
    record = simulation.record(script)
    simulation.restore(before)
    record.complete = "stopped" not in record.provenance
    return record


log = logging.getLogger(__name__)

REQUESTS = {SWITCHING: "switching", FIXING: "fixing"}


class SnakeSession:
    """Session of a kinematic snake robot; see :data:`dynsim.teleop.snake.Session`.

    The session is the :class:`~dynsim.snake.description.CommandSource` for its own run. ``longest`` is the maximum
    duration [s].
    """

    has_gripper = True

    def __init__(self, scenario: Scenario, limits: SpeedLimits, longest: float) -> None:
        controller = scenario.resolved["controller"] | {"commands": [], "paths": [], "commands_wait": False}
        self._scenario, self._controller = scenario, controller
        self._command = Command((0.0,) * 6)
        self._commands: list[dict[str, Any]] = []
        self._begin(with_controller(scenario, longest, controller))
        group = "gripper" if self._run.description.point_offset > 0.0 else "head"
        self.axes = tuple(
            PilotAxis(name, group, *(("m/s", limits.hand) if k < 3 else ("rad/s", limits.turn)))
            for k, name in enumerate(COORDINATES)
        )
        self.modes = self._run.controller.modes.numbers
        self.period = self._run.controller.schedule.period

    _run: SnakeControl

    def _begin(self, scenario: Scenario) -> None:
        """Prepare the run, load its kernels, and record its start."""
        run = self._kinematic = prepare(scenario, self)
        run.load_kernels()
        self._run = run
        self.still = make_record(run, self._scenario, 0.0)
        assert self.still.scene is not None
        self._scene: Scene = self.still.scene

    @property
    def ticks(self) -> int:
        """Number of control periods that have been executed."""
        return self._run.tick

    @property
    def time(self) -> float:
        """Simulation time [s]."""
        return self._run.time

    @property
    def finished(self) -> bool:
        """True if the maximum duration has passed."""
        return self.ticks >= self._run.ticks

    def read(self, first: int, count: int, period: float, feedback: Feedback) -> CommandBlock:
        """Return the present command for one period."""
        command = self._command
        # Add zero to avoid negative zeros, which a script does not contain either.
        velocity = np.zeros((1, 6)) + np.array(command.velocity)
        return CommandBlock(velocity, np.array([command.request]), np.array([int(command.closed)]))

    def tick(self, command: Command) -> None:
        """Advance by one control period."""
        before, self._command = self._command, command
        entry: dict[str, Any] = {}
        if command.velocity != before.velocity:
            entry["velocity"] = [value + 0.0 for value in command.velocity]
        if command.request != NO_REQUEST:
            entry["mode"] = REQUESTS.get(command.request, command.request)
        if command.closed != before.closed:
            entry["gripper"] = "closed" if command.closed else "open"
        if entry:
            self._commands.append({"at_s": self.ticks * self.period, **entry})
        if self.ticks == 0:
            # Replace the commands that had been read when the run was prepared.
            self._run.read_commands(waiting=False)
        self._advance()

    def _advance(self) -> None:
        self._kinematic.advance()

    def frame(self) -> LiveFrame:
        """Return the present state, to be shown to the pilot."""
        run, state = self._run, self._run.state
        row = int(state.counts[ss.MODE])
        return LiveFrame(
            time=self.time,
            poses=poses_at(self._scene, self._positions()),
            hand=state.w_target[:3].copy(),
            hindrance=self._hindrance(),
            extra={
                "wheels": run.controller.law.grounded[row].tolist(),
                "gripper": int(self._command.closed),
                "mode": run.mode,
                **self._grip(),
            },
            touching=self._touching(),
        )

    def _positions(self) -> Mapping[str, Mapping[str, float]]:
        """Return the joint positions of the scene, by signal and label."""
        run, state = self._run, self._run.state
        objects = (
            {}
            if self._kinematic.objects is None
            else {"q": self._kinematic.objects.positions(run.tick, run.posture()[0])}
        )
        return objects | {
            "base_pose": dict(zip(("x", "y", "yaw"), state.base.tolist(), strict=True)),
            "phi": dict(zip(run.description.joint_names, state.phi.tolist(), strict=True)),
            "rho": dict(zip(run.description.wheel_names, state.rho.tolist(), strict=True)),
        }

    def _grip(self) -> dict[str, str]:
        """Return a description of the gripper state; it is empty if there are no objects to grip."""
        objects = self._kinematic.objects
        return {} if objects is None else {"grip": objects.state_in_words(self.ticks)}

    def _touching(self) -> Mapping[str, Touch]:
        return {}

    def _hindrance(self) -> str:
        """Return the reason why the target pose does not advance; empty if it advances."""
        return self._run.hindrance

    def joints(self) -> Mapping[str, Array]:
        """Return joint and wheel angles, and grounded wheel pairs.

        Rates are omitted, because they are constant in each period: they are differences of angles.
        """
        run, state = self._run, self._run.state
        grounded = run.controller.law.grounded[int(state.counts[ss.MODE])]
        return {"phi": state.phi.copy(), "rho": state.rho.copy(), "grounded": grounded}

    def record(self) -> Record:
        """Return the record of all ticks so far; its scenario contains the script of commands."""
        duration = max(self.ticks, 1) * self.period
        return self._record(with_controller(self._scenario, duration, {**self._controller, "commands": self._commands}))

    def _record(self, script: Scenario) -> Record:
        return make_record(self._kinematic, script, 0.0)


class DynamicSnakeSession(SnakeSession):
    """Session of a dynamic snake robot, with servos and slipping wheels; the simulation reads the commands."""

    def _begin(self, scenario: Scenario) -> None:
        with kernels_logged(log):
            trial = Simulation(scenario, duration=math.inf, operator=self)
            trial.advance(2.0 * self._pilot(trial).period)
        self.still = trial.record(self._scenario)
        self.still.complete = True
        self._simulation = Simulation(scenario, duration=math.inf, operator=self)
        self._run = self._pilot(self._simulation)
        assert self.still.scene is not None
        self._scene = self.still.scene

    @staticmethod
    def _pilot(simulation: Simulation) -> SnakePilot:
        assert isinstance(simulation.operator, SnakePilot)
        return simulation.operator

    @property
    def time(self) -> float:
        """Simulation time [s], which is half a tick before the time of the last tick."""
        return self._simulation.time

    def _advance(self) -> None:
        self._simulation.advance((self.ticks + 0.5) * self.period)

    def _positions(self) -> Mapping[str, Mapping[str, float]]:
        q = self._simulation.state.q.tolist()
        return {"q": dict(zip(self._simulation.robot.position_names, q, strict=True))}

    def _grip(self) -> dict[str, str]:
        grip = self._pilot(self._simulation).grip
        return {} if grip is None else {"grip": grip.state_in_words}

    def _touching(self) -> Mapping[str, Touch]:
        return self._simulation.touching

    def _record(self, script: Scenario) -> Record:
        longest, self._run.ticks = self._run.ticks, self.ticks
        record = _record_until(self._simulation, self.ticks * self.period, script)
        self._run.ticks = longest
        return record


# Teleoperation of an arm: at each tick, the commanded velocities of the hand and the mobile base become references.


_NAMES = ("x", "y", "z", "ahead", "turn")
# Velocity used in the trial ticks that load the kernels [m/s].
_SMALL = 1e-6


class ArmSession:
    """Session of an arm; see :data:`dynsim.teleop.snake.Session`.

    The session is the :class:`~dynsim.compile.references.teleop.VelocitySource` for its own simulation. ``longest`` is
    the maximum duration [s].
    """

    modes: tuple[int, ...] = ()
    has_gripper = False

    def __init__(self, scenario: Scenario, limits: SpeedLimits, longest: float) -> None:
        controller = scenario.resolved["controller"]
        if "operator" not in type(scenario.controller).model_fields:
            raise ScenarioError(f"controller {scenario.controller.type!r} cannot follow an operator; use joint_pd")
        operator = controller.get("operator") or _default_operator(scenario, controller)
        self._controller = {key: value for key, value in controller.items() if key not in PLANNED}
        self._operator = {**operator, "commands": []}
        self._scenario, self._longest = scenario, longest
        self._velocity, self._last = np.zeros(VELOCITIES), np.zeros(VELOCITIES)
        self._velocity[HAND] = _SMALL
        begun = with_controller(scenario, longest, {**self._controller, "operator": self._operator})
        # Run two ticks of another simulation, to load or compile the kernels.
        with kernels_logged(log):
            trial = Simulation(begun, duration=math.inf, operator=self)
            trial.advance(2.0 / trial.operator.rate if trial.operator is not None else 0.0)
        self.still = trial.record()
        self.still.complete = True
        self._velocity = np.zeros(VELOCITIES)
        self.simulation = Simulation(begun, duration=math.inf, operator=self)
        self._rate = float(self._operator.get("rate_hz", 100.0))
        self.period, self.ticks = 1.0 / self._rate, 0
        self._commands: list[dict[str, Any]] = []
        robot = self.simulation.robot
        units = {"ahead": ("m/s", limits.base), "turn": ("rad/s", limits.turn)}
        driven = {motor.joint for motor in robot.motors}
        self._parts = list(range(VELOCITIES))[HAND] if self._operator.get("joints") else []
        if robot.base is not None and driven.issuperset(robot.base.wheels):
            self._parts += list(range(VELOCITIES))[BASE]
        if not self._parts:
            raise ScenarioError(
                "no joint to drive; list joints in controller.operator.joints "
                f"(joints with a motor: {', '.join(sorted(driven)) or 'none'})"
            )
        self.axes = tuple(
            PilotAxis(_NAMES[k], "hand" if k < BASE.start else "base", *units.get(_NAMES[k], ("m/s", limits.hand)))
            for k in self._parts
        )

    @property
    def time(self) -> float:
        """Simulation time [s], which is half a tick before the time of the next command."""
        return self.simulation.time

    @property
    def finished(self) -> bool:
        """True if the maximum duration has passed or the simulation has ended."""
        return self.simulation.finished or self.ticks >= self._longest * self._rate

    def read(self, tick: int) -> Array:
        """Return the present command; ``tick`` is ignored."""
        return self._velocity

    def tick(self, command: Command) -> None:
        """Advance to half a period before the next tick, which reads the next command."""
        velocity = np.zeros(VELOCITIES)
        velocity[self._parts] = command.velocity
        velocity += 0.0
        entry: dict[str, Any] = {}
        for name, part in (("hand", HAND), ("base", BASE)):
            if not np.array_equal(velocity[part], self._last[part]):
                entry[name] = velocity[part].tolist()
        if entry:
            self._commands.append({"at_s": self.ticks / self._rate, **entry})
        self._velocity = self._last = velocity
        self.ticks += 1
        self.simulation.advance((self.ticks - 0.5) / self._rate)

    def frame(self) -> LiveFrame:
        """Return the present state, to be shown to the pilot."""
        simulation, scene = self.simulation, self.still.scene
        robot, operator = simulation.robot, simulation.operator
        assert isinstance(operator, Operator)
        assert scene is not None
        q = simulation.state.q
        positions = {"q": dict(zip(robot.position_names, q.tolist(), strict=True))}
        if robot.base is not None:
            pose = base_pose(robot, q[None])[0].tolist()
            positions["base_pose"] = dict(zip(("x", "y", "heading"), pose, strict=True))
        return LiveFrame(
            time=simulation.time,
            poses=poses_at(scene, positions),
            hand=operator.target.copy(),
            hindrance=operator.hindrance,
            extra={},
            touching=simulation.touching,
        )

    def joints(self) -> Mapping[str, Array]:
        """Return positions and rates of all joints of the model."""
        state = self.simulation.state
        return {"q": state.q, "v": state.v}

    def record(self) -> Record:
        """Return the record of all ticks so far; its scenario contains the script of commands."""
        # Compute the end from the number of ticks, because a rounding error would change the last step when the run is
        # repeated.
        duration = max(self.ticks, 1) * self.period
        operator = {**self._operator, "commands": self._commands}
        script = with_controller(self._scenario, duration, {**self._controller, "operator": operator})
        return _record_until(self.simulation, self.ticks * self.period, script)


def _default_operator(scenario: Scenario, controller: dict[str, Any]) -> dict[str, Any]:
    """Return the default operator entry: it moves the joints of the hand path or, without one, all suitable joints.

    Suitable joints are those with position control that are not wheels. If there is no hand path and the arm has
    bilateral contacts, the result is empty.
    """
    if (hand := controller.get("hand")) is not None:
        return {key: hand[key] for key in ("joints", "braces", "tolerance_m") if key in hand}
    robot, touching = build.robot_and_contacts(scenario)
    if touching and scenario.config.contacts.law != "unilateral":
        return {}
    wheels = () if robot.base is None else robot.base.wheels
    return {"joints": [m.joint for m in robot.motors if not isinstance(m, TorqueSource) and m.joint not in wheels]}


# Function that starts the session for a scenario.


Session = SnakeSession | ArmSession
"""Simulation that a pilot commands.

Attributes
----------
axes : tuple of PilotAxis
    Components of the commanded velocity.
modes : tuple of int
    Modes that may be requested.
has_gripper : bool
    True if the robot has a gripper.
period : float
    Duration of a tick [s].
ticks : int
    Number of ticks so far.
time : float
    Simulation time [s]: the time of the last tick, or half a tick earlier.
finished : bool
    True if the maximum duration has passed or the simulation has ended.
still : Record
    Short record of the robot at its start, from which the page is built.
"""


def begin(scenario: Scenario, *, limits: SpeedLimits | None = None, longest: float = 600.0) -> Session:
    """Start a session of a scenario with its plant, surfaces, contacts and loads; a pilot replaces its references.

    Parameters
    ----------
    scenario : Scenario
    limits : SpeedLimits, optional
        Maximum velocities.
    longest : float, optional
        Maximum duration [s].

    Raises
    ------
    ScenarioError
        If the scenario has no controller whose references a pilot can command.
    """
    require_scenario(scenario)
    with named(scenario):
        if scenario.controller is None:
            raise ScenarioError("a live drive requires a controller; add one, such as joint_pd")
        session: type[SnakeSession] | type[ArmSession] = ArmSession
        if scenario.controller.type == "task_space":
            session = SnakeSession if scenario.engine == "kinematic" else DynamicSnakeSession
        return session(scenario, limits or SpeedLimits(), longest)

"""Task-space control of the dynamic snake: it sets references for the servos of joints and wheels at every tick.

Order within a tick t_k: sensors, controller, modes and lifts, references. Joint servos follow the integrated command,
q_d(t) = φ + u (t − t_k), with commanded angles φ and rates u, independent of the actual joint angles ([T] IV.C); wheel
servos follow rates. The state that the controller uses:

    feedforward   its own command, integrated ([T] IV.C.2)
    estimated     encoders of the joints; x, y, γ of the head integrated ([T] IV.C.1)
    measured      motion capture of the head ([T] V.A, Fig 7b); joints as commanded
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.clearance import poses
from dynsim.compile.model import Model
from dynsim.compile.snake_tree import GROUND, HEAD, ROOT, SnakeTree
from dynsim.engine.gripper import GripperControl
from dynsim.engine.kinematic import add_task, effort, hold_last, task_summary, task_warnings
from dynsim.engine.operator import Referenced, SampledSensor
from dynsim.engine.saved_state import Stateful
from dynsim.engine.snake_control import SnakeControl, WheelLifter
from dynsim.engine.stepped import State
from dynsim.errors import SimulationStopped
from dynsim.integrators.run import QUEUE_LENGTH
from dynsim.jit.kernel import FixedSignature
from dynsim.model.description import Array
from dynsim.model.drives import Servo
from dynsim.model.gripper import graspable
from dynsim.record import Record
from dynsim.scenario.schema import Sensors
from dynsim.snake import ticks as ss
from dynsim.snake.description import CommandSource, TaskSpaceController
from dynsim.snake.ticks import FEEDFORWARD, GIVEN, MEASURED, NOT_FINITE, SnakeTrace, command_ticks, record_rows

_ROOT_COORDINATES = 7
# Interval of the overload checks, and duration of an overload after which the run ends [s].
OVERLOAD_LOOK, OVERLOAD_TIME = 0.1, 0.5
# Distance below the target beyond which the head counts as far too low [m], and tilt beyond which the robot counts as
# overturned [rad] (both assumed).
SAG, OVERTURNED = 0.05, 0.8


class SnakePilot(Stateful, SnakeControl):
    """Control of a dynamic snake, called at the ticks of its simulation.

    Parameters
    ----------
    model : Model
        Model of a :class:`~dynsim.compile.snake_tree.SnakeTree`.
    controller : TaskSpaceController
        Controller.
    ticks : int
        Number of control periods of the run.
    stride : int
        Number of control periods between recorded samples.
    source : CommandSource, optional
        Source of the commands instead of the controller's script.
    sensors : Sensors, optional
        Sensors through which the controller observes the robot.
    """

    SAVED = (
        "state", "gripper", "block", "block_start", "blocked", "recovering", "switch_due", "switcher", "grip",
        "_lifter", "_row", "_added", "_added_rate", "_update", "_begun", "_commanded", "_overloaded_since",
    )  # fmt: skip
    path = None  # the record has the target as part of the controller state

    def __init__(
        self,
        model: Model,
        controller: TaskSpaceController,
        ticks: int,
        stride: int,
        source: CommandSource | None = None,
        sensors: Sensors | None = None,
    ) -> None:
        robot = model.robot
        assert isinstance(robot, SnakeTree)
        state_source = controller.schedule.state_source
        schedule = controller.schedule._replace(state_source=GIVEN if state_source == MEASURED else FEEDFORWARD)
        # A predicted period continues from the present estimate, as feedforward does.
        prediction = controller.prediction._replace(state_source=FEEDFORWARD)
        controller = replace(controller, schedule=schedule, prediction=prediction)
        d = robot.description
        chosen = controller.source if source is None else source
        super().__init__(d, d.arrays(), controller, chosen, ticks, stride)
        self.state_source, self.tree, self.robot = state_source, model, robot
        self.period, self.rate = schedule.period, 1.0 / schedule.period
        self._joints = _places(robot, d.joint_names)
        # Head contacts with the ground. The last joint of the head part is at the axle of wheel pair 1.
        ends = (HEAD, f"{HEAD}_end", *d.joint_names[: d.head_joints - 1])
        self._head_contacts = frozenset([*ends, *(f"{name}_{GROUND}" for name in ends)])
        # Motors with position and rate references: joints, pitch joints that only lift, and wheels.
        joints = (*d.joint_names, *robot.lifting_joints[1:])
        motors = [motor.joint for motor in robot.motors]
        self._motors = np.array([motors.index(joint) for joint in (*joints, *robot.wheel_joints)])
        self._command = FixedSignature(command_ticks)
        self._lines = np.zeros((1 + QUEUE_LENGTH, len(self._motors), 2))
        # Number of ticks until the simulation may change otherwise, and queue of references for these ticks.
        self.ticks_ahead: Callable[[], int] = lambda: 0
        self.queue: Callable[[NDArray[np.int64], Array], None]
        # Bodies at whose origins the drawn polyline has its corners, from the hand to the axle of the tail.
        chain = list(d.joint_names[: d.head_joints + 1])
        for k in range(1, d.base_joints):
            chain += [robot.lifting_joints[k], d.joint_names[d.head_joints + k]]
        body_of = {link.joint: link.name for link in robot.links}
        self._chain, self._tail = [body_of[joint] for joint in chain], f"pair{d.pairs}"
        self._lifter = WheelLifter(robot, controller.law.grounded[controller.fixing_row].astype(np.float64))
        self._row = controller.fixing_row
        self._added = self._lifter.angles(0.0, self.state.phi[d.head_joints :])
        self._added_rate = np.zeros_like(self._added)
        servos = {motor.joint: motor for motor in robot.motors if isinstance(motor, Servo)}
        self._volts_per_rad = np.array([servos[joint].k_p for joint in d.joint_names])
        self._volts = np.array([servos[joint].voltage_limit for joint in d.joint_names])
        self._overload_ticks = max(1, round(OVERLOAD_LOOK / self.period))
        self._overloaded_since: float | None = None
        self.sensors = self._sensors(sensors or Sensors())
        objects = graspable(robot)
        self.grip = GripperControl(model, robot.gripper, objects, self.period) if objects else None
        # Tick of the next update of the rates of lifting; state and this tick before the last call with several ticks.
        self._update = self._commanded = 0
        self._begun = list[Array](), 0
        self._seen: Any = None
        self.read_commands(waiting=False)

    @property
    def blind(self) -> bool:
        """Whether the controller uses no sensors."""
        return bool(self.state_source == ss.FEEDFORWARD)

    def posture(self) -> tuple[Array, Array, Array]:
        """Return the actual posture instead of the controller's estimate, see :meth:`SnakeControl.posture`."""
        if self._seen is None:
            return super().posture()
        q = self._seen.q
        return self.head_pose(q), base_pose(q), q[self._joints]

    def head_pose(self, q: Array) -> Array:
        """Return the pose w of the controlled point at coordinates (nq,), (6,) [m, rad]."""
        body, point = self.robot.hand
        R, p = self.tree.body_pose(body, q)
        return np.concatenate([p + R @ point, roll_pitch_yaw(R)])

    def __call__(self, simulation: Referenced) -> None:
        """Run control periods: rewrite the references up to the next tick, and queue those of the ticks after it.

        Without sensors, the commands do not depend on the robot's motion. They are computed for several ticks at once,
        unless something must be done at a tick before.
        """
        tick, time, state, lifter = self.tick, self.time, self.state, self._lifter
        if tick >= self.ticks:
            return
        if self._update < 0:
            raise self._failed()
        self._seen = simulation.state
        if tick % self._overload_ticks == 0:
            self._refuse_overload(simulation)
        self._read_sensors()
        self.begin_period()
        if self.grip is not None:
            self.grip.step(time, bool(self.gripper[tick]), self._seen, simulation)
        mode, count = int(state.counts[ss.MODE]), 1
        if mode != self._row:
            self._row, self._update = mode, 0
            lifter.change(time, self.controller.law.grounded[mode].astype(np.float64))
        if self.blind and self.grip is None and not self.recovering and (ahead := self.ticks_ahead()) > 0:
            looks = self._overload_ticks - tick % self._overload_ticks
            count = min(1 + ahead, looks, self.periods(), self.ticks - tick)
            self._begun = [array.copy() for array in self._changing()], self._update
        done, blocked = self._command_ticks(count)
        if done == 0:
            raise self._failed()
        self.end_period(blocked)
        # Joint servos follow their rates from here on, and lifting adds to the pitch joints on the axles.
        simulation.set_lines(self._motors, self._lines[0])
        if done > 1:
            self.queue(self._motors, self._lines[1:done])

    def _command_ticks(self, count: int) -> tuple[int, bool]:
        """Command periods, see :func:`command_ticks`; return their number, and whether the last one was blocked."""
        lifter, controller = self._lifter, self.controller
        moving, slows = int(not self.recovering), int(controller.when_blocked)
        done, blocked, self._update = self._command(
            self.model, controller.law, controller.schedule, self.state, self.block.velocity, moving, slows, self.ws,
            self.stride, self.trace, lifter.lifting, lifter.up, lifter.down, self._added, self._added_rate,
            self._update, count, self._lines,
        )  # fmt: skip
        self._commanded = (self.tick - 1) // self.stride + 1
        return done, blocked

    def _changing(self) -> list[Array]:
        """Return the arrays that a command changes, except the trace."""
        return [*self.state, self._added, self._added_rate]

    def rewind(self, queued: int) -> None:
        """Return to the last tick that the simulation has reached, ``queued`` ticks ago."""
        reached = self.tick - queued
        begun, self._update = self._begun
        for array, value in zip(self._changing(), begun, strict=True):
            array[...] = value
        self._command_ticks(reached - self.tick)

    def _failed(self) -> SimulationStopped:
        """Return the exception for the last period."""
        if self._update == NOT_FINITE:
            return self.diverged()
        time = (self.tick - 1) * self.period
        return SimulationStopped(
            f"too_far: no pitch angles can lift the wheel pairs of mode {self.mode} at t = {time:g} s: the base part "
            "is bent too much",
            time=time,
            state=self.postures(),
        )

    def _refuse_overload(self, simulation: Referenced) -> None:
        """Stop if the robot overturns, or if a servo is saturated and the head stays far below its target."""
        q, time = self._seen.q, self.time
        _, x, y, _ = q[3:_ROOT_COORDINATES].tolist()
        tilt = math.acos(max(1.0 - 2.0 * (x * x + y * y), -1.0))
        if tilt > OVERTURNED:
            text = f"overturned: {ROOT}, which carries the head, is tilted by {np.degrees(tilt):.0f}° at t = {time:g} s"
            raise SimulationStopped(text, time=time, state=self.postures(), kind="overturned")
        overloaded = np.abs(self._volts_per_rad * (self.state.phi - q[self._joints])) >= self._volts
        if not overloaded.any():
            self._overloaded_since = None
            return
        below = float(self.state.w_target[2] - self.head_pose(q)[2])
        on_ground = any(touch.force > 0.0 for name, touch in simulation.touching.items() if name in self._head_contacts)
        if not (on_ground or below > SAG):
            self._overloaded_since = None
        elif self._overloaded_since is None:
            self._overloaded_since = time
        elif time - self._overloaded_since >= OVERLOAD_TIME:
            names = ", ".join(np.array(self.description.joint_names)[overloaded])
            how = "the head lies on the ground" if on_ground else f"the head is {1e3 * below:.0f} mm below its target"
            raise SimulationStopped(
                f"too_heavy: {how} at t = {time:g} s, with {names} at the voltage limit since "
                f"t = {self._overloaded_since:g} s",
                time=time,
                state=self.postures(),
                kind="too_heavy",
            )

    def _read_sensors(self) -> None:
        """Update the controller's state from the sensors."""
        self.state.base[:] = base_pose(self._seen.q)
        for sensor in self.sensors:
            estimate = self.state.w_hat if self.state_source == ss.MEASURED else self.state.phi_hat
            estimate[:] = sensor.value(self._seen.time)

    def _sensors(self, config: Sensors) -> list[SampledSensor]:
        """Return the sensors of the controller; feedforward uses none."""

        def sensor(read: Callable[[State], Array], of: Any, noise: Array, resolution: Array) -> SampledSensor:
            period = self.period if of is None or of.rate_hz is None else 1.0 / of.rate_hz
            delay, seed = 0.0 if of is None else of.delay_s, [config.seed, self.state_source]
            return SampledSensor(read, period=period, delay=delay, noise=noise, resolution=resolution, seed=seed)

        if self.state_source == ss.MEASURED:
            capture = config.motion_capture
            noise = np.zeros(6)
            if capture is not None:
                noise[:3], noise[3:] = capture.position_noise_m, capture.attitude_noise_rad
            return [sensor(lambda state: self.head_pose(state.q), capture, noise, np.zeros(6))]
        if self.state_source == ss.ESTIMATED:
            encoders = config.encoders
            deg = np.zeros(2) if encoders is None else np.radians([encoders.noise_deg, encoders.resolution_deg])
            noise, resolution = np.repeat(deg, len(self._joints)).reshape(2, -1)
            return [sensor(lambda state: state.q[self._joints], encoders, noise, resolution)]
        return []

    def saved_state(self) -> dict[str, Any]:
        """Return the state of the control, of its sensors and of the recorded samples."""
        return super().saved_state() | {
            "trace": [array[: self._commanded].copy() for array in self.trace],
            "rates": self.ws.work.u.copy(),
            "sensors": [sensor.saved_state() for sensor in self.sensors],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the result of :meth:`saved_state`."""
        super().restore(state)
        for mine, array in zip(self.trace, state["trace"], strict=True):
            mine[: len(array)] = array
        self.ws.work.u[...] = state["rates"]
        for sensor, part in zip(self.sensors, state["sensors"], strict=True):
            sensor.restore(part)

    def add_to(self, record: Record) -> None:
        """Add signals and summary of the control, and the signals of joints and wheels under their snake names."""
        q, v = record["q"], record["v"]
        if len(record) == 0:
            return
        # The last sample may be between ticks, at the end of the run.
        ticks = np.floor(record.time / self.period + 1e-6).astype(int) // self.stride
        d, axle = self.description, np.array([-self.description.link_length, 0.0, 0.0])
        trace = SnakeTrace(*(array[ticks] for array in self.trace))
        commanded = trace.phi.copy()
        trace.base[:], trace.phi[:] = [base_pose(row) for row in q], q[:, self._joints]
        trace.rho[:] = q[:, _places(self.robot, self.robot.wheel_joints)]
        end, begun = float(record.time[-1]), float(ticks[-1] * self.stride * self.period)
        between, before = end > begun + 1e-6 * self.period, trace.w_target[-1].copy()
        if between or ticks[-1] >= self._commanded:
            trace.mode[-1], trace.w_target[-1] = self.state.counts[ss.MODE], self.state.w_target
            commanded[-1], trace.w_hat[-1] = self.state.phi, self.state.w_hat
        if between:
            # Joints have followed linear references since the last tick, and the target has already moved to the next
            # tick.
            now = self.tick * self.period
            commanded[-1] += (end - now) * self.ws.work.u[: commanded.shape[1]]
            if end < now:
                trace.w_target[-1] = before + (end - begun) / (now - begun) * (self.state.w_target - before)
        hold_last(trace)
        record_rows(self.model, self.controller.law, deepcopy(self.state), self.ws, trace)
        # Controlled point, joints and axles to the tail.
        (head, point), places = self.robot.hand, {link.name: (R, p) for link, R, p in poses(self.robot, q)}
        ends = [
            (p + np.einsum("ijt,j->it", R, x)).T for R, p, x in ((*places[head], point), (*places[self._tail], axle))
        ]
        w = np.hstack([ends[0], roll_pitch_yaw(np.moveaxis(places[head][0], -1, 0))])
        points = np.stack([ends[0], *(places[body][1].T for body in self._chain), ends[1]], axis=1)
        slip = np.linalg.norm(record["contact_slip_velocity"], axis=2)
        trace.slip[:] = np.where(record["contact_normal_force"] > 0.0, slip, 0.0).max(axis=1)
        rate = dict(zip(record.labels["v"], v.T, strict=True))
        names, columns, add = d.joint_names, len(d.joint_names), record.add
        add("phi", trace.phi, "rad", labels=names, description="joint angles, head to tail")
        add("rho", trace.rho, "rad", labels=d.wheel_names, description="angles of the active wheels")
        rates = np.stack([rate[joint] for joint in names], axis=1)
        add("phi_dot", rates, "rad/s", labels=names, description="joint rates")
        rates = np.stack([rate[joint] for joint in self.robot.wheel_joints], axis=1)
        add("rho_dot", rates, "rad/s", labels=d.wheel_names, description="rates of the active wheels")
        text = "joint angles commanded to the servos, without lifting"
        add("phi_command", commanded, "rad", labels=names, description=text)
        text = "commanded rates, held from this time on"
        add("phi_dot_command", trace.u[:, :columns], "rad/s", labels=names, description=f"joint {text}")
        add("rho_dot_command", trace.u[:, columns:], "rad/s", labels=d.wheel_names, description=f"wheel {text}")
        add_task(record, self, trace, w, points)
        if self.grip is not None:
            self.grip.add_to(record)
        summary = {**record.summary, **task_summary(self, record), **effort(record.summary)}
        record.summary = {**summary, "warnings": [*summary["warnings"], *task_warnings(self, record, summary)]}


def _places(robot: SnakeTree, joints: tuple[str, ...]) -> Array:
    """Return the indices of joint coordinates in q."""
    places = dict(zip(robot.joint_names, robot.position_index, strict=True))
    return np.array([places[joint] for joint in joints])


def base_pose(q: Array) -> Array:
    """Return x, y [m] of wheel pair 1 and yaw [rad] of the base part at coordinates (nq,) of the tree, (3,)."""
    px, py, _, w, x, y, z = q[:_ROOT_COORDINATES].tolist()
    # Use the yaw of the axle, e_y of the root, because the axle stays level even if the body behind it is tilted.
    return np.array([px, py, math.atan2(-2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z))])


def roll_pitch_yaw(R: Array) -> Array:
    """Return α, β, γ of R = Rz(γ) Ry(β) Rx(α), (…, 3, 3) → (…, 3) [rad]."""
    return np.stack(
        [
            np.arctan2(R[..., 2, 1], R[..., 2, 2]),
            np.arctan2(-R[..., 2, 0], np.hypot(R[..., 2, 1], R[..., 2, 2])),
            np.arctan2(R[..., 1, 0], R[..., 0, 0]),
        ],
        axis=-1,
    )

"""Simulation of multibody plants: the public stepper :class:`Simulation`, the check of a start, and complete runs.

As long as the caller changes nothing, the steps are bit-identical to :func:`dynsim.simulate`, because ``advance`` does
not shorten them. The step that passes the requested time is kept pending, and the state at that time is interpolated
from its dense output. If the caller then makes a change, this step is discarded, and a shorter one ends at the
requested time.
"""

from __future__ import annotations

import logging
import math
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.compile.clearance import by_surface, sinking
from dynsim.compile.control import END_SLACK
from dynsim.compile.model import Model
from dynsim.compile.posture import holding_torques, load_forces, static_margin
from dynsim.compile.references.teleop import VelocitySource
from dynsim.compile.tables import check_couplings, joint_stops
from dynsim.compile.tie_rests import deflection, may_have_slid, rest_here, set_rests
from dynsim.compile.touching import gap_at
from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.drive.law import follow_lines, take_commands
from dynsim.dynamics.state import block
from dynsim.dynamics.tree import loads as kl
from dynsim.dynamics.tree.joints import normalise
from dynsim.engine import SIMULATION, Progress, Start, stopping
from dynsim.engine.brakes import Brakes, projection_loss
from dynsim.engine.linearization import Linearization, linearized
from dynsim.engine.link_sensors import AppliedWrench
from dynsim.engine.operator import EncodedCommands, Operator
from dynsim.engine.outcome import interrupted, mark_stopped, raise_stopped, run_to_end
from dynsim.engine.prepare import Prepared, at_start, prepare, sample_times
from dynsim.engine.recording import drawn_scene, make_record
from dynsim.engine.soundness import unstable_loop
from dynsim.engine.stepped import GUARDS, Snapshot, State, Touch, event_name, take_log
from dynsim.engine.stopping import last_state, stopped
from dynsim.engine.target_distance import head_distance
from dynsim.engine.trace import BLOCK, Trace
from dynsim.errors import ModelError, ScenarioError, SimulationInterrupted, SimulationStopped, brief, first_few
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.integrators.run import state_within
from dynsim.jit.kernel import integers, reals
from dynsim.library.families import member
from dynsim.model.description import Contact, Robot
from dynsim.model.drives import Drive
from dynsim.record import Event, Record
from dynsim.record.measures import TIP_OVER
from dynsim.scenario import Scenario, build, require_scenario
from dynsim.scenario.between import idle_entries
from dynsim.scenario.build import START_TOLERANCE, check_start
from dynsim.scenario.combinations import LINEARIZATION, WATCHED_EVENTS
from dynsim.scenario.effect import without_effect
from dynsim.system import interruption
from dynsim.system.arguments import names_wrong_types
from dynsim.system.memo import Memo, recall, remembering

if TYPE_CHECKING:
    from dynsim.engine.snake_pilot import SnakePilot
    from dynsim.snake.description import CommandSource

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

# Limits for ticks that a caller adds: their number (each is a bit of an integer), and their shortest period [s].
MOST_TICKS, SHORTEST_PERIOD = 60, 1e-9
# Ticks that differ from the requested time by less than this fraction of it count as at that time.
TICK_SLACK = 1e-12
# End of a run for which no end is set [s]: finite, but later than any time in use.
_FAR = 1e300
# In a state from a time-stepping run, points may be below a surface and joints beyond a stop by one step at this speed
# [m/s or rad/s].
FASTEST_LANDING = 5.0
SERVO_MODES = {"position": ka.POSITION_MODE, "velocity": ka.VELOCITY_MODE, "off": ka.OFF}
# Buffers that kernels write samples to, and tables of callbacks: their sizes change.
_BUFFERS = {f"run.{field}": field for field in ("sample_time", "sample", "output")}
# Attributes in a snapshot, copied.
_SAVED = (
    "_time", "_trace", "_happened", "_pushed", "_past_pushes", "_base_as_planned", "_frozen", "_due", "_samples_end",
    "_window",
)  # fmt: skip
_TABLES = {f"run.{field}": field for field in ("tick", "tick_table", "event", "event_table")}


@names_wrong_types
class Simulation:
    """Step a scenario interactively: advance, apply forces, change references, save and restore.

    Parameters
    ----------
    scenario : Scenario
        Scenario of a plant with dynamics, see :func:`dynsim.load_scenario`.
    state : State, optional
        State from which to start, at its own time, e.g. ``State.of(record)``; default: the scenario's start at t = 0.
        The energy ledger starts at zero.
    duration : float, optional
        End of the run [s], ``math.inf`` for no end; default: the end of the scenario. References keep their final
        values after their end.
    trace : int, optional
        Number of last samples to keep; default (None): all samples, 0: none.
    motors : sequence of Drive, optional
        Motors to use instead of the motors of the plant, see :mod:`dynsim.model.description`; records still show the
        motors of the scenario.
    operator : VelocitySource or CommandSource, optional
        Command source to use instead of the script of a scenario with ``controller.operator`` or of a snake.

    Raises
    ------
    ModelError
        If the plant is kinematic, the scenario is not physically valid, or the state belongs to another robot or has
        contact points off their surfaces.
    UnreachableReference
        If the hand cannot follow its path.
    ScenarioError
        If an argument is invalid, or the record would be too large.

    Notes
    -----
    As long as the caller changes nothing, results are bit-identical to :func:`dynsim.simulate`. Every change, such as
    :meth:`set_wrench`, takes effect at :attr:`time`. The equations are [WM] eqs 25, 42–44 and 54–55, see
    docs/theory/multibody.md.

    Examples
    --------
    >>> import dynsim
    >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "two_elbows"))
    >>> simulation.advance(0.5).q.shape
    (10,)
    >>> simulation.set_wrench("link_10", force=[0.0, 0.0, -5.0])
    >>> simulation.advance(1.0).time
    1.0
    >>> record = simulation.record()
    >>> record["q"].shape, simulation.finished
    ((201, 10), False)
    """

    # Rows of the buffer for samples; whether the records of exceptions have scenes.
    _block, _pictured = BLOCK, True

    def __init__(
        self,
        scenario: Scenario,
        *,
        state: State | None = None,
        duration: float | None = None,
        trace: int | None = None,
        motors: Sequence[Drive] | None = None,
        operator: VelocitySource | CommandSource | None = None,
    ) -> None:
        require_scenario(scenario)
        if scenario.engine != "dynamics":
            raise ModelError(f"plant {scenario.plant.type!r} is kinematic: only plants with dynamics can be stepped")
        if state is not None and not isinstance(state, State):
            raise ModelError(f"state must be a State, e.g. State.of(record), got {brief(state)}")
        if trace is not None and (not isinstance(trace, int) or trace < 0):
            raise ScenarioError(f"trace must be a number of samples, or None for all, got {brief(trace)}")
        start = 0.0 if state is None else float(state.time)
        if not math.isfinite(start):
            raise ModelError(f"state.time must be finite, got {start}")
        end = scenario.duration_s if duration is None else float(duration)
        if not end > start:
            raise ScenarioError(f"duration must be later than the start at t = {start:g} s, got {end:g} s")
        self._scenario = scenario
        self._end = min(end, _FAR)
        self._prepared = self._prepare(end=self._end, motors=motors, starts=state is None)
        if (unstable := unstable_loop(scenario, self._prepared)) is not None:
            # Log the warning now: it is in the summary of a record, but a live session may never create a record.
            log.warning("%s: %s", scenario.title, unstable[0])
        self._time, self._begun, self._wall = start, start, 0.0
        # Time until which steps are taken without a return to the caller.
        self._until = start
        # With a ring buffer or a start from a state, the ledger counts from the first sample.
        self._relative = trace is not None or state is not None
        self._happened: list[Event] = []
        self._token = object()
        # Exception by which a controller ended the run.
        self._ended_by: SimulationStopped | None = None
        # Callbacks due at the present time, in call order, and the callback that is being called.
        self._due: list[Callable[[Simulation], None]] = []
        self._calling: Callable[[Simulation], None] | None = None
        self._loaded, self._watch = False, stopping.WallWatch(scenario.integrator.wall_limit_s)
        self._kernel = driver.direct(self._prepared.run)
        self._calls: list[Callable[[Simulation], None]] = []
        robot = self.robot
        # Kind, subject and callback of each guard: first those that a run has by default. Events of contacts and stops
        # are logged under separate numbers, see event_name.
        tipping = [] if robot.base is None else [(TIP_OVER, robot.base.body, None)]
        unnamed = len(self._prepared.run.event) - len(tipping)
        self._guards: list[tuple[str, str, Callable[[Simulation], None] | None]] = [
            *tipping,
            *[("", "", None)] * unnamed,
        ]
        self._brakes = Brakes(scenario, self._prepared)
        self._joints = {link.joint: i for i, link in enumerate(robot.links)}
        self._motors = {motor.joint: a for a, motor in enumerate(robot.motors)}
        first = len(self._prepared.loads) - len(robot.bodies)
        self._pushes = {body: first + k for k, body in enumerate(robot.bodies)}
        # Planned references and voltages, for motors that are released later.
        self._splines = self._prepared.system.reference.spline.copy()
        self._voltages = self._prepared.system.reference.voltage.copy()
        self._references_end = self._prepared.control.end
        self._frozen = not math.isfinite(self._references_end)
        self._pushed: set[int] = set()
        # Keep the caller's wrenches if there are sensors on links; otherwise the record needs only their work.
        self._keeps_pushes, self._past_pushes = bool(build.sensor_mounts(scenario, robot)), list[AppliedWrench]()
        times = None
        if state is None and self._end == scenario.duration_s and trace is None:
            # Use exactly the sample times of simulate, including its size limit.
            times = sample_times(scenario, self._prepared.run.layout, self._prepared.run.columns, len(robot.links))
        self._trace = Trace(start, self._end, scenario.record.rate_hz, trace, times, self._block)
        self._sampled = self._prepared.system.drives.table[:, ka.SAMPLED].copy()
        reference = self._prepared.control.reference
        # Planned control, from which the target of the base is computed until a wheel is commanded otherwise.
        self._planned = replace(self._prepared.control, reference=reference._replace(spline=reference.spline.copy()))
        self._base_as_planned = state is None
        self._warnings: list[str] = []
        # End of the samples [s]; once a step has passed it, the snapshot there and the wall-clock time until then [s].
        self._samples_end: float = math.inf
        self._window: tuple[Snapshot, float] | None = None
        run = self._prepared.run
        if state is not None:
            self._start_from(state)
        run.clock[[ki.TIME, ki.COUNTED_SINCE]] = start
        run.tick[:, [ki.TICK_NEXT, ki.TICK_PHASE]] = start
        self._refill()
        encoded = self._encoded_commands()
        self._operator = self._tick_handler(operator, state)
        if self._operator is not None:
            self.every(self._operator.period, self._operator)
        elif operator is not None:
            raise ScenarioError("operator requires a scenario with controller.operator")
        self._tick_handlers = [handler for handler in (encoded, self._operator) if handler is not None]
        self._own_calls = tuple(self._calls)

    def _prepare(self, **options: Any) -> Prepared:
        """Compile the scenario to kernel arrays, see :func:`dynsim.engine.prepare.prepare`."""
        # Use a separate memo, because other runs must not share tables that the caller may change.
        with remembering(Memo()):
            return prepare(self._scenario, pushable=True, times=np.full(1, np.inf), **options)

    def _tick_handler(self, source: Any, state: State | None) -> Operator | SnakePilot | None:
        """Return the handler that rewrites references at its ticks, or None without an operator or snake controller."""
        control = self._prepared.control
        if control.teleop is not None:
            return Operator(self.model, control.teleop, source, state)
        if control.task_space is None:
            return None
        # Imported here because an arm does not need the snake modules.
        from dynsim.engine.snake_control import control_periods
        from dynsim.engine.snake_pilot import SnakePilot

        if state is not None:
            raise ModelError(
                "a snake with a task-space controller cannot start from a State, which lacks its target and gripper; "
                "restore a Simulation.snapshot()"
            )
        periods = control_periods(self._scenario, control.task_space.schedule.period)
        pilot = SnakePilot(self.model, control.task_space, *periods, source, self._scenario.config.sensors)
        pilot.ticks_ahead, pilot.queue = self._ticks_ahead, self._queue
        for sensor in pilot.sensors:
            # Register sensors first: if both are due, they are called before the controller.
            self.every(sensor.period, sensor)
        return pilot

    def _ticks_ahead(self) -> int:
        """Return the number of ticks before the next return to the caller, 0 if there are other callbacks."""
        tick = self._prepared.run.tick
        if len(self._calls) > 1 or len(tick) > 1:
            return 0
        until = self._until if self._window is not None else min(self._until, self._samples_end)
        return min(int((until - self._time) / float(tick[0, ki.TICK_PERIOD]) + 1e-6), ki.QUEUE_LENGTH)

    def _queue(self, motors: NDArray[np.int64], lines: Array) -> None:
        """Set linear references of all motors at the next ticks, (k, na, 2); see :meth:`set_lines`."""
        run = self._prepared.run
        first = len(run.queue) - len(lines)
        run.queue[first:, motors], run.tick_table[0, ki.TICK_QUEUED] = lines, len(lines)
        if (balance := self._prepared.balance) is not None:
            run.queue[first:, :, 0] += balance.shift

    def _encoded_commands(self) -> EncodedCommands | None:
        """Return the handler that computes commands at the ticks of a sampled controller with encoders, or None."""
        sensors, period = self._scenario.config.sensors, self._prepared.control.sample_time
        if sensors is None or sensors.encoders is None or period is None:
            return None
        encoded = EncodedCommands(sensors.encoders, sensors.seed, self.robot, period, self._take_commands)
        self.every(encoded.sensor.period, encoded.sensor)
        self.every(period, encoded)
        return encoded

    def _take_commands(self, position: Array, rate: Array) -> None:
        """Compute the commands of all sampled motors from measured joint positions and rates, (na,)."""
        self._settle_now()
        system, workspace = self._prepared.system, self._prepared.workspace
        driven = system.drives.table[:, ka.DRIVEN]
        workspace.joints[driven, ka.Q], workspace.joints[driven, ka.QD] = position, rate
        take_commands(system.drives, system.reference, self._time, workspace)
        self._restart()

    @property
    def scenario(self) -> Scenario:
        """Scenario of the simulation."""
        return self._scenario

    @property
    def robot(self) -> Any:
        """Robot description with the names of joints, motors and bodies."""
        return self._prepared.model.robot

    @property
    def model(self) -> Model:
        """Rigid-body model of the robot (:class:`dynsim.Model`); ``armature`` is very large at a closed brake."""
        return self._prepared.model

    @property
    def touching(self) -> dict[str, Touch]:
        """Force and mode of each contact point at the last sample; empty before the first sample."""
        run = self._prepared.run
        outputs = run.output[: int(run.count[ki.SAMPLE])]
        last = outputs[-1] if len(outputs) else self._trace.last_output()
        if last is None or not self._prepared.contacts:
            return {}
        rows = last[block(run.columns, "contact")].reshape(len(self._prepared.contacts), -1)
        real = self._prepared.system.unilateral is not None
        return {
            contact.name: Touch(
                force=float(row[kst.OUT_FORCE]),
                vector=row[kst.OUT_VECTOR : kst.OUT_VECTOR + 3].copy(),
                mode=int(row[kst.OUT_MODE]) if real else None,
                position=row[kst.OUT_POSITION : kst.OUT_POSITION + 3].copy(),
                normal=row[kst.OUT_NORMAL : kst.OUT_NORMAL + 3].copy(),
            )
            for contact, row in zip(self._prepared.contacts, rows, strict=True)
        }

    @property
    def tie_force(self) -> dict[str, float]:
        """Force of each tie on its first body in the last step [N or N m]; zero for an inactive tie."""
        unilateral = self._prepared.system.unilateral
        if unilateral is None:
            return {}
        forces = np.where(unilateral.tie_table[:, ku.TIE_HOLDS] == 1, unilateral.tie[:, ku.TIE_FORCE], 0.0)
        return dict(zip((tie.name for tie in self.robot.ties), forces.tolist(), strict=True))

    @property
    def tie_slip(self) -> dict[str, float]:
        """Total distance that each tie has slid at its bound since it began, in both directions [m or rad]."""
        unilateral = self._prepared.system.unilateral
        slips = [] if unilateral is None else unilateral.tie[:, ku.TIE_GIVEN].tolist()
        return dict(zip((tie.name for tie in self.robot.ties), slips, strict=False))

    @property
    def operator(self) -> Operator | SnakePilot | None:
        """Handler that rewrites references of hand and base (``controller.operator``) or a snake (``task_space``)."""
        return self._operator

    @property
    def time(self) -> float:
        """Present time [s]."""
        return self._time

    @property
    def finished(self) -> bool:
        """True at the end of the run, or after an event that ends it."""
        return bool(self._prepared.run.count[ki.STATUS] != ki.RUNNING)

    @property
    def happened(self) -> tuple[Event, ...]:
        """Events so far."""
        return tuple(self._happened)

    @property
    def state(self) -> State:
        """State at :attr:`time`."""
        run = self._prepared.run
        y = run.y.copy()
        if run.count[ki.PENDING] == 1 and self._time > run.clock[ki.TIME]:
            state_within(run, self._time, y)
            if run.layout.extra > 0:
                # Within a step, quaternions are interpolated by a polynomial.
                normalise(self._prepared.system.model, y, run.layout.q)
        q, v, current = (y[block(run.layout, name)] for name in ("q", "v", "current"))
        unilateral = self._prepared.system.unilateral
        if unilateral is None or not len(unilateral.tie):
            return State(self._time, q, v, current)
        return State(self._time, q, v, current, unilateral.tie[:, ku.TIE_REST].copy())

    def advance(self, until: float) -> State:
        """Integrate to a time [s] or to the end of the run, whichever is first, and return the state.

        Parameters
        ----------
        until : float
            Time to reach [s], not before :attr:`time`.

        Returns
        -------
        State
            State at the time reached.

        Raises
        ------
        ScenarioError
            If the time is in the past or not a number, or the call comes from a callback.
        SimulationStopped
            If the run diverges, has no solution, makes no progress or exceeds the wall-clock limit; ``error.record``
            contains the trace so far.
        KeyboardInterrupt
            On Ctrl-C, within a second. The simulation is then at the end of a step and can be advanced again, unless
            that step would have taken longer than this.

        Notes
        -----
        Calls the callbacks of :meth:`every` and :meth:`watch`, including those due at ``until``. An exception from a
        callback ends the call; the simulation stays at the time of that callback and can be advanced again. The
        callback is not called a second time, and other callbacks due at that time are called first.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum"))
        >>> simulation.advance(0.25).time
        0.25
        >>> simulation.advance(100.0).time, simulation.finished
        (10.0, True)
        """
        if self._calling is not None:
            raise ScenarioError("a callback cannot advance its simulation; return to the caller of advance first")
        if not isinstance(until, (int, float, np.number)) or not until >= self._time:
            raise ScenarioError(f"cannot advance to t = {brief(until)} s: the simulation is at {self._time:g} s")
        try:
            return self._advanced(min(float(until), self._end))
        except SimulationStopped as stop:
            if stop.record is None:  # raised by a controller, e.g. if the task of a snake has failed
                self._ended_by = stop
                raise_stopped(stop, self.record(pictured=self._pictured))
            raise

    def _advanced(self, until: float) -> State:
        # Call callbacks that are left over from a snapshot or from an error in a callback.
        self._call_due()
        last = self._references_end
        # In a whole run, rounding may make the references end slightly before the run. They must not be rewritten then.
        if not self._frozen and until > last + END_SLACK * max(1.0, abs(last)):
            self._reach(max(last, self._time))
            if not self.finished:
                self._freeze()
        self._reach(until)
        return self.state

    def end_samples(self, time: float) -> None:
        """Take the last sample at a time [s]; the simulation continues without further samples.

        Later records are identical to records of a run that ends at this time, including events and summary.

        Parameters
        ----------
        time : float
            Time of the last sample [s], not before :attr:`time`.

        Raises
        ------
        ScenarioError
            If the time is in the past, or the samples have already ended.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum"))
        >>> simulation.end_samples(0.5)
        >>> state = simulation.advance(1.0)
        >>> float(simulation.record().time[-1])
        0.5
        """
        if not time >= self._time:
            raise ScenarioError(f"samples cannot end at t = {brief(time)} s: the simulation is at {self._time:g} s")
        if self._window is not None:
            raise ScenarioError(
                f"samples have already ended at t = {self._samples_end:g} s; restore an earlier snapshot to continue"
            )
        self._samples_end = float(time)
        self._trace.end_at(float(time), self._prepared.run)

    def every(self, period: float, call: Callable[[Simulation], None], *, first: float | None = None) -> None:
        """Call a function every ``period`` [s], e.g. a sampled controller.

        Parameters
        ----------
        period : float
            Period [s].
        call : callable
            Called with the simulation.
        first : float, optional
            Time of the first call [s]; default: now.

        Raises
        ------
        ScenarioError
            If the period is too short, the first time is in the past, or there are too many ticks.

        Notes
        -----
        Steps end at the ticks, and changes made by ``call`` remain until they are changed again. Callbacks due at the
        same time are called in this order: callbacks of :meth:`watch`; encoders, controller and operator of the
        scenario; then the others in the order of their registration.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "two_elbows"))
        >>> calls = []
        >>> simulation.every(0.1, lambda simulation: calls.append(simulation.time))
        >>> state = simulation.advance(0.25)
        >>> len(calls)
        3
        """
        first = self._time if first is None else float(first)
        if not (period >= SHORTEST_PERIOD and math.isfinite(period) and first >= self._time):
            raise ScenarioError(
                f"period must be at least {SHORTEST_PERIOD:g} s and first must not be in the past, "
                f"got {period!r} and {first!r}"
            )
        if len(self._calls) == MOST_TICKS:
            raise ScenarioError(f"too many ticks (limit {MOST_TICKS}); call several functions from one tick")
        # End the pending step first, because callbacks that are called on the way may add ticks.
        self._settle_now()
        run = self._prepared.run
        tick = np.zeros((1, ki.TICK_SIZE))
        tick[0, [ki.TICK_PERIOD, ki.TICK_NEXT, ki.TICK_PHASE]] = period, first, first
        table = np.array([[ki.CALLER << len(self._calls), 0, 0]])
        self._calls.append(call)
        self._swap(tick=np.vstack([run.tick, tick]), tick_table=np.vstack([run.tick_table, table]))

    def watch(
        self,
        kind: str,
        subject: str,
        level: float = 0.0,
        *,
        direction: int = 0,
        call: Callable[[Simulation], None] | None = None,
        stop: bool = False,
    ) -> None:
        """Register an event that occurs when a quantity crosses a level.

        Parameters
        ----------
        kind : str
            ``joint_position``, ``joint_rate``, ``motor_current``, ``motor_voltage``, ``contact_force``,
            ``contact_gap``, ``hand_position`` or ``tip_margin``.
        subject : str
            Name of the joint, joint of the motor, contact, axis of the hand position (x, y, z), or mobile base.
        level : float, optional
            Level [rad, m, rad/s, m/s, A, V, N or 1].
        direction : int, optional
            +1 for rising, −1 for falling, 0 for both.
        call : callable, optional
            Called with the simulation at the event; may change references, forces etc.
        stop : bool, optional
            If True, end the run at the event.

        Raises
        ------
        ModelError
            If the kind or subject does not exist.
        ScenarioError
            With ``integrator.method: time_stepping``, which does not locate events within its steps.

        Notes
        -----
        Events are listed in :attr:`happened` and in the record.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum"))
        >>> simulation.watch("joint_position", "joint_1", level=3.0, direction=1)
        >>> state = simulation.advance(1.0)
        >>> [(event.kind, event.name) for event in simulation.happened]
        [('joint_position', 'joint_1')]
        """
        if conflict := WATCHED_EVENTS.conflict(self.scenario.config):
            raise ScenarioError(f"Simulation.watch {WATCHED_EVENTS.message(conflict)}")
        if kind not in GUARDS:
            raise ModelError(f"unknown event {brief(kind)}; events: {', '.join(GUARDS)}")
        number, family = GUARDS[kind]
        contacts = {contact.name: k for k, contact in enumerate(self._prepared.contacts)}
        base = {} if self.robot.base is None else {self.robot.base.body: 0}
        choices = {"joint": self._joints, "motor": self._motors, "contact": contacts, "base": base}
        choices["axis"] = {"x": 0, "y": 1, "z": 2}
        index = _index(choices[family], subject, family)
        action = ki.STOP if stop else ki.LOG if call is None else ki.RETURN
        event = np.zeros((1, ki.EVENT_SIZE))
        event[0, ki.EVENT_LEVEL] = _finite("level", [level])[0]
        axis = family == "axis"
        table = np.array([[number + (index if axis else 0), 0 if axis else index, int(np.sign(direction)), action]])
        self._settle_now()
        run = self._prepared.run
        self._guards.append((kind, subject, call))
        self._swap(event=np.vstack([run.event, event]), event_table=np.vstack([run.event_table, table]))
        self._restart()

    def set_reference(self, joint: str, position: float, rate: float = 0.0) -> None:
        """Set a linear reference for the motor of a joint: q_d(t) = position + rate (t − now).

        Parameters
        ----------
        joint : str
            Joint with a motor.
        position : float
            Position [rad or m]; for an open-loop torque source, its torque [N m].
        rate : float, optional
            Rate [rad/s or m/s].

        Raises
        ------
        ModelError
            If the joint has no motor, or a value is not finite.

        Notes
        -----
        The reference shift of ``initial.equilibrium`` is added. Voltages planned by ``feed_forward`` or ``brace`` for
        this motor belong to its planned reference and are switched off until :meth:`release`.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_reference("joint_10", 1.0, rate=0.1)
        >>> state = simulation.advance(0.5)
        """
        self.set_references({joint: (position, rate)})

    def set_references(self, lines: Mapping[str, tuple[float, float]]) -> None:
        """Set linear references for several joints at once, see :meth:`set_reference`.

        Parameters
        ----------
        lines : mapping of str to (float, float)
            Position [rad or m] and rate [rad/s or m/s] for each joint.

        Raises
        ------
        ModelError
            If a joint has no motor, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_references({"joint_9": (-0.7, 0.0), "joint_10": (1.0, 0.1)})
        >>> state = simulation.advance(0.5)
        """
        if not lines:
            return
        self.set_lines(np.array([self._motor(joint) for joint in lines]), list(lines.values()))

    def set_lines(self, motors: NDArray[np.int64], lines: ArrayLike) -> None:
        """Set linear references by motor index, see :meth:`set_references`.

        Parameters
        ----------
        motors : (m,) ndarray of int
            Indices of motors in ``robot.motors``.
        lines : array_like, shape (m, 2)
            Position [rad or m] and rate [rad/s or m/s] for each motor.

        Raises
        ------
        ModelError
            If a value is not a finite number, or the shapes do not match.

        Examples
        --------
        >>> import dynsim
        >>> import numpy as np
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_lines(np.array([8, 9]), [[-0.7, 0.0], [1.0, 0.1]])
        >>> state = simulation.advance(0.5)
        """
        values = reals(_finite("reference", lines))
        if np.asarray(motors).dtype.kind not in "iu" or values.shape != (*np.shape(motors), 2):
            raise ModelError(
                f"motors = {brief(motors)}: must be indices of motors, with one row (position, rate) each in lines"
            )
        if (balance := self._prepared.balance) is not None:
            values[:, 0] += balance.shift[motors]
        self._follow_lines(motors, values)
        self._plan_voltages(motors, 0.0)
        self._leave_plan(self.robot.motors[a].joint for a in motors)

    def _follow_lines(self, motors: NDArray[np.int64], values: Array) -> None:
        """Set linear references of motors from now on, values (motors, 2)."""
        self._settle_now()
        drives, spline, chosen = self._prepared.system.drives, self._prepared.system.reference.spline, integers(motors)
        if not follow_lines(spline, drives.table, drives.input, self._sampled, chosen, values, self._time):
            raise ModelError(f"motors = {brief(motors)}: must be indices from 0 to {len(spline) - 1}")
        self._restart()

    def _plan_voltages(self, motors: NDArray[np.int64], share: float) -> None:
        """Apply a share of the planned voltages to motors: 1 along planned references, 0 along other references."""
        if len(planned := self._voltages):
            self._prepared.system.reference.voltage[:, motors] = share * planned[:, motors]

    def set_command(self, joint: str, command: float) -> None:
        """Set a constant command of a motor, independent of its controller.

        Parameters
        ----------
        joint : str
            Joint with a motor.
        command : float
            Voltage of a motor or servo [V], or torque of an open-loop torque source [N m].

        Raises
        ------
        ModelError
            If the joint has no motor, or the command is not finite.

        Notes
        -----
        :meth:`release` returns the motor to the controller.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_command("joint_10", 1.5)
        >>> state = simulation.advance(0.1)
        """
        a = self._motor(joint)
        value = _finite("command", [command])[0]
        self._settle_now()
        drives = self._prepared.system.drives
        drives.table[a, ka.SAMPLED], drives.input[a, ka.COMMAND] = ka.GIVEN, value
        self._restart()
        self._leave_plan([joint])

    def _leave_plan(self, joints: Iterable[str]) -> None:
        """Record that a wheel of the base no longer follows the scenario."""
        base = self.robot.base
        if base is not None and any(joint in base.wheels for joint in joints):
            self._base_as_planned = False

    def set_mode(self, joint: str, mode: str) -> None:
        """Set the mode of a servo.

        Parameters
        ----------
        joint : str
            Joint with a servo.
        mode : str
            ``"position"`` or ``"velocity"`` to follow positions or rates of its reference; ``"off"`` opens its circuit,
            and only the drag of its gear remains.

        Raises
        ------
        ModelError
            If the mode does not exist, the motor is not a servo, or the servo has no gain for the mode.

        Examples
        --------
        >>> import dynsim
        >>> motor = {"plant.chain.0.motor": {"type": "mx_106"}}
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum", overrides=motor))
        >>> simulation.set_mode("joint_1", "off")
        >>> state = simulation.advance(0.1)
        """
        a = self._motor(joint)
        number = _index(SERVO_MODES, mode, "mode")
        drives = self._prepared.system.drives
        if drives.table[a, ka.DRIVE_KIND] != ka.POSITION_SERVO:
            raise ModelError(f"the motor of {joint} is not a servo; only servos have modes")
        gain = {ka.POSITION_MODE: ka.K_P, ka.VELOCITY_MODE: ka.K_V}.get(number)
        if gain is not None and drives.motor[a, gain] == 0.0:
            raise ModelError(f"the servo of {joint} has no gain for mode {mode}")
        self._settle_now()
        drives.table[a, ka.SERVO_MODE] = number
        self._restart()

    def set_supply(self, voltage: float) -> None:
        """Limit the voltage of all motors [V] from now on, replacing their own limits.

        Parameters
        ----------
        voltage : float
            Supply voltage [V], not negative.

        Raises
        ------
        ModelError
            If the voltage is negative or not finite.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_supply(12.0)
        >>> state = simulation.advance(0.1)
        """
        value = _finite("supply", [voltage])[0]
        if value < 0.0:
            raise ModelError(f"voltage must not be negative, got {voltage:g} V")
        self._settle_now()
        self._prepared.system.drives.motor[:, ka.U_MAX] = value
        self._restart()

    def set_brake(self, joint: str, closed: bool) -> None:
        """Lock or release a joint with an ideal brake.

        Parameters
        ----------
        joint : str
            Any joint that is not coupled to another.
        closed : bool
            True to lock the joint at its present position, False to release it.

        Raises
        ------
        ModelError
            If the joint does not exist or is coupled to another.

        Notes
        -----
        A moving joint is stopped by an impulse, Δv = −M⁻¹ e v_j / (eᵀ M⁻¹ e), with the unit vector e of the joint and M
        including rotors. Its kinetic energy, ½ v_j² / (eᵀ M⁻¹ e), counts as joint loss in the ledger. Contacts and
        couplings react with separate impulses: their energy counts as impact loss under the unilateral law and as joint
        loss under the bilateral law. A contact that only braked joints would move along its normal is left out while
        the brakes are closed.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_brake("joint_2", closed=True)
        >>> bool(abs(simulation.advance(0.1).v[1]) < 1e-6)
        True
        """
        j = _index(self._joints, joint, "joint")
        if any(joint in (coupling.joint, coupling.leader) for coupling in self.robot.couplings):
            raise ModelError(f"{joint} is coupled to another joint and cannot be braked; only uncoupled joints can")
        model = self._prepared.model
        armature = model.arrays.body[:, ka.ARMATURE]
        if closed == (armature[j] == ka.BRAKED):
            return
        self._settle_now()
        run = self._prepared.run
        if closed:
            v = run.y[block(run.layout, "v")]
            inertia = model.mass_matrix(run.y[block(run.layout, "q")]) + np.diag(model.armature)
            response = np.linalg.solve(inertia, np.eye(model.n)[j])
            run.y[run.layout.ledger + kst.JOINT] += 0.5 * v[j] ** 2 / response[j]
            v -= response * (v[j] / response[j])
            v[j] = 0.0
        armature[j] = ka.BRAKED if closed else self._brakes.armature[j]
        self._prepared, sentences = self._brakes.leave_contacts_out(self._prepared, self._time)
        for sentence in sentences:
            log.warning("%s: %s", self._scenario.title, sentence)
        if (law := self._prepared.system.unilateral) is not None:
            law.dry_table[law.dry_table[:, ku.DRY_JOINT] == j, ku.DRY_BRAKE] = ku.CLOSED if closed else ku.OPENED
        elif closed:
            run.y[run.layout.ledger + kst.JOINT] += projection_loss(self._prepared, self._time)
        if run.count[ki.MODES_DUE] == 0:
            run.count[ki.MODES_DUE] = ki.AFTER_JUMP
        self._restart()

    def set_tie(
        self,
        name: str,
        *,
        holds: bool | None = None,
        stiffness: float | None = None,
        damping: float | None = None,
    ) -> None:
        """Start or end a tie, or change its spring and damper; omitted values remain unchanged.

        Parameters
        ----------
        name : str
            Key of the scenario's ``ties``.
        holds : bool, optional
            True to start the tie, False to end it.
        stiffness : float, optional
            Stiffness [N/m or N m/rad].
        damping : float, optional
            Damping [N s/m or N m s/rad].

        Raises
        ------
        ModelError
            If the tie does not exist, a value is negative, or both stiffness and damping would be zero.

        Notes
        -----
        A tie that starts has no force at the present position of its bodies, unless the scenario sets its rest value.
        Added stiffness starts undeflected: x_0 moves so that the force stays the same, as in a gripper that hardens in
        its present shape. Removing stiffness also removes its share of the force. Both changes take energy from the
        spring, which counts as lost in its damper. When a tie ends, all of its energy counts as lost.

        Examples
        --------
        >>> import dynsim
        >>> tie = {"type": "linear", "body": "link_5", "other": "world", "axis": [0, 0, 1], "damping_N_s_per_m": 5.0}
        >>> changes = {"ties": {"string": tie}, "integrator.method": "time_stepping"}
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("falling_arm", overrides=changes))
        >>> simulation.set_tie("string", stiffness=100.0)
        >>> state = simulation.advance(0.05)
        >>> list(simulation.tie_force)
        ['string']
        """
        ties = {tie.name: k for k, tie in enumerate(self.robot.ties)}
        k = _index(ties, name, "tie")
        asked = {"stiffness": stiffness, "damping": damping}
        values = {key: _finite(key, [value])[0] for key, value in asked.items() if value is not None}
        unilateral = self._prepared.system.unilateral
        assert unilateral is not None  # ties require this law
        before, c = unilateral.tie[k, [ku.TIE_STIFFNESS, ku.TIE_DAMPING]]
        after = values.get("stiffness", float(before))
        if min(values.values(), default=0.0) < 0.0 or not after + values.get("damping", float(c)) > 0.0:
            raise ModelError(f"tie {name}: stiffness or damping must be positive, and neither may be negative")
        self._settle_now()
        prepared, tie = self._prepared, self.robot.ties[k]
        assert prepared.system.unilateral is not None
        table, row = prepared.system.unilateral.tie_table[k], prepared.system.unilateral.tie[k]
        y, layout = prepared.run.y, prepared.run.layout
        q, stored = y[block(layout, "q")], float(row[ku.TIE_STORED])
        if table[ku.TIE_HOLDS] == 1 and after != before:
            # A one-sided tie that is not in contact has no force that must stay the same.
            if after > before and (stored > 0.0 or not tie.pushes):
                x = deflection(prepared.model, prepared.system.unilateral, k, q)
                row[ku.TIE_REST] += x * (1.0 - before / after)
            row[ku.TIE_STORED] = stored * (before / after if after > before else after / before)
        row[ku.TIE_STIFFNESS], row[ku.TIE_DAMPING] = after, values.get("damping", float(c))
        if holds is not None and holds != (table[ku.TIE_KIND] >= 0):
            table[ku.TIE_KIND] = (kc.ONE_WAY if tie.pushes else kc.BOX) if holds else -1
            if holds and table[ku.TIE_HOLDS] == 1:  # the tie ended and starts again, without a step in between
                row[[ku.TIE_STORED, ku.TIE_GIVEN, ku.TIE_FORCE, ku.TIE_TURNED]] = 0.0
            row[ku.TIE_REST] = tie.rest
            if holds and math.isnan(tie.rest):
                # Set the rest value here, because the first step would use the geometry at its midpoint.
                rest_here(prepared.model, prepared.system.unilateral, k, q)
        lost = stored - row[ku.TIE_STORED]
        y[layout.elastic + kst.STORED] -= lost
        y[layout.elastic + kst.DAMPED] += lost
        self._restart()

    def release(self, joint: str) -> None:
        """Return a motor to the controller and references of the scenario.

        Parameters
        ----------
        joint : str
            Joint with a motor.

        Raises
        ------
        ModelError
            If the joint has no motor.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow"))
        >>> simulation.set_command("joint_10", 0.0)
        >>> state = simulation.advance(0.1)
        >>> simulation.release("joint_10")
        """
        a = self._motor(joint)
        self._settle_now()
        self._prepared.system.reference.spline[a] = self._splines[a]
        self._plan_voltages(np.array([a]), 1.0)
        self._prepared.system.drives.table[a, ka.SAMPLED] = self._sampled[a]
        if self._frozen and self._splines[a] >= 0:
            self._hold_at_end(joint)
        self._restart()

    def set_wrench(
        self,
        body: str,
        force: ArrayLike = (0.0, 0.0, 0.0),
        torque: ArrayLike = (0.0, 0.0, 0.0),
        *,
        point: ArrayLike = (0.0, 0.0, 0.0),
        in_body: bool = False,
    ) -> None:
        """Apply a constant force and torque to a body from now on.

        The wrench replaces any wrench that was set earlier on the same body.

        Parameters
        ----------
        body : str
            Name of a body of the robot.
        force : array_like, shape (3,), optional
            Force [N]; default: zero.
        torque : array_like, shape (3,), optional
            Torque [N m]; default: zero.
        point : array_like, shape (3,), optional
            Point of application in the body's frame [m]; default: the origin.
        in_body : bool, optional
            If True, `force` and `torque` are in body axes; default: world axes.

        Raises
        ------
        ModelError
            If `body` does not exist, or a vector does not have three finite components.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "two_elbows"))
        >>> simulation.set_wrench("link_10", force=[0.0, 0.0, -2.0])
        >>> state = simulation.advance(0.1)
        """
        k = _index(self._pushes, body, "body")
        values = _finite("wrench", [*np.ravel(point), *np.ravel(force), *np.ravel(torque)])
        if len(values) != 9:
            raise ModelError("point, force and torque must have three components each")
        self._settle_now()
        loads = self._prepared.system.loads
        offset = loads.table[k, kl.DATA]
        loads.table[k, kl.IN_BODY] = int(in_body)
        loads.data[offset + kl.POINT : offset + kl.POINT + 9] = values
        if values[3:].any():
            self._pushed.add(k)
        if self._keeps_pushes:
            index, _ = self.robot.attach(body, values[:3])
            self._past_pushes.append(AppliedWrench(self.time, index, in_body, values))
        self._restart()

    def linearize(
        self,
        inputs: Sequence[str] = ("command",),
        outputs: Sequence[str] = ("hand_position",),
        *,
        reduced: bool = False,
    ) -> Linearization:
        """Linearize the complete system about the present state: δẋ = A δx + B δu, δy = C δx + D δu.

        Parameters
        ----------
        inputs : sequence of str, optional
            ``command`` of motors, in addition to the controller's command [V; N m for an open-loop torque source],
            ``reference`` [rad or m], ``reference_rate``, and ``force`` [N] and ``torque`` [N m] on bodies, in the axes
            of the present wrench. Each entry is a whole family or a member of it, such as ``"command.joint_3"`` or
            ``"force.link_10.z"``.
        outputs : sequence of str, optional
            ``q``, ``v``, ``current``, ``vdot``, ``voltage``, ``motor_torque``, ``hand_position``,
            ``contact_normal_force``, ``contact_force``, ``contact_gap``, or their members.
        reduced : bool, optional
            Whether the state contains free motions only, without the directions that contacts, stops and couplings
            block. Controllers such as an LQR require it, because no input moves a blocked direction.

        Returns
        -------
        Linearization
            Matrices A, B, C, D with the names of states, inputs and outputs.

        Raises
        ------
        ScenarioError
            If an input or output does not exist, or with ``integrator.method: time_stepping``, which has no modes
            between its steps; with ``reduced`` also if the robot moves too fast.

        Notes
        -----
        x contains q, v and the currents of motors with a circuit. Contacts, stops and couplings keep their present
        modes, and the controller is part of the system. A sampled controller is treated as continuous: its period and
        the delay, resolution and rates of its encoders are neglected. Commands set by the caller, and the references of
        an operator or of a snake's controller, stay constant. The simulation is not changed. Derivatives are central
        differences of sixth order.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "two_elbows"))
        >>> A, B, C, D = simulation.linearize(inputs=["reference"], outputs=["hand_position", "contact_normal_force"])
        >>> A.shape, B.shape, C.shape
        ((30, 30), (30, 10), (5, 30))
        """
        if conflict := LINEARIZATION.conflict(self.scenario.config):
            raise ScenarioError(f"Simulation.linearize {LINEARIZATION.message(conflict)}")
        before = self._saved()
        try:
            self._settle_now(calling=False)
            if self._prepared.run.count[ki.STARTED] == 0:
                # Contact modes are chosen at the start of a step; no step is taken here.
                driver.advance(self._prepared.system, self._prepared.workspace, self._prepared.run, 0)
            return linearized(self._prepared, inputs, outputs, reduced)
        finally:
            self._restore_arrays(before)

    def snapshot(self) -> Snapshot:
        """Save the complete simulation state for :meth:`restore`.

        Returns
        -------
        Snapshot
            State that only this simulation can restore.

        Raises
        ------
        ScenarioError
            If called within a tick of the scenario's operator, because half of that tick would be lost.

        Notes
        -----
        A callback may take a snapshot. The snapshot contains the changes that the callback has made so far, but not its
        later ones, and :meth:`restore` does not call that callback again. Other callbacks due at this time are called
        by the next :meth:`advance`. Variables of callbacks are not part of the snapshot.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum"))
        >>> snapshot = simulation.snapshot()
        >>> first = simulation.advance(0.5).q
        >>> simulation.restore(snapshot)
        >>> bool((simulation.advance(0.5).q == first).all())
        True
        """
        if any(self._calling is call for call in self._own_calls):
            raise ScenarioError(
                "an operator or its command source cannot take a snapshot of its simulation; take it in a callback of "
                "Simulation.every, or between two calls of advance"
            )
        return self._saved()

    def _saved(self) -> Snapshot:
        """Return the snapshot; one taken within an operator's tick may only be restored immediately."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        tick_handlers = [handler.saved_state() for handler in self._tick_handlers]
        attributes = {name: copy(getattr(self, name)) for name in _SAVED}
        behind_brakes = self._prepared.behind_brakes
        return Snapshot(self._token, arrays, behind_brakes, tick_handlers, attributes)

    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot of this simulation; it then continues bit-identically.

        Parameters
        ----------
        snapshot : Snapshot
            Result of :meth:`snapshot`.

        Raises
        ------
        ScenarioError
            If events or ticks were added after the snapshot, if the snapshot belongs to another simulation, or if the
            call comes from a callback.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum"))
        >>> snapshot = simulation.snapshot()
        >>> state = simulation.advance(0.5)
        >>> simulation.restore(snapshot)
        >>> simulation.time
        0.0
        """
        if self._calling is not None:
            raise ScenarioError("a callback cannot restore its simulation; restore it after advance has returned")
        if not isinstance(snapshot, Snapshot):
            raise ScenarioError(f"snapshot must be a Snapshot of this simulation, got {brief(snapshot)}")
        own = self._arrays()
        sizes = ({k: a.shape for k, a in arrays.items() if k not in _BUFFERS} for arrays in (own, snapshot.arrays))
        if snapshot.owner is not self._token or next(sizes) != next(sizes):
            raise ScenarioError("the snapshot belongs to another simulation, or ticks or events were added later")
        self._restore_arrays(snapshot)
        self._ended_by = None

    def _restore_arrays(self, snapshot: Snapshot) -> None:
        """Restore all arrays and values from a matching snapshot."""
        self._swap(**{field: snapshot.arrays[name].copy() for name, field in (_BUFFERS | _TABLES).items()})
        for name, array in self._arrays().items():
            array[...] = snapshot.arrays[name]
        for name, value in snapshot.attributes.items():
            setattr(self, name, copy(value))
        self._prepared = replace(self._prepared, behind_brakes=snapshot.behind_brakes)
        for handler, kept in zip(self._tick_handlers, snapshot.tick_handlers, strict=True):
            handler.restore(kept)

    def record(self, scenario: Scenario | None = None, *, pictured: bool = True) -> Record:
        """Return the record of the trace so far, with a summary of the run up to now.

        Parameters
        ----------
        scenario : Scenario, optional
            Scenario to store in the record, for a scenario built during the run; default: the scenario of the
            simulation.
        pictured : bool, optional
            If False, omit the scene and the poses of bodies.

        Returns
        -------
        Record
            Signals, events and summary; ``complete`` is True if the run has reached its end.

        Notes
        -----
        With a limited ``trace``, the summary covers the kept samples only.

        Examples
        --------
        >>> import dynsim
        >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "two_elbows"))
        >>> state = simulation.advance(0.5)
        >>> record = simulation.record()
        >>> float(record.time[-1]), record.complete
        (0.5, False)
        """
        wall = self._wall
        if self._window is None and self.finished:
            record = self._record_now(scenario, pictured, wall)
        else:
            # Samples, statistics and events must refer to the same time, which may lie in the pending step. Therefore
            # end the step here, start the next one, and undo this afterwards.
            before = self._saved()
            try:
                if self._window is not None:
                    there, wall = self._window
                    self._restore_arrays(there)
                else:
                    self._end_here()
                record = self._record_now(scenario, pictured, wall)
            finally:
                self._restore_arrays(before)
        record.complete = self.finished
        if self._ended_by is not None:
            mark_stopped(self._ended_by, record)
        elif self._failed():
            mark_stopped(stopped(self._scenario, self._prepared), record)
        return record

    def _end_here(self) -> None:
        """End a step at the present time, and record the sample there; the caller undoes this."""
        self._settle_now(calling=False)
        if not self._loaded:
            return
        run = self._prepared.run
        if run.count[ki.SAMPLE] == len(run.sample_time):
            self._refill()
            run = self._prepared.run
        row, now = int(run.count[ki.SAMPLE]), float(run.clock[ki.TIME])
        # Time stepping has already recorded this sample.
        late = run.stepping is None and abs(run.sample_time[row] - now) <= TICK_SLACK * max(1.0, abs(now))
        if late:
            # If a step ends before a sample only because of rounding, it leaves the sample to the next step. At a
            # start, the sample at this time is written again, whatever the buffer contains.
            run.count[ki.SAMPLE], run.count[ki.STARTED], run.sample[row] = row + 1, 0, np.nan
        self._kernel(self._prepared.system, self._prepared.workspace, run, 0)
        if late and np.isnan(run.sample[row]).any():
            # The integration cannot start from this state, so no sample was written.
            run.count[ki.SAMPLE] = row

    def _keep_window(self, until: float) -> None:
        """Save the state at the end of the samples before the pending step passes that time on the way to ``until``."""
        run, end = self._prepared.run, self._samples_end
        passes = run.count[ki.PENDING] == 1 and run.clock[ki.TIME] + run.clock[ki.STEP] > end
        if self._window is not None or not (passes and until > end):
            return
        before = self._saved()
        try:
            self._time = end
            self._end_here()
            window = self._saved(), self._wall
        finally:
            self._restore_arrays(before)
        self._window = window

    def _hold_time(self, until: float) -> float:
        """Return the time [s] that a step must not pass yet: the end of the buffer or the end of the samples."""
        last, end = float(self._prepared.run.sample_time[-1]), self._samples_end
        return min(last, end) if self._window is None and until > end else last

    def _record_now(self, scenario: Scenario | None, pictured: bool, wall: float) -> Record:
        """Create a record from the present arrays of the run, which has taken ``wall`` [s]."""
        run = self._prepared.run
        times, states, outputs = self._trace.rows(run)
        y = run.y
        if len(times) and self._relative:
            states, y = states.copy(), y.copy()
            integrals = slice(run.layout.tracked, run.layout.size)
            y[integrals] -= states[0, integrals]
            states[:, integrals] -= states[0, integrals]
        count = run.count.copy()
        count[ki.SAMPLE] = len(times)
        whole = run._replace(y=y, sample_time=times, sample=states, output=outputs, count=count)
        planned = self._planned
        if self._operator is not None and self._operator.path is not None:
            planned = replace(planned, path=self._operator.path)
        record = make_record(
            self._scenario if scenario is None else scenario,
            replace(self._prepared, run=whole, control=planned),
            wall,
            pushed=sorted(self._pushed),
            pushes=self._past_pushes,
            happened=self._happened,
            base_as_planned=self._base_as_planned,
            pictured=pictured,
            begun=self._begun,
        )
        record.summary["warnings"] += self._warnings
        if queued := int(run.tick_table[:, ki.TICK_QUEUED].sum()):
            assert self._operator is not None
            assert not isinstance(self._operator, Operator)
            self._operator.rewind(queued)
            run.tick_table[:, ki.TICK_QUEUED] = 0
        for handler in self._tick_handlers:
            handler.add_to(record)
        if "final_position_error_m" in record.summary:
            head_distance(record, self._prepared, getattr(self._operator, "blind", False))
        return record

    def _motor(self, joint: str) -> int:
        return _index(self._motors, joint, "motor")

    def _start_from(self, state: State) -> None:
        """Start from a state."""
        run, model = self._prepared.run, self._prepared.model
        at_start = run.y[block(run.layout, "q")].copy()
        for name in ("q", "v", "current"):
            part = block(run.layout, name)
            values = _finite(name, np.ravel(getattr(state, name)))
            circuits = self._prepared.system.drives.table[:, ka.CIRCUIT] >= 0
            if name == "current" and len(values) == len(circuits):
                # Records have a current for each motor; currents of motors without a circuit follow from the other
                # values.
                values = values[circuits]
            if values.shape != run.y[part].shape:
                raise ModelError(
                    f"the state has {len(values)} values of {name}, but {model.robot.name} has {part.stop - part.start}"
                )
            run.y[part] = values
        q = run.y[block(run.layout, "q")]
        check_couplings(model.robot, q)
        beyond = START_TOLERANCE
        if run.method == ki.TIME_STEPPING:
            # Points that have landed may be below their surface, and joints beyond their stop, by up to one step at
            # their speed.
            beyond = max(beyond, float(run.clock[ki.STEP]) * FASTEST_LANDING)
        if self._prepared.system.unilateral is not None:
            joint_stops(model.robot, q, beyond)
        check_start(self._scenario, model, self._prepared.contacts, q, beyond)
        if (unilateral := self._prepared.system.unilateral) is not None and model.robot.ties:
            self._restore_ties(unilateral, at_start, state.tie_rest)

    def _restore_ties(self, unilateral: UnilateralArrays, at_start: Array, rests: Array | None) -> None:
        """Continue ties from the point they have slid to; at_start: coordinates of the scenario's start, (nq,)."""
        model, ties = self._prepared.model, self._prepared.model.robot.ties
        if rests is not None and np.shape(rests) != (len(ties),):
            raise ModelError(f"the state has {np.size(rests)} values of tie_rest; {model.robot.name} has {len(ties)}")
        set_rests(model, unilateral, at_start, rests)
        slid = [tie.name for tie in ties if may_have_slid(tie)]
        if rests is None and slid:
            self._warnings.append(
                f"{first_few(slid)}: the state does not contain how far ties have slid beyond their bounds (tie_rest); "
                "they start without slip; start from Simulation.state or from a snapshot"
            )
            log.warning("%s: %s", self._scenario.title, self._warnings[-1])

    def _reach(self, asked: float) -> None:
        """Integrate until a step ends at a time, or until the step that would pass this time is pending."""
        until = asked = self._until = min(asked, self._end)
        while not self.finished and self._time < until:
            self._keep_window(until)
            run = self._prepared.run
            # Include a tick that differs from the requested time by rounding.
            slack = TICK_SLACK * max(1.0, abs(asked))
            ticks = run.tick[:, ki.TICK_NEXT].tolist() if self._calls else []
            near = [time for time in ticks if abs(time - asked) <= slack]
            until = min(max([until, *near]), self._end)
            beyond = until + slack if near else until
            if run.count[ki.PENDING] == 1 and run.clock[ki.TIME] + run.clock[ki.STEP] > beyond:
                break
            self._piece(until)
            run = self._prepared.run
            if run.count[ki.STARTED] == 1 and run.clock[ki.TIME] >= until:
                break
        while not self.finished and self._prepared.run.clock[ki.TIME] >= self._end:
            # A tick at the end time was handled first; run the end itself now.
            self._piece(self._end)
        self._time = until if not self.finished else float(self._prepared.run.clock[ki.TIME])

    def _piece(self, until: float) -> None:
        """Run one piece of compiled code, and the callbacks that are due after it."""
        run = self._prepared.run
        if run.count[ki.PENDING] == 1:
            self._refill(run.clock[ki.TIME] + run.clock[ki.STEP])
            run = self._prepared.run
        run.clock[ki.HOLD] = min(until, self._hold_time(until))
        raised = self._run_piece(self._look)
        self._collect_due(raised)
        self._call_due()
        if raised is not None:
            self._time = max(self._time, float(self._prepared.run.clock[ki.TIME]))
            raise raised

    def _look(self) -> None:
        """Check for signals while compiled code runs."""
        interruption.check()

    def _load(self) -> None:
        """Load or compile the kernels before the first piece, so that it does not count as integration time."""
        if not self._loaded:
            prepared = self._prepared
            size = prepared.model.n, len(prepared.contacts), len(prepared.stops)
            recall("kernels", partial(stopping.load, prepared), prepared.choice.method, *size)
            self._loaded = True

    def _run_piece(self, look: Callable[[], None]) -> BaseException | None:
        """Run one piece of compiled code and return the exception raised meanwhile by ``look`` or by a signal."""
        self._load()
        begun = clock.perf_counter()
        self._prepared, raised = stopping.advance(self._prepared, self._watch, look, self._kernel)
        self._wall += clock.perf_counter() - begun
        return raised

    def _collect_due(self, raised: BaseException | None) -> None:
        """Empty the kernel log, and collect the callbacks due at the current time of the run.

        All callbacks are collected before the first is called, so that a snapshot taken in a callback contains all
        events and due callbacks of this time.
        """
        run = self._prepared.run
        for time, e in take_log(run):
            named = event_name(self._prepared, e)
            kind, subject, call = self._guards[e] if named is None else (*named, None)
            self._happened.append(Event(time, kind, subject))
            if call is not None:
                self._due.append(call)
        ticked = int(run.count[ki.TICKED])
        run.count[ki.TICKED] = 0
        if not self._failed():
            self._due += [call for k, call in enumerate(self._calls) if ticked & (ki.CALLER << k)]
        elif raised is None:
            self._due.append(Simulation._raise_stopped)
        if self._due:
            self._time = float(run.clock[ki.TIME])

    def _call_due(self) -> None:
        """Call all due callbacks, each once, even if it raises."""
        while self._due:
            self._calling = self._due.pop(0)
            try:
                self._calling(self)
            finally:
                self._calling = None

    def _raise_stopped(self) -> None:
        raise_stopped(stopped(self._scenario, self._prepared), self.record(pictured=self._pictured))

    def _failed(self) -> bool:
        """Return whether the run has ended before its regular end, also if the base has tipped and that ends it."""
        status, base = self._prepared.run.count[ki.STATUS], self.robot.base
        if status == ki.STOPPED and base is not None and base.stop_on_overturn:
            return any(event.kind == TIP_OVER for event in self._happened)
        return bool(status not in (ki.RUNNING, ki.FINISHED, ki.STOPPED))

    def _settle_now(self, *, calling: bool = True) -> None:
        """End a step at the present time if it lies within one.

        If ``calling`` is True, callbacks of events that only the shorter steps detect are called at the times of these
        events. If it is False, the caller undoes this step.
        """
        run, now = self._prepared.run, self._time
        if run.count[ki.PENDING] == 0 or self.finished:
            return
        run.count[[ki.PENDING, ki.SEARCHING, ki.FIRED]] = 0
        step = run.clock[ki.STEP] = max(run.clock[ki.PROPOSED], run.clock[ki.STEP])
        if now > run.clock[ki.TIME]:
            self._integrate_to(now, calling)
            # After an abandoned piece of compiled code, the run consists of copies.
            run = self._prepared.run
            if self.finished:
                self._time = float(run.clock[ki.TIME])
                return
            self._time = run.clock[ki.TIME] = now
            run.clock[ki.STEP] = max(run.clock[ki.STEP], step)

    def _integrate_to(self, until: float, calling: bool) -> None:
        """Integrate to a time as if the run ended there, or until it ends earlier."""
        reached, self._until = False, until
        while not (reached or self.finished):
            self._keep_window(until)
            run = self._prepared.run
            if run.count[ki.PENDING] == 1:
                self._refill(run.clock[ki.TIME] + run.clock[ki.STEP])
                run = self._prepared.run
            run.clock[ki.HOLD], run.clock[ki.END] = self._hold_time(until), until
            # This end is only part of an operation, so pending signals must wait.
            raised = self._run_piece(lambda: None)
            # Callbacks and their snapshots must not see this temporary end.
            run = self._prepared.run
            run.clock[ki.END] = self._end
            reached = bool(run.count[ki.STATUS] == ki.FINISHED)
            if reached:
                run.count[ki.STATUS] = ki.RUNNING
            self._collect_due(raised)
            if calling:
                self._call_due()
            elif self._failed() and raised is None:
                self._raise_stopped()
            if raised is not None:
                self._time = float(run.clock[ki.TIME])
                raise raised

    def _restart(self) -> None:
        """Restart the integration at the present state with the same step size, because derivatives have jumped."""
        self._prepared.run.count[ki.STARTED] = 0

    def _freeze(self) -> None:
        """Keep moving references at their final values."""
        # End the pending step first, so that a snapshot taken in a callback on the way is not frozen.
        self._settle_now()
        self._frozen = True
        for joint, a in self._motors.items():
            if self._prepared.system.reference.spline[a] >= 0:
                self._hold_at_end(joint)

    def _hold_at_end(self, joint: str) -> None:
        """Keep the reference of a joint at the final value of its spline."""
        reference = self._prepared.system.reference
        powers = reference.grid[1] ** np.arange(6)
        end = float(reference.coefficients[-1, self._splines[self._motors[joint]]] @ powers)
        self._follow_lines(np.array([self._motors[joint]]), np.array([[end, 0.0]]))

    def _refill(self, until: float = -np.inf) -> None:
        """Move samples to the trace, and fill the buffer with the next sample times, at least up to ``until``."""
        run = self._prepared.run
        times = self._trace.move(run, until)
        if len(times) != len(run.sample_time):
            self._swap(
                sample_time=times,
                sample=np.zeros((len(times), run.layout.size)),
                output=np.zeros((len(times), run.columns.size)),
            )
        else:
            run.sample_time[:] = times
        run.count[ki.SAMPLE] = 0

    def _swap(self, **arrays: Any) -> None:
        """Replace some arrays of the run."""
        self._prepared = replace(self._prepared, run=self._prepared.run._replace(**arrays))

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays of the run and its tables with their names: the complete changing state."""
        prepared = self._prepared
        parts = {"run": prepared.run, "workspace": prepared.workspace, "system": prepared.system}
        return {name: array for owner, part in parts.items() for name, array in _arrays_in(part, owner)}


def _arrays_in(value: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays in nested named tuples, with dotted names."""
    if isinstance(value, np.ndarray):
        yield name, value
    elif hasattr(value, "_asdict"):
        for field, part in value._asdict().items():
            yield from _arrays_in(part, f"{name}.{field}")


def _index(choices: dict[str, int], name: str, family: str) -> int:
    if name not in choices:
        raise ModelError(f"unknown {family} {brief(name)}; choices: {', '.join(choices) or 'none'}")
    return choices[name]


def _finite(quantity: str, values: ArrayLike) -> Array:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"{quantity} must be numeric, got {brief(values)}") from None
    # The sum of squares is faster to check, but may overflow.
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():
        raise ModelError(f"{quantity} must be finite, got {array.tolist()}")
    return array


# Start of a dynamics run: initial posture, gaps, tip margin, and the checks before the first step.


# A joint that the posture solution moves by less than this counts as unmoved [rad or m].
MOVED = 1e-12


def check(scenario: Scenario, started: Callable[[Start], None]) -> Start:
    """Check the scenario, see :func:`dynsim.engine.check`."""
    start = start_of(scenario)
    started(start)
    prepared = prepare(scenario)
    control, model = prepared.control, prepared.model
    start = replace(start, scene=drawn_scene(scenario, model.robot, prepared.contacts))
    if prepared.balance is not None:
        # Pressing compliant contacts in moves joints.
        points, gaps, pairs = _touching(model, prepared.contacts)
        hand = model.point_position(*model.robot.hand, model.robot.initial)
        said = [*start.warnings, *prepared.balance.warnings]
        start = replace(start, hand=hand, contacts=points, gaps=gaps, pairs=pairs, warnings=said)
    if (unstable := unstable_loop(scenario, prepared)) is not None:
        start = replace(start, warnings=[*start.warnings, unstable[0]])
    if control.path is not None and control.teleop is None:
        begin = control.path.position(np.zeros(1))[0]
        start = replace(start, off_path=float(np.linalg.norm(begin - start.hand)))
    _begin(scenario, prepared)
    return start


def commanded_by_python(scenario: Scenario) -> bool:
    """Return whether Python code sets commands at ticks: an operator, a snake's controller, or encoders."""
    controller, sensors = scenario.controller, scenario.config.sensors
    encoded = sensors is not None and sensors.encoders is not None
    if encoded or controller is None:
        return encoded
    of_snake = member("controller", controller.type).ENGINE == "kinematic"
    return of_snake or getattr(controller, "operator", None) is not None


def _begin(scenario: Scenario, prepared: Prepared) -> None:
    """Choose contact modes and find forces at t = 0, as a run does before its first step.

    Nothing is done if Python code sets the first commands.

    Raises
    ------
    SimulationStopped
        If no consistent forces exist, or if they break down immediately.
    """
    if not prepared.contacts or commanded_by_python(scenario):
        return
    stopping.load(prepared)
    work = partial(driver.advance, prepared.system, prepared.workspace, prepared.run, 0)
    _, raised = stopping.run_in_thread(work, lambda: None, interruption.check)
    if raised is not None:
        raise raised
    if prepared.run.count[ki.STATUS] not in (ki.RUNNING, ki.FINISHED):
        raise stopped(scenario, prepared)


def start_of(scenario: Scenario) -> Start:
    """Return posture, gaps and margins at t = 0, whether they are valid or not."""
    described, contacts, piloted = at_start(scenario)
    model = recall("model", lambda: Model(described), described)
    robot = model.robot
    q, (points, gaps, pairs) = robot.initial, _touching(model, contacts)
    declared = scenario.config.contacts.points
    movable = declared.keys() - {contact.name for contact in contacts if contact.left_out}
    if piloted is not None:  # `initial` does not place the joints of a snake
        movable = set()
    brace = getattr(scenario.config.controller, "brace", None)
    for name, force in brace.items() if isinstance(brace, dict) else ():
        if (during := getattr(force, "during_s", None)) and during[0][0] > 0.0:  # presses later
            movable = movable - {name}
    aloft = [name for name, gap in gaps.items() if name in movable and abs(gap) > build.START_TOLERANCE]
    solved = {}
    if scenario.config.initial is not None and scenario.config.initial.on_surface:
        before = build.unposed(scenario).initial
        for link, k in zip(robot.links, robot.position_index, strict=True):
            if len(link.row.neutral) == 1 and abs(q[k] - before[k]) > MOVED:
                angle = link.units[0] == "rad"
                ends = np.array([q[k], before[k]])
                to, was = (np.degrees(ends) if angle else ends).tolist()
                solved[link.joint] = (to, was, "deg" if angle else "m")
    hand = model.point_position(*robot.hand, q)
    key = build.on_surface_key(scenario, aloft) if aloft else ""
    warnings = [
        *robot.notes,
        *without_effect(scenario, bool(robot.motors)),
        *idle_entries(scenario, robot),
        *_below(scenario, robot),
        *build.left_out_warnings(scenario, contacts),
    ]
    start = Start(hand, points, gaps, key, solved, *_margins(scenario, model, contacts), warnings)
    nearest = {name: at for name, at in _nearest(robot).items() if name not in solved}
    return replace(start, nearest=nearest, pairs=pairs)


def _nearest(robot: Robot) -> dict[str, tuple[float, str]]:
    """Return the positions [deg or m] of joints that start at the legal position nearest to zero, and their units."""
    q, joints = robot.initial, zip(robot.links, robot.position_index, strict=True)
    return {
        link.joint: (float(np.degrees(q[k])), "deg") if link.units[0] == "rad" else (float(q[k]), link.units[0])
        for link, k in joints
        if link.joint in robot.nearest
    }


def _touching(model: Model, contacts: Sequence[Contact]) -> tuple[dict[str, Array], dict[str, float], dict[str, float]]:
    """Return the positions (3,) of contact points at the start, their gaps, and the gaps of pairs of bodies [m]."""
    points, gaps, pairs, q = dict[str, Array](), dict[str, float](), dict[str, float](), model.robot.initial
    for contact in contacts:
        if contact.slot:  # the first contact of two solids is the deepest
            continue
        try:
            gap = gap_at(model, contact, q)
        except ModelError:  # an unknown body; the contact check reports it with its line
            continue
        if contact.is_between_bodies:
            name = f"{contact.body}-{contact.surface_name}"
            pairs[name] = min(gap, pairs.get(name, gap))
        else:
            gaps[contact.name] = gap
            points[contact.name] = model.point_position(contact.body, contact.point, q)
    return points, gaps, dict(sorted(pairs.items(), key=lambda entry: entry[1]))


def _below(scenario: Scenario, robot: Robot) -> list[str]:
    """Return a warning for each surface that bodies start below."""
    sunk = by_surface(sinking(robot, build.surfaces(scenario), robot.initial[None]))
    return [
        f"{', '.join(s.body for s in below)}: below {surface} at the start, by up to "
        f"{1e3 * max(s.depth for s in below):.3g} mm; only contact points interact with surfaces"
        for surface, below in sunk.items()
    ]


def _margins(scenario: Scenario, model: Model, contacts: Sequence[Contact]) -> tuple[float | None, float | None]:
    """Return the tip margins of a mobile base at rest, without and with its braces; None if undefined."""
    robot, q = model.robot, model.robot.initial
    if robot.base is None:
        return None, None
    loads = build.loads(scenario, robot)
    forces = load_forces(model, q, loads)
    alone, able = static_margin(model, q, forces), [motor.joint for motor in robot.motors]
    try:
        balance = holding_torques(model, q, contacts, loads, able, scenario.config.contacts.law == "unilateral")
    except ModelError:
        return alone, None
    return alone, static_margin(model, q, [*forces, *balance.forces]) if balance.forces else None


# Complete runs: integrate the coupled system and make the record.


# Ticks between checks for Ctrl-C and progress updates.
TICKS = 10


class _WholeRun(Simulation):
    """Run of a scenario to its end that nobody but its own controllers changes, and that reports its progress."""

    def __init__(self, scenario: Scenario, progress: Progress | None, pictured: bool) -> None:
        self._progress, self._pictured, self._ticked = progress, pictured, commanded_by_python(scenario)
        # Without ticks, compiled code runs to the end in one piece, and its buffer is the record.
        self._block = BLOCK if self._ticked else 1 << 62
        # With ticks it has no end, as in a session: a step that ends at a tick and one at the end of a run may differ.
        super().__init__(scenario, duration=math.inf if self._ticked else None)
        if self._ticked:
            self.end_samples(scenario.duration_s)

    def _prepare(self, **options: Any) -> Prepared:
        # Ticks change tables, which other runs must not share.
        with remembering(Memo() if self._ticked else None):
            return prepare(self._scenario, self._progress, pushable=self._ticked, **options)

    def _look(self) -> None:
        if self._progress is not None:
            self._progress(float(self._prepared.run.clock[ki.TIME]), SIMULATION)
        interruption.check()

    def work(self) -> None:
        """Integrate to the end."""
        end, method, ticks, period = self._scenario.duration_s, self._prepared.choice.method, 0, math.inf
        if self._ticked:
            period = self._prepared.control.sample_time or 1.0 if self._operator is None else self._operator.period
        self._load()
        self._look()
        if nearest := _nearest(self._prepared.model.robot):
            text = ", ".join(f"{joint} {value:.6g} {unit}" for joint, (value, unit) in nearest.items())
            log.info("%s: joints without a position start within their limits: %s", self._scenario.title, text)
        log.info("%s: integrating %g s by %s", self._scenario.title, end, method)
        while self._time < end and not self.finished:
            ticks += TICKS
            # A signal within a callback would leave references half written.
            interruption.keep()
            self.advance(min(ticks * period, end))
            interruption.heed()
            self._look()

    def interrupt(self) -> SimulationInterrupted:
        """Return the exception for Ctrl-C."""
        self._ended_by = interrupted(self._scenario, self._time, last_state(self._prepared, self._prepared.run.y))
        return self._ended_by

    def result(self) -> Record:
        """Return the record up to now."""
        run = self._prepared.run
        steps, wall = run.count[ki.STEPS], self._wall
        log.info("%s: integrated %g s in %d steps, %.3f s", self._scenario.title, run.clock[ki.TIME], steps, wall)
        return self.record(pictured=self._pictured)


def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """Simulate the scenario, see :func:`dynsim.engine.simulate`."""
    run = _WholeRun(scenario, progress, pictured)
    record = run_to_end(run.work, run.interrupt, run.result)
    record.complete = True
    return record

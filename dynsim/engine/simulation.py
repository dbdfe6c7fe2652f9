"""Simulation under the caller's control: advance, read, rewrite references and wrenches, restore a snapshot.

Steps are those of :func:`dynsim.simulate`, bit for bit, as long as nothing is rewritten: ``advance`` does not cut them.
The step that passes the requested time is kept, and the state at that time is taken from its dense output. Only when
something is rewritten, that step is discarded, and a shorter one ends at the requested time.

Long because: it is one class, the public stepper, and half of it is its documentation.
"""

from __future__ import annotations

import logging
import math
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.compile.clearance import by_surface, sinking
from dynsim.compile.control import END_SLACK, JointControl
from dynsim.compile.model import Model
from dynsim.compile.posture import holding_torques, load_forces, static_margin
from dynsim.compile.references.teleop import VelocitySource
from dynsim.compile.shapes import gap_at
from dynsim.compile.tables import check_couplings, joint_stops
from dynsim.compile.tie_rests import deflection, may_have_slid, rest_here, set_rests
from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.drive.law import take_measured_commands
from dynsim.dynamics.state import block
from dynsim.dynamics.tree import loads as kl
from dynsim.dynamics.tree.joints import normalise
from dynsim.engine import SIMULATION, Progress, Start, stopping
from dynsim.engine.brakes import Brakes, projection_loss
from dynsim.engine.linearization import Linearization, linearized
from dynsim.engine.operator import EncodedCommands, Operator
from dynsim.engine.outcome import interrupted, mark_stopped, raise_stopped
from dynsim.engine.prepare import Prepared, at_start, prepare, sample_times
from dynsim.engine.recording import make_record
from dynsim.engine.soundness import unstable_loop
from dynsim.engine.stepped import GUARDS, Snapshot, State, Touch, event_name, own_guards, take_log
from dynsim.engine.stopping import last_state, stopped
from dynsim.engine.trace import Trace
from dynsim.errors import ModelError, ScenarioError, SimulationStopped, brief, first_few
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.integrators.run import state_within
from dynsim.model.description import Contact, Robot
from dynsim.model.drives import Drive
from dynsim.record import Event, Record
from dynsim.record.measures import TIP_OVER
from dynsim.scenario import Scenario, build, require_scenario
from dynsim.scenario.build import START_TOLERANCE, check_start
from dynsim.scenario.combinations import LINEARIZATION, WATCHED_EVENTS
from dynsim.scenario.effect import without_effect
from dynsim.system import interruption
from dynsim.system.memo import Memo, recall, remembering

if TYPE_CHECKING:
    from dynsim.engine.snake_pilot import SnakePilot
    from dynsim.snake.description import CommandSource

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

# Most steps in one call of compiled code, which ends sooner on request, see dynsim.engine.stopping.
_PIECE = 1 << 62
# Limits on ticks of callers: their number (kinds are bits of an integer), and their period [s].
MOST_TICKS, SHORTEST_PERIOD = 60, 1e-9
# Ticks within this of the requested time count as at it, relative to that time.
TICK_SLACK = 1e-12
# End of a run without a given end [s]: finite, and later than any time in use.
_FAR = 1e300
# A state under time stepping may be a step of this speed below a surface or beyond a stop [m/s or rad/s].
FASTEST_LANDING = 5.0
SERVO_MODES = {"position": ka.POSITION_MODE, "velocity": ka.VELOCITY_MODE, "off": ka.OFF}
# Buffers into which kernels sample; their sizes change. So do the tables of callbacks, to which more may be added.
_BUFFERS = {f"run.{field}": field for field in ("sample_time", "sample", "output")}
_TABLES = {f"run.{field}": field for field in ("tick", "tick_table", "event", "event_table")}


class Simulation:
    """A scenario that is advanced by its caller.

    >>> simulation = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "two_elbows"))
    >>> simulation.advance(0.5).q
    >>> simulation.set_wrench("link_10", force=[0.0, 0.0, -5.0])
    >>> simulation.advance(1.0)
    >>> record = simulation.record()

    Parameters
    ----------
    scenario : of a plant with dynamics
    state : to start from, at its time; default: the scenario's, at t = 0. ``State.of(record)`` is that of a record's
        last sample. The ledger starts at zero.
    duration : end of the run [s], ``math.inf`` for none; default: the scenario's. References hold where they end.
    trace : samples that are kept: all (None), the last so many, or none (0)
    motors : instead of those of the plant, see :mod:`dynsim.model.description`; records still show the scenario's
    operator : instead of the script of a scenario that has ``controller.operator``, or of a snake's

    Raises
    ------
    ModelError, UnreachableReference, ScenarioError
        See :func:`dynsim.simulate`; a state of another robot, or one whose contact points are off their surfaces.
    """

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
            raise ModelError(f"a simulation starts from a State, such as State.of(record), not from {brief(state)}")
        if trace is not None and (not isinstance(trace, int) or trace < 0):
            raise ScenarioError(f"trace is a number of samples, or None for all, not {brief(trace)}")
        start = 0.0 if state is None else float(state.time)
        if not math.isfinite(start):
            raise ModelError(f"the state to start from has time {start}")
        end = scenario.duration_s if duration is None else float(duration)
        if not end > start:
            raise ScenarioError(f"a simulation from t = {start:g} s cannot end at {end:g} s")
        self._scenario = scenario
        self._end = min(end, _FAR)
        # Tables that callers may change are nobody else's.
        with remembering(Memo()):
            self._prepared = prepare(
                scenario,
                pushable=True,
                times=np.full(1, np.inf),
                end=self._end,
                motors=motors,
                starts=state is None,
            )
        if (unstable := unstable_loop(scenario, self._prepared)) is not None:
            # Live sessions may never make a record, whose summary has this warning.
            log.warning("%s: %s", scenario.title, unstable[0])
        self._time, self._begun, self._wall = start, start, 0.0
        # Of a ring, and of a run that goes on from another, the ledger counts from the first sample on.
        self._relative = trace is not None or state is not None
        self._happened: list[Event] = []
        self._token = object()
        # What a controller has ended the run by.
        self._ended_by: SimulationStopped | None = None
        # Callbacks that are due at the present time, in the order of their calls; the callback that is called now.
        self._due: list[Callable[[Simulation], None]] = []
        self._calling: Callable[[Simulation], None] | None = None
        self._loaded, self._watch = False, stopping.WallWatch(scenario.integrator.wall_limit_s)
        self._kernel = driver.direct(self._prepared.run)
        self._guards: list[tuple[str, str, Callable[[Simulation], None] | None]] = []
        self._calls: list[Callable[[Simulation], None]] = []
        robot = self.robot
        self._guards.extend((kind, subject, None) for kind, subject in own_guards(self._prepared))
        self._brakes = Brakes(scenario, self._prepared)
        self._joints = {link.joint: i for i, link in enumerate(robot.links)}
        self._motors = {motor.joint: a for a, motor in enumerate(robot.motors)}
        first = len(self._prepared.loads) - len(robot.bodies)
        self._pushes = {body: first + k for k, body in enumerate(robot.bodies)}
        # As planned: a motor whose reference is rewritten now may be given back later.
        self._splines = self._prepared.system.reference.spline.copy()
        self._voltages = self._prepared.system.reference.voltage.copy()
        self._references_end = self._prepared.control.end
        self._frozen = not math.isfinite(self._references_end)
        self._pushed: set[int] = set()
        times = None
        if state is None and self._end == scenario.duration_s and trace is None:
            # The very samples of simulate; its limit of size holds here too.
            times = sample_times(scenario, self._prepared.run.layout, self._prepared.run.columns, len(robot.links))
        self._trace = Trace(start, self._end, scenario.record.rate_hz, trace, times)
        self._sampled = self._prepared.system.drives.table[:, ka.SAMPLED].copy()
        reference = self._prepared.control.reference
        # As planned: where the base should be is drawn from it, until a wheel is told otherwise.
        self._planned = replace(self._prepared.control, reference=reference._replace(spline=reference.spline.copy()))
        self._base_as_planned = state is None
        self._said: list[str] = []
        # Where samples are to end [s]; once a step has passed that, what there was, and the wall time until then [s].
        self._samples_end: float = math.inf
        self._window: tuple[Snapshot, float] | None = None
        run = self._prepared.run
        if state is not None:
            self._take(state)
        run.clock[[ki.TIME, ki.COUNTED_SINCE]] = start
        run.tick[:, [ki.TICK_NEXT, ki.TICK_PHASE]] = start
        self._refill()
        encoded = self._encoded_commands()
        self._operator = self._attendant(operator, state)
        if self._operator is not None:
            self.every(self._operator.period, self._operator)
        elif operator is not None:
            raise ScenarioError("an operator needs a scenario with controller.operator, which says what it moves")
        self._attendants = [attendant for attendant in (encoded, self._operator) if attendant is not None]
        self._own_calls = tuple(self._calls)

    def _attendant(self, source: Any, state: State | None) -> Operator | SnakePilot | None:
        """Who rewrites references at the ticks of its own, where the scenario has somebody."""
        control = self._prepared.control
        if control.teleop is not None:
            return Operator(self.model, control.teleop, source, state)
        if control.task_space is None:
            return None
        # Imported here: an arm needs nothing of a snake.
        from dynsim.engine.snake_control import control_periods
        from dynsim.engine.snake_pilot import SnakePilot

        if state is not None:
            raise ModelError(
                "a snake with a task-space controller cannot start from a State, which contains neither its target nor "
                "its gripper; go back to a Simulation.snapshot()"
            )
        periods = control_periods(self._scenario, control.task_space.schedule.period)
        pilot = SnakePilot(self.model, control.task_space, *periods, source, self._scenario.config.sensors)
        for sensor in pilot.sensors:
            # Before the controller, where both are due.
            self.every(sensor.period, sensor)
        return pilot

    def _encoded_commands(self) -> EncodedCommands | None:
        """Who takes commands at the ticks of a sampled controller that has encoders."""
        sensors, period = self._scenario.config.sensors, self._prepared.control.sample_time
        if sensors is None or sensors.encoders is None or period is None:
            return None
        encoded = EncodedCommands(sensors.encoders, sensors.seed, self.robot, period, self._take_commands)
        self.every(encoded.sensor.period, encoded.sensor)
        self.every(period, encoded)
        return encoded

    def _take_commands(self, position: Array, rate: Array) -> None:
        """Take the commands of all sampled motors by measured positions and rates of their joints, (na,)."""
        self._settle_now()
        system, workspace = self._prepared.system, self._prepared.workspace
        driven = system.drives.table[:, ka.DRIVEN]
        workspace.joints[driven, ka.Q], workspace.joints[driven, ka.QD] = position, rate
        take_measured_commands(system.drives, system.reference, self._time, workspace)
        self._restart()

    @property
    def scenario(self) -> Scenario:
        """What is simulated."""
        return self._scenario

    @property
    def robot(self) -> Any:
        """The robot, with the names of its joints, motors and bodies."""
        return self._prepared.model.robot

    @property
    def model(self) -> Model:
        """Its rigid-body model; ``armature`` is very large where a brake is closed."""
        return self._prepared.model

    @property
    def touching(self) -> dict[str, Touch]:
        """What each contact point did at the last sample; empty before the first."""
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
            )
            for contact, row in zip(self._prepared.contacts, rows, strict=True)
        }

    @property
    def tie_force(self) -> dict[str, float]:
        """Forces on the first bodies of ties in the last step [N or N m]; zero where a tie does not hold."""
        unilateral = self._prepared.system.unilateral
        if unilateral is None:
            return {}
        forces = np.where(unilateral.tie_table[:, ku.TIE_HOLDS] == 1, unilateral.tie[:, ku.TIE_FORCE], 0.0)
        return dict(zip((tie.name for tie in self.robot.ties), forces.tolist(), strict=True))

    @property
    def tie_slip(self) -> dict[str, float]:
        """Ways by which ties have slid beyond their bounds since they began, there and back [m or rad]."""
        unilateral = self._prepared.system.unilateral
        slips = [] if unilateral is None else unilateral.tie[:, ku.TIE_GIVEN].tolist()
        return dict(zip((tie.name for tie in self.robot.ties), slips, strict=False))

    @property
    def operator(self) -> Operator | SnakePilot | None:
        """Who rewrites references: of hand and base under ``controller.operator``, of a snake under ``task_space``."""
        return self._operator

    @property
    def time(self) -> float:
        """Time that was last advanced to [s]."""
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
        """The state at :attr:`time`."""
        run = self._prepared.run
        y = run.y.copy()
        if run.count[ki.PENDING] == 1 and self._time > run.clock[ki.TIME]:
            state_within(run, self._time, y)
            if run.layout.extra > 0:
                # Between the ends of a step it is a polynomial, also of quaternions.
                normalise(self._prepared.system.model, y, run.layout.q)
        q, v, current = (y[block(run.layout, name)] for name in ("q", "v", "current"))
        unilateral = self._prepared.system.unilateral
        if unilateral is None or not len(unilateral.tie):
            return State(self._time, q, v, current)
        return State(self._time, q, v, current, unilateral.tie[:, ku.TIE_REST].copy())

    def advance(self, until: float) -> State:
        """Integrate up to a time [s], or to the end of the run when that comes first, and return the state there.

        Callbacks of :meth:`every` and :meth:`watch` are called on the way, also those due at ``until``. An error that
        one raises ends the call; the simulation stands at its time, and can be advanced again: that callback is not
        called again, and what else is due at that time is called first.

        Raises
        ------
        ScenarioError
            A time that is past, or not a number.
        SimulationStopped
            Divergence, no solution, no progress, or the wall limit; ``error.record`` holds the trace until then.
        KeyboardInterrupt
            Ctrl-C, within a second. The simulation stands at a step on the way, and can be advanced again, unless that
            step would have taken longer.
        """
        if self._calling is not None:
            raise ScenarioError("a callback cannot advance the simulation that calls it")
        if not isinstance(until, (int, float, np.number)) or not until >= self._time:
            raise ScenarioError(f"cannot advance to t = {brief(until)} s: the simulation is at {self._time:g} s")
        try:
            return self._advanced(min(float(until), self._end))
        except SimulationStopped as stop:
            if stop.record is None:  # of the controller, as a snake's, whose task has failed
                self._ended_by = stop
                raise_stopped(stop, self.record())
            raise

    def _advanced(self, until: float) -> State:
        # What a snapshot, or an error in a callback, has left over.
        self._call_due()
        last = self._references_end
        # References of the whole run may end a rounding before it, where nothing is to be rewritten.
        if not self._frozen and until > last + END_SLACK * max(1.0, abs(last)):
            self._reach(max(last, self._time))
            if not self.finished:
                self._freeze()
        self._reach(until)
        return self.state

    def end_samples(self, time: float) -> None:
        """Let the samples end with one at a time [s], as those of a run that ends there do; the simulation goes on.

        Later records are those of a run that ends there: their events and summary too.

        Raises
        ------
        ScenarioError
            A time that is past, or samples that have ended already.
        """
        if not time >= self._time:
            raise ScenarioError(f"samples cannot end at t = {brief(time)} s: the simulation is at {self._time:g} s")
        if self._window is not None:
            raise ScenarioError(
                f"samples have ended at t = {self._samples_end:g} s and cannot go on; restore a snapshot of before"
            )
        self._samples_end = float(time)
        self._trace.end_at(float(time), self._prepared.run)

    def every(self, period: float, call: Callable[[Simulation], None], *, first: float | None = None) -> None:
        """Call back every ``period`` [s] from ``first`` on (default: now): a sampled controller.

        Steps end there, and what ``call`` rewrites holds until it is rewritten again. Callbacks that are due at one
        time are called in this order: those of :meth:`watch`; encoders, controller and operator of the scenario; then
        the others, as they were added.
        """
        first = self._time if first is None else float(first)
        if not (period >= SHORTEST_PERIOD and math.isfinite(period) and first >= self._time):
            raise ScenarioError(
                f"a tick needs a period of at least {SHORTEST_PERIOD:g} s and a first time from now on, "
                f"not {period!r} and {first!r}"
            )
        if len(self._calls) == MOST_TICKS:
            raise ScenarioError(f"a simulation has at most {MOST_TICKS} ticks; call several functions at one")
        # First, since callbacks on the way may add ticks.
        self._settle_now()
        run = self._prepared.run
        tick = np.zeros((1, ki.TICK_SIZE))
        tick[0, [ki.TICK_PERIOD, ki.TICK_NEXT, ki.TICK_PHASE]] = period, first, first
        table = np.array([[ki.CALLER << len(self._calls), 0]])
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
        """Locate where a quantity passes a level: an event.

        Parameters
        ----------
        kind : ``joint_position``, ``joint_rate``, ``motor_current``, ``motor_voltage``, ``contact_force``,
            ``contact_gap``, ``hand_position`` or ``tip_margin``
        subject : joint, joint of the motor, contact, x, y, z of the hand, or the mobile base
        level : [rad, m, rad/s, A, V, N, 1]
        direction : +1 rising only, −1 falling only, 0 both
        call : called at the event, may rewrite; ``stop`` ends the run there

        Raises
        ------
        ModelError
            No such kind or subject.
        ScenarioError
            Under ``integrator.method: time_stepping``, which locates nothing within its steps.
        """
        if conflict := WATCHED_EVENTS.conflict(self.scenario.config):
            raise ScenarioError(f"Simulation.watch {WATCHED_EVENTS.message(conflict)}")
        if kind not in GUARDS:
            raise ModelError(f"no event {brief(kind)}; events: {', '.join(GUARDS)}")
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
        """From now on the motor of a joint follows q_d(t) = position + rate (t − now) [rad, rad/s; m, m/s].

        Of an open torque ``position`` is the torque [N m]. What ``initial.equilibrium`` has moved the references by is
        added. Voltages that ``feed_forward`` or ``brace`` has planned for this motor belong to its planned reference:
        they do not act until :meth:`release`.
        """
        self.set_references({joint: (position, rate)})

    def set_references(self, lines: Mapping[str, tuple[float, float]]) -> None:
        """:meth:`set_reference` of several joints at once: (position, rate) by joint."""
        if not lines:
            return
        self.set_lines(np.array([self._motor(joint) for joint in lines]), list(lines.values()))

    def set_lines(self, motors: NDArray[np.int64], lines: ArrayLike) -> None:
        """:meth:`set_references` by numbers of motors in ``robot.motors``, (m,): position and rate of each, (m, 2)."""
        values = _finite("reference", lines)
        if (balance := self._prepared.balance) is not None:
            values[:, 0] += balance.shift[motors]
        self._follow_lines(motors, values)
        self._plan_voltages(motors, 0.0)
        self._leave_plan(self.robot.motors[a].joint for a in motors)

    def _follow_lines(self, motors: NDArray[np.int64], values: Array) -> None:
        """Let motors follow lines from now on, values (motors, 2)."""
        self._settle_now()
        drives, reference = self._prepared.system.drives, self._prepared.system.reference
        reference.spline[motors], drives.table[motors, ka.SAMPLED] = ka.REWRITTEN, self._sampled[motors]
        drives.input[motors, ka.LINE_START : ka.LINE_RATE + 1] = values
        drives.input[motors, ka.LINE_SINCE] = self._time
        self._restart()

    def _plan_voltages(self, motors: NDArray[np.int64], share: float) -> None:
        """Let a share of the planned voltages act on motors: 1 along their planned references, 0 along others."""
        if len(planned := self._voltages):
            self._prepared.system.reference.voltage[:, motors] = share * planned[:, motors]

    def set_command(self, joint: str, command: float) -> None:
        """Hold the command of a motor: the voltage of a motor or servo [V], the torque of an open torque [N m]."""
        a = self._motor(joint)
        value = _finite("command", [command])[0]
        self._settle_now()
        drives = self._prepared.system.drives
        drives.table[a, ka.SAMPLED], drives.input[a, ka.COMMAND] = ka.GIVEN, value
        self._restart()
        self._leave_plan([joint])

    def _leave_plan(self, joints: Iterable[str]) -> None:
        """Remember that a wheel of the base does not do any more what the scenario says."""
        base = self.robot.base
        if base is not None and any(joint in base.wheels for joint in joints):
            self._base_as_planned = False

    def set_mode(self, joint: str, mode: str) -> None:
        """Let a servo follow positions (``"position"``) or rates (``"velocity"``) of its reference, or switch it off.

        ``"off"`` opens its circuit, and the drag of its gear is left. It must have the gain of the mode.
        """
        a = self._motor(joint)
        number = _index(SERVO_MODES, mode, "mode")
        drives = self._prepared.system.drives
        if drives.table[a, ka.DRIVE_KIND] != ka.POSITION_SERVO:
            raise ModelError(f"the motor of {joint} is no servo and has no modes")
        gain = {ka.POSITION_MODE: ka.K_P, ka.VELOCITY_MODE: ka.K_V}.get(number)
        if gain is not None and drives.motor[a, gain] == 0.0:
            raise ModelError(f"the servo of {joint} has no gain in mode {mode}")
        self._settle_now()
        drives.table[a, ka.SERVO_MODE] = number
        self._restart()

    def set_supply(self, voltage: float) -> None:
        """From now on the supply of all motors limits their voltages to this one [V], whatever limits they had."""
        value = _finite("supply", [voltage])[0]
        if value < 0.0:
            raise ModelError(f"a supply of {voltage:g} V; it must not be negative")
        self._settle_now()
        self._prepared.system.drives.motor[:, ka.U_MAX] = value
        self._restart()

    def set_brake(self, joint: str, closed: bool) -> None:
        """Close or open the brake that every joint is thought to have: it holds the joint where it is.

        A joint that turns is brought to rest by an impulse, Δv = −M⁻¹ e v_j / (eᵀ M⁻¹ e) with e the joint's unit vector
        and M with rotors, and joint losses of the ledger take the kinetic energy, ½ v_j² / (eᵀ M⁻¹ e). Contacts and
        couplings answer with impulses of their own: what these take is impact loss under the unilateral law, joint loss
        under the bilateral one. A contact that braked joints alone would move along its normal is left out meanwhile.
        """
        j = _index(self._joints, joint, "joint")
        if any(joint in (coupling.joint, coupling.leader) for coupling in self.robot.couplings):
            raise ModelError(f"{joint}: a joint that is coupled to another has no brake of its own")
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
        """Let a tie begin or end, or change its spring and damper; what is not given stays as it is.

        A tie that begins has no force where its bodies are then, unless the scenario states its rest. What is added to
        a spring is not deflected yet, x_0 moves so that the force stays, as in a gripper that hardens in the shape
        that it has; what is taken from a spring takes its force with it. Both take energy from the spring, which
        counts as lost in its damper, and so does all of it when a tie ends.

        >>> simulation.set_tie("grip", holds=True)

        Parameters
        ----------
        name : a key of the scenario's ``ties``
        stiffness, damping : [N/m, N s/m; N m/rad, N m s/rad]

        Raises
        ------
        ModelError
            No such tie, a negative value, or neither a stiffness nor a damping.
        """
        ties = {tie.name: k for k, tie in enumerate(self.robot.ties)}
        k = _index(ties, name, "tie")
        asked = {"stiffness": stiffness, "damping": damping}
        values = {key: _finite(key, [value])[0] for key, value in asked.items() if value is not None}
        unilateral = self._prepared.system.unilateral
        assert unilateral is not None  # ties need that law
        before, c = unilateral.tie[k, [ku.TIE_STIFFNESS, ku.TIE_DAMPING]]
        after = values.get("stiffness", float(before))
        if min(values.values(), default=0.0) < 0.0 or not after + values.get("damping", float(c)) > 0.0:
            raise ModelError(f"tie {name}: needs a stiffness or a damping, neither negative")
        self._settle_now()
        prepared, tie = self._prepared, self.robot.ties[k]
        assert prepared.system.unilateral is not None
        table, row = prepared.system.unilateral.tie_table[k], prepared.system.unilateral.tie[k]
        y, layout = prepared.run.y, prepared.run.layout
        q, stored = y[block(layout, "q")], float(row[ku.TIE_STORED])
        if table[ku.TIE_HOLDS] == 1 and after != before:
            # A one-sided tie without contact has no force that could be kept.
            if after > before and (stored > 0.0 or not tie.pushes):
                x = deflection(prepared.model, prepared.system.unilateral, k, q)
                row[ku.TIE_REST] += x * (1.0 - before / after)
            row[ku.TIE_STORED] = stored * (before / after if after > before else after / before)
        row[ku.TIE_STIFFNESS], row[ku.TIE_DAMPING] = after, values.get("damping", float(c))
        if holds is not None and holds != (table[ku.TIE_KIND] >= 0):
            table[ku.TIE_KIND] = (kc.ONE_WAY if tie.pushes else kc.BOX) if holds else -1
            if holds and table[ku.TIE_HOLDS] == 1:  # it has ended and begins anew, without a step between
                row[[ku.TIE_STORED, ku.TIE_GIVEN, ku.TIE_FORCE, ku.TIE_TURNED]] = 0.0
            row[ku.TIE_REST] = tie.rest
            if holds and math.isnan(tie.rest):
                # Not by the first step, whose geometry is that of its middle.
                rest_here(prepared.model, prepared.system.unilateral, k, q)
        lost = stored - row[ku.TIE_STORED]
        y[layout.elastic + kst.STORED] -= lost
        y[layout.elastic + kst.DAMPED] += lost
        self._restart()

    def release(self, joint: str) -> None:
        """Give a motor back to the controller and references of the scenario."""
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
        """From now on a force [N] and a torque [N m] act on a point of a body, instead of what was set before.

        Parameters
        ----------
        point : in the body's frame [m]
        in_body : components are in the axes of the body, else of the world
        """
        k = _index(self._pushes, body, "body")
        values = _finite("wrench", [*np.ravel(point), *np.ravel(force), *np.ravel(torque)])
        if len(values) != 9:
            raise ModelError("point, force and torque have three components each")
        self._settle_now()
        loads = self._prepared.system.loads
        offset = loads.table[k, kl.DATA]
        loads.table[k, kl.IN_BODY] = int(in_body)
        loads.data[offset + kl.POINT : offset + kl.POINT + 9] = values
        if values[3:].any():
            self._pushed.add(k)
        self._restart()

    def linearize(
        self, inputs: Sequence[str] = ("command",), outputs: Sequence[str] = ("hand_position",)
    ) -> Linearization:
        """Linear equations of the whole system about the present state: δẋ = A δx + B δu, δy = C δx + D δu.

        x is q, v and the currents of motors with a circuit; contacts, stops and couplings are held as they are now, and
        the controller is part of the system. A sampled one counts as continuous: its period, and the delay, resolution
        and rates of encoders, are left out. Commands that the caller holds, and the references of an operator or of a
        snake's controller, stay as they are. The simulation stays as it is.

        >>> A, B, C, D = simulation.linearize(inputs=["reference"], outputs=["hand_position", "contact_normal_force"])

        Parameters
        ----------
        inputs : ``command`` of motors, beyond what the controller asks for [V; N m of an open torque], ``reference``
            [rad or m], ``reference_rate``, ``force`` [N] and ``torque`` [N m] on bodies, in the axes of the wrench
            that is set; a family of them, or one: ``"command.joint_3"``, ``"force.link_10.z"``
        outputs : ``q``, ``v``, ``current``, ``vdot``, ``voltage``, ``motor_torque``, ``hand_position``,
            ``contact_normal_force``, ``contact_force``, ``contact_gap``, likewise

        Raises
        ------
        ScenarioError
            No such input or output, or ``integrator.method: time_stepping``, which knows no modes between its steps.
        """
        if conflict := LINEARIZATION.conflict(self.scenario.config):
            raise ScenarioError(f"Simulation.linearize {LINEARIZATION.message(conflict)}")
        before = self._kept()
        try:
            self._settle_now(calling=False)
            if self._prepared.run.count[ki.STARTED] == 0:
                # Modes of contacts are chosen where a step starts; none is taken.
                driver.advance(self._prepared.system, self._prepared.workspace, self._prepared.run, 0)
            return linearized(self._prepared, inputs, outputs)
        finally:
            self._go_back(before)

    def snapshot(self) -> Snapshot:
        """Return everything that :meth:`restore` needs to continue from here.

        A callback may take a snapshot too. It contains the changes that the callback has made before, but not its later
        ones, and :meth:`restore` does not call that callback again. Other callbacks that are due at this time and have
        not been called yet are called by the next :meth:`advance`. Variables of callbacks are not in the snapshot.

        Raises
        ------
        ScenarioError
            Within the tick of the scenario's own operator, of which half would be lost.
        """
        if any(self._calling is call for call in self._own_calls):
            raise ScenarioError(
                "an operator, or the source of its commands, cannot take a snapshot of the simulation that asks it: "
                "only callbacks of Simulation.every can, or the caller between two calls of advance"
            )
        return self._kept()

    def _kept(self) -> Snapshot:
        """Return the snapshot; one from the middle of an operator's tick is only good to go back to at once."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        attendants = [attendant.remembered() for attendant in self._attendants]
        trace, happened, pushed = self._trace.snapshot(), tuple(self._happened), frozenset(self._pushed)
        shown = (pushed, self._base_as_planned, self._prepared.behind_brakes)
        due, window = tuple(self._due), (self._samples_end, self._window)
        return Snapshot(self._token, arrays, self._time, trace, happened, *shown, self._frozen, attendants, due, window)

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot of this simulation: the same future, bit for bit.

        Raises
        ------
        ScenarioError
            Events or ticks were added since, or the snapshot is of another simulation; within a callback.
        """
        if self._calling is not None:
            raise ScenarioError(
                "a callback cannot restore the simulation that calls it; restore it after advance has returned"
            )
        if not isinstance(snapshot, Snapshot):
            raise ScenarioError(f"a simulation is restored from its snapshot, not from {brief(snapshot)}")
        own = self._arrays()
        sizes = ({k: a.shape for k, a in arrays.items() if k not in _BUFFERS} for arrays in (own, snapshot.arrays))
        if snapshot.owner is not self._token or next(sizes) != next(sizes):
            raise ScenarioError("the snapshot is of another simulation, or ticks or events were added since")
        self._go_back(snapshot)
        self._ended_by = None

    def _go_back(self, snapshot: Snapshot) -> None:
        """Take everything from a snapshot that fits."""
        self._swap(**{field: snapshot.arrays[name].copy() for name, field in (_BUFFERS | _TABLES).items()})
        for name, array in self._arrays().items():
            array[...] = snapshot.arrays[name]
        self._trace.restore(snapshot.trace)
        self._time, self._frozen, self._happened = snapshot.time, snapshot.frozen, list(snapshot.happened)
        self._pushed, self._base_as_planned = set(snapshot.pushed), snapshot.base_as_planned
        self._prepared = replace(self._prepared, behind_brakes=snapshot.behind_brakes)
        for attendant, kept in zip(self._attendants, snapshot.attendants, strict=True):
            attendant.restore(kept)
        self._due = list(snapshot.due)
        self._samples_end, self._window = snapshot.window

    def record(self, scenario: Scenario | None = None, *, pictured: bool = True) -> Record:
        """Record of the trace so far, with a summary of the run up to now; of a ring, of its samples alone.

        ``complete`` is True for a run that has come to its end.

        Parameters
        ----------
        scenario : that the record is said to be of, where it was found on the way; default: what is simulated
        pictured : with scene and poses of bodies
        """
        wall = self._wall
        if self._window is None and self.finished:
            record = self._record_now(scenario, pictured, wall)
        else:
            # Samples, tallies and events are to be of one time, and that may lie in the step that is kept back: end the
            # step here, begin the next one, and take that back.
            before = self._kept()
            try:
                if self._window is not None:
                    there, wall = self._window
                    self._go_back(there)
                else:
                    self._end_here()
                record = self._record_now(scenario, pictured, wall)
            finally:
                self._go_back(before)
        record.complete = self.finished
        if self._failed():
            mark_stopped(stopped(self._scenario, self._prepared), record)
        elif self._ended_by is not None:
            mark_stopped(self._ended_by, record)
        return record

    def _end_here(self) -> None:
        """End a step at the present time, and record the sample there; to be taken back."""
        self._settle_now(calling=False)
        if not self._loaded:
            return
        run = self._prepared.run
        if run.count[ki.SAMPLE] == len(run.sample_time):
            self._refill()
            run = self._prepared.run
        row, now = int(run.count[ki.SAMPLE]), float(run.clock[ki.TIME])
        # Time stepping has recorded it.
        late = run.stepping is None and abs(run.sample_time[row] - now) <= TICK_SLACK * max(1.0, abs(now))
        if late:
            # A step that ends a rounding before a sample leaves it to the next one. At a start, the sample at this time
            # is written again, whatever is there.
            run.count[ki.SAMPLE], run.count[ki.STARTED], run.sample[row] = row + 1, 0, np.nan
        self._kernel(self._prepared.system, self._prepared.workspace, run, 0)
        if late and np.isnan(run.sample[row]).any():
            # There is no start from here.
            run.count[ki.SAMPLE] = row

    def _keep_window(self, until: float) -> None:
        """Keep what there is at the end of the samples, before the pending step passes it on the way to a time."""
        run, end = self._prepared.run, self._samples_end
        passes = run.count[ki.PENDING] == 1 and run.clock[ki.TIME] + run.clock[ki.STEP] > end
        if self._window is not None or not (passes and until > end):
            return
        before = self._kept()
        try:
            self._time = end
            self._end_here()
            window = self._kept(), self._wall
        finally:
            self._go_back(before)
        self._window = window

    def _hold(self, until: float) -> float:
        """Time beyond which a step on the way to another time is kept back: buffer or samples end there [s]."""
        last, end = float(self._prepared.run.sample_time[-1]), self._samples_end
        return min(last, end) if self._window is None and until > end else last

    def _record_now(self, scenario: Scenario | None, pictured: bool, wall: float) -> Record:
        """Record of the arrays as they are, whose run has taken so much wall time [s]."""
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
            happened=self._happened,
            base_as_planned=self._base_as_planned,
            pictured=pictured,
            begun=self._begun,
        )
        record.summary["warnings"] += self._said
        for attendant in self._attendants:
            attendant.add_to(record)
        return record

    def _motor(self, joint: str) -> int:
        return _index(self._motors, joint, "motor")

    def _take(self, state: State) -> None:
        """Start at a given state."""
        run, model = self._prepared.run, self._prepared.model
        at_start = run.y[block(run.layout, "q")].copy()
        for name in ("q", "v", "current"):
            part = block(run.layout, name)
            values = _finite(name, np.ravel(getattr(state, name)))
            circuits = self._prepared.system.drives.table[:, ka.CIRCUIT] >= 0
            if name == "current" and len(values) == len(circuits):
                # Records have a current for each motor; those without a circuit follow from the rest.
                values = values[circuits]
            if values.shape != run.y[part].shape:
                raise ModelError(
                    f"the state has {len(values)} values of {name}, {model.robot.name} has {part.stop - part.start}"
                )
            run.y[part] = values
        q = run.y[block(run.layout, "q")]
        check_couplings(model.robot, q)
        beyond = START_TOLERANCE
        if run.method == ki.TIME_STEPPING:
            # What has landed is below its surface, or beyond its stop, by up to a step of its speed.
            beyond = max(beyond, float(run.clock[ki.STEP]) * FASTEST_LANDING)
        if self._prepared.system.unilateral is not None:
            joint_stops(model.robot, q, beyond)
        check_start(self._scenario, model, self._prepared.contacts, q, beyond)
        if (unilateral := self._prepared.system.unilateral) is not None and model.robot.ties:
            self._take_ties(unilateral, at_start, state.tie_rest)

    def _take_ties(self, unilateral: UnilateralArrays, at_start: Array, rests: Array | None) -> None:
        """Let ties go on from where they have slid to; at_start: coordinates of the scenario's start, (nq,)."""
        model, ties = self._prepared.model, self._prepared.model.robot.ties
        if rests is not None and np.shape(rests) != (len(ties),):
            raise ModelError(f"the state has {np.size(rests)} values of tie_rest, {model.robot.name} has {len(ties)}")
        set_rests(model, unilateral, at_start, rests)
        slid = [tie.name for tie in ties if may_have_slid(tie)]
        if rests is None and slid:
            self._said.append(
                f"{first_few(slid)}: the state does not say how far ties have slid beyond their bounds (tie_rest); "
                "they start as if they never had; go on from Simulation.state, or from a snapshot"
            )
            log.warning("%s: %s", self._scenario.title, self._said[-1])

    def _reach(self, asked: float) -> None:
        """Integrate until the step that would pass a time is pending, or ends there."""
        until = asked = min(asked, self._end)
        while not self.finished and self._time < until:
            self._keep_window(until)
            run = self._prepared.run
            # A tick that differs from the time asked for by roundings is not left for later.
            slack = TICK_SLACK * max(1.0, abs(asked))
            near = run.tick[:, ki.TICK_NEXT] if len(self._calls) else np.zeros(0)
            near = near[np.abs(near - asked) <= slack]
            until = min(max(until, float(near.max(initial=until))), self._end)
            beyond = until + slack if len(near) else until
            if run.count[ki.PENDING] == 1 and run.clock[ki.TIME] + run.clock[ki.STEP] > beyond:
                break
            self._piece(until)
            run = self._prepared.run
            if run.count[ki.STARTED] == 1 and run.clock[ki.TIME] >= until:
                break
        while not self.finished and self._prepared.run.clock[ki.TIME] >= self._end:
            # A tick at the end came before the end itself.
            self._piece(self._end)
        self._time = until if not self.finished else float(self._prepared.run.clock[ki.TIME])

    def _piece(self, until: float) -> None:
        """One compiled piece, and what it wants its caller to look at."""
        run = self._prepared.run
        if run.count[ki.PENDING] == 1:
            self._refill(run.clock[ki.TIME] + run.clock[ki.STEP])
            run = self._prepared.run
        run.clock[ki.HOLD] = min(until, self._hold(until))
        begun = clock.perf_counter()
        raised = self._attended(_PIECE, interruption.check)
        self._wall += clock.perf_counter() - begun
        self._take_due(raised)
        self._call_due()
        if raised is not None:
            self._time = max(self._time, float(self._prepared.run.clock[ki.TIME]))
            raise raised

    def _attended(self, limit: int, look: Callable[[], None]) -> BaseException | None:
        """One compiled piece; what ``look`` has raised meanwhile, or a signal."""
        if not self._loaded:
            stopping.load(self._prepared)
            self._loaded = True
        self._prepared, raised = stopping.advance(self._prepared, limit, self._watch, look, self._kernel)
        return raised

    def _take_due(self, raised: BaseException | None) -> None:
        """Empty the log of the kernels, and note the callbacks that are due at the present end of the run.

        All before the first call, so that a snapshot in a callback has all events and due callbacks of this time.
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
            self._due.append(Simulation._say_stopped)
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

    def _say_stopped(self) -> None:
        raise_stopped(stopped(self._scenario, self._prepared), self.record())

    def _failed(self) -> bool:
        """True for a run that has ended, and not where it was to end."""
        return (
            bool(self._prepared.run.count[ki.STATUS] not in (ki.RUNNING, ki.FINISHED, ki.STOPPED)) or self._overturned()
        )

    def _overturned(self) -> bool:
        """True when the base has tipped and its scenario says that runs stop there."""
        base = self.robot.base
        if base is None or not base.stop_on_overturn or self._prepared.run.count[ki.STATUS] != ki.STOPPED:
            return False
        return any(event.kind == TIP_OVER for event in self._happened)

    def _settle_now(self, *, calling: bool = True) -> None:
        """End a step at the present time, when it lies within one.

        Parameters
        ----------
        calling : with callbacks at events that only the shorter steps find, at their times; False: it is undone
        """
        run, now = self._prepared.run, self._time
        if run.count[ki.PENDING] == 0 or self.finished:
            return
        run.count[[ki.PENDING, ki.SEARCHING, ki.FIRED]] = 0
        step = run.clock[ki.STEP] = max(run.clock[ki.PROPOSED], run.clock[ki.STEP])
        if now > run.clock[ki.TIME]:
            self._go_to(now, calling)
            # Where a piece was left alone there are copies.
            run = self._prepared.run
            if self.finished:
                self._time = float(run.clock[ki.TIME])
                return
            self._time = run.clock[ki.TIME] = now
            run.clock[ki.STEP] = max(run.clock[ki.STEP], step)

    def _go_to(self, until: float, calling: bool) -> None:
        """Integrate until a time as if the run ended there, or until it ends before."""
        reached = False
        while not (reached or self.finished):
            self._keep_window(until)
            run = self._prepared.run
            if run.count[ki.PENDING] == 1:
                self._refill(run.clock[ki.TIME] + run.clock[ki.STEP])
                run = self._prepared.run
            run.clock[ki.HOLD], run.clock[ki.END] = self._hold(until), until
            # What comes to its end here is half of something: signals that wait go on waiting.
            raised = self._attended(_PIECE, lambda: None)
            # Callbacks, and their snapshots, know nothing of this end.
            run = self._prepared.run
            run.clock[ki.END] = self._end
            reached = bool(run.count[ki.STATUS] == ki.FINISHED)
            if reached:
                run.count[ki.STATUS] = ki.RUNNING
            self._take_due(raised)
            if calling:
                self._call_due()
            elif self._failed() and raised is None:
                self._say_stopped()
            if raised is not None:
                self._time = float(run.clock[ki.TIME])
                raise raised

    def _restart(self) -> None:
        """Derivatives have jumped: the next step starts anew from the present state, with the step size that it had."""
        self._prepared.run.count[ki.STARTED] = 0

    def _freeze(self) -> None:
        """Let moving references hold where they end."""
        # First: a snapshot in a callback on the way is of before.
        self._settle_now()
        self._frozen = True
        for joint, a in self._motors.items():
            if self._prepared.system.reference.spline[a] >= 0:
                self._hold_at_end(joint)

    def _hold_at_end(self, joint: str) -> None:
        """Let the reference of a joint hold where its spline ends."""
        reference = self._prepared.system.reference
        powers = reference.grid[1] ** np.arange(6)
        end = float(reference.coefficients[-1, self._splines[self._motors[joint]]] @ powers)
        self._follow_lines(np.array([self._motors[joint]]), np.array([[end, 0.0]]))

    def _refill(self, until: float = -np.inf) -> None:
        """Move what was sampled to the trace, and give the buffer the times from there on, at least up to ``until``."""
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
        """Take other arrays for some of those of the run."""
        self._prepared = replace(self._prepared, run=self._prepared.run._replace(**arrays))

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays of the run and its tables, by name: everything that changes is in them."""
        prepared = self._prepared
        parts = {"run": prepared.run, "workspace": prepared.workspace, "system": prepared.system}
        return {name: array for owner, part in parts.items() for name, array in _arrays_in(part, owner)}


def _arrays_in(value: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """The arrays in named tuples and those within, with dotted names."""
    if isinstance(value, np.ndarray):
        yield name, value
    elif hasattr(value, "_asdict"):
        for field, part in value._asdict().items():
            yield from _arrays_in(part, f"{name}.{field}")


def _index(choices: dict[str, int], name: str, family: str) -> int:
    if name not in choices:
        raise ModelError(f"no {family} {brief(name)}; those are: {', '.join(choices) or 'none'}")
    return choices[name]


def _finite(quantity: str, values: ArrayLike) -> Array:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"{quantity} {brief(values)} must be numbers") from None
    if not np.isfinite(array).all():
        raise ModelError(f"{quantity} {array.tolist()} must be finite")
    return array


# Start of a dynamics run: initial posture, gaps and tip margin, and the checks before the first step.


# A joint that the solution of the posture moves by less than this counts as unmoved [rad or m].
MOVED = 1e-12


def check(scenario: Scenario, started: Callable[[Start], None]) -> Start:
    """See :func:`dynsim.engine.check`."""
    start = start_of(scenario)
    started(start)
    prepared = prepare(scenario)
    control, model = prepared.control, prepared.model
    if prepared.balance is not None:
        # Compliant contacts are pressed in, which moves joints.
        points, gaps = _touching(model, prepared.contacts)
        hand = model.point_position(*model.robot.hand, model.robot.initial)
        said = [*start.warnings, *prepared.balance.warnings]
        start = replace(start, hand=hand, contacts=points, gaps=gaps, warnings=said)
    if (unstable := unstable_loop(scenario, prepared)) is not None:
        start = replace(start, warnings=[*start.warnings, unstable[0]])
    if control.path is not None and control.teleop is None:
        begin = control.path.position(np.zeros(1))[0]
        start = replace(start, off_path=float(np.linalg.norm(begin - start.hand)))
    _begin(scenario, prepared)
    return start


def commanded_by_python(scenario: Scenario, control: JointControl) -> bool:
    """Return whether Python code gives commands at ticks: an operator, the controller of a snake, or encoders."""
    sensors = scenario.config.sensors
    encoded = sensors is not None and sensors.encoders is not None
    return encoded or control.teleop is not None or control.task_space is not None


def _begin(scenario: Scenario, prepared: Prepared) -> None:
    """Choose contact modes and find forces at t = 0, as a run does before its first step.

    Not if Python code gives the first commands.

    Raises
    ------
    SimulationStopped
        If forces do not exist, or cannot last.
    """
    if not prepared.contacts or commanded_by_python(scenario, prepared.control):
        return
    stopping.load(prepared)
    work = partial(driver.advance, prepared.system, prepared.workspace, prepared.run, 0)
    _, raised = stopping.attend(work, lambda: None, interruption.check)
    if raised is not None:
        raise raised
    if prepared.run.count[ki.STATUS] not in (ki.RUNNING, ki.FINISHED):
        raise stopped(scenario, prepared)


def start_of(scenario: Scenario) -> Start:
    """Posture, gaps and margin at t = 0, whether they are allowed or not."""
    described, contacts, piloted = at_start(scenario)
    model = recall("model", lambda: Model(described), described)
    robot = model.robot
    q, (points, gaps) = robot.initial, _touching(model, contacts)
    declared = scenario.config.contacts.points
    movable = declared.keys() - {contact.name for contact in contacts if contact.left_out}
    if piloted is not None:  # a snake, whose joints `initial` does not place
        movable = set()
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
        *without_effect(scenario, bool(robot.motors)),
        *_below(scenario, robot),
        *build.left_out_warnings(scenario, contacts),
    ]
    return Start(hand, points, gaps, key, solved, *_margins(scenario, model, contacts), warnings)


def _touching(model: Model, contacts: Sequence[Contact]) -> tuple[dict[str, Array], dict[str, float]]:
    """Positions (3,) of contact points at the start, and their gaps [m]."""
    points, gaps, q = dict[str, Array](), dict[str, float](), model.robot.initial
    for contact in contacts:
        try:
            gaps[contact.name] = gap_at(model, contact, q)
        except ModelError:  # an unknown body, of which the check of contacts gives the line
            continue
        points[contact.name] = model.point_position(contact.body, contact.point, q)
    return points, gaps


def _below(scenario: Scenario, robot: Robot) -> list[str]:
    """A sentence for each surface that bodies begin below."""
    sunk = by_surface(sinking(robot, build.surfaces(scenario), robot.initial[None]))
    return [
        f"{', '.join(s.body for s in below)}: below {surface} at the start, by up to "
        f"{1e3 * max(s.depth for s in below):.3g} mm; surfaces hold only the points of contacts"
        for surface, below in sunk.items()
    ]


def _margins(scenario: Scenario, model: Model, contacts: Sequence[Contact]) -> tuple[float | None, float | None]:
    """Tip margin of a mobile base at rest, alone and with its braces; None where there is none."""
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


# Engine of the multibody plants: integrates the coupled system and makes the record of the run.


# More steps than any run takes.
_ALL = 1 << 62
# Ticks between two checks for Ctrl-C, at which the progress bar is updated.
TICKS = 10


def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """See :func:`dynsim.engine.simulate`."""
    if scenario.controller is not None and scenario.controller.type == "task_space":
        # Not prepared twice: that raises the head of a snake.
        return _stepped(scenario, progress, pictured)
    prepared = prepare(scenario, progress)
    if commanded_by_python(scenario, prepared.control):
        return _stepped(scenario, progress, pictured)
    size = prepared.model.n, len(prepared.contacts), len(prepared.stops)
    # Loading or compiling the kernels is no integration time.
    recall("kernels", partial(stopping.load, prepared), prepared.choice.method, *size)
    if (unstable := unstable_loop(scenario, prepared)) is not None:
        log.warning("%s: %s", scenario.title, unstable[0])
    watch, run = stopping.WallWatch(scenario.integrator.wall_limit_s), prepared.run

    def look() -> None:
        if progress is not None:
            progress(float(run.clock[ki.TIME]), SIMULATION)
        interruption.check()

    own = own_guards(prepared)
    happened: list[Event] = []
    stop: SimulationStopped | None = None
    started = clock.perf_counter()
    try:
        look()
        log.info("%s: integrating %g s by %s", scenario.title, scenario.duration_s, prepared.choice.method)
        while run.count[ki.STATUS] == ki.RUNNING:
            prepared, raised = stopping.advance(prepared, _ALL, watch, look)
            run = prepared.run
            happened += [Event(time, *(event_name(prepared, e) or own[e])) for time, e in take_log(run)]
            if raised is not None:
                raise raised
            look()
        interruption.keep()
    except KeyboardInterrupt:
        interruption.keep()
        interruption.answered()
        stop = interrupted(scenario, float(run.clock[ki.TIME]), last_state(prepared, run.y))
    wall = clock.perf_counter() - started
    log.info("%s: integrated %g s in %d steps, %.3f s", scenario.title, run.clock[ki.TIME], run.count[ki.STEPS], wall)
    record = make_record(scenario, prepared, wall, happened=happened, pictured=pictured)
    if stop is None and run.count[ki.STATUS] != ki.FINISHED:
        stop = stopped(scenario, prepared)
    if stop is not None:
        raise_stopped(stop, record)
    return record


def _stepped(scenario: Scenario, progress: Progress | None, pictured: bool) -> Record:
    """A run with ticks of an operator, a snake's script or encoders: by the public stepper, bit for bit its record."""
    from dynsim.engine.simulation import Simulation

    # Without an end, as a session: a step that ends at a tick and one at the end of a run need not be the same.
    simulation = Simulation(scenario, duration=math.inf)
    simulation.end_samples(scenario.duration_s)
    prepared, operator, k = simulation._prepared, simulation.operator, 0
    # It has times of its own; a record that is too large is refused before it begins.
    sample_times(scenario, prepared.run.layout, prepared.run.columns, len(prepared.model.robot.links))
    rate = operator.rate if operator is not None else 1.0 / (prepared.control.sample_time or 1.0)
    stop: SimulationStopped | None = None
    try:
        while simulation.time < scenario.duration_s:
            k += TICKS
            # A signal within a callback would leave references half written.
            interruption.keep()
            simulation.advance(min(k / rate, scenario.duration_s))
            if progress is not None:
                progress(simulation.time, SIMULATION)
            interruption.heed()
            interruption.check()
    except SimulationStopped as ended:
        stop = ended
    except KeyboardInterrupt:
        interruption.answered()
        stop = interrupted(scenario, simulation.time, {})
    interruption.keep()
    record = simulation.record(scenario, pictured=pictured)
    if stop is not None:
        raise_stopped(stop, record)
    record.complete = True
    return record

"""A record and its scenario: bodies, contacts, drives and loads at the samples, computed without the kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from combinations.bodies import Bodies, Ends, Motion, position_rates, times
from combinations.running import Run
from combinations.sentences import SHARED
from combinations.surfaces import Shape, nearest, seen_from, shape, solid
from dynsim.model.description import WORLD, Contact, Load, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource
from dynsim.model.surfaces import Box, Capsule, HeightField
from dynsim.record import Record
from dynsim.scenario import build

Array = NDArray[np.float64]

OPEN, SLIDING, STICKING = 0, 1, 2
# Largest distance of a sample from the end of a step to count as that end, in steps.
AT_STEP = 1e-6
# Samples resolve a circuit if their spacing is below this part of L/R. If not, this time after an event is left out,
# three of the longest periods of published motors in stiff loops [s].
RESOLVED, SETTLING = 0.3, 0.03
# Slack for a current, or torque of a torque source, that the record does not show [A or N m].
UNKNOWN = 1e9
# Residual of the equation of motion relative to its terms: for event-driven methods the recorded accelerations and
# forces solve one linear system, whose condition costs up to six of sixteen digits.
BALANCE = 1e-8
# Relative residual if forces are shared among rows that count as dependent, although not to the last digit.
SHARED_BALANCE = 1e-7
# Relative residual of time stepping: its forces and contact positions follow from differences of rounded rates, h Δv̇.
STEPPED_BALANCE = 1e-7


@dataclass(frozen=True)
class Touch:
    """One contact at all samples.

    Attributes
    ----------
    contact : description of the contact; body : index of its body, or of two bodies that touch each other
    position : touching point, (T, 3) [m]; normal : (T, 3)
    gap, gap_before : (T,) [m]; the second at the midpoint of the sample's step; equal for event-driven methods
    slip, slip_before : (T, 3) tangential velocity [m/s]; the second with the rates at the start of the sample's step
        and the bodies at its midpoint, as in the law of time stepping; equal for event-driven methods
    slip_after : (T, 3) slip at the end of the sample's step: that of the sample, unless it lies within the step
    approach, approach_before : velocity along the normal, (T,) [m/s]; the second in the same state as ``slip_before``
    lag : possible difference of the slip in the law of time stepping and the slip at the end of the step, (T,) [m/s]:
        the law uses the rows of the midpoint, plus half of their rotation since the last midpoint, at the start's rates
    turned : angle of the normal to that of the previous sample, or of the midpoint of the step, (T,) [rad]
    force : (T, 3) [N]; normal_force : (T,) as recorded [N]; mode : (T,)
    """

    contact: Contact
    body: Ends
    position: Array
    normal: Array
    gap: Array
    gap_before: Array
    slip: Array
    slip_before: Array
    slip_after: Array
    approach: Array
    approach_before: Array
    turned: Array
    lag: Array
    force: Array
    normal_force: Array
    mode: Array

    @property
    def tangential(self) -> Array:
        """Component of the force along the surface, (T, 3) [N]."""
        return self.force - (self.force * self.normal).sum(axis=1, keepdims=True) * self.normal


class Observed:
    """Quantities that the checks use, for a run with a record of the dynamics."""

    def __init__(self, run: Run) -> None:
        assert run.record is not None
        assert run.resolved is not None
        self.run = run
        self.record: Record = run.record
        self.scenario = run.resolved
        self.config: dict[str, Any] = run.resolved.resolved
        self.robot: Robot = build.robot(run.resolved)
        self.bodies = Bodies(self.robot)
        self.time = self.record.time
        self.q, self.v, self.vdot = (self.record[name] for name in ("q", "v", "vdot"))
        self.real = self.config["contacts"]["law"] == "unilateral"
        self.stepped = run.resolved.integrator.method == "time_stepping"
        self.step = float(self.record.summary["time_stepping"]["step_s"]) if self.stepped else 0.0
        self.joints = list(self.robot.joint_names)

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def motion(self) -> Motion:
        """Motion of all bodies at the samples."""
        return self.bodies.motion(self.q, self.v, self.vdot)

    @cached_property
    def shapes(self) -> dict[str, Shape]:
        """Surfaces of the scenario, with their names as keys."""
        error = self.config.get("surface_error") or {}
        shift, fields = np.array(error.get("shift_m", [0.0, 0.0, 0.0])), build.surfaces(self.scenario)
        made = {}
        for name, config in self.config["surfaces"].items():
            if config.get("on") is not None:
                continue
            described, grid = fields[name], None
            if isinstance(described, HeightField):
                grid = described.origin - shift[:2], described.spacing, described.heights - shift[2]
            made[name] = shape(config, shift, grid)
        return made

    @cached_property
    def described_contacts(self) -> list[Contact]:
        """Contacts of the scenario that the record contains, in the record's order."""
        by_name = {contact.name: contact for contact in build.contacts(self.scenario, self.robot)}
        return [by_name[name] for name in self.record.labels["contact_gap"]]

    def touches(self, motion: Motion | None = None) -> list[Touch]:
        """Return the contacts at the samples, or for a given motion."""
        return (
            self._touches_of_samples
            if motion is None
            else [self._touch(k, contact, motion) for k, contact in enumerate(self.described_contacts)]
        )

    @cached_property
    def _touches_of_samples(self) -> list[Touch]:
        return [self._touch(k, contact, self.motion) for k, contact in enumerate(self.described_contacts)]

    @cached_property
    def touches_before(self) -> list[Touch]:
        """Contacts at the positions one step before each sample, with the rates of the sample."""
        q = self.q - self.step * position_rates(self.bodies, self.q, self.v)
        return self.touches(self.bodies.motion(q, self.v, np.zeros_like(self.v)))

    def nearest_point(self, contact: Contact, motion: Motion) -> tuple[Ends, Array, Array, Array]:
        """Return a contact's body, and at each instant the centre nearest to its surface [m], distance and normal."""
        if contact.solid is not None:
            # Slots of two links: the axis of one against the other.
            assert isinstance(contact.solid, Capsule)
            own = contact.solid
            contact = replace(contact, solid=None, point=own.start, tip=own.start + own.axis, radius=own.radius)
        body, point = self.robot.attach(contact.body, contact.point)
        start = motion.point(body, point)
        tip = None if contact.tip is None else motion.point(body, self.robot.attach(contact.body, contact.tip)[1])
        ends, surface = self.surface_of(contact, body, motion)
        centre = nearest(surface, start, tip)
        far, normal = surface.look(centre)
        return ends, centre, far, normal

    def surface_of(self, contact: Contact, body: int, motion: Motion) -> tuple[Ends, Shape]:
        """Return the bodies of a contact and its surface at each instant."""
        described = contact.surface
        if described.carrier is None:
            return body, self.shapes[contact.surface_name]
        assert isinstance(described, Box | Capsule)
        carrier, _ = self.robot.attach(described.carrier, np.zeros(3))
        return (body, carrier), seen_from(solid(described), motion.rotation[carrier], motion.origin[carrier])

    def _touch(self, k: int, contact: Contact, motion: Motion) -> Touch:
        body, centre, far, normal = self.nearest_point(contact, motion)
        position = centre - contact.radius * normal
        velocity = motion.velocity(body, position)
        approach = (velocity * normal).sum(axis=1)
        slip = velocity - approach[:, None] * normal
        gap = midway = far - contact.radius
        before, after, began = slip, slip, approach
        turned, lag = np.linalg.norm(np.diff(normal, axis=0, prepend=normal[:1]), axis=1), np.zeros(len(far))
        if self.stepped and motion is self.motion:
            start, end = self.v_start, self.v_end
            before, began, middle, midway = self._at_midpoints(contact, start)
            turned = np.maximum(turned, np.linalg.norm(normal - middle, axis=1))
            after = self._slip_of(contact, self._ends, end)[0]
            lag = np.linalg.norm(after - self._at_midpoints(contact, end)[0], axis=1)
            lag = lag + 0.5 * np.linalg.norm(before - self._slip_of(contact, self._middles_before, start)[0], axis=1)
        record = self.record
        force = record["contact_normal_force"][:, k]
        mode = record["contact_mode"][:, k] if "contact_mode" in record else np.full(len(force), SLIDING)
        return Touch(
            contact,
            body,
            position,
            np.asarray(normal, dtype=np.float64),
            gap,
            midway,
            slip,
            before,
            after,
            approach,
            began,
            np.asarray(turned, dtype=np.float64),
            lag,
            record["contact_force"][:, k],
            force,
            mode,
        )

    @cached_property
    def steps_around(self) -> tuple[Array, Array]:
        """Start and end of the step of each sample, (T,) [s]: the step that it ends, or lies within.

        Steps of one length follow each other from each beginning and end of a load, and from each tick; the last one
        before the next is cut there, and at the end of the run.
        """
        h, t = self.step, self.time
        knots = [t[:1], np.array([self.scenario.duration_s]), *(load.knots for load in self.loads)]
        for period in self.periods:
            knots.append(period * np.arange(np.ceil(t[0] / period - AT_STEP), t[-1] / period + 1.0))
        instants = np.unique(np.concatenate(knots))
        k = np.maximum(np.searchsorted(instants, t - AT_STEP * h) - 1, 0)
        whole = np.maximum(np.ceil((t - instants[k]) / h - AT_STEP) - 1.0, 0.0)
        start = instants[k] + whole * h
        following = np.append(instants, np.inf)[k + 1]
        return start, np.maximum(np.minimum(start + h, following), t)

    @cached_property
    def v_start(self) -> Array:
        """Rates at the start of the step of each sample, (T, n); between the ends of a step they are linear."""
        return np.asarray(self.v - (self.time - self.steps_around[0])[:, None] * self.vdot)

    @cached_property
    def v_end(self) -> Array:
        """Rates at the end of the step of each sample, (T, n)."""
        return np.asarray(self.v + (self.steps_around[1] - self.time)[:, None] * self.vdot)

    def _v_theta(self) -> Array:
        return np.asarray(self.v_start + self.scenario.integrator.theta * (self.v_end - self.v_start))

    @cached_property
    def q_middle(self) -> Array:
        """Coordinates at midpoints of the steps of samples: half a step after the start, at its rates."""
        start, end = self.steps_around
        # Go back to the start, then to the midpoint: rotations about different axes do not add like their rates.
        back = -(self.time - start)[:, None] * self._v_theta()
        began = self.q + position_rates(self.bodies, self.q, back)
        return np.asarray(began + position_rates(self.bodies, began, 0.5 * (end - start)[:, None] * self.v_start))

    @cached_property
    def _middles(self) -> Motion:
        """Motion of all bodies at the midpoints of steps, with the rates of the start."""
        return self.bodies.motion(self.q_middle, self.v_start, self.vdot)

    @cached_property
    def _ends(self) -> Motion:
        """Motion of all bodies at the ends of steps."""
        ahead = (self.steps_around[1] - self.time)[:, None] * self._v_theta()
        return self.bodies.motion(self.q + position_rates(self.bodies, self.q, ahead), self.v_end, self.vdot)

    @cached_property
    def _middles_before(self) -> Motion:
        """Motion as in :attr:`_middles`, one step earlier: from the previous sample, or from the rates of the start."""
        start, end = self.steps_around
        q = self.q_middle + position_rates(self.bodies, self.q_middle, -self.step * self.v_start)
        # The step of the first sample is also that of the next one.
        beside = np.flatnonzero(np.abs(end[:-1] - start[1:]) < AT_STEP * self.step) + 1
        q[beside] = self.q_middle[beside - 1]
        return self.bodies.motion(q, self.v_start, self.vdot)

    def _at_midpoints(self, contact: Contact, rates: Array) -> tuple[Array, Array, Array, Array]:
        """Return the values of :meth:`_slip_of` at midpoints of steps."""
        return self._slip_of(contact, self._middles, rates)

    def _slip_of(self, contact: Contact, motion: Motion, rates: Array) -> tuple[Array, Array, Array, Array]:
        """Return velocity at these rates along the surface and along its normal [m/s], normal, and gap [m]."""
        body, centre, far, normal = self.nearest_point(contact, motion)
        velocity = np.einsum("tkn,tn->tk", self.bodies.jacobian(motion, body, centre - contact.radius * normal), rates)
        along = (velocity * normal).sum(axis=1)
        return np.asarray(velocity - along[:, None] * normal), along, normal, far - contact.radius

    @cached_property
    def loads(self) -> list[Load]:
        """Loads on the robot: outside forces and torques."""
        return build.loads(self.scenario, self.robot)

    @cached_property
    def event_times(self) -> Array:
        """Times of events that may make velocities or accelerations jump [s]."""
        instants = [self.time[0] - 1e-12, *(event.time for event in self.record.events)]
        for load in self.loads:
            instants += list(load.knots)
        return np.array(sorted(instants))

    @cached_property
    def settling(self) -> float:
        """Time after an event in which circuits may oscillate faster than samples resolve [s]."""
        spacing = float(np.diff(self.time).max(initial=0.0))
        lags = [motor.inductance / motor.resistance for motor in self.robot.motors if isinstance(motor, Motor)]
        return SETTLING if lags and spacing > RESOLVED * min(lags) else 0.0

    def quiet(self, count: int = 1) -> NDArray[np.bool_]:
        """Return whether no event or settling falls between each sample and the count-th after it, (T − count,)."""
        before = np.searchsorted(self.event_times, self.time[:-count] - self.settling, side="left")
        after = np.searchsorted(self.event_times, self.time[count:], side="right")
        return np.asarray(before == after)

    def apart_from_events(self, span: float) -> NDArray[np.bool_]:
        """Return whether each sample is further than ``span`` [s] from all events, (T,)."""
        return np.array([(np.abs(self.event_times - t) > span).all() for t in self.time], dtype=bool)

    # Sampled loops hold their commands from one tick to the next.
    @property
    def sample_time(self) -> float | None:
        """Period of the controller [s]; None if it is continuous."""
        return (self.config.get("controller") or {}).get("sample_time_s")

    @property
    def reads_sensors(self) -> bool:
        """Whether the controller reads sensors instead of the exact state."""
        return not {"encoders", "motion_capture"}.isdisjoint(self.config.get("sensors") or {})

    @property
    def periods(self) -> list[float]:
        """Periods of ticks, at which commands of a controller or an operator are taken [s]."""
        controller = self.config.get("controller") or {}
        operator = controller.get("operator")
        periods = [self.sample_time, controller.get("period_s"), 1.0 / operator["rate_hz"] if operator else None]
        return [period for period in periods if period is not None]

    @cached_property
    def at_ticks(self) -> NDArray[np.bool_]:
        """Whether each sample is at a tick, when the controller has just given new commands, (T,)."""
        at = np.zeros(len(self), dtype=bool)
        for period in self.periods:
            at |= np.abs(self.time / period - np.round(self.time / period)) < AT_STEP
        return at

    @cached_property
    def constants(self) -> Array:
        """Torque per ampere of each drive; 1 for torque sources, whose current is their torque."""
        return np.array(
            [1.0 if isinstance(motor, TorqueSource) else motor.joint_constant for motor in self.robot.motors]
        )

    def driven_torques(self, current: Array, v: Array) -> Array:
        """Return drive torques at currents (T, na) and rates (T, n), without dry friction of joints at rest, (T, n)."""
        torque = np.zeros_like(v)
        for a, motor in enumerate(self.robot.motors):
            j = self.joints.index(motor.joint)
            torque[:, j] += self.constants[a] * current[:, a]
            if isinstance(motor, Servo) and motor.coulomb_friction > 0.0 and self.smoothed(motor):
                speed = 1e-2 if motor.coulomb_speed is None else motor.coulomb_speed
                torque[:, j] -= motor.coulomb_friction * v[:, j] / np.hypot(v[:, j], speed)
        return torque

    def smoothed(self, motor: Servo) -> bool:
        """Whether the dry friction of a servo is a smooth function of its rate."""
        return motor.coulomb_speed is not None or not self.real

    def has_circuits(self) -> bool:
        """Whether currents are states."""
        return any(isinstance(motor, Motor) for motor in self.robot.motors)

    def joint_signal(self, name: str) -> Array:
        """Return a signal of some joints as columns of all joints, with zeros for the rest, (T, n)."""
        spread = np.zeros_like(self.v)
        if name in self.record:
            for k, joint in enumerate(self.record.labels[name]):
                spread[:, self.joints.index(joint)] += self.record[name][:, k]
        return spread

    def tie_wrenches(
        self, motion: Motion, rows: NDArray[np.int64] | None = None
    ) -> list[tuple[int, int, Array, Array, Array]]:
        """Return first body, second body, point, and force and moment on the first body, for each tie and this motion.

        rows : samples of the motion; None for all
        """
        acting = []
        for k, tie in enumerate(self.robot.ties if "tie_force" in self.record else ()):
            a, _ = self.robot.attach(tie.body, tie.point)
            # The world is body −1.
            fixed = tie.other == WORLD
            b, other = (-1, tie.other_point) if fixed else self.robot.attach(tie.other, tie.other_point)
            axis = self.robot.attached_axes(tie.body) @ np.asarray(tie.axis) / np.linalg.norm(tie.axis)
            axes = np.broadcast_to(axis, (len(motion.rotation[a]), 3))
            if tie.turns:
                axes = self._turning_axes(motion, a, b, axis)
            along = times(motion.rotation[a], axes)
            recorded = self.record["tie_force"][:, k : k + 1]
            push = along * (recorded if rows is None else recorded[rows])
            still = np.zeros_like(push)
            force, moment = (still, push) if tie.turns else (push, still)
            acting.append(
                (a, b, np.broadcast_to(other, push.shape) if fixed else motion.point(b, other), force, moment)
            )
        return acting

    def _turning_axes(self, motion: Motion, a: int, b: int, axis: Array) -> Array:
        """Return by differences how turns of b against a change the part along an axis of a of its rotation vector."""
        still = np.eye(3) if b < 0 else self.motion.rotation[b][0]
        start, second = self.motion.rotation[a][0].T @ still, np.eye(3) if b < 0 else motion.rotation[b]
        turned = Rotation.from_matrix(np.swapaxes(motion.rotation[a], 1, 2) @ second @ start.T)
        little = 1e-5 * np.eye(3)
        parts = [
            ((Rotation.from_rotvec(d) * turned).as_rotvec() - (Rotation.from_rotvec(-d) * turned).as_rotvec()) @ axis
            for d in little
        ]
        return np.stack(parts, axis=1) / 2e-5


@dataclass(frozen=True)
class Balance:
    """Generalised forces at samples: residual and size of the equation of motion.

    Attributes
    ----------
    rows : indices of the samples; left : (len(rows), n) [N m or N]; scale : (len(rows), n), the sum of the sizes
    slack : (len(rows), n), possible error of the terms that the record does not show exactly
    share : part of the scale that rounding may leave
    """

    rows: NDArray[np.int64]
    left: Array
    scale: Array
    slack: Array
    share: float

    @property
    def excess(self) -> Array:
        """The residual relative to the allowed residual, (len(rows), n)."""
        allowed = self.share * self.scale.max(axis=1, keepdims=True) + 2.0 * self.slack + 1e-10
        return np.asarray(np.abs(self.left) / allowed)


def balance(seen: Observed) -> Balance:
    """Return M v̇ + h + D v − τ − Jᵀ f − loads for all samples at which the record shows every term.

    For event-driven methods the terms belong to the sample's state. Time stepping records means of its last step, at
    the midpoint: the state at the step's start follows from the accelerations, which are means too; contacts act at the
    end of the step.
    """
    if seen.stepped:
        return _stepped_balance(seen)
    rows = np.arange(len(seen))
    motion = seen.motion
    terms = [seen.bodies.along_rows(motion, seen.bodies.wrenches(motion)), seen.bodies.armature * seen.vdot]
    terms += [seen.bodies.damping * seen.v, -seen.driven_torques(seen.record["current"], seen.v)]
    terms += [-seen.joint_signal("joint_friction"), -seen.joint_signal("stop_force")]
    terms += [*_contact_terms(seen, motion, rows), *_load_terms(seen, motion, seen.time)]
    terms += _tie_terms(seen, motion, rows)
    return _balanced(seen, rows, terms, np.zeros_like(seen.v))


def _stepped_balance(seen: Observed) -> Balance:
    h, theta = seen.step, seen.scenario.integrator.theta
    rows = whole_steps(seen)
    if not len(rows):
        empty = np.zeros((0, seen.bodies.n))
        return Balance(rows, empty, empty, empty, STEPPED_BALANCE)
    a, v_end, q_end = seen.vdot[rows], seen.v[rows], seen.q[rows]
    v_start = v_end - h * a
    v_theta = v_start + theta * h * a
    q_middle = seen.q_middle[rows]
    middle = seen.bodies.motion(q_middle, v_theta, a)
    end = seen.bodies.motion(q_end, v_end, a)
    current, slack = _theta_currents(seen, rows, v_theta, theta)
    terms = [seen.bodies.along_rows(middle, seen.bodies.wrenches(middle)), seen.bodies.armature * a]
    terms += [seen.bodies.damping * v_theta, -seen.driven_torques(current, v_theta)]
    terms += [-seen.joint_signal(name)[rows] for name in ("joint_friction", "stop_force")]
    terms += _contact_terms(seen, end, rows)
    terms += _load_terms(seen, middle, seen.time[rows] - h + theta * h)
    terms += _tie_terms(seen, middle, rows)
    # Contacts act at the middle of the step, but the record shows them at its end, rotated with the normal.
    there, here = seen.touches(middle), seen.touches(end)
    for touch, later in zip(there, here, strict=True):
        turned = _turned(touch.force[rows], later.normal, touch.normal)
        for force in (touch.force[rows], turned):
            slack = slack + np.abs(
                _contact_term(seen, middle, touch, force) - _contact_term(seen, end, later, later.force[rows])
            )
        # Tangents may rotate about the normal by the same angle as the normal.
        angle = np.linalg.norm(later.normal - touch.normal, axis=1, keepdims=True)
        slack = slack + np.abs(_contact_term(seen, middle, touch, angle * np.cross(touch.normal, turned)))
    # Velocity products use the rates extrapolated with the last acceleration, after an impact that of the last step
    # without one, or the rates of the start if contacts have changed. A landing that is too slow is not an impact.
    best = _balanced(seen, rows, [_inertial(seen, q_middle, v_start, a), *terms[1:]], slack)
    smooth = _without_impact(seen)
    for last in (rows - 1, rows - 2, rows - 3, smooth[rows - 1]):
        earlier = np.where((last > 0)[:, None], seen.vdot[last], 0.0)
        led = _balanced(seen, rows, [_inertial(seen, q_middle, v_start + theta * h * earlier, a), *terms[1:]], slack)
        better = (led.excess.max(axis=1) < best.excess.max(axis=1))[:, None]
        best = replace(best, left=np.where(better, led.left, best.left), scale=np.where(better, led.scale, best.scale))
    return best


def _without_impact(seen: Observed) -> NDArray[np.int64]:
    """Return for each sample the last one until then whose step had no impact, (T,); 0 if no such sample exists."""
    index = np.arange(len(seen))
    for event in seen.record.events:
        if event.kind in ("landing", "stop_hit"):
            k = int(np.searchsorted(seen.time, event.time - AT_STEP * seen.step))
            if k < len(seen):
                index[k] = 0
    return np.maximum.accumulate(index)


def _inertial(seen: Observed, q: Array, v: Array, a: Array) -> Array:
    motion = seen.bodies.motion(q, v, a)
    return seen.bodies.along_rows(motion, seen.bodies.wrenches(motion))


def whole_steps(seen: Observed) -> NDArray[np.int64]:
    """Return the samples at the end of a time step that also has a sample at its start."""
    h, a = seen.step, seen.vdot[1:]
    change = np.diff(seen.v, axis=0)
    # Steps end at the beginning and end of a load; later samples may lie between the ends of steps, but this does not
    # show for bodies at rest.
    beside = np.abs(np.diff(seen.time) - h) < AT_STEP * h
    knots = np.sort(np.concatenate([seen.time[:1], *(load.knots for load in seen.loads)]))
    since = (seen.time[1:] - knots[np.searchsorted(knots, seen.time[1:] - AT_STEP * h) - 1]) / h
    beside &= np.abs(since - np.round(since)) < AT_STEP
    moved = np.abs(change - h * a).max(axis=1) <= AT_STEP * (np.abs(change) + h * np.abs(a)).max(axis=1) + 1e-13
    return np.flatnonzero(beside & moved) + 1


def _theta_currents(seen: Observed, rows: NDArray[np.int64], v_theta: Array, theta: float) -> tuple[Array, Array]:
    """Return the currents of the steps that end at samples, and the resulting uncertainty of torques, (·, n)."""
    current = seen.record["current"]
    now, before = current[rows], current[rows - 1]
    used = now - (1.0 - theta) * (now - before)
    slack = np.zeros_like(v_theta)
    for a, motor in enumerate(seen.robot.motors):
        if isinstance(motor, Motor):
            continue
        j = seen.joints.index(motor.joint)
        # If a limit begins or ends within a step, the law is not linear. References bend between the ends of a step,
        # and signals that follow them bend too.
        off = np.abs(now[:, a] - before[:, a]) + _bends(current[:, a], rows)
        if isinstance(motor, Servo):
            q, v = seen.q[:, seen.bodies.places[j]], seen.v[:, j]
            off = off + (motor.k_p * _bends(q, rows) + (motor.k_d + motor.k_v) * _bends(v, rows)) / motor.resistance
        # A sample at a tick already shows the new command.
        off = np.where(seen.at_ticks[rows], UNKNOWN, off)
        slack[:, j] += seen.constants[a] * off
    return used, slack


def _bends(signal: Array, rows: NDArray[np.int64]) -> Array:
    """Return second differences of a signal around the steps that end at rows."""
    bend = np.abs(np.diff(signal, n=2, prepend=signal[:1], append=signal[-1:]))
    return np.maximum(bend[rows], bend[rows - 1])


def _contact_terms(seen: Observed, motion: Motion, rows: NDArray[np.int64]) -> list[Array]:
    touches = seen.touches(None if motion is seen.motion else motion)
    return [_contact_term(seen, motion, touch, touch.force[rows]) for touch in touches]


def _contact_term(seen: Observed, motion: Motion, touch: Touch, force: Array) -> Array:
    return -seen.bodies.force_along_rows(motion, touch.body, touch.position, force, np.zeros_like(force))


def _turned(force: Array, normal: Array, other: Array) -> Array:
    """Return forces rotated by the shortest rotation from one normal to another, (T, 3)."""
    axis = np.cross(normal, other)
    cosine = (normal * other).sum(axis=1, keepdims=True)
    along = (axis * force).sum(axis=1, keepdims=True)
    return np.asarray(cosine * force + np.cross(axis, force) + axis * along / np.maximum(1.0 + cosine, 1e-6))


def _load_terms(seen: Observed, motion: Motion, time: Array) -> list[Array]:
    terms = []
    for load in seen.loads:
        body, point = seen.robot.attach(load.body, load.point)
        wrench = load.components(time)
        parts = [wrench[:, :3], wrench[:, 3:]]
        if load.in_body:
            parts = [times(motion.rotation[body], part) for part in parts]
        terms.append(-seen.bodies.force_along_rows(motion, body, motion.point(body, point), parts[0], parts[1]))
    return terms


def _tie_terms(seen: Observed, motion: Motion, rows: NDArray[np.int64]) -> list[Array]:
    terms = []
    for a, b, position, force, moment in seen.tie_wrenches(motion, rows):
        on_first = seen.bodies.force_along_rows(motion, a, position, force, moment)
        if b >= 0:
            on_first = on_first + seen.bodies.force_along_rows(motion, b, position, -force, -moment)
        terms.append(-on_first)
    return terms


def _balanced(seen: Observed, rows: NDArray[np.int64], terms: list[Array], slack: Array) -> Balance:
    basis = seen.bodies.free_directions()
    left = sum(terms[1:], start=terms[0].copy())
    scale = np.sum([np.abs(term) for term in terms], axis=0)
    if seen.robot.couplings:
        left, scale, slack = left @ basis, scale @ np.abs(basis), slack @ np.abs(basis)
    by_events = SHARED_BALANCE if warned(seen, SHARED) else BALANCE
    return Balance(rows, left, scale, slack, STEPPED_BALANCE if seen.stepped else by_events)


def warned(seen: Observed, text: str) -> bool:
    """Whether a warning of the run contains this text."""
    return any(text in warning for warning in seen.run.warnings)

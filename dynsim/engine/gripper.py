"""Gripper during a run: its hardening and softening, the capture, slip and loss of objects, and the resulting stops.

A close command hardens the gripper. The captured object is held in its present position: the springs start without
force, and stiffness added by hardening starts undeflected.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.engine.operator import Referenced
from dynsim.engine.saved_state import Stateful
from dynsim.engine.stepped import State
from dynsim.errors import SimulationStopped
from dynsim.model.description import Array
from dynsim.model.gripper import DIRECTIONS, Gripper, grasp_frame, tie_name
from dynsim.record import Event, Record
from dynsim.record.measures import GRIPPER_STATES

# The kind of a gripper event is this word followed by one of the words below.
EVENT, EVENT_KINDS = "gripper", ("captures", "slips", "loses", "releases")
SOFT, HARDENING, HARDENED, SOFTENING = range(4)
# Minimum share of the spring stiffness while an object is held, because a tie requires some stiffness.
LEAST_SHARE = 0.01
# Slips smaller than this [m, rad] are not recorded.
SLIPPED = np.array([1e-3, 2e-2])
# A tie is at its bound if its force is below the bound by less than this fraction.
AT_BOUND = 1e-3
# A held object on a hinge or rails counts as at rest if it is slower than this speed [rad/s or m/s], and as stuck after
# it has been at rest for this time [s].
AT_REST, STUCK_FOR = 1e-3, 1.0


@dataclass
class GripperControl(Stateful):
    """A gripper and the objects that it can hold.

    Attributes
    ----------
    objects : tuple of str
        Objects that have a grasp frame.
    period : float
        Control period [s].
    mode : int
        SOFT, HARDENING, HARDENED or SOFTENING.
    share : float
        Present stiffness of the springs as a fraction of their hardened stiffness, 0 to 1.
    held : str or None
        Name of the object in the gripper.
    slipping : bool
        True once the slip of the present object is recorded.
    stuck_since : float or None
        Time since which this object has been stuck [s].
    trace : list of (int, float)
        Mode and share after each period.
    """

    SAVED = ("mode", "share", "held", "slipping", "stuck_since", "events", "trace")

    model: Model
    gripper: Gripper
    objects: tuple[str, ...]
    period: float
    mode: int = SOFT
    share: float = 0.0
    held: str | None = None
    slipping: bool = False
    stuck_since: float | None = None
    events: tuple[Event, ...] = ()
    trace: list[tuple[int, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._body = self.model.body_index(self.gripper.body)
        # Index of the rate of each object on a hinge or rails.
        joints = [link.joint for link in self.model.robot.links]
        self._rate = {name: joints.index(name) for name in self.objects if name in joints}

    @property
    def state_in_words(self) -> str:
        """State as text for the pilot's page."""
        return state_text(self.mode, self.held)

    def nearest(self, q: Array, gripper: Gripper | None = None) -> tuple[str, float, float]:
        """Return the nearest object at coordinates (nq,), see :func:`nearest_object`."""
        R, p = self.model.body_pose(self._body, q)
        return nearest_object(self.model, self.objects, q, (R, p + R @ self.gripper.tip), gripper)

    def step(self, time: float, closed: bool, state: State, simulation: Referenced) -> None:
        """Run one control period that starts in this state of the simulation.

        Raises
        ------
        SimulationStopped
            ``too_far``: the gripper closes and no object is within its capture range; ``lost``: an object has slipped
            out; ``too_stiff``: an object on a hinge or rails does not move.
        """
        if closed and self.mode in {SOFT, SOFTENING}:
            if self.held is None:
                self._capture(time, state.q, simulation)
            self.mode = HARDENING
        elif not closed and self.mode in {HARDENING, HARDENED}:
            self.mode = SOFTENING
        self._harden(time, simulation)
        if self.held is not None:
            self._look(self.held, time, state, simulation)
        self.trace.append((self.mode, self.share))

    def _capture(self, time: float, q: Array, simulation: Referenced) -> None:
        name, distance, angle = self.nearest(q, self.gripper)
        refuse_capture(self.gripper, time, name, distance, angle)
        self.held, self.slipping, self.stuck_since = name, False, None
        self._add_event(time, "captures", name, distance)
        for direction in DIRECTIONS:
            simulation.set_tie(tie_name(name, direction), holds=True)

    def _harden(self, time: float, simulation: Referenced) -> None:
        """Increase or decrease the spring stiffness, and release the object when the stiffness reaches zero."""
        before = self.share
        if self.mode == HARDENING:
            self.share = min(self.share + self.period / self.gripper.hardening, 1.0)
            self.mode = HARDENED if self.share >= 1.0 - 1e-9 else HARDENING
        elif self.mode == SOFTENING:
            self.share = max(self.share - self.period / self.gripper.softening, 0.0)
            self.mode = SOFT if self.share <= 1e-9 else SOFTENING
        if self.held is None or self.share == before:
            return
        name, share = self.held, max(self.share, LEAST_SHARE)
        for direction, law in self.gripper.laws.items():
            spring = {"stiffness": share * law.stiffness, "damping": share * law.damping}
            simulation.set_tie(tie_name(name, direction), holds=self.mode != SOFT, **spring)
        if self.mode == SOFT:
            self.held = None
            self._add_event(time, "releases", name)

    def _look(self, name: str, time: float, state: State, simulation: Referenced) -> None:
        """Check whether the held object slips, is lost or is stuck."""
        g = self.gripper
        if self.mode == SOFTENING:  # an object that slips out now is being released
            self.stuck_since = None
            return
        force, slip = simulation.tie_force, simulation.tie_slip
        loads = np.array([abs(force[tie_name(name, direction)]) for direction in DIRECTIONS])
        bounds = np.array([law.bound for law in g.laws.values()])
        bound = loads >= (1.0 - AT_BOUND) * bounds
        slips = np.array([slip[tie_name(name, direction)] for direction in DIRECTIONS])
        moved = float(np.linalg.norm(slips[:3])), float(np.linalg.norm(slips[3:]))
        if not self.slipping and (np.array(moved) > SLIPPED).any():
            self.slipping = True
            self._add_event(time, "slips", name, moved[0])
        still = name in self._rate and abs(float(state.v[self._rate[name]])) < AT_REST
        if not (still and bound.any()):
            self.stuck_since = None
        elif self.stuck_since is None:
            self.stuck_since = time
        lost = moved[0] > g.lost_distance or moved[1] > g.lost_angle
        slipped = (
            f"{name} has slipped by {1e3 * moved[0]:.3g} mm and {moved[1]:.3g} rad in the gripper at t = {time:g} s"
        )
        if lost:
            self._add_event(time, "loses", name, moved[0])
        if self.stuck_since is not None and (lost or time - self.stuck_since >= STUCK_FOR):
            worst = DIRECTIONS[int((loads / bounds).argmax())]
            direction = f"along {worst}" if len(worst) == 1 else f"about {worst[1]}"
            raise SimulationStopped(
                f"too_stiff: {name} has not moved since t = {self.stuck_since:g} s and the gripper is at its bound "
                f"{direction}; {slipped} (plant.gripper)",
                time=time,
                kind="too_stiff",
            )
        if lost:
            raise SimulationStopped(
                f"lost: {slipped}; its limits are {g.along.bound:g} N and {g.about.bound:g} N m (plant.gripper)",
                time=time,
                kind="lost",
            )

    def _add_event(self, time: float, kind: str, name: str, value: float | None = None) -> None:
        self.events = (*self.events, gripper_event(time, kind, name, value))

    def add_to(self, record: Record) -> None:
        """Add signals, events and summary of the gripper to a record."""
        ticks = np.floor(record.time / self.period + 1e-6).astype(int)
        rows = np.array(self.trace or [(SOFT, 0.0)])
        state, share = rows[np.minimum(ticks, len(rows) - 1)].T
        record.add("gripper_share", share, "1", description="spring stiffness relative to the hardened gripper")
        distance = np.array([self.nearest(q)[1] for q in record["q"]])
        add_gripper(record, state.astype(np.int64), distance, self.events)
        record.summary = {**record.summary, "gripper": gripper_summary(record, self.objects)}


def gripper_event(time: float, kind: str, name: str, value: float | None = None) -> Event:
    """Create a gripper event of one of the :data:`EVENT_KINDS` for an object."""
    return Event(time, f"{EVENT} {kind}", name, value)


def state_text(state: int, name: str | None) -> str:
    """Return the state of a gripper and its object as text."""
    return GRIPPER_STATES[state] + (f" around {name}" if name is not None else "")


def add_gripper(record: Record, state: NDArray[np.int64], distance: Array, events: Iterable[Event]) -> None:
    """Add the signals of both plant levels, states and distances [m], (T,), and the events within the samples."""
    text = ", ".join(f"{number} {name}" for number, name in enumerate(GRIPPER_STATES))
    record.add("gripper_state", state, "1", description=text)
    text = "from the tip of the gripper to the nearest grasp frame"
    record.add("grasp_distance", distance, "m", description=text)
    for event in events:
        if record.time[0] <= event.time <= record.time[-1]:
            record.add_event(event.time, event.kind, event.name, value=event.value)


def gripper_summary(record: Record, objects: Iterable[str]) -> dict[str, Any]:
    """Summarise the actions of the gripper and the displacement of objects for ``summary.json``.

    The key ``moved`` is the change of the coordinate of an object on a hinge or rails [rad or m], or the displacement
    of a free object [m].
    """
    labels, q = list(record.labels["q"]), record["q"]
    moved: dict[str, float | list[float]] = {}
    for name in objects:
        own = [name] if name in labels else [f"{name}.{axis}" for axis in "xyz"]
        change = [float(q[-1, labels.index(label)] - q[0, labels.index(label)]) for label in own]
        moved[name] = change[0] if len(change) == 1 else change
    by_kind = {kind: [e.name for e in record.events if e.kind == f"{EVENT} {kind}"] for kind in EVENT_KINDS}
    summary: dict[str, Any] = {"moved": moved, **by_kind}
    if "tie_force" in record:
        ties = list(record.labels["tie_force"])
        for key, axes in (("force_max_N", DIRECTIONS[:3]), ("torque_max_N_m", DIRECTIONS[3:])):
            columns = [k for k, tie in enumerate(ties) if tie.startswith("gripper.") and tie.rpartition(".")[2] in axes]
            summary[key] = float(np.abs(record["tie_force"][:, columns]).max(initial=0.0))
    return summary


def nearest_object(
    model: Model, objects: Iterable[str], q: Array, tip: tuple[Array, Array], gripper: Gripper | None = None
) -> tuple[str, float, float]:
    """Return the object with the nearest grasp frame, its distance [m], and its angle to the gripper axis [rad].

    Parameters
    ----------
    model : Model
        Model of robot and objects.
    objects : iterable of str
        Objects to consider.
    q : (nq,) ndarray
        Positions [rad or m].
    tip : ((3, 3) ndarray, (3,) ndarray)
        Rotation and position [m] of the gripper tip.
    gripper : Gripper, optional
        If set, objects within its capture range take precedence.
    """
    seen = []
    for name in objects:
        body, at = model.robot.attach(grasp_frame(name), np.zeros(3))
        B, origin = model.body_pose(body, q)
        distance = float(np.linalg.norm(origin + B @ at - tip[1]))
        axis = B @ model.robot.attached_axes(grasp_frame(name))[:, 0]
        angle = float(np.arccos(np.clip(axis @ tip[0][:, 0], -1.0, 1.0)))
        seen.append((gripper is not None and not captures(gripper, distance, angle), distance, angle, name))
    _, distance, angle, name = min(seen)
    return name, distance, angle


def captures(gripper: Gripper, distance: float, angle: float) -> bool:
    """Return whether a grasp frame at a distance [m] and angle [rad] is within capture range."""
    return distance <= gripper.capture_distance and angle <= gripper.capture_angle


def refuse_capture(gripper: Gripper, time: float, name: str, distance: float, angle: float) -> None:
    """Raise SimulationStopped if the nearest object, at a distance [m] and angle [rad], is out of capture range."""
    if captures(gripper, distance, angle):
        return
    raise SimulationStopped(
        f"too_far: the gripper closes at t = {time:g} s, {1e3 * distance:.3g} mm and {np.degrees(angle):.3g}° from the "
        f"grasp frame of {name}; it captures within {1e3 * gripper.capture_distance:g} mm and "
        f"{np.degrees(gripper.capture_angle):g}° (plant.gripper)",
        time=time,
        kind="too_far",
    )

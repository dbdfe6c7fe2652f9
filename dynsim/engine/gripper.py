"""The gripper in a run: soft, hardening, hardened, softening; what it captures, how that slips, and why a run ends.

A command to close hardens the gripper. The captured object is held in its present position: the springs begin without
force, and the stiffness that the hardening adds is not deflected yet.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.engine.operator import Referenced
from dynsim.errors import SimulationStopped
from dynsim.model.description import Array
from dynsim.model.gripper import DIRECTIONS, Gripper, grasp_frame, tie_name
from dynsim.record import Event, Record

# Kinds of events, after this word.
EVENT, EVENT_KINDS = "gripper ", ("captures", "slips", "loses", "releases")
SOFT, HARDENING, HARDENED, SOFTENING = range(4)
STATES = ("soft", "hardening", "hardened", "softening")
STATES_TEXT = ", ".join(f"{number} {name}" for number, name in enumerate(STATES))
# A gripper that holds an object has at least this share of its springs: a tie needs a stiffness.
LEAST_SHARE = 0.01
# Smaller slips are not recorded [m, rad].
SLIPPED = np.array([1e-3, 2e-2])
# A tie is at its bound when less than this share of it is missing.
AT_BOUND = 1e-3
# A held object on a hinge or rails that moves no faster is at rest [rad/s or m/s], and stuck after this time [s].
AT_REST, STUCK_FOR = 1e-3, 1.0


@dataclass(frozen=True)
class Held:
    """An object in the gripper: the placement of its grasp frame in that of the gripper at its capture."""

    name: str
    R: Array
    p: Array


@dataclass
class GripperControl:
    """A gripper and the objects that it can hold.

    Attributes
    ----------
    objects : names of the objects that have a grasp frame
    period : control period [s]
    mode : one of :data:`STATES`; share : present share of the hardened springs
    slipping : the slip of the present object is recorded; stuck_since : time since which this object is stuck [s]
    """

    model: Model
    gripper: Gripper
    objects: tuple[str, ...]
    period: float
    mode: int = SOFT
    share: float = 0.0
    held: Held | None = None
    slipping: bool = False
    stuck_since: float | None = None
    events: tuple[Event, ...] = ()
    trace: list[tuple[int, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        robot = self.model.robot
        self._body = self.model.body_index(self.gripper.body)
        self._grasps = {name: _attached(self.model, grasp_frame(name)) for name in self.objects}
        # Of objects on hinges or rails: their rates.
        joints = [link.joint for link in robot.links]
        self._rate = {name: joints.index(name) for name in self.objects if name in joints}

    @property
    def state_in_words(self) -> str:
        """Return the state in words, for the page of a pilot."""
        return STATES[self.mode] + (f" around {self.held.name}" if self.held is not None else "")

    def remembered(self) -> GripperControl:
        """Return a copy of the state and of the recorded samples."""
        return replace(self, trace=list(self.trace))

    def restore(self, kept: GripperControl) -> None:
        """Go back to what :meth:`remembered` gave."""
        for name in ("mode", "share", "held", "slipping", "stuck_since", "events"):
            setattr(self, name, getattr(kept, name))
        self.trace = list(kept.trace)

    def placement(self, name: str, q: Array) -> tuple[Array, Array]:
        """Rotation and origin of an object's grasp frame in that of the gripper, whose origin is its tip."""
        R, p = self.model.body_pose(self._body, q)
        body, A, at = self._grasps[name]
        B, other = self.model.body_pose(body, q)
        return R.T @ B @ A, R.T @ (other + B @ at - p) - self.gripper.tip

    def nearest(self, q: Array) -> tuple[str, float, float]:
        """The nearest object, its distance [m], and the angle between its axis and the gripper's [rad]."""
        return nearest_of({name: self.placement(name, q) for name in self.objects})

    def step(self, time: float, closed: bool, simulation: Referenced) -> None:
        """One control period.

        Raises
        ------
        SimulationStopped
            ``too_far``: it closes, and nothing is within capture; ``lost``: an object has slipped out; ``too_stiff``:
            an object on a hinge or rails does not move.
        """
        q = simulation.state.q
        if closed and self.mode in {SOFT, SOFTENING}:
            if self.held is None:
                self._capture(time, q, simulation)
            self.mode = HARDENING
        elif not closed and self.mode in {HARDENING, HARDENED}:
            self.mode = SOFTENING
        self._harden(time, simulation)
        if self.held is not None:
            self._look(time, simulation)
        self.trace.append((self.mode, self.share, self.nearest(q)[1]))

    def _capture(self, time: float, q: Array, simulation: Referenced) -> None:
        placements = {name: self.placement(name, q) for name in self.objects}
        name, distance, angle = nearest_of(placements, self.gripper)
        if (stop := too_far(self.gripper, time, name, distance, angle)) is not None:
            raise stop
        self.held, self.slipping, self.stuck_since = Held(name, *self.placement(name, q)), False, None
        self._tell(time, "gripper captures", name, distance)
        for direction in DIRECTIONS:
            simulation.set_tie(tie_name(name, direction), holds=True)

    def _harden(self, time: float, simulation: Referenced) -> None:
        """Let the springs grow or fade, and release the object when they are gone."""
        before = self.share
        if self.mode == HARDENING:
            self.share = min(self.share + self.period / self.gripper.hardening, 1.0)
            self.mode = HARDENED if self.share >= 1.0 - 1e-9 else HARDENING
        elif self.mode == SOFTENING:
            self.share = max(self.share - self.period / self.gripper.softening, 0.0)
            self.mode = SOFT if self.share <= 1e-9 else SOFTENING
        if self.held is None or self.share == before:
            return
        name, share = self.held.name, max(self.share, LEAST_SHARE)
        for k, direction in enumerate(DIRECTIONS):
            stiffness, damping, _ = self.gripper.laws[k // 3]
            simulation.set_tie(
                tie_name(name, direction), stiffness=share * stiffness, damping=share * damping, holds=self.mode != SOFT
            )
        if self.mode == SOFT:
            self.held = None
            self._tell(time, "gripper releases", name)

    def _look(self, time: float, simulation: Referenced) -> None:
        """Check whether the held object slips, is lost, or is stuck."""
        assert self.held is not None
        name, g = self.held.name, self.gripper
        if self.mode == SOFTENING:  # what slips out now is let go
            self.stuck_since = None
            return
        force, slip = simulation.tie_force, simulation.tie_slip
        loads = np.array([abs(force[tie_name(name, direction)]) for direction in DIRECTIONS])
        bounds = np.repeat([g.bound, g.turning_bound], 3)
        bound = loads >= (1.0 - AT_BOUND) * bounds
        slips = np.array([slip[tie_name(name, direction)] for direction in DIRECTIONS])
        moved = float(np.linalg.norm(slips[:3])), float(np.linalg.norm(slips[3:]))
        if not self.slipping and (np.array(moved) > SLIPPED).any():
            self.slipping = True
            self._tell(time, "gripper slips", name, moved[0])
        still = name in self._rate and abs(float(simulation.state.v[self._rate[name]])) < AT_REST
        if not (still and bound.any()):
            self.stuck_since = None
        elif self.stuck_since is None:
            self.stuck_since = time
        lost = moved[0] > g.lost_distance or moved[1] > g.lost_angle
        slipped = (
            f"{name} has slipped by {1e3 * moved[0]:.3g} mm and {moved[1]:.3g} rad in the gripper at t = {time:g} s"
        )
        if lost:
            self._tell(time, "gripper loses", name, moved[0])
        if self.stuck_since is not None and (lost or time - self.stuck_since >= STUCK_FOR):
            worst = DIRECTIONS[int((loads / bounds).argmax())]
            direction = f"along {worst}" if len(worst) == 1 else f"about {worst[1]}"
            raise SimulationStopped(
                f"too_stiff: {name} does not move from t = {self.stuck_since:g} s on, the gripper is at its bound "
                f"{direction}; {slipped} (plant.gripper)",
                time=time,
                kind="too_stiff",
            )
        if lost:
            raise SimulationStopped(
                f"lost: {slipped}; it holds {g.bound:g} N and {g.turning_bound:g} N m (plant.gripper)",
                time=time,
                kind="lost",
            )

    def _tell(self, time: float, kind: str, name: str, value: float | None = None) -> None:
        self.events = (*self.events, Event(time, kind, name, value))

    def columns(self, ticks: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """State, share of its springs, and distance of the nearest grasp frame [m] at ticks, (T,) each."""
        if not self.trace:
            return tuple(np.zeros(len(ticks)) for _ in range(3))  # type: ignore[return-value]
        rows = np.array(self.trace)[np.minimum(ticks, len(self.trace) - 1)]
        return rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 2]


def gripper_summary(record: Record, objects: Iterable[str]) -> dict[str, Any]:
    """What the gripper did and how far objects have moved, for ``summary.json``.

    ``moved`` : last less first coordinate of an object on a hinge or rails [rad or m], displacement of a free one [m]
    """
    labels, q = list(record.labels["q"]), record["q"]
    moved: dict[str, float | list[float]] = {}
    for name in objects:
        own = [name] if name in labels else [f"{name}.{axis}" for axis in "xyz"]
        change = [float(q[-1, labels.index(label)] - q[0, labels.index(label)]) for label in own]
        moved[name] = change[0] if len(change) == 1 else change
    kinds = [(event.kind.removeprefix(EVENT), event.name) for event in record.events if event.kind.startswith(EVENT)]
    by_kind = {kind: [name for other, name in kinds if other == kind] for kind in EVENT_KINDS}
    summary: dict[str, Any] = {"moved": moved, **by_kind}
    if "tie_force" in record:
        ties = list(record.labels["tie_force"])
        for key, axes in (("force_max_N", DIRECTIONS[:3]), ("torque_max_N_m", DIRECTIONS[3:])):
            columns = [k for k, tie in enumerate(ties) if tie.startswith("gripper.") and tie.rpartition(".")[2] in axes]
            summary[key] = float(np.abs(record["tie_force"][:, columns]).max(initial=0.0))
    return summary


def nearest_of(
    placements: Mapping[str, tuple[Array, Array]], gripper: Gripper | None = None
) -> tuple[str, float, float]:
    """The object with the nearest grasp frame, its distance [m], and the angle between the two axes [rad].

    Parameters
    ----------
    placements : rotation and origin of grasp frames in that of the gripper, by object
    gripper : objects within its capture come first
    """

    def seen(name: str) -> tuple[bool, float, float]:
        R, p = placements[name]
        distance, angle = float(np.linalg.norm(p)), float(np.arccos(np.clip(R[0, 0], -1.0, 1.0)))
        beyond = gripper is not None and (distance > gripper.capture_distance or angle > gripper.capture_angle)
        return beyond, distance, angle

    name = min(placements, key=lambda name: (*seen(name), name))
    return name, *seen(name)[1:]


def too_far(gripper: Gripper, time: float, name: str, distance: float, angle: float) -> SimulationStopped | None:
    """What ends a run in which the gripper closes so far from the nearest object [m, rad]; None if it captures that."""
    if distance <= gripper.capture_distance and angle <= gripper.capture_angle:
        return None
    return SimulationStopped(
        f"too_far: the gripper closes at t = {time:g} s, {1e3 * distance:.3g} mm and {np.degrees(angle):.3g}° from the "
        f"grasp frame of {name}; it captures within {1e3 * gripper.capture_distance:g} mm and "
        f"{np.degrees(gripper.capture_angle):g}° (plant.gripper)",
        time=time,
        kind="too_far",
    )


def _attached(model: Model, frame: str) -> tuple[int, Array, Array]:
    """Return the body of a frame, and rotation and origin of the frame in this body."""
    robot = model.robot
    body, at = robot.attach(frame, np.zeros(3))
    return body, robot.attached_axes(frame), at

"""The servo map: which servo follows which column of a record, and what that joint may do.

Joint angle and servo position are tied by

    tick = zero_tick + sign · gear · angle / (2π/4096)

``gear`` being servo turns per joint turn. Angles are radians inside; a key whose unit is not SI carries it in its name.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from dynsim.config import error_at
from dynsim.errors import shown
from dynsim.hardware.bus.control_table import (
    BAUD_RATES,
    MAX_ID,
    MODELS,
    RAD_PER_TICK,
    RAD_S_PER_UNIT,
    TICKS_PER_TURN,
    OperatingMode,
    ServoModel,
)
from dynsim.hardware.data_sheet import objections_to_limits, objections_to_safety
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.strict_yaml import Finite, Positive, StrictModel, read_yaml
from dynsim.inputs import is_file

_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent / "scenarios" / "hardware"
SHIPPED = _CHECKOUT if _CHECKOUT.is_dir() else _PACKAGE / "shipped_scenarios" / "hardware"
"""Folder of the servo maps that come with dynsim."""

FaultPolicy = Literal["hold", "decelerate", "off"]


class Follows(StrictModel):
    """Signals of the record a servo follows.

    Attributes
    ----------
    position, velocity : str
        Angle [rad] and its rate [rad/s].
    torque : str or None
        Joint torque [N m] to be held against ``limits.torque`` by the offline check.
    rates : "continuous" or "held"
        Whether the rate changes smoothly between samples, or is held until the next one (a sampled controller).
    """

    position: str
    velocity: str
    torque: str | None = None
    rates: Literal["continuous", "held"] = "continuous"


class Limits(StrictModel):
    """What a joint may do.

    Attributes
    ----------
    position_deg : tuple of float or None
        Lowest and highest joint angle [°]; None for a wheel.
    velocity : float
        Highest joint speed [rad/s].
    torque : float
        Joint torque at which the replay aborts [N·m].
    acceleration : float
        Highest acceleration of the path, between samples too [rad/s²]. The default lets the start of the published
        arm's record pass, which jumps to 2.6 rad/s within 5 ms; a joint that turns a load wants less.
    jerk : float
        Highest change of acceleration, averaged in magnitude over 0.1 s [rad/s³]
        (:meth:`dynsim.hardware.replay.trajectory.Path.jerk`). The default refuses a zigzag of 2 mrad every 5 ms.
    """

    position_deg: tuple[Finite, Finite] | None = None
    velocity: Positive
    torque: Positive
    acceleration: Positive = 2000.0
    jerk: Positive = 60_000.0


# For editors; what loading says about it is in _position_limits_fit_the_mode.
_POSITION_NEEDS_LIMITS: dict[str, Any] = {
    "if": {"properties": {"mode": {"const": "position"}}},
    "then": {
        "properties": {"limits": {"required": ["position_deg"], "properties": {"position_deg": {"type": "array"}}}}
    },
}


class Kind(StrictModel):
    """Everything servos of one sort have in common.

    Attributes
    ----------
    model : str
        A name of :data:`dynsim.hardware.bus.control_table.MODELS`.
    mode : "position" or "velocity"
    firmware_min : int
        Oldest firmware accepted.
    follows : Follows
    limits : Limits
    following_error : float
        Abort threshold between measured and commanded: [rad] in position mode, [rad/s] in velocity mode.
    gear : float
        Servo turns per joint turn.
    """

    model: Literal["MX-106", "MX-28", "XL430-W250", "XM430-W210", "XM430-W350", "XH540-W150", "XH540-W270"]
    mode: Literal["position", "velocity"]
    firmware_min: int = 41
    follows: Follows
    limits: Limits
    following_error: Positive
    gear: Positive = 1.0

    model_config = ConfigDict(json_schema_extra=_POSITION_NEEDS_LIMITS)

    @model_validator(mode="after")
    def _position_limits_fit_the_mode(self) -> Kind:
        limits = self.limits.position_deg
        if self.mode == "position" and limits is None:
            raise error_at("limits", "a servo in position mode needs limits.position_deg: [lowest, highest]")
        if limits is not None and not limits[0] < limits[1]:
            raise error_at("limits.position_deg", f"{limits[0]} is not below {limits[1]}")
        for key, text in objections_to_limits(
            MODELS[self.model],
            self.gear,
            turns_to_angle=self.mode == "position",
            position_deg=limits,
            velocity=self.limits.velocity,
            torque=self.limits.torque,
            following_error=self.following_error,
        ):
            raise error_at(key, text)
        return self


class ServoEntry(StrictModel):
    """One servo: its kind, bus ID, sense, zero, and (held joints) the angle it keeps instead of following a record."""

    kind: str
    id: Annotated[int, Field(ge=0, le=MAX_ID)]
    sign: Literal[1, -1] = 1
    zero_tick: Annotated[int, Field(ge=-(1 << 20), le=1 << 20)] = 2048
    label: str | None = None
    hold_at_deg: Finite | None = None


# 4.5 Mbit/s is the servos' but not the client library's.
_BAUD_CHOICES = [rate for rate in BAUD_RATES if rate <= 4_000_000]


class Bus(StrictModel):
    """The serial line.

    Attributes
    ----------
    baud : int
        [bit/s].
    rate : float
        Goal and state cycles per second [Hz].
    latency : float
        What adapter and operating system may add to an answer [s].
    return_delay : float
        Longest return delay a servo may have stored [s].
    """

    baud: Annotated[int, Field(json_schema_extra={"enum": _BAUD_CHOICES})] = 3_000_000
    rate: Positive = 200.0
    latency: Positive = 2e-3
    return_delay: Annotated[float, Field(ge=0, le=508e-6)] = 0.0

    @model_validator(mode="after")
    def _baud_is_one_of_the_servos(self) -> Bus:
        if self.baud not in _BAUD_CHOICES:
            raise error_at("baud", f"is not one of {', '.join(map(str, _BAUD_CHOICES))}")
        return self


class Supply(StrictModel):
    """Voltage range in which the robot may move [V]."""

    lowest: Positive = 10.0
    highest: Positive = 14.8


class Safety(StrictModel):
    """When to abort, and how to stop.

    Attributes
    ----------
    policy : "hold", "decelerate" or "off"
        What to do on a fault: freeze where the robot is; slow down along the path and hold; release torque.
    stop_time : float
        Time in which `decelerate` comes to rest [s].
    run_up : float
        Acceleration of the stretch added where a record begins or ends in motion [rad/s²].
    approach_velocity : float
        Top speed of the move to the start posture [rad/s].
    start_distance : float
        A joint further than this from the start posture is asked about once more [rad].
    watchdog : float
        Servos stop by themselves when the bus is silent for this long [s].
    missed_cycles, late_cycles, following_cycles, torque_cycles : int
        Consecutive cycles of one servo without a status, of late deadlines, of following error and of too much torque
        that abort.
    temperature_max : float
        [°C].
    at_end : "off" or "hold"
        Torque after a run that went well. A robot that falls when limp holds.
    """

    policy: FaultPolicy = "decelerate"
    stop_time: Annotated[float, Field(gt=0, le=3.0)] = 0.3
    run_up: Positive = 2.0
    approach_velocity: Positive = 0.3
    start_distance: Positive = 0.5
    watchdog: Annotated[float, Field(ge=0.02, le=2.54)] = 0.2
    missed_cycles: Annotated[int, Field(ge=1, le=100)] = 3
    late_cycles: Annotated[int, Field(ge=1, le=1000)] = 5
    following_cycles: Annotated[int, Field(ge=1, le=100)] = 5
    torque_cycles: Annotated[int, Field(ge=1, le=100)] = 10
    temperature_max: Positive = 65.0
    supply: Supply = Supply()
    at_end: Literal["off", "hold"] = "off"


class Lifts(StrictModel):
    """How wheel pairs that the record lifts are lifted.

    Attributes
    ----------
    signal : str
        Signal of the record with 1 where a wheel pair is on the ground, 0 where it is lifted.
    joints : tuple of str
        The pitch joints on the axles of the first, second, ... pair: every pair but the last has one. Lifting is added
        to what they do otherwise; the first, on the axle that carries the head, follows the record and keeps the head
        where it is.
    clearance_mm : float
        Height of the lower wheel of a lifted pair above the floor.
    blend_s : float
        Time to lift a pair, and to put it down [s of record time].
    tilt_mm : float
        A record is refused where one wheel of a grounded pair would be further above the floor: a bent base twists.
    """

    signal: str = "grounded"
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    clearance_mm: Positive = 5.0
    blend_s: Positive = 0.3
    tilt_mm: Positive = 2.5


class _MapFile(StrictModel):
    """A servo map: which servo follows which column of a record, and what that joint may do."""

    model_config = ConfigDict(title="ServoMap")

    robot: str
    bus: Bus = Bus()
    safety: Safety = Safety()
    lifts: Lifts | None = None
    kinds: dict[str, Kind]
    servos: Annotated[dict[str, ServoEntry], Field(json_schema_extra={"minProperties": 1})]

    @model_validator(mode="after")
    def _servos_are_consistent(self) -> _MapFile:
        if not self.servos:
            raise error_at("servos", "the map names none")
        owner: dict[int, str] = {}
        follower: dict[tuple[str, str], str] = {}
        for joint, entry in self.servos.items():
            if entry.kind not in self.kinds:
                raise error_at(f"servos.{joint}.kind", f"is not one of {', '.join(self.kinds)}")
            if entry.id in owner:
                raise error_at(f"servos.{joint}.id", f"is also the ID of {owner[entry.id]}")
            owner[entry.id] = joint
            column = (self.kinds[entry.kind].follows.position, entry.label or joint)
            if entry.hold_at_deg is None and (other := follower.setdefault(column, joint)) != joint:
                raise error_at(f"servos.{joint}.label", f"{other} already follows {column[1]!r} of {column[0]!r}")
        for joint in self.lifts.joints if self.lifts else ():
            if joint not in self.servos:
                raise error_at("lifts.joints", f"{joint} is none of the servos")
            if self.kinds[self.servos[joint].kind].mode != "position" or self.servos[joint].hold_at_deg not in (
                None,
                0,
            ):
                raise error_at(
                    "lifts.joints", f"{joint} must be in position mode and follow the record or be held at 0"
                )
        return self

    @model_validator(mode="after")
    def _safety_fits_the_servos(self) -> _MapFile:
        safety, supply = self.safety, self.safety.supply
        used = {name: self.kinds[name] for name in dict.fromkeys(entry.kind for entry in self.servos.values())}
        models = [MODELS[kind.model] for kind in used.values()]
        for key, text in objections_to_safety(models, safety.temperature_max, (supply.lowest, supply.highest)):
            raise error_at(f"safety.{key}", text)
        if self.bus.latency >= safety.watchdog:
            raise error_at("bus.latency", "is not below safety.watchdog: one lost answer would trip the watchdogs")
        for name, kind in used.items():
            limits = kind.limits
            if kind.mode == "position" and safety.approach_velocity > limits.velocity:
                raise error_at("safety.approach_velocity", f"is above kinds.{name}.limits.velocity")
            if (needed := limits.velocity / safety.stop_time) > limits.acceleration:
                raise error_at("safety.stop_time", f"stops kinds.{name} with {needed:.4g} rad/s², above its limit")
        return self


class Servo:
    """One servo of the map, with its conversions.

    Attributes
    ----------
    joint, label : str
        Name of the joint, and of its column in the record.
    id : int
    model : ServoModel
    kind : Kind
    position_limits : tuple of float
        Lowest and highest joint angle [rad]; infinite for a wheel.
    """

    def __init__(self, joint: str, entry: ServoEntry, kind: Kind) -> None:
        self.joint = joint
        self.label = entry.label or joint
        self.id = entry.id
        self.sign = entry.sign
        self.zero_tick = entry.zero_tick
        self.kind = kind
        self.gear = kind.gear
        self.hold_at = None if entry.hold_at_deg is None else math.radians(entry.hold_at_deg)
        self.model: ServoModel = MODELS[kind.model]
        limits = kind.limits.position_deg
        self.position_limits = (-math.inf, math.inf) if limits is None else tuple(math.radians(x) for x in limits)

    @property
    def in_position_mode(self) -> bool:
        return self.kind.mode == "position"

    @property
    def operating_mode(self) -> OperatingMode:
        """Value of address 11 this servo must have."""
        return OperatingMode.POSITION if self.in_position_mode else OperatingMode.VELOCITY

    def to_ticks(self, angle: float) -> int:
        """Servo position for a joint angle [rad]."""
        return self.zero_tick + round(self.sign * self.gear * angle / RAD_PER_TICK)

    def to_angle(self, ticks: int) -> float:
        """Joint angle [rad] for a servo position."""
        return self.sign * (ticks - self.zero_tick) * RAD_PER_TICK / self.gear

    def to_velocity_units(self, velocity: float) -> int:
        """Servo velocity register for a joint velocity [rad/s]."""
        return round(self.sign * self.gear * velocity / RAD_S_PER_UNIT)

    def to_velocity(self, units: int) -> float:
        """Joint velocity [rad/s] for a servo velocity register."""
        return self.sign * units * RAD_S_PER_UNIT / self.gear

    def to_torque(self, effort: int) -> float:
        """Estimated joint torque [N·m] for the register at address 126."""
        return self.sign * self.gear * self.model.torque(effort)

    @property
    def tick_limits(self) -> tuple[int, int]:
        """Lowest and highest goal position this joint may ever be sent."""
        if not self.in_position_mode:
            return (0, TICKS_PER_TURN - 1)
        ends = [self.to_ticks(angle) for angle in self.position_limits]
        return max(0, min(ends)), min(TICKS_PER_TURN - 1, max(ends))


class ServoMap:
    """All servos of a robot, in the order of the file.

    Attributes
    ----------
    robot : str
    path : Path
    bus : Bus
    safety : Safety
    lifts : Lifts or None
    servos : tuple of Servo
    """

    def __init__(self, path: Path, content: _MapFile) -> None:
        self.path = path
        self.robot = content.robot
        self.bus = content.bus
        self.safety = content.safety
        self.lifts = content.lifts
        self.servos = tuple(Servo(joint, entry, content.kinds[entry.kind]) for joint, entry in content.servos.items())

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(servo.id for servo in self.servos)

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(servo.joint for servo in self.servos)

    @property
    def lifting(self) -> dict[str, Any]:
        """The entry ``lifts``, if there is one, with the columns of a record instead of the joints: for provenance."""
        if self.lifts is None:
            return {}
        label = {servo.joint: servo.label for servo in self.servos}
        return {"lifts": self.lifts.model_dump() | {"joints": [label[joint] for joint in self.lifts.joints]}}


def load_servo_map(path: str | Path) -> ServoMap:
    """Read and validate a servo map: the file of that path, or the one of that name that comes with dynsim ("arm").

    Raises
    ------
    ServoMapError
        The file is missing, is not YAML, or an entry is wrong; with file and line.
    """
    if not isinstance(path, (str, Path)):
        raise ServoMapError(
            f"a servo map is named by its file, or by its name when it is shipped, not by {shown(path)}"
        )
    path = Path(path)
    shipped = SHIPPED / f"{path.stem}.yaml"
    named = path.parent in (Path(), Path("scenarios/hardware")) and shipped.is_file()
    if named and not is_file(path, ServoMapError):
        path = shipped
    return ServoMap(path, read_yaml(path, _MapFile))


def json_schema() -> dict[str, Any]:
    """JSON schema of servo maps, for editors.

    It cannot say what ties entries together: that ``kind`` names one of ``kinds``, that IDs differ, and that the lower
    limit is below the upper one. Loading checks these.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_MapFile.model_json_schema()}

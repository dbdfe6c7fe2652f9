"""The servo map: its schema, its checks and its files; servos, the columns of a record they follow, and limits.

Joint angle [rad] and servo position [ticks] are related by

    tick = zero_tick + sign · gear · angle / (2π/4096)

``gear`` being servo turns per joint turn. Angles are radians inside; a key whose unit is not SI carries it in its name.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from dynsim.config.base import Positive, StrictConfig, error_at
from dynsim.config.problems import Origin, dotted, suggest
from dynsim.errors import brief
from dynsim.hardware.bus.control_table import (
    MAX_ID,
    MODELS,
    RAD_PER_TICK,
    RAD_S_PER_UNIT,
    TICKS_PER_TURN,
    VOLT_PER_UNIT,
    OperatingMode,
    ServoModel,
)
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.safety import BusSettings, Safety, objections_to_times
from dynsim.hardware.strict_yaml import Objection, Within, read_located, rounded_up
from dynsim.snake.lifting import Lifts
from dynsim.system.files import file_name
from dynsim.system.inputs import is_file

_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent / "scenarios" / "hardware"
SHIPPED = _CHECKOUT if _CHECKOUT.is_dir() else _PACKAGE / "shipped_scenarios" / "hardware"
"""Folder of the servo maps that come with dynsim."""


HIGHEST_SUPPLY, RATED_SUPPLY = 14.8, 12.0
"""Highest recommended supply of the MX series, and supply of its data sheet [V]; speed and torque grow with it."""
FURTHEST_OFF = 1.0
"""Largest limit on the following error of a position servo; a larger one would have no effect [rad]."""
ROOM = 20.0
"""Room temperature, which a servo that has not moved yet has [°C]."""

_NO_LIMIT = "bounds nothing that a servo can do, or lets nothing pass"


class Follows(StrictConfig):
    """Signals of the record a servo follows."""

    position: str = Field(description="signal with the joint's angle [rad]")
    velocity: str = Field(description="signal with its rate [rad/s]")
    torque: str | None = Field(
        None, description="signal with its torque [N m], which the offline check compares with limits.torque"
    )
    rates: Literal["continuous", "held"] = Field(
        "continuous",
        description="the rate changes smoothly between samples, or is held until the next one (a sampled controller)",
    )


class Limits(StrictConfig):
    """What a joint may do.

    The default of the acceleration lets the start of the published arm's record pass, which jumps to 2.6 rad/s within
    5 ms; a joint that turns a load wants less. That of the jerk refuses a zigzag of 2 mrad every 5 ms.
    """

    position_deg: tuple[float, float] | None = Field(
        None, description="lowest and highest joint angle [°]; required in position mode, not for wheels"
    )
    velocity: Positive = Field(description="highest joint speed [rad/s]")
    torque: Positive = Field(description="joint torque at which the replay aborts [N m]")
    acceleration: Annotated[Positive, Within(0.01, 1e5, "rad/s²", _NO_LIMIT)] = Field(
        2000.0, description="highest acceleration of the path, between samples too [rad/s²]"
    )
    jerk: Annotated[Positive, Within(0.01, 1e7, "rad/s³", _NO_LIMIT)] = Field(
        60_000.0, description="highest change of acceleration, averaged in magnitude over 0.1 s [rad/s³]"
    )
    shaking: Annotated[Positive, Within(0.01, 100.0, "rad/s", _NO_LIMIT)] = Field(
        3.0, description="highest velocity that is gained and lost again within 0.3 s, or lost and gained [rad/s]"
    )


# For editors; what loading says about it is in _position_limits_fit_the_mode.
_POSITION_NEEDS_LIMITS: dict[str, Any] = {
    "if": {"properties": {"mode": {"const": "position"}}},
    "then": {
        "properties": {"limits": {"required": ["position_deg"], "properties": {"position_deg": {"type": "array"}}}}
    },
}


class Kind(StrictConfig):
    """Everything servos of one sort have in common."""

    model: Literal["MX-106", "MX-28", "XL430-W250", "XM430-W210", "XM430-W350", "XH540-W150", "XH540-W270"] = Field(
        description="of the servo"
    )
    mode: Literal["position", "velocity"] = Field(description="of the servo: position for joints, velocity for wheels")
    firmware_min: int = Field(41, description="oldest firmware accepted")
    follows: Follows = Field(description="signals of the record")
    limits: Limits = Field(description="what the joint may do")
    following_error: Positive = Field(
        description="largest difference of measured and commanded: [rad] in position mode, [rad/s] in velocity mode"
    )
    gear: Positive = Field(1.0, description="servo turns per joint turn")

    model_config = ConfigDict(json_schema_extra=_POSITION_NEEDS_LIMITS)

    @model_validator(mode="after")
    def _fits_its_servo(self) -> Kind:
        for key, text in self._objections():
            raise error_at(key, text)
        return self

    def _objections(self) -> Iterator[Objection]:
        """What no servo of this model and gear can do, and rules that could never fire."""
        model, gear, limits, error = MODELS[self.model], self.gear, self.limits, self.following_error
        position = limits.position_deg
        speed = model.no_load_speed * HIGHEST_SUPPLY / RATED_SUPPLY / gear
        stall = model.stall_torque * HIGHEST_SUPPLY / RATED_SUPPLY * gear
        in_position_mode = self.mode == "position"
        if in_position_mode and position is None:
            yield "limits", "a servo in position mode needs limits.position_deg: [lowest, highest]"
        if position is not None and not position[0] < position[1]:
            yield "limits.position_deg", f"{position[0]} is not below {position[1]}"
        if limits.velocity > speed:
            yield "limits.velocity", f"a {model.name} turns this joint at {speed:.3g} rad/s at most"
        if limits.torque > stall:
            yield "limits.torque", f"a {model.name} stalls at {stall:.3g} N m here: the rule would never fire"
        if limits.torque < (least := model.torque(1) * gear):
            text = f"is below what a {model.name} can tell from none; use {rounded_up(least):g} N m or more"
            yield "limits.torque", text
        unit, name = (RAD_PER_TICK, "rad") if in_position_mode else (RAD_S_PER_UNIT, "rad/s")
        if error < unit / gear:
            yield "following_error", f"is below what the servo can tell; use {rounded_up(unit / gear):g} {name} or more"
        if not in_position_mode and position is not None:
            text = "a servo in velocity mode is not held to angles; leave it out, or use mode: position"
            yield "limits.position_deg", text
        if in_position_mode and position is not None:
            if (position[1] - position[0]) * gear > 360.0:
                text = f"position mode knows one turn of the servo, {360 / gear:.4g}° of this joint"
                yield "limits.position_deg", text
            if error > FURTHEST_OFF:
                yield "following_error", f"is more than {FURTHEST_OFF:g} rad: the rule would watch nothing"
        elif error > limits.velocity:
            yield "following_error", "is more than limits.velocity: a servo that stands still would not be noticed"


def _not_a_flag(value: Any) -> Any:
    """``True`` equals 1, so a choice among numbers takes it."""
    if isinstance(value, bool):
        raise ValueError("must be 1 or -1")
    return value


class ServoEntry(StrictConfig):
    """One servo: its kind, bus ID, sense, zero, and (held joints) the angle it keeps instead of following a record."""

    kind: str = Field(description="one of `kinds`")
    id: int = Field(ge=0, le=MAX_ID, description="on the bus")
    sign: Annotated[Literal[1, -1], BeforeValidator(_not_a_flag)] = Field(
        1, description="sense of the servo against that of the joint"
    )
    zero_tick: int = Field(
        2048, ge=-(1 << 20), le=1 << 20, description="servo position in the zero posture of the joint [ticks of 0.088°]"
    )
    label: str | None = Field(None, description="column of the record; default: the name of the joint")
    hold_at_deg: float | None = Field(
        None, description="angle that the joint keeps instead of following the record [°]"
    )


def _is_a_file_name(robot: str) -> str:
    if file_name(robot) != robot:
        raise ValueError(
            f"names the folder of results; use a name without / and the like, such as {file_name(robot)!r}"
        )
    return robot


class _MapFile(StrictConfig):
    """A servo map: which servo follows which column of a record, and what that joint may do."""

    model_config = ConfigDict(title="ServoMap")

    robot: Annotated[str, AfterValidator(_is_a_file_name)] = Field(
        description="name of the robot, also in that of its folder of results"
    )
    bus: BusSettings = Field(BusSettings(), description="the serial line")
    safety: Safety = Field(Safety(), description="when to abort, and how to stop")
    lifts: Lifts | None = Field(None, description="how a snake's wheel pairs are lifted")
    kinds: dict[str, Kind] = Field(description="what several servos have in common")
    servos: dict[str, ServoEntry] = Field(
        json_schema_extra={"minProperties": 1}, description="the servo of each joint, by the joint's name"
    )

    @model_validator(mode="after")
    def _entries_fit_each_other(self) -> _MapFile:
        objections = itertools.chain(self._in_names(), self._in_safety(), objections_to_times(self.bus, self.safety))
        for key, text in itertools.chain(objections, self._in_zeros()):
            raise error_at(key, text)
        return self

    def _in_names(self) -> Iterator[Objection]:
        """IDs and columns that are used twice, kinds and joints that do not exist."""
        if not self.servos:
            yield "servos", "the map names none"
        owner: dict[int, str] = {}
        follower: dict[tuple[str, str], str] = {}
        for joint, entry in self.servos.items():
            if entry.kind not in self.kinds:
                like = suggest(entry.kind, self.kinds)
                yield f"servos.{joint}.kind", f"is not one of {', '.join(self.kinds)}{like}"
            if entry.id in owner:
                yield f"servos.{joint}.id", f"is also the ID of {owner[entry.id]}"
            owner[entry.id] = joint
            column = (self.kinds[entry.kind].follows.position, entry.label or joint)
            if entry.hold_at_deg is None and (other := follower.setdefault(column, joint)) != joint:
                yield f"servos.{joint}.label", f"{other} already follows {column[1]!r} of {column[0]!r}"
        for joint in self.lifts.joints if self.lifts else ():
            if joint not in self.servos:
                yield "lifts.joints", f"{joint} is none of the servos"
            entry = self.servos[joint]
            if self.kinds[entry.kind].mode != "position" or entry.hold_at_deg not in (None, 0):
                yield "lifts.joints", f"{joint} must be in position mode and follow the record or be held at 0"

    def _in_safety(self) -> Iterator[Objection]:
        """What the kinds that are used, or their servos' models, cannot do of what ``safety`` asks for.

        Among it are thresholds at which the servos have long protected themselves, by going limp.
        """
        safety, hottest, supply = self.safety, self.safety.temperature_max, self.safety.supply
        kinds = {name: self.kinds[name] for name in dict.fromkeys(entry.kind for entry in self.servos.values())}
        if supply.lowest >= supply.highest:
            yield "safety.supply.lowest", "is not below supply.highest"
        if hottest <= ROOM:
            text = f"is no more than the {ROOM:g} °C of a room: every run would abort; use 65 or so"
            yield "safety.temperature_max", text
        for model in (MODELS[kind.model] for kind in kinds.values()):
            limp = model.fields["temperature_limit"].default
            low, high = model.fields["min_voltage"].low, model.fields["max_voltage"].high
            if hottest > limp:
                yield "safety.temperature_max", f"a {model.name} goes limp at {limp} °C"
            if low is not None and supply.lowest < low * VOLT_PER_UNIT:
                yield "safety.supply.lowest", f"a {model.name} does not work below {low * VOLT_PER_UNIT:g} V"
            if high is not None and supply.highest > high * VOLT_PER_UNIT:
                yield "safety.supply.highest", f"a {model.name} does not work above {high * VOLT_PER_UNIT:g} V"
        for name, kind in kinds.items():
            limits = kind.limits
            if kind.mode == "position" and safety.approach_velocity > limits.velocity:
                text = f"is above kinds.{name}.limits.velocity; use {limits.velocity:g} or less"
                yield "safety.approach_velocity", text
            if (needed := limits.velocity / safety.stop_time) > limits.acceleration:
                least = rounded_up(limits.velocity / limits.acceleration)
                text = f"stops kinds.{name} with {needed:.4g} rad/s², above its limit; use {least:g} or more"
                yield "safety.stop_time", text
            if safety.run_up > limits.acceleration:
                text = f"is above kinds.{name}.limits.acceleration, {limits.acceleration:g} rad/s²; use that or less"
                yield "safety.run_up", text

    def _in_zeros(self) -> Iterator[Objection]:
        """Servos in position mode that are to be held where they must not be, or have nowhere to go."""
        for joint, entry in self.servos.items():
            kind = self.kinds[entry.kind]
            limits = kind.limits.position_deg
            if kind.mode != "position" or limits is None:
                continue
            if entry.hold_at_deg is not None and not limits[0] <= entry.hold_at_deg <= limits[1]:
                text = f"is beyond limits.position_deg; use {limits[0]:g} to {limits[1]:g}"
                yield f"servos.{joint}.hold_at_deg", text
            lowest, highest = MappedServo(joint, entry, kind).tick_limits
            if lowest > highest:
                text = (
                    f"leaves no tick of 0 to {TICKS_PER_TURN - 1}, the turn of position mode, within "
                    "limits.position_deg; use that of the zero posture (`dynsim hw calibrate`)"
                )
                yield f"servos.{joint}.zero_tick", text


class MappedServo:
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
    entry : str
        File, line and key of the entry, or of its ``label``: for errors.
    """

    def __init__(self, joint: str, entry: ServoEntry, kind: Kind, origin: Origin | None = None) -> None:
        self.joint = joint
        keys = ("servos", joint, *(["label"] if entry.label else []))
        self.entry = f"{origin.location(keys)}: {dotted(keys)}" if origin else dotted(keys)
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

    def __str__(self) -> str:
        return f"{self.joint} (ID {self.id})"

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
    bus : BusSettings
    safety : Safety
    lifts : Lifts or None
    servos : tuple of MappedServo
    """

    def __init__(self, content: _MapFile, origin: Origin) -> None:
        self.path = Path(origin.file)
        self.robot = content.robot
        self.bus = content.bus
        self.safety = content.safety
        self.lifts = content.lifts
        self.servos = tuple(
            MappedServo(joint, entry, content.kinds[entry.kind], origin) for joint, entry in content.servos.items()
        )

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
            f"a servo map is named by its file, or by its name when it is shipped, not by {brief(path)}"
        )
    path = Path(path)
    shipped = SHIPPED / f"{path.stem}.yaml"
    named = path.parent in (Path(), Path("scenarios/hardware")) and shipped.is_file()
    if named and not is_file(path, ServoMapError):
        path = shipped
    return ServoMap(*read_located(path, _MapFile))


def json_schema() -> dict[str, Any]:
    """JSON schema of servo maps, for editors.

    It cannot say what ties entries together: that ``kind`` names one of ``kinds``, that IDs differ, and that the lower
    limit is below the upper one. Loading checks these.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_MapFile.model_json_schema()}

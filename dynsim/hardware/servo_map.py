"""Servo maps: schema, checks and files, conversions between joints and servos, safety settings, and calibration.

A joint angle [rad] and the servo position [ticks] are related by

    tick = zero_tick + sign · gear · angle / (2π/4096)

where ``gear`` is the number of servo turns per joint turn. Internally, all angles are in radians; the name of a key
contains the unit if it is not an SI unit.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import core_schema
from ruamel.yaml import YAML

from dynsim.config.base import Positive, StrictConfig, error_at
from dynsim.config.problems import Origin, dotted, explain, suggest, unknown_keys
from dynsim.errors import RecordError, brief
from dynsim.hardware.bus.control_table import (
    BAUD_RATES,
    EXTENDED_TURNS,
    MAX_ID,
    MODELS,
    MX_106,
    PWM_PER_UNIT,
    RAD_PER_TICK,
    RAD_S_PER_UNIT,
    SINGLE_TURN,
    STATE_BLOCK,
    VOLT_PER_UNIT,
    OperatingMode,
    ServoModel,
)
from dynsim.hardware.bus.protocol import Bus, NoAnswer, RequestRefused
from dynsim.hardware.errors import ServoMapError, VerificationFailed
from dynsim.snake.lifting import Lifts
from dynsim.system.files import file_name, write_text
from dynsim.system.inputs import is_file, parse_yaml, read_text

# Functions that read YAML files for hardware (servo maps, fault scripts, gates) into pydantic models; error messages
# state file, line and key.


Objection = tuple[str, str]
"""Dotted key of a value in a file, and the reason why the value is rejected."""


@dataclass(frozen=True)
class Within:
    """Annotation for a number from ``low`` to ``high``; the error message states ``why`` and this range."""

    low: float
    high: float
    unit: str
    why: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        json_schema = {key: value for key, value in handler(schema).items() if key != "exclusiveMinimum"}
        return json_schema | {"minimum": self.low, "maximum": self.high}

    def _checked(self, value: float) -> float:
        if not self.low <= value <= self.high:
            bounds = f"{self.low:g} to {self.high:g}{self.unit and ' ' + self.unit}"
            raise ValueError(f"{self.why}; use {bounds}")
        return value


_Schema = TypeVar("_Schema", bound=BaseModel)


def rounded_up(value: float) -> float:
    """Round up to a multiple of 1e-4, so that the value suggested in an error message is valid."""
    return math.ceil(value * 1e4) / 1e4


def read_yaml(path: Path, schema: type[_Schema], context: dict[str, Any] | None = None) -> _Schema:
    """Read a YAML file into a pydantic model, see :func:`read_located`."""
    return read_located(path, schema, context)[0]


def read_located(path: Path, schema: type[_Schema], context: dict[str, Any] | None = None) -> tuple[_Schema, Origin]:
    """Read a YAML file into a pydantic model; return the model and the origin of its values in the file.

    Parameters
    ----------
    path : Path
        YAML file.
    schema : type of BaseModel
        Pydantic model of the file.
    context : dict, optional
        Context that is passed to the validators.

    Raises
    ------
    ServoMapError
        If the file is missing, is not YAML or has an invalid entry; the message states file, line and key.
    """
    data = parse_yaml(read_text(path, ServoMapError), ServoMapError, str(path))
    if not isinstance(data, dict):
        raise ServoMapError(f"{path}: expected a mapping with the keys {', '.join(schema.model_fields)}")
    origin = Origin(path, (data,))
    try:
        return schema.model_validate(data, context=context), origin
    except ValidationError as error:
        raise ServoMapError(explain(error, data, origin, unknown_keys(error, data, origin, schema))) from None


# Sections of a servo map that apply to all servos: serial line, supply, and abort limits.


LONGEST_REACTION = 0.5
"""Maximum time between the first cycle with a fault and the abort [s]."""
STOP_CYCLES = 3
"""Minimum number of cycles that a stop along the path must last."""
ROUNDED = 1e-9
"""Relative rounding error allowed when a number of cycles is compared with a time."""

FaultPolicy = Literal["hold", "decelerate", "off"]

# The servos support 4.5 Mbit/s, but the client library does not.
_BAUD_CHOICES = [rate for rate in BAUD_RATES if rate <= 4_000_000]


class BusSettings(StrictConfig):
    """Settings of the serial line."""

    baud: int = Field(3_000_000, json_schema_extra={"enum": [*_BAUD_CHOICES]}, description="bit rate [bit/s]")
    rate: Positive = Field(200.0, description="cycle rate; each cycle sends goals and reads states [Hz]")
    latency: Annotated[
        Positive, Within(1e-4, 2.54, "s", "must be long enough for an adapter, and at most the longest watchdog time")
    ] = Field(2e-3, description="maximum delay of an answer caused by adapter and operating system [s]")
    return_delay: float = Field(0.0, ge=0, le=508e-6, description="maximum return delay time stored in the servos [s]")

    @model_validator(mode="after")
    def _baud_is_one_of_the_servos(self) -> BusSettings:
        if self.baud not in _BAUD_CHOICES:
            raise error_at("baud", f"must be one of {', '.join(map(str, _BAUD_CHOICES))}")
        return self


class Supply(StrictConfig):
    """Range of supply voltages in which the robot may move."""

    lowest: Positive = Field(10.0, description="minimum voltage [V]")
    highest: Positive = Field(14.8, description="maximum voltage [V]")


class Safety(StrictConfig):
    """Conditions for aborting a motion, and how the robot stops."""

    policy: FaultPolicy = Field(
        "decelerate",
        description="reaction to a fault: `hold` the present position, `decelerate` along the path and hold, or switch "
        "torque `off`",
    )
    stop_time: float = Field(0.3, gt=0, le=3.0, description="duration of a stop with the policy `decelerate` [s]")
    run_up: Annotated[Positive, Within(0.01, 1e5, "rad/s²", "must make the run-up neither very long nor abrupt")] = (
        Field(2.0, description="acceleration of the run-up or run-out if a record starts or ends in motion [rad/s²]")
    )
    approach_velocity: Annotated[
        Positive, Within(1e-3, 1.0, "rad/s", "must be slow, because the move to the start is not checked")
    ] = Field(0.3, description="maximum speed of the move to the start posture [rad/s]")
    start_distance: Annotated[
        Positive, Within(1e-3, 2 * math.pi, "rad", "must require confirmation sometimes, but not always")
    ] = Field(0.5, description="a joint farther than this from the start posture needs a second confirmation [rad]")
    watchdog: float = Field(0.2, ge=0.02, le=2.54, description="servos stop if the bus is silent for this long [s]")
    missed_cycles: int = Field(
        3, ge=1, le=100, description="consecutive cycles without a status from a servo before an abort"
    )
    late_cycles: int = Field(5, ge=1, le=1000, description="consecutive late cycles before an abort")
    following_cycles: int = Field(
        5, ge=1, le=100, description="consecutive cycles beyond following_error before an abort"
    )
    torque_cycles: int = Field(10, ge=1, le=100, description="consecutive cycles beyond limits.torque before an abort")
    temperature_max: Positive = Field(65.0, description="servo temperature above which the replay aborts [°C]")
    supply: Supply = Field(Supply(), description="voltage range outside which the replay aborts or does not start")
    at_end: Literal["off", "hold"] = Field(
        "off", description="torque after a successful run; use `hold` for a robot that falls without torque"
    )


def objections_to_times(bus: BusSettings, safety: Safety) -> Iterable[Objection]:
    """Yield objections to abort rules that fire too late at the map's rate, and to a stop with too few cycles."""
    if bus.latency >= safety.watchdog:
        yield "bus.latency", "must be below safety.watchdog; otherwise one lost answer would trip the watchdogs"
    for key in ("missed_cycles", "late_cycles", "following_cycles", "torque_cycles"):
        reaction = getattr(safety, key) / bus.rate
        if reaction > LONGEST_REACTION * (1 + ROUNDED):
            most = int(LONGEST_REACTION * bus.rate * (1 + ROUNDED))
            fix = f"use {most} or less" if most else "use a higher bus.rate"
            yield f"safety.{key}", f"takes {reaction:.3g} s at {bus.rate:g} Hz (limit {LONGEST_REACTION:g} s); {fix}"
    if safety.missed_cycles / bus.rate >= safety.watchdog:
        yield (
            "safety.missed_cycles",
            f"takes {safety.missed_cycles / bus.rate:.3g} s at {bus.rate:g} Hz, but the watchdogs trip after "
            f"{safety.watchdog:g} s; use fewer cycles or a longer safety.watchdog",
        )
    if safety.stop_time < STOP_CYCLES / bus.rate:
        yield (
            "safety.stop_time",
            f"is less than {STOP_CYCLES} cycles at {bus.rate:g} Hz; use {rounded_up(STOP_CYCLES / bus.rate):g} or more",
        )


_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent / "scenarios" / "hardware"
SHIPPED = _CHECKOUT if _CHECKOUT.is_dir() else _PACKAGE / "shipped_scenarios" / "hardware"
"""Folder with the servo maps that are shipped with dynsim."""


MAX_FOLLOWING_ERROR = 1.0
"""Largest limit allowed for the following error of a position servo [rad]; a larger limit would have no effect."""
ROOM = 20.0
"""Room temperature, which is assumed for a servo that has not moved yet [°C]."""

_NO_LIMIT = "would have no effect or reject every motion"


class Follows(StrictConfig):
    """Signals in the record that a servo follows."""

    position: str = Field(description="signal with the joint angle [rad]")
    velocity: str = Field(description="signal with the joint rate [rad/s]")
    torque: str | None = Field(
        None, description="signal with the joint torque [N m], which the offline check compares with limits.torque"
    )
    rates: Literal["continuous", "held"] = Field(
        "continuous",
        description="joint rate between samples: `continuous`, or `held` constant (for a sampled controller)",
    )


class Limits(StrictConfig):
    """Limits of a joint.

    The default acceleration allows the record of the published arm, in which a joint rate jumps to 2.6 rad/s within
    5 ms at the start; use a lower value for a joint that turns a load. The default jerk rejects a zigzag of 2 mrad
    every 5 ms.
    """

    position_deg: tuple[float, float] | None = Field(
        None, description="minimum and maximum joint angle [°]; required in position mode, not allowed for wheels"
    )
    velocity: Positive = Field(description="maximum joint speed [rad/s]")
    torque: Positive = Field(description="joint torque at which the replay aborts [N m]")
    acceleration: Annotated[Positive, Within(0.01, 1e5, "rad/s²", _NO_LIMIT)] = Field(
        2000.0, description="maximum acceleration of the path, including between samples [rad/s²]"
    )
    jerk: Annotated[Positive, Within(0.01, 1e7, "rad/s³", _NO_LIMIT)] = Field(
        60_000.0, description="maximum magnitude of the jerk, averaged over 0.1 s [rad/s³]"
    )
    shaking: Annotated[Positive, Within(0.01, 100.0, "rad/s", _NO_LIMIT)] = Field(
        3.0, description="maximum change of velocity that is reversed within 0.3 s [rad/s]"
    )


# Part of the JSON schema for editors; when a map is loaded, Kind._objections checks the same rule.
_POSITION_NEEDS_LIMITS: dict[str, Any] = {
    "if": {"properties": {"mode": {"enum": ["position", "extended_position"]}}},
    "then": {
        "properties": {"limits": {"required": ["position_deg"], "properties": {"position_deg": {"type": "array"}}}}
    },
}


def _refuse_protocol_1(model: Any) -> Any:
    """Reject models that support Protocol 1 only: the series AX, DX, EX and RX, and MX-12W."""
    if isinstance(model, str) and re.match(r"(AX|DX|EX|RX)[-_]?\d|MX[-_]?12", model, re.IGNORECASE):
        raise ValueError("uses Protocol 1, which is unsupported; use a servo with Protocol 2.0, such as XL430-W250")
    return model


class Kind(StrictConfig):
    """Settings that several servos share."""

    model: Annotated[
        Literal[
            "MX-106", "MX-64", "MX-28", "XL330-M077", "XL330-M288", "XL430-W250", "XC430-W150", "XC430-W240",
            "XM430-W210", "XM430-W350", "XM540-W150", "XM540-W270", "XH540-W150", "XH540-W270",
        ],
        BeforeValidator(_refuse_protocol_1),
    ] = Field(description="model of the servo")  # fmt: skip
    mode: Literal["position", "velocity", "extended_position"] = Field(
        description="operating mode: position for joints, extended_position for joints that need more than one turn of "
        "the servo, velocity for wheels"
    )
    firmware_min: int = Field(41, description="oldest firmware version that is accepted")
    follows: Follows = Field(description="signals of the record that the servo follows")
    limits: Limits = Field(description="limits of the joint")
    following_error: Positive = Field(
        description="maximum difference between measured and commanded value: [rad] in position mode, [rad/s] in "
        "velocity mode"
    )
    gear: Positive = Field(1.0, description="servo turns per joint turn")

    model_config = ConfigDict(json_schema_extra=_POSITION_NEEDS_LIMITS)

    @model_validator(mode="after")
    def _fits_its_servo(self) -> Kind:
        for key, text in self._objections():
            raise error_at(key, text)
        return self

    def _objections(self) -> Iterator[Objection]:
        """Yield objections to values that this servo and gear cannot reach, and to abort rules that can never fire."""
        model, gear, limits, error = MODELS[self.model], self.gear, self.limits, self.following_error
        position = limits.position_deg
        # Speed and torque are assumed to be proportional to the supply voltage.
        highest = model.highest_voltage / model.rated_voltage
        speed, stall = model.no_load_speed * highest / gear, model.stall_torque * highest * gear
        in_position_mode = self.mode != "velocity"
        if in_position_mode and position is None:
            yield "limits", f"mode: {self.mode} requires limits.position_deg; add it as [lowest, highest]"
        if position is not None and not position[0] < position[1]:
            yield "limits.position_deg", f"{position[0]} must be below {position[1]}"
        if limits.velocity > speed:
            yield (
                "limits.velocity",
                f"the maximum speed of a {model.name} at this joint is {speed:.3g} rad/s; use that or less",
            )
        if limits.torque > stall:
            yield "limits.torque", f"a {model.name} stalls at {stall:.3g} N m at this joint; use that or less"
        if limits.torque < (least := model.torque(1) * gear):
            text = f"is below the torque resolution of a {model.name}; use {rounded_up(least):g} N m or more"
            yield "limits.torque", text
        unit, name = (RAD_PER_TICK, "rad") if in_position_mode else (RAD_S_PER_UNIT, "rad/s")
        if error < unit / gear:
            yield "following_error", f"is below the servo resolution; use {rounded_up(unit / gear):g} {name} or more"
        if not in_position_mode and position is not None:
            text = "conflicts with mode: velocity, which has no angle limits; remove it or use mode: position"
            yield "limits.position_deg", text
        if in_position_mode and position is not None:
            if self.mode == "position" and (position[1] - position[0]) * gear > 360.0:
                text = (
                    f"exceeds the range of position mode, one servo turn; use {360 / gear:.4g}° of joint angle or "
                    "less, or mode: extended_position"
                )
                yield "limits.position_deg", text
            if error > MAX_FOLLOWING_ERROR:
                yield "following_error", f"is above {MAX_FOLLOWING_ERROR:g} rad and would have no effect; use less"
        elif error > limits.velocity:
            yield "following_error", "is above limits.velocity, so that a stopped servo would not be detected; use less"


def _not_a_flag(value: Any) -> Any:
    """Reject Booleans, because ``True`` equals 1 and would be accepted as a sign."""
    if isinstance(value, bool):
        raise ValueError("must be 1 or -1")
    return value


_Sign = Annotated[Literal[1, -1], BeforeValidator(_not_a_flag)]
_Zero = Annotated[int, Field(ge=-(1 << 20), le=1 << 20)]


class PairedServo(StrictConfig):
    """Second servo on the axle of a joint: the same kind and the same goals, with its own ID, direction and zero."""

    id: int = Field(ge=0, le=MAX_ID, description="ID on the bus")
    sign: _Sign = Field(-1, description="direction of rotation relative to the joint; -1 if the servos face each other")
    zero_tick: _Zero = Field(2048, description="servo position at the zero angle of the joint [ticks of 0.088°]")
    max_difference_deg: Annotated[Positive, Within(0.1, 30.0, "°", "must allow backlash, but not a wrong zero")] = (
        Field(3.0, description="maximum difference between the joint angles that the two servos measure [°]")
    )


class ServoEntry(StrictConfig):
    """One servo: its kind, bus ID, direction of rotation, zero position, record column, and fixed angle, if any."""

    kind: str = Field(description="name of an entry in `kinds`")
    id: int = Field(ge=0, le=MAX_ID, description="ID on the bus")
    sign: _Sign = Field(1, description="direction of rotation of the servo relative to the joint")
    zero_tick: _Zero = Field(2048, description="servo position at the zero angle of the joint [ticks of 0.088°]")
    label: str | None = Field(None, description="label of the column in the record; default: the name of the joint")
    hold_at_deg: float | None = Field(None, description="fixed joint angle, used instead of the record [°]")
    pair: PairedServo | None = Field(None, description="second servo on the same axle")


def _is_a_file_name(robot: str) -> str:
    if file_name(robot) != robot:
        raise ValueError(f"must be a valid folder name, because results are saved there; use {file_name(robot)!r}")
    return robot


class _MapFile(StrictConfig):
    """Servo map, which defines the column of a record that each servo follows, and the limits of its joint."""

    model_config = ConfigDict(title="ServoMap")

    robot: Annotated[str, AfterValidator(_is_a_file_name)] = Field(
        description="name of the robot, which is also part of the name of the results folder"
    )
    bus: BusSettings = Field(BusSettings(), description="settings of the serial line")
    safety: Safety = Field(Safety(), description="conditions for aborting a motion, and how the robot stops")
    lifts: Lifts | None = Field(None, description="how a snake robot lifts its wheel pairs")
    kinds: dict[str, Kind] = Field(description="settings shared by several servos")
    servos: dict[str, ServoEntry] = Field(
        json_schema_extra={"minProperties": 1}, description="servo of each joint; the key is the name of the joint"
    )

    @model_validator(mode="after")
    def _entries_fit_each_other(self) -> _MapFile:
        objections = itertools.chain(self._in_names(), self._in_safety(), objections_to_times(self.bus, self.safety))
        for key, text in itertools.chain(objections, self._in_zeros()):
            raise error_at(key, text)
        return self

    def _in_names(self) -> Iterator[Objection]:
        """Yield objections to IDs and columns that are used twice, and to kinds and joints that do not exist."""
        if not self.servos:
            yield "servos", "must list at least one servo"
        owner: dict[int, str] = {}
        follower: dict[tuple[str, str], str] = {}
        for joint, entry in self.servos.items():
            if entry.kind not in self.kinds:
                like = suggest(entry.kind, self.kinds)
                yield f"servos.{joint}.kind", f"must be one of {', '.join(self.kinds)}{like}"
            ids = {f"servos.{joint}.id": entry.id} | ({f"servos.{joint}.pair.id": entry.pair.id} if entry.pair else {})
            for key, id_ in ids.items():
                if id_ in owner:
                    yield key, f"is also the ID of {owner[id_]}"
                owner[id_] = joint
            if entry.pair and entry.kind in self.kinds and self.kinds[entry.kind].mode == "velocity":
                yield f"servos.{joint}.pair", "requires a kind with mode: position or extended_position"
            column = (self.kinds[entry.kind].follows.position, entry.label or joint)
            if entry.hold_at_deg is None and (other := follower.setdefault(column, joint)) != joint:
                text = f"{other} already follows column {column[1]!r} of signal {column[0]!r}"
                hint = f"; if both servos turn one axle, use servos.{other}.pair: {{id: {entry.id}}}"
                yield f"servos.{joint}.label", text + hint
        for joint in self.lifts.joints if self.lifts else ():
            if joint not in self.servos:
                yield "lifts.joints", f"{joint} is not in servos"
            entry = self.servos[joint]
            if self.kinds[entry.kind].mode != "position" or entry.hold_at_deg not in (None, 0):
                yield "lifts.joints", f"{joint} must be in position mode, without hold_at_deg or with hold_at_deg: 0"

    def _in_safety(self) -> Iterator[Objection]:
        """Yield objections to settings in ``safety`` that conflict with the kinds in use or their servo models.

        These include abort thresholds at which a servo would already have switched its own torque off.
        """
        safety, hottest, supply = self.safety, self.safety.temperature_max, self.safety.supply
        kinds = {name: self.kinds[name] for name in dict.fromkeys(entry.kind for entry in self.servos.values())}
        if supply.lowest >= supply.highest:
            yield "safety.supply.lowest", "must be below supply.highest"
        if hottest <= ROOM:
            text = f"must be above room temperature ({ROOM:g} °C); otherwise every run would abort; use about 65"
            yield "safety.temperature_max", text
        for model in (MODELS[kind.model] for kind in kinds.values()):
            limp = model.fields["temperature_limit"].default
            low, high = model.fields["min_voltage"].low, model.fields["max_voltage"].high
            if hottest > limp:
                yield "safety.temperature_max", f"a {model.name} switches its torque off at {limp} °C; use that or less"
            if low is not None and supply.lowest < low * VOLT_PER_UNIT:
                yield "safety.supply.lowest", f"a {model.name} requires at least {low * VOLT_PER_UNIT:g} V"
            if high is not None and supply.highest > high * VOLT_PER_UNIT:
                yield "safety.supply.highest", f"a {model.name} allows at most {high * VOLT_PER_UNIT:g} V"
        for name, kind in kinds.items():
            limits = kind.limits
            if kind.mode != "velocity" and safety.approach_velocity > limits.velocity:
                text = f"is above kinds.{name}.limits.velocity; use {limits.velocity:g} or less"
                yield "safety.approach_velocity", text
            if (needed := limits.velocity / safety.stop_time) > limits.acceleration:
                least = rounded_up(limits.velocity / limits.acceleration)
                text = f"stops kinds.{name} at {needed:.4g} rad/s², above its limit; use {least:g} or more"
                yield "safety.stop_time", text
            if safety.run_up > limits.acceleration:
                text = f"is above kinds.{name}.limits.acceleration, {limits.acceleration:g} rad/s²; use that or less"
                yield "safety.run_up", text

    def _in_zeros(self) -> Iterator[Objection]:
        """Yield objections to fixed angles outside the limits, and to servos that have no allowed position."""
        for joint, entry in self.servos.items():
            kind = self.kinds[entry.kind]
            limits = kind.limits.position_deg
            if kind.mode == "velocity" or limits is None:
                continue
            if entry.hold_at_deg is not None and not limits[0] <= entry.hold_at_deg <= limits[1]:
                text = f"is outside limits.position_deg; use {limits[0]:g} to {limits[1]:g}"
                yield f"servos.{joint}.hold_at_deg", text
            for servo in servos_of(joint, entry, kind):
                lowest, highest = servo.tick_limits
                if lowest > highest:
                    text = (
                        f"puts limits.position_deg outside ticks {servo.turn[0]} to {servo.turn[1]}, the range of "
                        f"{kind.mode.replace('_', ' ')} mode; measure it with `dynsim hw calibrate`"
                    )
                    yield f"{dotted(servo.keys)}.zero_tick", text


class MappedServo:
    """One servo in the map, with conversions between joint units and servo units.

    Attributes
    ----------
    joint, axle, label : str
        Name of the servo, name of its joint, and label of its column in the record. The names of servo and joint are
        equal, except for the second servo of a pair.
    keys : tuple of str
        Keys of the entry in the file.
    max_difference : float
        Maximum difference of the joint angles that the two servos of a pair measure [rad]; NaN unless this is the
        second servo of a pair.
    id : int
    model : ServoModel
    kind : Kind
    position_limits : tuple of float
        Minimum and maximum joint angle [rad]; infinite for a wheel.
    entry : str
        File, line and key of the entry or of its ``label``, for error messages.
    """

    def __init__(
        self, joint: str, entry: ServoEntry, kind: Kind, origin: Origin | None = None, pair: PairedServo | None = None
    ) -> None:
        self.joint, self.axle = f"{joint}.pair" if pair else joint, joint
        self.keys = ("servos", joint, *(["pair"] if pair else []))
        keys = (*self.keys, *(["label"] if entry.label and not pair else []))
        self.entry = f"{origin.location(keys)}: {dotted(keys)}" if origin else dotted(keys)
        self.label = entry.label or joint
        shaft = pair or entry
        self.id, self.sign, self.zero_tick = shaft.id, shaft.sign, shaft.zero_tick
        self.max_difference = math.radians(pair.max_difference_deg) if pair else math.nan
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
        """True in position mode and in extended position mode."""
        return self.kind.mode != "velocity"

    @property
    def counts_turns(self) -> bool:
        """True in extended position mode."""
        return self.kind.mode == "extended_position"

    @property
    def operating_mode(self) -> OperatingMode:
        """Value that the operating mode register (address 11) of this servo must contain."""
        return OperatingMode[self.kind.mode.upper()]

    @property
    def turn(self) -> tuple[int, int]:
        """Lowest and highest goal that the operating mode allows [ticks]."""
        return EXTENDED_TURNS if self.counts_turns else SINGLE_TURN

    def bound_text(self, angle: float) -> str:
        """Describe a limit of the joint angle [rad]: tick, zero, the reason for the limit, and its entry in the map."""
        tick, own = self.to_ticks(angle), any(math.isclose(angle, limit) for limit in self.position_limits)
        reason = "limits.position_deg" if own else "end of the turn in position mode"
        return f"tick {tick}, zero_tick {self.zero_tick}, {reason}, {self.entry}"

    def to_ticks(self, angle: float) -> int:
        """Return the servo position [ticks] for a joint angle [rad]."""
        return self.zero_tick + round(self.sign * self.gear * angle / RAD_PER_TICK)

    def to_angle(self, ticks: int) -> float:
        """Return the joint angle [rad] for a servo position [ticks]."""
        return self.sign * (ticks - self.zero_tick) * RAD_PER_TICK / self.gear

    def to_velocity_units(self, velocity: float) -> int:
        """Return the value of the servo's velocity register for a joint velocity [rad/s]."""
        return round(self.sign * self.gear * velocity / RAD_S_PER_UNIT)

    def to_velocity(self, units: int) -> float:
        """Return the joint velocity [rad/s] for a value of the servo's velocity register."""
        return self.sign * units * RAD_S_PER_UNIT / self.gear

    def to_torque(self, effort: int) -> float:
        """Return the estimated joint torque [N·m] for a value of the register at address 126."""
        return self.sign * self.gear * self.model.torque(effort)

    def to_pwm(self, units: int) -> float:
        """Return the PWM in the direction of the joint, as a fraction of the supply voltage, for a register value."""
        return self.sign * units * PWM_PER_UNIT

    @property
    def tick_limits(self) -> tuple[int, int]:
        """Lowest and highest goal position that may be sent to this servo [ticks]."""
        if not self.in_position_mode:
            return SINGLE_TURN
        ends = [self.to_ticks(angle) for angle in self.position_limits]
        return max(self.turn[0], min(ends)), min(self.turn[1], max(ends))


def servos_of(joint: str, entry: ServoEntry, kind: Kind, origin: Origin | None = None) -> list[MappedServo]:
    """Return the servo of a map entry, and the second servo if the entry has a ``pair``."""
    return [MappedServo(joint, entry, kind, origin, pair) for pair in (None, *([entry.pair] if entry.pair else []))]


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
            servo
            for joint, entry in content.servos.items()
            for servo in servos_of(joint, entry, content.kinds[entry.kind], origin)
        )

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(servo.id for servo in self.servos)

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(servo.joint for servo in self.servos)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of the two servos of each pair."""
        return [(index - 1, index) for index, servo in enumerate(self.servos) if servo.joint != servo.axle]

    @property
    def lifting(self) -> dict[str, Any]:
        """Entry ``lifts`` for the provenance, with column labels instead of joint names; empty without ``lifts``."""
        if self.lifts is None:
            return {}
        label = {servo.joint: servo.label for servo in self.servos}
        return {"lifts": self.lifts.model_dump() | {"joints": [label[joint] for joint in self.lifts.joints]}}


def load_servo_map(path: str | Path) -> ServoMap:
    """Read and validate a servo map.

    Parameters
    ----------
    path : str or Path
        Path of a file, or the name of a shipped map ("arm", "snake").

    Raises
    ------
    ServoMapError
        If the file is missing, is not YAML or has an invalid entry; the message states the file and the line.
    """
    if not isinstance(path, (str, Path)):
        raise ServoMapError(
            f"expected the path of a servo map or the name of a shipped map (arm, snake), got {brief(path)}"
        )
    path = Path(path)
    shipped = SHIPPED / f"{path.stem}.yaml"
    named = path.parent in (Path(), Path("scenarios/hardware")) and shipped.is_file()
    if named and not is_file(path, ServoMapError):
        path = shipped
    return ServoMap(*read_located(path, _MapFile))


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of servo maps, for use in editors.

    The schema cannot express relations between entries, for example that ``kind`` is a key of ``kinds``, that all IDs
    are different, or that a lower limit is below the upper limit. These relations are checked when a map is loaded.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_MapFile.model_json_schema()}


# Calibration of a servo map: read the zero ticks in a posture that was set by hand, and write zero ticks or signs to
# the map.


Key = Literal["zero_tick", "sign"]
READS = 20
STILL = 3
"""Maximum difference between the positions that are read from a servo at rest [ticks]."""


def read_zero_ticks(bus: Bus, servos: Iterable[MappedServo]) -> dict[str, int]:
    """Return the median of the positions [ticks] that are read from the servo of each joint while the torque is off.

    Raises
    ------
    VerificationFailed
        If the torque of a servo is on, or if a servo does not answer or is moving.
    """
    chosen = list(servos)
    refuse_torque(bus, chosen)
    ticks: dict[str, list[int]] = {servo.joint: [] for servo in chosen}
    for _ in range(READS):
        replies = bus.sync_read([servo.id for servo in chosen], *STATE_BLOCK).replies
        for servo in chosen:
            if servo.id in replies:
                registers = servo.model.registers_in(STATE_BLOCK[0], replies[servo.id].data)
                ticks[servo.joint].append(registers["present_position"])
    for servo in chosen:
        seen = ticks[servo.joint]
        if len(seen) < READS // 2:
            raise VerificationFailed(f"{servo}: answered only {len(seen)} of {READS} reads; check its cable and power")
        if max(seen) - min(seen) > STILL:
            raise VerificationFailed(f"{servo.joint} moves (ticks {min(seen)} to {max(seen)}); hold it still")
    return {joint: int(np.median(seen)) for joint, seen in ticks.items()}


def mark_turns(bus: Bus, servos: Iterable[MappedServo], *, verified: bool = True) -> None:
    """Mark that the posture of servos in extended position mode was verified, or remove the mark.

    The torque must be off. A servo loses the mark when it loses its count of turns, because it restarts.

    Raises
    ------
    NoAnswer, RequestRefused
        If a servo does not answer or refuses the write.
    """
    for servo in servos:
        if servo.counts_turns:
            mark = servo.model.turn_mark
            bus.write(servo.id, mark, mark.default - verified)


def turns_verified(bus: Bus, servo: MappedServo) -> bool:
    """Return whether a servo in extended position mode still has the mark of :func:`mark_turns`."""
    mark = servo.model.turn_mark
    return bus.read(servo.id, mark) == mark.default - 1


def refuse_torque(bus: Bus, servos: Iterable[MappedServo]) -> None:
    """Raise VerificationFailed if the torque of a servo is on or a servo does not answer."""
    for servo in servos:
        try:
            torque = bus.read(servo.id, MX_106.fields["torque_enable"])
        except (NoAnswer, RequestRefused) as error:
            raise VerificationFailed(f"{servo.joint}: {error}; check the power, cable, ID and baud rate") from error
        if torque:
            raise VerificationFailed(f"{servo}: torque is on; switch it off with `dynsim hw stop`")


def write_into_map(servo_map: ServoMap, key: Key, values: Mapping[str, int], path: Path) -> None:
    """Write a copy of the map with new zero ticks or signs; all other entries and comments are kept.

    Parameters
    ----------
    servo_map : ServoMap
        Map to copy.
    key : {"zero_tick", "sign"}
        Key to change.
    values : mapping of str to int
        New value for each joint.
    path : Path
        Output file.

    Raises
    ------
    ServoMapError
        If the limits of a joint would exceed the single turn that position mode allows, or if the file cannot be
        written.
    """
    yaml = YAML(typ="rt")
    yaml.preserve_quotes = True
    yaml.width = 200
    data = yaml.load(servo_map.path.read_text(encoding="utf-8"))
    for servo in servo_map.servos:
        if servo.joint in values:
            entry = data
            for part in servo.keys:
                entry = entry[part]
            entry[key] = values[servo.joint]
    text = io.StringIO()
    yaml.dump(data, text)
    with TemporaryDirectory() as folder:
        draft = Path(folder, servo_map.path.name)
        draft.write_text(text.getvalue(), encoding="utf-8")
        for servo in load_servo_map(draft).servos:
            ends = (
                sorted(servo.to_ticks(angle) for angle in servo.position_limits) if servo.in_position_mode else [0, 0]
            )
            if servo.joint in values and (ends[0] < servo.turn[0] or ends[1] > servo.turn[1]):
                raise ServoMapError(
                    f"{servo.joint}: with sign {servo.sign} and zero_tick {servo.zero_tick} its limits are ticks "
                    f"{ends[0]} to {ends[1]}, outside position mode ({servo.turn[0]} to {servo.turn[1]}); turn the "
                    "horn or narrow the limits"
                )
    try:
        write_text(path, text.getvalue())
    except RecordError as error:
        raise ServoMapError(str(error)) from error

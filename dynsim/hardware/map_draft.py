"""Draft of a servo map for the robot of a scenario: servo models, limits and modes; the user completes it."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from dynsim.errors import CheckRefused
from dynsim.hardware.bus.control_table import MODELS, RAD_S_PER_UNIT, SINGLE_TURN, TICKS_PER_TURN
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.replay.check import plan_cycle
from dynsim.hardware.servo_map import Supply, load_servo_map, rounded_up
from dynsim.model.description import Link
from dynsim.model.drives import Drive, Servo
from dynsim.scenario import Scenario, build
from dynsim.system.files import file_name

BAUD = 1_000_000
RATES = (200, 100, 50, 20)
"""Cycle rates [Hz]; the draft has the highest rate that the bus allows."""
TORQUE, FOLLOWING_ERROR = 0.7, 0.3
"""Assumed abort limits: fraction of the stall torque, and following error [rad]; servos lag by up to 0.2 rad."""
APPROACH = 0.3
"""Assumed speed of the move to the start [rad/s]."""
HOTTEST, COOLER = 65, 5
"""Assumed limit of the temperature [°C], and its minimum distance from the temperature at which a servo shuts down."""
TURN, UNLIMITED = 359.8, 36_000.0
"""Range of a joint in position mode, and limit of a joint without a limit in one direction [°]."""
SUPPLY = (0.875, 1.16)
"""Assumed range of the supply voltage as a fraction of the rated voltage."""
HEADER = """\
Servo map drafted by `dynsim hw map` from {scenario}.
Before the first motion: set every id, measure every zero_tick with `dynsim hw calibrate`, and check every sign with
`dynsim hw calibrate --nudge`. The values of following_error, limits.torque and safety are assumed: adapt them.
"""
LEFT_OUT = "Joints with a motor that have no servo here, because they are not revolute joints of the arm: {joints}.\n"


def draft_map(scenario: Scenario, model: str | None = None) -> str:
    """Return the text of a servo map for the robot of a scenario, which passes all checks of a map.

    Parameters
    ----------
    scenario : Scenario
        Scenario with an arm, whose joints with a motor get servos.
    model : str, optional
        Model of the servos for motors that are not Dynamixel servos of the catalogue.

    Raises
    ------
    ServoMapError
        If the robot is a snake, the arm has no revolute joint with a motor, or the model of a servo is unknown.
    """
    if model is not None and model not in MODELS:
        raise ServoMapError(f"--model must be one of {', '.join(MODELS)}, got {model}")
    if scenario.plant.type == "snake":
        raise ServoMapError("plant.type: snake requires lifts for its wheels; copy and change the map snake.yaml")
    robot = build.robot(scenario)
    objects = tuple(f"{name}." for name in scenario.config.objects)
    links = {link.joint: link for link in robot.links if link.kind == "revolute" and not link.joint.startswith(objects)}
    driven = [motor for motor in robot.motors if not motor.joint.startswith(objects)]
    models = _models([motor for motor in driven if motor.joint in links], model)
    left_out = [motor.joint for motor in driven if motor.joint not in links]
    kinds: dict[str, Any] = {}
    servos: dict[str, Any] = {}
    for number, (joint, (name, wheel)) in enumerate(models.items(), start=1):
        kind, zero = _kind(links[joint], name, wheel)
        title = next((title for title, other in kinds.items() if other == kind), f"kind_{len(kinds) + 1}")
        kinds[title] = kind
        servos[joint] = _flow({"kind": title, "id": number, "sign": 1, "zero_tick": zero})
    used = [MODELS[name] for name, _ in models.values()]
    low = max(math.ceil(10 * SUPPLY[0] * sheet.rated_voltage) / 10 for sheet in used)
    high = min(math.floor(10 * min(SUPPLY[1] * sheet.rated_voltage, sheet.highest_voltage)) / 10 for sheet in used)
    if low >= high:
        raise ServoMapError(f"{', '.join(sorted({sheet.name for sheet in used}))}: have no common supply voltage")
    limp = min(sheet.fields["temperature_limit"].default for sheet in used)
    content = {
        "robot": file_name(scenario.name),
        "bus": _flow({"baud": BAUD, "rate": RATES[-1], "latency": 0.002, "return_delay": 0}),
        "safety": {
            "policy": "decelerate",
            "at_end": "hold",
            "approach_velocity": min(APPROACH, *(kind["limits"]["velocity"] for kind in kinds.values())),
            "temperature_max": min(HOTTEST, limp - COOLER),
            "supply": _flow(Supply(lowest=low, highest=high).model_dump()),
        },
        "kinds": kinds,
        "servos": servos,
    }
    comment = HEADER.format(scenario=scenario.name) + (LEFT_OUT.format(joints=", ".join(left_out)) if left_out else "")
    for rate in RATES:
        content["bus"]["rate"] = rate
        text = _text(content, comment)
        try:
            with TemporaryDirectory() as folder:
                path = Path(folder, "map.yaml")
                path.write_text(text, encoding="utf-8")
                plan_cycle(load_servo_map(path), rate)
        except CheckRefused:
            continue
        return text
    raise ServoMapError(f"{len(servos)} servos are too many for a bus at {BAUD} bit/s")


def _models(motors: Sequence[Drive], model: str | None) -> dict[str, tuple[str, bool]]:
    """Return the model of the servo of each joint with a motor, and whether the servo is in velocity mode."""
    sheets = {motor.joint: motor.sheet if isinstance(motor, Servo) else "" for motor in motors}
    if not sheets:
        raise ServoMapError("the arm has no revolute joint with a motor; add motors, such as motor: {type: xm430_w350}")
    if missing := [joint for joint, sheet in sheets.items() if sheet not in MODELS and model is None]:
        raise ServoMapError(
            f"the motors of {', '.join(missing)} are not Dynamixel servos; use motor: {{type: xm430_w350}} or another "
            "servo of the catalogue (`dynsim list`), or --model MODEL"
        )
    wheels = {motor.joint: isinstance(motor, Servo) and motor.velocity_mode for motor in motors}
    return {joint: (sheet if sheet in MODELS else str(model), wheels[joint]) for joint, sheet in sheets.items()}


def _kind(link: Link, name: str, wheel: bool) -> tuple[dict[str, Any], int]:
    """Return the kind of a servo, and its zero [ticks]: the middle of the turn, or such that the limits fit."""
    sheet = MODELS[name]
    # Some vendors write 0 for an unknown limit.
    speed, torque = link.velocity_limit or math.inf, link.effort_limit or math.inf
    speed = min(speed, sheet.no_load_speed, sheet.fields["velocity_limit"].default * RAD_S_PER_UNIT)
    limits: dict[str, Any] = {
        "velocity": max(math.floor(100 * speed) / 100, 0.01),
        "torque": max(float(f"{min(torque, TORQUE * sheet.stall_torque):.2g}"), rounded_up(sheet.torque(1))),
    }
    mode, zero = "velocity", TICKS_PER_TURN // 2
    if not wheel:
        # Rounded outward by less than an encoder tick, so that a joint may start at its limit.
        low = math.floor(100 * max(math.degrees(link.lower), -UNLIMITED) + 0.01) / 100
        high = math.ceil(100 * min(math.degrees(link.upper), UNLIMITED) - 0.01) / 100
        if not (math.isfinite(link.lower) or math.isfinite(link.upper)):
            low, high = -TURN / 2, TURN / 2
        limits = {"position_deg": _flow([low, high])} | limits
        mode = "position" if high - low <= TURN else "extended_position"
        ticks = [round(angle / 360 * TICKS_PER_TURN) for angle in (low, high)]
        if mode == "position" and not SINGLE_TURN[0] <= zero + ticks[0] <= zero + ticks[1] <= SINGLE_TURN[1]:
            zero -= sum(ticks) // 2
    error = FOLLOWING_ERROR if not wheel else limits["velocity"] / 2
    follows = _flow({"position": "q", "velocity": "v"})
    return {"model": name, "mode": mode, "follows": follows, "limits": _flow(limits), "following_error": error}, zero


def _flow(content: Any) -> Any:
    """Return a mapping or list that is written in one line."""
    flow = CommentedMap(content) if isinstance(content, dict) else CommentedSeq(content)
    flow.fa.set_flow_style()
    return flow


def _text(content: dict[str, Any], comment: str) -> str:
    yaml = YAML(typ="rt")
    yaml.width = 200
    document = CommentedMap(content)
    document.yaml_set_start_comment(comment)
    stream = io.StringIO()
    yaml.dump(document, stream)
    return stream.getvalue()

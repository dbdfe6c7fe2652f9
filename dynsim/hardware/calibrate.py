"""Calibration of a servo map: zero ticks read in a zero posture set by hand; zero ticks or signs written to the map."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from ruamel.yaml import YAML

from dynsim.errors import RecordError
from dynsim.hardware.bus.control_table import MX_106, STATE_BLOCK
from dynsim.hardware.bus.protocol import Bus, NoAnswer, RequestRefused
from dynsim.hardware.errors import ServoMapError, VerificationFailed
from dynsim.hardware.servo_map import MappedServo, ServoMap, load_servo_map
from dynsim.system.files import write_text

Key = Literal["zero_tick", "sign"]
READS = 20
STILL = 3
"""Largest spread over the reads of a servo at rest [ticks]."""


def read_zero_ticks(bus: Bus, servos: Iterable[MappedServo]) -> dict[str, int]:
    """Median servo position of each joint, torque being off.

    Raises
    ------
    VerificationFailed
        Torque is on, a servo does not answer, or moves.
    """
    chosen = list(servos)
    refuse_torque(bus, chosen)
    ticks: dict[str, list[int]] = {servo.joint: [] for servo in chosen}
    for _ in range(READS):
        replies = bus.sync_read([servo.id for servo in chosen], *STATE_BLOCK).replies
        for servo in chosen:
            if servo.id in replies:
                ticks[servo.joint].append(int.from_bytes(replies[servo.id].data[6:10], "little", signed=True))
    for servo in chosen:
        seen = ticks[servo.joint]
        if len(seen) < READS // 2:
            raise VerificationFailed(f"{servo}: {len(seen)} of {READS} reads answered")
        if max(seen) - min(seen) > STILL:
            raise VerificationFailed(f"{servo.joint} moves (ticks {min(seen)} to {max(seen)}); hold it still")
    return {joint: int(np.median(seen)) for joint, seen in ticks.items()}


def refuse_torque(bus: Bus, servos: Iterable[MappedServo]) -> None:
    """Raises VerificationFailed where a servo has its torque on, or does not answer."""
    for servo in servos:
        try:
            torque = bus.read(servo.id, MX_106.fields["torque_enable"])
        except (NoAnswer, RequestRefused) as error:
            raise VerificationFailed(f"{servo.joint}: {error}; check power, cable, ID and baud rate") from error
        if torque:
            raise VerificationFailed(f"{servo}: torque is on; `dynsim hw stop` releases it")


def write_into_map(servo_map: ServoMap, key: Key, values: Mapping[str, int], path: Path) -> None:
    """Write the map with new zero ticks or senses, by joint, to ``path``; all else, comments too, stays as it is.

    Raises
    ------
    ServoMapError
        With the new value a joint's limits would leave the single turn position mode knows, or the file cannot be
        written.
    """
    yaml = YAML(typ="rt")
    yaml.preserve_quotes = True
    yaml.width = 200
    data = yaml.load(servo_map.path.read_text(encoding="utf-8"))
    for joint, value in values.items():
        data["servos"][joint][key] = value
    text = io.StringIO()
    yaml.dump(data, text)
    with TemporaryDirectory() as folder:
        draft = Path(folder, servo_map.path.name)
        draft.write_text(text.getvalue(), encoding="utf-8")
        for servo in load_servo_map(draft).servos:
            ends = (
                sorted(servo.to_ticks(angle) for angle in servo.position_limits) if servo.in_position_mode else [0, 0]
            )
            if servo.joint in values and (ends[0] < 0 or ends[1] > 4095):
                raise ServoMapError(
                    f"{servo.joint}: with sign {servo.sign} and zero at tick {servo.zero_tick} its limits reach ticks "
                    f"{ends[0]} to {ends[1]}, position mode ends at 0 and 4095; turn the horn or narrow the limits"
                )
    try:
        write_text(path, text.getvalue())
    except RecordError as error:
        raise ServoMapError(str(error)) from error
